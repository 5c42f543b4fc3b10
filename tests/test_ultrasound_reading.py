"""Sweeps written by SimpleITK itself are read whole, or refused with a reason."""

from __future__ import annotations

import re
import tracemalloc
import zlib
from contextlib import suppress

import numpy as np
import pytest
from sweep_files import COLUMNS, FRAMES, PIXELS, ROWS, calibration, good_fields, rigid, text, write

from pipeline.errors import InputError
from pipeline.imaging.ultrasound import odd_transforms, read_sweep, read_sweeps
from pipeline.study import UltrasoundFiles


@pytest.mark.parametrize(
    ("name", "compress"), [("s.mha", False), ("s.mha", True), ("s.mhd", False)]
)
def test_frames_times_and_poses_are_read(tmp_path, name, compress):
    sweep = read_sweep(write(tmp_path / name, good_fields(), compress=compress))
    np.testing.assert_array_equal(sweep.images, PIXELS)
    assert sweep.images.dtype == np.float32
    np.testing.assert_array_equal(sweep.times_s, 3.0 + 0.05 * np.arange(FRAMES))
    assert (sweep.name, sweep.pose_frame, sweep.remarks) == ("s", "Tracker", ())
    np.testing.assert_array_equal(sweep.numbers, np.arange(FRAMES))
    for k in range(FRAMES):
        # Column 3, row 7, through the probe into the tracker, one link after the other.
        probe_mm = calibration() @ [3, 7, 0, 1]
        tracker_mm = rigid(k) @ probe_mm
        np.testing.assert_allclose(sweep.tracker_from_image[k] @ [3, 7, 0, 1], tracker_mm)


@pytest.mark.parametrize(
    ("orientation", "turned"),
    [
        *(("MF", PIXELS), ("MFA", PIXELS), ("XX", PIXELS), ("UF", PIXELS[:, :, ::-1])),
        *(("MN", PIXELS[:, ::-1]), ("una", PIXELS[:, ::-1, ::-1])),
    ],
)
def test_pictures_of_another_orientation_are_turned_as_plus_turns_them(
    tmp_path, orientation, turned
):
    fields = good_fields() | {"UltrasoundImageOrientation": orientation}
    sweep = read_sweep(write(tmp_path / "s.mha", fields, np.ascontiguousarray(turned)))
    np.testing.assert_array_equal(sweep.images, PIXELS)
    np.testing.assert_allclose(sweep.tracker_from_image[1], rigid(1) @ calibration())


def test_an_orientation_that_is_none_is_refused(tmp_path):
    fields = good_fields() | {"UltrasoundImageOrientation": "FM"}
    with pytest.raises(InputError, match=r"Orientation is FM; it needs MF, UF, MN or UN"):
        read_sweep(write(tmp_path / "s.mha", fields))


def test_what_is_no_picture_as_it_is_shown_is_refused(tmp_path):
    fields = good_fields() | {"UltrasoundImageType": "BRIGHTNESS"}
    assert read_sweep(write(tmp_path / "s.mha", fields)).remarks == ()
    # Of three colours each, all alike, as some grabbers store grey.
    fields["UltrasoundImageType"] = "RGB_COLOR"
    alike = np.repeat(PIXELS[..., None], 3, axis=-1)
    sweep = read_sweep(write(tmp_path / "s.mha", fields, alike, vector=True))
    np.testing.assert_array_equal(sweep.images, PIXELS)
    fields["UltrasoundImageType"] = "RF_REAL"
    with pytest.raises(InputError, match="UltrasoundImageType is RF_REAL; it needs the brightness"):
        read_sweep(write(tmp_path / "s.mha", fields))


def test_compressed_pixels_of_unknown_length_are_refused(tmp_path):
    """The library would show them black."""
    path = write(tmp_path / "s.mha", good_fields(), compress=True)
    path.write_bytes(re.sub(rb"CompressedDataSize = \d+\n", b"", path.read_bytes()))
    with pytest.raises(InputError, match=r"does not say how long its compressed pixels are"):
        read_sweep(path)
    # A file of their own is as long as they are.
    path = write(tmp_path / "s.mhd", good_fields(), compress=True)
    path.write_bytes(re.sub(rb"CompressedDataSize = \d+\n", b"", path.read_bytes()))
    np.testing.assert_array_equal(read_sweep(path).images, PIXELS)


def test_compressed_pixels_are_unpacked_no_further_than_they_are_read(tmp_path):
    """A file of a hundred kilobytes would become a hundred megabytes, and take as much memory."""
    path = write(tmp_path / "s.mha", good_fields(), compress=True)
    header, pixels = path.read_bytes().split(b"ElementDataFile = LOCAL\n")
    bomb = zlib.compress(zlib.decompress(pixels) + bytes(100_000_000))
    header = re.sub(rb"(CompressedDataSize = )\d+", rb"\g<1>%d" % len(bomb), header)
    path.write_bytes(header + b"ElementDataFile = LOCAL\n" + bomb)
    tracemalloc.start()
    with suppress(InputError):
        read_sweep(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 20_000_000


def test_calibration_may_stand_once_for_the_file(tmp_path):
    fields = {k: v for k, v in good_fields().items() if "ImageToProbe" not in k}
    fields["ImageToProbeTransform"] = text(calibration())
    sweep = read_sweep(write(tmp_path / "s.mha", fields))
    np.testing.assert_allclose(sweep.tracker_from_image[1], rigid(1) @ calibration())


@pytest.mark.parametrize(
    "status", ["ProbeToTrackerTransformStatus", "ImageToProbeTransformStatus", "ImageStatus"]
)
def test_invalid_frames_are_left_out_and_counted(tmp_path, status):
    fields = good_fields()
    fields[f"Seq_Frame0001_{status}"] = "INVALID"
    # What a tracker writes while it does not see the marker must not matter.
    fields["Seq_Frame0001_ProbeToTrackerTransform"] = text(np.full((4, 4), np.nan))
    fields["Seq_Frame0001_Timestamp"] = "nan"
    sweep = read_sweep(write(tmp_path / "s.mha", fields))
    assert sweep.remarks == ("1 of 5 frames left out, which have no valid picture or pose",)
    np.testing.assert_array_equal(sweep.numbers, [0, 2, 3, 4])
    np.testing.assert_array_equal(sweep.images, PIXELS[[0, 2, 3, 4]])
    np.testing.assert_allclose(sweep.times_s, 3.0 + 0.05 * np.array([0, 2, 3, 4]))


def test_sweep_without_a_valid_frame_is_refused(tmp_path):
    fields = good_fields()
    for k in range(FRAMES):
        fields[f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus"] = "INVALID"
    with pytest.raises(InputError, match="none of its 5 frames"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("shared", [2, 3])
def test_a_sweep_that_is_another_once_more_is_refused(tmp_path, shared):
    """A recording that was copied, or cut in two that overlap, is no second view."""
    other = PIXELS.copy()
    other[shared:] += 1
    paths = [
        write(tmp_path / "one.mha", good_fields(), PIXELS),
        write(tmp_path / "two.mha", good_fields(), other),
    ]
    files = UltrasoundFiles(sweeps=tuple(paths))
    if shared == 2:
        assert len(read_sweeps(files)) == 2
        return
    with pytest.raises(InputError, match=r"two\.mha: 3 of its pictures are those of .*one\.mha"):
        read_sweeps(files)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"s\.mha: no such file"):
        read_sweep(tmp_path / "s.mha")


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.98])
def test_truncated_file_is_refused(tmp_path, kept, compress, capfd):
    path = write(tmp_path / "s.mha", good_fields(), compress=compress)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match=r"s\.mha: .*; copy it again") as told:
        read_sweep(path)
    if kept > 0.9:
        needed = int(re.search(rb"CompressedDataSize = (\d+)", content)[1]) if compress else 1020
        found = needed - len(content) + int(kept * len(content))
        assert f"need {needed} bytes, it holds {found} of them" in str(told.value)
    assert capfd.readouterr() == ("", ""), "the library's own lines are for nobody"


@pytest.mark.parametrize("name", ["s.raw", "s.zraw"])
def test_truncated_raw_file_is_named(tmp_path, name, capfd):
    path = write(tmp_path / "s.mhd", good_fields(), compress=name == "s.zraw")
    raw = tmp_path / name
    raw.write_bytes(raw.read_bytes()[:-100])
    with pytest.raises(InputError, match=rf"{name}: ends too early"):
        read_sweep(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("fault", ["damaged", "short"])
def test_compressed_pixels_that_cannot_be_unpacked_are_refused(tmp_path, fault, capfd):
    path = write(tmp_path / "s.mhd", good_fields(), compress=True)
    raw = tmp_path / "s.zraw"
    packed = bytearray(raw.read_bytes())
    if fault == "damaged":
        packed[300:400] = bytes(100)
    else:
        packed[:] = zlib.compress(bytes(500)).ljust(len(packed), b"\0")
    raw.write_bytes(packed)
    words = {"damaged": "compressed pixels are damaged", "short": "500 of them can be unpacked"}
    with pytest.raises(InputError, match=rf"s\.zraw: .*{words[fault]}"):
        read_sweep(path)
    assert capfd.readouterr() == ("", "")


def test_pixels_in_one_file_a_frame_are_left_to_the_library(tmp_path):
    path = write(tmp_path / "s.mhd", good_fields())
    path.write_text(path.read_text().replace("s.raw", "s%d.raw 0 4 1"))
    for k in range(FRAMES):
        (tmp_path / f"s{k}.raw").write_bytes(PIXELS[k].tobytes())
    np.testing.assert_array_equal(read_sweep(path).images, PIXELS)


def test_header_without_its_raw_file_is_refused(tmp_path, capfd):
    path = write(tmp_path / "s.mhd", good_fields())
    path.with_suffix(".raw").unlink()
    with pytest.raises(InputError, match=r"s\.mhd: its pixels are in .*s\.raw, which is no file"):
        read_sweep(path)
    assert capfd.readouterr() == ("", "")


def test_file_of_another_kind_is_refused(tmp_path, capfd):
    (tmp_path / "s.mha").write_text("not an image")
    with pytest.raises(InputError, match="no MetaImage file: it begins with 'not an image'"):
        read_sweep(tmp_path / "s.mha")
    assert capfd.readouterr() == ("", "")


def test_transforms_in_metres_are_told_but_not_refused(tmp_path):
    fields = good_fields()
    for k in range(FRAMES):
        pose = rigid(k)
        pose[:3, 3] /= 1000
        fields[f"Seq_Frame{k:04d}_ProbeToTrackerTransform"] = text(pose)
    sweep = read_sweep(write(tmp_path / "s.mha", fields))
    assert "ProbeToTracker looks as if it were in metres" in odd_transforms([sweep])
    moved = read_sweep(write(tmp_path / "t.mha", good_fields()))
    assert odd_transforms([sweep, moved]) == ""


def test_a_probe_held_still_is_not_told(tmp_path):
    fields = good_fields()
    for k in range(FRAMES):
        fields[f"Seq_Frame{k:04d}_ProbeToTrackerTransform"] = text(rigid(0))
    assert odd_transforms([read_sweep(write(tmp_path / "s.mha", fields))]) == ""


def test_a_probe_without_calibration_is_told(tmp_path):
    fields = good_fields()
    for k in range(FRAMES):
        fields[f"Seq_Frame{k:04d}_ImageToProbeTransform"] = text(np.eye(4))
    sweep = read_sweep(write(tmp_path / "s.mha", fields))
    assert "ImageToProbe is the identity" in odd_transforms([sweep])


@pytest.mark.parametrize("name", ["ProbeToTracker", "ImageToProbe"])
def test_missing_transform_is_named_with_those_that_are_there(tmp_path, name):
    fields = {k: v for k, v in good_fields().items() if f"{name}Transform" not in k}
    fields["Seq_Frame0000_StylusToTrackerTransform"] = text(np.eye(4))
    with pytest.raises(InputError, match=f"frame 0: has no {name}Transform.*StylusToTracker"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("name", ["ProbeToTracker", "ImageToProbe"])
@pytest.mark.parametrize("value", [text(np.full((4, 4), np.nan)), "1 0 0", "a b c", text([np.inf])])
def test_transform_that_is_not_16_finite_numbers_is_refused(tmp_path, name, value):
    fields = good_fields()
    fields[f"Seq_Frame0003_{name}Transform"] = value
    with pytest.raises(InputError, match=f"frame 3: {name}Transform needs 16 finite"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("fault", ["scaled", "mirrored", "last row"])
def test_probe_pose_that_is_not_rigid_is_refused(tmp_path, fault):
    pose = rigid(2)
    if fault == "last row":
        pose[3, 0] = 1.0
    else:
        pose[:3, 0] *= {"scaled": 1.01, "mirrored": -1.0}[fault]
    fields = good_fields()
    fields["Seq_Frame0002_ProbeToTrackerTransform"] = text(pose)
    words = r"frame 2: ProbeToTrackerTransform: is not a rotation"
    with pytest.raises(InputError, match=words) as told:
        read_sweep(write(tmp_path / "s.mha", fields))
    assert "transposed" not in str(told.value)


def test_probe_pose_in_columns_is_told(tmp_path):
    fields = good_fields() | {"Seq_Frame0002_ProbeToTrackerTransform": text(rigid(2).T)}
    with pytest.raises(InputError, match=r"frame 2: ProbeToTracker(.*\n)*.*looks transposed"):
        read_sweep(write(tmp_path / "s.mha", fields))


def test_probe_pose_of_few_decimals_is_told(tmp_path):
    fields = good_fields() | {"Seq_Frame0002_ProbeToTrackerTransform": text(rigid(2).round(2))}
    with pytest.raises(InputError, match=r"frame 2: ProbeToTracker(.*\n)*.*five decimals"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("fault", ["metres", "flat", "last row"])
def test_calibration_that_is_no_plane_in_mm_is_refused(tmp_path, fault):
    matrix = calibration(0.0005 if fault == "metres" else 0.5)
    if fault == "flat":
        matrix[:3, 1] = matrix[:3, 0]
    if fault == "last row":
        matrix[3, 3] = 2.0
    fields = good_fields() | {"Seq_Frame0000_ImageToProbeTransform": text(matrix)}
    with pytest.raises(InputError, match="frame 0: ImageToProbeTransform: is no calibration"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("time", ["3.05", "2.0"])
def test_time_that_does_not_rise_is_refused(tmp_path, time):
    fields = good_fields() | {"Seq_Frame0002_Timestamp": time}
    with pytest.raises(InputError, match=r"from frame 1 \(3\.05 s\) to frame 2"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("time", ["", "noon", "inf", None])
def test_frame_without_a_time_is_refused(tmp_path, time):
    fields = good_fields()
    del fields["Seq_Frame0002_Timestamp"]
    if time is not None:
        fields["Seq_Frame0002_Timestamp"] = time
    with pytest.raises(InputError, match="frame 2: Timestamp is"):
        read_sweep(write(tmp_path / "s.mha", fields))


@pytest.mark.parametrize("frames", [FRAMES - 1, FRAMES + 1])
def test_wrong_number_of_frames_is_refused(tmp_path, frames):
    pixels = np.zeros((frames, ROWS, COLUMNS), np.uint8)
    with pytest.raises(InputError, match=f"holds {frames} images but describes 5 frames"):
        read_sweep(write(tmp_path / "s.mha", good_fields(), pixels))


def test_image_without_frame_fields_is_refused(tmp_path):
    with pytest.raises(InputError, match="no Seq_Frame fields"):
        read_sweep(write(tmp_path / "s.mha", {}))


@pytest.mark.parametrize("shape", [(ROWS, COLUMNS), (FRAMES, 3, ROWS, COLUMNS)])
def test_frames_that_are_not_2d_are_refused(tmp_path, shape):
    with pytest.raises(InputError, match=f"has {len(shape)} dimensions"):
        read_sweep(write(tmp_path / "s.mha", good_fields(), np.zeros(shape, np.uint8)))


def test_pixels_that_are_no_numbers_are_refused_by_frame(tmp_path):
    spoilt = PIXELS.astype(np.float32)
    spoilt[1, 2, 3] = np.nan
    with pytest.raises(InputError, match="frame 1 has pixels that are no numbers"):
        read_sweep(write(tmp_path / "s.mha", good_fields(), spoilt))


def test_frames_one_pixel_thick_are_frames(tmp_path):
    path = write(tmp_path / "s.mha", good_fields(), PIXELS[:, None])
    np.testing.assert_array_equal(read_sweep(path).images, PIXELS)


def test_an_unknown_orientation_is_told(tmp_path):
    fields = good_fields() | {"UltrasoundImageOrientation": "XX"}
    (remark,) = read_sweep(write(tmp_path / "s.mha", fields)).remarks
    assert "orientation" in remark.lower()


def test_colour_frames_are_refused(tmp_path):
    colour = np.repeat(PIXELS[..., None], 3, axis=-1)
    grey = write(tmp_path / "grey.mha", good_fields(), colour, vector=True)
    np.testing.assert_array_equal(read_sweep(grey).images, PIXELS)
    colour[0, 0, 0, 2] += 1
    with pytest.raises(InputError, match="3 values a pixel"):
        read_sweep(write(tmp_path / "s.mha", good_fields(), colour, vector=True))
    # As PLUS stores it.
    kinds = b"Kinds = vector domain domain list\nDimSize = 3 17 12 5"
    grey.write_bytes(grey.read_bytes().replace(b"DimSize = 17 12 5", kinds))
    with pytest.raises(InputError, match=r"has 3 values a pixel \(Kinds begins with vector\)"):
        read_sweep(grey)
