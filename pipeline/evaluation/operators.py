"""Simulated operators: what a hand, an eye and a haptic device are taken to be.

A simulated operator shows by which mechanism a fixture helps; it is no result about people. Every
parameter is either a published figure or, where it says "assumed", a guess whose weight the
sensitivity figure shows. None is chosen for the outcome.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.geometry import Float

TREMOR_HZ = (8.0, 12.0)
"""Physiological tremor; Riviere et al. and those they cite place it there."""

TREMOR_WAVES = 3
EFFECTIVE_WIDTH = 4.133
"""Width of a target over the standard deviation of where reaches end, at 4 % misses (MacKenzie,
Human-Computer Interaction 7:91-139, 1992; from memory)."""


class Operator(NamedTuple):
    """One operator; a tuple of numbers, as the compiled loop takes it."""

    delay_s: float
    """From seeing to moving, and the constant of the law of movement time."""

    slope_s_per_bit: float
    """Movement time for each bit of log2(distance / width + 1)."""

    depth_sd_mm: float
    """Scatter of depth seen along the view axis, drawn anew at each look."""

    depth_bias_mm: float
    """What this operator always sees too far, or too near."""

    turn_rad: float
    """By how much movements mirrored at the pivot still go astray about the rod."""

    gain: float
    """Lateral movement made, over that needed."""

    tremor_mm: float
    """Root mean square of the tremor on each axis of the hand."""

    stiffness_n_per_mm: float
    """Of arm and grip, between where the hand wants to be and where the handle is."""

    damping_ratio: float
    """Of hand and device on that stiffness."""

    hand_kg: float
    """What moves with the handle."""


class Spread(NamedTuple):
    """Median or mean over people, relative or absolute spread, and where it is from."""

    centre: float
    spread: float
    relative: bool
    source: str


JACOBS = (
    "Jacobs et al., Ann. Thorac. Surg. 76:2029-2035, 2003: {} through a telemanipulator, {} by hand"
)

POPULATION: dict[str, Spread] = {
    "delay_s": Spread(0.630, 0.2, True, JACOBS.format("630 ms", "201 ms")),
    "slope_s_per_bit": Spread(0.250, 0.2, True, JACOBS.format("250 ms/bit", "86 ms/bit")),
    "depth_sd_mm": Spread(
        4.0, 0.3, True,
        "assumed; depth seen on a flat monitor is 6.2 times less precise than in stereo at 1 m "
        "(Sakata et al., Br. J. Surg. 104:1097-1106, 2017)",
    ),
    "depth_bias_mm": Spread(0.0, 2.0, False, "assumed"),
    "turn_rad": Spread(0.0, math.radians(10), False, "assumed: adapted to the fulcrum but for 10°"),
    "gain": Spread(1.0, 0.1, False, "assumed: adapted to the lever but for 10 %"),
    "tremor_mm": Spread(
        0.083, 0.3, True,
        "144 µm in 3D while pointing (peak at 6 to 12 Hz; Wells et al., PMC3989364), over √3; "
        "49 µm holding still (Riviere et al., 1997)",
    ),
    "stiffness_n_per_mm": Spread(
        0.3, 0.3, True,
        "order of arm and grip, 100 to 600 N/m (Mussa-Ivaldi et al., J. Neurosci. 5:2732-2743, "
        "1985; from memory)",
    ),
    "damping_ratio": Spread(0.7, 0.15, True, "assumed: a well damped hand"),
    "hand_kg": Spread(0.1, 0.2, True, "assumed: fingers and stylus"),
}  # fmt: skip
"""What is known of people, by parameter. Relative spreads are those of a lognormal law."""


class Handle(NamedTuple):
    """The haptic device in the hand."""

    mass_kg: float
    damping_ns_per_mm: float


HANDLES: dict[str, Handle] = {
    # Apparent mass at the tip 45 g from the maker's data sheet, from memory; damping assumed.
    "touch": Handle(0.045, 0.0005),
    # Assumed: a parallel device of 12 N is heavier.
    "omega7": Handle(0.2, 0.002),
}


def handle_of(device: str) -> Handle:
    """What is known of a device; of others than a Touch that they are as heavy as an omega.7."""
    return HANDLES.get(device, HANDLES["omega7"])


def operator(seed: int, number: int, **scaled: float) -> tuple[Operator, Float]:
    """One operator of the population, and the waves of the tremor.

    Parameters
    ----------
    seed, number
        The same operator every time, whatever the others.
    scaled
        Factors on parameters, for the sensitivity figure; 1 leaves them as they are.

    Returns
    -------
    The operator, and ``(axis, wave, 3)``: amplitude (mm), frequency (Hz), phase (radians).
    """
    rng = np.random.default_rng([seed, number])
    values = {}
    for name, about in POPULATION.items():
        unit = float(np.clip(rng.standard_normal(), -2.5, 2.5))
        if about.relative:
            value = about.centre * math.exp(about.spread * unit)
        else:
            # What is off centre is what is scaled: half an error is half as far from none.
            value = about.centre + scaled.get(name, 1.0) * about.spread * unit
        values[name] = value * (scaled.get(name, 1.0) if about.relative else 1.0)
    waves = np.empty((3, TREMOR_WAVES, 3))
    waves[..., 0] = values["tremor_mm"] * math.sqrt(2 / TREMOR_WAVES)
    waves[..., 1] = rng.uniform(*TREMOR_HZ, size=(3, TREMOR_WAVES))
    waves[..., 2] = rng.uniform(0, 2 * math.pi, size=(3, TREMOR_WAVES))
    return Operator(**values), waves
