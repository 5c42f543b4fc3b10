"""Planes to volume: shapes whose every cross-section is known by formula."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.imaging.alignment import _observations, slice_shifts_mm
from pipeline.imaging.interpolation import (
    REFINE,
    isotropic_labels,
    plane_depth_mm,
)
from pipeline.imaging.labels import LABELS
from pipeline.imaging.tapering import BAND_MM

PIXEL_MM = 1.5
SIDE = 64
STEP_MM = 10 / 3
CENTRE_MM = (SIDE - 1) / 2 * PIXEL_MM

# An outline found on points REFINE a pixel, linearly between pixels, lies within half a point.
OUTLINE_MM = 0.5 * PIXEL_MM / REFINE


def in_plane_mm():
    axis = np.arange(SIDE) * PIXEL_MM - CENTRE_MM
    return np.meshgrid(axis, axis)


def soft(depth_mm):
    """Probability whose half-way contour is the zero of a signed depth: a 1-pixel edge."""
    return 1 / (1 + np.exp(-np.clip(depth_mm / PIXEL_MM * 4, -30, 30)))


def stack_of(inside):
    """One phase of two classes, background and a body of probability ``inside`` (plane, y, x)."""
    return np.stack([1 - inside, inside], axis=1)[None].astype(np.float32)


def volume_of(probability, plane_mm, shifts_mm=None, reach_mm=10.0, grid_mm=PIXEL_MM):
    shifts_mm = np.zeros((len(plane_mm), 2)) if shifts_mm is None else shifts_mm
    volume, first_mm = isotropic_labels(
        probability, PIXEL_MM, plane_mm, shifts_mm, reach_mm, grid_mm, 6.0
    )
    heights_mm = first_mm[2] + grid_mm * np.arange(volume.shape[1])
    return volume[0], heights_mm, first_mm


@pytest.mark.parametrize("sharpness", [1, 4])
def test_outlines_lie_neither_inside_nor_outside_on_average(sharpness):
    """Of rings with three classes, where an outline often halves a point's cell."""
    rng, off_mm = np.random.default_rng(0), []
    for _ in range(40):
        inner = rng.uniform(8, 24)
        outer = inner + rng.uniform(5, 11)
        x, y = in_plane_mm()
        away_mm = np.hypot(x - rng.uniform(-1, 1), y - rng.uniform(-1, 1))
        cavity, body = (soft(sharpness * (radius - away_mm)) for radius in (inner, outer))
        ring = np.stack([1 - body, cavity, body - cavity]).astype(np.float32)
        depth_mm = plane_depth_mm(ring, PIXEL_MM, rng.uniform(-2, 2, 2), PIXEL_MM)
        labels = depth_mm.argmax(axis=0)
        for pixels, radius in (((labels == 1).sum(), inner), ((labels > 0).sum(), outer)):
            off_mm.append(PIXEL_MM * np.sqrt(pixels / np.pi) - radius)
    # The mean of 40 has a standard error of 0.015 mm; smoothing moves a curved outline by less than
    # (EDGE_PX * PIXEL_MM)^2 / (2 radius), 0.05 mm on average here, and all inwards.
    mean_mm = np.reshape(off_mm, (-1, 2)).mean(axis=0)
    assert np.abs(mean_mm).max() < 0.1


def test_depth_of_a_disc_is_its_radius_less_the_distance_from_its_centre():
    x, y = in_plane_mm()
    truth_mm = 20 - np.hypot(x, y)

    depth_mm = plane_depth_mm(
        np.stack([1 - soft(truth_mm), soft(truth_mm)]).astype(np.float32),
        PIXEL_MM,
        np.zeros(2),
        PIXEL_MM,
    )

    # The nearest of a lattice of outline points lies at most half a lattice diagonal too far.
    # At the very centre, averaging the tip of the cone over a pixel adds as much again.
    near = np.abs(truth_mm) < 15
    allowed_mm = OUTLINE_MM + PIXEL_MM / REFINE * np.sqrt(2) / 2
    np.testing.assert_allclose(depth_mm[1][near], truth_mm[near], rtol=0, atol=allowed_mm)
    np.testing.assert_allclose(depth_mm[0][near], -truth_mm[near], rtol=0, atol=allowed_mm)


def test_a_class_that_a_plane_lacks_is_infinitely_far():
    depth_mm = plane_depth_mm(
        np.stack([np.ones((8, 8)), np.zeros((8, 8))]).astype(np.float32), 1.5, np.zeros(2), 1.5
    )
    assert np.isneginf(depth_mm[1]).all()


@pytest.mark.parametrize("grid_mm", [1.0, 1.5, 2.0])
def test_sphere_has_the_right_radius_at_every_height(grid_mm):
    """Between planes the radius may miss the circle by the sag of a chord, h^2 / 8 * |r''|."""
    radius_mm = 27.0
    plane_mm = np.arange(-30, 30.1, STEP_MM)
    x, y = in_plane_mm()
    section_mm = np.sqrt(np.maximum(radius_mm**2 - plane_mm**2, 0))
    depth_mm = section_mm[:, None, None] - np.hypot(x, y)

    volume, height_mm, _ = volume_of(stack_of(soft(depth_mm)), plane_mm, grid_mm=grid_mm)

    for height, plane in zip(height_mm, volume, strict=True):
        # The chord spans heights up to one step further out than this one.
        outer_mm = abs(height) + STEP_MM
        if outer_mm > 0.9 * radius_mm:
            continue
        r_mm = np.sqrt(radius_mm**2 - outer_mm**2)
        sag_mm = STEP_MM**2 / 8 * radius_mm**2 / r_mm**3
        found_mm = np.sqrt(plane.sum() * grid_mm**2 / np.pi)
        # Counting the lattice points of a disc errs by far less than half a lattice step.
        tolerance_mm = sag_mm + OUTLINE_MM + grid_mm / 4
        assert found_mm == pytest.approx(np.sqrt(radius_mm**2 - height**2), abs=tolerance_mm)


def test_sphere_ends_within_half_a_plane_step_of_its_poles():
    radius_mm, plane_mm = 22.0, np.arange(-30, 30.1, STEP_MM)
    x, y = in_plane_mm()
    section_mm = np.sqrt(np.maximum(radius_mm**2 - plane_mm**2, 0)) - 1e3 * (
        np.abs(plane_mm) > radius_mm
    )
    depth_mm = section_mm[:, None, None] - np.hypot(x, y)

    volume, height_mm, _ = volume_of(stack_of(soft(depth_mm)), plane_mm)

    present_mm = height_mm[volume.any(axis=(1, 2))]
    # Where exactly between the last plane that shows it and the next is not in the data.
    assert np.abs(present_mm).max() == pytest.approx(radius_mm, abs=STEP_MM)


@given(lean=st.floats(-1.0, 1.0), offset_mm=st.floats(-5, 5))
@example(lean=1.0, offset_mm=0.75)
@settings(max_examples=15, deadline=None)
def test_slanting_wall_between_two_structures_stays_flat(lean, offset_mm):
    """Depths of half-spaces are linear in height, so interpolation is exact.

    A wall in its plane is not: margins, tanh(2 u) at u pixels from the wall of `soft`, are drawn as
    a line between two pixels, whose zero is up to 0.092 pixels off (u = 0.2).
    """
    plane_mm = np.arange(0, 30.1, STEP_MM)
    x, _ = in_plane_mm()
    depth_mm = x[None] - offset_mm - lean * (plane_mm - 15)[:, None, None]
    # The distance within a plane is what counts: walls of classes 1 and 2 fill the image.
    chance = soft(depth_mm)
    probability = np.stack([0 * chance, chance, 1 - chance], axis=1)[None].astype(np.float32)

    volume, height_mm, first_mm = volume_of(probability, plane_mm)

    inner = (height_mm > plane_mm[0]) & (height_mm < plane_mm[-1])
    across_mm = first_mm[0] + PIXEL_MM * np.arange(volume.shape[2]) - CENTRE_MM
    for height, plane in zip(height_mm[inner], volume[inner], strict=True):
        wall_mm = offset_mm + lean * (height - 15)
        clear = np.abs(across_mm - wall_mm) > OUTLINE_MM + 0.092 * PIXEL_MM
        expected = np.where(across_mm > wall_mm, 1, 2)[clear]
        np.testing.assert_array_equal(
            plane[:, clear], np.broadcast_to(expected, plane[:, clear].shape)
        )


def test_structures_that_end_against_each_other_leave_no_gap():
    """A ventricle below, an atrium above, same outline: their seam lies half-way, closed."""
    plane_mm = np.arange(0, 30.1, STEP_MM)
    x, y = in_plane_mm()
    inside = np.broadcast_to(soft(20 - np.hypot(x, y)), (len(plane_mm), SIDE, SIDE))
    lower = (np.arange(len(plane_mm)) < 5)[:, None, None]
    probability = np.stack([1 - inside, inside * lower, inside * ~lower], axis=1)[None]

    volume, height_mm, first_mm = volume_of(probability.astype(np.float32), plane_mm)

    seam_mm = (plane_mm[4] + plane_mm[5]) / 2
    row, column = (round((CENTRE_MM - first_mm[k]) / PIXEL_MM) for k in (1, 0))
    core = volume[:, row - 8 : row + 9, column - 8 : column + 9]
    inner = (height_mm > plane_mm[0]) & (height_mm < plane_mm[-1])
    below = inner & (height_mm < seam_mm - 0.01)
    assert (core[below] == 1).all()
    assert (core[inner & (height_mm > seam_mm + 0.01)] == 2).all()
    # At the rim background may take a third of the band; nowhere more.
    reach_mm = np.hypot(
        *np.meshgrid(
            *(
                first_mm[k] + PIXEL_MM * np.arange(n) - CENTRE_MM
                for k, n in zip((0, 1), volume.shape[:0:-1], strict=True)
            )
        )
    )
    deep = reach_mm < 20 - BAND_MM / 3 - OUTLINE_MM - PIXEL_MM / 2
    assert (volume[inner][:, deep] > 0).all()


def test_paraboloid_cut_by_the_stack_is_completed_to_its_tip():
    """The square of its radius is linear along its axis, which is how ends are carried on."""
    tip_mm, focal = -6.0, 12.0
    plane_mm = np.arange(0, 30.1, STEP_MM)
    x, y = in_plane_mm()
    section_mm = np.sqrt(focal * (plane_mm - tip_mm))
    depth_mm = section_mm[:, None, None] - np.hypot(x, y)

    volume, height_mm, _ = volume_of(stack_of(soft(depth_mm)), plane_mm)

    lowest_mm = height_mm[volume.any(axis=(1, 2))].min()
    # Caps are made plane by plane: the tip lies within one step, the grid adds a voxel.
    assert lowest_mm == pytest.approx(tip_mm, abs=STEP_MM + PIXEL_MM)


def test_what_grows_towards_the_end_stops_before_the_next_slice():
    plane_mm = np.arange(0, 30.1, STEP_MM)
    x, y = in_plane_mm()
    depth_mm = (15 + 0.2 * plane_mm)[:, None, None] - np.hypot(x, y)

    volume, height_mm, _ = volume_of(stack_of(soft(depth_mm)), plane_mm, reach_mm=10.0)

    present_mm = height_mm[volume.any(axis=(1, 2))]
    assert plane_mm[-1] < present_mm.max() < plane_mm[-1] + 10
    assert plane_mm[0] > present_mm.min() > plane_mm[0] - 10


def test_shifted_planes_give_the_volume_of_unshifted_ones():
    """Whole-pixel shifts can be taken back without a trace."""
    rng = np.random.default_rng(3)
    plane_mm = np.arange(0, 30.1, STEP_MM)
    x, y = in_plane_mm()
    pixels = rng.integers(-3, 4, (len(plane_mm), 2))
    straight = soft(np.stack([18 - np.hypot(x, y)] * len(plane_mm)))
    moved = np.stack(
        [np.roll(p, (s[1], s[0]), axis=(0, 1)) for p, s in zip(straight, pixels, strict=True)]
    )

    expected, _, _ = volume_of(stack_of(straight), plane_mm)
    found, _, _ = volume_of(stack_of(moved), plane_mm, pixels * PIXEL_MM)

    # The box follows where the heart was seen, so only sizes and shapes can be compared.
    np.testing.assert_array_equal(
        found.reshape(len(found), -1).sum(1), expected.reshape(len(expected), -1).sum(1)
    )


@pytest.mark.parametrize("shift_mm", [0.0, 6.0])
def test_a_body_is_the_same_without_a_margin_around_it(shift_mm):
    x, y = in_plane_mm()
    disc = stack_of(np.stack([soft(12 - np.hypot(x - shift_mm, y))] * 6))
    plane_mm, shifts_mm = STEP_MM * np.arange(6), np.tile([shift_mm, 0.0], (6, 1))
    wide, none = (
        isotropic_labels(disc, PIXEL_MM, plane_mm, shifts_mm, 2.0, PIXEL_MM, margin_mm)[0]
        for margin_mm in (20.0, 0.0)
    )
    assert (none > 0).sum() == (wide > 0).sum()


def tilted_heart(shifts_mm, phases=2):
    """Cone-like bodies about a slanting axis, as labels 1 and 2, displaced slice by slice."""
    x, y = in_plane_mm()
    drawn = []
    for k, (dx, dy) in enumerate(shifts_mm):
        r = np.hypot(x - (2.0 * k - 10) - dx, y + (1.0 * k - 5) - dy)
        radius_mm = 10 + k
        drawn.append(np.where(r < radius_mm, 1, np.where(r < radius_mm + 8, 2, 0)))
    return np.broadcast_to(np.stack(drawn), (phases, *np.stack(drawn).shape)).astype(np.uint8)


def without_trend(shifts_mm):
    """What is left of shifts when a straight axis, which cannot be told from tilt, is fitted."""
    k = np.arange(len(shifts_mm))
    basis = np.stack([np.ones_like(k), k], axis=1).astype(float)
    return shifts_mm - basis @ np.linalg.lstsq(basis, shifts_mm, rcond=None)[0]


def test_slices_unevenly_spaced_are_told_what_their_shifts_make_of_a_curved_axis():
    """An axis that is a parabola in height bends as much everywhere, in deviations."""
    x, y = in_plane_mm()
    heights_mm = np.array([0.0, 10, 20, 40, 50, 70, 80, 90])
    shifts_mm = np.random.default_rng(2).normal(0, 1.5, (len(heights_mm), 2))

    def observed(curvature, moved_mm):
        axis_mm = 0.3 * (heights_mm - 45) + curvature / 2 * (heights_mm - 45) ** 2
        places = zip(axis_mm + moved_mm[:, 0], moved_mm[:, 1], strict=True)
        labels = np.stack([np.hypot(x - dx, y - dy) < 20 for dx, dy in places]).astype(np.uint8)
        return _observations(labels[None] * LABELS["right_atrium"], PIXEL_MM, heights_mm)

    still = observed(0.005, 0 * shifts_mm)
    in_deviations = still.offsets_mm[:, 0] * np.sqrt(still.precision[:, 0, 0])
    # A bend is half the curvature times both parts of the chord, which 10 mm each make 0.25 mm;
    # a disc's centre on a lattice is known to some tenth of a pixel.
    np.testing.assert_allclose(in_deviations, -0.25 / 1.5, atol=0.15 * PIXEL_MM / 1.5)
    moved = observed(0.0, shifts_mm)
    bends_mm = moved.offsets_mm[:, :2]
    np.testing.assert_allclose(moved.matrix @ shifts_mm, bends_mm, atol=0.15 * PIXEL_MM)
    # Of the normal a bend tells nothing.
    assert not moved.precision[:, 2].any()
    assert not moved.precision[:, :, 2].any()


@pytest.mark.parametrize("aside_mm", [9.0, 14.0, 20.0])
@pytest.mark.parametrize("number", [2, 5, 7])
def test_a_slice_far_aside_is_brought_back_and_the_others_stay(number, aside_mm):
    """A breath-hold beyond all usual ones, in any direction: what is left is a usual one's."""
    heights_mm, axes = 10.0 * np.arange(10), np.eye(3)[[0, 2, 1]]
    usual_mm = np.random.default_rng(9).normal(0, (0.5, 1.0), (10, 2))
    still = slice_shifts_mm(tilted_heart(usual_mm), PIXEL_MM, heights_mm, axes)[:, :2]
    for angle in np.deg2rad([20, 110, 250]):
        far_mm = np.zeros((10, 2))
        far_mm[number] = aside_mm * np.array([np.cos(angle), np.sin(angle)])
        found = slice_shifts_mm(tilted_heart(usual_mm + far_mm), PIXEL_MM, heights_mm, axes)
        left_mm = np.linalg.norm(found[:, :2] - still - far_mm, axis=1)
        assert left_mm[number] < 2.2
        assert np.delete(left_mm, number).max() < 1.0


@pytest.mark.parametrize("angle_degrees", [0, 90, 200])
@pytest.mark.parametrize("last", [7, 9])
def test_half_of_a_cut_through_a_valve_is_no_breath_hold(last, angle_degrees):
    """The ventricle's last cut is halved, with or without atria beyond: no slice is far aside."""
    x, y = in_plane_mm()
    labels = tilted_heart(np.zeros((10, 2)))
    angle = np.deg2rad(angle_degrees)
    way = np.cos(angle) * (x - 2.0 * last + 10) + np.sin(angle) * (y + 1.0 * last - 5)
    labels[:, last] *= way < 0
    labels[:, last + 1 :][labels[:, last + 1 :] > 0] = LABELS["left_atrium"]
    found = slice_shifts_mm(labels, PIXEL_MM, 10.0 * np.arange(10), np.eye(3)[[0, 2, 1]])
    assert np.abs(found[:, :2]).max() < 5


def test_the_rim_of_a_valves_opening_moves_no_slice():
    """The last cut is a sixth of the one before it, 12 mm beside the axis, in every phase."""
    x, y = in_plane_mm()
    labels = tilted_heart(np.zeros((10, 2)))
    places = np.array([[2.0 * k - 10, 5 - 1.0 * k] for k in range(10)])
    rim = np.hypot(x - places[9, 0] - 12, y - places[9, 1]) < 11
    labels[:, 9] = np.where(rim, 2, 0)
    labels[:, 9][:, np.hypot(x - places[9, 0] - 12, y - places[9, 1]) < 7.5] = 1
    found = slice_shifts_mm(labels, PIXEL_MM, 10.0 * np.arange(10), np.eye(3)[[0, 2, 1]])
    assert np.abs(found).max() < 0.2 * PIXEL_MM


def test_breath_hold_jumps_are_found_and_tilt_is_left_alone():
    axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    rng = np.random.default_rng(5)
    shifts_mm = rng.normal(0, (0.5, 2.0), (10, 2))

    heights_mm = 10.0 * np.arange(10)
    found = slice_shifts_mm(tilted_heart(shifts_mm), PIXEL_MM, heights_mm, axes)
    still_mm = slice_shifts_mm(tilted_heart(0 * shifts_mm), PIXEL_MM, heights_mm, axes)
    # Smoothness alone is too uncertain to tell of the third direction.
    assert not found[:, 2].any()
    found_mm = found[:, :2]

    left_mm = without_trend(found_mm - shifts_mm)
    # The part that carries no curvature cannot be seen; of the rest at least half must go.
    assert np.square(left_mm).mean() < 0.25 * np.square(without_trend(shifts_mm)).mean()
    # A disc's centre on a lattice is known to well under a fifth of a pixel.
    assert np.abs(still_mm).max() < 0.2 * PIXEL_MM
