"""A heart that is larger or smaller than the frames' own is told of, one that is not is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ellipsoid_heart import CENTRE_MM, TILT, moving_surfaces, record, start_off

from pipeline.geometry import transform_points
from pipeline.imaging.cine import Cine
from pipeline.registration.pose_search import Pivot
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import AS_IT_IS, Size, fitting_size, planes_of
from pipeline.registration.space import find

QUICK = RegisterSettings(grid_mm=3.0, sample_spacing_mm=6.0, candidates=80, starts=2, max_frames=20)
PIVOT = Pivot(np.array([10.0, -20.0, 30.0]), 50.0)
STACK = np.eye(4)
STACK[:3, :3] = TILT * [1.5, 2.0, 8.0]
SLICES = Cine(np.zeros((1, 1, 1, 1), np.float32), STACK, np.zeros(1), 0.8)


@pytest.fixture(scope="module")
def recording():
    return record(seed=1)


def stretched(factors):
    """The ellipsoids' surfaces, larger by these factors along their own axes."""
    linear = TILT @ np.diag(factors) @ TILT.T
    return {
        name: replace(one, vertices_mm=(one.vertices_mm - CENTRE_MM) @ linear + CENTRE_MM)
        for name, one in moving_surfaces().items()
    }


def found_with(recording, factors):
    start = start_off(recording, 100, 8, 8)
    return find(recording.sweeps, recording.phases, stretched(factors), start, QUICK)


@pytest.fixture(scope="module")
def right(recording):
    return found_with(recording, [1, 1, 1])


def test_a_heart_of_its_own_size_is_not_in_doubt(right):
    assert not right.size.in_doubt
    assert right.size.error_mm == 0
    assert "better with a heart" not in right.reason


@pytest.mark.parametrize(
    ("factor", "way"), [(0.93, "larger"), pytest.param(1.08, "smaller", marks=pytest.mark.slow)]
)
def test_a_wrong_size_is_in_doubt_and_expected_as_an_error(recording, right, factor, way):
    wrong = found_with(recording, [factor] * 3)
    assert wrong.size.in_doubt
    # In steps of 4 %, of which the nearest is meant.
    assert (1 + wrong.size.larger) * factor == pytest.approx(1, abs=0.035)
    assert wrong.verdict != "good"
    assert f"{abs(wrong.size.larger):.0%} {way} than the MR's: look at" in wrong.reason
    points = np.concatenate([one.vertices_mm[0] for one in moving_surfaces().values()])
    tracker = transform_points(np.linalg.inv(recording.mr_from_tracker), points)
    shown = np.concatenate([one.vertices_mm[0] for one in stretched([factor] * 3).values()])
    error_mm = np.linalg.norm(transform_points(wrong.mr_from_tracker, tracker) - shown, axis=1)
    rms_mm = np.sqrt((error_mm**2).mean())
    assert right.expected_mm < 0.7 * rms_mm < 1.4 * wrong.expected_mm


class Bowl:
    """Frames that agree best with a model larger by ``size`` in the planes of `SLICES`."""

    def __init__(self, size, planes, best=1.0):
        self.size, self.planes, self.best = size, planes, best
        self.asked = []

    def score(self, pose):
        """``best`` at the right size, less beside it."""
        self.asked.append(pose)
        wanted = np.eye(3) + (1 / (1 + self.size) - 1) * self.planes
        return self.best - float(((pose[:3, :3] - wanted) ** 2).sum())


@pytest.mark.parametrize(
    ("size", "found"), [(0.0, 0.0), (0.01, 0.0), (0.05, 0.04), (-0.07, -0.08), (0.3, 0.12)]
)
def test_steps_go_on_while_they_help(monkeypatch, size, found):
    planes = planes_of(SLICES)
    monkeypatch.setattr("pipeline.registration.size.climb", lambda level, pose, *_: pose)
    bowl = Bowl(size, planes)
    best = fitting_size(bowl, np.eye(4), PIVOT, planes)
    assert best.larger == pytest.approx(found)
    assert (best == AS_IT_IS) == (found == 0)
    shares = [np.trace(pose[:3, :3] - np.eye(3)) / 2 for pose in bowl.asked[1:4]]
    # By 4 %, 8 % and 12 % of the model as it is, until that does not help.
    wanted = [1 / (1 + larger) - 1 for larger in (0.04, 0.08, 0.12)]
    np.testing.assert_allclose(shares[:1], wanted[:1])
    assert size < 0.1 or shares == pytest.approx(wanted)
    for pose in bowl.asked:
        np.testing.assert_allclose(
            transform_points(pose, PIVOT.centre_mm[None])[0], PIVOT.centre_mm
        )


def test_the_error_of_a_size_moves_the_heart_as_far_as_the_stretch_does(monkeypatch):
    planes = planes_of(SLICES)
    monkeypatch.setattr("pipeline.registration.size.climb", lambda level, pose, *_: pose)
    best = fitting_size(Bowl(0.3, planes, best=0.2), np.eye(4), PIVOT, planes)
    assert best.in_doubt
    moved_mm = np.linalg.norm(best.larger * PIVOT.lever_mm * planes, axis=0)
    # Along three axes, and about the two that a point does not lie on.
    assert best.error_mm * np.sqrt(5) == pytest.approx(np.sqrt((moved_mm**2).mean()))


def test_frames_that_agree_with_nothing_tell_no_size(monkeypatch):
    planes = planes_of(SLICES)
    monkeypatch.setattr("pipeline.registration.size.climb", lambda level, pose, *_: pose)
    assert fitting_size(Bowl(0.3, planes, best=0.0), np.eye(4), PIVOT, planes) == AS_IT_IS


def test_planes_are_those_of_the_slices():
    across, up, through = TILT.T
    planes = planes_of(SLICES)
    np.testing.assert_allclose(planes @ np.stack([across, up], 1), np.stack([across, up], 1))
    np.testing.assert_allclose(planes @ through, 0, atol=1e-12)
    np.testing.assert_array_equal(planes_of(None), np.eye(3))


def test_little_better_is_no_doubt():
    assert not Size(0.04, 0.029).in_doubt
    assert Size(0.04, 0.031).in_doubt
