"""Sums over the samples of every frame, at one pose: the inner loops of `similarity`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pipeline.compiled import door, fetch

PARTS = 3
"""What the model is made of: blood, its walls, and, where the images end inside a chamber, blood
carried on; a model without that has two, and nothing is added up for the third."""

SUMS = 1 + PARTS + 1
"""What a part is multiplied with and added up: grey, each of the parts, and 1."""

PUSHES = 1 + PARTS + 6
"""What a change of the fitted picture is multiplied with and added up: grey, each of the parts, and
each of the six changes."""

# Samples that are asked for before the first is looked up: the model is too large for a processor's
# own caches, and the way to memory takes longer than all else. Whole fours.
_TILE = 64

_compiled = door(Path(__file__).parent, ("kernels", "../compiled"), nogil=True, cache=True)


@_compiled
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
    """Per frame: products of the parts with grey, each other and 1 (``sums``), and with the trend.

    Frames of one geometry are taken tile by tile: the trend is read once for all of them.
    """
    phases, depth, height, width, parts = share.shape
    m = index_from_tracker
    shares, beside = np.zeros((parts, _TILE), np.float32), np.zeros((_TILE, SUMS), np.float32)
    rows, every = np.zeros(_TILE, np.int64), np.arange(_TILE)
    tiles = _tiles(first, trend_row)
    for number in range(len(tiles)):
        f, start = tiles[number, 0], tiles[number, 1]
        before, after, late = lower[f], (lower[f] + 1) % phases, np.float32(weight[f])
        count, stop = 0, min(start + _TILE, first[f + 1])
        _ask_for(share, before, after, points, start, stop, m, shift[f])
        for s in range(start, stop):
            x, y, z = _moved(points, s, m)
            x, y, z = x + shift[f, 0], y + shift[f, 1], z + shift[f, 2]
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if 0 <= i < width - 1 and 0 <= j < height - 1 and 0 <= k < depth - 1:
                u, v, w = np.float32(x - i), np.float32(y - j), np.float32(z - k)
                blood, wall = _interpolate(share, before, k, j, i, w, v, u)
                blood_late, wall_late = _interpolate(share, after, k, j, i, w, v, u)
                blood += late * (blood_late - blood)
                wall += late * (wall_late - wall)
                carried = np.float32(0)
                if parts > 2:
                    carried = _carried(share, before, after, late, k, j, i, (u, v, w))[0]
                    shares[2, count] = carried
                shares[0, count], shares[1, count] = blood, wall
                _lay(beside, count, grey[s], blood, wall, carried)
                beside[count, SUMS - 1] = 1
                rows[count] = trend_row[f] + s - first[f]
                if blood > 0 or wall > 0 or carried > 0:
                    count += 1
        if count > 0:
            _fill_up(shares, rows, count)
            _multiply(sums[f], shares, count, beside, every)
            _multiply(with_trend[f], shares, count, trend, rows)


@_compiled
def _lay(beside, n, grey, blood, wall, carried):  # type: ignore[no-untyped-def]
    """What each value of a tile's sample ``n`` is multiplied with: grey, and the parts."""
    beside[n, 0], beside[n, 1], beside[n, 2], beside[n, 3] = grey, blood, wall, carried


@_compiled
def _tiles(first, trend_row):  # type: ignore[no-untyped-def]
    """Frame and first sample of every tile; of frames with one trend, all first tiles first."""
    frames, most, count, begin = len(trend_row), 0, 0, 0
    for f in range(frames):
        most += (first[f + 1] - first[f] + _TILE - 1) // _TILE
    tiles = np.empty((most, 2), np.int64)
    while begin < frames:
        end, longest = begin, 0
        while end < frames and trend_row[end] == trend_row[begin]:
            longest = max(longest, first[end + 1] - first[end])
            end += 1
        for passed in range(0, longest, _TILE):
            for f in range(begin, end):
                if first[f] + passed < first[f + 1]:
                    tiles[count, 0], tiles[count, 1] = f, first[f] + passed
                    count += 1
        begin = end
    return tiles


@_compiled
def _moved(points, s, m):  # type: ignore[no-untyped-def]
    """A sample's place by a 4x4 transform."""
    px, py, pz = points[s, 0], points[s, 1], points[s, 2]
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    return x, y, z


@_compiled
def _ask_for(share, before, after, points, start, stop, m, shift):  # type: ignore[no-untyped-def]
    """Have what the model holds around samples brought, in two phases."""
    _, depth, height, width, parts = share.shape
    address, size = np.uintp(share.ctypes.data), parts * share.itemsize
    early, late = before * depth * height * width, after * depth * height * width
    for s in range(start, stop):
        x, y, z = _moved(points, s, m)
        x, y, z = x + shift[0], y + shift[1], z + shift[2]
        if 0 <= x < width - 1 and 0 <= y < height - 1 and 0 <= z < depth - 1:
            for k in range(int(z), int(z) + 2):
                for j in range(int(y), int(y) + 2):
                    node = (k * height + j) * width + int(x)
                    fetch(address + np.uintp(size * (early + node)))
                    fetch(address + np.uintp(size * (late + node)))


@_compiled
def _fill_up(values, rows, count):  # type: ignore[no-untyped-def]
    """Make ``count`` samples of a tile whole fours, the last of no weight."""
    for n in range(count, (count + 3) // 4 * 4):
        rows[n] = rows[count - 1]
        for v in range(len(values)):
            values[v, n] = 0


@_compiled
def _multiply(sums, values, count, table, rows):  # type: ignore[no-untyped-def]
    """Add the products of a tile's values with rows of a table, four samples at a time.

    Sums over one tile are short enough for single precision.
    """
    columns = table.shape[1]
    tile = np.empty(columns, np.float32)
    for v in range(len(values)):
        for column in range(columns):
            tile[column] = 0
        for n in range(0, count, 4):
            a, b, c, d = values[v, n], values[v, n + 1], values[v, n + 2], values[v, n + 3]
            row_a, row_b, row_c, row_d = rows[n], rows[n + 1], rows[n + 2], rows[n + 3]
            for column in range(columns):
                tile[column] += (a * table[row_a, column] + b * table[row_b, column]) + (
                    c * table[row_c, column] + d * table[row_d, column]
                )
        for column in range(columns):
            sums[v, column] += tile[column]


@_compiled
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


@_compiled
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
    with_trend,
):
    """Per frame: products of the fitted picture's six changes with a step of the pose with grey,
    the model's parts and each other (``pushes``), and with the trend; in tiles as `add_up`."""
    phases, depth, height, width, parts = share.shape
    m = index_from_tracker
    changes, beside = np.zeros((6, _TILE), np.float32), np.zeros((_TILE, PUSHES), np.float32)
    rows, every = np.zeros(_TILE, np.int64), np.arange(_TILE)
    tiles = _tiles(first, trend_row)
    for number in range(len(tiles)):
        f, start = tiles[number, 0], tiles[number, 1]
        before, after, late = lower[f], (lower[f] + 1) % phases, np.float32(weight[f])
        count, stop = 0, min(start + _TILE, first[f + 1])
        _ask_for(share, before, after, points, start, stop, m, shift[f])
        for s in range(start, stop):
            x, y, z = _moved(points, s, m)
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
                slope_x /= spacing_mm[0]
                slope_y /= spacing_mm[1]
                slope_z /= spacing_mm[2]
                ax = (x - centre[0]) * spacing_mm[0] * turn
                ay = (y - centre[1]) * spacing_mm[1] * turn
                az = (z - centre[2]) * spacing_mm[2] * turn
                _change(changes, count, slope_x, slope_y, slope_z, ax, ay, az)
                _lay(beside, count, grey[s], blood, wall, carried)
                for change in range(6):
                    beside[count, 1 + PARTS + change] = changes[change, count]
                rows[count] = trend_row[f] + s - first[f]
                if blood > 0 or wall > 0 or carried > 0:
                    count += 1
        if count > 0:
            _fill_up(changes, rows, count)
            _multiply(pushes[f], changes, count, beside, every)
            _multiply(with_trend[f], changes, count, trend, rows)


@_compiled
def _change(changes, n, x, y, z, ax, ay, az):  # type: ignore[no-untyped-def]
    """Changes by a shift along each axis, and by a turn about each: the arm times the slope."""
    changes[0, n], changes[1, n], changes[2, n] = x, y, z
    changes[3, n], changes[4, n], changes[5, n] = ay * z - az * y, az * x - ax * z, ax * y - ay * x


@_compiled
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


@_compiled
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
