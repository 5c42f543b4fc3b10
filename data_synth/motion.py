"""One smooth, cyclic, exactly invertible map that carries the heart through its beat.

The map runs from the heart at the R peak (where it is the identity) to any other phase. It is a
chain of maps that are monotone in one coordinate while the others rest, so each has an exact
inverse and nothing can tear, fold or overlap:

1. the atria swell about their centres;
2. the ventricles contract about the long axis, ``s -> f(s)`` in the squared radius ``s``; inside
   the walls ``f' = 1 / stretch`` along the axis, which keeps the wall's volume exactly;
3. twist about the long axis;
4. the valve plane descends along the axis, while apex and atrial roof stay.

Steps 1 and 2 are monotone rational-quadratic splines, whose inverse is a quadratic equation
(Gregory and Delbourgo, IMA J. Numer. Anal. 2:123-130, 1982).
"""

from __future__ import annotations

import math

import numpy as np

from data_synth.kernels import Beat, Float, Shape, compiled
from data_synth.profiles import endocardium, epicardium, rv_depth, rv_share

OUTER_MM = 105.0
"""Radius about the long axis beyond which the radial contraction is nil."""
ATRIAL_SUPPORT = 1.55
"""Atrial growth ends at this multiple of the atrium's own radii."""
KINK_MM = 9.0
"""Half-width of the rounding of the descent's corners at apex, base and roof."""
ROOF_MM = 52.0
"""Height above the mitral plane that descends no more."""


@compiled
def spline(v: float, x: Float, y: Float, d: Float) -> float:
    """Monotone rational-quadratic spline through ``(x, y)`` with slopes ``d``; identity beyond."""
    if v >= x[-1]:
        return v
    k = 0
    while v >= x[k + 1]:
        k += 1
    width = x[k + 1] - x[k]
    mean = (y[k + 1] - y[k]) / width
    t = (v - x[k]) / width
    rise = (y[k + 1] - y[k]) * (mean * t * t + d[k] * t * (1 - t))
    return float(y[k] + rise / (mean + (d[k + 1] + d[k] - 2 * mean) * t * (1 - t)))


@compiled
def spline_inverse(w: float, x: Float, y: Float, d: Float) -> float:
    """Exact inverse of :func:`spline`: the root of a quadratic in its stable form."""
    if w >= y[-1]:
        return w
    k = 0
    while w >= y[k + 1]:
        k += 1
    height = y[k + 1] - y[k]
    mean = height / (x[k + 1] - x[k])
    bend = d[k + 1] + d[k] - 2 * mean
    up = w - y[k]
    a = height * (mean - d[k]) + up * bend
    b = height * d[k] - up * bend
    c = -mean * up
    t = 2 * c / (-b - math.sqrt(max(b * b - 4 * a * c, 0.0)))
    return float(x[k] + t * (x[k + 1] - x[k]))


@compiled
def smooth_step(t: float) -> float:
    """0 below 0, 1 above 1, with two continuous derivatives."""
    t = min(max(t, 0.0), 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)


@compiled
def ramp(x: float) -> tuple[float, float]:
    """max(x, 0) with a rounded corner, twice differentiable; and its slope."""
    t = (x + KINK_MM) / (2 * KINK_MM)
    if t <= 0:
        return 0.0, 0.0
    if t >= 1:
        return x, 1.0
    return 2 * KINK_MM * t * t * t * (1 - t / 2), t * t * (3 - 2 * t)


@compiled
def descent(z: float, shape: Shape) -> tuple[float, float]:
    """Share of the valve plane's way that height z takes part in; and its slope (1/mm)."""
    apex = -shape.lv_length
    rise, fall = -1 / apex, 1 / ROOF_MM
    low, low_slope = ramp(z - apex)
    base, base_slope = ramp(z)
    roof, roof_slope = ramp(z - ROOF_MM)
    share = rise * low - (rise + fall) * base + fall * roof
    return share, rise * low_slope - (rise + fall) * base_slope + fall * roof_slope


@compiled
def drop(x: float, beat: Beat) -> float:
    """Way of the valve plane (mm) at sideways position x: more on the right side."""
    share = smooth_step((x - 26) / 34)
    return beat.descent_lv + (beat.descent_rv - beat.descent_lv) * share


@compiled
def lower(x: float, z: float, shape: Shape, beat: Beat) -> float:
    """Height z after the descent of the valve plane."""
    return z - drop(x, beat) * descent(z, shape)[0]


@compiled
def lower_inverse(x: float, z: float, shape: Shape, beat: Beat) -> float:
    """Exact inverse of :func:`lower` by Newton steps (the slope lies between 0.6 and 1.3)."""
    way = drop(x, beat)
    guess = z + way * descent(z, shape)[0]
    for _ in range(30):
        share, slope = descent(guess, shape)
        step = (guess - way * share - z) / (1 - way * slope)
        guess -= step
        if abs(step) < 1e-12:
            break
    return guess


@compiled
def twist(radius2: float, z: float, shape: Shape, beat: Beat) -> float:
    """Angle (radians) by which a ring turns: opposite at apex and base, fading outwards."""
    u = smooth_step(-z / shape.lv_length)
    basal = 1 - smooth_step((z + 5) / 40)
    fade = 1 / (1 + (radius2 / 4900.0) ** 2)
    return (beat.twist_apex * u + beat.twist_base * (1 - u) * basal) * fade


@compiled
def contraction_share(z: float) -> float:
    """1 in the ventricles, 0 in the atria."""
    return 1 - smooth_step((z + 14) / 30)


@compiled
def radial_knots(
    z: float, angle: float, shape: Shape, beat: Beat, x: Float, y: Float, d: Float
) -> None:
    """Fill knots of the radial map at one height and angle: squared radii before and after.

    Knots: axis, endocardium, epicardium, inside and outside of the right free wall, outer end.
    Floors keep them apart below the apex and away from the right ventricle.
    """
    share = contraction_share(z)
    stretch = 1 - beat.descent_lv * descent(z, shape)[1]
    slope = 1 + (1 / stretch - 1) * share
    inner = endocardium(z, shape)[0]
    inner = 0.49 * (inner + math.sqrt(inner * inner + 100)) + 1
    outer = epicardium(z, shape)[0]
    outer = 0.5 * (outer + math.sqrt(outer * outer + 100)) + 4
    outer = inner + math.sqrt((outer - inner) ** 2 + 100)
    depth = rv_depth(z, shape)[0]
    depth = 0.5 * (depth + math.sqrt(depth * depth + 4))
    part = rv_share(angle, shape)[0]
    part = 0.5 * (part + math.sqrt(part * part + 0.01))
    depth *= part
    free = (math.sqrt(outer) + math.sqrt(depth * depth + 36)) ** 2
    x[0], x[1], x[2], x[3] = 0.0, inner, outer, free
    x[4] = (math.sqrt(free) + shape.rv_wall) ** 2
    x[5] = OUTER_MM * OUTER_MM
    y[0] = 0.0
    y[1] = inner * (slope - beat.lv * share)
    y[2] = y[1] + (x[2] - x[1]) * slope
    y[3] = y[2] + (x[3] - x[2]) * slope * (1 - beat.rv * share * depth / (depth + 3))
    y[4] = y[3] + (x[4] - x[3]) * slope
    y[5] = x[5]
    d[:] = slope
    d[0] = y[1] / inner
    d[5] = 1.0


@compiled
def swell_knots(growth: float, x: Float, y: Float, d: Float) -> None:
    """Fill knots of an atrium's growth: squared distance in units of its radii."""
    scale = (1 + growth) ** 2
    x[0], x[1], x[2] = 0.0, 1.0, ATRIAL_SUPPORT**2
    y[0], y[1], y[2] = 0.0, scale, ATRIAL_SUPPORT**2
    d[0], d[1], d[2] = scale, (y[2] - y[1]) / (x[2] - x[1]), 1.0


@compiled
def swell(p: Float, centre: Float, radii: Float, growth: float, inverse: bool) -> None:
    """Move p away from an atrium's centre by its growth (or back), in place."""
    x, y, d = np.empty(3), np.empty(3), np.empty(3)
    q = 0.0
    for axis in range(3):
        q += ((p[axis] - centre[axis]) / radii[axis]) ** 2
    if q >= ATRIAL_SUPPORT**2 or q == 0.0 or growth == 0.0:
        return
    swell_knots(growth, x, y, d)
    moved = spline_inverse(q, x, y, d) if inverse else spline(q, x, y, d)
    ratio = math.sqrt(moved / q)
    for axis in range(3):
        p[axis] = centre[axis] + (p[axis] - centre[axis]) * ratio


@compiled
def swell_atria(p: Float, shape: Shape, beat: Beat, inverse: bool) -> None:
    """Both atria's growth in place; the inverse undoes them in the opposite order."""
    la = np.array([shape.la_x, shape.la_y, shape.la_z + 5])
    la_radii = np.array([shape.la_radius_x, shape.la_radius_y, shape.la_radius_z])
    ra = np.array([shape.ra_x, shape.ra_y, shape.ra_z + 5])
    ra_radii = np.array([shape.ra_radius_x, shape.ra_radius_y, shape.ra_radius_z])
    if inverse:
        swell(p, ra, ra_radii, beat.ra, inverse)
        swell(p, la, la_radii, beat.la, inverse)
    else:
        swell(p, la, la_radii, beat.la, inverse)
        swell(p, ra, ra_radii, beat.ra, inverse)


@compiled
def turn(p: Float, angle: float) -> None:
    """Turn p about the z axis, in place."""
    c, s = math.cos(angle), math.sin(angle)
    p[0], p[1] = c * p[0] - s * p[1], s * p[0] + c * p[1]


@compiled
def carry_points(points: Float, shape: Shape, beat: Beat) -> Float:
    """Heart-frame points (n, 3) at the R peak -> where they are at the beat's instant."""
    moved = points.copy()
    x, y, d = np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(points)):
        p = moved[n]
        swell_atria(p, shape, beat, False)
        s = p[0] * p[0] + p[1] * p[1]
        if s > 0:
            radial_knots(p[2], math.atan2(p[1], p[0]), shape, beat, x, y, d)
            ratio = math.sqrt(spline(s, x, y, d) / s)
            p[0] *= ratio
            p[1] *= ratio
        turn(p, twist(p[0] * p[0] + p[1] * p[1], p[2], shape, beat))
        p[2] = lower(p[0], p[2], shape, beat)
    return moved


@compiled
def reference_points(points: Float, shape: Shape, beat: Beat) -> Float:
    """Exact inverse of :func:`carry_points`."""
    moved = points.copy()
    x, y, d = np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(points)):
        p = moved[n]
        p[2] = lower_inverse(p[0], p[2], shape, beat)
        s = p[0] * p[0] + p[1] * p[1]
        turn(p, -twist(s, p[2], shape, beat))
        if s > 0:
            radial_knots(p[2], math.atan2(p[1], p[0]), shape, beat, x, y, d)
            ratio = math.sqrt(spline_inverse(s, x, y, d) / s)
            p[0] *= ratio
            p[1] *= ratio
        swell_atria(p, shape, beat, True)
    return moved
