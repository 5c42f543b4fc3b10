"""A cine in DICOM whose files do not tell when its images were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cine_files import (
    PHASES,
    RR_MS,
    assert_is_the_stack,
    dicom_frame,
    in_series,
    read_dicom_cine,
    write_dicom,
)
from pydicom.dataset import FileDataset

from pipeline.errors import InputError


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
    with pytest.raises(InputError, match="has no trigger time"):
        read_dicom_cine(tmp_path, RR_MS)
