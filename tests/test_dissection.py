"""The simulated dissection: physics, repeatability, and the reader's own forces."""

from __future__ import annotations

import math

import numpy as np
import pytest
from field_baked import RADII_MM, RR_S
from field_shapes import beating, sphere

from pipeline.errors import InputError
from pipeline.evaluation import dissection as task
from pipeline.evaluation import rod
from pipeline.evaluation.dissection import Condition, Room, interval, run_all, run_trial
from pipeline.evaluation.dissection_values import Sum
from pipeline.evaluation.operators import operator
from pipeline.evaluation.places import on_surface, settle
from pipeline.field import BakeSettings, Fixture, ForceField
from pipeline.field.bake import bake_field
from pipeline.field.kernels import force_at

PHASES = np.arange(5) / 5
OMEGA = task.guidance("heart", "omega7")
SCALE = 1.6


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A ball of 32 mm that beats by a quarter of its radius."""
    path = tmp_path_factory.mktemp("room") / "field.zarr"
    surfaces = {"heart": beating(sphere(1.0, 4), SCALE * RADII_MM, PHASES)}
    fixtures = {
        "guide": Fixture(structure="heart", kind="guidance", gamma_mm=2.5, m=2, f_max_n=2.0)
    }
    settings = BakeSettings(spacing_mm=3.0, samples=100, fit_rounds=0)
    bake_field(path, surfaces, fixtures, settings, mr_from_tracker=None, rr_s=RR_S, source={})
    return Room(path, "heart", 1)


def test_pellets_keep_their_height_above_the_beating_heart(room):
    heights = room.field.distance_mm(
        room.pellets_mm.reshape(-1, 3), np.tile(np.arange(100) / 100, 10), "heart"
    ).reshape(10, 100)
    low, high = task.HEIGHTS_MM
    assert heights.min() > low - 1e-5
    assert heights.max() < high + 1e-5
    assert np.ptp(heights, axis=1).max() < 1e-5


def test_the_lifted_law_is_the_readers_force_on_a_surface_farther_out(room):
    """The same force as the formula on the reader's distance less the lift, for three numbers."""
    rng = np.random.default_rng(3)
    law = room.law(OMEGA)
    for point in rng.uniform(-40, 40, (50, 3)):
        phase = float(rng.uniform())
        found = np.array(force_at(*law, *point, phase))
        distance = room.field.distance_mm([point], phase, "heart")[0] - task.LIFT_MM
        slope = room.field.gradient([point], phase, "heart")[0]
        size = -math.expm1(-((distance**2 / (2 * OMEGA.resolved_delta_mm**2)) ** OMEGA.m))
        expected = -OMEGA.f_max_n * math.copysign(size, distance) * slope
        expected /= max(np.linalg.norm(slope), 0.5)
        # Coefficients of up to 60 mm are float32: off by 4e-6 mm, times 2 N/mm of stiffness.
        assert np.abs(found - expected).max() < 1e-5


@pytest.mark.parametrize("beats", [False, True])
@pytest.mark.parametrize("tool", ["point", "torus"])
def test_energy_of_operator_device_and_fixture_is_accounted_for(room, tool, beats):
    for fixture in (None, OMEGA):
        sums = run_trial(room, Condition(tool, beats, fixture), 1, 0).sums
        given = sums[Sum.WORK] + sums[Sum.FIXTURE]
        lost = sums[Sum.DEVICE_LOSS] + sums[Sum.HAND_LOSS]
        kept = sums[Sum.KINETIC] + sums[Sum.SPRING]
        # Hand and handle alone, then with the fixture, the heart and what holding the force made.
        assert abs(given - lost - kept) < 1e-9 * lost
        through = sums[Sum.HEART] + sums[Sum.SAMPLING] - sums[Sum.STORED]
        assert abs(sums[Sum.FIXTURE] - through) < 1e-9 * lost
        assert sums[Sum.WORST] < 1e-6 * lost / (sums[Sum.TIME] / task.TICK_S)
        assert sums[Sum.DEVICE_LOSS] > 0
        assert sums[Sum.HAND_LOSS] > 0


def test_energy_made_by_holding_the_force_falls_with_the_tick(room):
    """Holding a force for a tick errs by half the tick's way times the stiffness, so the energy
    that it makes is of first order in the tick: a tenth of the tick makes a tenth of it."""
    short = Condition("point", False, OMEGA)
    coarse = run_trial(room, short, 1, 2, tick_s=1e-3).sums
    fine = run_trial(room, short, 1, 2, tick_s=1e-4).sums
    assert coarse[Sum.SAMPLING] > 0
    # Movements differ in detail, so the ratio is 0.1 within a factor of two.
    assert 0.05 < fine[Sum.SAMPLING] / coarse[Sum.SAMPLING] < 0.2


def test_a_rod_carries_force_and_torque_to_the_hand_by_their_work():
    """Against differences: what the tip goes and the rod turns while the handle moves a little."""
    rng = np.random.default_rng(5)
    pivot, length, step = np.zeros(3), task.ROD_MM, 1e-4
    handle = 240.0 * np.array([0.48, -0.6, 0.64])
    force, torque = rng.standard_normal(3), 50 * rng.standard_normal(3)
    across, carried = rod.across.py_func, rod.at_the_handle.py_func

    def rod_axis(place):
        return (pivot - place) / np.linalg.norm(pivot - place)

    work = []
    for way in np.eye(3):
        ends = [handle + sign * step * way for sign in (-0.5, 0.5)]
        gone = np.subtract(*[across(end, pivot, length) for end in ends[::-1]])
        turned = np.cross(rod_axis(ends[0]), rod_axis(ends[1]))
        work.append((force @ gone + torque @ turned) / step)
    assert np.allclose(carried(force, torque, handle, pivot, length), work, atol=1e-6)


def test_a_whole_tool_makes_no_more_energy_than_its_sampling(room):
    """A ring whose torque does not turn the rod about its pivot seems to make 2.5 mJ more."""
    sums = run_trial(room, Condition("torus", False, OMEGA), 1, 0).sums
    assert abs(sums[Sum.SAMPLING]) < 2


def test_no_fixture_gives_nothing_and_a_heart_at_rest_neither(room):
    free = run_trial(room, Condition("point", True), 1, 0).sums
    still = run_trial(room, Condition("point", False, OMEGA), 1, 0).sums
    assert free[Sum.FIXTURE] == free[Sum.HEART] == free[Sum.FORCE] == 0
    assert still[Sum.HEART] == 0
    assert still[Sum.FORCE] > 0


def test_force_at_the_handle_never_exceeds_that_of_the_fixture(room):
    """The lever outside is longer than inside, so the handle feels no more than the tip."""
    sums = run_trial(room, Condition("point", True, OMEGA), 1, 1).sums
    assert sums[Sum.FORCE] <= OMEGA.f_max_n * (1 + 1e-12)


@pytest.mark.slow
def test_same_seed_gives_the_same_table_and_another_overlaps(room):
    conditions = [Condition("point", True), Condition("point", True, OMEGA)]
    one = run_all(room, conditions, 1, 16)
    other = run_all(room, conditions, 7, 16)
    # Each operator is the same whatever the others, and the threads that serve them.
    again = run_all(room, conditions, 1, 4)
    assert np.array_equal(one[:, :4], again)
    assert not np.array_equal(one, other)
    for first, second in zip(one, other, strict=True):
        (a, da), (b, db) = interval(first[:, Sum.TIME]), interval(second[:, Sum.TIME])
        assert abs(a - b) < da + db


def test_guided_operators_touch_the_heart_less(room):
    conditions = [Condition("point", True), Condition("point", True, OMEGA)]
    free, guided = run_all(room, conditions, 3, 16)
    assert guided[:, Sum.CONTACT_TIME].sum() < free[:, Sum.CONTACT_TIME].sum()
    assert guided[:, Sum.DEPTH].mean() < free[:, Sum.DEPTH].mean()
    assert (free[:, Sum.REMOVED] == task.PELLETS).all()


def test_trace_shows_tip_clearance_and_force(room):
    trial = run_trial(room, Condition("point", False, OMEGA), 1, 0, trace_rows=300)
    rows = trial.trace
    assert rows[:, 0] == pytest.approx(0.01 * np.arange(300))
    distance = room.field.distance_mm(rows[:, 1:4], 0.0, "heart")
    # float32 coefficients less the lift, as above.
    assert rows[:, 4] == pytest.approx(distance, abs=1e-4)
    assert np.linalg.norm(rows[:, 5:8], axis=1).max() <= OMEGA.f_max_n * (1 + 1e-9)


def test_an_operator_is_the_same_whatever_the_others_and_scales_alone():
    plain, waves = operator(5, 3)
    again, _ = operator(5, 3)
    shaky, wide = operator(5, 3, tremor_mm=2.0)
    assert plain == again
    assert shaky.tremor_mm == pytest.approx(2 * plain.tremor_mm)
    assert wide[..., 0] == pytest.approx(2 * waves[..., 0])
    assert shaky._replace(tremor_mm=plain.tremor_mm) == plain
    # Three waves of amplitude a have a root mean square of a sqrt(3 / 2).
    assert waves[0, :, 0] * math.sqrt(3 / 2) == pytest.approx(plain.tremor_mm)


def test_places_settle_on_the_height_asked_for(room):
    feet, out = on_surface(room.field, "heart", 8, 2)
    radius = np.linalg.norm(feet, axis=1)
    # The ball's facets and the 3 mm grid without a fit: within a few tenths of a millimetre.
    assert radius == pytest.approx(SCALE * RADII_MM[0], abs=0.5)
    assert (np.sum(out * feet, axis=1) > 0.99 * radius).all()
    above = settle(room.field, "heart", feet, 0.4, 3.0)
    assert room.field.distance_mm(above, 0.4, "heart") == pytest.approx(3.0, abs=1e-5)


def test_a_surface_without_room_is_refused(room, tmp_path):
    with pytest.raises(InputError, match="places were found"):
        on_surface(room.field, "heart", 10**6, 1)
    assert isinstance(room.field, ForceField)


def test_interval_is_students():
    """1, 2, 3: mean 2, standard error 1/sqrt(3), t of 2 degrees of freedom 4.302653 (tables)."""
    mean, half = interval(np.array([1.0, 2.0, 3.0]))
    assert mean == 2
    assert half == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
