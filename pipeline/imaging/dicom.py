"""Cine MR from DICOM files: classic single-frame and Enhanced multi-frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.errors import InvalidDicomError

from pipeline.errors import InputError
from pipeline.imaging.cine import Frame, Stack, stack_frames

NOT_IMAGES = {"DICOMDIR"}


def read_dicom_cine(folder: Path, rr_ms: float | None = None) -> Stack:
    """Read every DICOM file below ``folder`` as one cine stack.

    Parameters
    ----------
    rr_ms
        Overrides the files' own RR interval.

    Raises
    ------
    InputError
        When a file is not readable or truncated, has no trigger time or no place in space, or
        the frames do not make up a regular stack.
    """
    paths = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and path.name not in NOT_IMAGES and not path.name.startswith(".")
    )
    if not paths:
        raise InputError(f"{folder}: is empty; it needs the cine's DICOM files, or a 4D NIfTI file")
    frames = [frame for path in paths for frame in _read_frames(path, rr_ms)]
    source = "study.yaml" if rr_ms is not None else "DICOM trigger time and RR interval"
    return stack_frames(frames, source, str(folder))


def _read_frames(path: Path, rr_ms: float | None) -> Iterator[Frame]:
    try:
        dataset = pydicom.dcmread(path)
    except (InvalidDicomError, EOFError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: cannot be read as DICOM ({error}); copy it again from the scanner"
        ) from error
    _require_image(dataset, path)
    pixels = _pixels(dataset, path)
    if "PerFrameFunctionalGroupsSequence" in dataset:
        yield from _enhanced_frames(dataset, pixels, path, rr_ms)
    else:
        yield _frame(str(path), pixels[0], dataset, dataset, dataset, dataset, rr_ms)


def _require_image(dataset: Any, path: Path) -> None:
    if "PixelData" not in dataset or "Rows" not in dataset:
        raise InputError(
            f"{path}: holds no image (truncated, or not an image object); "
            "copy it again, or take it out of the cine folder"
        )


def _pixels(dataset: Any, path: Path) -> Any:
    """Stored values times slope plus intercept, ``(frame, row, column)``."""
    try:
        stored = dataset.pixel_array
    except Exception as error:  # pydicom's decoders raise many kinds for damaged pixel data
        raise InputError(
            f"{path}: its pixels cannot be read, the file is truncated or damaged ({error}); "
            "copy it again from the scanner"
        ) from error
    frames = stored.reshape(-1, int(dataset.Rows), int(dataset.Columns)).astype(np.float32)
    slope = np.float32(dataset.get("RescaleSlope", 1) or 1)
    return frames * slope + np.float32(dataset.get("RescaleIntercept", 0) or 0)


def _enhanced_frames(dataset: Any, pixels: Any, path: Path, rr_ms: float | None) -> Iterator[Frame]:
    shared = dataset.get("SharedFunctionalGroupsSequence", [pydicom.Dataset()])[0]
    for number, own in enumerate(dataset.PerFrameFunctionalGroupsSequence):

        def group(name: str, own: Any = own) -> Any:
            items = own.get(name) or shared.get(name) or [pydicom.Dataset()]
            return items[0]

        yield _frame(
            f"{path} frame {number + 1}",
            pixels[number],
            group("PlanePositionSequence"),
            group("PlaneOrientationSequence"),
            group("PixelMeasuresSequence"),
            group("CardiacSynchronizationSequence"),
            rr_ms,
        )


def _frame(
    where: str,
    pixels: Any,
    position: Any,
    orientation: Any,
    measures: Any,
    timing: Any,
    rr_ms: float | None,
) -> Frame:
    place = position.get("ImagePositionPatient")
    axes = orientation.get("ImageOrientationPatient")
    spacing = measures.get("PixelSpacing")
    if place is None or axes is None or spacing is None:
        raise InputError(
            f"{where}: has no ImagePositionPatient, ImageOrientationPatient or PixelSpacing; "
            "export the original images, not screen captures"
        )
    trigger = timing.get("TriggerTime", timing.get("NominalCardiacTriggerDelayTime"))
    if trigger is None:
        raise InputError(
            f"{where}: has no trigger time; export the cine with TriggerTime (0018,1060), or "
            "give it as NIfTI with a timing file"
        )
    return Frame(
        where=where,
        pixels=pixels,
        position_mm=np.array(place, dtype=float),
        axes=np.array(axes, dtype=float).reshape(2, 3),
        spacing_mm=(float(spacing[1]), float(spacing[0])),
        trigger_time_ms=float(trigger),
        rr_ms=_rr_ms(timing, where) if rr_ms is None else rr_ms,
    )


def _rr_ms(timing: Any, where: str) -> float:
    for name in ("NominalInterval", "RRIntervalTimeNominal"):
        if timing.get(name):
            return float(timing.get(name))
    if timing.get("HeartRate"):
        return 60000 / float(timing.HeartRate)
    raise InputError(
        f"{where}: has no RR interval (NominalInterval (0018,1062) or HeartRate (0018,1088)); "
        "give cine.rr_ms in study.yaml"
    )
