"""Enhanced MR Image Storage: one multi-frame object a series (PS3.3, A.36.2).

All slices and phases of a series make up one object, slice by slice, as Philips scanners write
it; other makers write an object a slice or a volume. A frame's place among the slices and in the
cycle is told by the dimensions InStackPositionNumber and TemporalPositionIndex.
"""

from __future__ import annotations

import math
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.breathing import Breathing
from data_synth.bssfp import PROTON_MHZ_PER_T
from data_synth.dicom_header import (
    MANUFACTURER,
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
    unique_identifier,
    window,
)
from data_synth.protocol import MrSettings
from data_synth.sampling import acquisition_window

ENHANCED_MR_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.4.1"
PIXEL_BANDWIDTH_HZ = 930.0
"""The standard asks for values that the phantom has no use for: bandwidth, absorption rate and
gradient output are those of an ordinary cine, and change nothing in the images."""
ABSORPTION_RATE_W_KG, GRADIENT_OUTPUT_PERCENT = 1.5, 50.0
IMAGE_TYPE = ["ORIGINAL", "PRIMARY", "CARDIAC_GATED", "NONE"]
DIMENSIONS = (
    ("Stack", 0x00209056),
    ("Slice", 0x00209057),
    ("Phase", 0x00209128),
)
"""What tells frames apart: StackID, InStackPositionNumber and TemporalPositionIndex."""
FRAME_CONTENT_SEQUENCE = 0x00209111
BREATH_HOLD = {
    "RespiratoryMotionCompensationTechnique": "BREATH_HOLD",
    "RespiratorySignalSource": "NONE",
}
FREE_BREATHING = {
    "RespiratoryMotionCompensationTechnique": "GATING",
    "RespiratorySignalSource": "NAVIGATOR",
    "RespiratoryTriggerType": "AMPLITUDE",
    "RespiratoryTriggerDelayThreshold": 0.0,
}
"""The navigator accepts positions near the end of breathing out, where a breath begins."""


def write_enhanced(
    folder: Path, patient_id: str, key: str, series: ImageSeries, settings: MrSettings
) -> None:
    """Write a series as the single object ``folder/IM_0001.dcm``."""
    fields = identifiers(key, ENHANCED_MR_IMAGE_STORAGE, series, 1)
    fields |= patient_and_study(patient_id) | series_and_equipment(series)
    fields |= _multi_frame(key, series, settings) | _image(series)
    fields |= _gating(series) | _pulse_sequence(series)
    frames = series.cine.intensity[:, list(series.slices)].swapaxes(0, 1)
    fields |= image_pixels(frames.reshape(-1, *frames.shape[2:]))
    save(filled(fields), folder / "IM_0001.dcm")


def _multi_frame(key: str, series: ImageSeries, settings: MrSettings) -> dict[str, Any]:
    """Multi-frame Functional Groups and Multi-frame Dimension modules (C.7.6.16, C.7.6.17)."""
    organization = unique_identifier(key, "dimensions", series.number)
    phases = len(series.cine.intensity)
    dimensions = [
        filled(
            {
                "DimensionOrganizationUID": organization,
                "DimensionIndexPointer": pointer,
                "FunctionalGroupPointer": FRAME_CONTENT_SEQUENCE,
                "DimensionDescriptionLabel": label,
            }
        )
        for label, pointer in DIMENSIONS
    ]
    return {
        "NumberOfFrames": len(series.slices) * phases,
        "DimensionOrganizationSequence": {"DimensionOrganizationUID": organization},
        "DimensionIndexSequence": dimensions,
        "SharedFunctionalGroupsSequence": _shared(series, settings),
        "PerFrameFunctionalGroupsSequence": [
            filled(_own(series, z, k)) for z in series.slices for k in range(phases)
        ],
    }


def _image(series: ImageSeries) -> dict[str, Any]:
    """Enhanced MR Image and Acquisition Context modules (C.8.13.1, C.7.6.14)."""
    moment = series.moment(series.slices[0])
    return {
        "ImageType": IMAGE_TYPE,
        **_description(series),
        "AcquisitionNumber": 1,
        "ContentDate": date(moment),
        "ContentTime": time(moment),
        "AcquisitionDateTime": date(moment) + time(moment),
        "AcquisitionDuration": series.duration_s,
        "AcquisitionContextSequence": [],
        "ContentQualification": "RESEARCH",
        "ResonantNucleus": "1H",
        "KSpaceFiltering": "NONE",
        "MagneticFieldStrength": decimal(series.cine.field_strength_t),
        "ApplicableSafetyStandardAgency": "IEC",
        "BurnedInAnnotation": "NO",
        "LossyImageCompression": "00",
        "PresentationLUTShape": "IDENTITY",
    }


def _description(series: ImageSeries) -> dict[str, Any]:
    """Common and MR image description macros (C.8.16.2, C.8.13.3), for object and frames alike."""
    return {
        "PixelPresentation": "MONOCHROME",
        "VolumetricProperties": "VOLUME" if len(series.slices) > 1 else "SAMPLED",
        "VolumeBasedCalculationTechnique": "NONE",
        "ComplexImageComponent": "MAGNITUDE",
        "AcquisitionContrast": "UNKNOWN",
    }


def _gating(series: ImageSeries) -> dict[str, Any]:
    """Cardiac and Respiratory Synchronization modules (C.7.6.18)."""
    rr_ms = series.cine.rr_ms[list(series.slices)]
    return {
        "CardiacSynchronizationTechnique": "RETROSPECTIVE",
        "CardiacSignalSource": "ECG",
        "CardiacRRIntervalSpecified": float(rr_ms.mean()),
        "CardiacBeatRejectionTechnique": "NONE",
        "LowRRValue": math.floor(rr_ms.min()),
        "HighRRValue": math.ceil(rr_ms.max()),
        # Beats are not counted; the standard lets these be empty.
        "IntervalsAcquired": "",
        "IntervalsRejected": "",
        **(FREE_BREATHING if series.volume else BREATH_HOLD),
    }


def _pulse_sequence(series: ImageSeries) -> dict[str, Any]:
    """MR Pulse Sequence module (C.8.13.4): a balanced gradient echo."""
    rows = series.cine.intensity.shape[2]
    fields = {
        "PulseSequenceName": "bssfp3d" if series.volume else "bssfp2d",
        "MRAcquisitionType": "3D" if series.volume else "2D",
        "EchoPulseSequence": "GRADIENT",
        "MultiPlanarExcitation": "NO",
        "PhaseContrast": "NO",
        "TimeOfFlightContrast": "NO",
        "SteadyStatePulseSequence": "FREE_PRECESSION",
        "EchoPlanarPulseSequence": "NO",
        "SaturationRecovery": "NO",
        "SpectrallySelectedSuppression": "NONE",
        "OversamplingPhase": "NONE",
        "GeometryOfKSpaceTraversal": "RECTILINEAR",
        "RectilinearPhaseEncodeReordering": "LINEAR",
        "SegmentedKSpaceTraversal": "PARTIAL",
        "NumberOfKSpaceTrajectories": rows,
    }
    return fields | ({"CoverageOfKSpace": "FULL"} if series.volume else {})


def _shared(series: ImageSeries, settings: MrSettings) -> dict[str, Any]:
    """Functional groups that all frames have in common."""
    where = place(series, series.slices[0])
    return _breathing(series, settings) | {
        "PixelMeasuresSequence": where["measures"],
        "PlaneOrientationSequence": where["orientation"],
        "FrameAnatomySequence": {
            "FrameLaterality": "U",
            "AnatomicRegionSequence": {
                "CodeValue": "80891009",
                "CodingSchemeDesignator": "SCT",
                "CodeMeaning": "Heart",
            },
        },
        "PixelValueTransformationSequence": {
            "RescaleIntercept": "0",
            "RescaleSlope": "1",
            "RescaleType": "US",
        },
        "FrameVOILUTSequence": window(series.cine.intensity),
        "MRImageFrameTypeSequence": {"FrameType": IMAGE_TYPE, **_description(series)},
        "MRAveragesSequence": {"NumberOfAverages": 1.0},
        **_timing_and_geometry(series, settings),
        **_modifiers(series),
        **_coils(),
    }


def _breathing(series: ImageSeries, settings: MrSettings) -> dict[str, Any]:
    """Respiratory Synchronization macro (C.7.6.16.2.17), for free breathing alone."""
    if not series.volume:
        return {}
    accepted = settings.volume_gating_mm / Breathing().amplitude_mm
    group = {
        "NominalPercentageOfRespiratoryPhase": 0.0,
        "NominalRespiratoryTriggerDelayTime": 0.0,
        "StartingRespiratoryAmplitude": 0.0,
        "StartingRespiratoryPhase": "EXPIRATION",
        "EndingRespiratoryAmplitude": min(100 * accepted, 100.0),
        "EndingRespiratoryPhase": "INSPIRATION",
    }
    return {"RespiratorySynchronizationSequence": group}


def _timing_and_geometry(series: ImageSeries, settings: MrSettings) -> dict[str, Any]:
    """MR Timing, MR Echo and MR FOV/Geometry macros (C.8.13.5)."""
    rows, columns = series.cine.intensity.shape[2:]
    geometry = {
        "InPlanePhaseEncodingDirection": "ROW",
        "MRAcquisitionFrequencyEncodingSteps": columns,
        "MRAcquisitionPhaseEncodingStepsInPlane": rows,
        "PercentSampling": 100.0,
        "PercentPhaseFieldOfView": 100.0,
    }
    if series.volume:
        geometry["MRAcquisitionPhaseEncodingStepsOutOfPlane"] = len(series.slices)
    return {
        "MRTimingAndRelatedParametersSequence": {
            "RepetitionTime": decimal(settings.repetition_ms),
            "FlipAngle": decimal(settings.flip_angle_deg),
            "EchoTrainLength": 1,
            "RFEchoTrainLength": 0,
            "GradientEchoTrainLength": 1,
            "SpecificAbsorptionRateSequence": {
                "SpecificAbsorptionRateDefinition": "IEC_WHOLE_BODY",
                "SpecificAbsorptionRateValue": ABSORPTION_RATE_W_KG,
            },
            "GradientOutputType": "PER_NERVE_STIM",
            "GradientOutput": GRADIENT_OUTPUT_PERCENT,
            "OperatingModeSequence": {
                "OperatingModeType": "STATIC FIELD",
                "OperatingMode": "IEC_NORMAL",
            },
        },
        "MREchoSequence": {"EffectiveEchoTime": echo_time_ms(settings)},
        "MRFOVGeometrySequence": geometry,
    }


def _modifiers(series: ImageSeries) -> dict[str, Any]:
    """MR Modifier and MR Imaging Modifier macros: nothing is prepared, nothing skipped."""
    return {
        "MRModifierSequence": {
            "InversionRecovery": "NO",
            "FlowCompensation": "NONE",
            "Spoiling": "NONE",
            "T2Preparation": "NO",
            "SpectrallySelectedExcitation": "NONE",
            "SpatialPresaturation": "NONE",
            "PartialFourier": "NO",
            "ParallelAcquisition": "NO",
        },
        "MRImagingModifierSequence": {
            "MagnetizationTransfer": "NONE",
            "BloodSignalNulling": "NO",
            "Tagging": "NONE",
            "TransmitterFrequency": PROTON_MHZ_PER_T * series.cine.field_strength_t,
            "PixelBandwidth": decimal(PIXEL_BANDWIDTH_HZ),
        },
    }


def _coils() -> dict[str, Any]:
    return {
        "MRReceiveCoilSequence": {
            "ReceiveCoilName": "CARDIAC",
            "ReceiveCoilManufacturerName": MANUFACTURER,
            "ReceiveCoilType": "SURFACE",
            "QuadratureReceiveCoil": "NO",
        },
        "MRTransmitCoilSequence": {
            "TransmitCoilName": "BODY",
            "TransmitCoilManufacturerName": MANUFACTURER,
            "TransmitCoilType": "BODY",
        },
    }


def _own(series: ImageSeries, z: int, k: int) -> dict[str, Any]:
    """Functional groups of one frame: what it is, where it lies, when it was."""
    cine, position = series.cine, series.slices.index(z) + 1
    trigger_ms, rr_ms = float(cine.trigger_times_ms[z, k]), float(cine.rr_ms[z])
    window_ms = rr_ms * acquisition_window(len(cine.intensity))
    middle = series.moment(z) + timedelta(milliseconds=trigger_ms)
    start = middle - timedelta(milliseconds=window_ms / 2)
    return {
        "FrameContentSequence": {
            "FrameAcquisitionNumber": 1 if series.volume else position,
            "FrameReferenceDateTime": date(middle) + time(middle),
            "FrameAcquisitionDateTime": date(start) + time(start),
            "FrameAcquisitionDuration": window_ms,
            "DimensionIndexValues": [1, position, k + 1],
            "StackID": "1",
            "InStackPositionNumber": position,
            "TemporalPositionIndex": k + 1,
        },
        "PlanePositionSequence": place(series, z)["position"],
        "CardiacSynchronizationSequence": {
            "NominalPercentageOfCardiacPhase": float(np.float32(100 * trigger_ms / rr_ms)),
            "NominalCardiacTriggerDelayTime": trigger_ms,
            "RRIntervalTimeNominal": rr_ms,
        },
    }
