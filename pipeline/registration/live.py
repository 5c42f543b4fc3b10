"""Follow a registration while it is in use: one new tracked frame in, drift out.

The pose is a state of six numbers that may creep; each frame measures it a little. An information
filter adds up what the frames say: the state's information is that of the registration, less what
the time since may have undone, plus the frame's own (as in A. H. Jazwinski, "Stochastic Processes
and Filtering Theory", Academic Press 1970, chapter 7, with the frame's loss expanded to second
order about the present pose in the place of a linear measurement). What all frames share no frame
can tell: it is considered, not estimated, and stays in the covariance (S. F. Schmidt, "Application
of state-space methods to navigation problems", Adv Control Syst 3 (1966) 293-340).
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, MovingSurface
from pipeline.imaging.cine import Cine
from pipeline.registration.frames import Lattice, Samples, TrackedSweep, lattice_of, sample_pictures
from pipeline.registration.pose_search import Pivot
from pipeline.registration.reading import Reader, as_compared
from pipeline.registration.search import Level, prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.space import Registration
from pipeline.registration.tissue_map import TissueMap
from pipeline.registration.uncertainty import STEP_MM, curvature_at, rising, sandwich

# A step of one frame beyond this is no drift but an outlier; it is cut to this length.
_LONGEST_STEP_MM = 1.0
# A frame that agrees with the model by less than this share of what is usual shows something else.
_ODD_SHARE = 0.5
# Share of the difference by which a frame changes what is usual.
_FOLLOWED = 0.1

LOST_AFTER = 10
"""So many frames in a row that show a body and disagree are no chance: they show something else, or
tracker or patient have moved farther than a frame's optimum reaches. Beside its place one frame in
some agrees by chance, so that as many in a row have to agree before the pose is trusted again."""


@dataclass(frozen=True, slots=True)
class LiveState:
    """What is known at one moment."""

    mr_from_tracker: Float
    """4x4, the present estimate."""

    covariance_mm2: Float
    """``(6, 6)`` of its error, in square millimetres of `Pivot.move`; `Follower.shared_mm2` is part
    of it."""

    usual: float
    """Running mean of the share of grey values that the model explains."""

    astray: int = 0
    """How many frames in a row, up to now, show a body and do not agree; while the pose is lost,
    how many in all."""

    picture: int = 0
    """Checksum of the last frame's grey values: shown again they tell nothing."""

    agreed: int = 0
    """How many frames in a row, up to now, agree since the pose was lost; 0 while it is not."""

    @property
    def lost(self) -> bool:
        """Whether the pose, and its covariance, are to be trusted no longer (`LOST_AFTER`): as many
        frames in a row that agree say that they are, or a new registration."""
        return self.astray >= LOST_AFTER


@dataclass(frozen=True, slots=True)
class Drift:
    """What one frame said."""

    state: LiveState
    """After the frame."""

    shift_mm: float
    """How far the heart's middle has moved since the registration."""

    turn_deg: float
    """How far it has turned."""

    used: bool
    """Whether the frame agreed with the model well enough to count."""


@dataclass(frozen=True, slots=True)
class Eye:
    """How new pictures of one sweep's geometry are looked at."""

    lattice: Lattice
    reader: Reader | None
    """Finds the blood that is compared; None: grey values are."""

    shape: tuple[int, int]
    """Rows and columns of the sweep's pictures."""

    def require(self, image: Float32, tracker_from_image: Float) -> None:
        """Raise an InputError for a picture of another size, or for what is no transform."""
        if np.shape(image) != self.shape:
            raise InputError(
                f"a frame must be of its sweep's size, {self.shape[0]} rows and {self.shape[1]} "
                f"columns of grey values; got {np.shape(image)}: give the eye of its own sweep"
            )
        transform = np.asarray(tracker_from_image)
        # One that was lost, all NaN, is no frame's place, but is what trackers tell.
        if transform.shape != (4, 4) or (
            np.isfinite(transform[3]).all() and not np.allclose(transform[3], [0, 0, 0, 1])
        ):
            raise InputError(
                "tracker_from_image must be a 4x4 transform with 0 0 0 1 for its last row; got "
                f"{np.array2string(transform, threshold=16)}"
            )

    def sample(self, image: Float32, tracker_from_image: Float, phase: float) -> Samples:
        """Samples of one picture ``(h, w)``; none where it shows no body or has no pose."""
        images, transforms = image[None], tracker_from_image[None]
        if self.reader is not None:
            images, transforms = self.reader.read(images), self.reader.placed(transforms)
        return sample_pictures(self.lattice, images, transforms, np.array([phase]))


@dataclass(frozen=True, slots=True)
class Follower:
    """All that does not change from frame to frame."""

    tissue: TissueMap
    """The model, blurred as the frames are smoothed."""

    pivot: Pivot
    registered: Float
    """4x4: the registration that is followed."""

    information_of_loss: float
    """How much information, per square millimetre, a unit of a frame's curvature is worth: below 1
    where samples and neighbouring frames repeat one another."""

    shared_mm2: Float
    """``(6, 6)`` covariance of what all frames share, such as the error of the surfaces, in square
    millimetres of `Pivot.move`: however many follow, they cannot tell it."""

    creep_mm: float = 0.1
    """Standard deviation by which the pose may change from frame to frame, along each axis and
    about each axis at the pivot's lever."""

    def follow(
        self, state: LiveState, eye: Eye, image: Float32, tracker_from_image: Float, phase: float
    ) -> Drift:
        """Refine the state by one frame.

        Parameters
        ----------
        eye
            Of the sweep's geometry, from `prepare_follower`.
        image
            ``(h, w)`` grey values.
        tracker_from_image
            4x4: pixel ``(i, j, 0)`` to tracker millimetres.
        phase
            Of the frame, in [0, 1).

        Raises
        ------
        InputError
            When the phase is not in [0, 1), the picture not of the eye's size, or the transform
            none.
        """
        if not 0 <= phase < 1:
            raise InputError(f"a frame's phase must lie in [0, 1), got {phase!r}")
        eye.require(image, tracker_from_image)
        waited = state.covariance_mm2 - self.shared_mm2 + self.creep_mm**2 * np.eye(6)
        picture = zlib.crc32(np.ascontiguousarray(image).tobytes())
        if picture == state.picture:
            return self._left(state, waited)
        state = replace(state, picture=picture)
        samples = eye.sample(image, tracker_from_image, phase)
        if samples.frames == 0:
            return self._left(state, waited)
        level = Level(samples, self.tissue)
        explained = float(level.at(state.mr_from_tracker).explained[0])
        if not explained > _ODD_SHARE * state.usual:
            return self._left(replace(state, astray=state.astray + 1, agreed=0), waited)
        usual = state.usual + _FOLLOWED * (explained - state.usual)
        step, covariance = self._update(level, state.mr_from_tracker, waited)
        pose = self.pivot.move(state.mr_from_tracker, step)
        agreed = state.agreed + 1 if state.lost else 0
        lost = 0 < agreed < LOST_AFTER
        found = LiveState(
            pose,
            covariance + self.shared_mm2,
            usual,
            astray=state.astray if lost else 0,
            picture=picture,
            agreed=agreed if lost else 0,
        )
        return self._drift(found, used=True)

    def _left(self, state: LiveState, waited: Float) -> Drift:
        """After a frame that told nothing."""
        return self._drift(replace(state, covariance_mm2=waited + self.shared_mm2), used=False)

    def _update(self, level: Level, pose: Float, prior_mm2: Float) -> tuple[Float, Float]:
        """Step and covariance after one frame's loss, expanded about the present pose."""

        def slopes(step_mm: Float) -> Float:
            moved = self.pivot.move(pose, step_mm)
            return np.asarray(level.expansion(moved, self.pivot).slopes[0])

        # How the slopes change is a third of the work of how the losses do, to second order.
        steps = STEP_MM * np.eye(6)
        rows = np.array([slopes(step) - slopes(-step) for step in steps]) / (2 * STEP_MM)
        # Where one frame's loss bends the wrong way it says nothing.
        bending = rising((rows + rows.T) / 2)
        information = np.linalg.inv(prior_mm2) + self.information_of_loss * bending
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        step = -self.information_of_loss * covariance @ slopes(np.zeros(6))
        length = float(np.linalg.norm(step))
        return step * min(1.0, _LONGEST_STEP_MM / max(length, 1e-12)), covariance

    def _drift(self, state: LiveState, used: bool) -> Drift:
        shift_mm, turn_deg = self.pivot.distance(state.mr_from_tracker, self.registered)
        return Drift(state, shift_mm, turn_deg, used)


def prepare_follower(
    sweeps: Sequence[TrackedSweep],
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    registered: Registration,
    settings: RegisterSettings | None = None,
    cine: Cine | None = None,
) -> tuple[Follower, LiveState, list[Eye]]:
    """What is needed to follow a registration, from what it was made with.

    Returns
    -------
    The follower, the state to begin with, and for each sweep the eye for new frames of its
    geometry.

    Raises
    ------
    InputError
        As in `pipeline.registration.space.register`.
    StageError
        When the network cannot be loaded.
    """
    settings = settings or RegisterSettings()
    pose = registered.mr_from_tracker
    search = prepare_search(phases, surfaces, pose, settings, cine)
    compared = as_compared(sweeps, settings)
    level = search.fine_level(compared)
    good = np.flatnonzero(registered.valid[level.samples.number])
    level = level.only(good).thinned(settings.max_frames)
    curvature = curvature_at(lambda step_mm: level.losses(search.pivot.move(pose, step_mm)))
    spread = sandwich(curvature, level.samples.sweep)
    scale = np.repeat([1.0, search.pivot.lever_mm], 3)
    covariance_mm2 = registered.covariance * np.outer(scale, scale)
    shared_mm2 = rising(covariance_mm2 - spread)
    follower = Follower(
        search.fine, search.pivot, pose, information_of(spread, curvature.bending), shared_mm2
    )
    lengths_mm = settings.sample_spacing_mm, settings.smoothing_mm, settings.trend_mm
    eyes = [
        Eye(
            lattice_of(seen, *lengths_mm),
            Reader.of(sweep, hurried=True) if settings.reading == "network" else None,
            sweep.images.shape[1:],
        )
        for seen, sweep in zip(compared, sweeps, strict=True)
    ]
    usual = float(np.median(1 - registered.residual[registered.valid]))
    return follower, LiveState(pose, spread + shared_mm2, usual), eyes


def information_of(covariance_mm2: Float, bending: Float) -> float:
    """Information per unit of curvature: so much that all frames' curvature together, ``(6, 6)``,
    is worth what the estimate's covariance says it was."""
    return float(6 / np.trace(covariance_mm2 @ rising(bending)))
