"""The detector after what was louder than the heart: cautery, hum, a lead that was touched."""

from __future__ import annotations

import numpy as np
import pytest
from arrhythmia_records import matched, record

from pipeline.registration.rpeaks import RPeakDetector

FROM_S, RATE_HZ = 20.0, 250.0


def louder(signal_mv, what, size_mv, until_s, from_s=FROM_S, rate_hz=RATE_HZ):
    """The record with all leads taken from the heart for a while."""
    rng = np.random.default_rng(5)
    times_s = np.arange(len(signal_mv)) / rate_hz
    taken = (times_s >= from_s) & (times_s < until_s)
    out = signal_mv.copy()
    if what == "hum":
        out[taken] = size_mv * np.sin(2 * np.pi * 50 * times_s[taken])[:, None]
    else:
        out[taken] += size_mv * rng.normal(size=out[taken].shape)
    return out


def heard(signal_mv, r_times_s, from_s, rate_hz=RATE_HZ):
    """Share of the beats after a moment that are found, and whether the leads are usable then."""
    detector = RPeakDetector(rate_hz, signal_mv.shape[1])
    found_s = np.array([beat.time_s for beat in detector.push(signal_mv)])
    late = r_times_s[(r_times_s > from_s) & (r_times_s < len(signal_mv) / rate_hz - 0.5)]
    return (matched(found_s[found_s > from_s - 0.3], late) >= 0).mean(), detector.usable


@pytest.mark.parametrize("case", ["normal", "bundle branch block", "slow"])
@pytest.mark.parametrize(
    ("what", "size_mv", "lasts_s"),
    [("noise", 3.0, 8.0), ("noise", 10.0, 8.0), ("hum", 3.0, 8.0), ("hum", 10.0, 20.0)],
)
def test_beats_are_found_again_after_cautery_and_hum(case, what, size_mv, lasts_s):
    drawn = record(case, seed=3, duration_s=70.0, rate_hz=RATE_HZ)
    signal_mv = louder(drawn.signal_mv, what, size_mv, FROM_S + lasts_s)
    share, usable = heard(signal_mv, drawn.r_times_s, FROM_S + lasts_s + 12.0)
    assert usable
    assert share > 0.95


@pytest.mark.parametrize(
    ("case", "noise_mv", "size_mv", "lasts_s", "settles_s", "rate_hz"),
    [
        ("normal", 0.1, 5.0, 8.0, 12.0, 125.0),
        ("normal", 0.1, 10.0, 25.0, 12.0, 125.0),
        ("normal", 0.1, 5.0, 8.0, 12.0, 1000.0),
        ("normal", 0.1, 10.0, 25.0, 12.0, 1000.0),
        ("fast", 0.0, 5.0, 8.0, 15.0, 125.0),
        ("fast", 0.0, 5.0, 8.0, 15.0, 250.0),
    ],
)
def test_noisy_and_racing_beats_too(case, noise_mv, size_mv, lasts_s, settles_s, rate_hz):
    drawn = record(case, seed=3, duration_s=80.0, rate_hz=rate_hz)
    rng = np.random.default_rng(8)
    noisy_mv = drawn.signal_mv + noise_mv * rng.normal(size=drawn.signal_mv.shape)
    signal_mv = louder(noisy_mv, "noise", size_mv, FROM_S + lasts_s, rate_hz=rate_hz)
    share, usable = heard(signal_mv, drawn.r_times_s, FROM_S + lasts_s + settles_s, rate_hz)
    assert usable
    assert share > 0.95


@pytest.mark.parametrize("rate_hz", [125.0, 1000.0])
def test_no_beats_are_found_where_only_noise_is_left_after_cautery(rate_hz):
    drawn = record("normal", seed=4, duration_s=80.0, rate_hz=rate_hz)
    signal_mv = louder(drawn.signal_mv, "noise", 5.0, 28.0, rate_hz=rate_hz)
    still = np.arange(len(signal_mv)) >= 28.0 * rate_hz
    signal_mv[still] = 0.2 * np.random.default_rng(7).normal(size=signal_mv[still].shape)
    found = RPeakDetector(rate_hz, signal_mv.shape[1]).push(signal_mv)
    assert not [beat for beat in found if beat.time_s > 34.0]


@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
def test_a_heart_that_stops_under_bursts_of_muscle_noise_has_no_beats(rate_hz):
    drawn = record("normal", seed=5, duration_s=80.0, rate_hz=rate_hz)
    rng, count = np.random.default_rng(3), len(drawn.signal_mv)
    knots = np.arange(0, count, 0.3 * rate_hz)
    bursts = np.exp(0.8 * np.interp(np.arange(count), knots, rng.normal(size=len(knots))))
    signal_mv = drawn.signal_mv.copy()
    signal_mv[int(40.0 * rate_hz) :] = 0.0
    signal_mv += 0.015 * bursts[:, None] * rng.normal(size=signal_mv.shape)
    found = RPeakDetector(rate_hz, signal_mv.shape[1]).push(signal_mv)
    assert not [beat for beat in found if beat.time_s > 41.0]


@pytest.mark.parametrize("what", ["noise", "hum"])
def test_a_stream_that_begins_in_noise_finds_beats_when_it_ends(what):
    drawn = record("normal", seed=4, duration_s=60.0, rate_hz=RATE_HZ)
    signal_mv = louder(drawn.signal_mv, what, 5.0, 15.0, from_s=0.0)
    share, usable = heard(signal_mv, drawn.r_times_s, 30.0)
    assert usable
    assert share > 0.95


def test_an_open_input_after_cautery_stays_lost():
    drawn = record("normal", seed=4, duration_s=60.0, rate_hz=RATE_HZ)
    signal_mv = louder(drawn.signal_mv, "noise", 3.0, 28.0)
    open_from = int(28.0 * RATE_HZ)
    rest = signal_mv[open_from:]
    rest[:] = 0.001 * np.random.default_rng(6).normal(size=rest.shape)
    detector = RPeakDetector(RATE_HZ, 2)
    detector.push(signal_mv[: open_from + 50])
    said = [detector.usable for one in signal_mv[open_from + 50 :] if not detector.push(one)]
    assert len(said) > 7000
    assert not any(said)
