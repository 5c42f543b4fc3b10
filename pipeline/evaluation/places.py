"""Places about a baked surface, found by asking the field alone."""

from __future__ import annotations

import numpy as np

from pipeline.errors import InputError
from pipeline.field.reader import ForceField
from pipeline.geometry import Float

STEPS = 60
CLOSE_MM = 1e-6
STRAIGHT = 0.97
FREE_MM = 10.0
CONE_DEG = 35.0
ROUNDS = 20
TRIED = 5000


def settle(
    field: ForceField,
    structure: str,
    points_mm: Float,
    phase: float | Float,
    height_mm: float = 0.0,
) -> Float:
    """Move points along the gradient until the distance there is ``height_mm``.

    Newton's steps ``(height - d) g / |g|^2``, of no more than 2 mm times ``|g|`` each; points near
    a medial axis may not arrive.

    Parameters
    ----------
    points_mm
        ``(n, 3)``, LPS mm.
    phase
        One number or ``(n,)``.

    Returns
    -------
    ``(n, 3)``.
    """
    points = np.array(points_mm, dtype=float)
    for _ in range(STEPS):
        lacking = height_mm - field.distance_mm(points, phase, structure)
        if np.abs(lacking).max() < CLOSE_MM:
            break
        slope = field.gradient(points, phase, structure)
        size2 = np.maximum((slope**2).sum(axis=1), 0.25)
        step = np.clip(lacking / size2, -2.0, 2.0)
        points += step[:, None] * slope
    return points


def on_surface(
    field: ForceField, structure: str, count: int, seed: int, towards: Float | None = None
) -> tuple[Float, Float]:
    """Places of a baked surface, at the R peak, from which one can leave it in a straight line.

    Parameters
    ----------
    count
        How many.
    towards
        ``(3,)`` direction that the surface must face there within 35 degrees; any when None.

    Returns
    -------
    Places ``(count, 3)`` mm and directions outwards ``(count, 3)``.

    Raises
    ------
    InputError
        When the surface has too few such places.
    """
    rng = np.random.default_rng(seed)
    feet, ways = np.empty((0, 3)), np.empty((0, 3))
    for _ in range(ROUNDS):
        foot, way = _free_places(field, structure, rng)
        if towards is not None:
            facing = way @ (towards / np.linalg.norm(towards)) > np.cos(np.radians(CONE_DEG))
            foot, way = foot[facing], way[facing]
        feet, ways = np.concatenate([feet, foot]), np.concatenate([ways, way])
        if len(feet) >= count:
            return feet[:count], ways[:count]
    raise InputError(
        f"{structure}: only {len(feet)} of {count} places were found where the baked surface "
        "is free to its outside; give a field of a closed surface with 15 mm around it"
    )


def _free_places(
    field: ForceField, structure: str, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Random places on the surface, with 10 mm of straight way out, and their directions out."""
    points = rng.uniform(np.array(field.grid.origin_mm), field.grid.upper_mm, size=(TRIED, 3))
    near = np.abs(field.distance_mm(points, 0.0, structure)) < 12
    points = settle(field, structure, points[near], 0.0)
    good = np.abs(field.distance_mm(points, 0.0, structure)) < 1e-4
    out = field.gradient(points, 0.0, structure)
    size = np.linalg.norm(out, axis=1)
    good &= np.abs(size - 1) < 1 - STRAIGHT
    out /= np.maximum(size, 0.5)[:, None]
    # A line that leaves straight is 10 mm away after 10 mm, and still inside the grid.
    ahead = points + FREE_MM * out
    good &= field.contains(ahead)
    good &= np.abs(field.distance_mm(ahead, 0.0, structure) - FREE_MM) < 0.05 * FREE_MM
    return points[good], out[good]
