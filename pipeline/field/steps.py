"""Compiled measures of how far a force changes between neighbouring nodes and phases."""

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
