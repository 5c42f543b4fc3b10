"""Ways in which DICOM files store images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from cine_files import assert_is_the_stack, pixel_value, read_dicom_cine, write_dicom
from pydicom import dcmread, dcmwrite
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset, FileDataset
from pydicom.uid import ExplicitVRBigEndian

from pipeline.errors import InputError


@pytest.mark.parametrize("signed", [False, True])
def test_images_that_are_stored_white_for_black_are_turned(tmp_path: Path, signed: bool) -> None:
    def turned(data: FileDataset, number: int, phase: int) -> bool:
        data.PhotometricInterpretation = "MONOCHROME1"
        data.BitsStored, data.PixelRepresentation = 12, int(signed)
        # PS3.3 C.7.6.3.1.2: the least sample value is shown white.
        stored = (-1 if signed else 4095) - pixel_value(phase, number).astype(np.int16)
        data.PixelData = stored.tobytes()
        return True

    write_dicom(tmp_path, turned)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_lossless_jpeg_is_read_exactly_with_its_rescaling(tmp_path: Path) -> None:
    def packed(data: FileDataset, number: int, phase: int) -> bool:
        writer = sitk.ImageFileWriter()
        writer.SetImageIO("GDCMImageIO")
        writer.SetFileName(str(tmp_path / "packed.dcm"))
        writer.UseCompressionOn()
        writer.SetCompressor("JPEG")
        writer.Execute(sitk.GetImageFromArray(2 * data.pixel_array[None] + 6))
        other = dcmread(tmp_path / "packed.dcm")
        (tmp_path / "packed.dcm").unlink()
        data.file_meta.TransferSyntaxUID = other.file_meta.TransferSyntaxUID
        assert data.file_meta.TransferSyntaxUID == "1.2.840.10008.1.2.4.70"
        data["PixelData"] = other["PixelData"]
        for name in ("BitsStored", "HighBit", "BitsAllocated", "PixelRepresentation"):
            setattr(data, name, getattr(other, name))
        data.RescaleSlope, data.RescaleIntercept = "0.5", "-3"
        return True

    write_dicom(tmp_path / "cine", packed)
    assert_is_the_stack(read_dicom_cine(tmp_path / "cine"))
    path = next((tmp_path / "cine").glob("*.dcm"))
    data = dcmread(path)
    data.PixelData = data.PixelData[:30]
    data["PixelData"].is_undefined_length = True
    data.save_as(path)
    with pytest.raises(InputError, match=r"pixels cannot be read.*JPEG Lossless"):
        read_dicom_cine(tmp_path / "cine")
    # The library that unpacks it turns white for black, or does not: nothing is taken on trust.
    other = dcmread(next(one for one in (tmp_path / "cine").glob("*.dcm") if one != path))
    other.PhotometricInterpretation = "MONOCHROME1"
    other.save_as(path)
    with pytest.raises(InputError, match=r"pixels cannot be read.*JPEG Lossless"):
        read_dicom_cine(tmp_path / "cine")


def assert_padding_is_dark(folder: Path) -> None:
    """In the second and third pixel; the first is the darkest one."""
    expected = pixel_value(2, 1)
    expected[0, 1:3] = expected[0, 0]
    np.testing.assert_array_equal(read_dicom_cine(folder).cine.intensity[2, 1], expected)


@pytest.mark.parametrize("white_for_black", [False, True])
@pytest.mark.parametrize("limit", [None, -32760])
def test_padding_is_as_dark_as_the_darkest_place(
    tmp_path: Path, white_for_black: bool, limit: int | None
) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        stored = pixel_value(phase, number).astype(np.int16)
        if white_for_black:
            data.PhotometricInterpretation = "MONOCHROME1"
            stored = -1 - stored
        stored[0, 1:3] = -32768, -32768 if limit is None else limit
        data.PixelRepresentation, data.PixelPaddingValue = 1, -32768
        if limit is not None:
            data.PixelPaddingRangeLimit = limit
        data.PixelData = stored.tobytes()
        return True

    write_dicom(tmp_path, change)
    assert_padding_is_dark(tmp_path)


@pytest.mark.parametrize("implicit", [False, True])
def test_objects_without_preamble_and_meta_information_are_read(
    tmp_path: Path, implicit: bool
) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        dcmwrite(
            tmp_path / f"{number}_{phase}",
            Dataset({element.tag: element for element in data}),
            implicit_vr=implicit,
            little_endian=True,
            enforce_file_format=False,
        )
        return False

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_objects_that_lost_their_preamble_alone_are_read(tmp_path: Path) -> None:
    write_dicom(tmp_path)
    for path in tmp_path.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[132:])
    assert_is_the_stack(read_dicom_cine(tmp_path))


@pytest.mark.parametrize("value", [[4095, 4095], "none"])
def test_padding_that_is_no_single_number_is_no_padding(tmp_path: Path, value: Any) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        element = "IS" if value == "none" else "US"
        data.add(DataElement(0x00280120, element, None if value == "none" else value))
        return True

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_bright_places_within_an_image_are_no_padding(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        data.PixelPaddingValue = int(pixel_value(phase, number)[2, 3])
        return True

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path))


@pytest.mark.parametrize(
    ("signed", "bits", "value", "fits"),
    [
        (False, 12, 4096, False),
        (False, 12, 4095, True),
        (True, 12, 2048, True),
        (True, 12, -2049, False),
        (True, 12, -2048, True),
        (False, 14, 4096, True),
    ],
)
def test_values_beyond_the_bits_that_the_header_tells_are_refused(
    tmp_path: Path, signed: bool, bits: int, value: int, fits: bool
) -> None:
    """A value of 12 bits reads the same whatever its sign bits say; more would lose its top."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        stored = pixel_value(phase, number).astype(np.int16)
        stored[-1, -1] = value
        data.BitsStored, data.HighBit, data.PixelRepresentation = bits, bits - 1, int(signed)
        data.PixelData = stored.tobytes()
        return True

    write_dicom(tmp_path, change)
    if fits:
        read_dicom_cine(tmp_path)
    else:
        with pytest.raises(InputError, match=rf"values beyond its {bits} bits .*export it anew"):
            read_dicom_cine(tmp_path)


def test_padding_and_bytes_behind_the_image_may_have_any_bits(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        stored = pixel_value(phase, number)
        stored[0, 0] = 0x8000
        data.BitsStored, data.HighBit = 12, 11
        data.PixelPaddingValue = 0x8000
        data.PixelData = stored.tobytes() + b"\xff\xff"
        return True

    write_dicom(tmp_path, change)
    with pytest.warns(UserWarning, match="excess padding"):
        found = read_dicom_cine(tmp_path).cine.intensity[2, 1]
    assert found[0, 0] <= found[0, 1] == pixel_value(2, 1)[0, 1]


def test_overlays_in_the_upper_bits_are_no_values(tmp_path: Path) -> None:
    def change(data: FileDataset, number: int, phase: int) -> bool:
        stored = pixel_value(phase, number)
        stored[0, :3] |= 1 << 12
        data.BitsStored, data.HighBit = 12, 11
        data.PixelData = stored.tobytes()
        data.add_new((0x6000, 0x0102), "US", 12)
        return True

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path))


@pytest.mark.parametrize(("signed", "told"), [(True, 63536), (False, -2000)])
def test_padding_told_with_the_other_sign_is_padding(
    tmp_path: Path, signed: bool, told: int
) -> None:
    """-2000 and 63536 are one word of 16 bits, which programs write as either."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        stored = pixel_value(phase, number).astype(np.int16)
        stored[0, 1:3] = -2000
        data.PixelRepresentation = int(signed)
        data.add(DataElement(0x00280120, "US" if told > 0 else "SS", told))
        data.PixelData = stored.tobytes()
        return True

    write_dicom(tmp_path, change)
    assert_padding_is_dark(tmp_path)


def test_values_of_twelve_bits_may_be_stored_big_end_first(tmp_path: Path) -> None:
    """Read in the other order, nearly all of them would lie beyond their bits."""

    def change(data: FileDataset, number: int, phase: int) -> bool:
        turned = Dataset({element.tag: element for element in data})
        turned.file_meta = data.file_meta
        turned.file_meta.TransferSyntaxUID = ExplicitVRBigEndian
        turned.BitsStored, turned.HighBit = 12, 11
        turned.PixelData = pixel_value(phase, number).astype(">u2").tobytes()
        turned.save_as(tmp_path / f"{number}_{phase}.dcm", enforce_file_format=True)
        return False

    write_dicom(tmp_path, change)
    assert_is_the_stack(read_dicom_cine(tmp_path))
