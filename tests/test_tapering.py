"""The ventricle between slices and at its tip: bodies of revolution, whose cuts are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from pipeline.imaging.interpolation import REFINE, isotropic_labels
from pipeline.imaging.labels import LABELS
from pipeline.imaging.tapering import LID_MM

PIXEL_MM, SIDE, STEP_MM = 1.5, 72, 10.0
PLANES = 3
CENTRE_MM = (SIDE - 1) / 2 * PIXEL_MM
CAVITY, MUSCLE, RIGHT = (LABELS[name] for name in ("lv_cavity", "lv_myocardium", "rv_cavity"))
OUTLINE_MM = 0.5 * PIXEL_MM / REFINE + PIXEL_MM / 4
"""An outline is found on points `REFINE` a pixel; counting a disc's errs by far less than half a
step of the lattice."""


def radius_mm(height_mm, tip_mm, length_mm, widest_mm):
    """Of an ellipsoid that stands on its tip, cut at its widest at ``tip_mm + length_mm``."""
    up = np.clip((np.asarray(height_mm) - tip_mm) / length_mm, 0, 1)
    return widest_mm * np.sqrt(1 - (1 - up) ** 2)


def drawn(outside_mm, inside_mm, right=None):
    """Probabilities of slices in rows of three planes that all show the slice's own outlines."""
    axis = np.arange(SIDE) * PIXEL_MM - CENTRE_MM
    away_mm = np.hypot(*np.meshgrid(axis, axis))
    labels = np.zeros((len(outside_mm), SIDE, SIDE), int)
    for plane, outer_mm, inner_mm in zip(labels, outside_mm, inside_mm, strict=True):
        if right is not None:
            plane[(axis < 0)[None, :] & (away_mm < right)] = RIGHT
        plane[away_mm < outer_mm] = MUSCLE
        plane[away_mm < inner_mm] = CAVITY
    one_hot = np.eye(1 + len(LABELS), dtype=np.float32)[labels].transpose(0, 3, 1, 2)
    return np.repeat(one_hot, PLANES, axis=0)[None]


def volume_of(slice_mm, probability):
    plane_mm = (slice_mm[:, None] + STEP_MM / PLANES * np.array([-1, 0, 1])).ravel()
    half_mm = STEP_MM / 2 - STEP_MM / PLANES
    volume, first_mm = isotropic_labels(
        probability, PIXEL_MM, plane_mm, np.zeros((len(plane_mm), 2)), half_mm, 1.5, 6.0, PLANES
    )
    return volume[0], first_mm[2] + 1.5 * np.arange(volume.shape[1])


def found_mm(volume, *values):
    return np.sqrt(np.isin(volume, values).sum(axis=(1, 2)) * 1.5**2 / np.pi)


@given(
    tip_mm=st.floats(-9, -2),
    length_mm=st.floats(60, 90),
    widest_mm=st.floats(24, 36),
    wall_mm=st.floats(5, 9),
)
@settings(max_examples=15, deadline=None)
def test_outlines_of_slices_alone_give_an_ellipsoid(tip_mm, length_mm, widest_mm, wall_mm):
    """Radii run through the slices' as the cubic that scipy draws with numpy's slopes."""
    slice_mm = np.arange(-10, 70.1, STEP_MM)
    shape = (tip_mm, length_mm, widest_mm)
    outside_mm = radius_mm(slice_mm, *shape)
    inside_mm = radius_mm(slice_mm, tip_mm + wall_mm, length_mm, widest_mm - wall_mm)

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, inside_mm))

    seen = outside_mm > 0
    slopes = np.gradient(outside_mm[seen], slice_mm[seen], edge_order=2)
    cubic_mm = CubicHermiteSpline(slice_mm[seen], outside_mm[seen], slopes)
    between = (height_mm > slice_mm[seen][0]) & (height_mm < min(60, tip_mm + length_mm - STEP_MM))
    off_mm = found_mm(volume, CAVITY, MUSCLE) - cubic_mm(height_mm)
    # Planes lie a third of a step apart; between them radii run straight.
    sag_mm = (STEP_MM / PLANES) ** 2 / 8 * np.abs(cubic_mm(height_mm, 2))
    assert np.all(np.abs(off_mm)[between] < OUTLINE_MM + sag_mm[between])
    # One step above the last cut the root itself is met.
    inner = between & (height_mm > slice_mm[seen][1])
    truth_mm = radius_mm(height_mm, *shape)
    assert np.abs(found_mm(volume, CAVITY, MUSCLE) - truth_mm)[inner].max() < OUTLINE_MM + 0.3


@given(tip_mm=st.floats(-8, -3), growth_mm=st.floats(15, 30))
@settings(max_examples=15, deadline=None)
def test_a_paraboloid_ends_at_its_tip(tip_mm, growth_mm):
    """Its cuts fall in a straight line, which is what is carried on: radius squared by height."""
    slice_mm = np.arange(-10, 50.1, STEP_MM)
    outside_mm = np.sqrt(np.maximum(growth_mm * (slice_mm - tip_mm), 0))
    inside_mm = np.sqrt(np.maximum(growth_mm * (slice_mm - tip_mm) - 250, 0))

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, inside_mm))

    shown = np.isin(volume, (CAVITY, MUSCLE)).any(axis=(1, 2))
    # Cuts counted in pixels put the tip wrong by little more than a grid step.
    assert height_mm[shown][0] == pytest.approx(tip_mm, abs=1.5 + OUTLINE_MM)
    cavity = (volume == CAVITY).any(axis=(1, 2))
    assert height_mm[cavity][0] - height_mm[shown][0] >= LID_MM - 1.5 / 2
    under = height_mm < 0
    truth_mm = np.sqrt(np.maximum(growth_mm * (height_mm - tip_mm), 0))
    off_mm = found_mm(volume, CAVITY, MUSCLE) - truth_mm
    # A step up or down of the grid where the tip is steepest.
    assert np.abs(off_mm[under & shown]).max() < np.sqrt(growth_mm * 1.5) + OUTLINE_MM


def test_the_tip_lies_before_the_far_face_of_the_slice_that_does_not_show_it():
    slice_mm = np.arange(-10, 50.1, STEP_MM)
    outside_mm = np.where(slice_mm > 5, 28 + slice_mm / 10, 0.0)

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, outside_mm - 8))

    shown = np.isin(volume, (CAVITY, MUSCLE)).any(axis=(1, 2))
    assert -STEP_MM / 2 - 1.5 <= height_mm[shown][0] < 0
    assert (np.diff(found_mm(volume, CAVITY, MUSCLE)[shown][:8]) > 0).all()


def test_a_stack_that_cuts_the_ventricle_off_adds_no_more_than_half_a_step():
    slice_mm = np.arange(0, 50.1, STEP_MM)
    outside_mm = 20 + slice_mm / 10

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, outside_mm - 8))

    shown = np.isin(volume, (CAVITY, MUSCLE)).any(axis=(1, 2))
    assert height_mm[shown][0] == pytest.approx(-STEP_MM / 2, abs=1.5)


def test_no_gap_opens_between_the_ventricles():
    """Where the left one is drawn narrower between slices, the right one follows."""
    slice_mm = np.arange(-10, 70.1, STEP_MM)
    outside_mm = radius_mm(slice_mm, -4, 70, 30)
    inside_mm = radius_mm(slice_mm, 3, 70, 23)

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, inside_mm, right=45))

    for height, plane in zip(height_mm, volume, strict=True):
        if 0 < height < 60:
            row = plane[SIDE // 2]
            heart = np.flatnonzero(row)
            assert (row[heart[0] : heart[-1]] > 0).all()


def test_chambers_without_muscle_are_left_alone():
    slice_mm = np.arange(-10, 50.1, STEP_MM)
    outside_mm = radius_mm(slice_mm, -4, 70, 30)
    chance = drawn(outside_mm, outside_mm)
    plane_mm = (slice_mm[:, None] + STEP_MM / PLANES * np.array([-1, 0, 1])).ravel()

    given_, _ = isotropic_labels(
        chance, PIXEL_MM, plane_mm, np.zeros((len(plane_mm), 2)), 5 / 3, 1.5, 6.0
    )

    np.testing.assert_array_equal(volume_of(slice_mm, chance)[0], given_[0])
