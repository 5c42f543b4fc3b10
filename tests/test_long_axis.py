"""Long-axis views: which images they are, and what they tell of breath-holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from cine_files import (
    COLUMNS,
    PHASES,
    ROWS,
    RR_MS,
    dicom_frame,
    in_series,
    pixel_value,
    write_dicom,
)
from pydicom import dcmread
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.imaging import alignment
from pipeline.imaging.alignment import _in_order, slice_shifts_mm
from pipeline.imaging.cine import Cine
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.long_axis import (
    INDEPENDENT,
    LEAST_AGREEMENT,
    NO_CROSSINGS,
    PLACE_MM,
    SEARCH_MM,
    Crossings,
    _at_phases,
    _place,
    find_crossings,
)
from pipeline.imaging.nifti import read_nifti_views, write_image
from pipeline.imaging.view import PIXEL_MM, view_of
from pipeline.products import read_long_axis, write_cine

ACROSS = [0, 1, 0, 0, 0, -1]  # 37 degrees from the stack's rows, its slices seen from the side
LEANING = [0.8, 0.6, 0.0, -0.3, 0.4, -np.sqrt(0.75)]  # 30 degrees off the stack's own plane


def add_view(folder: Path, number: int, moments: int = PHASES, **changes: Any) -> None:
    for phase in range(moments):
        data = in_series(dicom_frame(0, phase), 50 + number, f"view {number}")
        data.ImageOrientationPatient = ACROSS
        data.NominalInterval = 1000
        for name, value in changes.items():
            setattr(data, name, value)
        data.save_as(folder / f"view_{number}_{phase}.dcm")


def in_frame(uid: str) -> Any:
    def change(data: Any, number: int, phase: int) -> bool:
        data.FrameOfReferenceUID = uid
        return True

    return change


def test_views_are_cines_across_the_stack_in_its_own_frame_of_reference(tmp_path: Path) -> None:
    write_dicom(tmp_path, in_frame("1.2.3"))
    add_view(tmp_path, 0, FrameOfReferenceUID="1.2.3")
    add_view(tmp_path, 1, FrameOfReferenceUID="1.2.4")
    add_view(tmp_path, 2, moments=1, FrameOfReferenceUID="1.2.3", ImagePositionPatient=[9, 9, 9])
    add_view(tmp_path, 3, FrameOfReferenceUID="1.2.3", ImageOrientationPatient=LEANING)
    derived = {"ImageType": ["DERIVED", "SECONDARY"], "PixelData": pixel_value(7, 3).tobytes()}
    add_view(tmp_path, 4, FrameOfReferenceUID="1.2.3", **derived)
    stack, views = read_dicom_study(tmp_path)
    assert [view.name for view in views] == ['series 50 "view 0"']
    view = views[0].cine
    assert view.intensity.shape == (PHASES, 1, *stack.cine.intensity.shape[2:])
    # Its own RR interval is 1000 ms; the stack's is another.
    np.testing.assert_allclose(view.phases, np.arange(PHASES) * RR_MS / PHASES / 1000)
    assert view.rr_s == 1.0
    np.testing.assert_allclose(view.mr_from_index[:3, 0], [0, 1.25, 0], atol=1e-9)
    *apart, derived_why, why = stack.left_out
    assert len(apart) == 5
    told = 'series 54 "view 4": no long-axis view: its images are derived, and no original ones'
    assert derived_why == told
    assert why.startswith('series 51 "view 1": no long-axis view: it has another Frame')


@pytest.mark.parametrize(
    ("every", "third", "words"),
    [
        ({}, {"TriggerTime": 1000.5}, r"its trigger times, from 0 to 1000.5 ms, do not fit in its"),
        # The next R peak is the first moment of the next beat.
        ({}, {"TriggerTime": 1000}, "its trigger times, from 0 to 1000 ms, do not fit in its RR"),
        ({}, {"TriggerTime": -3}, "its trigger times, from -3 to "),
        ({}, {"TriggerTime": ""}, "it has no trigger times"),
        ({}, {"NominalInterval": 0}, "it has no RR interval; cine.rr_ms in study.yaml gives one"),
        ({"NominalInterval": 9}, {}, "its RR interval is 9 ms"),
    ],
)
def test_a_cine_across_the_stack_that_is_no_view_is_told_with_the_reason(
    tmp_path: Path, every: dict[str, Any], third: dict[str, Any], words: str
) -> None:
    write_dicom(tmp_path)
    add_view(tmp_path, 0, **every)
    data = dcmread(tmp_path / "view_0_2.dcm")
    for name, value in third.items():
        setattr(data, name, value)
    data.save_as(tmp_path / "view_0_2.dcm")
    stack, views = read_dicom_study(tmp_path)
    assert views == ()
    assert stack.left_out[-1].startswith(f'series 50 "view 0": no long-axis view: {words}')


@pytest.mark.parametrize(("rr_ms", "views"), [(1400, 1), (1800, 0)])
def test_a_view_spans_a_tenth_of_its_beat(tmp_path: Path, rr_ms: int, views: int) -> None:
    """Two moments 160 ms apart."""
    write_dicom(tmp_path)
    add_view(tmp_path, 0, moments=2, NominalInterval=rr_ms)
    stack, found = read_dicom_study(tmp_path)
    assert len(found) == views
    assert stack.left_out[-1].endswith("all at nearly one moment of the beat, 0 to 160 ms") == (
        not views
    )


@pytest.mark.parametrize(("study", "views"), [("1.2.7", 1), ("1.2.8", 0)])
def test_a_view_without_a_frame_of_reference_is_of_the_stacks_examination(
    tmp_path: Path, study: str, views: int
) -> None:
    def change(data: Any, number: int, phase: int) -> bool:
        data.FrameOfReferenceUID, data.StudyInstanceUID = "1.2.3", "1.2.7"
        return True

    write_dicom(tmp_path, change)
    add_view(tmp_path, 0, StudyInstanceUID=study)
    stack, found = read_dicom_study(tmp_path)
    assert len(found) == views
    assert ("or none and another StudyInstanceUID" in stack.left_out[-1]) == (not views)


def test_a_series_of_two_images_at_each_time_is_no_view(tmp_path: Path) -> None:
    """As of flow, where nothing tells magnitude from velocity."""
    write_dicom(tmp_path)
    add_view(tmp_path, 0)
    add_view(tmp_path, 1, PixelData=pixel_value(7, 3).tobytes(), SeriesInstanceUID="1.2.3.50",
             SeriesNumber=50, SeriesDescription="view 0")  # fmt: skip
    stack, views = read_dicom_study(tmp_path)
    assert views == ()
    reason = 'series 50 "view 0": no long-axis view: it shows two images at 0 ms'
    assert stack.left_out[-1] == reason


def test_a_view_beside_velocities_in_its_series_is_no_other_kind(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    add_view(tmp_path, 0)
    velocity = {"ImageType": ["ORIGINAL", "PRIMARY", "P"], "SeriesNumber": 50}
    add_view(tmp_path, 1, SeriesInstanceUID="1.2.3.50", SeriesDescription="view 0", **velocity)
    stack, views = read_dicom_study(tmp_path)
    assert [view.name for view in views] == ['series 50 "view 0"']
    assert not any("no long-axis view" in line for line in stack.left_out)


def test_velocities_beside_original_images_that_are_no_view_are_not_told_as_alone(
    tmp_path: Path,
) -> None:
    """The images of both times have no RR interval, and that is why there is no view."""
    write_dicom(tmp_path)
    no_rr = {"NominalInterval": None, "HeartRate": None}
    add_view(tmp_path, 0, **no_rr)
    velocity = {"ImageType": ["ORIGINAL", "PRIMARY", "P"], "SeriesNumber": 50}
    named = {"SeriesInstanceUID": "1.2.3.50", "SeriesDescription": "view 0"}
    add_view(tmp_path, 1, **named, **velocity, **no_rr)
    stack, views = read_dicom_study(tmp_path)
    assert views == ()
    told = [line for line in stack.left_out if "no long-axis view" in line]
    assert len(told) == 1
    assert "no RR interval" in told[0]


def test_a_view_is_timed_by_what_tells_its_images_apart(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    for phase in range(PHASES):
        data = in_series(dicom_frame(0, phase), 50, "view")
        data.ImageOrientationPatient, data.TriggerTime = ACROSS, 0
        data.ActualCardiacTriggerDelayTime = 100.0 * phase
        data.save_as(tmp_path / f"view_{phase}.dcm")
    _, (view,) = read_dicom_study(tmp_path)
    np.testing.assert_allclose(view.cine.phases, 100 * np.arange(PHASES) / RR_MS)


@pytest.mark.parametrize("digits", [4, 5, 6])
def test_a_view_is_one_however_its_direction_is_rounded(tmp_path: Path, digits: int) -> None:
    write_dicom(tmp_path)
    rng = np.random.default_rng(0)
    for phase in range(PHASES):
        data = in_series(dicom_frame(0, phase), 50, "view")
        jitter = rng.uniform(-0.5, 0.5, 4) * 10.0**-digits
        # Half-way between two thousandths, and between two tenths of a millimetre.
        along = [0, 0.5005 + jitter[0], np.sqrt(1 - 0.5005**2) + jitter[1]]
        data.ImageOrientationPatient = [*along, *np.cross([1, 0, 0], along)]
        data.ImagePositionPatient = [9.05 + jitter[2], 9.05 + jitter[3], 9]
        data.NominalInterval = 1000
        data.save_as(tmp_path / f"view_{phase}.dcm")
    _, (view,) = read_dicom_study(tmp_path)
    assert view.cine.intensity.shape[0] == PHASES


@pytest.mark.parametrize(
    "changes",
    [
        {"ImagePositionPatient": [9, 9, 10]},
        {"PixelSpacing": [1.3, 1.3]},
        {"ImageOrientationPatient": [0, 1, 0, 0.01, 0, -np.sqrt(1 - 1e-4)]},
    ],
)
def test_views_beside_one_another_are_two(tmp_path: Path, changes: dict[str, Any]) -> None:
    write_dicom(tmp_path)
    place = {"ImagePositionPatient": [9, 9, 9], "PixelSpacing": [1.25, 1.25]}
    add_view(tmp_path, 0, **place)
    add_view(tmp_path, 1, **(place | changes))
    _, views = read_dicom_study(tmp_path)
    assert [len(view.cine.intensity) for view in views] == [PHASES, PHASES]


def test_a_view_taken_again_is_another_and_its_copy_is_none(tmp_path: Path) -> None:
    """Put into one, images of two breath-holds would take turns."""
    write_dicom(tmp_path)
    add_view(tmp_path, 0)
    sevens = np.full((ROWS, COLUMNS), 7, "<u2").tobytes()
    add_view(tmp_path, 1, NominalInterval=900, PixelData=sevens)
    for phase in range(PHASES):
        # As an Enhanced copy of the first tells its times, rounded otherwise.
        data = in_series(dicom_frame(0, phase), 52, "a copy")
        data.ImageOrientationPatient, data.NominalInterval = ACROSS, 1000
        data.TriggerTime = f"{float(data.TriggerTime) + 1e-5:.5f}"
        data.save_as(tmp_path / f"view_2_{phase}.dcm")
    late = in_series(dicom_frame(0, 1), 53, "late enhancement")
    late.ImageOrientationPatient, late.TriggerTime = ACROSS, 555
    late.save_as(tmp_path / "late.dcm")
    _, views = read_dicom_study(tmp_path)
    assert [view.name for view in views] == ['series 50 "view 0"', 'series 51 "view 1"']
    assert [len(view.cine.phases) for view in views] == [PHASES, PHASES]
    assert [view.cine.rr_s for view in views] == [1.0, 0.9]
    assert (views[1].cine.intensity == 7).all()


def test_a_view_taken_again_at_moments_between_the_first_ones_is_another(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    for again in range(2):
        for phase in range(PHASES):
            data = in_series(dicom_frame(0, phase), 50 + again, f"view {again}")
            data.ImageOrientationPatient = ACROSS
            data.TriggerTime = float(data.TriggerTime) + 20 * again
            data.PixelData = pixel_value(phase, 2 * again).tobytes()
            data.save_as(tmp_path / f"view_{again}_{phase}.dcm")
    _, views = read_dicom_study(tmp_path)
    assert [len(view.cine.phases) for view in views] == [PHASES, PHASES]


@pytest.mark.parametrize("at_a_time", [1, 2, 3])
def test_a_view_of_a_series_for_some_phases_each_is_one(tmp_path: Path, at_a_time: int) -> None:
    write_dicom(tmp_path)
    for phase in range(PHASES):
        data = in_series(dicom_frame(0, phase), 50 + phase // at_a_time, "view")
        data.ImageOrientationPatient = ACROSS
        data.save_as(tmp_path / f"view_{phase}.dcm")
    _, (view,) = read_dicom_study(tmp_path)
    assert len(view.cine.phases) == PHASES


def test_views_written_then_read_are_the_same(tmp_path: Path) -> None:
    write_dicom(tmp_path / "cine")
    add_view(tmp_path / "cine", 0)
    stack, views = read_dicom_study(tmp_path / "cine")
    write_cine(tmp_path, stack, views)
    (again,) = read_long_axis(tmp_path)
    assert again.name == views[0].name
    np.testing.assert_array_equal(again.cine.intensity, views[0].cine.intensity)
    np.testing.assert_allclose(again.cine.mr_from_index, views[0].cine.mr_from_index, atol=1e-6)
    np.testing.assert_array_equal(again.cine.phases, views[0].cine.phases)
    # Another program sees the mean step from phase to phase.
    step_s = sitk.ReadImage(str(tmp_path / "cine.nii.gz")).GetSpacing()[3]
    assert step_s == pytest.approx(stack.cine.rr_s / PHASES, rel=1e-6)


def test_views_in_nifti_have_their_own_timing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 99, (3, 1, 6, 7)).astype(np.int16)
    write_image(tmp_path / "two_chamber.nii.gz", images, np.eye(4))
    timing = '{"trigger_times_ms": [[0, 200, 500]], "rr_ms": [1000]}'
    (tmp_path / "two_chamber_timing.json").write_text(timing)
    (view,) = read_nifti_views(tmp_path)
    assert view.name == "two_chamber"
    np.testing.assert_array_equal(view.cine.intensity, images)
    np.testing.assert_allclose(view.cine.phases, [0, 0.2, 0.5])
    write_image(tmp_path / "stack.nii.gz", np.zeros((3, 4, 6, 7), np.int16), np.eye(4))
    with pytest.raises(InputError, match=r"stack\.nii\.gz: is no long-axis view"):
        read_nifti_views(tmp_path)
    assert read_nifti_views(tmp_path / "none") == ()


SLICES, SIDE, SPACING_MM, MOMENTS = 9, 64, 2.0, 4
BREATH_MM = (0.6, 2.2, 1.0)
"""Breath-holds differ along head and feet above all: here along the stack's rows."""

TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The body's y axis runs to the patient's feet."""


class Body:
    """Grey values known everywhere: a beating sum of Gaussians, no two places alike."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.centres_mm = rng.uniform((-45, -45, -10), (45, 45, 90), (60, 3))
        self.widths_mm = rng.uniform(7, 14, 60)
        self.heights = rng.uniform(-1, 1, 60)
        self.swing_mm = rng.normal(0, 2, (60, 3))

    def seen(self, points_mm: Any, phase: float) -> Any:
        centres_mm = self.centres_mm + np.sin(2 * np.pi * phase) * self.swing_mm
        total = np.zeros(points_mm.shape[:-1])
        for centre, width, height in zip(centres_mm, self.widths_mm, self.heights, strict=True):
            away_mm = points_mm - centre
            squares = np.einsum("...i,...i->...", away_mm, away_mm)
            total += height * np.exp(-squares / (2 * width**2))
        return total


def image_of(body: Body, frame: Any, moved_mm: Any, noise: float, rng: Any) -> Any:
    """Images ``(phase, row, column)``, 8 mm thick, of a body displaced by ``moved_mm``."""
    y, x = np.mgrid[:SIDE, :SIDE]
    points_mm = x[..., None] * frame[:3, 0] + y[..., None] * frame[:3, 1] + frame[:3, 3] - moved_mm
    normal = frame[:3, 2] / np.linalg.norm(frame[:3, 2])
    through = points_mm + np.linspace(-4, 4, 5)[:, None, None, None] * normal
    images = np.stack([body.seen(through, k / MOMENTS).mean(axis=0) for k in range(MOMENTS)])
    return images + noise * rng.standard_normal(images.shape)


def frame_of(columns: Any, rows: Any, middle_mm: Any, step_mm: float) -> Any:
    frame = np.eye(4)
    frame[:3, :3] = np.stack([columns, rows, np.cross(columns, rows)], axis=1)
    frame[:3, :2] *= SPACING_MM
    frame[:3, 2] *= step_mm
    frame[:3, 3] = middle_mm - (SIDE - 1) / 2 * frame[:3, :2].sum(axis=1)
    return frame


def turned(frame: Any) -> Any:
    lying = np.eye(4)
    lying[:3, :3] = TURN
    return lying @ frame


def stack_and_views(seed: int, noise: float = 0.05) -> Any:
    """A stack and three views of one body, each image displaced in its own way."""
    rng = np.random.default_rng([seed, 1])
    body, phases = Body(seed), np.arange(MOMENTS) / MOMENTS
    frame = frame_of(*np.eye(3)[:2], np.zeros(3), 10.0)
    slices_mm = rng.normal(0, BREATH_MM, (SLICES, 3))
    stack = [
        image_of(body, frame + np.outer([0, 0, 10.0 * z, 0], [0, 0, 0, 1]), moved, noise, rng)
        for z, moved in enumerate(slices_mm)
    ]
    intensity = np.stack(stack, axis=1).astype(np.float32)
    cine = Cine(intensity, turned(frame), phases, 0.8)
    views, views_mm = [], rng.normal(0, BREATH_MM, (3, 3))
    for angle, moved in zip(np.radians([10, 70, 130]), views_mm, strict=True):
        across = np.array([np.cos(angle), np.sin(angle), 0])
        own = frame_of(across, np.array([0, 0, 1.0]), np.array([0, 0, 40.0]), 1.0)
        # Another gain and offset: nothing but the pattern is compared.
        image = 3 * image_of(body, own, moved, noise, rng) + 7
        views.append(Cine(image[:, None].astype(np.float32), turned(own), phases, 0.8))
    return cine, views, slices_mm, views_mm


def drawn_on(view: Any, shifts_mm: Any) -> Any:
    """Discs, one a slice, displaced with it: a ventricle seen through the stack."""
    rows, columns = np.mgrid[: view.shape[0], : view.shape[1]] * PIXEL_MM
    middle_mm = -view.corner_mm @ view.axes[:2].T
    labels = [
        np.hypot(columns - middle_mm[0] - s[0], rows - middle_mm[1] - s[1]) < 28 for s in shifts_mm
    ]
    return np.repeat(np.stack(labels)[None], MOMENTS, axis=0).astype(np.uint8)


def in_view(view: Any, shifts_mm: Any) -> Any:
    """Displacements of the body along columns, rows and normal of a view, apex first."""
    moved_mm = shifts_mm @ TURN.T @ view.axes.T
    return moved_mm[list(view.order)] if len(shifts_mm) == len(view.order) else moved_mm


def left_mm(shifts_mm: Any) -> float:
    """Root mean square of shifts, the mean apart, which no image can tell."""
    return float(np.sqrt(np.square(shifts_mm - shifts_mm.mean(axis=0)).sum(axis=1).mean()))


def test_crossings_tell_how_far_a_slice_lies_from_a_view() -> None:
    cine, views, slices_mm, views_mm = stack_and_views(1, noise=0.0)
    view = view_of(cine)
    ours, theirs = in_view(view, slices_mm), in_view(view, views_mm)
    found = find_crossings(cine, views, view, drawn_on(view, ours))
    assert len(found.slices) > 0.8 * 3 * SLICES
    error_mm = found.offsets_mm - (ours[list(found.slices)] - theirs[list(found.views)])
    # Linear interpolation on 2 mm pixels and steps of 1 mm; both images are blurred alike. Sums
    # over steps tell a place to half a step.
    assert (np.sqrt(np.square(error_mm).mean(axis=0)) < 0.5).all()


def test_views_are_seen_at_the_stacks_phases_across_the_end_of_the_beat() -> None:
    brightness = np.array([10.0, 40.0, 20.0], np.float32)
    pixels = brightness[:, None, None, None] * np.ones((1, 2, 2), np.float32)
    view = Cine(pixels, np.eye(4), np.array([0.1, 0.4, 0.8]), 0.8)
    found = _at_phases(view, np.array([0.0, 0.1, 0.25, 0.9]))[:, 0, 0]
    # From 0.8 to 1.1 it falls from 20 to 10.
    np.testing.assert_allclose(found, [20 - 20 / 3, 10, 25, 20 - 10 / 3], rtol=1e-6)


def test_the_place_of_agreement_is_the_likelihoods_mean() -> None:
    """Where the likelihood is normal, place and covariance are those of the normal distribution."""
    place_mm = np.array([2.3, -1.4, 0.6])
    tried = np.arange(-SEARCH_MM, SEARCH_MM + 1)
    off = np.stack(np.meshgrid(tried, tried, tried, indexing="ij"), axis=-1) - place_mm
    bend = np.array([[0.9, 0.2, 0.1], [0.2, 0.7, -0.2], [0.1, -0.2, 0.8]])
    fall = np.einsum("...i,ij,...j->...", off, bend, off) / 2
    agreement = np.sqrt(np.clip(1 - np.exp((fall - 30) / (INDEPENDENT / 2)), 0, 1))
    found = _place(agreement)
    assert found is not None
    # Sums over steps of one deviation leave exp(-2 pi^2), and agreement below 0 counts as none.
    np.testing.assert_allclose(found[0], place_mm, atol=1e-6)
    covariance = np.linalg.inv(bend) + np.diag(np.square(PLACE_MM))
    np.testing.assert_allclose(found[1], covariance, atol=1e-5)
    low = LEAST_AGREEMENT / agreement.max()
    assert _place(0.99 * low * agreement) is None
    assert _place(np.roll(agreement, SEARCH_MM - 2, axis=0)) is None


def drawn_stack_and_views(seed: int) -> Any:
    """And the view of the stack, how slices are displaced in it, and their labels."""
    cine, views, slices_mm, _ = stack_and_views(seed)
    view = view_of(cine)
    truth = in_view(view, slices_mm)
    return cine, views, view, truth, drawn_on(view, truth)


def in_plane_mm(*given: Any) -> Any:
    return slice_shifts_mm(*given)[:, :2]


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 4))]
)
def test_views_leave_less_of_the_shifts_than_smoothness_alone(seed: int) -> None:
    cine, views, view, truth, drawn = drawn_stack_and_views(seed)
    heights_mm = 10.0 * np.arange(SLICES)
    smooth = slice_shifts_mm(drawn, PIXEL_MM, heights_mm, view.axes)
    crossings = find_crossings(cine, views, view, drawn)
    seen = slice_shifts_mm(drawn, PIXEL_MM, heights_mm, view.axes, crossings)
    in_plane, normal = slice(0, 2), slice(2, 3)
    assert left_mm((truth - smooth)[:, in_plane]) < left_mm(truth[:, in_plane])
    # Three lines a slice, each known to half a step (1 mm) of the search and better, leave
    # 0.5 / sqrt(3) mm on either axis; along the normal, where all is blurred, twice as much.
    left_in_plane_mm = left_mm((truth - seen)[:, in_plane])
    assert left_in_plane_mm < 0.5 * np.sqrt(2 / 3) < left_mm((truth - smooth)[:, in_plane])
    assert left_mm((truth - seen)[:, normal]) < 1 / np.sqrt(3) < left_mm(truth[:, normal])
    np.testing.assert_array_equal(smooth[:, normal], 0)


@pytest.mark.parametrize("wrong", ["another body", "displaced"])
def test_a_view_that_is_wrong_is_voted_out(wrong: str) -> None:
    cine, views, view, truth, drawn = drawn_stack_and_views(2)
    heights_mm = 10.0 * np.arange(SLICES)
    smooth = in_plane_mm(drawn, PIXEL_MM, heights_mm, view.axes)
    if wrong == "another body":
        off = stack_and_views(77)[1][0]
    else:
        moved = views[0].mr_from_index.copy()
        moved[:3, 3] += (14.0, 21.0, 9.0)
        off = replace(views[0], mr_from_index=moved)
    crossings = find_crossings(cine, [off, *views[1:]], view, drawn)
    seen = in_plane_mm(drawn, PIXEL_MM, heights_mm, view.axes, crossings)
    assert left_mm(truth[:, :2] - seen) < left_mm(truth[:, :2] - smooth)
    agree, lines = np.transpose([crossings.agreement(k) for k in range(3)])
    assert np.all(lines >= SLICES // 2)
    assert np.all(agree[1:] > lines[1:] / 2)
    if wrong == "another body":
        assert agree[0] < lines[0] / 2


def test_a_view_that_contradicts_slices_and_views_is_left_out_of_the_equations() -> None:
    """Offsets of one view drift from slice to slice as those of no rigid view can."""
    cine, views, view, _, drawn = drawn_stack_and_views(3)
    heights_mm = 10.0 * np.arange(SLICES)
    good = find_crossings(cine, views, view, drawn)
    offsets_mm = good.offsets_mm.copy()
    third = np.array(good.views) == 2
    offsets_mm[third] += np.linspace(-15, 15, third.sum())[:, None]
    bad = replace(good, offsets_mm=offsets_mm)
    with_bad = in_plane_mm(drawn, PIXEL_MM, heights_mm, view.axes, bad)
    without = in_plane_mm(drawn, PIXEL_MM, heights_mm, view.axes, good.without(2))
    np.testing.assert_allclose(with_bad, without, atol=1e-9)


def test_slices_of_one_volume_are_not_moved() -> None:
    cine, views, slices_mm, _ = stack_and_views(4)
    view = view_of(cine)
    drawn = drawn_on(view, in_view(view, slices_mm))
    assert not slice_shifts_mm(drawn, PIXEL_MM, 2.0 * np.arange(SLICES), view.axes).any()
    thin = replace(cine, mr_from_index=cine.mr_from_index @ np.diag([1, 1, 0.2, 1]))
    assert find_crossings(thin, views, view_of(thin), drawn) is NO_CROSSINGS


@pytest.mark.slow
def test_a_shift_seen_in_the_plane_tells_of_the_one_along_the_normal() -> None:
    """What is left is the variance of a normal distribution's third component, given two."""
    count = 400
    axes = Rotation.from_euler("xyz", [50, 30, 20], degrees=True).as_matrix()
    covariance = axes @ np.diag(np.square(alignment.BREATH_MM)) @ axes.T
    shifts_mm = np.random.default_rng(8).multivariate_normal(np.zeros(3), covariance, count)
    exact = np.tile(1e6 * np.diag([1.0, 1.0, 0.0]), (count, 1, 1))
    cut = Crossings(tuple(range(count)), (0,) * count, shifts_mm, exact)
    nothing = np.zeros((1, count, 4, 4), np.uint8)
    # So far apart that no slice is held back.
    far_mm = 100.0 * np.arange(count)
    found_mm = slice_shifts_mm(nothing, PIXEL_MM, far_mm, axes, cut)
    left_mm = found_mm[:, 2] - shifts_mm[:, 2]
    given = covariance[2, :2] @ np.linalg.inv(covariance[:2, :2]) @ covariance[:2, 2]
    expected = covariance[2, 2] - given
    assert expected < 0.5 * covariance[2, 2]
    # Four standard deviations of a variance's estimate.
    assert left_mm.var() == pytest.approx(expected, rel=4 * np.sqrt(2 / count))
    # Slices that no view cuts stay at their height.
    half = replace(cut.without(0), slices=cut.slices[::2], views=cut.views[::2])
    half = replace(half, offsets_mm=cut.offsets_mm[::2], precision=exact[::2])
    alone_mm = slice_shifts_mm(nothing, PIXEL_MM, far_mm, axes, half)
    assert alone_mm[::2, 2].any()
    assert not alone_mm[1::2, 2].any()
    # Near to one another, they keep their order, and half of their distance.
    near_mm = 5.0 * np.arange(count)
    moved_mm = slice_shifts_mm(nothing, PIXEL_MM, near_mm, axes, cut)[:, 2]
    assert np.diff(near_mm - found_mm[:, 2]).min() < 0
    assert np.diff(near_mm - moved_mm).min() == pytest.approx(2.5, abs=1e-5)


@pytest.mark.parametrize("weights", [np.ones(20), np.linspace(0.1, 1, 20)], ids=["alike", "not"])
def test_slices_that_would_change_places_move_as_little_as_keeps_them_apart(weights) -> None:
    heights_mm = 5.0 * np.arange(20)
    given_mm = np.random.default_rng(9).normal(0, 4, 20)

    def off_mm(gaps_mm: Any) -> Any:
        """How far places with these gaps lie from those given, where their mean is best."""
        away_mm = np.concatenate([[0], np.cumsum(gaps_mm)]) - (heights_mm - given_mm)
        return away_mm - np.average(away_mm, weights=weights)

    # The least squares that such places leave, by a general solver.
    start = np.full(19, 5.0)
    best = minimize(
        lambda gaps: (weights * np.square(off_mm(gaps))).sum(), start, bounds=[(2.5, None)] * 19
    )
    assert best.success
    assert best.fun > 10
    left_mm = _in_order(heights_mm, given_mm, weights) - given_mm
    np.testing.assert_allclose(left_mm, -off_mm(best.x), atol=1e-2)
