"""Compiled kernels: the spline through the baked distance, its gradient, and the force.

Importing this module imports numba; only functions that need it do so. The kernels release the
interpreter lock, so callers split work over threads.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

from pipeline.compiled import door, fetch, mixed, place_of, spread
from pipeline.field import potential as formulas

# The compiled code calls the very functions that NumPy users call.
for _formula in (formulas.offence, formulas.potential, formulas.pull, formulas.direction_scale):
    register_jitable(_formula)
_pull = formulas.pull
_direction_scale = formulas.direction_scale

AHEAD = 16
"""How many questions ahead of its answer what one asks for is brought into the cache."""

CONTRACT = {"contract"}
"""A product and a sum may be rounded once instead of twice; nothing else is relaxed."""

ASKED: dict[str, Any] = {
    "nogil": True, "cache": True, "fastmath": CONTRACT, "no_cfunc_wrapper": True,
}  # fmt: skip
# No way in from Python, which would be compiled too.
INNER = {**ASKED, "no_cpython_wrapper": True}

_SOURCES = ("potential", "kernels", "batches", "tool_kernels", "../compiled")

asked = door(Path(__file__).parent, _SOURCES, **ASKED)
"""Compiles what Python calls."""

inner = door(Path(__file__).parent, _SOURCES, **INNER)
"""Compiles what only compiled code calls."""

_FOUR_SINGLE = ir.VectorType(ir.FloatType(), 4)
_FOUR = ir.VectorType(ir.DoubleType(), 4)


def _nodes(builder: Any, address: Any, row: Any) -> Any:
    """Four float32 numbers from number ``row`` after an address on, as float64."""
    start = builder.add(address, builder.shl(row, ir.Constant(row.type, 2)))
    singles = builder.load(builder.inttoptr(start, _FOUR_SINGLE.as_pointer()), align=4)
    return builder.fpext(singles, _FOUR)


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def _sum(typing_context: Any, phases: Any, rows: Any, weights: Any) -> Any:
    """Value, and slopes per step of the grid, from nine rows of four nodes at three phases.

    Whole rows are summed as vectors, and along x last: a loop over single nodes takes twice as
    long to answer, and several times as long to compile.

    Parameters
    ----------
    phases
        Three addresses of float32 ``(z, y, x)`` coefficients.
    rows
        Number of the first node of each row, those with the same z together.
    weights
        23 numbers: of three phases, of nodes along x (4), y (3) and z (3), and their slopes.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        p, starts, w = (cgutils.unpack_tuple(builder, argument) for argument in arguments)
        # Products and sums are fused where the processor can.
        sum_of = functools.partial(mixed, builder, flags=tuple(CONTRACT))
        wx, sx = w[3:7], w[13:17]
        time, wy, wz, sy, sz = (
            [spread(builder, one) for one in part]
            for part in (w[:3], w[7:10], w[10:13], w[17:20], w[20:])
        )
        planes, slopes = [], []
        for c in range(0, 9, 3):
            lines = [
                sum_of(time, [_nodes(builder, one, start) for one in p])
                for start in starts[c : c + 3]
            ]
            planes.append(sum_of(wy, lines))
            slopes.append(sum_of(sy, lines))
        value, along_y, along_z = sum_of(wz, planes), sum_of(wz, slopes), sum_of(sz, planes)
        found = [
            sum_of(along, [builder.extract_element(row, place_of(n)) for n in range(4)])
            for along, row in ((wx, value), (sx, value), (wx, along_y), (wx, along_z))
        ]
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.float64, 4)(phases, rows, weights), generate


@inner
def _three(place, count):  # type: ignore[no-untyped-def]
    """Three neighbours of a place on one axis, their weights, and their slopes per step.

    Beyond the grid's end the coefficients go on in a straight line; the ghost is folded into
    the weights of the two last, so every index that has a weight stays inside the grid.
    """
    place = min(max(place, 0.0), count - 1.0)
    middle = int(place + 0.5)
    t = place - middle
    w0, w1, w2 = 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)
    s0, s1, s2 = t - 0.5, -2.0 * t, t + 0.5
    if middle == 0:
        w1, w2, w0, s1, s2, s0 = w1 + 2 * w0, w2 - w0, 0.0, s1 + 2 * s0, s2 - s0, 0.0
    if middle == count - 1:
        w1, w0, w2, s1, s0, s2 = w1 + 2 * w2, w0 - w2, 0.0, s1 + 2 * s2, s0 - s2, 0.0
    return middle, (w0, w1, w2), (s0, s1, s2)


@inner
def _four(weights, left):  # type: ignore[no-untyped-def]
    """Weights of three neighbours as those of four nodes, the first of them at ``left``."""
    w0, w1, w2 = weights
    if left == 0:
        return w0, w1, w2, 0.0
    if left == 1:
        return 0.0, w0, w1, w2
    # At the ends, where one neighbour is a ghost without weight.
    return (w1, w2, 0.0, 0.0) if left < 0 else (0.0, 0.0, w0, w1)


@inner
def moment_of(line, phase):  # type: ignore[no-untyped-def]
    """Interval of a phase in ``spline.timeline``, and the weights of its three phases."""
    first, count = line[0, 0], len(line)
    turned = phase
    if not first <= turned < first + 1.0:
        # Of a float, for no integer holds what a phase may be.
        turned -= np.floor(phase - first)
        if turned >= first + 1.0:
            turned -= 1.0
        elif turned < first:
            turned += 1.0  # So large a phase that first is lost in it.
    # Phases are mostly evenly spaced; where they are not, halving finds the interval.
    low = int((turned - first) * count)
    if low < 0 or low >= count or line[low, 0] > turned or line[low, 1] <= turned:
        low, high = 0, count
        while high - low > 1:
            middle = (low + high) // 2
            if line[middle, 0] <= turned:
                low = middle
            else:
                high = middle
    late, early = turned - line[low, 0], line[low, 1] - turned
    before, after = early * early * line[low, 2], late * late * line[low, 3]
    return low, (before, 1.0 - before - after, after)


@inner
def spline_at(addresses, line, grid, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Distance and gradient at one point whose numbers are finite; see ``sample``."""
    width, height, depth = int(grid[6]), int(grid[7]), int(grid[8])
    k, time = moment_of(line, phase)
    last = len(addresses) - 1
    p0, p2 = addresses[k - 1 if k > 0 else last], addresses[k + 1 if k < last else 0]
    i, wx, sx = _three((x_mm - grid[0]) * grid[9], width)
    j, wy, sy = _three((y_mm - grid[1]) * grid[10], height)
    n, wz, sz = _three((z_mm - grid[2]) * grid[11], depth)
    first = max(min(i - 1, width - 4), 0)
    wx, sx = _four(wx, i - 1 - first), _four(sx, i - 1 - first)
    # Neighbours without weight may lie outside: any node inside does in their place.
    j0, j1, j2 = max(j - 1, 0) * width, j * width, min(j + 1, height - 1) * width
    layer = width * height
    k0, k1, k2 = max(n - 1, 0) * layer, n * layer, min(n + 1, depth - 1) * layer
    k0, k1, k2 = k0 + first, k1 + first, k2 + first
    rows = (k0 + j0, k0 + j1, k0 + j2, k1 + j0, k1 + j1, k1 + j2, k2 + j0, k2 + j1, k2 + j2)
    value, gx, gy, gz = _sum((p0, addresses[k], p2), rows, time + wx + wy + wz + sx + sy + sz)
    return value, gx * grid[9], gy * grid[10], gz * grid[11]


@inner
def _expect(addresses, line, grid, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Bring what a question will ask for into the cache.

    Returns the middle of the cell where all questions ask for the same, and its interval.
    """
    width, layer, last = int(grid[6]), int(grid[6] * grid[7]), len(addresses) - 1
    k, _ = moment_of(line, phase)
    i = int(min(max((x_mm - grid[0]) * grid[9] - 0.5, 0.0), grid[6] - 3.0))
    j = int(min(max((y_mm - grid[1]) * grid[10] - 0.5, 0.0), grid[7] - 3.0))
    n = int(min(max((z_mm - grid[2]) * grid[11] - 0.5, 0.0), grid[8] - 3.0))
    first = layer * n + width * j + i
    for moment in (k - 1 if k > 0 else last, k, k + 1 if k < last else 0):
        for c in range(3):
            for b in range(3):
                fetch(addresses[moment] + np.uintp(4 * (first + layer * c + width * b)))
    x_mm, y_mm = grid[0] + (i + 1) * grid[3], grid[1] + (j + 1) * grid[4]
    return x_mm, y_mm, grid[2] + (n + 1) * grid[5], line[k, 0], line[k, 1]


@asked
def distance_at(addresses, line, grid, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Distance and gradient at one point: four numbers, none where the question has none.

    The arguments are those of ``sample``.
    """
    if not math.isfinite(x_mm + y_mm + z_mm + phase):
        return math.nan, math.nan, math.nan, math.nan
    return spline_at(addresses, line, grid, x_mm, y_mm, z_mm, phase)


@inner
def felt_at(law, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Force and distance at one point whose numbers are finite: four numbers.

    ``law`` is the first seven arguments of ``force_at``.
    """
    addresses, line, grid, side, delta_mm, m, f_max_n = law
    distance_mm, gx, gy, gz = spline_at(addresses, line, grid, x_mm, y_mm, z_mm, phase)
    size = _pull(distance_mm, side, delta_mm, m)
    scale = -f_max_n * size * _direction_scale(math.sqrt(gx * gx + gy * gy + gz * gz))
    return scale * gx, scale * gy, scale * gz, distance_mm


@asked
def force_at(addresses, line, grid, side, delta_mm, m, f_max_n, x_mm, y_mm, z_mm, phase):  # type: ignore[no-untyped-def]
    """Force at one point: three newtons, none where the question has a number that is none."""
    if not math.isfinite(x_mm + y_mm + z_mm + phase):
        return math.nan, math.nan, math.nan
    law = (addresses, line, grid, side, delta_mm, m, f_max_n)
    fx, fy, fz, _ = felt_at(law, x_mm, y_mm, z_mm, phase)
    return fx, fy, fz


@asked
def sample(addresses, line, grid, points_mm, phases, distance_mm, gradient):  # type: ignore[no-untyped-def]
    """Distance and its gradient at points.

    Parameters
    ----------
    addresses
        ``(phase,)`` where in memory the float32 ``(z, y, x)`` coefficients of each phase are;
        where there are fewer than four along x, three numbers more must be readable behind them.
    line
        ``spline.timeline`` of the phases.
    grid
        Origin, spacing, node counts and nodes a millimetre, each ``x, y, z``: twelve numbers.
    points_mm
        ``(n, 3)``; those outside the grid are moved to its boundary.
    phases
        ``(n,)``, or ``(1,)`` for all.
    distance_mm, gradient
        Where the ``(n,)`` distances and ``(n, 3)`` gradients go.
    """
    # The cell that was fetched last, and its interval of phases; none yet.
    cx, cy, cz, since, until = math.inf, 0.0, 0.0, 0.0, 0.0
    hx, hy, hz = 0.5 * grid[3], 0.5 * grid[4], 0.5 * grid[5]
    for n in range(len(points_mm)):
        if n + AHEAD < len(points_mm):
            x, y, z = points_mm[n + AHEAD, 0], points_mm[n + AHEAD, 1], points_mm[n + AHEAD, 2]
            then = phases[n + AHEAD if len(phases) > 1 else 0]
            inside = abs(x - cx) < hx and abs(y - cy) < hy and abs(z - cz) < hz
            if not (inside and since <= then < until):
                cx, cy, cz, since, until = _expect(addresses, line, grid, x, y, z, then)
        phase = phases[n if len(phases) > 1 else 0]
        value, gx, gy, gz = spline_at(
            addresses, line, grid, points_mm[n, 0], points_mm[n, 1], points_mm[n, 2], phase
        )
        distance_mm[n] = value
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = gx, gy, gz


@asked
def sample_force(law, points_mm, phases, force_n):  # type: ignore[no-untyped-def]
    """Force at points into ``(n, 3)``; ``law`` is the first seven arguments of ``force_at``."""
    addresses, line, grid = law[:3]
    # The loop is that of ``sample``: a function that looks ahead for both takes a third longer,
    # or more.
    # The cell that was fetched last, and its interval of phases; none yet.
    cx, cy, cz, since, until = math.inf, 0.0, 0.0, 0.0, 0.0
    hx, hy, hz = 0.5 * grid[3], 0.5 * grid[4], 0.5 * grid[5]
    for n in range(len(points_mm)):
        if n + AHEAD < len(points_mm):
            x, y, z = points_mm[n + AHEAD, 0], points_mm[n + AHEAD, 1], points_mm[n + AHEAD, 2]
            then = phases[n + AHEAD if len(phases) > 1 else 0]
            inside = abs(x - cx) < hx and abs(y - cy) < hy and abs(z - cz) < hz
            if not (inside and since <= then < until):
                cx, cy, cz, since, until = _expect(addresses, line, grid, x, y, z, then)
        phase = phases[n if len(phases) > 1 else 0]
        fx, fy, fz, _ = felt_at(law, points_mm[n, 0], points_mm[n, 1], points_mm[n, 2], phase)
        force_n[n, 0], force_n[n, 1], force_n[n, 2] = fx, fy, fz
