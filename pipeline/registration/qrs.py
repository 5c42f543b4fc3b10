"""Which waves of a running electrocardiogram are beats: the compiled detector.

The design is that of J. Pan and W. J. Tompkins, "A real-time QRS detection algorithm", IEEE Trans
Biomed Eng 32 (1985) 230-236, with the rules of P. Hamilton, "Open source ECG analysis", Comput
Cardiol 29 (2002) 101-104. Three things differ: one wavelet's envelope for the energy, leads that
add up, and seconds for samples, so that rates differ in nothing but the number of samples.

With every sample, in this order:

1. ``store``: it goes into a ring, and ``quality`` judges whether its lead is still connected.
2. ``envelope``: energy in the band of the QRS complex is the mean envelope of one complex wavelet
   (a Gaussian's second derivative and its Hilbert transform). It does not depend on polarity and
   weighs a T wave as high as R with a sixth.
3. ``_learn``: until beats are plain to see, levels of beats and of what lies between them are
   sought in all samples so far (``levels``); then all of these are gone through anew.
4. ``fuse``: leads add up, each in units of its own beats, weighted by how far those stand out of
   what lies between (inverse variance), so a lead that is lost or noisy has no say.
5. ``_decide``: the highest sum that nothing exceeded for ``confirm`` samples is a wave. ``_judge``
   takes it for a beat if it is none of noise, T waves and P waves (``rules``), nor an echo of the
   last beat (``echoes``). It may also show
   that the beat before was its P wave, or in a fast heart a T wave: that one is unlearnt.
6. ``_look_back``: when a beat is overdue, the highest wave since the last one is judged again, by
   lower thresholds; after a long silence levels are learnt again (``_learn_again``).
7. ``_accept``: a beat, timed by its shape (``waves``), is told; levels, intervals and shapes
   follow it.
"""

from __future__ import annotations

from pipeline.geometry import Float
from pipeline.registration.compiled import asked, inner, within
from pipeline.registration.detector_state import KEPT_INTERVALS, KEPT_WAVES, Plan, State
from pipeline.registration.echoes import is_echo, keep_beat, learn_echo
from pipeline.registration.envelope import store
from pipeline.registration.leads import SILENT_EVERY_S, fuse, refuse_knocks, refuse_silent
from pipeline.registration.levels import (
    LEAST_NOISE,
    REFRACTORY_S,
    follow_noise,
    learn_level,
    wave_levels,
)
from pipeline.registration.rules import (
    LATE_T_WAVE_S,
    LONG_AHEAD_S,
    OUTDONE,
    SPLIT_S,
    T_WAVE_S,
    VERY_ALIKE,
    is_beat,
    is_sharper_than_last,
    is_usual_t_wave,
    last_may_be_p_wave,
    learn_stature,
    learn_t_wave,
    measure_stature,
    outdoes_last,
    resembles,
    towers,
)
from pipeline.registration.waves import learn_beat, measure_beat

# When a beat is overdue, and what then.
OVERDUE = 1.5
"""A beat is overdue after so many mean RR intervals (Pan and Tompkins: 1.66)."""
PATIENCE_S = 0.3
"""A low wave is taken for a missed beat no sooner: it may be the P wave of a beat to come."""
SILENCE, SILENCE_S = 2.5, 2.5
"""After so many RR intervals and seconds without a beat levels are learnt again."""
LONGEST_RR_S = 3.0
"""What is longer holds beats that were missed, and is none of the intervals."""

# When levels hold.
CLEAR, UNCLEAR = 3.5, 2.0
"""Beats have at least so many times the energy of what lies between them where they are plain to
see; waves that have less than so many times are none, or not all of them."""
RACING = 1.65
"""The same of a heart at 200 a minute, which hardly rests; noise of any colour reaches 1.55, and
more only where it comes in bursts, whose waves are not even."""
MOST_S, LOOK_S = 6.0, 0.25
"""Where no beat is plain to see after ``LEARN_S`` it is looked for this long, this often."""
RECENT_S = 4.0
"""When beats are unclear levels are learnt again by the waves of so many seconds."""
FALL = 0.7
"""Levels fall no lower at once than to this share, unless a wave looks like the usual beat."""

# What a single wave may say.
MOST_BETWEEN = 0.6
"""Height that a wave between beats counts with at most."""


@asked
def feed(block: Float, plan: Plan, s: State) -> int:
    """Take ``(n, leads)`` samples; how many beats became known: the first of ``s.found``."""
    now = s.now[0]
    now.found = 0
    for row in range(len(block)):
        store(block[row], plan, s)
        at = now.seen
        now.seen = at + 1
        middle = at - plan.half - plan.mean
        if middle < 0:
            continue
        first = middle
        if not now.learnt:
            first = _learn(middle, plan, s) if at - now.learn_at >= plan.learn else middle + 1
        for i in range(first, middle + 1):
            _decide(i, plan, s)
    return now.found


@inner
def _learn(middle: int, plan: Plan, s: State) -> int:
    """First levels, from all that has been seen; the sample from which on they decide, which is
    yet to come where no beat is plain to see."""
    now = s.now[0]
    first = max(0, middle - plan.length + 4 * plan.half)
    clear, highest = False, 0.0
    for k in range(len(s.leads)):
        level, noise, lone, _ = wave_levels(k, first, middle, plan, s)
        s.leads[k].usual.level, s.leads[k].noise = level, max(noise, LEAST_NOISE * level)
        clear = clear or (level > CLEAR * noise and not lone)
        highest = max(highest, level)
    # A slow heart may not have beaten yet.
    now.learn_at = now.seen + int(LOOK_S * plan.rate_hz) - plan.learn
    if not clear and (middle - first < MOST_S * plan.rate_hz or highest <= 0.0):
        return middle + 1
    now.learnt = True
    learn_stature(first, middle, plan, s)
    # A record may begin with a beat; none is overdue yet.
    s.now[0].rhythm.last_at = first - int(T_WAVE_S * plan.rate_hz)
    return first


@within
def _decide(i: int, plan: Plan, s: State) -> None:
    """Look at the energy at sample ``i``: has a wave passed, is a beat overdue?"""
    now, rhythm, rate_hz = s.now[0], s.now[0].rhythm, plan.rate_hz
    beat, silent = -1, False
    for k in range(len(s.leads)):
        follow_noise(s.leads[k], s.energy[k, i % plan.length], rate_hz)
    height = fuse(i, plan, s)
    s.fused[i % plan.length] = height
    if height > now.best:
        now.best, now.best_at = height, i
    elif i - now.best_at >= plan.confirm:
        at = now.best_at
        now.best, now.best_at = -1.0, i
        # Else it only falls from a wave that was judged.
        if s.fused[at % plan.length] > s.fused[(at - 1) % plan.length] and _judge(at, plan, s):
            beat = at
    if beat < 0 and i - rhythm.last_at > OVERDUE * rhythm.usual_rr:
        beat = _look_back(i, plan, s)
        silent = beat < 0 and _is_silent(i, plan, s)
    unclear = beat >= 0 and _accept(beat, plan, s)
    if unclear or silent:
        first, last = beat - int(RECENT_S * rate_hz), beat
        if silent:
            first = rhythm.last_at + int(LATE_T_WAVE_S * rate_hz)
            last = i - int(PATIENCE_S * rate_hz)
        _learn_again(first, last, i - rhythm.last_at > MOST_S * rate_hz, plan, s)


@within
def _judge(at: int, plan: Plan, s: State) -> bool:
    """Whether the wave at a sample is a beat."""
    now, rhythm = s.now[0], s.now[0].rhythm
    now.overdue = False
    since_s = (at - rhythm.last_at) / plan.rate_hz
    measure_stature(at, plan, s)
    doubted = since_s < LONG_AHEAD_S and last_may_be_p_wave(at, s)
    if since_s < SPLIT_S and not doubted:
        return False
    # Leads that turned out to be lost since then no longer count.
    refuse_knocks(at, plan, s)
    height = fuse(at, plan, s)
    measure_stature(at, plan, s)
    instead = doubted and outdoes_last(since_s, height, s)
    anew = False
    if since_s < REFRACTORY_S and not instead and is_sharper_than_last(height, s):
        rhythm.outdone = True
        anew = rhythm.outdone_before >= OUTDONE
    instead = instead or anew
    if instead:
        since_s = (at - now.before.last_at) / plan.rate_hz
    now.after = False
    usual_t_wave = not instead and is_usual_t_wave(since_s, height, plan, s)
    echo = not instead and is_echo(at, since_s, height, plan, s)
    if since_s < REFRACTORY_S or usual_t_wave or echo:
        return False
    if not is_beat(since_s, height, plan, s) or not resembles(at, since_s, height, plan, s):
        _keep(at, height, s)
        return False
    wave = s.found[now.found]
    if instead:
        _take_back(s)
        measure_beat(at, wave, plan, s)
    wave.height, wave.instead, now.anew = height, instead, anew
    return True


@inner
def _take_back(s: State) -> None:
    """The last beat was none: know what was known before it, and that such a wave is no beat."""
    now, low = s.now[0], min(s.now[0].rhythm.last_height, MOST_BETWEEN)
    now.between += 0.25 * max(low - now.between, 0.0)
    now.rhythm = now.before
    for lead in s.leads:
        lead.usual = lead.before


@inner
def _keep(at: int, height: float, s: State) -> None:
    """A wave that was no beat: learn from it, and keep it for when one is overdue."""
    now = s.now[0]
    now.between += 0.125 * (min(height, MOST_BETWEEN) - now.between)
    wave = s.waves[now.waiting % KEPT_WAVES]
    wave.at, wave.height, wave.tall, wave.steep = at, height, now.tall, now.steep
    now.waiting += 1


@within
def _look_back(i: int, plan: Plan, s: State) -> int:
    """A beat is overdue: the sample of the highest wave since the last one, if that may be it; -1
    if not."""
    now, rhythm, rate_hz = s.now[0], s.now[0].rhythm, plan.rate_hz
    now.overdue = True
    # Before some beats are known, one lead may have the levels of another's noise.
    if rhythm.beats > KEPT_INTERVALS and i % max(1, int(SILENT_EVERY_S * rate_hz)) == 0:
        refuse_silent(i, plan, s)
    best = _highest_kept(i, plan, s)
    if best < 0:
        return -1
    kept, wave = s.waves[best], s.found[now.found]
    # Of a wave that is kept only the sum over all leads is known.
    measure_stature(kept.at, plan, s)
    now.after = False
    if not resembles(kept.at, (kept.at - rhythm.last_at) / rate_hz, kept.height, plan, s):
        kept.height = 0.0
        return -1
    wave.height, wave.instead, now.anew = kept.height, False, False
    return kept.at


@inner
def _is_silent(i: int, plan: Plan, s: State) -> bool:
    """Whether no beat was found for so long that levels must be wrong."""
    rhythm = s.now[0].rhythm
    silent_s = (i - max(rhythm.last_at, s.now[0].learn_at)) / plan.rate_hz
    return silent_s > max(SILENCE_S, SILENCE * rhythm.usual_rr / plan.rate_hz)


@inner
def _highest_kept(i: int, plan: Plan, s: State) -> int:
    """The highest wave since the last beat that is high enough for one; -1 if there is none."""
    now, best = s.now[0], -1
    for k in range(min(now.waiting, KEPT_WAVES)):
        wave = s.waves[k]
        since_s = (wave.at - s.now[0].rhythm.last_at) / plan.rate_hz
        now.tall, now.steep = wave.tall, wave.steep
        if (
            since_s >= REFRACTORY_S
            and i - wave.at >= PATIENCE_S * plan.rate_hz
            and is_beat(since_s, wave.height, plan, s)
            and (best < 0 or wave.height > s.waves[best].height)
        ):
            best = k
    return best


@within
def _learn_again(first: int, last: int, racing: bool, plan: Plan, s: State) -> None:
    """Beats may have become smaller, or what was taken for beats was none: new levels.

    They are learnt where beats are plain to see, or even waves look like those of a ``racing``
    heart. Levels fall at once if the highest wave looks like a usual beat, and slowly if it does
    not: it may be a P wave that no beat follows.
    """
    s.now[0].learn_at = s.now[0].seen
    first = max(first, last - plan.length + 4 * plan.half, 0)
    highest = first
    for i in range(first, last + 1):
        if s.fused[i % plan.length] > s.fused[highest % plan.length]:
            highest = i
    wave = s.found[s.now[0].found]
    measure_beat(highest, wave, plan, s)
    least = 0.0 if wave.likeness >= VERY_ALIKE else FALL
    for k in range(len(s.leads)):
        lead, usual = s.leads[k], s.leads[k].usual
        # A lead that is off says nothing about how large its beats are.
        if lead.weight <= 0.0:
            continue
        level, noise, _, even = wave_levels(k, first, last, plan, s)
        if level > (RACING if racing and even else CLEAR) * noise:
            level = max(level, least * usual.level)
            change = level / usual.level if usual.level > 0.0 else 0.0
            usual.tall *= change
            usual.steep *= change
            usual.level, lead.noise = level, noise


@within
def _accept(at: int, plan: Plan, s: State) -> bool:
    """The wave that was judged last is a beat: learn from it, and report it; whether beats have
    become unclear."""
    now, rhythm, wave = s.now[0], s.now[0].rhythm, s.found[s.now[0].found]
    height, late = wave.height, now.overdue
    anew = towers(height, s) or now.anew
    if not now.after:
        learn_t_wave(s)
    now.before = now.rhythm
    for lead in s.leads:
        lead.before = lead.usual
    _learn_interval(at, plan, s)
    keep_beat(at, height, wave.likeness, plan, s)
    anew = learn_echo(plan, s) or anew
    rhythm.last_at, rhythm.last_height, rhythm.last_likeness = at, height, wave.likeness
    rhythm.last_tall, rhythm.last_steep = now.tall, now.steep
    rhythm.last_sharp = now.sharp
    rhythm.outdone_before = rhythm.outdone_before + 1 if rhythm.outdone else 0
    rhythm.outdone = False
    if anew:
        rhythm.intervals, rhythm.usual_rr = 0, plan.rate_hz
    _drop_waves(at, s)
    contrast = 0.0
    for k in range(len(s.leads)):
        lead, usual, energy = s.leads[k], s.leads[k].usual, s.energy[k, at % plan.length]
        if anew:
            usual.level = max(usual.level, energy)
        learn_level(lead, energy, late)
        if lead.weight > 0.0:
            contrast = max(contrast, usual.level / lead.noise)
    wave.known_at, wave.late = now.seen - 1, late
    wave.breadth = now.tall / now.steep if now.steep > 0.0 else 1.0
    learn_beat(at, wave, anew, plan, s)
    now.found += 1
    return contrast < UNCLEAR and at - now.learn_at > RECENT_S * plan.rate_hz


@inner
def _drop_waves(at: int, s: State) -> None:
    """Of the waves that are kept only those after the last beat may still be beats."""
    now, kept = s.now[0], 0
    for k in range(min(now.waiting, KEPT_WAVES)):
        if s.waves[k].at > at:
            s.waves[kept] = s.waves[k]
            kept += 1
    now.waiting = kept


@inner
def _learn_interval(at: int, plan: Plan, s: State) -> None:
    rhythm = s.now[0].rhythm
    interval = float(at - rhythm.last_at)
    rhythm.beats += 1
    if rhythm.beats < 2 or interval > LONGEST_RR_S * plan.rate_hz:
        return
    rhythm.interval[rhythm.intervals % KEPT_INTERVALS] = interval
    rhythm.intervals += 1
    count = min(rhythm.intervals, KEPT_INTERVALS)
    mean = 0.0
    for k in range(count):
        mean += rhythm.interval[k] / count
    rhythm.usual_rr = mean
