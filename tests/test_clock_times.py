"""The phase clock and time: beats and questions of different clocks, stalls, slow monitors."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.registration.clock import PhaseClock

TICK_S = 0.004
KNOWN_S = 0.13


def beating(clock, until_s, ahead_s=0.0, start_s=0.0, withheld=False):
    """A regular heart, each beat told 0.13 s after it, timed by a clock that is ahead."""
    said = []
    for k in range(round((until_s - start_s) / TICK_S)):
        now_s = start_s + k * TICK_S
        if k % 200 == 50:
            clock.beat(now_s - KNOWN_S + ahead_s)
        said.append(clock.at(now_s, withheld=withheld))
    return said


@pytest.mark.parametrize("ahead_s", [0.2, 0.4, 0.6, 1.0, 2.8])
def test_beats_timed_by_a_clock_that_is_ahead_make_no_valid_phase(ahead_s):
    said = beating(PhaseClock(0.8), 20.0, ahead_s)
    assert not any(tick.valid for tick in said)
    assert max(tick.fade for tick in said) == 0


@pytest.mark.parametrize("wrong_s", [float("nan"), float("inf"), 1.7e308, -20.0, 25.0, 1e6])
def test_a_time_of_another_clock_ends_validity_at_the_fades_own_rate(wrong_s):
    """As of a system clock that is set, or a counter that begins anew."""
    clock = PhaseClock(0.8, f_max_n=2.0, force_rate_n_per_s=10.0)
    assert beating(clock, 30.0)[-1].fade == 1
    fades = [1.0]
    start_s = wrong_s if abs(wrong_s) < 1e11 else 30.0
    for k in range(400):
        now_s = wrong_s if k == 0 else start_s + k * TICK_S
        try:
            tick = clock.at(now_s)
        except InputError:
            tick = None
        if tick:
            assert not tick.valid
            fades.append(tick.fade)
    steps = -np.diff(fades)
    # 10 N/s of 2 N are a fiftieth in a tick of 4 ms; where time stood still a loop's turn counts.
    assert steps.max() <= 5.0 * 0.02 + 1e-9
    assert (steps[1:] <= 5.0 * TICK_S + 1e-6).all()
    assert fades[-1] == 0
    again = beating(clock, start_s + 40.0, start_s=start_s + 10.0)
    fresh = beating(PhaseClock(0.8, f_max_n=2.0), start_s + 40.0, start_s=start_s + 10.0)
    if wrong_s != 1e6:
        # After a leap ahead it still knows how regular the heart was.
        assert [tick.valid for tick in again] == [tick.valid for tick in fresh]
    assert again[-1].fade == 1


@pytest.mark.parametrize("wrong_s", [float("nan"), float("inf"), -1e300, 1e12])
def test_times_that_are_none_fade_as_in_milliseconds(wrong_s):
    clock = PhaseClock(0.8, f_max_n=2.0, force_rate_n_per_s=10.0)
    assert beating(clock, 30.0)[-1].fade == 1
    fades = []
    for _ in range(250):
        with pytest.raises(InputError, match="time must rise"):
            clock.at(wrong_s)
        fades.append(clock.tick.fade)
    assert clock.tick.state == "lost"
    assert fades[99] == pytest.approx(0.5)
    assert fades[-1] == 0


def test_a_beat_ahead_ends_validity_at_once_and_cannot_be_taken_back():
    clock = PhaseClock(0.8)
    assert beating(clock, 19.5)[-1].valid
    clock.beat(19.9)
    assert not clock.at(19.5).valid
    clock.take_back()
    assert not any(clock.at(19.5 + 0.01 * k).valid for k in range(60))


def test_a_time_that_is_a_trifle_before_the_last_changes_nothing():
    clock = PhaseClock(0.8)
    before = beating(clock, 20.0)[-1]
    state = clock._state.copy()
    with pytest.raises(InputError, match="time must rise"):
        clock.at(20.0 - TICK_S - 0.019)
    np.testing.assert_array_equal(clock._state, state)
    assert before.valid


def test_the_fade_does_not_leap_after_a_stall():
    first = next(k for k, tick in enumerate(beating(PhaseClock(0.8), 20.0)) if tick.valid)
    clock = PhaseClock(0.8, f_max_n=2.0, force_rate_n_per_s=10.0)
    before = beating(clock, (first + 1) * TICK_S)[-1]
    after = clock.at(first * TICK_S + 0.05)
    assert before.valid
    assert after.valid
    assert after.fade - before.fade == pytest.approx(5.0 * 0.02)


@pytest.mark.parametrize("glitch", [-0.5, 0.0, 0.3, 3.0, 3.37])
def test_a_time_that_leaps_and_a_stall_move_no_rendered_phase_by_more_than_the_slack(glitch):
    """As of one reading from another clock, or of a loop that the system held up."""
    clock = PhaseClock(0.8)
    assert beating(clock, 20.0)[-1].fade == 1
    times_s = 20.0 + 0.001 * np.arange(2000)
    said = [beating(clock, 20.0 + TICK_S, start_s=20.0)[-1]]
    leapt = 20.0 + TICK_S + np.concatenate([[glitch], max(glitch, 0.4) + times_s - 20.0])
    for now_s in leapt:
        with suppress(InputError):
            said.append(clock.at(now_s))
    phase = np.array([tick.phase for tick in said])
    fade = np.array([tick.fade for tick in said])
    moved = np.abs((np.diff(phase) + 0.5) % 1.0 - 0.5)
    # One and a half times its speed, in a beat whose phases pass by up to half as fast again.
    assert (moved[fade[:-1] > 0] <= 1.5 * 1.5 * 0.02 / 0.8).all()
    assert not fade[-1]


def test_a_force_that_is_withheld_fades_and_the_rhythm_is_kept():
    clock = PhaseClock(0.8, f_max_n=2.0, force_rate_n_per_s=10.0)
    assert beating(clock, 19.5)[-1].fade == 1
    fades = [clock.at(19.5 + 0.01 * k, withheld=True).fade for k in range(31)]
    np.testing.assert_allclose(-np.diff(fades[:19]), 0.05)
    assert fades[-1] == 0
    again = clock.at(19.81)
    assert again.valid
    assert again.fade == pytest.approx(0.05)


@pytest.mark.parametrize(("late_s", "waits_s", "valid"), [
    (0.13, 0.14, True), (0.35, 0.14, False), (0.35, 0.36, True),
])  # fmt: skip
def test_beats_that_a_monitor_tells_late_need_a_clock_that_waits(late_s, waits_s, valid):
    clock, ticks_told = PhaseClock(0.8, latency_s=waits_s), []
    for k in range(8000):
        now_s = k * TICK_S
        if k > 100 and (k - round(late_s / TICK_S)) % 200 == 0:
            clock.beat(now_s - late_s)
        if now_s > 10:
            ticks_told.append(clock.at(now_s).valid)
        else:
            clock.at(now_s)
    assert set(ticks_told) == {valid}


@pytest.mark.parametrize("behind_s", [0.18, 0.25, 0.3, 0.38, 0.5])
def test_beats_whose_clock_falls_behind_while_the_phase_is_valid_end_that_for_good(behind_s):
    """As where the loop's clock is set forward: each beat is regular, and told too late."""
    clock, valid = PhaseClock(0.8), []
    for k in range(10_000):
        now_s = k * TICK_S
        if (k - 33) % 200 == 0:
            clock.beat(now_s - 0.132)
        tick = clock.at(now_s + (behind_s if now_s > 20 else 0.0))
        valid.append(tick.valid)
    # Until the first beat is overdue nothing shows it.
    assert valid[4999]
    assert not any(valid[round(21.6 / TICK_S) :])


def test_a_question_long_before_the_loop_is_no_usual_turn_of_it():
    """Asked to warm up, at 0, and then at times of an epoch, 30 times a second, with one stall."""
    start_s, clock = 1.7e9, PhaseClock(0.8)
    clock.at(0.0)
    told = 0
    for k in range(180):
        now_s = start_s + k / 30
        while start_s + 0.8 * told + 0.132 <= now_s:
            clock.beat(start_s + 0.8 * told)
            told += 1
        before = clock.at(now_s)
    assert before.fade == 1
    after = clock.at(now_s + 0.5)
    moved = (after.phase - before.phase + 0.5) % 1 - 0.5
    # Three usual turns, at one and a half times the speed.
    assert abs(moved) <= 1.5 * 3 / 30 / 0.8 + 1e-6
    assert not after.valid


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("held_s", [0.05, 0.15, 0.5, 1.0])
def test_a_loop_that_was_held_up_is_not_made_up_for_at_once(told, held_s):
    """Whether the beats of the time between were told, as another thread's are, or not."""
    clock = PhaseClock(0.8)
    before = beating(clock, 20.0)[-1]
    now_s = 20.0 - TICK_S + held_s
    for beat_s in np.arange(20.0, now_s - 0.13, 0.8) if told else ():
        clock.beat(beat_s)
    after = clock.at(now_s)
    moved = (after.phase - before.phase + 0.5) % 1 - 0.5
    assert before.fade == 1
    # One and a half times its speed, in a beat whose phases pass by up to half as fast again.
    assert abs(moved) <= 1.5 * 1.5 * 0.02 / 0.8


@pytest.mark.parametrize("rate_hz", [10, 25, 60, 1000])
def test_who_asks_seldom_is_answered_as_who_asks_often(rate_hz):
    """As of a camera's or a scanner's frames; the shortest turn of a beat of 0.8 s is 0.13."""
    clock = PhaseClock(0.8)
    told, valid = 0, []
    for k in range(20 * rate_hz):
        now_s = k / rate_hz
        while 0.8 * told + 0.13 <= now_s:
            clock.beat(0.8 * told)
            told += 1
        tick = clock.at(now_s)
        if now_s > 10:
            valid.append(tick.valid)
            # The clock's own doubt about a rhythm that has hardly changed.
            assert abs((tick.phase - now_s / 0.8 + 0.5) % 1 - 0.5) < 0.005
    assert all(valid)


def test_a_field_changes_while_nothing_is_rendered_and_the_rhythm_is_kept():
    clock = PhaseClock(0.8, f_max_n=2.0)
    assert beating(clock, 20.0)[-1].fade == 1
    with pytest.raises(InputError, match="the field changes at a fade of 1"):
        clock.change_field(1.0, f_max_n=2.0)
    last = beating(clock, 21.0, start_s=20.0, withheld=True)[-1]
    assert last.fade == 0
    clock.change_field(1.0, f_max_n=4.0)
    new = PhaseClock(1.0, f_max_n=4.0)
    for one in np.arange(0.07, 20.88, 0.8):
        new.beat(one)
    tick = clock.at(21.0)
    assert tick.valid
    assert tick.phase == pytest.approx(new.at(21.0).phase, abs=1e-3)
    assert tick.fade == pytest.approx(10.0 / 4.0 * TICK_S)
    with pytest.raises(InputError, match="cycle_rr_s is None"):
        clock.change_field(None)


def test_after_lost_leads_three_intervals_are_needed():
    """The beat that ends the silence closes no interval."""
    clock = PhaseClock(0.8)
    beating(clock, 20.0)
    clock.at(20.0, usable=False)
    said = beating(clock, 26.0, start_s=20.004)
    assert next(k for k, tick in enumerate(said) if tick.valid) == 50 + 3 * 200
