"""Corrections of each sweep's image calibration: found beside the pose, and how sure both are."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from ellipsoid_heart import (
    CENTRE_MM,
    TILT,
    Sweep,
    draw_frame,
    moving_surfaces,
    random_motion,
    record,
    target_error_mm,
)
from scipy.spatial.transform import Rotation

from pipeline.geometry import Float, transform_points
from pipeline.registration.calibration import (
    _cost,
    _Expansion,
    _expansion,
    calibration_of,
    certainty,
)
from pipeline.registration.correction import Correction, put_right, tracker_from_picture
from pipeline.registration.frames import Samples, sample_frames
from pipeline.registration.pose_search import Pivot
from pipeline.registration.search import prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.space import find
from pipeline.registration.uncertainty import frame_curvatures

FIXED = RegisterSettings(grid_mm=3.0, sample_spacing_mm=6.0, candidates=1, starts=1)
PER_SWEEP = FIXED.model_copy(update={"calibration": "per_sweep"})
WINDOWS = {
    "apical": ([5, -5, -75], [-0.1, 0.1, 1]),
    "parasternal": ([10, -90, -5], [-0.15, 1, 0.15]),
    "lateral": ([80, 0, 10], [-1, 0.1, 0.1]),
}
SHAPE = (160, 150)
MIDDLE_PX = np.array([75, 90])
# Of chi-square with six degrees of freedom: passed as rarely as three standard deviations by a
# normal value, by 27 in 10000.
THREE_SIGMA = 20.06


def fan(window):
    """Pose of a picture that looks into a window, its tip in the middle of the first row."""
    tip, aim = (np.array(v, float) for v in WINDOWS[window])
    along = TILT @ aim / np.linalg.norm(aim)
    across = np.cross(along, TILT @ np.array([0.3, 0.2, 1.0]))
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, along, np.cross(across, along)], axis=1)
    pose[:3, 3] = CENTRE_MM + TILT @ tip
    return pose


def recorded(rng, truth, name, poses):
    """A sweep of pictures at ``poses`` of their tips, and its phases."""
    phases = (rng.uniform() + 0.11 * np.arange(len(poses))) % 1
    tip_from_image = np.eye(4)
    tip_from_image[0, 3] = -SHAPE[1] / 2
    mr_from_image = [pose @ tip_from_image for pose in poses]
    images = np.stack(
        [
            draw_frame(rng, pose, phase, SHAPE)
            for pose, phase in zip(mr_from_image, phases, strict=True)
        ]
    )
    return Sweep(name, images, np.linalg.inv(truth) @ np.stack(mr_from_image)), phases


def turned(window, frames):
    """A fan turned by 120 degrees about its middle beam."""
    angles = np.radians(np.linspace(-60, 60, frames))
    turns = np.tile(np.eye(4), (frames, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * [0, 1, 0]).as_matrix()
    return fan(window) @ turns


def motion(rng, shift_mm, turn_deg):
    """A shift and a turn about the origin of these sizes, in random directions."""
    way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    moved[:3, 3] = shift_mm * way
    return moved


def miscalibrated(sweep, true_from_given):
    """The sweep as tracked with a calibration that puts pictures beside their place."""
    planes = tracker_from_picture(sweep.tracker_from_image, MIDDLE_PX)
    wrong = planes @ np.linalg.inv(true_from_given) @ np.linalg.inv(planes)
    return replace(sweep, tracker_from_image=wrong @ sweep.tracker_from_image)


def squared_error(correction, true_from_given):
    """Of a correction, in units of its covariance."""
    found = correction.corrected_from_calibrated
    turn = Rotation.from_matrix(found[:3, :3] @ true_from_given[:3, :3].T).as_rotvec()
    error = np.concatenate([found[:3, 3] - true_from_given[:3, 3], turn])
    return error @ np.linalg.solve(correction.covariance, error)


@pytest.fixture(scope="module")
def surfaces():
    return moving_surfaces()


@pytest.fixture(scope="module")
def points(surfaces):
    return np.concatenate([surface.vertices_mm[0] for surface in surfaces.values()])


@pytest.fixture(scope="module")
def study():
    """A long sweep and two short ones, each turned by 120 degrees about its own beam."""
    rng = np.random.default_rng(1)
    truth = random_motion(rng, 200, 120)
    made = [
        recorded(rng, truth, window, turned(window, frames))
        for window, frames in zip(WINDOWS, (30, 12, 12), strict=True)
    ]
    return [sweep for sweep, _ in made], [phases for _, phases in made], truth


class TestThreeSweeps:
    def test_a_wrong_calibration_is_found_and_the_pose_is_nearer(self, study, surfaces, points):
        """The long sweep's probe was clamped anew, 3 mm and 3 degrees off.

        One pose for all follows the frames, 30 of 54 of which are wrong; with corrections the
        sweeps count alike, one of three of which is wrong, and what turns with the probe is seen.
        """
        sweeps, phases, truth = study
        off = motion(np.random.default_rng(2), 3.0, 3.0)
        given = [miscalibrated(sweeps[0], off), *sweeps[1:]]
        fixed, freed = (find(given, phases, surfaces, truth, each) for each in (FIXED, PER_SWEEP))
        error_mm = [
            target_error_mm(one.mr_from_tracker, truth, points).mean() for one in (fixed, freed)
        ]
        assert error_mm[1] < error_mm[0]
        assert freed.score > fixed.score
        assert fixed.corrections == ()
        assert [one.sweep for one in freed.corrections] == list(WINDOWS)
        for correction, true_from_given in zip(
            freed.corrections, (off, np.eye(4), np.eye(4)), strict=True
        ):
            assert squared_error(correction, true_from_given) < THREE_SIGMA
        # More than half of what is wrong is put right, along each way that it is.
        shift_mm = freed.corrections[0].corrected_from_calibrated[:3, 3]
        assert shift_mm @ off[:3, 3] > 0.5 * off[:3, 3] @ off[:3, 3]

    @pytest.mark.slow
    def test_right_calibrations_are_left_so_and_the_pose_is_as_near(self, study, surfaces, points):
        """With corrections the sweeps count alike, whatever their number of frames.

        Of sweeps that hold the pose alike but for their number of frames, the plain mean has
        (54 / 30 + 54 / 12 + 54 / 12) / 9 = 1.2 times the variance of the best mean, which is that
        of all frames; so the two differ by a variance of 0.2 of it (J. A. Hausman, "Specification
        tests in econometrics", Econometrica 46 (1978) 1251-1271): three standard deviations of it.
        That of all frames is what is expected where the model is exact.
        """
        sweeps, phases, truth = study
        exact = FIXED.model_copy(update={"model_error_mm": 0.0})
        fixed, freed = (find(sweeps, phases, surfaces, truth, each) for each in (exact, PER_SWEEP))
        error_mm = [
            target_error_mm(one.mr_from_tracker, truth, points).mean() for one in (fixed, freed)
        ]
        assert error_mm[1] < error_mm[0] + 3 * np.sqrt(0.2) * fixed.expected_mm
        for correction in freed.corrections:
            assert squared_error(correction, np.eye(4)) < THREE_SIGMA
        assert freed.expected_mm > fixed.expected_mm


@pytest.mark.slow
def test_a_probe_that_only_moves_on_leaves_the_pose_as_open_as_the_calibration(surfaces, points):
    """One sweep, moved without a turn: a shift of all its pictures is one of the tracker.

    What is believed of the shift, 2 mm along each axis, is all that is ever known of it: it adds
    to the variance of the pose at every point, in every direction.
    """
    rng = np.random.default_rng(4)
    truth = random_motion(rng, 200, 120)
    poses = np.tile(fan("apical"), (20, 1, 1))
    poses[:, :3, 3] += np.linspace(-30, 30, 20)[:, None] * poses[:, :3, 2]
    sweep, phases = recorded(rng, truth, "straight", poses)
    fixed, freed = (find([sweep], [phases], surfaces, truth, each) for each in (FIXED, PER_SWEEP))
    assert fixed.expected_mm < FIXED.good_tre_mm < freed.expected_mm
    assert freed.verdict != "good"
    assert np.linalg.eigvalsh(freed.covariance[:3, :3])[0] > 2.0**2
    assert freed.expected_tre_mm(points).min() > np.sqrt(3) * 2.0
    # The ridge that keeps open directions solvable takes a thousandth off.
    shift = freed.corrections[0].covariance[:3, :3]
    np.testing.assert_allclose(shift, 2.0**2 * np.eye(3), atol=0.01)


@dataclass(frozen=True)
class PointLevel:
    """Frames of points that are known by their places: a loss whose derivatives are exact."""

    samples: Samples
    places_mm: Float

    def losses(self, mr_from_tracker):
        off = transform_points(mr_from_tracker, self.samples.points_mm) - self.places_mm
        return np.add.reduceat((off**2 * [1.0, 2.0, 0.5]).sum(axis=1), self.samples.first[:-1])


def hessian(function, count, step):
    """Second derivatives at zero by central differences."""
    ways = step * np.eye(count)
    bent = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            ends = (function(a * ways[i] + b * ways[j]) * a * b for a in (1, -1) for b in (1, -1))
            bent[i, j] = sum(ends) / (4 * step**2)
    return bent


@pytest.fixture(scope="module")
def planes():
    """Points in the planes of two sweeps of five frames, and the calibration as it was given."""
    recording = record(seed=3, frames=5)
    pivot = Pivot(CENTRE_MM, 45.0)
    samples = sample_frames(recording.sweeps, recording.phases, 25.0, 1.5, 75.0)
    samples = replace(samples, points_mm=samples.points_mm.astype(float))
    level = PointLevel(samples, transform_points(recording.mr_from_tracker, samples.points_mm))
    calibration = calibration_of(recording.sweeps, level, pivot, RegisterSettings())
    return calibration, level, recording.mr_from_tracker


def test_covariance_is_the_inverse_of_all_derivatives_of_pose_and_corrections(planes):
    """Against differences in all 18 parameters, at a loss of zero.

    Without spread, a unit of loss is worth so much that the trace of all frames' curvature times
    the model's variance is 6. Points move along arcs: a step of 1 mm at a lever of 45 mm changes
    second derivatives by its square, 5e-4, times some units.
    """
    calibration, level, pose = planes
    settings = RegisterSettings(model_error_mm=0.8, calibration_sd_mm=2.0, calibration_sd_deg=2.0)

    def loss(step):
        moved = replace(calibration, steps_mm=step[6:].reshape(2, 6)).placed(level)
        return moved.losses(calibration.pivot.move(pose, step[:6])).sum()

    of_frames = hessian(loss, 18, 1e-3)
    of_frames *= 6 / (0.8**2 * np.trace(of_frames[:6, :6]))
    sd_mm = np.repeat([2.0, np.radians(2.0) * 45.0], 3)
    believed = np.diag(np.concatenate([np.zeros(6), np.tile(sd_mm**-2.0, 2)]))
    joint = np.linalg.inv(of_frames + believed)
    in_radians = np.repeat([1.0, 1 / 45.0], 3)
    scale = np.outer(in_radians, in_radians)

    opened, corrections = certainty(calibration, level, pose, settings)

    alone = np.linalg.inv(of_frames[:6, :6])
    np.testing.assert_allclose(
        opened / scale, joint[:6, :6] - alone, atol=0.01 * np.abs(joint[:6, :6]).max()
    )
    for k, correction in enumerate(corrections):
        block = joint[6 * k + 6 : 6 * k + 12, 6 * k + 6 : 6 * k + 12]
        np.testing.assert_allclose(
            correction.covariance / scale, block, atol=0.01 * np.abs(block).max()
        )


def test_a_step_of_the_pose_does_what_that_of_a_correction_does(planes):
    """To first order: steps of 0.01 mm, and corrections whose own turn of 1 degree counts for half
    of itself, 0.9 %, in what a further turn does."""
    calibration, level, pose = planes
    rng = np.random.default_rng(0)
    turn_mm = np.radians(1.0) * 45.0
    steps_mm = np.hstack([rng.normal(size=(2, 3)), turn_mm * np.eye(3)[:2]])
    bent = replace(calibration, steps_mm=steps_mm)
    further = rng.normal(scale=0.01, size=(2, 6))
    before = bent.placed(level).samples.points_mm
    after = replace(bent, steps_mm=steps_mm + further).placed(level).samples.points_mm
    lifts = bent.lifts(level, pose)
    for frame, (first, end) in enumerate(
        zip(level.samples.first[:-1], level.samples.first[1:], strict=True)
    ):
        step = lifts[frame] @ further[frame // 5]
        lifted = transform_points(calibration.pivot.move(pose, step), before[first:end])
        moved = transform_points(pose, after[first:end])
        way_mm = moved - transform_points(pose, before[first:end])
        assert np.abs(lifted - moved).max() < 0.02 * np.abs(way_mm).max()


def test_slopes_of_the_cost_are_those_of_its_differences(planes):
    """In all 18 parameters, at corrections that shift. A frame's slopes are told by steps of 1 mm,
    which at a lever of 45 mm bend by the square of 1 / 45: by less than a thousandth."""
    calibration, level, pose = planes
    steps_mm = np.hstack(
        [np.random.default_rng(0).normal(scale=4.0, size=(2, 3)), np.zeros((2, 3))]
    )
    shifted = replace(calibration, steps_mm=steps_mm)
    placed = shifted.placed(level)
    derivatives = frame_curvatures(lambda step: placed.losses(shifted.pivot.move(pose, step)))
    expansion = _expansion(shifted, placed, pose, *derivatives, 0.5)

    def cost(step):
        moved = replace(shifted, steps_mm=steps_mm + step[6:].reshape(2, 6))
        return _cost(moved, level, shifted.pivot.move(pose, step[:6]), expansion.worth)

    differences = np.array([cost(way) - cost(-way) for way in 1e-3 * np.eye(18)]) / 2e-3
    np.testing.assert_allclose(expansion.slope, differences, atol=1e-3 * np.abs(differences).max())


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_step_is_cut_to_three_millimetres_whichever_way_it_goes(way):
    """The optimum of a bowl of unit bending lies as far off as its slope is steep."""
    slope = way * np.array([6.0, 1.0, 0.0, 0.0, 2.0, 0.0])
    step = _Expansion(slope, np.eye(6), np.zeros((6, 6)), 1.0).towards_optimum()
    np.testing.assert_allclose(step, -slope / 2)
    near = _Expansion(slope / 3, np.eye(6), np.zeros((6, 6)), 1.0).towards_optimum()
    np.testing.assert_allclose(near, -slope / 3)


def test_a_sweep_that_shows_nothing_is_as_unsure_as_before(surfaces):
    """Its covariance is what was believed; and no other's pose is the worse for it."""
    recording = record(seed=5, frames=12)
    seen, dead = recording.sweeps
    dead = replace(dead, images=90.0 * (dead.images > 0).astype(np.float32))
    search = prepare_search(recording.phases, surfaces, recording.mr_from_tracker, PER_SWEEP)
    level = search.fine_level([seen, dead])
    both = calibration_of([seen, dead], level, search.pivot, PER_SWEEP)
    alone = calibration_of([seen], level, search.pivot, PER_SWEEP)
    opened, corrections = certainty(both, level, recording.mr_from_tracker, PER_SWEEP)
    rows, columns = dead.images.shape[1:]
    assert corrections[1].origin_px == (columns // 2, rows // 2)
    np.testing.assert_allclose(
        corrections[1].covariance, np.diag([4.0] * 3 + [np.radians(2.0) ** 2] * 3), rtol=1e-9
    )
    np.testing.assert_allclose(
        opened, certainty(alone, level, recording.mr_from_tracker, PER_SWEEP)[0], rtol=1e-6
    )


class TestCorrection:
    FOUND = Correction(
        "sweep_001",
        motion(np.random.default_rng(6), 3.0, 2.0),
        (75, 90),
        np.diag([1.0] * 3 + [np.radians(1.5) ** 2] * 3),
    )

    def test_pictures_are_put_back_by_the_motion_that_displaced_them(self):
        sweep = record(seed=3, frames=4).sweeps[0]
        given = miscalibrated(sweep, self.FOUND.corrected_from_calibrated)
        assert not np.allclose(given.tracker_from_image, sweep.tracker_from_image, atol=0.5)
        restored = self.FOUND.applied(given.tracker_from_image)
        np.testing.assert_allclose(restored, sweep.tracker_from_image, atol=1e-9)

    def test_what_was_written_corrects_its_own_sweep_alone(self):
        transforms = record(seed=3, frames=4).sweeps[0].tracker_from_image
        written = json.loads(json.dumps([self.FOUND.table()]))
        own = put_right(transforms, "sweep_001", written)
        np.testing.assert_array_equal(own, self.FOUND.applied(transforms))
        assert put_right(transforms, "sweep_000", written) is transforms
        assert put_right(transforms, "sweep_001", None) is transforms

    def test_words_say_how_much_and_how_sure(self):
        assert self.FOUND.words() == (
            "calibration of sweep_001 corrected by 3.0 ± 1.0 mm and 2.0 ± 1.5 degrees"
        )

    def test_axes_of_a_picture_are_rigid_though_pixels_are_neither_square_nor_1_mm(self):
        tracker_from_image = np.eye(4)[None].repeat(2, axis=0)
        tracker_from_image[:, :3, :3] = np.diag([0.5, 0.25, 0.0])
        tracker_from_image[1, :3, 3] = 1, 2, 3
        placed = tracker_from_picture(tracker_from_image, np.array([10, 40]))
        np.testing.assert_allclose(placed[:, :3, :3], np.eye(3)[None].repeat(2, axis=0))
        np.testing.assert_allclose(placed[:, :3, 3], [[5, 10, 0], [6, 12, 3]])


def test_calibrations_are_taken_as_right_unless_asked():
    assert RegisterSettings().calibration == "fixed"
    with pytest.raises(ValueError, match="calibration"):
        RegisterSettings(calibration="each")
    with pytest.raises(ValueError, match="calibration_sd_mm"):
        RegisterSettings(calibration_sd_mm=0.0)
