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

import numpy as np
from numba import njit

from pipeline.errors import StageError
from pipeline.geometry import Float, Grid, Integer, Mask

# Rounding can lose a crossing only for a ray within about 1e-13 mm of an edge; a row whose
# crossings do not cancel is asked again from beside.
ATTEMPTS = 4
STEP_ASIDE_MM = 1e-7


def inside_nodes(vertices_mm: Float, triangles: Integer, grid: Grid) -> Mask:
    """Nodes ``(z, y, x)`` with a winding number above zero, for a closed outward surface.

    Raises
    ------
    StageError
        When the crossings of a row do not cancel, which closed surfaces do not allow.
    """
    axes = [
        grid.origin_mm[axis] + grid.spacing_mm[axis] * np.arange(grid.shape[2 - axis])
        for axis in range(3)
    ]
    for attempt in range(ATTEMPTS):
        aside_mm = attempt * STEP_ASIDE_MM
        winding = np.zeros((grid.shape[0], grid.shape[1], grid.shape[2] + 1), dtype=np.int16)
        _count_crossings(
            vertices_mm, triangles, axes[0], axes[1] + aside_mm, axes[2] + aside_mm / 3, winding
        )
        np.cumsum(winding, axis=2, out=winding)
        if not winding[:, :, -1].any():
            inside: Mask = winding[:, :, :-1] > 0
            return inside
    raise StageError(
        "the rays through the surface enter and leave it unequally often; it is not closed"
    )


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def _node_range(low, high, start, step, count):  # type: ignore[no-untyped-def]
    """First and one past the last node of [low, high], one wider for rounding."""
    first = max(math.floor((low - start) / step), 0)
    end = min(math.ceil((high - start) / step) + 1, count)
    return first, end


@njit(nogil=True, cache=True)
def _crossing(vertices, a, b, c, y, z):  # type: ignore[no-untyped-def]
    """Direction in which the ray crosses the triangle (0: not at all), and where along x."""
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
def _count_crossings(vertices, triangles, x_mm, y_mm, z_mm, winding):  # type: ignore[no-untyped-def]
    step_x, step_y, step_z = x_mm[1] - x_mm[0], y_mm[1] - y_mm[0], z_mm[1] - z_mm[0]
    for number in range(len(triangles)):
        a, b, c = triangles[number]
        ya, yb, yc = vertices[a, 1], vertices[b, 1], vertices[c, 1]
        za, zb, zc = vertices[a, 2], vertices[b, 2], vertices[c, 2]
        first_j, end_j = _node_range(min(ya, yb, yc), max(ya, yb, yc), y_mm[0], step_y, len(y_mm))
        first_k, end_k = _node_range(min(za, zb, zc), max(za, zb, zc), z_mm[0], step_z, len(z_mm))
        for k in range(first_k, end_k):
            for j in range(first_j, end_j):
                direction, x = _crossing(vertices, a, b, c, y_mm[j], z_mm[k])
                if direction != 0:
                    # A counter-clockwise triangle seen from +x faces +x: the ray leaves there.
                    behind = math.ceil((x - x_mm[0]) / step_x)
                    behind = min(max(behind, 0), len(x_mm))
                    winding[k, j, behind] -= direction
