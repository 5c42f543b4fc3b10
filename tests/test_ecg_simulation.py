"""Waves, phases and files of the simulated ECG agree with its truth, in every lead."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from ecg_records import LEAD_II, QUIET, STEADY, STILL, lead, library, record, times_of
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from data_synth.ecg import (
    ALL_LEADS,
    LEADS,
    EcgSettings,
    phase_at,
    write_annotations,
    write_wfdb,
)
from data_synth.errors import SynthError


@pytest.mark.parametrize("mean_rr_s", [0.45, 0.8, 1.2])
def test_lead_ii_peaks_at_every_r_time(mean_rr_s):
    clean = record(mean_rr_s=mean_rr_s, **QUIET)
    times_s = times_of(clean)
    for r_s in clean.r_times_s[1:-1]:
        near = np.abs(times_s - r_s) < 0.15
        peak_s = times_s[near][np.argmax(clean.signal_mv[near, LEAD_II])]
        # Half a sample. Breath turns the vector by 0.105 rad: the S wave, against which the peak
        # was placed, changes by 0.2 mV, 28 ms after the peak of width 10.5 ms: its tail there
        # has a slope of 0.2 * 0.02 * 28 / 10^2 mV/ms over a curvature of 1.1 / 10.5^2: 0.1 ms.
        assert abs(peak_s - r_s) <= 0.5 / clean.sampling_rate_hz + 0.00025


@pytest.mark.parametrize("focus", ["right_ventricle", "left_ventricle"])
@pytest.mark.parametrize(
    "rhythm",
    [
        {"ectopic_probability": 0.3},
        {"atrial_probability": 0.3},
        {"fibrillation": True, "fibrillation_wave_mv": 0.0},
    ],
)
def test_r_time_is_where_lead_ii_is_farthest_from_baseline_in_any_beat(rhythm, focus):
    clean = record(mean_rr_s=0.9, rate_hz=2000.0, ectopic_focus=focus, **rhythm, **STILL)
    times_s = times_of(clean)
    for r_s, wide in list(zip(clean.r_times_s, clean.ectopic, strict=True))[1:-1]:
        near = np.abs(times_s - r_s) < 0.03
        peak_s = times_s[near][np.argmax(np.abs(clean.signal_mv[near, LEAD_II]))]
        # Under a wide beat the T wave before and the blocked P wave after it slope by up to
        # 3 mV/s; the beat's own curvature is 0.9 mV / (25 ms)^2 = 1400 mV/s^2.
        assert abs(peak_s - r_s) <= 0.25e-3 + (2.2e-3 if wide else 0.3e-3)


def test_s_wave_of_v1_comes_after_the_r_time():
    clean = record(leads=("V1",), **QUIET)
    times_s = times_of(clean)
    late_s = []
    for r_s in clean.r_times_s[1:-1]:
        near = np.abs(times_s - r_s) < 0.06
        late_s.append(times_s[near][np.argmin(clean.signal_mv[near, 0])] - r_s)
    assert 0.012 < np.median(late_s) < 0.03


def test_every_beat_of_the_recording_is_listed_once():
    clean = record(**QUIET)
    heights = clean.signal_mv[:, LEAD_II]
    # R is the only wave of lead II over 0.7 mV: T reaches 0.35.
    rises = np.flatnonzero((heights[1:] > 0.7) & (heights[:-1] <= 0.7))
    assert abs(len(rises) - len(clean.r_times_s)) <= 1
    assert (np.diff(clean.r_times_s) > 0).all()
    assert clean.kinds == ("normal",) * len(clean.r_times_s)


def test_an_independent_detector_finds_the_beats():
    noisy = record(40.0, magnetohydrodynamic_mv=0.5, seed=5)
    with library("wfdb.processing") as processing:
        found = processing.xqrs_detect(noisy.signal_mv[:, LEAD_II], 500.0, verbose=False)
    # It learns for some seconds, and the last beat may not be whole.
    truth_s = noisy.r_times_s[(noisy.r_times_s > 3) & (noisy.r_times_s < 39.5)]
    found_s = found / 500.0
    nearest = np.argmin(np.abs(truth_s[:, None] - found_s), axis=1)
    # It marks a peak or a slope of its own filtered signal, somewhere in the QRS.
    assert np.abs(truth_s - found_s[nearest]).max() < 0.05
    np.testing.assert_array_equal(np.diff(nearest), 1)


@pytest.mark.parametrize(("correction", "power"), [("fridericia", 1 / 3), ("bazett", 1 / 2)])
@pytest.mark.parametrize("rr_s", [0.7, 1.0, 1.5])
def test_qt_follows_the_interval(correction, power, rr_s):
    clean = record(30.0, rr_s, rate_hz=1000.0, qt_correction=correction, **STEADY, **STILL)
    r_s = clean.r_times_s[10]
    offset_s = np.arange(0.08, 0.6 * rr_s**power, 1e-3)
    t_mv = np.interp(r_s + offset_s, times_of(clean), lead(clean, "II"))
    # The tangent at the steepest fall meets the baseline at the end of T.
    peak = int(np.argmax(t_mv))
    slope = np.gradient(t_mv, 1e-3)
    steepest = peak + int(np.argmin(slope[peak:]))
    end_s = offset_s[steepest] - t_mv[steepest] / slope[steepest]
    # QRS starts 40 ms before R. Steps of 1 ms at either end; the next P is over 60 ms away.
    assert end_s + 0.040 == pytest.approx(0.410 * rr_s**power, abs=0.003)


def test_intervals_lie_in_published_normal_ranges():
    """Second to 98th percentile of 36,299 women.

    Rautaharju et al., J Electrocardiol 46 (2013) 707-716, table 2.
    """
    clean = record(30.0, 1.0, rate_hz=1000.0, leads=ALL_LEADS, **STEADY, **STILL)
    start = round(clean.r_times_s[10] * 1000)
    beat_mv = clean.signal_mv[start - 300 : start + 600]
    activity_mv = np.abs(beat_mv).max(axis=1)
    offset_ms = np.arange(-300, 600)

    def first_last(low_ms, high_ms, threshold_mv):
        here = offset_ms[(offset_ms >= low_ms) & (offset_ms < high_ms)]
        above = here[activity_mv[300 + here] > threshold_mv]
        return above[0], above[-1]

    p_onset, _ = first_last(-300, -80, 0.015)
    qrs_onset, qrs_end = first_last(-70, 70, 0.08)
    t_peak = offset_ms[np.argmax(np.where(offset_ms > 120, activity_mv, 0))]
    assert 118 <= qrs_onset - p_onset <= 212
    assert 70 <= qrs_end - qrs_onset <= 104
    assert 294 <= t_peak - qrs_onset <= 366
    # T end by the tangent, at 410 ms after the onset (see the test of QT).
    assert 63 <= -40 + 410 - t_peak <= 112


def test_twelve_leads_look_as_in_health():
    clean = record(30.0, 1.0, leads=ALL_LEADS, **STEADY, **STILL)
    at = [round((clean.r_times_s[10] + s) * 500) for s in (-0.28, -0.06, 0.08, 0.45)]
    p, qrs, t = (clean.signal_mv[a:b] for a, b in pairwise(at))
    height = {name: qrs[:, k].max() for k, name in enumerate(ALL_LEADS)}
    depth = {name: -qrs[:, k].min() for k, name in enumerate(ALL_LEADS)}
    net = {name: height[name] - depth[name] for name in ALL_LEADS}
    axis_deg = np.degrees(np.arctan2(2 / np.sqrt(3) * net["aVF"], net["I"]))
    assert -30 < axis_deg < 90
    # r in V1 grows to R in V4, S shrinks from V2 to V6: the transition.
    assert 0.1 < height["V1"] < height["V2"] < height["V3"] < height["V4"]
    assert depth["V2"] > depth["V3"] > depth["V4"] > depth["V5"] > depth["V6"]
    assert net["V2"] < 0 < net["V4"]
    ii, avr, v1 = (ALL_LEADS.index(name) for name in ("II", "aVR", "V1"))
    assert p[:, ii].max() == pytest.approx(0.14, abs=0.06)
    assert p[:, v1].max() > 0.02
    assert p[:, v1].min() < -0.02
    for wave in (p, qrs, t):
        assert wave[:, avr].max() < -0.5 * wave[:, avr].min()
    for name in ("I", "II", "V3", "V4", "V5", "V6"):
        assert t[:, ALL_LEADS.index(name)].max() > 0.1


def test_leads_obey_einthoven_and_goldberger_in_all_noise():
    noisy = record(
        20.0, leads=ALL_LEADS, motion_per_minute=20, gradient_mv=0.2, magnetohydrodynamic_mv=0.5
    )
    i, ii = lead(noisy, "I"), lead(noisy, "II")
    laws = {"III": ii - i, "aVR": -(i + ii) / 2, "aVL": i - ii / 2, "aVF": ii - i / 2}
    for name, expected in laws.items():
        np.testing.assert_allclose(lead(noisy, name), expected, atol=1e-12)


def test_choice_of_leads_changes_no_lead():
    chosen, whole = (record(10.0, leads=leads) for leads in (("V5", "II"), ALL_LEADS))
    for name in ("V5", "II"):
        np.testing.assert_allclose(lead(chosen, name), lead(whole, name), atol=1e-12)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 2000.0])
def test_sampling_rate_changes_neither_beats_nor_waves(rate_hz):
    coarse, fine = (record(20.0, rate_hz=hz, **QUIET) for hz in (rate_hz, 1000.0))
    np.testing.assert_array_equal(coarse.r_times_s, fine.r_times_s)
    shared_s = np.arange(0, 19.9, 0.01)
    samples = [
        ecg.signal_mv[np.round(shared_s * ecg.sampling_rate_hz).astype(int)]
        for ecg in (coarse, fine)
    ]
    # Waves end where they fall below a millionth of a mV or so.
    np.testing.assert_allclose(samples[0], samples[1], atol=5e-6)


def test_breath_swings_the_height_of_r():
    clean = record(120.0, respiration_hz=0.2, respiratory_modulation=0.1, **STEADY, **QUIET)
    times_s = times_of(clean)
    heights = CubicSpline(times_s, lead(clean, "II"))(clean.r_times_s[1:-1])
    hz, density = welch(heights / heights.mean() - 1, 1 / 0.8, nperseg=100)
    assert hz[1:][np.argmax(density[1:])] == pytest.approx(0.2, abs=0.02)
    # At R the vector is about (1.2, 0.75) mV to the left and feet, and II is 0.235 x + 1.066 y. A
    # turn by 0.5 * 0.1 adds 0.05 * (1.066 * 1.2 - 0.235 * 0.75) = 0.055 mV, 0.05 of II's 1.1, to
    # the swing of 0.1. The other waves of the QRS move it by a few hundredths of that.
    assert np.sqrt(2) * np.std(heights / heights.mean()) == pytest.approx(0.15, rel=0.1)


def test_ventricular_beats_are_wide_and_have_no_p_wave():
    clean = record(200.0, 0.9, ectopic_probability=0.15, **STILL)
    half = {}
    before = {}
    for r_s, early in list(zip(clean.r_times_s, clean.ectopic, strict=True))[2:-2]:
        near = np.abs(times_of(clean) - r_s) < 0.12
        mv = np.abs(lead(clean, "II")[near])
        half.setdefault(early, []).append((mv > mv.max() / 2).sum() / 500)
        p = lead(clean, "II")[np.abs(times_of(clean) - r_s + 0.15) < 0.05]
        before.setdefault(early, []).append(np.ptp(p))
    # Width at half height: 2.35 * 24 ms against 2.35 * 10.5 ms.
    assert np.median(half[True]) > 2 * np.median(half[False])
    assert np.median(before[False]) > 0.1


def test_fibrillating_atria_show_f_waves_and_no_p():
    kept = {"rate_hz": 250.0, "fibrillation": True, "fibrillation_wave_hz": 7.0, **STILL}
    waves = record(120.0, fibrillation_wave_mv=0.2, **kept)
    none = record(120.0, fibrillation_wave_mv=0.0, **kept)
    hz, density = welch(lead(waves, "V1") - lead(none, "V1"), 250.0, nperseg=1024)
    assert hz[np.argmax(density)] == pytest.approx(7.0, abs=0.5)
    assert 4 < hz[np.argmax(density)] < 9
    # Without f waves nothing is left between T and Q: beats after a long pause show it.
    long = 1 + np.flatnonzero(np.diff(none.r_times_s) > 1.0)
    assert len(long) > 5
    for r_s in none.r_times_s[long]:
        quiet = (times_of(none) > r_s - 0.25) & (times_of(none) < r_s - 0.07)
        assert np.abs(lead(none, "II")[quiet]).max() < 0.01


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
    with library() as wfdb:
        back = wfdb.rdrecord(str(tmp_path / "ecg" / "mr"))
    # One step is 1 microvolt.
    np.testing.assert_allclose(back.p_signal, signal.signal_mv, atol=0.0005 + 1e-9)
    assert (back.fs, back.sig_name, back.units) == (500, list(LEADS), ["mV"] * 3)
    assert back.base_date is None
    assert back.base_time is None


def test_annotations_name_each_beat_rhythm_and_loss(tmp_path):
    signal = record(
        ectopic_probability=0.2,
        atrial_probability=0.2,
        fibrillation=True,
        fibrillation_s=(20.0, 40.0),
        lost=[{"lead": "II", "start_s": 50.0, "end_s": 52.0}],
    )
    write_annotations(tmp_path / "truth", "mr", signal)
    with library() as wfdb:
        back = wfdb.rdann(str(tmp_path / "truth" / "mr"), "atr")
    beats = [k for k, symbol in enumerate(back.symbol) if symbol in "NVA"]
    np.testing.assert_array_equal(back.sample[beats], np.round(signal.r_times_s * 500))
    codes = {"premature_ventricular": "V", "premature_atrial": "A"}
    assert [back.symbol[k] for k in beats] == [codes.get(kind, "N") for kind in signal.kinds]
    assert {"V", "A", "N"} <= set(back.symbol)
    marks = [
        (back.sample[k] / 500, back.symbol[k], back.aux_note[k].rstrip("\0"))
        for k in range(len(back.symbol))
        if k not in beats
    ]
    assert marks == [
        (0.0, "+", "(N"),
        (20.0, "+", "(AFIB"),
        (40.0, "+", "(N"),
        (50.0, "~", "lost II"),
        (52.0, "~", "back II"),
    ]
    assert back.fs == 500


def test_same_seed_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        signal = record(duration_s=10.0, lost_per_minute=10, motion_per_minute=10)
        write_wfdb(tmp_path / name, "mr", signal)
        write_annotations(tmp_path / name, "mr", signal)
    for suffix in ("hea", "dat", "atr"):
        first, second = (tmp_path / name / f"mr.{suffix}" for name in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()
    assert not np.array_equal(record(seed=1).r_times_s, record(seed=2).r_times_s)


def test_signal_too_large_for_the_format_is_refused(tmp_path):
    plain = record(duration_s=10.0)
    with pytest.raises(SynthError, match="32"):
        write_wfdb(tmp_path, "mr", replace(plain, signal_mv=100 * plain.signal_mv))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"duration_s": 1.0}, "three beats"),
        ({"duration_s": float("nan")}, "three beats"),
        ({"mean_rr_s": 0.1}, "heart rate"),
        ({"mean_rr_s": float("nan")}, "heart rate"),
        ({"rate_hz": 90.0}, "sampling_rate_hz"),
        ({"rate_hz": 4000.0}, "sampling_rate_hz"),
        ({"lost": [{"lead": "II", "start_s": 50.0, "end_s": 90.0}]}, "past the recording"),
        ({"fibrillation": True, "fibrillation_s": (70.0, 90.0)}, "past the recording"),
    ],
)
def test_impossible_recordings_are_refused(arguments, words):
    with pytest.raises(SynthError, match=words):
        record(**arguments)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mains_v": 1.0}, "mains_v"),
        ({"leads": ()}, "leads"),
        ({"leads": ("II", "II")}, "twice"),
        ({"leads": ("II", "V7")}, "V7"),
        ({"start_rate_bpm": 60}, "belong together"),
        ({"respiratory_variation": 0.2, "lf_hf_ratio": 5}, "lower them"),
        ({"fibrillation_s": (1.0, 2.0)}, "fibrillation: true"),
        ({"fibrillation": True, "fibrillation_s": (3.0, 2.0)}, "start < end"),
        ({"lost": [{"lead": "V6", "start_s": 1, "end_s": 2}]}, "not recorded"),
        ({"lost": [{"lead": "II", "start_s": 2, "end_s": 1}]}, "not before"),
        ({"muscle_mv": float("nan")}, "muscle_mv"),
        ({"baseline_mv": -1.0}, "baseline_mv"),
        ({"qtc_ms": 100.0}, "qtc_ms"),
    ],
)
def test_impossible_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        EcgSettings(**settings)
