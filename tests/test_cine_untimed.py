"""A cine in DICOM whose files do not tell when its images were taken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    PHASES,
    PIXEL_MM,
    RR_MS,
    SLICES,
    assert_is_the_stack,
    dicom_frame,
    enhanced_object,
    in_series,
    item,
    pixel_value,
    read_dicom_cine,
    write_dicom,
)
from pydicom.dataset import FileDataset

from pipeline.errors import InputError
from pipeline.imaging.dicom import read_dicom_study


def without_times(data: FileDataset, number: int, phase: int) -> bool:
    in_series(data, 1, "short axis")
    del data.TriggerTime
    data.InstanceNumber = 1 + number * PHASES + phase
    return True


@pytest.mark.parametrize("time_ms", [None, 0, 12.5])
def test_images_that_do_not_tell_their_time_are_spread_over_an_rr_interval_that_is_given(
    tmp_path: Path, time_ms: float | None
) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        without_times(data, number, phase)
        if time_ms is not None:
            data.TriggerTime = time_ms
        return True

    write_dicom(tmp_path, change)
    # One image of a slice, such as a localiser, has no phase.
    other = in_series(dicom_frame(0, 0), 9, "localiser")
    other.PixelSpacing = [3, 3]
    other.save_as(tmp_path / "localiser.dcm")
    with pytest.raises(InputError, match=r"cine\.rr_ms in study\.yaml, by which phases are spread"):
        read_dicom_cine(tmp_path)
    stack = read_dicom_cine(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert stack.timing_source == "study.yaml"
    assert "in the order of their InstanceNumber, evenly" in stack.remarks[0]
    assert "across it" not in stack.remarks[0]


def test_an_rr_interval_of_ones_own_leaves_times_that_files_tell(tmp_path: Path) -> None:
    times_ms = [0, 130, 300, 500, 650]

    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.TriggerTime, data.InstanceNumber = times_ms[phase], 1 + phase
        return True

    write_dicom(tmp_path, change)
    stack = read_dicom_cine(tmp_path, RR_MS)
    np.testing.assert_allclose(stack.cine.phases, np.array(times_ms) / RR_MS)
    assert stack.remarks == ()


@pytest.mark.parametrize("number", [None, 3])
def test_images_of_neither_time_nor_number_are_refused(tmp_path: Path, number: int | None) -> None:
    def change(data: FileDataset, slice_number: int, phase: int) -> bool:
        without_times(data, slice_number, phase)
        data.InstanceNumber = number
        return True

    write_dicom(tmp_path, change)
    with pytest.raises(InputError, match=r"has no trigger time.*cine\.rr_ms alone does not do"):
        read_dicom_cine(tmp_path, RR_MS)


@pytest.mark.parametrize("rr_ms", [None, RR_MS])
def test_one_image_without_a_time_is_named(tmp_path: Path, rr_ms: float | None) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "short axis")
        if (number, phase) == (1, 2):
            del data.TriggerTime
        return True

    write_dicom(tmp_path, change)
    with pytest.raises(InputError, match=r"no trigger time, as 1 of the stack's \d+ images.*again"):
        read_dicom_cine(tmp_path, rr_ms)


@pytest.mark.parametrize("how", ["twice", "uid a file", "uid a phase"])
def test_copies_and_uids_do_not_hinder_the_order(tmp_path: Path, how: str) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        without_times(data, number, phase)
        if how == "uid a file":
            data.SeriesInstanceUID = f"1.2.{data.InstanceNumber}"
        if how == "uid a phase":
            data.SeriesInstanceUID = f"1.2.{phase + 1}"
        return True

    write_dicom(tmp_path / "cine", change)
    if how == "twice":
        write_dicom(tmp_path / "cine" / "again", change)
    assert_is_the_stack(read_dicom_cine(tmp_path / "cine", RR_MS))


def test_the_same_images_as_classic_and_enhanced_objects_are_one_beat(tmp_path: Path) -> None:
    write_dicom(tmp_path, without_times)
    data = in_series(enhanced_object(ALL_FRAMES), 1, "short axis")
    for frame in data.PerFrameFunctionalGroupsSequence:
        del frame.CardiacSynchronizationSequence
    data.save_as(tmp_path / "enhanced.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path, RR_MS))


@pytest.mark.parametrize("objects", [1, 2, SLICES, PHASES])
def test_frames_of_enhanced_objects_are_taken_in_their_order(tmp_path: Path, objects: int) -> None:
    for k in range(objects):
        part = [
            (number, phase)
            for number, phase in ALL_FRAMES
            if k == {1: 0, 2: phase // 3, SLICES: number, PHASES: phase}[objects]
        ]
        data = enhanced_object(part)
        data.InstanceNumber = k + 1
        for frame in data.PerFrameFunctionalGroupsSequence:
            del frame.CardiacSynchronizationSequence
        data.save_as(tmp_path / f"{k}.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path, RR_MS))


def real_time(count: int, across: bool = False) -> list[FileDataset]:
    found = []
    for number in range(SLICES):
        for k in range(count):
            data = in_series(dicom_frame(number, 0), 9, "real time")
            del data.TriggerTime
            data.InstanceNumber = 1 + number * count + k
            data.PixelSpacing = [3, 3]
            data.PixelData = (3 * pixel_value(k, number)).tobytes()
            if across:
                data.ImageOrientationPatient = [0, 1, 0, 0, 0, -1]
            found.append(data)
    return found


def test_of_two_untimed_stacks_of_one_direction_none_is_taken_for_its_number(
    tmp_path: Path,
) -> None:
    write_dicom(tmp_path, without_times)
    for k, data in enumerate(real_time(4 * PHASES)):
        data.save_as(tmp_path / f"other_{k}.dcm")
    with pytest.raises(
        InputError, match=r"do not tell when.*with 20; one may be in real time.*leave_out_series"
    ):
        read_dicom_cine(tmp_path, RR_MS)
    stack, _ = read_dicom_study(tmp_path, RR_MS, without_series=[9])
    assert_is_the_stack(stack)


@pytest.mark.parametrize(
    ("count", "views"), [(PHASES, 1), (PHASES + 1, 1), (7, 0), (4 * PHASES, 0), (2, 0)]
)
def test_what_lies_across_is_spread_where_it_has_as_many_images(
    tmp_path: Path, count: int, views: int
) -> None:
    """A cine has; perfusion, maps and localisers do not."""
    write_dicom(tmp_path, without_times)
    for data in real_time(count, across=True)[:count]:
        data.save_as(tmp_path / f"other_{data.InstanceNumber}.dcm")
    stack, found = read_dicom_study(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert len(found) == views
    assert ('series 9 "real time"' in stack.remarks[0]) == bool(views)
    assert (stack.left_out[-1].endswith("it has no trigger times")) == (not views)


def test_frames_that_tell_their_order_in_time_need_not_be_stored_in_it(tmp_path: Path) -> None:
    """DICOM PS3.3 C.7.6.16.2.2: TemporalPositionIndex rises with time, from 1."""
    order = ALL_FRAMES[::-1]
    data = enhanced_object(order)
    for frame, (_, phase) in zip(data.PerFrameFunctionalGroupsSequence, order, strict=True):
        del frame.CardiacSynchronizationSequence
        frame.FrameContentSequence = item(TemporalPositionIndex=phase + 1)
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path, RR_MS))


def plain(count: int, **changes: object) -> list[FileDataset]:
    """Another stack in the stack's direction, on its matrix but of other pixels."""
    found = real_time(count)
    for data in found:
        for name, value in changes.items():
            setattr(data, name, value)
    return found


def test_real_time_without_times_beside_a_stack_that_has_them_is_left_as_it_is(
    tmp_path: Path,
) -> None:
    """Spread over a beat it would be the stack, for it has more images."""
    write_dicom(tmp_path, lambda data, number, phase: bool(in_series(data, 1, "short axis")))
    for k, data in enumerate(plain(4 * PHASES)):
        data.save_as(tmp_path / f"other_{k}.dcm")
    stack = read_dicom_cine(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert stack.remarks == ()


@pytest.mark.parametrize("timed", [False, True])
def test_derived_images_of_one_direction_do_not_hinder_the_order(
    tmp_path: Path, timed: bool
) -> None:
    write_dicom(tmp_path, without_times)
    for k, data in enumerate(plain(PHASES, ImageType=["DERIVED", "SECONDARY", "M"])):
        if timed:
            data.TriggerTime = k % PHASES * RR_MS / PHASES
        data.save_as(tmp_path / f"other_{k}.dcm")
    stack = read_dicom_cine(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert len(stack.left_out) == 1


def test_what_tells_nearly_one_moment_is_not_spread(tmp_path: Path) -> None:
    """A map across the stack: as many images, a millisecond apart."""
    write_dicom(tmp_path, without_times)
    for k, data in enumerate(real_time(PHASES, across=True)[:PHASES]):
        data.TriggerTime = 300 + k
        data.save_as(tmp_path / f"other_{k}.dcm")
    stack, views = read_dicom_study(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert views == ()
    assert "all at nearly one moment of the beat" in stack.left_out[-1]


def test_a_stack_that_was_taken_twice_is_not_one_of_twice_as_many_phases(tmp_path: Path) -> None:
    write_dicom(tmp_path, without_times)
    for k, data in enumerate(plain(PHASES, PixelSpacing=list(PIXEL_MM))):
        data.InstanceNumber = 1000 + k
        data.save_as(tmp_path / f"other_{k}.dcm")
    with pytest.raises(InputError, match="slices 0 to 3 are given twice: by series 1"):
        read_dicom_cine(tmp_path, RR_MS)


@pytest.mark.parametrize("number", [None, 1])
def test_a_slice_of_two_acquisitions_is_not_one_of_twice_as_many_phases(
    tmp_path: Path, number: int | None
) -> None:
    """Two heartbeats in one; ``number``: the slice that was taken twice, None: all were."""

    def change(data: FileDataset, slice_number: int, phase: int) -> bool:
        without_times(data, slice_number, phase)
        data.AcquisitionNumber = 1
        return True

    write_dicom(tmp_path, change)
    for again, phase in ALL_FRAMES:
        if number in (None, again):
            data = dicom_frame(again, phase)
            without_times(data, again, phase)
            data.InstanceNumber += 1000
            data.AcquisitionNumber = 2
            data.PixelData = (pixel_value(phase, again) + 1000).tobytes()
            data.save_as(tmp_path / f"again_{again}_{phase}.dcm")
    which = "slices 0 to 3 are" if number is None else f"slice {number} is"
    with pytest.raises(InputError, match=f"{which} given twice.*acquisition 1.*acquisition 2.*out"):
        read_dicom_cine(tmp_path, RR_MS)


@pytest.mark.parametrize("of_phase", [lambda phase: phase, lambda phase: min(phase, 1)])
def test_acquisitions_that_are_no_beat_each_leave_a_slice_whole(
    tmp_path: Path, of_phase: Callable[[int], int]
) -> None:
    """A number that counts the images, and one that a single image has of its own."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.AcquisitionNumber = of_phase(phase)
        return without_times(data, number, phase)

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path, RR_MS))


def test_a_cine_that_is_called_derived_throughout_is_spread(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageType = ["DERIVED", "SECONDARY", "M"]
        return without_times(data, number, phase)

    write_dicom(tmp_path, change)
    stack = read_dicom_cine(tmp_path, RR_MS)
    assert_is_the_stack(stack)
    assert "in the order of their InstanceNumber" in stack.remarks[0]


def test_derived_images_beside_a_cine_without_an_order_do_not_stand_for_it(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        without_times(data, number, phase)
        del data.InstanceNumber
        return True

    write_dicom(tmp_path, change)
    for k, data in enumerate(plain(PHASES, ImageType=["DERIVED", "SECONDARY", "M"])):
        data.save_as(tmp_path / f"other_{k}.dcm")
    with pytest.raises(InputError, match="has no trigger time"):
        read_dicom_cine(tmp_path, RR_MS)
