"""The accuracy certificate of a baked field: measured on the finished values, none assumed.

Distances are checked against VTK, which shares no code with the baking; forces are compared
between neighbouring nodes and between phases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np

from pipeline.field.distance import processors
from pipeline.field.reader import ForceField
from pipeline.geometry import Float, Surface

BAND_MM = 15.0
"""How far from the surface the interpolated distance is checked."""

SIGN_TOLERANCE_MM = 0.1
"""A sign counts as wrong where the exact distance is larger than this."""


class BeatingSurface(Protocol):
    """Anything that gives a closed surface for every stored phase."""

    @property
    def phases(self) -> Float:
        """``(phase,)`` in [0, 1), rising."""

    def at(self, index: int) -> Surface:
        """The surface at stored phase number ``index``."""


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
    forces = {name: _ForceSteps(volume, name) for name in volume.fixtures}
    with ThreadPoolExecutor(processors()) as pool:
        for index in range(len(volume.phases)):
            steps = [pool.submit(one.add, index) for one in forces.values()]
            for name, found in distances.items():
                found.append(_distance_errors(volume, name, index, surfaces[name], samples))
            for step in steps:
                step.result()
            progress()
    structures = {name: _over_phases(found) for name, found in distances.items()}
    fixtures = {name: one.result() for name, one in forces.items()}
    return {
        **_over_structures(distances),
        **_over_fixtures(fixtures),
        "samples_per_phase": samples,
        "band_mm": BAND_MM,
        "sign_tolerance_mm": SIGN_TOLERANCE_MM,
        "structures": structures,
        "fixtures": fixtures,
    }


def points_about(surface: Surface, rng: np.random.Generator, count: int, band_mm: float) -> Float:
    """Random points at most ``band_mm`` from a surface: ``(count, 3)``, uniform over its area."""
    corners = surface.vertices_mm[surface.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    chosen = corners[rng.choice(len(area), size=count, p=area / area.sum())]
    weights = rng.dirichlet(np.ones(3), size=count)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away_mm = rng.uniform(0, band_mm, size=(count, 1))
    points: Float = np.einsum("nk,nkd->nd", weights, chosen) + away_mm * direction
    return points


def vtk_distance(surface: Surface, points_mm: Float) -> Float:
    """Exact signed distance of ``(n, 3)`` points by VTK, negative inside, mm."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkDoubleArray, vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

    places, cells = vtkPoints(), vtkCellArray()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(surface.vertices_mm), deep=1))
    offsets = np.arange(0, 3 * len(surface.triangles) + 1, 3)
    connectivity = np.ascontiguousarray(surface.triangles.ravel())
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=1), numpy_to_vtkIdTypeArray(connectivity, deep=1)
    )
    mesh = vtkPolyData()
    mesh.SetPoints(places)
    mesh.SetPolys(cells)
    implicit = vtkImplicitPolyDataDistance()
    implicit.SetInput(mesh)
    found = vtkDoubleArray()
    implicit.EvaluateFunction(numpy_to_vtk(np.ascontiguousarray(points_mm), deep=1), found)
    distance: Float = vtk_to_numpy(found).copy()
    return distance


def _distance_errors(
    volume: ForceField, structure: str, index: int, moving: BeatingSurface, samples: int
) -> dict[str, Any]:
    """Errors of one phase, at points about the surface and at nodes anywhere."""
    rng = np.random.default_rng(index)
    surface = moving.at(index)
    points_mm = points_about(surface, rng, samples, BAND_MM)
    points_mm = points_mm[volume.contains(points_mm)]
    stored = volume.stored_distance_mm(structure, index)
    nodes = np.unravel_index(rng.integers(stored.size, size=samples // 2), stored.shape)
    grid = volume.grid
    nodes_mm = grid.origin_mm + np.column_stack(nodes[::-1]) * np.array(grid.spacing_mm)
    exact_mm = vtk_distance(surface, np.concatenate([points_mm, nodes_mm]))
    between_mm = volume.distance_mm(points_mm, volume.phases[index], structure)
    found_mm = np.concatenate([between_mm, stored[nodes]])
    error_mm = np.abs(found_mm - exact_mm)
    wrong = np.signbit(found_mm) != np.signbit(exact_mm)
    return {
        "between": error_mm[: len(points_mm)],
        "nodes": float(error_mm[len(points_mm) :].max()),
        "signs": int((wrong & (np.abs(exact_mm) > SIGN_TOLERANCE_MM)).sum()),
    }


def _over_phases(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    every = np.concatenate([one["between"] for one in found])
    return {
        "distance_error_max_mm": float(every.max()),
        "distance_error_p99_mm": float(np.percentile(every, 99)),
        "distance_error_max_mm_by_phase": [float(one["between"].max()) for one in found],
        "node_error_max_mm": max(one["nodes"] for one in found),
        "sign_errors": sum(one["signs"] for one in found),
    }


def _over_structures(distances: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    whole = _over_phases([one for found in distances.values() for one in found])
    del whole["distance_error_max_mm_by_phase"]
    return whole


def _over_fixtures(fixtures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The largest of every figure; unknown (None) where any fixture's is."""
    names = next(iter(fixtures.values()))
    columns = {name: [one[name] for one in fixtures.values()] for name in names}
    return {name: None if None in values else max(values) for name, values in columns.items()}


class _ForceSteps:
    """Largest steps of one fixture's force, gathered phase by phase in their order."""

    def __init__(self, volume: ForceField, name: str) -> None:
        self._volume = volume
        self._name = name
        self._fixture = fixture = volume.fixtures[name]
        self._near_mm = 2 * fixture.resolved_delta_mm
        self._first_n: Float | None = None
        self._before_n: Float | None = None
        self._steps_n = np.zeros((2, 3))
        self._changes_n: list[float] = []

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

    def _forces(self, index: int) -> Float:
        grid = self._volume.grid
        nodes_mm = grid.nodes_mm().reshape(-1, 3)
        phase = self._volume.phases[index]
        return self._volume.force_n(nodes_mm, phase, self._name).reshape(*grid.shape, 3)

    def result(self) -> dict[str, Any]:
        """The largest steps over space and, the cycle closed, over time."""
        from pipeline.field.steps import largest_change

        changes_n = [*self._changes_n, float(largest_change(self._before_n, self._first_n))]
        phases, rr_s = self._volume.phases, self._volume.rr_s
        gaps = np.diff(phases, append=phases[0] + 1)
        rate = None if rr_s is None else float(max(changes_n / (gaps * rr_s * 1000)))
        spacing_mm = np.array(self._volume.grid.spacing_mm)
        return {
            "force_step_max_n": float(self._steps_n[0].max()),
            "force_step_max_n_per_mm": float((self._steps_n[0] / spacing_mm).max()),
            "force_step_near_surface_n_per_mm": float((self._steps_n[1] / spacing_mm).max()),
            "force_change_max_n": max(changes_n),
            "force_change_max_n_per_ms": rate,
        }
