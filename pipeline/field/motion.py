"""How surfaces beat: what is known of them between the stored phases."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol, Self

import numpy as np

from pipeline.geometry import Float, Integer, Mask, Surface, area_vectors

GAP = 1.5
"""A step longer than so many mean ones is a gap in the phases: no spline knows the way through it.
"""
LEFT_OUT = ((8, 1.5), (10, 2.0), (np.inf, 3.0))
"""Of fewer phases than so many: a spline misses a place that it was not given by about so many
times what it misses at most between places that it was given. In 99 places of 100 of four
structures of six phantoms it was 0.8 to 4.4 times at 3 to 6 phases, 1.1 to 7.6 at 7 to 9, 1.1 to
5.6 at 10 to 12, and 2.6 and more from 15 on."""


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

    phases: Float
    """``(phase,)`` in [0, 1), rising."""

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
        places_mm = np.stack([one.vertices_mm for one in each])
        return cls(weights, places_mm, first.triangles, moving.phases)

    def at(self, phase: float) -> Surface:
        """The surface at any phase."""
        return Surface(np.tensordot(self.weights(phase), self.places_mm, 1), self.triangles)

    def unsure_mm(self) -> Float:
        """``(phase, n)``: by about how much each vertex may be off along its normal between a
        stored phase and the next: what their own places miss a spline through all others by, over
        what ``LEFT_OUT`` tells."""
        weights = _weights_of_others(tuple(self.phases.tolist()))
        missed_mm = self.places_mm - np.tensordot(weights, self.places_mm, 1)
        along_mm = np.empty(missed_mm.shape[:2])
        for along, one, vertices_mm in zip(along_mm, missed_mm, self.places_mm, strict=True):
            normals = _normals(vertices_mm, self.triangles)
            along[:] = np.abs(np.einsum("ij,ij->i", one, normals))
        times = next(times for fewer, times in LEFT_OUT if len(self.phases) < fewer)
        return np.asarray((along_mm + np.roll(along_mm, -1, axis=0)) / 2 / times)


@lru_cache(maxsize=16)
def _weights_at(phases: tuple[float, ...]) -> Any:
    """The periodic spline of each phase's weight; a heart's surfaces have their phases in common.

    SciPy solves one right-hand side after another: a spline for each phase is far fewer than one
    for each coordinate.
    """
    from scipy.interpolate import make_interp_spline

    stored, one_by_one = _led_across_gaps(np.array([*phases, phases[0] + 1]))
    return make_interp_spline(stored, one_by_one, k=_order(len(phases)), bc_type="periodic")


@lru_cache(maxsize=16)
def _weights_of_others(phases: tuple[float, ...]) -> Float:
    """``(phase, phase)``: what the places at all other phases count for at each by a spline."""
    from scipy.interpolate import make_interp_spline

    count = len(phases)
    weights = np.zeros((count, count))
    for k, phase in enumerate(phases):
        # Once round from the next one, so that the one left out lies in the last step.
        rest = np.roll(np.arange(count), -k - 1)[:-1]
        stored = np.array(phases)[rest]
        stored = np.append(stored + (stored <= phase), stored[0] + (stored[0] <= phase) + 1)
        one_by_one = np.eye(count - 1)
        spline = make_interp_spline(
            stored, np.vstack([one_by_one, one_by_one[:1]]), k=_order(count - 1), bc_type="periodic"
        )
        weights[k, rest] = spline(phase + 1)
    return weights


def _order(count: int) -> int:
    """Degree of the spline through so many phases."""
    return 5 if count >= 8 else 3 if count >= 3 else 1


def _normals(vertices_mm: Float, triangles: Integer) -> Float:
    """Unit normals ``(n, 3)``: the area-weighted mean over the triangles of a vertex."""
    area = np.repeat(area_vectors(vertices_mm[triangles]), 3, axis=0)
    at, count = triangles.ravel(), len(vertices_mm)
    normals = np.stack([np.bincount(at, area[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, np.finfo(float).tiny))


def _led_across_gaps(phases: Float) -> tuple[Float, Float]:
    """Phases ``(n,)``, the first again a beat later, and what each stored phase's places count for
    there, ``(n, phase)``: more of them, on the straight line, where no phase is for long.

    A spline through places that are a little off swings the wider the longer it is left alone.
    """
    steps, one_by_one = np.diff(phases), np.eye(len(phases) - 1)
    apart = is_gap(phases[:-1])
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
    steps = _steps(phases)[:, None] / count
    return np.asarray(phases[:, None] + steps * np.arange(count)).ravel()


def is_gap(phases: Float) -> Mask:
    """Which of the steps from stored phases ``(n,)`` to the next, across the cycle's end too, are
    gaps."""
    steps = _steps(phases)
    return np.asarray(steps > GAP * steps.mean())


def halfway(phases: Float) -> Float:
    """Moments in the middle between stored phases, the last with the first of the next beat; none
    in a gap."""
    return np.asarray((phases + _steps(phases) / 2)[~is_gap(phases)])


def _steps(phases: Float) -> Float:
    return np.diff(phases, append=phases[0] + 1)
