"""Which images of a folder are the cine's, where several series could be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    PHASES,
    ROW_AXIS,
    RR_MS,
    SLICES,
    across,
    assert_is_the_stack,
    beside_the_stack,
    coarser,
    dicom_frame,
    in_series,
    read_dicom_cine,
    series,
    write_dicom,
)
from pydicom import dcmread
from pydicom.dataset import FileDataset

from pipeline.errors import InputError


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
    words = r'slices 0 to 3 are given twice: by series 1 "short axis", acquisition 1, .*, and by '
    with pytest.raises(InputError, match=words + r"series 1 .*take the other's files out$"):
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
