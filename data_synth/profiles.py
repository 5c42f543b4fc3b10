"""Outlines of the ventricles along the long axis: shared by anatomy and motion.

Squared radii are used throughout, for they stay smooth where a cavity closes at its apex.
"""

from __future__ import annotations

import math

from data_synth.kernels import Shape, compiled

FLAT = 0.45
"""Above the mitral plane the outline loses at most this share of its squared radius."""
FULLNESS = 0.35
"""Weight of the fourth power: how blunt the apex is."""


@compiled
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


@compiled
def endocardium(z: float, shape: Shape) -> tuple[float, float]:
    """Squared radius of the left cavity and its slope along z."""
    widest = -shape.lv_widest * shape.lv_length
    return squared_radius(z, shape.lv_radius, widest, -shape.lv_length, shape.lv_narrowing)


@compiled
def epicardium(z: float, shape: Shape) -> tuple[float, float]:
    """Squared radius of the outside of the left ventricle and its slope along z."""
    widest = -shape.lv_widest * shape.lv_length
    tip = -shape.lv_length - shape.apex_wall
    return squared_radius(z, shape.lv_radius + shape.lv_wall, widest, tip, shape.lv_narrowing)


@compiled
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


@compiled
def rv_share(angle: float, shape: Shape) -> tuple[float, float]:
    """Thickness of the crescent at an angle, 1 in its middle, negative outside; its slope."""
    turn = math.pi / (2 * shape.rv_half_angle)
    offset = angle - shape.rv_angle
    offset -= 2 * math.pi * math.floor(offset / (2 * math.pi) + 0.5)
    return math.cos(turn * offset), -turn * math.sin(turn * offset)
