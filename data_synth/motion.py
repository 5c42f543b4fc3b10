"""One smooth, cyclic, exactly invertible map that carries the heart through its beat.

The map runs from the heart at the R peak (where it is the identity) to any other phase. It is a
chain of maps that are monotone in one coordinate while the others rest, so each has an exact
inverse, its Jacobian determinant is a slope, and nothing can tear, fold or overlap:

1. above the mitral plane each atrium widens about its own upright axis;
2. the ventricles contract about the long axis, ``s -> f(s)`` in the squared radius ``s``; inside
   the left muscle ``f' = 1 / stretch`` with the stretch of step 3, which keeps its volume exactly;
3. the valve plane descends along the axis, while apex and atrial roof stay;
4. twist about the long axis.

Steps 1 and 2 are monotone rational-quadratic splines; see data_synth.splines.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.kernels import Float, Shape, asked, inner
from data_synth.primitives import smooth_step
from data_synth.profiles import endocardium, epicardium, rv_depth, rv_share, unevenness
from data_synth.splines import spline, spline_inverse, spline_slope

OUTER_MM = 130.0
"""Radius about the long axis beyond which the radial contraction is nil."""
ATRIAL_CORE, ATRIAL_SUPPORT = 1.2, 2.3
"""Multiples of an atrium's own radii up to which its growth is even, and at which it ends."""
KINK_MM = 9.0
"""Half-width of the rounding of the descent's corners at apex, base and roof."""
ROOF_MM = 52.0
"""Height above the mitral plane that descends no more."""
LINING, RIM = 0.94, 0.72
"""Share of the cavity's squared radius at which the muscle's law takes over, and the same at the
valve plane, where the rounded rim of the muscle leans inwards."""
TIP_MM2 = 100.0
"""Squared cavity radius about which contraction fades out towards the closed apex."""


class Beat(NamedTuple):
    """How much each part has moved at one instant; no motion at the R peak."""

    lv: float
    """Share of squared cavity radius lost by radial contraction."""
    rv: float
    """Share of the right ventricle's cross-section lost."""
    descent_lv: float
    """Way of the mitral plane towards the apex, mm."""
    descent_rv: float
    """The same of the tricuspid plane, mm."""
    twist_apex: float
    """Rotation of the apex about the long axis, radians, from +x towards +y.

    Negative in systole: seen from below, the apex turns counter-clockwise.
    """
    twist_base: float
    la: float
    """Growth of the left atrium's width, 0 for none."""
    ra: float
    infarct_angle: float = 0.0
    """Where the muscle does not contract; see Pulse."""
    infarct_half_angle: float = 1.0
    infarct_height: float = 0.5
    infarct_half_height: float = 0.3
    infarct_strength: float = 0.0


@inner
def smooth_slope(t: float) -> float:
    """Derivative of :func:`smooth_step`."""
    t = min(max(t, 0.0), 1.0)
    return 30 * t * t * (1 - t) * (1 - t)


@inner
def ramp(x: float) -> tuple[float, float]:
    """max(x, 0) with a rounded corner, twice differentiable; and its slope."""
    t = (x + KINK_MM) / (2 * KINK_MM)
    if t <= 0:
        return 0.0, 0.0
    if t >= 1:
        return x, 1.0
    return 2 * KINK_MM * t * t * t * (1 - t / 2), t * t * (3 - 2 * t)


@inner
def descent(z: float, shape: Shape) -> tuple[float, float]:
    """Share of the valve plane's way that height z takes part in; and its slope (1/mm)."""
    apex = -shape.lv_length
    rise, fall = -1 / apex, 1 / ROOF_MM
    low, low_slope = ramp(z - apex)
    base, base_slope = ramp(z)
    roof, roof_slope = ramp(z - ROOF_MM)
    share = rise * low - (rise + fall) * base + fall * roof
    return share, rise * low_slope - (rise + fall) * base_slope + fall * roof_slope


@inner
def drop(x: float, shape: Shape, beat: Beat) -> float:
    """Way of the valve plane (mm) at sideways position x: more on the right of the septum."""
    share = smooth_step((x - shape.lv_radius - shape.lv_wall) / 34)
    return beat.descent_lv + (beat.descent_rv - beat.descent_lv) * share


@inner
def plateau(u: float) -> tuple[float, float]:
    """1 up to |u| = 0.7, one half at 1, 0 from 1.3; and its integral from the middle."""
    size = abs(u)
    t = min(max((size - 0.7) / 0.6, 0.0), 1.0)
    area = min(size, 1.3) - 0.6 * t * t * t * t * (t * t - 3 * t + 2.5)
    return 1 - smooth_step(t), math.copysign(area, u)


@asked
def infarct_around(angle: float, beat: Beat) -> float:
    """Share of contraction missing at an angle, in the middle of the infarct's height."""
    if beat.infarct_strength == 0.0:
        return 0.0
    offset = angle - beat.infarct_angle
    offset -= 2 * math.pi * math.floor(offset / (2 * math.pi) + 0.5)
    return beat.infarct_strength * plateau(offset / beat.infarct_half_angle)[0]


@inner
def infarct_along(z: float, shape: Shape, beat: Beat) -> tuple[float, float]:
    """Share of contraction missing at a height, at the infarct's own angle; and its integral up
    from the apex as a share of the cavity's length.

    The patch ends at the mitral plane and short of the apex, where all angles meet.
    """
    low = max(beat.infarct_height - 1.3 * beat.infarct_half_height, 0.0)
    high = min(beat.infarct_height + 1.3 * beat.infarct_half_height, 0.93)
    half = (high - low) / 2.6
    share, area = plateau((-z / shape.lv_length - (low + high) / 2) / half)
    return share, half * (1.0 - area)


@asked
def infarct_share(z: float, angle: float, shape: Shape, beat: Beat) -> float:
    """Share of contraction missing at a height and angle of the left wall, 0 for healthy muscle."""
    around = infarct_around(angle, beat)
    return around * infarct_along(z, shape, beat)[0] if around > 0 else 0.0


@inner
def sinking(x: float, y: float, z: float, shape: Shape, beat: Beat) -> tuple[float, float]:
    """Way (mm) that a point sinks with the valve plane, and the slope of that way along z.

    Where muscle does not contract it does not shorten either, so that the valve plane sinks less
    on that side. This fades out towards the axis and outside of the left ventricle.
    """
    way = drop(x, shape, beat)
    share, slope = descent(z, shape)
    around = infarct_around(math.atan2(y, x), beat)
    if around > 0:
        radius = math.sqrt(x * x + y * y)
        around *= smooth_step(radius / 7)
        around *= 1 - smooth_step((radius - shape.lv_radius - shape.lv_wall) / 30)
        along, area = infarct_along(z, shape, beat)
        roof = 1 - smooth_step(z / ROOF_MM)
        fading = -smooth_slope(z / ROOF_MM) / ROOF_MM
        share -= around * area * roof
        slope -= around * (along * roof / shape.lv_length + area * fading)
    return way * share, way * slope


@inner
def rise(x: float, y: float, z: float, shape: Shape, beat: Beat) -> float:
    """Height from which a point has sunk to z: Newton steps on a slope between 0.6 and 1.3."""
    guess = z + sinking(x, y, z, shape, beat)[0]
    for _ in range(30):
        way, slope = sinking(x, y, guess, shape, beat)
        step = (guess - way - z) / (1 - slope)
        guess -= step
        if abs(step) < 1e-12:
            break
    return guess


@inner
def twist(radius2: float, z: float, shape: Shape, beat: Beat) -> float:
    """Angle (radians) by which a ring turns: opposite at apex and base, fading outwards."""
    u = smooth_step(-z / shape.lv_length)
    basal = 1 - smooth_step((z + 5) / 40)
    fade = 1 / (1 + (radius2 / 4900.0) ** 2)
    return (beat.twist_apex * u + beat.twist_base * (1 - u) * basal) * fade


@inner
def contraction_share(z: float) -> float:
    """1 in the ventricles, 0 in the atria."""
    return 1 - smooth_step((z + 14) / 30)


@asked
def muscle_stretch(z: float, around: float, shape: Shape, beat: Beat) -> float:
    """Length of the left wall along the axis, in its length at the R peak; see infarct_around."""
    slope = descent(z, shape)[1]
    if around > 0 and z < 0:
        slope -= around * infarct_along(z, shape, beat)[0] / shape.lv_length
    return 1 - beat.descent_lv * slope


@asked
def muscle_slope(z: float, around: float, shape: Shape, beat: Beat) -> float:
    """Growth of squared radii that keeps the left muscle's volume; 1 well above the valves."""
    return 1 + (1 / muscle_stretch(z, around, shape, beat) - 1) * (1 - smooth_step(z / 14))


@inner
def right_slope(x: float, z: float, shape: Shape, beat: Beat) -> float:
    """The same for the right free wall, at the sideways position to which it has moved."""
    stretch = 1 - drop(x, shape, beat) * descent(z, shape)[1]
    return 1 + (1 / stretch - 1) * (1 - smooth_step(z / 14))


@asked
def contracting(z: float, shape: Shape) -> float:
    """Squared radius (mm^2) of the left cavity as far as it contracts: nil at its closed tip."""
    inner = max(endocardium(z, shape)[0], 0.0)
    return contraction_share(z) * inner**3 / (inner**2 + TIP_MM2**2)


@inner
def radial_knots(
    z: float, angle: float, shape: Shape, beat: Beat, x: Float, y: Float, d: Float
) -> None:
    """Fill knots of the radial map at one height and angle: squared radii before and after.

    Knots: axis, endocardium, epicardium, inside and outside of the right free wall, outer end.
    Floors keep them apart below the apex and away from the right ventricle.
    """
    share = contraction_share(z)
    around = infarct_around(angle, beat)
    still = around * infarct_along(z, shape, beat)[0] if around > 0 else 0.0
    healthy = muscle_slope(z, 0.0, shape, beat)
    slope = muscle_slope(z, around, shape, beat) if around > 0 else healthy
    loss = beat.lv * contracting(z, shape)
    lining = LINING + (RIM - LINING) * smooth_step(1 + z / 8)
    inner = lining * endocardium(z, shape)[0]
    inner = 0.5 * (inner + math.sqrt(inner * inner + 4))
    # The same at all angles, so that the map is smooth on the axis.
    axis = healthy - loss / inner
    uneven = unevenness(z, angle, shape)[0] ** 2
    inner, loss = inner * uneven, loss * uneven
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
    y[1] = inner * slope - loss * (1 - still)
    y[2] = y[1] + (x[2] - x[1]) * slope
    y[3] = y[2] + (x[3] - x[2]) * slope * (1 - beat.rv * share * depth / (depth + 3))
    right = right_slope(math.sqrt(y[3]) * math.cos(angle), z, shape, beat)
    y[4] = y[3] + (x[4] - x[3]) * right
    y[5] = x[5]
    d[0], d[1], d[2], d[3], d[4], d[5] = axis, slope, slope, right, right, 1.0


@inner
def widen(
    p: Float,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    growth: float,
    inverse: bool,
    knots: tuple[Float, Float, Float],
) -> float:
    """Move p sideways from an atrium's upright axis (or back), in place; the slope of that map."""
    across, along = (p[0] - centre[0]) / radii[0], (p[1] - centre[1]) / radii[1]
    q = across * across + along * along
    if q >= ATRIAL_SUPPORT**2:
        return 1.0
    growth *= smooth_step(p[2] / 12)
    growth *= 1 - smooth_step((p[2] - centre[2] - 0.7 * radii[2]) / (1.3 * radii[2]))
    if growth == 0.0:
        return 1.0
    x, y, d = knots[0][:3], knots[1][:3], knots[2][:3]
    scale = (1 + growth) ** 2
    x[0], x[1], x[2] = 0.0, ATRIAL_CORE**2, ATRIAL_SUPPORT**2
    y[0], y[1], y[2] = 0.0, scale * ATRIAL_CORE**2, ATRIAL_SUPPORT**2
    d[0], d[1], d[2] = scale, (y[2] - y[1]) / (x[2] - x[1]), 1.0
    if q == 0.0:
        return scale
    moved = spline_inverse(q, x, y, d) if inverse else spline(q, x, y, d)
    ratio = math.sqrt(moved / q)
    p[0] = centre[0] + (p[0] - centre[0]) * ratio
    p[1] = centre[1] + (p[1] - centre[1]) * ratio
    return 1.0 if inverse else spline_slope(q, x, y, d)


@inner
def widen_atria(
    p: Float, shape: Shape, beat: Beat, inverse: bool, knots: tuple[Float, Float, Float]
) -> float:
    """Both atria's growth in place; the inverse undoes them in the opposite order.

    Returns the Jacobian determinant, of the forward map alone.
    """
    if p[2] <= 0:
        return 1.0
    la = (shape.la_x, shape.la_y, shape.la_z)
    la_radii = (shape.la_radius_x, shape.la_radius_y, shape.la_radius_z)
    ra = (shape.ra_x, shape.ra_y, shape.ra_z)
    ra_radii = (shape.ra_radius_x, shape.ra_radius_y, shape.ra_radius_z)
    if inverse:
        widen(p, ra, ra_radii, beat.ra, inverse, knots)
        return widen(p, la, la_radii, beat.la, inverse, knots)
    slope = widen(p, la, la_radii, beat.la, inverse, knots)
    return slope * widen(p, ra, ra_radii, beat.ra, inverse, knots)


@inner
def turn(p: Float, angle: float) -> None:
    """Turn p about the z axis, in place."""
    c, s = math.cos(angle), math.sin(angle)
    p[0], p[1] = c * p[0] - s * p[1], s * p[0] + c * p[1]


@inner
def carry_point(p: Float, shape: Shape, beat: Beat, x: Float, y: Float, d: Float) -> float:
    """Carry p in place; the Jacobian determinant there. ``x, y, d`` are room for six knots."""
    volume = widen_atria(p, shape, beat, False, (x, y, d))
    s = p[0] * p[0] + p[1] * p[1]
    radial_knots(p[2], math.atan2(p[1], p[0]), shape, beat, x, y, d)
    volume *= spline_slope(s, x, y, d)
    if s > 0:
        ratio = math.sqrt(spline(s, x, y, d) / s)
        p[0] *= ratio
        p[1] *= ratio
    way, slope = sinking(p[0], p[1], p[2], shape, beat)
    p[2] -= way
    turn(p, twist(p[0] * p[0] + p[1] * p[1], p[2], shape, beat))
    return volume * (1 - slope)


@asked
def carry_points(points: Float, shape: Shape, beat: Beat) -> Float:
    """Heart-frame points (n, 3) at the R peak -> where they are at the beat's instant."""
    moved = points.copy()
    x, y, d = np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(points)):
        carry_point(moved[n], shape, beat, x, y, d)
    return moved


@asked
def volume_ratios(points: Float, shape: Shape, beat: Beat) -> Float:
    """Jacobian determinant (n,) of :func:`carry_points` at points (n, 3) at the R peak."""
    ratios = np.empty(len(points))
    x, y, d = np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(points)):
        ratios[n] = carry_point(points[n].copy(), shape, beat, x, y, d)
    return ratios


@asked
def reference_points(points: Float, shape: Shape, beat: Beat) -> Float:
    """Exact inverse of :func:`carry_points`."""
    moved = points.copy()
    x, y, d = np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(points)):
        p = moved[n]
        s = p[0] * p[0] + p[1] * p[1]
        turn(p, -twist(s, p[2], shape, beat))
        p[2] = rise(p[0], p[1], p[2], shape, beat)
        if s > 0:
            radial_knots(p[2], math.atan2(p[1], p[0]), shape, beat, x, y, d)
            ratio = math.sqrt(spline_inverse(s, x, y, d) / s)
            p[0] *= ratio
            p[1] *= ratio
        widen_atria(p, shape, beat, True, (x, y, d))
    return moved
