"""Whether the parts of a recording agree on one pose.

A patient, tracker or reference that moves while sweeps are recorded, and a calibration or a pixel
size that is wrong, leave each part of the recording with a pose of its own; the common one lies
between them, and is worth little however well it is held. So every part is asked how much better
its frames would agree with the model if only they had to: as much as the parabola that its slope
and curvature make at the common pose falls to its bottom (as in the score test of C. R. Rao, Proc
Camb Phil Soc 44 (1948) 50-57). Directions in which a part is not held gain nothing, and what the
scatter between its own frames lets expect is no gain. How far the bottoms lie from the common pose
tells how far that may be off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Integer
from pipeline.registration.pose_search import Pivot
from pipeline.registration.search import Level
from pipeline.registration.similarity import Expansion
from pipeline.registration.uncertainty import rising

# So many parts where there are frames enough: each of one sweep, and of no fewer frames than have
# six parameters to fit.
_PARTS, _LEAST_FRAMES = 4, 6
# Of the mean curvature: what holds a part where its frames do not. Where it would go without is of
# no account for what it gains, but for how far off the common pose is said to be.
_DAMPING, _FIRM_DAMPING = 0.01, 0.1


@dataclass(frozen=True, slots=True)
class Apart:
    """How parts of a recording differ."""

    gain: float
    """By what share of the score frames would agree better if each part had a pose of its own. 0
    where there are fewer than two parts, or no agreement; below 0 where parts differ less than
    their frames do."""

    spread_mm2: Float
    """``(6, 6)`` of the parts' own poses about the common one, square millimetres of `Pivot.move`,
    less what the scatter between frames lets expect."""


def parts_apart(level: Level, pose: Float, pivot: Pivot, sweep: Integer) -> Apart:
    """How the parts of a recording differ.

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
        return Apart(0.0, np.zeros((6, 6)))
    each = [level.only(part).expansion(pose, pivot) for part in parts]
    spread_mm2 = np.mean([_step_squared(one) for one in each], axis=0)
    return Apart(sum(_gain(one) for one in each) / agreed, rising(spread_mm2))


def parts_of(sweep: Integer) -> Iterator[Integer]:
    """Places of the frames of each part: sweeps, each cut evenly in time as far as frames reach."""
    numbers = np.unique(sweep)
    wanted = -(-_PARTS // max(len(numbers), 1))
    for number in numbers:
        own = np.flatnonzero(sweep == number)
        pieces = min(wanted, len(own) // _LEAST_FRAMES)
        yield from np.array_split(own, pieces) if pieces else ()


def _gain(here: Expansion) -> float:
    """How far the summed loss would fall from here, by its slope and curvature, less what it would
    by chance."""
    held = _held(here, _DAMPING)
    return 0.0 if held is None else float(np.trace(np.linalg.solve(held, _drawn(here))) / 2)


def _step_squared(here: Expansion) -> Float:
    """``(6, 6)`` outer product of the step to the bottom, less what it would be by chance."""
    held = _held(here, _FIRM_DAMPING)
    if held is None:
        return np.zeros((6, 6))
    inverse = np.linalg.inv(held)
    return np.asarray(inverse @ _drawn(here) @ inverse)


def _held(here: Expansion, damping: float) -> Float | None:
    """Curvature of the summed loss, held a little everywhere; None where it does not bend up."""
    least = damping * np.trace(here.bending) / 6
    return np.asarray(here.bending + least * np.eye(6)) if least > 0 else None


def _drawn(here: Expansion) -> Float:
    """``(6, 6)`` square of the summed slope, less what it would be if the frames' slopes were
    independent draws with their scatter."""
    slope = here.slopes.sum(axis=0)
    return np.asarray(np.outer(slope, slope) - len(here.slopes) * np.cov(here.slopes.T))
