"""Smooth signed distances against balls, planes and linear fields."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from surface_shapes import SPACING_MM, voxel_noise_mm

from pipeline.surface.level_set import (
    LevelSet,
    enclosed_mm3,
    euclidean_voxels,
    smooth_level_set,
    smooth_union,
    volume_shift,
    with_balls,
    with_necks,
    with_sign_of,
)
from pipeline.surface.mesh import extract_surface


def ball(radius_voxels: float, offset: tuple[float, float, float] = (0, 0, 0)):
    """Mask of a ball with 8 voxels of room, and distances of the voxels from its centre."""
    half = int(np.ceil(radius_voxels)) + 8
    z, y, x = np.indices((2 * half + 1,) * 3) - half
    far = np.linalg.norm(np.stack([x, y, z], axis=-1) - offset, axis=-1)
    return far < radius_voxels, far


offsets = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


@settings(max_examples=15, deadline=None)
@given(st.floats(6, 16), offsets)
def test_zero_level_of_a_ball_is_unbiased_at_any_curvature(radius, offset):
    """No shrinking: the smooth distance at the true surface is voxel noise about zero.

    Plain smoothing would move a face by s^2 / R: 0.24 voxels at a radius of 6. Here the face is
    that of the ball with as many voxels as the mask, and the mean of noise over the R^2 / s^2
    independent patches of a sphere is within two of its own deviations.
    """
    mask, far = ball(radius, offset)
    level = smooth_level_set(mask, 1.0, 1.2)
    near = np.abs(far - radius) < 0.5
    error = level.distance_mm[near] - (far[near] - radius)
    noise = voxel_noise_mm(1.0, 1.2)
    as_counted = (3 * np.count_nonzero(mask) / (4 * np.pi)) ** (1 / 3)
    assert abs(error.mean() - (radius - as_counted)) < 2 * noise / (radius / 1.2)
    assert error.std() < 1.5 * noise


def test_a_rim_is_moved_no_more_than_a_flat_side():
    """The constant that keeps the volume brings a ball back, but no body of several curvatures.

    Plain smoothing moves the rim of a lens inwards by s^2 times its mean curvature, its flat sides
    by s^2 times theirs; of the difference more than half must go.
    """
    wide, high, s = 20.0, 8.0, 1.5
    way = np.random.default_rng(0).normal(size=(6000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    rim, flat = np.abs(way[:, 2]) < 0.1, np.abs(way[:, 2]) > 0.95
    found = []
    # Where a flat side lies among the voxels decides more than its curvature.
    for middle in 24 + np.arange(4) / 4:
        z, y, x = np.indices((49, 65, 65)) - np.array([middle, 32, 32])[:, None, None, None]
        level = smooth_level_set((x**2 + y**2) / wide**2 + z**2 / high**2 < 1, 1.0, s)
        off = level.sample(way * (wide, wide, high) + (32, 32, middle))[0]
        found.append(off[rim].mean() - off[flat].mean())
    plain = s**2 * ((wide / high**2 + 1 / wide) / 2 - high / wide**2)
    assert abs(np.mean(found)) < plain / 2


@settings(max_examples=15, deadline=None)
@given(st.floats(5, 14), offsets)
def test_zero_level_encloses_the_volume_of_the_voxels(radius, offset):
    """The promise of 0.5 %, by the voxels that lie within the level, partly filled ones included"""
    mask, _ = ball(radius, offset)
    level = smooth_level_set(mask, SPACING_MM, 1.2)
    assert enclosed_mm3(level) == pytest.approx(mask.sum() * SPACING_MM**3, rel=5e-3)


def test_distance_stays_a_distance_far_from_the_surface():
    """The slope is one within a voxel's noise where only the far field speaks."""
    mask, far = ball(12)
    level = smooth_level_set(mask, SPACING_MM, 1.0)
    beyond = (far > 15) & (far < 19)
    error = level.distance_mm[beyond] - SPACING_MM * (far[beyond] - 12)
    # Maurer's distance is to voxel faces, which are within half a diagonal of the ball.
    assert np.abs(error).max() < SPACING_MM * np.sqrt(3) / 2


def test_euclidean_distance_agrees_with_scipy():
    """Outside: distance to the nearest voxel inside, less half a voxel; inside to the rim."""
    mask, _ = ball(5, (0.2, 0.1, 0.4))
    mask[9, 9, 9] = True
    rim = mask & ~ndimage.binary_erosion(mask, np.ones((3, 3, 3)))
    to_rim = ndimage.distance_transform_edt(~rim)
    expected = np.where(mask, -to_rim, to_rim) - 0.5
    np.testing.assert_allclose(euclidean_voxels(mask), expected, atol=1e-5)


def test_volume_shift_finds_the_level_of_a_known_slab():
    """Distances z - 10 over a floor of 25 voxels: 25 c + 25 * 10.5 voxels lie below level c."""
    slab = np.broadcast_to(np.arange(40.0)[:, None, None] - 10, (40, 5, 5))
    assert volume_shift(slab, 25 * 10.5 + 25 * 0.8) == pytest.approx(0.8, abs=1e-6)


vectors = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


@settings(max_examples=25, deadline=None)
@given(vectors, st.floats(-5, 5))
def test_sampling_a_linear_field_is_exact(slope, height):
    """Trilinear interpolation reproduces a linear field and its gradient everywhere inside."""
    z, y, x = np.indices((5, 7, 6)) * SPACING_MM
    values = height + slope[0] * x + slope[1] * y + slope[2] * z
    level = LevelSet(values.astype(np.float32), SPACING_MM)
    top = SPACING_MM * np.array([5, 6, 4])
    points = np.random.default_rng(0).random((50, 3)) * top
    points = np.concatenate([points, [top, 0 * top]])

    found, gradient = level.sample(points)

    # Values are stored in 32 bits.
    slack = 8 * np.finfo(np.float32).eps * (np.abs(values).max() + 1)
    np.testing.assert_allclose(found, height + points @ slope, atol=slack)
    np.testing.assert_allclose(
        gradient, np.broadcast_to(slope, (52, 3)), atol=4 * slack / SPACING_MM
    )


def test_points_beyond_the_grid_read_its_border():
    level = LevelSet(np.arange(27, dtype=np.float32).reshape(3, 3, 3), 1.0)
    found, _ = level.sample(np.array([[-5.0, -5, -5], [9, 9, 9]]))
    np.testing.assert_array_equal(found, [0, 26])


def test_newton_steps_reach_the_surface_and_are_bounded():
    mask, _ = ball(10)
    level = smooth_level_set(mask, 1.0, 1.2)
    direction = np.random.default_rng(2).normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = 18 + 13 * direction
    step = level.newton_step(points, 0.5)
    assert np.linalg.norm(step, axis=1).max() < 0.5 * 1.2
    for _ in range(4):
        points = points + level.newton_step(points, 5.0)
    assert np.abs(level.sample(points)[0]).max() < 0.01


def test_smooth_union_fills_a_seam_by_its_closed_form():
    """Where two bodies are equally near the union is deeper by k log 2, k a quarter blend."""
    d = np.array([0.5, -1.0, 3.0], dtype=np.float32)
    found = smooth_union([d, d], 8.0)
    np.testing.assert_allclose(found, d - 2 * np.log(2), rtol=1e-6)


def test_smooth_union_leaves_a_lone_body_alone():
    near, far = np.array([1.0], np.float32), np.array([40.0], np.float32)
    np.testing.assert_allclose(smooth_union([near, far], 8.0), near, atol=1e-6)
    np.testing.assert_array_equal(smooth_union([near, far], 0.0), near)


def test_smooth_union_does_not_depend_on_the_order():
    parts = list(np.random.default_rng(0).normal(0, 3, (4, 6)).astype(np.float32))
    np.testing.assert_allclose(smooth_union(parts, 6.0), smooth_union(parts[::-1], 6.0), rtol=1e-5)


def test_mended_distances_have_the_sign_of_the_mask():
    distance = np.array([-2.0, 3.0, 4.0, -1.0], np.float32)
    found = with_sign_of(distance, np.array([True, True, False, False]), 2.0)
    np.testing.assert_array_equal(found, [-2.0, -0.5, 4.0, 0.5])


@pytest.mark.parametrize("length", [3, 7])
def test_a_neck_thinner_than_the_smoothing_is_kept(length):
    """Two balls joined by a row of single voxels: smoothing parts them, the tube joins them."""
    first, _ = ball(6)
    second, _ = ball(4)
    room = (second.shape[0] - 7) // 2
    small = second[room:-room, room:-room, room:-room]
    mask = np.pad(first, ((0, 0), (0, 0), (0, 2 * length + 20)))
    middle, begin = mask.shape[0] // 2, int(np.flatnonzero(mask.any(axis=(0, 1)))[-1]) + 1
    mask[middle, middle, begin : begin + length] = True
    side = small.shape[0]
    around = slice(middle - side // 2, middle - side // 2 + side)
    mask[around, around, begin + length : begin + length + side] |= small
    level = smooth_level_set(mask, SPACING_MM, 1.5)
    assert ndimage.label(level.distance_mm < 0)[1] == 2

    kept = with_necks(level, mask, 1.8, 60)

    assert ndimage.label(kept.distance_mm < 0)[1] == 1
    # Marching cubes of 2 mm triangles sees one closed body, whose hole count is a ball's.
    surface = extract_surface(kept, 2.0)
    assert len(surface.vertices_mm) - len(surface.triangles) / 2 == 2
    assert np.ptp(surface.vertices_mm[:, 0]) > SPACING_MM * (12 + length + 6)
    # Elsewhere the surface is where it was: 8 mm from the row no tube is felt.
    row = np.zeros_like(mask)
    row[middle, middle, begin : begin + length] = True
    far = ndimage.distance_transform_edt(~row) * SPACING_MM > 8
    far &= np.abs(level.distance_mm) < SPACING_MM
    np.testing.assert_allclose(kept.distance_mm[far], level.distance_mm[far], atol=1e-3)


def test_necks_leave_alone_what_is_in_one_piece():
    mask, _ = ball(6)
    level = smooth_level_set(mask, SPACING_MM, 1.5)
    assert with_necks(level, mask, 1.8, 60) is level


def test_balls_joined_to_a_body_far_off_are_balls():
    """Of a ball apart from the body the level is its distance, as far as a distance is of use."""
    body = np.full((40, 30, 30), 50.0, np.float32)
    centre_mm = SPACING_MM * np.array([14.4, 15.2, 24.7])
    level = with_balls(LevelSet(body, SPACING_MM), centre_mm[None], 4.0)
    z, y, x = np.indices(body.shape)
    away_mm = np.linalg.norm(SPACING_MM * np.stack([x, y, z], axis=-1) - centre_mm, axis=-1)
    near = away_mm < 4 + 8 * SPACING_MM
    np.testing.assert_allclose(level.distance_mm[near], away_mm[near] - 4, atol=1e-5)
    assert (level.distance_mm[away_mm > 40] == 50).all()
    assert (body == 50).all()


def test_specks_are_not_joined():
    mask, _ = ball(6)
    mask[2:4, 2:4, 2:4] = True
    level = smooth_level_set(mask, SPACING_MM, 0.5)
    assert ndimage.label(level.distance_mm < 0)[1] == 2
    assert with_necks(level, mask, 1.8, 60) is level
