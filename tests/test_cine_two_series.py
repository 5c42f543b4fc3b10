"""Folders with two series of the same slices, or of slices between one another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    NORMAL,
    ORIGIN_MM,
    PHASES,
    RR_MS,
    SLICES,
    STEP_MM,
    coarser,
    dicom_frame,
    in_series,
    pixel_value,
    read_dicom_cine,
    write_dicom,
)
from pydicom.dataset import FileDataset

from pipeline.errors import InputError
from pipeline.imaging.dicom import read_dicom_study


def test_a_derived_series_gives_the_slice_that_the_originals_lack_alone(tmp_path: Path) -> None:
    def original(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "cine")
        return number != SLICES - 1

    write_dicom(tmp_path, original)
    for k, which in enumerate(ALL_FRAMES):
        data = in_series(dicom_frame(*which), 9, "filtered")
        data.ImageType = ["DERIVED", "PRIMARY", "M", "NORM"]
        data.PixelData = (2 * data.pixel_array).tobytes()
        data.save_as(tmp_path / f"0{k:03d}_other.dcm")
    stack = read_dicom_cine(tmp_path)
    expected = np.stack(
        [
            [(2 if z == SLICES - 1 else 1) * pixel_value(phase, z) for z in range(SLICES)]
            for phase in range(PHASES)
        ]
    )
    np.testing.assert_array_equal(stack.cine.intensity, expected)
    (line,) = stack.left_out
    assert f"{PHASES * (SLICES - 1)} images" in line
    assert "derived images, slices that the stack has already" in line


@pytest.mark.parametrize("away", [0.5, float(SLICES)])
def test_slices_of_a_second_stack_between_those_of_the_first_are_told(
    tmp_path: Path, away: float
) -> None:
    """As of rest and stress; a stack that goes on in another series needs no word."""

    def numbered(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "rest")
        return True

    write_dicom(tmp_path, numbered)
    for k, (number, phase) in enumerate(ALL_FRAMES):
        data = in_series(dicom_frame(number, phase), 5, "stress")
        place_mm = ORIGIN_MM + (number + away) * STEP_MM * NORMAL
        data.ImagePositionPatient = place_mm.tolist()
        data.save_as(tmp_path / f"0{k:03d}_other.dcm")
    stack = read_dicom_cine(tmp_path)
    assert stack.cine.intensity.shape[1] == 2 * SLICES
    told = [one for one in stack.remarks if "such as rest and stress" in one]
    assert len(told) == (away < 1)
    for one in told:
        assert 'series 1 "rest"' in one
        assert 'series 5 "stress"' in one


@pytest.mark.parametrize(
    ("later_ms", "words"),
    [
        (-20.0, "-20 to 620 ms do not fit .*times of 0 and more"),
        (RR_MS, "800 to 1440 ms do not fit .*from an earlier R peak: give times since the last"),
    ],
)
def test_times_from_another_r_peak_are_told_and_no_coarser_stack_takes_their_place(
    tmp_path: Path, later_ms: float, words: str
) -> None:
    def later(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "cine")
        data.TriggerTime = float(data.TriggerTime) + later_ms
        return True

    write_dicom(tmp_path, later)
    tagged = [in_series(dicom_frame(*one), 9, "tagged") for one in ALL_FRAMES]
    for k, data in enumerate(coarser(tagged[: 3 * PHASES])):
        data.save_as(tmp_path / f"0{k:03d}_other.dcm")
    with pytest.raises(InputError, match=words):
        read_dicom_cine(tmp_path)


def test_two_echoes_in_one_series_are_told_as_that(tmp_path: Path) -> None:
    def numbered(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, 1, "cine")
        return True

    write_dicom(tmp_path, numbered)
    for phase in range(PHASES):
        data = in_series(dicom_frame(1, phase), 1, "cine")
        data.PixelData = (2 * data.pixel_array).tobytes()
        data.save_as(tmp_path / f"0{phase:03d}_other.dcm")
    with pytest.raises(InputError, match=r'both are of series 1 "cine".*take the files of one out'):
        read_dicom_cine(tmp_path)


def taken_again(folder: Path, repeats: Callable[[int], int | None]) -> str:
    """What is said of a stack of which slices were taken again, each in the series that
    ``repeats`` numbers."""
    write_dicom(folder, lambda data, number, phase: bool(in_series(data, 1, "short axis")))
    for k, (number, phase) in enumerate(ALL_FRAMES):
        again = repeats(number)
        if again is not None:
            data = in_series(dicom_frame(number, phase), again, "again")
            data.PixelData = (data.pixel_array + 3).tobytes()
            data.save_as(folder / f"again_{k}.dcm")
    with pytest.raises(InputError) as raised:
        read_dicom_cine(folder)
    return str(raised.value)


def test_all_slices_that_were_taken_again_are_named_at_once(tmp_path: Path) -> None:
    """By a series each, or by one of all; what the message says to leave out is enough."""
    said = taken_again(tmp_path / "each", lambda number: 11 + number if number != 2 else None)
    for number in (0, 1, 3):
        words = f'slice {number} is given twice: by series 1 "short axis", '
        assert words in said
        assert f'by series {11 + number} "again", {PHASES} images' in said
    assert "slice 2 is" not in said
    assert said.count("cine.leave_out_series in study.yaml, which takes several") == 1
    without = read_dicom_study(tmp_path / "each", without_series=(11, 12, 14))[0]
    np.testing.assert_array_equal(without.cine.intensity[2, 3], pixel_value(2, 3))
    said = taken_again(tmp_path / "one", lambda number: 9)
    assert "slices 0 to 3 are given twice" in said
    assert said.count("given twice") == 1
    said = taken_again(tmp_path / "some", lambda number: 9 if number != 1 else None)
    assert "slices 0, 2 to 3 are given twice" in said
