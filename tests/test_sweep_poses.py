"""Which transforms of a recording lead from the probe to the tracker, or to the patient."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation
from sweep_files import FRAMES, PIXELS, calibration, good_fields, rigid, text, write

from pipeline.errors import InputError
from pipeline.geometry import require_rigid
from pipeline.imaging.sweep_poses import require_resting
from pipeline.imaging.ultrasound import read_sweep, read_sweeps, remarks_on
from pipeline.products import write_slicer_transform
from pipeline.run import STAGES, _described
from pipeline.stages import register
from pipeline.study import UltrasoundFiles
from pipeline.summary import remarks

STEP_MM = 4.0
PROBE_TO_REFERENCE = "ProbeToReferenceTransform"


def reference(k):
    """The patient's marker: far from the probe, and it drifts and turns a little."""
    pose = rigid(5)
    pose[:3, 3] += [STEP_MM * k, 0, 100]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, 0.02 * k]).as_matrix()
    return pose


def followed(k):
    return np.linalg.inv(reference(k)) @ rigid(k)


def with_reference(**others):
    fields = good_fields()
    for k in range(FRAMES):
        start = f"Seq_Frame{k:04d}_"
        fields[start + "ReferenceToTrackerTransform"] = text(reference(k))
        fields[start + "ReferenceToTrackerTransformStatus"] = "OK"
        for name, value in others.items():
            fields[start + name] = value(k)
    return fields


def without(fields, name):
    return {key: value for key, value in fields.items() if not key.endswith(name)}


def files(*paths, **keys):
    return UltrasoundFiles(sweeps=paths, **keys)


def poses(sweeps):
    return sweeps[0].tracker_from_probe


def test_poses_follow_the_patients_reference_where_asked(tmp_path):
    path = write(tmp_path / "s.mha", with_reference())
    sweeps = read_sweeps(files(path, pose_frame="Reference"))
    np.testing.assert_allclose(poses(sweeps), [followed(k) for k in range(FRAMES)], atol=1e-9)
    assert "frame Reference: mr_from_tracker starts from there" in remarks_on(sweeps)[0]
    still = read_sweeps(files(path, pose_frame="Tracker"))
    np.testing.assert_allclose(poses(still), [rigid(k) for k in range(FRAMES)])
    assert remarks_on(still) == []


@pytest.mark.parametrize("told_by_probe", [False, True])
def test_a_reference_that_moves_needs_a_choice(tmp_path, told_by_probe):
    fields = with_reference()
    if told_by_probe:
        fields = without(fields, "ReferenceToTrackerTransform")
        for k in range(FRAMES):
            fields[f"Seq_Frame{k:04d}_{PROBE_TO_REFERENCE}"] = text(followed(k))
    path = write(tmp_path / "s.mha", fields)
    with pytest.raises(InputError, match=r"Reference moves .* us\.pose_frame"):
        read_sweeps(files(path))


@pytest.mark.parametrize("still", [False, True])
def test_what_a_reference_moves_by_is_told_of_the_probe_and_noise_is_none(tmp_path, still):
    """About the probe's own place nothing moves, whatever the marker does far from it."""
    fields = with_reference()
    middle = np.mean([rigid(k)[:3, 3] for k in range(FRAMES)], axis=0)
    for k in range(FRAMES):
        motion, about = np.eye(4), np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec([0, 0.01 * k, 0]).as_matrix()
        motion[0, 3] = 0.0 if still else 1.0 * k
        about[:3, 3] = middle
        pose = about @ motion @ np.linalg.inv(about) @ reference(0)
        fields[f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"] = text(pose)
    path = write(tmp_path / "s.mha", fields)
    if still:
        read_sweeps(files(path))
    else:
        # Of 2, 1, 0, 1 and 2 mm from the middle the root mean square is the root of 2.
        with pytest.raises(InputError, match=r"by 1\.4 mm at the probe"):
            read_sweeps(files(path))
    # Poses that follow it are asked nothing.
    read_sweeps(files(path, pose_frame="Reference"))


def test_a_pose_now_and_then_is_no_motion(tmp_path):
    fields, many = {}, 40
    pixels = np.zeros((many, 12, 17), np.uint8)
    for k in range(many):
        start = f"Seq_Frame{k:04d}_"
        place = reference(0)
        place[0, 3] += 9.0 * (k == 7)
        fields[start + "Timestamp"] = f"{0.1 * k}"
        fields[start + "ProbeToTrackerTransform"] = text(rigid(k))
        fields[start + "ReferenceToTrackerTransform"] = text(place)
        fields[start + "ImageToProbeTransform"] = text(calibration())
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields, pixels)))
    assert (sweep.pose_frame, len(sweep.numbers)) == ("Tracker", many)


def test_a_frame_that_moves_with_the_probe_is_none_for_poses(tmp_path):
    path = write(tmp_path / "s.mha", with_reference())
    with pytest.raises(InputError, match="Probe moves with the probe"):
        read_sweeps(files(path, pose_frame="Probe"))


def test_a_reference_that_moves_between_sweeps_needs_a_choice(tmp_path):
    for number in range(2):
        fields = with_reference()
        for k in range(FRAMES):
            name = f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"
            fields[name] = text(reference(3 * number))
        write(tmp_path / f"{number}.mha", fields, PIXELS ^ number)
    read_sweeps(files(tmp_path / "0.mha"))
    with pytest.raises(InputError, match=r"Reference moves"):
        read_sweeps(files(tmp_path / "0.mha", tmp_path / "1.mha"))


def test_a_reference_seen_with_a_trackers_noise_rests(tmp_path):
    rng = np.random.default_rng(0)
    fields = with_reference()
    for k in range(FRAMES):
        shaken = reference(0)
        shaken[:3, 3] += rng.normal(0, 0.3, 3)
        fields[f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"] = text(shaken)
    # What is written while the marker is not seen must not count.
    fields["Seq_Frame0003_ReferenceToTrackerTransform"] = text(reference(9))
    fields["Seq_Frame0003_ReferenceToTrackerTransformStatus"] = "INVALID"
    sweeps = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    np.testing.assert_allclose(poses(sweeps), [rigid(k) for k in range(FRAMES)])


def test_frames_whose_reference_was_not_seen_are_left_out_where_it_counts(tmp_path):
    fields = with_reference() | {"Seq_Frame0002_ReferenceToTrackerTransformStatus": "MISSING"}
    path = write(tmp_path / "s.mha", fields)
    (sweep,) = read_sweeps(files(path, pose_frame="Reference"))
    np.testing.assert_array_equal(sweep.numbers, [0, 1, 3, 4])
    (sweep,) = read_sweeps(files(path, pose_frame="Tracker"))
    np.testing.assert_array_equal(sweep.numbers, np.arange(FRAMES))


def test_poses_in_the_references_frame_alone_are_taken_and_told(tmp_path):
    fields = without(
        with_reference(ProbeToReferenceTransform=lambda k: text(followed(k))), "Status"
    )
    fields = without(without(fields, "ProbeToTrackerTransform"), "ReferenceToTrackerTransform")
    path = write(tmp_path / "s.mha", fields)
    sweeps = read_sweeps(files(path))
    np.testing.assert_allclose(poses(sweeps), [followed(k) for k in range(FRAMES)])
    assert len(remarks_on(sweeps)) == 1
    other = write(tmp_path / "t.mha", good_fields(), PIXELS ^ 1)
    with pytest.raises(InputError, match=r"s are in the frame Reference, those of t in Tracker"):
        read_sweeps(files(path, other))
    with pytest.raises(InputError, match=r"t\.mha, frame 0: has no ProbeToReferenceTransform"):
        read_sweeps(files(path, other, pose_frame="Reference"))


def test_a_calibration_of_the_study_stands_in_for_the_files(tmp_path):
    given = calibration(0.25)
    fields = {key: value for key, value in good_fields().items() if "ImageToProbe" not in key}
    path = write(tmp_path / "s.mha", fields)
    with pytest.raises(InputError, match=r"has no ImageToProbe.*us\.probe_from_image"):
        read_sweep(path)
    marked = good_fields() | {"Seq_Frame0001_ImageToProbeTransformStatus": "INVALID"}
    for one in (path, write(tmp_path / "t.mha", marked)):
        (sweep,) = read_sweeps(files(one, probe_from_image=given.tolist()))
        wanted = [rigid(k) @ given for k in range(FRAMES)]
        np.testing.assert_allclose(sweep.tracker_from_image, wanted)
    with pytest.raises(InputError, match=r"us\.probe_from_image of study\.yaml: is no calibration"):
        read_sweeps(files(path, probe_from_image=calibration(9.0).tolist()))


@pytest.mark.parametrize("third", [np.zeros(3), calibration()[:3, 0]], ids=["none", "in plane"])
def test_a_calibration_without_a_third_axis_can_be_turned_back(tmp_path, third):
    """Pixels are (i, j, 0): nobody asks where it leads, but whoever cuts surfaces by a picture."""
    flat = calibration()
    flat[:3, 2] = third
    (sweep,) = read_sweeps(
        files(write(tmp_path / "s.mha", good_fields()), probe_from_image=flat.tolist())
    )
    (whole,) = read_sweeps(
        files(write(tmp_path / "t.mha", good_fields()), probe_from_image=calibration().tolist())
    )
    np.testing.assert_allclose(sweep.tracker_from_image[..., :2], whole.tracker_from_image[..., :2])
    across, down, normal = np.moveaxis(sweep.tracker_from_image[:, :3, :3], 2, 0)
    np.testing.assert_allclose(np.einsum("nk,nk->n", across, normal), 0, atol=1e-9)
    np.testing.assert_allclose(np.einsum("nk,nk->n", down, normal), 0, atol=1e-9)
    areas = np.linalg.norm(np.cross(across, down), axis=1)
    np.testing.assert_allclose(np.linalg.det(sweep.tracker_from_image[:, :3, :3]), areas**1.5)


def test_a_pose_of_zeros_is_none(tmp_path):
    blank = np.diag([0.0, 0, 0, 1])
    fields = good_fields() | {"Seq_Frame0004_ProbeToTrackerTransform": text(blank)}
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    np.testing.assert_array_equal(sweep.numbers, np.arange(4))
    assert remarks_on([sweep]) == [f"s: {sweep.remarks[0]}"]


@pytest.mark.parametrize(("wider", "told"), [(1.0, 0), (0.98, 0), (1.1, 1), (0.91, 1)])
def test_pixels_that_are_not_square_are_told(tmp_path, wider, told):
    """No pose and no size of the heart tells that a picture is calibrated too wide."""
    given = calibration() @ np.diag([wider, 1, 1, 1])
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", good_fields()),
                                 probe_from_image=given.tolist()))  # fmt: skip
    assert len(sweep.remarks) == told
    assert all("pixels are" in one and "square" in one for one in sweep.remarks)


def test_the_identity_is_no_pose_but_of_a_probe_that_rests_there(tmp_path):
    """As some recorders write for a tool unseen; a pose that was measured is never exact."""
    place = "Seq_Frame{:04d}_ProbeToTrackerTransform"
    fields = good_fields() | {place.format(k): text(np.eye(4)) for k in (1, 2)}
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    np.testing.assert_array_equal(sweep.numbers, [0, 3, 4])
    assert sweep.remarks == ("2 of 5 frames left out, which have no valid picture or pose",)
    fields |= {place.format(k): text(np.eye(4)) for k in range(FRAMES)}
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    assert len(sweep.numbers) == FRAMES


def test_rows_of_frames_are_numbered_as_in_the_file(tmp_path):
    fields = good_fields() | {"Seq_Frame0001_ImageStatus": "INVALID"}
    sweeps = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    found = SimpleNamespace(residual=np.zeros(4), valid=np.ones(4, bool))
    rows = register._rows(sweeps, [np.linspace(0, 0.9, 4)], found)
    assert [row.frame for row in rows] == [0, 2, 3, 4]
    assert [row.time_s for row in rows] == pytest.approx([3.0, 3.1, 3.15, 3.2])


@pytest.mark.parametrize(
    "key",
    [
        {"pose_frame": "Reference"},
        {"probe_from_image": np.eye(4).tolist()},
        {"initial_mr_from_tracker": np.eye(4).tolist()},
    ],
)
def test_what_the_study_says_of_poses_makes_a_registration_anew(tmp_path, key):
    (stage,) = [one for one in STAGES if one.name == "register"]
    said = [
        _described(SimpleNamespace(us=files(tmp_path / "s.mha", **keys)), stage)
        for keys in ({}, key)
    ]
    assert said[0] != said[1]


def test_what_is_to_be_known_of_sweeps_is_told_at_the_end(tmp_path):
    told = remarks({"register": {"status": "done", "figures": {"remarks": ["one", "two"]}}})
    assert told == [("input", "one"), ("input", "two")]


def test_the_transform_for_slicer_puts_tracker_points_beside_the_mr(tmp_path):
    """Slicer makes the file's inverse, turned from LPS to RAS, the way from child to parent."""
    mr_from_tracker = rigid(7)
    write_slicer_transform(tmp_path / "TrackerToRAS.tfm", mr_from_tracker)
    stored = sitk.ReadTransform(str(tmp_path / "TrackerToRAS.tfm"))
    turn = np.array([-1.0, -1.0, 1.0])
    tip = np.array([12.0, -7.0, 30.0])
    shown = turn * stored.GetInverse().TransformPoint((turn * tip).tolist())
    np.testing.assert_allclose(shown, turn * (mr_from_tracker @ [*tip, 1])[:3], atol=1e-9)


def test_a_reference_that_rests_by_two_poses_of_the_probe_is_left_alone(tmp_path):
    """The probe moves in both frames; where the reference stands follows from both together."""
    fields = without(with_reference(), "ReferenceToTrackerTransform")
    for k in range(FRAMES):
        pose = np.linalg.inv(reference(0)) @ rigid(k)
        fields[f"Seq_Frame{k:04d}_{PROBE_TO_REFERENCE}"] = text(pose)
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    np.testing.assert_allclose(sweep.tracker_from_reference, [reference(0)] * FRAMES, atol=1e-6)


def test_the_identity_is_no_pose_of_a_reference_but_where_it_rests(tmp_path):
    fields = without(with_reference(), "Status")
    for k in (1, 3):
        fields[f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"] = text(np.eye(4))
    sweep = read_sweep(write(tmp_path / "s.mha", fields), "Reference")
    assert sweep.numbers.tolist() == [0, 2, 4]
    assert sweep.remarks == ("2 of 5 frames left out, which have no valid picture or pose",)
    for at, k in enumerate(sweep.numbers):
        np.testing.assert_allclose(sweep.tracker_from_probe[at], followed(k), atol=1e-9)
    for k in range(FRAMES):
        fields[f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"] = text(np.eye(4))
    sweep = read_sweep(write(tmp_path / "s.mha", fields), "Reference")
    np.testing.assert_allclose(sweep.tracker_from_probe, [rigid(k) for k in range(FRAMES)])


def test_a_reference_unseen_for_some_frames_does_not_move(tmp_path):
    fields = without(with_reference(), "Status")
    for k in range(FRAMES):
        place = np.eye(4) if k == 2 else reference(1)
        fields[f"Seq_Frame{k:04d}_ReferenceToTrackerTransform"] = text(place)
    (sweep,) = read_sweeps(files(write(tmp_path / "s.mha", fields)))
    assert len(sweep.numbers) == FRAMES
    assert len(sweep.tracker_from_reference) == FRAMES - 1


def test_a_size_of_pixels_beside_the_calibration_is_told_and_instead_of_it_refused(tmp_path):
    """PLUS looks at the calibration alone, 3D Slicer multiplies the two."""
    image = sitk.ReadImage(str(write(tmp_path / "s.mha", good_fields())))
    image.SetSpacing((0.2, 0.3, 1.0))
    sitk.WriteImage(image, str(tmp_path / "s.mha"))
    [told] = read_sweep(tmp_path / "s.mha").remarks
    assert told.startswith("ElementSpacing of 0.2 by 0.3 mm is not looked at")
    for k in range(FRAMES):
        image.SetMetaData(f"Seq_Frame{k:04d}_ImageToProbeTransform", text(calibration(1.0)))
    sitk.WriteImage(image, str(tmp_path / "s.mha"))
    with pytest.raises(InputError, match=r"pixels of 0\.2 by 0\.3 mm and ImageToProbe takes each"):
        read_sweep(tmp_path / "s.mha")
    given = calibration() @ np.eye(4)
    assert len(read_sweep(tmp_path / "s.mha", probe_from_image=given).remarks) == 1


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (np.diag([1.0, 1, -1, 1]), "it mirrors"),
        (np.diag([1.0, 1, 1.002, 1]), "is not a rotation and a shift"),
        (np.eye(4) + 1e-4 * np.outer([0, 0, 0, 1], [1, 0, 0, 0]), "is not a rotation and a shift"),
    ],
)
def test_what_mirrors_stretches_or_projects_is_no_rigid_motion(wrong, words):
    require_rigid(np.eye(4), "here")
    with pytest.raises(InputError, match=words):
        require_rigid(wrong, "here")


@pytest.mark.parametrize(("away_mm", "rests"), [(0.75, True), (0.85, False)])
def test_eight_tenths_of_a_millimetre_are_the_most_that_noise_does(away_mm, rests):
    """Back and forth by as much about the middle: that is the root mean square, too."""
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = away_mm * (-1.0) ** np.arange(40)
    if rests:
        require_resting(list(poses), np.zeros(3), "us")
    else:
        with pytest.raises(InputError, match=rf"moves against the tracker, by {away_mm:.1f} mm"):
            require_resting(list(poses), np.zeros(3), "us")
