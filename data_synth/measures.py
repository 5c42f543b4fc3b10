"""What a reader would measure on a phantom's heart: volumes, ejection, mass, wall."""

from __future__ import annotations

import math

import numpy as np

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.meshes import enclosed_ml, reference_meshes
from data_synth.motion import carry_points
from data_synth.profiles import endocardium_at, epicardium

MUSCLE_G_ML = 1.05
"""Density of heart muscle."""
COARSE_MM = 3.0


def measure_heart(heart: BeatingHeart, spacing_mm: float = COARSE_MM) -> dict[str, float]:
    """Usual measures of a heart, from its own surfaces meshed at ``spacing_mm``.

    Keys: lv_ml, rv_ml (at the R peak), lv_ejection, rv_ejection, lv_stroke_ml, rv_stroke_ml,
    lv_mass_g, la_ml, ra_ml (at end-systole), la_emptying, ra_emptying, lv_wall_mm (mean about the
    middle of the ventricle), lv_wall_largest_mm, lv_wall_smallest_mm, lv_sphericity (width over
    length). Meshes of 3 mm cut up to 2.6 % off the left atrium, 1.6 % off the right
    ventricle, 1.3 % off the right atrium, 0.7 % off the left ventricle.
    """
    full, empty = (_volumes(heart, phase, spacing_mm) for phase in (0.0, heart.pulse.end_systole))
    measures = {"lv_mass_g": full["lv_myocardium"] * MUSCLE_G_ML}
    for name, body in (("lv", "lv_endocardium"), ("rv", "rv_endocardium")):
        stroke = full[body] - empty[body]
        measures |= {f"{name}_ml": full[body], f"{name}_stroke_ml": stroke}
        measures[f"{name}_ejection"] = stroke / full[body]
    for name, body in (("la", "left_atrium"), ("ra", "right_atrium")):
        measures[f"{name}_ml"] = empty[body]
        measures[f"{name}_emptying"] = 1 - full[body] / empty[body]
    walls = wall_thickness_mm(heart)
    middle = walls[len(walls) // 2]
    measures["lv_wall_mm"] = float(middle.mean())
    measures["lv_wall_largest_mm"] = float(walls.max())
    measures["lv_wall_smallest_mm"] = float(walls.min())
    measures["lv_sphericity"] = 2 * heart.shape.lv_radius / heart.shape.lv_length
    return measures


def wall_thickness_mm(heart: BeatingHeart) -> Float:
    """End-diastolic wall, (11 heights, 72 angles), from 0.2 to 0.8 of the cavity's length down.

    Measured at right angles to the long axis, as on short-axis slices; angles run from -pi.
    """
    shape = heart.shape
    rows = []
    for z in -shape.lv_length * np.linspace(0.2, 0.8, 11):
        outside = math.sqrt(epicardium(z, shape)[0])
        angles = np.linspace(-math.pi, math.pi, 72, endpoint=False)
        rows.append([outside - math.sqrt(endocardium_at(z, a, shape)[0]) for a in angles])
    return np.array(rows)


def _volumes(heart: BeatingHeart, phase: float, spacing_mm: float) -> dict[str, float]:
    beat = heart.beat(phase)
    meshes = reference_meshes(heart.shape, spacing_mm)
    return enclosed_ml(
        {
            name: (carry_points(vertices, heart.shape, beat), triangles)
            for name, (vertices, triangles) in meshes.items()
        }
    )
