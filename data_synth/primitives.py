"""Building blocks of implicit bodies: distances to simple shapes, and how they are joined.

Bodies are given in millimetres, negative inside. Outside of it, ``tube`` is exact where its radius
does not change; ``ellipsoid``, ``bullet`` and ``rim`` are right to first order: value over slope of
a smooth level function, so the error is of second order in the distance to the surface.
"""

from __future__ import annotations

import math

from data_synth.kernels import Float, asked, inner


@inner
def smooth_min(a: float, b: float, k: float) -> float:
    """Union of two bodies, its seam rounded over k mm (polynomial smooth minimum)."""
    h = max(k - abs(a - b), 0.0) / k
    return min(a, b) - h * h * k / 4


@inner
def smooth_max(a: float, b: float, k: float) -> float:
    """Intersection of two bodies, its edge rounded over k mm."""
    h = max(k - abs(a - b), 0.0) / k
    return max(a, b) + h * h * k / 4


@asked
def smooth_step(t: float) -> float:
    """0 below 0, 1 above 1, with two continuous derivatives."""
    t = min(max(t, 0.0), 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)


@inner
def bump(u: float) -> tuple[float, float]:
    """1 at 0, 0 beyond 1 on either side, twice differentiable; and its slope."""
    v = 1 - u * u
    return (v * v * v, -6 * u * v * v) if v > 0 else (0.0, 0.0)


@asked
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
        squared, reach = px * px + py * py + pz * pz, best + radius
        # Deep inside a thicker piece nothing of a thinner one is nearer: then this is negative.
        if reach > 0 and squared < reach * reach:
            best = math.sqrt(squared) - radius
    return best


@inner
def box_distance(x: float, y: float, z: float, box: Float) -> float:
    """Distance to a box given as low and high corner, ``(6,)``; 0 inside."""
    dx = max(box[0] - x, x - box[3], 0.0)
    dy = max(box[1] - y, y - box[4], 0.0)
    dz = max(box[2] - z, z - box[5], 0.0)
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@inner
def boxed_tube(x: float, y: float, z: float, line: Float, box: Float, reach: float) -> float:
    """Distance to a tube; where its box is farther than ``reach``, the distance to the box.

    That is a lower bound of the distance, so nothing within ``reach`` of the tube changes.
    """
    away = box_distance(x, y, z, box)
    return away if away >= reach else tube(x, y, z, line)


@inner
def joined(
    x: float, y: float, z: float, body: float, line: Float, box: Float, k: float, reach: float
) -> float:
    """Smooth union of a body and a tube, which is looked at only where it can make a difference.

    The union is ``body`` itself wherever the tube is farther by ``k``, and the box is never
    farther than the tube; beyond ``reach`` the box stands for the tube.
    """
    away = box_distance(x, y, z, box)
    if away >= body + k:
        return body
    return smooth_min(body, away if away >= reach else tube(x, y, z, line), k)


@inner
def ellipsoid(x: float, y: float, z: float, rx: float, ry: float, rz: float) -> float:
    """First-order distance to an ellipsoid about the origin."""
    k0 = math.sqrt((x / rx) ** 2 + (y / ry) ** 2 + (z / rz) ** 2)
    k1 = math.sqrt((x / rx**2) ** 2 + (y / ry**2) ** 2 + (z / rz**2) ** 2)
    return k0 * (k0 - 1) / k1 if k1 > 1e-9 else -min(rx, ry, rz)


@inner
def bullet(s: float, value: float, slope: float, around: float) -> float:
    """First-order distance to the outline s = value(z, angle) of squared radius s.

    ``slope`` is the outline's slope along z (mm), ``around`` its slope by angle (mm^2).
    """
    return (s - value) / math.sqrt(4 * s + slope * slope + around * around / (s + 4) + 4)


@inner
def rim(x: float, y: float, half_width: float, half_depth: float) -> float:
    """First-order distance to an ellipse about the origin (squarish, as a chest is)."""
    u, v = x / half_width, y / half_depth
    level = u * u + v * v + 0.25 * u * u * v * v
    gu = (2 * u + 0.5 * u * v * v) / half_width
    gv = (2 * v + 0.5 * u * u * v) / half_depth
    return (level - 1) / max(math.sqrt(gu * gu + gv * gv), 1e-3)
