"""Which waves of a running electrocardiogram are beats: the compiled detector.

The design is that of J. Pan and W. J. Tompkins, "A real-time QRS detection algorithm", IEEE Trans
Biomed Eng 32 (1985) 230-236, with the rules of P. Hamilton, "Open source ECG analysis", Comput
Cardiol 29 (2002) 101-104: energy in the band of the QRS complex, levels of beats and of noise with
a threshold between them, a second look at half the threshold when a beat is overdue, and a bar for
T waves. Three things differ. The energy is the envelope of one complex wavelet (a Gaussian's second
derivative and its Hilbert transform), which does not depend on polarity and weighs a T wave as high
as R with a sixth. Leads add up, each in units of its own beats, weighted by how far those stand out
of what lies between (inverse variance), so a lead that is lost or noisy has no say. And all is
reckoned in seconds: sampling rates differ in nothing but the number of samples.
"""

from __future__ import annotations

import math

from pipeline.geometry import Float
from pipeline.registration.compiled import compiled
from pipeline.registration.detector_state import (
    BAD_UNTIL,
    BEATS,
    BEST,
    BEST_AT,
    BETWEEN,
    FOUND,
    HEIGHT,
    INSTEAD,
    INTERVALS,
    KEPT_INTERVALS,
    KEPT_WAVES,
    KNOWN,
    LAST,
    LAST_BEAT,
    LAST_HEIGHT,
    LAST_LIKENESS,
    LAST_STEEP,
    LAST_TALL,
    LATE,
    LEARN_AT,
    LEARNT,
    LEARNT_OF_BEATS,
    LEVEL,
    LIKENESS,
    NOISE,
    RUN,
    SEEN,
    STEEP,
    STEEP_NOW,
    STRANGE,
    TALL,
    TALL_NOW,
    USABLE,
    USUAL_RR,
    WAITING,
    WEIGHT,
    Plan,
    State,
)
from pipeline.registration.levels import REFRACTORY_S, follow_noise, learn_level, wave_levels
from pipeline.registration.quality import RUN_S, SETTLE_S, shows_nothing, watch
from pipeline.registration.rules import (
    DULL,
    LATE_T_WAVE_S,
    T_WAVE_S,
    VERY_ALIKE,
    is_beat,
    learn_stature,
    measure_stature,
    resembles,
    towers,
)
from pipeline.registration.waves import learn_beat, measure_beat

AHEAD_S, LONG_AHEAD_S, AHEAD, LOW, OWN = 0.25, 0.32, 2.0, 0.7, 0.98
"""A low wave that another follows so soon, by such a factor higher, was that one's P wave: no
ventricle beats twice in that time; up to the second time, if it was duller for its height, too.
Unless it is just like a beat and came when one was due: a tug at the electrode may follow a small
beat. P waves come too soon, and are 0.90 to 0.98 like beats."""
PATIENCE_S = 0.3
"""A low wave is taken for a missed beat no sooner: it may be the P wave of a beat to come."""
OVERDUE = 1.5
"""A beat is overdue after so many mean RR intervals."""
KNOCK = 8.0
"""Energy, in units of a lead's beats, that no beat has."""
CLEAR, UNCLEAR = 3.5, 2.0
"""Beats have at least so many times the energy of what lies between them where they are plain to
see; waves that have less than so many times are none, or not all of them."""
MOST_S, LOOK_S = 6.0, 0.25
"""Where no beat is plain to see after ``LEARN_S`` it is looked for this long, this often."""
FALL = 0.7
"""Levels fall no lower at once than to this share, unless a wave looks like the usual beat."""
SILENCE, SILENCE_S, RECENT_S = 2.5, 2.5, 4.0
"""After so many RR intervals and seconds without a beat levels are learnt again; and by the waves
of so many seconds when beats are unclear."""


@compiled
def feed(block: Float, plan: Plan, s: State) -> None:
    """Take ``(n, leads)`` samples; beats that became known are rows of ``s.found``."""
    s.counters[FOUND] = 0
    for row in range(len(block)):
        _store(block[row], plan, s)
        now = s.counters[SEEN]
        s.counters[SEEN] = now + 1
        middle = now - plan.half - plan.mean
        if middle < 0:
            continue
        if s.counters[LEARNT]:
            _decide(middle, plan, s)
        elif now - s.counters[LEARN_AT] >= plan.learn:
            _learn(middle, plan, s)


@compiled
def _store(sample: Float, plan: Plan, s: State) -> None:
    """Put one sample of every lead into the rings, and filter."""
    now, length = s.counters[SEEN], plan.length
    at = now % length
    for k in range(len(sample)):
        lead, value = s.leads[k], sample[k]
        if not math.isfinite(value):
            value = lead[LAST]
            lead[BAD_UNTIL] = now + SETTLE_S * plan.rate_hz
        if now == 0:
            s.raw[k, :] = value
        else:
            watch(lead, s.raw[k], value, now, plan)
        lead[LAST] = value
        s.raw[k, at] = value
        s.raw[k, at + length] = value
        _filter(k, now, plan, s)


@compiled
def _filter(k: int, now: int, plan: Plan, s: State) -> None:
    """Power of the wavelet half its width ago, and its mean half a mean before that."""
    half, length = plan.half, plan.length
    start = (now - 2 * half) % length
    even, odd = 0.0, 0.0
    for j in range(2 * half + 1):
        value = s.raw[k, start + j]
        even += s.even[j] * value
        odd += s.odd[j] * value
    at = (now - half) % length
    s.power[k, at] = even * even + odd * odd
    s.power[k, at + length] = s.power[k, at]
    start = (now - half - 2 * plan.mean) % length
    total = 0.0
    for j in range(2 * plan.mean + 1):
        total += s.power[k, start + j]
    s.energy[k, (now - half - plan.mean) % length] = math.sqrt(total / (2 * plan.mean + 1))


@compiled
def _learn(middle: int, plan: Plan, s: State) -> None:
    """First levels, from all that has been seen; then decide about all of that."""
    first = max(0, middle - plan.length + 4 * plan.half)
    clear = False
    for k in range(len(s.leads)):
        level, noise, lone = wave_levels(k, first, middle, plan, s)
        s.leads[k, LEVEL] = level
        s.leads[k, NOISE] = max(noise, 0.02 * level)
        clear = clear or (level > CLEAR * noise and not lone)
    # A slow heart may not have beaten yet.
    s.counters[LEARN_AT] = s.counters[SEEN] + int(LOOK_S * plan.rate_hz) - plan.learn
    if not clear and (middle - first < MOST_S * plan.rate_hz or s.leads[:, LEVEL].max() <= 0.0):
        return
    s.counters[LEARNT] = 1
    learn_stature(first, middle, plan, s)
    # A record may begin with a beat; none is overdue yet.
    s.counters[LAST_BEAT] = first - int(T_WAVE_S * plan.rate_hz)
    for i in range(first, middle + 1):
        _decide(i, plan, s)


@compiled
def _decide(i: int, plan: Plan, s: State) -> None:
    """Look at the energy at sample ``i``: has a wave passed, is a beat overdue?"""
    for k in range(len(s.leads)):
        follow_noise(s.leads[k], s.energy[k, i % plan.length], plan.rate_hz)
    height = _height(i, plan, s)
    s.fused[i % plan.length] = height
    if height > s.numbers[BEST]:
        s.numbers[BEST] = height
        s.counters[BEST_AT] = i
    elif i - s.counters[BEST_AT] >= plan.confirm:
        at = s.counters[BEST_AT]
        s.numbers[BEST] = -1.0
        s.counters[BEST_AT] = i
        if s.fused[at % plan.length] > s.fused[(at - 1) % plan.length]:
            _judge(at, plan, s)
    if i - s.counters[LAST_BEAT] > OVERDUE * s.numbers[USUAL_RR]:
        _look_back(i, plan, s)


@compiled
def _height(i: int, plan: Plan, s: State) -> float:
    """Energy of all leads that are connected at sample ``i``, 1 for a usual beat."""
    total, weights, now = 0.0, 0.0, s.counters[SEEN]
    usable = False
    for k in range(len(s.leads)):
        lead = s.leads[k]
        flat = lead[RUN] >= RUN_S * plan.rate_hz
        gone = now < lead[BAD_UNTIL]
        usable = usable or not shows_nothing(lead, now, plan.rate_hz)
        lead[WEIGHT] = 0.0
        if flat or gone or lead[LEVEL] <= 0.0:
            continue
        contrast = min(lead[LEVEL] / lead[NOISE], 20.0)
        lead[WEIGHT] = contrast * contrast
        weights += lead[WEIGHT]
        total += lead[WEIGHT] * min(s.energy[k, i % plan.length] / lead[LEVEL], 2.0)
    s.counters[USABLE] = 1 if usable else 0
    return total / weights if weights > 0.0 else 0.0


@compiled
def _judge(at: int, plan: Plan, s: State) -> None:
    """Take the wave at a sample for a beat or not."""
    since_s = (at - s.counters[LAST_BEAT]) / plan.rate_hz
    low = s.numbers[LAST_HEIGHT] < LOW and not _was_due(at, s)
    ahead = since_s < LONG_AHEAD_S and s.counters[BEATS] > 1 and low
    if since_s < REFRACTORY_S and not ahead:
        return
    # Leads that turned out to be lost since then no longer count.
    _refuse_knocks(at, plan, s)
    height = _height(at, plan, s)
    measure_stature(at, plan, s)
    instead = ahead and height > AHEAD * s.numbers[LAST_HEIGHT]
    if instead and since_s >= AHEAD_S:
        sharp = s.numbers[LAST_TALL] * s.numbers[STEEP_NOW]
        instead = s.numbers[LAST_STEEP] * s.numbers[TALL_NOW] < DULL * sharp
    if instead:
        since_s = (at - s.before.counters[LAST_BEAT]) / plan.rate_hz
    if since_s < REFRACTORY_S:
        return
    if is_beat(since_s, height, 1.0, plan, s) and resembles(at, height, 1.0, plan, s):
        if instead:
            _take_back(s)
            measure_beat(at, s.found[s.counters[FOUND]], plan, s)
        s.found[s.counters[FOUND], INSTEAD] = 1.0 if instead else 0.0
        _accept(at, height, 0.0, plan, s)
        return
    s.numbers[BETWEEN] += 0.125 * (min(height, 0.6) - s.numbers[BETWEEN])
    kept = s.counters[WAITING] % KEPT_WAVES
    s.waves[kept, 0], s.waves[kept, 1] = at, height
    s.waves[kept, 2], s.waves[kept, 3] = s.numbers[STEEP_NOW], s.numbers[TALL_NOW]
    s.counters[WAITING] += 1


@compiled
def _was_due(at: int, s: State) -> bool:
    """Whether the last beat looks like one and ends the interval before it better than a wave."""
    usual, before = s.before.numbers[USUAL_RR], s.before.counters[LAST_BEAT]
    off, off_now = abs(s.counters[LAST_BEAT] - before - usual), abs(at - before - usual)
    return bool(s.numbers[LAST_LIKENESS] >= OWN and off < off_now)


@compiled
def _take_back(s: State) -> None:
    """The last beat was none: know what was known before it, and that such a wave is no beat."""
    low = min(s.numbers[LAST_HEIGHT], 0.6)
    s.numbers[BETWEEN] += 0.25 * max(low - s.numbers[BETWEEN], 0.0)
    for number in (LAST_HEIGHT, LAST_LIKENESS, LAST_STEEP, LAST_TALL, USUAL_RR):
        s.numbers[number] = s.before.numbers[number]
    for counter in (LAST_BEAT, BEATS, INTERVALS, STRANGE):
        s.counters[counter] = s.before.counters[counter]
    for column in LEARNT_OF_BEATS:
        s.leads[:, column] = s.before.leads[:, column]
    s.shapes[:] = s.before.shapes
    s.intervals[:] = s.before.intervals


@compiled
def _keep(s: State) -> None:
    """Keep what is known before a beat, should it be none."""
    s.before.leads[:] = s.leads
    s.before.shapes[:] = s.shapes
    s.before.intervals[:] = s.intervals
    s.before.counters[:] = s.counters
    s.before.numbers[:] = s.numbers


@compiled
def _refuse_knocks(at: int, plan: Plan, s: State) -> None:
    """Take the say from leads whose energy near a wave is beyond any beat's: they were knocked."""
    for k in range(len(s.leads)):
        lead, most = s.leads[k], 0.0
        for i in range(at - plan.confirm, at + plan.confirm + 1):
            most = max(most, s.energy[k, i % plan.length])
        if most > KNOCK * lead[LEVEL] > 0.0:
            lead[BAD_UNTIL] = max(lead[BAD_UNTIL], s.counters[SEEN] + 1.0)
            # Should beats have become so much larger, they count after some of them.
            lead[LEVEL] *= 1.3


@compiled
def _look_back(i: int, plan: Plan, s: State) -> None:
    """A beat is overdue: take the highest wave since the last one, or lower the levels."""
    best = -1
    for k in range(min(s.counters[WAITING], KEPT_WAVES)):
        since_s = (s.waves[k, 0] - s.counters[LAST_BEAT]) / plan.rate_hz
        fits = since_s >= REFRACTORY_S and i - s.waves[k, 0] >= PATIENCE_S * plan.rate_hz
        s.numbers[STEEP_NOW], s.numbers[TALL_NOW] = s.waves[k, 2], s.waves[k, 3]
        fits = fits and is_beat(since_s, s.waves[k, 1], 0.5, plan, s)
        if fits and (best < 0 or s.waves[k, 1] > s.waves[best, 1]):
            best = k
    if best >= 0:
        at, height = int(s.waves[best, 0]), s.waves[best, 1]
        # Of a wave that is kept only the sum over all leads is known.
        measure_stature(at, plan, s)
        if resembles(at, height, 0.5, plan, s):
            s.found[s.counters[FOUND], INSTEAD] = 0.0
            _accept(at, height, 1.0, plan, s)
            return
        s.waves[best, 1] = 0.0
    silent_s = (i - max(s.counters[LAST_BEAT], s.counters[LEARN_AT])) / plan.rate_hz
    if silent_s > max(SILENCE_S, SILENCE * s.numbers[USUAL_RR] / plan.rate_hz):
        first = s.counters[LAST_BEAT] + int(LATE_T_WAVE_S * plan.rate_hz)
        _learn_again(first, i - int(PATIENCE_S * plan.rate_hz), plan, s)


@compiled
def _learn_again(first: int, last: int, plan: Plan, s: State) -> None:
    """Beats may have become smaller, or what was taken for beats was none: new levels.

    Levels fall at once if the highest wave looks like a usual beat, and slowly if it does not: it
    may be a P wave that no beat follows.
    """
    s.counters[LEARN_AT] = s.counters[SEEN]
    first = max(first, last - plan.length + 4 * plan.half, 0)
    highest = first
    for i in range(first, last + 1):
        if s.fused[i % plan.length] > s.fused[highest % plan.length]:
            highest = i
    measure_beat(highest, s.found[s.counters[FOUND]], plan, s)
    least = 0.0 if s.found[s.counters[FOUND], LIKENESS] >= VERY_ALIKE else FALL
    for k in range(len(s.leads)):
        lead = s.leads[k]
        # A lead that is off says nothing about how large its beats are.
        if lead[WEIGHT] <= 0.0:
            continue
        level, noise, _ = wave_levels(k, first, last, plan, s)
        if level > CLEAR * noise:
            level = max(level, least * lead[LEVEL])
            for column in (TALL, STEEP):
                lead[column] *= level / lead[LEVEL] if lead[LEVEL] > 0.0 else 0.0
            lead[LEVEL], lead[NOISE] = level, noise


@compiled
def _accept(at: int, height: float, late: float, plan: Plan, s: State) -> None:
    """A beat: time it, learn from it, and report it."""
    row, anew = s.found[s.counters[FOUND]], towers(height, s)
    _keep(s)
    _learn_interval(at, plan, s)
    s.counters[LAST_BEAT] = at
    s.numbers[LAST_HEIGHT], s.numbers[LAST_LIKENESS] = height, row[LIKENESS]
    s.numbers[LAST_STEEP], s.numbers[LAST_TALL] = s.numbers[STEEP_NOW], s.numbers[TALL_NOW]
    kept = 0
    for k in range(min(s.counters[WAITING], KEPT_WAVES)):
        if s.waves[k, 0] > at:
            s.waves[kept, :] = s.waves[k, :]
            kept += 1
    s.counters[WAITING] = kept
    contrast = 0.0
    if anew:
        s.counters[INTERVALS], s.numbers[USUAL_RR] = 0, plan.rate_hz
    for k in range(len(s.leads)):
        if anew:
            s.leads[k, LEVEL] = max(s.leads[k, LEVEL], s.energy[k, at % plan.length])
        learn_level(s.leads[k], s.energy[k, at % plan.length], late)
        if s.leads[k, WEIGHT] > 0.0:
            contrast = max(contrast, s.leads[k, LEVEL] / s.leads[k, NOISE])
    row[KNOWN], row[HEIGHT], row[LATE] = s.counters[SEEN] - 1, height, late
    learn_beat(at, row, anew, plan, s)
    s.counters[FOUND] += 1
    if contrast < UNCLEAR and at - s.counters[LEARN_AT] > RECENT_S * plan.rate_hz:
        _learn_again(at - int(RECENT_S * plan.rate_hz), at, plan, s)


@compiled
def _learn_interval(at: int, plan: Plan, s: State) -> None:
    interval = float(at - s.counters[LAST_BEAT])
    s.counters[BEATS] += 1
    if s.counters[BEATS] < 2 or interval > 3.0 * plan.rate_hz:
        return
    s.intervals[s.counters[INTERVALS] % KEPT_INTERVALS] = interval
    s.counters[INTERVALS] += 1
    count = min(s.counters[INTERVALS], KEPT_INTERVALS)
    mean = 0.0
    for k in range(count):
        mean += s.intervals[k] / count
    s.numbers[USUAL_RR] = mean
