"""Where the vertices of a moving surface are between the phases that were imaged."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from pipeline.geometry import Float, MovingSurface

# Degrees of the spline in time, by how many phases each needs.
DEGREES = ((6, 5), (4, 3), (2, 1))


def positions_at(moving: MovingSurface, phases: Float) -> Float:
    """Positions ``(k, n, 3)`` in mm of all vertices at any phases ``(k,)``, cyclic.

    A periodic spline in time through the places at the stored phases: of the fifth degree where
    there are six phases or more, of lower degree where there are fewer. It passes through what is
    stored, and velocity and acceleration have no step, not at the end of the beat either.

    Parameters
    ----------
    moving
        Corresponding vertices at phases that rise within [0, 1).
    phases
        Any numbers; whole beats do not matter.
    """
    count = len(moving.phases)
    degree = next((degree for needed, degree in DEGREES if count >= needed), 0)
    if degree == 0:
        return np.repeat(moving.vertices_mm, len(phases), axis=0)
    knots = np.append(moving.phases, moving.phases[0] + 1)
    places = np.concatenate([moving.vertices_mm, moving.vertices_mm[:1]])
    spline = make_interp_spline(knots, places, k=degree, bc_type="periodic", axis=0)
    start = moving.phases[0]
    return np.asarray(spline((np.asarray(phases) - start) % 1.0 + start))
