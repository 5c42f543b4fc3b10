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

DIVISIONS = 8
"""A stretch of a tool is divided into thirds no more often than this."""
LONGEST_SPACINGS = 3.0
"""Spacings of the grid from end to end of a stretch that is believed, so one from place to place:
the spline's curvature changes from node to node, and longer stretches could step over that."""
UNSEEN = 1.0 / 3.0
"""Share of the bound that a turn of the force between two places may be worth to a stretch."""
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
def _change2(left, here, right):  # type: ignore[no-untyped-def]
    """Square of what a stretch's force changes by where its thirds are asked in its place."""
    total = 0.0
    for axis in range(3, 6):
        change = 0.375 * (left[axis] + right[axis]) - 0.75 * here[axis]
        total += change * change
    return total


@_inner
def _apart2(one, other):  # type: ignore[no-untyped-def]
    """Square of how far two felt forces are apart."""
    x, y, z = one[3] - other[3], one[4] - other[4], one[5] - other[5]
    return x * x + y * y + z * z


@_inner
def _copy(source, target):  # type: ignore[no-untyped-def]
    """Whole rows at once would take a second longer to compile."""
    for n in range(7):
        target[n] = source[n]


@_inner
def _one_line(law, line_mm, handle_mm, pose, phase, bound_n, room, found):  # type: ignore[no-untyped-def]
    """``tool_force`` on one line; its length, and how often the field was asked, -1: too long."""
    grid, side, delta_mm, m, f_max_n = law[2], law[3], law[4], law[5], law[6]
    stack, places, walk = room[:, :7], room[:, 7:11], room[-1]
    # What was felt at a stretch's outer thirds, before it, and after all stretches on the stack.
    left, right, last, ahead = room[-2], room[-3], room[-4], room[-5]
    walk[0], walk[1], walk[2] = 0.0, 0.0, 0.0
    total = _length(line_mm)
    if total > LONGEST * _diagonal(grid):
        return total, -1
    if len(line_mm) > 1:
        walk[2] = _piece_length(line_mm, 0)
    _feel(law, line_mm, pose, phase, 0.0, walk, last)
    if total == 0.0:
        _add(found, last, 1.0, pose, handle_mm)
        return total, 1
    longest = LONGEST_SPACINGS * min(grid[3], grid[4], grid[5])
    # A turn of the force that is unseen is worth a sixth of a stretch: it lies beyond one place.
    seen2 = (6.0 * UNSEEN * bound_n) ** 2
    count = max(math.ceil(total / (3.0 * longest)), 1)
    asked = count + 2
    _feel(law, line_mm, pose, phase, 0.5 * total / count, walk, ahead)
    for number in range(count):
        places[0, 0], places[0, 1], places[0, 2], places[0, 3] = (
            (number + 0.5) * total / count, total / count, 1.0 / count, 0.0,
        )  # fmt: skip
        _copy(ahead, stack[0])
        _feel(law, line_mm, pose, phase, min((number + 1.5) * total / count, total), walk, ahead)
        top = 0
        while top >= 0:
            middle, length, share = places[top, 0], places[top, 1], places[top, 2]
            depth, here = places[top, 3], stack[top]
            way = 0.5 * length
            farthest = abs(here[6]) + way if side == 0 else here[6] + side * way
            if 2.0 * f_max_n * abs(_pull(farthest, side, delta_mm, m)) <= bound_n:
                _add(found, here, share, pose, handle_mm)
                _copy(here, last)
                top -= 1
                continue
            _feel(law, line_mm, pose, phase, middle - length / 3.0, walk, left)
            _feel(law, line_mm, pose, phase, middle + length / 3.0, walk, right)
            asked += 2
            following = stack[top - 1] if top > 0 else ahead
            within2 = max(_apart2(left, here), _apart2(here, right))
            beside2 = max(_apart2(last, left), _apart2(right, following))
            small = _change2(left, here, right) <= bound_n * bound_n
            small &= share * share * max(within2, beside2) <= seen2
            if depth == DIVISIONS or (length <= longest and small):
                _add(found, left, share * 0.375, pose, handle_mm)
                _add(found, here, share * 0.25, pose, handle_mm)
                _add(found, right, share * 0.375, pose, handle_mm)
                _copy(right, last)
                top -= 1
                continue
            _divide(stack, places, top, left, right)
            top += 2
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
def _divide(stack, places, top, left, right):  # type: ignore[no-untyped-def]
    """Put the three thirds of the topmost stretch in its place, the left one on top."""
    _copy(left, stack[top + 2])
    _copy(stack[top], stack[top + 1])
    _copy(right, stack[top])
    middle, third, share = places[top, 0], places[top, 1] / 3.0, places[top, 2] / 3.0
    depth = places[top, 3] + 1
    for n in range(3):
        places[top + n, 0], places[top + n, 1] = middle + (1 - n) * third, third
        places[top + n, 2], places[top + n, 3] = share, depth


@_asked
def tool_force(law, points_mm, starts, handle_mm, pose, phase, bound_n, found):  # type: ignore[no-untyped-def]
    """Force and torque on lines of straight pieces: the mean over their length, within a bound.

    The same steps as ``bf_tool_force`` of the C header. A stretch is asked in its middle and in
    those of its outer thirds, and divided into thirds, which are asked already, until MacLaurin's
    rule (weights 3/8, 1/4, 3/8) changes the middle's answer by less than the bound, and until a
    turn of the force between any two places, those of the stretches beside it as well, would be
    worth less than a third of it. Stretches that the distance, which changes by no more than the
    way, shows to feel less than the bound are not asked again.

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
    room, part = np.empty((2 * DIVISIONS + 6, 11)), np.empty(6)
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
