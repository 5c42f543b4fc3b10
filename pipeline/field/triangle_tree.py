"""Triangles in an order that keeps neighbours together, and boxes around runs of them.

The triangles are halved across their longest side until runs of eight are left; eight that follow
each other get an oriented box, eight boxes a larger one, and so on. A box lies along the mean
plane of what it holds: a patch of a smooth surface is flat, so such a box is thinner by far than
an upright one, and a search opens few beside the nearest. The tree needs no links: box i of a
level holds boxes 8 i to 8 i + 7 of the level below.

Importing this module imports numba. The kernels release the interpreter lock.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.geometry import Float, Float32, Integer

FAN = 8
# Rows of a box: middle (3), first axis (3), second axis (3), half its sizes (3).
BOX_ROWS = 12
# Numbers of a triangle: see `TriangleTree.triangles`.
TRIANGLE_NUMBERS = 19
# Fewer triangles than these are not worth a thread of their own.
SHARE = 8192
# Boxes that are not there are far from everything.
NOWHERE_MM = 1e6
_NO_BOX = np.array([NOWHERE_MM] * 3 + [1, 0, 0, 0, 1, 0, 0, 0, 0], dtype=np.float32)[:, None]
# How much larger than exact a box must be, as a share of R, the largest distance from the centre.
# Rounding to single precision moves a number by 2^-24 of itself at most. A point and a box's middle
# are each off by R 2^-24 along every axis and their difference, up to 2 R, by as much again, which
# a unit axis sums to 7 R 2^-24 at most; the axis is off by 2^-24 (the third, a cross product, by
# 3 times that), which the difference makes 11 R 2^-24 at most; sums of three products add 6 R 2^-24
# and the steps to a block's corners as much: 30 R 2^-24 altogether.
WIDER = 32 * 2.0**-24


class TriangleTree(NamedTuple):
    """Triangles and their boxes, all in millimetres from ``centre_mm``."""

    boxes: Float32
    """``(group, 12, 8)``: the boxes of all levels, eight side by side. Those of triangles come
    first; group i of a level holds what box i of the next level encloses."""

    starts: Integer
    """``(level + 1,)``: first group of every level, and one past the last."""

    triangles: Float
    """``(m, 19)``: corner A; unit axes along the longest edge AB, across it, and normal; length
    of AB; then direction in the plane and length of BC, and of AC."""

    centre_mm: Float
    """Middle of the surface."""


def plant(vertices_mm: Float, triangles: Integer, around_mm: Float, threads: int) -> TriangleTree:
    """Build the tree of ``(n, 3)`` vertices and ``(m, 3)`` vertex numbers.

    ``around_mm`` are two opposite corners ``(2, 3)`` of the space from which distances will be
    asked. Triangles without area are left out: they are lines, and in a closed surface the
    triangles beside them cover those. The tree does not depend on the number of threads.
    """
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    centre_mm = 0.5 * (low + high)
    reach_mm = float(max(np.abs(around_mm - centre_mm).max(), np.abs(high - centre_mm).max()))
    wider_mm = np.sqrt(3) * reach_mm * WIDER
    threads = max(1, min(threads, len(triangles) // SHARE))
    with ThreadPoolExecutor(threads) as pool:
        order = _sorted(vertices_mm, triangles, pool, threads)
        flat = np.empty((len(triangles), TRIANGLE_NUMBERS))
        runs = _runs(len(flat), threads)
        lay_flat = partial(_lay_flat, vertices_mm, triangles, order, centre_mm, flat)
        used = 0
        for (first, _), count in zip(
            runs, pool.map(lay_flat, *zip(*runs, strict=True)), strict=True
        ):
            if used < first:
                flat[used : used + count] = flat[first : first + count]
            used += count
        flat = flat[:used]
        starts = _level_starts(len(flat))
        boxes = np.empty((starts[-1], BOX_ROWS, FAN), dtype=np.float32)
        # The last group of a level may hold fewer than eight.
        boxes[starts[1:] - 1] = _NO_BOX
        runs = _runs(len(flat), threads)
        list(pool.map(partial(_box_triangles, flat, boxes, wider_mm), *zip(*runs, strict=True)))
        for level in range(1, len(starts) - 1):
            box = partial(_box_boxes, boxes, starts[level - 1], starts[level], wider_mm)
            runs = _runs(_box_count(len(flat), level), threads)
            list(pool.map(box, *zip(*runs, strict=True)))
    return TriangleTree(boxes, starts, flat, centre_mm)


def _runs(count: int, threads: int) -> list[tuple[int, int]]:
    """First and end of runs of about equal length, of whole groups of eight but for the last."""
    cuts = np.linspace(0, count, threads + 1).astype(int) // FAN * FAN
    cuts[-1] = count
    return list(pairwise(cuts))


def _sorted(
    vertices_mm: Float, triangles: Integer, pool: ThreadPoolExecutor, threads: int
) -> Integer:
    """Triangles in an order in which every run of 8, 16, 32, ... is close together."""
    order, middles = np.arange(len(triangles)), np.empty((len(triangles), 3))
    find = partial(_middles, vertices_mm, triangles, middles)
    list(pool.map(find, *zip(*_runs(len(order), threads), strict=True)))
    runs = [(0, len(order))]
    while len(runs) < threads:
        parts = pool.map(partial(_halve, middles, order), *zip(*runs, strict=True))
        runs = [half for (a, c), b in zip(runs, parts, strict=True) for half in ((a, b), (b, c))]
    list(pool.map(partial(_sort, middles, order), *zip(*runs, strict=True)))
    return order


def _box_count(triangles: int, level: int) -> int:
    """Number of boxes of a level."""
    return -(-triangles // int(FAN**level))


def _level_starts(count: int) -> Integer:
    """First group of every level; the last level is one group or a few."""
    groups = [-(-count // FAN)]
    while groups[-1] > FAN:
        groups.append(-(-groups[-1] // FAN))
    return np.concatenate([[0], np.cumsum(groups)])


def typical_size_mm(tree: TriangleTree) -> list[float]:
    """Mean of half the length of the boxes of every level."""
    return [
        float(np.mean(np.maximum(tree.boxes[a:b, 9], tree.boxes[a:b, 10])))
        for a, b in zip(tree.starts[:-1], tree.starts[1:], strict=True)
    ]


# Below, numbers are moved one by one: whole-array expressions take seconds to compile.


@njit(nogil=True, cache=True)
def _middles(vertices, triangles, middles, first, end):  # type: ignore[no-untyped-def]
    """Three times the middle of the triangles ``first`` to ``end``."""
    for number in range(first, end):
        a, b, c = triangles[number, 0], triangles[number, 1], triangles[number, 2]
        for k in range(3):
            middles[number, k] = vertices[a, k] + vertices[b, k] + vertices[c, k]


@njit(nogil=True, cache=True)
def _sort(middles, order, first, end):  # type: ignore[no-untyped-def]
    """Halve runs until they are no longer than eight."""
    waiting = np.empty((64, 2), dtype=np.int64)
    waiting[0, 0], waiting[0, 1] = first, end
    height = 1
    while height > 0:
        height -= 1
        first, end = waiting[height, 0], waiting[height, 1]
        while end - first > FAN:
            part = _halve(middles, order, first, end)
            waiting[height, 0], waiting[height, 1] = part, end
            height += 1
            end = part


@njit(nogil=True, cache=True)
def _halve(middles, order, first, end):  # type: ignore[no-untyped-def]
    """Part a run across its longest side; where its second half begins."""
    part = first + ((end - first) // 2 + FAN - 1) // FAN * FAN
    _select(middles, order, first, end - 1, part, _widest(middles, first, end))
    return part


@njit(nogil=True, cache=True)
def _widest(middles, first, end):  # type: ignore[no-untyped-def]
    """Axis along which the triangles first to end are spread most."""
    widest, axis = -1.0, 0
    for k in range(3):
        low = high = middles[first, k]
        for place in range(first + 1, end):
            low, high = min(low, middles[place, k]), max(high, middles[place, k])
        if high - low > widest:
            widest, axis = high - low, k
    return axis


@njit(nogil=True, cache=True)
def _select(middles, order, low, high, part, axis):  # type: ignore[no-untyped-def]
    """Move the least of places low to high before ``part`` (Hoare 1961, Find)."""
    while low < high:
        pivot = middles[(low + high) // 2, axis]
        left, right = low, high
        while left <= right:
            while middles[left, axis] < pivot:
                left += 1
            while middles[right, axis] > pivot:
                right -= 1
            if left <= right:
                for k in range(3):
                    middles[left, k], middles[right, k] = middles[right, k], middles[left, k]
                order[left], order[right] = order[right], order[left]
                left += 1
                right -= 1
        if part <= right:
            high = right
        elif part >= left:
            low = left
        else:
            return


@njit(nogil=True, cache=True)
def _lay_flat(vertices, triangles, order, centre, flat, first, end):  # type: ignore[no-untyped-def]
    """Describe the triangles of a run in their own planes, from ``flat[first]`` on; returns how
    many have an area."""
    used = first
    ab, ac = np.empty(3), np.empty(3)
    for number in order[first:end]:
        longest, turn = -1.0, 0
        for k in range(3):
            a, b = triangles[number, k], triangles[number, (k + 1) % 3]
            length2 = 0.0
            for axis in range(3):
                length2 += (vertices[b, axis] - vertices[a, axis]) ** 2
            if length2 > longest:
                longest, turn = length2, k
        if longest == 0.0:
            continue
        a = triangles[number, turn]
        b, c = triangles[number, (turn + 1) % 3], triangles[number, (turn + 2) % 3]
        length = np.sqrt(longest)
        for axis in range(3):
            flat[used, axis] = vertices[a, axis] - centre[axis]
            ab[axis] = (vertices[b, axis] - vertices[a, axis]) / length
            ac[axis] = vertices[c, axis] - vertices[a, axis]
        used += _describe(ab, ac, length, flat[used])
    return used - first


@njit(nogil=True, cache=True)
def _describe(ab, ac, length, out):  # type: ignore[no-untyped-def]
    """Axes and edges of one triangle in its plane; 0 if it has no area, else 1.

    The axis across AB is made square to it twice over, which keeps the axes square even where C
    is next to AB (Giraud et al. 2005). AB being the longest edge, C is then misplaced by rounding
    of its length at most, however thin the triangle.
    """
    along = ac[0] * ab[0] + ac[1] * ab[1] + ac[2] * ab[2]
    x, y, z = ac[0] - along * ab[0], ac[1] - along * ab[1], ac[2] - along * ab[2]
    rest = x * ab[0] + y * ab[1] + z * ab[2]
    x, y, z = x - rest * ab[0], y - rest * ab[1], z - rest * ab[2]
    height = np.sqrt(x * x + y * y + z * z)
    if height == 0.0:
        return 0
    x, y, z = x / height, y / height, z / height
    out[3], out[4], out[5] = ab[0], ab[1], ab[2]
    out[6], out[7], out[8] = x, y, z
    out[9] = ab[1] * z - ab[2] * y
    out[10] = ab[2] * x - ab[0] * z
    out[11] = ab[0] * y - ab[1] * x
    out[12] = length
    bc, ac_length = np.sqrt((along - length) ** 2 + height**2), np.sqrt(along**2 + height**2)
    out[13], out[14], out[15] = (along - length) / bc, height / bc, bc
    out[16], out[17], out[18] = along / ac_length, height / ac_length, ac_length
    return 1


@njit(nogil=True, cache=True)
def _box_triangles(flat, boxes, wider, first, end):  # type: ignore[no-untyped-def]
    """Boxes of triangles: along AB, across it, and flat."""
    for number in range(first, end):
        group, lane = number // FAN, number % FAN
        half_along, half_across = 0.5 * flat[number, 12], 0.5 * flat[number, 17] * flat[number, 18]
        for k in range(3):
            along, across = flat[number, 3 + k], flat[number, 6 + k]
            boxes[group, k, lane] = flat[number, k] + half_along * along + half_across * across
            boxes[group, 3 + k, lane] = along
            boxes[group, 6 + k, lane] = across
        boxes[group, 9, lane] = half_along + wider
        boxes[group, 10, lane] = half_across + wider
        boxes[group, 11, lane] = wider


@njit(nogil=True, cache=True)
def _normal(boxes, group, lane, normal):  # type: ignore[no-untyped-def]
    """Third axis of a box."""
    ax, ay, az = boxes[group, 3, lane], boxes[group, 4, lane], boxes[group, 5, lane]
    bx, by, bz = boxes[group, 6, lane], boxes[group, 7, lane], boxes[group, 8, lane]
    normal[0], normal[1], normal[2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(nogil=True, cache=True)
def _unit(vector):  # type: ignore[no-untyped-def]
    """Make a vector one long, unless it is none; tells whether it is one."""
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    if length < 1e-12:
        return False
    for k in range(3):
        vector[k] /= length
    return True


@njit(nogil=True, cache=True)
def _choose_axes(boxes, group, count, axes, normal):  # type: ignore[no-untyped-def]
    """Axes of a box around eight: their mean normal, and the way from their middle to the
    furthest of them."""
    middle, third = np.zeros(3), axes[2]
    for k in range(3):
        third[k] = 0.0
    for lane in range(count):
        _normal(boxes, group, lane, normal)
        area = boxes[group, 9, lane] * boxes[group, 10, lane]
        for k in range(3):
            third[k] += area * normal[k]
            middle[k] += boxes[group, k, lane] / count
    if not _unit(third):
        # Normals that cancel leave every axis as good as another.
        for k in range(3):
            third[k] = normal[k]
        _unit(third)
    furthest = -1.0
    for lane in range(count):
        height, length2 = 0.0, 0.0
        for k in range(3):
            normal[k] = boxes[group, k, lane] - middle[k]
            height += normal[k] * third[k]
        for k in range(3):
            normal[k] -= height * third[k]
            length2 += normal[k] ** 2
        if length2 > furthest:
            furthest = length2
            for k in range(3):
                axes[0, k] = normal[k]
    if not _unit(axes[0]):
        least = 0 if abs(third[0]) < 0.6 else 1
        part = -third[least]
        for k in range(3):
            axes[0, k] = part * third[k]
        axes[0, least] += 1.0
        _unit(axes[0])
    axes[1, 0] = third[1] * axes[0, 2] - third[2] * axes[0, 1]
    axes[1, 1] = third[2] * axes[0, 0] - third[0] * axes[0, 2]
    axes[1, 2] = third[0] * axes[0, 1] - third[1] * axes[0, 0]


@njit(nogil=True, cache=True)
def _box_boxes(boxes, source, target, wider, first, end):  # type: ignore[no-untyped-def]
    """Boxes around the groups ``first`` to ``end`` of the level from ``source`` on, each of eight
    boxes or, at the end, fewer."""
    axes, normal = np.empty((3, 3)), np.empty(3)
    for number in range(first, end):
        held = source + number
        lanes = FAN
        while boxes[held, 0, lanes - 1] == NOWHERE_MM:
            lanes -= 1
        _choose_axes(boxes, held, lanes, axes, normal)
        group, lane = target + number // FAN, number % FAN
        boxes[group, 0, lane] = boxes[group, 1, lane] = boxes[group, 2, lane] = 0.0
        for axis in range(3):
            low, high = np.inf, -np.inf
            for one in range(lanes):
                at, half = _extent(boxes, held, one, axes, axis, normal)
                low, high = min(low, at - half), max(high, at + half)
            for k in range(3):
                boxes[group, k, lane] += 0.5 * (low + high) * axes[axis, k]
                if axis < 2:
                    boxes[group, 3 + 3 * axis + k, lane] = axes[axis, k]
            boxes[group, 9 + axis, lane] = 0.5 * (high - low) * (1 + WIDER) + wider


@njit(nogil=True, cache=True)
def _extent(boxes, group, lane, axes, axis, normal):  # type: ignore[no-untyped-def]
    """Where the middle of a box is along an axis, and half its size along it."""
    _normal(boxes, group, lane, normal)
    at, first, second, third = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        at += boxes[group, k, lane] * axes[axis, k]
        first += boxes[group, 3 + k, lane] * axes[axis, k]
        second += boxes[group, 6 + k, lane] * axes[axis, k]
        third += normal[k] * axes[axis, k]
    half = boxes[group, 9, lane] * abs(first) + boxes[group, 10, lane] * abs(second)
    return at, half + boxes[group, 11, lane] * abs(third)
