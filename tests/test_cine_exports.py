"""What scanners and archives put beside a cine, or write otherwise than is usual."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    COLUMNS,
    NORMAL,
    ORIGIN_MM,
    PHASES,
    PIXEL_MM,
    ROWS,
    RR_MS,
    SLICES,
    STEP_MM,
    across,
    assert_is_the_stack,
    beside_the_stack,
    coarser,
    dicom_frame,
    enhanced_object,
    in_series,
    item,
    read_dicom_cine,
    series,
    write_dicom,
)
from pydicom import dcmread
from pydicom.dataset import Dataset, FileDataset
from pydicom.uid import MediaStorageDirectoryStorage

from pipeline.errors import InputError
from pipeline.imaging.dicom_timing import rr_intervals_ms

AT_ONE_MOMENT = [400.0 + 0.5 * k for k in range(40)]


def first_pass() -> list[FileDataset]:
    """Perfusion: each slice at a moment of its own, in many beats."""
    return [
        data
        for number in range(3)
        for data in series([number], [100.0 + 250.0 * number + 0.5 * k for k in range(40)])
    ]


@pytest.mark.parametrize(
    "others",
    [
        series([0, 1, 2], AT_ONE_MOMENT),
        coarser(series([0, 1, 2], AT_ONE_MOMENT)),
        first_pass(),
        coarser(first_pass()),
        series([2], AT_ONE_MOMENT),
        series([SLICES, SLICES + 1], [500.0]),
    ],
    ids=[
        *("perfusion", "perfusion, other pixels", "first pass", "first pass, other pixels"),
        *("mapping", "late enhancement beyond the stack"),
    ],
)
def test_what_shows_one_moment_of_the_beat_is_no_cine_however_many_images_it_has(
    tmp_path: Path, others: list[FileDataset]
) -> None:
    stack = read_dicom_cine(beside_the_stack(tmp_path, others))
    assert_is_the_stack(stack)
    assert len(stack.left_out) == 1
    assert f'series 9 "other": {len(others)} images' in stack.left_out[0]
    assert "no cine" in stack.left_out[0]
    assert stack.remarks == ()


def velocity_maps() -> list[FileDataset]:
    found = across(SLICES + 2, "ORIGINAL")
    for data in found:
        data.ImageType = ["ORIGINAL", "PRIMARY", "P"]
    return found


@pytest.mark.parametrize(
    "others", [velocity_maps, lambda: across(SLICES + 2, "DERIVED")], ids=["velocity", "derived"]
)
def test_what_is_no_original_magnitude_does_not_go_before_the_stack_for_its_number(
    tmp_path: Path, others: Callable[[], list[FileDataset]]
) -> None:
    stack = read_dicom_cine(beside_the_stack(tmp_path, others()))
    assert_is_the_stack(stack)
    assert "not parallel" in stack.left_out[0]


@pytest.mark.parametrize("slices", [3, SLICES + 1])
def test_images_of_another_patient_are_refused_even_where_they_would_be_left_out(
    tmp_path: Path, slices: int
) -> None:
    others = across(slices, "ORIGINAL")
    for data in others:
        data.PatientID = "somebody else"
    beside_the_stack(tmp_path, others)
    for path in tmp_path.glob("0*.dcm"):
        data = dcmread(path)
        data.PatientID = "somebody"
        data.save_as(path)
    with pytest.raises(InputError, match="different PatientIDs; a study is of one patient"):
        read_dicom_cine(tmp_path)


def in_colour() -> FileDataset:
    data = dicom_frame(0, 0)
    data.SamplesPerPixel, data.PhotometricInterpretation = 3, "RGB"
    data.PlanarConfiguration, data.BitsAllocated, data.BitsStored, data.HighBit = 0, 8, 8, 7
    data.PixelData = bytes(3 * data.Rows * data.Columns)
    return data


def without_place() -> FileDataset:
    data = dicom_frame(0, 0)
    data.ImageType = ["DERIVED", "SECONDARY", "OTHER"]
    del data.ImagePositionPatient, data.ImageOrientationPatient
    return data


def many_in_one() -> FileDataset:
    data = dicom_frame(0, 0)
    data.ImageType = ["DERIVED", "SECONDARY", "OTHER"]
    data.NumberOfFrames = 3
    data.PixelData = 3 * data.PixelData
    return data


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (in_colour, "in colour"),
        (without_place, "without a place in space"),
        (many_in_one, "without a place in space"),
    ],
)
def test_maps_and_graphs_that_are_mr_objects_are_left_out(
    tmp_path: Path, other: Callable[[], FileDataset], words: str
) -> None:
    stack = read_dicom_cine(beside_the_stack(tmp_path, [other()]))
    assert_is_the_stack(stack)
    assert f"MR Image Storage, {words}" in stack.left_out[0]


def test_an_original_image_without_a_place_is_refused(tmp_path: Path) -> None:
    data = without_place()
    data.ImageType = ["ORIGINAL", "PRIMARY", "M"]
    with pytest.raises(InputError, match="has no ImagePositionPatient"):
        read_dicom_cine(beside_the_stack(tmp_path, [data]))


def test_several_frames_that_do_not_say_where_they_lie_are_refused(tmp_path: Path) -> None:
    data = dicom_frame(0, 0)
    data.NumberOfFrames = 3
    data.PixelData = 3 * data.PixelData
    with pytest.raises(InputError, match="has 3 frames, and does not say where and when"):
        read_dicom_cine(beside_the_stack(tmp_path, [data]))


def test_what_systems_leave_is_passed_over_and_foreign_files_are_told_at_once(
    tmp_path: Path,
) -> None:
    beside_the_stack(tmp_path, [])
    directory = dicom_frame(0, 0)
    directory.file_meta.MediaStorageSOPClassUID = MediaStorageDirectoryStorage
    directory.save_as(tmp_path / "dicomdir")
    for name in ("Thumbs.db", ".DS_Store", "desktop.ini", "DICOMDIR"):
        (tmp_path / name).write_bytes(b"left")
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert stack.left_out == ()
    beside = {"Case.CSV": b"x", "viewer.exe": b"MZ", "AUTORUN.INF": b"x", "README": b"As you\n"}
    for name, content in {**beside, "study.yaml": b"x", "EMPTY": b"", "IM7": b"\0\1x"}.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "ANNOTATED.seq.NRRD").touch()
    with pytest.raises(
        InputError, match=r"NRRD: is an image, but neither DICOM nor .nii.*4D \.nii\.gz"
    ):
        read_dicom_cine(tmp_path)
    (tmp_path / "ANNOTATED.seq.NRRD").unlink()
    with pytest.raises(InputError, match=r"EMPTY and 1 more \(IM7\): is not"):
        read_dicom_cine(tmp_path)
    (tmp_path / "IM7").unlink()
    (tmp_path / "EMPTY").rename(tmp_path / "cine.zip")
    with pytest.raises(InputError, match=r"cine\.zip: is an archive; unpack it"):
        read_dicom_cine(tmp_path)
    (tmp_path / "cine.zip").unlink()
    told = read_dicom_cine(tmp_path).left_out
    assert told == ("notes: 5 files (the first is AUTORUN.INF): not DICOM",)


@pytest.mark.filterwarnings("ignore:Invalid value for VR IS")
def test_a_series_that_is_not_numbered_is_read(tmp_path: Path) -> None:
    def label(data: FileDataset, number: int, phase: int) -> bool:
        data.add_new("SeriesNumber", "LO", "S1")
        return True

    write_dicom(tmp_path, label)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_directions_of_few_decimals_are_read(tmp_path: Path) -> None:
    """Three: what was of length 1 is 0.9998 long, whose square is the cosine of 1.2 degrees."""
    axes = np.array([[0.776, 0.622, 0.105], [-0.297, 0.507, -0.809]])
    normal = np.cross(*axes)

    def turn(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageOrientationPatient = axes.ravel().tolist()
        data.ImagePositionPatient = (number * STEP_MM * normal).round(1).tolist()
        return True

    write_dicom(tmp_path, turn)
    cine = read_dicom_cine(tmp_path).cine
    assert cine.intensity.shape == (PHASES, SLICES, ROWS, COLUMNS)
    np.testing.assert_allclose(cine.spacing_mm[:2], PIXEL_MM[::-1], atol=1e-9)
    found = cine.mr_from_index[:3, :2] / cine.spacing_mm[:2]
    np.testing.assert_allclose(found.T, axes, atol=5e-4)
    assert abs(found[:, 0] @ found[:, 1]) < 1e-9


def test_times_that_a_converter_left_among_the_unassigned_are_read(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    data.SOPClassUID = "1.2.840.10008.5.1.4.1.1.4.4"
    shared: Dataset = data.SharedFunctionalGroupsSequence[0]
    shared.UnassignedSharedConvertedAttributesSequence = item(NominalInterval=int(RR_MS))
    for own, (_, phase) in zip(data.PerFrameFunctionalGroupsSequence, ALL_FRAMES, strict=True):
        del own.CardiacSynchronizationSequence
        time_ms = phase * RR_MS / PHASES
        own.UnassignedPerFrameConvertedAttributesSequence = item(TriggerTime=time_ms)
    data.save_as(tmp_path / "converted.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def again_beside_its_place(data: FileDataset, number: int, phase: int) -> bool:
    data.ImagePositionPatient = (
        ORIGIN_MM + (number - 0.9 * (number == 3)) * STEP_MM * NORMAL
    ).tolist()
    return True


def without_times(data: FileDataset, number: int, phase: int) -> bool:
    data.TriggerTime = 0
    return True


def prospective(data: FileDataset, number: int, phase: int) -> bool:
    data.TriggerTime, data.NominalInterval = 150.0 * phase, 700 + 150 * number
    return True


def most_missing(data: FileDataset, number: int, phase: int) -> bool:
    data.ImagePositionPatient = (ORIGIN_MM + [0, 8, 32, 56][number] * NORMAL).tolist()
    return True


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (most_missing, "missing slice between"),
        (
            again_beside_its_place,
            "given twice, .*slices 2 and 3 lie 1.00 mm apart: images of.*leave_out",
        ),
        (without_times, "do not tell its phases apart"),
        (prospective, "same in all slices and RR intervals differ, cine.rr_ms"),
    ],
)
def test_messages_name_what_is_at_fault(tmp_path: Path, change: Any, words: str) -> None:
    write_dicom(tmp_path, change)
    with pytest.raises(InputError, match=words):
        read_dicom_cine(tmp_path)


def test_one_rr_interval_for_all_serves_prospective_triggering(tmp_path: Path) -> None:
    write_dicom(tmp_path, prospective)
    cine = read_dicom_cine(tmp_path, rr_ms=900.0).cine
    np.testing.assert_allclose(cine.phases, 150 * np.arange(PHASES) / 900)


def of_ge(part: int) -> Callable[[FileDataset], None]:
    def change(data: FileDataset) -> None:
        data.private_block(0x0043, "GEMS_PARM_01", create=True).add_new(0x2F, "SS", part)

    return change


def test_what_no_vendor_writes_in_its_place_tells_nothing(tmp_path: Path) -> None:
    def marked(data: FileDataset, number: int, phase: int) -> bool:
        block = data.private_block(0x0043, "GEMS_PARM_01", create=True)
        block.add_new(0x2F, "SS", [1, 2])
        return True

    write_dicom(tmp_path, marked)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def of_type(*values: str) -> Callable[[FileDataset], None]:
    def change(data: FileDataset) -> None:
        data.ImageType = ["ORIGINAL", "PRIMARY", *values]

    return change


@pytest.mark.parametrize(
    "change",
    [of_ge(1), of_ge(3), of_type("R_FFE", "R"), of_type("I_FFE", "I"), of_type("PHASE MAP", "P")],
)
def test_parts_of_complex_images_in_the_cines_own_series_are_left_out(
    tmp_path: Path, change: Callable[[FileDataset], None]
) -> None:
    others = [dicom_frame(*which) for which in ALL_FRAMES]
    for data in others:
        data.PixelData = (data.pixel_array + 500).tobytes()
        change(data)
    write_dicom(tmp_path, lambda data, number, phase: bool(in_series(data, 1, "cine")))
    for k, data in enumerate(others):
        in_series(data, 1, "cine").save_as(tmp_path / f"other_{k}.dcm")
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert f"{len(others)} images" in stack.left_out[0]


def test_a_frames_own_rr_interval_goes_before_that_of_its_whole_object() -> None:
    frame, whole = Dataset(), Dataset()
    frame.RRIntervalTimeNominal, whole.RRIntervalTimeNominal = 800.0, 950.0
    whole.HeartRate = 60
    assert rr_intervals_ms(frame, whole) == {"RRIntervalTimeNominal": 800.0, "HeartRate": 1000.0}
    assert rr_intervals_ms(Dataset(), whole)["RRIntervalTimeNominal"] == 950.0


def test_finer_images_in_real_time_are_not_named_as_the_better_stack(tmp_path: Path) -> None:
    """An image every 0.9 s, of beats of 0.8 s."""
    others = series([*range(SLICES)], [0.0, 900.0, 1800.0, 2700.0])
    for data in others:
        data.PixelSpacing = [value / 2 for value in PIXEL_MM]
    stack = read_dicom_cine(beside_the_stack(tmp_path, others))
    assert_is_the_stack(stack)
    assert stack.remarks == ()
    assert "many beats in real time" in stack.left_out[0]
