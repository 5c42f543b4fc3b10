"""Records and beats that the tests of the simulated ECG share."""

from __future__ import annotations

import importlib
import warnings
from contextlib import contextmanager

import numpy as np

from data_synth.ecg import LEADS, EcgSettings, simulate_ecg
from data_synth.rhythm import draw_breath, draw_rhythm

QUIET = {"baseline_mv": 0.0, "mains_mv": 0.0, "muscle_mv": 0.0}
STEADY = {"respiratory_variation": 0.0, "jitter": 0.0}
STILL = {**QUIET, "respiratory_modulation": 0.0}
LEAD_II = LEADS.index("II")


def record(duration_s=60.0, mean_rr_s=0.8, seed=0, rate_hz=500.0, **settings):
    rng = np.random.default_rng(seed)
    return simulate_ecg(rng, duration_s, mean_rr_s, rate_hz, EcgSettings(**settings))


def times_of(ecg):
    return np.arange(len(ecg.signal_mv)) / ecg.sampling_rate_hz


def lead(ecg, name):
    return ecg.signal_mv[:, ecg.leads.index(name)]


@contextmanager
def library(name="wfdb"):
    """The WFDB library, which calls deprecated parts of others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield importlib.import_module(name)


def rhythm(duration_s, mean_rr_s=0.8, seed=0, **settings):
    """Beats alone, without voltages."""
    settings = EcgSettings(**settings)
    rng = np.random.default_rng(seed)
    breath = draw_breath(rng, duration_s, settings)
    return draw_rhythm(rng, duration_s, mean_rr_s, breath, settings)
