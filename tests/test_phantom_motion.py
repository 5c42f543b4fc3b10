"""The motion is one smooth map: invertible, cyclic, and true to the muscle's volume."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from data_synth.anatomy import label_points
from data_synth.beat import (
    PLACES,
    TWIST,
    Pulse,
    atrial_filling,
    contraction,
    end_systole_phase,
    kick_onset_phase,
    step_sum,
    systole_s,
    warp_phase,
)
from data_synth.breathing import BREATHING_AXIS, Breathing, breath_hold_mm, free_breathing_mm
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.population import PATHOLOGIES, draw_heart
from data_synth.primitives import tube
from data_synth.tissue import TRUTH_LABELS, Tissue, truth_values

INFARCT = {"infarct_strength": 1.0, "infarct_angle": 0.9, "infarct_height": 0.6}
DRAWN = {name: (k, min(k, 2)) for k, name in enumerate(PATHOLOGIES)}
"""Pathology -> (seed, spread): the mean healthy heart, and ever stranger ones of the others."""
ALL_PHASES = np.arange(0, 1, 0.05)
phases = st.floats(0, 1, exclude_max=True)
rr = st.floats(0.35, 2.0)
# Everything within the envelope that the phantom looks at, and some way beyond.
offsets = st.lists(
    st.tuples(*[st.floats(-160, 160, allow_subnormal=False)] * 3), min_size=1, max_size=20
)


@cache
def heart_of(kind: str) -> BeatingHeart:
    """A heart drawn for each pathology."""
    seed, spread = DRAWN[kind]
    return draw_heart(np.random.default_rng(seed), spread, kind)


@pytest.fixture(params=PATHOLOGIES)
def heart(request) -> BeatingHeart:
    return heart_of(request.param)


@cache
def heart_points(heart: BeatingHeart, count: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    """Random points of the heart at the R peak, with their tissue."""
    points = np.random.default_rng(7).uniform(-110, 110, (count, 3))
    labels = label_points(points, heart.shape, heart.tubes)
    return heart.into_patient(points[labels > 0]), labels[labels > 0]


@cache
def wall_points(heart: BeatingHeart, count: int = 20000) -> np.ndarray:
    """Random points of the left muscle at the R peak, LPS."""
    side = heart.shape.lv_radius + heart.shape.lv_wall + 3
    low = [-side, -side, -heart.shape.lv_length - heart.shape.apex_wall - 3]
    points = np.random.default_rng(3).uniform(low, [side, side, 3], (count, 3))
    labels = truth_values()[label_points(points, heart.shape, heart.tubes)]
    return heart.into_patient(points[labels == truth_values()[Tissue.LV_MYOCARDIUM]])


def jacobians(heart: BeatingHeart, points: np.ndarray, phase: float) -> np.ndarray:
    """Determinant of the map's slope by central differences."""
    # Rounding of coordinates near 100 mm: 1e-14 / 1e-4 = 1e-10. Truncation: 1e-8.
    step = 1e-4 * np.eye(3)
    columns = [
        (heart.carry(points + h, phase) - heart.carry(points - h, phase)) / 2e-4 for h in step
    ]
    return np.linalg.det(np.stack(columns, axis=-1))


def volumes(heart: BeatingHeart, chamber: str, times: np.ndarray) -> np.ndarray:
    """Volume of a chamber at phases, its volume at the R peak 1, by the map's determinant."""
    points, labels = heart_points(heart)
    inside = points[truth_values()[labels] == TRUTH_LABELS[chamber][0]]
    return np.array([heart.volume_ratio(inside, p).mean() for p in times])


@given(kind=st.sampled_from(PATHOLOGIES), phase=phases, offsets=offsets)
def test_reference_undoes_carry_and_carry_undoes_reference(kind, phase, offsets):
    heart = heart_of(kind)
    points = heart.centre_mm + np.array(offsets)
    # The closed-form inverses round at 1e-13 mm; slopes of 0.1 to 10 leave that far below 1e-9.
    there = heart.carry(points, phase)
    np.testing.assert_allclose(heart.reference(there, phase), points, rtol=0, atol=1e-9)
    back = heart.reference(points, phase)
    np.testing.assert_allclose(heart.carry(back, phase), points, rtol=0, atol=1e-9)


def test_the_cycle_closes_and_nothing_moves_at_the_r_peak(heart):
    points, _ = heart_points(heart)
    for phase in (0.0, 1.0, -2.0):
        np.testing.assert_allclose(heart.carry(points, phase), points, rtol=0, atol=1e-9)
    there = heart.carry(points, 0.3)
    # Phases 5.3 and 0.3 differ by rounding, 1e-15, times the fastest way, 400 mm in a cycle.
    np.testing.assert_allclose(heart.carry(points, 5.3), there, rtol=0, atol=1e-9)
    assert np.abs(heart.displacement_mm(points, 1.0)).max() < 1e-9


def test_velocity_and_acceleration_have_no_step_in_time(heart):
    """Steps of first and second differences shrink with their spacing, at the R peak too."""
    points = heart_points(heart)[0][::150]
    largest = []
    for step in (1 / 800, 1 / 1600):
        track = np.array([heart.carry(points, k * step) for k in range(-2, round(1 / step) + 2)])
        velocity = np.diff(track, axis=0) / step
        acceleration = np.diff(velocity, axis=0) / step
        largest.append(
            [np.abs(np.diff(values, axis=0)).max() for values in (velocity, acceleration)]
        )
    # A step would stay as it is when the spacing is halved; smooth values give a ratio of 2,
    # less what the coarse spacing misses of the steepest place.
    ratio = np.array(largest[0]) / np.array(largest[1])
    assert (ratio > 1.7).all()


def test_left_muscle_keeps_its_volume_everywhere_and_always(heart):
    """The accepted bound is 5 %; the map is built to keep it exactly, so only rounding is left."""
    wall = wall_points(heart)
    assert len(wall) > 1500
    for phase in ALL_PHASES:
        np.testing.assert_allclose(jacobians(heart, wall, phase), 1.0, rtol=0, atol=1e-4)


def test_volume_ratio_is_the_determinant_of_the_map(heart):
    points, _ = heart_points(heart)
    for phase in (0.2, 0.44, 0.9):
        expected = jacobians(heart, points, phase)
        # Central differences miss where one leg crosses a knot of a spline: 1e-4 times the jump of
        # the second derivative, 0.1 per mm.
        found = heart.volume_ratio(points, phase)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
        assert found.min() > 0.05


def test_velocity_is_the_derivative_of_the_way_along_a_path(heart):
    points = heart_points(heart)[0][::50]
    for phase, rr_s in ((0.1, None), (0.25, 1.1), (0.6, 0.7), (0.999, None)):
        length = heart.rr_s if rr_s is None else rr_s
        step = 1e-4
        ways = [heart.displacement_mm(points, phase + k * step, rr_s) for k in (-1, 0, 1)]
        expected = (ways[2] - ways[0]) / (2 * step * length)
        found = heart.velocity_mm_s(points + ways[1], phase, rr_s)
        # Central differences err by step^2 / 6 times the third derivative, about 2e5 mm/cycle^3.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-2)


def test_chambers_eject_what_is_asked(heart):
    full, empty = heart.volumes_ml(0.0), heart.volumes_ml(heart.pulse.end_systole)
    # Rounded rims at the valves, which the integral leaves out, hold under 2 % of a ventricle.
    ejected = 1 - empty["lv_endocardium"] / full["lv_endocardium"]
    assert ejected == pytest.approx(heart.pulse.lv_ejection, abs=0.012)
    assert empty["lv_myocardium"] == pytest.approx(full["lv_myocardium"], rel=2e-3)
    if heart.pulse.rv_ejection is not None:
        ejected = 1 - empty["rv_endocardium"] / full["rv_endocardium"]
        assert ejected == pytest.approx(heart.pulse.rv_ejection, abs=0.012)
    # The atria are fullest when all of their reservoir step is done, at 0.48 of the nominal cycle.
    largest = heart.volumes_ml(0.49)
    for side, wanted in (("left", heart.pulse.la_emptying), ("right", heart.pulse.ra_emptying)):
        if wanted is not None:
            name = f"{side}_atrium"
            assert 1 - full[name] / largest[name] == pytest.approx(wanted, abs=0.012)


def test_ventricles_eject_rest_fill_rest_and_are_filled_up():
    heart = heart_of("healthy")
    curve = volumes(heart, "lv_cavity", ALL_PHASES)
    lost = (1 - curve) / (1 - curve.min())
    at = dict(zip(np.round(ALL_PHASES, 2).tolist(), lost, strict=True))
    assert at[0.05] < 0.01 < at[0.15]  # isovolumic contraction, then ejection
    assert at[0.5] > 0.99  # isovolumic relaxation
    assert at[0.75] < 0.3 < 0.5 < at[0.6]  # rapid filling
    assert at[0.75] - at[0.85] < 0.05  # rest
    assert at[0.85] == pytest.approx(heart.pulse.kick, abs=0.02)  # atrial contraction brings this
    assert (np.diff(lost[:9]) > -1e-9).all()
    assert (np.diff(lost[10:]) < 1e-9).all()


@pytest.mark.parametrize("chamber", ["left_atrium", "right_atrium"])
def test_atria_fill_in_systole_and_empty_in_two_steps(chamber):
    heart = heart_of("healthy")
    atrium = volumes(heart, chamber, ALL_PHASES)
    ventricle = volumes(heart, "lv_cavity", ALL_PHASES)
    assert abs(ALL_PHASES[atrium.argmax()] - ALL_PHASES[ventricle.argmin()]) <= 0.1
    assert atrium.argmin() == 0
    drop = -np.diff(np.append(atrium, atrium[0])) / (atrium.max() - 1)
    conduit, rest, booster = drop[10:15].sum(), drop[15:17].sum(), drop[17:].sum()
    assert conduit > 0.4
    assert abs(rest) < 0.06
    assert booster > 0.2


@pytest.mark.parametrize("rate", [50, 60, 75, 90, 110])
def test_systole_lasts_as_weissler_measured(rate):
    # Q to aortic closure less 40 ms from Q to R; men's and women's lines bound their mean.
    men, women = 0.546 - 0.0021 * rate, 0.549 - 0.0020 * rate
    assert min(men, women) <= systole_s(60 / rate) + 0.04 <= max(men, women)
    # Boudoulas et al., Chest 80:613-617, 1981 measured 541 - 2.2 HR and 540 - 2.0 HR anew.
    assert systole_s(60 / rate) + 0.04 == pytest.approx(0.5405 - 0.0021 * rate, abs=0.015)
    heart = heart_of("healthy")
    place = heart.nominal_phase(end_systole_phase(rate), 60 / rate)
    assert place == pytest.approx(heart.pulse.end_systole, abs=1e-12)


def test_places_of_the_envelope_resemble_every_instant():
    def state(place: float) -> list[float]:
        place %= 1
        return [contraction(place, 0.18), atrial_filling(place), step_sum(TWIST, place)]

    known = np.array([state(place) for place in PLACES])
    for place in np.linspace(0, 1, 500):
        assert np.abs(known - state(place)).max(axis=1).min() < 1 / 8


@given(rr_s=rr)
def test_systole_takes_a_larger_share_of_a_shorter_beat_and_leaves_room(rr_s):
    longer = end_systole_phase(60 / (rr_s * 1.01))
    assert end_systole_phase(60 / rr_s) > longer - 1e-12
    assert end_systole_phase(60 / rr_s) < kick_onset_phase(60 / rr_s) - 0.1
    # Neither length nor share has a step: 1 % of the beat changes systole by 1 % at most.
    assert -1e-12 <= systole_s(rr_s * 1.01) - systole_s(rr_s) <= 0.0101 * systole_s(rr_s)


@given(phase=phases, rr_s=rr)
def test_phase_of_another_beat_is_monotone_cyclic_and_fixed_at_the_r_peak(phase, rr_s):
    heart = heart_of("healthy")
    assert heart.nominal_phase(phase, heart.rr_s) == pytest.approx(phase, abs=1e-12)
    place = heart.nominal_phase(phase, rr_s)
    assert 0 <= place < 1
    assert math.cos(2 * math.pi * (heart.nominal_phase(phase + 1, rr_s) - place)) > 1 - 1e-12
    assert math.sin(math.pi * heart.nominal_phase(0.0, rr_s)) == pytest.approx(0, abs=1e-12)
    ahead = (heart.nominal_phase(phase + 0.01, rr_s) - place) % 1.0
    # Between the slowest and the fastest place of the warp its speed differs 50-fold at most.
    assert 0.0005 < ahead < 0.05


@given(
    source=st.tuples(st.just(0.0), st.floats(0.2, 0.6), st.floats(0.7, 0.95)),
    target=st.tuples(st.just(0.0), st.floats(0.2, 0.6), st.floats(0.7, 0.95)),
    phase=phases,
)
def test_warp_takes_three_phases_to_three_others_and_back(source, target, phase):
    for p, q in zip(source, target, strict=True):
        assert math.sin(math.pi * (warp_phase(p, source, target) - q)) == pytest.approx(0, abs=1e-9)
    back = warp_phase(warp_phase(phase, source, target), target, source)
    assert math.sin(math.pi * (back - phase)) == pytest.approx(0, abs=1e-9)


def test_base_descends_while_apex_and_roof_stay(heart):
    length = heart.shape.lv_length
    axis = np.array([[0, 0, 0.0], [0, 0, -length], [0, 0, 62.0]])
    moved = heart.displacement_mm(heart.into_patient(axis), heart.pulse.end_systole)
    base, apex, roof = moved @ heart.long_axis
    assert base == pytest.approx(-heart.pulse.descent_lv, rel=0.15)
    assert abs(apex) < 0.15 * heart.pulse.descent_lv
    assert abs(roof) < 0.5


def test_apex_and_base_twist_against_each_other(heart):
    z = np.array([-0.85, -0.12]) * heart.shape.lv_length
    ring = np.stack([np.zeros(2), np.full(2, 12.0), z], axis=1)
    moved = heart.into_heart(heart.carry(heart.into_patient(ring), heart.pulse.end_systole))
    # Both points started on the anterior wall. Seen from the apex, the right ventricle to the left,
    # the apex turns counter-clockwise in systole: its anterior wall towards the right ventricle.
    apex, base = np.arctan2(moved[:, 0], moved[:, 1])
    # All of the twist at its ends, a good part of it at these heights.
    assert apex > 0.3 * abs(heart.pulse.twist_apex)
    assert base < 0


def thickness(heart: BeatingHeart, height: float, angle: float, phase: float) -> float:
    """Thickness (mm) of the left wall between the same two material points at a phase."""
    direction = np.array([math.cos(angle), math.sin(angle)])
    z = -height * heart.shape.lv_length
    radii = np.arange(5.0, 70.0, 0.05)
    ray = np.column_stack([radii[:, None] * direction, np.full(len(radii), z)])
    labels = label_points(ray, heart.shape, heart.tubes)
    muscle = (labels == Tissue.LV_MYOCARDIUM) | (labels == Tissue.SCAR)
    wall = heart.carry(heart.into_patient(ray[muscle][[0, -1]]), phase)
    return float(np.linalg.norm(wall[1] - wall[0]))


def test_infarct_neither_thickens_nor_moves_while_healthy_muscle_does():
    heart = heart_of("infarct")
    pulse, systole = heart.pulse, heart.pulse.end_systole
    still = thickness(heart, 0.6, pulse.infarct_angle, systole)
    rest = thickness(heart, 0.6, pulse.infarct_angle, 0.0)
    assert still == pytest.approx(rest, rel=0.01)
    far = pulse.infarct_angle + math.pi
    grown = thickness(heart, 0.6, far, systole) / thickness(heart, 0.6, far, 0.0)
    assert grown > 1.25
    assert heart.shape.lv_length * pulse.infarct_half_height > 20  # a patch of some size


def test_infarct_lowers_ejection_at_equal_effort_of_the_rest():
    healthy = heart_of("healthy")
    sick = replace(healthy, pulse=healthy.pulse._replace(**INFARCT))
    amounts = sick.amounts._replace(lv=healthy.amounts.lv)
    object.__setattr__(sick, "amounts", amounts)
    phase = np.array([healthy.pulse.end_systole])
    lost = 1 - volumes(sick, "lv_cavity", phase)[0]
    usual = 1 - volumes(healthy, "lv_cavity", phase)[0]
    # The patch spans 1.6 of 6.28 radians and 0.6 of the length: about 15 % of the wall.
    assert 0.06 < 1 - lost / usual < 0.25


def test_ejection_beyond_reach_is_reached_as_far_as_it_goes():
    healthy = heart_of("healthy")
    weak = {"infarct_strength": 1.0, "infarct_half_angle": 2.2, "infarct_half_height": 0.6}
    sick = replace(healthy, pulse=healthy.pulse._replace(lv_ejection=0.6, **weak))
    lost = 1 - volumes(sick, "lv_cavity", np.array([sick.pulse.end_systole]))[0]
    assert 0.1 < lost < 0.55
    assert jacobians(sick, heart_points(sick)[0], sick.pulse.end_systole).min() > 0.02


@pytest.mark.parametrize(
    ("name", "value"),
    [("lv_ejection", 1.2), ("infarct_strength", -0.1), ("end_systole", 0.9), ("rv", float("nan"))],
)
def test_impossible_motion_is_refused(name, value):
    healthy = heart_of("healthy")
    with pytest.raises(SynthError, match=name):
        replace(healthy, pulse=Pulse(**{name: value}))


@pytest.mark.parametrize("rr_s", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_beat_lengths_are_refused(rr_s):
    with pytest.raises(SynthError, match="RR interval"):
        heart_of("healthy").nominal_phase(0.2, rr_s)


def test_breathing_axis_is_that_of_its_source():
    """Shechter et al., 2004: 4.9 mm towards the feet, 1.3 mm forwards; LPS is left, back, head."""
    expected = np.array([0.0, -1.3, -4.9])
    np.testing.assert_allclose(BREATHING_AXIS, expected / np.linalg.norm(expected), atol=1e-4)


@given(
    amplitude_mm=st.floats(0, 40),
    period_s=st.floats(1, 20),
    start=st.floats(0, 1),
    power=st.integers(1, 10),
)
def test_free_breathing_is_periodic_and_spans_its_amplitude(amplitude_mm, period_s, start, power):
    settings = Breathing(amplitude_mm=amplitude_mm, period_s=period_s, power=power)
    times = np.linspace(0, period_s, 401)
    shift = free_breathing_mm(times, settings, start)
    depth = shift @ np.array(BREATHING_AXIS)
    np.testing.assert_allclose(shift, np.outer(depth, BREATHING_AXIS), atol=1e-2)
    assert depth.min() >= 0
    # The top of the highest power, 20, drops by 20 (pi / 800)^2 = 0.0003 half a sample away.
    assert depth.max() == pytest.approx(amplitude_mm, rel=1e-3, abs=1e-6)
    again = free_breathing_mm(times + 3 * period_s, settings, start)
    np.testing.assert_allclose(again, shift, atol=1e-9)


def test_breathing_starts_at_rest_and_lingers_at_expiration():
    settings = Breathing()
    assert np.abs(free_breathing_mm(np.zeros(1), settings)).max() == 0
    times = np.linspace(0, settings.period_s, 1000, endpoint=False)
    depth = np.linalg.norm(free_breathing_mm(times, settings), axis=1)
    assert (depth < 0.1 * settings.amplitude_mm).mean() > 0.4
    assert (depth > 0.9 * settings.amplitude_mm).mean() < 0.15


def test_breath_holds_scatter_as_asked_and_repeat_by_seed():
    settings = Breathing(hold_sd_mm=2.0)
    shift = breath_hold_mm(np.random.default_rng(5), 4000, settings)
    depth = shift @ np.array(BREATHING_AXIS)
    # Standard error of a standard deviation from 4000 draws: 2 / sqrt(8000) = 0.022; five of them.
    assert depth.std() == pytest.approx(2.0, abs=0.11)
    again = breath_hold_mm(np.random.default_rng(5), 4000, settings)
    np.testing.assert_array_equal(again, shift)


@pytest.mark.parametrize("bad", [{"amplitude_mm": -1}, {"period_s": 0}, {"speed": 3}])
def test_impossible_breathing_is_refused(bad):
    with pytest.raises(ValidationError):
        Breathing(**bad)


def test_deep_in_a_thick_piece_of_a_tube_a_thin_one_beside_it_changes_nothing():
    line = np.array([[0.0, 0, 0, 10], [0, 0, 20, 10], [1, 0, 20, 1], [1, 0, 10, 1]])
    assert tube(0.0, 0.0, 10.0, line) == pytest.approx(-10.0)
