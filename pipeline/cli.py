"""The command line: the only part that prints (with `pipeline.console`) and ends the program.

Exit codes: 0 done, 1 a stage failed, 2 the input or the command is wrong, 130 interrupted, 141
nobody reads what is printed any more.
Heavy libraries are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from pipeline import __version__
from pipeline.caches import provide_place
from pipeline.console import (
    BatchConsole,
    Console,
    Whole,
    in_one_line,
    say,
    show,
    tell,
    warning_line,
)
from pipeline.ending import guarded, hear_signals
from pipeline.errors import INTERRUPTED_CODE, NOT_TO_BE_USED, BeatfieldError, InputError
from pipeline.paper.options import PAPER, PaperOptions
from pipeline.summary import summary

HELP = "From a patient's cine MR to a force field that a haptic robot can feel."

app = App(
    name="beatfield",
    version=__version__,
    help=HELP,
    help_format="plaintext",
    result_action="return_value",
    # Said by `guarded`, in the program's own words.
    suppress_keyboard_interrupt=False,
)

STUDY = "folder of the study: cine/, and where there are any ecg/, us/, study.yaml"
Out = Annotated[Path, Parameter(help="folder for the products; each patient gets one in it")]
Config = Annotated[Path | None, Parameter(help="YAML file of settings; defaults without it")]


def _run(
    study: Path, out: Path, config: Path | None, first: str | None = None, last: str | None = None
) -> None:
    from pipeline.config import read_settings
    from pipeline.publish import standing_products
    from pipeline.run import run_study
    from pipeline.study import open_study

    try:
        settings, opened = read_settings(config), open_study(study)
    except InputError as error:
        for products in standing_products(_meant(study), out):
            error.add_note(f"{products} holds products of another run; {NOT_TO_BE_USED}")
        raise
    record = run_study(opened, settings, out, Console(), first, last)
    show(summary(record, out / record["patient_id"]))


def _meant(folder: Path) -> Path:
    """A study that may not be understood: the folder, or the only study in it; of several none is
    meant."""
    from pipeline.study import is_study, studies_in

    # Where they cannot be looked at, that is not what is to be told.
    with suppress(OSError):
        if folder.is_dir() and not is_study(folder) and len(inside := studies_in(folder)) == 1:
            return inside[0]
    return folder


def _stage_name(name: str | None) -> str | None:
    from pipeline.run import STAGE_NAMES

    if name is not None and name not in STAGE_NAMES:
        raise InputError(f"no stage {name!r}; the stages are {', '.join(STAGE_NAMES)}")
    return name


def _require_order(first: str | None, last: str | None) -> None:
    from pipeline.run import STAGE_NAMES

    if first and last and STAGE_NAMES.index(first) > STAGE_NAMES.index(last):
        raise InputError(
            f"--from {first} comes after --until {last}: no stage would be run again; the stages "
            f"are, in order, {', '.join(STAGE_NAMES)}"
        )


@app.command
def run(
    study: Annotated[Path, Parameter(help=STUDY)],
    /,
    *,
    out: Out,
    config: Config = None,
    from_: Annotated[str | None, Parameter(name="--from")] = None,
    until: str | None = None,
) -> int:
    """Run all stages of one patient's study; finished ones that still hold are not run again.

    Parameters
    ----------
    from_
        Run this stage and those after it even if nothing changed: ingest, segment, surface,
        register, bake, evaluate or report.
    until
        End after this stage, one of the same.
    """
    first, last = _stage_name(from_), _stage_name(until)
    _require_order(first, last)
    _run(study, out, config, first, last)
    return 0


def _stage_command(name: str, help_text: str) -> None:
    def command(
        study: Annotated[Path, Parameter(help=STUDY)], /, *, out: Out, config: Config = None
    ) -> int:
        _run(study, out, config, last=name)
        return 0

    command.__doc__ = help_text + ", bringing the stages before it up to date."
    app.command(command, name=name)


for _name, _help in {
    "ingest": "Read the cine",
    "segment": "Label chambers and heart muscle",
    "surface": "Extract the moving surfaces",
    "register": "Bring tracked ultrasound to the MR",
    "evaluate": "Measure the products against truth",
    "report": "Write the page that shows what happened",
}.items():
    _stage_command(_name, _help)


@app.command
def bake(
    study: Path | None = None,
    /,
    *,
    out: Out,
    surfaces: Path | None = None,
    config: Config = None,
) -> int:
    """Bake the force field of a study, or of closed surfaces of one's own.

    Parameters
    ----------
    study
        Folder of the study; the stages before are brought up to date.
    surfaces
        Folder of closed surfaces in LPS mm (VTP, STL, PLY), named STRUCTURE_000, STRUCTURE_001,
        ..., one a phase; optional phases.json. Writes OUT/field.zarr.
    """
    if (study is None) == (surfaces is None):
        raise InputError("bake needs either a STUDY or --surfaces FOLDER")
    if study is not None:
        _run(study, out, config, last="bake")
        return 0
    assert surfaces is not None
    from pipeline.config import read_settings
    from pipeline.own_surfaces import bake_own_surfaces, what_was_baked

    settings = read_settings(config, own_surfaces=True)
    field = bake_own_surfaces(surfaces, out, settings, Console().progress)
    show(f"field     {field}")
    show("\n".join(what_was_baked(field)))
    return 0


@app.command
def batch(
    studies: Path,
    /,
    *,
    out: Out,
    workers: Whole = 1,
    config: Config = None,
    until: str | None = None,
    shard: str = "1/1",
) -> int:
    """Run a folder of studies, each in a process of its own; print and write a table of all.

    An interrupt begins no other study; the table then has what ended. Logs are in OUT/logs.

    Parameters
    ----------
    studies
        Folder whose subfolders are studies.
    workers
        How many studies to run at a time.
    until
        End each study's run after this stage: ingest, segment, surface, register, bake, evaluate or
        report.
    shard
        Run only a part, as one of several machines that write into one OUT: 2/4 is the second of
        four, with a table of its own, OUT/batch-2-of-4.csv.
    """
    from pipeline.batch import run_batch
    from pipeline.batch_plan import Shard
    from pipeline.batch_table import NO_STUDY, table
    from pipeline.config import read_settings

    if workers < 1:
        raise InputError(f"--workers {workers}: at least 1 is needed")
    part = Shard.parse(shard)
    # What is wrong with the settings is wrong for every study, and is said once.
    read_settings(config)

    ended = run_batch(studies, out, workers, config, BatchConsole(), _stage_name(until), part)
    show(table(ended.outcomes))
    for note in ended.notes:
        show(f"note      {note}")
    show(f"products  {out}/<patient id>")
    if ended.unwritten:
        raise ended.unwritten
    show(f"table     {ended.table}")
    if ended.interrupted:
        return INTERRUPTED_CODE
    return 0 if all(one.status in ("done", NO_STUDY) for one in ended.outcomes) else 1


def _tell_doubts(doubts: Iterable[str]) -> None:
    for text in doubts:
        show(f"doubtful  {in_one_line(text)}")


def _tell_if_stale(field: Path) -> None:
    from pipeline.publish import stale_words

    if words := stale_words(field):
        say(f"note: {words}")


@app.command
def query(
    field: Path,
    /,
    *,
    point: Annotated[tuple[float, float, float], Parameter(negative="")],
    phase: float,
    fixture: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Ask a baked field for distance, potential and force at a point.

    Parameters
    ----------
    field
        The field.zarr folder.
    point
        X Y Z in LPS mm of the MR frame.
    phase
        Share of the heartbeat since the R peak, below 10: only its fraction counts, 1.25 is 0.25.
    fixture
        Only this fixture; all of them without it.
    as_json
        Print JSON.
    """
    from pipeline.field.query import limits_words, query_inside

    answers = query_inside(field, point, phase, fixture)
    _tell_if_stale(field)
    if as_json:
        show(json.dumps(answers))
        return 0
    for name, answer in answers.items():
        # No force has no sign.
        force = " ".join(f"{round(value, 4) + 0.0:+.4f}" for value in answer["force_n"])
        show(
            f"{name}: distance {answer['distance_mm']:+.3f} mm, "
            f"potential {answer['potential']:.4f}, force {force} N{limits_words(answer)}"
        )
    return 0


@app.command
def verify(fields: list[Path], /, *, surfaces: Path | None = None) -> int:
    """Check baked fields: manifest, sizes, checksums, metadata, finite values.

    What a whole field says that speaks against it is printed, and no failure.

    Parameters
    ----------
    fields
        The field.zarr folders; the exit code is that of the worst.
    surfaces
        Folder of the surfaces it was baked from: its accuracy is measured anew against them.
    """
    if surfaces is not None and len(fields) > 1:
        raise InputError(f"--surfaces {surfaces}: is of one field, and {len(fields)} are given")
    worst = 0
    for field in fields:
        try:
            _verify(field, surfaces)
        except BeatfieldError as error:
            worst = max(worst, tell(error))
    return worst


def _verify(field: Path, surfaces: Path | None) -> None:
    from pipeline.field.verify import certificate_rows, verify_field

    whole = verify_field(field)
    show(f"{field}: {whole}")
    _tell_doubts(whole.doubts)
    _tell_if_stale(field)
    if surfaces is not None:
        from pipeline.own_surfaces import measure_field

        measured = measure_field(field, surfaces, Console().progress)
        for name, text in certificate_rows(measured):
            show(f"{name:36} {text}")


@app.command
def export(field: Path, /, *, to: str, out: Path | None = None) -> int:
    """Write a baked field's distances and potentials for other programs.

    Parameters
    ----------
    field
        The field.zarr folder.
    to
        nrrd (3D Slicer sequences), nifti, vti (ParaView), mhd (headers that point into the field,
        without a copy) or sofa (raw distance grids).
    out
        Folder to write; must not exist. By default field-FORMAT, where you are.
    """
    from pipeline.field.export import export_field, lost_in
    from pipeline.field.files import read_metadata
    from pipeline.field.verify import told_doubts

    show(f"exported  {export_field(field, to, out or Path(f'field-{to}'))}")
    # No other format has room for them.
    _tell_doubts(told_doubts(read_metadata(field).source))
    _tell_if_stale(field)
    if lost := lost_in(field, to):
        show(f"note      {lost}")
    return 0


@app.command
def rpeaks(record: Path, /, *, out: Path) -> int:
    """Find the R peaks of an electrocardiogram, as a stream would show them.

    Writes a row for each beat: R time (s, on the recording's clock), kind,
    whether the phase was valid, best lead, RR interval, likeness to other beats,
    when it became known, and whether its shape is unlike the others'.

    Parameters
    ----------
    record
        A WFDB record (its path with or without ending), a .csv table or a DICOM waveform file.
    out
        CSV file to write.
    """
    from pipeline.imaging.ecg import read_ecg
    from pipeline.registration.rhythm import doubt, read_rhythm, write_rhythm
    from pipeline.study_files import is_of_record

    if is_of_record(out, record):
        raise InputError(f"--out {out}: is the recording itself; choose another name for the table")
    ecg = read_ecg(record, gaps=True)
    lasts_s, leads = len(ecg.signal_mv) / ecg.sampling_rate_hz, ", ".join(ecg.leads)
    # Compiling, the first time, takes longer than most records.
    show(f"record    {lasts_s:.1f} s at {ecg.sampling_rate_hz:g} Hz: {leads}")
    try:
        beats = read_rhythm(ecg.signal_mv, ecg.sampling_rate_hz)
    except InputError as error:
        raise InputError(f"{record}: {error}") from error
    write_rhythm(out, beats, ecg.leads, ecg.start_s)
    ectopic, irregular = (sum(one.kind == k for one in beats) for k in ("ectopic", "irregular"))
    show(f"beats     {len(beats)}, {ectopic} ectopic, {irregular} irregular")
    if said := doubt(beats):
        show(f"doubtful  {said}")
    show(f"table     {out}")
    return 0


@app.command(help_flags=(), version_flags=())
def synth(*arguments: Annotated[str, Parameter(allow_leading_hyphen=True, show=False)]) -> int:
    """Make synthetic patient studies: beatfield synth OUT [--seed N] [--preview] ...

    `beatfield synth --help` lists all options.
    """
    # A process of its own: the pipeline does not know the code that makes its test data. Nor does
    # it look for it in the folder in which the user happens to be (-P).
    with subprocess.Popen([sys.executable, "-P", "-m", "data_synth", *arguments]) as child:
        try:
            code = child.wait()
        except KeyboardInterrupt:
            # It clears away what is half-done, which takes it a moment.
            child.terminate()
            child.wait()
            raise
    if code < 0:
        say(f"error: the process that makes studies was ended by signal {-code}")
        return 128 - code
    return code


@app.command
def paper(out: Path, /, options: Annotated[PaperOptions, Parameter(name="*")] = PAPER) -> int:
    """Repeat the paper's figures and table from a baked field.

    Parameters
    ----------
    out
        Folder for index.html and its figures.
    """
    from pipeline.paper.write import write_paper

    show(f"page      {write_paper(out, options, Console())}")
    return 0


def _require_no_empty(arguments: Sequence[str]) -> None:
    """An empty path would be the folder in which the user happens to be."""
    for before, one in pairwise(("", *arguments)):
        name, equals, value = one.partition("=")
        if not one or (name.startswith("--") and equals and not value):
            option = name or (before if before.startswith("--") else "")
            where = option or (f"what follows {before}" if before else "the first argument")
            raise InputError(
                f"{where}: is empty, as where a variable of the shell has no value; give it a value"
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code."""
    hear_signals()
    warnings.formatwarning = warning_line

    given = sys.argv[1:] if arguments is None else arguments

    def command() -> Any:
        _require_no_empty(given)
        provide_place()
        _settle_libraries()
        return app(arguments, exit_on_error=False, print_error=True)

    return guarded(command)


def _settle_libraries() -> None:
    """No picture needs a window, and nothing works without the compiler.

    Raises
    ------
    InputError
        When the environment turns the compiler off.
    """
    os.environ["MPLBACKEND"] = "agg"
    if os.environ.get("NUMBA_DISABLE_JIT", "0").strip() not in ("", "0"):
        raise InputError("NUMBA_DISABLE_JIT turns the compiler off, which is needed; unset it")
    threads = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    if threads.startswith("-") or threads == "0":
        raise InputError(f"NUMBA_NUM_THREADS is {threads}; give 1 or more, or unset it")


if __name__ == "__main__":
    sys.exit(main())
