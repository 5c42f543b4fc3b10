"""Shapes that the outside heart is put together from: distances in mm, and random fields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Waves:
    """A smooth random field of unit deviation: a few plane waves."""

    wave: Array
    """``(n, 3)`` wave vectors, radians per mm."""
    start: Array
    """``(n,)`` radians."""

    @classmethod
    def drawn(cls, rng: np.random.Generator, length_mm: float, count: int = 4) -> Waves:
        """Waves about ``length_mm`` long in any direction."""
        way = rng.standard_normal((count, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        way *= 2 * np.pi / (length_mm * rng.uniform(0.7, 1.4, (count, 1)))
        start = rng.uniform(0, 2 * np.pi, count)
        return cls(way.astype(np.float32), start.astype(np.float32))

    def at(self, points: Array) -> Array:
        """Values at ``(n, 3)`` points."""
        total = np.zeros(len(points), np.float32)
        for wave, start in zip(self.wave, self.start, strict=True):
            total += np.sin(points @ wave + start)
        return total * np.float32(np.sqrt(2 / len(self.wave)))


def ellipsoid(p: Array, middle: tuple[float, ...], half: tuple[float, ...]) -> Array:
    """About the distance (mm) outside an ellipsoid, negative inside."""
    away = np.sqrt(sum(((p[:, k] - middle[k]) / half[k]) ** 2 for k in range(3)))
    return np.asarray((away - 1) * min(half), np.float32)


REACH_MM = 16.0
"""Farther from a tube than this, nothing asks how far."""


def tube(p: Array, way: npt.ArrayLike, radius: npt.ArrayLike) -> Array:
    """Distance (mm) outside a tube along a polyline whose radius changes from point to point."""
    points = np.asarray(way, np.float32)
    radii = np.broadcast_to(np.asarray(radius, np.float32), len(points))
    best = np.full(len(p), 1e3, np.float32)
    room = radii.max() + REACH_MM
    inside = np.ones(len(p), bool)
    for k in range(3):
        inside &= np.abs(p[:, k] - np.ptp(points[:, k]) / 2 - points[:, k].min()) < (
            np.ptp(points[:, k]) / 2 + room
        )
    some = np.flatnonzero(inside)
    q = p[some]
    near = best[some]
    for k in range(len(points) - 1):
        step = points[k + 1] - points[k]
        share = np.clip((q - points[k]) @ step / (step @ step), 0, 1)
        away = q - points[k] - share[:, None] * step
        there = np.sqrt(np.einsum("ij,ij->i", away, away))
        np.minimum(near, there - radii[k] - share * (radii[k + 1] - radii[k]), out=near)
    best[some] = near
    return best


def both(a: Array, b: Array, round_mm: float = 6.0) -> Array:
    """Distance outside what two bodies share, its edge rounded."""
    return np.asarray(0.5 * (a + b + np.sqrt((a - b) ** 2 + np.float32(round_mm) ** 2)))
