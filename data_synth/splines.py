"""Monotone rational-quadratic splines, whose inverse is the root of a quadratic equation.

Gregory and Delbourgo, IMA J. Numer. Anal. 2:123-130, 1982. A spline passes through the knots
``(x, y)`` with the slopes ``d``; positive slopes make it monotone.
"""

from __future__ import annotations

import math

from data_synth.kernels import Float, inner


@inner
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


@inner
def spline_slope(v: float, x: Float, y: Float, d: Float) -> float:
    """Derivative of :func:`spline`."""
    if v >= x[-1]:
        return 1.0
    k = 0
    while v >= x[k + 1]:
        k += 1
    width = x[k + 1] - x[k]
    mean = (y[k + 1] - y[k]) / width
    t = (v - x[k]) / width
    blend = t * (1 - t)
    low = mean + (d[k + 1] + d[k] - 2 * mean) * blend
    high = d[k + 1] * t * t + 2 * mean * blend + d[k] * (1 - t) * (1 - t)
    return float(mean * mean * high / (low * low))


@inner
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
