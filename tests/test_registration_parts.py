"""Whether parts of a recording agree on a pose: parabolas, counting, and a heart that is moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from ellipsoid_heart import CENTRE_MM, moving_surfaces, record, target_error_mm
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.registration.dissent import NONE, dissent
from pipeline.registration.parts import parts_apart, parts_of
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.search import prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.similarity import Expansion
from pipeline.registration.space import find
from pipeline.registration.verdict import APART

PIVOT = Pivot(np.zeros(3), 40.0)
BENDING = np.diag([2.0, 3.0, 1.0, 1.5, 0.5, 4.0]) + 0.2


@dataclass(frozen=True)
class Bowls:
    """Frames whose losses are parabolas, each with an optimum of its own; poses are steps."""

    optima: np.ndarray
    depth: float = 1.0

    def only(self, frames):
        return replace(self, optima=self.optima[frames])

    def losses(self, step):
        off = step - self.optima
        return 0.5 * np.einsum("fi,ij,fj->f", off, BENDING, off) - self.depth

    def expansion(self, step, _pivot):
        slopes = (step - self.optima) @ BENDING
        return Expansion(self.losses(step), slopes, len(self.optima) * BENDING)


def test_the_gain_of_parabolas_is_how_deep_their_own_optima_lie():
    """Parts of one mind each, their optima a millimetre to either side along x."""
    sweep = np.repeat([0, 1], 20)
    optima = np.where(sweep[:, None] == 0, 1, -1) * np.eye(6)[0]
    level = Bowls(optima, depth=3.0)
    expected = 0.5 * BENDING[0, 0] / (3.0 - 0.5 * BENDING[0, 0])
    # What holds a part where its frames do not takes a hundredth of the mean curvature's gain.
    assert parts_apart(level, np.zeros(6), PIVOT, sweep).gain == pytest.approx(expected, rel=0.02)


def test_scatter_between_frames_is_no_gain():
    """The mean over draws of frames that differ by chance alone is 0, within its own error."""
    rng = np.random.default_rng(8)
    sweep = np.repeat([0, 1], 24)
    gains = []
    for _ in range(400):
        level = Bowls(0.3 * rng.normal(size=(48, 6)), depth=3.0)
        gains.append(parts_apart(level, np.zeros(6), PIVOT, sweep).gain)
    assert abs(np.mean(gains)) < 3 * np.std(gains) / np.sqrt(len(gains))
    assert np.std(gains) > 0


def test_spread_of_parts_is_how_far_their_poses_lie_from_the_common_one():
    """Two parts a step either way of the common pose, which holds them a little."""
    step = np.array([2.0, 0, 0, 0, -1.0, 0])
    level = Bowls(np.repeat([step, -step], 20, axis=0), depth=9.0)
    found = parts_apart(level, np.zeros(6), PIVOT, np.repeat([0, 1], 20)).spread_mm2
    held = np.linalg.solve(BENDING + 0.1 * np.trace(BENDING) / 6 * np.eye(6), BENDING) @ step
    np.testing.assert_allclose(found, np.outer(held, held), atol=1e-9)
    # Held a little everywhere, a part goes most of its way.
    assert 0.6 < np.linalg.norm(held) / np.linalg.norm(step) < 1


def test_frames_that_differ_by_chance_alone_show_little_spread():
    rng = np.random.default_rng(8)
    sweep = np.repeat([0, 1], 24)
    found = [
        np.trace(
            parts_apart(
                Bowls(0.3 * rng.normal(size=(48, 6)), depth=3.0), np.zeros(6), PIVOT, sweep
            ).spread_mm2
        )
        for _ in range(100)
    ]
    # The mean of a part's twelve frames varies by 0.3**2 / 12 mm2 in each of six parameters: with
    # that taken off less is left, and never less than nothing.
    assert min(found) >= 0
    assert np.mean(found) < 6 * 0.3**2 / 12


def test_nothing_to_compare_gains_nothing():
    level = Bowls(np.eye(6)[np.zeros(11, int)])
    # Eleven frames of one sweep are no two parts of six.
    assert parts_apart(level, np.zeros(6), PIVOT, np.zeros(11, int)).gain == 0
    hopeless = Bowls(np.repeat([[9.0], [-9.0]], 20, axis=0) * np.ones(6))
    assert parts_apart(hopeless, np.zeros(6), PIVOT, np.repeat([0, 1], 20)).gain == 0


@given(sizes=st.lists(st.integers(0, 60), max_size=7))
def test_parts_are_stretches_of_one_sweep(sizes):
    sweep = np.repeat(np.arange(len(sizes)), sizes)
    parts = list(parts_of(sweep))
    told = np.concatenate([*parts, np.zeros(0, int)])
    assert len(np.unique(told)) == len(told)
    for part in parts:
        assert len(part) >= 6
        assert len(np.unique(sweep[part])) == 1
        assert (np.diff(part) == 1).all()
    assert all(one[-1] < other[0] for one, other in pairwise(parts))
    # Six frames are enough for a part; four parts are made where each sweep could be cut in four.
    assert len(told) == sum(size for size in sizes if size >= 6)
    shown = [size for size in sizes if size]
    if shown and min(shown) >= 24:
        assert len(parts) >= 4


def moved(recording, motion):
    """The recording, the tracker's reference at ``motion(share)`` after that share of it."""
    frames = sum(len(sweep.images) for sweep in recording.sweeps)
    sweeps, begun = [], 0
    for sweep in recording.sweeps:
        places = (begun + np.arange(len(sweep.images))) / (frames - 1)
        begun += len(sweep.images)
        motions = np.stack([motion(place) for place in places])
        sweeps.append(replace(sweep, tracker_from_image=motions @ sweep.tracker_from_image))
    return sweeps


def gain_of(recording, motion):
    """Where the search ends for these sweeps, from the truth, and what parts gain there."""
    settings = RegisterSettings(reading="grey")
    sweeps = moved(recording, motion)
    search = prepare_search(recording.phases, moving_surfaces(), None, settings)
    level = search.fine_level(sweeps)
    pose = climb(level, recording.mr_from_tracker, search.pivot)
    return parts_apart(level, pose, search.pivot, level.samples.sweep).gain


def shifted(x_mm):
    motion = np.eye(4)
    motion[0, 3] = x_mm
    return motion


def turned_about(point_mm, degrees):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    motion[:3, 3] = point_mm - motion[:3, :3] @ point_mm
    return motion


@pytest.mark.slow
def test_a_patient_who_moves_is_told_from_one_who_lies_still():
    recording = record(seed=0, frames=30)
    inverse = np.linalg.inv(recording.mr_from_tracker)
    heart_mm = inverse[:3, :3] @ CENTRE_MM + inverse[:3, 3]
    still = gain_of(recording, lambda _: np.eye(4))
    for motion in (
        lambda share: shifted(8 * share),
        lambda share: shifted(6 * (share > 0.5)),
        lambda share: turned_about(heart_mm, 12 * share),
    ):
        assert gain_of(recording, motion) > max(0.06, 1.5 * still)
    assert still < 0.06


def test_a_patient_who_moved_is_expected_as_an_error():
    """By 6 mm between the sweeps: the common pose is off before the move or after it, or both.

    It is held as well as any: its frames alone, and the surfaces' own error, expect what they do
    of a patient who lies still.
    """
    recording, surfaces = record(seed=0, frames=30), moving_surfaces()
    settings = RegisterSettings(
        reading="grey", candidates=1, starts=1, grid_mm=3.0, sample_spacing_mm=6.0
    )
    before = recording.mr_from_tracker
    still, apart = (
        find(moved(recording, motion), recording.phases, surfaces, before, settings)
        for motion in (lambda _: np.eye(4), lambda share: shifted(6 * (share > 0.5)))
    )
    points_mm = surfaces["lv_endocardium"].vertices_mm[0]
    after = before @ np.linalg.inv(shifted(6))
    off_mm = [
        target_error_mm(apart.mr_from_tracker, truth, points_mm).mean() for truth in (before, after)
    ]
    assert min(off_mm) > 2
    assert still.apart < APART < apart.apart
    assert min(off_mm) < apart.expected_mm < max(off_mm)
    assert apart.expected_mm > 1.5 * still.expected_mm
    assert apart.chance_under_2_mm < 0.5 < still.chance_under_2_mm
    assert "better with poses of their own" in apart.reason


@pytest.mark.parametrize("seen", ["heart", "noise"])
def test_frames_that_contradict_with_one_voice_leave_the_pose_open(seen):
    """The second sweep was taken after the patient moved by 12 mm, or shows nothing at all."""
    recording = record(seed=0, frames=24)
    sweeps = moved(recording, lambda share: shifted(12 * (share > 0.5)))
    if seen == "noise":
        noise = np.random.default_rng(1).normal(100, 30, sweeps[1].images.shape)
        shown = np.where(sweeps[1].images > 0, np.clip(noise, 1, 255), 0).astype(np.float32)
        sweeps[1] = replace(sweeps[1], images=shown)
    settings = RegisterSettings(
        reading="grey", grid_mm=3.0, sample_spacing_mm=6.0, candidates=100, starts=4
    )
    search = prepare_search(recording.phases, moving_surfaces(), None, settings)
    level = search.fine_level(sweeps)
    first = level.samples.sweep == 0
    pose = recording.mr_from_tracker
    found = dissent(search, sweeps, level, pose, 1 - first.astype(int), first, ~first)
    if seen == "noise":
        assert found is NONE
        return
    after = pose @ np.linalg.inv(shifted(12))
    step = search.pivot.step_between(pose, after)
    np.testing.assert_allclose(search.pivot.move(pose, step), after, atol=1e-9)
    # Held a little everywhere, they go most of the way, and are half of all frames.
    assert 0.7 < found.away_mm / np.linalg.norm(step[:3]) < 1.1
    most = np.linalg.eigh(found.spread_mm2)
    assert 0.7**2 < most[0][-1] / (np.linalg.norm(step) ** 2 / 2) < 1.1**2
    assert abs(most[1][:, -1] @ step) > 0.95 * np.linalg.norm(step)


def test_a_few_frames_have_no_pose_of_their_own():
    level = Bowls(np.eye(6)[np.zeros(20, int)])
    few = np.arange(20) < 9
    sweep = np.zeros(20, int)
    assert dissent(None, [], level, np.zeros(6), sweep, ~few, few) is NONE
    assert dissent(None, [], level, np.zeros(6), sweep, np.zeros(20, bool), ~few) is NONE


def test_ten_frames_that_hardly_turn_are_no_contradiction():
    """They were not moved, and hold no six parameters: where they would slide is held."""
    recording = record(seed=0, frames=40)
    settings = RegisterSettings(
        reading="grey", grid_mm=3.0, sample_spacing_mm=6.0, candidates=100, starts=4
    )
    search = prepare_search(recording.phases, moving_surfaces(), None, settings)
    level, ten = search.fine_level(recording.sweeps), np.arange(80) >= 70
    sweep = np.repeat([0, 1], 40)
    pose = recording.mr_from_tracker
    found = dissent(search, recording.sweeps, level, pose, sweep, ~ten, ten)
    # Of eight times as many for the pose they make it unsure by less than a millimetre or two.
    assert np.sqrt(np.trace(found.spread_mm2)) < 1.5


@pytest.mark.slow
def test_a_bump_is_told_and_leaves_the_pose_of_use():
    """Twelve frames of 80 were taken while the patient lay 9 mm beside: they are told, with where
    they lie, and the pose by the others is right, and expected so within what they leave open."""
    recording, surfaces = record(seed=0, frames=40), moving_surfaces()
    sweeps = moved(recording, lambda share: shifted(9 * (share > 67.5 / 79)))
    settings = RegisterSettings(
        reading="grey", grid_mm=3.0, sample_spacing_mm=6.0, candidates=60, starts=4
    )
    truth = recording.mr_from_tracker
    found = find(sweeps, recording.phases, surfaces, truth, settings)
    points_mm = surfaces["lv_endocardium"].vertices_mm[0]
    off_mm = target_error_mm(found.mr_from_tracker, truth, points_mm).mean()
    assert found.verdict == "doubtful"
    assert "frames in a row of sweep 2 show the heart" in found.reason
    assert "and agree on a place" in found.reason
    # Twelve in eighty, held a little: the rest alone expect less than that.
    least_mm = 0.7 * 9 * np.sqrt(12 / 80)
    assert off_mm < 1 < least_mm < found.expected_mm < settings.worst_tre_mm
