"""Register: tracked ultrasound comes to the MR, in time by the ECG and in space by its pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError, StageError, UnregistrableError
from pipeline.geometry import Float, MovingSurface
from pipeline.imaging.ecg import Ecg, other_patient, read_ecg
from pipeline.imaging.ultrasound import Sweep, leaps, odd_transforms, read_sweeps, remarks_on
from pipeline.job import Job, Skipped
from pipeline.products import (
    FrameRow,
    read_cine,
    read_surfaces,
    read_table,
    write_frames,
    write_slicer_transform,
    write_table,
)
from pipeline.registration.clock_offset import Timing
from pipeline.registration.in_view import require_frames
from pipeline.registration.rhythm import read_rhythm, unordered
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.space import Registration, register
from pipeline.registration.time import detect_r_peaks, in_known_beats, median_rr_s, phases_at

if TYPE_CHECKING:
    # For types only: a stage's product must not depend on how a study's folder is understood.
    from pipeline.study import Study


def run(job: Job) -> dict[str, Any]:
    """Write ``mr_from_tracker.json``, ``frames.csv``, and the transform for 3D Slicer."""
    if job.study.us is None:
        raise Skipped("no tracked ultrasound: the field is in the frame of the MR")
    start = job.study.us.start()
    ecg = _ecg(job.study)
    r_times_s = _r_times_s(job.study, ecg)
    sweeps = _sweeps(job.study, ecg, r_times_s)
    cycle = read_table(job.products / "ingest" / "phases.json")
    surfaces = read_surfaces(job.products / "surface", np.array(cycle["phases"]))
    timing = _timing(job.study, sweeps, r_times_s, cycle["rr_s"])
    found = _registered(job, sweeps, timing, surfaces, start)
    phases = timing.phases(found.clock.applied_s if found.clock else 0.0)
    _write(job, found, _rows(sweeps, phases, found), sweeps[0].pose_frame)
    return {
        "frames": len(found.valid),
        "valid": int(found.valid.sum()),
        "score": round(found.score, 5),
        "start_score": round(found.start_score, 5),
        "confidence": round(found.confidence, 2),
        "reading": job.settings.register_.reading,
        "verdict": found.verdict,
        "reason": found.reason,
        "expected_tre_mm": round(found.expected_mm, 3),
        "good_tre_mm": job.settings.register_.good_tre_mm,
        "worst_tre_mm": job.settings.register_.worst_tre_mm,
        "chance_under_2_mm": round(found.chance_under_2_mm, 3),
        "breath": job.settings.register_.breath,
        "breath_range_mm": round(float(np.ptp(found.breath_mm)), 2),
        "calibration": "; ".join(one.words() for one in found.corrections),
        "median_rr_s": round(median_rr_s(r_times_s), 4),
        **_clock_figures(found),
        "remarks": [*remarks_on(sweeps), *_doubts_of_patient(job, ecg), *_doubts_of_rhythm(ecg)],
    }


def require_usable(study: Study, settings: RegisterSettings) -> None:
    """Refuse at once what `run` would refuse of the ultrasound's files minutes later.

    Raises
    ------
    InputError
        When a sweep or its ECG cannot be read, they do not overlap, or frames are too few.
    """
    if study.us is None:
        return
    ecg = _ecg(study)
    r_times_s = _r_times_s(study, ecg)
    sweeps = _sweeps(study, ecg, r_times_s)
    timing = _timing(study, sweeps, r_times_s, None)
    if settings.on_failure == "stop":
        require_frames(sweeps, timing.phases(), settings)


def _registered(
    job: Job,
    sweeps: list[Sweep],
    timing: Timing,
    surfaces: dict[str, MovingSurface],
    start: Float | None,
) -> Registration:
    """The registration; where there is none and the user wants it so, the MR's frame."""
    settings, phases = job.settings.register_, timing.phases()
    cine = read_cine(job.products / "ingest")
    doubts = [*_doubts_of_images(job), *leaps(sweeps), *timing.doubts()]
    known = start, settings, job.progress, timing, cine, doubts
    try:
        return register(sweeps, phases, surfaces, *known)
    except (InputError, StageError) as error:
        odd = odd_transforms(sweeps)
        said = type(error)(f"{error}; {odd}") if odd else error
        malformed = isinstance(error, InputError) and not isinstance(error, UnregistrableError)
        if malformed or settings.on_failure == "stop":
            raise said from error.__cause__
        raise Skipped(f"{said}; the field is in the frame of the MR") from error


def _sweeps(study: Study, ecg: Ecg, r_times_s: Float) -> list[Sweep]:
    """The sweeps, without frames that were taken while the ECG shows no beat."""
    assert study.us is not None, "only a study with ultrasound is registered"
    sweeps = []
    for path, sweep in zip(study.us.sweeps, read_sweeps(study.us), strict=True):
        known = in_known_beats(sweep.times_s, r_times_s, ecg.recorded_s)
        told = [] if known.all() else [_told_of_pause(sweep.times_s[~known], len(known))]
        if not known.any():
            raise InputError(f"{path}, beside {study.ecg.us}: {told[0]}; give its own ECG, whole")
        sweeps.append(sweep.only(known, *told))
    return sweeps


def _told_of_pause(times_s: Float, frames: int) -> str:
    return (
        f"{len(times_s)} of {frames} frames, between {times_s[0]:.2f} and {times_s[-1]:.2f} s, "
        "left out: the ECG shows no beat there for longer than one lasts"
    )


def _timing(
    study: Study, sweeps: list[Sweep], r_times_s: Float, cycle_rr_s: float | None
) -> Timing:
    """When frames were taken; each sweep must lie within its ECG."""
    assert study.us is not None, "only a study with ultrasound is registered"
    for path, sweep in zip(study.us.sweeps, sweeps, strict=True):
        try:
            phases_at(sweep.times_s, r_times_s, cycle_rr_s)
        except InputError as error:
            raise InputError(f"{path}, beside {study.ecg.us}: {error}") from error
    return Timing([sweep.times_s for sweep in sweeps], r_times_s, cycle_rr_s)


def _ecg(study: Study) -> Ecg:
    assert study.ecg.us is not None, "a study with ultrasound has its ECG"
    return read_ecg(study.ecg.us)


def _doubts_of_patient(job: Job, ecg: Ecg) -> list[str]:
    assert job.study.ecg.us is not None, "a study with ultrasound has its ECG"
    return other_patient(ecg, job.figures("ingest")["patient_mark"], job.study.ecg.us)


def _doubts_of_rhythm(ecg: Ecg) -> list[str]:
    """A sentence where a force server would withhold forces for much of the time."""
    beats = read_rhythm(ecg.signal_mv, ecg.sampling_rate_hz)
    said = unordered(beats)
    return [f"the ultrasound's ECG: {said}; forces are withheld in such a rhythm"] if said else []


def _doubts_of_images(job: Job) -> list[str]:
    if not job.figures("segment")["mirror_image"]:
        return []
    return [
        "the MR's images are a mirror image of what their header says, to which no tracker's pose "
        "fits: look at the order of the slices and the orientation in the file"
    ]


def _r_times_s(study: Study, ecg: Ecg) -> Float:
    try:
        return detect_r_peaks(ecg.signal_mv, ecg.sampling_rate_hz) + ecg.start_s
    except InputError as error:
        raise InputError(f"{study.ecg.us}: {error}") from error


def _rows(sweeps: list[Sweep], phases: list[Float], found: Registration) -> list[FrameRow]:
    rows = [
        (sweep.name, int(number), float(time_s), float(phase))
        for sweep, phases_of in zip(sweeps, phases, strict=True)
        for number, time_s, phase in zip(sweep.numbers, sweep.times_s, phases_of, strict=True)
    ]
    return [
        FrameRow(*row, float(residual), bool(valid))
        for row, residual, valid in zip(rows, found.residual, found.valid, strict=True)
    ]


def _clock_figures(found: Registration) -> dict[str, float | None]:
    """How far the ultrasound's clock is ahead of the ECG's (None: not asked for, or the frames do
    not tell), its standard deviation, and what of it was taken off."""
    clock = found.clock
    if clock is None or clock.offset_s is None:
        return {"us_clock_offset_s": None, "us_clock_offset_sd_s": None, "us_clock_applied_s": 0.0}
    return {
        "us_clock_offset_s": round(clock.offset_s, 4),
        "us_clock_offset_sd_s": round(clock.sd_s, 4),
        "us_clock_applied_s": round(clock.applied_s, 4),
    }


def _write(job: Job, found: Registration, rows: list[FrameRow], pose_frame: str) -> None:
    write_table(
        job.folder / "mr_from_tracker.json",
        {
            "mr_from_tracker": found.mr_from_tracker.tolist(),
            "tracker": pose_frame,
            "frame": "LPS",
            "unit": "mm",
            "covariance": found.covariance.tolist(),
            "covariance_units": "mm, rad about centre_mm",
            "centre_mm": found.centre_mm.tolist(),
            "expected_tre_mm": round(found.expected_mm, 3),
            "chance_under_2_mm": round(found.chance_under_2_mm, 3),
            "verdict": found.verdict,
            "reason": found.reason,
            "calibration": [one.table() for one in found.corrections] or None,
            **_clock_figures(found),
        },
    )
    write_slicer_transform(job.folder / f"{pose_frame}ToRAS.tfm", found.mr_from_tracker)
    write_frames(job.folder / "frames.csv", rows)
