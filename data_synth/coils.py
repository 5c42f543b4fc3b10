"""Receive sensitivity of a phased array on chest and back."""

from __future__ import annotations

import math

import numpy as np

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.thorax import Thorax

LOOP_RADIUS_MM = 65.0
LOOP_SEGMENTS = 24
CLEARANCE_MM = 12.0
"""Gap between the skin and the loops."""
COLUMNS_DEG = (-50.0, 0.0, 50.0)
"""Where around the body the loops of one row sit, off the middle of chest or back."""
ROWS_MM = (-55.0, 55.0)
"""Heights of the two rows of loops about the heart's centre."""


def array_loops(chest: Thorax, height_mm: float) -> Float:
    """Corners of twelve loops, six on the chest and six on the back: (loop, corner, 3) LPS mm."""
    turn = np.arange(LOOP_SEGMENTS) * 2 * math.pi / LOOP_SEGMENTS
    loops = []
    for side in (-1.0, 1.0):
        for column in np.deg2rad(COLUMNS_DEG):
            out = np.array([math.sin(column), side * math.cos(column), 0.0])
            reach = np.array([chest.half_width, chest.half_depth, 0.0]) + CLEARANCE_MM
            along = np.array([out[1], -out[0], 0.0])
            for row in ROWS_MM:
                middle = out * reach + (0.0, 0.0, height_mm + row)
                ring = np.outer(np.cos(turn), along) + np.outer(np.sin(turn), (0.0, 0.0, 1.0))
                loops.append(middle + LOOP_RADIUS_MM * ring)
    return np.array(loops)


def sum_of_squares(points_mm: Float, loops_mm: Float) -> Float:
    """Root of the summed squared sensitivities of the loops at points (n, 3), arbitrary scale.

    By reciprocity a loop's sensitivity is the part across the main field (z) of the field that
    unit current in it would make (Hoult and Richards, J. Magn. Reson. 24:71-85, 1976); the field
    is Biot-Savart's, summed over straight pieces of wire.
    """
    total = np.zeros(len(points_mm))
    for loop in loops_mm:
        wire = np.roll(loop, -1, axis=0) - loop
        away = points_mm[:, None] - (loop + wire / 2)
        across = np.cross(wire, away) / np.linalg.norm(away, axis=2, keepdims=True) ** 3
        field = across.sum(axis=1)
        total += field[:, 0] ** 2 + field[:, 1] ** 2
    return np.asarray(np.sqrt(total))


def shading(heart: BeatingHeart, points_mm: Float, strength: float) -> Float:
    """Factor that the coils put on the image at LPS points (n, 3): 1 at the heart's centre.

    ``strength`` is the share, in the logarithm, that is left of the array's own shading.
    """
    if strength == 0:
        return np.ones(len(points_mm))
    loops = array_loops(heart.chest, float(heart.centre_mm[2]))
    values = sum_of_squares(np.vstack([heart.centre_mm, points_mm]), loops)
    return np.asarray((values[1:] / values[0]) ** strength)
