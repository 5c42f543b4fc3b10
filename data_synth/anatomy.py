"""The heart at the R peak as closed implicit surfaces in its own frame.

Every function gives a distance-like value in millimetres, negative inside. Bodies are joined and
cut by smooth minima and maxima of first-order distances, so the values are not quite distances.
Against the exact distance to the truth meshes, at points within 4 mm of a surface: the zero sets
agree within 0.15 mm (facets of the mesh), the mean error is below 0.15 mm, 99 % are off by less
than 1.5 mm, and no value is larger than 1.3 times the distance (below it by more where a seam is
concave or the right ventricle thins out to its edge). ``tests/test_phantom_anatomy.py`` holds them
to these bounds.
"""

from __future__ import annotations

import math

import numpy as np

from data_synth.kernels import Float, Label, Shape, Tubes, asked, inner
from data_synth.lining import lv_lining, lv_wall, rv_lining
from data_synth.primitives import (
    box_distance,
    boxed_tube,
    bullet,
    ellipsoid,
    joined,
    smooth_max,
    smooth_min,
    tube,
)
from data_synth.profiles import (
    endocardium,
    endocardium_at,
    epicardium,
    is_round,
    rv_depth,
    rv_share,
)
from data_synth.tissue import Tissue

FAT = int(Tissue.FAT)
RV_WALL = int(Tissue.RV_WALL)
LEFT_ATRIUM = int(Tissue.LEFT_ATRIUM)
RIGHT_ATRIUM = int(Tissue.RIGHT_ATRIUM)
ATRIAL_WALL = int(Tissue.ATRIAL_WALL)
AORTA = int(Tissue.AORTA)
VESSEL_WALL = int(Tissue.VESSEL_WALL)
BLOOD_VESSEL = int(Tissue.BLOOD_VESSEL)
PERICARDIUM = int(Tissue.PERICARDIUM)
LEAFLET = int(Tissue.LEAFLET)

BOX_MM = ((-75.0, 110.0), (-85.0, 115.0), (-145.0, 115.0))
"""Heart-frame box (x, y, z) that holds every part of any heart that can be drawn."""
VESSEL_WALL_MM = 1.8
SEPTUM_MM = 3.0
"""Wall between the atria."""
LEAFLET_MM = 1.0
"""Thickness of the closed mitral and tricuspid leaflets, the gap between the bodies there."""
REACH_MM, VESSEL_REACH_MM = 26.0, 14.0
"""Tubes and vessels farther than this from a point take no part in anything there."""
STUB_REACH_MM = 30.0
"""Vein stubs end nearer than this to the atrium's ball."""
SAC_TOP_MM = 52.0
"""The pericardium ends on the great vessels at this height above the mitral plane."""
VESSEL_FAT_MM = 3.5
"""Outer edge of wall and fat round a vessel outside the pericardium."""


@inner
def lv_cavity(x: float, y: float, z: float, shape: Shape) -> float:
    """Left-ventricular cavity, closed by the mitral plane."""
    if is_round(shape):
        value, slope = endocardium(z, shape)
        return smooth_max(bullet(x * x + y * y, value, slope, 0.0), z, 3.0)
    value, slope, around = endocardium_at(z, math.atan2(y, x), shape)
    return smooth_max(bullet(x * x + y * y, value, slope, around), z, 3.0)


@inner
def lv_outside(x: float, y: float, z: float, shape: Shape) -> float:
    """Left-ventricular muscle with its cavity, closed by the mitral plane."""
    value, slope = epicardium(z, shape)
    return smooth_max(bullet(x * x + y * y, value, slope, 0.0), z, 4.0)


@inner
def aorta(x: float, y: float, z: float, pipe: float, tubes: Tubes) -> float:
    """Aortic root with its three sinuses and ascending aorta, from the base plane up.

    ``pipe`` is the distance to the aorta's tube.
    """
    if -8.0 < z < 36.0 and pipe < 12.0:
        for k in range(3):
            cx, cy, cz, radius = tubes.sinuses[k]
            ball = math.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - radius
            pipe = smooth_min(pipe, ball, 2.0)
    return smooth_max(pipe, 0.3 - z, 2.0)


@inner
def crescent(x: float, y: float, z: float, shape: Shape) -> float:
    """Outside of the right ventricle's body, an outline about the long axis."""
    value, slope = epicardium(z, shape)
    base = math.sqrt(max(value, 9.0))
    depth, depth_slope = rv_depth(z, shape)
    share, share_slope = rv_share(math.atan2(y, x), shape)
    r = math.sqrt(x * x + y * y)
    along = depth_slope * share + (slope / (2 * base) if value > 9.0 else 0.0)
    around = depth * share_slope / max(r, 8.0)
    steep = math.sqrt(1 + along * along + around * around)
    if depth <= 0.0 or share <= 0.0:
        # Beyond its tip the outline is no longer a graph: keep the value positive and growing.
        return max(r - base, 0.0) / steep + max(-depth, 0.0) + 25 * max(-share, 0.0)
    return (r - base - depth * share) / steep


@inner
def rv_cavity(
    x: float, y: float, z: float, shape: Shape, tubes: Tubes, lv: float, pipe: float
) -> float:
    """Right ventricle with its outflow, up to the tricuspid plane and the pulmonary valve.

    Kept off the left ventricle and the aorta's tube, whose distances are ``lv`` and ``pipe``.
    """
    body = smooth_max(crescent(x, y, z, shape), z + 1.5, 6.0)
    whole = joined(x, y, z, body, tubes.outflow, tubes.boxes[1], 8.0, REACH_MM)
    whole = smooth_max(whole, VESSEL_WALL_MM + 1.0 - pipe, 3.0)
    return smooth_max(whole, 0.3 - lv, 4.0)


@inner
def left_atrium(x: float, y: float, z: float, shape: Shape, tubes: Tubes, root: float) -> float:
    """Left atrium with funnel, appendage and vein stubs; ``root`` is the distance to the aorta."""
    dx, dy, dz = x - shape.la_x, y - shape.la_y, z - shape.la_z
    ball = ellipsoid(dx, dy, dz, shape.la_radius_x, shape.la_radius_y, shape.la_radius_z)
    radius = math.sqrt(dx * dx + (dy - 1) ** 2)
    funnel = smooth_max(radius - shape.mitral_radius, z - 12.0, 4.0)
    whole = smooth_min(ball, funnel, 8.0)
    whole = joined(x, y, z, whole, tubes.appendage, tubes.boxes[2], 5.0, REACH_MM)
    if -20.0 < ball < STUB_REACH_MM:
        for k in range(4):
            whole = smooth_min(whole, tube(x, y, z, tubes.veins[k, :2]), 5.0)
    whole = smooth_max(whole, LEAFLET_MM - z, 2.0)
    return smooth_max(whole, VESSEL_WALL_MM + 1 - root, 4.0)


@inner
def right_atrium(
    x: float, y: float, z: float, shape: Shape, root: float, left: float, right: float
) -> float:
    """Right atrium with funnel; kept off aorta, left atrium and right ventricle (distances)."""
    ball = ellipsoid(
        x - shape.ra_x,
        y - shape.ra_y,
        z - shape.ra_z,
        shape.ra_radius_x,
        shape.ra_radius_y,
        shape.ra_radius_z,
    )
    radius = math.sqrt((x - shape.ra_x) ** 2 + (y - shape.ra_y) ** 2)
    funnel = smooth_max(radius - shape.tricuspid_radius, z - 12.0, 4.0)
    whole = smooth_max(smooth_min(ball, funnel, 8.0), LEAFLET_MM - 1.5 - z, 2.0)
    whole = smooth_max(whole, VESSEL_WALL_MM + 1 - root, 4.0)
    whole = smooth_max(whole, SEPTUM_MM - left, 4.0)
    return smooth_max(whole, 0.3 - right, 2.0)


@inner
def bodies(x: float, y: float, z: float, shape: Shape, tubes: Tubes) -> tuple[float, ...]:
    """Values of (lv cavity, epicardium, rv cavity, left atrium, right atrium, aorta)."""
    inner = lv_cavity(x, y, z, shape)
    lv = lv_outside(x, y, z, shape)
    pipe = boxed_tube(x, y, z, tubes.aorta, tubes.boxes[0], VESSEL_REACH_MM)
    root = aorta(x, y, z, pipe, tubes)
    right = rv_cavity(x, y, z, shape, tubes, lv, pipe)
    left = left_atrium(x, y, z, shape, tubes, root)
    return inner, lv, right, left, right_atrium(x, y, z, shape, root, left, right), root


@inner
def whole_heart(values: tuple[float, ...]) -> float:
    """Everything the truth labels name, its clefts of a few millimetres filled."""
    whole = smooth_min(values[1], values[2], 8.0)
    whole = smooth_min(whole, smooth_min(values[3], values[4], 8.0), 8.0)
    return smooth_min(whole, values[5], 8.0)


@inner
def vessel_at(x: float, y: float, z: float, trunk: float, tubes: Tubes) -> float:
    """Distance to the nearest vessel that is no body of its own; ``trunk`` is the pulmonary.

    Where nothing is nearer than VESSEL_FAT_MM, some value that is no less.
    """
    boxes, best, far = tubes.boxes, trunk, VESSEL_FAT_MM
    best = min(best, boxed_tube(x, y, z, tubes.right_branch, boxes[5], min(best, far)))
    best = min(best, boxed_tube(x, y, z, tubes.left_branch, boxes[6], min(best, far)))
    best = min(best, boxed_tube(x, y, z, tubes.upper_cava, boxes[7], min(best, far)))
    best = min(best, boxed_tube(x, y, z, tubes.lower_cava, boxes[8], min(best, far)))
    if box_distance(x, y, z, boxes[3]) < min(best, far):
        for k in range(4):
            best = min(best, tube(x, y, z, tubes.veins[k, 1:]))
    return best


@inner
def is_leaflet(x: float, y: float, z: float, shape: Shape) -> bool:
    """Whether a point outside all bodies lies in the closed mitral or tricuspid valve."""
    if -0.5 < z < LEAFLET_MM + 0.5:
        mitral = (x - shape.la_x) ** 2 + (y - shape.la_y - 1) ** 2
        if mitral < shape.mitral_radius**2:
            return True
    if -2.0 < z < LEAFLET_MM - 1.0:
        tricuspid = (x - shape.ra_x) ** 2 + (y - shape.ra_y) ** 2
        return tricuspid < shape.tricuspid_radius**2
    return False


@inner
def tissue_at(x: float, y: float, z: float, shape: Shape, tubes: Tubes) -> int:
    """Tissue at a heart-frame point at the R peak; 0 outside the heart."""
    inner = lv_cavity(x, y, z, shape)
    if inner < 0:
        return lv_lining(x, y, z, -inner, shape, tubes)
    lv = lv_outside(x, y, z, shape)
    if lv < 0:
        return lv_wall(x, y, z, shape)
    pipe = boxed_tube(x, y, z, tubes.aorta, tubes.boxes[0], VESSEL_REACH_MM)
    root = aorta(x, y, z, pipe, tubes)
    if root < 0:
        return AORTA
    right = rv_cavity(x, y, z, shape, tubes, lv, pipe)
    if right < 0:
        return rv_lining(x, y, z, -right, shape, tubes)
    left = left_atrium(x, y, z, shape, tubes, root)
    if left < 0:
        return LEFT_ATRIUM
    ra = right_atrium(x, y, z, shape, root, left, right)
    if ra < 0:
        return RIGHT_ATRIUM
    if is_leaflet(x, y, z, shape):
        return LEAFLET
    return around_bodies(x, y, z, shape, tubes, (lv, right, left, ra, root))


@inner
def around_bodies(
    x: float, y: float, z: float, shape: Shape, tubes: Tubes, near: tuple[float, ...]
) -> int:
    """Walls, vessels, fat and pericardium outside the bodies, whose distances are ``near``."""
    lv, right, left, ra, root = near
    if root < VESSEL_WALL_MM:
        return VESSEL_WALL
    if right < shape.rv_wall and z < 4:
        return RV_WALL
    trunk = boxed_tube(x, y, z, tubes.pulmonary, tubes.boxes[4], VESSEL_REACH_MM)
    vessel = vessel_at(x, y, z, trunk, tubes)
    if vessel < 0:
        return BLOOD_VESSEL
    if right < shape.rv_wall:
        return RV_WALL
    if min(left, ra) < shape.atrial_wall:
        return ATRIAL_WALL
    if vessel < VESSEL_WALL_MM:
        return VESSEL_WALL
    ventricles = smooth_min(lv, right - shape.rv_wall, 18.0)
    atria = smooth_min(left, ra, 18.0) - shape.atrial_wall
    sac = smooth_min(ventricles, atria, 18.0)
    great = max(min(root, trunk), z - SAC_TOP_MM)
    sac = smooth_min(sac, great, 8.0) - shape.fat_depth
    if sac < 0:
        return FAT
    if sac < shape.pericardium:
        return PERICARDIUM
    return FAT if min(root, vessel) < VESSEL_FAT_MM else 0


@asked
def label_points(points: Float, shape: Shape, tubes: Tubes) -> Label:
    """Tissue of heart-frame points (n, 3) at the R peak; 0 outside the heart."""
    labels = np.zeros(len(points), np.uint8)
    for n in range(len(points)):
        labels[n] = tissue_at(points[n, 0], points[n, 1], points[n, 2], shape, tubes)
    return labels


@asked
def sample_bodies(x: Float, y: Float, z: Float, shape: Shape, tubes: Tubes) -> Float:
    """Values of the six bodies and the whole heart on a grid: (7, x, y, z)."""
    values = np.empty((7, len(x), len(y), len(z)))
    for i in range(len(x)):
        for j in range(len(y)):
            for k in range(len(z)):
                here = bodies(x[i], y[j], z[k], shape, tubes)
                for n in range(6):
                    values[n, i, j, k] = here[n]
                values[6, i, j, k] = whole_heart(here)
    return values


BODY_NAMES = (
    "lv_endocardium",
    "epicardium",
    "rv_endocardium",
    "left_atrium",
    "right_atrium",
    "aorta",
    "heart",
)
"""Names of the bodies in the order of :func:`sample_bodies`."""
