"""Exact signed distance from closed surfaces to grid nodes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import product

import numpy as np

from pipeline.errors import InputError
from pipeline.field.threads import processors
from pipeline.geometry import Float32, Grid, Surface


def require_closed(surface: Surface, where: str) -> None:
    """Raise InputError unless the surface is finite, closed and faces outwards."""
    require_usable_vertices(surface, where)
    require_no_open_edge(surface, where)
    require_outward(surface, where)


def require_no_open_edge(surface: Surface, where: str) -> None:
    """Raise InputError unless every edge belongs to two triangles of opposed direction."""
    edges = len(surface.boundary_edges())
    if edges:
        twins = len(surface.vertices_mm) - len(np.unique(surface.vertices_mm, axis=0))
        merge = f"merge the {twins} vertices that lie where others do, " if twins else ""
        raise InputError(
            f"{where}: is not closed, {edges} edges are not shared by two triangles of opposed "
            f"direction; {merge}close its holes and make its normals agree"
        )


def require_outward(surface: Surface, where: str) -> None:
    """Raise InputError unless a closed surface encloses a positive volume."""
    volume_mm3 = surface.volume_mm3()
    if not volume_mm3 > 0:
        raise InputError(
            f"{where}: faces inwards or encloses nothing (volume {volume_mm3:.6g} mm3); flip its "
            "triangles so that normals point out"
        )


def require_usable_vertices(surface: Surface, where: str) -> None:
    """Raise InputError unless all vertices are numbers and all triangles name existing ones."""
    bad = np.flatnonzero(~np.isfinite(surface.vertices_mm).all(axis=1))
    if len(bad):
        raise InputError(
            f"{where}: {len(bad)} vertices are not finite, the first is number {bad[0]} at "
            f"{surface.vertices_mm[bad[0]]}; every coordinate must be a number in mm"
        )
    count = len(surface.vertices_mm)
    if surface.triangles.min() < 0 or surface.triangles.max() >= count:
        raise InputError(
            f"{where}: triangles name vertices {surface.triangles.min()} to "
            f"{surface.triangles.max()}, there are {count}"
        )


def distance_of_closed(surface: Surface, grid: Grid, threads: int | None = None) -> Float32:
    """Distance in mm from every grid node to the closest triangle, negative inside.

    The magnitude is exact everywhere, near and far: triangles are left out only where others are
    proven to be nearer. Inside is where the surface winds around a node, so sheets that touch or
    overlap need no care. The result does not depend on the number of threads. Memory beyond the
    result is half of it, for the signs, and about 0.25 kB a triangle, for the tree.

    Parameters
    ----------
    surface
        Closed, with outward normals (`require_closed`).
    grid
        Nodes in the same frame.
    threads
        How many to use; as many as there are processors when None.

    Returns
    -------
    ``(z, y, x)`` array, mm.

    Raises
    ------
    StageError
        When a row of nodes enters and leaves the surface unequally often, as one that is not
        closed.
    """
    from pipeline.field.nearest import TOP, block_distance, levels_of_blocks, prepared
    from pipeline.field.triangle_tree import plant
    from pipeline.field.winding import negate_inside

    vertices_mm = np.ascontiguousarray(surface.vertices_mm, dtype=np.float64)
    triangles = np.ascontiguousarray(surface.triangles, dtype=np.int64)
    axes_mm = grid.axes_mm
    threads = threads or processors()
    # Blocks at the end of the grid reach beyond it.
    beyond_mm = grid.upper_mm + TOP * np.array(grid.spacing_mm)
    tree = plant(vertices_mm, triangles, np.array([grid.origin_mm, beyond_mm]), threads)
    levels = levels_of_blocks(tree, grid.spacing_mm)
    distance_mm = np.empty(grid.shape, dtype=np.float32)

    blocks = product(*(range(0, count, TOP) for count in grid.shape))

    def fill(_: int) -> None:
        work = prepared(tree)
        # Threads take turns to ask for the next block.
        for corner in blocks:
            block_distance(tree, work, levels, axes_mm, *corner, distance_mm)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, range(threads)))
    negate_inside(distance_mm, vertices_mm, triangles, axes_mm, threads)
    return distance_mm
