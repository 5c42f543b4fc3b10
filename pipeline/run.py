"""The stages of a study, in order.

A stage whose inputs, settings and code have not changed is not run again; an interrupted run
goes on from the first stage that is not finished.
"""

from __future__ import annotations

import importlib
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from pipeline.config import Settings
from pipeline.errors import NOT_TO_BE_USED, BeatfieldError, InputError
from pipeline.job import Job, Skipped
from pipeline.memory import PeakMemory
from pipeline.publish import only_run_in, publishing, read_record, remove, write_json
from pipeline.sealing import (
    code_digest,
    fingerprint,
    library_versions,
    network_digests,
    require_same_study,
    require_unaltered,
    seal,
    sealed,
)
from pipeline.study import Study
from pipeline.summary import remarks


@dataclass(frozen=True, slots=True)
class Stage:
    """What a stage depends on, so that a change anywhere else leaves its product standing."""

    name: str
    after: tuple[str, ...] = ()
    """Stages whose products it reads."""

    inputs: tuple[str, ...] = ()
    """Kinds of study files it reads: cine, mr_ecg, us, truth."""

    settings: tuple[str, ...] = ()
    """Sections of the settings it reads."""

    repeats_reasons: bool = False
    """Whether it tells why stages before it made nothing."""


STAGES = (
    Stage("ingest", inputs=("cine", "mr_ecg")),
    Stage("segment", after=("ingest",), settings=("segment",)),
    Stage("surface", after=("ingest", "segment"), settings=("surface",)),
    Stage(
        "register", after=("ingest", "segment", "surface"), inputs=("us",), settings=("register",)
    ),
    Stage(
        "bake",
        after=("ingest", "segment", "surface", "register"),
        # Their digests stand in the field.
        inputs=("cine", "mr_ecg", "us"),
        settings=("bake", "fixtures"),
    ),
    Stage(
        "evaluate",
        after=("ingest", "segment", "surface", "register", "bake"),
        inputs=("truth",),
    ),
    Stage(
        "report",
        after=("ingest", "segment", "surface", "register", "bake", "evaluate"),
        inputs=("cine", "mr_ecg", "us"),
        settings=("segment", "surface", "register", "bake", "fixtures"),
        repeats_reasons=True,
    ),
)

STAGE_NAMES = tuple(stage.name for stage in STAGES)

MEASURED = ("seconds", "peak_memory_mb", "finished")
"""What is told of a stage's run and does not decide its product."""


class Watcher(Protocol):
    """Whoever shows the user how the run goes."""

    def started(self, stage: str) -> None:
        """A stage begins."""

    def progress(self, done: int, total: int) -> None:
        """The stage in flight has done this much."""

    def ended(self, stage: str, outcome: str, seconds: float) -> None:
        """A stage ended: ``done``, ``unchanged``, ``failed``, or ``skipped: `` and why.

        One that is unchanged, skipped as in an earlier run, or refused because its product was
        altered has not been told to begin.
        """


@dataclass(slots=True)
class _Run:
    study: Study
    settings: Settings
    products: Path
    watcher: Watcher
    inputs: dict[str, dict[str, str]]
    before: Mapping[str, Any]
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)


def run_study(
    study: Study,
    settings: Settings,
    out: Path,
    watcher: Watcher,
    first: str | None = None,
    last: str | None = None,
) -> dict[str, Any]:
    """Run a study's stages; return what ``run.json`` says.

    Parameters
    ----------
    out
        Products go to ``out/<patient id>/``.
    first
        This stage and those after it run even if nothing changed.
    last
        The run ends after this stage.

    Raises
    ------
    InputError, StageError
        As the stage that failed says; ``run.json`` records it, and finished stages stay.
    InputError
        When ``out`` lies inside the study, another run is at work in the products, they are of
        another study with the same patient id, or an input cannot be read.
    """
    products = out / study.patient_id
    if products.resolve().is_relative_to(study.folder):
        raise InputError(f"{out}: lies inside the study; choose a folder outside {study.folder}")
    wanted = STAGES[: STAGE_NAMES.index(last) + 1] if last else STAGES
    forced = STAGE_NAMES[STAGE_NAMES.index(first) :] if first else ()
    with only_run_in(products):
        inputs = study.input_digests()
        require_same_study(study.folder, study.patient_id, inputs, products, STAGE_NAMES)
        run = _Run(study, settings, products, watcher, inputs, _earlier_stages(products))
        try:
            # From here on it is told which products are old, however the run ends.
            _record(run, "running")
            for stage in wanted:
                if stage.name == "register":
                    _require_ultrasound(run, stage, stage.name in forced)
            for stage in wanted:
                _bring_up_to_date(run, stage, force=stage.name in forced)
        except KeyboardInterrupt as interrupt:
            stages = _record(run, "interrupted")["stages"]
            _warn_of(run, [name for name in stages if stages[name]["status"] == "stale"], interrupt)
            raise
        except BaseException:
            # Of a stage that failed it has been told why; else, as where nobody reads its progress
            # any more, that the run is over.
            with suppress(OSError):
                _record(run, "failed")
            raise
        return _record(run, "done")


def _bring_up_to_date(run: _Run, stage: Stage, force: bool) -> None:
    key = _fingerprint(run, stage)
    target = run.products / stage.name
    standing = sealed(target)
    if standing and standing["fingerprint"] == key and not force:
        _require_as_it_was(run, stage, target)
        run.watcher.ended(stage.name, "unchanged", 0.0)
        run.stages[stage.name] = _entry(run, stage.name, "done", standing["figures"], key)
        return
    skipped = _skipped_before(run, stage, key)
    if skipped and not target.exists() and not force:
        # To find that ultrasound cannot be registered takes minutes.
        run.watcher.ended(stage.name, f"skipped: {skipped['cause']}", 0.0)
        run.stages[stage.name] = skipped
        return
    run.watcher.started(stage.name)
    clock, memory = time.perf_counter(), PeakMemory()
    try:
        figures = _execute(run, stage, target, key)
    except Skipped as reason:
        remove(target)
        run.watcher.ended(stage.name, f"skipped: {reason}", 0.0)
        run.stages[stage.name] = {"status": "skipped", "cause": str(reason), "fingerprint": key}
        return
    except Exception as error:
        _fail(run, stage, error, time.perf_counter() - clock)
        # What finished stages noticed may be why this one failed.
        for word, text in remarks(run.stages) if isinstance(error, BeatfieldError) else ():
            error.add_note(f"{word}: {text}")
        raise
    seconds = time.perf_counter() - clock
    ended = datetime.now(UTC).isoformat(timespec="seconds")
    figures_of_run = (round(seconds, 3), round(memory.megabytes()), ended)
    measured = dict(zip(MEASURED, figures_of_run, strict=True))
    run.stages[stage.name] = _entry(run, stage.name, "done", figures, key, measured)
    _record(run, "running")
    run.watcher.ended(stage.name, "done", seconds)


def _require_as_it_was(run: _Run, stage: Stage, target: Path) -> None:
    """Let no product stand whose bytes are others than were sealed. It is not made anew unasked:
    labels may have been corrected by hand."""
    clock = time.perf_counter()
    try:
        require_unaltered(target)
    except InputError as error:
        _fail(run, stage, error, time.perf_counter() - clock)
        raise


def _is_settled(run: _Run, stage: Stage) -> bool:
    """Whether an earlier run made of the same what there is to make, if only a reason for none."""
    key, standing = _fingerprint(run, stage), sealed(run.products / stage.name)
    if standing:
        return bool(standing["fingerprint"] == key)
    return _skipped_before(run, stage, key) is not None


def _require_ultrasound(run: _Run, register: Stage, force: bool) -> None:
    """Refuse at once what the stage register would refuse minutes later, if it is to run."""
    if run.study.us is None or (not force and _is_settled(run, register)):
        return
    module = importlib.import_module(f"pipeline.stages.{register.name}")
    clock = time.perf_counter()
    try:
        module.require_usable(run.study, run.settings.register_)
    except BeatfieldError as error:
        run.watcher.started(register.name)
        _fail(run, register, error, time.perf_counter() - clock)
        raise


def _fail(run: _Run, stage: Stage, error: Exception, seconds: float) -> None:
    """Record that a stage failed, and say what of earlier runs is no longer to be used."""
    standing = _all_stages(run)
    later = [one.name for one in STAGES[STAGES.index(stage) :]]
    left = [name for name in later if (run.products / name).is_dir()]
    ended = {"cause": str(error), "seconds": round(seconds, 3)}
    run.stages[stage.name] = {"status": "failed", **ended}
    run.watcher.ended(stage.name, "failed", seconds)
    _record(run, "failed")
    _warn_of(run, [name for name in left if standing.get(name, {}).get("status") != "done"], error)


def _warn_of(run: _Run, old: list[str], error: BaseException) -> None:
    """Say which products an earlier run left, of stages that this one did not come to."""
    if old:
        error.add_note(
            f"{', '.join(old)} in {run.products} came of an earlier run with other input or "
            f"settings; {NOT_TO_BE_USED}"
        )


def _all_stages(run: _Run) -> dict[str, dict[str, Any]]:
    """What this run did, and what stands of the stages that it has not come to.

    What was made from a product that no longer holds does not hold either.
    """
    stages: dict[str, dict[str, Any]] = {}
    for stage in STAGES:
        holds = all(stages.get(one, {}).get("status") in ("done", "skipped") for one in stage.after)
        entry = run.stages.get(stage.name) or _standing(run, stage, holds)
        if entry:
            stages[stage.name] = entry
    return stages


def _standing(run: _Run, stage: Stage, holds: bool) -> dict[str, Any] | None:
    """What an earlier run left of a stage: its product, done or stale, or why there is none.

    ``holds`` says that nothing which it was made from is to be made anew.
    """
    key = _fingerprint(run, stage)
    standing = sealed(run.products / stage.name)
    if standing is None:
        return _skipped_before(run, stage, key) if holds else None
    made_from = standing["fingerprint"]
    status = "done" if holds and made_from == key else "stale"
    return _entry(run, stage.name, status, standing["figures"], made_from)


def _skipped_before(run: _Run, stage: Stage, key: str) -> dict[str, Any] | None:
    """What an earlier run said of a stage that had nothing to do, if that was of the same."""
    earlier = _earlier(run, stage.name)
    same = earlier.get("status") == "skipped" and earlier.get("fingerprint") == key
    return dict(earlier) if same and isinstance(earlier.get("cause"), str) else None


def _execute(run: _Run, stage: Stage, target: Path, key: str) -> dict[str, Any]:
    module = importlib.import_module(f"pipeline.stages.{stage.name}")
    for name in stage.after:
        require_unaltered(run.products / name)
    with publishing(target) as folder:
        inputs = {kind: run.inputs[kind] for kind in stage.inputs}
        reasons, settings = _reasons(run, stage), _settings_of(run, stage)
        about = run.watcher.progress, inputs, key, reasons
        job = Job(run.study, run.settings, run.products, folder, *about)
        figures: dict[str, Any] = module.run(job)
        _require_inputs_of_the_start(run, stage)
        seal(folder, key, figures, settings)
    return figures


def _require_inputs_of_the_start(run: _Run, stage: Stage) -> None:
    """Refuse what was made of files that changed since the run began: a later run with the files
    of the start would take it for theirs."""
    now = run.study.input_digests(stage.inputs)
    for kind in stage.inputs:
        changed = dict(run.inputs[kind].items() ^ now[kind].items())
        if changed:
            raise InputError(
                f"{run.study.folder / min(changed)}: changed while the study ran, so nothing is "
                f"made of it by the stage {stage.name}, which needs the files that the run began "
                "with; wait until nobody writes to the study, then run it again"
            )


def _reasons(run: _Run, stage: Stage) -> dict[str, str]:
    """Why stages before this one made nothing, if it tells that."""
    before = stage.after if stage.repeats_reasons else ()
    entries = {name: run.stages.get(name) or _earlier(run, name) for name in before}
    skipped = {name: one for name, one in entries.items() if one.get("status") == "skipped"}
    return {name: str(one.get("cause")) for name, one in skipped.items()}


def _fingerprint(run: _Run, stage: Stage) -> str:
    before = {name: sealed(run.products / name) for name in stage.after}
    return fingerprint(
        {
            "stage": stage.name,
            "patient_id": run.study.patient_id,
            "inputs": {kind: run.inputs[kind] for kind in stage.inputs},
            "study": _described(run.study, stage),
            "settings": _settings_of(run, stage),
            # What a stage noticed stands among its figures alone, and later ones repeat it.
            "before": {
                name: one and (one["files"], one["figures"]) for name, one in before.items()
            },
            "reasons": _reasons(run, stage),
            "code": code_digest(f"pipeline.stages.{stage.name}"),
            "libraries": library_versions(),
        }
    )


def _settings_of(run: _Run, stage: Stage) -> dict[str, Any]:
    """The sections that a stage reads."""
    settings = run.settings.model_dump(mode="json", by_alias=True)
    return {name: settings[name] for name in stage.settings}


def _described(study: Study, stage: Stage) -> dict[str, Any]:
    """What ``study.yaml`` says beyond file names, for the stages that read it."""
    says: dict[str, Any] = {}
    if "cine" in stage.inputs:
        says["rr_ms"] = study.cine.rr_ms
        says["leave_out_series"] = study.cine.leave_out_series
        says["fill_gaps"] = study.cine.fill_gaps
        says["spoilt_slices"] = study.cine.spoilt_slices
    if "us" in stage.inputs and study.us:
        says["us"] = study.us.model_dump(exclude={"sweeps"})
    return says


def _earlier_stages(products: Path) -> Mapping[str, Any]:
    stages = read_record(products).get("stages")
    return stages if isinstance(stages, dict) else {}


def _earlier(run: _Run, name: str) -> Mapping[str, Any]:
    entry = run.before.get(name)
    return entry if isinstance(entry, dict) else {}


def _entry(
    run: _Run,
    name: str,
    status: str,
    figures: Mapping[str, Any],
    key: str,
    measured: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Describe a finished stage; one that was not run again keeps the timing of when it was."""
    if measured is None:
        earlier = _earlier(run, name)
        same = earlier.get("fingerprint") == key
        measured = {k: earlier.get(k) if same else None for k in MEASURED}
    return {"status": status, "fingerprint": key, **measured, "figures": dict(figures)}


def _record(run: _Run, status: str) -> dict[str, Any]:
    from pipeline import __version__

    content = {
        "patient_id": run.study.patient_id,
        "study": str(run.study.folder),
        "status": status,
        "versions": {
            "beatfield": __version__,
            "python": platform.python_version(),
            **library_versions(),
        },
        "code": {stage.name: code_digest(f"pipeline.stages.{stage.name}") for stage in STAGES},
        "networks": network_digests(),
        "settings": run.settings.model_dump(mode="json", by_alias=True),
        "inputs": run.inputs,
        "stages": _all_stages(run),
    }
    write_json(run.products / "run.json", content)
    return content
