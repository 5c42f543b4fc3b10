"""An energy tank that keeps a moving fixture from driving the hand.

A field at rest gives back what was put into it, where the gradient of its distance has length 1,
and some millijoules more or less on a closed way about a rim or a medial axis; a beating one can
push on and on. The tank is a passivity observer with a budget: Hannaford and Ryu, IEEE Trans.
Robot. Autom. 18(1):1-10, 2002; tanks after Franken et al., IEEE Trans. Robot. 27(4):741-756, 2011.
Newtons times millimetres are millijoules.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipeline.errors import InputError

Triple = tuple[float, float, float]

LOW, LOW_TICKS = 0.1, 12
"""Below this share of its capacity a tank lessens a force that drives, as its level falls; or below
the work of so many ticks, of which twenty, each lessened by a twentieth more, take ten and a half.
"""

WITHHOLD, GIVE_BACK = 0.05, 0.005
"""By how much of the force a tick may withhold more, or less.

At 1 kHz all of it goes within 0.02 s and comes back within 0.2 s: 2 N at 100 N/s and at 10 N/s.
"""

NONE = 1e100
"""Millimetres or newtons beyond which no tool is and no device pushes: squares of larger ones may
be infinite."""


class EnergyTank:
    """What may be rendered of a force, tick by tick.

    Energy that the hand gives fills the tank, up to its capacity; energy that the hand gets drains
    it; where it is empty, the part of the force that would drive the motion on is withheld. So
    the hand never gets more than the tank held at first, but for one tick's step at a turn of the
    motion, which could not be foreseen. Before it is empty a force that drives is lessened by
    degrees, all of it, as the level falls, and comes back by degrees: else it would begin and end
    at every turn of the motion. It counts what it passes, so that must be what the hand gets:
    fading and a device's limit come before it. A torque is not counted. ``bf_pass`` of the C
    header is the same.

    Raises
    ------
    InputError
        When a level is negative, or above the capacity, or the capacity is infinite.
    """

    def __init__(self, level_mj: float = 5.0, capacity_mj: float = 20.0) -> None:
        if not 0 <= level_mj <= capacity_mj < math.inf:
            raise InputError(
                f"energy tank: a level of {level_mj:g} mJ in a capacity of {capacity_mj:g} mJ; "
                "needs 0 <= level_mj <= capacity_mj, and a finite capacity"
            )
        self.level_mj = level_mj
        self._capacity_mj = capacity_mj
        self._point_mm: Sequence[float] | None = None
        self._force_n: Triple = (0.0, 0.0, 0.0)
        self._blind = False
        self._driving = False
        self._withheld = 0.0

    def passed(self, point_mm: Sequence[float], force_n: Sequence[float]) -> Triple:
        """The force to render at the tool's present point, of the one that is wanted.

        Where a number of one of them is not finite, or beyond 1e100, nothing is rendered.

        Raises
        ------
        InputError
            When one of them is not three numbers.
        """
        if len(point_mm) != 3 or len(force_n) != 3:
            raise InputError(
                f"energy tank: point {point_mm} and force {force_n} must be three numbers each"
            )
        if not all(abs(number) <= NONE for number in point_mm):
            self._blind = True
            return 0.0, 0.0, 0.0
        if not all(abs(number) <= NONE for number in force_n):
            force_n = (0.0, 0.0, 0.0)
        last = self._point_mm if self._point_mm is not None else point_mm
        way = [now - before for now, before in zip(point_mm, last, strict=True)]
        way2 = _dot(way, way)
        # What the force held since the last tick has really done. Of a way that was not seen only
        # what the hand may have got is counted.
        work = _dot(self._force_n, way)
        work = max(work, 0.0) if self._blind else work
        self._blind = False
        self.level_mj = min(self.level_mj - work, self._capacity_mj)
        ahead, allowed = _dot(force_n, way), max(self.level_mj, 0.0)
        share = self._share(ahead)
        ahead *= share
        x, y, z = (share * f for f in force_n)
        if way2 > 0 and (ahead > allowed or self.level_mj < 0):
            # The next step will be much like the last. In debt, only force against the motion is
            # left.
            along, kept = ahead / way2, min(ahead, allowed) / way2
            across = 0.0 if self.level_mj < 0 else 1.0
            x, y, z = (
                across * (f - along * w) + kept * w for f, w in zip((x, y, z), way, strict=True)
            )
        elif self.level_mj < 0 and self._driving:
            x = y = z = 0.0
        self._point_mm, self._force_n = tuple(point_mm), (x, y, z)
        return x, y, z

    def _share(self, ahead_mj: float) -> float:
        """Share of the force to render in this tick; ``ahead_mj`` is its work over the last way.

        What a tool at rest did last stands, or a coarse encoder would tell one thing and the other
        by turns. Nor does force come back at rest while the tank is low: it could not pay for the
        next step forward.
        """
        if ahead_mj < 0 or ahead_mj > 0:
            self._driving = ahead_mj > 0
        low_mj, goal = max(LOW * self._capacity_mj, LOW_TICKS * ahead_mj), 0.0
        if self.level_mj < low_mj and self._driving:
            goal = 1.0 - self.level_mj / low_mj if self.level_mj > 0 else 1.0
        elif self.level_mj < low_mj and not ahead_mj < 0:
            goal = self._withheld
        self._withheld += min(max(goal - self._withheld, -GIVE_BACK), WITHHOLD)
        return 1.0 - self._withheld


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
