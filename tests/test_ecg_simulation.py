"""The simulated ECG keeps its promises: R peaks where it says, and noise of the kind it says."""

from __future__ import annotations

import importlib
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import welch

from data_synth.ecg import LEADS, EcgSettings, phase_at, simulate_ecg, write_wfdb
from data_synth.errors import SynthError

QUIET = {"baseline_mv": 0.0, "mains_mv": 0.0, "muscle_mv": 0.0}
LEAD_II = LEADS.index("II")


def record(duration_s=60.0, mean_rr_s=0.8, seed=0, rate_hz=500.0, **settings):
    rng = np.random.default_rng(seed)
    return simulate_ecg(rng, duration_s, mean_rr_s, rate_hz, EcgSettings(**settings))


@pytest.mark.parametrize("mean_rr_s", [0.45, 0.8, 1.2])
def test_lead_ii_peaks_at_every_r_time(mean_rr_s):
    clean = record(mean_rr_s=mean_rr_s, **QUIET)
    times_s = np.arange(len(clean.signal_mv)) / clean.sampling_rate_hz
    for r_s in clean.r_times_s[1:-1]:
        near = np.abs(times_s - r_s) < 0.15
        peak_s = times_s[near][np.argmax(clean.signal_mv[near, LEAD_II])]
        # Half a sample, and the tilt of the S wave under the peak: its slope of 1.1 mV/s over the
        # R wave's curvature of 1.1 mV / (10.5 ms)^2 is 0.11 ms; twice that for other waves.
        assert abs(peak_s - r_s) <= 0.5 / clean.sampling_rate_hz + 0.00025


def test_every_beat_of_the_recording_is_listed_once():
    clean = record(**QUIET)
    heights = clean.signal_mv[:, LEAD_II]
    # R is the only wave of lead II over 0.7 mV: T reaches 0.33.
    rises = np.flatnonzero((heights[1:] > 0.7) & (heights[:-1] <= 0.7))
    assert abs(len(rises) - len(clean.r_times_s)) <= 1
    assert (np.diff(clean.r_times_s) > 0).all()


def test_intervals_average_to_the_rate_asked_for():
    signal = record(duration_s=300.0, mean_rr_s=0.8)
    intervals_s = np.diff(signal.r_times_s)
    # Jitter averages out with the root of the count; respiration leaves at most half a cycle's
    # surplus over the record, and its square a quarter of the variation's square.
    jitter = 4 * 0.015 / np.sqrt(len(intervals_s))
    respiration = 0.04 / (np.pi * 0.25 * 300.0) + 0.04**2
    assert intervals_s.mean() == pytest.approx(0.8, rel=jitter + respiration)


def test_intervals_swing_with_the_breath():
    signal = record(duration_s=240.0, respiration_hz=0.2, jitter=0.0)
    even_s = np.arange(5, 235, 0.25)
    swing = np.interp(even_s, signal.r_times_s[:-1], np.diff(signal.r_times_s))
    power = np.abs(np.fft.rfft(swing - swing.mean())) ** 2
    rate_hz = np.fft.rfftfreq(len(swing), 0.25)[np.argmax(power)]
    assert rate_hz == pytest.approx(0.2, abs=1 / 230)


def test_steady_heart_has_equal_intervals():
    signal = record(respiratory_variation=0.0, jitter=0.0, mean_rr_s=0.9)
    np.testing.assert_allclose(np.diff(signal.r_times_s), 0.9, rtol=1e-12)


def test_scanner_swells_the_t_wave_and_spares_the_r_time():
    off, on = record(**QUIET), record(magnetohydrodynamic_mv=1.0, **QUIET)
    np.testing.assert_array_equal(off.r_times_s, on.r_times_s)
    artefact = on.signal_mv - off.signal_mv
    rate_hz = off.sampling_rate_hz
    at_r = artefact[np.round(off.r_times_s[1:-1] * rate_hz).astype(int)]
    at_flow = artefact[np.round((off.r_times_s[1:-1] + 0.17) * rate_hz).astype(int)]
    # The mean height is 1 mV times the lead's share; each beat's varies by a tenth.
    sampling = 4 * 0.1 / np.sqrt(len(at_flow))
    assert at_flow[:, LEAD_II].mean() == pytest.approx(1.0, abs=sampling + 0.05)
    assert np.sign(at_flow.mean(axis=0)).tolist() == [1, 1, -1]
    assert np.abs(at_r).max() < 0.1


def test_mains_and_muscle_fill_their_own_bands():
    only_mains = record(mains_mv=0.1, baseline_mv=0, muscle_mv=0)
    only_muscle = record(mains_mv=0, baseline_mv=0, muscle_mv=0.1)
    clean = record(**QUIET)
    rate_hz = clean.sampling_rate_hz
    hz, mains = welch((only_mains.signal_mv - clean.signal_mv)[:, 0], rate_hz, nperseg=1000)
    assert hz[np.argmax(mains)] == pytest.approx(50.0, abs=0.5)
    _, muscle = welch((only_muscle.signal_mv - clean.signal_mv)[:, 0], rate_hz, nperseg=1000)
    # A Butterworth band of order 2, run both ways, halves the amplitude at 20 and 150 Hz.
    assert muscle[(hz >= 20) & (hz <= 150)].sum() > 0.85 * muscle.sum()
    spread = (only_muscle.signal_mv - clean.signal_mv).std(axis=0)
    np.testing.assert_allclose(spread, 0.1, rtol=1e-9)


def test_early_beats_are_followed_by_a_pause():
    signal = record(duration_s=200.0, ectopic_probability=0.1, jitter=0.0, respiratory_variation=0)
    early = np.flatnonzero(signal.ectopic[1:-1]) + 1
    assert 10 < len(early) < 50
    before = signal.r_times_s[early] - signal.r_times_s[early - 1]
    after = signal.r_times_s[early + 1] - signal.r_times_s[early]
    assert (before < 0.7 * 0.8).all()
    # The sinus node keeps its own time.
    np.testing.assert_allclose(before + after, 1.6, rtol=1e-9)


@given(
    steps=st.lists(st.floats(0.3, 2.0), min_size=2, max_size=20),
    shares=st.lists(st.floats(0, 0.999), min_size=1, max_size=20),
)
def test_phase_is_the_share_of_the_interval_that_has_passed(steps, shares):
    r_times_s = np.cumsum([0.0, *steps])
    times_s = np.array(shares) * r_times_s[-1]
    phase = phase_at(times_s, r_times_s)
    beats = np.interp(times_s, r_times_s, np.arange(len(r_times_s)))
    turned = np.abs(np.exp(2j * np.pi * phase) - np.exp(2j * np.pi * beats))
    # Division by an interval of 0.3 s or more magnifies the rounding of times up to 40 s.
    assert turned.max() < 2 * np.pi * 40 * 4 * np.finfo(float).eps / 0.3
    assert ((phase >= 0) & (phase < 1)).all()


@pytest.mark.parametrize("time_s", [0.5, 3.0, 3.5])
def test_phase_outside_the_beats_is_refused(time_s):
    with pytest.raises(SynthError, match="longer ECG"):
        phase_at(np.array([time_s]), np.array([1.0, 2.0, 3.0]))


def test_wfdb_reads_back_what_was_written(tmp_path):
    signal = record(duration_s=10.0)
    write_wfdb(tmp_path / "ecg", "mr", signal)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        back = importlib.import_module("wfdb").rdrecord(str(tmp_path / "ecg" / "mr"))
    # One step is 1 microvolt.
    np.testing.assert_allclose(back.p_signal, signal.signal_mv, atol=0.0005 + 1e-9)
    assert (back.fs, back.sig_name, back.units) == (500, list(LEADS), ["mV"] * 3)
    assert back.base_date is None
    assert back.base_time is None


def test_same_seed_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_wfdb(tmp_path / name, "mr", record(duration_s=10.0))
    for suffix in ("hea", "dat"):
        first, second = (tmp_path / name / f"mr.{suffix}" for name in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()
    assert not np.array_equal(record(seed=1).r_times_s, record(seed=2).r_times_s)


def test_signal_too_large_for_the_format_is_refused(tmp_path):
    huge = record(duration_s=10.0, baseline_mv=100.0)
    with pytest.raises(SynthError, match="32"):
        write_wfdb(tmp_path, "mr", huge)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"duration_s": 1.0}, "three beats"),
        ({"mean_rr_s": 0.1}, "heart rate"),
        ({"mean_rr_s": float("nan")}, "heart rate"),
        ({"rate_hz": 90.0}, "sampling_rate_hz"),
    ],
)
def test_impossible_recordings_are_refused(arguments, words):
    with pytest.raises(SynthError, match=words):
        record(**arguments)


def test_unknown_settings_are_refused():
    with pytest.raises(ValueError, match="mains_v"):
        EcgSettings(mains_v=1.0)
