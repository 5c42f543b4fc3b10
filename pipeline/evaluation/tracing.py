"""A hand that follows a fixed line near a beating surface, with and without a fixture's force."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.evaluation.operators import POPULATION, handle_of
from pipeline.field.reader import ForceField
from pipeline.geometry import Float

TICK_S = 0.001
KEPT_EVERY = 5


@dataclass(frozen=True, slots=True)
class Tracing:
    """Where the tip went, every 5 ms."""

    times_s: Float
    tips_mm: Float
    """``(n, 3)``, LPS mm."""

    forces_n: Float
    """``(n, 3)``."""


def trace_along(
    field: ForceField,
    fixture: str,
    line_mm: Float,
    lasts_s: float,
    phase_at: Callable[[float], float],
    force: bool,
) -> Tracing:
    """Follow a line at even speed with the population's middle hand, holding the fixture's device.

    The handle moves by the midpoint rule, the force held for each tick, as in the dissection.

    Parameters
    ----------
    line_mm
        ``(n, 3)`` points where the hand means to be, evenly in time.
    lasts_s
        Time for the whole line.
    phase_at
        The heart's phase so many seconds after the start.
    force
        Whether the fixture's force is rendered.
    """
    handle = handle_of(field.fixtures[fixture].device.name)
    mass = (handle.mass_kg + POPULATION["hand_kg"].centre) / 1000
    stiff = POPULATION["stiffness_n_per_mm"].centre
    damp = 2 * POPULATION["damping_ratio"].centre * math.sqrt(stiff * mass)
    count = round(lasts_s / TICK_S)
    shares = np.linspace(0, len(line_mm) - 1, count + 1)
    meant = np.column_stack(
        [np.interp(shares, np.arange(len(line_mm)), line_mm[:, k]) for k in range(3)]
    )
    place, speed = meant[0].copy(), np.zeros(3)
    tips, forces = np.empty((count, 3)), np.zeros((count, 3))
    inertia = 2 * mass / TICK_S
    resist = inertia + handle.damping_ns_per_mm + damp + 0.5 * stiff * TICK_S
    for n in range(count):
        x, y, z = place.tolist()
        held = np.zeros(3)
        if force:
            held = np.array(field.force_at(x, y, z, phase_at(n * TICK_S), fixture))
        tips[n], forces[n] = place, held
        rate = (meant[n + 1] - meant[n]) / TICK_S
        pulled = held + stiff * (0.5 * (meant[n] + meant[n + 1]) - place) + damp * rate
        middle = (pulled + inertia * speed) / resist
        place = place + TICK_S * middle
        speed = 2 * middle - speed
    kept = slice(None, None, KEPT_EVERY)
    return Tracing(TICK_S * np.arange(float(count))[kept], tips[kept], forces[kept])
