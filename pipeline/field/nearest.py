"""Exact distance from grid nodes to the nearest triangle, block by block: compiled kernels.

A block of nodes inherits from the block around it the boxes of triangles that can hold the
nearest to any of its nodes, and passes on those that still can. Let q be a point of the surface
and p another. Then ``|v - p|^2 - |v - q|^2`` is linear in v, so if p is nearer than q to any point
v of the block it is so to one of its eight corners; and if it is, so is the box around p. This
rule is exact but for the box. It does not weaken with the distance from the surface, as bounds
from a block's middle and radius do (triangle inequality), so the nodes far away cost no more than
those nearby. In the end a cube of 2 x 2 x 2 nodes measures one triangle that is near, and then
those whose boxes are nearer to one of the nodes than what was measured.

Most boxes are sifted out by less. With m the block's middle and h half its sizes, the difference
above is at the corner where it is least ``|m - p|^2 - |m - q|^2 - 2 h . abs(p - q)``; so where a
box is farther from m than ``|m - q|^2`` and twice h times the farthest that it reaches from q along
each axis, it holds no such p. That asks for one distance instead of eight.

Boxes are compared in single precision, sixteen at a time on a wide processor, and have been made
larger by more than the rounding; triangles are measured in double precision, so the distance that
comes out is exact.

Kernels are compiled into their callers, for a call hands over every array of the tree and of the
work. They make no array and do not count who holds one, which takes as long as a tenth of the
search: whoever calls `block_distance` holds them all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from pipeline.field.triangle_tree import BOX_ROWS, FAN, TriangleTree, typical_size_mm
from pipeline.geometry import Float, Float32, Integer

# Nodes along the side of a task of one thread, and of a cube that is measured at once.
TOP, LEAST = 32, 2
CORNERS = 8
# One list for all boxes, for blocks of 32, 16, 8 and 4 nodes a side, and one for a cube; behind
# them one of those that a sieve has let through.
DEPTHS = SIFTED = 6
# Lists are worked on in whole vectors; what is behind their end is worked on in vain.
LANES = 16
# A block holds boxes whose half length is this part of its own. Twice or half as much is slower.
BOX_TO_BLOCK = 0.5
# More than the rounding of a sum of squares in single precision, and of the sum of more.
SLACK, MORE_SLACK = np.float32(1 + 1e-6), np.float32(1 + 8e-6)
# Numba compiles a function anew for a literal number; this one is a number like any other.
NOUGHT = np.int64(0)
# Without a count of who holds which array.
UNCOUNTED = {"nogil": True, "cache": True, "_nrt": False}
# Minima are vector instructions only where NaN is ruled out. Fused products round less, not more.
FAST = {"nnan", "nsz", "contract"}


class Work(NamedTuple):
    """What one thread works with."""

    lists: Float32
    """``(depth + 1, 12, n)``: boxes that blocks hold, one list a depth, rows as in the tree; and
    those of one of them that were sifted."""

    numbers: npt.NDArray[np.uint32]
    """``(depth, n)``: numbers of these boxes in their level of the tree. Unsigned, as are places:
    a signed index is asked first whether it counts from the end."""

    counts: Integer
    """``(depth,)``: how many they are."""

    held: Integer
    """``(depth,)``: their level."""

    bound: Float32
    """``(n,)``: a figure for every box of a list."""

    kept: npt.NDArray[np.uint32]
    """``(n,)``: places in a list."""

    upper: Float32
    """``(8,)``: squared distances of a block's corners to some point of the surface."""

    middle: Float
    """``(3,)``: middle of a block, mm from the tree's centre."""

    half: Float
    """``(3,)``: half its sizes, mm."""

    point: Float
    """``(3,)``: some point of the surface, near the block."""

    nodes: Float
    """``(3, 8)``: the nodes of a cube."""

    best: Float
    """``(8,)``: their distances, squared until the last."""

    least: Float32
    """``(16,)``: the least of a figure in every lane."""

    first: Integer
    """``(depth, 3)``: first node (z, y, x) of the block of each depth."""

    visited: Integer
    """``(depth,)``: how many of its eight parts are done."""


def levels_of_blocks(tree: TriangleTree, spacing_mm: tuple[float, float, float]) -> Integer:
    """Level of the boxes that blocks of 32, 16, 8 and 4 nodes a side hold: single triangles in the
    end, but where those are much finer than the grid."""
    sizes_mm, mean_mm = typical_size_mm(tree), float(np.mean(spacing_mm))
    levels = []
    for nodes in (32, 16, 8, 4):
        half_mm = BOX_TO_BLOCK * 0.5 * (nodes - 1) * mean_mm
        levels.append(max((k for k, size in enumerate(sizes_mm) if size <= half_mm), default=0))
    return np.array(levels)


@njit(nogil=True, cache=True)
def prepared(tree):  # type: ignore[no-untyped-def]
    """Room for the longest lists there can be; only what is used becomes memory.

    Compiled, for NumPy asks for pages of megabytes, which are cleared whole.
    """
    fan = tree.boxes.shape[2]
    room = (len(tree.triangles) // fan + 1 + fan) * fan + LANES
    return Work(
        np.empty((DEPTHS + 1, tree.boxes.shape[1], room), np.float32),
        np.empty((DEPTHS, room), np.uint32),
        np.zeros(DEPTHS, np.int64),
        np.zeros(DEPTHS, np.int64),
        np.empty(room, np.float32),
        np.empty(room, np.uint32),
        np.empty(CORNERS, np.float32),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty((3, CORNERS)),
        np.empty(CORNERS),
        np.empty(LANES, np.float32),
        np.empty((DEPTHS, 3), np.int64),
        np.empty(DEPTHS, np.int64),
    )


@njit(**UNCOUNTED, forceinline=True, fastmath=FAST)
def _closest_middle(work, depth):  # type: ignore[no-untyped-def]
    """Place in a list of the box whose middle is closest to the block's."""
    lists, away2, count = work.lists, work.bound, work.counts[depth]
    x, y, z = np.float32(work.middle[0]), np.float32(work.middle[1]), np.float32(work.middle[2])
    for k in range(-count // LANES * -LANES):
        dx, dy, dz = lists[depth, 0, k] - x, lists[depth, 1, k] - y, lists[depth, 2, k] - z
        away2[k] = dx * dx + dy * dy + dz * dz
    for k in range(count, -count // LANES * -LANES):
        away2[k] = np.inf
    # One minimum a lane, for a single one is found box after box.
    least = work.least
    for lane in range(LANES):
        least[lane] = np.inf
    for k in range(0, count, LANES):
        for lane in range(LANES):
            least[lane] = min(least[lane], away2[k + lane])
    nearest = least[0]
    for lane in range(LANES):
        nearest = min(nearest, least[lane])
    closest = 0
    while away2[closest] > nearest:
        closest += 1
    return closest


@njit(**UNCOUNTED, forceinline=True, fastmath=FAST)
def _away2(u, v, w, half):  # type: ignore[no-untyped-def]
    """Squared distance from a box, in its axes."""
    zero = np.float32(0)
    du, dv = max(abs(u) - half[0], zero), max(abs(v) - half[1], zero)
    dw = max(abs(w) - half[2], zero)
    return du * du + dv * dv + dw * dw


@njit(**UNCOUNTED, forceinline=True, fastmath=FAST)
def _bounds(lists, depth, count, middle, half_block, upper, bound):  # type: ignore[no-untyped-def]
    """For each box: the least, over the corners of a block, of its squared distance less the
    bound there."""
    x, y, z = np.float32(middle[0]), np.float32(middle[1]), np.float32(middle[2])
    hx, hy, hz = np.float32(half_block[0]), np.float32(half_block[1]), np.float32(half_block[2])
    upper_0, upper_1, upper_2, upper_3 = upper[0], upper[1], upper[2], upper[3]
    upper_4, upper_5, upper_6, upper_7 = upper[4], upper[5], upper[6], upper[7]
    for k in range(count):
        dx, dy, dz = lists[depth, 0, k] - x, lists[depth, 1, k] - y, lists[depth, 2, k] - z
        ax, ay, az = lists[depth, 3, k], lists[depth, 4, k], lists[depth, 5, k]
        bx, by, bz = lists[depth, 6, k], lists[depth, 7, k], lists[depth, 8, k]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        u, v = dx * ax + dy * ay + dz * az, dx * bx + dy * by + dz * bz
        w = dx * nx + dy * ny + dz * nz
        half = lists[depth, 9, k], lists[depth, 10, k], lists[depth, 11, k]
        ax, bx, nx = hx * ax, hx * bx, hx * nx
        ay, by, ny = hy * ay, hy * by, hy * ny
        az, bz, nz = hz * az, hz * bz, hz * nz
        # One after the other, for a loop over corners is taken for the one to make vectors of.
        least = _away2(u + ax + ay + az, v + bx + by + bz, w + nx + ny + nz, half) - upper_0
        one = _away2(u - ax + ay + az, v - bx + by + bz, w - nx + ny + nz, half) - upper_1
        least = min(least, one)
        one = _away2(u + ax - ay + az, v + bx - by + bz, w + nx - ny + nz, half) - upper_2
        least = min(least, one)
        one = _away2(u - ax - ay + az, v - bx - by + bz, w - nx - ny + nz, half) - upper_3
        least = min(least, one)
        one = _away2(u + ax + ay - az, v + bx + by - bz, w + nx + ny - nz, half) - upper_4
        least = min(least, one)
        one = _away2(u - ax + ay - az, v - bx + by - bz, w - nx + ny - nz, half) - upper_5
        least = min(least, one)
        one = _away2(u + ax - ay - az, v + bx - by - bz, w + nx - ny - nz, half) - upper_6
        least = min(least, one)
        one = _away2(u - ax - ay - az, v - bx - by - bz, w - nx - ny - nz, half) - upper_7
        bound[k] = min(least, one)


@njit(**UNCOUNTED, forceinline=True, fastmath=FAST)
def _least_bounds(lists, depth, count, middle, half, point, bound):  # type: ignore[no-untyped-def]
    """For each box: no more than `_bounds` tells where its bounds are the ways to ``point``."""
    zero, two = np.float32(0), np.float32(2)
    x, y, z = np.float32(middle[0]), np.float32(middle[1]), np.float32(middle[2])
    hx, hy, hz = np.float32(half[0]), np.float32(half[1]), np.float32(half[2])
    qx, qy, qz = np.float32(point[0]), np.float32(point[1]), np.float32(point[2])
    away2 = (x - qx) * (x - qx) + (y - qy) * (y - qy) + (z - qz) * (z - qz)
    for k in range(count):
        px, py, pz = lists[depth, 0, k], lists[depth, 1, k], lists[depth, 2, k]
        dx, dy, dz = px - x, py - y, pz - z
        ax, ay, az = lists[depth, 3, k], lists[depth, 4, k], lists[depth, 5, k]
        bx, by, bz = lists[depth, 6, k], lists[depth, 7, k], lists[depth, 8, k]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        half_u, half_v, half_w = lists[depth, 9, k], lists[depth, 10, k], lists[depth, 11, k]
        du = max(abs(dx * ax + dy * ay + dz * az) - half_u, zero)
        dv = max(abs(dx * bx + dy * by + dz * bz) - half_v, zero)
        dw = max(abs(dx * nx + dy * ny + dz * nz) - half_w, zero)
        reach_x = abs(px - qx) + abs(ax) * half_u + abs(bx) * half_v + abs(nx) * half_w
        reach_y = abs(py - qy) + abs(ay) * half_u + abs(by) * half_v + abs(ny) * half_w
        reach_z = abs(pz - qz) + abs(az) * half_u + abs(bz) * half_v + abs(nz) * half_w
        most = away2 + two * (hx * reach_x + hy * reach_y + hz * reach_z)
        bound[k] = du * du + dv * dv + dw * dw - MORE_SLACK * most


@njit(**UNCOUNTED, forceinline=True)
def _closest_point(triangles, t, point, closest):  # type: ignore[no-untyped-def]
    """The point of triangle t that is closest to another point."""
    x, y, z = point[0] - triangles[t, 0], point[1] - triangles[t, 1], point[2] - triangles[t, 2]
    u = x * triangles[t, 3] + y * triangles[t, 4] + z * triangles[t, 5]
    v = x * triangles[t, 6] + y * triangles[t, 7] + z * triangles[t, 8]
    ab, bx, by, bc = triangles[t, 12], triangles[t, 13], triangles[t, 14], triangles[t, 15]
    cx, cy, ac = triangles[t, 16], triangles[t, 17], triangles[t, 18]
    outside = max(-v, (u - ab) * by - v * bx, v * cx - u * cy)
    if outside > 0:
        s, r = min(max((u - ab) * bx + v * by, 0.0), bc), min(max(u * cx + v * cy, 0.0), ac)
        best_u, best_v = min(max(u, 0.0), ab), 0.0
        best = (u - best_u) ** 2 + v * v
        for other_u, other_v in ((ab + s * bx, s * by), (r * cx, r * cy)):
            other = (u - other_u) ** 2 + (v - other_v) ** 2
            if other < best:
                best, best_u, best_v = other, other_u, other_v
        u, v = best_u, best_v
    for k in range(3):
        closest[k] = triangles[t, k] + u * triangles[t, 3 + k] + v * triangles[t, 6 + k]


@njit(**UNCOUNTED, forceinline=True, fastmath=FAST)
def _measure(triangles, numbers, depth, kept, count, nodes, best):  # type: ignore[no-untyped-def]
    """Squared distance from nodes to some triangles of a list, where it is less than ``best``.

    In the triangle's plane: zero inside all three edges, else that to the nearest edge; then
    across the plane. All nodes take the same steps, so that they share vector instructions.
    """
    for k in range(count):
        t = numbers[depth, kept[k]]
        x0, y0, z0 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = triangles[t, 3], triangles[t, 4], triangles[t, 5]
        bx, by, bz = triangles[t, 6], triangles[t, 7], triangles[t, 8]
        nx, ny, nz = triangles[t, 9], triangles[t, 10], triangles[t, 11]
        ab, bcu, bcv, bc = triangles[t, 12], triangles[t, 13], triangles[t, 14], triangles[t, 15]
        acu, acv, ac = triangles[t, 16], triangles[t, 17], triangles[t, 18]
        for i in range(len(best)):
            x, y, z = nodes[0, i] - x0, nodes[1, i] - y0, nodes[2, i] - z0
            u = x * ax + y * ay + z * az
            v = x * bx + y * by + z * bz
            w = x * nx + y * ny + z * nz
            past = u - min(max(u, 0.0), ab)
            plane2 = past * past + v * v
            from_b = u - ab
            along, beyond_bc = from_b * bcu + v * bcv, from_b * bcv - v * bcu
            past = along - min(max(along, 0.0), bc)
            plane2 = min(plane2, past * past + beyond_bc * beyond_bc)
            along, beyond_ac = u * acu + v * acv, v * acu - u * acv
            past = along - min(max(along, 0.0), ac)
            plane2 = min(plane2, past * past + beyond_ac * beyond_ac)
            outside = max(max(beyond_bc, beyond_ac), -v)
            plane2 = plane2 if outside > 0.0 else 0.0
            # Zero alters nothing, but what stays as it was is then written as well: a write that
            # leaves out lanes is slow on some processors.
            best[i] = max(min(best[i], plane2 + w * w), 0.0)


@njit(**UNCOUNTED, forceinline=True)
def _sift(work, depth):  # type: ignore[no-untyped-def]
    """List the boxes of a list that may come nearer to a corner than the point; how many."""
    lists, bound, kept, count = work.lists, work.bound, work.kept, work.counts[depth]
    vectors = -count // LANES * -LANES
    _least_bounds(lists, depth, vectors, work.middle, work.half, work.point, bound)
    sifted = 0
    for k in range(count):
        kept[sifted] = k
        sifted += bound[k] <= 0
    for row in range(lists.shape[1]):
        for k in range(sifted):
            lists[SIFTED, row, k] = lists[depth, row, kept[k]]
    return sifted


@njit(**UNCOUNTED, forceinline=True)
def _select(work, depth):  # type: ignore[no-untyped-def]
    """Find the boxes of a list that come nearer to a corner than the bound there, which is no
    farther than the point; how many."""
    count = work.counts[depth]
    sifted = _sift(work, depth)
    vectors = -sifted // LANES * -LANES
    _bounds(work.lists, SIFTED, vectors, work.middle, work.half, work.upper, work.bound)
    used = 0
    for k in range(sifted):
        work.kept[used] = work.kept[k]
        used += work.bound[k] <= 0
    if used == 0:
        # The box that gave the bound is always kept; should it not be, keeping all is right too.
        for k in range(count):
            work.kept[k] = k
        used = count
    return used


@njit(**UNCOUNTED, forceinline=True)
def _narrow(tree, work, depth):  # type: ignore[no-untyped-def]
    """Find the boxes of a list that can hold the nearest to the block's nodes; how many."""
    number = work.numbers[depth, _closest_middle(work, depth)]
    # Any point of the surface will do; one of the first triangle in this box is near.
    triangle = number * tree.boxes.shape[2] ** work.held[depth]
    _closest_point(tree.triangles, triangle, work.middle, work.point)
    for corner in range(CORNERS):
        away2 = 0.0
        for k in range(3):
            side = work.half[k] if corner >> k & 1 else -work.half[k]
            away2 += (work.middle[k] + side - work.point[k]) ** 2
        work.upper[corner] = SLACK * np.float32(away2)
    return _select(work, depth)


@njit(**UNCOUNTED, forceinline=True)
def _open(tree, work, source, target, count):  # type: ignore[no-untyped-def]
    """Fill a list with what the kept boxes of another, or of the same, hold."""
    boxes, kept = tree.boxes, work.kept
    start = tree.starts[work.held[source] - 1]
    lists, numbers = work.lists[target], work.numbers[target]
    for k in range(count):
        kept[k] = work.numbers[source, kept[k]]
    for k in range(count):
        group, first = start + kept[k], k * FAN
        for row in range(BOX_ROWS):
            # All eight are read before one is written, so that they travel as a vector.
            a, b = boxes[group, row, 0], boxes[group, row, 1]
            c, d = boxes[group, row, 2], boxes[group, row, 3]
            e, f = boxes[group, row, 4], boxes[group, row, 5]
            g, h = boxes[group, row, 6], boxes[group, row, 7]
            lists[row, first], lists[row, first + 1] = a, b
            lists[row, first + 2], lists[row, first + 3] = c, d
            lists[row, first + 4], lists[row, first + 5] = e, f
            lists[row, first + 6], lists[row, first + 7] = g, h
        for lane in range(FAN):
            numbers[first + lane] = kept[k] * FAN + lane
    work.counts[target] = FAN * count
    work.held[target] = work.held[source] - 1


@njit(**UNCOUNTED, forceinline=True)
def _copy(work, source, target, count):  # type: ignore[no-untyped-def]
    """Fill a list with the kept boxes of another, or drop the rest of the same."""
    for row in range(work.lists.shape[1]):
        for k in range(count):
            work.lists[target, row, k] = work.lists[source, row, work.kept[k]]
    for k in range(count):
        work.numbers[target, k] = work.numbers[source, work.kept[k]]
    work.counts[target] = count
    work.held[target] = work.held[source]


@njit(**UNCOUNTED, forceinline=True)
def _enter(tree, work, depth, level):  # type: ignore[no-untyped-def]
    """Make a block's list, at ``depth + 1``, from that of the block around it."""
    source, target = depth, depth + 1
    while True:
        count = _narrow(tree, work, source)
        if work.held[source] <= level:
            break
        _open(tree, work, source, target, count)
        source = target
    _copy(work, source, target, count)


@njit(**UNCOUNTED, forceinline=True)
def _open_all(tree, work, depth):  # type: ignore[no-untyped-def]
    """Open a list's boxes that can hold the nearest, down to triangles; where that list is."""
    source = depth
    while work.held[source] > 0:
        _open(tree, work, source, depth + 1, _narrow(tree, work, source))
        source = depth + 1
    return source


@njit(**UNCOUNTED, forceinline=True)
def _list_all(tree, work):  # type: ignore[no-untyped-def]
    """Make the list at depth 0: all boxes of the last level."""
    first = NOUGHT
    last = len(tree.starts) - 2
    groups = tree.starts[last + 1] - tree.starts[last]
    # As if they were held by boxes of one level more.
    for group in range(groups):
        work.kept[group] = work.numbers[first, group] = group
    work.held[first] = last + 1
    _open(tree, work, first, first, groups)


@njit(**UNCOUNTED, forceinline=True)
def _place(tree, work, axes, corner, size):  # type: ignore[no-untyped-def]
    """Go to the block of ``size`` nodes a side whose first node is ``corner`` (z, y, x)."""
    for k in range(3):
        axis = axes[k]
        step = axis[1] - axis[0]
        work.half[k] = 0.5 * (size - 1) * step
        work.middle[k] = axis[0] + corner[2 - k] * step + work.half[k] - tree.centre_mm[k]


@njit(**UNCOUNTED, forceinline=True)
def _fill_cube(tree, work, axes, depth, corner, out):  # type: ignore[no-untyped-def]
    """Distances of a cube of 2 x 2 x 2 nodes, each of which is a corner."""
    for lane in range(CORNERS):
        for k in range(3):
            place, axis = corner[2 - k] + (lane >> k & 1), axes[k]
            # A cube may reach one node beyond the grid.
            at = axis[place] if place < len(axis) else 2 * axis[-1] - axis[-2]
            work.nodes[k, lane] = at - tree.centre_mm[k]
    work.best[:] = np.inf
    closest = work.kept[0] = _closest_middle(work, depth)
    _closest_point(tree.triangles, work.numbers[depth, closest], work.middle, work.point)
    _measure(tree.triangles, work.numbers, depth, work.kept, NOUGHT + 1, work.nodes, work.best)
    for lane in range(CORNERS):
        work.upper[lane] = SLACK * np.float32(work.best[lane])
    count = _select(work, depth)
    _measure(tree.triangles, work.numbers, depth, work.kept, count, work.nodes, work.best)
    for lane in range(CORNERS):
        work.best[lane] = np.sqrt(work.best[lane])
    z, y, x = corner
    for k in range(z, min(z + LEAST, out.shape[0])):
        for j in range(y, min(y + LEAST, out.shape[1])):
            for i in range(x, min(x + LEAST, out.shape[2])):
                out[k, j, i] = work.best[4 * (k - z) + 2 * (j - y) + i - x]


@njit(**UNCOUNTED)
def block_distance(tree, work, levels, axes, z, y, x, out):  # type: ignore[no-untyped-def]
    """Unsigned distance, mm, of a block of 32 nodes a side, or what of it is in the grid.

    ``axes`` are the coordinates of the nodes along x, y and z; (z, y, x) is the block's first
    node; ``out`` is the grid's array ``(z, y, x)``. Blocks are halved and their parts visited
    in depth, so that one list a depth is in use.
    """
    _list_all(tree, work)
    first, visited, depth = work.first, work.visited, NOUGHT
    first[depth, 0], first[depth, 1], first[depth, 2] = z, y, x
    # The block is the first part, and the only one, of what is around it.
    visited[depth] = 0
    while True:
        part = visited[depth]
        if part == CORNERS:
            depth -= 1
            continue
        if depth == 0 and part > 0:
            break
        visited[depth] += 1
        size = TOP >> depth
        z = first[depth, 0] + size * (part >> 2)
        y = first[depth, 1] + size * (part >> 1 & 1)
        x = first[depth, 2] + size * (part & 1)
        if z >= out.shape[0] or y >= out.shape[1] or x >= out.shape[2]:
            continue
        _place(tree, work, axes, (z, y, x), size)
        if size == LEAST:
            _fill_cube(tree, work, axes, _open_all(tree, work, depth), (z, y, x), out)
            continue
        _enter(tree, work, depth, levels[depth])
        depth += 1
        visited[depth] = 0
        first[depth, 0], first[depth, 1], first[depth, 2] = z, y, x
