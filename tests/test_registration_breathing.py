"""Displacement of the heart with breathing, frame by frame, from the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ellipsoid_heart import moving_surfaces, record, target_error_mm

from pipeline.registration import space
from pipeline.registration.breathing import (
    AXIS,
    is_mostly_inspired,
    likeliest_way_mm,
    rest_error_mm,
)
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.space import find

QUICK = RegisterSettings(grid_mm=3.0, sample_spacing_mm=6.0, candidates=1, starts=1, max_frames=30)
FRAMES = 40
DEPTH_MM = 7.0


def total_cost(costs, way):
    """Of places by number, by the model's own definition."""
    places_mm = np.arange(-12, 12.125, 0.25)[np.asarray(way)]
    own = sum(cost[k] for cost, k in zip(costs, way, strict=True))
    steps = (np.diff(places_mm, axis=0) / 0.5) ** 2
    return own + 0.5 * steps.sum(axis=0) + 0.5 * ((places_mm / 6.0) ** 2).sum(axis=0)


def test_the_likeliest_way_is_that_of_all_ways_that_costs_least():
    """Every way of three frames through 97 places is tried: 912673 of them."""
    rng = np.random.default_rng(1)
    costs = rng.uniform(0, 200, (3, 97))
    ways = np.indices((97, 97, 97)).reshape(3, -1)
    best = ways[:, total_cost(costs, ways).argmin()]
    np.testing.assert_allclose(likeliest_way_mm(costs), np.arange(-12, 12.125, 0.25)[best])


def test_frames_that_say_nothing_stay_at_rest():
    np.testing.assert_array_equal(likeliest_way_mm(np.zeros((5, 97))), 0.0)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_rest_is_as_unsure_as_breaths_differ(n):
    """What a quarter of the frames lie before is off by no more than 1.5 deviations of what is
    told, whether breaths are even or rest for long (Lujan's form)."""
    breath_mm = 10 * np.cos(np.linspace(0, np.pi, 1000, endpoint=False)) ** (2 * n)
    assert np.quantile(breath_mm, 0.25) < 1.5 * rest_error_mm(breath_mm)
    assert not is_mostly_inspired(breath_mm)
    # Who rests with full lungs is told, unless the breath is shallow.
    assert is_mostly_inspired(10 - breath_mm) == (n > 1)
    assert not is_mostly_inspired((10 - breath_mm) / 6)


def test_breath_that_was_held_leaves_rest_sure():
    assert rest_error_mm(np.zeros(40)) == 0
    assert not is_mostly_inspired(np.zeros(40))


@pytest.fixture(scope="module")
def breathing():
    """Sweeps of one breath each, 7 mm deep, at rest at the end of expiration for a third of it.

    Pictures are drawn of a heart at rest; that each was taken when the heart lay ``depth_mm``
    along the axis is the same as that the probe was that much further when it was drawn.
    """
    recording = record(seed=3, frames=FRAMES)
    truth = recording.mr_from_tracker
    sweeps, depths = [], []
    for number, sweep in enumerate(recording.sweeps):
        turns = (np.arange(FRAMES) + 15 * number) / FRAMES
        depth_mm = DEPTH_MM * np.sin(np.pi * turns) ** 4
        moved = np.tile(np.eye(4), (FRAMES, 1, 1))
        moved[:, :3, 3] = depth_mm[:, None] * AXIS
        poses = np.linalg.inv(truth) @ moved @ truth @ sweep.tracker_from_image
        sweeps.append(replace(sweep, tracker_from_image=poses))
        depths.append(depth_mm)
    return sweeps, recording.phases, truth, np.concatenate(depths)


@pytest.mark.slow
def test_breath_is_followed_and_the_pose_is_that_of_rest(breathing, monkeypatch):
    sweeps, phases, truth, depth_mm = breathing
    surfaces = moving_surfaces()
    points = surfaces["lv_endocardium"].vertices_mm[0]
    found = {}
    for breath in ("hold", "free"):
        settings = QUICK.model_copy(update={"breath": breath})
        found[breath] = find(sweeps, phases, surfaces, truth, settings)
    error_mm = {
        breath: target_error_mm(one.mr_from_tracker, truth, points).mean()
        for breath, one in found.items()
    }
    # As if held, the pose is pulled away from rest, by up to the mean of a breath: 3/8 of 7 mm.
    assert error_mm["hold"] > 1.0
    assert error_mm["free"] < 2 / 3 * error_mm["hold"]
    assert not found["hold"].breath_mm.any()
    left_mm = found["free"].breath_mm - depth_mm
    assert left_mm.std() < 0.5 * depth_mm.std()
    assert abs(left_mm.mean()) < 1.0
    assert found["free"].score > found["hold"].score
    # Where it rests is unsure by a tenth of the breath, along its axis: more than the same result
    # without that would be.
    along = AXIS @ found["free"].covariance[:3, :3] @ AXIS
    rest_mm = rest_error_mm(found["free"].breath_mm)
    assert rest_mm == pytest.approx(0.7, abs=0.15)
    monkeypatch.setattr(space, "rest_error_mm", lambda _: 0.0)
    # And who is never nearer to expiration is told.
    monkeypatch.setattr(space, "is_mostly_inspired", lambda _: True)
    settings = QUICK.model_copy(update={"breath": "free"})
    sure = find(sweeps, phases, surfaces, truth, settings)
    assert along - AXIS @ sure.covariance[:3, :3] @ AXIS == pytest.approx(rest_mm**2)
    assert "the heart is taken to rest" not in found["free"].reason
    assert "the heart is taken to rest" in sure.reason


@pytest.mark.parametrize(("depth_mm", "told"), [(1.9, False), (2.1, True)])
def test_full_lungs_are_told_of_breaths_deeper_than_two_millimetres(depth_mm, told):
    """Three tenths of the frames at the end of expiration, the others at that of inspiration."""
    assert is_mostly_inspired(depth_mm * (np.arange(100) >= 30)) == told


@pytest.mark.parametrize(("inspired", "told"), [(45, False), (55, True)])
def test_full_lungs_are_those_of_most_frames(inspired, told):
    assert is_mostly_inspired(9.0 * (np.arange(100) < inspired)) == told
