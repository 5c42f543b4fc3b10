"""Compiled kernels of tools that are not points: force and torque within a bound.

Importing this module imports numba; only functions that need it do so.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.field import kernels
from pipeline.field import potential as formulas

_felt_at = kernels.felt_at
_pull = formulas.pull
_asked, _inner = kernels.asked, kernels.inner

HALVINGS = 12
"""A stretch of a tool is halved no more often than this."""
LARGE, FINER, STRICTER = 0.2, 0.125, 1.0 / 3.0
"""A stretch that is more than this share of its tool has few beside it to make up for its error: it
is so much shorter, and may change by so much less, before it is believed."""
LONGEST = 20.0
"""Times the grid's diagonal: a tool's line that is longer is in another unit."""


@_inner
def _on_tool(line_mm, along, walk, feel):  # type: ignore[no-untyped-def]
    """Point of a tool at a length along it, into ``feel[:3]``.

    ``walk`` holds the piece that was asked for last, its start and length: places asked for one
    after the other are near each other. A closed line repeats its first point.
    """
    pieces = len(line_mm) - 1
    piece, start, length = int(walk[0]), walk[1], walk[2]
    while along > start + length and piece + 1 < pieces:
        start += length
        piece += 1
        length = _piece_length(line_mm, piece)
    while along < start and piece > 0:
        piece -= 1
        length = _piece_length(line_mm, piece)
        start -= length
    walk[0], walk[1], walk[2] = piece, start, length
    share = (along - start) / length if length > 0 else 0.0
    end = piece + 1 if pieces > 0 else piece
    for axis in range(3):
        feel[axis] = line_mm[piece, axis] + share * (line_mm[end, axis] - line_mm[piece, axis])


@_inner
def _piece_length(line_mm, piece):  # type: ignore[no-untyped-def]
    x = line_mm[piece + 1, 0] - line_mm[piece, 0]
    y = line_mm[piece + 1, 1] - line_mm[piece, 1]
    z = line_mm[piece + 1, 2] - line_mm[piece, 2]
    return math.sqrt(x * x + y * y + z * z)


@_inner
def _feel(law, line_mm, pose, phase, along, walk, feel):  # type: ignore[no-untyped-def]
    """Ask at a length along a tool: its point, the force and the distance into ``feel``."""
    _on_tool(line_mm, along, walk, feel)
    x = pose[0, 0] * feel[0] + pose[0, 1] * feel[1] + pose[0, 2] * feel[2] + pose[0, 3]
    y = pose[1, 0] * feel[0] + pose[1, 1] * feel[1] + pose[1, 2] * feel[2] + pose[1, 3]
    z = pose[2, 0] * feel[0] + pose[2, 1] * feel[1] + pose[2, 2] * feel[2] + pose[2, 3]
    feel[3], feel[4], feel[5], feel[6] = _felt_at(law, x, y, z, phase)


@_inner
def _add(found, feel, weight, pose, handle_mm):  # type: ignore[no-untyped-def]
    """Add a share of a felt force, and of its torque about the handle."""
    ax, ay, az = feel[0] - handle_mm[0], feel[1] - handle_mm[1], feel[2] - handle_mm[2]
    x = pose[0, 0] * ax + pose[0, 1] * ay + pose[0, 2] * az
    y = pose[1, 0] * ax + pose[1, 1] * ay + pose[1, 2] * az
    z = pose[2, 0] * ax + pose[2, 1] * ay + pose[2, 2] * az
    for axis in range(3):
        found[axis] += weight * feel[3 + axis]
    found[3] += weight * (y * feel[5] - z * feel[4])
    found[4] += weight * (z * feel[3] - x * feel[5])
    found[5] += weight * (x * feel[4] - y * feel[3])


@_inner
def _is_rigid(pose):  # type: ignore[no-untyped-def]
    """Whether a 4x4 is a rotation and a shift, within 1e-3: the quick form of a slow check."""
    off = abs(pose[3, 0]) + abs(pose[3, 1]) + abs(pose[3, 2]) + abs(pose[3, 3] - 1.0)
    if not off <= 1e-6 or not math.isfinite(pose[0, 3] + pose[1, 3] + pose[2, 3]):
        return False
    for a in range(3):
        for b in range(3):
            dot = pose[a, 0] * pose[b, 0] + pose[a, 1] * pose[b, 1] + pose[a, 2] * pose[b, 2]
            if not abs(dot - (1.0 if a == b else 0.0)) <= 1e-3:
                return False
    x = pose[1, 1] * pose[2, 2] - pose[1, 2] * pose[2, 1]
    y = pose[1, 2] * pose[2, 0] - pose[1, 0] * pose[2, 2]
    z = pose[1, 0] * pose[2, 1] - pose[1, 1] * pose[2, 0]
    return pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z > 0.0


@_inner
def _change2(here, left, right):  # type: ignore[no-untyped-def]
    """Square of what a stretch's force changes by where its halves are asked in its place."""
    total = 0.0
    for axis in range(3, 6):
        change = 0.5 * (left[axis] + right[axis]) - here[axis]
        total += change * change
    return total


@_inner
def _is_enough(share, length, longest, change2, bound_n):  # type: ignore[no-untyped-def]
    """Whether a stretch is so short, and changes by so little, that it need not be divided."""
    if share > LARGE:
        longest, bound_n = FINER * longest, STRICTER * bound_n
    return length <= longest and change2 <= bound_n * bound_n


@_inner
def _one_line(law, line_mm, handle_mm, pose, phase, bound_n, room, found):  # type: ignore[no-untyped-def]
    """``tool_force`` on one line; its length, and how often the field was asked, -1: too long."""
    grid, side, delta_mm, m, f_max_n = law[2], law[3], law[4], law[5], law[6]
    stack, places, walk = room[:, :7], room[:, 7:11], room[-1]
    left, right = room[-2], room[-3]
    walk[0], walk[1], walk[2] = 0.0, 0.0, 0.0
    total = _length(line_mm)
    if total > LONGEST * _diagonal(grid):
        return total, -1
    if len(line_mm) > 1:
        walk[2] = _piece_length(line_mm, 0)
    longest = 2.0 * min(grid[3], grid[4], grid[5])
    count = max(math.ceil(total / (4.0 * longest)), 1)
    asked = count
    for number in range(count):
        middle = (number + 0.5) * total / count
        _feel(law, line_mm, pose, phase, middle, walk, stack[0])
        if total == 0.0:
            _add(found, stack[0], 1.0, pose, handle_mm)
            continue
        places[0, 0], places[0, 1], places[0, 2], places[0, 3] = (
            middle, total / count, 1.0 / count, 0.0,
        )  # fmt: skip
        top = 0
        while top >= 0:
            middle, length, share = places[top, 0], places[top, 1], places[top, 2]
            depth, here = places[top, 3], stack[top]
            way = 0.5 * length
            farthest = abs(here[6]) + way if side == 0 else here[6] + side * way
            if 2.0 * f_max_n * abs(_pull(farthest, side, delta_mm, m)) <= bound_n:
                _add(found, here, share, pose, handle_mm)
                top -= 1
                continue
            _feel(law, line_mm, pose, phase, middle - way / 2, walk, left)
            _feel(law, line_mm, pose, phase, middle + way / 2, walk, right)
            asked += 2
            change2 = _change2(here, left, right)
            if depth == HALVINGS or _is_enough(share, length, longest, change2, bound_n):
                _add(found, left, share * 2 / 3, pose, handle_mm)
                _add(found, right, share * 2 / 3, pose, handle_mm)
                _add(found, here, -share / 3, pose, handle_mm)
                top -= 1
                continue
            _halve(stack, places, top, left, right)
            top += 1
    return total, asked


@_inner
def _diagonal(grid):  # type: ignore[no-untyped-def]
    """Length of the grid from corner to corner."""
    x, y, z = (grid[6] - 1) * grid[3], (grid[7] - 1) * grid[4], (grid[8] - 1) * grid[5]
    return math.sqrt(x * x + y * y + z * z)


@_inner
def _length(line_mm):  # type: ignore[no-untyped-def]
    """Length of a whole line."""
    total = 0.0
    for piece in range(len(line_mm) - 1):
        total += _piece_length(line_mm, piece)
    return total


@_inner
def _halve(stack, places, top, left, right):  # type: ignore[no-untyped-def]
    """Put the two halves of the topmost segment in its place, the left one on top."""
    # Whole rows at once would take a second longer to compile.
    for n in range(7):
        stack[top, n], stack[top + 1, n] = right[n], left[n]
    middle, way, share = places[top, 0], 0.5 * places[top, 1], 0.5 * places[top, 2]
    depth = places[top, 3] + 1
    places[top, 0], places[top, 1] = middle + way / 2, way
    places[top, 2], places[top, 3] = share, depth
    places[top + 1, 0], places[top + 1, 1] = middle - way / 2, way
    places[top + 1, 2], places[top + 1, 3] = share, depth


@_asked
def tool_force(law, points_mm, starts, handle_mm, pose, phase, bound_n, found):  # type: ignore[no-untyped-def]
    """Force and torque on lines of straight pieces: the mean over their length, within a bound.

    The same steps as ``bf_tool_force`` of the C header: stretches are halved until Simpson's rule
    changes the midpoint's by less than the bound, unless the distance, which changes by no more
    than the way, shows that the whole stretch feels less than the bound.

    Parameters
    ----------
    law
        The first seven arguments of ``force_at``.
    points_mm
        ``(n, 3)`` points of all lines in the tool's own frame; a closed line repeats its first.
    starts
        Number of each line's first point, and n: one more than there are lines. A line of one
        point weighs as much as 1 mm.
    handle_mm
        Three numbers in the tool's frame: torque is about that point.
    pose
        4x4 ``mr_from_tool``.
    phase, bound_n
        Moment, and largest error of the force.
    found
        Where force (N) and torque (N mm) go: six numbers.

    Returns
    -------
    How often the field was asked; -1, and nothing found, where the pose is not rigid, and -2 where
    a line is longer than `LONGEST` diagonals of the grid.
    """
    if not _is_rigid(pose):
        return -1
    # Rows of both stacks, and below them rows for what else a line needs.
    room, part = np.empty((HALVINGS + 5, 11)), np.empty(6)
    found[:] = 0.0
    weight, asked = 0.0, 0
    for n in range(len(starts) - 1):
        part[:] = 0.0
        line_mm = points_mm[starts[n] : starts[n + 1]]
        length, questions = _one_line(law, line_mm, handle_mm, pose, phase, bound_n, room, part)
        if questions < 0:
            return -2
        asked += questions
        length = length if length > 0.0 else 1.0
        weight += length
        for k in range(6):
            found[k] += length * part[k]
    for k in range(6):
        found[k] /= weight
    return asked
