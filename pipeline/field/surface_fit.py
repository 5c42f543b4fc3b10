"""Move a field's spline such that its zero lies on the surface, between nodes and phases too.

The spline through exact distances takes them at the nodes; between nodes and between phases it
rounds off whatever is sharper than the grid. Its coefficients about the surface are therefore
corrected by a small change that brings the interpolated distance at points of the moving surface
close to zero: damped least squares by conjugate gradients on the normal equations (CGLS; Björck,
Numerical Methods for Least Squares Problems, SIAM 1996), stopped after a few steps. Points are
asked for at the stored phases and halfway between, where vertices follow their own spline in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.field.motion import BeatingSurface, Motion, halfway
from pipeline.field.spline import phase_weights, timeline
from pipeline.geometry import Float, Float32, Grid, Surface

POINTS_A_CELL = 6.0
"""Points of the surface for each square of the grid's spacing."""
DAMPING = 0.1
"""Weight of a coefficient's squared change beside the squared distance of one point."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """Points at which the distance is to be zero, all at one phase."""

    nodes: Float32
    """``(point, 3)``: x, y, z counted in nodes from the corner of the box."""

    interval: int
    """Number of the interval in time."""

    weights: Float32
    """``(3,)``: of the phases before, at and after it."""


def fit_to_surface(
    splines: Sequence[Float32], phases: Float, grid: Grid, moving: BeatingSurface, rounds: int
) -> float:
    """Correct the coefficients of one structure in place.

    Parameters
    ----------
    splines
        ``(z, y, x)`` coefficients, one array a phase, solved in space and time.
    phases
        ``(phase,)`` in [0, 1), rising.
    grid
        Where the coefficients live.
    moving
        The surface, LPS mm.
    rounds
        Steps of the conjugate gradients; nothing is changed when 0.

    Returns
    -------
    The largest change of a coefficient, mm: no interpolated distance changes by more.
    """
    if rounds == 0:
        return 0.0
    places = [(phase, _spread_over(one, grid)) for phase, one in _surfaces(moving, phases)]
    low, high = _box([points_mm for _, points_mm in places], grid)
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    line = timeline(phases)
    moments = []
    for phase, points_mm in places:
        interval, weights = phase_weights(line, phase)
        nodes = (points_mm - grid.origin_mm) / np.array(grid.spacing_mm) - low
        moments.append(
            _Moment(nodes.astype(np.float32), interval, np.array(weights, dtype=np.float32))
        )
    coefficients = np.stack([one[box] for one in splines])
    change = _least_squares(coefficients, moments, rounds)
    for one, part in zip(splines, change, strict=True):
        one[box] += part
    return float(np.abs(change).max())


def _surfaces(moving: BeatingSurface, phases: Float) -> Iterator[tuple[float, Surface]]:
    """What is known of a surface: stored phases, and between them where vertices correspond."""
    for index, phase in enumerate(phases):
        yield float(phase), moving.at(index)
    motion = Motion.of(moving)
    if motion:
        for phase in halfway(phases):
            yield float(phase), motion.at(float(phase))


def _spread_over(surface: Surface, grid: Grid) -> Float:
    """``(n, 3)`` points spread evenly over a surface, and vertices, which stand out most, mm."""
    corners = surface.vertices_mm[surface.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.cumsum(np.linalg.norm(across, axis=1)) / 2
    count = int(np.ceil(POINTS_A_CELL * area[-1] / min(grid.spacing_mm) ** 2))
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    # An even sequence in the square (Roberts 2018: powers of the inverse of the plastic number),
    # folded into the triangle.
    u, v = (np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532) % 1).T
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    weights = np.stack([1 - u - v, u, v], axis=1)
    inner = np.einsum("nk,nkd->nd", weights, corners[chosen])
    vertices_mm = surface.vertices_mm[:: max(1, len(surface.vertices_mm) // count)]
    return _inside(np.concatenate([inner, vertices_mm]), grid)


def _inside(points_mm: Float, grid: Grid) -> Float:
    """Those points whose three nodes an axis are all in the grid."""
    nodes = (points_mm - grid.origin_mm) / np.array(grid.spacing_mm)
    return np.asarray(
        points_mm[((nodes >= 0.5) & (nodes < np.array(grid.shape[::-1]) - 1.5)).all(1)]
    )


def _box(points_mm: Sequence[Float], grid: Grid) -> tuple[list[int], list[int]]:
    """First node (x, y, z) of the part of the grid that points ask, and the one behind its last."""
    least = np.min([one.min(axis=0) for one in points_mm], axis=0)
    most = np.max([one.max(axis=0) for one in points_mm], axis=0)
    low, high = (
        np.floor((place - grid.origin_mm) / np.array(grid.spacing_mm) + 0.5).astype(int)
        for place in (least, most)
    )
    # One node more than needed, for rounding to single precision.
    low = np.maximum(low - 2, 0)
    high = np.minimum(high + 3, grid.shape[::-1])
    return low.tolist(), high.tolist()


def _least_squares(coefficients: Float32, moments: Sequence[_Moment], rounds: int) -> Float32:
    """The change of the coefficients after ``rounds`` steps from none."""
    off = [-_values(coefficients, one) for one in moments]
    change = np.zeros_like(coefficients)
    slope = _slope(change, moments, off)
    way, length2 = slope.copy(), _squares([slope])
    for _ in range(rounds):
        along = [_values(way, one) for one in moments]
        curvature = _squares(along) + DAMPING * _squares([way])
        # Nothing is left to do on a surface that the spline already has.
        if curvature == 0:
            break
        step = np.float32(length2 / curvature)
        change += step * way
        off = [old - step * one for old, one in zip(off, along, strict=True)]
        slope = _slope(change, moments, off)
        before, length2 = length2, _squares([slope])
        way *= np.float32(length2 / before)
        way += slope
    return change


def _slope(change: Float32, moments: Sequence[_Moment], off: Sequence[Float32]) -> Float32:
    """Down which way the sum of squares falls."""
    slope = np.float32(-DAMPING) * change
    for one, values in zip(moments, off, strict=True):
        _scatter(slope, one.nodes, one.interval, one.weights, values)
    return slope


def _squares(parts: Sequence[Float32]) -> float:
    # A product by BLAS would be summed in an order that depends on its threads.
    return float(sum(np.square(one).sum(dtype=float) for one in parts))


def _values(coefficients: Float32, moment: _Moment) -> Float32:
    found = np.empty(len(moment.nodes), dtype=np.float32)
    _gather(coefficients, moment.nodes, moment.interval, moment.weights, found)
    return found


@njit(nogil=True, cache=True)
def _weigh(place, weights):  # type: ignore[no-untyped-def]
    """Weights of the three nodes about a place on an axis; the first node's number."""
    middle = int(np.floor(place + np.float32(0.5)))
    t = place - np.float32(middle)
    half = np.float32(0.5)
    weights[0] = half * (half - t) * (half - t)
    weights[1] = np.float32(0.75) - t * t
    weights[2] = half * (half + t) * (half + t)
    return middle - 1


@njit(nogil=True, cache=True)
def _gather(coefficients, nodes, interval, in_time, found):  # type: ignore[no-untyped-def]
    """Interpolated distances at points of one moment."""
    count, w = len(coefficients), np.empty((3, 3), np.float32)
    for n in range(len(nodes)):
        x, y, z = _weigh(nodes[n, 0], w[0]), _weigh(nodes[n, 1], w[1]), _weigh(nodes[n, 2], w[2])
        value = np.float32(0)
        for t in range(3):
            phase = coefficients[(interval + t - 1) % count]
            for k in range(3):
                for j in range(3):
                    row = phase[z + k, y + j]
                    line = w[0, 0] * row[x] + w[0, 1] * row[x + 1] + w[0, 2] * row[x + 2]
                    value += in_time[t] * w[2, k] * w[1, j] * line
        found[n] = value


@njit(nogil=True, cache=True)
def _scatter(target, nodes, interval, in_time, values):  # type: ignore[no-untyped-def]
    """Add to every coefficient the values of the points that it acts on, by its weight there."""
    count, w = len(target), np.empty((3, 3), np.float32)
    for n in range(len(nodes)):
        x, y, z = _weigh(nodes[n, 0], w[0]), _weigh(nodes[n, 1], w[1]), _weigh(nodes[n, 2], w[2])
        for t in range(3):
            phase = target[(interval + t - 1) % count]
            for k in range(3):
                for j in range(3):
                    row = phase[z + k, y + j]
                    part = values[n] * in_time[t] * w[2, k] * w[1, j]
                    row[x] += part * w[0, 0]
                    row[x + 1] += part * w[0, 1]
                    row[x + 2] += part * w[0, 2]
