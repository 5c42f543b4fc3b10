"""The chest around the heart, at rest: body wall, ribs, spine, lungs, liver, great vessels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.kernels import Float, Label, compiled
from data_synth.tissue import Tissue

AIR = int(Tissue.AIR)
FAT = int(Tissue.FAT)
MUSCLE = int(Tissue.MUSCLE)
LUNG = int(Tissue.LUNG)
BONE = int(Tissue.BONE)
LIVER = int(Tissue.LIVER)
BLOOD_VESSEL = int(Tissue.BLOOD_VESSEL)
VESSEL_WALL = int(Tissue.VESSEL_WALL)
STOMACH = int(Tissue.STOMACH)


class Thorax(NamedTuple):
    """Sizes of one chest, LPS mm, about the middle of the body."""

    half_width: float = 172.0
    half_depth: float = 118.0
    skin_fat: float = 15.0
    body_muscle: float = 9.0
    rib_cage: float = 9.0
    mediastinum: float = 38.0
    """Half-width of the tissue between the lungs."""
    diaphragm_z: float = -72.0
    """Height of the right dome."""
    aorta_radius: float = 11.5


@compiled
def rim(x: float, y: float, half_width: float, half_depth: float) -> float:
    """First-order distance to an ellipse about the origin (squarish, as a chest is)."""
    u, v = x / half_width, y / half_depth
    level = u * u + v * v + 0.25 * u * u * v * v
    gu = (2 * u + 0.5 * u * v * v) / half_width
    gv = (2 * v + 0.5 * u * u * v) / half_depth
    return (level - 1) / max(math.sqrt(gu * gu + gv * gv), 1e-3)


@compiled
def inner_organ(x: float, y: float, z: float, chest: Thorax) -> int:
    """Tissue inside the rib cage: below the diaphragm, or lungs and mediastinum."""
    bowl = 0.0035 * (x * x / 1.6 + (y - 10) * (y - 10))
    dome = chest.diaphragm_z - bowl - (6.0 if x > 25 else 0.0) * min((x - 25) / 25, 1.0)
    if z < dome:
        edge = 35 + 0.25 * (z - chest.diaphragm_z)
        if x < edge:
            return LIVER
        return FAT if x < edge + 5 else STOMACH
    half = chest.mediastinum * (0.62 + 0.3 * ((y + 20) / 80) ** 2)
    return FAT if abs(x - 8) < half and y < 70 else LUNG


@compiled
def cage(x: float, y: float, z: float) -> int:
    """Ribs between muscle: sloping rings, 26 mm apart."""
    place = (z + 0.35 * y) / 26.0
    return BONE if place - math.floor(place) < 0.38 else MUSCLE


@compiled
def chest_at(x: float, y: float, z: float, chest: Thorax) -> int:
    """Tissue of the chest at one LPS point about the middle of the body."""
    outer = rim(x, y, chest.half_width, chest.half_depth)
    if outer > 0:
        return AIR
    if outer > -chest.skin_fat:
        return FAT
    vessel = math.sqrt((x - 24) ** 2 + (y - 58) ** 2) - chest.aorta_radius
    if vessel < 1.5:
        return BLOOD_VESSEL if vessel < 0 else VESSEL_WALL
    if (x / 19) ** 2 + ((y - 76) / 17) ** 2 < 1:
        return BONE
    if y > 60 and abs(abs(x) - 32) < 24 and outer > -45:
        return MUSCLE
    if abs(x) < 16 and abs(y + chest.half_depth - chest.skin_fat - 12) < 6:
        return BONE
    if outer > -chest.skin_fat - chest.body_muscle:
        return MUSCLE
    if outer > -chest.skin_fat - chest.body_muscle - chest.rib_cage:
        return cage(x, y, z)
    return inner_organ(x, y, z, chest)


@compiled
def chest_points(points: Float, chest: Thorax) -> Label:
    """Tissue of LPS points (n, 3) about the middle of the body, with no heart in it."""
    labels = np.zeros(len(points), np.uint8)
    for n in range(len(points)):
        labels[n] = chest_at(points[n, 0], points[n, 1], points[n, 2], chest)
    return labels
