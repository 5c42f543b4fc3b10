"""Waves as sharp as beats that follow every beat: echoes, no beats.

In a scanner's field the blood itself makes voltages as its flow turns (Krug and others, "A database
of electrocardiogram signals acquired in different magnetic resonance imaging scanners", Comput
Cardiol 44, 2017). They are known by coming after beat upon beat, as late, as high and as unlike it.
"""

from __future__ import annotations

import numpy as np

from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import KEPT_BEATS, Plan, State
from pipeline.registration.waves import ALIKE, measure_beat

FROM_S, UNTIL_S, SPREAD_S = 0.22, 0.46, 0.06
"""An echo comes so long after its beat, with little spread from beat to beat."""
HEIGHT, EVEN_HEIGHT, EVENLY = 0.65, 0.5, 0.1
"""It has on average less than this share of the beat's energy; or than the second, where both take
turns at intervals as even as the third: so do beats of a racing heart, one larger than the next."""
LONGEST_S, STEADY = 1.25, 0.8
"""Beats it follows are no farther apart, for a ventricle's that follow each of the heart's own have
a pause after them; and their shortest interval has this share of their longest."""
BROAD, UNLIKE = 1.4, 0.03
"""What is broader than the beats by the first factor comes from a ventricle. Beats of the atria are
as like the usual one as the heart's own; each of some echoes is less like it than every one of the
beats, or more, by the second. Means would not tell: noise takes more of the likeness of low beats.
"""
HIGHER, NEAR_S, FOLLOW, GONE = 1.5, 0.05, 1 / 16, 0.15
"""What comes within so long of its time, and is no higher than by the first factor, is one. What is
known of it follows by a share, until it came after fewer than the last of these."""


@inner
def keep_beat(at: int, height: float, likeness: float, plan: Plan, s: State) -> None:
    """Keep a beat among the latest, and what is known of echoes, now that its predecessor's time
    for one is over. After a pause it does not count: a beat of a ventricle may have come before."""
    now, rhythm = s.now[0], s.now[0].rhythm
    slot = rhythm.beats % KEPT_BEATS
    rhythm.at[slot], rhythm.height[slot], rhythm.alike[slot] = at, height, likeness
    rhythm.breadth[slot] = now.tall / now.steep if now.steep > 0.0 else 1.0
    if rhythm.echo_s > 0.0:
        paused = at - rhythm.last_at > LONGEST_S * plan.rate_hz
        came = 1.0 if rhythm.echoed and not paused else 0.0
        rhythm.echo_share += FOLLOW * (came - rhythm.echo_share)
        if rhythm.echo_share < GONE:
            rhythm.echo_s = 0.0
    rhythm.echoed = False


@inner
def learn_echo(plan: Plan, s: State) -> bool:
    """Whether every other of the latest beats is now known to be the echo of the one before it."""
    rhythm = s.now[0].rhythm
    if rhythm.echo_s > 0.0 or rhythm.beats < KEPT_BEATS:
        return False
    beats, echoes, breadth, echo_breadth = 0.0, 0.0, 0.0, 0.0
    least, most, echo_least, echo_most = np.inf, -np.inf, np.inf, -np.inf
    soonest, latest, shortest, longest = np.inf, 0.0, np.inf, 0.0
    pairs = KEPT_BEATS // 2
    for pair in range(pairs):
        first = (rhythm.beats + 1 + 2 * pair) % KEPT_BEATS
        echo, after = (first + 1) % KEPT_BEATS, (first + 2) % KEPT_BEATS
        since_s = (rhythm.at[echo] - rhythm.at[first]) / plan.rate_hz
        whole_s = (rhythm.at[after] - rhythm.at[first]) / plan.rate_hz
        soonest, latest = min(soonest, since_s), max(latest, since_s)
        shortest, longest = min(shortest, whole_s), max(longest, whole_s)
        beats += rhythm.height[first] / pairs
        echoes += rhythm.height[echo] / pairs
        breadth += rhythm.breadth[first] / pairs
        echo_breadth += rhythm.breadth[echo] / pairs
        least, most = min(least, rhythm.alike[first]), max(most, rhythm.alike[first])
        echo_least = min(echo_least, rhythm.alike[echo])
        echo_most = max(echo_most, rhythm.alike[echo])
    early = soonest < FROM_S or latest > UNTIL_S or latest - soonest > SPREAD_S
    steady = longest < LONGEST_S and shortest > STEADY * longest
    unlike = max(least - echo_most, echo_least - most)
    broad = echo_breadth > BROAD * breadth
    if early or not steady or broad or unlike < UNLIKE:
        return False
    even = abs(soonest + latest - 0.5 * (shortest + longest)) < EVENLY * longest
    if echoes > (EVEN_HEIGHT if even else HEIGHT) * beats:
        return False
    rhythm.echo_s, rhythm.echo_height = 0.5 * (soonest + latest), echoes / beats
    rhythm.echo_breadth = echo_breadth / breadth if breadth > 0.0 else 1.0
    rhythm.echo_share = 1.0
    return True


@inner
def is_echo(at: int, since_s: float, height: float, plan: Plan, s: State) -> bool:
    """Whether a wave comes when an echo of the last beat is due, and is no higher than one,
    not much broader, and not as alike to the usual beat as what it follows."""
    now, rhythm = s.now[0], s.now[0].rhythm
    share = height / rhythm.last_height if rhythm.last_height > 0.0 else 1.0
    if rhythm.echo_s <= 0.0 or abs(since_s - rhythm.echo_s) > NEAR_S:
        return False
    if share > HIGHER * rhythm.echo_height:
        return False
    broadest = BROAD * rhythm.echo_breadth
    if now.tall * rhythm.last_steep > broadest * rhythm.last_tall * now.steep:
        return False
    wave = s.found[now.found]
    measure_beat(at, wave, plan, s)
    if wave.likeness > max(rhythm.last_likeness, ALIKE) - UNLIKE:
        return False
    if share * HIGHER > rhythm.echo_height:
        rhythm.echoed = True
        rhythm.echo_s += FOLLOW * (since_s - rhythm.echo_s)
        rhythm.echo_height += FOLLOW * (share - rhythm.echo_height)
    return True
