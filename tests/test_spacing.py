"""Stacks that lack slices: refused, or, where the user says so, filled in and told."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cine_files import (
    NORMAL,
    ORIGIN_MM,
    PHASES,
    ROW_AXIS,
    SLICES,
    STEP_MM,
    pixel_value,
    write_dicom,
)

from pipeline.errors import InputError
from pipeline.imaging.cine import Cine
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.interpolation import isotropic_labels
from pipeline.imaging.spacing import fill_gaps
from pipeline.products import read_cine, read_table, write_cine


def without(*missing: int) -> Any:
    return lambda data, number, phase: number not in missing


def spread(step_mm: float) -> Any:
    """The same slices, further apart, without the second."""

    def change(data: Any, number: int, phase: int) -> bool:
        data.ImagePositionPatient = (ORIGIN_MM + number * step_mm * NORMAL).tolist()
        return number != 1

    return change


def test_a_missing_slice_is_the_mean_of_its_neighbours_where_the_user_says_so(
    tmp_path: Path,
) -> None:
    write_dicom(tmp_path, without(1))
    cine = read_dicom_study(tmp_path, fill=True)[0].cine
    assert cine.intensity.shape[1] == SLICES
    assert cine.interpolated == (1,)
    np.testing.assert_allclose(np.linalg.norm(cine.mr_from_index[:3, 2]), STEP_MM)
    for phase in range(PHASES):
        for number in (0, 2, 3):
            np.testing.assert_array_equal(cine.intensity[phase, number], pixel_value(phase, number))
        mean = (pixel_value(phase, 0).astype(float) + pixel_value(phase, 2)) / 2
        np.testing.assert_allclose(cine.intensity[phase, 1], mean)


def test_a_missing_slice_is_refused_unless_the_user_says_so(tmp_path: Path) -> None:
    write_dicom(tmp_path, without(1))
    with pytest.raises(InputError, match=r"missing slice.*20.00 mm apart.*cine.fill_gaps"):
        read_dicom_study(tmp_path)


@pytest.mark.parametrize("change", [spread(13.0), without(1, 2)])
def test_a_wide_gap_is_refused_always(tmp_path: Path, change: Any) -> None:
    write_dicom(tmp_path, change)
    with pytest.raises(InputError, match=r"at most 25 mm, which this is not|at least 3 slices"):
        read_dicom_study(tmp_path, fill=True)


def test_what_was_filled_in_is_written_and_read(tmp_path: Path) -> None:
    write_dicom(tmp_path / "cine", without(1))
    stack = read_dicom_study(tmp_path / "cine", fill=True)[0]
    write_cine(tmp_path, stack)
    again = read_cine(tmp_path)
    assert isinstance(again, Cine)
    assert again.interpolated == (1,)
    np.testing.assert_allclose(again.intensity, stack.cine.intensity)
    told = read_table(tmp_path / "phases.json")
    missing = [row is None for row in told["trigger_times_ms"]]
    assert missing == [row is None for row in told["rr_ms"]] == [False, True, False, False]


@pytest.mark.parametrize(
    ("by_ms", "words"), [(150, r"slice 3 lies 0\.\d+ of a cycle off"), (160, r"\(slice 3\)")]
)
def test_slices_are_counted_in_messages_as_the_stack_has_them(
    tmp_path: Path, by_ms: float, words: str
) -> None:
    """The third of those that are there is number 3 where one between is missing."""

    def late(data: Any, number: int, phase: int) -> bool:
        data.TriggerTime += by_ms if number == 3 and phase else 0.0
        return number != 1

    write_dicom(tmp_path, late)
    with pytest.raises(InputError, match=words):
        read_dicom_study(tmp_path, fill=True)


def test_every_third_slice_may_be_missing() -> None:
    here = np.array([0, 1, 3, 4, 6, 7, 9])
    slices = np.arange(7, dtype=np.float32)[None, :, None, None] * np.ones((2, 1, 3, 4), np.float32)
    filled, missing = fill_gaps(slices, here)
    assert missing == (2, 5, 8)
    np.testing.assert_allclose(filled[1, :, 0, 0], [0, 1, 1.5, 2, 3, 3.5, 4, 5, 5.5, 6])


def test_planes_unevenly_spaced_give_the_body_that_evenly_spaced_ones_give() -> None:
    """A cone's cross-sections are linear in height, so that a missing plane loses nothing."""
    y, x = np.mgrid[:64, :64] * 1.5 - 47.25
    heights_mm = np.arange(0, 50.1, 5.0)
    depth_mm = (12 + 0.3 * heights_mm)[:, None, None] - np.hypot(x, y)
    inside = 1 / (1 + np.exp(-depth_mm * 3))
    value = np.stack([1 - inside, inside], axis=1)[None].astype(np.float32)
    there = np.array([0, 1, 3, 4, 6, 7, 9, 10])
    whole, parts = (
        isotropic_labels(value[:, k], 1.5, heights_mm[k], np.zeros((len(k), 2)), 2.5, 1.5, 6.0)[0]
        for k in (np.arange(11), there)
    )
    # Outlines are found to a quarter of a pixel; a voxel on the outline may fall either way.
    outline = np.pi * 2 * (12 + 0.3 * 25) / 1.5 * 50 / 1.5
    assert (whole != parts).sum() < outline / 4


def beside(asides_mm: Sequence[float]) -> Any:
    """Slices moved in their plane, along their rows, by so much each."""

    def change(data: Any, number: int, phase: int) -> bool:
        across = np.array(data.ImageOrientationPatient[:3], dtype=float)
        place_mm = np.array(data.ImagePositionPatient, dtype=float)
        data.ImagePositionPatient = (place_mm + asides_mm[number] * across).tolist()
        return True

    return change


@pytest.mark.parametrize(
    ("asides_mm", "told"),
    [
        ((0, 0.02, 0.04, 0.06), None),
        ((0, 0, 0.6, 0), r"1 of 4 slices lie up to 0\.60 mm \(slice 2\)"),
        ((0.6, 0, 0, 0), r"1 of 4 slices lie up to 0\.60 mm \(slice 0\)"),
        ((0, 0.3, 0.6, 0.9), r"2 of 4 slices lie up to 0\.45 mm"),
    ],
)
def test_slices_less_than_half_a_pixel_aside_are_drawn_on_one_line_and_told(
    tmp_path: Path, asides_mm: tuple[float, ...], told: str | None
) -> None:
    """Of pixels of 1.25 mm. By DICOM's equation (C.7.6.2.1) no pixel lies farther from where it
    was recorded than is told; slices that agree stay where they are."""
    write_dicom(tmp_path / "cine", beside(asides_mm))
    stack = read_dicom_study(tmp_path / "cine")[0]
    if told is None:
        assert stack.remarks == ()
    else:
        (remark,) = stack.remarks
        assert re.match(told, remark)
    drawn_mm = np.array([(stack.cine.mr_from_index @ [0, 0, z, 1])[:3] for z in range(SLICES)])
    recorded_mm = ORIGIN_MM + np.arange(SLICES)[:, None] * STEP_MM * NORMAL
    recorded_mm = recorded_mm + np.array(asides_mm)[:, None] * ROW_AXIS
    off_mm = np.linalg.norm(drawn_mm - recorded_mm, axis=1)
    assert off_mm.max() < max(asides_mm) / 2 + 1e-6 or (off_mm > 1e-6).sum() == 1
    axes = stack.cine.mr_from_index[:3, :3] / stack.cine.spacing_mm
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-6)
    write_cine(tmp_path, stack)
    np.testing.assert_allclose(
        read_cine(tmp_path).mr_from_index, stack.cine.mr_from_index, atol=1e-4
    )


@pytest.mark.parametrize(
    ("asides_mm", "words"),
    [
        ((0, 0.5, 1, 1.5), "2 of 4 lie too far .* by 0.75 mm; 0.62 mm, 0.5 of a pixel, are allow"),
        ((0, 0, 0.7, 0), "1 of 4 lie too far .* by 0.70 mm; .*cine.fill_gaps"),
    ],
)
def test_slices_half_a_pixel_aside_are_refused(
    tmp_path: Path, asides_mm: tuple[float, ...], words: str
) -> None:
    write_dicom(tmp_path / "cine", beside(asides_mm))
    with pytest.raises(InputError, match=f"shifted sideways: {words}"):
        read_dicom_study(tmp_path / "cine")
