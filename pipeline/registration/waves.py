"""The shape of one beat in one lead: when its main deflection peaks, and what it looks like.

All functions are compiled; rings hold every sample twice, ``length`` apart, so that a window of
samples is always one piece of memory.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry import Float
from pipeline.registration.compiled import asked, inner
from pipeline.registration.detector_state import SHAPE_POINTS, Found, Here, Plan, State, Usual

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
OTHER_WAY = 0.13
"""A deflection against a lead's usual direction is the main one of a beat of another shape if it is
larger by this share of the sum of both."""
TURNED = 0.05
"""The usual direction changes when on average the other one is larger by this share."""


@inner
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


@asked
def vertex(before: float, at: float, after: float) -> float:
    """Where the parabola through three samples peaks, in samples from the middle one.

    >>> vertex(0.0, 1.0, 0.5) == 1 / 6
    True
    """
    bend = before - 2.0 * at + after
    if bend >= 0.0 or at < before or at < after:
        return 0.0
    return 0.5 * (before - after) / bend


@inner
def above_rest(window: Float, before: int, rate_hz: float) -> Float:
    """The window less the line from before the QRS complex to after it: without drift."""
    early = max(1, before - int(REST_BEFORE_S * rate_hz))
    tail = before + int(REST_AFTER_S * rate_hz)
    first, last = window[:early].mean(), window[tail:].mean()
    first_at, last_at = 0.5 * (early - 1), 0.5 * (tail + len(window) - 1)
    slope = (last - first) / (last_at - first_at)
    away: Float = window - first - slope * (np.arange(len(window)) - first_at)
    return away


@inner
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


@inner
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


@inner
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


@inner
def measure_beat(at: int, wave: Found, plan: Plan, s: State) -> None:
    """Time R by all leads that show it, and compare its shape with the usual one."""
    likeness, weights, best = 0.0, 0.0, 0
    for k in range(len(s.leads)):
        lead = s.leads[k]
        weight, here, usual = lead.weight, lead.here, lead.usual
        if weight <= 0.0:
            continue
        here.peak = _time_lead(k, at, plan, s)
        if usual.timed > 0.0:
            likeness += weight * (here.shape * usual.shape).sum()
            weights += weight
        if weight > s.leads[best].weight:
            best = k
    wave.lead, wave.likeness = best, likeness / weights if weights > 0.0 else 1.0
    wave.time_s = (at + _common_time(wave.likeness >= ALIKE, s)) / plan.rate_hz


@inner
def _time_lead(k: int, at: int, plan: Plan, s: State) -> float:
    """When a lead's main deflection peaks, in samples after the complex's middle.

    A lead whose R and S are about as large keeps to the one it was timed by, as long as that looks
    as usual: they are some 20 to 30 ms apart.
    """
    lead, rate_hz = s.leads[k], plan.rate_hz
    here, usual = lead.here, lead.usual
    around, before = int(SEARCH_S * rate_hz), int(BEFORE_S * rate_hz)
    window = smooth_window(s.raw[k], plan.length, at, before, int(AFTER_S * rate_hz), s.coarse)
    away = above_rest(window, before, rate_hz)[before - around : before + around + 1]
    bend = smooth_window(s.raw[k], plan.length, at, around, around, s.even)
    # Bends alone tell the main side, for what the scanner adds to the ST segment is smooth.
    rise, fall = max(bend[1:-1].max(), 0.0), max(-bend[1:-1].min(), 0.0)
    here.lean = (rise - fall) / max(rise + fall, 1e-300)
    if usual.timed == 0.0:
        usual.way = 1.0 if rise >= fall else -1.0
        usual.lean = here.lean
    here.sign = usual.way
    place, peak = _climb(k, at, away, bend, plan, s)
    if here.lean * usual.way < -OTHER_WAY and (here.shape * usual.shape).sum() < ALIKE:
        here.sign = -usual.way
        place, peak = _climb(k, at, away, bend, plan, s)
    return _refine(k, at, place, peak, abs(away[around + place]), plan, s)


@inner
def _climb(k: int, at: int, away: Float, bend: Float, plan: Plan, s: State) -> tuple[int, float]:
    """The largest deflection to a lead's side, and the summit near it, in samples after the
    complex's middle; and the shape about it."""
    here, reach = s.leads[k].here, max(1, int(CLIMB_S * plan.rate_hz))
    place = deflection(away, bend, here.sign) - len(away) // 2
    peak = place + summit(s.raw[k], plan.length, at + place, here.sign, s.coarse, reach)
    read_shape(s.raw[k], plan.length, at + peak, plan.rate_hz, s.even, here.shape)
    return place, peak


@inner
def _refine(k: int, at: int, place: int, peak: float, size: float, plan: Plan, s: State) -> float:
    """The peak with what smoothing moves it by, which is the same in every beat; noise is not."""
    here, usual = s.leads[k].here, s.leads[k].usual
    if here.sign != usual.way:
        return peak
    reach = max(1, int(CLIMB_S * plan.rate_hz))
    fine = summit(s.raw[k], plan.length, at + place, here.sign, s.fine, reach)
    here.shift, here.size_mv = place - peak + fine, size
    if usual.timed == 0.0:
        return peak + here.shift
    return peak + usual.shift / (1.0 + (usual.scatter / (0.001 * plan.rate_hz)) ** 2)


@inner
def _common_time(usual: bool, s: State) -> float:
    """One time of the leads that agree with the best one.

    In a lead such as V1 the largest deflection is S, which follows R by some 30 ms; leads keep
    such offsets from beat to beat. A beat of another shape has others: there the earlier half of
    the leads decides.
    """
    total, weights = 0.0, 0.0
    for lead in s.leads:
        if usual and lead.weight > 0.0 and lead.usual.timed > 0.0:
            total += lead.weight * (lead.here.peak - lead.usual.offset)
            weights += lead.weight
    if weights > 0.0:
        return total / weights
    peaks, count = np.empty(len(s.leads)), 0
    for lead in s.leads:
        if lead.weight > 0.0:
            peaks[count] = lead.here.peak
            count += 1
    return _lower_median(peaks[:count]) if count else 0.0


@inner
def _lower_median(values: Float) -> float:
    return float(np.sort(values)[(len(values) - 1) // 2])


@inner
def learn_beat(at: int, wave: Found, anew: bool, plan: Plan, s: State) -> None:
    """Let what is usual follow the beat that was measured last, or be that beat."""
    if at < BEFORE_S * plan.rate_hz:
        # The record began within this beat.
        return
    rhythm, usual = s.now[0].rhythm, wave.likeness >= ALIKE
    rhythm.strange = 0 if usual else rhythm.strange + 1
    if anew or usual or rhythm.strange >= _patience(s):
        _learn_shapes(wave.time_s * plan.rate_hz - at, anew or not usual, plan, s)


@inner
def _patience(s: State) -> float:
    """How many beats of other shapes make another shape the usual one: few, where few are known."""
    known = 0.0
    for lead in s.leads:
        known = max(known, lead.usual.timed)
    return min(known + 1.0, float(FORGET_SHAPE))


@inner
def _learn_shapes(together: float, anew: bool, plan: Plan, s: State) -> None:
    """Let the usual shape, direction and offset of every lead follow this beat, or be its own."""
    for lead in s.leads:
        here, usual = lead.here, lead.usual
        if lead.weight <= 0.0:
            continue
        if anew:
            usual.way, usual.lean, usual.timed = here.sign, here.lean, 0.0
        elif here.sign != usual.way:
            continue
        _learn_size(here, usual, plan.rate_hz)
        usual.tall = _follow(usual.tall, here.tall, anew)
        usual.steep = _follow(usual.steep, here.steep, anew)
        usual.timed = min(usual.timed + 1.0, 64.0)
        # A mean of all beats so far, later of the latest ones.
        share, follow = max(1.0 / usual.timed, 0.02), max(1.0 / usual.timed, 0.1)
        usual.lean += share * (here.lean - usual.lean)
        usual.offset += share * (here.peak - together - usual.offset)
        for j in range(SHAPE_POINTS):
            usual.shape[j] += follow * (here.shape[j] - usual.shape[j])
        if usual.lean * usual.way < -TURNED:
            # From the next beat on this lead is timed by its other side.
            usual.timed = 0.0
    s.now[0].rhythm.strange = 0
    _centre_offsets(s)


@inner
def _learn_size(here: Here, usual: Usual, rate_hz: float) -> None:
    """How high beats are, and by how much smoothing moves their summit."""
    if usual.timed == 0.0:
        usual.shift, usual.size_mv, usual.scatter = here.shift, here.size_mv, 0.0
        return
    limit = 0.003 * rate_hz
    usual.scatter += 0.1 * (min(abs(here.shift - usual.shift), limit) - usual.scatter)
    usual.shift += 0.1 * min(max(here.shift - usual.shift, -limit), limit)
    usual.size_mv += 0.1 * (here.size_mv - usual.size_mv)


@inner
def _follow(usual: float, here: float, anew: bool) -> float:
    """A usual height or steepness after a beat; slowly downwards, for low waves may be none."""
    if anew or usual <= 0.0:
        return here
    return usual + (GROW if here > usual else SHRINK) * (here - usual)


@inner
def _centre_offsets(s: State) -> None:
    """Offsets are against the earlier half of the leads, for S follows R; on average, not once."""
    offsets, count, fewest = np.empty(len(s.leads)), 0, np.inf
    for lead in s.leads:
        usual = lead.usual
        if usual.timed > 0.0:
            offsets[count], fewest = usual.offset, min(fewest, usual.timed)
            count += 1
    if count == 0:
        return
    middle = _lower_median(offsets[:count]) * max(1.0 / fewest, 0.1)
    for lead in s.leads:
        lead.usual.offset -= middle
