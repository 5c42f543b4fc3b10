"""Centre lines of vessels, papillary muscles and bands that fit a heart of given sizes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from data_synth.kernels import Float, Shape, Tubes
from data_synth.profiles import endocardium, epicardium, rv_depth, rv_share

Point = tuple[float, float, float, float]

VEIN_WAYS = ((0.36, -0.07, 0.93), (0.33, -0.64, 0.69), (-0.91, 0.40, -0.10), (-0.93, -0.14, -0.36))
"""Directions of the pulmonary veins in the heart frame: right upper and lower, left the same.

In a patient they point to the right or left, and backwards.
"""
STUB_MM = 7.0
"""Part of each pulmonary vein beyond the atrium's wall that counts to the atrium."""


def bend(points: Sequence[Point], count: int) -> Float:
    """Smooth centre line of ``count`` pieces through (x, y, z, radius) points."""
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0, 1, len(points))
    line = CubicSpline(knots, np.array(points), axis=0)(np.linspace(0, 1, count + 1))
    return np.ascontiguousarray(line)


def build_tubes(shape: Shape) -> Tubes:
    """All lines of a heart of this shape."""
    lines = {
        **_aorta(shape),
        "appendage": _appendage(shape),
        "veins": _veins(shape),
        **_right_vessels(shape),
        **_left_muscles(shape),
        **_right_muscles(shape),
    }
    order = [name for name in Tubes._fields if name not in ("sinuses", "boxes")]
    boxes = [_box(lines[name].reshape(-1, 4)) for name in order]
    return Tubes(**lines, sinuses=_sinuses(shape), boxes=np.array(boxes))


def _box(rows: Float) -> Float:
    """Low and high corner around balls (x, y, z, radius)."""
    low = (rows[:, :3] - rows[:, 3:]).min(axis=0)
    return np.concatenate([low, (rows[:, :3] + rows[:, 3:]).max(axis=0)])


def _aorta(shape: Shape) -> dict[str, Float]:
    r = shape.aorta_radius
    wide = (shape.lv_radius + shape.lv_wall) / 36.5
    outflow = [(46 * wide, 24 * wide, -26, 13), (36 * wide, 40 * wide, -6, 13), (17, 53, 12, 12)]
    return {
        "aorta": bend(
            [(10, 9, -3, r - 1.5), (13, 17, 22, r - 0.8), (15, 40, 45, r), (8, 72, 62, r)], 8
        ),
        "outflow": bend(outflow, 6),
    }


def _sinuses(shape: Shape) -> Float:
    """Three balls round the aortic root, which together are as wide as the root is to be."""
    axis = np.array([3, 8, 25]) / np.linalg.norm([3, 8, 25])
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    middle = np.array([10, 9, -3]) + 13.0 * axis
    radius = 0.66 * shape.sinus_radius
    turns = np.deg2rad([90, 210, 330])
    ways = np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * other
    centres = middle + (shape.sinus_radius - radius) * ways
    return np.ascontiguousarray(np.column_stack([centres, np.full(3, radius)]))


def _appendage(shape: Shape) -> Float:
    a, f = shape.appendage_length, shape.appendage_radius
    left, front, top = shape.la_x - 17, shape.la_y + 14, shape.la_z + 3
    points = [
        (left, front, top, f),
        (left - 12 * a, front + 13 * a, top - 4 * a, f - 1),
        (left - 9 * a, front + 30 * a, top - 9 * a, f - 2.5),
        (left + 4 * a, front + 40 * a, top - 10 * a, f - 4.5),
    ]
    return bend(points, 7)


def _veins(shape: Shape) -> Float:
    """Each from inside the left atrium: one piece as its stub, two more as a vessel."""
    centre = np.array([shape.la_x, shape.la_y, shape.la_z])
    radii = np.array([shape.la_radius_x, shape.la_radius_y, shape.la_radius_z])
    lines = []
    for way in np.array(VEIN_WAYS):
        way = way / np.linalg.norm(way)
        wall = 1 / np.linalg.norm(way / radii)
        places = np.array([0.6 * wall, wall + STUB_MM, wall + 24, wall + 40])
        r = shape.vein_radius
        lines.append(np.column_stack([centre + places[:, None] * way, [r + 0.5, r, r, r - 1]]))
    return np.ascontiguousarray(lines)


def _right_vessels(shape: Shape) -> dict[str, Float]:
    x, y, z = shape.ra_x, shape.ra_y, shape.ra_z
    return {
        "pulmonary": bend([(17, 53, 12, 12), (2, 62, 30, 12.5), (-10, 63, 46, 12)], 5),
        "right_branch": bend(
            [(-8, 60, 46, 10), (-9, 38, 63, 9.5), (14, 26, 84, 9), (46, 15, 108, 8)], 6
        ),
        "left_branch": bend([(-8, 60, 46, 10.5), (-28, 57, 48, 10), (-56, 48, 50, 9)], 4),
        "upper_cava": bend(
            [(x - 4, y + 10, z + 10, 9), (x - 6, y + 50, z + 34, 9), (x - 10, y + 90, z + 55, 9)], 3
        ),
        "lower_cava": bend(
            [(x, y - 8, z - 2, 10.5), (x - 3, y - 38, z - 16, 10.5), (x - 9, y - 78, z - 36, 11)], 3
        ),
    }


def _left_muscles(shape: Shape) -> dict[str, Float]:
    """Papillary muscles: from the free wall below the middle towards the mitral leaflets."""

    def line(angle: float, r: float) -> Float:
        points = []
        for down, out, thick in ((0.72, 1.0, 1.0), (0.54, 0.74, 0.95), (0.34, 0.50, 0.65)):
            z = -down * shape.lv_length
            wide = out * math.sqrt(endocardium(z, shape)[0])
            points.append((wide * math.cos(angle), wide * math.sin(angle), z, thick * r))
        return np.array(points)

    r = shape.papillary_radius
    return {
        "anterolateral": line(math.radians(150), r),
        "posteromedial": line(math.radians(-80), 1.05 * r),
    }


def _right_muscles(shape: Shape) -> dict[str, Float]:
    """Moderator band and the anterior papillary muscle, where the band meets the free wall."""

    def place(down: float, angle: float, out: float, r: float) -> Point:
        z = -down * shape.lv_length
        wide = math.sqrt(epicardium(z, shape)[0])
        wide += out * rv_depth(z, shape)[0] * rv_share(angle, shape)[0]
        return (wide * math.cos(angle), wide * math.sin(angle), z, r)

    middle = shape.rv_angle
    foot = place(0.56, middle - 0.15, 0.85, 3.5)
    band = [place(0.42, middle + 0.45, -0.05, 2.6), place(0.5, middle + 0.1, 0.5, 2.0), foot]
    head = (shape.ra_x - 6, shape.ra_y + 8, -0.2 * shape.lv_length, 2.2)
    return {"moderator": bend(band, 4), "right_papillary": np.array([foot, head])}
