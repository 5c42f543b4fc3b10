"""Frames that repeat a picture or a pose which is not theirs are left out and told; what real
scanners, trackers and arms repeat is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sweep_files import calibration, text, write

from pipeline.errors import InputError
from pipeline.imaging.stuck import without_stuck
from pipeline.imaging.ultrasound import Sweep, leaps, read_sweep, remarks_on

COUNT, RATE_HZ = 60, 20.0
STUCK = slice(20, 35)
"""0.7 s of frames 0.05 s apart."""


def swept(rng, speed_mm_s=15.0, jitter_mm=0.05):
    """A probe that slides along, as a tracker that measures tells it."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 0, 3] = speed_mm_s * np.arange(COUNT) / RATE_HZ
    poses[:, :3, 3] += rng.normal([100, -50, 30], jitter_mm, (COUNT, 3))
    return poses


def recording(poses, images=None, seed=1):
    if images is None:
        images = np.random.default_rng(seed).integers(1, 256, (COUNT, 8, 9)).astype(np.float32)
    times_s = 3 + np.arange(COUNT) / RATE_HZ
    return Sweep("s", images, times_s, poses @ calibration(), poses, np.arange(COUNT))


def repeating(answers, frames, first=None):
    """The answers with the first of these frames in place of all of them."""
    repeated = answers.copy()
    repeated[frames] = answers[frames.start if first is None else first]
    return repeated


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_a_frozen_display_over_a_moving_probe_is_left_out(rng):
    sweep = recording(swept(rng))
    frozen = recording(sweep.tracker_from_probe, repeating(sweep.images, STUCK))
    kept = without_stuck(frozen)
    # The first frame is at its place.
    np.testing.assert_array_equal(kept.numbers, [*range(21), *range(35, COUNT)])
    for name in ("images", "times_s", "tracker_from_image", "tracker_from_probe"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(frozen, name)[kept.numbers])
    assert kept.remarks == (
        "14 of 60 frames left out: their picture stands still while the probe moves (was the "
        "display frozen?)",
    )


def test_a_tracker_that_was_stuck_and_leaps_is_left_out(rng):
    kept = without_stuck(recording(repeating(swept(rng), STUCK)))
    np.testing.assert_array_equal(kept.numbers, [*range(21), *range(35, COUNT)])
    assert "14 of 60 frames left out: their pose stands still and then leaps" in kept.remarks[0]


def test_where_a_recording_begins_stuck_no_frame_is_known_to_be_new(rng):
    kept = without_stuck(recording(repeating(swept(rng), slice(0, 30))))
    np.testing.assert_array_equal(kept.numbers, np.arange(30, COUNT))
    assert len(kept.remarks) == 1


def test_one_leap_hides_no_other(rng):
    poses = repeating(repeating(swept(rng), slice(10, 25)), slice(35, 50))
    kept = without_stuck(recording(poses))
    np.testing.assert_array_equal(kept.numbers, [*range(11), *range(25, 36), *range(50, COUNT)])


def test_a_tracker_that_stays_stuck_is_told_of(rng):
    kept = without_stuck(recording(repeating(swept(rng), slice(30, COUNT))))
    assert len(kept.numbers) == COUNT
    assert "frames 30 to 59 (1.5 s) have one and the same pose" in kept.remarks[0]


def test_a_pose_that_a_sweep_begins_with_and_leaves_slowly_is_told_of():
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 1, 3] = np.cumsum(np.repeat([0.0, 2.5], [30, 30]))
    kept = without_stuck(recording(poses))
    assert len(kept.numbers) == COUNT
    assert "frames 0 to 29 (1.5 s) have one and the same pose" in kept.remarks[0]


def still(rng):
    return swept(rng, speed_mm_s=0.0)


def encoders(rng):
    """An arm that goes, halts for a second and goes on, told to the last bit."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 1, 3] = np.cumsum(np.repeat([2.5, 0.0, 2.5], [12, 24, 24]))
    return poses


def hasty_encoders(rng):
    """The same, which begins to move at twice its speed."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 1, 3] = np.cumsum(np.repeat([2.5, 0.0, 5.0, 2.5], [12, 24, 1, 23]))
    return poses


def stuck_at_last(rng):
    """For 0.7 s, which may be the probe's rest."""
    return repeating(swept(rng), slice(45, COUNT))


def slow_encoders(rng):
    """The same, asked four times as often as it answers."""
    return encoders(rng)[np.arange(COUNT) // 4 * 4]


def stuck_for_little(rng):
    """A leap of less than harms."""
    return repeating(swept(rng, speed_mm_s=1.0, jitter_mm=0.005), STUCK)


def slow_tracker(rng):
    return swept(rng, speed_mm_s=30.0)[np.arange(COUNT) // 5 * 5]


@pytest.mark.parametrize(
    "poses",
    [
        still,
        encoders,
        hasty_encoders,
        slow_encoders,
        stuck_for_little,
        stuck_at_last,
        slow_tracker,
        swept,
    ],
)
def test_arms_and_slow_trackers_are_in_order(rng, poses):
    sweep = recording(poses(rng))
    kept = without_stuck(sweep)
    assert len(kept.numbers) == COUNT
    assert kept.remarks == ()


def test_a_frozen_picture_of_a_probe_that_is_held_is_in_order(rng):
    sweep = recording(still(rng))
    frozen = recording(sweep.tracker_from_probe, repeating(sweep.images, STUCK))
    assert without_stuck(frozen).remarks == ()


def test_pictures_of_a_slow_scanner_and_flat_ones_are_in_order(rng):
    sweep = recording(swept(rng))
    for times in (4, 8):
        slow = sweep.images[np.arange(COUNT) // times * times]
        assert without_stuck(recording(sweep.tracker_from_probe, slow)).remarks == ()
    hiccup = repeating(sweep.images, slice(20, 25))
    assert without_stuck(recording(sweep.tracker_from_probe, hiccup)).remarks == ()
    flat = sweep.images.copy()
    flat[STUCK] = 0
    assert without_stuck(recording(sweep.tracker_from_probe, flat)).remarks == ()


def test_a_recorder_that_repeats_whole_frames_is_in_order(rng):
    """Picture and pose belong together, whatever comes after."""
    poses = repeating(swept(rng), STUCK)
    images = repeating(recording(poses).images, STUCK)
    assert len(without_stuck(recording(poses, images)).numbers) == COUNT


def test_a_file_is_read_without_them(tmp_path, rng):
    poses, fields = repeating(swept(rng), STUCK), {"ImageToProbeTransform": text(calibration())}
    for k in range(COUNT):
        start = f"Seq_Frame{k:04d}_"
        fields[start + "Timestamp"] = f"{3.0 + k / RATE_HZ:.3f}"
        fields[start + "ProbeToTrackerTransform"] = text(poses[k])
    pixels = recording(poses).images.astype(np.uint8)
    sweep = read_sweep(write(tmp_path / "s.mha", fields, pixels))
    assert len(sweep.numbers) == COUNT - 14
    assert "s: 14 of 60 frames left out" in remarks_on([sweep])[0]


def test_a_sweep_of_which_no_frame_is_left_is_refused(rng):
    """Its pose is stuck until its display freezes for good."""
    poses = repeating(swept(rng), slice(0, 21))
    images = repeating(recording(poses).images, slice(15, COUNT))
    with pytest.raises(InputError, match=r"^s: 60 of 60 frames left out: .*record the sweep"):
        without_stuck(recording(poses, images))


def test_a_probe_that_is_suddenly_elsewhere_and_stays_there_is_told(rng):
    """150 mm within 0.05 s are 3 m/s."""
    poses = swept(rng)
    assert leaps([recording(poses)]) == []
    moved = poses.copy()
    moved[20:, 1, 3] += 150
    told = leaps([recording(poses), recording(moved)])
    assert len(told) == 1
    assert "s: the probe leaps by 150 mm within 50 ms after 3.95 s" in told[0]
    # A wrong pose nearby hides nothing.
    moved[[17, 22], 2, 3] += 400
    assert "leaps by 150 mm within 50 ms after 3.95 s" in leaps([recording(moved)])[0]
    # By less a hand may be, or what the tracker measures; what it measures wrongly comes back.
    slower = poses.copy()
    slower[20:, 1, 3] += 90
    outliers = poses.copy()
    outliers[[12, 30, 31, 45], 1, 3] += 400
    assert leaps([recording(slower), recording(outliers)]) == []
    # While the tracker did not see it, it may have been carried there.
    times_s = recording(moved).times_s + np.where(np.arange(COUNT) < 20, 0, 1.0)
    assert leaps([replace(recording(moved), times_s=times_s)]) == []
    late = poses.copy()
    late[-3:, 1, 3] += 150
    assert leaps([recording(late)]) == []


def test_a_tracker_slower_than_the_pictures_is_no_probe_that_leaps(rng):
    """Pictures every 0.01 s, poses every 0.2 s of a hand at 0.15 m/s: 30 mm apart."""
    number = np.arange(COUNT)
    poses = swept(rng)
    poses[:, :3, 3] = [100, -50, 30]
    poses[:, 0, 3] += 30 * (number // 20)
    times_s = 3 + 0.01 * number
    assert leaps([replace(recording(poses), times_s=times_s)]) == []
    poses[40:, 1, 3] += 500
    assert len(leaps([replace(recording(poses), times_s=times_s)])) == 1
