"""Cine MR read from files that pydicom and nibabel wrote, good ones and bad ones."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pydicom
import pytest
from cine_files import (
    COLUMNS,
    NORMAL,
    ORIGIN_MM,
    PHASES,
    ROWS,
    RR_MS,
    SLICES,
    STEP_MM,
    Change,
    assert_is_the_stack,
    dicom_frame,
    enhanced_object,
    pixel_value,
    read_dicom_cine,
    write_dicom,
)
from pydicom.dataset import FileDataset

from pipeline.errors import InputError
from pipeline.imaging.frames import are_parallel, have_same_axes


def test_classic_dicom_is_sorted_by_position_then_trigger_time(tmp_path: Path) -> None:
    write_dicom(tmp_path / "cine")
    assert_is_the_stack(read_dicom_cine(tmp_path / "cine"))


def test_enhanced_dicom_gives_the_same_stack(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    order = [divmod(int(k), PHASES) for k in rng.permutation(SLICES * PHASES)]
    (tmp_path / "cine").mkdir()
    enhanced_object(order).save_as(tmp_path / "cine" / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path / "cine"))


def test_slices_of_another_orientation_are_left_out_and_named(tmp_path: Path) -> None:
    write_dicom(tmp_path / "cine")
    for phase in range(PHASES):
        data = dicom_frame(0, phase)
        data.ImageOrientationPatient = [0, 1, 0, 0, 0, -1]
        data.save_as(tmp_path / "cine" / f"long_axis_{phase}.dcm")
    stack = read_dicom_cine(tmp_path / "cine")
    assert_is_the_stack(stack)
    assert len(stack.left_out) == 1
    assert f"{PHASES} images" in stack.left_out[0]
    assert "long_axis_0.dcm" in stack.left_out[0]
    assert "not parallel" in stack.left_out[0]


def drop(name: str) -> Change:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        delattr(data, name)
        return True

    return change


def alter(name: str, value: Any, at: int = 2) -> Change:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        if number == at:
            setattr(data, name, value)
            if name == "Rows":
                data.PixelData = data.PixelData[: value * COLUMNS * 2]
        return True

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data, number, phase: number != 1, "missing slice"),
        (
            lambda data, number, phase: (number, phase) != (1, 2),
            "missing phase: of 5 phases, slice 1.* has 4; ",
        ),
        (
            lambda data, number, phase: number == 0 or phase or number == 3,
            r"phases, slice 1 \(.*\) has 4, slice 2 \(.*\) has 4; .*fill_gaps",
        ),
        (alter("Rows", 4), "different matrices"),
        (alter("PixelSpacing", [2.0, 2.0]), "different pixel spacing"),
        (
            alter("ImageOrientationPatient", [1, 0, 0, 0, 0, -1]),
            "missing slice.*; not taken: .* not parallel",
        ),
        (
            alter("ImagePositionPatient", (ORIGIN_MM + 23 * NORMAL).tolist()),
            "evenly spaced: .*fill_gaps",
        ),
        (drop("TriggerTime"), "no trigger time; export"),
        (alter("TriggerTime", None), r"no trigger time, as .* do without .*leave_out_series"),
        (drop("NominalInterval"), "no RR interval"),
        (drop("ImagePositionPatient"), "no ImagePositionPatient.*leave_out_series"),
        (alter("NominalInterval", 90000), "RR interval 90000 ms"),
        (alter("TriggerTime", 0.0), "same trigger time"),
        (lambda data, number, phase: number == 0, "1 slices of 5 phases"),
        (lambda data, number, phase: phase == 0, "4 slices of 1 phases"),
    ],
)
def test_a_bad_dicom_stack_is_refused_with_its_reason(
    tmp_path: Path, change: Change, words: str
) -> None:
    write_dicom(tmp_path / "cine", change)
    with pytest.raises(InputError, match=words) as raised:
        read_dicom_cine(tmp_path / "cine")
    assert "cine" in str(raised.value)


@pytest.mark.parametrize("kept", [0, 60, 400, -20])
def test_a_truncated_dicom_file_is_named(tmp_path: Path, kept: int) -> None:
    write_dicom(tmp_path)
    victim = tmp_path / "0007.dcm"
    victim.write_bytes(victim.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"0007\.dcm"):
        read_dicom_cine(tmp_path)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is empty"):
        read_dicom_cine(tmp_path)


def test_the_users_rr_interval_overrides_the_files(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    stack = read_dicom_cine(tmp_path, rr_ms=1000)
    np.testing.assert_allclose(stack.cine.phases, 0.8 * np.arange(PHASES) / PHASES)
    assert stack.timing_source == "study.yaml"
    with pytest.raises(InputError, match=r"with cine\.rr_ms 500: .* do not fit in an RR interval"):
        read_dicom_cine(tmp_path, rr_ms=500)


def test_rescaled_pixels_are_in_the_scanners_units(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.RescaleSlope, data.RescaleIntercept = 2, -7
        return True

    write_dicom(tmp_path, change)
    found = read_dicom_cine(tmp_path).cine.intensity[1, 2]
    np.testing.assert_array_equal(found, 2.0 * pixel_value(1, 2) - 7)


def test_pydicom_itself_reads_what_the_tests_write(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    assert pydicom.dcmread(tmp_path / "0000.dcm").pixel_array.shape == (ROWS, COLUMNS)


def test_the_rr_interval_is_the_mean_of_the_slices(tmp_path: Path) -> None:
    def own_rate(data: FileDataset, number: int, phase: int) -> bool:
        data.NominalInterval = 770 + 20 * number
        data.TriggerTime = phase / PHASES * float(data.NominalInterval)
        return True

    write_dicom(tmp_path, own_rate)
    stack = read_dicom_cine(tmp_path)
    np.testing.assert_allclose(stack.rr_ms, [770, 790, 810, 830])
    assert stack.cine.rr_s == pytest.approx(0.8)


def test_the_nominal_interval_goes_before_the_rounded_heart_rate(tmp_path: Path) -> None:
    write_dicom(tmp_path, lambda data, number, phase: setattr(data, "HeartRate", "74") is None)
    assert read_dicom_cine(tmp_path).cine.rr_s == pytest.approx(0.8)


def test_two_hundredths_of_a_step_are_the_most_that_a_slice_may_be_off(tmp_path: Path) -> None:
    def moved(by_mm: float) -> Change:
        def change(data: FileDataset, number: int, phase: int) -> bool:
            place = ORIGIN_MM + (number * STEP_MM + by_mm * (number == 2)) * NORMAL
            data.ImagePositionPatient = place.tolist()
            return True

        return change

    write_dicom(tmp_path / "near", moved(0.15))
    read_dicom_cine(tmp_path / "near")
    write_dicom(tmp_path / "off", moved(0.3))
    with pytest.raises(InputError, match="not evenly spaced"):
        read_dicom_cine(tmp_path / "off")


def test_images_two_degrees_apart_are_not_of_one_stack() -> None:
    def turned(degrees: float) -> SimpleNamespace:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        axes = np.array([[1.0, 0, 0], [0, c, s]])
        return SimpleNamespace(axes=axes, normal=np.cross(*axes))

    for degrees, same in ((0.9, True), (1.1, False)):
        assert have_same_axes(turned(0), turned(degrees)) == same
        assert are_parallel(turned(0), turned(degrees)) == same


def test_who_gives_the_rr_interval_is_not_asked_for_it_again(tmp_path: Path) -> None:
    """60,000 / 40 is far from the `RR_MS` that the images tell, too."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.HeartRate = "40"
        return True

    write_dicom(tmp_path, change)
    for given_ms, asked in ((None, True), (RR_MS, False)):
        remarks = read_dicom_cine(tmp_path, given_ms).remarks
        assert any("HeartRate 1500 ms" in one for one in remarks) == asked


def test_directions_written_with_few_decimals_shrink_no_pixel(tmp_path: Path) -> None:
    """0.707 for the root of a half: a vector 0.15 thousandths too short."""
    axes = [0.707, 0.707, 0.0, 0.0, 0.0, -1.0]
    normal = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)

    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageOrientationPatient = axes
        data.ImagePositionPatient = (number * STEP_MM * normal).tolist()
        return True

    write_dicom(tmp_path, change)
    found = read_dicom_cine(tmp_path).cine
    np.testing.assert_allclose(found.spacing_mm, (1.25, 1.5, STEP_MM), rtol=1e-6)


@pytest.mark.parametrize(("skew", "fits"), [(0.002, True), (0.02, False)])
def test_rows_and_columns_that_are_not_at_right_angles_are_refused(
    tmp_path: Path, skew: float, fits: bool
) -> None:
    """A degree is more than rounding, and no scanner's."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageOrientationPatient = [0.8, 0.6, 0.0, 0.8 * skew, 0.6 * skew, -1.0]
        return True

    write_dicom(tmp_path, change)
    if fits:
        read_dicom_cine(tmp_path)
    else:
        with pytest.raises(InputError, match="ImageOrientationPatient"):
            read_dicom_cine(tmp_path)
