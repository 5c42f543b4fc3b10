"""The ventricle between slices and at its tip: bodies of revolution, whose cuts are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.interpolate import CubicHermiteSpline

from pipeline.imaging import interpolation
from pipeline.imaging.interpolation import (
    REFINE,
    close_ends,
    isotropic_labels,
    plane_depth_mm,
    ventricle_depth_mm,
)
from pipeline.imaging.labels import LABELS
from pipeline.imaging.tapering import BAND_MM, taper_ventricle

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


def untapered(slice_mm, probability):
    """The same volume with the ventricle as the planes show it."""
    plane_mm = (slice_mm[:, None] + STEP_MM / PLANES * np.array([-1, 0, 1])).ravel()
    half_mm = STEP_MM / 2 - STEP_MM / PLANES
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpolation, "taper_ventricle", lambda depth, heights, *_: (depth, heights))
        return isotropic_labels(
            probability, PIXEL_MM, plane_mm, np.zeros((len(plane_mm), 2)), half_mm, 1.5, 6.0
        )[0][0]


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
    """Its cuts fall in a straight line, which is what is carried on: radius squared by height.

    It stands under a cylinder, which tells nothing of the tip; so does its cavity, 10 to 17 mm
    above its own.
    """
    slice_mm = np.arange(-10, 50.1, STEP_MM)
    up_mm = np.minimum(slice_mm - tip_mm, 35)
    outside_mm = np.sqrt(np.maximum(growth_mm * up_mm, 0))
    inside_mm = np.sqrt(np.maximum(growth_mm * up_mm - 250, 0))

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, inside_mm))

    shown = np.isin(volume, (CAVITY, MUSCLE)).any(axis=(1, 2))
    # Cuts counted in pixels put the tip wrong by little more than a grid step.
    assert height_mm[shown][0] == pytest.approx(tip_mm, abs=1.5 + OUTLINE_MM)
    cavity = (volume == CAVITY).any(axis=(1, 2))
    assert height_mm[cavity][0] == pytest.approx(tip_mm + 250 / growth_mm, abs=1.5 + OUTLINE_MM)
    # A step of the grid from the tip on, where it is less steep, its roundness shows: the cone
    # through the last cut would be a quarter of that cut's radius too narrow half-way.
    under = (height_mm < 0) & (height_mm > tip_mm + 1.5)
    truth_mm = np.sqrt(growth_mm * (height_mm[under] - tip_mm))
    moved_mm = np.sqrt(growth_mm * (height_mm[under] - tip_mm + OUTLINE_MM)) - truth_mm
    off_mm = found_mm(volume, CAVITY, MUSCLE)[under] - truth_mm
    assert np.all(np.abs(off_mm) < OUTLINE_MM + moved_mm)


def lowest_mm(volume, height_mm, *values):
    """Height of the lowest voxel of some classes, and how many they have."""
    shown = np.isin(volume, values)
    return height_mm[shown.any(axis=(1, 2))][0], np.count_nonzero(shown)


def test_a_smaller_last_cut_never_makes_the_tip_longer():
    """The last slice's cut shrinks to nothing, and the tip moves from below it to above it."""
    slice_mm = np.arange(0, 60.1, STEP_MM)
    found = []
    for last_mm in (12.0, 10.0, 8.0, 6.0, 4.0, 0.0):
        outside_mm = np.array([last_mm, 22, 25, 27, 28, 28.5, 29])
        volume, height_mm = volume_of(slice_mm, drawn(outside_mm, outside_mm - 8))
        found.append(lowest_mm(volume, height_mm, CAVITY, MUSCLE))
    tips_mm, voxels = np.array(found).T
    assert np.all(np.diff(tips_mm) >= 0)
    assert np.all(np.diff(voxels) < 0)
    # The last slice shows nothing of it, and has nothing of it.
    assert 0 <= tips_mm[-1] < slice_mm[1]


@pytest.mark.parametrize("planes_a_slice", [1, 3])
def test_what_slices_show_stays_as_it_is(planes_a_slice):
    """Depth on the slices from the last cut on, and on all planes above the widest."""
    slice_mm = np.arange(-10, 70.1, STEP_MM)
    outside_mm = radius_mm(slice_mm, -4, 70, 30) - 0.1 * np.maximum(slice_mm - 40, 0)
    inside_mm = radius_mm(slice_mm, 3, 70, 23)
    labels = drawn(outside_mm, inside_mm, right=40)[0]
    if planes_a_slice == 1:
        labels, height_mm = labels[1::PLANES], slice_mm
    else:
        height_mm = (slice_mm[:, None] + STEP_MM / PLANES * np.array([-1, 0, 1])).ravel()
    depth_mm = np.stack([plane_depth_mm(one, PIXEL_MM, np.zeros(2), 1.5) for one in labels])
    depth_mm, height_mm = close_ends(depth_mm, height_mm, 3.0)
    slices = np.flatnonzero(np.isin(height_mm, slice_mm))
    ventricle = np.stack(
        [
            ventricle_depth_mm(one, PIXEL_MM, np.zeros(2), 1.5)
            for one in labels[planes_a_slice // 2 :: planes_a_slice]
        ]
    )

    tapered_mm, tapered_height_mm = taper_ventricle(depth_mm, height_mm, slices, ventricle)

    widest = slices[int(outside_mm.argmax())]
    kept = np.union1d(slices[outside_mm > 0], np.arange(widest, len(height_mm)))
    where = np.searchsorted(tapered_height_mm, height_mm[kept])
    np.testing.assert_array_equal(tapered_height_mm[where], height_mm[kept])
    shown_mm = np.clip(depth_mm[kept], -BAND_MM, BAND_MM)
    # Single precision, a few roundings between planes.
    np.testing.assert_allclose(tapered_mm[where], shown_mm, atol=2e-6)
    tapering = tapered_height_mm < height_mm[widest]
    lowest = np.flatnonzero((tapered_mm[:, [CAVITY, MUSCLE]] > 0).any(axis=(1, 2, 3)))[0]
    assert np.diff(tapered_height_mm[tapering][lowest:]).max() <= 1.5


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

    np.testing.assert_array_equal(volume_of(slice_mm, chance)[0], untapered(slice_mm, chance))


def test_a_slice_left_out_leaves_no_step():
    """Radii follow the cubic over a gap of 20 mm as they do elsewhere."""
    slice_mm = np.array([0.0, 20, 30, 40, 50])
    outside_mm = np.array([10.0, 26, 29, 31, 31.5])
    plane_mm = (slice_mm[:, None] + STEP_MM / PLANES * np.array([-1, 0, 1])).ravel()

    volume, first_mm = isotropic_labels(
        drawn(outside_mm, outside_mm - 7), PIXEL_MM, plane_mm, np.zeros((15, 2)), 5 / 3, 1.5, 6.0, 3
    )

    height_mm = first_mm[2] + 1.5 * np.arange(volume.shape[1])
    inner = (height_mm > 0) & (height_mm < 40)
    slopes = np.gradient(outside_mm, slice_mm, edge_order=2)
    cubic_mm = CubicHermiteSpline(slice_mm, outside_mm, slopes)(height_mm)
    off_mm = found_mm(volume[0], CAVITY, MUSCLE) - cubic_mm
    assert np.abs(off_mm[inner]).max() < OUTLINE_MM


def test_the_tip_takes_nothing_from_another_chamber():
    """A right ventricle that goes on where the left one's last slice is over."""
    slice_mm = np.arange(0, 60.1, STEP_MM)
    outside_mm = np.array([0.0, 24, 26, 27, 28, 28.5, 29])
    chance = drawn(outside_mm, outside_mm - 8, right=45)
    before = untapered(slice_mm, chance)

    after, height_mm = volume_of(slice_mm, chance)

    # Planes of the first slice show it whole; the next one, of the second slice, its lesser part.
    low = height_mm < STEP_MM / PLANES
    assert (before[low] == RIGHT).any()
    np.testing.assert_array_equal(after[low] == RIGHT, before[low] == RIGHT)


def test_no_muscle_grows_across_the_valve():
    """A cavity that borders on the left atrium on its slices does so between them."""
    slice_mm = np.arange(-10, 70.1, STEP_MM)
    outside_mm = radius_mm(slice_mm, -4, 80, 30)
    inside_mm = radius_mm(slice_mm, 3, 80, 23)
    axis = np.arange(SIDE) * PIXEL_MM - CENTRE_MM
    beside = np.broadcast_to(axis > 20, (SIDE, SIDE))
    chance = drawn(outside_mm, inside_mm)
    for plane, inner_mm in zip(chance[0], np.repeat(inside_mm, PLANES), strict=True):
        if inner_mm > 20.5:
            plane[:, beside] = 0
            plane[LABELS["left_atrium"], beside] = 1

    volume, height_mm = volume_of(slice_mm, chance)

    open_mm = slice_mm[inside_mm > 20.5]
    rows = volume[(height_mm > open_mm[0]) & (height_mm < open_mm[-1]), SIDE // 2]
    for row in rows:
        cavity = np.flatnonzero(row == CAVITY)
        assert row[cavity[-1] + 1] == LABELS["left_atrium"]


def test_cavity_and_background_never_touch():
    """Where the wall leans so far that the slice's cavity is wider than the outside beside it."""
    slice_mm = np.arange(0, 50.1, STEP_MM)
    outside_mm = np.array([8.0, 30, 31, 32, 32.5, 33])

    volume, height_mm = volume_of(slice_mm, drawn(outside_mm, outside_mm - 4))

    cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
    assert (volume[height_mm < 45] == CAVITY).any()
    for plane in volume[height_mm < 45]:
        assert not (ndimage.binary_dilation(plane == CAVITY, cross) & (plane == 0)).any()


def test_outlines_stay_within_those_of_the_slices_on_both_sides():
    """A cubic that turns off sharply would overshoot by 2.6 mm."""
    slice_mm = np.arange(0, 40.1, STEP_MM)
    outside_mm = np.array([0, 8, 30, 30.4, 25])

    volume, _ = volume_of(slice_mm, drawn(outside_mm, outside_mm - 7))

    assert found_mm(volume, CAVITY, MUSCLE).max() < 30.4 + OUTLINE_MM


def test_a_ventricle_that_a_slice_interrupts_is_left_alone():
    slice_mm = np.arange(0, 60.1, STEP_MM)
    outside_mm = np.array([12.0, 18, 0, 24, 26, 27, 28])
    chance = drawn(outside_mm, outside_mm - 7)

    np.testing.assert_array_equal(volume_of(slice_mm, chance)[0], untapered(slice_mm, chance))
