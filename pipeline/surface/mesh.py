"""Triangle meshes of level sets: closed, outward, even; and the operators defined on them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from skimage.measure import marching_cubes

from pipeline.errors import StageError
from pipeline.geometry import Float, Integer, Mask, Surface
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.kernels import corner_normals, faulty
from pipeline.surface.level_set import LevelSet

# Marching cubes with step h leaves 3/2 vertices per h^2 of surface (the mean of |nx|+|ny|+|nz|
# over all directions); equilateral triangles with that density have edges of 0.877 h.
EDGE_PER_STEP = (2 / np.sqrt(3) / 1.5) ** 0.5
RELAXATIONS = 30
UNTANGLINGS = 40
# Rounds after which one more ring of vertices takes part.
WIDENING_ROUNDS = 4
SLIVER_QUALITY = 0.3


Faults = Callable[[Float, Integer], Mask]
"""Which triangles ``(m,)`` are wrong, from vertices and triangles."""


def extract_surface(level: LevelSet, edge_mm: float) -> Surface:
    """Closed surface of even triangles on the zero level of a signed distance.

    Marching cubes (Lewiner et al. 2003) on a grid whose step suits the edge, largest component
    only, then tangential relaxation with the vertices kept on the zero level: unlike plain
    smoothing it neither shrinks the body nor rounds it.

    Raises
    ------
    StageError
        When the level set has no zero level, or its surface is not closed.
    """
    surface = largest_component(_march(level, edge_mm))
    if len(surface.boundary_edges()):
        raise StageError(
            f"marching cubes left {len(surface.boundary_edges())} open edges on a surface of "
            f"{len(surface.triangles)} triangles; a structure must not reach the grid's border"
        )
    return _relaxed(surface, level)


def marched_nodes(level: LevelSet, edge_mm: float) -> tuple[Float, float]:
    """What marching cubes reads for triangles with edges of ``edge_mm``.

    Returns
    -------
    distance_mm
        ``(z, y, x)`` at nodes of a grid of its own.
    step_mm
        Of that grid; its first node is the level set's first voxel.
    """
    step_mm = float(edge_mm / EDGE_PER_STEP)
    extent_mm = (np.array(level.distance_mm.shape) - 1) * level.spacing_mm
    counts = np.maximum(np.ceil(extent_mm / step_mm).astype(int) + 1, 2)
    index = np.indices(tuple(counts)) * (step_mm / level.spacing_mm)
    field = ndimage.map_coordinates(level.distance_mm, index, order=1, mode="nearest")
    return np.asarray(field), step_mm


def _march(level: LevelSet, edge_mm: float) -> Surface:
    """Marching cubes on a grid whose step suits the edge, vertices in millimetres."""
    field, step_mm = marched_nodes(level, edge_mm)
    # A node exactly on the level would give several vertices in one place.
    field = np.where(np.abs(field) < 1e-3 * step_mm, 1e-3 * step_mm, field)
    if not (field.min() < 0 < field.max()):
        raise StageError("a structure is too small for a surface: its smooth distance has no zero")
    vertices, triangles, _, _ = marching_cubes(field, 0.0, spacing=(step_mm,) * 3)
    # Axes in the reverse order turn every triangle round.
    outward = np.ascontiguousarray(triangles[:, ::-1], dtype=np.int64)
    return Surface(vertices[:, ::-1].astype(np.float64), outward)


def largest_component(surface: Surface) -> Surface:
    """The connected part with most vertices, renumbered."""
    _, part = csgraph.connected_components(adjacency(surface.triangles, len(surface.vertices_mm)))
    chosen = part == np.bincount(part).argmax()
    number = np.cumsum(chosen) - 1
    triangles = number[surface.triangles[chosen[surface.triangles[:, 0]]]]
    return Surface(surface.vertices_mm[chosen], triangles)


def adjacency(triangles: Integer, count: int) -> sparse.csr_array:
    """Symmetric ``(n, n)`` matrix with a one for each pair of vertices that share an edge."""
    rows = triangles[:, [0, 1, 2]].ravel()
    columns = triangles[:, [1, 2, 0]].ravel()
    both = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    matrix = sparse.csr_array((np.ones(len(both[0])), both), shape=(count, count))
    matrix.data[:] = 1.0
    return matrix


def laplacian(triangles: Integer, count: int) -> sparse.csr_array:
    """Graph Laplacian over its mean degree of six: about ``edge^2 / 4`` times minus Laplace's."""
    neighbours = adjacency(triangles, count)
    degree = sparse.diags_array(neighbours.sum(axis=1))
    return sparse.csr_array((degree - neighbours) / 6.0)


def vertex_normals(vertices_mm: Float, triangles: Integer) -> Float:
    """Unit normals ``(n, 3)``: the area-weighted mean over the triangles of a vertex."""
    normals, _ = corner_normals(vertices_mm, triangles)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, np.finfo(float).tiny))


def vertex_areas(vertices_mm: Float, triangles: Integer) -> Float:
    """Third of the area ``(n,)`` of the triangles round each vertex, mm^2."""
    return np.asarray(corner_normals(vertices_mm, triangles)[1] / 6)


def untangled(vertices_mm: Float, triangles: Integer, level: LevelSet) -> Float:
    """Vertices ``(n, 3)`` whose triangles are neither slivers nor folded over, as far as it goes.

    Only vertices of bad triangles and their neighbours move, and as long as that does not help
    those round them too: towards the mean of their own neighbours, and back onto the zero level.
    Where the level itself is too sharp for the mesh that folds them again, so the later rounds let
    the surface be round instead.
    """
    return _mended(vertices_mm, triangles, level, bad_triangles)


def uncrossed(vertices_mm: Float, triangles: Integer, level: LevelSet) -> Float:
    """Vertices ``(n, 3)`` of a mesh that no longer passes through itself, as far as it goes.

    The zero level of a distance never crosses itself; where the mesh does, it is drawn back to it
    as in ``untangled``. A mesh that does not cross itself is returned as it is.
    """
    return _mended(vertices_mm, triangles, level, crossing_triangles)


def _mended(
    vertices_mm: Float,
    triangles: Integer,
    level: LevelSet,
    faults: Faults,
) -> Float:
    """Even out the surroundings of faulty triangles ``(m,)`` until there are none."""
    wrong = faults(vertices_mm, triangles)
    if not wrong.any():
        return vertices_mm
    neighbours = adjacency(triangles, len(vertices_mm))
    degree = neighbours.sum(axis=1)[:, None]
    for done in range(UNTANGLINGS):
        touched = np.zeros(len(vertices_mm), dtype=bool)
        touched[triangles[wrong]] = True
        for _ in range(1 + done // WIDENING_ROUNDS):
            touched |= neighbours @ touched.astype(float) > 0
        moved = np.flatnonzero(touched)
        places = vertices_mm[moved]
        places += 0.5 * (neighbours[moved] @ vertices_mm / degree[moved] - places)
        if done < UNTANGLINGS / 2:
            places += level.newton_step(places, level.spacing_mm)
        vertices_mm = vertices_mm.copy()
        vertices_mm[moved] = places
        wrong = faults(vertices_mm, triangles)
        if not wrong.any():
            break
    return vertices_mm


def bad_triangles(vertices_mm: Float, triangles: Integer) -> Mask:
    """Which triangles ``(m,)`` are slivers or look away from the surface round them."""
    return np.asarray(faulty(vertices_mm, triangles, SLIVER_QUALITY))


def _relaxed(surface: Surface, level: LevelSet) -> Surface:
    """Slide vertices towards the mean of their neighbours, back on the zero level each time."""
    vertices, triangles = surface.vertices_mm, surface.triangles
    neighbours = adjacency(triangles, len(vertices))
    degree = neighbours.sum(axis=1)[:, None]
    for _ in range(RELAXATIONS):
        pull = 0.5 * (neighbours @ vertices / degree - vertices)
        normals = vertex_normals(vertices, triangles)
        vertices = vertices + pull - np.einsum("ij,ij->i", pull, normals)[:, None] * normals
        vertices = vertices + level.newton_step(vertices, level.spacing_mm)
    return Surface(vertices, triangles)
