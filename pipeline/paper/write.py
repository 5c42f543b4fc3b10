"""Make the page of the paper's experiments: the parts in order, and the files they become."""

from __future__ import annotations

import base64
import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipeline.errors import InputError
from pipeline.paper import dissection, laws, robustness
from pipeline.paper.constrained_motion import constrained_motion
from pipeline.paper.options import PaperOptions
from pipeline.paper.reader_time import reader_time
from pipeline.paper.slice_through_the_beat import slice_through_the_beat
from pipeline.paper.subject import Subject, open_subject
from pipeline.paper.torus_tool import torus_tool
from pipeline.progress import Progress
from pipeline.publish import publishing
from pipeline.report.page import Section, filled
from pipeline.report.style import own_style
from pipeline.study import open_study

Make = Callable[[Subject, int, int, Progress], Section]

MARK = "paper.txt"


class Watcher(Protocol):
    """Told of the course of a long work."""

    def started(self, stage: str) -> None:
        """A part begins."""

    def progress(self, done: int, total: int) -> None:
        """How far it is."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """One part of the page."""

    make: Make
    """From subject, seed, number of operators and progress."""

    what: str
    """What of the paper it repeats."""

    paper: str
    """What the paper shows."""

    here: str
    """What is shown here beyond that."""

    needs_images: bool = False
    needs_ultrasound: bool = False


EXPERIMENTS: Mapping[str, Experiment] = {
    "figure-2": Experiment(
        lambda subject, seed, operators, progress: laws.effect_of_m(subject),
        "Figure 2, Eq. 1 and 2",
        "potential and force for rising m; a large m nears an on-off switch",
        "also read from the baked field; steepest slope measured beside the analytic one",
    ),
    "figure-3": Experiment(
        lambda subject, seed, operators, progress: laws.effect_of_widths(),
        "Figure 3",
        "effect of gamma and delta on the workspace",
        "also what each haptic device can render by its stiffness",
    ),
    "figure-4": Experiment(
        lambda subject, seed, operators, progress: slice_through_the_beat(subject),
        "Figure 4",
        "a slice of the heart and its potential field",
        "through the beat, on the MR slice, lines in mm",
        needs_images=True,
    ),
    "figure-5": Experiment(
        dissection.dissection,
        "Figure 5, Table 1",
        "3'31\" without, 1'30\" with force; 3'45\" without, 1'26\" with",
        "simulated operators: times, contacts, depth, energy, 95 % intervals",
    ),
    "sensitivity": Experiment(
        dissection.sensitivity,
        "(not in the paper)", "-", "which parameters of an operator matter",
    ),
    "figure-6": Experiment(
        lambda subject, seed, operators, progress: constrained_motion(subject),
        "Figure 6",
        "constrained motion on the beating surface, on ultrasound",
        "with and without the fixture, as a strip and moving, force drawn",
        needs_images=True, needs_ultrasound=True,
    ),
    "figure-7": Experiment(
        lambda subject, seed, operators, progress: torus_tool(subject, seed),
        "Figure 7",
        "a torus of segments on the surface",
        "force error and time against segments, beside adaptive division",
    ),
    "future-work": Experiment(
        robustness.future_work,
        "Future work",
        "robust registration in space and time is asked for",
        "force error against errors in space and time; loss of ECG and ultrasound",
    ),
    "time": Experiment(
        lambda subject, seed, operators, progress: reader_time(subject, seed),
        "1 kHz", "-", "the reader's time for a tick, percentiles to 99.99 %",
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Part:
    """A finished experiment under its name."""

    name: str
    experiment: Experiment
    section: Section
    command: str


@own_style()
def write_paper(out: Path, options: PaperOptions, watcher: Watcher) -> Path:
    """Write ``index.html``, and every figure and table as a file of its own, into ``out``.

    Parameters
    ----------
    out
        A folder that does not exist yet, or that this function wrote.
    watcher
        Told which part is made, and how far it is.

    Returns
    -------
    The page.

    Raises
    ------
    InputError
        When the folder holds something else, a name is unknown, the field is not fit, or the study
        is none.
    """
    _require_ours(out)
    _require_sensible(options)
    subject = open_subject(options.products, options.resolved_study())
    if subject.study is not None:
        # Refused before minutes are spent on what comes before it.
        open_study(subject.study)
    parts, notes = [], []
    for name, experiment in EXPERIMENTS.items():
        if options.only and name not in options.only:
            continue
        lacking = _lacking(experiment, subject)
        if lacking:
            notes.append(f"{experiment.what} is left out: {lacking}.")
            continue
        watcher.started(name)
        section = experiment.make(subject, options.seed, options.operators, watcher.progress)
        parts.append(Part(name, experiment, section, f"{options.command()} --only {name}"))
    with publishing(out) as folder:
        (folder / MARK).write_text("written by beatfield paper\n")
        (folder / "index.html").write_text(
            render(subject, parts, notes), encoding="utf-8", errors="backslashreplace"
        )
        for part in parts:
            _write_files(folder, part)
    return out / "index.html"


def _require_sensible(options: PaperOptions) -> None:
    unknown = sorted(set(options.only) - set(EXPERIMENTS))
    if unknown:
        raise InputError(f"--only {unknown[0]}: no such part; there are {', '.join(EXPERIMENTS)}")
    if options.operators < 2:
        raise InputError(f"--operators {options.operators}: an interval needs at least 2")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must be 0 or more")


def _require_ours(out: Path) -> None:
    if out.exists() and not (out / MARK).is_file():
        raise InputError(f"{out}: exists and was not written by this command; choose another place")


def _lacking(experiment: Experiment, subject: Subject) -> str | None:
    if experiment.needs_images and subject.products is None:
        return "it needs a patient's products, and a field alone was given"
    if not experiment.needs_ultrasound:
        return None
    if subject.study is None:
        return "it needs the study's ultrasound frames (--study)"
    assert subject.products is not None
    if subject.field.mr_from_tracker is None or not (subject.products / "register").is_dir():
        return "the study has no registered ultrasound"
    return None


def render(subject: Subject, parts: Sequence[Part], notes: Sequence[str]) -> str:
    """The page as HTML; text is escaped."""
    source, folder = str(subject.field_path), Path(__file__).parent
    return filled(folder, source=source, notes=notes, parts=parts)


def _write_files(folder: Path, part: Part) -> None:
    """``NAME-<k>.svg`` or ``.webp`` and ``NAME-table-<k>.csv``."""
    for number, shown in enumerate(part.section.pictures, start=1):
        head, coded = shown.source.split(",", 1)
        ending = "svg" if "svg" in head else head.split("/")[1].split(";")[0]
        (folder / f"{part.name}-{number}.{ending}").write_bytes(base64.b64decode(coded))
    for number, table in enumerate(part.section.tables, start=1):
        with (folder / f"{part.name}-table-{number}.csv").open(
            "w", newline="", encoding="utf-8"
        ) as handle:
            lines = csv.writer(handle, lineterminator="\n")
            lines.writerow(table.head)
            lines.writerows(table.rows)
