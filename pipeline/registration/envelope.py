"""Samples of the electrocardiogram into rings, and each lead's energy in the band of QRS complexes.

The energy is the mean envelope of one complex wavelet; it is known half the wavelet's width and
half the mean's after a sample.
"""

from __future__ import annotations

import math

from pipeline.geometry import Float
from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import Plan, State
from pipeline.registration.quality import BRIDGED_S, SETTLE_S, watch


@inner
def store(sample: Float, plan: Plan, s: State) -> None:
    """Put one sample of every lead into the rings, and filter."""
    now, length = s.now[0].seen, plan.length
    at = now % length
    for k in range(len(sample)):
        lead, value = s.leads[k], sample[k]
        if not math.isfinite(value):
            lead.missing += 1
            value = lead.last
            if lead.missing > max(1.0, BRIDGED_S * plan.rate_hz):
                lead.bad_until = now + SETTLE_S * plan.rate_hz
        elif lead.missing > 0:
            _bridge(k, value, now, plan, s)
        if now == 0:
            s.raw[k, :] = value
        else:
            watch(lead, s.raw[k], value, now, plan)
        lead.last = value
        s.raw[k, at] = value
        s.raw[k, at + length] = value
        _filter(k, now, plan, s)


@inner
def _bridge(k: int, value: float, now: int, plan: Plan, s: State) -> None:
    """A lead is back: let a line lead to it from its last sample, if it was away for a moment."""
    lead, count, length = s.leads[k], s.leads[k].missing, plan.length
    lead.missing = 0
    if count > max(1.0, BRIDGED_S * plan.rate_hz) or count >= now:
        return
    for i in range(1, count + 1):
        at = (now - i) % length
        between = value + (lead.last - value) * i / (count + 1)
        s.raw[k, at] = between
        s.raw[k, at + length] = between
    for i in range(now - count, now):
        _filter(k, i, plan, s)
    # A step of the line is none of the lead's.
    lead.last, lead.run = value, 0


@inner
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
