"""Ways in which all leads of an electrocardiogram are lost, and when the clock says so.

What can be known when: leads that fall silent (one value, missing samples, or an amplifier's own
noise) show it at once. Where hum or noise takes the heart's place, its beats may still be hidden in
it until the next one is overdue: until the latest moment at which a beat of the rhythm so far, as
the clock knew it, could have come.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfilt

from data_synth.ecg import EcgSettings, simulate_ecg
from pipeline.geometry import Float
from pipeline.registration.clock import PhaseClock
from pipeline.registration.rpeaks import LATENCY_S, RPeakDetector

SILENT = ("0 mV", "last value held", "rail", "samples missing", "amplifier noise")
LOUD = ("hum 1 mV", "noise half", "noise equal", "noise threefold", "noise tenfold")
RATES_HZ = (100.0, 250.0, 1000.0)
INTERVALS_S = (0.5, 0.7, 0.9, 1.2)
_LEARNT_S, _AFTER_S = 14.0, 6.0
_RAIL_MV = 5.0


def without_heart(
    rng: np.random.Generator, signal_mv: Float, first: int, kind: str, rate_hz: float
) -> Float:
    """The recording ``(n, leads)`` with all leads lost from a sample on."""
    out = signal_mv.copy()
    shape = out[first:].shape
    if kind in LOUD[1:]:
        times = {"noise half": 0.5, "noise equal": 1.0, "noise threefold": 3.0}.get(kind, 10.0)
        band = butter(2, (15.0, min(100.0, 0.45 * rate_hz)), "bandpass", fs=rate_hz, output="sos")
        noise = sosfilt(band, rng.normal(size=shape), axis=0)
        # As strong as the heart's own signal was, or so many times.
        out[first:] = times * signal_mv[:first].std(axis=0) * noise / noise.std(axis=0)
    elif kind == "hum 1 mV":
        turn = 2 * np.pi * 50.0 * np.arange(shape[0]) / rate_hz
        # At 100 Hz every sample of 50 Hz meets the same two places of the wave.
        out[first:] = np.sin(turn + 1.0)[:, None] + 0.01 * rng.normal(size=shape)
    else:
        values: dict[str, Float | float] = {
            "0 mV": 0.0,
            "last value held": out[first],
            "rail": _RAIL_MV,
            "samples missing": np.nan,
            "amplifier noise": 0.001 * rng.normal(size=shape),
        }
        out[first:] = values[kind]
    return out


def losses(kind: str, seeds: int) -> tuple[Float, Float, int]:
    """Milliseconds from loss to invalid, and from when it can be known; and losses that were not
    counted, for the phase was not valid before."""
    after, known, left_out = [], [], 0
    for seed in range(seeds):
        for rate_hz in RATES_HZ:
            for rr_s in INTERVALS_S:
                one = _lose(seed, kind, rate_hz, rr_s)
                if one is None:
                    left_out += 1
                else:
                    after.append(1e3 * one[0])
                    known.append(1e3 * one[1])
    return np.array(after), np.array(known), left_out


def _lose(seed: int, kind: str, rate_hz: float, rr_s: float) -> tuple[float, float] | None:
    rng = np.random.default_rng([seed, int(rate_hz), round(100 * rr_s)])
    ecg = simulate_ecg(rng, _LEARNT_S + _AFTER_S, rr_s, rate_hz, EcgSettings())
    first = round(rate_hz * (_LEARNT_S + rng.uniform(0, rr_s)))
    signal_mv = without_heart(rng, ecg.signal_mv, first, kind, rate_hz)
    detector, clock = RPeakDetector(rate_hz, signal_mv.shape[1]), PhaseClock(0.8)
    lost_s = first / rate_hz
    last_r_s = float(ecg.r_times_s[ecg.r_times_s < lost_s][-1])
    due_s, was_valid = 0.0, False
    for number, sample in enumerate(signal_mv):
        for beat in detector.push(sample):
            clock.beat(beat.time_s, beat.strange)
        valid = clock.at(number / rate_hz, detector.usable).valid
        now_s = number / rate_hz
        if now_s < max(lost_s, last_r_s + LATENCY_S):
            due_s = last_r_s + clock.next_rr_s + clock.tolerance_s
        if number < first:
            was_valid = valid
        elif not was_valid:
            return None
        elif not valid:
            knowable_s = lost_s if kind in SILENT else max(lost_s, due_s)
            return now_s - lost_s, now_s - knowable_s
    return np.inf, np.inf


def loss_table(seeds: int) -> None:
    """Print how long the phase is still called valid, by kind of loss."""
    count = seeds * len(RATES_HZ) * len(INTERVALS_S)
    print(f"all leads lost, {count} times each, anywhere in the beat")
    for kind in SILENT + LOUD:
        after, known, left_out = losses(kind, seeds)
        print(
            f"  {kind:16s} invalid after the loss {np.median(after):5.0f} ms, longest "
            f"{after.max():5.0f}; after it can be known {np.percentile(known, 95):5.0f} (95 %), "
            f"longest {known.max():5.0f}; {(known <= 150).mean():.1%} of {len(known)} within 150 ms"
            f" ({left_out} more were not valid before)"
        )
