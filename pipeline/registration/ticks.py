"""Where in the mechanical beat the heart is now, from R times alone: the compiled clock.

``include/beatfield_clock.h`` says the same in C99, statement by statement. Numbers only; the
meaning is told in ``clock``.
"""

from __future__ import annotations

import math

from pipeline.geometry import Float
from pipeline.registration.compiled import asked, inner
from pipeline.registration.intervals import (
    BEATS,
    BEFORE,
    COUNT,
    CYCLE_RR,
    ECTOPIC_BEAT,
    FADE,
    FADE_PER_S,
    FIBRILLATING,
    GAP,
    GOOD,
    IRREGULAR_BEAT,
    KEPT,
    LAST_R,
    LATENCY,
    LOST,
    MOST_SHARE,
    NEEDED,
    NORMAL_BEAT,
    NOW,
    PHASE,
    REGULAR,
    RINGS,
    RR,
    SD,
    SIZE,
    SPREAD,
    STARTED,
    STATE,
    TURN,
    VALID,
    interval,
    judge,
    remember,
    tolerance,
)

R_AFTER_Q_S = 0.04
SLOWEST_BPM, FASTEST_BPM = 45.0, 120.0
KICK_S = 0.12
LATENCY_S = 0.14
"""An R peak is known about 0.132 s after it, 99 in 100 within this."""
SHORTEST_RR_S, LONGEST_RR_S = 0.2, 3.0
"""Of a heart."""
NEAREST_S = 0.18
"""Ventricles are not excited again so soon: a peak nearer to the last one is a bounce of a line, or
a pulse of a pacemaker or of diathermy, and tells no rate."""
R_SD_S = 0.002
CLOSE = 0.02
"""Largest distance in phase from where the beats say for a phase to become valid."""
MOST_SD = 0.05
SLOWEST, QUICKEST = 0.5, 1.5
"""The phase is corrected by running at no less and no more than so many times its own speed."""
AHEAD_S = 3.0
"""How far a beat may lie beyond the latest time that the clock was told of: no heart waits longer,
so what lies further ahead was timed by another clock, or in another unit."""
SLACK_S = 0.02
"""How far a beat may lie ahead of the time asked for (no heart has beaten before it beats), and a
time before the one before it; and how much time one step of the fade may make up for."""
TICK_S = 0.001
"""What is taken to have passed where the time tells nothing: a turn of a haptic loop."""
HELD_UP = 3.0
"""So many usual turns of the loop, or ``SLACK_S``, are all that the phase makes up for in one
answer: a loop that was held up for longer, or whose time was set, would render a jump."""
MOST_TURN_S = 0.1
"""The first turn counts for no longer: a question asked to warm up may lie long before the loop."""
FOLLOWED = 0.1
"""Share of the difference by which a turn changes what is a usual one."""
MOST_TIME_S = 1e11
"""A number beyond is no time in seconds: three thousand years."""


@asked
def systole_share(rr_s: float) -> float:
    """Share of a beat from the R peak to the closure of the aortic valve."""
    rate = min(max(60.0 / rr_s, SLOWEST_BPM), FASTEST_BPM)
    length_s = 0.5475 - 0.00205 * rate - R_AFTER_Q_S
    return length_s * min(1.0, rr_s * FASTEST_BPM / 60.0) / rr_s


@asked
def kick_phase(rr_s: float) -> float:
    """Share of a beat after which the atria contract, a fixed time before the next R peak."""
    return 1.0 - KICK_S / max(rr_s, 60.0 / FASTEST_BPM)


@asked
def to_cycle(phase: float, rr_s: float, cycle_rr_s: float) -> float:
    """Phase of a beat of ``rr_s`` on the axis of a beat of ``cycle_rr_s``.

    The circle of phases is mapped on itself so that R peak, end of systole and atrial contraction
    fall on their own places: cot(pi q) = a + b cot(pi p), the Moebius map of the circle.
    """
    if rr_s == cycle_rr_s:
        return phase
    from_end = 1.0 / math.tan(math.pi * systole_share(rr_s))
    from_kick = 1.0 / math.tan(math.pi * kick_phase(rr_s))
    to_end = 1.0 / math.tan(math.pi * systole_share(cycle_rr_s))
    to_kick = 1.0 / math.tan(math.pi * kick_phase(cycle_rr_s))
    b = (to_end - to_kick) / (from_end - from_kick)
    a = to_end - b * from_end
    sine = math.sin(math.pi * phase)
    place = math.atan2(sine, a * sine + b * math.cos(math.pi * phase)) / math.pi
    return place if place < 1.0 else 0.0


@asked
def wrapped(turns: float) -> float:
    """The same angle in [-0.5, 0.5)."""
    return turns - math.floor(turns + 0.5)


@asked
def reset(c: Float, cycle_rr_s: float, fade_per_s: float, latency_s: float) -> None:
    """A clock that has seen nothing; all three are sound."""
    for i in range(SIZE):
        c[i] = 0.0
    c[CYCLE_RR] = cycle_rr_s
    c[FADE_PER_S] = fade_per_s
    c[LATENCY] = latency_s
    _forget(c)


@asked
def change(c: Float, cycle_rr_s: float, fade_per_s: float) -> int:
    """Go on for another field; -1 while anything is rendered of the one before."""
    if c[FADE] > 0.0:
        return -1
    c[CYCLE_RR], c[FADE_PER_S] = cycle_rr_s, fade_per_s
    # So that the phase is set, not corrected, on the axis of the new cycle.
    c[VALID] = 0.0
    if c[BEATS] == 0.0:
        _forget(c)
    return 0


@inner
def _forget(c: Float) -> None:
    """Know of no beat, as at the start; the time and what is rendered stay."""
    for i in range(RINGS, BEFORE):
        c[i] = 0.0
    c[LAST_R], c[BEATS], c[COUNT] = 0.0, 0.0, 0.0
    c[RR] = c[CYCLE_RR]
    c[SPREAD] = 0.05 * c[CYCLE_RR]
    c[NEEDED] = 3.0
    remember(c)


@inner
def _is_time(time_s: float) -> bool:
    return bool(abs(time_s) <= MOST_TIME_S)


@asked
def beat(c: Float, r_s: float, strange: bool) -> int:
    """An R peak became known; what kind of beat it is, or -1 if it does not count: it is no later
    than the last, or too far ahead of all that the clock was told."""
    remember(c)
    if not _is_time(r_s) or (c[BEATS] > 0.0 and not r_s > c[LAST_R]):
        return -1
    # The last beat counts beside the time: the next question may lie far from the last one.
    if (c[STARTED] > 0.0 or c[BEATS] > 0.0) and r_s > _latest(c) + AHEAD_S:
        return -1
    rr_s = r_s - c[LAST_R]
    c[LAST_R] = r_s
    c[BEATS] += 1.0
    if c[BEATS] < 2.0 or c[GAP] > 0.0:
        c[GAP] = 0.0
        return NORMAL_BEAT
    strange = strange or rr_s < NEAREST_S
    off_s = rr_s - c[RR]
    known = c[COUNT] >= 3.0
    # Before a prediction can be trusted, intervals are held against one another.
    first = c[COUNT] == 0.0 or abs(rr_s - interval(c, 0)) <= MOST_SHARE * rr_s
    regular = not strange and (abs(off_s) <= tolerance(c) if known else first)
    early = strange or (known and off_s < -tolerance(c))
    place = int(c[COUNT]) % KEPT
    c[RINGS + place] = rr_s
    c[RINGS + KEPT + place] = -1.0 if strange else (1.0 if regular else 0.0)
    c[COUNT] += 1.0
    learning = c[NEEDED] > 1.0
    settled = judge(c, regular, off_s)
    if not learning:
        _doubt_if_late(c, r_s)
    if c[STATE] == FIBRILLATING:
        return IRREGULAR_BEAT
    # The third beat of a new rate is one of its rhythm.
    return ECTOPIC_BEAT if early and not settled else NORMAL_BEAT


@inner
def _doubt_if_late(c: Float, r_s: float) -> None:
    """A beat that is told so late was overdue, however regular: by a clock that is behind the
    loop's every beat is, and the phase is off by as much. The first beats come late for another
    reason: a detector tells them when it knows what a beat looks like."""
    if c[STARTED] > 0.0 and c[NOW] - r_s > c[LATENCY] + MOST_SHARE * c[RR]:
        c[GOOD], c[VALID] = 0.0, 0.0
        if c[STATE] == REGULAR:
            c[STATE] = LOST


@asked
def take_back(c: Float) -> None:
    """The last beat was none: know what was known before it."""
    # Leads that were lost since are not to be forgotten.
    if c[GAP] == 0.0:
        for i in range(BEFORE - STATE):
            c[STATE + i] = c[BEFORE + i]


@inner
def _latest(c: Float) -> float:
    """The latest time that the clock was told of, by a question or by a beat."""
    if c[STARTED] > 0.0 and c[BEATS] > 0.0:
        return float(max(c[NOW], c[LAST_R]))
    return float(c[NOW] if c[STARTED] > 0.0 else c[LAST_R])


@inner
def _beats_since(c: Float, now_s: float, rr_s: float) -> float:
    """Beats since the last R peak, whole ones and the phase of this one, if the interval is
    ``rr_s`` and the next come as due. It never falls as time goes on."""
    turns = (now_s - c[LAST_R]) / rr_s
    whole = math.floor(turns)
    place = to_cycle(turns - whole, rr_s, c[CYCLE_RR])
    # A phase that is rounded up to the next R peak is 0 there, with one whole beat more.
    return float(whole + (1.0 if place == 0.0 and turns - whole > 0.5 else place))


@inner
def _place(c: Float, now_s: float, rr_s: float) -> float:
    """Where the heart should be, if the interval is ``rr_s`` and the next beats come as due."""
    beats = _beats_since(c, now_s, rr_s)
    return beats - math.floor(beats)


@asked
def advance(c: Float, now_s: float, usable: bool, withheld: bool) -> int:
    """Bring the clock to ``now_s``; -1 when that is no time at or after the last.

    Afterwards ``c`` holds phase, its standard deviation, state, validity and fade.
    """
    if not _is_time(now_s) or (c[STARTED] > 0.0 and now_s < c[NOW]):
        _lose_time(c, now_s)
        return -1
    passed_s = now_s - c[NOW] if c[STARTED] > 0.0 else 0.0
    before_s = now_s - _followed(c, passed_s)
    c[STARTED], c[NOW] = 1.0, now_s
    if c[BEATS] > 0.0 and c[LAST_R] > now_s + SLACK_S:
        # Left in, it would shift the phase, and make true beats come too late.
        _forget(c)
    _watch(c, now_s, usable)
    _turn(c, before_s, now_s)
    reach = c[FADE_PER_S] * min(passed_s, SLACK_S)
    wanted = 0.0 if withheld else c[VALID]
    c[FADE] += min(max(wanted - c[FADE], -reach), reach)
    return 0


@inner
def _followed(c: Float, passed_s: float) -> float:
    """How much of the time since the last question the phase may make up for."""
    if c[TURN] == 0.0:
        c[TURN] = min(passed_s, MOST_TURN_S)
    followed_s = min(passed_s, max(SLACK_S, HELD_UP * c[TURN]))
    c[TURN] += FOLLOWED * (followed_s - c[TURN])
    return float(followed_s)


@inner
def _lose_time(c: Float, now_s: float) -> None:
    """A time that is none, or of another clock: what beats told of is worth nothing any more."""
    if _is_time(now_s) and now_s >= c[NOW] - SLACK_S:
        return
    _forget(c)
    c[STATE], c[GOOD], c[VALID] = LOST, 0.0, 0.0
    c[FADE] = max(c[FADE] - c[FADE_PER_S] * TICK_S, 0.0)
    if _is_time(now_s):
        c[NOW] = now_s


@inner
def _watch(c: Float, now_s: float, usable: bool) -> None:
    """Notice that no lead shows anything, or that a beat is overdue."""
    waited_s = now_s - c[LAST_R]
    if not usable or c[BEATS] < 1.0 or waited_s > 3.0 * c[RR]:
        c[STATE], c[NEEDED], c[GOOD], c[VALID] = LOST, 3.0, 0.0, 0.0
        if not usable or waited_s > max(3.0 * c[RR], LONGEST_RR_S):
            # How many beats were missed is unknown: the next one ends no interval. A shorter wait
            # may be a heart that beats three times slower, as after a racing rhythm.
            c[GAP] = 1.0
    elif waited_s > c[RR] + tolerance(c) + c[LATENCY]:
        # After an early beat comes a pause, and in fibrillation nothing is due.
        c[STATE] = LOST if c[STATE] == REGULAR else c[STATE]
        c[GOOD], c[VALID] = 0.0, 0.0


@inner
def _turn(c: Float, before_s: float, now_s: float) -> None:
    """Move the phase towards where the beats say, and judge it."""
    there = _beats_since(c, now_s, c[RR])
    natural = there - _beats_since(c, before_s, c[RR])
    place = there - math.floor(there)
    if c[FADE] == 0.0 and c[VALID] == 0.0:
        c[PHASE] = place
    else:
        step = natural + wrapped(place - c[PHASE] - natural)
        c[PHASE] += min(max(step, SLOWEST * natural), QUICKEST * natural)
        c[PHASE] -= math.floor(c[PHASE])
    off = wrapped(c[PHASE] - place)
    # Beats nearer to each other than is usual for a spread are none of a heart.
    h = min(max(c[SPREAD], 1e-4), 0.5 * c[RR])
    late, early = _place(c, now_s, c[RR] + h), _place(c, now_s, c[RR] - h)
    by_interval = 0.5 * c[SPREAD] / h * wrapped(early - late)
    by_peak = R_SD_S / c[RR]
    c[SD] = math.sqrt(by_interval * by_interval + by_peak * by_peak + off * off)
    good = c[STATE] == REGULAR and c[GOOD] >= c[NEEDED] and c[SD] <= MOST_SD
    # Once valid, a beat that corrects the phase more than that does not end it, as long as the
    # phase is sure: how far it is off is a part of how unsure it is.
    c[VALID] = 1.0 if good and (c[VALID] > 0.0 or abs(off) <= CLOSE) else 0.0


@asked
def to_cycle_all(phases: Float, rr_s: Float, cycle_rr_s: float, out: Float) -> None:
    """:func:`to_cycle` of each of ``(n,)`` phases and intervals."""
    for i in range(len(phases)):
        out[i] = to_cycle(phases[i], rr_s[i], cycle_rr_s)
