"""Whether a lead of the electrocardiogram still shows anything, as its samples come.

A lead that was lost shows less than the heart ever lets it: one value, or the amplifier's own
noise. How still a lead is when it is connected is learnt from its stillest moments, between the
beats. What takes the heart's place and is as lively as the heart, hum or noise, is not told here: a
beat that is overdue tells it. All is compiled; a lead's memory is one row of numbers.
"""

from __future__ import annotations

import math

from pipeline.geometry import Float
from pipeline.registration.compiled import compiled
from pipeline.registration.detector_state import (
    BAD_UNTIL,
    EPOCH_END,
    JUMPED,
    LAST,
    LOWEST,
    LOWEST_OLD,
    LOWEST_OLDER,
    RUN,
    SIZE,
    SMALLEST_STEP,
    STILLEST,
    Plan,
)

RUN_S = 0.12
"""A lead that repeats one value for so long shows nothing."""
SETTLE_S = 0.2
"""So long after it came back a lead's filters still show that it was away."""
STILL_S, LOOK_EVERY_S = 0.10, 0.005
"""How still a lead is is told by its swing in so long a window, looked at so often."""
STILL_SHARE, BACK_SHARE = 0.33, 0.66
"""A lead whose swing is under the first share of that in its stillest moments is lost, until it is
over the second. The swing of ten samples of noise, the fewest in a window, comes under the smallest
of eighty windows by such a factor less than once in a million windows."""
DEAD_SHARE = 0.05
"""A lost lead that swings by more than this share of its stillest moments may be one that is less
noisy than before: what it shows becomes its stillest moment once it comes back."""
COARSEST_STEPS = 4.0
"""A lead whose stillest moments swing by no more than so many steps of its converter is not judged:
it may well repeat a value."""
EPOCH_S = 2.0
"""Stillest moments are those of the last two whole times of this length."""
HESITATE_S = 0.5
"""So long such a time waits, at most, for the swing to stop falling."""


@compiled
def watch(lead: Float, ring: Float, value: float, now: int, plan: Plan) -> None:
    """Take a lead's next sample, before it is stored: is the lead off?

    Parameters
    ----------
    lead
        Its row of the detector's state.
    ring
        ``(2 length,)`` its samples before this one.
    """
    rate_hz = plan.rate_hz
    step = abs(value - lead[LAST])
    if 0.0 < step < lead[SMALLEST_STEP]:
        lead[SMALLEST_STEP] = step
    _watch_runs(lead, step, now, rate_hz)
    if now % max(1, int(LOOK_EVERY_S * rate_hz)) == 0 and now > STILL_S * rate_hz:
        _watch_swing(lead, _swing(ring, now, plan), now, rate_hz)


@compiled
def _watch_runs(lead: Float, step: float, now: int, rate_hz: float) -> None:
    """Follow runs of one value. A run that begins or ends with a jump is a lead that came off."""
    jumped = step > 0.1 * lead[SIZE]
    if step == 0.0:
        lead[RUN] += 1
        return
    if lead[RUN] >= RUN_S * rate_hz and (jumped or lead[JUMPED] > 0.0):
        lead[BAD_UNTIL] = now + SETTLE_S * rate_hz
    lead[RUN] = 0
    lead[JUMPED] = 1.0 if jumped else 0.0


@compiled
def _swing(ring: Float, now: int, plan: Plan) -> float:
    """How far the latest samples swing about the line from their first to their last."""
    count = int(STILL_S * plan.rate_hz)
    start = (now - count) % plan.length
    slope = (ring[start + count - 1] - ring[start]) / (count - 1)
    low, high = 0.0, 0.0
    for i in range(count):
        away = ring[start + i] - ring[start] - slope * i
        low, high = min(low, away), max(high, away)
    return high - low


@compiled
def _watch_swing(lead: Float, swing: float, now: int, rate_hz: float) -> None:
    """Hold the swing against that of the lead's stillest moments, and learn these."""
    stillest = min(lead[LOWEST_OLD], lead[LOWEST_OLDER])
    known = math.isfinite(stillest) and stillest > COARSEST_STEPS * lead[SMALLEST_STEP]
    share = BACK_SHARE if lead[STILLEST] < math.inf else STILL_SHARE
    if known and swing < share * stillest:
        lead[BAD_UNTIL] = now + SETTLE_S * rate_hz
        lead[STILLEST] = min(lead[STILLEST], swing)
        return
    if known and DEAD_SHARE * stillest < lead[STILLEST] < math.inf:
        lead[LOWEST_OLD] = lead[STILLEST]
    lead[STILLEST] = math.inf
    lead[LOWEST] = min(lead[LOWEST], swing)
    # An epoch does not end while the swing falls: the lead may be about to be lost.
    late = now >= lead[EPOCH_END] + HESITATE_S * rate_hz
    if now >= lead[EPOCH_END] and (swing >= stillest or late):
        if lead[EPOCH_END] > 0.0:
            lead[LOWEST_OLDER], lead[LOWEST_OLD] = lead[LOWEST_OLD], lead[LOWEST]
        lead[LOWEST], lead[EPOCH_END] = math.inf, now + EPOCH_S * rate_hz


@compiled
def shows_nothing(lead: Float, now: int, rate_hz: float) -> bool:
    """Whether a lead is off, or has not settled since."""
    off = lead[RUN] >= RUN_S * rate_hz and lead[JUMPED] > 0.0
    return bool(off or now < lead[BAD_UNTIL])
