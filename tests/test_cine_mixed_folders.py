"""Folders as scanners and archives export them: the stack is found, the rest is named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    COLUMN_AXIS,
    COLUMNS,
    NORMAL,
    ORIGIN_MM,
    PHASES,
    ROW_AXIS,
    ROWS,
    RR_MS,
    SLICES,
    STEP_MM,
    assert_is_the_stack,
    dicom_frame,
    enhanced_object,
    in_series,
    pixel_value,
    read_dicom_cine,
    write_dicom,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from pydicom.dataset import FileDataset
from pydicom.uid import (
    BasicTextSRStorage,
    MRImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    SecondaryCaptureImageStorage,
)
from scipy.spatial.transform import Rotation

from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.imaging.cine import stack_frames
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.frames import DERIVED, ORIGINAL, Frame
from pipeline.job import Job
from pipeline.stages import ingest
from pipeline.study import open_study


def resized(data: FileDataset, factor: int) -> FileDataset:
    """The same field of view on a finer matrix."""
    pixels = data.pixel_array.repeat(factor, axis=0).repeat(factor, axis=1)
    data.Rows, data.Columns = pixels.shape
    data.PixelSpacing = [float(value) / factor for value in data.PixelSpacing]
    # The corner pixel's centre moves by half of what its size shrinks.
    shrinks = [(factor - 1) / 2 * float(value) for value in data.PixelSpacing]
    corner_mm = np.array(data.ImagePositionPatient, float)
    corner_mm = corner_mm - shrinks[1] * ROW_AXIS - shrinks[0] * COLUMN_AXIS
    data.ImagePositionPatient = corner_mm.tolist()
    data.PixelData = pixels.tobytes()
    return data


def untimed(data: FileDataset) -> FileDataset:
    del data.TriggerTime, data.NominalInterval
    return data


def mixed(folder: Path, others: list[FileDataset]) -> Path:
    """The good stack, its slices as series 1 to 4, with other files among it."""

    def numbered(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, number + 1, "cine short axis")
        return True

    write_dicom(folder, numbered)
    for k, data in enumerate(others):
        data.save_as(folder / f"0{k:03d}_other.dcm")
    return folder


def localisers() -> list[FileDataset]:
    found = []
    for k, axes in enumerate(([1, 0, 0, 0, 1, 0], [0, 1, 0, 0, 0, -1], [1, 0, 0, 0, 0, -1])):
        data = in_series(untimed(resized(dicom_frame(k, 0), 2)), 9, "localiser")
        data.ImageOrientationPatient = axes
        found.append(data)
    return found


def parallel_scouts() -> list[FileDataset]:
    """Single images along and beyond the stack, wider apart."""
    scouts = [untimed(resized(dicom_frame(0, 0), 2)) for _ in range(5)]
    for k, data in enumerate(scouts):
        away = (1.7 * k - 2) * STEP_MM * NORMAL
        data.ImagePositionPatient = (np.array(data.ImagePositionPatient, float) + away).tolist()
    return [in_series(data, 9, "scout") for data in scouts]


def other_cine(change: Callable[[FileDataset], object]) -> list[FileDataset]:
    """All the stack's frames once more, changed."""
    found = [in_series(dicom_frame(*which), 9, "more of the same") for which in ALL_FRAMES]
    for data in found:
        change(data)
    return found


def finer() -> list[FileDataset]:
    """Three of the four slices on another matrix."""
    return other_cine(lambda data: resized(data, 2))[: 3 * PHASES]


def of_type(*values: str) -> list[FileDataset]:
    def change(data: FileDataset) -> None:
        data.ImageType = list(values)
        data.PixelData = (2 * data.pixel_array).tobytes()

    return other_cine(change)


def stills() -> list[FileDataset]:
    """Late-enhancement images: one a slice, on the cine's own grid."""
    found = [in_series(dicom_frame(number, 3), 9, "late enhancement") for number in range(SLICES)]
    for data in found:
        data.PixelData = (3 * data.pixel_array).tobytes()
    return found


@pytest.mark.parametrize(
    ("others", "lines"),
    [
        (
            localisers,
            [
                'series 9 "localiser": 1 image (',
                "not parallel to the stack, turned by 90 degrees",
                "turned by 37 degrees",
                "turned by 53 degrees",
            ],
        ),
        (parallel_scouts, ['series 9 "scout": 5 images', "one moment a slice, no cine"]),
        (finer, ['series 9 "more of the same": 15 images', "has already, 12 x 16 pixels"]),
        (lambda: of_type("DERIVED", "SECONDARY", "MPR"), ["20 images", "derived images, slices"]),
        (lambda: of_type("ORIGINAL", "PRIMARY", "P"), ["20 images", "phase images, slices"]),
        (stills, ['series 9 "late enhancement": 4 images', "one moment of the beat"]),
        (
            lambda: other_cine(lambda data: None),
            ["series 1 ", "series 4 ", "5 images", 'a copy of series 9 "more'],
        ),
    ],
    ids=["localisers", "scouts", "finer", "derived", "phase images", "stills", "copies"],
)
def test_what_is_not_of_the_stack_is_left_out_and_named(
    tmp_path: Path, others: Callable[[], list[FileDataset]], lines: list[str]
) -> None:
    stack = read_dicom_cine(mixed(tmp_path, others()))
    assert_is_the_stack(stack)
    told = "\n".join(stack.left_out)
    for words in lines:
        assert words in told


def test_of_two_stacks_of_the_same_slices_the_finer_one_is_taken(tmp_path: Path) -> None:
    twice = other_cine(lambda data: resized(data, 2))
    stack = read_dicom_cine(mixed(tmp_path, twice))
    np.testing.assert_array_equal(stack.cine.intensity[1, 2], twice[2 * PHASES + 1].pixel_array)
    assert len(stack.left_out) == SLICES
    assert all("slices that the stack has already, 6 x 8" in line for line in stack.left_out)


def test_a_folder_copied_into_itself_is_one_stack_and_a_line_a_series(tmp_path: Path) -> None:
    mixed(tmp_path / "cine", [])
    shutil.copytree(tmp_path / "cine", tmp_path / "cine" / "again")
    stack = read_dicom_cine(tmp_path / "cine")
    assert_is_the_stack(stack)
    assert len(stack.left_out) == SLICES
    assert all(f"{PHASES} images" in line and "a copy of" in line for line in stack.left_out)


def test_images_of_another_modality_are_no_cine(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.2"
        data.Modality = "CT"
        return True

    write_dicom(tmp_path, change)
    with pytest.raises(InputError, match="CT Image Storage, of modality CT"):
        read_dicom_cine(tmp_path)


def test_the_same_cine_as_classic_and_enhanced_objects_is_one_stack(tmp_path: Path) -> None:
    stack = read_dicom_cine(mixed(tmp_path, [enhanced_object(ALL_FRAMES)]))
    assert_is_the_stack(stack)
    assert len(stack.left_out) == SLICES
    assert all("a copy of images of an unnumbered series" in line for line in stack.left_out)


def other_object(sop_class: str) -> FileDataset:
    data = untimed(dicom_frame(0, 0))
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = sop_class
    del data.ImagePositionPatient, data.ImageOrientationPatient, data.PixelSpacing
    if sop_class == BasicTextSRStorage:
        del data.PixelData, data.Rows, data.Columns
    return data


@pytest.mark.parametrize(
    ("sop_class", "words"),
    [
        (BasicTextSRStorage, "Basic Text SR Storage, no image"),
        (
            SecondaryCaptureImageStorage,
            "Secondary Capture Image Storage, without a place in space",
        ),
    ],
)
def test_reports_and_screen_captures_are_left_out_and_named(
    tmp_path: Path, sop_class: str, words: str
) -> None:
    stack = read_dicom_cine(mixed(tmp_path / "cine", [other_object(sop_class)]))
    assert_is_the_stack(stack)
    line = f"images of an unnumbered series: 1 object (0000_other.dcm): {words}"
    assert stack.left_out == (line,)
    (tmp_path / "none").mkdir()
    other_object(sop_class).save_as(tmp_path / "none" / "only.dcm")
    with pytest.raises(InputError, match="holds no MR image"):
        read_dicom_cine(tmp_path / "none")


def emptied(*names: str, sop_class: str = SecondaryCaptureImageStorage) -> FileDataset:
    """A picture of the screen, as a program that makes files anonymous leaves it."""
    data = dicom_frame(0, 0)
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = sop_class
    data.Modality, data.ImageType = "OT", ["DERIVED", "SECONDARY"]
    for name in names:
        setattr(data, name, None)
    return data


@pytest.mark.parametrize(
    "picture",
    [
        emptied("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"),
        emptied("PixelSpacing"),
        emptied("ImagePositionPatient", sop_class=MRImageStorage),
    ],
)
def test_pictures_whose_place_was_emptied_are_left_out(
    tmp_path: Path, picture: FileDataset
) -> None:
    stack = read_dicom_cine(mixed(tmp_path, [picture]))
    assert_is_the_stack(stack)
    (line,) = stack.left_out
    assert "1 object" in line
    assert "without a place in space" in line


def test_converted_images_that_tell_their_planes_are_the_stack(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = (
        MultiFrameGrayscaleWordSecondaryCaptureImageStorage
    )
    data.Modality = "OT"
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_derived_images_alone_are_a_stack(tmp_path: Path) -> None:
    def derived(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageType = ["DERIVED", "PRIMARY", "M"]
        return True

    write_dicom(tmp_path, derived)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_a_derived_slice_stands_in_where_there_is_no_original_one(tmp_path: Path) -> None:
    def derived(data: FileDataset, number: int, phase: int) -> bool:
        data.ImageType = ["DERIVED" if number == 1 else "ORIGINAL", "PRIMARY", "M"]
        return True

    write_dicom(tmp_path, derived)
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert stack.left_out == ()


def test_every_phase_as_a_series_of_its_own_is_read(tmp_path: Path) -> None:
    def by_phase(data: FileDataset, number: int, phase: int) -> bool:
        in_series(data, phase + 1, f"phase {phase}")
        return True

    write_dicom(tmp_path, by_phase)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_a_wrong_distance_between_slices_in_the_header_changes_nothing(tmp_path: Path) -> None:
    def lying(data: FileDataset, number: int, phase: int) -> bool:
        data.SpacingBetweenSlices = 2 * STEP_MM
        return True

    write_dicom(tmp_path, lying)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_each_slice_has_its_own_heartbeat(tmp_path: Path) -> None:
    rr_ms = [800, 900, 1000, 700]

    def own(data: FileDataset, number: int, phase: int) -> bool:
        data.NominalInterval = rr_ms[number]
        data.TriggerTime = rr_ms[number] * phase / PHASES
        return True

    write_dicom(tmp_path, own)
    stack = read_dicom_cine(tmp_path)
    np.testing.assert_allclose(stack.cine.phases, np.arange(PHASES) / PHASES)
    np.testing.assert_allclose(stack.rr_ms, rr_ms)
    assert stack.cine.rr_s == pytest.approx(0.85)


def repeated_slice() -> list[FileDataset]:
    """Slice 2 in another breath-hold, with another heart rate."""
    found = [in_series(dicom_frame(2, phase), 9, "slice 3 again") for phase in range(PHASES)]
    for phase, data in enumerate(found):
        data.TriggerTime, data.NominalInterval = 170.0 * phase, 850
        data.PixelData = (2 * data.pixel_array).tobytes()
    return found


def test_a_series_that_study_yaml_leaves_out_is_not_read(tmp_path: Path) -> None:
    """Where a slice was taken again, whoever made the study says which is good."""
    folder = mixed(tmp_path, repeated_slice())
    stack, _ = read_dicom_study(folder, without_series=(9,))
    assert_is_the_stack(stack)
    images = f"{PHASES} images (the first is 0000_other.dcm)"
    reason = "study.yaml leaves it out"
    assert stack.left_out == (f'series 9 "slice 3 again": {images}: {reason}',)
    again, _ = read_dicom_study(folder, without_series=(3,))
    assert again.cine.intensity.shape == stack.cine.intensity.shape
    assert (again.cine.intensity[:, 2] == 2 * stack.cine.intensity[:, 2]).all()
    assert (again.cine.intensity[:, 1] == stack.cine.intensity[:, 1]).all()
    with pytest.raises(InputError, match=r"holds no series 4711.*leave_out_series.*1, 2, 3, 4, 9"):
        read_dicom_study(folder, without_series=(9, 4711))


def turned_slice() -> list[FileDataset]:
    found = [in_series(dicom_frame(SLICES, phase), 9, "turned") for phase in range(PHASES)]
    for data in found:
        data.ImageOrientationPatient = [*COLUMN_AXIS, *-ROW_AXIS]
    return found


def further_slices_finer() -> list[FileDataset]:
    found = [dicom_frame(SLICES, phase) for phase in range(PHASES)]
    return [in_series(resized(data, 2), 9, "the last slice") for data in found]


def second_stack() -> list[FileDataset]:
    def turn(data: FileDataset) -> None:
        number = round(float((np.array(data.ImagePositionPatient) - ORIGIN_MM) @ NORMAL) / STEP_MM)
        data.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = [0, 0, number * STEP_MM]

    return other_cine(turn)


@pytest.mark.parametrize(
    ("others", "words"),
    [
        (
            repeated_slice,
            r'slice 2 is given twice: by series 3 .*, and by series 9 "slice 3 again"',
        ),
        (turned_slice, "turned in their plane: .*cine.leave_out_series"),
        (
            further_slices_finer,
            r'matrices: series \d "cine short axis" .*, series 9 "the last slice" .*leave_out',
        ),
        (second_stack, "two stacks of 20 images in different directions"),
    ],
)
def test_what_may_be_of_the_stack_but_does_not_fit_is_refused(
    tmp_path: Path, others: Callable[[], list[FileDataset]], words: str
) -> None:
    with pytest.raises(InputError, match=words) as raised:
        read_dicom_cine(mixed(tmp_path, others()))
    assert "_other.dcm" in str(raised.value)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("TriggerTime", "", "no trigger time"),
        ("NominalInterval", 0, "no RR interval"),
        ("ImagePositionPatient", [1.0, 2.0], "cannot be understood"),
        ("PixelSpacing", [0.0, 1.0], "cannot be understood .*PixelSpacing"),
        ("ImageOrientationPatient", [1, 0, 0, 1, 0, 0], "cannot be understood .*Orientation"),
        ("NumberOfFrames", 2, "pixels cannot be read"),
    ],
)
def test_a_header_without_sense_is_refused_and_its_file_named(
    tmp_path: Path, name: str, value: Any, words: str
) -> None:
    def spoil(data: FileDataset, number: int, phase: int) -> bool:
        if (number, phase) == (1, 2):
            setattr(data, name, value)
        return True

    write_dicom(tmp_path, spoil)
    with pytest.raises(InputError, match=words) as raised:
        read_dicom_cine(tmp_path)
    assert ".dcm" in str(raised.value)


def test_what_is_left_out_is_told_by_the_stage(tmp_path: Path) -> None:
    mixed(tmp_path / "cine", localisers())
    (tmp_path / "out").mkdir()
    job = Job(
        open_study(tmp_path), Settings(), tmp_path, tmp_path / "out", lambda done, total: None
    )
    figures = ingest.run(job)
    assert len(figures["left_out"]) == 3
    assert all('series 9 "localiser": 1 image (00' in line for line in figures["left_out"])
    (tmp_path / "study.yaml").write_text("cine: {leave_out_series: [9]}\n")
    (line,) = ingest.run(replace(job, study=open_study(tmp_path)))["left_out"]
    assert line.startswith('series 9 "localiser": 3 images')


def slice_frame(series: int, z: int, phase: int, title: str, **changed: Any) -> Frame:
    values: dict[str, Any] = {
        "where": f"{title} {z} {phase}",
        "pixels": pixel_value(phase, z),
        "position_mm": ORIGIN_MM + z * STEP_MM * NORMAL,
        "axes": np.stack([ROW_AXIS, COLUMN_AXIS]),
        "spacing_mm": (1.25, 1.5),
        "times_ms": {"trigger time": phase * RR_MS / PHASES},
        "rr_ms": RR_MS,
        "series": title,
        "series_uid": str(series),
    }
    return Frame(**(values | changed))


CROWD = [
    *(slice_frame(z, z, phase, "cine") for z, phase in ALL_FRAMES),
    *(slice_frame(7, z, phase, "copy") for z, phase in ALL_FRAMES),
    *(slice_frame(8, z, 1, "still", pixels=np.ones((ROWS, COLUMNS))) for z in range(SLICES)),
    *(slice_frame(9, z, 0, "scout", times_ms={}, spacing_mm=(2.0, 2.0)) for z in range(3)),
    *(slice_frame(10, z, 0, "view", axes=np.eye(3)[:2]) for z in range(2)),
]


@given(order=st.permutations(range(len(CROWD))))
@settings(max_examples=40, deadline=None)
def test_the_order_of_the_files_changes_nothing(order: list[int]) -> None:
    stack = stack_frames([CROWD[k] for k in order], "folder")
    assert_is_the_stack(stack)
    assert stack.left_out == stack_frames(CROWD, "folder").left_out
    assert len(stack.left_out) == SLICES + 3


def test_stills_with_a_series_a_slice_may_reach_beyond_the_stack() -> None:
    cine = [slice_frame(z, z, phase, "cine") for z, phase in ALL_FRAMES]
    blank = np.zeros((ROWS, COLUMNS))
    late = [slice_frame(20 + z, z, 1, "late", pixels=blank) for z in range(SLICES + 1)]
    stack = stack_frames(cine + late, "folder")
    assert_is_the_stack(stack)
    assert len(stack.left_out) == SLICES + 1
    # Alone the last may be a slice of the cine whose other images were lost.
    with pytest.raises(InputError, match=rf"late {SLICES} 1"):
        stack_frames(cine + late[-1:], "folder")


def turned(frame: Frame, rotation: Rotation) -> Frame:
    """As an oblique stack of another patient lies: its numbers are rounded otherwise."""
    position_mm, axes = rotation.apply(frame.position_mm), rotation.apply(frame.axes)
    return replace(frame, position_mm=position_mm, axes=axes)


def wider(frame: Frame) -> Frame:
    """Two columns more at both sides."""
    position_mm = frame.position_mm - 2 * frame.spacing_mm[0] * frame.axes[0]
    return replace(frame, position_mm=position_mm, pixels=np.pad(frame.pixels, ((0, 0), (2, 2))))


def about(frame: Frame) -> Frame:
    """The same image, its rows and columns counted from the other corner."""
    rows, columns = (np.array(frame.pixels.shape) - 1) * frame.spacing_mm[::-1]
    position_mm = frame.position_mm + columns * frame.axes[0] + rows * frame.axes[1]
    pixels = np.rot90(frame.pixels, 2)
    return replace(frame, position_mm=position_mm, axes=-frame.axes, pixels=pixels)


def alternating(rotation: Rotation, *changes: Callable[[Frame], Frame]) -> list[Frame]:
    """A stack that begins and ends with its first form, and has others between."""
    return [
        turned(changes[z % len(changes)](slice_frame(z, z, phase, "cine")), rotation)
        for z in range(5 * len(changes) + 1)
        for phase in range(PHASES)
    ]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("changes", [(wider,), (about,), (wider, about)])
def test_slices_that_alternate_between_forms_are_refused(
    seed: int, changes: tuple[Callable[[Frame], Frame], ...]
) -> None:
    """Whichever way the last digits of the places between two slices fall."""
    frames = alternating(Rotation.random(random_state=seed), lambda frame: frame, *changes)
    with pytest.raises(InputError, match=r"different matrices|turned in their plane"):
        stack_frames(frames, "folder")


@pytest.mark.parametrize("share", [0.2, 0.3, 0.4, 0.45])
def test_a_cine_planned_anew_is_left_out(share: float) -> None:
    """Of another matrix, its slices elsewhere between those of the stack."""
    cine = [slice_frame(z, z, phase, "cine") for z, phase in ALL_FRAMES]
    again = [
        wider(
            slice_frame(
                9, z, phase, "again", position_mm=ORIGIN_MM + (z + share) * STEP_MM * NORMAL
            )
        )
        for z in range(SLICES - 1)
        for phase in range(PHASES)
    ]
    stack = stack_frames(cine + again, "folder")
    assert stack.cine.intensity.shape[:2] == (PHASES, SLICES)
    assert len(stack.left_out) == 1


@pytest.mark.parametrize("step", [0.55, 0.7, 0.85])
def test_a_cine_of_another_step_is_left_out(step: float) -> None:
    """Some of its slices lie in the middle of two of the stack, and some a third of the way."""
    cine = [slice_frame(z, z, phase, "cine") for z in range(10) for phase in range(PHASES)]
    places_mm = np.arange(0.1, 9, step) * STEP_MM
    again = [
        wider(slice_frame(9, 0, phase, "again", position_mm=ORIGIN_MM + at_mm * NORMAL))
        for at_mm in places_mm[:9]
        for phase in range(PHASES)
    ]
    stack = stack_frames(cine + again, "folder")
    assert stack.cine.intensity.shape[:2] == (PHASES, 10)
    assert len(stack.left_out) == 1


@pytest.mark.parametrize("seed", range(4))
def test_of_derived_slices_those_that_are_lacking_are_taken(seed: int) -> None:
    """Every second original one was not sent; the derived ones are all there."""
    rotation = Rotation.random(random_state=seed)
    count = 2 * SLICES + 1
    frames = [
        turned(slice_frame(k, z, phase, "cine", kind=kind), rotation)
        for k, (kind, step) in enumerate(((ORIGINAL, 2), (DERIVED, 1)))
        for z in range(0, count, step)
        for phase in range(PHASES)
    ]
    stack = stack_frames(frames, "folder")
    assert stack.cine.intensity.shape[:2] == (PHASES, count)


@pytest.mark.parametrize("share", [0.0, 1 / 3, 0.4, 0.5])
def test_late_enhancement_between_the_slices_is_no_cine(share: float) -> None:
    """Two series of the cine's own matrix, one moment each."""
    cine = [slice_frame(z, z, phase, "cine") for z, phase in ALL_FRAMES]
    late = [
        slice_frame(
            20 + k, z, k, f"late {k}", position_mm=ORIGIN_MM + (z + share) * STEP_MM * NORMAL,
            pixels=np.full((ROWS, COLUMNS), k),
        )
        for k in range(2)
        for z in range(SLICES - 1)
    ]  # fmt: skip
    assert_is_the_stack(stack_frames(cine + late, "folder"))


@pytest.mark.parametrize("seed", range(8))
def test_a_cine_between_two_slices_is_left_out(seed: int) -> None:
    """Such as one of flow through the aorta, of another matrix."""
    rotation = Rotation.random(random_state=seed)
    cine = [slice_frame(z, z, phase, "cine") for z, phase in ALL_FRAMES]
    middle_mm = ORIGIN_MM + 1.5 * STEP_MM * NORMAL
    flow = [
        wider(slice_frame(9, 0, phase, "flow", position_mm=middle_mm)) for phase in range(PHASES)
    ]
    stack = stack_frames([turned(frame, rotation) for frame in cine + flow], "folder")
    assert stack.cine.intensity.shape[:2] == (PHASES, SLICES)
    assert [line for line in stack.left_out if "flow" in line] == list(stack.left_out)


@pytest.mark.parametrize("seed", range(4))
def test_derived_slices_between_original_ones_make_up_one_stack(seed: int) -> None:
    rotation = Rotation.random(random_state=seed)
    frames = [
        turned(slice_frame(z, z, phase, "cine", kind=(ORIGINAL, DERIVED)[z % 2]), rotation)
        for z, phase in ALL_FRAMES
    ]
    assert stack_frames(frames, "folder").cine.intensity.shape[:2] == (PHASES, SLICES)
