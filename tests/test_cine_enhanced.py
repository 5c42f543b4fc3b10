"""Enhanced multi-frame MR objects: what a frame inherits, how it is timed, thin volumes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cine_files import (
    ALL_FRAMES,
    COLUMNS,
    NORMAL,
    ORIGIN_MM,
    PHASES,
    ROWS,
    RR_MS,
    SLICES,
    assert_is_the_stack,
    enhanced_object,
    in_series,
    item,
    pixel_value,
    read_dicom_cine,
)
from pydicom.uid import generate_uid

from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.job import Job
from pipeline.stages import ingest
from pipeline.study import open_study


def test_an_enhanced_object_a_slice_is_the_same_stack(tmp_path: Path) -> None:
    for number in range(SLICES):
        data = in_series(enhanced_object([(number, k) for k in range(PHASES)]), 3, "cine")
        data.SOPInstanceUID = generate_uid()
        data.save_as(tmp_path / f"{7 - number}.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_enhanced_frames_have_their_own_slope_and_intercept(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    for k, own in enumerate(data.PerFrameFunctionalGroupsSequence):
        own.PixelValueTransformationSequence = item(
            RescaleSlope=str(1 + k), RescaleIntercept="-7", RescaleType="US"
        )
    data.save_as(tmp_path / "all.dcm")
    found = read_dicom_cine(tmp_path).cine.intensity
    for k, (number, phase) in enumerate(ALL_FRAMES):
        expected = pixel_value(phase, number) * float(1 + k) - 7
        np.testing.assert_array_equal(found[phase, number], expected)


@pytest.mark.parametrize(
    ("name", "scale"),
    [("ActualCardiacTriggerDelayTime", RR_MS), ("NominalPercentageOfCardiacPhase", 100.0)],
)
def test_tied_trigger_times_give_way_to_the_next_best_clock(
    tmp_path: Path, name: str, scale: float
) -> None:
    data = enhanced_object(ALL_FRAMES)
    for own, (_, phase) in zip(data.PerFrameFunctionalGroupsSequence, ALL_FRAMES, strict=True):
        timing = own.CardiacSynchronizationSequence[0]
        timing.NominalCardiacTriggerDelayTime = 0.0
        setattr(timing, name, phase / PHASES * scale)
    data.save_as(tmp_path / "all.dcm")
    stack = read_dicom_cine(tmp_path)
    assert_is_the_stack(stack)
    assert name in stack.timing_source


def test_the_heart_rate_goes_before_the_interval_that_was_asked_for(tmp_path: Path) -> None:
    """Of an Enhanced object both stand at the top; 60,000 / 75 is `RR_MS`."""
    data = enhanced_object(ALL_FRAMES)
    for own in data.PerFrameFunctionalGroupsSequence:
        del own.CardiacSynchronizationSequence[0].RRIntervalTimeNominal
    data.HeartRate, data.CardiacRRIntervalSpecified = "75", 1000.0
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_a_beat_of_a_frame_goes_before_that_of_the_whole_object(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    data.RRIntervalTimeNominal = 1.5 * RR_MS
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_enhanced_frames_without_description_are_refused(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    del data.PerFrameFunctionalGroupsSequence[-1]
    data.save_as(tmp_path / "all.dcm")
    with pytest.raises(InputError, match=r"20 frames of pixels and 19 descriptions"):
        read_dicom_cine(tmp_path)


def test_two_hundred_thin_slices_are_one_volume(tmp_path: Path) -> None:
    order = [(number, phase) for number in range(200) for phase in range(2)]
    data = enhanced_object(order)
    for own, (number, phase) in zip(data.PerFrameFunctionalGroupsSequence, order, strict=True):
        position_mm = ORIGIN_MM + 0.8 * number * NORMAL
        own.PlanePositionSequence[0].ImagePositionPatient = position_mm.tolist()
        own.CardiacSynchronizationSequence[0].NominalCardiacTriggerDelayTime = 400.0 * phase
    data.save_as(tmp_path / "all.dcm")
    cine = read_dicom_cine(tmp_path).cine
    assert cine.intensity.shape == (2, 200, ROWS, COLUMNS)
    np.testing.assert_allclose(cine.spacing_mm, (1.25, 1.5, 0.8), atol=1e-6)
    np.testing.assert_array_equal(cine.intensity[1, 137], pixel_value(1, 137))


def ingested(folder: Path, thick_mm: float, ecg_s: float) -> dict[str, Any]:
    """Figures of the ingest stage for 40 slices of 0.8 s heartbeats and an ECG beside them."""
    order = [(number, phase) for number in range(40) for phase in range(PHASES)]
    data = enhanced_object(order)
    for own, (number, _) in zip(data.PerFrameFunctionalGroupsSequence, order, strict=True):
        position_mm = ORIGIN_MM + thick_mm * number * NORMAL
        own.PlanePositionSequence[0].ImagePositionPatient = position_mm.tolist()
    for name in ("cine", "ecg", "out"):
        (folder / name).mkdir()
    data.save_as(folder / "cine" / "all.dcm")
    times_s = np.arange(0, ecg_s, 0.004)
    rows = [f"{time_s:.3f},{np.sin(7.9 * time_s):.4f}" for time_s in times_s]
    (folder / "ecg" / "mr.csv").write_text("\n".join(["time_s,II", *rows, ""]))
    (folder / "study.yaml").write_text("patient_id: p\ncine: {path: cine}\necg: {mr: ecg/mr.csv}\n")
    study = open_study(folder)
    return ingest.run(Job(study, Settings(), folder, folder / "out", lambda done, total: None))


def test_the_slices_of_a_volume_need_no_heartbeat_each(tmp_path: Path) -> None:
    """40 slices of 0.8 s would take 32 s one by one."""
    for name in ("volume", "stack"):
        (tmp_path / name).mkdir()
    assert ingested(tmp_path / "volume", thick_mm=1.5, ecg_s=20)["slices"] == 40
    with pytest.raises(InputError, match="shorter than the cine"):
        ingested(tmp_path / "stack", thick_mm=8.0, ecg_s=20)


def test_what_a_frame_says_itself_goes_before_what_is_said_of_all(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    data.SharedFunctionalGroupsSequence[0].update(
        {
            "PlanePositionSequence": item(ImagePositionPatient=[0.0, 0.0, 0.0]),
            "PixelValueTransformationSequence": item(
                RescaleSlope="3", RescaleIntercept="5", RescaleType="US"
            ),
        }
    )
    for own in data.PerFrameFunctionalGroupsSequence:
        own.PixelValueTransformationSequence = item(
            RescaleSlope="1", RescaleIntercept="0", RescaleType="US"
        )
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))


def test_the_interval_of_a_frame_goes_before_the_rounded_heart_rate(tmp_path: Path) -> None:
    data = enhanced_object(ALL_FRAMES)
    data.HeartRate = "80"
    data.save_as(tmp_path / "all.dcm")
    assert_is_the_stack(read_dicom_cine(tmp_path))
