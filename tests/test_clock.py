"""The phase clock against beats that are known: accuracy, honesty, and what it does in trouble."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import InputError
from pipeline.registration import ticks
from pipeline.registration.clock import PhaseClock, systole_s, to_cycle

TICK_S = 0.004
KNOWN_S = 0.13
"""A detector tells of R so long after it."""


def follow(r_times_s, end_s, cycle_rr_s=0.8, strange=(), lost=(np.inf, np.inf), **limits):
    """Ticks ``(n, 5)``: time, phase, sd, valid, fade; and states."""
    clock, rows, states, told = PhaseClock(cycle_rr_s, **limits), [], [], 0
    for now_s in np.arange(0.0, end_s, TICK_S):
        while told < len(r_times_s) and r_times_s[told] + KNOWN_S <= now_s:
            if not lost[0] <= r_times_s[told] < lost[1]:
                clock.beat(r_times_s[told], told in strange)
            told += 1
        tick = clock.at(now_s, not lost[0] <= now_s < lost[1])
        rows.append((now_s, tick.phase, tick.sd, tick.valid, tick.fade))
        states.append(tick.state)
    return np.array(rows), np.array(states)


def cyclic(difference):
    return (difference + 0.5) % 1 - 0.5


def regular(count=40, rr_s=0.8):
    return 0.2 + rr_s * np.arange(count)


def test_a_steady_heart_is_followed_exactly():
    ticks, states = follow(regular(), 30.0)
    late = ticks[:, 0] > 5.0
    assert (ticks[late, 3] == 1).all()
    assert (states[late] == "regular").all()
    truth = (ticks[late, 0] - 0.2) / 0.8
    # Equal intervals leave nothing to predict; what is left is rounding.
    assert np.abs(cyclic(ticks[late, 1] - truth)).max() < 1e-6


@pytest.mark.parametrize(
    ("fast_s", "slow_s", "beats"), [(0.3, 0.8, 20), (0.3, 1.0, 20), (0.5, 1.6, 20), (0.4, 1.3, 0)]
)
def test_a_heart_that_slows_down_by_three_is_followed_again(fast_s, slow_s, beats):
    """Within six beats, as where a racing rhythm breaks off, or noise was taken for one."""
    racing = 0.2 + fast_s * np.arange(beats)
    after_s = racing[-1] if beats else 0.2
    slow = after_s + slow_s * np.arange(1, 30)
    ticks, _ = follow(np.concatenate([racing, slow]), slow[-1], cycle_rr_s=fast_s)
    late = ticks[:, 0] > after_s + 6 * slow_s + KNOWN_S
    assert ticks[late, 3].mean() > 0.95
    truth = (ticks[late, 0] - after_s) / slow_s
    told = to_cycle(truth % 1, slow_s, fast_s)
    wrong = np.abs(cyclic(ticks[late, 1] - told))[ticks[late, 3] == 1]
    assert wrong.max() < 0.05


def test_breathing_is_predicted_better_than_by_the_last_interval():
    beat = np.arange(80)
    rr_s = 0.8 + 0.05 * np.sin(2 * np.pi * beat / 5.3)
    r_s = np.cumsum(rr_s)
    clock = PhaseClock(0.8)
    errors = []
    for k, one in enumerate(r_s):
        clock.beat(one)
        if 20 < k < 79:
            errors.append(clock.next_rr_s - rr_s[k + 1])
    last = rr_s[21:79] - rr_s[22:80]
    assert np.std(errors) < 0.5 * np.std(last)


def test_where_valid_the_phase_neither_jumps_nor_turns_back():
    rng = np.random.default_rng(3)
    rr_s = np.clip(0.8 + 0.04 * rng.normal(size=60), 0.6, 1.0)
    rr_s[[20, 40]] *= 0.65
    ticks, _ = follow(np.cumsum(rr_s), 45.0)
    steps = cyclic(np.diff(ticks[:, 1]))
    both = (ticks[1:, 3] > 0) & (ticks[:-1, 3] > 0)
    # Half again of a beat's own speed; the map between beats of 0.6 to 1.0 s at most doubles it.
    assert (steps[both] > 0).all()
    assert steps[both].max() < 1.5 * 2.0 * TICK_S / 0.6


def test_the_beats_of_a_quicker_rhythm_are_normal_once_it_has_come_to_stay():
    clock = PhaseClock(0.8)
    r_s = np.cumsum([0.8] * 12 + [0.6] * 6)
    kinds = [clock.beat(at_s) for at_s in r_s]
    assert kinds[12:14] == ["ectopic", "ectopic"]
    assert set(kinds[:12] + kinds[14:]) == {"normal"}


@pytest.mark.parametrize("strange", [False, True])
def test_an_early_beat_makes_the_phase_invalid_at_once(strange):
    r_s = regular()
    r_s = np.sort(np.append(r_s, r_s[20] + 0.5))
    ticks, states = follow(r_s, 30.0, strange=(21,) if strange else ())
    early_s = r_s[21]
    before = ticks[(ticks[:, 0] > early_s - 0.3) & (ticks[:, 0] < early_s)]
    assert (before[:, 3] == 1).all()
    after = (ticks[:, 0] > early_s + 0.15) & (ticks[:, 0] < early_s + 0.5)
    assert (ticks[after, 3] == 0).all()
    assert (states[after] == "ectopic").all()
    assert (ticks[ticks[:, 0] > early_s + 4.0, 3] == 1).all(), "a regular heart is trusted again"


@pytest.mark.parametrize(("pulses", "apart_s"), [(3, 0.005), (3, 0.02), (40, 0.08), (20, 0.1)])
def test_pulses_nearer_to_each_other_than_beats_make_no_rate(pulses, apart_s):
    """As where a line bounces, or a pacemaker or diathermy gets into a monitor's pulses."""
    beats = regular(15)
    burst = beats[-1] + apart_s * np.arange(1, pulses + 1)
    after = burst[-1] + 0.8 * np.arange(1, 12)
    ticks, _ = follow(np.concatenate([beats, burst, after]), after[-1])
    # On its own axis a steady heart's phase moves evenly, and a correction adds half of that.
    moved = (np.diff(ticks[:, 1]) % 1)[ticks[1:, 4] > 0]
    assert moved.max() < 1.5 * TICK_S / 0.8 + 1e-9
    during = (ticks[:, 0] > burst[0] + KNOWN_S + TICK_S) & (ticks[:, 0] < burst[-1] + KNOWN_S)
    assert not ticks[during, 3].any()
    assert ticks[-1, 3] == 1


def test_a_lost_lead_makes_the_phase_invalid_at_once():
    ticks, states = follow(regular(), 30.0, lost=(12.0, 18.0))
    within = (ticks[:, 0] >= 12.0) & (ticks[:, 0] < 18.0)
    assert (ticks[within, 3] == 0).all()
    assert (states[within] == "lost").all()
    assert ticks[ticks[:, 0] > 24.0, 3].all()


def test_a_beat_that_does_not_come_makes_the_phase_invalid():
    ticks, _ = follow(regular(20), 30.0)
    due_s = regular(21)[-1]
    # Known at the end of what a regular beat may be late, a tenth of the interval.
    knowable_s = due_s + 0.1 * 0.8
    assert (ticks[ticks[:, 0] > knowable_s + 0.15 + TICK_S, 3] == 0).all()


def test_disorder_is_called_fibrillation():
    rng = np.random.default_rng(0)
    rr_s = 0.45 + rng.exponential(0.2, 80)
    ticks, states = follow(np.cumsum(rr_s), 45.0)
    late = ticks[:, 0] > 15.0
    assert (states[late] == "fibrillating").mean() > 0.7
    assert ticks[late, 3].mean() < 0.05


def test_beats_of_two_kinds_in_turn_are_no_fibrillation():
    rr_s = np.tile([0.52, 1.08], 30)
    ticks, states = follow(np.cumsum(rr_s), 40.0)
    assert not (states == "fibrillating").any()
    assert not ticks[ticks[:, 0] > 5.0, 3].any()


@pytest.mark.parametrize("lengths_s", [(0.6, 0.8), (0.4, 0.8), (0.4, 0.6, 0.8)])
def test_a_block_that_changes_by_chance_is_hardly_ever_trusted(lengths_s):
    """Flutter of the atria, of whose turns two, three or four make a beat: nothing tells which.

    Of two lengths as likely, one in 16 beats comes after three that were alike, and is another.
    """
    beats = wrong = 0
    for seed in range(4):
        r_s = np.cumsum(np.random.default_rng(seed).choice(lengths_s, 150))
        ticks, _ = follow(r_s, r_s[-1])
        at = ticks[np.searchsorted(ticks[:, 0], r_s[20:]) - 1]
        beats += len(at)
        wrong += int(((at[:, 3] == 1) & (np.abs(cyclic(at[:, 1])) > 0.1)).sum())
    assert wrong < beats / 16


def test_a_single_early_beat_costs_one_regular_interval():
    """So do two of them, some beats apart: that is no habit yet."""
    rr_s = np.full(60, 0.8)
    rr_s[[30, 38]], rr_s[[31, 39]] = 0.5, 1.1
    r_s = 0.2 + np.cumsum(rr_s)
    ticks, _ = follow(r_s, r_s[-1])
    for early in (30, 38):
        # The pause's end is no regular beat; the one after it is, and is told later.
        known_s = r_s[early + 2] + KNOWN_S
        assert not ticks[(ticks[:, 0] > r_s[early] + KNOWN_S) & (ticks[:, 0] < known_s), 3].any()
        later = (ticks[:, 0] > known_s + 0.8) & (ticks[:, 0] < r_s[early + 5])
        assert ticks[later, 3].all()


@given(f_max_n=st.floats(0.5, 12.0), rate=st.floats(1.0, 50.0), seed=st.integers(0, 5))
def test_no_force_step_exceeds_the_limit(f_max_n, rate, seed):
    rng = np.random.default_rng(seed)
    rr_s = 0.8 * rng.choice([1.0, 1.0, 1.0, 1.0, 0.6, 1.4], 12)
    ticks, _ = follow(
        np.cumsum(rr_s), 9.0, lost=(5.0, 5.4), f_max_n=f_max_n, force_rate_n_per_s=rate
    )
    steps_n = np.abs(np.diff(ticks[:, 4])) * f_max_n
    # Rounding of the times adds a billionth.
    assert steps_n.max() <= rate * TICK_S * (1 + 1e-9)
    assert ((ticks[:, 4] >= 0) & (ticks[:, 4] <= 1)).all()


def test_the_uncertainty_is_that_of_the_phase():
    rng = np.random.default_rng(1)
    rr_s = 0.8 * (1 + 0.02 * rng.normal(size=120))
    r_s = np.cumsum(rr_s)
    ticks, _ = follow(r_s, 90.0)
    kept = (ticks[:, 3] > 0) & (ticks[:, 0] > 10.0)
    beat = np.searchsorted(r_s, ticks[kept, 0], side="right") - 1
    truth = to_cycle((ticks[kept, 0] - r_s[beat]) / rr_s[beat + 1], rr_s[beat + 1], 0.8)
    ratio = cyclic(ticks[kept, 1] - truth) / ticks[kept, 2]
    # 100 beats tell a spread to 7 %; its estimate from some ten intervals is off by 20 %.
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.4


@given(phase=st.floats(0, 0.999), rr_s=st.floats(0.35, 2.0), cycle_s=st.floats(0.35, 2.0))
def test_phases_of_one_beat_go_to_another_and_back(phase, rr_s, cycle_s):
    there = to_cycle(phase, rr_s, cycle_s)
    assert 0 <= there < 1
    back = to_cycle(there, cycle_s, rr_s)
    # The map's slope stays between 0.1 and 10 for these lengths.
    assert abs(cyclic(back - phase)) < 1e-9


def test_r_peak_end_of_systole_and_atrial_contraction_keep_their_places():
    for rr_s in (0.55, 0.7, 1.0, 1.3):
        own = np.array([0.0, systole_s(rr_s) / rr_s, 1 - 0.12 / rr_s])
        nominal = np.array([0.0, systole_s(0.8) / 0.8, 1 - 0.12 / 0.8])
        np.testing.assert_allclose(to_cycle(own, rr_s, 0.8), nominal, atol=1e-12)


def test_systole_lasts_as_long_as_weissler_measured():
    # 546 - 2.1 HR and 549 - 2.0 HR ms from Q, whose mean at 60 is 424.5 ms; R is 40 ms after Q.
    assert systole_s(1.0) == pytest.approx(0.3845, abs=1e-12)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: PhaseClock(0.05), "no heartbeat"),
        (lambda: PhaseClock(0.8, f_max_n=0.0), "must be positive"),
        (lambda: PhaseClock(0.8, latency_s=1.5), "latency_s = 1.5"),
        (lambda: PhaseClock(0.8).at(float("nan")), "time must rise"),
        (lambda: to_cycle([1.0], 0.8, 0.8), "lie in"),
        (lambda: to_cycle([0.5], -0.8, 0.8), "must be positive"),
    ],
)
def test_nonsense_is_refused(ask, words):
    with pytest.raises(InputError, match=words):
        ask()


def test_time_that_runs_back_is_refused():
    clock = PhaseClock(0.8)
    clock.at(1.0)
    with pytest.raises(InputError, match="time must rise"):
        clock.at(0.9)


def test_a_beat_before_the_last_does_not_count():
    clock = PhaseClock(0.8)
    clock.beat(2.0)
    assert clock.beat(1.5) is None


@pytest.mark.parametrize("wrong_s", [1012.0, 12_000.0, 1.75e9])
def test_a_beat_of_another_clock_is_refused_and_changes_nothing(wrong_s):
    clock, other = PhaseClock(0.8), PhaseClock(0.8)
    for k, now_s in enumerate(np.arange(0.0, 20.0, TICK_S)):
        if k % 200 == 50:
            assert clock.beat(now_s - KNOWN_S) == other.beat(now_s - KNOWN_S) == "normal"
        if k == 3000:
            assert clock.beat(wrong_s) is None
        assert clock.at(now_s) == other.at(now_s)
    assert clock.at(20.0).valid


def test_beats_as_near_to_each_other_as_their_spread_stop_nothing():
    """Of a long cycle's clock: an interval less its spread may be nothing to divide by."""
    clock = PhaseClock(3.0)
    clock.beat(0.0)
    clock.beat(0.18)
    assert clock.next_rr_s == 0.18
    tick = clock.at(0.19)
    assert np.isfinite([tick.phase, tick.sd]).all()
    assert not tick.valid


def test_how_far_ahead_a_beat_may_lie():
    clock = PhaseClock(0.8)
    clock.at(10.0)
    assert clock.beat(13.001) is None
    assert clock.beat(12.999) == "normal"
    # Of beats told in advance each is held against the one before it.
    assert clock.beat(15.9) == "normal"
    assert clock.beat(19.0) is None


def test_beats_told_before_the_first_question_and_far_from_it_are_forgotten():
    clock, other = PhaseClock(0.8), PhaseClock(0.8)
    for wrong_s in (1000.0, 1000.8, 1001.6, 1002.4):
        assert clock.beat(wrong_s) == "normal"
    for k, now_s in enumerate(np.arange(0.0, 8.0, TICK_S)):
        if k % 200 == 50:
            assert clock.beat(now_s - KNOWN_S) == other.beat(now_s - KNOWN_S) == "normal"
        assert clock.at(now_s) == other.at(now_s)
    assert clock.at(8.0).valid


def test_beats_may_be_told_long_before_the_first_question():
    clock = PhaseClock(0.8)
    r_s = 100.0 + regular()
    assert [clock.beat(one) for one in r_s] == ["normal"] * len(r_s)
    assert clock.at(r_s[-1] + 0.2).phase == pytest.approx(0.25, abs=1e-9)
    assert clock.next_rr_s == pytest.approx(0.8)


def test_questions_may_lie_far_apart():
    """As of somebody who asks for the phases of a few pictures, all beats told in between."""
    clock, r_s, told_s = PhaseClock(0.8), regular(200), -np.inf
    for now_s in (30.05, 75.3, 140.6):
        for one in r_s[(r_s > told_s) & (r_s <= now_s)]:
            assert clock.beat(one) == "normal"
        told_s = now_s
        assert cyclic(clock.at(now_s).phase - (now_s - 0.2) / 0.8) == pytest.approx(0, abs=1e-6)


def test_what_the_clock_says_can_be_written_as_json():
    clock = PhaseClock(0.8)
    said = json.loads(json.dumps(dataclasses.asdict(clock.at(1.0))))
    assert said["valid"] is False


def test_the_clock_loads_nothing_heavier_than_numpy_and_numba():
    script = (
        "import sys, pipeline.registration.clock\n"
        # numba itself looks for SciPy's version; none of its parts is needed.
        "heavy = {'scipy.signal', 'scipy.ndimage', 'scipy.linalg', 'SimpleITK', 'vtk', 'pyvista',"
        " 'cv2', 'matplotlib', 'pydicom', 'wfdb'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.mark.parametrize("rr_s", [0.364, 0.42, 0.7, 0.816])
@pytest.mark.parametrize("cycle_s", [0.75, 1.2])
def test_a_paced_heart_on_the_grid_of_the_loop_never_makes_the_phase_jump(rr_s, cycle_s):
    """Where R times and questions are whole milliseconds, some fall a rounding before an R peak."""
    clock, told, before = PhaseClock(cycle_s), 0, None
    fastest = 0.0
    for n in range(6000):
        while told * rr_s + 0.132 <= n / 1000:
            clock.beat(told * rr_s)
            told += 1
        now = clock.at(n / 1000)
        if before and before.valid:
            step = now.phase - before.phase
            fastest = max(fastest, step - np.floor(step + 0.5))
            assert step - np.floor(step + 0.5) >= 0
        before = now
    # Of a beat's parts the quickest is diastole, told within what atrial contraction leaves of it.
    assert 0 < fastest < 0.02


def test_a_beat_that_is_taken_back_leaves_nothing_but_what_was_rendered():
    """P waves told 0.17 s ahead of every beat: the clock knows what one without them knows."""
    misled, other = PhaseClock(0.8), PhaseClock(0.8)
    rng, r_s = np.random.default_rng(3), 0.5
    for _ in range(30):
        for clock in (misled, other):
            clock.at(r_s - 0.03)
        misled.beat(r_s - 0.17)
        for clock in (misled, other):
            clock.at(r_s + 0.13)
        misled.take_back()
        assert misled.beat(r_s) == other.beat(r_s)
        known = [clock._state[ticks.STATE : ticks.BEFORE] for clock in (misled, other)]
        np.testing.assert_array_equal(*known)
        r_s += 0.8 * (1 + 0.03 * rng.normal())
    # Beats that did not count, and what came before the first, cannot be taken back.
    known = misled._state.copy()
    assert misled.beat(r_s - 5.0) is None
    misled.take_back()
    np.testing.assert_array_equal(
        misled._state[ticks.STATE : ticks.BEFORE], known[ticks.STATE : ticks.BEFORE]
    )
    fresh = PhaseClock(0.8)
    fresh.take_back()
    assert fresh.beat(1.0) == "normal"


def test_leads_lost_after_a_beat_are_not_forgotten_with_it():
    clock = PhaseClock(0.8)
    for k in range(8):
        clock.beat(0.5 + 0.8 * k)
        clock.at(0.5 + 0.8 * k + 0.14)
    clock.beat(6.73)
    clock.at(6.87, usable=False)
    clock.take_back()
    clock.beat(6.9)
    assert not clock.at(7.03).valid


def test_pulses_too_near_for_beats_are_no_rhythm():
    """0.17 s apart, as of a pacemaker that runs away."""
    beats = regular(15)
    burst = beats[-1] + 0.17 * np.arange(1, 21)
    said, _ = follow(np.concatenate([beats, burst]), burst[-1])
    assert not said[said[:, 0] > burst[0] + KNOWN_S + TICK_S, 3].any()


def test_no_valid_phase_is_less_sure_than_a_twentieth_of_a_beat():
    r_times_s = np.cumsum(0.8 * (1 + 0.06 * np.random.default_rng(0).normal(size=100)))
    said, _ = follow(r_times_s, r_times_s[-1])
    assert 0.045 < said[said[:, 3] > 0, 2].max() <= 0.05


@pytest.mark.parametrize(
    ("off", "valid_before", "valid"),
    [(0.019, False, True), (0.022, False, False), (0.045, True, True), (0.055, True, False)],
)
def test_how_far_off_a_valid_phase_may_be(off, valid_before, valid):
    """It becomes valid within a fiftieth of a beat, and stays so within a twentieth."""
    clock = PhaseClock(0.8)
    for k in range(20):
        clock.beat(0.8 * k)
    for k in range(25):
        clock.at(15.3 + 0.001 * k)
    state = clock._state
    state[ticks.PHASE] += off
    state[ticks.VALID], state[ticks.FADE] = valid_before, 1.0
    assert clock.at(15.324).valid == valid


@pytest.mark.parametrize(("step", "disorder"), [(0.065, False), (0.085, True)])
def test_how_large_a_step_is_disorder(step, disorder):
    """Three lengths in turn: two of three steps, to either beat before, are that share."""
    clock = PhaseClock(0.8)
    r_times_s = np.cumsum(np.tile(0.8 + 0.8 * step * np.array([-1, 0, 1]), 8))
    for one in r_times_s:
        clock.beat(one)
    assert (clock.at(r_times_s[-1] + 0.1).state == "fibrillating") == disorder


def test_how_many_even_beats_end_a_habit_of_surprises():
    clock, valid = PhaseClock(0.8), []
    for one in np.cumsum([0.52, 1.08] * 12 + [0.8] * 12):
        clock.beat(one)
        valid.append(clock.at(one + 0.14).valid)
    assert not any(valid[2:24])
    # Six intervals, the first of which ends what was uneven.
    assert valid[24:].index(True) == 7


@pytest.mark.parametrize(("off", "speed"), [(-0.1, 1.5), (0.1, 0.5)])
def test_how_fast_a_phase_is_corrected(off, speed):
    clock = PhaseClock(0.8)
    for k in range(20):
        clock.beat(0.8 * k)
    clock.at(15.4)
    clock._state[ticks.PHASE] += off
    clock._state[ticks.FADE] = 1.0
    before = clock.tick.phase
    assert clock.at(15.41).phase - before == pytest.approx(speed * 0.01 / 0.8)


def test_fibrillation_ends_after_three_even_intervals():
    clock, states = PhaseClock(0.8), []
    disorder = np.tile(0.8 + 0.08 * np.array([-1, 0, 1]), 6)
    for r_s in np.cumsum([*disorder, *[0.8] * 12]):
        clock.beat(r_s)
        states.append(clock.at(r_s + 0.14).state)
    assert states[17] == "fibrillating"
    # Two thirds of the last nine steps are small from the third even interval on.
    assert states[18:].index("regular") == 5
