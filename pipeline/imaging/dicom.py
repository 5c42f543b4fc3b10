"""Cine MR from DICOM files: classic single-frame and Enhanced multi-frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pydicom

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.cine import Stack, stack_frames
from pipeline.imaging.dicom_files import DIRECTORY, DIRECTORY_NAMES, is_bare, told_from_notes
from pipeline.imaging.dicom_pixels import (
    rescaled,
    stored_pixels,
    upright,
    whole_number,
    without_padding,
)
from pipeline.imaging.dicom_timing import rr_intervals_ms, times_ms
from pipeline.imaging.frames import DERIVED, ORIGINAL, Frame
from pipeline.imaging.left_out import LeftOut, left_out_lines
from pipeline.imaging.limits import FARTHEST_MM
from pipeline.imaging.long_axis_series import LongAxis, long_axis_views
from pipeline.imaging.untimed import spread_evenly
from pipeline.study_files import files_below

Groups = Callable[[str], Any]
"""One frame's functional group by name; the whole object for a classic image."""

MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4"
MR_CLASSES = {
    MR_IMAGE: "MR Image Storage",
    "1.2.840.10008.5.1.4.1.1.4.1": "Enhanced MR Image Storage",
    "1.2.840.10008.5.1.4.1.1.4.4": "Legacy Converted Enhanced MR Image Storage",
}
DEFLATED = b"1.2.840.10008.1.2.1.99"
_META_BYTES = 2048
"""So many hold the part of a file that tells how the others are written."""

MOST_FRAMES = 10**6
"""No object holds more."""

UNASSIGNED = "Unassigned{}ConvertedAttributesSequence"
"""Where Legacy Converted Enhanced objects keep attributes without a functional group."""

OTHER_COMPONENTS = {
    "phase": {"P", "PHASE", "PHASE MAP", "VELOCITY", "VELOCITY MAP"},
    "real": {"R", "REAL"},
    "imaginary": {"I", "IMAGINARY"},
}
"""What in ImageType tells that an image is no magnitude."""


def read_dicom_study(
    folder: Path,
    rr_ms: float | None = None,
    fill: bool = False,
    without_series: Sequence[int] = (),
) -> tuple[Stack, tuple[LongAxis, ...]]:
    """Read every DICOM file below ``folder``, classic or Enhanced: one cine stack, and the
    long-axis views that lie beside it (`pipeline.imaging.long_axis_series.long_axis_views`).

    The folder may hold other images too (long-axis views, localisers, derived images, reports):
    they are listed in the stack's ``left_out``.

    Parameters
    ----------
    rr_ms
        Overrides the files' own RR interval.
    fill
        Let the mean of both neighbours stand in for a slice that is missing.
    without_series
        SeriesNumbers of what is not to be used.

    Raises
    ------
    InputError
        When a file is not readable or truncated, a series that is to be left out is
        not there, an MR image has no place in space, the stack's images have no trigger time, or
        they do not make up a regular stack.
    """
    paths = [path for path in files_below(folder) if path.name.upper() not in DIRECTORY_NAMES]
    if not paths:
        raise InputError(f"{folder}: is empty; it needs the cine's DICOM files, or a 4D NIfTI file")
    images, notes = told_from_notes(paths)
    frames: list[Frame] = []
    numbers: set[int | None] = set()
    others = [LeftOut(str(path), "notes", "", "not DICOM", "file") for path in notes]
    for path in images:
        try:
            number, found = _read_object(path, rr_ms, without_series)
        except (InputError, MemoryError):
            raise
        except Exception as error:  # pydicom raises many kinds where a value is asked for
            raise _not_understood(str(path), error) from error
        if found is not None:
            numbers.add(number)
        if isinstance(found, LeftOut):
            others.append(found)
        else:
            frames += found or []
    _require_series(without_series, numbers, str(folder))
    if not frames:
        told = "; ".join(left_out_lines(others, str(folder)))
        raise InputError(f"{folder}: holds no MR image: {told}; give the cine's files")
    frames = _with_series_told_apart(frames)
    source, remark = None, ""
    if rr_ms is not None:
        source = "study.yaml"
        frames, remark = spread_evenly(frames, rr_ms, str(folder))
    stack = stack_frames(frames, str(folder), source, others, fill)
    if remark:
        stack = replace(stack, remarks=(remark, *stack.remarks))
    views, no_views = long_axis_views(frames, stack.cine)
    return replace(stack, left_out=(*stack.left_out, *no_views)), views


def _read_object(
    path: Path, rr_ms: float | None, without_series: Sequence[int]
) -> tuple[int | None, list[Frame] | LeftOut | None]:
    """Number of a file's series and its frames, or why none is used; None of a directory."""
    dataset = _read(path)
    if _is_directory(dataset):
        return None, None
    number = _series_number(dataset)
    unwanted = number in without_series
    other = "study.yaml leaves it out" if unwanted else _other_object(dataset)
    if not other:
        return number, _read_frames(dataset, path, rr_ms)
    uid, noun = str(dataset.get("SeriesInstanceUID", "")), "image" if unwanted else "object"
    return number, LeftOut(str(path), _series_name(dataset), uid, other, noun)


def _with_series_told_apart(frames: Sequence[Frame]) -> list[Frame]:
    """Series as their number and description tell them, too: programs that make files anonymous may
    give all series one UID, or each file a UID of its own."""
    one_each = len({frame.series_uid for frame in frames}) > 0.5 * len(frames)
    return [
        replace(frame, series_uid=f"{'' if one_each else frame.series_uid} {frame.series}")
        for frame in frames
    ]


def _require_series(asked: Sequence[int], there: set[int | None], where: str) -> None:
    absent = [number for number in asked if number not in there]
    if absent:
        known = sorted(number for number in there if number is not None)
        raise InputError(
            f"{where}: holds no series {absent[0]}, which cine.leave_out_series in study.yaml "
            f"names; there are {', '.join(map(str, known)) or 'none with a number'}"
        )


def _read(path: Path) -> Any:
    try:
        with path.open("rb") as file:
            deflated = DEFLATED in file.read(_META_BYTES)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give yourself the right to, or take it out"
        ) from error
    if deflated:
        # Of a megabyte that unpacks to gigabytes the library makes gigabytes.
        raise InputError(
            f"{path}: is deflated as a whole (transfer syntax {DEFLATED.decode()}); export it "
            "uncompressed, or with its pixels alone compressed"
        )
    try:
        dataset = pydicom.dcmread(path, force=is_bare(path))
        if "TransferSyntaxUID" not in dataset.file_meta:
            implicit, _ = dataset.original_encoding
            dataset.file_meta.TransferSyntaxUID = (
                pydicom.uid.ImplicitVRLittleEndian
                if implicit
                else pydicom.uid.ExplicitVRLittleEndian
            )
        return dataset
    except MemoryError:
        raise
    # What the library raises of damaged files is of many kinds.
    except Exception as error:
        raise InputError(
            f"{path}: is not DICOM, or damaged; copy it again from the scanner, or take it out of "
            f"the folder where it does not belong there ({str(error).partition('. Use ')[0]})"
        ) from error


def _is_directory(dataset: Any) -> bool:
    return str(dataset.file_meta.get("MediaStorageSOPClassUID", "")) == DIRECTORY


def _other_object(dataset: Any) -> str | None:
    """What the object is, when it is known to be something else than an image of a slice."""
    sop_class = str(dataset.get("SOPClassUID", "") or MR_IMAGE)
    magnetic = sop_class in MR_CLASSES
    name = MR_CLASSES.get(sop_class) or pydicom.uid.UID(sop_class).name
    if "PixelData" not in dataset:
        return None if magnetic else f"{name}, no image"
    # OT is what programs call images that they convert, of any origin.
    modality = str(dataset.get("Modality", "") or "MR")
    if modality not in ("MR", "OT") and not magnetic:
        return f"{name}, of modality {modality}"
    if int(dataset.get("SamplesPerPixel", 1) or 1) != 1:
        return f"{name}, in colour"
    # Programs that make files anonymous may leave the attribute, and empty it.
    placed = bool(dataset.get("ImagePositionPatient"))
    placed = placed and (magnetic or bool(dataset.get("PixelSpacing")))
    if "PerFrameFunctionalGroupsSequence" in dataset:
        placed = placed or magnetic or _tells_planes(dataset)
    elif int(dataset.get("NumberOfFrames", 1) or 1) > 1:
        placed = False
    # An original MR image without a place may be one of the cine's, spoilt by an export.
    doubtful = magnetic and _kind(dataset, pydicom.Dataset()) != DERIVED
    return None if placed or doubtful else f"{name}, without a place in space"


def _tells_planes(dataset: Any) -> bool:
    """Whether the functional groups of an object with many frames hold places of its planes."""
    groups = ("PerFrameFunctionalGroupsSequence", "SharedFunctionalGroupsSequence")
    return any("PlanePositionSequence" in item for name in groups for item in dataset.get(name, []))


def _read_frames(dataset: Any, path: Path, rr_ms: float | None) -> list[Frame]:
    if "PixelData" not in dataset or "Rows" not in dataset:
        raise InputError(
            f"{path}: holds no image (truncated, or not an image object); "
            "copy it again, or take it out of the cine folder"
        )
    pixels = upright(without_padding(stored_pixels(dataset, path), dataset), dataset)
    if "PerFrameFunctionalGroupsSequence" not in dataset:
        if len(pixels) > 1:
            raise InputError(
                f"{path}: has {len(pixels)} frames, and does not say where and when each was taken "
                "(PerFrameFunctionalGroupsSequence); export it as Enhanced MR, or an image a file"
            )
        return [_frame(str(path), pixels[0], dataset, lambda _: dataset, rr_ms)]
    own_groups = dataset.PerFrameFunctionalGroupsSequence
    if len(own_groups) != len(pixels):
        raise InputError(
            f"{path}: has {len(pixels)} frames of pixels and {len(own_groups)} descriptions of "
            "frames; copy it again from the scanner"
        )
    shared = (dataset.get("SharedFunctionalGroupsSequence") or [pydicom.Dataset()])[0]
    return [
        _frame(f"{path} frame {k + 1}", pixels[k], dataset, _groups(shared, own), rr_ms, k)
        for k, own in enumerate(own_groups)
    ]


def _groups(shared: Any, own: Any) -> Groups:
    """Functional groups of one frame by name: its own before those of all frames."""

    def group(name: str) -> Any:
        return (own.get(name) or shared.get(name) or [pydicom.Dataset()])[0]

    def with_converted(name: str) -> Any:
        if name != "CardiacSynchronizationSequence":
            return group(name)
        # Converters of classic images leave their times among what has no place of its own.
        found = pydicom.Dataset()
        for one in (UNASSIGNED.format("Shared"), UNASSIGNED.format("PerFrame"), name):
            found.update(group(one))
        return found

    return with_converted


def _frame(
    where: str, pixels: Any, dataset: Any, group: Groups, rr_ms: float | None, place: int = 0
) -> Frame:
    corner = group("PlanePositionSequence").get("ImagePositionPatient")
    axes = group("PlaneOrientationSequence").get("ImageOrientationPatient")
    spacing = group("PixelMeasuresSequence").get("PixelSpacing")
    if not corner or not axes or not spacing:
        told = {"ImagePositionPatient": corner, "ImageOrientationPatient": axes}
        lacking = [name for name, value in {**told, "PixelSpacing": spacing}.items() if not value]
        raise InputError(
            f"{where}: has no {' and no '.join(lacking)}; export the original images, not screen "
            "captures, or, if it is none of the cine, leave its series out: cine.leave_out_series "
            "in study.yaml takes its number"
        )
    try:
        timing = group("CardiacSynchronizationSequence")
        told = rr_intervals_ms(timing, dataset)
        own_rr_ms = next(iter(told.values()), None) if rr_ms is None else rr_ms
        position_mm, directions, spacing_mm = _geometry(corner, axes, spacing)
        return Frame(
            where=where,
            pixels=rescaled(pixels, group("PixelValueTransformationSequence")),
            position_mm=position_mm,
            axes=directions,
            spacing_mm=spacing_mm,
            times_ms=times_ms(timing, own_rr_ms),
            rr_ms=own_rr_ms,
            series=_series_name(dataset),
            series_uid=str(dataset.get("SeriesInstanceUID", "")),
            kind=_kind(dataset, group("MRImageFrameTypeSequence")),
            frame_of_reference=str(dataset.get("FrameOfReferenceUID", "") or ""),
            patient=str(dataset.get("PatientID", "") or "").strip(),
            born=_born(dataset),
            number=_number(dataset, group, place),
            study=str(dataset.get("StudyInstanceUID", "") or ""),
            acquisition=_acquisition(dataset, group),
            other_rr_ms=told.get("HeartRate") if rr_ms is None and len(told) > 1 else None,
        )
    except (ValueError, TypeError, IndexError) as error:
        raise _not_understood(where, error) from error


def _not_understood(where: str, error: Exception) -> InputError:
    return InputError(
        f"{where}: a value in its header cannot be understood ({error}); "
        "copy it again from the scanner"
    )


def _geometry(place: Any, axes: Any, spacing: Any) -> tuple[Float, Float, tuple[float, float]]:
    """Position, directions of columns and rows, and pixel spacing along these.

    Raises
    ------
    ValueError
        When they are not three, six and two finite numbers, or place no right-angled image.
    """
    position_mm = np.array(place, dtype=float).reshape(3)
    directions = np.array(axes, dtype=float).reshape(2, 3)
    along_row, along_column = (float(value) for value in np.array(spacing, float).reshape(2)[::-1])
    if not np.allclose(directions @ directions.T, np.eye(2), atol=5e-3):
        raise ValueError(f"ImageOrientationPatient {directions.ravel().tolist()}")
    if not (np.abs(position_mm).max() <= FARTHEST_MM and 0 < min(along_row, along_column) < np.inf):
        raise ValueError(f"position {position_mm.tolist()} and PixelSpacing {list(spacing)}")
    # Of directions written with few decimals, the nearest that are of length 1 and at right angles.
    left, _, right = np.linalg.svd(directions, full_matrices=False)
    return position_mm, left @ right, (along_row, along_column)


def _series_number(dataset: Any) -> int | None:
    """None where the file does not tell, or tells no number: it is a label, no more."""
    return whole_number(dataset.get("SeriesNumber"))


def _number(dataset: Any, group: Groups, place: int) -> int | None:
    """The image's number, of frames of one object their order in it or in time behind that."""
    number = whole_number(dataset.get("InstanceNumber"))
    if "PerFrameFunctionalGroupsSequence" not in dataset:
        return number
    in_time = whole_number(group("FrameContentSequence").get("TemporalPositionIndex"))
    return MOST_FRAMES * (number or 0) + (place if in_time is None else in_time)


def _acquisition(dataset: Any, group: Groups) -> int | None:
    own = group("FrameContentSequence").get("FrameAcquisitionNumber")
    return whole_number(dataset.get("AcquisitionNumber") if own is None else own)


def _series_name(dataset: Any) -> str:
    number, title = _series_number(dataset), dataset.get("SeriesDescription")
    name = "images of an unnumbered series" if number is None else f"series {number}"
    return f'{name} "{title}"' if title else name


def _born(dataset: Any) -> str:
    """The patient's date of birth as eight digits; empty where it is no date, as of a patient whom
    somebody made anonymous."""
    told = str(dataset.get("PatientBirthDate", "") or "").strip()
    # Of old, dates had dots.
    found = re.fullmatch(r"(\d{4})([.-]?)(\d\d)\2(\d\d)", told, re.ASCII)
    date = "".join(found.group(1, 3, 4)) if found else ""
    return date if date.strip("0") else ""


def _kind(dataset: Any, frame_type: Any) -> str:
    """``original`` magnitude images, or else what sort of image it is."""
    described = frame_type.get("FrameType") or dataset.get("ImageType") or []
    # A single value, of which there should be two or more, comes as text and not as a list.
    described = [described] if isinstance(described, str) else described
    values = [str(value).upper() for value in described]
    component = frame_type.get("ComplexImageComponent") or dataset.get("ComplexImageComponent")
    if component not in (None, "", "MAGNITUDE"):
        return str(component).lower()
    if part := _component_of_ge(dataset):
        return part
    for name, words in OTHER_COMPONENTS.items():
        if words & set(values[2:]):
            return name
    return DERIVED if values[:1] == ["DERIVED"] else ORIGINAL


def _component_of_ge(dataset: Any) -> str | None:
    """What GE's scanners tell of an image that is no magnitude, in an attribute of their own."""
    try:
        value = dataset.get_private_item(0x0043, 0x2F, "GEMS_PARM_01").value
    except KeyError:
        return None
    number = int.from_bytes(value[:2], "little") if isinstance(value, bytes) else value
    if not isinstance(number, int):
        return None
    return {1: "phase", 2: "real", 3: "imaginary"}.get(number)
