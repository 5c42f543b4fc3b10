"""Move a field's spline such that its zero lies on the surface, between nodes and phases too.

The spline through exact distances takes them at the nodes; between nodes and between phases it
rounds off whatever is sharper than the grid. Its coefficients about the surface are therefore
corrected by a small change that brings the interpolated distance at points of the moving surface
close to zero: damped least squares by conjugate gradients on the normal equations (CGLS; Björck,
Numerical Methods for Least Squares Problems, SIAM 1996), scaled by the diagonal. After every round
the points that are still too far off get more weight, in proportion to it: so Lawson's
algorithm goes from least squares to the least maximum (Lawson, Contributions to the theory of
linear least maximum approximations, UCLA 1961). Points are asked for at three moments a stored
phase, where vertices follow their own spline in time. They are few, for most of a surface needs no
more; before some rounds many more places are looked at, and those that are too far off become
points (the exchange of Remez: Cheney, Introduction to Approximation Theory, 1966, chapter 3).
Where phases are few nobody knows where the surface was between them, and a zero that is bent to a
guess bends the distance about it: such a point weighs by the inverse of its variance.

The nodes about the surface are held at what they have, for there the distance is exact at stored
phases: where sheets are nearer to each other than the grid can show, such as at the tip of a vein,
the zero would otherwise come to their points by islands beside them and holes between them.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.field.fit_kernels import gather, mix, room, scatter, share, touch
from pipeline.field.motion import BeatingSurface
from pipeline.field.spline import node_values, phase_weights, timeline
from pipeline.field.surface_points import Sheet, Spread, sheets_of
from pipeline.field.threads import processors
from pipeline.geometry import Float, Float32, Grid

T = TypeVar("T")

LOOK_BEFORE = 2, 5, 8, 10
"""Rounds before which places are looked at; those that are too far off, but by less than a spacing,
become points, once more each time."""
DAMPING = 0.06
"""Weight of a coefficient's squared change beside the squared distance of one point."""
NEAR_ENOUGH = 0.035
"""A point that is nearer to the spline's zero than this share of the grid's spacing gets no more
weight: to bring it nearer still would cost the gradient about it more than it is worth. One
whose own place is less sure than that need come no nearer than it is sure."""
MOST_WEIGHT = 500.0
MOST_CHANGE = 1.0
"""No coefficient moves by more than so many spacings: where two rims share their nodes, no change
suits both, and what little it gains there it would cost many times over beside them."""
STEPS_A_ROUND = 4
HELD, HELD_WITHIN = 0.1, 1.0
"""Weight of a node's squared change beside the squared distance of one point, and by how many
spacings nodes are held. More of either costs the zero more between nodes and phases."""
HELD_NEAR, HELD_SHARE, HELD_POWER = 0.15, 0.8, 8
"""A node whose distance changes by less than this share of the grid's spacing, or of that distance,
gets no more weight. One that comes to lie on the other side changes by all of it, and a few rounds
must do: weights grow by this power of how many times as much it is."""


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

    sheet: Sheet | None = None
    """Where more places are to be looked at; None where points are nodes, whose distance is to stay
    as it is instead of coming to zero."""


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
    step_mm = min(grid.spacing_mm)
    sheets = list(sheets_of(moving, phases, grid))
    low, high = _box([one.vertices for one in sheets], grid)
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    shape = splines[0][box].shape
    line = timeline(phases)
    moments = []
    for one in sheets:
        interval, weights = phase_weights(line, one.phase)
        moved = replace(one, vertices=one.vertices - np.array([*low, 0], dtype=np.float32))
        nodes, near_enough_mm = _asked(moved, one.points, shape, step_mm)
        parts = nodes, interval, np.array(weights, dtype=np.float32), near_enough_mm
        moments.append(_Moment(*parts, moved))
    del sheets
    # A surface may lie outside the grid, all of it.
    if not any(len(one.nodes) for one in moments):
        return 0.0
    touched = np.zeros(shape, dtype=bool)
    for moment in moments:
        touch(touched, moment.nodes)
        # Places at an edge may ask for nodes that no point of the triangles beside it does.
        if moment.sheet is not None:
            places, _ = _asked(moment.sheet, moment.sheet.looked_at, shape, step_mm)
            touch(touched, places)
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


def _asked(
    sheet: Sheet, spread: Spread, shape: tuple[int, ...], step_mm: float
) -> tuple[Float32, Float32]:
    """Points in the box, ``(n, 3)``, and how near each has to come, mm ``(n,)``."""
    points = spread.carried(sheet.vertices)
    nodes, unsure_mm = points[:, :3], points[:, 3]
    # The last thousandth would ask for one node more, rounded to single precision.
    inside = ((nodes >= 0.5) & (nodes < np.array(shape[::-1]) - 1.501)).all(axis=1)
    near_enough_mm = np.maximum(np.float32(NEAR_ENOUGH * step_mm), unsure_mm[inside])
    return np.ascontiguousarray(nodes[inside]), near_enough_mm


def _box(vertices: Sequence[Float32], grid: Grid) -> tuple[list[int], list[int]]:
    """First node (x, y, z) of the part of the grid that points ask, and the one behind its last."""
    least = np.min([one[:, :3].min(axis=0) for one in vertices], axis=0)
    most = np.max([one[:, :3].max(axis=0) for one in vertices], axis=0)
    shape = np.array(grid.shape[::-1])
    # One node more than needed, for rounding to single precision.
    low = np.clip(np.floor(least + 0.5).astype(int) - 2, 0, shape)
    high = np.clip(np.floor(most + 0.5).astype(int) + 3, low, shape)
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
        moments.append(_Moment(nodes[near], interval, *parts))
    return moments


class _Layers(threading.local):
    """What each thread has for itself, ``(z, y, x)``."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mixed, self.acting = room(shape), room(shape)


class _Fit:
    """The change that brings coefficients to zero at all points.

    Coefficients ``(phase, n)`` are those that some point or place asks, a shell about the surface:
    ``shell`` are their places in an array of ``shape`` ``(z, y, x)``, flattened.
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
        self._moments = list(moments)
        self._runs = _runs([one.interval for one in moments], len(coefficients))
        self._pool = pool
        self._layers = _Layers(shape)
        self._shell = shell
        self._coefficients = coefficients
        self._spacing_mm = spacing_mm
        self._change = np.zeros_like(coefficients)
        self._before = [
            np.zeros_like(found) if one.sheet is None else -found
            for one, found in zip(moments, self._values(coefficients), strict=True)
        ]
        self._off = [one.copy() for one in self._before]
        self._weights = [
            np.full_like(one.near_enough_mm, HELD)
            if one.sheet is None
            else self._first_weights(one.near_enough_mm)
            for one in moments
        ]

    def after(self, rounds: int) -> Float32:
        """The change after some rounds of reweighted least squares."""
        for number in range(rounds):
            if number:
                self._weigh()
            if number in LOOK_BEFORE:
                self._look()
            self._least_squares()
            self._bound()
        return self._change

    def _bound(self) -> None:
        """Take back what moves a coefficient too far."""
        most_mm = np.float32(MOST_CHANGE * self._spacing_mm)
        if np.abs(self._change).max() > most_mm:
            np.clip(self._change, -most_mm, most_mm, out=self._change)
            moved = self._values(self._change)
            self._off = [one - other for one, other in zip(self._before, moved, strict=True)]

    def _weigh(self) -> None:
        """More weight to points that are too far off, and to nodes that change too much."""
        for one, weight, off in zip(self._moments, self._weights, self._off, strict=True):
            more = np.maximum(np.abs(off) / one.near_enough_mm, np.float32(1))
            weight *= more**HELD_POWER if one.sheet is None else more
            np.minimum(weight, np.float32(MOST_WEIGHT), out=weight)

    def _look(self) -> None:
        """Take in places of the surface that are too far off, for the points leave room between
        them."""
        coefficients = self._coefficients + self._change

        def look(number: int) -> None:
            one, layer = self._moments[number], self._layers.mixed
            if one.sheet is None:
                return
            shape = layer.shape
            nodes, near_enough_mm = _asked(one.sheet, one.sheet.looked_at, shape, self._spacing_mm)
            mix(coefficients, one.interval, one.weights, layer, self._shell)
            found = self._gathered(layer, nodes)
            off_mm = np.abs(found)
            missed = (off_mm > near_enough_mm) & (off_mm < MOST_CHANGE * self._spacing_mm)
            nodes, near_enough_mm, found = nodes[missed], near_enough_mm[missed], found[missed]
            mix(self._change, one.interval, one.weights, layer, self._shell)
            moved = self._gathered(layer, nodes)
            more = nodes, near_enough_mm, moved - found, -found, self._first_weights(near_enough_mm)
            before = self._before[number], self._off[number], self._weights[number]
            had = one.nodes, one.near_enough_mm, *before
            nodes, near_enough_mm, *rest = map(np.concatenate, zip(had, more, strict=True))
            self._moments[number] = replace(one, nodes=nodes, near_enough_mm=near_enough_mm)
            self._before[number], self._off[number], self._weights[number] = rest

        self._of_each(look, self._moments)

    def _first_weights(self, near_enough_mm: Float32) -> Float32:
        return np.asarray(np.square(np.float32(NEAR_ENOUGH * self._spacing_mm) / near_enough_mm))

    @staticmethod
    def _gathered(layer: Float32, nodes: Float32) -> Float32:
        values = np.empty(len(nodes), dtype=np.float32)
        gather(layer, nodes, values)
        return values

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
