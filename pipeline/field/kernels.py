"""Compiled kernels: the spline through the baked distance, its gradient, potential and force.

Importing this module imports numba; only functions that need it do so. The kernels release the
interpreter lock, so callers split work over threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic, register_jitable

from pipeline.field import potential as formulas

# The compiled code calls the very functions that NumPy users call.
for _formula in (formulas.offence, formulas.potential, formulas.pull, formulas.direction_scale):
    register_jitable(_formula)
_pull = formulas.pull
_direction_scale = formulas.direction_scale


CONTRACT = {"contract"}
"""A product and a sum may be rounded once instead of twice; nothing else is relaxed."""


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def _value(typing_context: Any, address: Any, index: Any) -> Any:
    """The float32 number ``index`` after an address, as float64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        single = context.get_value_type(types.float32)
        start = builder.inttoptr(arguments[0], single.as_pointer())
        value = builder.load(builder.gep(start, [arguments[1]]))
        return builder.fpext(value, context.get_value_type(types.float64))

    return types.float64(types.uintp, types.intp), generate


@njit(nogil=True, cache=True, fastmath=CONTRACT, inline="always")
def _three(place, count):  # type: ignore[no-untyped-def]
    """Three neighbours of a place on one axis, their weights, and their slopes per step.

    Beyond the grid's end the coefficients go on in a straight line; the ghost is folded into
    the weights of the two last, so every index stays inside the grid.
    """
    place = min(max(place, 0.0), count - 1.0)
    middle = int(place + 0.5)
    t = place - middle
    w0, w1, w2 = 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)
    s0, s1, s2 = t - 0.5, -2.0 * t, t + 0.5
    i0, i2 = middle - 1, middle + 1
    if i0 < 0:
        w1, w2, w0, s1, s2, s0 = w1 + 2 * w0, w2 - w0, 0.0, s1 + 2 * s0, s2 - s0, 0.0
        i0 = 0
    if i2 >= count:
        w1, w0, w2, s1, s0, s2 = w1 + 2 * w2, w0 - w2, 0.0, s1 + 2 * s2, s0 - s2, 0.0
        i2 = middle
    return i0, middle, i2, w0, w1, w2, s0, s1, s2


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def _moment(line, phase):  # type: ignore[no-untyped-def]
    """Interval of a phase in ``spline.timeline``, and the weights of its three phases."""
    first = line[0, 0]
    turned = phase - math.floor(phase - first)
    if turned >= first + 1.0:
        turned -= 1.0
    low, high = 0, len(line)
    while high - low > 1:
        middle = (low + high) // 2
        if line[middle, 0] <= turned:
            low = middle
        else:
            high = middle
    late, early = turned - line[low, 0], line[low, 1] - turned
    before, after = early * early * line[low, 2], late * late * line[low, 3]
    return low, before, 1.0 - before - after, after


@njit(nogil=True, cache=True, fastmath=CONTRACT, inline="always")
def _row(p0, p1, p2, t0, t1, t2, start, i0, i1, i2, w0, w1, w2, s0, s1, s2):  # type: ignore[no-untyped-def]
    """One row of nodes along x at one moment: its value, and its slope along x."""
    a = t0 * _value(p0, start + i0) + t1 * _value(p1, start + i0) + t2 * _value(p2, start + i0)
    b = t0 * _value(p0, start + i1) + t1 * _value(p1, start + i1) + t2 * _value(p2, start + i1)
    c = t0 * _value(p0, start + i2) + t1 * _value(p1, start + i2) + t2 * _value(p2, start + i2)
    return w0 * a + w1 * b + w2 * c, s0 * a + s1 * b + s2 * c


@njit(nogil=True, cache=True, fastmath=CONTRACT, inline="always")
def _plane(p0, p1, p2, t0, t1, t2, start, width, xs, ys):  # type: ignore[no-untyped-def]
    """One plane of nine nodes: value, and slopes along x and y."""
    i0, i1, i2, w0, w1, w2, s0, s1, s2 = xs
    j0, j1, j2, u0, u1, u2, r0, r1, r2 = ys
    a, ax = _row(p0, p1, p2, t0, t1, t2, start + j0 * width, i0, i1, i2, w0, w1, w2, s0, s1, s2)
    b, bx = _row(p0, p1, p2, t0, t1, t2, start + j1 * width, i0, i1, i2, w0, w1, w2, s0, s1, s2)
    c, cx = _row(p0, p1, p2, t0, t1, t2, start + j2 * width, i0, i1, i2, w0, w1, w2, s0, s1, s2)
    return (
        u0 * a + u1 * b + u2 * c,
        u0 * ax + u1 * bx + u2 * cx,
        r0 * a + r1 * b + r2 * c,
    )


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def _at(addresses, line, grid, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Distance and gradient at one point; see ``sample``."""
    count_x, count_y, count_z = int(grid[6]), int(grid[7]), int(grid[8])
    k, t0, t1, t2 = _moment(line, phase)
    phases = len(addresses)
    p0 = addresses[k - 1 if k > 0 else phases - 1]
    p1 = addresses[k]
    p2 = addresses[k + 1 if k + 1 < phases else 0]
    xs = _three((x_mm - grid[0]) / grid[3], count_x)
    ys = _three((y_mm - grid[1]) / grid[4], count_y)
    k0, k1, k2, v0, v1, v2, q0, q1, q2 = _three((z_mm - grid[2]) / grid[5], count_z)
    layer = count_x * count_y
    a, ax, ay = _plane(p0, p1, p2, t0, t1, t2, k0 * layer, count_x, xs, ys)
    b, bx, by = _plane(p0, p1, p2, t0, t1, t2, k1 * layer, count_x, xs, ys)
    c, cx, cy = _plane(p0, p1, p2, t0, t1, t2, k2 * layer, count_x, xs, ys)
    return (
        v0 * a + v1 * b + v2 * c,
        (v0 * ax + v1 * bx + v2 * cx) / grid[3],
        (v0 * ay + v1 * by + v2 * cy) / grid[4],
        (q0 * a + q1 * b + q2 * c) / grid[5],
    )


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def distance_at(addresses, line, grid, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Distance and gradient at one point: four numbers, none where the question has none.

    The arguments are those of ``sample``.
    """
    if not math.isfinite(x_mm + y_mm + z_mm + phase):
        return math.nan, math.nan, math.nan, math.nan
    return _at(addresses, line, grid, x_mm, y_mm, z_mm, phase)


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def _force(addresses, line, grid, side, delta_mm, m, f_max_n, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    distance_mm, gx, gy, gz = _at(addresses, line, grid, x_mm, y_mm, z_mm, phase)
    size = _pull(distance_mm, side, delta_mm, m)
    scale = -f_max_n * size * _direction_scale(math.sqrt(gx * gx + gy * gy + gz * gz))
    return scale * gx, scale * gy, scale * gz


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def force_at(addresses, line, grid, side, delta_mm, m, f_max_n, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Force at one point: three newtons, none where the question has a number that is none."""
    if not math.isfinite(x_mm + y_mm + z_mm + phase):
        return math.nan, math.nan, math.nan
    return _force(addresses, line, grid, side, delta_mm, m, f_max_n, x_mm, y_mm, z_mm, phase)


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def sample(addresses, line, grid, points_mm, phases, distance_mm, gradient):  # type: ignore[no-untyped-def]
    """Distance and its gradient at points.

    Parameters
    ----------
    addresses
        ``(phase,)`` where in memory the float32 ``(z, y, x)`` coefficients of each phase are.
    line
        ``spline.timeline`` of the phases.
    grid
        Origin, spacing and node counts, each ``x, y, z``: nine numbers.
    points_mm
        ``(n, 3)``; those outside the grid are moved to its boundary.
    phases
        ``(n,)``, or ``(1,)`` for all.
    distance_mm, gradient
        Where the ``(n,)`` distances and ``(n, 3)`` gradients go.
    """
    for n in range(len(points_mm)):
        phase = phases[n if len(phases) > 1 else 0]
        value, gx, gy, gz = _at(
            addresses, line, grid, points_mm[n, 0], points_mm[n, 1], points_mm[n, 2], phase
        )
        distance_mm[n] = value
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = gx, gy, gz


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def sample_force(addresses, line, grid, side, delta_mm, m, f_max_n, points_mm, phases, force_n):  # type: ignore[no-untyped-def]
    """Force at points into ``(n, 3)``; the arguments are those of ``sample`` and ``force_at``."""
    for n in range(len(points_mm)):
        phase = phases[n if len(phases) > 1 else 0]
        fx, fy, fz = _force(
            addresses, line, grid, side, delta_mm, m, f_max_n,
            points_mm[n, 0], points_mm[n, 1], points_mm[n, 2], phase,
        )  # fmt: skip
        force_n[n, 0], force_n[n, 1], force_n[n, 2] = fx, fy, fz


HALVINGS = 12
"""A stretch of a tool is halved no more often than this."""


@njit(nogil=True, cache=True, fastmath=CONTRACT)
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


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def _piece_length(line_mm, piece):  # type: ignore[no-untyped-def]
    x = line_mm[piece + 1, 0] - line_mm[piece, 0]
    y = line_mm[piece + 1, 1] - line_mm[piece, 1]
    z = line_mm[piece + 1, 2] - line_mm[piece, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def _feel(law, line_mm, pose, phase, along, walk, feel):  # type: ignore[no-untyped-def]
    """Ask at a length along a tool: its point, the force and the distance into ``feel``."""
    addresses, line, grid, side, delta_mm, m, f_max_n = law
    _on_tool(line_mm, along, walk, feel)
    x = pose[0, 0] * feel[0] + pose[0, 1] * feel[1] + pose[0, 2] * feel[2] + pose[0, 3]
    y = pose[1, 0] * feel[0] + pose[1, 1] * feel[1] + pose[1, 2] * feel[2] + pose[1, 3]
    z = pose[2, 0] * feel[0] + pose[2, 1] * feel[1] + pose[2, 2] * feel[2] + pose[2, 3]
    distance_mm, gx, gy, gz = _at(addresses, line, grid, x, y, z, phase)
    size = _pull(distance_mm, side, delta_mm, m)
    scale = -f_max_n * size * _direction_scale(math.sqrt(gx * gx + gy * gy + gz * gz))
    feel[3], feel[4], feel[5], feel[6] = scale * gx, scale * gy, scale * gz, distance_mm


@njit(nogil=True, cache=True, fastmath=CONTRACT)
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


@njit(nogil=True, cache=True, fastmath=CONTRACT)
def tool_force(law, line_mm, handle_mm, pose, phase, bound_n, found):  # type: ignore[no-untyped-def]
    """Force and torque on a line of straight pieces: the mean over its length, within a bound.

    The same steps as ``bf_tool_force`` of the C header: stretches are halved until Simpson's rule
    changes the midpoint's by less than the bound, unless the distance, which changes by no more
    than the way, shows that the whole stretch feels less than the bound.

    Parameters
    ----------
    law
        The first seven arguments of ``force_at``.
    line_mm
        ``(n, 3)`` points of the tool in its own frame; a closed line repeats its first.
    handle_mm
        ``(3,)`` in the tool's frame: torque is about it.
    pose
        4x4 ``mr_from_tool``.
    phase, bound_n
        Moment, and largest error of the force.
    found
        Where force (N) and torque (N mm) go: six numbers, 0 before.

    Returns
    -------
    How often the field was asked.
    """
    grid, side, delta_mm, m, f_max_n = law[2], law[3], law[4], law[5], law[6]
    walk = np.zeros(3)
    total = 0.0
    for piece in range(len(line_mm) - 1):
        total += _piece_length(line_mm, piece)
    if len(line_mm) > 1:
        walk[2] = _piece_length(line_mm, 0)
    longest = 2.0 * min(grid[3], grid[4], grid[5])
    count = max(math.ceil(total / (4.0 * longest)), 1)
    stack, places = np.empty((HALVINGS + 2, 7)), np.empty((HALVINGS + 2, 4))
    left, right = np.empty(7), np.empty(7)
    asked = 0
    for number in range(count):
        middle = (number + 0.5) * total / count
        _feel(law, line_mm, pose, phase, middle, walk, stack[0])
        asked += 1
        if total == 0.0:
            _add(found, stack[0], 1.0, pose, handle_mm)
            continue
        places[0, 0], places[0, 1], places[0, 2], places[0, 3] = (
            middle, total / count, 1.0 / count, 0.0,
        )  # fmt: skip
        top = 0
        while top >= 0:
            middle, length, share, depth = places[top]
            here = stack[top]
            way = 0.5 * length
            farthest = abs(here[6]) + way if side == 0 else here[6] + side * way
            if 2.0 * f_max_n * abs(_pull(farthest, side, delta_mm, m)) <= bound_n:
                _add(found, here, share, pose, handle_mm)
                top -= 1
                continue
            _feel(law, line_mm, pose, phase, middle - way / 2, walk, left)
            _feel(law, line_mm, pose, phase, middle + way / 2, walk, right)
            asked += 2
            off = 0.0
            for axis in range(3, 6):
                change = 0.5 * (left[axis] + right[axis]) - here[axis]
                off += change * change
            if (length <= longest and off <= bound_n * bound_n) or depth == HALVINGS:
                _add(found, left, share * 2 / 3, pose, handle_mm)
                _add(found, right, share * 2 / 3, pose, handle_mm)
                _add(found, here, -share / 3, pose, handle_mm)
                top -= 1
                continue
            stack[top], stack[top + 1] = right, left
            places[top, 0], places[top, 1] = middle + way / 2, way
            places[top, 2], places[top, 3] = share / 2, depth + 1
            places[top + 1, 0], places[top + 1, 1] = middle - way / 2, way
            places[top + 1, 2], places[top + 1, 3] = share / 2, depth + 1
            top += 1
    return asked
