"""A body with known answers for tests of ultrasound: a pulsating ball of blood in muscle."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from data_synth.tissue import Tissue
from data_synth.ultrasound import UltrasoundSettings, simulate_sweeps

R_TIMES_S = np.cumsum([0.3, *np.tile([0.7, 0.95, 0.8], 6)])
FAULTLESS = {
    "tracker_mm": 0.0,
    "tracker_deg": 0.0,
    "calibration_mm": 0.0,
    "calibration_deg": 0.0,
    "jitter_ms": 0.0,
    "breathing": {"hold_sd_mm": 0.0},
}
# From behind the heart nothing but 8 mm of muscle is between tip and ball.
STILL = FAULTLESS | {
    "probe": "transoesophageal",
    "standoff_mm": 8.0,
    "frequency_mhz": 2.5,
    "depth_mm": 150.0,
    "pixel_mm": 0.8,
    "slice_mm": 0.0,
    "hand_mm": 0.0,
    "hand_deg": 0.0,
    "dropout": 0.0,
}
SMALL = {"beams": 16, "pixel_mm": 3.0}
# Enough where nobody looks at the pictures.
TINY = SMALL | {"depth_mm": 40.0}
PIXEL_MM = 0.8


@dataclass(frozen=True)
class Ball:
    """Blood of a radius that follows the phase, in a shell of muscle, in fat, in air."""

    centre_mm: np.ndarray = field(default_factory=lambda: np.array([12.0, -40.0, 65.0]))
    long_axis: np.ndarray = field(default_factory=lambda: np.array([0.6, 0.0, 0.8]))

    def radius_mm(self, phase):
        return 24.0 + 6.0 * np.cos(2 * np.pi * np.asarray(phase))

    def heart_tissue(self, points_mm, phase):
        distance_mm = np.linalg.norm(points_mm - self.centre_mm, axis=1)
        labels = np.zeros(len(points_mm), dtype=np.uint8)
        labels[distance_mm < 45.0] = Tissue.LV_MYOCARDIUM
        labels[distance_mm < self.radius_mm(phase)] = Tissue.LV_CAVITY
        return labels

    def chest_tissue(self, points_mm):
        inside = np.linalg.norm(points_mm - self.centre_mm, axis=1) < 75.0
        return np.where(inside, Tissue.FAT, Tissue.AIR).astype(np.uint8)

    def reference(self, points_mm, phase):
        return points_mm

    def nominal_phase(self, phase, rr_s):
        return phase ** (0.8 / rr_s)


@dataclass(frozen=True)
class Nothing(Ball):
    """A body without a heart."""

    def heart_tissue(self, points_mm, phase):
        return np.zeros(len(points_mm), dtype=np.uint8)


def record(heart=None, seed=0, **settings):
    rng = np.random.default_rng(seed)
    return simulate_sweeps(rng, heart or Ball(), R_TIMES_S, UltrasoundSettings(**settings))
