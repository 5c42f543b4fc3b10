"""The heart coloured by how far the registration may be off at each place."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from pipeline.geometry import Float, Integer, MovingSurface, area_vectors
from pipeline.report.animation import TOWARDS_VIEWER, axes_of_view
from pipeline.report.colours import SOLID_COLOURS

# Light from the viewer; what turns away keeps this much of it, so that colours can be read.
_LEAST_LIGHT = 0.7
_VIEWS = (("from the front left", 1.0), ("from behind on the right", -1.0))

# The scale reaches from 0 to this or beyond, so that a small error does not look like a large one.
LEAST_TOP_MM = 2.0

ErrorAt = Callable[[Float], Float]
"""``(n,)`` mm to be expected at ``(n, 3)`` points, LPS mm."""


def expected_error(surfaces: Mapping[str, MovingSurface], error_mm: ErrorAt) -> Figure:
    """The heart's outer surfaces in the first phase from two sides, coloured by ``error_mm``."""
    corners = np.concatenate(
        [
            surfaces[name].at(0).vertices_mm[surfaces[name].triangles]
            for name in SOLID_COLOURS
            if name in surfaces
        ]
    )
    value = error_mm(corners.mean(axis=1))
    figure = Figure(figsize=(8, 4), layout="constrained")
    for axis, (title, sign) in zip(figure.subplots(1, 2), _VIEWS, strict=True):
        facing, shape, light = seen_from(corners, sign * TOWARDS_VIEWER)
        painted = PolyCollection(list(shape), cmap="viridis", linewidths=0.3)
        painted.set_clim(0, max(float(value.max()), LEAST_TOP_MM))
        colours = painted.to_rgba(value[facing])
        colours[:, :3] *= light[:, None]
        painted.set(facecolors=colours, edgecolors=colours)
        axis.add_collection(painted)
        axis.autoscale_view()
        axis.set_aspect("equal")
        axis.set_axis_off()
        axis.set_title(title, fontsize=9)
    figure.colorbar(painted, ax=figure.axes, label="expected error (mm)", shrink=0.8)
    return figure


def seen_from(corners_mm: Float, towards_viewer: Float) -> tuple[Integer, Float, Float]:
    """The triangles that face a far viewer, the farthest first.

    Parameters
    ----------
    corners_mm
        ``(n, 3, 3)`` corners of outward triangles.
    towards_viewer
        ``(3,)`` direction, of any length.

    Returns
    -------
    Their numbers ``(k,)``, corners ``(k, 3, 2)`` to the right and up in mm, and light ``(k,)``, 1
    where a triangle faces the viewer squarely.
    """
    right, up, towards = axes_of_view(towards_viewer)
    normal = area_vectors(corners_mm)
    length = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    squareness = normal @ towards / length
    facing = np.flatnonzero(squareness > 0)
    depth = corners_mm[facing].mean(axis=1) @ towards
    facing = facing[np.argsort(depth, kind="stable")]
    light = _LEAST_LIGHT + (1 - _LEAST_LIGHT) * squareness[facing]
    return facing, corners_mm[facing] @ np.stack([right, up], axis=1), light
