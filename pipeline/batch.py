"""A folder of patients, each in a process of its own: one that crashes costs only itself."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.publish import readable_write_errors
from pipeline.study import open_study, studies_in
from pipeline.summary import remarks

NO_STUDY = "no study"
"""Status of a folder among the studies that is none; nothing was run, and nothing failed."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one patient's run ended."""

    patient: str
    status: str
    """done, failed (the program said why), crashed (it could not) or `NO_STUDY`."""

    seconds: float
    lv_ejection_fraction: float | None
    target_registration_error_mm: float | None
    largest_distance_error_mm: float | None
    expected_tre_mm: float | None
    registration: str
    """Its verdict; empty where there is none."""

    remarks: str
    """What `pipeline.summary.remarks` says of it."""

    cause: str


def run_batch(
    studies: Path,
    out: Path,
    workers: int,
    config: Path | None,
    ended: Callable[[Outcome, int, int], None],
) -> list[Outcome]:
    """Run every study below ``studies``; write ``out/batch.csv``; return outcomes by name.

    ``ended`` is told of each that has ended, how many have, and of how many.
    Folders that are no study are listed among the outcomes, but for hidden ones and ``out``.

    Raises
    ------
    InputError
        When the folder is missing or holds no study, or ``out`` cannot be written.
    """
    if not studies.is_dir():
        raise InputError(f"{studies}: no such folder; give the folder that holds the studies")
    folders = studies_in(studies)
    if not folders:
        raise InputError(f"{studies}: holds no study (folders with cine/ or study.yaml)")
    _require_different_patients(folders)
    logs = out / "logs"
    with readable_write_errors(logs):
        logs.mkdir(parents=True, exist_ok=True)
    outcomes = []
    with ThreadPoolExecutor(workers) as pool:
        waiting = [pool.submit(_run_one, folder, out, config) for folder in folders]
        for finished in as_completed(waiting):
            outcome = finished.result()
            outcomes.append(outcome)
            ended(outcome, len(outcomes), len(folders))
    outcomes += _no_studies(studies, folders, out)
    outcomes.sort(key=lambda outcome: outcome.patient)
    with readable_write_errors(out):
        _write_csv(out / "batch.csv", outcomes)
    return outcomes


def _no_studies(studies: Path, folders: Sequence[Path], out: Path) -> list[Outcome]:
    others = (path for path in studies.iterdir() if path.is_dir() and path not in folders)
    return [
        Outcome(path.name, NO_STUDY, 0.0, *_figures({}), "has neither cine/ nor study.yaml")
        for path in others
        if not path.name.startswith(".") and path.resolve() != out.resolve()
    ]


def _require_different_patients(folders: Sequence[Path]) -> None:
    """Two studies of one patient id would write into one folder."""
    seen: dict[str, Path] = {}
    for folder in folders:
        try:
            patient = open_study(folder).patient_id
        except InputError:
            continue  # This patient's own run says what is wrong, and costs only itself.
        if patient in seen:
            raise InputError(
                f"{folder}: has the patient id {patient!r} of {seen[patient]}; "
                "give each study its own patient_id in study.yaml"
            )
        seen[patient] = folder


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as text, one line a patient."""
    head = f"{'patient':24s} {'status':8s} {'seconds':>8s} {'LV EF':>6s} {'TRE mm':>7s}"
    lines = [f"{head} {'expected':>8s}  {'verdict':8s}  cause or remarks"]
    for one in outcomes:
        figures = (
            f"{'-' if value is None else format(value, '.2f'):>{width}s}"
            for value, width in (
                (one.lv_ejection_fraction, 6),
                (one.target_registration_error_mm, 7),
                (one.expected_tre_mm, 8),
            )
        )
        lines.append(
            f"{one.patient:24s} {one.status:8s} {one.seconds:8.1f} {' '.join(figures)}  "
            f"{one.registration or '-':8s}  {one.cause or one.remarks}"
        )
    return "\n".join(lines)


def _run_one(study: Path, out: Path, config: Path | None) -> Outcome:
    command = [sys.executable, "-m", "pipeline", "run", str(study), "--out", str(out)]
    command += ["--config", str(config)] if config else []
    log = out / "logs" / f"{study.name}.log"
    clock = time.perf_counter()
    with log.open("w") as handle:
        code = subprocess.call(
            command, stdout=handle, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
        )
    seconds = time.perf_counter() - clock
    status, cause = _status(code, log)
    stages = _stages(out, study) if status == "done" else {}
    return Outcome(study.name, status, round(seconds, 1), *_figures(stages), cause)


def _status(code: int, log: Path) -> tuple[str, str]:
    if code == 0:
        return "done", ""
    lines = log.read_text(errors="replace").splitlines()
    if code < 0:
        return "crashed", f"{signal.Signals(-code).name}; see {log}"
    said = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    if said:
        return "failed", said[-1]
    return "crashed", f"{lines[-1] if lines else 'no message'}; see {log}"


def _stages(out: Path, study: Path) -> dict[str, Any]:
    record = json.loads((out / open_study(study).patient_id / "run.json").read_text())
    stages: dict[str, Any] = record["stages"]
    return stages


def _figures(
    stages: dict[str, Any],
) -> tuple[float | None, float | None, float | None, float | None, str, str]:
    def figure(stage: str, *keys: str) -> float | None:
        value = stages.get(stage, {}).get("figures", {})
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value if isinstance(value, float) else None

    verdict = stages.get("register", {}).get("figures", {}).get("verdict", "")
    return (
        figure("surface", "lv_ejection_fraction"),
        figure("evaluate", "target_registration_error_mm"),
        figure("bake", "accuracy", "distance_error_max_mm"),
        figure("register", "expected_tre_mm"),
        verdict,
        "; ".join(f"{word}: {text}" for word, text in remarks(stages)),
    )


def _write_csv(path: Path, outcomes: Sequence[Outcome]) -> None:
    with path.open("w", newline="") as handle:
        rows = csv.DictWriter(handle, [field.name for field in fields(Outcome)])
        rows.writeheader()
        rows.writerows(asdict(outcome) for outcome in outcomes)
