"""Where a mesh passes through itself."""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.geometry import Float, Integer, Mask

# Volumes below this share of a cell are rounding: what lies in one plane only touches.
ROUNDING = 1e-10


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


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def _crossings(vertices, triangles, low, high, starts, members, tiny):  # type: ignore[no-untyped-def]
    """Test all pairs of each cell whose boxes overlap."""
    crossing = np.zeros(len(triangles), np.bool_)
    for cell in range(len(starts) - 1):
        for at in range(starts[cell], starts[cell + 1]):
            s = members[at]
            for beside in range(at + 1, starts[cell + 1]):
                t = members[beside]
                apart = False
                for axis in range(3):
                    apart |= low[s, axis] > high[t, axis] or low[t, axis] > high[s, axis]
                if apart or (crossing[s] and crossing[t]):
                    continue
                one, other = triangles[s], triangles[t]
                if _pierces(vertices, one, other, tiny) or _pierces(vertices, other, one, tiny):
                    crossing[s] = crossing[t] = True
    return crossing


@njit(nogil=True, cache=True)
def _pierces(vertices, one, other, tiny):  # type: ignore[no-untyped-def]
    """Whether an edge of one triangle passes through another with which it shares no vertex."""
    a, b, c = other
    for corner in range(3):
        p, q = one[corner], one[(corner + 1) % 3]
        if p in (a, b, c) or q in (a, b, c):
            continue
        above, below = _side(vertices, a, b, c, p), _side(vertices, a, b, c, q)
        if min(above, below) > -tiny or max(above, below) < tiny:
            continue
        first = _side(vertices, p, q, a, b)
        second = _side(vertices, p, q, b, c)
        third = _side(vertices, p, q, c, a)
        if min(first, second, third) > tiny or max(first, second, third) < -tiny:
            return True
    return False


@njit(nogil=True, cache=True)
def _side(v, a, b, c, d):  # type: ignore[no-untyped-def]
    """Six times the signed volume of the tetrahedron a, b, c, d."""
    ux, uy, uz = v[b, 0] - v[a, 0], v[b, 1] - v[a, 1], v[b, 2] - v[a, 2]
    wx, wy, wz = v[c, 0] - v[a, 0], v[c, 1] - v[a, 1], v[c, 2] - v[a, 2]
    x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return x * (v[d, 0] - v[a, 0]) + y * (v[d, 1] - v[a, 1]) + z * (v[d, 2] - v[a, 2])
