"""The search for the pose of a whole study: where it begins, and from thick blur to thin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Integer, MovingSurface
from pipeline.imaging.cine import Cine
from pipeline.registration.frames import Samples, TrackedSweep, choose, sample_frames
from pipeline.registration.pose_search import (
    ROUGHLY_MM,
    Pivot,
    climb,
    climb_from_best,
    pivot_of,
    poses_anywhere,
    poses_around,
)
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.similarity import Agreement, Expansion, agreement, expansion
from pipeline.registration.tissue_map import (
    TissueMap,
    as_seen,
    blurred,
    cavities_of,
    draw_tissue,
    in_short_steps,
)

# The rough level: what is smaller than 5 mm is gone, so samples may lie twice that apart.
_COARSE_BLUR_MM = 5.0
_COARSE_SPACING_MM = 9.0
# Whole chambers are to be found, but what is wider than they are is mostly shadow and noise that
# rises with depth: left in, it draws the heart out of the picture.
_COARSE_TREND_MM = 35.0
_COARSE_FRAMES = 24
# Optima of the rough level that are compared at the fine one, how many of them climb there, and by
# how many frames: where noise is strong the right one is often not the best at the rough level.
_RIVALS, _FINALISTS = 8, 3
_RIVAL_FRAMES = 16
# Millimetres or degrees from the best pose at which another is another answer.
_ELSEWHERE = 10.0
# How much wider than around a start is looked without one.
_WIDER_REACH, _MORE_STARTS = 2, 8


@dataclass(frozen=True, slots=True)
class Level:
    """Frames and model at one degree of blur."""

    samples: Samples
    tissue: TissueMap
    shift_mm: Float | None = None
    """``(frames, 3)``: how much further each frame lies in the model than its pose says."""

    def only(self, frames: Integer) -> Level:
        """With these frames (rising) alone."""
        shift_mm = None if self.shift_mm is None else self.shift_mm[frames]
        return Level(choose(self.samples, frames), self.tissue, shift_mm)

    def thinned(self, count: int) -> Level:
        """With at most ``count`` of the frames, evenly spread."""
        frames = self.samples.frames
        if frames <= count:
            return self
        return self.only(np.linspace(0, frames - 1, count).round().astype(np.int64))

    def at(self, mr_from_tracker: Float) -> Agreement:
        """Agreement of each frame at a pose."""
        return agreement(self.samples, self.tissue, mr_from_tracker, self.shift_mm)

    def expansion(self, mr_from_tracker: Float, pivot: Pivot) -> Expansion:
        """Losses of each frame at a pose, and how they change about it."""
        arm = pivot.centre_mm, pivot.lever_mm
        return expansion(self.samples, self.tissue, mr_from_tracker, *arm, self.shift_mm)

    def losses(self, mr_from_tracker: Float) -> Float:
        """``(frames,)`` log of the share of each frame that is left unexplained at a pose."""
        return np.log1p(-self.at(mr_from_tracker).explained)

    def score(self, mr_from_tracker: Float) -> float:
        """Agreement of all frames at a pose."""
        return self.at(mr_from_tracker).score


@dataclass(frozen=True, slots=True)
class Best:
    """What a search found."""

    pose: Float
    """4x4 ``mr_from_tracker``."""

    score: float
    """Agreement there."""

    rival: float
    """Agreement at the best optimum somewhere else; 0 where none was met."""


@dataclass(frozen=True, slots=True)
class Search:
    """Where to look, with what model, and how."""

    start: Float | None
    pivot: Pivot
    coarse: TissueMap
    fine: TissueMap
    phases: Sequence[Float]
    settings: RegisterSettings

    def coarse_level(self, sweeps: Sequence[TrackedSweep], numbers: Integer | None = None) -> Level:
        """Few frames, few samples, thick blur; of the frames of these numbers alone, if any."""
        lengths_mm = _COARSE_SPACING_MM, _COARSE_BLUR_MM, _COARSE_TREND_MM
        level = Level(sample_frames(sweeps, self.phases, *lengths_mm), self.coarse)
        if numbers is not None:
            level = level.only(np.flatnonzero(np.isin(level.samples.number, numbers)))
        return level.thinned(_COARSE_FRAMES)

    def fine_level(self, sweeps: Sequence[TrackedSweep]) -> Level:
        """All frames as the settings ask for them."""
        settings = self.settings
        lengths_mm = settings.sample_spacing_mm, settings.smoothing_mm, settings.trend_mm
        samples = sample_frames(sweeps, self.phases, *lengths_mm)
        return Level(samples, self.fine)

    def candidates(self, coarse: Level) -> list[Float]:
        """The poses to begin from: around the start, or anywhere if there is none."""
        settings = self.settings
        if self.start is None:
            return poses_anywhere(
                coarse.samples.points_mm.astype(float),
                self.pivot,
                _WIDER_REACH * settings.capture_mm,
                settings.candidates_anywhere,
                settings.seed,
            )
        return poses_around(
            self.start,
            self.pivot,
            settings.capture_mm,
            settings.capture_deg,
            settings.candidates,
            settings.seed,
        )

    def best(self, sweeps: Sequence[TrackedSweep]) -> Best:
        """The pose at which the frames agree best with the model."""
        return self.best_of(self.coarse_level(sweeps), self.fine_level(sweeps))

    def best_of(self, coarse: Level, fine: Level) -> Best:
        """The same, of frames at either degree of blur."""
        starts = self.settings.starts * (_MORE_STARTS if self.start is None else 1)
        rivals = climb_from_best(coarse, self.candidates(coarse), self.pivot, starts, kept=_RIVALS)
        few = fine.thinned(_RIVAL_FRAMES)
        finalists = sorted(rivals, key=few.score, reverse=True)[:_FINALISTS]
        refined = [climb(few, rival, self.pivot, ROUGHLY_MM) for rival in finalists]
        fine = fine.thinned(self.settings.max_frames)
        pose = climb(fine, max(refined, key=fine.score), self.pivot)
        elsewhere = [
            fine.score(other)
            for other in refined
            if max(self.pivot.distance(other, pose)) > _ELSEWHERE
        ]
        return Best(pose, fine.score(pose), max(elsewhere, default=0.0))


def prepare_search(
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    start: Float | None,
    settings: RegisterSettings,
    cine: Cine | None = None,
) -> Search:
    """Draw the model, rough and fine.

    ``cine``: what the surfaces were found in, for the muscle inside the cavities, which grey values
    show and a network counts to the blood.

    Raises
    ------
    InputError
        When there is no cavity, or surfaces and cine have not the same phases.
    """
    if settings.reading == "grey":
        tissue = as_seen(draw_tissue(surfaces, settings.grid_mm, cine))
    else:
        tissue = draw_tissue(in_short_steps(surfaces), settings.grid_mm, cine, muscle=False)
    pivot = pivot_of(cavities_of(surfaces))
    coarse = blurred(tissue, _COARSE_BLUR_MM)
    fine = blurred(tissue, settings.smoothing_mm)
    return Search(start, pivot, coarse, fine, phases, settings)
