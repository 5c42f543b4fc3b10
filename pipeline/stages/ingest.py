"""Ingest: the scanner's files become one stack of slices through the heartbeat."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pipeline.errors import InputError
from pipeline.imaging.cine import Stack
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.ecg import read_ecg
from pipeline.imaging.faults import (
    doubts_of_order,
    redraw_slices,
    require_different_images,
    require_finite,
)
from pipeline.imaging.nifti import read_nifti_cine, read_nifti_views
from pipeline.job import Job
from pipeline.products import write_cine


def run(job: Job) -> dict[str, Any]:
    """Read the cine, DICOM or NIfTI, and write ``cine.nii.gz`` and ``phases.json``.

    Long-axis views are kept beside it: those in the folder of DICOM files, or, with a cine in
    NIfTI, those in the study's folder ``long_axis``.
    """
    files = job.study.cine
    if files.path.is_dir():
        stack, views = read_dicom_study(files.path, files.rr_ms, files.fill_gaps)
    else:
        stack = read_nifti_cine(files.path, files.timing, files.rr_ms)
        views = read_nifti_views(job.study.long_axis, files.rr_ms)
    where = f"{job.study.folder / 'study.yaml'}: cine.spoilt_slices"
    stack = replace(stack, cine=redraw_slices(stack.cine, files.spoilt_slices, where))
    require_finite(stack.cine, str(files.path))
    copies = require_different_images(stack.cine, str(files.path))
    for view in views:
        require_finite(view.cine, f"long-axis view {view.name}")
    _require_ecg_as_long(job, stack)
    write_cine(job.folder, stack, views)
    cine = stack.cine
    return {
        "phases": len(cine.phases),
        "slices": cine.intensity.shape[1],
        "interpolated_slices": list(cine.interpolated),
        "matrix": list(cine.intensity.shape[2:]),
        "spacing_mm": [round(float(value), 4) for value in cine.spacing_mm],
        "rr_s": round(cine.rr_s, 4),
        "timing_source": stack.timing_source,
        "left_out": list(stack.left_out),
        "remarks": [*stack.remarks, *copies, *doubts_of_order(stack.cine)],
        "long_axis": [view.name for view in views],
    }


def _require_ecg_as_long(job: Job, stack: Stack) -> None:
    """Refuse an ECG that cannot be of this cine: every slice takes a heartbeat at the least."""
    if job.study.ecg.mr is None:
        return
    ecg = read_ecg(job.study.ecg.mr)
    lasts_s = len(ecg.signal_mv) / ecg.sampling_rate_hz
    # The slices of a volume are acquired together; nothing but a heartbeat is certain.
    beats_ms = stack.rr_ms[:1] if _is_volume(stack) else stack.rr_ms
    needed_s = float(beats_ms.sum()) / 1000
    if lasts_s < needed_s:
        raise InputError(
            f"{job.study.ecg.mr}: the ECG is shorter than the cine: it lasts {lasts_s:.1f} s, and "
            f"{len(beats_ms)} slices of a heartbeat each take {needed_s:.1f} s at the least; "
            "give the whole record, or take it out of the study"
        )


def _is_volume(stack: Stack) -> bool:
    """Whether slices are about as thin as their pixels, as no slices acquired one by one are."""
    column_mm, row_mm, slice_mm = stack.cine.spacing_mm
    return bool(slice_mm < 1.5 * max(column_mm, row_mm))
