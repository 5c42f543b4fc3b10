"""The shape of one beat in one lead: when its main deflection peaks, and what it looks like.

All functions are compiled; rings hold every sample twice, ``length`` apart, so that a window of
samples is always one piece of memory.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry import Float
from pipeline.registration.compiled import compiled
from pipeline.registration.detector_state import (
    LEAD,
    LIKENESS,
    OFFSET,
    SCATTER,
    SHAPE_POINTS,
    SHIFT,
    SIGN,
    STRANGE,
    TIME,
    TIMED,
    WAY,
    WEIGHT,
    Plan,
    State,
)
from pipeline.registration.detector_state import SIZE as SIZE_MV

BEFORE_S, AFTER_S = 0.130, 0.100
"""Window about the middle of a QRS complex in which its main deflection is sought."""
REST_BEFORE_S, REST_AFTER_S = 0.095, 0.085
"""Beyond this the window shows the lead at rest, or nearly: PR and ST segment."""
SEARCH_S = 0.060
"""The main deflection lies this near the middle of the complex."""
CLIMB_S = 0.012
"""The summit of a deflection lies this near to where the wavelet finds it."""
SHAPE_BEFORE_S, SHAPE_STEP_S = 0.060, 0.004
"""Shapes are compared from 60 ms before R to 20 ms after it."""
ALIKE = 0.75
"""Correlation with the usual shape above which a beat has that shape."""
FORGET_SHAPE = 8
"""After so many beats in succession of other shapes the last one is the usual one."""
_OTHER_WAY = 1.3
"""A deflection against a lead's usual direction must be so much larger to be its main one."""


@compiled
def smooth_window(
    ring: Float, length: int, middle: int, before: int, after: int, kernel: Float
) -> Float:
    """``(before + after + 1,)`` samples about ``middle``, smoothed by a symmetric kernel."""
    half = len(kernel) // 2
    out = np.empty(before + after + 1)
    start = (middle - before - half) % length
    for i in range(len(out)):
        total = 0.0
        for j in range(len(kernel)):
            total += kernel[j] * ring[start + i + j]
        out[i] = total
    return out


@compiled
def vertex(before: float, at: float, after: float) -> float:
    """Where the parabola through three samples peaks, in samples from the middle one.

    >>> vertex(0.0, 1.0, 0.5) == 1 / 6
    True
    """
    bend = before - 2.0 * at + after
    if bend >= 0.0 or at < before or at < after:
        return 0.0
    return 0.5 * (before - after) / bend


@compiled
def above_rest(window: Float, before: int, rate_hz: float) -> Float:
    """The window less the line from before the QRS complex to after it: without drift."""
    early, tail = (
        max(1, before - int(REST_BEFORE_S * rate_hz)),
        before + int(REST_AFTER_S * rate_hz),
    )
    first, last = window[:early].mean(), window[tail:].mean()
    first_at, last_at = 0.5 * (early - 1), 0.5 * (tail + len(window) - 1)
    slope = (last - first) / (last_at - first_at)
    away: Float = window - first - slope * (np.arange(len(window)) - first_at)
    return away


@compiled
def main_deflection(away: Float, bend: Float, way: float) -> tuple[int, float]:
    """Sample of the largest deflection, and its height (signed).

    Largest is what lies far from rest and is bent besides: far alone would take an ST segment
    that the scanner lifts for rest, bent alone would take the onset of a wide wave for its summit.

    Parameters
    ----------
    away, bend
        ``(n,)`` lead against its rest, and the wavelet's even part, about the complex.
    way
        Direction in which this lead's beats usually point, 0 where that is not known.
    """
    far, sharp = max(np.abs(away).max(), 1e-300), max(np.abs(bend).max(), 1e-300)
    rise, fall = 0.0, 0.0
    up, down = len(away) // 2, len(away) // 2
    for i in range(1, len(away) - 1):
        score = away[i] / far + bend[i] / sharp
        if score > rise:
            up, rise = i, score
        if -score > fall:
            down, fall = i, -score
    if way > 0:
        rise *= _OTHER_WAY
    elif way < 0:
        fall *= _OTHER_WAY
    return (up, abs(away[up])) if rise >= fall else (down, -abs(away[down]))


@compiled
def summit(ring: Float, length: int, at: int, sign: float, kernel: Float, reach: int) -> float:
    """Where the smoothed signal peaks nearest to sample ``at``, in samples from it."""
    window = smooth_window(ring, length, at, reach + 1, reach + 1, kernel)
    i = reach + 1
    while i < 2 * reach + 1 and sign * window[i + 1] > sign * window[i]:
        i += 1
    while i > 1 and sign * window[i - 1] > sign * window[i]:
        i -= 1
    shift = vertex(sign * window[i - 1], sign * window[i], sign * window[i + 1])
    return i - (reach + 1) + shift


@compiled
def read_shape(
    ring: Float, length: int, peak: float, rate_hz: float, kernel: Float, shape: Float
) -> None:
    """The wavelet's even part at places about the peak into ``shape``, of unit length."""
    step, half = SHAPE_STEP_S * rate_hz, len(kernel) // 2
    first = peak - SHAPE_BEFORE_S * rate_hz
    size = 0.0
    for k in range(SHAPE_POINTS):
        start = (round(first + k * step) - half) % length
        total = 0.0
        for j in range(len(kernel)):
            total += kernel[j] * ring[start + j]
        shape[k] = total
        size += total * total
    if size > 0.0:
        size = math.sqrt(size)
        for k in range(SHAPE_POINTS):
            shape[k] /= size


@compiled
def time_beat(at: int, row: Float, plan: Plan, s: State) -> None:
    """Time R by all leads that show it, and compare its shape with the usual one."""
    count = len(s.leads)
    times, shapes = np.zeros(count), np.zeros((count, SHAPE_POINTS))
    likeness, weights, best = 0.0, 0.0, 0
    for k in range(count):
        if s.leads[k, WEIGHT] <= 0.0:
            continue
        times[k] = _time_lead(k, at, shapes[k], plan, s)
        alike = 0.0
        for j in range(SHAPE_POINTS):
            alike += shapes[k, j] * s.shapes[k, j]
        if s.leads[k, TIMED] > 0.0:
            likeness += s.leads[k, WEIGHT] * alike
            weights += s.leads[k, WEIGHT]
        if s.leads[k, WEIGHT] > s.leads[best, WEIGHT]:
            best = k
    likeness = likeness / weights if weights > 0.0 else 1.0
    usual = likeness >= ALIKE
    s.counters[STRANGE] = 0 if usual else s.counters[STRANGE] + 1
    together = _common_time(times, usual, best, s)
    row[LEAD], row[LIKENESS] = best, likeness
    row[TIME] = (at + together) / plan.rate_hz
    if usual or s.counters[STRANGE] >= FORGET_SHAPE:
        _learn_shapes(times, shapes, together, s)


@compiled
def _time_lead(k: int, at: int, shape: Float, plan: Plan, s: State) -> float:
    """When a lead's main deflection peaks, in samples after the complex's middle."""
    lead, rate_hz = s.leads[k], plan.rate_hz
    before, after = int(BEFORE_S * rate_hz), int(AFTER_S * rate_hz)
    window = smooth_window(s.raw[k], plan.length, at, before, after, s.coarse)
    around = int(SEARCH_S * rate_hz)
    away = above_rest(window, before, rate_hz)[before - around : before + around + 1]
    bend = smooth_window(s.raw[k], plan.length, at, around, around, s.even)
    peak, size = main_deflection(away, bend, lead[WAY])
    sign, peak = 1.0 if size > 0.0 else -1.0, peak - around
    reach = max(1, int(CLIMB_S * rate_hz))
    shift = summit(s.raw[k], plan.length, at + peak, sign, s.coarse, reach)
    read_shape(s.raw[k], plan.length, at + peak + shift, rate_hz, s.even, shape)
    finer = summit(s.raw[k], plan.length, at + peak, sign, s.fine, reach) - shift
    lead[SIGN] = sign
    if lead[TIMED] == 0.0:
        lead[SHIFT], lead[SIZE_MV], lead[WAY] = finer, abs(size), sign
    elif sign * lead[WAY] > 0.0:
        # What smoothing moves is the same in every beat; noise is not.
        limit = 0.003 * rate_hz
        lead[SCATTER] += 0.1 * (min(abs(finer - lead[SHIFT]), limit) - lead[SCATTER])
        lead[SHIFT] += 0.1 * min(max(finer - lead[SHIFT], -limit), limit)
        lead[SIZE_MV] += 0.1 * (abs(size) - lead[SIZE_MV])
    if sign * lead[WAY] < 0.0:
        return peak + shift
    trust = 1.0 / (1.0 + (lead[SCATTER] / (0.001 * rate_hz)) ** 2)
    return float(peak + shift + trust * lead[SHIFT])


@compiled
def _common_time(times: Float, usual: bool, best: int, s: State) -> float:
    """One time of the leads that agree with the best one.

    In a lead such as V1 the largest deflection is S, which follows R by some 30 ms; leads keep
    such offsets from beat to beat. A beat of another shape has others: there the earlier half of
    the leads decides.
    """
    if not usual:
        return _lower_median(times, s)
    total, weights = 0.0, 0.0
    for k in range(len(times)):
        weight = s.leads[k, WEIGHT] if s.leads[k, TIMED] > 0.0 else 0.0
        own = times[k] - s.leads[k, OFFSET]
        if weight > 0.0:
            total += weight * own
            weights += weight
    return float(total / weights) if weights > 0.0 else _lower_median(times, s)


@compiled
def _lower_median(times: Float, s: State) -> float:
    alive = times[s.leads[:, WEIGHT] > 0.0]
    if len(alive) == 0:
        return 0.0
    alive.sort()
    return float(alive[(len(alive) - 1) // 2])


@compiled
def _learn_shapes(times: Float, shapes: Float, together: float, s: State) -> None:
    """Let the usual shape, direction and offset of every lead follow this beat."""
    anew = s.counters[STRANGE] >= FORGET_SHAPE
    for k in range(len(times)):
        lead = s.leads[k]
        if lead[WEIGHT] <= 0.0:
            continue
        lead[WAY] = lead[SIGN] if anew else lead[WAY]
        lead[TIMED] = 1.0 if anew else min(lead[TIMED] + 1.0, 64.0)
        share = max(1.0 / lead[TIMED], 0.02)
        lead[OFFSET] += share * (times[k] - together - lead[OFFSET])
        follow = max(1.0 / lead[TIMED], 0.1)
        for j in range(SHAPE_POINTS):
            s.shapes[k, j] += follow * (shapes[k, j] - s.shapes[k, j])
    s.counters[STRANGE] = 0
    _centre_offsets(s)


@compiled
def _centre_offsets(s: State) -> None:
    """Offsets are against the earlier half of the leads, for S follows R; on average, not once."""
    timed = s.leads[s.leads[:, TIMED] > 0.0]
    offsets = np.sort(timed[:, OFFSET])
    middle = offsets[(len(offsets) - 1) // 2] * max(1.0 / timed[:, TIMED].max(), 0.02)
    s.leads[:, OFFSET] -= middle
