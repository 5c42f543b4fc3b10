"""Frames that show the heart and contradict the pose: how many, of which sweep, and what they say.

Where frames of a sweep do not bear out what the others do, nothing tells which are right, and both
may be wrong. So they are asked for the pose that suits them. As many frames for one pose as for the
other are two draws about the true one: half the square of the step between them is then what either
is off on average. Fewer count by their share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import Float, Integer, Mask
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.search import Level, Search
from pipeline.registration.uncertainty import rising

# Share of its frames up to which a sweep is against a pose, and from which it is for it.
_AGAINST, _FOR = 0.25, 0.5
# Fewer frames than this have no pose of their own: six parameters fit them by chance.
_LEAST_FRAMES = 10
# Of their mean curvature: what holds frames where they see little, as ten of a sweep that hardly
# turn do. Where they would go without is no contradiction.
_DAMPING = 0.1
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
    named = list(outvoted(sweep[shows], bears_out[shows], least))
    in_a_row, number = longest_astray(sweep[shows], bears_out[shows])
    if in_a_row >= IN_A_ROW:
        named.append(number)
    return np.asarray(shows & ~bears_out & np.isin(sweep + 1, named))


def dissent(
    search: Search,
    sweeps: Sequence[TrackedSweep],
    level: Level,
    pose: Float,
    sweep: Integer,
    bears_out: Mask,
    against: Mask,
) -> Dissent:
    """What the frames of each sweep that contradict a pose agree on; `NONE` where that is nothing.

    The search begins with all frames where they were recorded; it ends where their breath and
    their sweep's correction, if these were sought, have them.

    Parameters
    ----------
    sweeps
        As they are compared.
    level
        All frames, as finely as they are judged.
    pose
        4x4 ``mr_from_tracker``, the common one.
    sweep, bears_out, against
        ``(frames,)`` of ``level``: number of each one's sweep, which bear the pose out, and which
        contradict it.
    """
    found = [
        _of_one_sweep(search, sweeps, level, pose, bears_out, against & (sweep == number))
        for number in np.unique(sweep[against])
    ]
    if not any(one.away_mm > 0 for one in found):
        return NONE
    spread_mm2 = np.sum([one.spread_mm2 for one in found], axis=0)
    return Dissent(max(one.away_mm for one in found), spread_mm2)


def _of_one_sweep(
    search: Search,
    sweeps: Sequence[TrackedSweep],
    level: Level,
    pose: Float,
    bears_out: Mask,
    against: Mask,
) -> Dissent:
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
    step = _held(own.expansion(other, search.pivot).bending) @ search.pivot.step_between(
        pose, other
    )
    share = against.sum() / (against.sum() + bears_out.sum())
    # A turn moves what lies on its axis not at all: two thirds of the square are left.
    away_mm = np.sqrt((step[:3] ** 2).sum() + 2 / 3 * (step[3:] ** 2).sum())
    return Dissent(float(away_mm), np.outer(step, step) * share)


def _held(bending: Float) -> Float:
    """``(6, 6)``: the share of a step that is left where a little holds it everywhere."""
    rises = rising(bending)
    least = _DAMPING * np.trace(rises) / 6
    return np.asarray(np.linalg.solve(rises + least * np.eye(6), rises)) if least > 0 else 0 * rises
