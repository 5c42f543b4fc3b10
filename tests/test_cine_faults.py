"""Images that are copies, no numbers, or spoilt: refused, told, or drawn anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
import pytest
from cine_files import PHASES, SLICES, dicom_frame, write_dicom
from pydicom.dataset import Dataset

from pipeline.errors import InputError
from pipeline.imaging import dicom
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.dicom_files import told_from_notes
from pipeline.imaging.faults import (
    doubts_of_gaps,
    doubts_of_range,
    redraw_slices,
    require_different_images,
    require_room_for_a_heart,
    require_slices_before_phases,
    without_blank_ends,
)
from pipeline.imaging.frames import Frame, by_slice, span_beat
from pipeline.imaging.nifti import read_nifti_cine
from pipeline.imaging.phases import common_phases, doubts_of_phases
from pipeline.imaging.stack_choice import choose_stack
from pipeline.imaging.stored_order import doubts_of_order
from pipeline.imaging.unrecorded import require_finite, without_unrecorded
from pipeline.study import open_study
from tests.outside_heart import Scan, render

STEP_8_MM = np.diag([1.4, 1.4, 8.0, 1.0])


def brightness_of_slices(count: int, interpolated: tuple[int, ...] = ()) -> Cine:
    """Slice z of phase k is z^2 + 100 k all over."""
    value = np.arange(count, dtype=np.float32) ** 2 + 100 * np.arange(3, dtype=np.float32)[:, None]
    pixels = value[..., None, None] * np.ones((4, 5), np.float32)
    return Cine(pixels, STEP_8_MM, np.arange(3) / 3, 0.8, interpolated)


def test_spoilt_slices_are_the_mean_of_their_neighbours_in_every_phase() -> None:
    before = brightness_of_slices(8, (6,))
    found = redraw_slices(before, (2, 4), "study.yaml")
    assert found.interpolated == (2, 4, 6)
    np.testing.assert_allclose(
        found.intensity[1, :, 0, 0], [100, 101, 105, 109, 117, 125, 136, 149]
    )
    assert before.intensity[1, 2, 0, 0] == 104
    assert redraw_slices(before, (), "study.yaml") is before


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ((8,), "no slice 8; the stack has slices 0 to 7"),
        ((-1,), "no slice -1"),
        ((0,), "slice 0 is the stack's outermost"),
        ((7,), "slice 7 is the stack's outermost"),
        ((2, 3), "slice 2 has a neighbour that is spoilt"),
        ((5,), "slice 5 has a neighbour that is spoilt or missing"),
    ],
)
def test_spoilt_slices_that_nothing_can_stand_in_for_are_refused(spoilt, words) -> None:
    with pytest.raises(InputError, match=f"here: {words}"):
        redraw_slices(brightness_of_slices(8, (6,)), spoilt, "here")


def test_a_spoilt_slice_is_not_bridged_over_a_wide_gap() -> None:
    wide = replace(brightness_of_slices(5), mr_from_index=np.diag([1.4, 1.4, 13.0, 1.0]))
    with pytest.raises(InputError, match=r"slice 2 lie 26.0 mm apart, at most 25 mm"):
        redraw_slices(wide, (2,), "here")


def noisy(phases: int = 4, slices: int = 5) -> Cine:
    pixels = np.random.default_rng(3).normal(100, 5, (phases, slices, 6, 7)).astype(np.float32)
    return Cine(pixels, STEP_8_MM, np.arange(phases) / phases, 0.8)


def test_different_images_are_let_pass() -> None:
    assert require_different_images(noisy(), "here") == ()


def test_a_slice_that_is_a_copy_is_named_and_may_be_given_up() -> None:
    cine = noisy()
    cine.intensity[:, 3] = cine.intensity[:, 1]
    words = r"here: slices 1 and 3 show the same images.*cine\.spoilt_slices: \[3\]"
    with pytest.raises(InputError, match=words):
        require_different_images(cine, "here")
    assert require_different_images(redraw_slices(cine, (3,), "study.yaml"), "here") == ()


def test_slices_alike_in_a_single_phase_or_blank_are_no_copies() -> None:
    """Padding is blank; what a network makes of that is not for the reader to say."""
    cine = noisy()
    cine.intensity[0, 3] = cine.intensity[0, 1]
    cine.intensity[:, [0, 4]] = 0
    assert require_different_images(cine, "here") == ()


def test_phases_that_are_copies_are_told() -> None:
    cine = noisy()
    cine.intensity[2:] = cine.intensity[1]
    words = "phase {} shows the same images as phase 1 in all slices"
    assert require_different_images(cine, "here") == (words.format(2), words.format(3))


def test_one_image_in_several_phases_of_a_slice_is_told() -> None:
    cine = noisy()
    cine.intensity[3] = cine.intensity[0]
    cine.intensity[[1, 3], 2] = cine.intensity[0, 2]
    cine.intensity[:, 4] = 0
    assert require_different_images(cine, "here") == (
        "phase 3 shows the same images as phase 0 in all slices",
        "slice 2 shows one image in phases 0 1",
    )


def test_slices_of_repeated_images_are_named_together_and_few_sets_one_by_one() -> None:
    cine = noisy(phases=12)
    cine.intensity[1::2, 1:3] = cine.intensity[::2, 1:3]
    told = require_different_images(cine, "here")
    assert told[0] == "slice 1, 2 shows one image in phases 0 1"
    assert told[3:] == ("slices show one image in 3 more sets of phases",)


def test_a_heart_that_never_moves_is_refused() -> None:
    """As two files of which one was copied from the other."""
    cine = noisy(phases=2)
    cine.intensity[1] = cine.intensity[0]
    with pytest.raises(InputError, match="here: all phases show the same images"):
        require_different_images(cine, "here")
    # A padded slice does not make it beat.
    cine.intensity[:, 0] = 0
    with pytest.raises(InputError, match="here: all phases show the same images"):
        require_different_images(cine, "here")


def test_what_a_window_cut_off_is_told() -> None:
    """A tenth of each image; not what fills images up in all phases."""
    rng = np.random.default_rng(3)
    values = rng.normal(100, 5, (4, 5, 40, 40)).astype(np.float32)
    cine = Cine(values, STEP_8_MM, np.arange(4) / 4, 0.8)
    assert doubts_of_range(cine) == ()
    most = np.quantile(values, 0.9, axis=(2, 3), keepdims=True)
    (told,) = doubts_of_range(replace(cine, intensity=np.minimum(values, most)))
    assert told.startswith("10% of the pixels have the largest value of their image")
    values[..., :20] = 200
    assert doubts_of_range(cine) == ()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_no_numbers_are_named_by_place(value: float) -> None:
    cine = noisy()
    cine.intensity[2, 4, 1, 1] = value
    with pytest.raises(InputError, match=r"here, phase 2, slice 4: grey values must be finite"):
        require_finite(cine, "here")


@pytest.mark.parametrize(("fill", "name"), [(np.nan, "NaN"), (-1024.0, "-1024")])
def test_what_fills_up_about_what_was_recorded_is_dark_and_told(fill: float, name: str) -> None:
    """A disc of measurements, as of a field of view that was turned: what is in it stays."""
    cine = noisy(phases=3, slices=4)
    cine.intensity[1, 2, 3, 3] = -7.5
    y, x = np.mgrid[:6, :7]
    outside = np.hypot(x - 3, y - 2.5) > 3
    spoilt = replace(cine, intensity=np.where(outside, fill, cine.intensity))
    found, (remark,) = without_unrecorded(spoilt, "the cine")
    np.testing.assert_array_equal(found.intensity, np.where(outside, -7.5, cine.intensity))
    require_finite(found, "here")
    np.testing.assert_array_equal(spoilt.intensity[0, 0, 0, 0], fill)
    assert f"{outside.mean():.1%} of the pixels, at the edge of 4 of 4 slices" in remark
    assert f" are {name} in all phases" in remark
    assert remark.endswith("the darkest value, -7.5")
    assert without_unrecorded(cine, "the cine") == (cine, ())


@pytest.mark.parametrize(("step_mm", "told"), [(25.0, 0), (30.0, 1)])
def test_slices_too_far_apart_are_told(step_mm: float, told: int) -> None:
    mr_from_index = np.diag([1.5, 1.5, step_mm, 1])
    remarks = doubts_of_gaps(replace(noisy(), mr_from_index=mr_from_index))
    assert len(remarks) == told
    assert all("30 mm apart" in remark for remark in remarks)


def test_the_darkest_of_what_was_measured_fills_nothing_up() -> None:
    """Noise about zero whose darkest pixels stay dark, as air is, or masked to nothing."""
    cine = noisy(phases=3, slices=4)
    cine.intensity[:] = np.abs(cine.intensity - 100)
    cine.intensity[..., :2] = 0
    assert without_unrecorded(cine, "the cine") == (cine, ())


@pytest.mark.parametrize(("gap", "fills"), [(7.0, False), (14.0, True)])
def test_what_fills_up_lies_a_tenth_of_the_range_below_the_rest(gap: float, fills: bool) -> None:
    """Values evenly from 0 to 100 and four of 1000: from the 1st to the 99th percentile 98."""
    values = np.linspace(0, 100, 2 * 3 * 40 * 40, dtype=np.float32)
    values = np.random.default_rng(6).permutation(values).reshape(2, 3, 40, 40)
    values[:, :, :, :4], values[0, 1, 20, 19:23] = -gap, 1000
    # The darkest of the rest is 0, to a hundredth of the range.
    cine = Cine(values, STEP_8_MM, np.arange(2) / 2, 0.8)
    found, told = without_unrecorded(cine, "the cine")
    assert len(told) == fills
    assert (found.intensity.min() > -1) == fills


def test_of_images_of_two_values_none_fills_up() -> None:
    images = np.ones((2, 3, 6, 7), np.float32)
    images[..., :2] = 0
    cine = Cine(images, STEP_8_MM, np.arange(2) / 2, 0.8)
    assert without_unrecorded(cine, "the cine") == (cine, ())


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (np.s_[:, 2, 2:4, 2:4], r"phase 0, slice 2: .* in 4 pixels, the first in row 2, column 2"),
        (np.s_[1, 2, :2, :2], r"phase 1, slice 2: .* the first in row 0, column 0"),
        (np.s_[:, 2], r"phase 0, slice 2: .* in 42 pixels"),
    ],
    ids=["inside", "one phase", "a whole slice"],
)
def test_other_nan_is_refused_with_its_place(place: Any, words: str) -> None:
    cine = noisy()
    cine.intensity[place] = np.nan
    cine.intensity[:, :, -1] = np.nan
    found, _ = without_unrecorded(cine, "the cine")
    with pytest.raises(InputError, match=f"here, {words}"):
        require_finite(found, "here")


def test_slices_of_nan_at_the_ends_are_left_out_as_blank_ones_are() -> None:
    cine = noisy(slices=6)
    cine.intensity[:, [0, 5]] = np.nan
    found, _ = without_unrecorded(cine, "the cine")
    times_ms = np.tile(np.arange(4) * 200.0, (6, 1))
    left = without_blank_ends(Stack(found, times_ms, np.full(6, 800.0), "files", ()))
    np.testing.assert_array_equal(left.cine.intensity, cine.intensity[:, 1:5])


def beating_ball(phases: int = 20, slices: int = 12) -> Cine:
    """A bright ball off the middle, whose radius follows the beat, in a chest, with noise."""
    rng = np.random.default_rng(5)
    z, y, x = np.mgrid[:slices, :64, :64].astype(float)
    chest = 40.0 * (np.hypot((x - 32) / 28, (y - 32) / (14 + z)) < 1)
    beat = np.sin(np.pi * np.arange(phases) / phases) ** 2 + 0.2 * np.arange(phases) / phases
    radius = 16 - 6 * beat[:, None, None, None]
    ball = np.sqrt((x - 26) ** 2 + (y - 36) ** 2 + (8 * (z - 5) / 3) ** 2)[None] < radius
    pixels = chest + 60 * ball + rng.normal(0, 3, ball.shape)
    return Cine(pixels.astype(np.float32), STEP_8_MM, np.arange(phases) / phases, 0.8)


def by_name(count: int) -> list[int]:
    """0, 1, 10, 11, 2, ...: as files without leading zeros are sorted."""
    return sorted(range(count), key=str)


def test_images_in_their_order_raise_no_doubt() -> None:
    cine = beating_ball()
    assert doubts_of_order(cine) == ()
    assert doubts_of_order(replace(cine, intensity=cine.intensity[:, ::-1])) == ()
    # Which phase comes first is not for the images to say.
    assert doubts_of_order(replace(cine, intensity=np.roll(cine.intensity, 7, axis=0))) == ()


INTERLEAVED = [*range(0, 12, 2), *range(1, 12, 2)]
SWAPPED = [0, 1, 2, 3, 8, 5, 6, 7, 4, 9, 10, 11]


@pytest.mark.parametrize("order", [by_name(12), SWAPPED, INTERLEAVED])
def test_slices_out_of_order_are_told_with_their_order(order: list[int]) -> None:
    cine = beating_ball()
    (told,) = doubts_of_order(replace(cine, intensity=cine.intensity[:, order]))
    right = " ".join(str(order.index(number)) for number in range(12))
    assert told.startswith(f"slices look as if their order were {right};")


def test_a_blank_slice_has_no_place_in_the_order() -> None:
    cine = beating_ball()
    images = cine.intensity.copy()
    images[:, 6] = 0
    assert doubts_of_order(replace(cine, intensity=images)) == ()
    (told,) = doubts_of_order(replace(cine, intensity=images[:, SWAPPED]))
    assert told.startswith("slices look as if their order were 0 1 2 3 8 5 7 4 9 10 11;")


@pytest.mark.parametrize("phases", [*range(12, 16), 20])
@pytest.mark.parametrize("first", [0, 1])
def test_phases_sorted_by_name_are_told(phases: int, first: int) -> None:
    cine = beating_ball(phases)
    assert doubts_of_order(cine) == ()
    stored = sorted(range(first, first + phases), key=str)
    images = cine.intensity[np.array(stored) - first]
    (told,) = doubts_of_order(replace(cine, intensity=images))
    assert told.startswith("phases look as if their order were 0 ")
    # Of both directions of time that which goes on with the lower number.
    found = [int(number) for number in told.partition(" were ")[2].partition(";")[0].split()]
    assert sorted(found) == [*range(phases)]
    assert found[1] < found[-1] or phases < 16
    if phases < 16:
        assert found == [stored.index(number) for number in range(first, first + phases)]


def test_as_many_slices_as_a_thin_stack_has_are_judged() -> None:
    cine = beating_ball(phases=3, slices=31)
    order = [*range(31)]
    order[3], order[20] = 20, 3
    (told,) = doubts_of_order(replace(cine, intensity=cine.intensity[:, order]))
    assert told.startswith("slices look as if their order were 0 1 2 20 4 ")


def test_few_phases_in_any_other_order_and_volumes_are_not_judged() -> None:
    cine = beating_ball(phases=12, slices=61)
    images = cine.intensity[INTERLEAVED][:, by_name(61)]
    assert doubts_of_order(replace(cine, intensity=images)) == ()


def told_by_half(**fields: Any) -> Any:
    """Fields of the first two slices (first of each pair) and of the others."""

    def change(data: Any, number: int, phase: int) -> bool:
        for name, values in fields.items():
            setattr(data, name, values[number >= 2])
        return True

    return change


@pytest.mark.parametrize("told", ["PatientID", "PatientBirthDate"])
def test_slices_of_two_patients_are_no_stack(tmp_path: Path, told: str) -> None:
    values = {"PatientID": ("A17", "B4"), "PatientBirthDate": ("19500101", "19810230")}[told]
    write_dicom(tmp_path, told_by_half(**{told: values}))
    with pytest.raises(InputError, match=rf"\.dcm and .*\.dcm have different {told}s") as error:
        read_dicom_study(tmp_path)
    assert not any(value in str(error.value) for value in values)
    write_dicom(tmp_path / "other", told_by_half(**{told: (values[0], "")}))
    read_dicom_study(tmp_path / "other")


@pytest.mark.parametrize("other", ["1950.01.01", "1950", "00000000", "ANON"])
def test_dates_of_birth_written_otherwise_or_blotted_out_are_of_one_patient(
    tmp_path: Path, other: str
) -> None:
    def change(data: Any, number: int, phase: int) -> bool:
        value = "19500101" if number < 2 else other
        with pydicom.config.disable_value_validation():
            data.PatientBirthDate = value
        return True

    write_dicom(tmp_path, change)
    stack, _ = read_dicom_study(tmp_path)
    assert stack.cine.intensity.shape[:2] == (PHASES, SLICES)


def test_a_stack_knows_its_patient(tmp_path: Path) -> None:
    """Whom an ECG is compared with."""
    write_dicom(tmp_path, told_by_half(PatientID=("A17", "A17")))
    assert read_dicom_study(tmp_path)[0].patient == "A17"


def test_slices_in_two_frames_of_reference_are_told(tmp_path: Path) -> None:
    write_dicom(tmp_path, told_by_half(FrameOfReferenceUID=("1.2.3", "1.2.4")))
    (remark,) = read_dicom_study(tmp_path)[0].remarks
    assert "different FrameOfReferenceUIDs: if the patient was moved" in remark


def test_images_that_do_not_tell_their_patient_are_taken_for_the_same(tmp_path: Path) -> None:
    write_dicom(tmp_path, told_by_half(PatientID=("A17", ""), FrameOfReferenceUID=("", "1.2.4")))
    assert read_dicom_study(tmp_path)[0].remarks == ()


def saved(path: Path) -> Path:
    """A cine of noise as NIfTI."""
    pixels = np.random.default_rng(2).integers(0, 999, (64, 60, 4, 5)).astype(np.int16)
    image = nibabel.Nifti1Image(pixels, np.diag([1.5, 1.5, 8, 1]))
    image.header.set_xyzt_units("mm", "msec")
    image.header.set_zooms((1.5, 1.5, 8, 160))
    nibabel.save(image, path)
    return path


def test_images_too_small_for_a_heart_are_refused() -> None:
    cine = beating_ball()
    require_room_for_a_heart(cine, "here")
    small = replace(cine, mr_from_index=np.diag([0.14, 0.14, 0.8, 1.0]))
    with pytest.raises(InputError, match=r"here: its images measure 9 x 9 mm.*in centimetres\?"):
        require_room_for_a_heart(small, "here")


@pytest.mark.parametrize(
    ("slices", "step_mm", "fits"),
    [(10, 1.0, False), (12, 1.5, False), (3, 5.0, True), (12, 2.5, True), (30, 1.0, True)],
)
def test_a_stack_whose_header_lost_the_distance_of_its_slices_is_refused(
    slices: int, step_mm: float, fits: bool
) -> None:
    """Few slices of a usual distance, and thin ones that reach over a heart, are what they are."""
    pixels = np.zeros((2, slices, 64, 64), np.float32)
    cine = Cine(pixels, np.diag([1.5, 1.5, step_mm, 1.0]), np.arange(2) / 2, 0.8)
    if fits:
        require_room_for_a_heart(cine, "here")
        return
    words = rf"here: its {slices} slices lie {step_mm:g} mm apart .*write the affine"
    with pytest.raises(InputError, match=words):
        require_room_for_a_heart(cine, "here")


@pytest.mark.parametrize("phases", [6, pytest.param(14, marks=pytest.mark.slow)])
def test_slices_and_phases_that_are_exchanged_are_refused(phases: int) -> None:
    """Of a chest by another renderer, through a whole beat and through most of one."""
    for covered in (1.0, 0.7):
        moments = tuple(covered * np.arange(phases) / phases)
        scan = Scan(moments, slices=6, step_mm=12.0, pixel_mm=3.0, depths=1)
        cine = render(phases, scan).cine
        require_slices_before_phases(cine, "here")
        exchanged = replace(
            cine,
            intensity=np.ascontiguousarray(cine.intensity.swapaxes(0, 1)),
            phases=np.arange(6) / 6,
        )
        words = rf"here: its axes of .* its {phases} slices are alike .* its 6 phases .*swapaxes"
        with pytest.raises(InputError, match=words):
            require_slices_before_phases(exchanged, "here")


def test_thin_slices_of_two_phases_far_apart_are_not_taken_for_exchanged() -> None:
    """Neighbouring slices of a volume are more alike than end-diastole and end-systole."""
    whole = beating_ball(phases=20, slices=12)
    fine = np.repeat(whole.intensity[[0, 10, 11]], 8, axis=1)
    require_slices_before_phases(replace(whole, intensity=fine, phases=whole.phases[:3]), "here")
    require_slices_before_phases(whole, "here")


def test_a_damaged_file_is_named_with_what_to_do(tmp_path: Path) -> None:
    path = saved(tmp_path / "cine.nii.gz")
    content = bytearray(path.read_bytes())
    for place in range(len(content) // 2, len(content) // 2 + 400):
        content[place] ^= 255
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"cine\.nii\.gz: its voxels cannot be read.*--from STAGE"):
        read_nifti_cine(path, None)


def test_timing_as_windows_writes_it_is_read(tmp_path: Path) -> None:
    timing = tmp_path / "timing.json"
    times = '{"trigger_times_ms": [0, 160, 320, 480, 640], "rr_ms": 800}'
    timing.write_text(times, encoding="utf-8-sig")
    stack = read_nifti_cine(saved(tmp_path / "cine.nii"), timing)
    assert stack.trigger_times_ms[3].tolist() == [0, 160, 320, 480, 640]


@pytest.mark.parametrize("moment", ["null", "NaN"])
def test_a_trigger_time_that_is_no_number_is_named(tmp_path: Path, moment: str) -> None:
    timing = tmp_path / "timing.json"
    timing.write_text(f'{{"trigger_times_ms": [0, 160, {moment}, 480, 640], "rr_ms": 800}}')
    with pytest.raises(InputError, match=r"timing\.json: the trigger time of slice 0, phase 2, is"):
        read_nifti_cine(saved(tmp_path / "cine.nii"), timing)


def test_an_rr_interval_of_ones_own_that_does_not_fit_is_named(tmp_path: Path) -> None:
    timing = tmp_path / "timing.json"
    timing.write_text('{"trigger_times_ms": [0, 160, 320, 480, 640], "rr_ms": 800}')
    with pytest.raises(InputError, match=r"timing\.json, with cine\.rr_ms 500: trigger times"):
        read_nifti_cine(saved(tmp_path / "cine.nii"), timing, 500.0)


def study_of(folder: Path, *names: str) -> Path:
    """A study of empty files."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def stack_of_frames(kind: str, slices: tuple[int, ...]) -> list[Frame]:
    """Three moments of some slices, alike in all but their kind."""
    return [
        Frame(
            f"{kind} {z} {phase}",
            np.full((4, 4), 100 * z + 10 * phase + len(kind)),
            np.array([0.0, 0.0, 8.0 * z]),
            np.eye(3)[:2],
            (1.4, 1.4),
            {"trigger time": 250.0 * phase},
            800.0,
            kind,
            kind,
            kind,
        )
        for z in slices
        for phase in range(3)
    ]


def test_what_stands_in_for_a_slice_counts_when_other_images_of_it_are_judged() -> None:
    stack = stack_of_frames("original", (0, 1, 3, 4)) + stack_of_frames("derived", (2,))
    chosen, left_out = choose_stack(stack + stack_of_frames("phase", (0, 1, 2, 3, 4)), "folder")
    assert {frame.kind for frame in chosen} == {"original", "derived"}
    assert {one.reason for one in left_out} == {
        "phase images, slices that the stack has already, 4 x 4 pixels"
    }


@pytest.mark.parametrize("image_type", ["DERIVED", ["DERIVED", "SECONDARY"]])
def test_a_derived_image_is_known_by_one_value_too(image_type: Any) -> None:
    data = dicom_frame(0, 0)
    data.ImageType = image_type
    assert dicom._kind(data, Dataset()) == "derived"


def test_files_that_systems_leave_are_not_taken_for_images(tmp_path: Path) -> None:
    folder = study_of(tmp_path, "cine/a.dcm", "ecg/us.csv", "us/left.mha")
    study_of(folder, "cine/._a.dcm", "cine/._x.nii.gz", "cine/.DS_Store", "us/._left.mha")
    study = open_study(folder)
    assert study.cine.path == folder / "cine"
    assert study.us is not None
    assert [path.name for path in study.us.sweeps] == ["left.mha"]
    assert [path.name for path in study.input_files()["cine"]] == ["a.dcm"]


def test_endings_may_be_capitals(tmp_path: Path) -> None:
    assert open_study(study_of(tmp_path, "cine/CINE.NII.GZ")).cine.path.name == "CINE.NII.GZ"


def test_timing_without_its_images_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds timing\.json, but no NIfTI file"):
        open_study(study_of(tmp_path, "cine/timing.json"))


def nifti_bytes() -> bytearray:
    image = nibabel.Nifti1Image(np.ones((8, 6, 4, 5), np.int16), np.diag([1, 1, 8, 1.0]))
    image.set_qform(image.affine, 1)
    image.set_sform(None, 0)
    return bytearray(image.to_bytes())


def with_numbers(offset: int, values: list[float]) -> bytearray:
    """The header's numbers from ``offset`` on (nifti1.h) in single precision."""
    content = nifti_bytes()
    content[offset : offset + 4 * len(values)] = np.array(values, "<f4").tobytes()
    return content


def of_datatype(code: int, bits: int) -> bytearray:
    content = nifti_bytes()
    content[70:74] = np.array([code, bits], "<i2").tobytes()
    return content


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (with_numbers(112, [0.5, np.nan]), "cannot be read as NIfTI"),
        (with_numbers(256, [0.9, 0.9, 0.9]), "cannot be read as NIfTI"),
        (of_datatype(9999, 16), "cannot be read as NIfTI"),
        (of_datatype(128, 24), "voxels are colours"),
    ],
    ids=["intercept", "quaternion", "datatype", "RGB"],
)
def test_a_nifti_header_without_sense_is_refused(
    tmp_path: Path, content: bytearray, words: str
) -> None:
    (tmp_path / "cine.nii").write_bytes(content)
    with pytest.raises(InputError, match=rf"cine\.nii: .*{words}"):
        read_nifti_cine(tmp_path / "cine.nii", None, 900.0)


@pytest.mark.filterwarnings("ignore:Invalid value for VR IS")
@pytest.mark.parametrize(
    ("tag", "value", "words"),
    [
        # A private syntax, as GE's, and none at all: which pixels it has nobody can tell.
        (b"1.2.840.10008.1.2.1\0", b"1.2.840.113619.5.2\0\0", "pixels cannot be read"),
        (b"\x28\0\x08\0IS\x02\x001 ", b"\x28\0\x08\0IS\x02\0x ", "cannot be understood"),
    ],
)
def test_values_that_no_standard_knows_are_told(
    tmp_path: Path, tag: bytes, value: bytes, words: str
) -> None:
    data = dicom_frame(0, 0)
    data.NumberOfFrames = 1
    data.save_as(tmp_path / "odd.dcm")
    content = (tmp_path / "odd.dcm").read_bytes()
    assert content.count(tag) == 1
    (tmp_path / "odd.dcm").write_bytes(content.replace(tag, value))
    with pytest.raises(InputError, match=rf"odd\.dcm: .*{words}"):
        read_dicom_study(tmp_path)


@pytest.mark.parametrize("drawn", [(), (4,)])
def test_slices_at_the_ends_that_show_nothing_are_left_out_and_told(drawn: tuple[int, ...]) -> None:
    """Two below and one above; the places of the others stay, and their times go with them."""
    full = np.random.default_rng(1).normal(size=(3, 8, 6, 7)).astype(np.float32)
    full[:, [0, 1, 7]] = 5.0
    full[1, 5] = 0.0
    timed = tuple(k for k in range(8) if k not in drawn)
    times_ms = np.arange(3) * 300.0 + np.array(timed)[:, None]
    cine = Cine(full, STEP_8_MM, np.arange(3) / 3, 0.9, drawn)
    told = timed if drawn else ()
    stack = Stack(cine, times_ms, 900 + np.array(timed, float), "files", (), told, ("before",))
    left = without_blank_ends(stack)
    np.testing.assert_array_equal(left.cine.intensity, full[:, 2:7])
    np.testing.assert_allclose(left.cine.mr_from_index @ [1, 2, 0, 1], STEP_8_MM @ [1, 2, 2, 1])
    assert left.cine.interpolated == tuple(k - 2 for k in drawn)
    stay = [k for k in timed if 2 <= k < 7]
    np.testing.assert_array_equal(left.rr_ms, 900 + np.array(stay, float))
    np.testing.assert_array_equal(left.trigger_times_ms[:, 0], stay)
    assert left.timed == (tuple(k - 2 for k in stay) if drawn else ())
    _, remark = left.remarks
    assert remark.startswith("3 slices at the ends of the stack show nothing in any phase")
    assert "slice 2 of the files is slice 0" in remark
    assert left.blank_ends == (2, 1)
    # Nothing at the ends, or nothing at all: as it was.
    assert without_blank_ends(left) is left
    for shown in (0, 2):
        few = np.zeros_like(full)
        few[:, :shown] = full[:, 2 : 2 + shown]
        hardly = replace(stack, cine=replace(cine, intensity=few))
        assert without_blank_ends(hardly) is hardly


def test_a_slice_a_little_off_the_phases_of_many_is_told_and_one_further_off_refused() -> None:
    """Of 30 phases half a step is a sixtieth of a beat: scanners tell RR intervals no better."""
    times_ms = np.tile(np.arange(30) * 30.0, (12, 1))
    rr_ms = np.full(12, 900.0)
    assert doubts_of_phases(times_ms, rr_ms, range(12)) == ()
    rr_ms[4] = 900 * 1.03
    np.testing.assert_allclose(
        common_phases(times_ms, rr_ms, "here"), np.arange(30) / 30, atol=4e-3
    )
    [told] = doubts_of_phases(times_ms, rr_ms, range(5, 17))
    assert told.startswith("slice 9 lies 0.026 of a cycle off")
    rr_ms[4] = 900 * 1.07
    with pytest.raises(InputError, match=r"slice 4 lies .* at most 0\.050 off .* cine\.rr_ms"):
        common_phases(times_ms, rr_ms, "here")
    # Where one interval was given for all, to give one is no remedy.
    times_ms[4] += 60.0
    with pytest.raises(InputError, match=r"slice 4 lies .* correct its times, or leave the slice"):
        common_phases(times_ms[:, :28], np.full(12, 900.0), "here")


def test_what_is_text_beside_images_is_no_damaged_image(tmp_path: Path) -> None:
    write_dicom(tmp_path / "im")
    image = next(path for path in (tmp_path / "im").rglob("*") if path.is_file())
    texts = [tmp_path / "manifest.cvs", tmp_path / "contour.con"]
    for path in texts:
        path.write_text("1.0 2.0\n3.0 4.0\n")
    assert told_from_notes([image, *texts]) == ([image], texts)
    scanners = tmp_path / "0001.dcm"
    scanners.write_text("1.0 2.0\n")
    with pytest.raises(InputError, match=r"0001\.dcm: is not DICOM, or damaged"):
        told_from_notes([image, scanners])


def test_phases_are_the_mean_of_the_slices_own() -> None:
    """Of beats of 0.8 and 1 s, one slice a hundredth of a beat early and one as late."""
    triggers = np.array([[8.0, 168, 328, 488, 648], [30.0, 230, 430, 630, 830]])
    found = common_phases(triggers, np.array([800.0, 1000.0]), "here")
    np.testing.assert_allclose(found, [0.02, 0.22, 0.42, 0.62, 0.82])


@pytest.mark.parametrize(
    ("times_ms", "words"),
    [([0, 200, 200, 600], "must rise"), ([0, 200, 400, 800], "do not fit in an RR interval")],
)
def test_two_phases_of_one_moment_or_at_the_next_r_peak_are_refused(
    times_ms: list[int], words: str
) -> None:
    triggers = np.array([times_ms] * 3, float)
    with pytest.raises(InputError, match=words):
        common_phases(triggers, np.full(3, 800.0), "here")


@pytest.mark.parametrize(("off", "fits"), [(0.060, True), (0.066, False)])
def test_of_few_phases_a_slice_may_be_half_a_step_off(off: float, fits: bool) -> None:
    """A sixteenth of a cycle, of eight; the mean of a hundred slices hardly follows the one."""
    times_ms = np.tile(800 * (0.05 + 0.1 * np.arange(8)), (100, 1))
    times_ms[3] += 800 * off
    if fits:
        common_phases(times_ms, np.full(100, 800.0), "cine")
    else:
        with pytest.raises(InputError, match=r"slice 3 lies 0\.065 of a cycle off"):
            common_phases(times_ms, np.full(100, 800.0), "cine")


@pytest.mark.parametrize(("off", "told"), [(0.019, False), (0.022, True)])
def test_a_slice_more_than_half_a_step_off_is_told(off: float, told: bool) -> None:
    """A fiftieth of a cycle, of 25 phases."""
    times_ms = np.tile(800 * (0.02 + 0.03 * np.arange(25)), (100, 1))
    times_ms[3] += 800 * off
    doubts = doubts_of_phases(times_ms, np.full(100, 800.0), range(100))
    assert [doubt[:19] for doubt in doubts] == ["slice 3 lies 0.022 "] * told


def frame_at(along_mm: float, time_ms: float) -> Frame:
    """An image of 3 rows, 10 mm apart, and 5 columns, 2 mm apart, across the patient's x."""
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    position_mm = np.array([along_mm, 2.0, 3.0])
    times_ms = {"trigger time": time_ms}
    return Frame("here", np.zeros((3, 5)), position_mm, axes, (2.0, 10.0), times_ms, 800.0)


def test_the_middle_of_an_image_is_halfway_between_its_outer_pixels() -> None:
    np.testing.assert_allclose(frame_at(1.0, 0).middle_mm, [1, 2 + 4 * 2 / 2, 3 + 2 * 10 / 2])


def test_slices_of_a_thin_volume_are_told_apart_and_rounded_places_are_not() -> None:
    frames = [frame_at(z + off, 0) for z in (0.0, 0.6, 1.2) for off in (0, 0.01)]
    slices = by_slice(frames)
    assert [[one.position_mm[0] for one in part] for part in slices] == [
        [0, 0.01], [0.6, 0.61], [1.2, 1.21],
    ]  # fmt: skip


@pytest.mark.parametrize(("last_ms", "spans"), [(64.0, False), (88.0, True)])
def test_a_beat_is_spanned_by_a_tenth_of_it(last_ms: float, spans: bool) -> None:
    frames = [frame_at(z, time_ms) for z in (0.0, 8.0, 16.0) for time_ms in (0.0, last_ms)]
    assert span_beat(frames) == spans
