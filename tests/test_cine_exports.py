"""What scanners and archives put beside a cine, or write otherwise than is usual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    ROW_AXIS,
    ROWS,
    RR_MS,
    SLICES,
    STEP_MM,
    assert_is_the_stack,
    dicom_frame,
    enhanced_object,
    in_series,
    item,
    pixel_value,
    read_dicom_cine,
    write_dicom,
)
from pydicom import dcmread
from pydicom.dataset import Dataset, FileDataset
from pydicom.uid import MediaStorageDirectoryStorage

from pipeline.errors import InputError


def beside_the_stack(folder: Path, others: list[FileDataset]) -> Path:
    """The good stack as series 1, and other images as series 9."""
    write_dicom(folder, lambda data, number, phase: bool(in_series(data, 1, "short axis")))
    for k, data in enumerate(others):
        in_series(data, 9, "other").save_as(folder / f"other_{k:03d}.dcm")
    return folder


def series(slices: list[int], times_ms: list[float]) -> list[FileDataset]:
    """Images of some slices at some moments that none of the stack's equals."""
    found = []
    for number in slices:
        for k, time_ms in enumerate(times_ms):
            data = dicom_frame(number, 0)
            data.TriggerTime = time_ms
            data.PixelData = (3 * pixel_value(k, number)).tobytes()
            found.append(data)
    return found


def coarser(found: list[FileDataset]) -> list[FileDataset]:
    for data in found:
        data.PixelSpacing = [2 * value for value in data.PixelSpacing]
    return found


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


def test_a_slice_stored_in_two_series_of_which_one_is_short_stays_whole(tmp_path: Path) -> None:
    def parted(data: FileDataset, number: int, phase: int) -> bool:
        data.TriggerTime = 20.0 * phase + 600.0 * (phase > 1)
        in_series(data, 2 if (number, phase > 2) == (1, True) else 1, "part")
        return True

    write_dicom(tmp_path, parted)
    assert read_dicom_cine(tmp_path).cine.intensity.shape[:2] == (PHASES, SLICES)


def by_percentage(number: int, phase: int) -> FileDataset:
    """An image whose trigger time tells nothing, as some scanners write for Enhanced cines."""
    data = dicom_frame(number, phase)
    data.TriggerTime = 0
    data.NominalPercentageOfCardiacPhase = 100 * phase / PHASES
    return data


@pytest.mark.parametrize("late", [False, True])
def test_stills_and_other_stacks_are_told_from_a_cine_timed_by_percentage(
    tmp_path: Path, late: bool
) -> None:
    others = series([0, 1, 2, 3], [500.0]) if late else across(3, "ORIGINAL")
    for data in others:
        data.NominalPercentageOfCardiacPhase = 100 * float(data.TriggerTime) / RR_MS
    for k, data in enumerate([by_percentage(*which) for which in ALL_FRAMES]):
        in_series(data, 1, "short axis").save_as(tmp_path / f"{k:03d}.dcm")
    for k, data in enumerate(others):
        in_series(data, 9, "other").save_as(tmp_path / f"other_{k:03d}.dcm")
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert len(stack.left_out) == 1
    assert ("no cine" in stack.left_out[0]) is late
    assert bool(stack.remarks) is not late


@pytest.mark.parametrize("whole", [(3,), (0, 1)])
def test_a_cine_of_a_series_a_phase_may_have_slices_of_one_series(
    tmp_path: Path, whole: tuple[int, ...]
) -> None:
    def by_phase(data: FileDataset, number: int, phase: int) -> bool:
        return bool(in_series(data, 20 + number if number in whole else phase, "cine"))

    write_dicom(tmp_path, by_phase)
    assert_is_the_stack(read_dicom_cine(tmp_path))


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


def across(slices: int, kind: str, phases: int = PHASES) -> list[FileDataset]:
    """A cine stack in another direction."""
    found = series(list(range(slices)), [RR_MS * k / phases for k in range(phases)])
    for data in found:
        number = round(float((np.array(data.ImagePositionPatient) - ORIGIN_MM) @ NORMAL) / STEP_MM)
        data.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = [0, 0, number * STEP_MM]
        data.ImageType = [kind, "PRIMARY", "M"]
    return found


def test_a_stack_of_another_direction_is_told_whichever_is_larger(tmp_path: Path) -> None:
    stack = read_dicom_cine(beside_the_stack(tmp_path / "less", across(3, "ORIGINAL")))
    assert_is_the_stack(stack)
    assert 'series 9 "other" (' in stack.remarks[0]
    assert "cine of 3 slices too" in stack.remarks[0]
    stack = read_dicom_cine(beside_the_stack(tmp_path / "more", across(SLICES + 1, "ORIGINAL")))
    assert stack.cine.intensity.shape[1] == SLICES + 1
    assert 'series 1 "short axis" (' in stack.remarks[0]


def test_a_few_original_slices_do_not_go_before_a_derived_stack_across(tmp_path: Path) -> None:
    def derived(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageType = ["DERIVED", "PRIMARY", "DIS2D"]
        return bool(in_series(data, 1, "short axis"))

    write_dicom(tmp_path, derived)
    for k, data in enumerate(across(3, "ORIGINAL", phases=3)):
        in_series(data, 9, "two chambers").save_as(tmp_path / f"other_{k:03d}.dcm")
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert "two chambers" in stack.remarks[0]


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
        InputError, match=r"NRRD: is an image, but neither DICOM nor NIfTI.*4D \.nii\.gz"
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
        (again_beside_its_place, "slices 2 and 3 lie 1.00 mm apart.*given twice, by images of"),
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


@pytest.mark.parametrize("matrix", [coarser, list])
@pytest.mark.parametrize("untold", [False, True])
@pytest.mark.parametrize("slices", [range(SLICES), range(1, SLICES + 2), [2]])
def test_images_in_real_time_do_not_go_before_a_cine_for_their_number(
    tmp_path: Path, slices: Sequence[int], untold: bool, matrix: Callable[..., list[FileDataset]]
) -> None:
    """Their times run through many beats; they may have the cine's own matrix."""
    beats = matrix(series([*slices], [200.0 * k for k in range(4 * PHASES)]))
    if untold:
        for data in beats:
            del data.NominalInterval
    folder = beside_the_stack(tmp_path, beats)
    stack = read_dicom_cine(folder)
    assert_is_the_stack(stack)
    assert 'series 9 "other"' in stack.left_out[0]
    assert "many beats in real time, no cine" in stack.left_out[0]


def test_a_slice_that_runs_over_its_beat_does_not_make_a_cine_real_time(tmp_path: Path) -> None:
    scout = coarser(series([*range(SLICES)], [100.0, 400.0]))
    folder = beside_the_stack(tmp_path, scout)

    def late(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "short axis")
        if (number, phase) == (2, PHASES - 1):
            data.TriggerTime = 812
        return True

    write_dicom(folder, late)
    # What is refused is the cine, for that image: a smaller set does not take its place.
    with pytest.raises(InputError, match=r"812 ms do not fit in an .* of 800 ms \(slice 2\)"):
        read_dicom_cine(folder)


@pytest.mark.parametrize("uids", ["one", "each"])
def test_series_are_told_apart_by_number_where_their_uids_are_lost(
    tmp_path: Path, uids: str
) -> None:
    """Late enhancement of the stack's slices is no further phase of them."""
    enhancement = series([*range(SLICES)], [650.0])
    folder = beside_the_stack(tmp_path, enhancement)
    for k, path in enumerate(sorted(folder.glob("*.dcm"))):
        data = dcmread(path)
        data.SeriesInstanceUID = "1.2.3" if uids == "one" else f"1.2.3.{k + 1}"
        data.save_as(path)
    stack = read_dicom_cine(folder)
    assert_is_the_stack(stack)
    assert "one moment of the beat, no cine" in stack.left_out[0]


def test_slices_of_two_examinations_are_told(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.StudyInstanceUID = "1.2.1" if number < SLICES - 1 else "1.2.2"
        return True

    write_dicom(tmp_path, change)
    assert "different StudyInstanceUIDs" in read_dicom_cine(tmp_path).remarks[0]


def test_two_acquisitions_in_one_series_are_not_mixed(tmp_path: Path) -> None:
    """Times differ by a trifle, as RR intervals do: nothing else would part them."""

    def numbered(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "short axis").AcquisitionNumber = 1
        return True

    write_dicom(tmp_path, numbered)
    for k, (number, phase) in enumerate(ALL_FRAMES):
        data = in_series(dicom_frame(number, phase), 1, "short axis")
        data.TriggerTime, data.AcquisitionNumber = phase * RR_MS / PHASES + 2, 2
        data.PixelData = (data.pixel_array + 3).tobytes()
        data.save_as(tmp_path / f"again_{k}.dcm")
    words = r'slice 0 is given twice: by series 1 "short axis", acquisition 1, .*, and by series 1 '
    with pytest.raises(InputError, match=words + r".*take the other's files out$"):
        read_dicom_cine(tmp_path)


@pytest.mark.parametrize("aside_mm", [0.05, 6.0])
def test_phases_of_a_slice_lie_in_one_place(tmp_path: Path, aside_mm: float) -> None:
    def later_aside(data: FileDataset, number: int, phase: int) -> bool:
        if number == 2 and phase > 2:
            place_mm = np.array(data.ImagePositionPatient, float) + aside_mm * ROW_AXIS
            data.ImagePositionPatient = place_mm.tolist()
        return True

    write_dicom(tmp_path, later_aside)
    if aside_mm < 0.1:
        assert_is_the_stack(read_dicom_cine(tmp_path))
    else:
        with pytest.raises(InputError, match=r"phases of slice 2 lie in .*6\.00 mm"):
            read_dicom_cine(tmp_path)


def test_a_cine_that_tells_its_beat_goes_before_images_in_real_time_that_do_not(
    tmp_path: Path,
) -> None:
    """They are more, and last no longer than a slow heart's beat."""
    beats = coarser(series([*range(SLICES)], [100.0 * k for k in range(4 * PHASES)]))
    for data in beats:
        del data.NominalInterval
    assert_is_the_stack(read_dicom_cine(beside_the_stack(tmp_path, beats)))


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


@pytest.mark.parametrize(("rate", "told"), [(75, False), (60, False), (40, True), (150, True)])
def test_a_heart_rate_that_contradicts_the_interval_is_told(
    tmp_path: Path, rate: int, told: bool
) -> None:
    def rated(data: FileDataset, number: int, phase: int) -> bool:
        data.HeartRate = rate
        return True

    write_dicom(tmp_path, rated)
    stack = read_dicom_cine(tmp_path)
    assert stack.cine.rr_s == RR_MS / 1000
    assert [one for one in stack.remarks if "HeartRate" in one] == list(stack.remarks)
    assert len(stack.remarks) == told


def test_a_finer_stack_that_was_not_taken_is_told(tmp_path: Path) -> None:
    more = coarser(series([*range(SLICES)], [60.0 * k for k in range(2 * PHASES)]))
    (remark,) = read_dicom_cine(beside_the_stack(tmp_path, more)).remarks
    assert "a cine of 4 slices in the same direction, and of finer pixels than series 9" in remark
