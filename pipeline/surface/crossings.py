"""Where a mesh passes through itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.compiled import door
from pipeline.geometry import Float, Integer, Mask
from pipeline.surface.kernels import face_normal

# Volumes below this share of a cell are rounding: what lies in one plane only touches.
ROUNDING = 1e-10

_compiled = door(Path(__file__).parent, ("crossings", "kernels"), nogil=True, cache=True)


def crossing_triangles(vertices_mm: Float, triangles: Integer) -> Mask:
    """Which triangles ``(m,)`` cross another: pierced by its edge, or piercing it by an edge.

    Two triangles in general position meet exactly if an edge of one passes through the inside of
    the other; edges that only touch a triangle do not count. Pairs are sought in cells as wide as
    the longest triangle, so every pair that could meet shares a cell.

    Parameters
    ----------
    vertices_mm
        ``(n, 3)`` positions, finite.
    triangles
        ``(m, 3)`` vertex numbers.
    """
    corners = vertices_mm[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    cell_mm = max(float((high - low).max()), 1e-9)
    origin = vertices_mm.min(axis=0)
    first = np.floor((low - origin) / cell_mm).astype(np.int64)
    last = np.floor((high - origin) / cell_mm).astype(np.int64)
    counts = last.max(axis=0) + 1
    starts, members = _members(first, last, counts)
    tiny_mm3 = ROUNDING * cell_mm**3
    found: Mask = _crossings(vertices_mm, triangles, low, high, starts, members, tiny_mm3)
    return found


@_compiled
def _members(first, last, counts):  # type: ignore[no-untyped-def]
    """Triangles of each cell, in compressed rows: those whose box reaches into it."""
    starts = np.zeros(counts[0] * counts[1] * counts[2] + 1, np.int64)
    for t in range(len(first)):
        for i in range(first[t, 0], last[t, 0] + 1):
            for j in range(first[t, 1], last[t, 1] + 1):
                for k in range(first[t, 2], last[t, 2] + 1):
                    starts[(i * counts[1] + j) * counts[2] + k + 1] += 1
    starts = np.cumsum(starts)
    members, free = np.empty(starts[-1], np.int64), starts[:-1].copy()
    for t in range(len(first)):
        for i in range(first[t, 0], last[t, 0] + 1):
            for j in range(first[t, 1], last[t, 1] + 1):
                for k in range(first[t, 2], last[t, 2] + 1):
                    cell = (i * counts[1] + j) * counts[2] + k
                    members[free[cell]] = t
                    free[cell] += 1
    return starts, members


@_compiled
def _crossings(vertices, triangles, low, high, starts, members, tiny):  # type: ignore[no-untyped-def]
    """Test all pairs of each cell whose boxes overlap."""
    crossing = np.zeros(len(triangles), np.bool_)
    for cell in range(len(starts) - 1):
        for at in range(starts[cell], starts[cell + 1]):
            s = members[at]
            low_x, low_y, low_z = low[s, 0], low[s, 1], low[s, 2]
            high_x, high_y, high_z = high[s, 0], high[s, 1], high[s, 2]
            for beside in range(at + 1, starts[cell + 1]):
                t = members[beside]
                if (
                    low_x > high[t, 0]
                    or low[t, 0] > high_x
                    or low_y > high[t, 1]
                    or low[t, 1] > high_y
                    or low_z > high[t, 2]
                    or low[t, 2] > high_z
                    or (crossing[s] and crossing[t])
                ):
                    continue
                if _pierces(vertices, triangles, s, t, tiny) or _pierces(
                    vertices, triangles, t, s, tiny
                ):
                    crossing[s] = crossing[t] = True
    return crossing


@_compiled
def _pierces(v, triangles, one, other, tiny):  # type: ignore[no-untyped-def]
    """Whether an edge of one triangle passes through another with which it shares no vertex."""
    a, b, c = triangles[other, 0], triangles[other, 1], triangles[other, 2]
    p, q, r = triangles[one, 0], triangles[one, 1], triangles[one, 2]
    normal = face_normal(v, a, b, c)
    # Nearly all triangles that are near lie on one side.
    at_p, at_q = _height(v, a, p, normal), _height(v, a, q, normal)
    at_r = _height(v, a, r, normal)
    if min(at_p, at_q, at_r) > -tiny or max(at_p, at_q, at_r) < tiny:
        return False
    return (
        _passes(v, p, q, at_p, at_q, a, b, c, tiny)
        or _passes(v, q, r, at_q, at_r, a, b, c, tiny)
        or _passes(v, r, p, at_r, at_p, a, b, c, tiny)
    )


@_compiled
def _passes(v, p, q, above, below, a, b, c, tiny):  # type: ignore[no-untyped-def]
    """Whether the edge from p to q, which are so high above a, b, c, passes through between."""
    if p in (a, b, c) or q in (a, b, c):
        return False
    if min(above, below) > -tiny or max(above, below) < tiny:
        return False
    first, second, third = _side(v, p, q, a, b), _side(v, p, q, b, c), _side(v, p, q, c, a)
    return min(first, second, third) > tiny or max(first, second, third) < -tiny


@_compiled
def _side(vertices, a, b, c, d):  # type: ignore[no-untyped-def]
    """Six times the signed volume of the tetrahedron a, b, c, d."""
    return _height(vertices, a, d, face_normal(vertices, a, b, c))


@_compiled
def _height(v, a, d, normal):  # type: ignore[no-untyped-def]
    """How far d is above a, times the length of the normal."""
    x, y, z = normal
    return x * (v[d, 0] - v[a, 0]) + y * (v[d, 1] - v[a, 1]) + z * (v[d, 2] - v[a, 2])
