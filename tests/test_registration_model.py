"""The model that frames are compared with, and the measure of their agreement."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import pyvista as pv
from ellipsoid_heart import PHASES, moving_surfaces, record, start_off
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize

from pipeline.geometry import Float, Grid, MovingSurface, Surface, transform_points
from pipeline.registration import similarity
from pipeline.registration.frames import choose, sample_frames
from pipeline.registration.pose_search import climb, pivot_of
from pipeline.registration.search import Level
from pipeline.registration.similarity import agreement
from pipeline.registration.tissue_map import (
    TissueMap,
    as_seen,
    blurred,
    coverage,
    draw_tissue,
    in_short_steps,
)


@pytest.fixture(scope="module")
def recording():
    return record(seed=1)


@pytest.fixture(scope="module")
def tissue_map():
    return blurred(draw_tissue(moving_surfaces(), 2.5), 1.5)


def beating_ball(phases: Float) -> MovingSurface:
    """A ball whose radius is 24 + 6 cos(2 pi phase)."""
    ball = pv.Icosphere(radius=1.0, nsub=3)
    triangles = np.asarray(ball.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
    radius_mm = 24.0 + 6.0 * np.cos(2 * np.pi * phases)
    return MovingSurface(radius_mm[:, None, None] * np.asarray(ball.points), triangles, phases)


class TestPhasesBetween:
    """Where the model is drawn when the cine has few phases."""

    def test_vertices_follow_the_motion_between_phases(self):
        """A cubic spline strays from a function by 5/384 h^4 times its largest fourth derivative,
        a straight line by h^2/8 times its second: here 0.09 and 0.8 mm."""
        stored = np.arange(6) / 6 + 0.05

        between = in_short_steps({"left_atrium": beating_ball(stored)})["left_atrium"]

        assert np.diff(between.phases, append=between.phases[0] + 1).max() <= 0.06
        radius_mm = np.linalg.norm(between.vertices_mm, axis=2)
        truth_mm = 24.0 + 6.0 * np.cos(2 * np.pi * between.phases)
        strays_mm = 5 / 384 * (2 * np.pi / 6) ** 4 * 6.0
        # Vertices of the icosphere are float32.
        assert np.abs(radius_mm - truth_mm[:, None]).max() < strays_mm + 1e-5

    @pytest.mark.parametrize("count", [2, 17, 25, 40])
    def test_few_steps_and_short_ones_stay_as_they_are(self, count):
        ball = beating_ball(np.arange(count) / count)

        assert in_short_steps({"left_atrium": ball})["left_atrium"] is ball

    def test_a_gap_in_the_phases_is_not_bridged(self):
        """Twenty phases that end at 0.76 of the beat: nobody has seen what follows."""
        ball = beating_ball(np.arange(20) * 0.04)

        assert in_short_steps({"left_atrium": ball})["left_atrium"] is ball

    def test_blood_is_drawn_where_the_wall_is_between_phases(self):
        """The volume where the ball is almost smallest, which no stored phase shows: those beside
        it are 13 % larger."""
        stored = (np.arange(6) + 0.5) / 6

        drawn = draw_tissue(in_short_steps({"left_atrium": beating_ball(stored)}), 2.0)

        index = int(np.argmin(np.abs(drawn.phases - 0.5)))
        radius_mm = 24.0 + 6.0 * np.cos(2 * np.pi * drawn.phases[index])
        volume_mm3 = drawn.share[index, ..., 0].sum() * 2.0**3
        # The spline's 0.09 mm of 18, three times in the volume, and 1 % for facets and nodes.
        assert volume_mm3 == pytest.approx(4 / 3 * np.pi * radius_mm**3, rel=0.025)


class TestCoverage:
    def test_box_with_faces_on_nodes_has_its_exact_volume(self):
        """Every ray meets an edge or a corner somewhere, and is to cross exactly one triangle."""
        box = pv.Box((0.0, 10.0, 0.0, 8.0, 0.0, 6.0)).triangulate()
        triangles = np.asarray(box.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
        surface = Surface(np.asarray(box.points, float), triangles)
        grid = Grid((11, 13, 15), (-2.0, -2.0, -2.0), (1.0, 1.0, 1.0))

        share = coverage(surface, grid)

        assert surface.volume_mm3() == pytest.approx(480.0)
        # Shares are sums of float32 numbers up to 1.
        assert share.sum(dtype=float) == pytest.approx(480.0, rel=1e-5)
        assert share[5, 5, 5] == 1
        assert share[0, 0, 0] == 0

    @given(centre=st.tuples(*[st.floats(-1, 1)] * 3), spacing_mm=st.floats(1.0, 3.0))
    @settings(max_examples=20)
    def test_ball_is_full_inside_empty_outside_and_has_its_volume(self, centre, spacing_mm):
        ball = pv.Icosphere(radius=20.0, center=centre, nsub=4)
        triangles = np.asarray(ball.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
        surface = Surface(np.asarray(ball.points, float), triangles)
        count = int(np.ceil(50 / spacing_mm))
        grid = Grid((count,) * 3, (-25.0,) * 3, (spacing_mm,) * 3)

        share = coverage(surface, grid)

        distance_mm = np.linalg.norm(grid.nodes_mm() - centre, axis=-1) - 20
        # A ray through a node leaves its cell by half a cell at most; a flat facet lies up to
        # 0.1 mm inside the sphere of 20 mm (edges of 3 mm: 3^2 / (8 * 20) = 0.06).
        assert share[distance_mm > spacing_mm].max() < 1e-6
        assert share[distance_mm < -spacing_mm - 0.1].min() > 1 - 1e-6
        # Points of a lattice in a ball: the error grows as the surface's number of nodes to the
        # power 1/2, each off by less than half a cell.
        surface_nodes = 4 * np.pi * (20 / spacing_mm) ** 2
        tolerance = 3 * 0.5 * np.sqrt(surface_nodes) * spacing_mm**3
        assert abs(share.sum(dtype=float) * spacing_mm**3 - surface.volume_mm3()) < tolerance


def test_a_cavity_looks_smaller_by_what_the_beam_hears_of_its_wall():
    """At a flat wall a beam of deviation s hears 1 - F(d / s) of muscle, d inside blood.

    With F the normal distribution and an echo of blood of e, log(1 - F + e) is halfway to log(e)
    where 1 - F = sqrt(e) - e: for e = 0.05 and s = 1 mm, 0.940 mm inside.
    """
    x_mm = np.arange(-8, 8.01, 0.25)
    grid = Grid((9, 9, len(x_mm)), (-8.0, 0.0, 0.0), (0.25, 1.0, 1.0))
    step = np.clip(x_mm / 0.25 + 0.5, 0, 1)
    share = np.zeros((1, 9, 9, len(x_mm), 2), np.float32)
    share[..., 0], share[..., 1] = step, 0.3

    seen = as_seen(TissueMap(share, np.zeros(1), grid)).share

    dark = seen[0, 4, 4, :, 0]
    halfway_mm = np.interp(0.5, dark[:50], x_mm[:50])
    # Linear between nodes 0.25 mm apart, in a curve that bends by 0.2 a square millimetre or less.
    assert halfway_mm == pytest.approx(0.940, abs=0.02)
    assert dark[x_mm < -4].max() == 0
    # 1 - F(4) is 3e-5: beside 0.05, and over log(20), 2e-4 of the way back from blood to muscle.
    assert dark[x_mm == 4] == pytest.approx(1, abs=3e-4)
    np.testing.assert_array_equal(seen[..., 1], share[..., 1])


def with_images(sweep, images):
    return replace(sweep, images=images.astype(np.float32))


def explained_of(sweeps, recording, tissue_map):
    """``(frames,)`` explained share of each sweep at the true pose."""
    samples = [sample_frames([one], recording.phases[:1], 4.0, 1.5, 20.0) for one in sweeps]
    pose = recording.mr_from_tracker
    return [agreement(one, tissue_map, pose).explained for one in samples]


class TestAgreement:
    def test_explained_share_is_that_of_a_least_squares_fit(self, tissue_map, recording):
        """Against a general solver, with the model looked up by a general interpolator."""
        sweep, pose = recording.sweeps[0], recording.mr_from_tracker
        samples = sample_frames([sweep], [np.full(len(sweep.images), PHASES[3])], 4.0, 1.5, 20.0)
        grid = tissue_map.grid
        nodes = transform_points(pose, samples.points_mm.astype(float)) - grid.origin_mm
        nodes = (nodes / grid.spacing_mm).T[::-1]
        model = [map_coordinates(tissue_map.share[3, ..., k], nodes, order=1) for k in (0, 1)]

        found = agreement(samples, tissue_map, pose).explained

        for frame, (first, last) in enumerate(pairwise(samples.first)):
            row = samples.trend_row[frame]
            trend = samples.trend[row : row + last - first].astype(float)
            grey = samples.grey[first:last].astype(float)
            shares = np.column_stack([share[first:last] for share in model])
            shares -= trend @ np.linalg.lstsq(trend, shares)[0]
            fit = shares @ np.linalg.lstsq(shares, grey)[0]
            explained = (fit**2).mean()
            # The ridge, 1e-3 a sample, holds back at most its share of the weakest direction.
            weakest = np.linalg.svd(shares, compute_uv=False)[-1] ** 2 / len(grey)
            held_back = explained * 1e-3 / (weakest + 1e-3)
            rounding = 1e-4
            assert explained - held_back - rounding < found[frame] < explained + rounding

    def test_each_frame_is_compared_on_its_own_however_many_samples_others_have(
        self, tissue_map, recording
    ):
        """Two sweeps, and of every third frame the first samples alone."""
        whole = sample_frames(recording.sweeps, recording.phases, 4.0, 1.5, 20.0)
        counts = np.diff(whole.first)
        counts[::3] = 100
        kept = np.concatenate(
            [start + np.arange(count) for start, count in zip(whole.first, counts, strict=False)]
        )
        samples = replace(
            whole,
            points_mm=whole.points_mm[kept],
            grey=whole.grey[kept],
            first=np.concatenate([[0], np.cumsum(counts)]),
        )
        pose = recording.mr_from_tracker
        together = agreement(samples, tissue_map, pose)
        for frame in range(samples.frames):
            alone = agreement(choose(samples, np.array([frame])), tissue_map, pose)
            np.testing.assert_allclose(together.explained[frame], alone.explained[0], rtol=1e-9)
            np.testing.assert_allclose(together.in_view[frame], alone.in_view[0], rtol=1e-9)
        assert (together.explained[counts > 100] > 0).all()

    def test_agreement_is_best_at_the_true_pose(self, tissue_map, recording):
        samples = sample_frames(recording.sweeps, recording.phases, 4.0, 1.5, 20.0)
        here = agreement(samples, tissue_map, recording.mr_from_tracker)
        for seed in range(6):
            off = start_off(recording, seed, 6, 6)
            assert agreement(samples, tissue_map, off).score < here.score

    @pytest.mark.parametrize(("gain", "level"), [(0.1, 1.0), (10.0, 1.0), (1.0, 100.0)])
    def test_gain_and_level_do_not_matter(self, tissue_map, recording, gain, level):
        """Ranks do not change, but for ties that rounding makes or breaks."""
        sweep = recording.sweeps[0]
        changed = np.where(sweep.images > 0, gain * sweep.images + level, 0)
        before, after = explained_of((sweep, with_images(sweep, changed)), recording, tissue_map)
        np.testing.assert_allclose(after, before, atol=2e-3)

    def test_shading_across_the_sector_matters_little(self, tissue_map, recording):
        """As much as the whole contrast from edge to edge, in half a wave: a column of the trend
        but for its ranks, which are taken before. Without the trend nothing would be left."""
        sweep = recording.sweeps[0]
        shown = sweep.images > 0
        width = sweep.images.shape[2]
        wave = np.cos(np.pi * np.arange(width) / width)
        shading = 2 * sweep.images[shown].std() * wave
        changed = np.where(shown, sweep.images + shading - shading.min() + 1, 0)
        before, after = explained_of((sweep, with_images(sweep, changed)), recording, tissue_map)
        assert after.mean() > 0.8 * before.mean()

    def test_last_phase_flows_into_the_first(self, tissue_map, recording):
        """Half-way between the last stored phase and 1 lies half-way between last and first."""
        sweep, pose = recording.sweeps[0], recording.mr_from_tracker
        between = 1 - 0.5 / len(PHASES)

        def explained(phase: float, tissue: TissueMap) -> Float:
            phases = [np.full(len(sweep.images), phase)]
            return agreement(sample_frames([sweep], phases, 4.0, 1.5, 20.0), tissue, pose).explained

        middle = replace(
            tissue_map,
            share=tissue_map.share[[-1]] / 2 + tissue_map.share[[0]] / 2,
            phases=np.array([0.0]),
        )
        np.testing.assert_allclose(
            explained(between, tissue_map), explained(0.0, middle), atol=1e-5
        )


@pytest.fixture(scope="module")
def pivot():
    return pivot_of(list(moving_surfaces().values()))


@pytest.fixture(scope="module")
def level(recording, tissue_map):
    return Level(sample_frames(recording.sweeps, recording.phases, 4.0, 1.5, 20.0), tissue_map)


class TestExpansion:
    @pytest.mark.parametrize(
        ("seed", "case"), [(0, "as it is"), (1, "bright blood"), (2, "breath")]
    )
    def test_slopes_add_up_to_the_way_the_losses_go(self, recording, level, pivot, seed, case):
        """Their integral along a way of 3 mm in each parameter, by the midpoint rule: straight
        lines between nodes leave kinks in the losses, which differences would stumble over."""
        rng = np.random.default_rng(seed)
        if case == "bright blood":
            level = replace(level, samples=replace(level.samples, grey=-level.samples.grey))
        if case == "breath":
            level = replace(level, shift_mm=rng.normal(0, 3, (level.samples.frames, 3)))
        steps, count = rng.choice([-3.0, 3.0], 6), 150
        pose = start_off(recording, seed, 2, 2)
        first, way = level.losses(pose), np.zeros(level.samples.frames)
        for _ in range(count):
            middle = level.expansion(pivot.move(pose, steps / (2 * count)), pivot)
            way += middle.slopes @ steps / count
            pose = pivot.move(pose, steps / count)

        last = level.losses(pose)

        # Over a step of 0.02 mm a kink that turns the slope by itself is off by half of it in one
        # of a hundred steps; numbers are float32.
        np.testing.assert_allclose(way, last - first, atol=0.01 * np.abs(last - first).max())

    def test_losses_are_those_of_the_agreement(self, recording, level, pivot):
        pose = start_off(recording, 1, 3, 3)
        np.testing.assert_allclose(level.expansion(pose, pivot).losses, level.losses(pose))

    @pytest.mark.parametrize("case", ["as it is", "breath"])
    def test_frames_count_alike_alone_and_shared_among_threads(
        self, monkeypatch, recording, level, pivot, case
    ):
        if case == "breath":
            rng = np.random.default_rng(3)
            level = replace(level, shift_mm=rng.normal(0, 3, (level.samples.frames, 3)))
        pose = start_off(recording, 4, 3, 3)
        each = [level.only(np.array([k])) for k in range(level.samples.frames)]
        alone = [one.expansion(pose, pivot) for one in each]
        monkeypatch.setattr(similarity, "_SAMPLES_A_THREAD", 1)
        monkeypatch.setattr(similarity, "_THREADS", 3)

        shared = level.expansion(pose, pivot)

        np.testing.assert_array_equal(shared.losses, np.concatenate([o.losses for o in alone]))
        np.testing.assert_array_equal(shared.slopes, np.concatenate([o.slopes for o in alone]))
        np.testing.assert_allclose(shared.bending, sum(one.bending for one in alone), rtol=1e-9)


class TestClimb:
    def test_it_ends_in_one_place_wherever_it_begins(self, recording, level, pivot):
        ends = [climb(level, start_off(recording, seed, 5, 5), pivot) for seed in range(5)]
        away = [pivot.distance(end, ends[0]) for end in ends]
        # The last step is at most 0.02 mm in each of six parameters, and Gauss and Newton's steps
        # shrink by half or better each time: two ends lie twice that apart at most.
        assert max(shift_mm for shift_mm, _ in away) < 2 * 0.02 * np.sqrt(3)

    @pytest.mark.slow
    def test_it_goes_as_high_as_a_search_without_slopes(self, recording, level, pivot):
        start = start_off(recording, 2, 2, 2)
        found = minimize(
            lambda step_mm: -level.score(pivot.move(start, step_mm)),
            np.zeros(6),
            method="Powell",
            options={"xtol": 1e-3, "ftol": 1e-7},
        )
        assert level.score(climb(level, start, pivot)) > -found.fun - 1e-4

    def test_frames_that_see_nothing_leave_the_pose_alone(self, recording, level, pivot):
        far = recording.mr_from_tracker.copy()
        far[:3, 3] += 500
        np.testing.assert_array_equal(climb(level, far, pivot), far)
