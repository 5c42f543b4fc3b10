"""Register: tracked ultrasound comes to the MR, in time by the ECG and in space by its pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry import Float, require_rigid
from pipeline.imaging.ecg import read_ecg
from pipeline.imaging.ultrasound import Sweep, read_sweep
from pipeline.job import Job, Skipped
from pipeline.products import FrameRow, read_surfaces, read_table, write_frames, write_table
from pipeline.registration.space import Registration, register
from pipeline.registration.time import detect_r_peaks, phases_at, summarise_rr


def run(job: Job) -> dict[str, Any]:
    """Write ``mr_from_tracker.json`` and ``frames.csv``."""
    start = _start(job)
    sweeps = [read_sweep(path) for path in job.study.us.sweeps] if job.study.us else []
    r_times_s = _r_times_s(job)
    phases = [phases_at(sweep.times_s, r_times_s) for sweep in sweeps]
    cycle = np.array(read_table(job.products / "ingest" / "phases.json")["phases"])
    surfaces = read_surfaces(job.products / "surface", cycle)
    settings = job.settings.register_
    found = register(sweeps, phases, surfaces, start, settings, job.progress)
    _write(job, found, _rows(sweeps, phases, found))
    return {
        "frames": len(found.valid),
        "valid": int(found.valid.sum()),
        "score": round(found.score, 5),
        "start_score": round(found.start_score, 5),
        "confidence": round(found.confidence, 2),
        "median_rr_s": round(summarise_rr(r_times_s).median_s, 4),
    }


def _start(job: Job) -> Float:
    """The first guess of where the tracker stands, as the study gives it."""
    if job.study.us is None:
        raise Skipped("no tracked ultrasound: the field is in the frame of the MR")
    given = job.study.us.initial_mr_from_tracker
    if given is None:
        raise Skipped(
            "tracked ultrasound without a first guess: give us.initial_mr_from_tracker in "
            "study.yaml; the field is in the frame of the MR"
        )
    start = np.array(given, dtype=float)
    require_rigid(start, f"{job.study.folder}/study.yaml: us.initial_mr_from_tracker")
    return start


def _r_times_s(job: Job) -> Float:
    assert job.study.ecg.us is not None, "a study with ultrasound has its ECG"
    ecg = read_ecg(job.study.ecg.us)
    return detect_r_peaks(ecg.signal_mv, ecg.sampling_rate_hz) + ecg.start_s


def _rows(sweeps: list[Sweep], phases: list[Float], found: Registration) -> list[FrameRow]:
    rows = [
        (sweep.name, number, float(sweep.times_s[number]), float(phases_of[number]))
        for sweep, phases_of in zip(sweeps, phases, strict=True)
        for number in range(len(sweep.times_s))
    ]
    return [
        FrameRow(*row, float(residual), bool(valid))
        for row, residual, valid in zip(rows, found.residual, found.valid, strict=True)
    ]


def _write(job: Job, found: Registration, rows: list[FrameRow]) -> None:
    write_table(
        job.folder / "mr_from_tracker.json",
        {"mr_from_tracker": found.mr_from_tracker.tolist(), "frame": "LPS", "unit": "mm"},
    )
    write_frames(job.folder / "frames.csv", rows)
