"""Which waves count as beats: not noise, not T waves, not P waves; and how tall and steep one is.

Heights are energies in units of the usual beat's; thresholds are places between the level of what
lies between beats (0) and that of beats (1).
"""

from __future__ import annotations

import math

from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import SHAPE_POINTS, T_STEP_S, T_STEPS, Plan, State
from pipeline.registration.waves import ALIKE, measure_beat, smooth_window

# A beat at all: is it higher than noise?
THRESHOLD = 0.3
"""A wave is a beat from this place on."""
OVERDUE_SHARE = 0.5
"""Where a beat is overdue it need be no higher than this share of it (Pan and Tompkins)."""

# Not the T wave of the beat before?
T_WAVE_S, USUAL_S = 0.36, 0.8
"""Until so long after a beat a wave of less than half its energy is that beat's T wave; where the
usual RR interval is longer than the second, later by its root (Bazett, Heart 7:353-370, 1920)."""
LATE_T_WAVE_S = 0.45
"""The same at most, and when a beat is overdue, for then the heart is slow."""
FADE_S, LARGE = 0.15, 1.6
"""Wide beats, those of another shape and those so large have late or large T waves: after them what
a wave needs falls to nothing in so long, not at once. No beat counts as larger for its T wave."""
USUAL_WIDE = 0.36
"""Where the usual beat rises by less than this share of its height in ``RISE_S``, it is wide."""
T_ENERGY, SHARP_ENERGY = 0.5, 0.3
"""Shares of a beat's energy under which a wave in that time is its T wave; the second, if the wave
is as steep as so low a beat would be, which T waves are not (after Pan and Tompkins)."""
STRANGE_T_ENERGY, STRANGE_DULL = 0.7, 0.95
"""After a beat of another shape it is the first share, for what is less steep for its height than
that beat by the second factor: a ventricle's T waves have up to two thirds of their beat's energy,
and the next beat of a run is as steep as the last."""
DULL = 0.9
"""A wave is dull whose steepness, as a share of the usual beat's, is under this share of its
height's: atrial waves and T waves. Low beats stay steep."""
T_DULL, T_USUAL, T_HIGHER = 0.7, 0.5, 1.5
"""A wave in that time that is less steep for its height than the last beat by the first factor may
be a T wave, however high. It is one where, of late, as large a share of beats as the second had one
then, and theirs were no lower than by the third factor."""
VERY_DULL = 0.4
"""Less steep for its height than the last beat by this factor are few beats of a ventricle: such a
wave is a T wave where they came of late, however high. Theirs follow breath and posture."""
T_FAR_HIGHER = 4.0
"""By this factor above theirs it is a beat of a ventricle upon the T wave all the same; and after a
usual beat, where all else is quiet, a dull wave needs no more to be none of its T wave."""
T_KNOWN = 0.02
"""Energy from which T waves have been seen; where none was, they may yet grow."""
T_NEAR, T_FOLLOW, T_EARLIER = 4, 1 / 6, 0.9
"""Then is to so many steps: the energy of a T wave has one summit or two. How fast that share, and
what is known of their energy, follow. It is so in this share of the time of T waves: coupled beats
of a ventricle come at its end, as often as T waves do."""
SPIKE = 0.65
"""Largest change in half of ``RISE_S``, as a share of that in all of it: half for what is as smooth
as QRS complexes are, 0.6 for the narrowest, 0.7 and more for a pacemaker's spikes. What follows a
spike and is dull beside it is a QRS complex."""

# Not noise, and not of the atria?
VERY_ALIKE = 0.9
"""Correlation with the usual shape from which a low wave does look like the usual beat."""
STRANGE_THRESHOLD, STRANGE_OVERDUE = 0.36, 0.20
"""A wave that does not, P waves and noise among them, is a beat from this place on; and from the
second where a beat is overdue."""
SHORT, BLUNT, ATRIAL_THRESHOLD = 0.45, 0.7, 0.6
"""One that does, but is under the first share of the usual beat's height, and under the second of
the steepness that such a height should have, is an atrial wave up to the third place."""

TINY, TINY_STEEP, TINY_THRESHOLD = 0.35, 1.7, 0.7
"""Where the usual beat is wide, P waves are the steeper ones for their height. What is under the
first share of its height is one of them up to the third place (that of atrial waves if it looks
like the usual beat), unless it is steeper for its height by the second factor, as narrow QRS
complexes among wide ones are."""

# Of a ventricle, though its energy is low?
WIDE_TALL, WIDE_ENERGY, WIDE_THRESHOLD = 0.5, 0.38, 0.1
"""A wave as tall as the first share of the usual beat is one of a ventricle from the third place
on, if it has the second share of the energy that such a height should have: beats that creep
through muscle (s.d. 25 to 35 ms) have half of it, T waves (40 to 60 ms) a fifth to a third."""
EARLY_ENERGY = 0.48
"""A wave as tall in the time of the T wave of a usual, narrow beat counts as sharp from this share
of that energy on."""
AGAIN, MOST_RESTLESS = 0.96, 0.2
"""It has to look, by this correlation, like the wave before it of which that was true, and what
lies between beats to be lower than the second share of them: noise has such waves, too."""

# When a wave shows that the beat before it was its P wave.
AHEAD_S, AHEAD = 0.25, 2.0
"""A low wave that another follows so soon, by such a factor higher, was that one's P wave: no
ventricle beats twice in that time."""
LONG_AHEAD_S = 0.32
"""Up to so late, if it was duller for its height, too: PR intervals get so long."""
LOW = 0.7
"""Low is what has less than this share of a usual beat's energy."""
OWN = 0.98
"""Correlation from which a low wave is the heart's own beat, if it came when one was due: a tug at
the electrode may follow it. P waves come too soon, and are 0.90 to 0.98 like beats."""
MUCH_TALLER, MUCH_STEEPER = 2.0, 2.5
"""By these factors R outdoes P even where P was taken for the usual beat, and came when due."""

SHARPER, OUTDONE = 1.5, 4
"""A wave that follows a beat within the refractory time, as high and sharper by the first factor,
casts doubt on it; where that happened to so many beats in succession, what was taken for beats are
the T waves of those that follow: of a fast heart both lie within that time of each other."""
SPLIT_S = 0.08
"""Two waves closer than this are of one complex."""

FIRST_BEATS, TOWERING = 12, 1.9
"""Among so many first beats two of so much energy are the beats; the others were P waves of a heart
that beats slower."""
SPAN_S, RISE_S = 0.060, 0.012
"""Height is measured this far to either side of a wave's middle; steepness is change in so long."""


@inner
def is_beat(since_s: float, height: float, plan: Plan, s: State) -> bool:
    """Whether a wave so long after a beat is too high for noise and for that beat's T wave."""
    if height < _t_wave_bar(since_s, height, plan, s):
        return False
    if _is_wide(since_s, height, plan, s):
        return True
    return _exceeds(height, OVERDUE_SHARE * THRESHOLD if s.now[0].overdue else THRESHOLD, s)


@inner
def resembles(at: int, since_s: float, height: float, plan: Plan, s: State) -> bool:
    """Measure a wave that may be a beat: does it look like one, or is it high enough besides?"""
    now = s.now[0]
    wave = s.found[now.found]
    measure_beat(at, wave, plan, s)
    tiny = now.tall < TINY and now.steep < TINY_STEEP * now.tall and wave.likeness < OWN
    place = TINY_THRESHOLD if wave.likeness < VERY_ALIKE else ATRIAL_THRESHOLD
    if tiny and _are_wide(s) and not _exceeds(height, place, s):
        return False
    if wave.likeness < VERY_ALIKE:
        again = _is_wide(since_s, height, plan, s) and _came_before(s)
        return again or _exceeds(height, STRANGE_OVERDUE if now.overdue else STRANGE_THRESHOLD, s)
    atrial = now.tall < SHORT and now.steep < BLUNT * now.tall
    return not atrial or _exceeds(height, ATRIAL_THRESHOLD, s)


@inner
def _exceeds(height: float, place: float, s: State) -> bool:
    """Whether a wave is higher than a place between the levels of noise (0) and of beats (1)."""
    between = s.now[0].between
    return height > between + place * (1.0 - between)


@inner
def _t_wave_until_s(overdue: bool, plan: Plan, s: State) -> float:
    """Until when after the last beat a wave is its T wave."""
    if overdue or _are_wide(s):
        return LATE_T_WAVE_S
    slow = math.sqrt(max(s.now[0].rhythm.usual_rr / (USUAL_S * plan.rate_hz), 1.0))
    return min(T_WAVE_S * slow, LATE_T_WAVE_S)


@inner
def _are_wide(s: State) -> bool:
    """Whether the usual beat is as wide as where a bundle branch is blocked: its T wave is late."""
    ratio, weights = 0.0, 0.0
    for lead in s.leads:
        if lead.weight > 0.0 and lead.usual.tall > 0.0:
            ratio += lead.weight * lead.usual.steep / lead.usual.tall
            weights += lead.weight
    return ratio < USUAL_WIDE * weights


@inner
def _last_was_wide(s: State) -> bool:
    """Whether the last beat was of another shape, or large: its T wave is large and may be late."""
    rhythm = s.now[0].rhythm
    return bool(rhythm.last_likeness < ALIKE or rhythm.last_height > LARGE)


@inner
def _t_wave_bar(since_s: float, height: float, plan: Plan, s: State) -> float:
    """Height that a wave so long after a beat needs to be none of its T wave."""
    now, until_s = s.now[0], _t_wave_until_s(s.now[0].overdue, plan, s)
    sharp = now.steep >= DULL * now.tall or _is_dense_early_beat(height, s)
    share = SHARP_ENERGY if sharp else T_ENERGY
    strange = now.rhythm.last_likeness < ALIKE and since_s < T_WAVE_S
    if strange and _is_duller_than_last(STRANGE_DULL, s):
        share = STRANGE_T_ENERGY
    last = min(now.rhythm.last_height, LARGE)
    bar = share * last
    known = now.rhythm.t_height > T_KNOWN and now.rhythm.beats > FIRST_BEATS
    usual = known and now.rhythm.last_likeness >= ALIKE
    if usual and now.between < MOST_RESTLESS and _is_duller_than_last(T_DULL, s):
        bar = min(bar, max(SHARP_ENERGY * last, T_FAR_HIGHER * now.rhythm.t_height))
    if since_s < until_s:
        return bar
    late = _last_was_wide(s) or _are_wide(s)
    return bar * (1.0 - (since_s - until_s) / FADE_S) if late else 0.0


@inner
def _is_dense_early_beat(height: float, s: State) -> bool:
    """Whether a wave after a usual, narrow beat has more energy for its height than T waves have.

    Not among the first beats: those may be T waves, and what is usual be theirs.
    """
    rhythm = s.now[0].rhythm
    usual = rhythm.last_likeness >= ALIKE and rhythm.beats > FIRST_BEATS
    return usual and _is_dense(EARLY_ENERGY, height, s) and not _are_wide(s)


@inner
def _is_dense(energy: float, height: float, s: State) -> bool:
    """Whether a wave is tall, and has this share of the energy that such a height should have."""
    return bool(s.now[0].tall >= WIDE_TALL and height >= energy * s.now[0].tall)


@inner
def _is_wide(since_s: float, height: float, plan: Plan, s: State) -> bool:
    """Whether a wave after the last beat's T wave is tall and wide, as beats of a ventricle are."""
    now = s.now[0]
    over_s = _t_wave_until_s(False, plan, s) + (FADE_S if _last_was_wide(s) else 0.0)
    if not _is_dense(WIDE_ENERGY, height, s) or now.between > MOST_RESTLESS:
        return False
    return since_s > over_s and _exceeds(height, WIDE_THRESHOLD, s)


@inner
def _came_before(s: State) -> bool:
    """Whether the wave measured last looks like the wide wave before it, which it now replaces."""
    likeness, weights = 0.0, 0.0
    for lead in s.leads:
        if lead.weight > 0.0:
            likeness += lead.weight * (lead.here.shape * lead.wide).sum()
            weights += lead.weight
            # Slices are filled by code of numba's that takes two seconds to compile.
            for j in range(SHAPE_POINTS):
                lead.wide[j] = lead.here.shape[j]
    return weights > 0.0 and likeness > AGAIN * weights


@inner
def is_usual_t_wave(since_s: float, height: float, plan: Plan, s: State) -> bool:
    """Whether a wave is dull and comes when such waves have come after the beats before; its time
    is noted."""
    now, rhythm = s.now[0], s.now[0].rhythm
    dull = _is_duller_than_last(T_DULL, s)
    lower = height < rhythm.last_height and rhythm.last_sharp < SPIKE
    now.after = dull and lower and since_s < T_EARLIER * _t_wave_until_s(False, plan, s)
    if not now.after:
        return False
    at = int(since_s / T_STEP_S)
    for k in range(max(at - T_NEAR, 0), min(at + T_NEAR + 1, T_STEPS)):
        rhythm.t_wave_now[k] = 1.0
    rhythm.t_height_now = max(rhythm.t_height_now, height)
    known = at < T_STEPS and rhythm.t_wave[at] > T_USUAL
    most = T_FAR_HIGHER if _is_duller_than_last(VERY_DULL, s) else T_HIGHER
    expected = height < most * rhythm.t_height
    return bool(known and expected)


@inner
def _is_duller_than_last(share: float, s: State) -> bool:
    """Whether a wave is less steep for its height than the last beat, by that factor."""
    now, rhythm = s.now[0], s.now[0].rhythm
    return bool(now.steep * rhythm.last_tall < share * (rhythm.last_steep * now.tall))


@inner
def learn_t_wave(s: State) -> None:
    """A beat that is no T wave ends the time in which those of the last one come."""
    rhythm = s.now[0].rhythm
    for k in range(T_STEPS):
        rhythm.t_wave[k] += T_FOLLOW * (rhythm.t_wave_now[k] - rhythm.t_wave[k])
        rhythm.t_wave_now[k] = 0.0
    if rhythm.t_height_now > 0.0:
        rhythm.t_height += T_FOLLOW * (rhythm.t_height_now - rhythm.t_height)
    rhythm.t_height_now = 0.0


@inner
def last_may_be_p_wave(at: int, s: State) -> bool:
    """Whether the last beat was low and did not, as the heart's own, come when one was due; or the
    wave that was measured last is a beat beside which it is none."""
    rhythm, before = s.now[0].rhythm, s.now[0].before
    if rhythm.beats < 2 or rhythm.last_height >= LOW:
        return False
    now = s.now[0]
    if now.tall > MUCH_TALLER * rhythm.last_tall and now.steep > MUCH_STEEPER * rhythm.last_steep:
        return True
    due = before.last_at + before.usual_rr
    own = rhythm.last_likeness >= OWN and abs(rhythm.last_at - due) < abs(at - due)
    return not own


@inner
def outdoes_last(since_s: float, height: float, s: State) -> bool:
    """Whether a wave is so much higher than the last beat, and sharper, as R is than P."""
    rhythm, now = s.now[0].rhythm, s.now[0]
    duller = rhythm.last_steep * now.tall < DULL * (rhythm.last_tall * now.steep)
    return height > AHEAD * rhythm.last_height and (since_s < AHEAD_S or duller)


@inner
def is_sharper_than_last(height: float, s: State) -> bool:
    """Whether a wave is as high as the last beat, and sharper than it, as R is than T."""
    rhythm, now = s.now[0].rhythm, s.now[0]
    sharper = now.steep * rhythm.last_tall > SHARPER * (rhythm.last_steep * now.tall)
    return bool(height >= rhythm.last_height and sharper)


@inner
def towers(height: float, s: State) -> bool:
    """Whether a beat is the second that shows all others so far to have been atrial waves."""
    if height < TOWERING or s.now[0].rhythm.beats > FIRST_BEATS:
        return False
    s.now[0].towers += 1
    return s.now[0].towers == 2


@inner
def measure_stature(at: int, plan: Plan, s: State) -> None:
    """How tall and steep the wave at a sample is, in shares of the usual beat's; 1 if unknown."""
    tall, steep, weights = 0.0, 0.0, 0.0
    sharp, seen = 0.0, 0.0
    for k in range(len(s.leads)):
        lead = s.leads[k]
        weight, here, usual = lead.weight, lead.here, lead.usual
        if weight <= 0.0:
            continue
        sharp += weight * _measure(k, at, plan, s)
        seen += weight
        if usual.tall > 0.0 and usual.steep > 0.0:
            tall += weight * here.tall / usual.tall
            steep += weight * here.steep / usual.steep
            weights += weight
    s.now[0].tall = tall / weights if weights > 0.0 else 1.0
    s.now[0].steep = steep / weights if weights > 0.0 else 1.0
    s.now[0].sharp = sharp / seen if seen > 0.0 else 0.0


@inner
def learn_stature(first: int, last: int, plan: Plan, s: State) -> None:
    """First heights and steepnesses: those where a lead's energy is most like a beat's."""
    for k in range(len(s.leads)):
        here, usual, best = s.leads[k].here, s.leads[k].usual, first
        for i in range(first, last + 1):
            energy, nearest = s.energy[k, i % plan.length], s.energy[k, best % plan.length]
            if abs(energy - usual.level) < abs(nearest - usual.level):
                best = i
        _measure(k, best, plan, s)
        usual.tall, usual.steep = here.tall, here.steep


@inner
def _measure(k: int, at: int, plan: Plan, s: State) -> float:
    """Height and steepness of one lead about a sample, in its own units; and how sharp it is: its
    largest change in half a rise as a share of that in a whole one."""
    here = s.leads[k].here
    span, rise = int(SPAN_S * plan.rate_hz), max(1, round(RISE_S * plan.rate_hz))
    half = max(1, int(0.5 * RISE_S * plan.rate_hz))
    window = smooth_window(s.raw[k], plan.length, at, span, span, s.fine)
    here.tall, here.steep = window.max() - window.min(), 0.0
    for i in range(rise, len(window)):
        here.steep = max(here.steep, abs(window[i] - window[i - rise]))
    quick, slow = 0.0, 1e-300
    for i in range(2 * half, len(window)):
        quick = max(quick, abs(window[i] - window[i - half]))
        slow = max(slow, abs(window[i] - window[i - 2 * half]))
    return quick / slow
