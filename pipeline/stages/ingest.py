"""Ingest: the scanner's files become one stack of slices through the heartbeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.imaging.cine import OTHER_RATE, Stack
from pipeline.imaging.dicom import read_dicom_study
from pipeline.imaging.ecg import Ecg, other_patient, patient_mark, read_ecg
from pipeline.imaging.faults import (
    doubts_of_gaps,
    doubts_of_range,
    redraw_slices,
    require_different_images,
    require_slices_before_phases,
    without_blank_ends,
)
from pipeline.imaging.long_axis_series import LongAxis
from pipeline.imaging.nifti import read_nifti_cine, read_nifti_views
from pipeline.imaging.phases import doubts_of_phases
from pipeline.imaging.stored_order import doubts_of_order
from pipeline.imaging.unrecorded import require_finite, without_unrecorded
from pipeline.job import Job
from pipeline.products import write_cine
from pipeline.registration.time import detect_r_peaks, median_rr_s

PAIRED, LEAST_PAIRED = 0.2, 8
"""A step of less than this share of the mean one is none of a cine of so many phases."""
WIDEST_STEP, MOST_STEPS = 0.25, 3.0
"""Share of a beat between two phases, and times the usual step, beyond which it is told: gating
that waits for the next R peak leaves out a fifth at the end."""


def run(job: Job) -> dict[str, Any]:
    """Read the cine, DICOM or NIfTI, and write ``cine.nii.gz`` and ``phases.json``.

    Long-axis views are kept beside it: those in the folder of DICOM files, or, with a cine in
    NIfTI, those in the study's folder ``long_axis``.
    """
    files = job.study.cine
    if files.path.is_dir():
        without = files.leave_out_series
        stack, views = read_dicom_study(files.path, files.rr_ms, files.fill_gaps, without)
    else:
        stack = read_nifti_cine(files.path, files.timing, files.rr_ms)
        views = read_nifti_views(job.study.long_axis, files.rr_ms)
    cine, unrecorded = without_unrecorded(stack.cine, "the cine")
    stack = replace(stack, cine=cine, remarks=(*stack.remarks, *unrecorded))
    stack, copies = _of_usable_slices(job, stack)
    views, told_of_views = _views_of_numbers(views)
    ecg = None if job.study.ecg.mr is None else read_ecg(job.study.ecg.mr)
    _require_ecg_as_long(job, stack, ecg)
    write_cine(job.folder, stack, views)
    cine, timed = stack.cine, stack.timed or range(len(stack.rr_ms))
    return {
        "phases": len(cine.phases),
        "slices": cine.intensity.shape[1],
        "interpolated_slices": list(cine.interpolated),
        "matrix": list(cine.intensity.shape[2:]),
        "spacing_mm": [round(float(value), 4) for value in cine.spacing_mm],
        "rr_s": round(cine.rr_s, 4),
        "timing_source": stack.timing_source,
        "left_out": list(stack.left_out),
        "remarks": [
            *stack.remarks,
            *told_of_views,
            *copies,
            *doubts_of_gaps(cine),
            *doubts_of_order(cine),
            *doubts_of_range(cine),
            *doubts_of_phases(stack.trigger_times_ms, stack.rr_ms, timed),
            *_doubts_of_beat(job, stack, ecg),
            *_doubts_of_patient(job, stack, ecg),
        ],
        "patient_mark": patient_mark(stack.patient),
        "long_axis": [view.name for view in views],
    }


def _of_usable_slices(job: Job, stack: Stack) -> tuple[Stack, tuple[str, ...]]:
    """The stack without blank ends and with its spoilt slices drawn anew, and which phases are
    copies. ``cine.spoilt_slices`` counts as all messages do: blank ends have no number."""
    files, before = job.study.cine, len(stack.remarks)
    stack = without_blank_ends(stack)
    where = f"{job.study.folder / 'study.yaml'}: cine.spoilt_slices"
    try:
        stack = replace(stack, cine=redraw_slices(stack.cine, files.spoilt_slices, where))
        require_finite(stack.cine, str(files.path))
        if not files.path.is_dir():
            require_slices_before_phases(stack.cine, str(files.path))
        return stack, require_different_images(stack.cine, str(files.path))
    except InputError as error:
        for remark in stack.remarks[before:]:
            error.add_note(remark)
        raise


def _views_of_numbers(views: Sequence[LongAxis]) -> tuple[tuple[LongAxis, ...], list[str]]:
    """Long-axis views without NaN about what was recorded, and what is told of them and that."""
    kept: list[LongAxis] = []
    told: list[str] = []
    for view in views:
        where = f"long-axis view {view.name}"
        cine, unrecorded = without_unrecorded(view.cine, where)
        require_finite(cine, where)
        kept.append(replace(view, cine=cine))
        told += [*(f"{where}: {remark}" for remark in view.remarks), *unrecorded]
    return tuple(kept), told


def _doubts_of_beat(job: Job, stack: Stack, ecg: Ecg | None) -> list[str]:
    """What speaks against the length of the heartbeat, or against the ECG beside it, in words."""
    rr_s, phases = stack.cine.rr_s, stack.cine.phases
    doubts = []
    steps = np.diff(phases, append=phases[0] + 1)
    widest = int(steps.argmax())
    if steps[widest] > max(WIDEST_STEP, MOST_STEPS * float(np.median(steps))):
        doubts.append(
            f"no image shows the {steps[widest]:.0%} of the heartbeat after phase "
            f"{phases[widest]:.2f}, and the motion there is a guess: is the RR interval of "
            f"{1000 * rr_s:.0f} ms right? Times after the R peak are to be those of such a beat"
        )
    if len(steps) >= LEAST_PAIRED and (steps < PAIRED * steps.mean()).mean() > 1 / 3:
        doubts.append(
            f"phases come in pairs, {steps.min():.2g} of a beat apart, as where slices were taken "
            "twice and both were mixed: keep one acquisition"
        )
    if ecg is None:
        return doubts
    try:
        beat_s = median_rr_s(detect_r_peaks(ecg.signal_mv, ecg.sampling_rate_hz))
    except InputError:
        # In a scanner that may be: nothing else reads this record.
        return doubts
    if not 1 / OTHER_RATE <= rr_s / beat_s <= OTHER_RATE:
        doubts.append(
            f"the cine's RR interval is {1000 * rr_s:.0f} ms, that of {job.study.ecg.mr} "
            f"{1000 * beat_s:.0f} ms: either timing is wrong, or the ECG is of another "
            "examination or patient"
        )
    return doubts


def _doubts_of_patient(job: Job, stack: Stack, ecg: Ecg | None) -> list[str]:
    if ecg is None or job.study.ecg.mr is None:
        return []
    return other_patient(ecg, patient_mark(stack.patient), job.study.ecg.mr)


def _require_ecg_as_long(job: Job, stack: Stack, ecg: Ecg | None) -> None:
    """Refuse an ECG that cannot be of this cine: every slice takes a heartbeat at the least."""
    if ecg is None:
        return
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
