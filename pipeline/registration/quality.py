"""Whether a lead of the electrocardiogram still shows anything, as its samples come.

A lead that was lost shows less than the heart ever lets it: one value, or the amplifier's own
noise. How still a lead is when it is connected is learnt from its stillest moments, between the
beats. What takes the heart's place and is as lively as the heart, hum or noise, is not told here: a
beat that is overdue tells it. All is compiled; a lead's memory is one record.
"""

from __future__ import annotations

import math

from pipeline.geometry import Float
from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import Lead, Plan

RUN_S = 0.12
"""A lead that repeats one value for so long shows nothing."""
JUMP_SHARE = 0.1
"""From one sample to the next a step by more than this share of a beat's height is a jump."""
BRIDGED_S = 0.05
"""Where samples are missing for no longer, or a single one, a line bridges them: shorter than the
filters' delay, so that nothing has been decided about them when the lead comes back."""
SETTLE_S = 0.2
"""So long after it came back a lead's filters still show that it was away."""
STILL_S, LOOK_EVERY_S = 0.10, 0.005
"""How still a lead is is told by its swing in so long a window, looked at so often."""
STILL_SHARE, BACK_SHARE = 0.33, 0.66
"""A lead whose swing is under the first share of that in its stillest moments is lost, until it is
over the second. The swing of ten samples of noise, the fewest in a window, comes under the smallest
of eighty windows by such a factor some four times in a million windows."""
DEAD_SHARE = 0.05
"""A lost lead that swings by more than this share of its stillest moments may be one that is less
noisy than before: what it shows becomes its stillest moment once it comes back."""
LIVELY, CALM_SPEED, CALM_S = 4.5, 4.0, 0.5
"""A lost lead that swings by so many times what it does in three of ten windows shows a heart, and
all that is known of its stillest moments is of a noise or hum that has ended. An amplifier's own
noise is more even. What three of ten windows show is followed so fast, and first for so long."""
RISE = 1.05
"""While a lead swings too evenly to show a heart, what is known of its stillest moments rises by no
more than this factor an epoch: the noise of a cautery is not learnt, and forgotten when it ends."""
COARSEST_STEPS = 4.0
"""A lead whose stillest moments swing by no more than so many steps of its converter is not judged:
it may well repeat a value."""
EPOCH_S = 2.0
"""Stillest moments are those of the last two whole times of this length."""
HESITATE_S = 0.5
"""So long such a time waits, at most, for the swing to stop falling."""


@inner
def watch(lead: Lead, ring: Float, value: float, now: int, plan: Plan) -> None:
    """Take a lead's next sample, before it is stored: is the lead off?

    Parameters
    ----------
    lead
        Its record of the detector's state.
    ring
        ``(2 length,)`` its samples before this one.
    """
    rate_hz = plan.rate_hz
    step = abs(value - lead.last)
    if 0.0 < step < lead.smallest_step:
        lead.smallest_step = step
    _watch_runs(lead, step, now, rate_hz)
    if now % max(1, int(LOOK_EVERY_S * rate_hz)) == 0 and now > STILL_S * rate_hz:
        _watch_swing(lead, _swing(ring, now, plan), now, rate_hz)


@inner
def _watch_runs(lead: Lead, step: float, now: int, rate_hz: float) -> None:
    """Follow runs of one value. A run that begins or ends with a jump is a lead that came off."""
    jumped = step > JUMP_SHARE * lead.usual.size_mv
    if step == 0.0:
        lead.run += 1
        return
    if lead.run >= RUN_S * rate_hz and (jumped or lead.jumped):
        lead.bad_until = now + SETTLE_S * rate_hz
    lead.run = 0
    lead.jumped = jumped


@inner
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


@inner
def _watch_swing(lead: Lead, swing: float, now: int, rate_hz: float) -> None:
    """Hold the swing against that of the lead's stillest moments, and learn these."""
    stillest = min(lead.lowest_old, lead.lowest_older)
    known = math.isfinite(stillest) and stillest > COARSEST_STEPS * lead.smallest_step
    share = BACK_SHARE if lead.stillest < math.inf else STILL_SHARE
    lost = known and swing < share * stillest
    if lost and _is_lively(lead, swing, now, rate_hz):
        lead.lowest_old, lead.lowest_older, lead.epoch_end = math.inf, math.inf, 0.0
    elif lost:
        lead.bad_until = now + SETTLE_S * rate_hz
        lead.stillest = min(lead.stillest, swing)
        return
    elif known and DEAD_SHARE * stillest < lead.stillest < math.inf:
        lead.lowest_old = lead.stillest
    lead.stillest, lead.quiet = math.inf, 0.0
    lead.lowest, lead.wildest = min(lead.lowest, swing), max(lead.wildest, swing)
    # An epoch does not end while the swing falls: the lead may be about to be lost.
    late = now >= lead.epoch_end + HESITATE_S * rate_hz
    if now >= lead.epoch_end and (swing >= stillest or late):
        if lead.epoch_end > 0.0:
            most = math.inf if lead.wildest > LIVELY * lead.lowest else RISE * stillest
            lead.lowest_older, lead.lowest_old = lead.lowest_old, min(lead.lowest, most)
        lead.lowest, lead.wildest = math.inf, 0.0
        lead.epoch_end = now + EPOCH_S * rate_hz


@inner
def _is_lively(lead: Lead, swing: float, now: int, rate_hz: float) -> bool:
    """Whether a lead that is thought lost swings as unevenly as beats and what lies between do."""
    if swing == 0.0:
        lead.quiet = 0.0
        return False
    if lead.quiet == 0.0:
        lead.quiet, lead.quiet_from = swing, now + CALM_S * rate_hz
    step = CALM_SPEED * max(LOOK_EVERY_S, 1.0 / rate_hz)
    lead.quiet *= 1.0 + 0.3 * step if swing > lead.quiet else 1.0 - 0.7 * step
    return bool(now > lead.quiet_from and swing > LIVELY * lead.quiet)


@inner
def shows_nothing(lead: Lead, now: int, rate_hz: float) -> bool:
    """Whether a lead is off, or has not settled since."""
    off = lead.run >= RUN_S * rate_hz and lead.jumped
    return bool(off or now < lead.bad_until)
