"""A population of hearts: sizes, motion, place and chest, drawn at random."""

from __future__ import annotations

import math

import numpy as np

from data_synth.beat import Pulse
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart, Matrix
from data_synth.kernels import Shape
from data_synth.thorax import Thorax

EX, EZ = (-0.72, -0.66, -0.16), (-0.62, 0.58, 0.53)
"""Mean directions, LPS: towards the right ventricle, and from apex to base."""
CENTRE_MM = (18.0, -4.0, 2.0)
"""Mean place of the mitral plane in the chest."""


def _spread(mean: float, deviation: float, rng: np.random.Generator, spread: float) -> float:
    """Normal draw about the mean, cut at 2.2 deviations."""
    return mean + deviation * spread * float(np.clip(rng.standard_normal(), -2.2, 2.2))


def draw_heart(rng: np.random.Generator, spread: float = 1.0) -> BeatingHeart:
    """Draw a healthy heart: sizes, motion, place and chest.

    ``spread`` scales every deviation from the mean heart: 0 gives the mean, 1 a population with
    deviations near those of adult reference values (Petersen et al., J. Cardiovasc. Magn. Reson.
    19:18, 2017), 2 a wider one for training.

    Raises
    ------
    SynthError
        When ``spread`` lies outside [0, 3].
    """
    if not 0 <= spread <= 3:
        raise SynthError(f"spread is {spread}; give a number from 0 (mean heart) to 3")
    size = _spread(1.0, 0.04, rng, spread)
    shape = draw_shape(rng, spread, size)
    pulse = draw_pulse(rng, spread)
    girth = _spread(1.0, 0.05, rng, spread)
    chest = Thorax(
        half_width=172 * girth,
        half_depth=_spread(118, 5, rng, spread) * girth,
        skin_fat=max(_spread(15, 4, rng, spread), 4.0),
        mediastinum=_spread(38, 3, rng, spread),
        diaphragm_z=_spread(-72, 5, rng, spread),
    )
    return BeatingHeart(shape, pulse, chest, draw_place(rng, spread))


def draw_shape(rng: np.random.Generator, spread: float, size: float) -> Shape:
    """Draw sizes; ``size`` scales all lengths together."""
    mean = Shape()
    deviation = {
        "lv_radius": 1.2, "lv_length": 4.0, "lv_widest": 0.03, "lv_narrowing": 0.03,
        "lv_wall": 0.9, "apex_wall": 0.5, "rv_width": 1.8, "rv_half_angle": 0.05,
        "rv_angle": 0.06, "rv_reach": 0.02, "rv_wall": 0.25, "la_x": 1.5, "la_y": 1.5,
        "la_radius_x": 1.2, "la_radius_y": 1.2, "la_radius_z": 1.3, "ra_x": 1.5, "ra_y": 2.0,
        "ra_radius_x": 1.3, "ra_radius_y": 1.3, "ra_radius_z": 1.5, "mitral_radius": 0.7,
        "tricuspid_radius": 0.8, "atrial_wall": 0.15, "aorta_radius": 0.9,
        "appendage_length": 0.08, "appendage_radius": 0.7, "fat_depth": 0.8,
    }  # fmt: skip
    angles = {"rv_half_angle", "rv_angle", "lv_widest", "lv_narrowing", "rv_reach"}
    drawn = {}
    for name, sd in deviation.items():
        value = _spread(getattr(mean, name), sd, rng, spread)
        drawn[name] = value if name in angles | {"appendage_length"} else value * size
    drawn["la_z"] = drawn["la_radius_z"]
    drawn["ra_z"] = drawn["ra_radius_z"] - 5
    return mean._replace(**drawn)


def draw_pulse(rng: np.random.Generator, spread: float) -> Pulse:
    """Draw motion amplitudes and timing."""
    return Pulse(
        lv_ejection=_spread(0.605, 0.03, rng, spread),
        rv=_spread(0.72, 0.03, rng, spread),
        descent_lv=_spread(13.0, 1.2, rng, spread),
        descent_rv=_spread(18.5, 1.5, rng, spread),
        twist_apex=_spread(-0.16, 0.03, rng, spread),
        twist_base=_spread(0.07, 0.015, rng, spread),
        la=_spread(0.17, 0.02, rng, spread),
        ra=_spread(0.13, 0.02, rng, spread),
        end_systole=_spread(0.365, 0.012, rng, spread),
        kick=_spread(0.18, 0.02, rng, spread),
    )


def draw_place(rng: np.random.Generator, spread: float) -> Matrix:
    """Draw the heart's position and direction in the chest."""
    from scipy.spatial.transform import Rotation

    ez = np.array(EZ) / math.sqrt(sum(v * v for v in EZ))
    ex = np.array(EX) - np.dot(EX, ez) * ez
    ex /= np.linalg.norm(ex)
    home = np.column_stack([ex, np.cross(ez, ex), ez])
    lean = np.deg2rad([_spread(0, 5, rng, spread) for _ in range(3)])
    rotation = Rotation.from_rotvec(lean).as_matrix() @ home
    centre = np.array([_spread(mean, 4, rng, spread) for mean in CENTRE_MM])
    matrix = np.vstack([np.column_stack([rotation, centre]), (0, 0, 0, 1)])
    return tuple(tuple(float(v) for v in row) for row in matrix)
