"""Exact distances by VTK, to measure surfaces and baked fields by; baking uses none of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry import Float, Surface, area_vectors


class ExactSurface:
    """A closed surface that answers one point after another, exactly and slowly."""

    def __init__(self, surface: Surface) -> None:
        import pyvista
        from vtkmodules.vtkFiltersCore import vtkImplicitPolyDataDistance

        self._implicit: Any = vtkImplicitPolyDataDistance()
        mesh = pyvista.PolyData.from_regular_faces(
            surface.vertices_mm, surface.triangles, deep=True
        )
        self._implicit.SetInput(mesh)

    def distance_mm(self, points_mm: Float) -> Float:
        """Signed distance of ``(n, 3)`` points, negative inside, mm."""
        from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkDoubleArray

        found = vtkDoubleArray()
        self._implicit.EvaluateFunction(
            numpy_to_vtk(np.ascontiguousarray(points_mm, dtype=float), deep=1), found
        )
        return np.asarray(vtk_to_numpy(found).copy())

    def nearest(self, points_mm: Float) -> tuple[Float, Float]:
        """Signed distances of ``(n, 3)`` points, and the nearest points of the surface."""
        nearest_mm = np.empty((len(points_mm), 3))
        distance_mm = np.empty(len(points_mm))
        place = [0.0, 0.0, 0.0]
        for number, point in enumerate(points_mm):
            distance_mm[number] = self._implicit.EvaluateFunctionAndGetClosestPoint(point, place)
            nearest_mm[number] = place
        return distance_mm, nearest_mm


def points_about(surface: Surface, rng: np.random.Generator, count: int, band_mm: float) -> Float:
    """Random points at most ``band_mm`` from a surface: ``(count, 3)``, uniform over its area."""
    corners = surface.vertices_mm[surface.triangles]
    area = np.linalg.norm(area_vectors(corners), axis=1)
    chosen = corners[rng.choice(len(area), size=count, p=area / area.sum())]
    weights = rng.dirichlet(np.ones(3), size=count)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away_mm = rng.uniform(0, band_mm, size=(count, 1))
    points: Float = np.einsum("nk,nkd->nd", weights, chosen) + away_mm * direction
    return points
