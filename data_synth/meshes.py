"""Closed truth meshes of a heart's bodies at the R peak, and what they enclose."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from data_synth.anatomy import BODY_NAMES, BOX_MM, build_tubes, sample_bodies
from data_synth.kernels import Float, Shape, Tubes

Triangles = npt.NDArray[np.int64]
Mesh = tuple[Float, Triangles]

MESH_SPACING_MM = 1.5
COARSE_MM = 5.0


@lru_cache(maxsize=8)
def tubes_of(shape: Shape) -> Tubes:
    """Vessels and appendage of a heart of this shape."""
    return build_tubes(shape)


def mesh_volume_ml(vertices_mm: Float, triangles: Triangles) -> float:
    """Volume of a closed mesh by the divergence theorem, positive for outward normals."""
    a, b, c = (vertices_mm[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6000)


def enclosed_ml(surfaces: dict[str, Mesh]) -> dict[str, float]:
    """Volume of every mesh, and the left muscle's, from a heart's surfaces."""
    volumes = {name: mesh_volume_ml(*mesh) for name, mesh in surfaces.items()}
    volumes["lv_myocardium"] = volumes["epicardium"] - volumes["lv_endocardium"]
    return volumes


@lru_cache(maxsize=2)
def reference_meshes(shape: Shape) -> dict[str, Mesh]:
    """Meshes of all bodies at the R peak in the heart frame, by marching cubes."""
    axes = _mesh_axes(shape)
    x, y, z = axes
    values = sample_bodies(x, y, z, shape, tubes_of(shape))
    origin = np.array([axis[0] for axis in axes])
    return {
        name: _largest_mesh(value, origin) for name, value in zip(BODY_NAMES, values, strict=True)
    }


def _mesh_axes(shape: Shape) -> list[Float]:
    """Grid lines around all bodies at the R peak, with 10 mm to spare."""
    coarse = [np.arange(low, high, COARSE_MM) for low, high in BOX_MM]
    x, y, z = coarse
    inside = sample_bodies(x, y, z, shape, tubes_of(shape)).min(axis=0) < 0
    axes = []
    for axis, line in enumerate(coarse):
        filled = line[inside.any(axis=tuple({0, 1, 2} - {axis}))]
        axes.append(np.arange(filled[0] - 10, filled[-1] + 10, MESH_SPACING_MM))
    return axes


def _largest_mesh(values: Float, origin: Float) -> Mesh:
    """Largest connected zero surface of a grid; crumbs that cutting leaves are dropped."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from skimage.measure import marching_cubes

    # A node at exactly zero would make triangles without area.
    values = np.where(np.abs(values) < 1e-6, 1e-6, values)
    vertices, faces, _, _ = marching_cubes(
        values, 0.0, spacing=(MESH_SPACING_MM,) * 3, gradient_direction="descent"
    )
    triangles = faces.astype(np.int64)
    ends = triangles[:, [1, 2]].ravel()
    starts = np.repeat(triangles[:, 0], 2)
    graph = coo_array((np.ones(len(starts)), (starts, ends)), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1]
    keep = part == np.bincount(part).argmax()
    number = np.cumsum(keep) - 1
    return vertices[keep].astype(float) + origin, number[triangles[keep[triangles[:, 0]]]]
