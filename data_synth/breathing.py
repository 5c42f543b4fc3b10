"""Breathing shifts the heart as a whole along one axis, from end-expiration."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_synth.kernels import Float

BREATHING_AXIS = (0.0, -0.25644, -0.96656)
"""Unit vector, LPS, along which the heart moves on breathing in: towards the feet and forwards.

From the mean motion of ten hearts in quiet breathing, 4.9 mm towards the feet (sd 1.9 mm) and
1.3 mm forwards (sd 1.8 mm): Shechter, Ozturk, Resar and McVeigh, IEEE Trans. Med. Imaging
23:1046-1056, 2004. They found rotations of 1 to 2 degrees too, which this model leaves out.
"""


class Breathing(BaseModel):
    """How far and how fast the heart moves with breathing."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    amplitude_mm: float = Field(default=5.1, ge=0, le=40)
    """Way from end-expiration to end-inspiration; default from the source of the axis."""
    period_s: float = Field(default=4.5, ge=1, le=20)
    hold_sd_mm: float = Field(default=1.5, ge=0, le=10)
    """Standard deviation of the place along the axis from one breath-hold to another."""
    power: int = Field(default=3, ge=1, le=10)
    """How long expiration lasts: the larger, the longer the rest there."""


def free_breathing_mm(times_s: Float, settings: Breathing, start: float = 0.0) -> Float:
    """Shift of the heart (n, 3), LPS mm, at times (n,) in quiet breathing.

    A power of a sine, which rests at end-expiration: the waveform of Lujan, Larsen, Balter and
    Ten Haken, Med. Phys. 26:715-720, 1999. ``start`` is the share of a breath gone at time 0,
    counted from end-expiration, where the shift is nil.
    """
    turns = np.asarray(times_s, dtype=float) / settings.period_s + start
    depth_mm = settings.amplitude_mm * np.sin(np.pi * turns) ** (2 * settings.power)
    return np.asarray(depth_mm[:, None] * np.array(BREATHING_AXIS))


def breath_hold_mm(rng: np.random.Generator, count: int, settings: Breathing) -> Float:
    """Shift of the heart (count, 3), LPS mm, in each of a row of breath-holds."""
    depth_mm = settings.hold_sd_mm * rng.standard_normal(count)
    return np.asarray(depth_mm[:, None] * np.array(BREATHING_AXIS))
