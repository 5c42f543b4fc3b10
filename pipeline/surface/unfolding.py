"""Parts of a carried mesh that folded up, opened again after the shape that it had at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Surface
from pipeline.surface.correspondence import Smoother, make_smoother
from pipeline.surface.mesh import Faults, laplacian

# Lengths of smoothing in edges: of where to act, and of the displacement, one after the other.
SPREAD_EDGES = 2.0
REACH_EDGES = (2.0, 4.0, 8.0, 16.0)
# The smoothed place of faults, times this, is the share of the smooth displacement, one at most.
GAIN = 3.0


@dataclass(frozen=True, slots=True)
class Unfolder:
    """Mends one mesh in any phase; its smoothers are made once."""

    rest: Surface
    """The mesh where it is sound."""

    spread: Smoother
    """Low pass on the place of faults."""

    smoothers: tuple[Smoother, ...]
    """Low passes on ``(n, 3)`` displacements from rest, fine to coarse."""

    def mended(self, vertices_mm: Float, faults: Faults) -> Float:
        """Vertices ``(n, 3)`` without faults, as far as it goes; the very same if there are none.

        Where labels lose a part of a body, as the tip of an auricle that empties, its triangles are
        pressed together. There the displacement from rest is replaced by a smooth one, ever
        smoother as long as faults are left, which leaves the part its shape; elsewhere vertices
        stay.

        Parameters
        ----------
        vertices_mm
            ``(n, 3)`` positions.
        faults
            Which triangles ``(m,)`` are wrong, from vertices and triangles.
        """
        for smooth in self.smoothers:
            wrong = faults(vertices_mm, self.rest.triangles)
            if not wrong.any():
                break
            place = np.zeros_like(vertices_mm)
            place[self.rest.triangles[wrong]] = 1
            share = np.clip(GAIN * self.spread(place), 0, 1)
            way = vertices_mm - self.rest.vertices_mm
            vertices_mm = vertices_mm + share * (smooth(way) - way)
        return vertices_mm


def make_unfolder(rest: Surface) -> Unfolder:
    """Smoothers on a mesh at rest."""
    stiffness = laplacian(rest.triangles, len(rest.vertices_mm))
    smoothers = tuple(make_smoother(stiffness, reach) for reach in REACH_EDGES)
    return Unfolder(rest, make_smoother(stiffness, SPREAD_EDGES), smoothers)
