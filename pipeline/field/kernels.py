"""Compiled kernels: interpolation of the baked distance, and forces on all nodes.

Importing this module imports numba; only functions that need it do so. The kernels release the
interpreter lock, so callers split work over threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.extending import register_jitable

from pipeline.field import potential as formulas

# The compiled code calls the very functions that NumPy users call.
for _formula in (formulas.offence, formulas.potential, formulas.pull, formulas.direction_scale):
    register_jitable(_formula)
_pull = formulas.pull
_direction_scale = formulas.direction_scale


@njit(nogil=True, cache=True)
def _axis_weights(place, count, first, weights, slopes):  # type: ignore[no-untyped-def]
    """Catmull-Rom weights of four neighbours on one axis, and their slopes per node step.

    Beyond the grid's end the distance goes on in a straight line (one ghost node), which is
    folded into the weights of the two last nodes; so every index stays inside the grid.
    """
    place = min(max(place, 0.0), count - 1.0)
    cell = min(int(place), count - 2)
    t = place - cell
    weights[0] = ((2.0 - t) * t - 1.0) * t * 0.5
    weights[1] = ((3.0 * t - 5.0) * t * t + 2.0) * 0.5
    weights[2] = ((4.0 - 3.0 * t) * t + 1.0) * t * 0.5
    weights[3] = (t - 1.0) * t * t * 0.5
    slopes[0] = ((4.0 - 3.0 * t) * t - 1.0) * 0.5
    slopes[1] = (9.0 * t - 10.0) * t * 0.5
    slopes[2] = ((8.0 - 9.0 * t) * t + 1.0) * 0.5
    slopes[3] = (3.0 * t - 2.0) * t * 0.5
    for k in range(4):
        first[k] = cell - 1 + k
    if cell == 0:
        _fold(weights, 0, 1, 2)
        _fold(slopes, 0, 1, 2)
        first[0] = 0
    if cell == count - 2:
        _fold(weights, 3, 2, 1)
        _fold(slopes, 3, 2, 1)
        first[3] = count - 1


@njit(nogil=True, cache=True)
def _fold(values, ghost, end, before):  # type: ignore[no-untyped-def]
    values[end] += 2.0 * values[ghost]
    values[before] -= values[ghost]
    values[ghost] = 0.0


@njit(nogil=True, cache=True)
def interpolate(before, after, shares, origin_mm, spacing_mm, points_mm, distance_mm, gradient):  # type: ignore[no-untyped-def]
    """Distance and its gradient at points, between two stored phases.

    Parameters
    ----------
    before, after
        ``(z, y, x)`` distances of the two phases, mm.
    shares
        ``(n,)`` weight of ``after`` for every point.
    origin_mm, spacing_mm
        Of the grid, ``(x, y, z)``.
    points_mm
        ``(n, 3)``; those outside the grid are moved to its boundary.
    distance_mm, gradient
        Where the ``(n,)`` distances and ``(n, 3)`` gradients go.
    """
    index = np.empty((3, 4), dtype=np.int64)
    weights, slopes = np.empty((3, 4)), np.empty((3, 4))
    for number in range(len(points_mm)):
        for axis in range(3):
            place = (points_mm[number, axis] - origin_mm[axis]) / spacing_mm[axis]
            _axis_weights(place, before.shape[2 - axis], index[axis], weights[axis], slopes[axis])
        late = shares[number]
        early = 1.0 - late
        value, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
        for c in range(4):
            k = index[2, c]
            plane, plane_x, plane_y = 0.0, 0.0, 0.0
            for b in range(4):
                j = index[1, b]
                line, line_x = 0.0, 0.0
                for a in range(4):
                    i = index[0, a]
                    node = early * before[k, j, i] + late * after[k, j, i]
                    line += weights[0, a] * node
                    line_x += slopes[0, a] * node
                plane += weights[1, b] * line
                plane_x += weights[1, b] * line_x
                plane_y += slopes[1, b] * line
            value += weights[2, c] * plane
            gx += weights[2, c] * plane_x
            gy += weights[2, c] * plane_y
            gz += slopes[2, c] * plane
        distance_mm[number] = value
        gradient[number, 0] = gx / spacing_mm[0]
        gradient[number, 1] = gy / spacing_mm[1]
        gradient[number, 2] = gz / spacing_mm[2]


@njit(nogil=True, cache=True)
def _node_slope(distance_mm, k, j, i, dk, dj, di, spacing_mm):  # type: ignore[no-untyped-def]
    """The interpolant's slope at a node: central, one-sided at the grid's ends."""
    last = (distance_mm.shape[0] - 1, distance_mm.shape[1] - 1, distance_mm.shape[2] - 1)
    k0, j0, i0 = max(k - dk, 0), max(j - dj, 0), max(i - di, 0)
    k1, j1, i1 = min(k + dk, last[0]), min(j + dj, last[1]), min(i + di, last[2])
    steps = (k1 - k0) + (j1 - j0) + (i1 - i0)
    rise = np.float64(distance_mm[k1, j1, i1]) - np.float64(distance_mm[k0, j0, i0])
    return rise / (steps * spacing_mm)


@njit(nogil=True, cache=True)
def node_forces(distance_mm, spacing_mm, side, delta_mm, m, f_max_n, force_n):  # type: ignore[no-untyped-def]
    """The force at every node of one phase, into ``force_n`` ``(z, y, x, 3)``."""
    for k in range(distance_mm.shape[0]):
        for j in range(distance_mm.shape[1]):
            for i in range(distance_mm.shape[2]):
                gx = _node_slope(distance_mm, k, j, i, 0, 0, 1, spacing_mm[0])
                gy = _node_slope(distance_mm, k, j, i, 0, 1, 0, spacing_mm[1])
                gz = _node_slope(distance_mm, k, j, i, 1, 0, 0, spacing_mm[2])
                length = np.sqrt(gx * gx + gy * gy + gz * gz)
                size = _pull(np.float64(distance_mm[k, j, i]), side, delta_mm, m)
                scale = -f_max_n * size * _direction_scale(length)
                force_n[k, j, i, 0] = scale * gx
                force_n[k, j, i, 1] = scale * gy
                force_n[k, j, i, 2] = scale * gz


@njit(nogil=True, cache=True)
def largest_steps(force_n, distance_mm, near_mm, steps_n):  # type: ignore[no-untyped-def]
    """Largest force step between neighbouring nodes, into ``steps_n`` ``(2, 3)``.

    Per axis ``x, y, z``: row 0 over all nodes, row 1 over pairs both within ``near_mm`` of the
    surface.
    """
    for axis in range(3):
        steps_n[0, axis] = steps_n[1, axis] = 0.0
    shape = distance_mm.shape
    for k in range(shape[0]):
        for j in range(shape[1]):
            for i in range(shape[2]):
                near = abs(distance_mm[k, j, i]) <= near_mm
                for axis in range(3):
                    k1, j1, i1 = k + (axis == 2), j + (axis == 1), i + (axis == 0)
                    if k1 == shape[0] or j1 == shape[1] or i1 == shape[2]:
                        continue
                    step2 = 0.0
                    for part in range(3):
                        step2 += (force_n[k1, j1, i1, part] - force_n[k, j, i, part]) ** 2
                    steps_n[0, axis] = max(steps_n[0, axis], step2)
                    if near and abs(distance_mm[k1, j1, i1]) <= near_mm:
                        steps_n[1, axis] = max(steps_n[1, axis], step2)
    for axis in range(3):
        steps_n[0, axis] = np.sqrt(steps_n[0, axis])
        steps_n[1, axis] = np.sqrt(steps_n[1, axis])


@njit(nogil=True, cache=True)
def largest_change(before_n, after_n):  # type: ignore[no-untyped-def]
    """Largest change of force at a node between two phases, newtons."""
    largest = 0.0
    for k in range(before_n.shape[0]):
        for j in range(before_n.shape[1]):
            for i in range(before_n.shape[2]):
                change2 = 0.0
                for part in range(3):
                    change2 += (after_n[k, j, i, part] - before_n[k, j, i, part]) ** 2
                largest = max(largest, change2)
    return np.sqrt(largest)
