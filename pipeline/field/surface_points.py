"""Points of a moving surface that a field's zero is fitted to, and more places to look at.

Both lie on the material: vertices, places on triangles and, to be looked at, on edges. Those on
triangles are spread evenly, and are other ones at neighbouring moments.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.field.fit_kernels import carry
from pipeline.field.motion import BeatingSurface, Motion, between, is_gap
from pipeline.geometry import (
    Float,
    Float32,
    Grid,
    Integer,
    Surface,
    area_vectors,
    spread_over_triangle,
)

MOMENTS_A_PHASE = 3
POINTS_A_CELL = 2.0
"""Points of the surface for each square of the grid's spacing, one for each triangle at least,
beside vertices."""
LOOKED_A_CELL, LOOKED_A_SPACING = 6.0, 2.0
"""Places of the surface that are looked at for each square of the grid's spacing, and for each
spacing along an edge; one for each triangle and edge at least."""
ENOUGH_A_CELL = 5.0
"""Of a mesh with many more vertices, edges or triangles for each square of the grid's spacing some
are taken."""
FEW_PHASES = 16
"""With fewer, what the vertices' spline does not know costs the gradient more than its zero gains;
with more it follows the heart as closely as the field can."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Material points of a mesh."""

    corners: Integer
    """``(n, 3)`` vertex numbers."""

    shares: Float32
    """``(n, 3)`` of the corners."""

    @classmethod
    def points(cls, surface: Surface, step_mm: float, number: int) -> Spread:
        """What a fit begins with: vertices, which stand out most, and points of all triangles."""
        inside = _over_triangles(surface, step_mm, POINTS_A_CELL, number)
        cells, at = _cells(surface, step_mm), surface.triangles.ravel()
        some = _some(_summed(at, np.repeat(cells / 3, 3), len(surface.vertices_mm)))
        corners = np.repeat(some[:, None], 3, axis=1)
        return cls._of(inside, cls(corners, np.full(corners.shape, 1 / 3, dtype=np.float32)))

    @classmethod
    def looked_at(cls, surface: Surface, step_mm: float, number: int) -> Spread:
        """More places, of triangles and edges."""
        inside = _over_triangles(surface, step_mm, LOOKED_A_CELL, number)
        edges, side = _edges(surface.triangles)
        cells = np.tile(_cells(surface, step_mm) / 3, 3)
        edges = edges[_some(_summed(side, cells, len(edges)))]
        ends_mm = surface.vertices_mm[edges]
        length = np.linalg.norm(ends_mm[:, 1] - ends_mm[:, 0], axis=1) / step_mm
        counts = np.maximum(1, np.round(LOOKED_A_SPACING * length)).astype(int)
        share = (_numbered(counts) + 1) / np.repeat(counts + 1, counts)
        corners = np.repeat(edges, counts, axis=0)[:, [0, 1, 1]]
        shares = np.stack([1 - share, share, np.zeros_like(share)], axis=1)
        return cls._of(inside, cls(corners, shares.astype(np.float32)))

    @classmethod
    def _of(cls, one: Spread, other: Spread) -> Spread:
        corners = np.concatenate([one.corners, other.corners])
        return cls(corners, np.concatenate([one.shares, other.shares]))

    def carried(self, values: Float32) -> Float32:
        """What vertices have, ``(vertex, 4)``, at the points ``(n, 4)``."""
        found = np.empty((len(self.corners), 4), dtype=np.float32)
        carry(values, self.corners, self.shares, found)
        return found


@dataclass(frozen=True, slots=True)
class Sheet:
    """The surface at one phase."""

    phase: float
    vertices: Float32
    """``(vertex, 4)``: x, y, z counted in nodes, and by about how many mm each may be off."""

    points: Spread
    """Where the distance is to be zero."""

    looked_at: Spread
    """And where it is looked at."""


def sheets_of(moving: BeatingSurface, phases: Float, grid: Grid) -> Iterator[Sheet]:
    """The surface at some moments: at stored phases, and where vertices correspond between them,
    but in no gap: what a spline of few phases cannot follow there, it would make up for at the
    phases beside it."""
    step_mm = min(grid.spacing_mm)

    def placed(vertices_mm: Float, unsure_mm: Float) -> Float32:
        nodes = (vertices_mm - grid.origin_mm) / np.array(grid.spacing_mm)
        return np.column_stack([nodes, unsure_mm]).astype(np.float32)

    motion = Motion.of(moving)
    if motion is None:
        for index, phase in enumerate(phases.tolist()):
            surface = moving.at(index)
            vertices = placed(surface.vertices_mm, np.zeros(len(surface.vertices_mm)))
            yield Sheet(phase, vertices, *_spreads(surface, step_mm, index))
        return
    spreads = [_spreads(moving.at(0), step_mm, number) for number in range(MOMENTS_A_PHASE)]
    moments = between(phases, MOMENTS_A_PHASE).reshape(-1, MOMENTS_A_PHASE)
    moments[is_gap(phases), 1:] = np.nan
    unsure_of_each_mm = np.zeros(motion.places_mm.shape[:2])
    if len(phases) < FEW_PHASES:
        unsure_of_each_mm = motion.unsure_mm()
    for row, unsure_mm in zip(moments.tolist(), unsure_of_each_mm, strict=True):
        for number, (phase, spread) in enumerate(zip(row, spreads, strict=True)):
            if np.isfinite(phase):
                vertices_mm = motion.at(phase).vertices_mm
                yield Sheet(phase, placed(vertices_mm, unsure_mm * (number > 0)), *spread)


def _spreads(surface: Surface, step_mm: float, number: int) -> tuple[Spread, Spread]:
    """Points and places to look at: other ones for each number."""
    return (
        Spread.points(surface, step_mm, number),
        Spread.looked_at(surface, step_mm, number),
    )


def _over_triangles(surface: Surface, step_mm: float, a_cell: float, number: int) -> Spread:
    """So many points for each square of the grid's spacing, one for each triangle at least."""
    cells = _cells(surface, step_mm)
    some = _some(cells)
    counts = np.maximum(1, np.ceil(a_cell * cells[some] - 0.5)).astype(int)
    total = int(counts.sum())
    shares = spread_over_triangle(total, number * total)
    chosen = np.repeat(some, counts)
    return Spread(surface.triangles[chosen], shares.astype(np.float32))


def _some(cells: Float) -> Integer:
    """Numbers of vertices, edges or triangles that have so many squares of the grid's spacing about
    them; of a mesh that is much finer than the grid some, where it is."""
    if len(cells) < 2 * math.ceil(ENOUGH_A_CELL * cells.sum()):
        return np.arange(len(cells))
    due = np.minimum(1, ENOUGH_A_CELL * cells)
    return np.flatnonzero((np.diff(np.floor(np.cumsum(due)), prepend=0) > 0) | (due == 1))


def _summed(numbers: Integer, cells: Float, count: int) -> Float:
    return np.asarray(np.bincount(numbers, cells, count), dtype=float)


def _cells(surface: Surface, step_mm: float) -> Float:
    """Squares of the grid's spacing that each triangle would fill, ``(triangle,)``."""
    twice_mm2 = np.linalg.norm(area_vectors(surface.vertices_mm[surface.triangles]), axis=1)
    return np.asarray(twice_mm2 / 2 / step_mm**2)


def _numbered(counts: Integer) -> Integer:
    """From 0 for each of them up to its count."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _edges(triangles: Integer) -> tuple[Integer, Integer]:
    """``(n, 2)`` vertex numbers, each edge once, and the edge of each side of triangles."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, ::2]])
    edges, side = np.unique(np.sort(sides), axis=0, return_inverse=True)
    return edges, side.ravel()
