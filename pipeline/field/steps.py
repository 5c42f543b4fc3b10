"""Compiled measures of how far a force, or what it is made of, changes between neighbouring nodes
and phases."""

from __future__ import annotations

import math

from numba import njit


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
        steps_n[0, axis] = math.sqrt(steps_n[0, axis])
        steps_n[1, axis] = math.sqrt(steps_n[1, axis])


@njit(nogil=True, cache=True, fastmath={"nnan", "nsz"})
def largest_differences(values, first, second):  # type: ignore[no-untyped-def]
    """Largest differences between neighbouring nodes, where they are larger than what is there:
    along ``x, y, z`` into ``first`` ``(3,)``, and of those along each axis into ``second``
    ``(3, 3)``."""
    depth, height = values.shape[:2]
    for k in range(depth):
        for j in range(height):
            # One row of its own for each: the loops along it become vector instructions.
            row = values[k, j]
            first[0], second[0, 0] = _along(row, first[0], second[0, 0])
            for axis in range(1, 3):
                place, last = (j, height - 1) if axis == 1 else (k, depth - 1)
                if place == last:
                    continue
                after = values[k, j + 1] if axis == 1 else values[k + 1, j]
                first[axis], second[0, axis] = _across(row, after, first[axis], second[0, axis])
                if place > 0:
                    before = values[k, j - 1] if axis == 1 else values[k - 1, j]
                    second[axis, axis] = _bent(before, row, row, after, second[axis, axis])
            if j < height - 1 and k < depth - 1:
                beside = values[k, j + 1], values[k + 1, j], values[k + 1, j + 1]
                second[1, 2] = _bent(row, beside[0], beside[1], beside[2], second[1, 2])
    for axis in range(3):
        for other in range(axis):
            second[axis, other] = second[other, axis]


@njit(nogil=True, cache=True, fastmath={"nnan", "nsz"})
def _along(row, most, bent):  # type: ignore[no-untyped-def]
    for i in range(len(row) - 1):
        most = max(most, abs(row[i + 1] - row[i]))
    for i in range(1, len(row) - 1):
        bent = max(bent, abs(row[i + 1] - row[i] - (row[i] - row[i - 1])))
    return most, bent


@njit(nogil=True, cache=True, fastmath={"nnan", "nsz"})
def _across(row, after, most, bent):  # type: ignore[no-untyped-def]
    for i in range(len(row)):
        most = max(most, abs(after[i] - row[i]))
    for i in range(len(row) - 1):
        bent = max(bent, abs(after[i + 1] - row[i + 1] - (after[i] - row[i])))
    return most, bent


@njit(nogil=True, cache=True, fastmath={"nnan", "nsz"})
def _bent(a, b, c, d, bent):  # type: ignore[no-untyped-def]
    """How far ``d - c`` is from ``b - a``, at most."""
    for i in range(len(a)):
        bent = max(bent, abs(d[i] - c[i] - (b[i] - a[i])))
    return bent


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
    return math.sqrt(largest)
