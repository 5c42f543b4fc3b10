"""Outlines of the ventricles along the long axis: shared by anatomy and motion.

Squared radii are used throughout, for they stay smooth where a cavity closes at its apex.
"""

from __future__ import annotations

import math

from data_synth.kernels import Shape, asked, inner
from data_synth.primitives import bump

FLAT = 0.45
"""Above the mitral plane the outline loses at most this share of its squared radius."""
FULLNESS = 0.35
"""Weight of the fourth power: how blunt the apex is."""
BULGE_HALF_ANGLE = 1.9
"""Half of the angle over which a thickened septum fades to the usual wall, radians."""
BULGE_HEIGHT, BULGE_HALF_HEIGHT = 0.35, 0.8
"""Its middle and half its height below the mitral plane, as shares of the cavity's length."""


@inner
def squared_radius(
    z: float, radius: float, widest: float, tip: float, narrowing: float
) -> tuple[float, float]:
    """Squared radius (mm^2) of a bullet-shaped outline at height z, and its slope (mm).

    Ellipse-like from ``widest`` down to ``tip``; negative below the tip.
    """
    if z <= widest:
        reach = widest - tip
        u = (widest - z) / reach
        q = u * u
        value = 1 - q * (1 - FULLNESS + FULLNESS * q)
        slope = 2 * u * (1 - FULLNESS + 2 * FULLNESS * q) / reach
    else:
        u = z / -widest + 1
        t = narrowing * u * u
        value = 1 - t / (1 + t / FLAT)
        slope = -2 * narrowing * u / -widest / (1 + t / FLAT) ** 2
    return radius * radius * value, radius * radius * slope


@asked
def endocardium(z: float, shape: Shape) -> tuple[float, float]:
    """Squared radius of the left cavity and its slope along z."""
    widest = -shape.lv_widest * shape.lv_length
    return squared_radius(z, shape.lv_radius, widest, -shape.lv_length, shape.lv_narrowing)


@asked
def away_from(angle: float, middle: float) -> float:
    """Angle from ``middle``, between -pi and pi."""
    offset = angle - middle
    return offset - 2 * math.pi * math.floor(offset / (2 * math.pi) + 0.5)


@asked
def is_round(shape: Shape) -> bool:
    """Whether the cavity's outline is the same at every angle."""
    return shape.septal_bulge == 0.0 and shape.scar_thinning == 0.0


@inner
def scar_share(z: float, angle: float, shape: Shape) -> tuple[float, float, float]:
    """1 in the middle of the infarct, 0 outside; its slopes along z (1/mm) and by angle."""
    if shape.scar_half_angle <= 0.0:
        return 0.0, 0.0, 0.0
    tall = shape.scar_half_height * shape.lv_length
    turned, by_angle = bump(away_from(angle, shape.scar_angle) / shape.scar_half_angle)
    along, by_z = bump((z + shape.scar_height * shape.lv_length) / tall)
    return turned * along, turned * by_z / tall, by_angle * along / shape.scar_half_angle


@asked
def unevenness(z: float, angle: float, shape: Shape) -> tuple[float, float, float]:
    """Radius of the left cavity over the round one, at an angle about the axis; slopes by z, angle.

    Less than 1 under a thickened septum, more at a thinned scar. The change in millimetres shrinks
    with the outline towards the apex.
    """
    if is_round(shape):
        return 1.0, 0.0, 0.0
    scar, scar_z, scar_angle = scar_share(z, angle, shape)
    tall = BULGE_HALF_HEIGHT * shape.lv_length
    turned, by_angle = bump(away_from(angle, shape.bulge_angle) / BULGE_HALF_ANGLE)
    along, by_z = bump((z + BULGE_HEIGHT * shape.lv_length) / tall)
    inwards = shape.septal_bulge / shape.lv_radius
    outwards = shape.scar_thinning * shape.lv_wall / shape.lv_radius
    factor = 1 - inwards * turned * along + outwards * scar
    factor_z = outwards * scar_z - inwards * turned * by_z / tall
    return factor, factor_z, outwards * scar_angle - inwards * by_angle * along / BULGE_HALF_ANGLE


@asked
def endocardium_at(z: float, angle: float, shape: Shape) -> tuple[float, float, float]:
    """Squared radius of the left cavity at an angle about the axis; slopes along z, by angle."""
    value, slope = endocardium(z, shape)
    factor, by_z, by_angle = unevenness(z, angle, shape)
    twice = 2 * value * factor
    return value * factor * factor, slope * factor * factor + twice * by_z, twice * by_angle


@asked
def epicardium(z: float, shape: Shape) -> tuple[float, float]:
    """Squared radius of the outside of the left ventricle and its slope along z."""
    widest = -shape.lv_widest * shape.lv_length
    tip = -shape.lv_length - shape.apex_wall
    return squared_radius(z, shape.lv_radius + shape.lv_wall, widest, tip, shape.lv_narrowing)


@asked
def rv_depth(z: float, shape: Shape) -> tuple[float, float]:
    """Distance (mm) from septum to free wall in the middle of the right ventricle; its slope.

    Negative below the apex of the right ventricle.
    """
    widest = -0.2 * shape.lv_length
    tip = -shape.rv_reach * shape.lv_length
    if z <= widest:
        u = (widest - z) / (widest - tip)
        return shape.rv_width * (1 - u * u), shape.rv_width * 2 * u / (widest - tip)
    u = z / -widest + 1
    t = 0.12 * u * u
    value = 1 - t / (1 + t / FLAT)
    return shape.rv_width * value, -shape.rv_width * 0.24 * u / -widest / (1 + t / FLAT) ** 2


@asked
def rv_share(angle: float, shape: Shape) -> tuple[float, float]:
    """Thickness of the crescent at an angle, 1 in its middle, negative outside; its slope."""
    turn = math.pi / (2 * shape.rv_half_angle)
    offset = away_from(angle, shape.rv_angle)
    return math.cos(turn * offset), -turn * math.sin(turn * offset)
