"""Frames of which picture or pose stood still while the other went on: a frozen display, or a
tracker that repeats its last answer. Both are exact repetitions: no two answers of a tracker that
measures, and no two pictures of a body, are equal to the last bit, however still a probe is held.

What repeats now and then is in order: recorders ask faster than scanners and trackers answer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Mask

if TYPE_CHECKING:
    # Not at run time: ultrasound imports this module.
    from pipeline.imaging.ultrasound import Sweep

# A repetition is odd where it lasts this long, and this many times as long as answers usually do.
_LEAST_S, _TIMES_USUAL = 0.3, 3.0
# What a picture may be beside its place without harm.
_HARMLESS_MM = 2.0
# A probe that is held still begins to move slowly: a pose that was stuck leaps to where the probe
# has gone meanwhile, so many times as fast as it moves anywhere else.
_LEAP = 3.0
# A sweep that ends, or begins, with one and the same pose for so long is told of.
_TOLD_S = 1.0


@dataclass(frozen=True, slots=True)
class _Run:
    """Frames that repeat each other, from ``first`` to ``last``."""

    first: int
    last: int


def without_stuck(sweep: Sweep) -> Sweep:
    """The sweep without frames that show an old picture or have an old pose; remarks tell of them.

    A picture that stands still while the probe moves is at its place in the first frame alone. A
    pose that stands still while pictures go on is one of a probe at rest (an arm with encoders
    gives it to the last bit) unless it leaps afterwards, faster than the probe ever moves.

    Raises
    ------
    InputError
        When no frame is left.
    """
    corners_mm = _corners_mm(sweep)
    pictures = list(_odd(_repeats(sweep.images), sweep.times_s))
    frozen = [run for run in pictures if _is_frozen(sweep, corners_mm, run)]
    odd_poses = list(_odd(_repeats(sweep.tracker_from_probe), sweep.times_s))
    poses = [run for run in odd_poses if _pictures_go_on(sweep, run)]
    leaps = [run for run in poses if _leaps(corners_mm, sweep.times_s, run, odd_poses)]
    rest = [run for run in poses if run not in leaps and _is_told(sweep, run)]
    remarks = [_told_of_pose(sweep, run) for run in rest]
    kept = np.ones(len(sweep.times_s), dtype=bool)
    for run in frozen:
        kept[run.first + 1 : run.last + 1] = False
    for run in leaps:
        # Where the recording begins with it, not even the first is known to be new.
        kept[run.first + (run.first > 0) : run.last + 1] = False
    if not kept.all():
        remarks.append(_told_left_out(kept, frozen, leaps))
    if not kept.any():
        raise InputError(f"{sweep.name}: {remarks[-1]}; record the sweep again")
    return sweep.only(kept, *remarks)


def _repeats(answers: Float | Float32) -> Mask:
    """``(n - 1,)``: whether each of ``(n, ...)`` is followed by its equal."""
    return np.array([np.array_equal(*pair) for pair in pairwise(answers)], dtype=bool)


def _odd(repeats: Mask, times_s: Float) -> Iterator[_Run]:
    """Repetitions that last longer than a slow scanner or tracker explains."""
    fresh = np.flatnonzero(np.concatenate([[True], ~repeats]))
    # How long an answer usually stands; lost frames make it longer, so the median.
    usual_s = float(np.median(np.diff(times_s[fresh]))) if len(fresh) > 1 else 0.0
    least_s = max(_LEAST_S, _TIMES_USUAL * usual_s)
    for first, beyond in zip(fresh, [*fresh[1:], len(times_s)], strict=True):
        if times_s[beyond - 1] - times_s[first] >= least_s:
            yield _Run(int(first), int(beyond) - 1)


def _corners_mm(sweep: Sweep) -> Float:
    """``(n, 4, 3)`` tracker mm: where the corners of each picture lie."""
    rows, columns = sweep.images.shape[1:]
    corners = np.array([[i, j, 0, 1] for i in (0, columns - 1) for j in (0, rows - 1)], float)
    return np.asarray(np.einsum("nij,cj->nci", sweep.tracker_from_image[:, :3], corners))


def _moved_mm(corners_mm: Float, other_mm: Float) -> Float:
    """Furthest of the four corners, mm, over the last two axes ``(4, 3)``."""
    return np.asarray(np.linalg.norm(corners_mm - other_mm, axis=-1).max(axis=-1))


def _is_frozen(sweep: Sweep, corners_mm: Float, run: _Run) -> bool:
    """Whether the probe moves while the picture stands still; a flat picture shows nothing."""
    picture = sweep.images[run.first]
    moved = _moved_mm(corners_mm[run.first : run.last + 1], corners_mm[run.first])
    return bool(picture.min() < picture.max() and moved.max() > _HARMLESS_MM)


def _pictures_go_on(sweep: Sweep, run: _Run) -> bool:
    """Whether at least half of the pictures differ from the one before: where they stand still
    too, it is the recorder that repeats itself, and picture and pose belong together."""
    return float(_repeats(sweep.images[run.first : run.last + 1]).mean()) < 0.5


def _leaps(corners_mm: Float, times_s: Float, run: _Run, standing: list[_Run]) -> bool:
    """Whether the probe leaps as the pose goes on, faster than it moves elsewhere."""
    if run.last + 1 == len(times_s):
        return False
    steps_mm = _moved_mm(corners_mm[1:], corners_mm[:-1])
    changes = np.flatnonzero(steps_mm > 0)
    speeds = steps_mm / np.diff(times_s)
    elsewhere = np.setdiff1d(changes, [one.last for one in standing])
    faster = speeds[run.last] > _LEAP * speeds[elsewhere].max(initial=0.0)
    return bool(steps_mm[run.last] > _HARMLESS_MM and faster)


def _is_told(sweep: Sweep, run: _Run) -> bool:
    """Whether no leap could show, for the sweep begins or ends with the repeated pose."""
    at_an_end = run.first == 0 or run.last + 1 == len(sweep.times_s)
    return bool(at_an_end and sweep.times_s[run.last] - sweep.times_s[run.first] >= _TOLD_S)


def _told_of_pose(sweep: Sweep, run: _Run) -> str:
    seconds = sweep.times_s[run.last] - sweep.times_s[run.first]
    return (
        f"frames {sweep.numbers[run.first]} to {sweep.numbers[run.last]} ({seconds:.1f} s) have "
        "one and the same pose, to the last bit, while their pictures change: unless an arm with "
        "encoders held the probe still, the tracker was stuck; look at it, or cut them off"
    )


def _told_left_out(kept: Mask, frozen: list[_Run], leaps: list[_Run]) -> str:
    why = []
    if frozen:
        why.append("their picture stands still while the probe moves (was the display frozen?)")
    if leaps:
        why.append("their pose stands still and then leaps (the tracker was stuck)")
    return f"{(~kept).sum()} of {len(kept)} frames left out: {'; '.join(why)}"
