"""Which nodes of a grid a closed surface encloses: compiled kernel and its guard.

Every row of nodes along x is a ray. A triangle that the ray crosses adds or takes one to the
winding number of all nodes behind the crossing. Two triangles that share an edge evaluate the
same expression on the same numbers for it, and a ray that hits an edge or corner exactly is
moved by an infinitesimal step in y and a smaller one in z (simulation of simplicity, Edelsbrunner
& Muecke 1990), so no crossing is counted twice or lost; the sign does not depend on which
feature of the surface is nearest, which is what makes thin walls and touching sheets safe.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numba import njit

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Integer

# Rounding can lose a crossing only for a ray within about 1e-13 mm of an edge; a row whose
# crossings do not cancel is asked again from beside.
ATTEMPTS = 4
STEP_ASIDE_MM = 1e-7


def negate_inside(
    distance_mm: Float32,
    vertices_mm: Float,
    triangles: Integer,
    axes_mm: tuple[Float, Float, Float],
    threads: int,
) -> None:
    """Negate the distances ``(z, y, x)`` of nodes with a winding number above zero.

    The surface must be closed and face outwards; ``axes_mm`` are the coordinates of the nodes
    along x, y and z. Every thread works on layers of its own.

    Raises
    ------
    StageError
        When the crossings of a row do not cancel, which closed surfaces do not allow.
    """
    x_mm, y_mm, z_mm = axes_mm
    winding = np.empty((len(z_mm), len(y_mm), len(x_mm) + 1), dtype=np.int16)
    cuts = np.linspace(0, len(z_mm), threads + 1).astype(int)

    def count(first: int, end: int) -> bool:
        rows = x_mm, y_mm + aside_mm, z_mm + aside_mm / 3
        return bool(_count_crossings(vertices_mm, triangles, *rows, first, end, winding))

    with ThreadPoolExecutor(threads) as pool:
        for attempt in range(ATTEMPTS):
            aside_mm = attempt * STEP_ASIDE_MM
            if all(list(pool.map(count, cuts[:-1], cuts[1:]))):
                list(pool.map(partial(_negate, winding, distance_mm), cuts[:-1], cuts[1:]))
                return
    raise StageError(
        "the rays through the surface enter and leave it unequally often; it is not closed"
    )


@njit(nogil=True, cache=True, forceinline=True)
def _edge_side(vertices, first, second, y, z):  # type: ignore[no-untyped-def]
    """Twice the signed area of the edge and the ray seen along x; and its sign, never zero
    unless the edge is seen as a point."""
    flip = 1.0
    if first > second:
        first, second, flip = second, first, -1.0
    ay, az = vertices[first, 1], vertices[first, 2]
    dy, dz = vertices[second, 1] - ay, vertices[second, 2] - az
    area = dy * (z - az) - dz * (y - ay)
    sign = area
    if sign == 0:
        sign = -dz
    if sign == 0:
        sign = dy
    return flip * area, flip * np.sign(sign)


@njit(nogil=True, cache=True, forceinline=True)
def _node_range(low, high, start, step, count):  # type: ignore[no-untyped-def]
    """First and one past the last node of [low, high], one wider for rounding."""
    first = max(math.floor((low - start) / step), 0)
    end = min(math.ceil((high - start) / step) + 1, count)
    return first, end


@njit(nogil=True, cache=True, forceinline=True)
def crossing(vertices, a, b, c, y, z):  # type: ignore[no-untyped-def]
    """Direction in which the ray along x through (y, z) crosses the triangle (0: not at all), and
    where; 1 where the triangle faces +x."""
    area_c, side_c = _edge_side(vertices, a, b, y, z)
    area_a, side_a = _edge_side(vertices, b, c, y, z)
    if side_a != side_c or side_a == 0:
        return 0, 0.0
    area_b, side_b = _edge_side(vertices, c, a, y, z)
    if side_b != side_a:
        return 0, 0.0
    total = area_a + area_b + area_c
    if total == 0:
        return int(side_a), vertices[a, 0]
    x = area_a * vertices[a, 0] + area_b * vertices[b, 0] + area_c * vertices[c, 0]
    return int(side_a), x / total


@njit(nogil=True, cache=True)
def _count_crossings(vertices, triangles, x_mm, y_mm, z_mm, first, end, winding):  # type: ignore[no-untyped-def]
    """Count the crossings of the rows in layers ``first`` to ``end``; whether all cancel."""
    step_x, step_y, step_z = x_mm[1] - x_mm[0], y_mm[1] - y_mm[0], z_mm[1] - z_mm[0]
    winding[first:end] = 0
    for number in range(len(triangles)):
        a, b, c = triangles[number, 0], triangles[number, 1], triangles[number, 2]
        za, zb, zc = vertices[a, 2], vertices[b, 2], vertices[c, 2]
        first_k, end_k = _node_range(min(za, zb, zc), max(za, zb, zc), z_mm[0], step_z, len(z_mm))
        first_k, end_k = max(first_k, first), min(end_k, end)
        if first_k >= end_k:
            continue
        ya, yb, yc = vertices[a, 1], vertices[b, 1], vertices[c, 1]
        first_j, end_j = _node_range(min(ya, yb, yc), max(ya, yb, yc), y_mm[0], step_y, len(y_mm))
        for k in range(first_k, end_k):
            for j in range(first_j, end_j):
                direction, x = crossing(vertices, a, b, c, y_mm[j], z_mm[k])
                if direction != 0:
                    # A counter-clockwise triangle seen from +x faces +x: the ray leaves there.
                    behind = math.ceil((x - x_mm[0]) / step_x)
                    behind = min(max(behind, 0), len(x_mm))
                    winding[k, j, behind] -= direction
    return not _accumulate(winding, first, end)


@njit(nogil=True, cache=True, forceinline=True)
def _accumulate(winding, first, end):  # type: ignore[no-untyped-def]
    """Sum the crossings along the rows; how many rows do not end outside."""
    open_rows = 0
    for k in range(first, end):
        for j in range(winding.shape[1]):
            total = 0
            for i in range(winding.shape[2]):
                total += winding[k, j, i]
                winding[k, j, i] = total
            open_rows += total != 0
    return open_rows


@njit(nogil=True, cache=True)
def _negate(winding, distance, first, end):  # type: ignore[no-untyped-def]
    """Make the distance negative where the surface winds around."""
    for k in range(first, end):
        for j in range(distance.shape[1]):
            for i in range(distance.shape[2]):
                if winding[k, j, i] > 0:
                    distance[k, j, i] = -distance[k, j, i]


def winding_number(corners_mm: Float) -> float:
    """How often triangles ``(n, 3, 3)`` wind around the origin.

    Solid angles by van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30:125-126 (1983).
    """
    a, b, c = corners_mm.transpose(1, 0, 2)
    p, q, r = (np.linalg.norm(one, axis=1) for one in (a, b, c))
    triple = (a * np.cross(b, c)).sum(axis=1)
    around = p * q * r + (a * b).sum(axis=1) * r + (a * c).sum(axis=1) * q + (b * c).sum(axis=1) * p
    return float(np.arctan2(triple, around).sum() / (2 * np.pi))
