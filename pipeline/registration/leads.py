"""What say each lead has in what all of them tell together, as its energy and its beats show."""

from __future__ import annotations

from pipeline.registration.compiled import inner
from pipeline.registration.detector_state import Plan, State
from pipeline.registration.quality import RUN_S, shows_nothing
from pipeline.registration.rules import T_WAVE_S

MOST_CONTRAST, MOST_ENERGY = 20.0, 2.0
"""However clear a lead, it weighs no more than with the first ratio of beats to noise; and however
high a wave, no lead says more than so many of its beats."""
KNOCK, GAIN = 8.0, 1.3
"""Energy, in units of a lead's beats, that no beat has: the lead was knocked. Its level grows by a
factor each time: should beats have become so much larger, they count after some of them."""
SHOWN, SILENT, AWAY_S, SILENT_EVERY_S = 0.6, 0.1, 3.0, 0.1
"""Where a beat is overdue, a lead that since the last one had less than the second share of its
beats' energy, while another had the first, is lost for so long. It is looked for so often."""


@inner
def fuse(i: int, plan: Plan, s: State) -> float:
    """Weigh all leads by what they show now: their energy at sample ``i``, 1 for a usual beat."""
    total, weights, now = 0.0, 0.0, s.now[0].seen
    usable = False
    for k in range(len(s.leads)):
        lead, level = s.leads[k], s.leads[k].usual.level
        off = lead.run >= RUN_S * plan.rate_hz or now < lead.bad_until
        usable = usable or not shows_nothing(lead, now, plan.rate_hz)
        lead.weight = 0.0
        if off or level <= 0.0:
            continue
        contrast = min(level / lead.noise, MOST_CONTRAST)
        lead.weight = contrast * contrast
        weights += lead.weight
        total += lead.weight * min(s.energy[k, i % plan.length] / level, MOST_ENERGY)
    s.now[0].usable = usable
    return total / weights if weights > 0.0 else 0.0


@inner
def refuse_knocks(at: int, plan: Plan, s: State) -> None:
    """Take the say from leads whose energy near a wave is beyond any beat's: they were knocked."""
    for k in range(len(s.leads)):
        lead, usual, most = s.leads[k], s.leads[k].usual, 0.0
        for i in range(at - plan.confirm, at + plan.confirm + 1):
            most = max(most, s.energy[k, i % plan.length])
        if most > KNOCK * usual.level > 0.0:
            # For this sample alone: a beat of its own follows soon, by the level that is raised.
            lead.bad_until = max(lead.bad_until, s.now[0].seen + 1.0)
            usual.level *= GAIN


@inner
def refuse_silent(i: int, plan: Plan, s: State) -> None:
    """A beat is overdue: take the say from leads that show nothing where others show beats.

    What was so quiet that ``quality`` could not judge it seems clearest of all once it is lost.
    """
    first = s.now[0].rhythm.last_at + int(T_WAVE_S * plan.rate_hz)
    first = max(first, i - plan.length + 4 * plan.half)
    shown = 0.0
    for k in range(len(s.leads)):
        shown = max(shown, _most_since(k, first, i, plan, s))
    if shown < SHOWN:
        return
    for k in range(len(s.leads)):
        if _most_since(k, first, i, plan, s) < SILENT:
            lead = s.leads[k]
            lead.bad_until = max(lead.bad_until, s.now[0].seen + AWAY_S * plan.rate_hz)


@inner
def _most_since(k: int, first: int, last: int, plan: Plan, s: State) -> float:
    """The largest energy of a lead in a stretch of samples, 1 for a usual beat; 0 if it is off."""
    lead, most = s.leads[k], 0.0
    if lead.weight <= 0.0:
        return 0.0
    for i in range(first, last + 1):
        most = max(most, s.energy[k, i % plan.length])
    return most / lead.usual.level
