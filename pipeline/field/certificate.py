"""The accuracy certificate of a baked field: measured on the finished values, none assumed.

Distances and directions are checked against VTK, which shares no code with the baking, and what
is answered at the nodes against what is stored there; forces are compared between neighbouring
nodes and phases, and between places 0.1 mm and moments 1 ms apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.errors import StageError
from pipeline.exact import ExactSurface, points_about
from pipeline.field.fixture import Bounds, Fixture
from pipeline.field.motion import BeatingSurface, Motion, halfway, is_gap
from pipeline.field.reader import ForceField
from pipeline.field.stiffness import STEP_MM, field_rates_n_per_m
from pipeline.field.threads import processors
from pipeline.geometry import Float, Surface

BAND_MM = 15.0
"""How far from the surface the interpolated distance is checked."""
ANSWERED = 2.0
"""Within how many spacings of the surface all nodes are asked. No answer is moved by more than one
(`pipeline.field.surface_fit.MOST_CHANGE`), so none farther off comes to the other side. Nodes that
a fast surface passes two phases away are moved, too, farther from where it is."""
DIRECTION_BAND_MM = 5.0
DIRECTION_SAMPLES = 60
"""Directions are checked nearer, at fewer points: there the fixtures act."""
STEP_MS = 1.0
CLEAR_GRADIENT = 0.5
"""Where the gradient is as long as this, the force has the size that the law gives it: it is
shorter about the medial axis alone, where the force passes through zero."""
FORCE_SAMPLES = 4000


def certify(
    volume: ForceField,
    surfaces: Mapping[str, BeatingSurface],
    samples: int,
    progress: Callable[[], None],
) -> dict[str, Any]:
    """Measure a field against the surfaces that it was baked from.

    Parameters
    ----------
    volume
        The field, all phases written.
    surfaces
        By structure, with the phases of the field.
    samples
        Random points per surface and phase.
    progress
        Called once for every phase.

    Returns
    -------
    Largest errors over all, and per structure and fixture.
    """
    distances: dict[str, list[dict[str, Any]]] = {name: [] for name in volume.structures}
    nodes_mm = volume.grid.nodes_mm().reshape(-1, 3)
    forces = {name: _ForceSteps(volume, name, surfaces, nodes_mm) for name in volume.fixtures}
    with ThreadPoolExecutor(processors()) as pool:
        for index in range(len(volume.phases)):
            steps = [pool.submit(one.add, index) for one in forces.values()]
            for name, found in distances.items():
                errors = _distance_errors(volume, name, index, surfaces[name], samples)
                found.append(errors | _answered_errors(volume, name, index, nodes_mm))
            for step in steps:
                step.result()
            progress()
        limits = dict(
            zip(distances, pool.map(partial(spline_limits, volume), distances), strict=True)
        )
    structures = {
        name: _over_phases(found) | _drift(volume, name, surfaces[name])
        for name, found in distances.items()
    }
    fixtures = {
        name: one.result(*limits[volume.fixtures[name].structure]) for name, one in forces.items()
    }
    return {
        **_largest(structures),
        **_largest(fixtures),
        "samples_per_phase": samples,
        "band_mm": BAND_MM,
        "structures": structures,
        "fixtures": fixtures,
    }


def rate_bound_n_per_mm(fixture: Fixture, longest: float, turning_per_mm: float) -> float:
    """The stated bound of how fast a force changes with place, on the medial axis too, N/mm.

    The direction is the gradient projected onto a ball and divided by its radius 1/2, which turns
    no faster than twice the gradient does; the size follows the law's slope times the gradient's
    length. What limits both is from `spline_limits`.
    """
    return 2 * fixture.f_max_n * turning_per_mm + fixture.stiffness_n_per_m / 1000 * longest


def spline_limits(volume: ForceField, structure: str) -> tuple[float, float]:
    """Limits of a structure's gradient anywhere, in any direction: of its length, and of how fast
    it changes with place, 1/mm.

    Everywhere a first or second derivative of a quadratic spline is a mean of the differences of
    its coefficients between neighbours along these axes (de Boor, A Practical Guide to Splines,
    1978, chapter X), in time as well. So no derivative is larger than the largest difference, and
    the matrix of second derivatives is no larger than that of the largest ones.
    """
    from pipeline.field.steps import largest_differences

    first, second = np.zeros(3, np.float32), np.zeros((3, 3), np.float32)
    for index in range(len(volume.phases)):
        largest_differences(volume.stored_coefficients(structure, index), first, second)
    first, second = first.astype(np.float64), second.astype(np.float64)
    # Differences in single precision are rounded: each by half of this share of what it is of.
    rounding = float(np.finfo(np.float32).eps)
    second += 2 * rounding * (first.max() + second)
    first += rounding * first
    spacing_mm = np.array(volume.grid.spacing_mm)
    turning = np.linalg.eigvalsh(second / np.outer(spacing_mm, spacing_mm))
    return float(np.linalg.norm(first / spacing_mm)), float(turning[-1])


def allowed_errors(bounds: Bounds, spacing_mm: float) -> dict[str, float]:
    """The most that figures of a certificate may be, by their names."""
    return {
        "node_error_near_mm": bounds.node_error_near_mm,
        "node_error_far_mm": bounds.node_error_far_mm,
        "sign_errors": bounds.sign_errors,
        "surface_error_p99_mm": bounds.surface_error_p99_spacings * spacing_mm,
    }


def require_bounds(accuracy: Mapping[str, Any], bounds: Bounds, spacing_mm: float) -> None:
    """Refuse a field whose certificate is not within bounds.

    Raises
    ------
    StageError
        Naming every bound that is broken, and the structure where it is broken most.
    """
    parts = accuracy["structures"]
    broken = [
        f"{name} is {accuracy[name]:.4g} (most at {_worst(parts, name)}), allowed is {limit:.4g}"
        for name, limit in allowed_errors(bounds, spacing_mm).items()
        if not accuracy[name] <= limit
    ]
    if broken:
        raise StageError(
            f"bake: the field is not as exact as it must be: {'; '.join(broken)}; choose a finer "
            "bake.spacing_mm, allow more in bake.bounds, or take that structure's fixtures out"
        )


def _worst(parts: Mapping[str, Any], name: str) -> str:
    """The structure whose figure is the largest, or is none."""
    return max(parts, key=lambda one: (math.isnan(parts[one][name]), parts[one][name]))


def _distance_errors(
    volume: ForceField, structure: str, index: int, moving: BeatingSurface, samples: int
) -> dict[str, Any]:
    """Errors of one phase: on the surface, about it, at nodes anywhere, and of directions."""
    rng = np.random.default_rng(index)
    surface = moving.at(index)
    exact = ExactSurface(surface)
    phase = volume.phases[index]
    about_mm = points_about(surface, rng, samples, BAND_MM)
    about_mm = about_mm[volume.contains(about_mm)]
    found_mm = volume.distance_mm(about_mm, phase, structure)
    on_mm = points_about(surface, rng, samples, 0.0)
    stored = volume.stored_distance_mm(structure, index)
    nodes = np.unravel_index(rng.integers(stored.size, size=samples // 2), stored.shape)
    grid = volume.grid
    nodes_mm = grid.origin_mm + np.column_stack(nodes[::-1]) * np.array(grid.spacing_mm)
    at_nodes_mm = exact.distance_mm(nodes_mm)
    off_mm = np.abs(stored[nodes] - at_nodes_mm)
    near = np.abs(at_nodes_mm) <= BAND_MM
    # Zero may have either sign.
    wrong = (np.signbit(stored[nodes]) != np.signbit(at_nodes_mm)) & (off_mm > 1e-6)
    return {
        "between": np.abs(found_mm - exact.distance_mm(about_mm)),
        "surface": np.abs(volume.distance_mm(on_mm, phase, structure)),
        "near": float(off_mm[near].max(initial=0.0)),
        "far": float(off_mm[~near].max(initial=0.0)),
        "signs": int(wrong.sum()),
        **_gradient_errors(volume, structure, float(phase), surface, exact, rng),
    }


def _answered_errors(
    volume: ForceField, structure: str, index: int, nodes_mm: Float
) -> dict[str, float]:
    """How far what is answered at nodes about the surface is from what is stored there, which is
    exact, at most; and how far from the surface a node is told to be on the other side.

    They differ by what moved the splines' zeros to the surface between nodes.
    """
    stored = volume.stored_distance_mm(structure, index).ravel()
    near = np.abs(stored) <= ANSWERED * max(volume.grid.spacing_mm)
    stored = stored[near]
    answered = volume.distance_mm(nodes_mm[near], volume.phases[index], structure)
    wrong = np.signbit(answered) != np.signbit(stored)
    return {
        "answered": float(np.abs(answered - stored).max(initial=0.0)),
        "wrong_side": float(np.abs(stored[wrong]).max(initial=0.0)),
    }


def _gradient_errors(
    volume: ForceField,
    structure: str,
    phase: float,
    surface: Surface,
    exact: ExactSurface,
    rng: np.random.Generator,
) -> dict[str, Float]:
    """How far the gradient is from the true one, which points from the nearest point of the
    surface and is 1 long: the length of the difference, and the angle between them in degrees."""
    points_mm = points_about(surface, rng, DIRECTION_SAMPLES, DIRECTION_BAND_MM)
    distance_mm, nearest_mm = exact.nearest(points_mm)
    # On the surface itself the way to it has no direction.
    clear = np.abs(distance_mm) > 0.2
    away = (points_mm - nearest_mm)[clear] / distance_mm[clear, None]
    gradient = volume.gradient(points_mm[clear], phase, structure)
    cosine = np.einsum("ij,ij->i", away, gradient) / np.linalg.norm(gradient, axis=1)
    return {
        "slope": np.linalg.norm(gradient - away, axis=1),
        "turned": np.degrees(np.arccos(np.clip(cosine, -1, 1))),
    }


def _over_phases(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    between, surface, slope, turned = (
        np.concatenate([one[part] for one in found])
        for part in ("between", "surface", "slope", "turned")
    )
    # NumPy's maximum of what is no number is none, either.
    largest = [float(np.maximum(one["between"].max(), one["answered"])) for one in found]
    return {
        "distance_error_max_mm": float(np.max(largest)),
        "distance_error_p99_mm": float(np.percentile(between, 99)),
        "surface_error_max_mm": float(surface.max()),
        "surface_error_p99_mm": float(np.percentile(surface, 99)),
        "node_error_near_mm": max(one["near"] for one in found),
        "node_error_far_mm": max(one["far"] for one in found),
        "wrong_side_max_mm": max(one["wrong_side"] for one in found),
        "gradient_error_median": float(np.median(slope)),
        "gradient_error_p99": float(np.percentile(slope, 99)),
        "direction_error_median_deg": float(np.median(turned)),
        "direction_error_p99_deg": float(np.percentile(turned, 99)),
        "sign_errors": sum(one["signs"] for one in found),
        "distance_error_max_mm_by_phase": largest,
        "surface_error_max_mm_by_phase": [float(one["surface"].max()) for one in found],
        "gradient_error_median_by_phase": [float(np.median(one["slope"])) for one in found],
        "sign_errors_by_phase": [one["signs"] for one in found],
        "wrong_side_max_mm_by_phase": [one["wrong_side"] for one in found],
    }


def _drift(volume: ForceField, structure: str, moving: BeatingSurface) -> dict[str, Any]:
    """How far the field's surface is, halfway between phases, from the smoothly moving one.

    The measure is the interpolated distance at all vertices, which follow their own periodic spline
    in time, and in the middles of the triangles; beside it by about how much that spline may be
    off. None where vertices do not correspond, or phases are too few for a spline.
    """
    motion = Motion.of(moving)
    if motion is None:
        names = ("drift_max_mm", "drift_p99_mm", "motion_unsure_p99_mm", "drift_max_mm_by_phase")
        return dict.fromkeys(names)
    off = []
    unsure_mm = motion.unsure_mm()[~is_gap(volume.phases)]
    for moment in halfway(volume.phases).tolist():
        surface = motion.at(moment)
        middles_mm = surface.vertices_mm[surface.triangles].mean(axis=1)
        asked_mm = np.concatenate([surface.vertices_mm, middles_mm])
        off.append(np.abs(volume.distance_mm(asked_mm, moment, structure)))
    return {
        "drift_max_mm": float(np.max([one.max() for one in off])),
        "drift_p99_mm": float(np.percentile(np.concatenate(off), 99)),
        "motion_unsure_p99_mm": float(np.percentile(unsure_mm, 99)),
        "drift_max_mm_by_phase": [float(one.max()) for one in off],
    }


def _largest(parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The largest of every figure, counts added; unknown (None) where any part's is."""
    first = next(iter(parts.values()))
    columns = {name: [one[name] for one in parts.values()] for name in first}
    return {
        name: None if None in values else sum(values) if name == "sign_errors" else max(values)
        for name, values in columns.items()
        if not name.endswith("_by_phase")
    }


@dataclass(frozen=True, slots=True)
class _Sampled:
    """What random places about the surface had between one phase and the next."""

    step_n: float
    """Largest change of force over 0.1 mm."""
    late_n: float | None
    """Largest change over 1 ms; None where the heartbeat's duration is unknown."""
    stiffness_n_per_m: float
    """Largest change of the force's size along its own line."""
    gradient_longest: float
    holding_n_per_m: Float
    """Stiffness of every place in the direction in which it is largest."""


class _ForceSteps:
    """Largest steps of one fixture's force, gathered phase by phase in their order."""

    def __init__(
        self,
        volume: ForceField,
        name: str,
        surfaces: Mapping[str, BeatingSurface],
        nodes_mm: Float,
    ) -> None:
        self._volume = volume
        self._nodes_mm = nodes_mm
        self._name = name
        self._fixture = volume.fixtures[name]
        self._surface = surfaces[self._fixture.structure]
        self._near_mm = 2 * self._fixture.resolved_delta_mm
        self._first_n: Float | None = None
        self._before_n: Float | None = None
        self._steps_n = np.zeros((2, 3))
        self._changes_n: list[float] = []
        self._sampled: list[_Sampled] = []

    def add(self, index: int) -> None:
        """Measure phase ``index``, and the change to it from the phase before."""
        from pipeline.field.steps import largest_change, largest_steps

        force_n = self._forces(index)
        steps_n = np.empty((2, 3))
        stored = self._volume.stored_distance_mm(self._fixture.structure, index)
        largest_steps(force_n, stored, self._near_mm, steps_n)
        self._steps_n = np.maximum(self._steps_n, steps_n)
        if self._before_n is not None:
            self._changes_n.append(float(largest_change(self._before_n, force_n)))
        self._first_n = force_n if self._first_n is None else self._first_n
        self._before_n = force_n
        self._sampled.append(self._sample(index))

    def _forces(self, index: int) -> Float:
        force_n = self._volume.force_n(self._nodes_mm, self._volume.phases[index], self._name)
        return force_n.reshape(*self._volume.grid.shape, 3)

    def _sample(self, index: int) -> _Sampled:
        """Changes of force over 0.1 mm and over 1 ms, between this phase and the next."""
        rng = np.random.default_rng(index)
        volume, name = self._volume, self._name
        surface = self._surface.at(index)
        points_mm = points_about(surface, rng, FORCE_SAMPLES, self._near_mm + BAND_MM)
        phases = volume.phases
        length = (phases[(index + 1) % len(phases)] - phases[index]) % 1 or 1.0
        moments = phases[index] + length * rng.uniform(size=len(points_mm))
        here_n = volume.force_n(points_mm, moments, name)
        ways = rng.normal(size=points_mm.shape)
        ways *= STEP_MM / np.linalg.norm(ways, axis=1, keepdims=True)
        step_n = np.linalg.norm(volume.force_n(points_mm + ways, moments, name) - here_n, axis=1)
        late = None
        if volume.rr_s is not None:
            after_n = volume.force_n(points_mm, moments + STEP_MS / 1000 / volume.rr_s, name)
            late = float(np.linalg.norm(after_n - here_n, axis=1).max())
        stiffness, longest = self._along(points_mm, moments, here_n)
        holding = field_rates_n_per_m(volume, points_mm, moments, name)[:, -1]
        return _Sampled(float(step_n.max()), late, stiffness, longest, holding)

    def _along(self, points_mm: Float, moments: Float, here_n: Float) -> tuple[float, float]:
        """Largest change of the force's size along its own line, N/m, off the medial axis, and the
        longest gradient there, which is what it may exceed the law by.

        Its direction turns too, fastest about the medial axis; that is the rate's part.
        """
        structure = self._fixture.structure
        gradient = self._volume.gradient(points_mm, moments, structure)
        length = np.linalg.norm(gradient, axis=1)
        ahead_mm = points_mm + STEP_MM * gradient / np.maximum(length, 1e-9)[:, None]
        there = np.linalg.norm(self._volume.gradient(ahead_mm, moments, structure), axis=1)
        clear = np.minimum(length, there) >= CLEAR_GRADIENT
        ahead_n = np.linalg.norm(self._volume.force_n(ahead_mm, moments, self._name), axis=1)
        change_n = np.abs(ahead_n - np.linalg.norm(here_n, axis=1))[clear]
        longest = float(np.maximum(length, there)[clear].max(initial=0.0))
        return 1000 * float(change_n.max(initial=0.0)) / STEP_MM, longest

    def result(self, longest: float, turning_per_mm: float) -> dict[str, Any]:
        """The largest steps over space and, the cycle closed, over time; what limits the gradient
        is that of `spline_limits`."""
        from pipeline.field.steps import largest_change

        changes_n = [*self._changes_n, float(largest_change(self._before_n, self._first_n))]
        spacing_mm = np.array(self._volume.grid.spacing_mm)
        bound_n_per_mm = rate_bound_n_per_mm(self._fixture, longest, turning_per_mm)
        found = self._sampled
        steps, slopes = [one.step_n for one in found], [one.stiffness_n_per_m for one in found]
        lates = [one.late_n for one in found]
        change_n = None if None in lates else [one for one in lates if one is not None]
        return {
            "force_step_max_n": float(self._steps_n[0].max()),
            "force_step_max_n_per_mm": float((self._steps_n[0] / spacing_mm).max()),
            "force_step_near_surface_n_per_mm": float((self._steps_n[1] / spacing_mm).max()),
            "force_change_max_n": max(changes_n),
            "force_change_max_n_per_ms": None if change_n is None else max(change_n) / STEP_MS,
            "force_step_max_n_per_0_1_mm": max(steps),
            "force_rate_max_n_per_mm": max(steps) / STEP_MM,
            "force_rate_bound_n_per_mm": bound_n_per_mm,
            "stiffness_measured_n_per_m": max(slopes),
            "stiffness_n_per_m": self._fixture.stiffness_n_per_m,
            **self._holding(),
            "force_step_max_n_per_0_1_mm_by_phase": steps,
            "force_change_max_n_per_ms_by_phase": change_n,
            "stiffness_measured_n_per_m_by_phase": slopes,
        }

    def _holding(self) -> dict[str, Any]:
        """The stiffness that holds a tool, in whichever direction it is largest, at all places."""
        limit = self._fixture.device.stiffness_n_per_m
        holding = np.concatenate([one.holding_n_per_m for one in self._sampled])
        return {
            "stiffness_limit_n_per_m": limit,
            "gradient_longest": max(one.gradient_longest for one in self._sampled),
            "stiffness_any_direction_p99_n_per_m": float(np.percentile(holding, 99)),
            "stiffness_any_direction_max_n_per_m": float(holding.max()),
            "beyond_limit_share": None if limit is None else float((holding > limit).mean()),
        }
