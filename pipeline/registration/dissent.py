"""Frames that show the heart and contradict the pose: how many, of which sweep, and what they say.

Where the frames of a sweep do not bear out what those of another do, nothing tells which are right,
and both may be wrong. So they are asked for the pose that suits them. Two poses of one recording
are taken for two draws about the true one: half the square of the step between them is then what
either is off on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import Float, Integer, Mask
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.search import Level, Search

# Share of its frames up to which a sweep is against a pose, and from which it is for it.
_AGAINST, _FOR = 0.25, 0.5
# Fewer frames than this have no pose of their own: six parameters fit them by chance.
_LEAST_FRAMES = 10
# A pose at which frames agree less than so many times as well as others do at the common one is
# none: noise agrees somewhere, too.
_LEAST_AGREEMENT = 0.5

IN_A_ROW = 10
"""So many frames in a row that show the heart and do not fit are no chance."""


@dataclass(frozen=True, slots=True)
class Dissent:
    """What frames that contradict the common pose agree on."""

    away_mm: float
    """How far their own pose moves the heart from where the common one has it: root mean square,
    of a heart as wide in every direction."""

    spread_mm2: Float
    """``(6, 6)`` by how much the common pose is less sure for it, square millimetres of
    `Pivot.move`."""


NONE = Dissent(0.0, np.zeros((6, 6)))
"""Nobody contradicts, or not with one voice."""


def outvoted(sweep: Integer, bears_out: Mask, least: int) -> tuple[int, ...]:
    """Sweeps, counted from 1, that contradict another: each has a pose of its own.

    Parameters
    ----------
    sweep, bears_out
        ``(frames,)`` number of each frame's sweep, counted from 0, and whether it bears the
        common pose out.
    least
        Fewer frames than this are no sweep that could speak.
    """
    shares = {
        int(number): float(bears_out[sweep == number].mean())
        for number in np.unique(sweep)
        if (sweep == number).sum() >= least
    }
    if max(shares.values(), default=0.0) < _FOR:
        return ()
    return tuple(number + 1 for number, share in shares.items() if share <= _AGAINST)


def longest_astray(sweep: Integer, bears_out: Mask) -> tuple[int, int]:
    """How many frames of a sweep in a row, at most, do not bear a pose out, and of which sweep,
    counted from 1.

    Parameters
    ----------
    sweep, bears_out
        ``(frames,)`` in order of time, of frames that show the heart: number of each one's sweep,
        counted from 0, and whether it bears the pose out.
    """
    longest, run = (0, 0), 0
    for k, (number, fits) in enumerate(zip(sweep.tolist(), bears_out.tolist(), strict=True)):
        run = 0 if fits else 1 + (run if k and sweep[k - 1] == number else 0)
        longest = max(longest, (run, number + 1))
    return longest if longest[0] else (0, 0)


def contradicting(sweep: Integer, shows: Mask, bears_out: Mask, least: int) -> Mask:
    """``(frames,)`` which frames show the heart and contradict a pose, of sweeps that do as a whole
    or for a while.

    Parameters
    ----------
    sweep, shows, bears_out
        ``(frames,)`` in order of time: number of each frame's sweep, counted from 0, whether it
        shows the heart, and whether it bears the pose out.
    least
        As in `outvoted`.
    """
    named = list(outvoted(sweep, bears_out, least))
    in_a_row, number = longest_astray(sweep[shows], bears_out[shows])
    if in_a_row >= IN_A_ROW:
        named.append(number)
    return np.asarray(shows & ~bears_out & np.isin(sweep + 1, named))


def dissent(
    search: Search,
    sweeps: Sequence[TrackedSweep],
    level: Level,
    pose: Float,
    bears_out: Mask,
    against: Mask,
) -> Dissent:
    """What the frames that contradict a pose agree on; `NONE` where that is nothing.

    Parameters
    ----------
    sweeps
        As they are compared.
    level
        All frames, as finely as they are judged.
    pose
        4x4 ``mr_from_tracker``, the common one.
    bears_out, against
        ``(frames,)`` of ``level``: which bear it out, and which contradict it.
    """
    if against.sum() < _LEAST_FRAMES or not bears_out.any():
        return NONE
    own = level.only(np.flatnonzero(against))
    rough = search.coarse_level(sweeps, own.samples.number)
    if not rough.samples.frames:
        return NONE
    other = replace(search, start=pose).best_of(rough, own).pose
    agreed = np.median(level.only(np.flatnonzero(bears_out)).at(pose).explained)
    if np.median(own.at(other).explained) < _LEAST_AGREEMENT * agreed:
        return NONE
    step = search.pivot.step_between(pose, other)
    # A turn moves what lies on its axis not at all: two thirds of the square are left.
    away_mm = np.sqrt((step[:3] ** 2).sum() + 2 / 3 * (step[3:] ** 2).sum())
    return Dissent(float(away_mm), np.outer(step, step) / 2)
