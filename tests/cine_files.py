"""A cine stack in DICOM files as pydicom writes them: good ones, to be damaged by tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import (
    EnhancedMRImageStorage,
    ExplicitVRLittleEndian,
    MRImageStorage,
    generate_uid,
)

from pipeline.geometry import transform_points
from pipeline.imaging.cine import Stack
from pipeline.imaging.dicom import read_dicom_study

Change = Callable[[FileDataset, int, int], bool]

SLICES, PHASES, ROWS, COLUMNS = 4, 5, 6, 8
ALL_FRAMES = [(number, phase) for number in range(SLICES) for phase in range(PHASES)]
RR_MS = 800.0
STEP_MM = 10.0

# A stack that is oblique to every axis of the patient.
ROW_AXIS = np.array([0.8, 0.6, 0.0])
COLUMN_AXIS = np.array([0.0, 0.0, -1.0])
NORMAL = np.cross(ROW_AXIS, COLUMN_AXIS)
ORIGIN_MM = np.array([-50.0, 30.0, 12.5])
PIXEL_MM = (1.5, 1.25)  # from row to row, from column to column


def read_dicom_cine(folder: Path, rr_ms: float | None = None) -> Stack:
    """The stack of a folder of DICOM files, without the views beside it."""
    return read_dicom_study(folder, rr_ms)[0]


def pixel_value(phase: int, number: int) -> Any:
    """An image that no other slice and phase has."""
    return (100 * number + 10 * phase + np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)).astype(
        np.uint16
    )


def dicom_frame(number: int, phase: int) -> FileDataset:
    """One classic single-frame MR image."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = MRImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = MRImageStorage, meta.MediaStorageSOPInstanceUID
    data.Modality = "MR"
    data.Rows, data.Columns = ROWS, COLUMNS
    data.ImagePositionPatient = (ORIGIN_MM + number * STEP_MM * NORMAL).tolist()
    data.ImageOrientationPatient = [*ROW_AXIS, *COLUMN_AXIS]
    data.PixelSpacing = list(PIXEL_MM)
    data.TriggerTime = phase * RR_MS / PHASES
    data.NominalInterval = int(RR_MS)
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.PixelData = pixel_value(phase, number).tobytes()
    return data


def write_dicom(
    folder: Path, change: Callable[[FileDataset, int, int], bool] | None = None
) -> None:
    """A stack in files whose names say nothing of their order; ``change`` may drop one."""
    rng = np.random.default_rng(4)
    names = rng.permutation(SLICES * PHASES)
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(SLICES):
        for phase in range(PHASES):
            data = dicom_frame(number, phase)
            if change is not None and not change(data, number, phase):
                continue
            data.save_as(folder / f"{names[number * PHASES + phase]:04d}.dcm")


def item(**fields: Any) -> list[Dataset]:
    """A sequence of one item."""
    data = Dataset()
    for name, value in fields.items():
        setattr(data, name, value)
    return [data]


def in_series(data: FileDataset, number: int, title: str) -> FileDataset:
    data.SeriesInstanceUID = f"1.2.3.{number}"
    data.SeriesNumber, data.SeriesDescription = number, title
    return data


def enhanced_object(order: list[tuple[int, int]]) -> FileDataset:
    """One Enhanced multi-frame MR image with the (slice, phase) frames of ``order``."""
    data = dicom_frame(0, 0)
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = EnhancedMRImageStorage
    data.SharedFunctionalGroupsSequence = item(
        PlaneOrientationSequence=item(ImageOrientationPatient=data.ImageOrientationPatient),
        PixelMeasuresSequence=item(PixelSpacing=data.PixelSpacing),
    )
    moved = ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
    for name in ("TriggerTime", "NominalInterval", *moved):
        delattr(data, name)
    data.PerFrameFunctionalGroupsSequence = [
        item(
            PlanePositionSequence=item(
                ImagePositionPatient=(ORIGIN_MM + number * STEP_MM * NORMAL).tolist()
            ),
            CardiacSynchronizationSequence=item(
                NominalCardiacTriggerDelayTime=phase * RR_MS / PHASES, RRIntervalTimeNominal=RR_MS
            ),
        )[0]
        for number, phase in order
    ]
    data.NumberOfFrames = len(order)
    data.PixelData = b"".join(pixel_value(phase, number).tobytes() for number, phase in order)
    return data


def assert_is_the_stack(stack: Stack) -> None:
    cine = stack.cine
    assert cine.intensity.shape == (PHASES, SLICES, ROWS, COLUMNS)
    for phase in range(PHASES):
        for number in range(SLICES):
            np.testing.assert_array_equal(cine.intensity[phase, number], pixel_value(phase, number))
    np.testing.assert_allclose(cine.phases, np.arange(PHASES) / PHASES)
    assert cine.rr_s == pytest.approx(RR_MS / 1000)
    # The third pixel of row 2 in slice 3, by the DICOM standard's own equation (C.7.6.2.1).
    expected_mm = ORIGIN_MM + 3 * STEP_MM * NORMAL
    expected_mm = expected_mm + 3 * PIXEL_MM[1] * ROW_AXIS + 2 * PIXEL_MM[0] * COLUMN_AXIS
    found_mm = transform_points(cine.mr_from_index, np.array([3.0, 2.0, 3.0]))
    np.testing.assert_allclose(found_mm, expected_mm, atol=1e-6)


def beside_the_stack(folder: Path, others: list[FileDataset]) -> Path:
    """The good stack as series 1, and other images as series 9."""
    write_dicom(folder, lambda data, number, phase: bool(in_series(data, 1, "short axis")))
    for k, data in enumerate(others):
        in_series(data, 9, "other").save_as(folder / f"other_{k:03d}.dcm")
    return folder


def series(slices: list[int], times_ms: list[float]) -> list[FileDataset]:
    """Images of some slices at some moments that none of the stack's equals."""
    found = []
    for number in slices:
        for k, time_ms in enumerate(times_ms):
            data = dicom_frame(number, 0)
            data.TriggerTime = time_ms
            data.PixelData = (3 * pixel_value(k, number)).tobytes()
            found.append(data)
    return found


def coarser(found: list[FileDataset]) -> list[FileDataset]:
    for data in found:
        data.PixelSpacing = [2 * value for value in data.PixelSpacing]
    return found


def across(slices: int, kind: str, phases: int = PHASES) -> list[FileDataset]:
    """A cine stack in another direction."""
    found = series(list(range(slices)), [RR_MS * k / phases for k in range(phases)])
    for data in found:
        number = round(float((np.array(data.ImagePositionPatient) - ORIGIN_MM) @ NORMAL) / STEP_MM)
        data.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = [0, 0, number * STEP_MM]
        data.ImageType = [kind, "PRIMARY", "M"]
    return found
