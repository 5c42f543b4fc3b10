"""Write a cine as classic single-frame MR images, one series a slice, as scanners do."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from data_synth.mr import Int16, MrSettings, SyntheticCine

DATE, TIME = "20200101", "120000"
"""Every file bears this moment: the same seed must give the same bytes."""
MR_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.4"
EXPLICIT_LITTLE_ENDIAN = "1.2.840.10008.1.2.1"


def unique_identifier(*parts: object) -> str:
    """A UID that these parts determine, under the root for UUID-derived UIDs (PS3.5, B.2)."""
    digest = hashlib.sha256("/".join(str(part) for part in parts).encode()).digest()[:16]
    # Version and variant bits of a name-based UUID (RFC 4122, version 5 layout).
    digest = digest[:6] + bytes([digest[6] & 0x0F | 0x50]) + digest[7:]
    digest = digest[:8] + bytes([digest[8] & 0x3F | 0x80]) + digest[9:]
    return f"2.25.{int.from_bytes(digest, 'big')}"


def write_dicom(
    folder: Path, patient_id: str, key: str, cine: SyntheticCine, settings: MrSettings
) -> None:
    """Write every frame as ``folder/<series number>/IM_<instance>.dcm``.

    Parameters
    ----------
    folder
        Made if missing.
    patient_id
        Goes into PatientID and PatientName.
    key
        Text from which all UIDs are derived.
    cine
        Images, geometry and times.
    settings
        Protocol values that the headers repeat.
    """
    phases, slices = cine.intensity.shape[:2]
    for z in range(slices):
        series = folder / f"{z + 1:03d}"
        series.mkdir(parents=True, exist_ok=True)
        for k in range(phases):
            data = _dataset(patient_id, key, cine, settings, z, k)
            data.save_as(series / f"IM_{k + 1:04d}.dcm", enforce_file_format=True)


def _dataset(  # type: ignore[no-untyped-def]  # pydicom is imported without types
    patient_id: str, key: str, cine: SyntheticCine, settings: MrSettings, z: int, k: int
):
    from pydicom.dataset import Dataset, FileMetaDataset

    data = Dataset()
    identifiers = {
        "SOPClassUID": MR_IMAGE_STORAGE,
        "SOPInstanceUID": unique_identifier(key, "image", z, k),
        "StudyInstanceUID": unique_identifier(key, "study"),
        "SeriesInstanceUID": unique_identifier(key, "series", z),
        "FrameOfReferenceUID": unique_identifier(key, "frame of reference"),
    }
    fields = identifiers | _patient(patient_id) | _protocol(settings)
    fields |= _timing(cine, z, k) | _place(cine, settings, z) | _pixels(cine.intensity[k, z])
    for name, value in fields.items():
        setattr(data, name, value)
    data.file_meta = FileMetaDataset()
    data.file_meta.MediaStorageSOPClassUID = MR_IMAGE_STORAGE
    data.file_meta.MediaStorageSOPInstanceUID = identifiers["SOPInstanceUID"]
    data.file_meta.TransferSyntaxUID = EXPLICIT_LITTLE_ENDIAN
    data.file_meta.ImplementationClassUID = unique_identifier("beatfield", "data_synth")
    data.file_meta.ImplementationVersionName = "BEATFIELD"
    return data


def _patient(patient_id: str) -> dict[str, object]:
    return {
        "SpecificCharacterSet": "ISO_IR 192",
        "PatientName": f"Phantom^{patient_id}",
        "PatientID": patient_id,
        "PatientBirthDate": "",
        "PatientSex": "O",
        "StudyDate": DATE,
        "StudyTime": TIME,
        "SeriesDate": DATE,
        "SeriesTime": TIME,
        "AcquisitionDate": DATE,
        "AcquisitionTime": TIME,
        "ContentDate": DATE,
        "ContentTime": TIME,
        "ReferringPhysicianName": "",
        "AccessionNumber": "",
        "StudyID": "1",
        "StudyDescription": "Synthetic cardiac cine",
        "Manufacturer": "beatfield phantom",
    }


def _protocol(settings: MrSettings) -> dict[str, object]:
    return {
        "Modality": "MR",
        "BodyPartExamined": "HEART",
        "PatientPosition": "HFS",
        "PositionReferenceIndicator": "",
        "ProtocolName": "cine short axis",
        "ScanningSequence": "GR",
        "SequenceVariant": "SS",
        "ScanOptions": "CG",
        "MRAcquisitionType": "2D",
        "SequenceName": "bssfp2d",
        "MagneticFieldStrength": _number(1.5),
        "RepetitionTime": _number(settings.repetition_ms),
        "EchoTime": _number(settings.repetition_ms / 2),
        "EchoTrainLength": 1,
        "FlipAngle": _number(settings.flip_angle_deg),
    }


def _timing(cine: SyntheticCine, z: int, k: int) -> dict[str, object]:
    phases = len(cine.intensity)
    return {
        "SeriesNumber": z + 1,
        "SeriesDescription": f"cine short axis, slice {z + 1}",
        "AcquisitionNumber": 1,
        "InstanceNumber": k + 1,
        "TemporalPositionIdentifier": k + 1,
        "NumberOfTemporalPositions": phases,
        "CardiacNumberOfImages": phases,
        "TriggerTime": _number(cine.trigger_times_ms[z, k]),
        # Value representation IS: whole milliseconds are all the standard has room for.
        "NominalInterval": round(float(cine.rr_ms[z])),
        "HeartRate": round(60000 / float(cine.rr_ms[z])),
    }


def _place(cine: SyntheticCine, settings: MrSettings, z: int) -> dict[str, object]:
    axes = cine.mr_from_index[:3, :2] / settings.pixel_mm
    corner = cine.mr_from_index[:3, 3] + z * cine.mr_from_index[:3, 2]
    step = settings.slice_thickness_mm + settings.slice_gap_mm
    return {
        "ImageType": ["ORIGINAL", "PRIMARY", "OTHER"],
        "ImagePositionPatient": [_number(v) for v in corner],
        "ImageOrientationPatient": [_number(v) for v in axes.T.ravel()],
        "PixelSpacing": [_number(settings.pixel_mm)] * 2,
        "SliceThickness": _number(settings.slice_thickness_mm),
        "SpacingBetweenSlices": _number(step),
        "SliceLocation": _number(float(corner @ np.cross(axes[:, 0], axes[:, 1]))),
    }


def _pixels(image: Int16) -> dict[str, object]:
    return {
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "Rows": image.shape[0],
        "Columns": image.shape[1],
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 1,
        "SmallestImagePixelValue": int(image.min()),
        "LargestImagePixelValue": int(image.max()),
        "WindowCenter": _number(400),
        "WindowWidth": _number(800),
        "PixelData": image.astype("<i2").tobytes(),
    }


def _number(value: float) -> str:
    """A decimal string within the 16 characters that the standard allows."""
    for digits in range(12, 3, -1):
        text = f"{float(value):.{digits}g}"
        if len(text) <= 16:
            break
    return text
