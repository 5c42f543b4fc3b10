"""Cines in NIfTI files: their frame, their times, and headers that are none."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import InputError
from pipeline.geometry import corners_apart_mm, transform_points
from pipeline.imaging.nifti import read_image, read_nifti_cine, read_nifti_views, write_image
from pipeline.imaging.nifti_doubts import doubts_of_place


def nifti_cine(path: Path, affine_ras: Any, step_s: float | None = 0.16) -> None:
    """A 4D file by nibabel alone."""
    data = np.arange(8 * 6 * 4 * 5, dtype=np.int16).reshape(8, 6, 4, 5)
    image = nibabel.Nifti1Image(data, affine_ras)
    if step_s is not None:
        image.header.set_xyzt_units("mm", "sec")
        image.header.set_zooms((*image.header.get_zooms()[:3], step_s))
    nibabel.save(image, path)


def test_nifti_is_turned_from_ras_to_lps_and_phase_first(tmp_path: Path) -> None:
    affine = np.array([[1.5, 0, 0, -20], [0, 0, -10, 5], [0, 1.25, 0, 7], [0, 0, 0, 1.0]])
    nifti_cine(tmp_path / "cine.nii.gz", affine)
    cine = read_nifti_cine(tmp_path / "cine.nii.gz", None).cine
    data = nibabel.load(tmp_path / "cine.nii.gz").get_fdata()
    assert cine.intensity[3, 2, 1, 5] == data[5, 1, 2, 3]
    ras_mm = affine @ (5, 1, 2, 1)
    lps_mm = transform_points(cine.mr_from_index, np.array([5.0, 1.0, 2.0]))
    np.testing.assert_allclose(lps_mm, (-ras_mm[0], -ras_mm[1], ras_mm[2]), atol=1e-5)
    np.testing.assert_allclose(cine.phases, np.arange(5) / 5)
    assert cine.rr_s == pytest.approx(0.8, rel=1e-6)


def test_a_timing_file_gives_each_slice_its_own_heartbeat(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s=None)
    rr_ms = [800.0, 900.0, 1000.0, 700.0]
    triggers = [[rr * k / 5 for k in range(5)] for rr in rr_ms]
    timing = tmp_path / "timing.json"
    timing.write_text(json.dumps({"trigger_times_ms": triggers, "rr_ms": rr_ms}))
    stack = read_nifti_cine(tmp_path / "cine.nii", timing)
    np.testing.assert_allclose(stack.cine.phases, np.arange(5) / 5)
    assert stack.cine.rr_s == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{}", "trigger_times_ms"),
        ("not json", r"timing\.json"),
        (
            '{"trigger_times_ms": [0, 1], "rr_ms": 800}',
            "4 lists .* trigger_times_ms is a list of 2",
        ),
        ('{"trigger_times_ms": [[0, 1], [0]], "rr_ms": 8}', "is a list of 2 lists of 1 or 2"),
        ('{"trigger_time_ms": [0], "rr_ms": 800}', "it holds trigger_time_ms, rr_ms"),
        ('{"trigger_times_ms": [0, 1, 2, 3, 4], "rr_ms": "fast"}', "rr_ms is 'fast'"),
        ('{"trigger_times_ms": [0, true, 2, 3, 4], "rr_ms": 800}', "_ms holds true"),
        ('{"trigger_times_ms": [0, 200, 100, 300, 400], "rr_ms": 800}', "must rise"),
        ('{"trigger_times_ms": [0, 0.1, 0.2, 0.3, 0.4], "rr_ms": 800}', "are both in milliseconds"),
        ('{"trigger_times_ms": [0, 200, 400, 600, 900], "rr_ms": 800}', "do not fit"),
    ],
)
def test_a_bad_timing_file_is_refused(tmp_path: Path, content: str, words: str) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]))
    timing = tmp_path / "timing.json"
    timing.write_text(content)
    with pytest.raises(InputError, match=words):
        read_nifti_cine(tmp_path / "cine.nii", timing)


def test_a_slice_with_phases_of_its_own_is_refused(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]))
    even = [160.0 * k for k in range(5)]
    late = [150.0 + 130.0 * k for k in range(5)]
    timing = tmp_path / "timing.json"
    timing.write_text(json.dumps({"trigger_times_ms": [even, even, late, even], "rr_ms": 800}))
    with pytest.raises(InputError, match="slice 2 lies"):
        read_nifti_cine(tmp_path / "cine.nii", timing)


def test_a_file_of_one_phase_is_answered_with_what_to_do(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 4), np.int16), np.diag([1, 1, 8, 1.0]))
    nibabel.save(image, tmp_path / "ed.nii.gz")
    words = r"ed\.nii\.gz: is not a cine, its shape is \(8, 6, 4\).*join them into one 4D file"
    with pytest.raises(InputError, match=words):
        read_nifti_cine(tmp_path / "ed.nii.gz", None)


def test_complex_voxels_and_a_beat_without_moments_are_named(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 4, 5), np.complex64), np.diag([1, 1, 8, 1.0]))
    nibabel.save(image, tmp_path / "complex.nii.gz")
    with pytest.raises(InputError, match="voxels are complex numbers; store their magnitude"):
        read_nifti_cine(tmp_path / "complex.nii.gz", None, 800)
    nifti_cine(tmp_path / "cine.nii", np.diag([1.5, 1.5, 8, 1]))
    (tmp_path / "timing.json").write_text('{"rr_ms": 800}')
    with pytest.raises(InputError, match=r"it holds rr_ms; .* give cine\.rr_ms in study\.yaml"):
        read_nifti_cine(tmp_path / "cine.nii", tmp_path / "timing.json")


@pytest.mark.parametrize("shape", [(2, 40, 44, 7), (7, 40, 44, 2)])
def test_axes_in_another_order_are_named(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """Time or the slices first, as arrays of Python often have them."""
    image = nibabel.Nifti1Image(np.ones(shape, np.int16), np.eye(4))
    nibabel.save(image, tmp_path / "cine.nii.gz")
    with pytest.raises(InputError, match=r"so 44 slices of \d columns .*\(columns, rows, slices"):
        read_nifti_cine(tmp_path / "cine.nii.gz", None, 800)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_voxels_in_metres_or_micrometres_are_named(tmp_path: Path, unit: float) -> None:
    affine = np.diag([1.5 * unit, 1.5 * unit, 8 * unit, 1])
    # As far from the scanner's middle as a heart lies.
    affine[:3, 3] = unit * np.array([-180.0, -220.0, 90.0])
    nifti_cine(tmp_path / "cine.nii", affine)
    with pytest.raises(InputError, match=r"its voxels measure .* write its affine in millimetres"):
        read_nifti_cine(tmp_path / "cine.nii", None)


@pytest.mark.parametrize(
    ("column", "words"),
    [([0, 0, 0], "gives a voxel no size"), ([0, 2, 0], "same way")],
)
def test_a_placement_that_is_none_is_told_with_the_other(
    tmp_path: Path, column: list[float], words: str
) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1.5, 1.5, 8, 1]))
    image = nibabel.load(tmp_path / "cine.nii")
    image.set_qform(image.affine, 1)
    spoilt = image.affine.copy()
    spoilt[:3, 0] = column
    image.header.set_sform(spoilt, 1)
    image._affine = spoilt
    nibabel.save(image, tmp_path / "spoilt.nii")
    with pytest.raises(InputError, match=rf"its sform .*{words}.* set sform_code to 0"):
        read_nifti_cine(tmp_path / "spoilt.nii", None)


def test_voxels_without_a_size_are_refused_where_nothing_else_tells_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """At these bytes a header says them: nifti1.h."""
    nifti_cine(tmp_path / "cine.nii", np.diag([1.5, 1.5, 8, 1]))
    whole = bytearray((tmp_path / "cine.nii").read_bytes())
    struct.pack_into("<f", whole, 80, 0.0)
    (tmp_path / "cine.nii").write_bytes(whole)
    by_sform = read_nifti_cine(tmp_path / "cine.nii", None).cine.mr_from_index
    np.testing.assert_allclose(np.abs(np.diag(by_sform)), [1.5, 1.5, 8, 1])
    struct.pack_into("<hh", whole, 252, 1, 0)
    (tmp_path / "cine.nii").write_bytes(whole)
    with pytest.raises(InputError, match=r"no size of voxels \(pixdim \[0\.0, 1\.5, 8\.0\]"):
        read_nifti_cine(tmp_path / "cine.nii", None)
    assert capfd.readouterr() == ("", "")


def placed(path: Path, sform: int, qform: int, apart_mm: float = 0.0) -> tuple[str, ...]:
    """What is told of a file whose header has these codes, and two placements so far apart."""
    nifti_cine(path / "cine.nii", np.diag([1.5, 1.5, 8, 1]))
    image = nibabel.load(path / "cine.nii")
    other = image.affine.copy()
    other[0, 3] += apart_mm
    image.set_sform(image.affine, sform)
    image.set_qform(other, qform)
    nibabel.save(image, path / "placed.nii.gz")
    return read_nifti_cine(path / "placed.nii.gz", None).remarks


def test_a_map_of_labels_is_told(tmp_path: Path) -> None:
    path = tmp_path / "cine_gt.nii"
    labels = np.random.default_rng(1).integers(0, 4, (40, 40, 5, 5)).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(labels, np.diag([1, 1, 8, 1])), path)
    (remark,) = read_nifti_cine(path, None, 800).remarks
    assert remark == "its voxels hold 0, 1, 2, 3 alone, as a map of labels does: is it the cine?"


def test_voxels_that_lost_their_size_are_told(tmp_path: Path) -> None:
    path = tmp_path / "cine.nii"
    nifti_cine(path, np.eye(4))
    (remark,) = read_nifti_cine(path, None).remarks
    assert "voxels of 1 x 1 x 1 mm, so of a heart in 4 mm" in remark
    nifti_cine(path, np.diag([1.5, 1.5, 1, 1]))
    (remark,) = read_nifti_cine(path, None).remarks
    assert "voxels of 1.5 x 1.5 x 1 mm, so of a heart in 4 mm" in remark
    # Whole hearts in cubes of 1 mm, and flat voxels, are what they are.
    for affine, slices in ((np.eye(4), 70), (np.diag([1, 1, 8, 1]), 4)):
        image = nibabel.Nifti1Image(np.zeros((40, 40, slices, 5), np.int16), affine)
        nibabel.save(image, path)
        assert read_nifti_cine(path, None, 800).remarks == ()


@pytest.mark.parametrize(("repetition_s", "told"), [(0.16, True), (0.003, False), (None, False)])
def test_a_time_step_that_is_the_repetition_time_is_told(
    tmp_path: Path, repetition_s: float | None, told: bool
) -> None:
    """As converters write it, of segmented cines too."""
    path = tmp_path / "cine.nii"
    nifti_cine(path, np.diag([1.4, 1.4, 8, 1]))
    said = {} if repetition_s is None else {"RepetitionTime": repetition_s}
    (tmp_path / "cine.json").write_text(json.dumps(said))
    assert [
        ("repetition time of cine.json" in one) for one in read_nifti_cine(path, None).remarks
    ] == ([True] * told)
    assert read_nifti_cine(path, None, 800).remarks == ()


def test_a_header_that_places_the_images_nowhere_is_told(tmp_path: Path) -> None:
    (remark,) = placed(tmp_path, 0, 0)
    assert "places the images nowhere" in remark


def test_two_placements_that_differ_are_told(tmp_path: Path) -> None:
    assert placed(tmp_path, 1, 1, 0.4) == placed(tmp_path, 1, 0, 20) == placed(tmp_path, 0, 1) == ()
    (remark,) = placed(tmp_path, 1, 1, 12.5)
    assert "up to 12.5 mm apart; the sform is taken" in remark


def test_an_axis_too_many_is_named(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(np.zeros((8, 6, 4, 1, 5)), np.eye(4)), tmp_path / "a.nii")
    with pytest.raises(InputError, match=r"\(8, 6, 4, 1, 5\); store it without the axes of length"):
        read_nifti_cine(tmp_path / "a.nii", None)


def test_a_sheared_affine_is_refused(tmp_path: Path) -> None:
    affine = np.diag([1.5, 1.5, 10, 1.0])
    affine[0, 1] = 0.2
    nifti_cine(tmp_path / "cine.nii", affine)
    with pytest.raises(InputError, match="sheared"):
        read_nifti_cine(tmp_path / "cine.nii", None)


def test_nifti_without_timing_is_refused(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s=None)
    with pytest.raises(InputError, match="no trigger times"):
        read_nifti_cine(tmp_path / "cine.nii", None)


def test_times_without_a_unit_or_in_the_wrong_one_are_told(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s=0.15)
    with pytest.raises(InputError, match=r"RR interval 0\.9 ms, .*as if told in seconds; correct"):
        read_nifti_cine(tmp_path / "cine.nii", None, rr_ms=0.9)


@pytest.mark.parametrize(
    ("step", "rr_s"), [(0.15, 0.75), (150.0, 0.75), (1.0, None), (0.01, None), (5000.0, None)]
)
def test_a_step_without_a_unit_is_that_of_a_heartbeat_or_none(
    tmp_path: Path, step: float, rr_s: float | None
) -> None:
    """Of five phases; a step of 1 is what programs write that know none."""
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s=0.15)
    image = nibabel.load(tmp_path / "cine.nii")
    image.header.set_xyzt_units("mm", "unknown")
    image.header["pixdim"][4] = step
    nibabel.save(image, tmp_path / "other.nii")
    if rr_s is None:
        with pytest.raises(InputError, match=rf"a time step of {step:g} without a unit in its hea"):
            read_nifti_cine(tmp_path / "other.nii", None)
        return
    stack = read_nifti_cine(tmp_path / "other.nii", None)
    assert stack.cine.rr_s == pytest.approx(rr_s)
    assert stack.remarks[-1].startswith(f"the NIfTI header's time step of {step:g} has no unit")
    assert "makes a beat of 750 ms" in stack.remarks[-1]


@pytest.mark.parametrize("step_s", [None, 1.0, 0.16])
def test_a_given_rr_interval_spreads_the_phases_evenly(
    tmp_path: Path, step_s: float | None
) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s)
    stack = read_nifti_cine(tmp_path / "cine.nii", None, rr_ms=750)
    np.testing.assert_allclose(stack.cine.phases, np.arange(5) / 5)
    np.testing.assert_allclose(stack.trigger_times_ms, [[0, 150, 300, 450, 600]] * 4)
    assert stack.cine.rr_s == pytest.approx(0.75)
    assert stack.timing_source == "study.yaml"


def test_a_timing_file_keeps_its_trigger_times_under_a_given_rr_interval(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]))
    timing = tmp_path / "timing.json"
    timing.write_text('{"trigger_times_ms": [0, 100, 300, 400, 700], "rr_ms": 800}')
    stack = read_nifti_cine(tmp_path / "cine.nii", timing, rr_ms=1000)
    np.testing.assert_allclose(stack.cine.phases, [0, 0.1, 0.3, 0.4, 0.7])


def test_a_time_step_that_is_no_heart_is_explained(tmp_path: Path) -> None:
    nifti_cine(tmp_path / "cine.nii", np.diag([1, 1, 8, 1.0]), step_s=1.0)
    words = r"5000 ms = 5 phases x the header's time step of 1000 ms.*give cine\.rr_ms"
    with pytest.raises(InputError, match=words):
        read_nifti_cine(tmp_path / "cine.nii", None)


@pytest.mark.parametrize("step_s", [None, 1.0])
def test_a_given_rr_interval_is_that_of_untimed_long_axis_views_too(
    tmp_path: Path, step_s: float | None
) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 1, 4), np.int16), np.diag([1, 1, 8, 1.0]))
    if step_s is not None:
        image.header.set_xyzt_units("mm", "sec")
        image.header.set_zooms((1, 1, 8, step_s))
    nibabel.save(image, tmp_path / "four_chamber.nii.gz")
    nibabel.save(image, tmp_path / "two_chamber.nii.gz")
    own = '{"trigger_times_ms": [0, 200, 500, 900], "rr_ms": 1000}'
    (tmp_path / "two_chamber_timing.json").write_text(own)
    untimed, timed = (view.cine for view in read_nifti_views(tmp_path, rr_ms=800))
    np.testing.assert_allclose(untimed.phases, [0, 0.25, 0.5, 0.75])
    assert untimed.rr_s == pytest.approx(0.8)
    np.testing.assert_allclose(timed.phases, [0, 0.2, 0.5, 0.9])


@pytest.mark.parametrize(
    ("unit", "step", "told"), [("unknown", 0.2, True), ("unknown", 200, True), ("sec", 0.2, False)]
)
def test_a_views_time_step_without_a_unit_is_told_as_the_cines_is(
    tmp_path: Path, unit: str, step: float, told: bool
) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 1, 4), np.int16), np.diag([1, 1, 8, 1.0]))
    image.header.set_xyzt_units("mm", unit)
    image.header["pixdim"][4] = step
    nibabel.save(image, tmp_path / "four_chamber.nii.gz")
    (view,) = read_nifti_views(tmp_path)
    assert view.cine.rr_s == pytest.approx(0.8)
    words = (
        f"the NIfTI header's time step of {step:g} has no unit; as 200 ms it makes a beat of 800"
    )
    assert [one.startswith(words) for one in view.remarks] == [True] * told
    # Who gives the RR interval needs no word.
    assert read_nifti_views(tmp_path, rr_ms=800)[0].remarks == ()


@pytest.mark.parametrize("name", ["four_chamber.json", "2ch_timing.json", "IM0001"])
def test_what_is_no_long_axis_view_nor_its_timing_is_named(tmp_path: Path, name: str) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 1, 4), np.int16), np.diag([1, 1, 8, 1.0]))
    nibabel.save(image, tmp_path / "four_chamber.nii.gz")
    (tmp_path / ".DS_Store").touch()
    assert len(read_nifti_views(tmp_path, rr_ms=800)) == 1
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=rf"{name}: would not be read"):
        read_nifti_views(tmp_path, rr_ms=800)


def test_a_truncated_nifti_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cine.nii.gz"
    nifti_cine(path, np.diag([1, 1, 8, 1.0]))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match=r"cine\.nii\.gz"):
        read_nifti_cine(path, None)


@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    spacing_mm=st.tuples(*[st.floats(0.3, 12)] * 3),
    flip=st.booleans(),
    shape=st.tuples(*[st.integers(1, 5)] * 4),
)
def test_nifti_written_then_read_is_the_same_image_in_the_same_place(
    tmp_path_factory: pytest.TempPathFactory,
    angles: tuple[float, float, float],
    spacing_mm: tuple[float, float, float],
    flip: bool,
    shape: tuple[int, int, int, int],
) -> None:
    from scipy.spatial.transform import Rotation

    path = tmp_path_factory.mktemp("nifti") / "image.nii.gz"
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix() * spacing_mm
    mr_from_index[:3, 3] = (-31.0, 12.0, 250.0)
    if flip:
        mr_from_index[:3, 2] *= -1
    array = np.arange(np.prod(shape), dtype=np.int16).reshape(shape)
    write_image(path, array, mr_from_index)
    first = path.read_bytes()
    found, place = read_image(path)
    np.testing.assert_array_equal(found.reshape(shape), array)
    # The header holds single precision: seven digits of at most 250 mm.
    np.testing.assert_allclose(place, mr_from_index, atol=250 * 2**-23)
    write_image(path, array, mr_from_index)
    assert path.read_bytes() == first


@pytest.mark.parametrize(("unit", "step"), [("sec", 0.16), ("msec", 160), ("usec", 160_000)])
def test_every_unit_of_nifti_times_is_known(tmp_path: Path, unit: str, step: float) -> None:
    image = nibabel.Nifti1Image(np.ones((8, 6, 4, 5), np.int16), np.diag([1.5, 1.5, 8, 1]))
    image.header.set_xyzt_units("mm", unit)
    image.header.set_zooms((1.5, 1.5, 8, step))
    nibabel.save(image, tmp_path / "cine.nii.gz")
    assert read_nifti_cine(tmp_path / "cine.nii.gz", None).cine.rr_s == pytest.approx(0.8)


def test_an_affine_that_leans_by_a_quarter_of_a_degree_is_refused(tmp_path: Path) -> None:
    affine = np.diag([1.5, 1.5, 8, 1])
    affine[0, 2] = 8 * np.tan(np.radians(0.25))
    nifti_cine(tmp_path / "cine.nii.gz", affine)
    with pytest.raises(InputError, match="sheared"):
        read_nifti_cine(tmp_path / "cine.nii.gz", None)


@pytest.mark.parametrize(("off_mm", "told"), [(0.4, 0), (0.6, 1)])
def test_placements_half_a_millimetre_apart_are_told(
    tmp_path: Path, off_mm: float, told: int
) -> None:
    pixels = np.random.default_rng(0).normal(100, 20, (8, 6, 4, 5)).astype(np.float32)
    affine = np.diag([1.5, 1.5, 8, 1])
    image = nibabel.Nifti1Image(pixels, affine)
    affine[0, 3] += off_mm
    image.set_sform(affine, code=1)
    image.set_qform(np.diag([1.5, 1.5, 8, 1]), code=1)
    nibabel.save(image, tmp_path / "cine.nii.gz")
    remarks = read_nifti_cine(tmp_path / "cine.nii.gz", None, 800).remarks
    assert len([one for one in remarks if "sform and qform" in one]) == told


def test_a_matrix_of_other_sizes_than_the_list_is_told(tmp_path: Path) -> None:
    """As tools leave it that change one of the two."""
    image = nibabel.Nifti1Image(np.ones((8, 9, 10, 3), np.float32), np.diag([-8.0, -8, 6, 1]))
    assert doubts_of_place(image) == ()
    image.header["pixdim"][3] = 10
    [told] = doubts_of_place(image)
    assert "matrix has voxels of 8 x 8 x 6 and its pixdim of 8 x 8 x 10" in told


def test_a_step_of_one_without_a_unit_is_no_second_of_two_phases_either(tmp_path: Path) -> None:
    """End-diastole and end-systole alone, saved by a program that knows no times."""
    image = nibabel.Nifti1Image(np.ones((8, 6, 4, 2), np.int16), np.diag([1.5, 1.5, 8, 1]))
    image.header.set_xyzt_units("mm", "unknown")
    nibabel.save(image, tmp_path / "cine.nii")
    with pytest.raises(InputError, match="a time step of 1 without a unit in its header"):
        read_nifti_cine(tmp_path / "cine.nii", None)


@pytest.mark.parametrize(("slices", "phases"), [(2, 5), (4, 1)])
def test_too_few_slices_or_phases_are_named(tmp_path: Path, slices: int, phases: int) -> None:
    pixels = np.ones((8, 6, slices, phases), np.int16)
    nibabel.save(nibabel.Nifti1Image(pixels, np.diag([1.5, 1.5, 8, 1])), tmp_path / "cine.nii")
    with pytest.raises(InputError, match=rf"{slices} slices of {phases} phases; at least 3"):
        read_nifti_cine(tmp_path / "cine.nii", None, 800)


def test_placements_are_as_far_apart_as_their_farthest_corners() -> None:
    """Slices of 8 and of 10 mm from one first slice on: eight steps later 16 mm."""
    one, other = np.diag([1.5, 1.5, 8, 1]), np.diag([1.5, 1.5, 10, 1])
    assert corners_apart_mm(one, other, (5, 6, 9)) == pytest.approx(16)


def test_the_time_from_phase_to_phase_is_written(tmp_path: Path) -> None:
    write_image(tmp_path / "beat.nii.gz", np.zeros((5, 4, 6, 8), np.uint8), np.eye(4), 0.16)
    header: Any = nibabel.load(tmp_path / "beat.nii.gz").header
    assert header.get_zooms()[3] == pytest.approx(0.16)
    assert header.get_xyzt_units() == ("mm", "sec")
