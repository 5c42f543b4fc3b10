"""The chest around the heart, at rest: body wall, ribs, spine, lungs, belly, great vessels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.kernels import Float, Label, asked, inner
from data_synth.primitives import ellipsoid, rim, smooth_max, smooth_min, tube
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
GAS = int(Tissue.GAS)
SPLEEN = int(Tissue.SPLEEN)

RIB_PITCH_MM = 27.0
RIB_SLOPE = 0.45
"""Ribs fall by this much a mm from the back to the front."""
VERTEBRA_MM = 33.0
DISC_MM = 8.0
SPINE_Y_MM = 64.0
CANAL_Y_MM = 89.0
CANAL_MM = 9.0
AORTA_X_MM, AORTA_Y_MM = 27.0, 51.0
CAVA_X_MM, CAVA_Y_MM = -25.0, 12.0
GULLET_X_MM, GULLET_Y_MM, GULLET_MM = 7.0, 43.0, 6.0
DIAPHRAGM_MM = 3.0
ARCH = np.array(
    [
        (-8, -8, 92, 13.0),
        (-3, 2, 110, 12.5),
        (9, 22, 119, 12.0),
        (22, 42, 112, 11.5),
        (AORTA_X_MM, AORTA_Y_MM, 92, 11.0),
    ]
)
"""The aorta's arch, from the end of the heart's ascending part to the descending one."""


class Thorax(NamedTuple):
    """Sizes of one chest, LPS mm, about the middle of the body."""

    half_width: float = 172.0
    half_depth: float = 118.0
    skin_fat: float = 15.0
    body_muscle: float = 9.0
    rib_cage: float = 9.0
    mediastinum: float = 30.0
    """Half-width of the tissue between the lungs."""
    diaphragm_z: float = -72.0
    """Height of its middle, below the heart; the domes rise higher on both sides."""
    aorta_radius: float = 10.0
    """Descending aorta."""


@inner
def diaphragm(x: float, y: float, chest: Thorax) -> float:
    """Height of the diaphragm: a right dome, a lower left one, and the middle under the heart."""
    z = chest.diaphragm_z
    right = z + 26 - 0.0048 * ((x + 84) ** 2 + 0.8 * (y - 8) ** 2)
    left = z + 16 - 0.0052 * ((x - 90) ** 2 + 0.8 * (y - 30) ** 2)
    middle = z - 0.0022 * ((x - 10) ** 2 + (y + 10) ** 2)
    return -smooth_min(-middle, smooth_min(-right, -left, 12.0), 16.0)


@inner
def stomach(x: float, y: float, z: float, top: float) -> int:
    """Stomach under the left dome, gas in its front as in a patient on the back; or 0."""
    body = ellipsoid(x - 74, y + 6, z - top + 46, 44.0, 46.0, 40.0)
    if body > 3.0:
        return 0
    if body > 0.0:
        return MUSCLE
    return GAS if y < -22 else STOMACH


@inner
def belly(x: float, y: float, z: float, outer: float, roof: float, chest: Thorax) -> int:
    """Tissue below the diaphragm, whose height here is ``roof``."""
    under = roof - z
    if under < DIAPHRAGM_MM:
        return MUSCLE
    edge = 58 - 0.3 * max(chest.diaphragm_z - z, 0.0) - 0.2 * (y + 20)
    if x < edge and ((x + 30) / 150) ** 2 + ((y + 10) / 100) ** 2 < 1.0:
        gullies = (x - 6) ** 2 + (y - 30) ** 2
        return LIVER if gullies > 18.0**2 else FAT
    kind = stomach(x, y, z, chest.diaphragm_z)
    if kind:
        return kind
    spleen = ellipsoid(x - 104, y - 42, z - chest.diaphragm_z + 38, 22.0, 36.0, 44.0)
    if spleen < 0 and outer < -chest.skin_fat - chest.body_muscle - chest.rib_cage - 3:
        return SPLEEN
    return FAT


@inner
def lung(x: float, y: float, chest: Thorax) -> int:
    """Lungs and the fat between them: narrow before and behind the heart, wide beside it."""
    ahead = (y + 100) / 120
    waist = chest.mediastinum * max(ahead * (1.55 - ahead), 0.0) / 0.6
    return FAT if abs(x - 8) < min(3.0 + waist, chest.mediastinum) and y < 78 else LUNG


@inner
def cage(y: float, z: float, depth: float, chest: Thorax) -> int:
    """Ribs between muscle: flat bars that slope down to the front; ``depth`` mm into the cage."""
    place = (z - RIB_SLOPE * y) / RIB_PITCH_MM
    tall = (place - math.floor(place) - 0.5) * RIB_PITCH_MM / 6.5
    deep = (depth - chest.rib_cage / 2) / (0.42 * chest.rib_cage)
    return BONE if tall * tall + deep * deep < 1 else MUSCLE


@inner
def spine(x: float, y: float, z: float) -> int:
    """Vertebral bodies with discs between them, canal, arch and spines; 0 elsewhere."""
    body = (x / 19) ** 2 + ((y - SPINE_Y_MM) / 15) ** 2
    place = z / VERTEBRA_MM + 0.5
    place = (place - math.floor(place)) * VERTEBRA_MM
    if body < 1:
        return MUSCLE if place < DISC_MM else BONE
    canal = math.sqrt(x * x + (y - CANAL_Y_MM) ** 2)
    if canal < CANAL_MM:
        return MUSCLE if canal < 5.5 else FAT
    if canal < CANAL_MM + 4 and place > DISC_MM:
        return BONE
    way = abs(abs(x) - 0.9 * (y - CANAL_Y_MM + 6) - 10)
    if y > 78 and abs(x) < 34 and way < 4 and place > 20:
        return BONE
    return 0


@inner
def sternum(x: float, y: float, z: float, chest: Thorax) -> bool:
    """Breast bone: a plate behind the skin, above the diaphragm."""
    depth = y + chest.half_depth - chest.skin_fat
    if z < chest.diaphragm_z + 5:
        return False
    flat = (x / (14 + 0.06 * max(z, 0.0))) ** 2
    return flat * flat + ((depth - 9) / 6.0) ** 2 < 1


@inner
def middle_parts(x: float, y: float, z: float, chest: Thorax) -> int:
    """Aorta with its arch, lower cava, gullet and spine; 0 elsewhere."""
    if abs(x) > 60 or y < -30:
        return 0
    vessel = math.sqrt((x - AORTA_X_MM) ** 2 + (y - AORTA_Y_MM) ** 2) - chest.aorta_radius
    if z > 90:
        vessel = max(vessel, z - 105)
        vessel = min(vessel, tube(x, y, z, ARCH))
    if z < chest.diaphragm_z + 12:
        vessel = min(vessel, math.sqrt((x - CAVA_X_MM) ** 2 + (y - CAVA_Y_MM) ** 2) - 10.5)
    if vessel < 1.5:
        return BLOOD_VESSEL if vessel < 0 else VESSEL_WALL
    if y > SPINE_Y_MM - 16:
        kind = spine(x, y, z)
        if kind:
            return kind
    gullet = (x - GULLET_X_MM) ** 2 + (y - GULLET_Y_MM) ** 2
    if gullet < GULLET_MM**2 and z > chest.diaphragm_z - 20:
        return MUSCLE
    return 0


@inner
def back_muscle(x: float, y: float, outer: float) -> bool:
    """The long muscles on both sides of the spine."""
    return y > 62 and smooth_max(abs(abs(x) - 34) - 22, -48 - outer, 8.0) < 0


@inner
def chest_at(x: float, y: float, z: float, chest: Thorax) -> int:
    """Tissue of the chest at one LPS point about the middle of the body."""
    outer = rim(x, y, chest.half_width, chest.half_depth)
    if outer > 0:
        return AIR
    if outer > -chest.skin_fat:
        return FAT
    kind = middle_parts(x, y, z, chest)
    if kind:
        return kind
    if back_muscle(x, y, outer):
        return MUSCLE
    if y < -60 and abs(x) < 30 and sternum(x, y, z, chest):
        return BONE
    depth = -outer - chest.skin_fat - chest.body_muscle
    if depth < 0:
        return MUSCLE
    if depth < chest.rib_cage:
        return cage(y, z, depth, chest)
    roof = diaphragm(x, y, chest)
    return belly(x, y, z, outer, roof, chest) if z < roof else lung(x, y, chest)


@asked
def chest_points(points: Float, chest: Thorax) -> Label:
    """Tissue of LPS points (n, 3) about the middle of the body, with no heart in it."""
    labels = np.zeros(len(points), np.uint8)
    for n in range(len(points)):
        labels[n] = chest_at(points[n, 0], points[n, 1], points[n, 2], chest)
    return labels
