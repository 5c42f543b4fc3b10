"""How truly the vertices of a moving surface follow the material: displacement against truth.

Pure functions; lengths in mm, frame LPS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Integer, MovingSurface, Surface
from pipeline.surface.mesh import vertex_areas, vertex_normals


@dataclass(frozen=True, slots=True)
class MotionError:
    """Mean error of displacement since the reference phase, mm, one value a phase."""

    normal_mm: Float
    """``(phase,)`` size of the part across the true surface: the wall's motion."""

    tangential_mm: Float
    """``(phase,)`` size of the part along it: sliding, which the shape does not show."""

    reference: int
    """Number of the phase from which displacements count; both errors are 0 there."""

    def mean_mm(self) -> tuple[float, float]:
        """Normal and tangential error over all phases but the reference."""
        others = np.arange(len(self.normal_mm)) != self.reference
        return float(self.normal_mm[others].mean()), float(self.tangential_mm[others].mean())


def motion_error(found: MovingSurface, truth: MovingSurface, reference: int = 0) -> MotionError:
    """Error of the vertices' displacement against that of the material they started on.

    Each vertex is assigned the nearest point of the true surface at the reference phase, and that
    point travels with the true mesh. What is compared are displacements, so a surface that lies
    beside the truth but moves as it does has no error. The error is resolved along the true
    normal at the later phase. Means weigh each vertex by its area at the reference phase.

    Parameters
    ----------
    found, truth
        Surfaces at the same phases, at least two; their meshes may differ. Vertex i of the truth
        is one material point.
    reference
        Number of the phase from which displacements count.

    Raises
    ------
    InputError
        When the two have different numbers of phases, or fewer than two.
    """
    if len(found.phases) != len(truth.phases) or len(truth.phases) < 2:
        raise InputError(
            "surfaces whose motion is compared need the same two phases or more, got "
            f"{len(found.phases)} and {len(truth.phases)}"
        )
    corners, shares = material_points(found.vertices_mm[reference], truth.at(reference))
    area = vertex_areas(found.vertices_mm[reference], found.triangles)
    start = _carried(truth.vertices_mm[reference], corners, shares)
    across, along = np.zeros((2, len(found.phases)))
    for number in range(len(found.phases)):
        true_mm = _carried(truth.vertices_mm[number], corners, shares) - start
        wrong = found.vertices_mm[number] - found.vertices_mm[reference] - true_mm
        normal = _normals(truth.at(number), corners, shares)
        height = np.einsum("ij,ij->i", wrong, normal)
        across[number] = np.average(np.abs(height), weights=area)
        slid = np.linalg.norm(wrong - height[:, None] * normal, axis=1)
        along[number] = np.average(slid, weights=area)
    return MotionError(across, along, reference)


def material_points(points_mm: Float, surface: Surface) -> tuple[Integer, Float]:
    """Nearest points of a surface as shares of their triangles' corners.

    Returns
    -------
    tuple
        ``(n, 3)`` vertex numbers, and ``(n, 3)`` shares that add up to 1: material coordinates,
        which hold in every phase of a mesh whose vertices correspond.
    """
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(surface.vertices_mm, surface.triangles)
    cells, nearest = mesh.find_closest_cell(points_mm, return_closest_point=True)
    corners = surface.triangles[np.asarray(cells)]
    return corners, _shares(np.asarray(nearest), surface.vertices_mm[corners])


def _shares(points_mm: Float, corners_mm: Float) -> Float:
    """Barycentric coordinates ``(n, 3)`` of points in their triangles ``(n, 3, 3)``, in [0, 1]."""
    opposite = np.roll(corners_mm, -1, axis=1), np.roll(corners_mm, -2, axis=1)
    part = np.cross(opposite[0] - points_mm[:, None], opposite[1] - points_mm[:, None])
    whole = part.sum(axis=1, keepdims=True)
    share = np.maximum(np.einsum("nck,nok->nc", part, whole), 0)
    total = share.sum(axis=1, keepdims=True)
    # A triangle without area has no coordinates; its corners then share the point alike.
    return np.asarray(np.where(total > 0, share / np.where(total > 0, total, 1), 1 / 3))


def _carried(values: Float, corners: Integer, shares: Float) -> Float:
    return np.asarray(np.einsum("nc,nck->nk", shares, values[corners]))


def _normals(surface: Surface, corners: Integer, shares: Float) -> Float:
    """Unit normals ``(n, 3)`` at material points, between the area-weighted ones of vertices."""
    at_vertex = vertex_normals(surface.vertices_mm, surface.triangles)
    here = _carried(at_vertex, corners, shares)
    return np.asarray(here / np.maximum(np.linalg.norm(here, axis=1, keepdims=True), 1e-12))
