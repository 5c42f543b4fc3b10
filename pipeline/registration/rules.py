"""Which waves count as beats: thresholds, the bar for T waves, and how tall and steep a wave is."""

from __future__ import annotations

import math

from pipeline.registration.compiled import compiled
from pipeline.registration.detector_state import (
    BEATS,
    BETWEEN,
    FOUND,
    LAST_HEIGHT,
    LAST_LIKENESS,
    LEVEL,
    LIKENESS,
    STEEP,
    STEEP_HERE,
    STEEP_NOW,
    TALL,
    TALL_HERE,
    TALL_NOW,
    TOWERS,
    USUAL_RR,
    WEIGHT,
    Plan,
    State,
)
from pipeline.registration.waves import ALIKE, measure_beat, smooth_window

T_WAVE_S, USUAL_S = 0.36, 0.8
"""Until so long after a beat a wave of less than half its energy is that beat's T wave; where the
usual RR interval is longer than so, later by its root (Bazett, Heart 7:353-370, 1920)."""
LATE_T_WAVE_S = 0.45
"""The same at most, and when a beat is overdue, for then the heart is slow."""
FADE_S, LARGE = 0.15, 1.6
"""Beats of another shape, or so large, are wide or have large T waves: after them what a wave needs
falls to nothing in so long, not at once."""
T_ENERGY, SHARP_ENERGY = 0.5, 0.3
"""Shares of a beat's energy under which a wave in that time is its T wave; the second, if the wave
is as steep as so low a beat would be, which T waves are not (after Pan and Tompkins)."""
DULL = 0.9
"""A wave is dull whose steepness, as a share of the usual beat's, is under this share of its
height's: atrial waves and T waves. Low beats stay steep."""
THRESHOLD = 0.3
"""Place of the threshold between the levels of noise (0) and of beats (1)."""
STRANGE_THRESHOLD, STRANGE_LATE = 0.36, 0.20
"""The same for waves that do not look like the usual beat, P waves and noise among them; and where
a beat is overdue."""
VERY_ALIKE = 0.9
"""Correlation with the usual shape above which a low wave does look like the usual beat."""
SHORT, BLUNT, ATRIAL_THRESHOLD = 0.45, 0.7, 0.6
"""But one under the first share of the usual beat's height, and under the second of the steepness
that such a height should have, is an atrial wave up to the third place between the levels."""
FIRST_BEATS, TOWERING = 12, 1.9
"""Among so many first beats two of so much energy are the beats; the others were P waves of a heart
that beats slower."""
SPAN_S, RISE_S = 0.060, 0.012
"""Height is measured this far to either side of a wave's middle; steepness is change in so long."""


@compiled
def measure_stature(at: int, plan: Plan, s: State) -> None:
    """How tall and steep the wave at a sample is, in shares of the usual beat's; 1 if unknown."""
    tall, steep, weights = 0.0, 0.0, 0.0
    for k in range(len(s.leads)):
        lead = s.leads[k]
        if lead[WEIGHT] <= 0.0:
            continue
        _measure(k, at, plan, s)
        if lead[TALL] > 0.0 and lead[STEEP] > 0.0:
            tall += lead[WEIGHT] * lead[TALL_HERE] / lead[TALL]
            steep += lead[WEIGHT] * lead[STEEP_HERE] / lead[STEEP]
            weights += lead[WEIGHT]
    s.numbers[TALL_NOW] = tall / weights if weights > 0.0 else 1.0
    s.numbers[STEEP_NOW] = steep / weights if weights > 0.0 else 1.0


@compiled
def is_beat(since_s: float, height: float, share: float, plan: Plan, s: State) -> bool:
    """Whether a wave so long after a beat and so high exceeds a share of the threshold."""
    between, last = s.numbers[BETWEEN], s.numbers[LAST_HEIGHT]
    slow = math.sqrt(max(s.numbers[USUAL_RR] / (USUAL_S * plan.rate_hz), 1.0))
    bar_s = LATE_T_WAVE_S if share < 1.0 else min(T_WAVE_S * slow, LATE_T_WAVE_S)
    sharp = s.numbers[STEEP_NOW] >= DULL * s.numbers[TALL_NOW]
    bar = (SHARP_ENERGY if sharp else T_ENERGY) * min(last, LARGE)
    if since_s >= bar_s:
        wide = s.numbers[LAST_LIKENESS] < ALIKE or last > LARGE
        bar *= 1.0 - (since_s - bar_s) / FADE_S if wide else 0.0
    if height < bar:
        return False
    return bool(height > between + share * THRESHOLD * (1.0 - between))


@compiled
def resembles(at: int, height: float, share: float, plan: Plan, s: State) -> bool:
    """Measure a wave that may be a beat: does it look like one, or is it high enough besides?"""
    row, between = s.found[s.counters[FOUND]], s.numbers[BETWEEN]
    measure_beat(at, row, plan, s)
    strange = between + (STRANGE_THRESHOLD if share == 1.0 else STRANGE_LATE) * (1.0 - between)
    if row[LIKENESS] < VERY_ALIKE:
        return bool(height > strange)
    atrial = s.numbers[TALL_NOW] < SHORT and s.numbers[STEEP_NOW] < BLUNT * s.numbers[TALL_NOW]
    return bool(not atrial or height > between + ATRIAL_THRESHOLD * (1.0 - between))


@compiled
def towers(height: float, s: State) -> bool:
    """Whether a beat is the second that shows all others so far to have been atrial waves."""
    if height < TOWERING or s.counters[BEATS] > FIRST_BEATS:
        return False
    s.counters[TOWERS] += 1
    return bool(s.counters[TOWERS] == 2)


@compiled
def learn_stature(first: int, last: int, plan: Plan, s: State) -> None:
    """First heights and steepnesses: those where a lead's energy is most like a beat's."""
    for k in range(len(s.leads)):
        lead, best = s.leads[k], first
        for i in range(first, last + 1):
            energy, nearest = s.energy[k, i % plan.length], s.energy[k, best % plan.length]
            if abs(energy - lead[LEVEL]) < abs(nearest - lead[LEVEL]):
                best = i
        _measure(k, best, plan, s)
        lead[TALL], lead[STEEP] = lead[TALL_HERE], lead[STEEP_HERE]


@compiled
def _measure(k: int, at: int, plan: Plan, s: State) -> None:
    """Height and steepness of one lead about a sample, in its own units."""
    lead = s.leads[k]
    span, rise = int(SPAN_S * plan.rate_hz), max(1, round(RISE_S * plan.rate_hz))
    window = smooth_window(s.raw[k], plan.length, at, span, span, s.fine)
    lead[TALL_HERE], lead[STEEP_HERE] = window.max() - window.min(), 0.0
    for i in range(rise, len(window)):
        lead[STEEP_HERE] = max(lead[STEEP_HERE], abs(window[i] - window[i - rise]))
