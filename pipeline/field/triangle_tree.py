"""A tree of discs around triangles, and the exact search for the closest: compiled kernels.

A patch of a smooth surface is flat: a disc across its mean normal is thinner than an upright box
by far, so a search looks into few patches beside the closest. Every node of the tree has sixteen
children, whose discs are measured together by the processor's vector unit in single precision;
the discs are widened by more than its rounding, and triangles are measured in double precision,
so the distance that comes out is exact.

Importing this module imports numba. The kernels release the interpreter lock, so callers split
a grid over threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from pipeline.geometry import Float, Float32, Integer

WIDTH = 16
DISC_NUMBERS = 8
# Coordinates are kept from the surface's centre. Up to 250 mm from it single precision rounds
# them by 1.5e-5 mm at most, in the point and in the disc.
WIDER_MM = 1e-4
# The squared distance to a disc is a sum of about ten products, each good to 6e-8 of the squared
# distance to its centre.
ROUNDING = np.float32(2e-6)
# A child that is not there is far from everything.
NOWHERE_MM = 1e6
# A split in the middle of the space may peel off one triangle at a time. Past this depth the
# triangles are halved by count instead, so 32 more levels hold 2^32 of them.
MIDPOINT_DEPTH = 60
# A pile of waiting children is at most one node's per level of the tree.
STACK_SIZE = 2048


class TriangleTree(NamedTuple):
    """Discs and triangles, in the order of the tree."""

    discs: Float32
    """``(node, 8, 16)``: centre, unit axis, half the thickness, radius; of each child. From
    ``centre_mm``, mm."""

    children: npt.NDArray[np.int32]
    """``(node, 16)``: number of the child node, or -1 - number of a triangle."""

    triangles: Float
    """``(m, 12)``: a corner, two edges from it, and the edges' three dot products, mm."""

    centre_mm: Float
    """Middle of the surface: the origin of discs and triangles."""


def plant(vertices_mm: Float, triangles: Integer) -> TriangleTree:
    """Build the tree of ``(n, 3)`` vertices and ``(m, 3)`` vertex numbers.

    Triangles without area are left out: they are lines, and in a closed surface the triangles
    beside them cover those.
    """
    centre_mm = 0.5 * (vertices_mm.min(axis=0) + vertices_mm.max(axis=0))
    corners = (vertices_mm - centre_mm)[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = np.einsum("ij,ij->i", across, across) > 0
    corners, across = corners[solid], across[solid]
    count = len(corners)
    order, discs = np.arange(count), np.empty((2 * count, DISC_NUMBERS))
    pairs = np.empty((2 * count, 2), dtype=np.int32)
    _split(corners, across, order, discs, pairs)
    wide = np.zeros((count, DISC_NUMBERS, WIDTH), dtype=np.float32)
    wide[:, 0] = NOWHERE_MM
    children = np.zeros((count, WIDTH), dtype=np.int32)
    used = _widen(discs, pairs, wide, children)
    a, ab, ac = (corners[order, 0], *(corners[order, k] - corners[order, 0] for k in (1, 2)))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((ab, ab), (ab, ac), (ac, ac))]
    return TriangleTree(
        wide[:used], children[:used], np.column_stack([a, ab, ac, *dots]), centre_mm
    )


# Below, numbers are moved one by one: whole-array expressions take seconds to compile.


@njit(nogil=True, cache=True)
def _split(corners, across, order, discs, pairs):  # type: ignore[no-untyped-def]
    """Order the triangles, and fill the discs of a tree of pairs; a leaf is one triangle."""
    # What is still to be split: node, first, one past the last, depth.
    waiting = np.empty((STACK_SIZE, 4), dtype=np.int64)
    _wait(waiting, 0, 0, 0, len(order), 0)
    used, height = 1, 1
    while height > 0:
        height -= 1
        node, first = waiting[height, 0], waiting[height, 1]
        end, depth = waiting[height, 2], waiting[height, 3]
        _enclose(order, corners, across, first, end, discs[node])
        pairs[node, 0] = -1 - first
        if end - first == 1:
            continue
        middle = _partition(order, corners, first, end, depth)
        pairs[node, 0] = used
        pairs[node, 1] = used + 1
        # The larger half waits below the smaller one: the pile stays as high as log2(count).
        larger_first = middle - first > end - middle
        _wait(waiting, height + (not larger_first), used, first, middle, depth + 1)
        _wait(waiting, height + larger_first, used + 1, middle, end, depth + 1)
        used += 2
        height += 2


@njit(nogil=True, cache=True)
def _wait(waiting, place, node, first, end, depth):  # type: ignore[no-untyped-def]
    waiting[place, 0] = node
    waiting[place, 1] = first
    waiting[place, 2] = end
    waiting[place, 3] = depth


@njit(nogil=True, cache=True)
def _widen(discs, pairs, wide, children):  # type: ignore[no-untyped-def]
    """Make a tree of pairs a wide one, whose widest children give way to their own.

    Returns the number of wide nodes.
    """
    source = np.empty(len(discs), dtype=np.int64)
    gathered = np.empty(WIDTH, dtype=np.int64)
    source[0] = 0
    used, node = 1, 0
    while node < used:
        gathered[0] = source[node]
        count = 1
        while count < WIDTH:
            widest, radius = -1, -1.0
            for lane in range(count):
                if pairs[gathered[lane], 0] >= 0 and discs[gathered[lane], 7] > radius:
                    widest, radius = lane, discs[gathered[lane], 7]
            if widest < 0:
                break
            opened = gathered[widest]
            gathered[widest] = pairs[opened, 0]
            gathered[count] = pairs[opened, 1]
            count += 1
        for lane in range(count):
            for number in range(DISC_NUMBERS):
                wide[node, number, lane] = discs[gathered[lane], number]
            children[node, lane] = pairs[gathered[lane], 0]
            if pairs[gathered[lane], 0] >= 0:
                source[used] = gathered[lane]
                children[node, lane] = used
                used += 1
        node += 1
    return used


@njit(nogil=True, cache=True)
def _enclose(order, corners, across, first, end, disc):  # type: ignore[no-untyped-def]
    """The disc around ``order[first:end]``, across the mean normal of its triangles."""
    length2 = 0.0
    for k in range(3):
        low, high, along = np.inf, -np.inf, 0.0
        for place in range(first, end):
            along += across[order[place], k]
            for corner in range(3):
                low = min(low, corners[order[place], corner, k])
                high = max(high, corners[order[place], corner, k])
        disc[k] = 0.5 * (low + high)
        disc[3 + k] = along
        length2 += along * along
    if length2 == 0.0:
        # Normals that cancel leave every axis as good as another.
        disc[5] = length2 = 1.0
    for k in range(3, 6):
        disc[k] /= np.sqrt(length2)
    _measure_disc(order, corners, first, end, disc)


@njit(nogil=True, cache=True)
def _measure_disc(order, corners, first, end, disc):  # type: ignore[no-untyped-def]
    """Thickness and radius about the centre and axis in ``disc``; the centre moves between."""
    lowest, highest, radius2 = np.inf, -np.inf, 0.0
    for place in range(first, end):
        for corner in range(3):
            x = corners[order[place], corner, 0] - disc[0]
            y = corners[order[place], corner, 1] - disc[1]
            z = corners[order[place], corner, 2] - disc[2]
            along = x * disc[3] + y * disc[4] + z * disc[5]
            lowest, highest = min(lowest, along), max(highest, along)
            radius2 = max(radius2, x * x + y * y + z * z - along * along)
    for k in range(3):
        disc[k] += 0.5 * (lowest + highest) * disc[3 + k]
    disc[6] = 0.5 * (highest - lowest) + WIDER_MM
    disc[7] = np.sqrt(radius2) + WIDER_MM


@njit(nogil=True, cache=True)
def _middle(corners, triangle, axis):  # type: ignore[no-untyped-def]
    """Three times the centre of a triangle along an axis."""
    return corners[triangle, 0, axis] + corners[triangle, 1, axis] + corners[triangle, 2, axis]


@njit(nogil=True, cache=True)
def _partition(order, corners, first, end, depth):  # type: ignore[no-untyped-def]
    """Reorder ``order[first:end]`` into two halves along the widest axis; where they part."""
    axis, widest, cut = 0, -1.0, 0.0
    for one in range(3):
        lowest, highest = np.inf, -np.inf
        for place in range(first, end):
            at = _middle(corners, order[place], one)
            lowest, highest = min(lowest, at), max(highest, at)
        if highest - lowest > widest:
            axis, widest, cut = one, highest - lowest, 0.5 * (lowest + highest)
    part = first
    for place in range(first, end):
        if _middle(corners, order[place], axis) < cut:
            order[place], order[part] = order[part], order[place]
            part += 1
    if part in (first, end) or depth >= MIDPOINT_DEPTH:
        return (first + end) // 2
    return part


@njit(nogil=True, cache=True)
def _triangle_distance2(triangles, number, x, y, z):  # type: ignore[no-untyped-def]
    """Squared distance from a point to one triangle (Ericson, Real-Time Collision Detection)."""
    t = triangles[number]
    px, py, pz = x - t[0], y - t[1], z - t[2]
    along_ab = t[3] * px + t[4] * py + t[5] * pz
    along_ac = t[6] * px + t[7] * py + t[8] * pz
    ab2, abac, ac2 = t[9], t[10], t[11]
    v, w = _closest_weights(along_ab, along_ac, ab2, abac, ac2)
    dx = px - v * t[3] - w * t[6]
    dy = py - v * t[4] - w * t[7]
    dz = pz - v * t[5] - w * t[8]
    return dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True)
def _closest_weights(d1, d2, ab2, abac, ac2):  # type: ignore[no-untyped-def]
    """Weights of the edges ab and ac in the triangle's closest point.

    ``d1`` and ``d2`` are the dot products of ab and ac with the way from a to the point.
    """
    if d1 <= 0 and d2 <= 0:
        return 0.0, 0.0
    d3, d4 = d1 - ab2, d2 - abac
    if d3 >= 0 and d4 <= d3:
        return 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return d1 / ab2, 0.0
    d5, d6 = d1 - abac, d2 - ac2
    if d6 >= 0 and d5 <= d6:
        return 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return 0.0, d2 / ac2
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    return vb / (va + vb + vc), vc / (va + vb + vc)


@njit(nogil=True, cache=True)
def _bounds(discs, x, y, z, bounds):  # type: ignore[no-untyped-def]
    """Squared distances to a node's discs: no triangle in one can be nearer.

    Straight-line code on float32 alone becomes vector instructions; a count that is known only
    at run time keeps the compiler from unrolling the loop into single ones instead.
    """
    zero = np.float32(0)
    for lane in range(len(bounds)):
        px, py, pz = x - discs[0, lane], y - discs[1, lane], z - discs[2, lane]
        along = px * discs[3, lane] + py * discs[4, lane] + pz * discs[5, lane]
        away2 = px * px + py * py + pz * pz
        across2 = away2 - along * along
        across2 = across2 if across2 > zero else zero
        beyond = abs(along) - discs[6, lane]
        beyond = beyond if beyond > zero else zero
        outside = np.sqrt(across2) - discs[7, lane]
        outside = outside if outside > zero else zero
        bounds[lane] = beyond * beyond + outside * outside - ROUNDING * away2


@njit(nogil=True, cache=True)
def _search(tree, x, y, z, best, nearest, stack, waiting, bounds):  # type: ignore[no-untyped-def]
    """Closest triangle to a point, given one that is at squared distance ``best`` already."""
    discs, children, triangles, _ = tree
    x32, y32, z32 = np.float32(x), np.float32(y), np.float32(z)
    stack[0], waiting[0] = 0, -1.0
    height = 1
    while height > 0:
        height -= 1
        if waiting[height] >= best:
            continue
        node = stack[height]
        _bounds(discs[node], x32, y32, z32, bounds)
        for lane in range(WIDTH):
            if bounds[lane] >= best:
                continue
            child = children[node, lane]
            if child >= 0:
                stack[height], waiting[height] = child, bounds[lane]
                height += 1
                continue
            distance2 = _triangle_distance2(triangles, -1 - child, x, y, z)
            if distance2 < best:
                best, nearest = distance2, -1 - child
    return best, nearest


@njit(nogil=True, cache=True)
def layer_distance(tree, x_mm, y_mm, z_mm, out):  # type: ignore[no-untyped-def]
    """Unsigned distance of one layer of nodes ``(y, x)`` at height ``z_mm``, into ``out``.

    The closest triangles of the nodes before, in the row and in the row before, are a bound
    for the next, so the search opens almost only the discs that it must.
    """
    triangles, centre_mm = tree[2], tree[3]
    stack = np.empty(STACK_SIZE, dtype=np.int32)
    waiting, bounds = np.empty(STACK_SIZE, dtype=np.float32), np.empty(WIDTH, dtype=np.float32)
    row_before = np.zeros(len(x_mm), dtype=np.int64)
    z = z_mm - centre_mm[2]
    for j in range(len(y_mm)):
        y = y_mm[j] - centre_mm[1]
        nearest = row_before[0]
        for i in range(len(x_mm)):
            x = x_mm[i] - centre_mm[0]
            best = _triangle_distance2(triangles, nearest, x, y, z)
            other = _triangle_distance2(triangles, row_before[i], x, y, z)
            if other < best:
                best, nearest = other, row_before[i]
            best, nearest = _search(tree, x, y, z, best, nearest, stack, waiting, bounds)
            row_before[i] = nearest
            out[j, i] = np.sqrt(best)
