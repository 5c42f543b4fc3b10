"""Slices that do not beat with the others are told, by how they differ; those that do are not.

Truth are discs whose radii follow a curve of area; a disc's pixels count its area within what its
edge crosses.
"""

import numpy as np
import pytest

from pipeline.imaging.in_step import out_of_step
from pipeline.imaging.labels import LABELS

PHASES = 20

PIXEL_MM = 1.5


def areas(phases=PHASES, share=0.5, late=0.0):
    """Of the largest: out within a third of the beat, in over the rest, as a ventricle's."""
    t = (np.arange(phases) / phases - late) % 1
    out = np.where(t < 0.35, np.sin(np.pi / 2 * t / 0.35), np.cos(np.pi / 2 * (t - 0.35) / 0.65))
    return 1 - share * out**2


def drawn(*curves):
    """Cavities ringed by muscle, a slice for each curve of area over the phases."""
    row, column = np.mgrid[:64, :64] - 32 + 0.3
    labels = np.zeros((len(curves[0]), len(curves), 64, 64), np.uint8)
    for z, curve in enumerate(curves):
        for k, area in enumerate(curve):
            far = np.hypot(row, column)
            inner = 16 * np.sqrt(area)
            labels[k, z][far < inner + 8] = LABELS["lv_myocardium"]
            labels[k, z][far < inner] = LABELS["lv_cavity"]
    return labels


def told(*curves):
    phases = np.arange(len(curves[0])) / len(curves[0])
    return out_of_step(drawn(*curves), phases, PIXEL_MM)


def test_slices_that_swing_together_are_not_told_however_far_each_swings():
    assert told(*(areas(share=share) for share in (0.3, 0.5, 0.6, 0.65, 0.5))) == {}


@pytest.mark.parametrize("phases", [6, PHASES])
@pytest.mark.parametrize("late", [0.1, 0.25, 0.45, -0.2])
def test_a_slice_that_beats_late_is_told_with_how_late(late, phases):
    usual = areas(phases)
    found = told(usual, usual, areas(phases, late=late), usual, usual)
    assert set(found) == {2}
    # Steps of 0.01 in which it is sought, and half a phase between which lines stand for curves.
    assert found[2]["late"] == pytest.approx(late, abs=0.01 + 0.5 / phases)
    assert found[2]["swing"] == pytest.approx(1, abs=0.25)


def test_a_slice_that_beats_late_as_slices_of_one_heart_do_is_not_told():
    """Conduction, and triggers rounded to a phase: 20 ms of a beat of 0.8 s."""
    usual = areas()
    assert told(usual, usual, areas(late=0.025), usual, areas(late=-0.025)) == {}


def test_a_slice_whose_systole_is_a_tenth_longer_is_not_told():
    """Of another beat of the same heart, which its rate changes by so much."""
    usual = areas()
    t = np.arange(PHASES) / PHASES
    longer = np.interp(t, [0, 0.385, 1], [0, 0.35, 1])
    assert told(usual, usual, np.interp(longer, t, usual, period=1), usual) == {}


def test_most_of_the_slices_say_what_is_usual():
    usual = areas()
    late = np.roll(usual, 8)
    found = told(usual, late, usual, late, usual, late, usual)
    assert set(found) == {1, 3, 5}
    assert all(one["late"] == pytest.approx(0.4, abs=0.035) for one in found.values())


def test_a_slice_that_shows_one_image_throughout_is_told():
    usual = areas()
    found = told(usual, usual, np.full(PHASES, 0.8), usual)
    assert found == {2: {"swing": 0.0, "in_step": 0.0}}


def test_a_slice_of_few_phases_in_another_order_is_told():
    usual = areas(3)
    found = told(usual, usual[[2, 0, 1]], usual, usual)
    assert set(found) == {1}
    assert set(found[1]) == {"swing", "in_step"}
    beat = np.array([1.0, 0.5])
    assert told(beat, beat, beat[::-1], beat)[2]["in_step"] < -0.5


def test_two_beats_in_the_time_of_one_are_no_slice_that_hardly_moves():
    usual = areas()
    found = told(usual, usual, np.tile(usual[::2], 2), usual)
    assert found[2]["swing"] == pytest.approx(1, abs=0.1)
    assert abs(found[2]["in_step"]) < 0.25
    assert "late" not in found[2]


def test_a_slice_that_swings_by_a_tenth_is_not_called_late():
    """Noise decides what so little follows."""
    usual = areas()
    found = told(usual, areas(share=0.05, late=0.3), usual, usual)
    assert set(found) == {1}
    assert "late" not in found[1]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_of_three_slices_the_one_is_told(place):
    usual = areas()
    slices = [usual] * 3
    slices[place] = areas(late=0.25)
    assert set(told(*slices)) == {place}


def test_outlines_that_are_a_little_off_tell_nothing():
    """Of a dilated heart that moves by little more, in few phases: each image's radius has an error
    of its own, of half of what would be told and larger than the labels' on the phantoms."""
    rng = np.random.default_rng(5)
    usual = areas(6, share=0.16)
    for _ in range(20):
        radii = np.sqrt(usual) + rng.normal(0, 0.25 / (16 * PIXEL_MM), (5, 6))
        assert told(*radii**2) == {}


def test_nothing_is_told_of_the_tip_of_few_slices_and_of_hearts_that_hardly_beat():
    usual = areas()
    assert told(usual, usual, 0.15 * np.roll(usual, 8), usual) == {}
    assert told(usual, np.roll(usual, 8)) == {}
    still = areas(share=0.06)
    assert told(still, still, np.roll(still, 8), still) == {}
    nothing = np.zeros((PHASES, 5, 8, 8), np.uint8)
    assert out_of_step(nothing, np.arange(PHASES) / PHASES, PIXEL_MM) == {}


def test_nothing_is_told_of_a_slice_at_the_valves_that_loses_its_muscle():
    usual = areas()
    labels = drawn(usual, usual, usual, np.roll(usual, 8))
    last = labels[5:, 3, :34]
    last[last == LABELS["lv_myocardium"]] = 0
    labels[5:, 3, :, :34][labels[5:, 3, :, :34] == LABELS["lv_myocardium"]] = 0
    assert out_of_step(labels, np.arange(PHASES) / PHASES, PIXEL_MM) == {}


def test_nothing_is_told_of_a_slice_that_the_valves_leave_in_systole():
    """Its cavity all but goes while the plane of the valves is below it: no sign of another beat,
    whatever it shows meanwhile."""
    usual = areas()
    passed = np.where(np.arange(PHASES) % 2, 0.15, 0.9)
    assert told(usual, usual, usual, passed) == {}


def wave(amplitude, phases=PHASES):
    """About 1, of a root mean square of the amplitude over the root of 2."""
    return 1 + amplitude * np.cos(2 * np.pi * np.arange(phases) / phases)


@pytest.mark.parametrize(("rms", "found"), [(0.04, set()), (0.06, {2})])
def test_a_heart_beats_enough_to_be_judged_where_it_swings_by_a_twentieth(rms, found):
    usual = wave(np.sqrt(2) * rms)
    assert set(told(usual, usual, 2 - usual, usual)) == found


@pytest.mark.parametrize(("share", "is_told"), [(0.0, True), (0.17, True), (0.35, False)])
def test_a_slice_makes_at_least_a_quarter_of_the_usual_swing(share, is_told):
    usual = wave(0.35)
    found = told(usual, usual, 0.9 * (1 + share * (usual - 1)), usual)
    assert set(found) == ({2} if is_told else set())
    if is_told:
        # A disc's pixels are its area to some 1 %, a thirtieth of the usual swing.
        assert found[2]["in_step"] == pytest.approx(share, abs=0.03)


def test_a_slice_that_rests_is_told_where_the_others_radii_swing_by_half_a_millimetre():
    """By half the area's share of 0.053, so radii of 24 mm by 0.64 mm and of 16 mm by 0.42 mm."""
    usual = wave(np.sqrt(2) * 0.053)
    assert set(told(usual, usual, np.ones(PHASES), usual)) == {2}
    assert told(usual, usual, np.full(PHASES, (16 / 24) ** 2), usual) == {}


def test_a_slice_that_beats_a_little_otherwise_is_judged_by_what_is_left_of_it():
    """A third of the usual swing, and a second harmonic as large: it correlates by 0.7, but its
    radius of 15 mm departs from its own share by 0.4 mm alone."""
    t = np.arange(PHASES) / PHASES
    usual = wave(0.25)
    other = 0.4 * (1 + 0.08 * np.cos(2 * np.pi * t) + 0.07 * np.cos(4 * np.pi * t))
    assert told(usual, usual, other, usual, usual) == {}


def test_a_slice_that_correlates_well_is_in_step_though_its_radius_departs():
    """A twentieth of a beat late: the cosine of 18 degrees is 0.95; radii are 1.2 mm off."""
    usual = wave(0.45)
    assert told(usual, usual, np.roll(usual, 1), usual) == {}


def test_a_slice_of_a_third_of_the_largest_area_is_judged():
    usual = areas(share=0.4)
    assert set(told(usual, usual, 0.5 * np.roll(usual, 8), usual)) == {2}
