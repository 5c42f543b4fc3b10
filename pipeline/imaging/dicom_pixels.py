"""Pixels of a DICOM object, in whatever way they are stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from scipy.ndimage import label

from pipeline.errors import InputError
from pipeline.imaging.limits import MOST_PIXELS, require_bounded


def stored_pixels(dataset: Any, path: Path) -> Any:
    """Stored values, ``(frame, row, column)``."""
    frames = max(int(dataset.get("NumberOfFrames", 1) or 1), 1)
    pixels = int(dataset.Rows or 0) * int(dataset.get("Columns") or 0)
    require_bounded(pixels, f"{path}: one image", MOST_PIXELS)
    require_bounded(frames * pixels, str(path))
    try:
        stored = dataset.pixel_array
    except Exception as error:  # pydicom's decoders raise many kinds for damaged pixel data
        stored = _read_by_gdcm(dataset, path)
        if stored is None:
            raise InputError(
                f"{path}: its pixels cannot be read, the file is truncated, damaged or compressed "
                f"in a way not known here ({_syntax(dataset).name}; {error}); copy it again from "
                "the scanner, uncompressed"
            ) from error
    if stored.size != frames * dataset.Rows * dataset.Columns:
        raise InputError(f"{path}: is in colour; the cine needs grey images")
    _require_bits_as_told(dataset, path, stored.size)
    return stored.reshape(-1, int(dataset.Rows), int(dataset.Columns))


def _require_bits_as_told(dataset: Any, path: Path, count: int) -> None:
    """Refuse values larger than the header says, whose uppermost bits readers cut off.

    What was very bright would be dark. Before overlays had an attribute of their own they were kept
    in these bits (DICOM PS3.5, 8.1.1), which the header then tells.
    """
    bits = int(dataset.BitsStored)
    overlays = any(
        dataset.get((group, 0x0102)) and (group, 0x3000) not in dataset
        for group in range(0x6000, 0x6020, 2)
    )
    if int(dataset.BitsAllocated) != 16 or bits >= 16 or overlays or _syntax(dataset).is_compressed:
        return
    order = ">" if _syntax(dataset) == pydicom.uid.ExplicitVRBigEndian else "<"
    words = np.frombuffer(dataset.PixelData, f"{order}u2")[:count]
    beyond = words >> bits
    padding = whole_number(dataset.get("PixelPaddingValue"))
    if padding is not None:
        # It need not fit: no value is measured there.
        beyond = np.where(words == padding % 2**16, 0, beyond)
    if int(dataset.get("PixelRepresentation", 0)):
        negative = (words >> (bits - 1)) & 1
        beyond = np.where(negative & (beyond == (1 << (16 - bits)) - 1), 0, beyond)
    if beyond.any():
        raise InputError(
            f"{path}: has values beyond its {bits} bits (BitsStored (0028,0101)), such as "
            f"{words[beyond > 0][0]}; export it anew, with as many bits as its values have"
        )


def _syntax(dataset: Any) -> Any:
    return dataset.file_meta.get("TransferSyntaxUID", pydicom.uid.ImplicitVRLittleEndian)


def _read_by_gdcm(dataset: Any, path: Path) -> Any:
    """Stored values of one compressed classic image, by a library that knows more ways, or None.

    That library gives rescaled values: the stored ones are found again from them. What it makes
    of white for black differs with the encoding, so that is not asked of it.
    """
    plain = dataset.get("PhotometricInterpretation") == "MONOCHROME2"
    enhanced = "PerFrameFunctionalGroupsSequence" in dataset
    syntax = _syntax(dataset)
    if enhanced or not plain or not syntax.is_transfer_syntax or not syntax.is_compressed:
        return None
    if syntax == pydicom.uid.RLELossless:
        # Of damaged ones it makes black images, and says nothing; others are read without it.
        return None
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    try:
        values = sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError:
        return None
    slope, intercept = _rescaling(dataset)
    return np.rint((values - intercept) / slope) if (slope, intercept) != (1, 0) else values


def without_padding(stored: Any, dataset: Any) -> Any:
    """Stored values ``(frame, row, column)``; those that pad images are as dark as the darkest.

    DICOM PS3.3 C.7.5.1.1.2: a PixelPaddingValue, or the range from it to PixelPaddingRangeLimit,
    is no measurement. It pads what lies outside: saturated blood may have the same value.
    """
    first, limit = (
        whole_number(dataset.get(name)) for name in ("PixelPaddingValue", "PixelPaddingRangeLimit")
    )
    if first is None:
        return stored
    low, high = sorted((first, first if limit is None else limit))
    # A header may give the unsigned number of a value that is signed, or the other way round.
    bits = 2 ** int(dataset.BitsAllocated)
    padding = np.zeros(stored.shape, bool)
    for turn in (-bits, 0, bits):
        padding |= (stored >= low + turn) & (stored <= high + turn)
    if padding.any():
        padding = np.stack([at_the_edge(one) for one in padding])
    if not padding.any() or padding.all():
        return stored
    dark = stored[~padding].max() if _is_white_for_black(dataset) else stored[~padding].min()
    return np.where(padding, dark, stored)


def whole_number(value: Any) -> int | None:
    """None where a header does not tell it, or does not tell one whole number."""
    try:
        return None if value in (None, "") else int(value)
    except (ValueError, TypeError):
        return None


def at_the_edge(mask: Any) -> Any:
    """The parts of a mask ``(row, column)`` that touch the edge of the image."""
    parts, _ = label(mask)
    edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    return np.isin(parts, edge[edge > 0])


def _is_white_for_black(dataset: Any) -> bool:
    return bool(dataset.get("PhotometricInterpretation") == "MONOCHROME1")


def upright(stored: Any, dataset: Any) -> Any:
    """Stored values as they grow with brightness."""
    if not _is_white_for_black(dataset):
        return stored
    most = 2 ** int(dataset.BitsStored) - 1
    # Complement of two: the largest is one less than the smallest's magnitude.
    return (-1 if int(dataset.get("PixelRepresentation", 0)) else most) - stored.astype(np.int32)


def rescaled(pixels: Any, transformation: Any) -> Any:
    """Stored values times slope plus intercept."""
    slope, intercept = _rescaling(transformation)
    if (slope, intercept) == (1, 0):
        return pixels
    return pixels.astype(np.float32) * np.float32(slope) + np.float32(intercept)


def _rescaling(transformation: Any) -> tuple[float, float]:
    """Slope, 1 where none or 0 is told, and intercept."""
    slope = float(transformation.get("RescaleSlope", 1) or 1)
    return slope, float(transformation.get("RescaleIntercept", 0) or 0)
