"""Classic MR Image Storage: one file a frame (PS3.3, A.4)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from data_synth.dicom_header import (
    ImageSeries,
    date,
    decimal,
    echo_time_ms,
    filled,
    identifiers,
    image_pixels,
    patient_and_study,
    place,
    save,
    series_and_equipment,
    time,
    window,
)
from data_synth.protocol import MrSettings

MR_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.4"


def write_classic(
    folder: Path, patient_id: str, key: str, series: ImageSeries, settings: MrSettings
) -> None:
    """Write every frame of a series as ``folder/IM_<instance>.dcm``, slice by slice."""
    instance = 0
    for z in series.slices:
        for k in range(len(series.cine.intensity)):
            instance += 1
            fields = identifiers(key, MR_IMAGE_STORAGE, series, instance)
            fields |= patient_and_study(patient_id) | series_and_equipment(series)
            fields |= _image(series, z, k) | _sequence(series, settings) | _gating(series, z, k)
            save(filled(fields), folder / f"IM_{instance:04d}.dcm")


def _image(series: ImageSeries, z: int, k: int) -> dict[str, Any]:
    """General Image, Image Plane and Image Pixel modules."""
    moment, image = series.moment(z), series.cine.intensity[k, z]
    where = place(series, z)
    normal = np.cross(series.axes[:, 0], series.axes[:, 1])
    return {
        "ImageType": ["ORIGINAL", "PRIMARY", "OTHER"],
        "AcquisitionNumber": 1,
        "AcquisitionDate": date(moment),
        "AcquisitionTime": time(moment),
        "ContentDate": date(moment),
        "ContentTime": time(moment),
        **where["position"],
        **where["orientation"],
        **where["measures"],
        "SliceLocation": decimal(float(series.corner_mm(z) @ normal)),
        "SmallestImagePixelValue": int(image.min()),
        "LargestImagePixelValue": int(image.max()),
        **window(image),
        **image_pixels(image),
    }


def _sequence(series: ImageSeries, settings: MrSettings) -> dict[str, Any]:
    """MR Image module (PS3.3, C.8.3.1) but for the gating."""
    return {
        "ScanningSequence": "GR",
        "SequenceVariant": "SS",
        "ScanOptions": ["RG", "CG"] if series.volume else "CG",
        "MRAcquisitionType": "3D" if series.volume else "2D",
        "SequenceName": "bssfp3d" if series.volume else "bssfp2d",
        "MagneticFieldStrength": decimal(series.cine.field_strength_t),
        "ImagedNucleus": "1H",
        "RepetitionTime": decimal(settings.repetition_ms),
        "EchoTime": decimal(echo_time_ms(settings)),
        "EchoTrainLength": 1,
        "NumberOfAverages": 1,
        "FlipAngle": decimal(settings.flip_angle_deg),
    }


def _gating(series: ImageSeries, z: int, k: int) -> dict[str, Any]:
    """The frame's moment in the heartbeat of its own slice."""
    phases, rr_ms = len(series.cine.intensity), float(series.cine.rr_ms[z])
    return {
        "TemporalPositionIdentifier": k + 1,
        "NumberOfTemporalPositions": phases,
        "CardiacNumberOfImages": phases,
        "TriggerTime": decimal(series.cine.trigger_times_ms[z, k]),
        # Value representation IS: whole milliseconds are all the standard has room for.
        "NominalInterval": round(rr_ms),
        "HeartRate": round(60000 / rr_ms),
    }
