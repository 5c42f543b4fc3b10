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
    FINER,
    HEIGHT_MV,
    LEAD,
    LEAN,
    LEAN_NOW,
    LIKENESS,
    OFFSET,
    PEAK,
    SCATTER,
    SHAPE_POINTS,
    SHIFT,
    SIGN,
    STEEP,
    STEEP_HERE,
    STRANGE,
    TALL,
    TALL_HERE,
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
GROW, SHRINK = 0.3, 0.03
"""Shares by which usual height and steepness follow a beat that is taller or steeper, and less."""
_OTHER_WAY = 0.13
"""A deflection against a lead's usual direction is the main one of a beat of another shape if it is
larger by this share of the sum of both."""
_TURNED = 0.05
"""The usual direction changes when on average the other one is larger by this share."""


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
def deflection(away: Float, bend: Float, side: float) -> int:
    """Sample of the largest deflection to one side (1 up, -1 down).

    Largest is what lies far from rest and is bent besides: far alone would take an ST segment
    that the scanner lifts for rest, bent alone would take the onset of a wide wave for its summit.

    Parameters
    ----------
    away, bend
        ``(n,)`` lead against its rest, and the wavelet's even part, about the complex.
    """
    far, sharp = max(np.abs(away).max(), 1e-300), max(np.abs(bend).max(), 1e-300)
    place, most = len(away) // 2, 0.0
    for i in range(1, len(away) - 1):
        score = side * (away[i] / far + bend[i] / sharp)
        if score > most:
            place, most = i, score
    return place


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
def measure_beat(at: int, row: Float, plan: Plan, s: State) -> None:
    """Time R by all leads that show it, and compare its shape with the usual one."""
    likeness, weights, best = 0.0, 0.0, 0
    for k in range(len(s.leads)):
        lead = s.leads[k]
        if lead[WEIGHT] <= 0.0:
            continue
        lead[PEAK] = _time_lead(k, at, s.seen[k], plan, s)
        if lead[TIMED] > 0.0:
            likeness += lead[WEIGHT] * (s.seen[k] * s.shapes[k]).sum()
            weights += lead[WEIGHT]
        if lead[WEIGHT] > s.leads[best, WEIGHT]:
            best = k
    likeness = likeness / weights if weights > 0.0 else 1.0
    row[LEAD], row[LIKENESS] = best, likeness
    row[TIME] = (at + _common_time(likeness >= ALIKE, s)) / plan.rate_hz


@compiled
def learn_beat(at: int, row: Float, anew: bool, plan: Plan, s: State) -> None:
    """Let what is usual follow the beat that was measured last, or be that beat."""
    if at < BEFORE_S * plan.rate_hz:
        # The record began within this beat.
        return
    usual = row[LIKENESS] >= ALIKE
    s.counters[STRANGE] = 0 if usual else s.counters[STRANGE] + 1
    if anew or usual or s.counters[STRANGE] >= _patience(s):
        _learn_shapes(row[TIME] * plan.rate_hz - at, anew or not usual, plan, s)


@compiled
def _patience(s: State) -> float:
    """How many beats of other shapes make another shape the usual one: few, where few are known."""
    return float(min(s.leads[:, TIMED].max() + 1.0, float(FORGET_SHAPE)))


@compiled
def _time_lead(k: int, at: int, shape: Float, plan: Plan, s: State) -> float:
    """When a lead's main deflection peaks, in samples after the complex's middle.

    A lead whose R and S are about as large keeps to the one it was timed by, as long as that looks
    as usual: they are some 20 to 30 ms apart.
    """
    lead, rate_hz = s.leads[k], plan.rate_hz
    around, before = int(SEARCH_S * rate_hz), int(BEFORE_S * rate_hz)
    window = smooth_window(s.raw[k], plan.length, at, before, int(AFTER_S * rate_hz), s.coarse)
    away = above_rest(window, before, rate_hz)[before - around : before + around + 1]
    bend = smooth_window(s.raw[k], plan.length, at, around, around, s.even)
    # Bends alone tell the main side, for what the scanner adds to the ST segment is smooth.
    rise, fall = max(bend[1:-1].max(), 0.0), max(-bend[1:-1].min(), 0.0)
    lead[LEAN_NOW] = (rise - fall) / max(rise + fall, 1e-300)
    if lead[TIMED] == 0.0:
        lead[WAY] = 1.0 if rise >= fall else -1.0
        lead[LEAN] = lead[LEAN_NOW]
    lead[SIGN] = lead[WAY]
    place = deflection(away, bend, lead[SIGN])
    peak = _climb(k, at, place - around, shape, plan, s)
    if lead[LEAN_NOW] * lead[WAY] < -_OTHER_WAY and (shape * s.shapes[k]).sum() < ALIKE:
        lead[SIGN] = -lead[WAY]
        place = deflection(away, bend, lead[SIGN])
        peak = _climb(k, at, place - around, shape, plan, s)
    return _refine(k, at, place - around, peak, abs(away[place]), plan, s)


@compiled
def _climb(k: int, at: int, place: int, shape: Float, plan: Plan, s: State) -> float:
    """The summit near a sample, in samples after the complex's middle; and the shape about it."""
    reach = max(1, int(CLIMB_S * plan.rate_hz))
    sign = s.leads[k, SIGN]
    peak = place + summit(s.raw[k], plan.length, at + place, sign, s.coarse, reach)
    read_shape(s.raw[k], plan.length, at + peak, plan.rate_hz, s.even, shape)
    return float(peak)


@compiled
def _refine(k: int, at: int, place: int, peak: float, size: float, plan: Plan, s: State) -> float:
    """The peak with what smoothing moves it by, which is the same in every beat; noise is not."""
    lead, rate_hz = s.leads[k], plan.rate_hz
    reach = max(1, int(CLIMB_S * rate_hz))
    finer = place - peak + summit(s.raw[k], plan.length, at + place, lead[SIGN], s.fine, reach)
    if lead[SIGN] != lead[WAY]:
        return peak
    lead[FINER], lead[HEIGHT_MV] = finer, size
    shift, scatter = (lead[SHIFT], lead[SCATTER]) if lead[TIMED] > 0.0 else (finer, 0.0)
    return float(peak + shift / (1.0 + (scatter / (0.001 * rate_hz)) ** 2))


@compiled
def _common_time(usual: bool, s: State) -> float:
    """One time of the leads that agree with the best one.

    In a lead such as V1 the largest deflection is S, which follows R by some 30 ms; leads keep
    such offsets from beat to beat. A beat of another shape has others: there the earlier half of
    the leads decides.
    """
    if not usual:
        return _lower_median(s)
    total, weights = 0.0, 0.0
    for k in range(len(s.leads)):
        weight = s.leads[k, WEIGHT] if s.leads[k, TIMED] > 0.0 else 0.0
        own = s.leads[k, PEAK] - s.leads[k, OFFSET]
        if weight > 0.0:
            total += weight * own
            weights += weight
    return float(total / weights) if weights > 0.0 else _lower_median(s)


@compiled
def _lower_median(s: State) -> float:
    alive = s.leads[s.leads[:, WEIGHT] > 0.0][:, PEAK]
    if len(alive) == 0:
        return 0.0
    alive.sort()
    return float(alive[(len(alive) - 1) // 2])


@compiled
def _learn_shapes(together: float, anew: bool, plan: Plan, s: State) -> None:
    """Let the usual shape, direction and offset of every lead follow this beat, or be its own."""
    for k in range(len(s.leads)):
        lead = s.leads[k]
        if lead[WEIGHT] <= 0.0:
            continue
        if anew:
            lead[WAY], lead[LEAN], lead[TIMED] = lead[SIGN], lead[LEAN_NOW], 0.0
        elif lead[SIGN] != lead[WAY]:
            continue
        _learn_size(lead, plan)
        _learn_stature(lead, anew)
        lead[TIMED] = min(lead[TIMED] + 1.0, 64.0)
        share = max(1.0 / lead[TIMED], 0.02)
        lead[LEAN] += share * (lead[LEAN_NOW] - lead[LEAN])
        lead[OFFSET] += share * (lead[PEAK] - together - lead[OFFSET])
        follow = max(1.0 / lead[TIMED], 0.1)
        for j in range(SHAPE_POINTS):
            s.shapes[k, j] += follow * (s.seen[k, j] - s.shapes[k, j])
        if lead[LEAN] * lead[WAY] < -_TURNED:
            # From the next beat on this lead is timed by its other side.
            lead[TIMED] = 0.0
    s.counters[STRANGE] = 0
    _centre_offsets(s)


@compiled
def _learn_size(lead: Float, plan: Plan) -> None:
    """How high beats are, and by how much smoothing moves their summit."""
    if lead[TIMED] == 0.0:
        lead[SHIFT], lead[SIZE_MV], lead[SCATTER] = lead[FINER], lead[HEIGHT_MV], 0.0
        return
    limit = 0.003 * plan.rate_hz
    lead[SCATTER] += 0.1 * (min(abs(lead[FINER] - lead[SHIFT]), limit) - lead[SCATTER])
    lead[SHIFT] += 0.1 * min(max(lead[FINER] - lead[SHIFT], -limit), limit)
    lead[SIZE_MV] += 0.1 * (lead[HEIGHT_MV] - lead[SIZE_MV])


@compiled
def _learn_stature(lead: Float, anew: bool) -> None:
    """How tall and steep beats are; slowly downwards, for low waves may turn out to be none."""
    for usual, here in ((TALL, TALL_HERE), (STEEP, STEEP_HERE)):
        if anew or lead[usual] <= 0.0:
            lead[usual] = lead[here]
        else:
            away = lead[here] - lead[usual]
            lead[usual] += (GROW if away > 0.0 else SHRINK) * away


@compiled
def _centre_offsets(s: State) -> None:
    """Offsets are against the earlier half of the leads, for S follows R; on average, not once."""
    timed = s.leads[s.leads[:, TIMED] > 0.0]
    if len(timed) == 0:
        return
    offsets = np.sort(timed[:, OFFSET])
    middle = offsets[(len(offsets) - 1) // 2] * max(1.0 / timed[:, TIMED].min(), 0.1)
    s.leads[:, OFFSET] -= middle
