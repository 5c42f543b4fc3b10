"""What all DICOM objects of the phantom share: identifiers, patient, study, equipment, times."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.mr import Int16, SyntheticCine
from data_synth.protocol import BREATH_HOLD_S, VOLUME_S, MrSettings

START = datetime(2020, 1, 1, 12)
"""Every study begins at this moment: the same seed must give the same bytes."""
EXPLICIT_LITTLE_ENDIAN = "1.2.840.10008.1.2.1"
MANUFACTURER = "beatfield phantom"


@dataclass(frozen=True, slots=True)
class ImageSeries:
    """One series: some slices of a cine, acquired in one go or one breath-hold a slice."""

    number: int
    description: str
    cine: SyntheticCine
    slices: tuple[int, ...]
    """Which slices of ``cine`` belong to the series."""
    start_s: float
    """When it begins, after the start of the examination."""
    volume: bool = False
    """Acquired as one slab with three-dimensional encoding."""

    @property
    def axes(self) -> Any:
        """``(3, 2)`` unit vectors along which columns and rows count up."""
        return self.cine.mr_from_index[:3, :2] / self.cine.pixel_mm

    def corner_mm(self, z: int) -> Any:
        """LPS position of the first pixel's centre of slice ``z``."""
        return self.cine.mr_from_index[:3, 3] + z * self.cine.mr_from_index[:3, 2]

    def moment(self, z: int) -> datetime:
        """When the acquisition of slice ``z`` begins; a slab is acquired as one."""
        holds = 0 if self.volume else self.slices.index(z)
        return START + timedelta(seconds=self.start_s + BREATH_HOLD_S * holds)

    @property
    def duration_s(self) -> float:
        """How long the acquisition lasts."""
        return VOLUME_S if self.volume else BREATH_HOLD_S * len(self.slices)


def unique_identifier(*parts: object) -> str:
    """A UID that these parts determine, under the root for UUID-derived UIDs (PS3.5, B.2)."""
    digest = hashlib.sha256("/".join(str(part) for part in parts).encode()).digest()[:16]
    # Version and variant bits of a name-based UUID (RFC 4122, version 5 layout).
    digest = digest[:6] + bytes([digest[6] & 0x0F | 0x50]) + digest[7:]
    digest = digest[:8] + bytes([digest[8] & 0x3F | 0x80]) + digest[9:]
    return f"2.25.{int.from_bytes(digest, 'big')}"


def identifiers(key: str, sop_class: str, series: ImageSeries, instance: int) -> dict[str, Any]:
    """Who the object is: its class, and the UIDs that ``key`` and the numbers determine."""
    return {
        "SOPClassUID": sop_class,
        "SOPInstanceUID": unique_identifier(key, "image", series.number, instance),
        "StudyInstanceUID": unique_identifier(key, "study"),
        "SeriesInstanceUID": unique_identifier(key, "series", series.number),
        "FrameOfReferenceUID": unique_identifier(key, "frame of reference"),
        "InstanceNumber": instance,
    }


def patient_and_study(patient_id: str) -> dict[str, Any]:
    """Patient and General Study modules (PS3.3, C.7.1.1 and C.7.2.1)."""
    return {
        "SpecificCharacterSet": "ISO_IR 192",
        "PatientName": f"Phantom^{patient_id}",
        "PatientID": patient_id,
        "PatientBirthDate": "",
        "PatientSex": "O",
        "StudyDate": date(START),
        "StudyTime": time(START),
        "ReferringPhysicianName": "",
        "AccessionNumber": "",
        "StudyID": "1",
        "StudyDescription": "Synthetic cardiac cine",
    }


def series_and_equipment(series: ImageSeries) -> dict[str, Any]:
    """General Series, Frame of Reference and General Equipment (PS3.3, C.7.3.1, C.7.4, C.7.5)."""
    moment = series.moment(series.slices[0])
    return {
        "Modality": "MR",
        "SeriesNumber": series.number,
        "SeriesDescription": series.description,
        "SeriesDate": date(moment),
        "SeriesTime": time(moment),
        "ProtocolName": series.description.split(",")[0],
        "BodyPartExamined": "HEART",
        "PatientPosition": "HFS",
        "PositionReferenceIndicator": "",
        "Manufacturer": MANUFACTURER,
        "ManufacturerModelName": "data_synth",
        "DeviceSerialNumber": "1",
        "SoftwareVersions": "1",
    }


def image_pixels(image: Int16) -> dict[str, Any]:
    """Image Pixel module (PS3.3, C.7.6.3) of ``(y, x)`` or ``(frame, y, x)`` stored values."""
    return {
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "Rows": image.shape[-2],
        "Columns": image.shape[-1],
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 0,
        "PixelData": image.astype("<u2").tobytes(),
    }


def window(image: Int16) -> dict[str, Any]:
    """Grey values to show: from nothing to a little under the brightest fat."""
    top = max(float(np.percentile(image, 99.5)), 2.0)
    return {"WindowCenter": decimal(top / 2), "WindowWidth": decimal(top)}


def filled(fields: Mapping[str, Any]) -> Any:
    """A DICOM dataset of these fields; a mapping stands for a sequence of that one item."""
    from pydicom.dataset import Dataset

    data = Dataset()
    for name, value in fields.items():
        setattr(data, name, [filled(value)] if isinstance(value, Mapping) else value)
    return data


def save(data: Any, path: Path) -> None:
    """Write ``data`` as a DICOM file, explicit little endian."""
    from pydicom.dataset import FileMetaDataset

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = data.SOPClassUID
    meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID
    meta.TransferSyntaxUID = EXPLICIT_LITTLE_ENDIAN
    meta.ImplementationClassUID = unique_identifier("beatfield", "data_synth")
    meta.ImplementationVersionName = "BEATFIELD"
    data.file_meta = meta
    path.parent.mkdir(parents=True, exist_ok=True)
    data.save_as(path, enforce_file_format=True)


def place(series: ImageSeries, z: int) -> dict[str, dict[str, Any]]:
    """Where slice ``z`` lies: the fields of position, orientation and measures."""
    measures = {
        "PixelSpacing": [decimal(series.cine.pixel_mm)] * 2,
        "SliceThickness": decimal(series.cine.slice_thickness_mm),
    }
    if len(series.cine.intensity[0]) > 1:
        measures["SpacingBetweenSlices"] = decimal(series.cine.slice_step_mm)
    return {
        "position": {"ImagePositionPatient": [decimal(v) for v in series.corner_mm(z)]},
        "orientation": {"ImageOrientationPatient": [decimal(v) for v in series.axes.T.ravel()]},
        "measures": measures,
    }


def echo_time_ms(settings: MrSettings) -> float:
    """A balanced sequence samples its echo halfway between two pulses."""
    return settings.repetition_ms / 2


def decimal(value: float) -> str:
    """A decimal string within the 16 characters that the standard allows."""
    for digits in range(12, 3, -1):
        text = f"{float(value):.{digits}g}"
        if len(text) <= 16:
            break
    return text


def date(moment: datetime) -> str:
    """Value representation DA."""
    return f"{moment:%Y%m%d}"


def time(moment: datetime) -> str:
    """Value representation TM."""
    return f"{moment:%H%M%S.%f}"
