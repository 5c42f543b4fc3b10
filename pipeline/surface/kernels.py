"""Compiled inner loops of the surfaces: sampling a grid, fitting, smoothing, judging triangles.

Serial loops with a fixed order, so the same input gives the same bytes; they release the
interpreter lock, so structures can be worked on side by side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def sample(field, points):  # type: ignore[no-untyped-def]
    """Trilinear value ``(n,)`` and gradient ``(n, 3)`` of ``(z, y, x)`` values.

    Points ``(n, 3)`` are ``(x, y, z)`` in voxels; those beyond the grid read its border.
    """
    depth, height, width = field.shape
    values, gradients = np.empty(len(points)), np.empty((len(points), 3))
    for n in range(len(points)):
        x = min(max(points[n, 0], 0.0), width - 1.0)
        y = min(max(points[n, 1], 0.0), height - 1.0)
        z = min(max(points[n, 2], 0.0), depth - 1.0)
        i, j, k = min(int(x), width - 2), min(int(y), height - 2), min(int(z), depth - 2)
        u, v, w = x - i, y - j, z - k
        near_low, near_low_slope = _along_x(field, k, j, i, u)
        near_high, near_high_slope = _along_x(field, k, j + 1, i, u)
        far_low, far_low_slope = _along_x(field, k + 1, j, i, u)
        far_high, far_high_slope = _along_x(field, k + 1, j + 1, i, u)
        near = near_low + v * (near_high - near_low)
        far = far_low + v * (far_high - far_low)
        near_slope = near_low_slope + v * (near_high_slope - near_low_slope)
        far_slope = far_low_slope + v * (far_high_slope - far_low_slope)
        values[n] = near + w * (far - near)
        gradients[n, 0] = near_slope + w * (far_slope - near_slope)
        gradients[n, 1] = (1 - w) * (near_high - near_low) + w * (far_high - far_low)
        gradients[n, 2] = far - near
    return values, gradients


@njit(nogil=True, cache=True)
def _along_x(field, k, j, i, u):  # type: ignore[no-untyped-def]
    """Value and slope on one edge of a cell."""
    low, high = float(field[k, j, i]), float(field[k, j, i + 1])
    return low + u * (high - low), high - low


@njit(nogil=True, cache=True)
def chebyshev(starts, neighbours, weights, values, centre, radius, rounds):  # type: ignore[no-untyped-def]
    """Solve M u = v for ``(n, 3)`` values by Chebyshev's iteration, M in compressed rows.

    Unsigned ``starts`` and ``neighbours`` are quicker by a third: they cannot count from the end.
    """
    found, rest, step = np.zeros_like(values), values.copy(), values / centre
    after = np.empty_like(step)
    ratio = radius / centre
    for _ in range(rounds):
        following = 1 / (2 * centre / radius - ratio)
        onward = following * ratio
        for n in range(len(values)):
            x = y = z = 0.0
            for at in range(starts[n], starts[n + 1]):
                other, weight = neighbours[at], weights[at]
                x += weight * step[other, 0]
                y += weight * step[other, 1]
                z += weight * step[other, 2]
            rest[n, 0] -= x
            rest[n, 1] -= y
            rest[n, 2] -= z
            for axis in range(3):
                found[n, axis] += step[n, axis]
                after[n, axis] = onward * step[n, axis] + 2 * following / radius * rest[n, axis]
        step, after = after, step
        ratio = following
    return found


@njit(nogil=True, cache=True)
def affine_equations(basis, gradient, distance, weights):  # type: ignore[no-untyped-def]
    """Sums w r r^T ``(12, 12)`` and w r d ``(12,)``, a point's r being basis times gradient.

    A product by BLAS wakes its threads for so little, which then cost more than the sums, and
    rounds as many ways as a machine has processors.
    """
    normal, right, row = np.zeros((12, 12)), np.zeros(12), np.empty(12)
    for n in range(len(basis)):
        for i in range(12):
            row[i] = basis[n, i // 3] * gradient[n, i % 3]
        for i in range(12):
            weighted = weights[n] * row[i]
            right[i] += weighted * distance[n]
            for j in range(12):
                normal[i, j] += weighted * row[j]
    return normal, right


@njit(nogil=True, cache=True)
def corner_normals(vertices, triangles):  # type: ignore[no-untyped-def]
    """Twice the area-weighted sum of the normals round each vertex ``(n, 3)``, and of the areas."""
    normals, areas = np.zeros_like(vertices), np.zeros(len(vertices))
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x, y, z = face_normal(vertices, a, b, c)
        area = math.sqrt(x * x + y * y + z * z)
        for corner in range(3):
            n = triangles[t, corner]
            normals[n, 0] += x
            normals[n, 1] += y
            normals[n, 2] += z
            areas[n] += area
    return normals, areas


@njit(nogil=True, cache=True)
def face_normal(vertices, a, b, c):  # type: ignore[no-untyped-def]
    """Normal of a triangle, as long as twice its area."""
    ux = vertices[b, 0] - vertices[a, 0]
    uy = vertices[b, 1] - vertices[a, 1]
    uz = vertices[b, 2] - vertices[a, 2]
    vx = vertices[c, 0] - vertices[a, 0]
    vy = vertices[c, 1] - vertices[a, 1]
    vz = vertices[c, 2] - vertices[a, 2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(nogil=True, cache=True)
def faulty(vertices, triangles, least_quality):  # type: ignore[no-untyped-def]
    """Which triangles ``(m,)`` look away from the surface round them or are slivers.

    The quality is 4 sqrt(3) area over the sum of squared edges.
    """
    around, _ = corner_normals(vertices, triangles)
    for n in range(len(around)):
        length = math.sqrt(around[n, 0] ** 2 + around[n, 1] ** 2 + around[n, 2] ** 2)
        for axis in range(3):
            around[n, axis] /= max(length, 1e-300)
    fault = np.zeros(len(triangles), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x, y, z = face_normal(vertices, a, b, c)
        facing = squares = 0.0
        for corner in range(3):
            n, other = triangles[t, corner], triangles[t, (corner + 1) % 3]
            facing += x * around[n, 0] + y * around[n, 1] + z * around[n, 2]
            for axis in range(3):
                squares += (vertices[n, axis] - vertices[other, axis]) ** 2
        doubled_area = math.sqrt(x * x + y * y + z * z)
        fault[t] = facing <= 0 or 2 * math.sqrt(3) * doubled_area < least_quality * squares
    return fault
