"""Whether parts of a recording agree on a pose: parabolas, counting, and a heart that is moved."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from ellipsoid_heart import CENTRE_MM, moving_surfaces, record
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.registration.parts import gain_apart, parts_of
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.search import prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.similarity import Expansion

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
    assert gain_apart(level, np.zeros(6), PIVOT, sweep) == pytest.approx(expected, rel=0.02)


def test_scatter_between_frames_is_no_gain():
    """The mean over draws of frames that differ by chance alone is 0, within its own error."""
    rng = np.random.default_rng(8)
    sweep = np.repeat([0, 1], 24)
    gains = []
    for _ in range(400):
        level = Bowls(0.3 * rng.normal(size=(48, 6)), depth=3.0)
        gains.append(gain_apart(level, np.zeros(6), PIVOT, sweep))
    assert abs(np.mean(gains)) < 3 * np.std(gains) / np.sqrt(len(gains))
    assert np.std(gains) > 0


def test_nothing_to_compare_gains_nothing():
    level = Bowls(np.eye(6)[np.zeros(11, int)])
    # Eleven frames of one sweep are no two parts of six.
    assert gain_apart(level, np.zeros(6), PIVOT, np.zeros(11, int)) == 0
    hopeless = Bowls(np.repeat([[9.0], [-9.0]], 20, axis=0) * np.ones(6))
    assert gain_apart(hopeless, np.zeros(6), PIVOT, np.repeat([0, 1], 20)) == 0


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
    sweep = level.samples.sweep([len(one.images) for one in sweeps])
    return gain_apart(level, pose, search.pivot, sweep)


def shifted(x_mm):
    motion = np.eye(4)
    motion[0, 3] = x_mm
    return motion


def turned_about(point_mm, degrees):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    motion[:3, 3] = point_mm - motion[:3, :3] @ point_mm
    return motion


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
