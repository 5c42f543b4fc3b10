"""Move a field's spline such that its zero lies on the surface, between nodes and phases too.

The spline through exact distances takes them at the nodes; between nodes and between phases it
rounds off whatever is sharper than the grid. Its coefficients about the surface are therefore
corrected by a small change that brings the interpolated distance at points of the moving surface
close to zero: damped least squares by conjugate gradients on the normal equations (CGLS; Björck,
Numerical Methods for Least Squares Problems, SIAM 1996), scaled by the diagonal. After every round
the points that are still too far off get more weight, in proportion to it: so Lawson's
algorithm goes from least squares to the least maximum (Lawson, Contributions to the theory of
linear least maximum approximations, UCLA 1961). Points are asked for at three moments a stored
phase, where vertices follow their own spline in time. Where phases are few nobody knows where the
surface was between them, and a zero that is bent to a guess bends the distance about it: such a
point weighs by the inverse of its variance.

The nodes about the surface are held at what they have, for there the distance is exact at stored
phases: where sheets are nearer to each other than the grid can show, such as at the tip of a vein,
the zero would otherwise come to their points by islands beside them and holes between them.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.field.fit_kernels import gather, mix, room, scatter, share, touch
from pipeline.field.motion import BeatingSurface, Motion, between, is_gap
from pipeline.field.spline import node_values, phase_weights, timeline
from pipeline.field.threads import processors
from pipeline.geometry import (
    Float,
    Float32,
    Grid,
    Integer,
    Surface,
    area_vectors,
    spread_over_triangle,
)

T = TypeVar("T")

MOMENTS_A_PHASE = 3
POINTS_A_CELL = 2.0
"""Points of the surface for each square of the grid's spacing, beside vertices and edges."""
DAMPING = 0.06
"""Weight of a coefficient's squared change beside the squared distance of one point."""
NEAR_ENOUGH = 0.035
"""A point that is nearer to the spline's zero than this share of the grid's spacing gets no more
weight: to bring it nearer still would cost the gradient about it more than it is worth. One
whose own place is less sure than that need come no nearer than it is sure."""
FEW_PHASES = 16
"""With fewer, what the vertices' spline does not know costs the gradient more than its zero gains;
with more it follows the heart as closely as the field can."""
MOST_WEIGHT = 500.0
MOST_CHANGE = 1.0
"""No coefficient moves by more than so many spacings: where two rims share their nodes, no change
suits both, and what little it gains there it would cost many times over beside them."""
STEPS_A_ROUND = 4
HELD, HELD_WITHIN = 0.1, 1.0
"""Weight of a node's squared change beside the squared distance of one point, and by how many
spacings nodes are held. More of either costs the zero more between nodes and phases."""
HELD_NEAR, HELD_SHARE = 0.15, 0.45
"""A node whose distance changes by less than this share of the grid's spacing, or of that distance,
gets no more weight: a node that comes to lie on the other side changes by all of it."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """Points at which the distance is to be zero, all at one phase."""

    nodes: Float32
    """``(point, 3)``: x, y, z counted in nodes from the corner of the box."""

    interval: int
    """Number of the interval in time."""

    weights: Float32
    """``(3,)``: of the phases before, at and after it."""

    near_enough_mm: Float32
    """``(point,)``: one that is nearer to the spline's zero gets no more weight."""

    held: bool = False
    """Whether points are nodes, whose distance is to stay as it is instead of coming to zero."""


def fit_to_surface(
    splines: Sequence[Float32],
    phases: Float,
    grid: Grid,
    moving: BeatingSurface,
    rounds: int,
    threads: int | None = None,
) -> float:
    """Correct the coefficients of one structure in place.

    The result does not depend on the number of threads.

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
        How often the weights of the points are set; nothing is changed when 0, nor where no point
        of the surface lies in the grid.
    threads
        How many; as many as there are processors when None.

    Returns
    -------
    The largest change of a coefficient, mm: no interpolated distance changes by more.
    """
    if rounds == 0:
        return 0.0
    places = [one.inside(grid) for one in _places(moving, phases, grid)]
    # Between phases that lie close together a spline may carry all points out of the grid.
    places = [one for one in places if len(one.points_mm)]
    if not places:
        return 0.0
    low, high = _box([one.points_mm for one in places], grid)
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    line = timeline(phases)
    moments = []
    step_mm = min(grid.spacing_mm)
    for one in places:
        interval, weights = phase_weights(line, one.phase)
        nodes = (one.points_mm - grid.origin_mm) / np.array(grid.spacing_mm) - low
        near_enough_mm = np.maximum(NEAR_ENOUGH * step_mm, one.unsure_mm).astype(np.float32)
        parts = nodes.astype(np.float32), interval, np.array(weights, dtype=np.float32)
        moments.append(_Moment(*parts, near_enough_mm))
    del places
    shape = splines[0][box].shape
    touched = np.zeros(shape, dtype=bool)
    for moment in moments:
        touch(touched, moment.nodes)
    moments += _held([one[box] for one in splines], phases, touched, step_mm)
    shell = np.flatnonzero(touched).astype(np.uint32)
    near = np.stack([one[box].ravel()[shell] for one in splines])
    # No more runs than this are apart, and each thread has room of its own.
    threads = min(threads or processors(), max(1, len(phases) // 4))
    with ThreadPoolExecutor(threads) as pool:
        change = _Fit(near, shell, shape, moments, step_mm, pool).after(rounds)
    for spline, moved in zip(splines, change, strict=True):
        part = np.zeros(shape, dtype=np.float32)
        part.ravel()[shell] = moved
        spline[box] += part
    return float(np.abs(change).max())


@dataclass(frozen=True, slots=True)
class _Places:
    """Points of the surface at one phase."""

    phase: float
    points_mm: Float
    """``(n, 3)``."""

    unsure_mm: Float
    """``(n,)``: by about how much each may be off."""

    def inside(self, grid: Grid) -> _Places:
        """Those whose three nodes an axis are all in the grid."""
        nodes = (self.points_mm - grid.origin_mm) / np.array(grid.spacing_mm)
        # The last thousandth would be none, rounded to single precision.
        held = ((nodes >= 0.5) & (nodes < np.array(grid.shape[::-1]) - 1.501)).all(1)
        return _Places(self.phase, self.points_mm[held], self.unsure_mm[held])


def _places(moving: BeatingSurface, phases: Float, grid: Grid) -> Iterator[_Places]:
    """Points at some moments: at stored phases, and where vertices correspond the
    same material points between them, but in no gap: what a spline of few phases cannot follow
    there, it would make up for at the phases beside it."""
    step_mm = min(grid.spacing_mm)
    motion = Motion.of(moving)
    if motion is None:
        for index, phase in enumerate(phases.tolist()):
            surface = moving.at(index)
            points_mm = _carried(surface.vertices_mm, *_spread_over(surface, step_mm))
            yield _Places(phase, points_mm, np.zeros(len(points_mm)))
        return
    corners, shares = _spread_over(moving.at(0), step_mm)
    moments = between(phases, MOMENTS_A_PHASE).reshape(-1, MOMENTS_A_PHASE)
    moments[is_gap(np.diff(phases, append=phases[0] + 1)), 1:] = np.nan
    unsure_of_each_mm = np.zeros(motion.places_mm.shape[:2])
    if len(phases) < FEW_PHASES:
        unsure_of_each_mm = motion.unsure_mm()
    for (stored, *later), unsure_mm in zip(moments.tolist(), unsure_of_each_mm, strict=True):
        yield _Places(
            stored, _carried(motion.at(stored).vertices_mm, corners, shares), np.zeros(len(corners))
        )
        around_mm = _carried(unsure_mm, corners, shares)
        for phase in later:
            if np.isfinite(phase):
                yield _Places(
                    phase, _carried(motion.at(phase).vertices_mm, corners, shares), around_mm
                )


def _spread_over(surface: Surface, step_mm: float) -> tuple[Integer, Float]:
    """Points spread evenly over a surface, its vertices, which stand out most, and the middles of
    its edges: ``(n, 3)`` vertex numbers and their shares."""
    triangles = surface.triangles
    corners_mm = surface.vertices_mm[triangles]
    area = np.cumsum(np.linalg.norm(area_vectors(corners_mm), axis=1)) / 2
    count = int(np.ceil(POINTS_A_CELL * area[-1] / step_mm**2))
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, ::2]]))
    edges = np.unique(sides, axis=0)[:, [0, 1, 1]]
    vertices = np.repeat(np.arange(len(surface.vertices_mm))[:, None], 3, axis=1)
    # A mesh that is much finer than the grid has more of them than it takes.
    some = [one[:: max(1, len(one) // (2 * count))] for one in (vertices, edges)]
    shares = [spread_over_triangle(count)]
    shares += [np.tile((0.5, 0.25, 0.25), (len(one), 1)) for one in some]
    return np.concatenate([triangles[chosen], *some]), np.concatenate(shares)


def _carried(values: Float, corners: Integer, shares: Float) -> Float:
    """What vertices have, ``(vertex, ...)``, at material points ``(n, ...)``."""
    return np.asarray(
        sum((shares[:, k] * values[corners[:, k]].T).T for k in range(3)), dtype=float
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


def _held(
    splines: Sequence[Float32], phases: Float, touched: npt.NDArray[np.bool_], step_mm: float
) -> list[_Moment]:
    """The nodes near the surface at every stored phase, of those whose coefficients are asked."""
    # A node at the end of the box asks for coefficients beyond it.
    held = np.zeros_like(touched)
    held[1:-1, 1:-1, 1:-1] = touched[1:-1, 1:-1, 1:-1]
    nodes = np.argwhere(held)[:, ::-1].astype(np.float32)
    line = timeline(phases)
    moments = []
    for phase in phases.tolist():
        interval, weights = phase_weights(line, phase)
        about = [splines[(interval + step) % len(splines)] for step in (-1, 0, 1)]
        mixed = sum(weight * one for weight, one in zip(weights, about, strict=True))
        distance_mm = np.abs(node_values(np.asarray(mixed))[held])
        near = distance_mm <= HELD_WITHIN * step_mm
        near_enough_mm = np.maximum(HELD_NEAR * step_mm, HELD_SHARE * distance_mm[near])
        parts = np.array(weights, dtype=np.float32), near_enough_mm.astype(np.float32)
        moments.append(_Moment(nodes[near], interval, *parts, held=True))
    return moments


class _Layers(threading.local):
    """What each thread has for itself, ``(z, y, x)``."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mixed, self.acting = room(shape), room(shape)


class _Fit:
    """The change that brings coefficients to zero at all points.

    Coefficients ``(phase, n)`` are those that some point asks, a shell about the surface: ``shell``
    are their places in an array of ``shape`` ``(z, y, x)``, flattened.
    """

    def __init__(
        self,
        coefficients: Float32,
        shell: npt.NDArray[np.uint32],
        shape: tuple[int, ...],
        moments: Sequence[_Moment],
        spacing_mm: float,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._moments = moments
        self._runs = _runs([one.interval for one in moments], len(coefficients))
        self._pool = pool
        self._layers = _Layers(shape)
        self._shell = shell
        self._most_mm = np.float32(MOST_CHANGE * spacing_mm)
        self._change = np.zeros_like(coefficients)
        self._before = [
            np.zeros_like(found) if one.held else -found
            for one, found in zip(moments, self._values(coefficients), strict=True)
        ]
        self._off = [one.copy() for one in self._before]
        near_enough_mm = np.float32(NEAR_ENOUGH * spacing_mm)
        self._weights = [
            np.full_like(one.near_enough_mm, HELD)
            if one.held
            else np.square(near_enough_mm / one.near_enough_mm)
            for one in moments
        ]

    def after(self, rounds: int) -> Float32:
        """The change after some rounds of reweighted least squares."""
        for number in range(rounds):
            if number:
                self._weigh()
            self._least_squares()
            self._bound()
        return self._change

    def _bound(self) -> None:
        """Take back what moves a coefficient too far."""
        most_mm = self._most_mm
        if np.abs(self._change).max() > most_mm:
            np.clip(self._change, -most_mm, most_mm, out=self._change)
            moved = self._values(self._change)
            self._off = [one - other for one, other in zip(self._before, moved, strict=True)]

    def _weigh(self) -> None:
        """More weight to points that are too far off."""
        for one, weight, off in zip(self._moments, self._weights, self._off, strict=True):
            weight *= np.maximum(np.abs(off) / one.near_enough_mm, np.float32(1))
            np.minimum(weight, np.float32(MOST_WEIGHT), out=weight)

    def _least_squares(self) -> None:
        """A few steps down the sum of squares."""
        scale = self._scale()
        slope, way = np.zeros_like(scale), np.zeros_like(scale)
        length2 = math.inf

        def rise(phase: int) -> float:
            return _product(slope[phase], scale[phase] * slope[phase])

        def turn(phase: int) -> float:
            way[phase] *= kept
            way[phase] += scale[phase] * slope[phase]
            return _product(way[phase], way[phase])

        def move(phase: int) -> None:
            self._change[phase] += step * way[phase]

        def curving(number: int) -> float:
            return _product(self._weights[number] * along[number], along[number])

        def approach(number: int) -> None:
            self._off[number] -= step * along[number]

        for _ in range(STEPS_A_ROUND):
            self._find_slope(slope)
            before, length2 = length2, sum(self._of_each(rise, self._change))
            # Nothing is left to do on a surface that the spline already has.
            if length2 == 0:
                break
            kept = np.float32(length2 / before)
            curvature = DAMPING * sum(self._of_each(turn, way))
            along = self._values(way)
            curvature += sum(self._of_each(curving, along))
            if curvature == 0:
                break
            step = np.float32(length2 / curvature)
            self._of_each(move, way)
            self._of_each(approach, along)

    def _find_slope(self, slope: Float32) -> None:
        """Down which way the sum of squares falls."""
        np.multiply(self._change, np.float32(-DAMPING), out=slope)

        def add(number: int) -> None:
            one, acting = self._moments[number], self._layers.acting
            scatter(acting, one.nodes, self._weights[number] * self._off[number], squared=False)
            share(slope, one.interval, one.weights, acting, self._shell)

        self._for_all(add)

    def _scale(self) -> Float32:
        """One over the diagonal of the normal equations."""
        diagonal = np.full_like(self._change, np.float32(DAMPING))

        def add(number: int) -> None:
            one, acting = self._moments[number], self._layers.acting
            scatter(acting, one.nodes, self._weights[number], squared=True)
            share(diagonal, one.interval, one.weights**2, acting, self._shell)

        self._for_all(add)
        return np.asarray(np.float32(1) / diagonal)

    def _values(self, coefficients: Float32) -> list[Float32]:
        """Interpolated distances at all points."""
        values = [np.empty(len(one.nodes), dtype=np.float32) for one in self._moments]

        def ask(number: int) -> None:
            one, mixed = self._moments[number], self._layers.mixed
            mix(coefficients, one.interval, one.weights, mixed, self._shell)
            gather(mixed, one.nodes, values[number])

        self._for_all(ask)
        return values

    def _of_each(self, work: Callable[[int], T], ones: Sized) -> list[T]:
        """What some work gives for each of them, by its number, several at a time."""
        return list(self._pool.map(work, range(len(ones))))

    def _for_all(self, work: Callable[[int], None]) -> None:
        """Do something with every moment, by its number, several at a time; what it adds to
        phases is added in the same order however many threads there are."""

        def through(run: Sequence[int]) -> None:
            for number in run:
                work(number)

        # Every second run: no two of them share a phase.
        for some in (self._runs[::2], self._runs[1::2]):
            list(self._pool.map(through, some))


def _runs(intervals: Sequence[int], phases: int) -> list[list[int]]:
    """Numbers of moments in runs of neighbouring intervals, an even number of runs and
    two intervals or more in each: a moment acts on the phases beside its own too."""
    count = max(1, phases // 4) * 2
    runs: list[list[int]] = [[] for _ in range(count)]
    for number, interval in enumerate(intervals):
        runs[interval * count // phases].append(number)
    return runs


def _product(one: Float32, other: Float32) -> float:
    # A product by BLAS would be summed in an order that depends on its threads.
    return float(np.multiply(one, other).sum(dtype=float))
