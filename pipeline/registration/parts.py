"""Whether the parts of a recording agree on one pose.

A patient, tracker or reference that moves while sweeps are recorded, and a calibration or a pixel
size that is wrong, leave each part of the recording with a pose of its own; the common one lies
between them, and is worth little however well it is held. So every part is asked how much better
its frames would agree with the model if only they had to: as much as the parabola that its slope
and curvature make at the common pose falls to its bottom (as in the score test of C. R. Rao, Proc
Camb Phil Soc 44 (1948) 50-57). Directions in which a part is not held gain nothing, and what the
scatter between its own frames lets expect is no gain.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.geometry import Float, Integer
from pipeline.registration.pose_search import Pivot
from pipeline.registration.search import Level

# So many parts where there are frames enough: each of one sweep, and of no fewer frames than have
# six parameters to fit.
_PARTS, _LEAST_FRAMES = 4, 6
# Of the mean curvature: what holds a part where its frames do not.
_DAMPING = 0.01


def gain_apart(level: Level, pose: Float, pivot: Pivot, sweep: Integer) -> float:
    """By what share of the score frames would agree better if each part had a pose of its own.

    0 where there are fewer than two parts, or no agreement; below 0 where parts differ less than
    their frames do.

    Parameters
    ----------
    level
        All frames that show the heart, in order of time.
    pose
        4x4 ``mr_from_tracker``, the common one.
    sweep
        ``(frames,)`` number of each frame's sweep.
    """
    agreed = -float(level.losses(pose).sum())
    parts = list(parts_of(sweep))
    if len(parts) < 2 or not agreed > 0:
        return 0.0
    return sum(_gain(level.only(part), pose, pivot) for part in parts) / agreed


def parts_of(sweep: Integer) -> Iterator[Integer]:
    """Places of the frames of each part: sweeps, each cut evenly in time as far as frames reach."""
    numbers = np.unique(sweep)
    wanted = -(-_PARTS // max(len(numbers), 1))
    for number in numbers:
        own = np.flatnonzero(sweep == number)
        pieces = min(wanted, len(own) // _LEAST_FRAMES)
        yield from np.array_split(own, pieces) if pieces else ()


def _gain(level: Level, pose: Float, pivot: Pivot) -> float:
    """How far the summed loss would fall from here, by its slope and curvature, less what it would
    by chance if the frames' slopes were independent draws with this scatter."""
    here = level.expansion(pose, pivot)
    damping = _DAMPING * np.trace(here.bending) / 6
    if not damping > 0:
        return 0.0
    slope = here.slopes.sum(axis=0)
    scatter = len(here.slopes) * np.cov(here.slopes.T)
    reached = np.linalg.solve(here.bending + damping * np.eye(6), np.outer(slope, slope) - scatter)
    return float(np.trace(reached) / 2)
