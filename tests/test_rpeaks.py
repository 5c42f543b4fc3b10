"""The streaming detector against the phantom's beats: every rate, polarity, artefact and rhythm."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_synth.ecg import EcgSettings, LostLead, simulate_ecg
from pipeline.errors import InputError
from pipeline.registration.qrs import feed
from pipeline.registration.rhythm import doubt, read_rhythm
from pipeline.registration.rpeaks import (
    LATENCY_S,
    LEARN_S,
    RPeakDetector,
    _is_strange,
    _is_wide,
    find_beats,
)

# AAMI EC57 matches a detection to a beat within 150 ms.
SAME_BEAT_S = 0.15


def record(seed=0, duration_s=40.0, rr_s=0.8, rate_hz=250.0, **settings):
    rng = np.random.default_rng(seed)
    return simulate_ecg(rng, duration_s, rr_s, rate_hz, EcgSettings(**settings))


def score(ecg, signal_mv=None, leads=None):
    """Missed beats, extra beats, and how late each found beat was timed."""
    signal_mv = ecg.signal_mv if signal_mv is None else signal_mv
    signal_mv = signal_mv if leads is None else signal_mv[:, leads]
    found_s = np.array([one.time_s for one in find_beats(signal_mv, ecg.sampling_rate_hz)])
    truth_s = ecg.r_times_s
    # A complex that is cut by an end of the recording need not be seen.
    end_s = (len(signal_mv) - 1) / ecg.sampling_rate_hz
    inner_s = truth_s[(truth_s > 0.1) & (truth_s < end_s - 0.1)]
    late_s = np.array([found_s[np.abs(found_s - r).argmin()] - r for r in inner_s])
    missed = int((np.abs(late_s) > SAME_BEAT_S).sum())
    extra = sum(np.abs(truth_s - one).min() > SAME_BEAT_S for one in found_s)
    return missed, extra, late_s[np.abs(late_s) <= SAME_BEAT_S]


@pytest.mark.parametrize("rate_hz", [100.0, 360.0, 2000.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_clean_beats_are_found_and_timed_at_any_rate_and_polarity(rate_hz, sign):
    ecg = record(rate_hz=rate_hz, duration_s=20.0)
    missed, extra, late_s = score(ecg, sign * ecg.signal_mv)
    assert (missed, extra) == (0, 0)
    # The project's own requirement.
    assert np.median(np.abs(late_s)) < 0.002
    assert np.abs(late_s).max() < 0.010


def late_by(rate_hz, rise_s, fall_s):
    """By how much the peaks of waves made of half a Gaussian each way are told too late."""
    r_times_s = 0.5 + 0.8037 * np.arange(23)
    away_s = np.arange(round(19 * rate_hz))[:, None] / rate_hz - r_times_s
    width_s = np.where(away_s < 0, rise_s, fall_s)
    signal_mv = np.exp(-0.5 * (away_s / width_s) ** 2).sum(axis=1)
    found_s = np.array([one.time_s for one in find_beats(signal_mv[:, None], rate_hz)])
    assert len(found_s) == len(r_times_s)
    return (found_s - r_times_s)[4:]


@pytest.mark.parametrize("rate_hz", [100.0, 125.0, 250.0, 1000.0])
def test_peaks_between_samples_are_told_to_a_tenth_of_one(rate_hz):
    """Their times go through all fractions of a sample. A parabola through three samples of a
    Gaussian whose deviation is 1.4 of them or more is off by a twentieth at most."""
    assert np.abs(late_by(rate_hz, 0.012, 0.012)).max() < 0.1 / rate_hz


@pytest.mark.parametrize("rate_hz", [250.0, 1000.0])
@pytest.mark.parametrize("widths_s", [(0.008, 0.014), (0.014, 0.008)])
def test_waves_that_rise_and_fall_unlike_are_timed_by_their_peak(rate_hz, widths_s):
    """Smoothed as noise asks for, their summit lies 3 ms to the flatter side; what is required is
    2 ms."""
    assert np.abs(np.median(late_by(rate_hz, *widths_s))) < 0.002


@pytest.mark.parametrize(
    "settings",
    [
        {"magnetohydrodynamic_mv": 0.5, "muscle_snr_db": 6.0},
        {"magnetohydrodynamic_mv": 1.2},
        {"baseline_mv": 3.0},
        {"mains_mv": 0.3, "mains_hz": 60.0},
        {"fibrillation": True},
        {"ectopic_probability": 0.15, "ectopic_focus": "left_ventricle"},
        {"ectopic_probability": 0.15, "ectopic_pattern": "couplets"},
        {"ectopic_pattern": "bigeminy", "ectopic_focus": "left_ventricle"},
    ],
)
@pytest.mark.parametrize("leads", [None, [1]])
def test_no_beat_is_lost_or_added_by_disturbance_or_rhythm(settings, leads):
    missed, extra, late_s = score(record(seed=1, **settings), leads=leads)
    # One in a hundred is the requirement; 50 beats or fewer allow one of either kind.
    assert missed <= 1
    assert extra <= 1
    assert np.median(np.abs(late_s)) < 0.005


@pytest.mark.parametrize("kind", ["flat", "rail"])
def test_a_lost_lead_has_no_say(kind):
    lost = (
        LostLead(lead="II", start_s=8.3, end_s=14.1, kind=kind),
        LostLead(lead="I", start_s=20.2, end_s=29.0, kind=kind),
    )
    missed, extra, late_s = score(record(lost=lost))
    assert (missed, extra) == (0, 0)
    assert np.abs(late_s).max() < 0.010


def test_beats_are_found_again_after_all_leads_were_lost():
    ecg = record(lost=(LostLead(lead="all", start_s=12.0, end_s=24.0),))
    found_s = np.array([one.time_s for one in find_beats(ecg.signal_mv, 250.0)])
    after_s = ecg.r_times_s[(ecg.r_times_s > 25.0) & (ecg.r_times_s < 39.9)]
    assert np.abs(after_s[:, None] - found_s).min(axis=1).max() < 0.010
    assert len(found_s[found_s > 25.0]) <= len(after_s) + 1
    assert not ((found_s > 12.2) & (found_s < 23.9)).any()


SILENT = {
    "nothing": lambda rng, signal: np.zeros_like(signal),
    "last value": lambda rng, signal: np.repeat(signal[:1], len(signal), axis=0),
    "missing": lambda rng, signal: np.full_like(signal, np.nan),
    # An open input: the amplifier's own noise, a microvolt or so.
    "amplifier": lambda rng, signal: 0.001 * rng.normal(size=signal.shape),
    # The same, and charge that runs off.
    "drift": lambda rng, signal: (
        signal[:1]
        + np.linspace(0.0, 4.0, len(signal))[:, None]
        + 0.001 * rng.normal(size=signal.shape)
    ),
}


@pytest.mark.parametrize("rate_hz", [100.0, 500.0])
@pytest.mark.parametrize("kind", SILENT)
def test_silence_of_all_leads_is_noticed_at_any_moment_of_the_beat(kind, rate_hz):
    rng = np.random.default_rng(3)
    ecg = record(seed=4, duration_s=20.0, rate_hz=rate_hz)
    for late_s in (0.0, 0.2, 0.4, 0.6):
        signal_mv = ecg.signal_mv.copy()
        first = round((12.0 + late_s) * rate_hz)
        signal_mv[first:] = SILENT[kind](rng, signal_mv[first:])
        detector = RPeakDetector(rate_hz, 3)
        detector.push(signal_mv[:first])
        assert detector.usable
        # A window of 0.1 s, looked at every 5 ms or every sample.
        detector.push(signal_mv[first : first + round(0.12 * rate_hz) + 1])
        assert not detector.usable
        detector.push(signal_mv[first + round(0.12 * rate_hz) + 1 :])
        assert not detector.usable


def usable_times(signal_mv, rate_hz):
    detector = RPeakDetector(rate_hz, signal_mv.shape[1])
    usable = []
    for sample in signal_mv:
        detector.push(sample)
        usable.append(detector.usable)
    return np.array(usable)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"muscle_mv": 0.0, "mains_mv": 0.0},
        {"muscle_mv": 0.0, "mains_mv": 0.0, "baseline_mv": 0.0},
        {"muscle_snr_db": 6.0, "magnetohydrodynamic_mv": 0.5},
        {"baseline_mv": 2.0},
        {"motion_per_minute": 20.0},
    ],
)
@pytest.mark.parametrize("step_mv", [1e-6, 0.005, 0.02])
def test_no_connected_lead_is_taken_for_a_lost_one(settings, step_mv):
    """However clean, noisy or restless it is, and however coarse the converter."""
    ecg = record(seed=5, duration_s=30.0, rr_s=1.2, **settings)
    assert usable_times(step_mv * np.round(ecg.signal_mv / step_mv), 250.0).all()


def test_a_lead_that_grows_quiet_is_believed_again_after_a_beat():
    rng = np.random.default_rng(6)
    ecg = record(seed=6, duration_s=20.0, muscle_mv=0.01, mains_mv=0.0)
    signal_mv = ecg.signal_mv.copy()
    # A tense muscle that relaxes at 12 s: noise falls to a tenth.
    signal_mv[:3000] += 0.1 * rng.normal(size=signal_mv[:3000].shape)
    usable = usable_times(signal_mv, 250.0)
    assert usable[:3000].all()
    # The next beat comes within 0.8 s, and a lead that comes back settles for 0.2 s.
    assert usable[3000 + 300 :].all()


@pytest.mark.parametrize("rate_hz", [125.0, 1000.0])
def test_a_sample_missing_here_and_there_costs_nothing(rate_hz):
    ecg = record(rate_hz=rate_hz)
    broken = ecg.signal_mv.copy()
    broken[np.random.default_rng(7).random(len(broken)) < 0.01] = np.nan
    assert score(ecg, broken)[:2] == (0, 0)
    assert usable_times(broken, rate_hz).all()


def test_the_line_over_a_gap_tells_nothing_of_a_converter_s_steps():
    """By these a coarse lead is known, whose stillest moments may well be one value."""
    coarse = 0.02 * np.round(record().signal_mv / 0.02)
    for first in np.random.default_rng(7).integers(250, len(coarse), 20):
        coarse[first : first + 4] = np.nan
    detector = RPeakDetector(250.0, 3)
    detector.push(coarse)
    np.testing.assert_allclose(detector._state.leads["smallest_step"], 0.02)


def test_missing_samples_are_a_lost_lead():
    ecg = record()
    broken = ecg.signal_mv.copy()
    broken[2000:4000, 1] = np.nan
    assert score(ecg, broken)[:2] == (0, 0)


def test_a_beat_whose_peak_came_before_the_record_is_not_told():
    ecg = record()
    cut = ecg.signal_mv[round((ecg.r_times_s[3] + 0.012) * 250) :]
    beats = read_rhythm(cut, 250.0)
    assert min(one.time_s for one in beats) >= 0
    assert np.isnan(beats[0].rr_s)


def test_no_interval_is_told_across_lost_leads():
    ecg = record()
    broken = ecg.signal_mv.copy()
    broken[2000:2600] = np.nan
    beats = read_rhythm(broken, 250.0)
    across = next(one for one in beats if one.time_s > 2600 / 250)
    assert np.isnan(across.rr_s)
    assert [one for one in beats if np.isnan(one.rr_s)] == [beats[0], across]


def test_samples_that_are_no_numbers_are_refused():
    with pytest.raises(InputError, match="must be numbers"):
        RPeakDetector(250.0).push("x")


def test_a_rate_told_as_a_whole_number_compiles_nothing_anew():
    """The kernels are compiled when a detector is made, for rates of one kind."""
    detector = RPeakDetector(250)
    kinds = len(feed.signatures)
    detector.push(np.zeros(10)[:, None])
    assert len(feed.signatures) == kinds == 1


@pytest.mark.parametrize("noise", [{}, {"muscle_snr_db": 6.0, "magnetohydrodynamic_mv": 0.5}])
def test_ventricular_beats_look_strange_and_others_hardly_ever(noise):
    told: dict[str, list[bool]] = {"normal": [], "premature_ventricular": []}
    for seed in range(3):
        ecg = record(seed=seed, duration_s=60.0, ectopic_probability=0.1, **noise)
        beats = find_beats(ecg.signal_mv, 250.0)
        for r_s, kind in zip(ecg.r_times_s, ecg.kinds, strict=True):
            nearest = min(beats, key=lambda beat: abs(beat.time_s - r_s))
            if abs(nearest.time_s - r_s) < 0.15:
                told[kind].append(nearest.strange)
    # One that begins as usual beats do may pass for one; a usual one misjudged costs trust for two.
    assert np.mean(told["premature_ventricular"]) > 0.5
    assert np.mean(told["normal"]) < 0.01


@pytest.mark.parametrize(
    ("likeness", "others", "strange"),
    [
        (0.76, [], False),
        (0.74, [], True),
        # Five beats tell no scatter.
        (0.76, [0.99] * 5, False),
        (0.92, [0.99] * 6, True),
        (0.94, [0.99] * 6, False),
        # A median absolute deviation of 0.04: three standard deviations are 0.178.
        (0.78, [0.91, 0.95, 0.99] * 3, False),
        (0.76, [0.91, 0.95, 0.99] * 3, True),
        # However alike beats were, so little is another shape.
        (0.74, [0.6, 0.8, 1.0] * 3, True),
        (0.76, [0.6, 0.8, 1.0] * 3, False),
    ],
)
def test_another_shape_is_told_by_the_scatter_of_the_beats_before(likeness, others, strange):
    assert _is_strange(likeness, others) == strange


@pytest.mark.parametrize(
    ("broader", "others", "wide"),
    [
        # Five beats tell no scatter.
        (2.0, [1.0] * 5, False),
        (1.45, [1.0] * 6, True),
        (1.35, [1.0] * 6, False),
        # Usual beats are twice as broad for their height as those by which levels were learnt.
        (2.7, [2.0] * 6, False),
        (2.9, [2.0] * 6, True),
        # A median absolute deviation of a tenth: four standard deviations are a factor of 1.76.
        (1.7, [1 / 1.1, 1.0, 1.1] * 3, False),
        (1.8, [1 / 1.1, 1.0, 1.1] * 3, True),
    ],
)
def test_a_wide_beat_is_told_by_the_scatter_of_the_beats_before(broader, others, wide):
    assert _is_wide(np.log(broader), np.log(others)) == wide


def test_blocks_of_any_size_give_the_same_beats():
    ecg = record(duration_s=15.0, muscle_mv=0.05)
    whole = RPeakDetector(250.0, 3).push(ecg.signal_mv)
    rng, detector, parts, start = np.random.default_rng(0), RPeakDetector(250.0, 3), [], 0
    while start < len(ecg.signal_mv):
        size = int(rng.integers(1, 200))
        parts += detector.push(ecg.signal_mv[start : start + size])
        start += size
    assert parts == whole


def test_a_beat_is_known_within_the_stated_time_and_never_before():
    ecg = record(ectopic_probability=0.1)
    later = [one for one in find_beats(ecg.signal_mv, 250.0) if one.time_s > LEARN_S]
    in_time = [one for one in later if not one.late]
    assert len(in_time) >= 0.9 * (ecg.r_times_s > LEARN_S).sum()
    for beat in in_time:
        # R may lie 60 ms off the middle of its complex.
        assert 0.0 < beat.known_s - beat.time_s < LATENCY_S + 0.06


def test_the_future_changes_no_beat():
    ecg = record(duration_s=20.0)
    other = ecg.signal_mv.copy()
    other[2500:] = np.random.default_rng(0).normal(size=other[2500:].shape)
    both = [
        [one for one in RPeakDetector(250.0, 3).push(signal) if one.known_s < 9.99]
        for signal in (ecg.signal_mv, other)
    ]
    assert both[0] == both[1]
    assert len(both[0]) > 8


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("leads", [1, 3])
def test_beats_made_of_noise_are_doubted(seed, leads):
    noise = np.random.default_rng(seed).normal(size=(7500, leads))
    beats = read_rhythm(noise, 250.0)
    others = sum(beat.kind != "normal" for beat in beats)
    assert f"{others} of {len(beats)} beats are not normal" in doubt(beats)


@pytest.mark.parametrize("settings", [{}, {"muscle_snr_db": 6.0}, {"ectopic_probability": 0.1}])
def test_beats_of_a_heart_are_not_doubted(settings):
    ecg = record(seed=2, **settings)
    assert doubt(read_rhythm(ecg.signal_mv, 250.0)) == ""


def test_a_record_without_a_beat_is_doubted():
    assert "no beat" in doubt(read_rhythm(np.zeros((2500, 2)), 250.0))


@pytest.mark.parametrize(("rate_hz", "leads", "words"), [(99.0, 1, "99"), (2001.0, 1, "2001")])
def test_a_rate_outside_is_refused(rate_hz, leads, words):
    with pytest.raises(InputError, match=words):
        RPeakDetector(rate_hz, leads)


@pytest.mark.parametrize("rate_hz", [100.0, 2000.0])
def test_a_rate_told_by_rounded_times_is_no_other(rate_hz):
    ecg = record(rate_hz=rate_hz, duration_s=10.0)
    for near_hz in (rate_hz * (1 - 1e-6), rate_hz * (1 + 1e-6)):
        found_s = [one.time_s for one in find_beats(ecg.signal_mv, near_hz)]
        same_s = [one.time_s for one in find_beats(ecg.signal_mv, rate_hz)]
        assert len(found_s) > 8
        np.testing.assert_allclose(found_s, same_s, atol=1e-3)


def test_another_number_of_leads_is_refused():
    with pytest.raises(InputError, match=r"needs \(n, 2\)"):
        RPeakDetector(250.0, 2).push([1.0, 2.0, 3.0])


CHECKED = """
from arrhythmia_records import record
from pipeline.registration.rpeaks import find_beats

for case, first_s, last_s in (("bursts", 15, 22), ("fibrillation", 20, 30), ("normal", 0, 9)):
    drawn = record(case, 0, duration_s=40.0)
    silent = slice(int(first_s * drawn.rate_hz), int(last_s * drawn.rate_hz))
    drawn.signal_mv[silent] = 0.0
    assert len(find_beats(drawn.signal_mv, drawn.rate_hz)) > 10
"""


@pytest.mark.slow
def test_nothing_is_read_beside_an_array_when_all_leads_show_nothing(tmp_path):
    """What lies there differs from run to run, and so would the beats after the silence."""
    root = Path(__file__).parent.parent
    asked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    environment = os.environ | asked | {"PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}"}
    done = subprocess.run(
        [sys.executable, "-c", CHECKED], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
