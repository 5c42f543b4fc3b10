"""How surfaces beat: what is known of them between the stored phases."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol, Self

import numpy as np

from pipeline.geometry import Float, Integer, Mask, Surface

GAP = 1.5
"""A step longer than so many mean ones is a gap in the phases: no spline knows the way through it.
"""


class BeatingSurface(Protocol):
    """Anything that gives a closed surface for every stored phase."""

    @property
    def phases(self) -> Float:
        """``(phase,)`` in [0, 1), rising."""

    def at(self, index: int) -> Surface:
        """The surface at stored phase number ``index``."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A surface whose vertices are the same material points in every phase, at any phase.

    Each vertex follows the periodic spline in time through its places at the stored phases: of the
    fifth degree where there are phases enough, as it follows a heart more closely than the cubic.
    """

    weights: Any
    """What each stored phase's places count for at a phase, ``(phase,)``."""

    places_mm: Float
    """``(phase, n, 3)`` at the stored phases, LPS mm."""

    triangles: Integer
    """``(m, 3)`` vertex numbers."""

    @classmethod
    def of(cls, moving: BeatingSurface) -> Self | None:
        """The motion; None where vertices do not correspond or phases are fewer than three."""
        count = len(moving.phases)
        each = [moving.at(index) for index in range(count)]
        first = each[0]
        same = all(
            one.triangles is first.triangles or np.array_equal(one.triangles, first.triangles)
            for one in each
        )
        if not same or count < 3:
            return None
        weights = _weights_at(tuple(moving.phases.tolist()))
        return cls(weights, np.stack([one.vertices_mm for one in each]), first.triangles)

    def at(self, phase: float) -> Surface:
        """The surface at any phase."""
        return Surface(np.tensordot(self.weights(phase), self.places_mm, 1), self.triangles)


@lru_cache(maxsize=16)
def _weights_at(phases: tuple[float, ...]) -> Any:
    """The periodic spline of each phase's weight; a heart's surfaces have their phases in common.

    SciPy solves one right-hand side after another: a spline for each phase is far fewer than one
    for each coordinate.
    """
    from scipy.interpolate import make_interp_spline

    order = 5 if len(phases) >= 8 else 3
    stored, one_by_one = _led_across_gaps(np.array([*phases, phases[0] + 1]))
    return make_interp_spline(stored, one_by_one, k=order, bc_type="periodic")


def _led_across_gaps(phases: Float) -> tuple[Float, Float]:
    """Phases ``(n,)``, the first again a beat later, and what each stored phase's places count for
    there, ``(n, phase)``: more of them, on the straight line, where no phase is for long.

    A spline through places that are a little off swings the wider the longer it is left alone.
    """
    steps, one_by_one = np.diff(phases), np.eye(len(phases) - 1)
    apart = is_gap(steps)
    rows = np.vstack([one_by_one, one_by_one[:1]])
    at, through = [phases[:1]], [rows[:1]]
    for k, step in enumerate(steps):
        parts = max(1, round(step / steps.mean())) if apart[k] else 1
        share = np.arange(1, parts + 1)[:, None] / parts
        at.append(phases[k] + share[:, 0] * step)
        through.append((1 - share) * rows[k] + share * rows[k + 1])
    return np.concatenate(at), np.concatenate(through)


def between(phases: Float, count: int) -> Float:
    """``count`` moments a stored phase, evenly up to the next; the stored phases are among them."""
    steps = np.diff(phases, append=phases[0] + 1)[:, None] / count
    return np.asarray(phases[:, None] + steps * np.arange(count)).ravel()


def is_gap(steps: Float) -> Mask:
    """Which of the steps ``(n,)`` between phases that follow one another are gaps."""
    return np.asarray(steps > GAP * steps.mean())


def halfway(phases: Float) -> Float:
    """Moments in the middle between stored phases, the last with the first of the next beat; none
    in a gap."""
    steps = np.diff(phases, append=phases[0] + 1)
    return np.asarray((phases + steps / 2)[~is_gap(steps)])
