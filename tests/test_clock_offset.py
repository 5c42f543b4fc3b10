"""The offset between clocks: frames of a beating heart, stamped early or late by a known time."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from ellipsoid_heart import moving_surfaces, record, start_off

from pipeline.errors import InputError
from pipeline.registration.clock_offset import (
    MODEL_SD_S,
    ClockOffset,
    ClocksApart,
    Timing,
    _Profile,
    clocks_apart,
    estimate_offset,
    settle_clock,
)
from pipeline.registration.pose_search import climb
from pipeline.registration.search import Best, prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.space import find

RR_S = 0.8
R_TIMES_S = 0.3 + RR_S * np.arange(12)
SETTINGS = RegisterSettings(grid_mm=3.0, sample_spacing_mm=5.0)
QUICK = SETTINGS.model_copy(update={"candidates": 80, "starts": 2, "max_frames": 40})
FROM_THERE = QUICK.model_copy(update={"candidates": 1, "starts": 1})


@pytest.fixture(scope="module")
def surfaces():
    return moving_surfaces()


@pytest.fixture(scope="module")
def recording():
    return record(seed=2, frames=16)


@pytest.fixture(scope="module")
def drawn(recording, surfaces):
    """The model, drawn once for all searches of these surfaces."""
    return prepare_search(recording.phases, surfaces, recording.mr_from_tracker, SETTINGS)


def stamped(recording, late_s=0.0):
    """Times of frames of a regular heart, ``late_s`` ahead of the ECG's clock: frames follow one
    another by 0.11 of a beat, the second sweep begins some beats after the first."""
    sweeps = [
        R_TIMES_S[start] + RR_S * (phases[0] + 0.11 * np.arange(len(phases))) + late_s
        for start, phases in zip((1, 6), recording.phases, strict=True)
    ]
    return Timing(sweeps, R_TIMES_S, RR_S)


def estimated(recording, drawn, timing, shift_mm=0.0):
    """The offset, from the pose that fits best at the phases of the stamps as they are."""
    start = start_off(recording, 3, shift_mm, shift_mm)
    search = replace(drawn, phases=timing.phases(), start=start)
    level = search.fine_level(recording.sweeps)
    pose = climb(level, start, search.pivot)
    return estimate_offset(level, pose, search.pivot, timing)


def test_stamps_give_the_phases_they_were_made_from(recording):
    for found, true in zip(stamped(recording).phases(), recording.phases, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)


@pytest.mark.parametrize("late_s", [-0.17, 0.0, 0.12])
def test_the_offset_is_found_with_its_error(recording, drawn, late_s):
    found = estimated(recording, drawn, stamped(recording, late_s), shift_mm=3.0)
    # The project's own requirement; and four standard deviations, which one in 16000 passes.
    assert abs(found.offset_s - late_s) < 0.010
    assert abs(found.offset_s - late_s) < 4 * found.sd_s
    assert found.significant == (late_s != 0.0)


def test_a_pose_drawn_by_a_wrong_offset_is_put_right(recording, drawn):
    timing = stamped(recording, 0.15)
    search = replace(drawn, phases=timing.phases())
    level = search.fine_level(recording.sweeps)
    wrong = climb(level, recording.mr_from_tracker, search.pivot)
    found = estimate_offset(level, wrong, search.pivot, timing)
    before, after = (
        search.pivot.distance(pose, recording.mr_from_tracker)
        for pose in (wrong, found.mr_from_tracker)
    )
    assert max(after) < max(before)
    # Frames' speckle moves the pose of exact surfaces by some tenths of a millimetre.
    assert max(after) < 1.0


def test_frames_of_a_heart_that_stands_still_tell_no_offset(surfaces):
    """Pictures all drawn at one phase agree with the model whatever the clock says, or nowhere."""
    still = {
        name: replace(s, vertices_mm=s.vertices_mm[:1].repeat(len(s.phases), 0))
        for name, s in surfaces.items()
    }
    recording = record(seed=4)
    drawn = prepare_search(recording.phases, still, recording.mr_from_tracker, SETTINGS)
    found = estimated(recording, drawn, stamped(recording))
    assert found.offset_s is None
    assert found.sd_s == np.inf


def test_few_frames_tell_no_offset(drawn):
    recording = record(seed=5, frames=9)
    assert estimated(recording, drawn, stamped(recording)).offset_s is None


def test_frames_at_the_ends_of_the_ecg_do_not_stop_the_search(recording, drawn):
    timing = stamped(recording, 0.1)
    # The last R peak that is known is the one before the last frames.
    last_s = timing.times_s[1][-1]
    timing = replace(timing, r_times_s=R_TIMES_S[last_s > R_TIMES_S])
    found = estimated(recording, drawn, timing)
    assert abs(found.offset_s - 0.1) < 0.010


def test_an_offset_may_put_frames_more_than_a_beat_outside_the_ecg():
    """They stay at its end, as at every trial offset."""
    times_s = R_TIMES_S[0] - 0.9 * RR_S + 0.2 * np.arange(40)
    timing = Timing([times_s, times_s + 0.1], R_TIMES_S, RR_S)
    first, second = timing.phases(0.3)
    assert len(first) == len(second) == 40
    assert first[0] == pytest.approx(0.001)
    inside = times_s - 0.3 > R_TIMES_S[0]
    np.testing.assert_allclose(first[inside], (times_s[inside] - 0.3 - 0.3) / RR_S % 1, atol=1e-9)
    np.testing.assert_array_equal(np.concatenate([first, second]), timing.at(np.arange(80), 0.3))
    with pytest.raises(InputError, match="more than one beat outside"):
        replace(timing, times_s=[times_s - 0.2]).phases(0.3)


def settled(recording, drawn, timing, choice):
    """What a search finds at the phases of the stamps as they are, and after settling."""
    start = start_off(recording, 3, 8, 8)
    search = replace(drawn, phases=timing.phases(), start=start, settings=QUICK)
    best = search.best(recording.sweeps)
    return search, best, settle_clock(search, best, recording.sweeps, timing, choice)


def test_an_offset_beyond_doubt_is_taken_off_the_phases(recording, drawn):
    search, best, found = settled(recording, drawn, stamped(recording, 0.15), "apply")
    assert abs(found.clock.applied_s - 0.15) < 0.010
    assert found.best.score > best.score
    for own, true in zip(found.search.phases, recording.phases, strict=True):
        off = (own - true + 0.5) % 1 - 0.5
        assert np.abs(off).max() < 0.010 / RR_S
    after, before = (
        max(search.pivot.distance(one.pose, recording.mr_from_tracker))
        for one in (found.best, best)
    )
    assert after < before


def test_an_offset_that_is_only_measured_changes_nothing(recording, drawn):
    search, best, found = settled(recording, drawn, stamped(recording, -0.1), "measure")
    assert abs(found.clock.offset_s + 0.1) < 0.010
    assert found.clock.applied_s == 0.0
    assert found.search is search
    assert found.best is best


def test_clocks_that_agree_are_left_alone(recording, drawn):
    search, _, found = settled(recording, drawn, stamped(recording), "apply")
    assert abs(found.clock.offset_s) < 0.010
    assert found.clock.applied_s == 0.0
    assert found.search is search


def test_an_offset_that_is_ignored_is_not_looked_at(recording, drawn):
    search = replace(drawn, settings=QUICK)
    best = Best(recording.mr_from_tracker, 1.0, 0.0)
    timing = stamped(recording, 0.1)
    assert settle_clock(search, best, recording.sweeps, timing, "ignore").clock is None
    assert settle_clock(search, best, recording.sweeps, None, "apply").clock is None


def test_r_times_in_doubt_give_no_offset(recording, drawn):
    """A record told at half its sampling rate: beats twice as long as the cine's, by which the
    phases are wrong whatever the offset, though some offset fits best."""
    timing = replace(stamped(recording, 0.1), cycle_rr_s=RR_S / 2)
    search, best, found = settled(recording, drawn, timing, "apply")
    assert len(timing.doubts()) == 1
    assert found.clock.offset_s is None
    assert found.clock.applied_s == 0.0
    assert found.search is search
    assert found.best is best
    assert replace(timing, cycle_rr_s=RR_S).doubts() == []


@pytest.fixture(scope="module")
def truly(recording, surfaces):
    """What is found at the true phases, from the true pose."""
    given = recording.sweeps, recording.phases, surfaces, recording.mr_from_tracker
    return find(*given, FROM_THERE)


@pytest.mark.parametrize("choice", ["apply", pytest.param("ignore", marks=pytest.mark.slow)])
def test_registration_is_made_at_the_phases_of_one_clock(recording, surfaces, truly, choice):
    timing = stamped(recording, 0.15)
    chosen = QUICK.model_copy(update={"clock_offset": choice})
    start = start_off(recording, 3, 8, 8)
    found = find(recording.sweeps, timing.phases(), surfaces, start, chosen, timing=timing)
    if choice == "apply":
        assert abs(found.clock.applied_s - 0.15) < 0.010
        # Half a hundredth of a beat leaves next to nothing of the agreement to be had.
        assert found.score > 0.97 * truly.score
    else:
        assert found.clock is None
        assert found.score < 0.9 * truly.score


def test_an_offset_counts_from_three_standard_deviations_on():
    assert not ClockOffset(0.029, 0.010, np.eye(4)).significant
    assert ClockOffset(-0.031, 0.010, np.eye(4)).significant


@pytest.mark.parametrize(("sd_s", "known"), [(0.019, True), (0.0199, False)])
def test_an_offset_less_sure_than_20_ms_is_none(monkeypatch, recording, drawn, sd_s, known):
    """The model's own 5 ms counted in."""
    monkeypatch.setattr(_Profile, "nearest", lambda self, pose, offset_s: (0.1, pose))
    monkeypatch.setattr(_Profile, "summit", lambda self, poses, offset_s: (0.1, sd_s))
    monkeypatch.setattr(_Profile, "climb", lambda self, pose, offset_s: pose)
    found = estimated(recording, drawn, stamped(recording))
    assert (found.offset_s is not None) == known
    assert found.sd_s == (pytest.approx(np.hypot(sd_s, 0.005)) if known else np.inf)


@pytest.mark.parametrize("true_s", [0.0, 0.02, 0.06, 0.2])
@pytest.mark.parametrize("rr_s", [0.8, 0.81, 0.9])
def test_an_offset_that_fits_as_well_half_a_beat_away_is_seen(rr_s, true_s):
    """Wherever the two lie: the scan is as long as a beat, and goes round."""

    best_s, rival = scanned(
        rr_s, lambda turn: 1 + 0.5 * np.cos(2 * turn) + 0.002 * np.cos(turn), true_s
    )
    # The scan goes by steps of 20 ms at the most.
    assert abs(best_s - true_s) <= 0.011
    assert rival > 0.9


@pytest.mark.parametrize("rr_s", [0.8, 0.81, 0.82, 0.9, 1.0, 1.01])
@pytest.mark.parametrize("true_s", [0.0, 0.02, 0.06, 0.2])
def test_where_the_scan_goes_round_is_no_summit(rr_s, true_s):
    """A flat profile with one summit, lopsided, so that it is on a slope there."""
    best_s, rival = scanned(
        rr_s, lambda turn: 1 + 0.02 * np.cos(turn) + 0.004 * np.sin(2 * turn), true_s
    )
    assert abs(best_s - true_s) < 0.1
    assert rival == 0


def scanned(rr_s, profile, true_s):
    """Where a scan finds the summit of a profile over turns of a beat, and its rival."""

    class Score:
        def __init__(self, turn):
            self.turn = turn

        def score(self, _):
            return profile(self.turn)

    class Drawn(_Profile):
        __slots__ = ()

        def at(self, offset_s):
            return Score(2 * np.pi * (offset_s - true_s) / rr_s)

    timing = Timing([np.zeros(1)], np.arange(10) * rr_s, rr_s)
    return Drawn(None, None, timing).scan(np.eye(4))


@pytest.fixture(scope="module")
def long_recording():
    """Each sweep has frames enough to speak for itself."""
    return record(seed=2, frames=24)


def later_by(timing, late_s):
    """The second sweep's stamps alone, ahead by so much."""
    return replace(timing, times_s=[timing.times_s[0], timing.times_s[1] + late_s])


@pytest.mark.parametrize("late_s", [-0.3, 0.0, 0.03, 0.12, 0.35])
def test_sweeps_on_two_clocks_are_told_apart(long_recording, drawn, late_s):
    """At the pose that fits best by the stamps as they are, right or wrong."""
    timing = later_by(stamped(long_recording), late_s)
    start = long_recording.mr_from_tracker
    search = replace(drawn, phases=timing.phases(), start=start)
    level = search.fine_level(long_recording.sweeps)
    found = clocks_apart(level, climb(level, start, search.pivot), search.pivot, timing)
    if abs(late_s) < 0.05:
        assert found is None
        return
    assert found is not None
    assert (found.ahead, found.behind) == ((2, 1) if late_s > 0 else (1, 2))
    # Three standard deviations of what all frames of a sweep share, for two sweeps.
    assert abs(found.by_s - abs(late_s)) < 3 * np.sqrt(2) * MODEL_SD_S


def test_clocks_that_are_apart_make_a_result_doubtful(long_recording, surfaces):
    timing = later_by(stamped(long_recording), 0.2)
    given = long_recording.sweeps, timing.phases(), surfaces, long_recording.mr_from_tracker
    found = find(*given, FROM_THERE, timing=timing)
    assert found.verdict != "good"
    assert re.search(r"stamps of sweep 2 are 0\.(19|20|21) s ahead of .* sweep 1", found.reason)


def test_clocks_far_apart_are_compared_round_the_beat(monkeypatch):
    """Offsets of nearly half a beat ahead and behind lie side by side."""
    samples = type("Samples", (), {"sweep": np.repeat([0, 1, 2], 24)})()
    own_level = type("Own", (int,), {"thinned": lambda one, _: one})
    level = type("Level", (), {"samples": samples, "only": lambda _, some: own_level(some[0])})()
    own = {0: (0.38, 0.005), 24: (-0.39, 0.005), 48: (-0.30, 0.005)}
    monkeypatch.setattr(
        "pipeline.registration.clock_offset._own_offset", lambda first, *_: own[int(first)]
    )
    timing = Timing([np.arange(24.0)] * 3, R_TIMES_S, RR_S)
    found = clocks_apart(level, np.eye(4), None, timing)
    # The third is 0.12 s ahead of the first, the second 0.03.
    assert found == ClocksApart(3, 1, pytest.approx(0.12))
    own[48] = (-0.38, 0.005)
    assert clocks_apart(level, np.eye(4), None, timing) is None
