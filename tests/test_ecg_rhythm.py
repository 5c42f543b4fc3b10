"""Beats of the simulated ECG come when, and as irregularly, as the settings say."""

from __future__ import annotations

import numpy as np
import pytest
from ecg_records import QUIET, STEADY, record, rhythm
from scipy.interpolate import CubicSpline
from scipy.signal import welch


def tachogram_spectrum(r_times_s, step_s=0.25):
    """Welch's spectrum of the relative RR variation, each interval standing at its start."""
    intervals_s = np.diff(r_times_s)
    even_s = np.arange(r_times_s[0], r_times_s[-2], step_s)
    # A line between beats would damp the breathing rate; a spline hardly does.
    series = CubicSpline(r_times_s[:-1], intervals_s / intervals_s.mean())(even_s)
    return welch(series - series.mean(), 1 / step_s, nperseg=512)


def band_power(hz, density, low_hz, high_hz):
    return density[(hz >= low_hz) & (hz < high_hz)].sum() * (hz[1] - hz[0])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_intervals_average_to_the_rate_asked_for(seed):
    signal = rhythm(300.0, seed=seed)
    intervals_s = np.diff(signal.r_times_s)
    # Slow variation at f Hz leaves at most 1 / (pi f T) of its height: of jitter (mostly about
    # 0.01 Hz) 4 * 0.015 / (pi 0.01 300), of the 0.1 Hz band 4 * 0.028 / (pi 0.1 300), of breath
    # less. Time is shared by intervals, which lowers their mean by the relative variance.
    slow = 4 * 0.015 / (np.pi * 3) + 4 * 0.028 / (np.pi * 30)
    variance = 0.04**2 + 0.015**2
    assert intervals_s.mean() == pytest.approx(0.8, rel=slow + variance)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
@pytest.mark.parametrize("breath_hz", [0.2, 0.3])
def test_rr_spectrum_has_the_two_bands_in_the_ratio_asked_for(ratio, breath_hz):
    signal = rhythm(1200.0, respiration_hz=breath_hz, lf_hf_ratio=ratio, jitter=0.0)
    hz, density = tachogram_spectrum(signal.r_times_s)
    low, high = (hz > 0.04) & (hz < 0.15), (hz >= 0.15) & (hz < 0.4)
    # Bands have a deviation of 0.01 Hz; Welch's bins are 0.008 Hz wide.
    assert hz[low][np.argmax(density[low])] == pytest.approx(0.1, abs=0.02)
    assert hz[high][np.argmax(density[high])] == pytest.approx(breath_hz, abs=0.02)
    low_power, high_power = band_power(hz, density, 0.04, 0.15), band_power(hz, density, 0.15, 0.4)
    # The breath's sine has an exact power. The 0.1 Hz band is noise of bandwidth 2 sqrt(pi) 0.01
    # Hz, whose power over 1200 s varies by 1 / sqrt(B T) = 0.15; Welch and spline add some 0.05.
    assert high_power == pytest.approx(0.04**2 / 2, rel=0.12)
    assert low_power / high_power == pytest.approx(ratio, rel=0.35)


def test_jitter_falls_as_one_over_frequency():
    signal = rhythm(2400.0, respiratory_variation=0.0, jitter=0.05)
    hz, density = tachogram_spectrum(signal.r_times_s)
    fit = (hz > 0.01) & (hz < 0.3)
    slope = np.polyfit(np.log(hz[fit]), np.log(density[fit]), 1)[0]
    # Some 36 bins of 18 averaged spectra each scatter by 0.25 about a line that is 3.4 long.
    assert slope == pytest.approx(-1.0, abs=0.25)
    assert np.std(np.diff(signal.r_times_s)) / 0.8 == pytest.approx(0.05, rel=0.1)


def test_steady_heart_has_equal_intervals():
    signal = record(mean_rr_s=0.9, **STEADY)
    np.testing.assert_allclose(np.diff(signal.r_times_s), 0.9, rtol=1e-12)


def test_rate_runs_from_start_to_end():
    signal = record(120.0, start_rate_bpm=60, end_rate_bpm=120, **STEADY)
    rate_bpm = 60 / np.diff(signal.r_times_s)
    # An interval takes the rate at its start: the rate rises by 0.5 a minute each second.
    expected_bpm = 60 + 0.5 * signal.r_times_s[:-1]
    np.testing.assert_allclose(rate_bpm, expected_bpm, atol=1e-3)


@pytest.mark.parametrize("pattern", ["isolated", "couplets"])
def test_early_beats_are_followed_by_a_pause(pattern):
    signal = record(200.0, ectopic_probability=0.1, ectopic_pattern=pattern, **STEADY)
    runs = np.split(
        np.flatnonzero(signal.ectopic),
        np.flatnonzero(np.diff(np.flatnonzero(signal.ectopic)) > 1) + 1,
    )
    runs = [run for run in runs if run[0] > 0 and run[-1] < len(signal.kinds) - 1]
    assert 10 < len(runs) < 50
    assert {len(run) for run in runs} == {2 if pattern == "couplets" else 1}
    for run in runs:
        around_s = signal.r_times_s[[run[0] - 1, run[0], run[-1] + 1]]
        assert around_s[1] - around_s[0] < 0.7 * 0.8
        # The sinus node keeps its own time.
        assert around_s[2] - around_s[0] == pytest.approx(1.6, rel=1e-9)
    assert [kind == "premature_ventricular" for kind in signal.kinds] == signal.ectopic.tolist()


def test_bigeminy_alternates():
    signal = record(ectopic_pattern="bigeminy")
    assert (signal.ectopic[1:] != signal.ectopic[:-1]).all()


def test_early_atrial_beats_reset_the_sinus_node():
    signal = record(200.0, atrial_probability=0.1, **STEADY)
    early = [k for k, kind in enumerate(signal.kinds[1:-1], 1) if kind == "premature_atrial"]
    assert 10 < len(early) < 50
    assert not signal.ectopic.any()
    around_s = np.stack([signal.r_times_s[np.array(early) + k] for k in (-1, 0, 1)])
    assert (around_s[1] - around_s[0] < 0.75 * 0.8).all()
    # No compensatory pause: less than two sinus intervals in all.
    assert (around_s[2] - around_s[0] < 1.95 * 0.8).all()
    assert (around_s[2] - around_s[1] > 0.8).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_fibrillation_is_irregularly_irregular(seed):
    signal = rhythm(600.0, 0.7, seed=seed, fibrillation=True)
    intervals_s = np.diff(signal.r_times_s)
    assert set(signal.kinds[1:]) == {"fibrillation"}
    assert intervals_s.min() >= 0.25
    # Sum of an exponential time of deviation 0.2 and a correlated one of 0.2 * (0.8 - 0.25 / 0.7).
    deviation = np.hypot(0.2, 0.2 * (0.8 - 0.25 / 0.7))
    # 860 intervals: 4 / sqrt(2 * 860) for a normal distribution, twice that with a long tail.
    assert intervals_s.std() / intervals_s.mean() == pytest.approx(deviation, rel=0.2)
    assert intervals_s.mean() == pytest.approx(0.7, rel=0.05)
    successive = np.sqrt(np.mean(np.diff(intervals_s) ** 2))
    # Independent parts alone make sqrt(2) of 0.2; sinus rhythm stays under a tenth of the mean.
    assert successive / intervals_s.mean() > 0.22
    # The tail of long intervals is exponential: excess over the 80th percentile has the deviation
    # of its mean.
    excess_s = intervals_s - np.quantile(intervals_s, 0.8)
    tail_s = excess_s[excess_s > 0]
    assert tail_s.mean() == pytest.approx(0.2 * 0.7, rel=4 / np.sqrt(len(tail_s)))


def test_paroxysm_stays_in_its_stretch():
    signal = record(fibrillation=True, fibrillation_s=(20.0, 40.0), **QUIET)
    inside = (signal.r_times_s >= 20.0) & (signal.r_times_s < 40.0)
    assert [kind == "fibrillation" for kind in signal.kinds] == inside.tolist()
    assert signal.fibrillation_s == ((20.0, 40.0),)


@pytest.mark.parametrize("seed", range(12))
def test_nothing_but_fibrillation_lies_within_its_stretch(seed):
    """Early beats in pairs run on into it; then it begins behind them."""
    signal = record(
        seed=seed, fibrillation=True, fibrillation_s=(20.0, 40.0), ectopic_pattern="bigeminy"
    )
    ((start_s, end_s),) = signal.fibrillation_s
    assert 20.0 <= start_s < 22.5
    within = (signal.r_times_s >= start_s) & (signal.r_times_s < end_s)
    kinds = {kind for kind, one in zip(signal.kinds, within, strict=True) if one}
    assert kinds <= {"fibrillation", "premature_ventricular"}
    assert "fibrillation" in kinds
    assert np.diff(signal.r_times_s).min() >= 0.25
