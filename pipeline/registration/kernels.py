"""Sums over the samples of every frame, at one pose: the inner loops of `similarity`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

PARTS = 3
"""What the model is made of: blood, its walls, and, where the images end inside a chamber, blood
carried on; a model without that has two."""

SUMS = 10
"""Per frame: grey with each of the parts; blood with each, wall with wall and with what is carried
on, that with itself; and the sum of blood and wall."""


@njit(cache=True, nogil=True)
def add_up(  # type: ignore[no-untyped-def]
    points,
    grey,
    trend,
    trend_row,
    first,
    lower,
    weight,
    share,
    index_from_tracker,
    shift,
    sums,
    with_trend,
):
    """Per frame: products of the shares with grey, trend and each other, and their own sum."""
    phases, depth, height, width, parts = share.shape
    m = index_from_tracker
    for f in range(len(first) - 1):
        before, after, late = lower[f], (lower[f] + 1) % phases, weight[f]
        for s in range(first[f], first[f + 1]):
            px, py, pz = points[s, 0], points[s, 1], points[s, 2]
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] + shift[f, 0]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] + shift[f, 1]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3] + shift[f, 2]
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if 0 <= i < width - 1 and 0 <= j < height - 1 and 0 <= k < depth - 1:
                u, v, w = np.float32(x - i), np.float32(y - j), np.float32(z - k)
                blood, wall = _interpolate(share, before, k, j, i, w, v, u)
                blood_late, wall_late = _interpolate(share, after, k, j, i, w, v, u)
                blood += late * (blood_late - blood)
                wall += late * (wall_late - wall)
                row = trend[trend_row[f] + s - first[f]]
                if blood > 0 or wall > 0:
                    _accumulate(sums[f], with_trend[f], blood, wall, grey[s], row)
                if parts > 2:
                    near = np.float32(u), np.float32(v), np.float32(w)
                    late32 = np.float32(late)
                    carried = _carried(share, before, after, late32, k, j, i, near)[0]
                    if carried > 0:
                        _accumulate_carried(
                            sums[f], with_trend[f], blood, wall, carried, grey[s], row
                        )


@njit(cache=True, nogil=True)
def _interpolate(share, phase, k, j, i, w, v, u):  # type: ignore[no-untyped-def]
    """Trilinear blood and wall in one phase."""
    blood, wall = np.float32(0), np.float32(0)
    one = np.float32(1)
    for dk in range(2):
        wk = w if dk else one - w
        for dj in range(2):
            wj = wk * (v if dj else one - v)
            near, far = wj * (one - u), wj * u
            row = share[phase, k + dk, j + dj]
            blood += near * row[i, 0] + far * row[i + 1, 0]
            wall += near * row[i, 1] + far * row[i + 1, 1]
    return blood, wall


@njit(cache=True, nogil=True)
def _accumulate(sums, with_trend, blood, wall, grey, trend):  # type: ignore[no-untyped-def]
    """Add one sample's blood and wall to a frame's sums."""
    sums[0] += blood * grey
    sums[1] += wall * grey
    sums[3] += blood * blood
    sums[4] += blood * wall
    sums[6] += wall * wall
    sums[9] += blood + wall
    for c in range(len(trend)):
        with_trend[0, c] += blood * trend[c]
        with_trend[1, c] += wall * trend[c]


@njit(cache=True, nogil=True)
def _accumulate_carried(sums, with_trend, blood, wall, carried, grey, trend):  # type: ignore[no-untyped-def]
    """Add what is carried on at one sample to a frame's sums."""
    sums[2] += carried * grey
    sums[5] += blood * carried
    sums[7] += wall * carried
    sums[8] += carried * carried
    for c in range(len(trend)):
        with_trend[2, c] += carried * trend[c]


@njit(cache=True, nogil=True)
def bend(  # type: ignore[no-untyped-def]
    points,
    grey,
    trend,
    trend_row,
    first,
    lower,
    weight,
    share,
    index_from_tracker,
    shift,
    coefficients,
    spacing_mm,
    centre,
    turn,
    pushes,
    squares,
    with_trend,
):
    """Per frame: products of the fitted picture's six changes with a step of the pose with grey
    and the model's parts (``pushes``), with each other, and with the trend."""
    phases, depth, height, width, parts = share.shape
    m = index_from_tracker
    change = np.zeros(6)
    for f in range(len(first) - 1):
        before, after, late = lower[f], (lower[f] + 1) % phases, np.float32(weight[f])
        for s in range(first[f], first[f + 1]):
            px, py, pz = points[s, 0], points[s, 1], points[s, 2]
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            at = x + shift[f, 0], y + shift[f, 1], z + shift[f, 2]
            i, j, k = math.floor(at[0]), math.floor(at[1]), math.floor(at[2])
            if 0 <= i < width - 1 and 0 <= j < height - 1 and 0 <= k < depth - 1:
                near = np.float32(at[0] - i), np.float32(at[1] - j), np.float32(at[2] - k)
                blood, wall, slope_x, slope_y, slope_z = _slope(
                    share, before, after, late, k, j, i, near, coefficients[f]
                )
                carried = np.float32(0)
                if parts > 2:
                    carried, rise_x, rise_y, rise_z = _carried(
                        share, before, after, late, k, j, i, near
                    )
                    slope_x += coefficients[f, 2] * rise_x
                    slope_y += coefficients[f, 2] * rise_y
                    slope_z += coefficients[f, 2] * rise_z
                if blood > 0 or wall > 0 or carried > 0:
                    change[0] = slope_x / spacing_mm[0]
                    change[1] = slope_y / spacing_mm[1]
                    change[2] = slope_z / spacing_mm[2]
                    ax = (x - centre[0]) * spacing_mm[0] * turn
                    ay = (y - centre[1]) * spacing_mm[1] * turn
                    az = (z - centre[2]) * spacing_mm[2] * turn
                    change[3] = ay * change[2] - az * change[1]
                    change[4] = az * change[0] - ax * change[2]
                    change[5] = ax * change[1] - ay * change[0]
                    row = trend[trend_row[f] + s - first[f]]
                    for a in range(6):
                        pushes[f, 0, a] += change[a] * grey[s]
                        pushes[f, 1, a] += change[a] * blood
                        pushes[f, 2, a] += change[a] * wall
                        if parts > 2:
                            pushes[f, 3, a] += change[a] * carried
                        for b in range(6):
                            squares[f, a, b] += change[a] * change[b]
                        for c in range(len(row)):
                            with_trend[f, a, c] += change[a] * row[c]


@njit(cache=True, nogil=True)
def _slope(share, before, after, late, k, j, i, near, coefficients):  # type: ignore[no-untyped-def]
    """Trilinear blood and wall between two phases, and the slope of their sum under the
    coefficients, a node, along x, y and z."""
    x, y, z = near
    one, nothing = np.float32(1), np.float32(0)
    early = one - late
    blood, wall, slope_x, slope_y, slope_z = nothing, nothing, nothing, nothing, nothing
    for dk in range(2):
        wk, sk = (z, one) if dk else (one - z, -one)
        for dj in range(2):
            wj, sj = (y, one) if dj else (one - y, -one)
            row, next_row = share[before, k + dk, j + dj], share[after, k + dk, j + dj]
            left_blood = early * row[i, 0] + late * next_row[i, 0]
            left_wall = early * row[i, 1] + late * next_row[i, 1]
            rise_blood = early * row[i + 1, 0] + late * next_row[i + 1, 0] - left_blood
            rise_wall = early * row[i + 1, 1] + late * next_row[i + 1, 1] - left_wall
            here_blood, here_wall = left_blood + x * rise_blood, left_wall + x * rise_wall
            blood += wj * wk * here_blood
            wall += wj * wk * here_wall
            here = coefficients[0] * here_blood + coefficients[1] * here_wall
            slope_x += wj * wk * (coefficients[0] * rise_blood + coefficients[1] * rise_wall)
            slope_y += sj * wk * here
            slope_z += sk * wj * here
    return blood, wall, slope_x, slope_y, slope_z


@njit(cache=True, nogil=True)
def _carried(share, before, after, late, k, j, i, near):  # type: ignore[no-untyped-def]
    """What is carried on between two phases, trilinear, and its slope, a node, along x, y and z."""
    x, y, z = near
    one, nothing = np.float32(1), np.float32(0)
    carried, slope_x, slope_y, slope_z = nothing, nothing, nothing, nothing
    for dk in range(2):
        wk, sk = (z, one) if dk else (one - z, -one)
        for dj in range(2):
            wj, sj = (y, one) if dj else (one - y, -one)
            row, next_row = share[before, k + dk, j + dj], share[after, k + dk, j + dj]
            left = (one - late) * row[i, 2] + late * next_row[i, 2]
            rise = (one - late) * row[i + 1, 2] + late * next_row[i + 1, 2] - left
            here = left + x * rise
            carried += wj * wk * here
            slope_x += wj * wk * rise
            slope_y += sj * wk * here
            slope_z += sk * wj * here
    return carried, slope_x, slope_y, slope_z
