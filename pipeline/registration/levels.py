"""Energy of a lead's beats, and of what lies between them."""

from __future__ import annotations

import numpy as np

from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import KEPT_WAVES, Lead, Plan, State

REFRACTORY_S = 0.20
"""No two beats are closer together."""
LONE = 0.5
"""A wave stands out alone where the next lower one has less than so much of its energy."""
EVEN = 0.85
"""Waves are even where nine in ten have so much of the energy of beats."""
LEAST_NOISE = 0.02
"""No lead has less energy than this share of its beats' between them; a silent one would weigh all.
"""


@inner
def wave_levels(
    k: int, first: int, last: int, plan: Plan, s: State
) -> tuple[float, float, bool, bool]:
    """Energy of a lead's beats and of what lies between them, from a stretch of samples; whether
    one wave alone stands out, and whether all are even.

    Beats are the highest waves; the one highest of all may be a tug at the electrode, or the only
    beat that a slow heart has had in that time, between its atrial waves.
    """
    seen, waves = np.empty(last - first + 1), np.empty(KEPT_WAVES)
    count, best, best_at = 0, 0.0, first
    for i in range(first, last + 1):
        seen[i - first] = s.energy[k, i % plan.length]
        if seen[i - first] > best:
            best, best_at = seen[i - first], i
        elif i - best_at > REFRACTORY_S * plan.rate_hz:
            if count < KEPT_WAVES:
                waves[count] = best
                count += 1
            best, best_at = 0.0, i
    seen.sort()
    found = np.sort(waves[:count])
    # A lead that shows nothing has waves of no height.
    if count == 0 or found[-1] <= 0.0:
        return 0.8 * seen[-1], seen[int(0.7 * len(seen))], False, False
    lone = count > 1 and found[-2] < LONE * found[-1]
    high = found[found > 0.4 * found[max(0, count - 2)]]
    level = 0.9 * high[len(high) // 2]
    even = found[count // 10] >= EVEN * level
    return level, seen[int(0.7 * len(seen))], lone, even


@inner
def follow_noise(lead: Lead, energy: float, rate_hz: float) -> None:
    """Track the energy that 7 samples in 10 stay under: QRS complexes take less than 3."""
    step = 4.0 / rate_hz
    lead.noise *= 1.0 + 0.7 * step if energy > lead.noise else 1.0 - 0.3 * step
    lead.noise = max(lead.noise, LEAST_NOISE * lead.usual.level)


@inner
def learn_level(lead: Lead, energy: float, late: bool) -> None:
    """Move the level of a lead's beats a little towards this one, in the logarithm."""
    usual = lead.usual
    if energy <= 0.0:
        return
    if usual.level <= 0.0:
        usual.level, lead.noise = energy, 0.2 * energy
    elif lead.weight > 0.0:
        ratio = min(max(energy / usual.level, 0.5), 2.0)
        usual.level *= ratio ** (0.3 if late else 0.15)
