"""R peaks against drawn beats and the phantom's electrocardiogram; phases against arithmetic."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_files import good_fields, write

from data_synth.ecg import EcgSettings, simulate_ecg
from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.ecg import Ecg
from pipeline.registration.time import (
    detect_r_peaks,
    doubts_of_rate,
    in_known_beats,
    median_rr_s,
    phases_at,
)
from pipeline.stages.register import _sweeps, _timing
from pipeline.study import UltrasoundFiles

RATE_HZ = 500.0
# How far a detected peak may lie from the R wave it stands for and still be the same event: under
# half of the 0.25 s that two beats of one heart keep apart.
SAME_BEAT_S = 0.05

RHYTHMS = {
    "clean": EcgSettings(),
    "baseline wander": EcgSettings(baseline_mv=1.5),
    "mains": EcgSettings(mains_mv=0.3),
    "mains of 60 Hz": EcgSettings(mains_mv=0.3, mains_hz=60.0),
    "muscle": EcgSettings(muscle_mv=0.08),
    "scanner at 1.5 T": EcgSettings(magnetohydrodynamic_mv=0.5),
    "scanner at 3 T": EcgSettings(magnetohydrodynamic_mv=1.2),
}
# Standard deviation of the detected time. At its peak an R wave of height A and width w bends by
# A / w^2 = 1.1 mV / (10.5 ms)^2 = 1e4 mV/s^2; noise of slope s mV/s moves the peak by s / 1e4 s.
# Muscle noise of v mV, white from 20 to 150 Hz, keeps v / 2.5 mV under the 40 Hz of the detector's
# pass band, at a mean of 30 Hz: s = 2 pi 30 v / 2.5, for 0.08 mV 6 mV/s or 0.6 ms. A hum of 50 Hz
# and 0.3 mV is damped about fourfold: 2 pi 50 * 0.3 / 4 = 24 mV/s would be 2.4 ms. The other
# disturbances are slower and move less.
JITTER_S = {"muscle": 0.6e-3, "mains": 2.4e-3, "mains of 60 Hz": 2.4e-3}


def beats(times_s: Float, r_times_s: Float, width_s: float = 0.0105) -> Float:
    """One lead of Gaussian R waves of 1 mV and nothing else."""
    return np.exp(-0.5 * ((times_s[:, None] - r_times_s) / width_s) ** 2).sum(axis=1)


def inner(r_times_s: Float, duration_s: float) -> Float:
    """Beats that are wholly in the record."""
    return r_times_s[(r_times_s > 0.2) & (r_times_s < duration_s - 0.2)]


@pytest.mark.parametrize("rhythm", RHYTHMS)
@pytest.mark.parametrize("mean_rr_s", [0.5, 0.8, 1.4])
@pytest.mark.parametrize("seed", [1, 2])
def test_every_beat_is_found_once_and_in_time(rhythm, mean_rr_s, seed):
    ecg = simulate_ecg(np.random.default_rng(seed), 30.0, mean_rr_s, RATE_HZ, RHYTHMS[rhythm])

    found_s = detect_r_peaks(ecg.signal_mv, RATE_HZ)

    truth_s = inner(ecg.r_times_s, 30.0)
    distance_s = np.abs(truth_s[:, None] - found_s)
    assert (distance_s.min(axis=1) < SAME_BEAT_S).all(), "a beat was missed"
    assert len(inner(found_s, 30.0)) == len(truth_s), "a wave that is no beat was taken for one"
    # Four standard deviations, over the 0.5 ms by which Q and S skew the filtered R wave.
    tolerance_s = 0.5e-3 + 4 * JITTER_S.get(rhythm, 0.1e-3)
    assert np.median(distance_s.min(axis=1)) < tolerance_s


def worst_parabola_error(width_samples: float) -> float:
    """Largest error, in samples, of the parabola through the three highest of a Gaussian."""
    shift = np.linspace(-0.5, 0.5, 101)
    before, at, after = (
        np.exp(-0.5 * ((step - shift) / width_samples) ** 2) for step in (-1, 0, 1)
    )
    return float(np.abs(0.5 * (before - after) / (before - 2 * at + after) - shift).max())


@pytest.mark.parametrize("rate_hz", [125.0, 250.0, 1000.0])
def test_peaks_are_timed_finer_than_a_sample(rate_hz):
    rng = np.random.default_rng(0)
    r_times_s = 0.5 + np.cumsum(rng.uniform(0.7, 0.9, 30))
    times_s = np.arange(round(27.5 * rate_hz)) / rate_hz

    found_s = detect_r_peaks(beats(times_s, r_times_s)[:, None], rate_hz)

    kept = r_times_s[r_times_s < times_s[-1] - 0.2]
    error_s = np.abs(kept[:, None] - found_s).min(axis=1)
    # The filter only widens the wave, for which the parabola fits better; neighbouring beats,
    # 0.7 s away, leave a slope that moves a peak by some microseconds.
    assert error_s.max() < worst_parabola_error(0.0105 * rate_hz) / rate_hz + 20e-6


@given(
    scale=st.floats(1e-3, 1e3),
    flips=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
    order=st.permutations([0, 1, 2]),
    offset_mv=st.floats(-5, 5),
)
@settings(max_examples=15, deadline=None)
def test_gain_polarity_order_and_offset_of_leads_do_not_matter(scale, flips, order, offset_mv):
    ecg = simulate_ecg(np.random.default_rng(5), 12.0, 0.8, RATE_HZ)
    changed = scale * (ecg.signal_mv[:, order] * np.array(flips) + offset_mv)

    # Filters are linear: rounding alone separates the two, far under a microsecond.
    np.testing.assert_allclose(
        detect_r_peaks(changed, RATE_HZ), detect_r_peaks(ecg.signal_mv, RATE_HZ), atol=1e-6
    )


def test_lead_with_deep_s_wave_does_not_shift_the_beats():
    """In V1 the S wave, 28 ms late, is the largest; the leads that show R outvote it."""
    ecg = simulate_ecg(np.random.default_rng(3), 20.0, 0.8, RATE_HZ)
    louder = ecg.signal_mv * np.array([1.0, 1.0, 5.0])

    found_s = detect_r_peaks(louder, RATE_HZ)

    distance_s = np.abs(inner(ecg.r_times_s, 20.0)[:, None] - found_s).min(axis=1)
    assert distance_s.max() < 0.005


def test_early_beats_from_the_ventricle_are_found():
    rhythm = EcgSettings(ectopic_probability=0.15)
    ecg = simulate_ecg(np.random.default_rng(2), 60.0, 0.8, RATE_HZ, rhythm)
    assert ecg.ectopic.sum() >= 3

    found_s = detect_r_peaks(ecg.signal_mv, RATE_HZ)

    truth_s = inner(ecg.r_times_s, 60.0)
    missed = np.abs(truth_s[:, None] - found_s).min(axis=1) > SAME_BEAT_S
    # One early beat in twenty may hide in the T wave before it.
    assert missed.sum() <= len(truth_s) / 20
    extra = np.abs(inner(found_s, 60.0)[:, None] - ecg.r_times_s).min(axis=1) > SAME_BEAT_S
    assert not extra.any()


def test_beats_after_an_artefact_are_found_again():
    """A knock ten times as high as the beats costs no beat a second away from it."""
    ecg = simulate_ecg(np.random.default_rng(4), 30.0, 0.8, RATE_HZ)
    times_s = np.arange(len(ecg.signal_mv)) / RATE_HZ
    knock = 10 * np.exp(-0.5 * ((times_s - 12.0) / 0.015) ** 2)

    found_s = detect_r_peaks(ecg.signal_mv + knock[:, None], RATE_HZ)

    truth_s = inner(ecg.r_times_s, 30.0)
    far = truth_s[np.abs(truth_s - 12.0) > 1.0]
    assert np.abs(far[:, None] - found_s).min(axis=1).max() < SAME_BEAT_S


def test_lead_with_a_gap_is_left_out():
    ecg = simulate_ecg(np.random.default_rng(6), 12.0, 0.8, RATE_HZ)
    broken = ecg.signal_mv.copy()
    broken[100:200, 1] = np.nan

    distance_s = np.abs(inner(ecg.r_times_s, 12.0)[:, None] - detect_r_peaks(broken, RATE_HZ)).min(
        axis=1
    )

    assert distance_s.max() < 0.005


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_not_taken_for_a_heart(seed):
    noise = np.random.default_rng(seed).normal(size=(10_000, 2))
    noise[:, 1] = np.cumsum(noise[:, 1])

    with pytest.raises(InputError, match="none of 2 leads shows R peaks"):
        detect_r_peaks(noise, RATE_HZ)


@pytest.mark.parametrize(
    ("signal", "rate_hz", "message"),
    [
        (np.zeros((5000, 2)), 500.0, "none of 2 leads"),
        (np.full((5000, 1), np.nan), 500.0, "none of 1 leads"),
        (np.zeros((600, 1)), 500.0, "too short"),
        (np.zeros((600, 1)), 50.0, "too few"),
        (np.zeros(5000), 500.0, r"\(samples, leads\)"),
    ],
)
def test_unusable_records_are_refused(signal, rate_hz, message):
    with pytest.raises(InputError, match=message):
        detect_r_peaks(signal, rate_hz)


rr_lists = st.lists(st.floats(0.3, 2.0), min_size=1, max_size=20)


@given(rr_s=rr_lists, phase=st.floats(0, 1, exclude_max=True), beat=st.integers(0, 19))
def test_phase_inverts_linear_interpolation_between_beats(rr_s, phase, beat):
    r_times_s = 1.0 + np.concatenate([[0.0], np.cumsum(rr_s)])
    beat %= len(rr_s)
    time_s = r_times_s[beat] + phase * (r_times_s[beat + 1] - r_times_s[beat])

    found = phases_at(np.array([time_s]), r_times_s)[0]

    assert 0 <= found < 1
    # Times near 40 s carry 7e-15 s of rounding over an RR interval of 0.3 s or more.
    around = abs(found - phase)
    assert min(around, 1 - around) < 1e-12


def test_partial_beats_at_both_ends_take_the_median_interval():
    r_times_s = np.array([2.0, 3.0, 4.2, 5.2])
    phases = phases_at(np.array([1.25, 5.45, 6.1999]), r_times_s)
    np.testing.assert_allclose(phases, [0.25, 0.25, 0.9999], atol=1e-9)


@pytest.mark.parametrize("time_s", [0.99, 6.21, np.nan])
def test_times_that_the_ecg_does_not_cover_are_refused(time_s):
    with pytest.raises(InputError, match="does the ECG cover the images"):
        phases_at(np.array([3.5, time_s]), np.array([2.0, 3.0, 4.2, 5.2]))


R_TIMES_S = 0.4 + 0.8 * np.arange(60)


@pytest.mark.parametrize(
    ("times", "r_times_s", "words"),
    [
        (np.linspace(447.203, 2397.693, 40), R_TIMES_S, " divided by 1000"),
        (1.75e9 + np.arange(40.0), R_TIMES_S, " the times look as if counted from 1970"),
        (1.75e12 + np.arange(40.0), R_TIMES_S, " the times look as if counted from 1970"),
        (np.arange(40.0), R_TIMES_S + 1.75e9, " the R peaks look as if counted from 1970"),
        (np.arange(40.0) + 2e9, R_TIMES_S + 1.75e9, ""),
        (0.04 * np.arange(40) + 100, R_TIMES_S, ""),
    ],
)
def test_times_of_another_clock_are_told(times, r_times_s, words):
    sweep, ecg = Path("us/fan.mha"), Path("ecg/us")
    files = SimpleNamespace(us=SimpleNamespace(sweeps=(sweep,)), ecg=SimpleNamespace(us=ecg))
    sweeps = [SimpleNamespace(times_s=times)]
    with pytest.raises(InputError) as told:
        _timing(files, sweeps, r_times_s, None)
    said = str(told.value)
    assert said.startswith("us/fan.mha, beside ecg/us: ")
    assert said.partition("on the same clock?")[2].startswith(words)
    assert bool(words) == (not said.endswith("?"))


def test_times_that_the_ecg_covers_are_taken():
    files = SimpleNamespace(us=SimpleNamespace(sweeps=("a", "b")), ecg=SimpleNamespace(us="ecg"))
    sweeps = [SimpleNamespace(times_s=np.arange(5.0) + one) for one in (2.0, 20.0)]
    timing = _timing(files, sweeps, R_TIMES_S, 0.8)
    assert [len(phases) for phases in timing.phases()] == [5, 5]


@pytest.mark.parametrize("r_times_s", [[], [1.0], [2.0, 1.0], [1.0, 1.0, 2.0]])
def test_r_times_must_be_two_and_rise(r_times_s):
    with pytest.raises(InputError, match="R peaks or more with rising times"):
        phases_at(np.array([1.5]), np.array(r_times_s))


def test_detected_peaks_give_the_phantoms_own_phases():
    """Phases by detected peaks agree with phases by true ones to the peaks' own error."""
    ecg = simulate_ecg(np.random.default_rng(8), 20.0, 0.8, RATE_HZ)
    times_s = np.linspace(2.0, 18.0, 400)

    error = phases_at(times_s, detect_r_peaks(ecg.signal_mv, RATE_HZ)) - phases_at(
        times_s, ecg.r_times_s
    )

    # Each end of an interval is off by under 2 ms, of an interval of 0.7 s or more.
    assert np.abs((error + 0.5) % 1 - 0.5).max() < 0.002 / 0.7


def test_times_between_beats_that_were_not_found_have_no_phase():
    """RR intervals of 0.8 s, a compensatory pause of 1.2 s, and a lead that is off for 5 s."""
    ecg = simulate_ecg(np.random.default_rng(8), 30.0, 0.8, RATE_HZ)
    signal_mv = ecg.signal_mv.copy()
    times_s = np.arange(len(signal_mv)) / RATE_HZ
    signal_mv[(times_s > 12) & (times_s < 17)] = 0.0
    found_s = detect_r_peaks(signal_mv, RATE_HZ)
    asked_s = np.arange(2.0, 28.0, 0.05)
    known = in_known_beats(asked_s, found_s)
    assert known[(asked_s < 11) | (asked_s > 18.5)].all()
    assert not known[(asked_s > 12) & (asked_s < 17)].any()
    error = phases_at(asked_s, found_s) - phases_at(asked_s, ecg.r_times_s)
    away = np.abs((error + 0.5) % 1 - 0.5)
    assert away[known].max() < 0.01 < 0.3 < away[~known].max()

    paused_s = np.array([1.0, 1.8, 2.4, 3.6, 4.4, 5.2])
    assert in_known_beats(np.array([0.5, 1.0, 2.0, 3.0, 4.4, 5.9]), paused_s).all()


@pytest.mark.parametrize("beats", [2, 3, 40, 41])
def test_bigeminy_and_another_rate_have_phases_throughout(beats):
    for rr_s in (np.resize([0.5, 1.1], beats), np.repeat([0.4, 0.75], [2 * beats, beats])):
        r_times_s = np.cumsum(np.concatenate([[0.5], rr_s]))
        assert in_known_beats(np.arange(0.0, r_times_s[-1] + 0.4, 0.04), r_times_s).all()
    missed_s = np.delete(np.cumsum(np.resize([0.5, 1.1], 41)), [20, 21])
    asked_s = np.arange(missed_s[0], missed_s[-1], 0.04)
    widest = np.diff(missed_s).argmax()
    inside = (asked_s > missed_s[widest]) & (asked_s < missed_s[widest + 1])
    assert not in_known_beats(asked_s[inside], missed_s).any()
    assert in_known_beats(asked_s[~inside], missed_s).all()


@pytest.mark.parametrize("beyond", [0, 1, 2, 3])
@pytest.mark.parametrize("gap", [2.4, 3.5, 6.9, 7.5])
@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_pause_near_an_end_of_the_record_is_seen(beyond, gap, at_the_end):
    """So many intervals lie between it and the end; it is so many times as long as they are."""
    rr_s = np.full(20, 0.8)
    rr_s[beyond] *= gap
    r_times_s = np.cumsum(np.concatenate([[0.0], rr_s[::-1] if at_the_end else rr_s]))
    times_s = np.arange(0.0, r_times_s[-1], 0.1)
    start_s = r_times_s[19 - beyond if at_the_end else beyond]
    within = (times_s >= start_s) & (times_s < start_s + 0.8 * gap)
    np.testing.assert_array_equal(in_known_beats(times_s, r_times_s), ~within)


def test_times_at_the_ends_have_no_phase_where_the_leads_were_lost():
    r_times_s = np.array([5.0, 5.8, 6.6, 7.4])
    times_s = np.array([3.0, 4.1, 4.3, 5.5, 8.1, 8.3, 11.0])
    known = in_known_beats(times_s, r_times_s, (3.5, 10.0))
    assert known.tolist() == [True, False, True, True, True, False, True]
    # What the record covers has its phases now, and what it does not is refused as ever.
    phases_at(times_s[1:-1][known[1:-1]], r_times_s)
    with pytest.raises(InputError, match="2 of 5 times"):
        phases_at(times_s[known], r_times_s)


def test_frames_without_a_beat_are_left_out_and_told(tmp_path):
    path = write(tmp_path / "fan.mha", good_fields())
    files = UltrasoundFiles(sweeps=(path,))
    study = SimpleNamespace(us=files, ecg=SimpleNamespace(us=tmp_path / "us"))
    # Frames at 3.0 to 3.2 s: two within the last beat before the ECG shows none for 3 s.
    r_times_s = np.array([0.7, 1.5, 2.27, 3.08, 6.1, 6.9, 7.7])
    ecg = Ecg(np.zeros((4500, 1)), ("I",), 500.0)
    (sweep,) = _sweeps(study, ecg, r_times_s)
    assert sweep.numbers.tolist() == [0, 1]
    assert sweep.images.shape[0] == len(sweep.times_s) == len(sweep.tracker_from_image) == 2
    assert sweep.remarks[-1].startswith("3 of 5 frames, between 3.10 and 3.20 s, left out")
    with pytest.raises(InputError, match=r"fan\.mha, beside .*us: 5 of 5 frames.* whole"):
        _sweeps(study, ecg, r_times_s - 0.5)
    # The leads are lost for good after the first frames.
    (cut,) = _sweeps(study, ecg, r_times_s[:4] - 0.76)
    assert cut.numbers.tolist() == [0, 1, 2]


def test_median_rr_is_that_of_the_intervals():
    assert median_rr_s(np.array([0.0, 1.0, 1.8, 3.0])) == pytest.approx(1.0)


def test_a_sampling_rate_told_twice_as_low_is_doubted():
    r_times_s = np.arange(20) * 0.8
    assert doubts_of_rate(r_times_s, 0.8) == []
    # A heart that is excited, and one whose pacemaker is off.
    assert doubts_of_rate(r_times_s * 0.6, 0.8) == doubts_of_rate(r_times_s * 1.7, 0.8) == []
    (said,) = doubts_of_rate(2 * r_times_s, 0.8)
    assert "38 times a minute" in said
    assert "75 times in the MR" in said
    assert "sampling rate" in said


def test_one_beat_that_was_not_found_leaves_its_interval_without_phases():
    r_times_s = np.delete(0.3 + 0.8 * np.arange(20), 10)
    known = in_known_beats(np.array([7.4, 7.6, 8.3, 9.0, 9.2]), r_times_s)
    assert known.tolist() == [True, False, False, False, True]


def test_phases_of_a_slow_beat_are_those_of_the_nominal_one():
    """Systole lasts 547.5 - 2.05 HR ms (Weissler 1968) less 40 ms from Q to R, so 405 ms of a beat
    of 1.2 s and 353.75 ms of one of 0.8 s; atria contract 120 ms before the next R in both."""
    r_times_s = 0.5 + 1.2 * np.arange(5)
    times_s = r_times_s[2] + np.array([0.0, 0.405, 1.08])
    found = phases_at(times_s, r_times_s, 0.8)
    np.testing.assert_allclose(found, [0, 0.35375 / 0.8, 0.68 / 0.8], atol=1e-3)


@pytest.mark.parametrize(("longer", "known"), [(1.6, True), (1.9, False)])
def test_an_interval_nearly_twice_as_long_holds_a_beat_that_was_not_found(longer, known):
    """The heart was a little faster then; half as long again is a pause."""
    rr_s = np.full(20, 0.8)
    rr_s[10] *= longer
    r_times_s = np.cumsum(np.concatenate([[0.5], rr_s]))
    assert in_known_beats(np.array([r_times_s[10] + 0.4]), r_times_s).tolist() == [known]


def test_a_sampling_rate_told_twice_as_high_is_doubted():
    (said,) = doubts_of_rate(0.4 * np.arange(20), 0.8)
    assert "150 times a minute" in said
