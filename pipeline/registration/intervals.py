"""What the intervals between beats tell the clock: the rhythm, and when the next beat is due.

The state is one array of numbers, by places; `ticks` moves it through time.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry import Float
from pipeline.registration.compiled import asked, inner

KEPT = 16
REGULAR_SHARE, MOST_SHARE = 0.10, 0.17
"""A beat within this share of the predicted interval is regular; a rhythm that is less sure gets
more room, up to the second."""
IRREGULAR, ORDERLY = 0.075, 0.05
"""Step from interval to interval, as a share, which two thirds of the steps exceed where the rhythm
has no order; and below which it has one again."""

MOST_NEEDED = 6
"""Regular intervals in a row, at most, after which a rhythm that often surprised is trusted again.
Where beats come after three or four turns of the atria by chance, so many alike are rare."""

LOST, REGULAR, ECTOPIC, FIBRILLATING = range(4)
NORMAL_BEAT, ECTOPIC_BEAT, IRREGULAR_BEAT = range(3)
# Places of the state.
(
    CYCLE_RR, FADE_PER_S, LATENCY, NOW, STARTED, TURN, PHASE, SD, VALID, FADE, STATE, LAST_R, BEATS,
    RR, SPREAD, GOOD, NEEDED, COUNT, GAP, RINGS,
) = range(20)  # fmt: skip
"""Behind it ``KEPT`` intervals, and of each whether it was regular: 1, 0, or -1 for a beat of
another shape."""
BEFORE = RINGS + 2 * KEPT
"""And then all that beats have told, from ``STATE`` on, as it was before the last one."""
SIZE = 2 * BEFORE - STATE


@inner
def remember(c: Float) -> None:
    """Keep what beats have told, to be taken back."""
    for i in range(BEFORE - STATE):
        c[BEFORE + i] = c[STATE + i]


@asked
def tolerance(c: Float) -> float:
    """How far from its predicted time a regular beat may come, seconds."""
    return float(min(max(REGULAR_SHARE * c[RR], 3.0 * c[SPREAD]), MOST_SHARE * c[RR]))


@inner
def slot(c: Float, back: int) -> int:
    """Place of the interval ``back`` before the latest (0)."""
    return RINGS + int(c[COUNT] - 1.0 - back + KEPT) % KEPT


@asked
def interval(c: Float, back: int) -> float:
    """The interval ``back`` before the latest (0)."""
    return float(c[slot(c, back)])


@inner
def _was_regular(c: Float, back: int) -> bool:
    return bool(c[slot(c, back) + KEPT] > 0.0)


@inner
def judge(c: Float, regular: bool, off_s: float) -> bool:
    """What the rhythm is with its latest interval, and when the next beat is due; whether the last
    intervals agree (:func:`_settled`)."""
    steady = _settled(c)
    if not regular and steady:
        for back in range(KEPT):
            c[slot(c, back) + KEPT] = 1.0 if back < 3 else 0.0
    if regular and c[COUNT] > 3.0:
        c[SPREAD] = math.sqrt(0.8 * c[SPREAD] * c[SPREAD] + 0.2 * off_s * off_s)
    c[GOOD] = c[GOOD] + 1.0 if regular or steady else 0.0
    share = irregularity(c)
    if share > IRREGULAR or (c[STATE] == FIBRILLATING and share > ORDERLY):
        c[STATE], c[NEEDED], c[GOOD] = FIBRILLATING, 3.0, 0.0
    elif c[GOOD] >= c[NEEDED]:
        c[STATE], c[NEEDED] = REGULAR, 1.0
    elif not (regular or steady):
        c[STATE] = ECTOPIC
        # Two early beats and the pauses after them are no habit. What came before a new rate counts
        # as unexpected: three alike may be chance.
        often = min(_surprises(c) - 3, MOST_NEEDED)
        c[NEEDED] = max(c[NEEDED], float(often))
    if c[STATE] != REGULAR:
        c[VALID] = 0.0
    _predict(c)
    return steady


@inner
def _settled(c: Float) -> bool:
    """Whether the last three intervals agree, so that a new rate has come to stay."""
    if c[COUNT] < 3.0:
        return False
    for back in range(3):
        if c[slot(c, back) + KEPT] < 0.0:
            return False
    one, two, three = interval(c, 0), interval(c, 1), interval(c, 2)
    low, high = min(one, min(two, three)), max(one, max(two, three))
    return high - low <= REGULAR_SHARE * high


@inner
def _surprises(c: Float) -> int:
    """How many of the last intervals were not as expected, though between beats of one shape."""
    count, found = int(min(c[COUNT], float(KEPT))), 0
    for back in range(count):
        if _own(c, count, back) and not _was_regular(c, back):
            found += 1
    return found


@asked
def irregularity(c: Float) -> float:
    """Step between intervals, as a share of their mean, that two thirds of the last nine exceed.

    Steps to the interval before and to the one before that are both looked at, and the smaller is
    taken: beats of two kinds in turn have an order. Beats of another shape and the pauses after
    them do not count.
    """
    count = int(min(c[COUNT], 10.0))
    if count < 7:
        return 0.0
    mean = 0.0
    for back in range(count):
        mean += interval(c, back) / count
    return min(_usual_step(c, count, 1), _usual_step(c, count, 2)) / mean


@inner
def _own(c: Float, count: int, back: int) -> bool:
    """Whether an interval lies between two beats of the usual shape."""
    before = back + 1 < count and c[slot(c, back + 1) + KEPT] < 0.0
    return not (before or c[slot(c, back) + KEPT] < 0.0)


@inner
def _usual_step(c: Float, count: int, lag: int) -> float:
    """Size that a third of the steps between intervals ``lag`` apart stay under."""
    steps = np.empty(10)
    used = 0
    for i in range(count - lag):
        if _own(c, count, i) and _own(c, count, i + lag):
            # Sorted as they come: the library's own sort takes seconds to compile.
            step, place = abs(interval(c, i) - interval(c, i + lag)), used
            while place > 0 and steps[place - 1] > step:
                steps[place] = steps[place - 1]
                place -= 1
            steps[place] = step
            used += 1
    if used < 4:
        return 0.0
    return float(steps[(35 * (used - 1)) // 100])


@inner
def _predict(c: Float) -> None:
    """The next interval: what two before it say, by the latest regular ones (least squares).

    Two are enough for what breathing does, a sine of some beats' period; a small ridge draws the
    answer to the mean where intervals hardly differ.
    """
    count = int(min(c[COUNT], float(KEPT)))
    mean, used = 0.0, 0.0
    for back in range(count):
        if _was_regular(c, back):
            mean += interval(c, back)
            used += 1.0
    if used == 0.0:
        return
    mean /= used
    ridge = 2.0 * (0.01 * mean) * (0.01 * mean)
    s11, s12, s22, s1y, s2y = ridge, 0.0, ridge, 0.0, 0.0
    for back in range(count - 2):
        if _was_regular(c, back) and _was_regular(c, back + 1) and _was_regular(c, back + 2):
            y, one = interval(c, back) - mean, interval(c, back + 1) - mean
            two = interval(c, back + 2) - mean
            s11 += one * one
            s12 += one * two
            s22 += two * two
            s1y += one * y
            s2y += two * y
    whole = s11 * s22 - s12 * s12
    one = interval(c, 0) - mean if _was_regular(c, 0) else 0.0
    two = interval(c, 1) - mean if count > 1 and _was_regular(c, 1) else 0.0
    step = ((s1y * s22 - s2y * s12) * one + (s2y * s11 - s1y * s12) * two) / whole
    c[RR] = mean + min(max(step, -0.2 * mean), 0.2 * mean)
