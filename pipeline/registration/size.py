"""Whether frames fit a larger or a smaller heart better than the one they were registered to.

A rigid pose cannot make good what a wrong pixel size, or another patient's heart, puts wrong: the
best pose then splits the error between the heart's sides, and neither its curvature nor the spread
between frames shows it. So the model is stretched about its middle, the pose follows, and where
the frames then agree better, by more than they ever do with a heart that is their own, the size is
in doubt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import Float
from pipeline.imaging.cine import Cine
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.search import Level

# Large enough to stand out from the surfaces' own errors, some 1.5 %; small enough that the pose
# can follow. Steps go on for as long as the frames agree better.
_STEP, _MOST_STEPS = 0.04, 3
# By what share of the score frames may agree better with a heart of another size: of 120
# studies that were right four did by more, three of them more than 2.3 mm off.
_BETTER = 0.03
# How near its optimum a pose is followed: the score is flat there.
_WITHIN_MM = 0.1


@dataclass(frozen=True, slots=True)
class Size:
    """The size at which the frames agree best with the model."""

    larger: float
    """By what share of itself the model is larger there, 0.04 for 4 %; 0 as it is."""

    gain: float
    """By what share of the score the frames agree better there than as it is; 0 or more."""

    error_mm: float = 0.0
    """Where it is in doubt, the standard deviation, along each axis and about it at the pivot's
    lever, of an error that moves the heart as far as the stretch does; else 0."""

    @property
    def in_doubt(self) -> bool:
        """Whether the frames fit another size too well to leave it unsaid."""
        return self.gain > _BETTER


AS_IT_IS = Size(0.0, 0.0)
"""No other size fits better."""


def planes_of(cine: Cine | None) -> Float:
    """``(3, 3)``: projection onto the planes of the slices, whose pixels may be of a wrong size;
    identity where there is no cine."""
    if cine is None:
        return np.eye(3)
    axes = cine.mr_from_index[:3, :2]
    return np.asarray(axes @ np.linalg.pinv(axes))


def fitting_size(level: Level, pose: Float, pivot: Pivot, planes: Float) -> Size:
    """The size of the heart, in steps of 4 %, at which frames agree best with the model.

    Parameters
    ----------
    level
        The frames that found the pose.
    pose
        4x4 ``mr_from_tracker``, an optimum.
    planes
        ``(3, 3)``: the projection onto the directions, in the MR frame, in which the heart may be
        larger (`planes_of`).
    """
    usual = level.score(climb(level, pose, pivot, _WITHIN_MM))
    tries = [_uphill(level, pose, pivot, planes, sign * _STEP, usual) for sign in (1, -1)]
    larger, score = max(tries, key=lambda one: one[1])
    if score <= usual or usual <= 0:
        return AS_IT_IS
    size = Size(larger, score / usual - 1)
    return replace(size, error_mm=_error_mm(larger, pivot, planes)) if size.in_doubt else size


def _uphill(
    level: Level, pose: Float, pivot: Pivot, planes: Float, step: float, usual: float
) -> tuple[float, float]:
    """The size, and the score, at which steps this way no longer help."""
    best, reached = (0.0, usual), 0.0
    for _ in range(_MOST_STEPS):
        follow = _stretched(pose, pivot, planes, (1 + reached) / (1 + reached + step))
        pose, reached = climb(level, follow, pivot, _WITHIN_MM), reached + step
        score = level.score(pose)
        if score <= best[1]:
            break
        best = reached, score
    return best


def _stretched(pose: Float, pivot: Pivot, planes: Float, factor: float) -> Float:
    """The pose, after which the frames are ``factor`` as large about the heart's middle: to them
    the model is larger by its inverse."""
    linear = np.eye(3) + (factor - 1) * planes
    stretch = np.eye(4)
    stretch[:3, :3] = linear
    stretch[:3, 3] = pivot.centre_mm - linear @ pivot.centre_mm
    return np.asarray(stretch @ pose)


def _error_mm(larger: float, pivot: Pivot, planes: Float) -> float:
    """Error along and about each axis that moves points at the lever as far as the stretch does.

    1 mm along and about each of three axes moves them by the root of 3 + 2.
    """
    return abs(larger) * pivot.lever_mm * float(np.sqrt(np.trace(planes) / 3 / 5))
