"""Bring tracked ultrasound to the MR model in space: one rigid pose for the whole study.

All frames of all sweeps, each at its own phase of the heartbeat, are compared at once with the
moving surfaces. The search goes from thick blur to thin. Whether its result deserves trust is
decided by searching the same way with frames whose pictures are the same but in the wrong place
(mirrored, or in reverse order): their best score is what chance reaches.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError, StageError
from pipeline.geometry import Float, Integer, Mask, MovingSurface, require_rigid
from pipeline.registration.frames import (
    Samples,
    TrackedSweep,
    backwards,
    choose,
    mirrored,
    sample_frames,
)
from pipeline.registration.pose_search import (
    Pivot,
    climb,
    climb_from_best,
    pivot_of,
    poses_around,
)
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.similarity import agreement
from pipeline.registration.tissue_map import TissueMap, blurred, cavities_of, draw_tissue

# The rough level: what is smaller than 5 mm is gone, so samples may lie twice that apart.
_COARSE_BLUR_MM = 5.0
_COARSE_SPACING_MM = 9.0
_COARSE_FRAMES = 24
_CANDIDATES = 150
# A frame with less of its picture in blood or at its walls has too little to compare.
_LEAST_IN_VIEW = 0.05
# A frame that the model explains less than this share of the usual shows something else.
_LEAST_OF_USUAL = 0.25
_STEPS = 6

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the tracker stands in the MR frame, and how well each frame bears it out."""

    mr_from_tracker: Float
    """4x4, rigid: tracker millimetres to LPS millimetres."""

    residual: Float
    """``(frames,)`` through all sweeps: share of the variance of a frame's grey values that the
    model leaves unexplained; 1 where nothing could be compared."""

    valid: Mask
    """``(frames,)``: the frame meets the heart and agrees with the model, better than at poses
    nearby."""

    score: float
    """Mean over the valid frames of -log(1 - explained share); 0 for no agreement."""

    start_score: float
    """The same, of the same frames, at the start."""

    confidence: float
    """Score over the best that frames in the wrong place reach; 1 is chance."""


@dataclass(frozen=True, slots=True)
class _Level:
    """Frames and model at one degree of blur."""

    samples: Samples
    tissue: TissueMap

    def only(self, frames: Integer) -> _Level:
        return _Level(choose(self.samples, frames), self.tissue)

    def thinned(self, count: int) -> _Level:
        return self.only(_evenly(np.arange(self.samples.frames), count))

    def score(self, mr_from_tracker: Float) -> float:
        return agreement(self.samples, self.tissue, mr_from_tracker).score


@dataclass(frozen=True, slots=True)
class _Search:
    """Where to look, with what model, and how."""

    candidates: list[Float]
    pivot: Pivot
    coarse: TissueMap
    fine: TissueMap
    phases: Sequence[Float]
    settings: RegisterSettings

    def coarse_level(self, sweeps: Sequence[TrackedSweep]) -> _Level:
        samples = sample_frames(sweeps, self.phases, _COARSE_SPACING_MM, _COARSE_BLUR_MM)
        return _Level(samples, self.coarse).thinned(_COARSE_FRAMES)

    def fine_level(self, sweeps: Sequence[TrackedSweep]) -> _Level:
        settings = self.settings
        samples = sample_frames(
            sweeps, self.phases, settings.sample_spacing_mm, settings.smoothing_mm
        )
        return _Level(samples, self.fine)

    def best(self, sweeps: Sequence[TrackedSweep]) -> tuple[Float, float]:
        """The pose at which the frames agree best with the model, and their score there."""
        rough = climb_from_best(
            self.coarse_level(sweeps).score, self.candidates, self.pivot, self.settings.starts
        )
        fine = self.fine_level(sweeps).thinned(self.settings.max_frames)
        pose = climb(fine.score, rough, self.pivot)
        return pose, fine.score(pose)


def register(
    sweeps: Sequence[TrackedSweep],
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    start: Float,
    settings: RegisterSettings | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Find ``mr_from_tracker`` from tracked frames, their phases and the moving surfaces.

    Parameters
    ----------
    sweeps, phases
        The sweeps and, for each, the ``(n,)`` phases of its frames.
    surfaces
        The cavities through the beat, in LPS millimetres; other structures are not looked at.
    start
        4x4 ``mr_from_tracker``, within the settings' capture range of the truth.

    Raises
    ------
    InputError
        When the start is not rigid, frames are too few or never cross the heart near the start,
        phases or transforms do not fit the frames, or no cavity is given.
    StageError
        When the result cannot be trusted: the frames agree with the model hardly better than
        frames in the wrong place do, the best pose lies far outside the capture range, or too few
        frames bear it out.
    """
    settings = settings or RegisterSettings()
    tell = progress or (lambda done, total: None)
    require_rigid(start, "initial mr_from_tracker")
    frames = _require_frames(sweeps, phases, settings)
    search = _prepare(phases, surfaces, start, settings)
    tell(1, _STEPS)
    _require_heart_in_view(search.coarse_level(sweeps), search)
    pose, score = search.best(sweeps)
    tell(2, _STEPS)
    chance = []
    for step, displaced in enumerate((mirrored, backwards)):
        chance.append(search.best([displaced(sweep) for sweep in sweeps])[1])
        tell(3 + step, _STEPS)
    confidence = score / max(*chance, np.finfo(float).tiny)
    _require_trust(confidence, pose, start, search)
    everything = search.fine_level(sweeps)
    good = np.flatnonzero(_bears_out(everything, pose, search.pivot))
    _require_enough_valid(len(good), frames, settings)
    pose = climb(everything.only(good).thinned(settings.max_frames).score, pose, search.pivot)
    tell(5, _STEPS)
    result = _summarise(everything, pose, start, search.pivot, frames, confidence)
    tell(_STEPS, _STEPS)
    return result


def _prepare(
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    start: Float,
    settings: RegisterSettings,
) -> _Search:
    """Draw the model and choose the poses to begin from."""
    tissue = draw_tissue(surfaces, settings.grid_mm)
    pivot = pivot_of(cavities_of(surfaces))
    candidates = poses_around(
        start, pivot, settings.capture_mm, settings.capture_deg, _CANDIDATES, settings.seed
    )
    coarse = blurred(tissue, _COARSE_BLUR_MM)
    fine = blurred(tissue, settings.smoothing_mm)
    return _Search(candidates, pivot, coarse, fine, phases, settings)


def _require_frames(
    sweeps: Sequence[TrackedSweep], phases: Sequence[Float], settings: RegisterSettings
) -> int:
    """The number of frames, if it suffices."""
    if len(sweeps) != len(phases):
        raise InputError(f"{len(sweeps)} sweeps came with phases for {len(phases)}")
    frames = sum(len(sweep.images) for sweep in sweeps)
    if frames < settings.min_frames:
        raise InputError(
            f"{len(sweeps)} sweeps hold {frames} frames; registration needs "
            f"{settings.min_frames} or more: record a longer sweep"
        )
    return frames


def _evenly(frames: Integer, count: int) -> Integer:
    """At most ``count`` of the frames, evenly spread."""
    if len(frames) <= count:
        return frames
    return np.asarray(frames[np.linspace(0, len(frames) - 1, count).round().astype(int)])


def _require_heart_in_view(level: _Level, search: _Search) -> None:
    """Refuse frames that miss the heart wherever the tracker may stand."""
    seen = max(
        (agreement(level.samples, level.tissue, pose).in_view > _LEAST_IN_VIEW).sum()
        for pose in search.candidates
    )
    if seen < min(search.settings.min_frames, level.samples.frames) or seen == 0:
        raise InputError(
            f"of {level.samples.frames} frames looked at, {seen} or fewer cross the heart at every "
            f"pose within {search.settings.capture_mm:g} mm and {search.settings.capture_deg:g} "
            "degrees of the start; is initial_mr_from_tracker right, in the direction of its name?"
        )


def _require_trust(confidence: float, pose: Float, start: Float, search: _Search) -> None:
    settings = search.settings
    if confidence < settings.min_confidence:
        raise StageError(
            f"registration found no pose to trust: frames agree with the model {confidence:.2f} "
            "times as well as frames in the wrong place do, needs "
            f"{settings.min_confidence:g}; check the start, the phases (is the ECG of this "
            "recording?), the transforms and the patient"
        )
    shift_mm, turn_deg = search.pivot.distance(pose, start)
    # The candidates reach as far as the capture range; an optimum may lie a little beyond.
    if shift_mm > 1.5 * settings.capture_mm or turn_deg > 1.5 * settings.capture_deg:
        raise StageError(
            f"registration ended {shift_mm:.1f} mm and {turn_deg:.1f} degrees from the start, "
            f"far outside the {settings.capture_mm:g} mm and {settings.capture_deg:g} degrees "
            "that were searched; give a better start or widen capture_mm and capture_deg"
        )


def _require_enough_valid(valid: int, frames: int, settings: RegisterSettings) -> None:
    if valid < settings.min_frames:
        raise StageError(
            f"only {valid} of {frames} frames bear the registration out, needs "
            f"{settings.min_frames}; record sweeps that cross more of the heart"
        )


def _bears_out(level: _Level, pose: Float, pivot: Pivot) -> Mask:
    """Which frames meet the heart, agree as others do, and better here than at poses nearby."""
    here = agreement(level.samples, level.tissue, pose)
    # Far enough to leave the optimum, near enough to see the same parts.
    steps = 12.0 * np.concatenate([np.eye(6), -np.eye(6)])
    nearby = [
        agreement(level.samples, level.tissue, pivot.move(pose, step)).explained for step in steps
    ]
    usual = here.explained > _LEAST_OF_USUAL * np.median(here.explained)
    peak = here.explained > np.quantile(nearby, 0.75, axis=0)
    return np.asarray((here.in_view > _LEAST_IN_VIEW) & usual & peak)


def _summarise(
    level: _Level, pose: Float, start: Float, pivot: Pivot, frames: int, confidence: float
) -> Registration:
    """Judge every frame of the study at the final pose."""
    bears_out = _bears_out(level, pose, pivot)
    judged = level.only(np.flatnonzero(bears_out))
    residual = np.ones(frames)
    residual[level.samples.number] = 1 - agreement(level.samples, level.tissue, pose).explained
    valid = np.zeros(frames, dtype=bool)
    valid[level.samples.number] = bears_out
    return Registration(pose, residual, valid, judged.score(pose), judged.score(start), confidence)
