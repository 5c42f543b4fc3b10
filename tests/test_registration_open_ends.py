"""Stacks that end inside a chamber, or below one: what lies beyond is neither blood nor tissue."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from ellipsoid_heart import (
    CENTRE_MM,
    PHASES,
    TILT,
    moving_surfaces,
    record,
)
from scipy.ndimage import map_coordinates
from scipy.optimize import lsq_linear

from pipeline.geometry import MovingSurface, transform_points
from pipeline.imaging.cine import Cine
from pipeline.registration.frames import sample_frames
from pipeline.registration.open_ends import CHAMBERS, open_ends, open_lids
from pipeline.registration.pose_search import climb, pivot_of
from pipeline.registration.search import prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.similarity import agreement, expansion
from pipeline.registration.space import find
from pipeline.registration.tissue_map import blurred, draw_tissue

LAST_MM = 68.0
"""Height of the last slice's middle over the mitral plane: half of the left atrium lies beyond."""
STEP_MM = 8.0
GREY = RegisterSettings(
    reading="grey", candidates=1, starts=1, capture_mm=10, capture_deg=10, grid_mm=3.0
)


def height_mm(points_mm):
    return (points_mm - CENTRE_MM) @ TILT[:, 2]


def cut(surfaces, last_mm=LAST_MM):
    """As found in a stack: flat half a step beyond the last slice."""
    lid_mm = last_mm + STEP_MM / 2

    def flat(moving):
        beyond = np.maximum(height_mm(moving.vertices_mm) - lid_mm, 0)
        vertices_mm = moving.vertices_mm - beyond[..., None] * TILT[:, 2]
        return MovingSurface(vertices_mm, moving.triangles, moving.phases)

    return {name: flat(one) for name, one in surfaces.items()}


def ventricles(surfaces, last_mm=26.0):
    """Without atria and aorta, as of a stack that ends at the valves; a wall of 10 mm."""
    inner = surfaces["lv_endocardium"]
    middle_mm = inner.vertices_mm.mean(axis=1, keepdims=True)
    away_mm = inner.vertices_mm - middle_mm
    thick = 1 + 10 / np.linalg.norm(away_mm, axis=-1, keepdims=True)
    outer = MovingSurface(middle_mm + thick * away_mm, inner.triangles, inner.phases)
    right = surfaces["rv_endocardium"]
    return cut({"lv_endocardium": inner, "rv_endocardium": right, "epicardium": outer}, last_mm)


def stack(last_mm=LAST_MM, upside_down=False):
    """Short-axis slices from far below the tip to ``last_mm``; nothing asks what they show."""
    slices = 20
    frame = np.eye(4)
    frame[:3, :3] = TILT * [8.0, 8.0, STEP_MM]
    first_mm = last_mm - (slices - 1) * STEP_MM
    frame[:3, 3] = CENTRE_MM + TILT @ np.array([-100, -100, first_mm])
    if upside_down:
        frame[:3, 3] += (slices - 1) * frame[:3, 2]
        frame[:3, 2] *= -1
    intensity = np.ones((len(PHASES), slices, 25, 25), np.float32)
    return Cine(intensity, frame, PHASES, 0.8)


@pytest.fixture(scope="module")
def whole():
    return moving_surfaces()


@pytest.fixture(scope="module")
def recording():
    return record(seed=4, frames=30)


@pytest.mark.parametrize("upside_down", [False, True])
def test_the_end_that_cuts_chambers_is_found_with_the_area_of_their_cuts(whole, upside_down):
    (end,) = open_ends(cut(whole), stack(upside_down=upside_down))
    assert end.chambers == ("left_atrium", "right_atrium")
    np.testing.assert_allclose(end.outwards, TILT[:, 2], atol=1e-12)
    # Ellipses of the plane's cut through both at each phase (`ellipsoid_heart.ellipsoids`).
    pulse = np.exp(-(((PHASES - 0.38) / 0.16) ** 2))
    squeeze, base = 1 - 0.22 * pulse, 8 * pulse
    for name, wide, deep, middle in (("left_atrium", 22, 20, 70), ("right_atrium", 20, 22, 62)):
        tall = 22 if name == "left_atrium" else 20
        share = 1 - ((LAST_MM - middle + base) / tall) ** 2
        area_mm2 = np.pi * wide * deep / squeeze**2 * np.maximum(share, 0)
        # Triangles of 2 mm step over the plane's edge.
        assert end.cut_mm2(whole[name]) == pytest.approx(area_mm2.mean(), rel=0.06)


def test_a_stack_that_holds_the_chambers_has_no_open_end(whole):
    assert open_ends(whole, stack(last_mm=110.0)) == []
    without = draw_tissue(whole, 2.5)
    held = draw_tissue(whole, 2.5, stack(last_mm=110.0), muscle=False)
    np.testing.assert_array_equal(without.share, held.share)
    assert held.share.shape[-1] == 2


def test_beyond_the_end_blood_is_carried_on_and_below_all_is_as_it_was(whole):
    surfaces = cut(whole)
    drawn = draw_tissue(surfaces, 2.5, stack(), muscle=False)
    z, y, x = np.meshgrid(*(np.arange(n) for n in drawn.grid.shape), indexing="ij")
    places_mm = np.stack([x, y, z], axis=-1) * 2.5 + drawn.grid.origin_mm
    above_mm = height_mm(places_mm) - LAST_MM
    blood, wall, carried = (drawn.share[0, ..., part] for part in range(3))
    assert not blood[above_mm > 0].any()
    assert not wall[above_mm > 0].any()
    assert not carried[above_mm <= 0].any()
    assert carried[(above_mm > 0) & (above_mm < 5)].max() > 0.95
    assert not carried[above_mm > 24].any()
    # Well below, all is as the whole heart is drawn without a stack, on nodes that lie elsewhere.
    other = draw_tissue(whole, 2.5)
    low = above_mm < -12
    at = ((places_mm[low] - other.grid.origin_mm) / 2.5)[:, ::-1].T
    there = map_coordinates(other.share[0, ..., 0], at, order=1)
    assert np.abs(there - blood[low]).mean() < 0.01


def test_explained_share_is_that_of_a_bounded_least_squares_fit(whole, recording):
    """Against a general solver, blood and what is carried on dark; walls are free."""
    tissue = blurred(draw_tissue(cut(whole, 56.0), 2.5, stack(56.0), muscle=False), 1.5)
    sweep, pose = recording.sweeps[0], recording.mr_from_tracker
    samples = sample_frames([sweep], [np.full(len(sweep.images), PHASES[3])], 4.0, 1.5, 20.0)
    nodes = transform_points(pose, samples.points_mm.astype(float)) - tissue.grid.origin_mm
    nodes = (nodes / tissue.grid.spacing_mm).T[::-1]
    model = [map_coordinates(tissue.share[3, ..., k], nodes, order=1) for k in range(3)]
    found, of_it = agreement(samples, tissue, pose).explained, []
    for frame, (first, last) in enumerate(pairwise(samples.first)):
        row = samples.trend_row[frame]
        trend = samples.trend[row : row + last - first].astype(float)
        grey = samples.grey[first:last].astype(float)
        shares = np.column_stack([share[first:last] for share in model])
        shares -= trend @ np.linalg.lstsq(trend, shares)[0]
        # The ridge, 1e-3 a sample, as rows of its own.
        ridged = np.vstack([shares, np.sqrt(1e-3 * len(grey)) * np.eye(3)])
        best = lsq_linear(ridged, np.append(grey, [0, 0, 0]), ([-np.inf] * 3, [0, np.inf, 0])).x
        if best[0] < -1e-6:
            assert found[frame] == pytest.approx(best @ (shares.T @ grey) / len(grey), abs=2e-4)
            of_it.append(best[2] < -1e-6)
    assert sum(of_it) >= 5


def test_slopes_are_those_of_the_losses_with_blood_carried_on(whole, recording):
    """Central differences of the losses about a pose that is off, frame by frame."""
    tissue = blurred(draw_tissue(cut(whole), 2.5, stack(), muscle=False), 3.0)
    samples = sample_frames(recording.sweeps, recording.phases, 4.0, 3.0, 20.0)
    pivot = pivot_of([whole[name] for name in CHAMBERS])
    pose = pivot.move(recording.mr_from_tracker, np.array([1.0, -2, 1.5, 1, -1, 2]))
    found = expansion(samples, tissue, pose, pivot.centre_mm, pivot.lever_mm)

    def losses(step):
        return np.log1p(-agreement(samples, tissue, pivot.move(pose, step)).explained)

    np.testing.assert_allclose(found.losses, losses(np.zeros(6)), atol=1e-12)
    step_mm = 1e-3
    measured = np.stack(
        [(losses(step_mm * one) - losses(-step_mm * one)) / (2 * step_mm) for one in np.eye(6)],
        axis=1,
    )
    # Trilinear: where a sample crosses a node's cell within the step the slope itself jumps.
    assert np.abs(found.slopes - measured).max() < 0.02 * np.abs(measured).max()


def test_a_model_cut_off_draws_the_pose_along_unless_the_stack_says_where_it_ends(whole):
    """Beside what the whole model finds, by two recordings."""
    beside_mm = []
    for seed in (4, 5):
        made = record(seed, frames=30)

        def found_mm(surfaces, cine, made=made):
            search = prepare_search(made.phases, surfaces, made.mr_from_tracker, GREY, cine)
            pose = climb(search.fine_level(made.sweeps), made.mr_from_tracker, search.pivot)
            return transform_points(pose @ np.linalg.inv(made.mr_from_tracker), CENTRE_MM)

        best = found_mm(whole, None)
        blind, told = (found_mm(cut(whole, 60.0), cine) for cine in (None, stack(60.0)))
        beside_mm.append(
            np.abs([height_mm(blind) - height_mm(best), height_mm(told) - height_mm(best)])
        )
    blind_mm, told_mm = np.mean(beside_mm, axis=0)
    assert told_mm < 0.5 * blind_mm
    assert blind_mm > 0.2


def test_a_result_by_a_stack_that_ends_in_chambers_is_less_sure_and_says_so(whole, recording):
    quick = GREY.model_copy(update={"max_frames": 12, "good_tre_mm": 0.1})
    given = recording.sweeps, recording.phases, cut(whole), recording.mr_from_tracker, quick
    blind, told = find(*given), find(*given, cine=stack())
    assert told.expected_mm > 1.1 * blind.expected_mm
    assert "images end inside left_atrium, right_atrium" in told.reason
    assert "images end" not in blind.reason


def test_a_ventricle_without_its_atrium_is_open_above_its_lid(whole):
    surfaces = ventricles(whole)
    left, right = open_lids(surfaces)
    assert [left.atrium, right.atrium] == ["left_atrium", "right_atrium"]
    assert left.outwards @ TILT[:, 2] > 0.999
    drawn = draw_tissue(surfaces, 2.5)
    z, y, x = np.meshgrid(*(np.arange(n) for n in drawn.grid.shape), indexing="ij")
    local = (np.stack([x, y, z], axis=-1) * 2.5 + drawn.grid.origin_mm - CENTRE_MM) @ TILT
    blood, wall, carried = (drawn.share[0, ..., part] for part in range(3))
    # The lid lies 30 mm above the middle, where the cavity's radius is 24 sqrt(1 - (30 / 42)^2).
    above_mm = local[..., 2] - 30
    axis = np.hypot(local[..., 0], local[..., 1]) < 24 * np.sqrt(1 - (30 / 42) ** 2) - 4
    np.testing.assert_allclose(carried[axis & (above_mm > 2.5) & (above_mm < 9)], 1, atol=0.01)
    assert carried[axis & (above_mm > 27)].max() < 1e-6
    assert carried[above_mm < -8].max() < 1e-6
    assert wall[axis & (np.abs(above_mm) < 6)].max() < 0.1
    beside = (np.abs(local[..., 2]) < 20) & (blood > 0.3) & (blood < 0.7)
    assert wall[beside].min() > 0.5


@pytest.mark.parametrize("given", ["left_atrium", "right_atrium"])
def test_a_ventricle_with_its_atrium_is_not_open(whole, given):
    (lid,) = open_lids(ventricles(whole) | {given: whole[given]})
    assert lid.atrium == {"left_atrium": "right_atrium", "right_atrium": "left_atrium"}[given]


def test_a_ventricle_that_the_stack_cuts_is_open_at_the_end_of_the_stack_alone(whole):
    surfaces = ventricles(whole)
    ends = open_ends(surfaces, stack(last_mm=20.0))
    assert [end.chambers for end in ends] == [("lv_endocardium", "rv_endocardium")]
    assert open_lids(surfaces, ends) == []


def test_without_a_lid_at_the_valves_nothing_is_open(whole):
    """A whole ellipsoid within another tells no way; nor does a cavity without muscle."""
    surfaces = ventricles(whole, last_mm=110.0)
    assert open_lids(surfaces) == []
    del surfaces["epicardium"]
    assert draw_tissue(surfaces, 2.5).share.shape[-1] == 2


@pytest.mark.slow
def test_atria_that_a_model_lacks_do_not_draw_the_pose_along(whole):
    """Beside what the whole model finds; blind without the muscle that tells where the lid is."""
    surfaces = ventricles(whole, last_mm=14.0)
    blood = {name: one for name, one in surfaces.items() if name != "epicardium"}
    beside_mm = []
    for seed in (4, 5):
        made = record(seed, frames=30)

        def found_mm(model, made=made):
            search = prepare_search(made.phases, model, made.mr_from_tracker, GREY)
            pose = climb(search.fine_level(made.sweeps), made.mr_from_tracker, search.pivot)
            return transform_points(pose @ np.linalg.inv(made.mr_from_tracker), CENTRE_MM)

        best = height_mm(found_mm(whole))
        beside_mm.append([abs(height_mm(found_mm(one)) - best) for one in (blood, surfaces)])
    blind_mm, told_mm = np.mean(beside_mm, axis=0)
    assert told_mm < 0.4 * blind_mm
    assert blind_mm > 0.5
