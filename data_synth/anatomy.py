"""The heart at the R peak as closed implicit surfaces in its own frame.

Every function gives a distance-like value in millimetres, negative inside, whose slope is close
to 1 near the surface. Bodies are joined and cut by smooth minima and maxima.
"""

from __future__ import annotations

import math

import numpy as np

from data_synth.kernels import Float, Label, Shape, Tubes, compiled
from data_synth.profiles import endocardium, epicardium, rv_depth, rv_share
from data_synth.tissue import Tissue

FAT = int(Tissue.FAT)
LV_CAVITY = int(Tissue.LV_CAVITY)
LV_MYOCARDIUM = int(Tissue.LV_MYOCARDIUM)
RV_CAVITY = int(Tissue.RV_CAVITY)
RV_WALL = int(Tissue.RV_WALL)
LEFT_ATRIUM = int(Tissue.LEFT_ATRIUM)
RIGHT_ATRIUM = int(Tissue.RIGHT_ATRIUM)
ATRIAL_WALL = int(Tissue.ATRIAL_WALL)
AORTA = int(Tissue.AORTA)
VESSEL_WALL = int(Tissue.VESSEL_WALL)
BLOOD_VESSEL = int(Tissue.BLOOD_VESSEL)

BOX_MM = ((-75.0, 110.0), (-85.0, 115.0), (-145.0, 115.0))
"""Heart-frame box (x, y, z) that holds every part of any heart that can be drawn."""
VESSEL_WALL_MM = 1.8
SEPTUM_MM = 3.0
"""Wall between the atria."""


@compiled
def smooth_min(a: float, b: float, k: float) -> float:
    """Union of two bodies, its seam rounded over k mm (polynomial smooth minimum)."""
    h = max(k - abs(a - b), 0.0) / k
    return min(a, b) - h * h * k / 4


@compiled
def smooth_max(a: float, b: float, k: float) -> float:
    """Intersection of two bodies, its edge rounded over k mm."""
    h = max(k - abs(a - b), 0.0) / k
    return max(a, b) + h * h * k / 4


@compiled
def tube(x: float, y: float, z: float, line: Float) -> float:
    """Distance to a tube of varying radius: union of tapered capsules along its centre line."""
    best = 1e9
    for k in range(len(line) - 1):
        ax, ay, az, ar = line[k]
        ex, ey, ez = line[k + 1, 0] - ax, line[k + 1, 1] - ay, line[k + 1, 2] - az
        px, py, pz = x - ax, y - ay, z - az
        t = (px * ex + py * ey + pz * ez) / (ex * ex + ey * ey + ez * ez)
        t = min(max(t, 0.0), 1.0)
        px, py, pz = px - t * ex, py - t * ey, pz - t * ez
        radius = ar + t * (line[k + 1, 3] - ar)
        squared = px * px + py * py + pz * pz
        if squared < (best + radius) ** 2:
            best = math.sqrt(squared) - radius
    return best


@compiled
def ellipsoid(x: float, y: float, z: float, rx: float, ry: float, rz: float) -> float:
    """First-order distance to an ellipsoid about the origin."""
    k0 = math.sqrt((x / rx) ** 2 + (y / ry) ** 2 + (z / rz) ** 2)
    k1 = math.sqrt((x / rx**2) ** 2 + (y / ry**2) ** 2 + (z / rz**2) ** 2)
    return k0 * (k0 - 1) / k1 if k1 > 1e-9 else -min(rx, ry, rz)


@compiled
def bullet(s: float, value: float, slope: float) -> float:
    """First-order distance to the outline s = value(z) of squared radius s."""
    return (s - value) / math.sqrt(4 * s + slope * slope + 4)


@compiled
def lv_cavity(x: float, y: float, z: float, shape: Shape) -> float:
    """Left-ventricular cavity, closed by the mitral plane."""
    value, slope = endocardium(z, shape)
    return smooth_max(bullet(x * x + y * y, value, slope), z, 3.0)


@compiled
def lv_outside(x: float, y: float, z: float, shape: Shape) -> float:
    """Left-ventricular muscle with its cavity, closed by the mitral plane."""
    value, slope = epicardium(z, shape)
    return smooth_max(bullet(x * x + y * y, value, slope), z, 4.0)


@compiled
def aorta(x: float, y: float, z: float, shape: Shape, tubes: Tubes) -> float:
    """Aortic root and ascending aorta, from the base plane up."""
    return smooth_max(tube(x, y, z, tubes.aorta), 0.3 - z, 2.0)


@compiled
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
        return max(r - base, 0.0) / steep + max(-depth, 0.0) + 10 * max(-share, 0.0)
    return (r - base - depth * share) / steep


@compiled
def rv_cavity(x: float, y: float, z: float, shape: Shape, tubes: Tubes, lv: float) -> float:
    """Right ventricle with its outflow, up to the tricuspid plane and the pulmonary valve."""
    body = smooth_max(crescent(x, y, z, shape), z + 1.5, 6.0)
    whole = smooth_min(body, tube(x, y, z, tubes.outflow), 8.0)
    whole = smooth_max(whole, VESSEL_WALL_MM + 1.0 - tube(x, y, z, tubes.aorta), 3.0)
    return smooth_max(whole, 0.3 - lv, 4.0)


@compiled
def left_atrium(x: float, y: float, z: float, shape: Shape, tubes: Tubes, root: float) -> float:
    """Left atrium with funnel and appendage; ``root`` is the distance to the aorta."""
    ball = ellipsoid(
        x - shape.la_x,
        y - shape.la_y,
        z - shape.la_z,
        shape.la_radius_x,
        shape.la_radius_y,
        shape.la_radius_z,
    )
    radius = math.sqrt((x - shape.la_x) ** 2 + (y - shape.la_y - 1) ** 2)
    funnel = smooth_max(radius - shape.mitral_radius, z - 12.0, 4.0)
    whole = smooth_min(ball, funnel, 8.0)
    whole = smooth_min(whole, tube(x, y, z, tubes.appendage), 5.0)
    whole = smooth_max(whole, 0.3 - z, 2.0)
    return smooth_max(whole, VESSEL_WALL_MM + 1 - root, 4.0)


@compiled
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
    whole = smooth_max(smooth_min(ball, funnel, 8.0), -1.2 - z, 2.0)
    whole = smooth_max(whole, VESSEL_WALL_MM + 1 - root, 4.0)
    whole = smooth_max(whole, SEPTUM_MM - left, 4.0)
    return smooth_max(whole, 0.3 - right, 2.0)


@compiled
def bodies(x: float, y: float, z: float, shape: Shape, tubes: Tubes) -> tuple[float, ...]:
    """Values of (lv cavity, epicardium, rv cavity, left atrium, right atrium, aorta)."""
    inner = lv_cavity(x, y, z, shape)
    lv = lv_outside(x, y, z, shape)
    root = aorta(x, y, z, shape, tubes)
    right = rv_cavity(x, y, z, shape, tubes, lv)
    left = left_atrium(x, y, z, shape, tubes, root)
    return inner, lv, right, left, right_atrium(x, y, z, shape, root, left, right), root


@compiled
def whole_heart(values: tuple[float, ...]) -> float:
    """Everything the truth labels name, its clefts of a few millimetres filled."""
    whole = smooth_min(values[1], values[2], 8.0)
    whole = smooth_min(whole, smooth_min(values[3], values[4], 8.0), 8.0)
    return smooth_min(whole, values[5], 8.0)


@compiled
def tissue_at(x: float, y: float, z: float, shape: Shape, tubes: Tubes) -> int:
    """Tissue at a heart-frame point at the R peak; 0 outside the heart."""
    if lv_cavity(x, y, z, shape) < 0:
        return LV_CAVITY
    if lv_outside(x, y, z, shape) < 0:
        return LV_MYOCARDIUM
    _, lv, right, left, ra, root = bodies(x, y, z, shape, tubes)
    if root < 0:
        return AORTA
    if right < 0:
        return RV_CAVITY
    if left < 0:
        return LEFT_ATRIUM
    if ra < 0:
        return RIGHT_ATRIUM
    vessel = min(tube(x, y, z, tubes.pulmonary), tube(x, y, z, tubes.cava))
    if root < VESSEL_WALL_MM:
        return VESSEL_WALL
    if right < shape.rv_wall and z < 4:
        return RV_WALL
    if vessel < 0:
        return BLOOD_VESSEL
    if right < shape.rv_wall:
        return RV_WALL
    if min(left, ra) < shape.atrial_wall:
        return ATRIAL_WALL
    if vessel < VESSEL_WALL_MM:
        return VESSEL_WALL
    ventricles = smooth_min(lv, right - shape.rv_wall, 24.0)
    atria = smooth_min(left, ra, 24.0) - shape.atrial_wall
    around = smooth_min(smooth_min(ventricles, atria, 24.0), min(root, vessel), 16.0)
    return FAT if around < shape.fat_depth else 0


@compiled
def label_points(points: Float, shape: Shape, tubes: Tubes) -> Label:
    """Tissue of heart-frame points (n, 3) at the R peak; 0 outside the heart."""
    labels = np.zeros(len(points), np.uint8)
    for n in range(len(points)):
        labels[n] = tissue_at(points[n, 0], points[n, 1], points[n, 2], shape, tubes)
    return labels


@compiled
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


def bend(points: list[tuple[float, float, float, float]], count: int) -> Float:
    """Smooth centre line of ``count`` pieces through (x, y, z, radius) points."""
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0, 1, len(points))
    line = CubicSpline(knots, np.array(points), axis=0)(np.linspace(0, 1, count + 1))
    return np.ascontiguousarray(line)


def build_tubes(shape: Shape) -> Tubes:
    """Vessels, outflow and appendage that fit a heart of this shape."""
    r = shape.aorta_radius
    wide = (shape.lv_radius + shape.lv_wall) / 36.5
    a, f = shape.appendage_length, shape.appendage_radius
    left, front, top = shape.la_x - 17, shape.la_y + 14, shape.la_z + 3
    return Tubes(
        aorta=bend([(10, 9, -3, r - 2), (13, 17, 22, r + 1), (15, 40, 45, r), (8, 72, 62, r)], 8),
        outflow=bend(
            [(46 * wide, 24 * wide, -26, 13), (36 * wide, 40 * wide, -6, 13), (17, 53, 12, 12)], 6
        ),
        pulmonary=bend([(17, 53, 12, 12), (2, 62, 30, 12.5), (-10, 64, 50, 12)], 5),
        appendage=bend(
            [
                (left, front, top, f),
                (left - 12 * a, front + 13 * a, top - 4 * a, f - 1),
                (left - 9 * a, front + 30 * a, top - 9 * a, f - 2.5),
                (left + 4 * a, front + 40 * a, top - 10 * a, f - 4.5),
            ],
            7,
        ),
        cava=bend(
            [
                (shape.ra_x - 4, shape.ra_y + 14, shape.ra_z + 14, 9),
                (shape.ra_x - 6, shape.ra_y + 50, shape.ra_z + 34, 9),
                (shape.ra_x - 10, shape.ra_y + 90, shape.ra_z + 55, 9),
            ],
            3,
        ),
    )
