"""How far each sweep's image calibration is off, found together with the pose.

A calibration says where the pixels lie beside the marker that is tracked. Where it is off, or the
probe was clamped anew between sweeps, every picture of a sweep lies beside its place by one rigid
motion that turns with the probe: pixel to corrected pixel, to tracker, to MR. Pose and corrections
minimise the frames' losses and what the corrections cost under a Gaussian belief that they are
small (a maximum a posteriori estimate, by Newton's method). Where the probe hardly turns, a
correction does what a step of the pose does, and only the belief tells them apart: the curvature of
both together says so. What the pose loses by the corrections is the inverse of its Schur complement
less that of its own block (B. Triggs et al., "Bundle adjustment - a modern synthesis", Vision
Algorithms: Theory and Practice, Springer LNCS 1883 (2000) 298-372).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry import Float, Integer, Mask
from pipeline.registration.correction import Correction, tracker_from_picture
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.pose_search import Pivot
from pipeline.registration.search import Level
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.uncertainty import (
    Curvature,
    FrameLosses,
    frame_curvatures,
    in_radians,
    rising,
    sandwich,
    slopes_at,
)

# Rounds of choosing frames, most steps within each, and a step so small that it is the last.
_ROUNDS, _STEPS, _SMALL_MM = 2, 12, 0.05
# No parameter goes further in one step: losses are bowls for some millimetres only.
_LONGEST_MM = 3.0
# Times that a step that does not help is halved.
_HALVINGS = 4
# Information, in losses of all frames a square millimetre, that keeps what no frame fixes solvable.
_FLATTEST = 1e-4


@dataclass(frozen=True, slots=True)
class Calibration:
    """The planes of a study's frames, and how far each sweep's lie beside them."""

    names: tuple[str, ...]
    """Of the sweeps."""

    origins_px: Integer
    """``(sweeps, 2)`` columns and rows: see `Correction`."""

    tracker_from_picture: Float
    """``(frames, 4, 4)`` of all frames of the study, as calibrated."""

    steps_mm: Float
    """``(sweeps, 6)`` corrections: shift, then rotation vector times the pivot's lever."""

    belief_mm: Float
    """``(6,)`` standard deviations of such a correction before any frame is seen."""

    pivot: Pivot

    def placed(self, level: Level) -> Level:
        """The level, of frames as calibrated, with each where its correction puts it."""
        samples = level.samples
        planes = self.tracker_from_picture[samples.number]
        motions = planes @ self._motions()[samples.sweep] @ np.linalg.inv(planes)
        points_mm = np.empty_like(samples.points_mm)
        for motion, first, end in zip(motions, samples.first, samples.first[1:], strict=False):
            points_mm[first:end] = samples.points_mm[first:end] @ motion[:3, :3].T + motion[:3, 3]
        return replace(level, samples=replace(samples, points_mm=points_mm))

    def corrections(self, covariances: Float) -> tuple[Correction, ...]:
        """What was found for each sweep, with ``(sweeps, 6, 6)`` covariances (mm and rad)."""
        each = zip(self.names, self._motions(), self.origins_px, covariances, strict=True)
        return tuple(Correction(n, m, (int(o[0]), int(o[1])), c) for n, m, o, c in each)

    def lifts(self, level: Level, mr_from_tracker: Float) -> Float:
        """``(frames, 6, 6)``: the step of the pose that does to a frame what a small step of its
        sweep's correction does."""
        numbers = level.samples.number
        mr_from_picture = mr_from_tracker @ self.tracker_from_picture[numbers]
        turned = mr_from_picture[:, :3, :3]
        shift_mm = self.steps_mm[level.samples.sweep, :3, None]
        # A correction turns about where it has shifted the origin to; the pose about the pivot.
        origin_mm = (turned @ shift_mm)[..., 0] + mr_from_picture[:, :3, 3]
        arm = (origin_mm - self.pivot.centre_mm) / self.pivot.lever_mm
        lifts = np.zeros((len(numbers), 6, 6))
        lifts[:, :3, :3] = lifts[:, 3:, 3:] = turned
        lifts[:, :3, 3:] = np.cross(arm[:, None], turned.transpose(0, 2, 1)).transpose(0, 2, 1)
        return lifts

    def _motions(self) -> Float:
        """``(sweeps, 4, 4)`` of the corrections."""
        turns = Rotation.from_rotvec(self.steps_mm[:, 3:] / self.pivot.lever_mm)
        motions = np.tile(np.eye(4), (len(self.steps_mm), 1, 1))
        motions[:, :3, :3] = turns.as_matrix()
        motions[:, :3, 3] = self.steps_mm[:, :3]
        return motions


@dataclass(frozen=True, slots=True)
class _Expansion:
    """The cost of pose and corrections about the present ones, to second order."""

    slope: Float
    """``(6 + 6 sweeps,)``, a millimetre: of the pose first, then of each sweep's correction."""

    of_frames: Float
    """Curvature of what the frames say, with nothing that bends the wrong way."""

    of_belief: Float
    """Curvature of what is believed."""

    worth: float
    """Information that a unit of loss stands for."""

    def towards_optimum(self) -> Float:
        """Newton's step, no parameter by more than is safe."""
        step = -np.linalg.solve(self.of_frames + self.of_belief, self.slope)
        return np.asarray(step * min(1.0, _LONGEST_MM / np.abs(step).max()))

    def covariance(self) -> Float:
        """Of pose and corrections together, square millimetres."""
        return np.asarray(np.linalg.inv(self.of_frames + self.of_belief))

    def opened(self) -> Float:
        """``(6, 6)`` by which the covariance of the pose grows for the corrections' sake."""
        return np.asarray(self.covariance()[:6, :6] - np.linalg.inv(self.of_frames[:6, :6]))


def calibration_of(
    sweeps: Sequence[TrackedSweep], level: Level, pivot: Pivot, settings: RegisterSettings
) -> Calibration:
    """The planes of the sweeps' frames, nothing corrected yet.

    Parameters
    ----------
    level
        Samples of the sweeps' frames: the middle of a sector is that of what is looked at.
    """
    begins = np.cumsum([0, *(len(sweep.images) for sweep in sweeps)])
    origins = [_origin_px(sweep, level, k, begins[k]) for k, sweep in enumerate(sweeps)]
    planes = [
        tracker_from_picture(sweep.tracker_from_image, origin)
        for sweep, origin in zip(sweeps, origins, strict=True)
    ]
    turn_mm = np.radians(settings.calibration_sd_deg) * pivot.lever_mm
    return Calibration(
        names=tuple(sweep.name for sweep in sweeps),
        origins_px=np.array(origins),
        tracker_from_picture=np.concatenate(planes),
        steps_mm=np.zeros((len(sweeps), 6)),
        belief_mm=np.repeat([settings.calibration_sd_mm, turn_mm], 3),
        pivot=pivot,
    )


def _origin_px(sweep: TrackedSweep, level: Level, number: int, begin: int) -> Integer:
    """The pixel in the middle of what is looked at in a sweep's frames, the first of which is frame
    ``begin`` of the study."""
    samples = level.samples
    seen = np.flatnonzero(samples.sweep == number)
    if len(seen) == 0:
        return np.array(sweep.images.shape[:0:-1], dtype=np.int64) // 2
    points_mm = samples.points_mm[samples.first[seen[0]] : samples.first[seen[0] + 1]]
    pose = sweep.tracker_from_image[samples.number[seen[0]] - begin]
    middle = np.linalg.lstsq(pose[:3, :2], points_mm.mean(axis=0) - pose[:3, 3], rcond=None)[0]
    return np.asarray(middle.round(), dtype=np.int64)


def calibrate(
    calibration: Calibration,
    level: Level,
    pose: Float,
    settings: RegisterSettings,
    bears_out: Callable[[Level, Float], Mask],
) -> tuple[Calibration, Float]:
    """Pose and corrections that suit all frames best together.

    Parameters
    ----------
    calibration
        From `calibration_of`.
    level
        All frames, as calibrated.
    pose
        4x4 ``mr_from_tracker``, near the optimum.
    bears_out
        Which frames of a level to go by, at a pose: all, if they are too few.
    """
    for _ in range(_ROUNDS):
        good = np.flatnonzero(bears_out(calibration.placed(level), pose))
        chosen = level.only(good) if len(good) >= settings.min_frames else level
        chosen = chosen.thinned(settings.max_frames)
        calibration, pose = _descended(calibration, chosen, pose, settings.model_error_mm)
    return calibration, pose


def certainty(
    calibration: Calibration, placed: Level, pose: Float, settings: RegisterSettings
) -> tuple[Float, tuple[Correction, ...]]:
    """``(6, 6)`` by which the covariance of the pose (mm, rad about the pivot) grows because the
    corrections are not known, and the corrections with their own covariances.

    Parameters
    ----------
    placed
        The frames to go by, where their corrections put them.
    """
    slopes, bending = frame_curvatures(_losses(placed, pose, calibration.pivot))
    expansion = _expansion(calibration, placed, pose, slopes, bending, settings.model_error_mm)
    joint, pivot = expansion.covariance(), calibration.pivot
    blocks = [in_radians(joint[k : k + 6, k : k + 6], pivot) for k in range(6, len(joint), 6)]
    return in_radians(expansion.opened(), pivot), calibration.corrections(np.array(blocks))


def _losses(placed: Level, pose: Float, pivot: Pivot) -> FrameLosses:
    return lambda step_mm: placed.losses(pivot.move(pose, step_mm))


def _descended(
    calibration: Calibration, level: Level, pose: Float, error_mm: float
) -> tuple[Calibration, Float]:
    """The optimum near by. Within the millimetres of a search the bending hardly changes: it is
    taken once, slopes at every step."""
    bending = None
    for _ in range(_STEPS):
        placed = calibration.placed(level)
        losses = _losses(placed, pose, calibration.pivot)
        slopes = slopes_at(losses)
        if bending is None:
            bending = frame_curvatures(losses)[1]
        expansion = _expansion(calibration, placed, pose, slopes, bending, error_mm)
        moved = _moved(calibration, level, pose, expansion)
        if moved is None:
            break
        calibration, pose = moved
    return calibration, pose


def _moved(
    calibration: Calibration, level: Level, pose: Float, expansion: _Expansion
) -> tuple[Calibration, Float] | None:
    """Corrections and pose after a step that lowers the cost; None where there is none to make."""
    step = expansion.towards_optimum()
    before = _cost(calibration, level, pose, expansion.worth)
    for _ in range(_HALVINGS):
        if np.abs(step).max() < _SMALL_MM:
            return None
        steps_mm = calibration.steps_mm + step[6:].reshape(-1, 6)
        there = replace(calibration, steps_mm=steps_mm), calibration.pivot.move(pose, step[:6])
        if _cost(there[0], level, there[1], expansion.worth) < before:
            return there
        step = step / 2
    return None


def _cost(calibration: Calibration, level: Level, pose: Float, worth: float) -> float:
    """Minus the log of the posterior density, but for a constant."""
    believed = 0.5 * ((calibration.steps_mm / calibration.belief_mm) ** 2).sum()
    return float(worth * calibration.placed(level).losses(pose).sum() + believed)


def _expansion(
    calibration: Calibration,
    placed: Level,
    pose: Float,
    slopes: Float,
    bending: Float,
    error_mm: float,
) -> _Expansion:
    """Second order about the present pose and corrections, from the frames' derivatives there.

    A correction does to a frame what a step of the pose does, another one for each frame: the six
    derivatives of a frame's loss are those of all. How the lifts change with the correction
    counts for nothing where slopes cancel, as they do at the optimum.
    """
    sweep, sweeps = placed.samples.sweep, len(calibration.names)
    worth = _worth(Curvature(slopes, rising(bending.sum(axis=0))), sweep, error_mm)
    lifts = calibration.lifts(placed, pose)
    slope, of_frames = np.zeros((1 + sweeps, 6)), np.zeros((6 + 6 * sweeps, 6 + 6 * sweeps))
    slope[0] = worth * slopes.sum(axis=0)
    slope[1:] = calibration.steps_mm / calibration.belief_mm**2
    for number in range(sweeps):
        mine = sweep == number
        slope[1 + number] += worth * np.einsum("fij,fi->j", lifts[mine], slopes[mine])
        both = np.concatenate([np.tile(np.eye(6), (mine.sum(), 1, 1)), lifts[mine]], axis=2)
        where = np.concatenate([np.arange(6), np.arange(6) + 6 * (1 + number)])
        bent = np.einsum("fia,fij,fjb->ab", both, bending[mine], both)
        of_frames[np.ix_(where, where)] += worth * rising(bent)
    of_frames[:6, :6] += worth * _FLATTEST * np.eye(6)
    of_belief = np.diag(np.concatenate([np.zeros(6), np.tile(calibration.belief_mm**-2, sweeps)]))
    return _Expansion(slope.ravel(), of_frames, of_belief, worth)


def _worth(curvature: Curvature, sweep: Integer, error_mm: float) -> float:
    """Information that a unit of loss stands for: so much that all frames' curvature together is
    worth what their spread says, and an error of the model that all share."""
    spread = np.trace(sandwich(curvature, sweep) @ curvature.bending)
    # Frames of which none bends are worth nothing whatever a unit of loss is.
    return float(6 / max(spread + error_mm**2 * np.trace(curvature.bending), _FLATTEST))
