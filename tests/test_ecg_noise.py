"""What disturbs the simulated ECG has the size and band asked for, and moves no beat."""

from __future__ import annotations

import numpy as np
import pytest
from ecg_records import LEAD_II, QUIET, STEADY, lead, record, times_of
from scipy.signal import welch

from data_synth.ecg import (
    LEADS,
    EcgSettings,
)


def test_scanner_swells_the_t_wave_and_spares_the_r_time():
    off, on = record(**QUIET), record(magnetohydrodynamic_mv=1.0, **QUIET)
    np.testing.assert_array_equal(off.r_times_s, on.r_times_s)
    artefact = on.signal_mv - off.signal_mv
    rate_hz = off.sampling_rate_hz
    at_r = artefact[np.round(off.r_times_s[1:-1] * rate_hz).astype(int)]
    at_flow = artefact[np.round((off.r_times_s[1:-1] + 0.17) * rate_hz).astype(int)]
    # The mean height is 1 mV; each beat's varies by a tenth, and a little with its filling.
    sampling = 4 * 0.1 / np.sqrt(len(at_flow))
    assert at_flow[:, LEAD_II].mean() == pytest.approx(1.0, abs=sampling + 0.05)
    assert np.abs(at_r).max() < 0.1


def test_flow_artefact_is_proportional_to_the_field():
    off, low, high = (
        record(20.0, magnetohydrodynamic_mv=mv, field_strength_t=tesla, **QUIET).signal_mv
        for mv, tesla in ((0.0, 3.0), (0.5, 1.5), (0.5, 3.0))
    )
    np.testing.assert_allclose(high - off, 2 * (low - off), atol=1e-12)


def test_early_beats_eject_less():
    kept = {"ectopic_probability": 0.15, **QUIET, **STEADY}
    off, on = record(200.0, **kept), record(200.0, magnetohydrodynamic_mv=1.0, **kept)
    artefact = lead(on, "II") - lead(off, "II")
    inner = slice(2, -2)
    peak = np.round((off.r_times_s[inner] + 0.17) * 500).astype(int)
    early = artefact[peak][off.ectopic[inner]].mean()
    assert early < 0.9 * artefact[peak][~off.ectopic[inner]].mean()


def test_away_from_the_scanner_its_parts_are_gone():
    settings = EcgSettings(magnetohydrodynamic_mv=0.5, gradient_mv=0.2, baseline_mv=0.3)
    assert settings.away_from_scanner() == EcgSettings(baseline_mv=0.3)


def test_mains_and_muscle_fill_their_own_bands():
    only_mains = record(**(QUIET | {"mains_mv": 0.1}))
    only_muscle = record(**(QUIET | {"muscle_mv": 0.1}))
    clean = record(**QUIET)
    hz, mains = welch((only_mains.signal_mv - clean.signal_mv)[:, 0], 500.0, nperseg=1000)
    assert hz[np.argmax(mains)] == pytest.approx(50.0, abs=0.5)
    third = mains[(hz > 148) & (hz < 152)].sum() / mains[(hz > 48) & (hz < 52)].sum()
    assert third == pytest.approx(0.2**2, rel=0.05)
    hum = (only_mains.signal_mv - clean.signal_mv).std(axis=0)
    # A sine of 0.1 mV, whose height drifts by 0.2, with harmonics of 0.2, 0.1 and 0.05.
    root = np.sqrt((1 + 0.2**2 / 2) * (1 + 0.2**2 + 0.05**2) / 2)
    np.testing.assert_allclose(hum, 0.1 * root, rtol=0.02)
    _, muscle = welch((only_muscle.signal_mv - clean.signal_mv)[:, 0], 500.0, nperseg=1000)
    # A Butterworth band of order 2, run both ways, halves the amplitude at 20 and 150 Hz.
    assert muscle[(hz >= 20) & (hz <= 150)].sum() > 0.85 * muscle.sum()
    spread = (only_muscle.signal_mv - clean.signal_mv).std(axis=0)
    # 130 Hz for 60 s give 15,600 independent values: a deviation of 0.6 %, four times.
    np.testing.assert_allclose(spread, 0.1, rtol=0.025)


def test_mains_above_half_the_rate_are_left_out():
    with_hum, without = (record(20.0, rate_hz=100.0, **(QUIET | {"mains_mv": mv})) for mv in (1, 0))
    np.testing.assert_array_equal(with_hum.signal_mv, without.signal_mv)
    seen = record(20.0, rate_hz=120.0, **(QUIET | {"mains_mv": 1.0})).signal_mv
    assert seen[:, LEAD_II].std() > 0.6


@pytest.mark.parametrize("asked_db", [0.0, 20.0])
def test_muscle_noise_has_the_power_asked_for(asked_db):
    noisy = record(muscle_snr_db=asked_db, baseline_mv=0, mains_mv=0)
    clean = record(**QUIET)
    noise = lead(noisy, "II") - lead(clean, "II")
    got_db = 10 * np.log10(lead(clean, "II").var() / noise.var())
    # The noise's deviation is known to 0.6 % (see above), 0.05 dB; four times.
    assert got_db == pytest.approx(asked_db, abs=0.2)


def test_baseline_wanders_slowly():
    kept = {"duration_s": 240.0, "rate_hz": 100.0, "mains_mv": 0, "muscle_mv": 0}
    wander = record(baseline_mv=1.0, **kept).signal_mv - record(baseline_mv=0, **kept).signal_mv
    hz, density = welch(wander[:, LEAD_II], 100.0, nperseg=12000)
    assert density[hz < 0.4].sum() > 0.98 * density.sum()
    assert hz[hz > 0.21][np.argmax(density[hz > 0.21])] == pytest.approx(0.25, abs=0.02)


def test_tugged_electrodes_disturb_for_seconds_and_no_beat_moves():
    clean, tugged = record(**QUIET), record(motion_per_minute=6, motion_mv=2.0, **QUIET)
    np.testing.assert_array_equal(clean.r_times_s, tugged.r_times_s)
    disturbed = np.abs(tugged.signal_mv - clean.signal_mv).max(axis=1) > 0.05
    assert 0 < disturbed.mean() < 0.6
    assert np.abs(tugged.signal_mv - clean.signal_mv).max() < 2 * 2.0


def test_gradients_are_lines_at_the_rate_of_pictures():
    off, on = (record(gradient_mv=mv, gradient_segment_s=0.04, **QUIET) for mv in (0.0, 0.3))
    hz, density = welch((on.signal_mv - off.signal_mv)[:, LEAD_II], 500.0, nperseg=5000)
    assert hz[np.argmax(density)] == pytest.approx(25.0, abs=0.2)
    on_lines = np.abs((hz + 12.5) % 25 - 12.5) < 2.5
    assert density[on_lines].sum() > 0.95 * density.sum()


@pytest.mark.parametrize("kind", ["flat", "rail"])
def test_lost_lead_is_flat_where_truth_says(kind):
    lost = [{"lead": "II", "start_s": 4.0, "end_s": 6.0, "kind": kind}]
    whole, gap = record(20.0), record(20.0, lost=lost, range_mv=5.0)
    valid = gap.valid()
    times_s = times_of(gap)
    np.testing.assert_array_equal(~valid[:, LEAD_II], (times_s >= 4.0) & (times_s < 6.0))
    assert valid[:, [0, 2]].all()
    assert set(gap.signal_mv[~valid]) == {5.0 if kind == "rail" else 0.0}
    # A rail decays by e every 0.4 s: 6 s later 5 mV are under 2 microvolts.
    settled = valid & (np.abs(times_s - 8.0) > 4.0)[:, None]
    np.testing.assert_allclose(gap.signal_mv[settled], whole.signal_mv[settled], atol=2e-6)
    np.testing.assert_array_equal(whole.r_times_s, gap.r_times_s)


def test_leads_come_off_at_random_as_often_as_asked():
    signal = record(600.0, rate_hz=100.0, lost_per_minute=3, lost_mean_s=2.0)
    # Poisson with a mean of 30, and exponential durations.
    assert 30 - 4 * np.sqrt(30) < len(signal.lost) < 30 + 4 * np.sqrt(30)
    assert np.mean([one.end_s - one.start_s for one in signal.lost]) == pytest.approx(2.0, rel=0.8)
    assert {one.lead for one in signal.lost} <= set(LEADS)
    assert 0 < (~signal.valid()).mean() < 0.2


def test_all_leads_can_come_off_together():
    lost = [{"lead": "all", "start_s": 1.0, "end_s": 2.0}]
    assert not record(10.0, lost=lost).valid()[500:1000].any()


def test_amplifier_clips_at_its_range():
    clipped, whole = record(20.0, range_mv=0.5, **QUIET), record(20.0, **QUIET)
    np.testing.assert_array_equal(clipped.signal_mv, np.clip(whole.signal_mv, -0.5, 0.5))
    assert np.abs(whole.signal_mv).max() > 0.5


def test_a_disturbance_changes_no_other_part():
    plain = record(20.0)
    for change in ({"mains_mv": 0.5}, {"muscle_mv": 0.5}, {"lost_per_minute": 5.0}):
        np.testing.assert_array_equal(record(20.0, **change).r_times_s, plain.r_times_s)
    louder = record(20.0, mains_mv=0.5).signal_mv - record(20.0, mains_mv=0.25).signal_mv
    hum = record(20.0, mains_mv=0.25).signal_mv - record(20.0, mains_mv=0.0).signal_mv
    np.testing.assert_allclose(louder, hum, atol=1e-12)
