"""The energy tank on a simulated hand: what a moving fixture can give it is bounded."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import InputError
from pipeline.field.passivity import EnergyTank

STEP_S = 1e-3
MASS_KG = 0.2
"""A hand and stylus, loosely held: nothing damps it."""


def wall(swing_mm: float, rate_hz: float):
    """A stiff guidance surface that swings along x: 0.4 N/mm, at most 3 N."""

    def force(x_mm: float, time_s: float) -> float:
        centre = swing_mm * np.sin(2 * np.pi * rate_hz * time_s)
        return float(np.clip(-0.4 * (x_mm - centre), -3, 3))

    return force


def simulate(force, tank, seconds: float, start_mm: float = 2.0):
    """Energy (mJ) that the rendered force has given the hand, after every tick."""
    x, v, given_mj = start_mm, 0.0, [0.0]
    for tick in range(round(seconds / STEP_S)):
        wanted = (force(x, tick * STEP_S), 0.0, 0.0)
        rendered = (wanted if tank is None else tank.passed((x, 0.0, 0.0), wanted))[0]
        # Newtons over kilograms are m/s^2, a thousand mm/s^2; the force is held for the tick.
        acceleration = 1000 * rendered / MASS_KG
        way = v * STEP_S + acceleration * STEP_S**2 / 2
        given_mj.append(given_mj[-1] + rendered * way)
        x, v = x + way, v + acceleration * STEP_S
    return np.array(given_mj)


RESONANCE_HZ = np.sqrt(400 / MASS_KG) / (2 * np.pi)


def test_a_moving_fixture_drives_the_hand_and_the_tank_stops_it():
    """At the resonance of the hand on the spring, 1 mm of swing is enough."""
    driven = simulate(wall(1.0, RESONANCE_HZ), None, 6.0)
    tank = EnergyTank(5.0, 20.0)
    kept = simulate(wall(1.0, RESONANCE_HZ), tank, 6.0)

    assert driven.max() > 50
    # One unforeseen step: the largest force over the way of a tick at the speed that 5 mJ and
    # the spring's first 0.8 mJ give.
    step_mj = 3.0 * 1000 * np.sqrt(2 * 6e-3 / MASS_KG) * STEP_S
    assert kept.max() <= 5.0 + step_mj


def test_a_fixture_at_rest_is_left_alone():
    """Hand and spring swap the energy of the start; the tank has it, so nothing is withheld.

    For a second: a spring that is held from tick to tick makes some energy of its own.
    """
    free = simulate(wall(0.0, 1.0), None, 1.0)
    kept = simulate(wall(0.0, 1.0), EnergyTank(5.0, 20.0), 1.0)
    np.testing.assert_array_equal(free, kept)


def held(force, tank, seconds: float, encoder_mm: float):
    """Forces (N) on a trembling hand that holds its place, 0.3 N/mm and damped, seen in steps."""
    x, v, forces = 0.0, 0.0, []
    for tick in range(round(seconds / STEP_S)):
        seen = encoder_mm * round(x / encoder_mm)
        rendered = tank.passed((seen, 0.0, 0.0), (force(seen, tick * STEP_S), 0.0, 0.0))[0]
        forces.append(rendered)
        wish = 0.3 * np.sin(2 * np.pi * 9 * tick * STEP_S)
        v += 1000 * (rendered + 0.3 * (wish - x) - 0.006 * v) / MASS_KG * STEP_S
        x += v * STEP_S
    return np.array(forces)


@pytest.mark.parametrize("encoder_mm", [0.001, 0.03])
def test_an_empty_tank_lets_the_force_come_and_go_without_steps(encoder_mm):
    """The wall gives the hand more than it gets back in every beat, so the tank runs empty."""
    tank = EnergyTank(5.0, 20.0)
    forces = held(wall(6.0, 1.25), tank, 10.0, encoder_mm)

    assert 0 < tank.level_mj < 1
    # A twentieth of the wall's 3 N as it goes, and 0.4 N/mm at 47 mm/s.
    assert np.abs(np.diff(forces)).max() < 0.15 + 0.02


@pytest.mark.parametrize("encoder_mm", [0.001, 0.03])
@pytest.mark.parametrize("capacity_mj", [0.0, 20.0])
def test_a_tank_that_is_empty_from_the_start_drives_nothing(encoder_mm, capacity_mj):
    tank = EnergyTank(0.0, capacity_mj)
    held(wall(6.0, 1.25), tank, 10.0, encoder_mm)
    assert tank.level_mj > -0.1


def test_a_step_back_and_a_rest_do_not_arm_an_empty_tank():
    """The hand is pushed on until nothing is left, gives way by one count of its encoder, rests for
    a quarter of a second and is pushed on again."""
    tank, count_mm = EnergyTank(5.0, 20.0), 0.02
    places = count_mm * np.round(np.arange(20_000) * 0.03 / count_mm)
    back = np.full(230, places[-1] - count_mm)
    places = np.concatenate([places, back, np.full(50, places[-1])])
    forces = np.array([tank.passed((x, 0.0, 0.0), (1.9, 0.0, 0.0))[0] for x in places])
    assert forces[0] == 1.9
    # A twentieth.
    assert np.abs(np.diff(forces)).max() < 0.096


@given(st.floats(0.2, 4), st.floats(0.5, 12), st.floats(0, 10))
def test_no_swing_gives_more_than_the_tank_held(swing_mm, rate_hz, level_mj):
    given_mj = simulate(wall(swing_mm, rate_hz), EnergyTank(level_mj, 20.0), 1.5)
    # The speed comes from the tank's energy; half the spring's largest force times way is 11 mJ.
    step_mj = 3.0 * 1000 * np.sqrt(2 * (level_mj + 11.25) * 1e-3 / MASS_KG) * STEP_S
    assert given_mj.max() <= level_mj + 2 * step_mj


@pytest.mark.parametrize(
    ("level", "capacity"), [(-1, 5), (6, 5), (float("nan"), 5), (5, float("inf"))]
)
def test_impossible_tanks_are_refused(level, capacity):
    with pytest.raises(InputError, match="needs 0 <= level_mj <= capacity_mj"):
        EnergyTank(level, capacity)


def test_a_point_or_a_force_that_is_not_three_numbers_is_refused():
    with pytest.raises(InputError, match="three numbers each"):
        EnergyTank().passed((0.0, 0.0), (1.0, 0.0, 0.0))


def along(tank, way_mm: float, ticks: int):
    """Shares of 1 N that are rendered on a way too short to change the level."""
    start = tank._point_mm[0] if tank._point_mm else 0.0
    places = start + way_mm * np.arange(1, ticks + 1)
    return np.array([tank.passed((x, 0.0, 0.0), (1.0, 0.0, 0.0))[0] for x in places])


def test_a_low_tank_lessens_what_drives_by_its_level_and_what_brakes_not_at_all():
    tank = EnergyTank(1.0, 20.0)
    tank.passed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    # Half of a tenth of the capacity.
    going = along(tank, 1e-9, 30)
    np.testing.assert_allclose(going[:10], 1 - 0.05 * np.arange(1, 11))
    np.testing.assert_allclose(going[10:], 0.5, atol=1e-6)
    # Where the tool rests, what it did last stands.
    np.testing.assert_allclose(along(tank, 0.0, 5), 0.5, atol=1e-6)
    np.testing.assert_allclose(along(tank, -1e-9, 5), 0.5 + 0.005 * np.arange(1, 6), atol=1e-6)
    # Nor does more come back where it rests: what is left could not pay for a step forward.
    np.testing.assert_allclose(along(tank, 0.0, 50), 0.525, atol=1e-6)
    np.testing.assert_allclose(along(tank, -1e-9, 200)[-1], 1.0)
    np.testing.assert_array_equal(along(EnergyTank(2.1, 20.0), 1e-9, 30), 1.0)


@pytest.mark.parametrize("speed_mm_s", [25, 100, 200, 400])
@pytest.mark.parametrize("capacity_mj", [5.0, 20.0, 100.0])
def test_a_force_that_drives_steadily_is_withheld_by_degrees_at_any_speed(speed_mm_s, capacity_mj):
    """2 N along the motion, until the tank is empty; it must hold what twelve ticks take."""
    way_mm = speed_mm_s * STEP_S
    tank = EnergyTank(capacity_mj / 2, capacity_mj)
    places = way_mm * np.arange(20_000)
    forces = np.array([tank.passed((x, 0.0, 0.0), (2.0, 0.0, 0.0))[0] for x in places])
    assert forces[0] == 2
    assert forces[-1] < 0.02
    smooth = 12 * 2.0 * way_mm < capacity_mj / 2
    # A twentieth of the force.
    assert (np.abs(np.diff(forces)).max() <= 0.1 + 1e-9) or not smooth


def test_in_debt_a_tool_at_rest_feels_only_what_brakes():
    tank = EnergyTank(0.0, 20.0)
    along(tank, 0.01, 2)
    assert tank.level_mj < 0
    assert along(tank, 0.0, 1) == 0
    assert along(tank, -1e-9, 1) > 0
    assert along(tank, 0.0, 1) > 0


def test_of_a_way_that_was_not_seen_only_what_the_hand_got_counts():
    """1 N over 2 mm that no sensor saw: 2 mJ are gone, or none came; then ways count again."""
    nowhere, pull = (float("nan"), 0.0, 0.0), (1.0, 0.0, 0.0)
    for to_mm, level_mj in ((2.0, 3.0), (-2.0, 5.0)):
        tank = EnergyTank(5.0, 20.0)
        assert tank.passed((0.0, 0.0, 0.0), pull) == pull
        assert tank.passed(nowhere, pull) == (0.0, 0.0, 0.0)
        tank.passed((to_mm, 0.0, 0.0), pull)
        assert tank.level_mj == pytest.approx(level_mj)
    tank.passed((-4.0, 0.0, 0.0), pull)
    assert tank.level_mj == pytest.approx(7.0)


def test_in_debt_a_force_across_the_way_waits_too():
    """1 mJ more went along x than there was: only what takes it back is rendered."""
    tank = EnergyTank(0.0, 5.0)
    tank.passed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert tank.passed((1.0, 0.0, 0.0), (-1.0, 1.0, 0.0)) == (-1.0, 0.0, 0.0)


def test_a_tank_holds_no_more_than_its_capacity():
    tank = EnergyTank(19.0, 20.0)
    tank.passed((0.0, 0.0, 0.0), (-5.0, 0.0, 0.0))
    tank.passed((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert tank.level_mj == 20


def test_of_a_step_that_costs_more_than_is_left_only_that_is_rendered():
    """0.1 mJ are left, and the next step would take 0.76 along its way, and nothing across."""
    tank = EnergyTank(0.5, 0.5)
    tank.passed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    found = tank.passed((0.4, 0.0, 0.0), (2.0, 1.0, 0.0))
    assert found == pytest.approx((0.1 / 0.4, 0.95, 0.0))


def test_a_force_that_is_no_number_ends_what_was_held():
    tank = EnergyTank(5.0, 20.0)
    tank.passed((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert tank.passed((1.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)) == (0.0, 0.0, 0.0)
    tank.passed((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert tank.level_mj == pytest.approx(4.0)


def test_a_point_whose_memory_is_used_again_is_remembered():
    tank, here = EnergyTank(5.0, 20.0), [0.0, 0.0, 0.0]
    tank.passed(here, (1.0, 0.0, 0.0))
    here[0] = 1.0
    tank.passed(here, (1.0, 0.0, 0.0))
    assert tank.level_mj == pytest.approx(4.0)
