"""How the studies of a batch ended: one row each."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from pipeline.batch_plan import Plan
from pipeline.console import in_one_line, plain
from pipeline.errors import InputError
from pipeline.publish import write_whole
from pipeline.summary import remarks

NO_STUDY = "no study"
"""Status of a folder among the studies that is none; nothing was run, and nothing failed."""

INTERRUPTED = "interrupted"
"""Status of a study that was told to end, or that was not begun."""

WAITING = "not ended"
"""Status of a study of a batch that is at work, or was killed."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one patient's run ended."""

    patient: str
    """Name of the folder among the studies."""

    status: str
    """done, failed (the program said why), crashed (it could not), `INTERRUPTED`, `NO_STUDY` or
    `WAITING`."""

    seconds: float
    lv_ejection_fraction: float | None
    rv_ejection_fraction: float | None
    lv_end_diastolic_volume_ml: float | None
    lv_end_systolic_volume_ml: float | None
    rv_end_diastolic_volume_ml: float | None
    rv_end_systolic_volume_ml: float | None
    lv_mass_g: float | None
    target_registration_error_mm: float | None
    largest_distance_error_mm: float | None
    expected_tre_mm: float | None
    registration: str
    """Its verdict; empty where there is none."""

    remarks: str
    """What `pipeline.summary.remarks` says of it."""

    cause: str
    patient_id: str
    """Empty where the study cannot be opened."""

    study: str
    """The study's folder."""

    products: str
    """The patient's folder of products; empty where there is none of this study."""


@dataclass(frozen=True, slots=True)
class Ended:
    """An outcome, and by what images of other studies are known to be the same."""

    outcome: Outcome
    images: frozenset[str] = frozenset()


def outcome_of(
    plan: Plan,
    status: str,
    cause: str,
    seconds: float = 0.0,
    record: Mapping[str, Any] | None = None,
    products: Path | None = None,
) -> Ended:
    """Describe how a study ended; ``record`` is what its ``run.json`` says of this run.

    Of one that is not done the table has what its finished stages measured; what they remarked is
    among the causes already.
    """
    stages = {
        name: stage
        for name, stage in (record or {}).get("stages", {}).items()
        if stage.get("status") != "stale"
    }
    outcome = Outcome(
        patient=plan.name,
        status=status,
        seconds=round(seconds, 1),
        **_figures(stages),
        registration=_verdict(stages.get("register", {})),
        remarks=_remarks(stages) if status == "done" else "",
        cause=cause,
        patient_id=plan.patient_id,
        study=str(plan.folder),
        products=str(products or ""),
    )
    return Ended(outcome, _images(record or {}))


def _figures(stages: Mapping[str, Any]) -> dict[str, float | None]:
    """What of an outcome is measured."""

    def figure(stage: str, *keys: str) -> float | None:
        value = stages.get(stage, {}).get("figures", {})
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value if isinstance(value, float) else None

    def volume(chamber: str, pick: Callable[[list[float]], float]) -> float | None:
        volumes_ml = stages.get("surface", {}).get("figures", {}).get("volumes_ml", {})
        return pick(volumes_ml[chamber]) if chamber in volumes_ml else None

    off_mm = figure("bake", "accuracy", "distance_error_max_mm")
    return {
        "lv_ejection_fraction": figure("surface", "lv_ejection_fraction"),
        "rv_ejection_fraction": figure("surface", "rv_ejection_fraction"),
        "lv_end_diastolic_volume_ml": volume("lv_endocardium", max),
        "lv_end_systolic_volume_ml": volume("lv_endocardium", min),
        "rv_end_diastolic_volume_ml": volume("rv_endocardium", max),
        "rv_end_systolic_volume_ml": volume("rv_endocardium", min),
        "lv_mass_g": figure("surface", "lv_mass_g"),
        "target_registration_error_mm": figure("evaluate", "target_registration_error_mm"),
        "largest_distance_error_mm": None if off_mm is None else round(off_mm, 3),
        "expected_tre_mm": figure("register", "expected_tre_mm"),
    }


def _remarks(stages: dict[str, Any]) -> str:
    unregistered = _unregistered(stages.get("register", {}))
    told = [("not registered", unregistered)] if unregistered else []
    return "; ".join(f"{word}: {text}" for word, text in [*told, *remarks(stages)])


def _verdict(register: Mapping[str, Any]) -> str:
    verdict: str = register.get("figures", {}).get("verdict", "")
    return "failed" if _unregistered(register) else verdict


def _unregistered(register: Mapping[str, Any]) -> str:
    """Why ultrasound was left out (``on_failure: mr_frame``); empty where there was none."""
    cause = str(register.get("cause", "")) if register.get("status") == "skipped" else ""
    return "" if cause.startswith("no tracked ultrasound") else cause


def _images(record: Mapping[str, Any]) -> frozenset[str]:
    """Digests of the cine's images; when they were taken may be told otherwise of the same ones."""
    cine = record.get("inputs", {}).get("cine", {})
    return frozenset(digest for name, digest in cine.items() if not name.endswith(".json"))


def rows(ended: Sequence[Ended]) -> list[Outcome]:
    """Outcomes by name; studies of the same images have each other's names among the remarks."""
    by_name = sorted(ended, key=lambda one: one.outcome.patient)
    told = []
    for one in by_name:
        same = [
            f"same images as {other.outcome.patient}"
            for other in by_name
            if other is not one and one.images and other.images == one.images
        ]
        said = "; ".join(filter(None, (one.outcome.remarks, *same)))
        told.append(replace(one.outcome, remarks=said))
    return told


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as text, one line a patient."""
    head = f"{'patient':24s} {'patient id':24s} {'status':11s} {'seconds':>8s} {'LV EF':>6s}"
    lines = [f"{head} {'TRE mm':>7s} {'expected':>8s}  {'verdict':8s}  cause or remarks"]
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
            f"{one.patient:24s} {one.patient_id or '-':24s} {one.status:11s} {one.seconds:8.1f} "
            f"{' '.join(figures)}  {one.registration or '-':8s}  {one.cause or one.remarks}"
        )
    # Names of folders may hold bytes that are no text, and several lines, which would forge a row.
    lines = [in_one_line(line) for line in lines]
    return "\n".join(lines).encode("utf-8", "backslashreplace").decode()


def write_table(path: Path, outcomes: Sequence[Outcome]) -> InputError | None:
    """Write the outcomes as CSV, whole or not at all; return why that cannot be done, if so."""
    text = io.StringIO(newline="")
    lines = csv.DictWriter(text, [field.name for field in fields(Outcome)])
    lines.writeheader()
    for outcome in outcomes:
        lines.writerow({name: _as_text(value) for name, value in asdict(outcome).items()})
    try:
        write_whole(path, text.getvalue())
    except InputError as error:
        return error
    except OSError as error:
        return InputError(f"{path}: cannot be written ({error}); clear the way, or choose --out")
    return None


def _as_text(value: Any) -> Any:
    """A cell that spreadsheets and terminals show: they would run a folder's name that begins as a
    formula, or obey what is in it."""
    if not isinstance(value, str):
        return value
    return plain(f"'{value}" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else value)
