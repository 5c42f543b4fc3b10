"""The program where no developer sits: other users, closed terminals, names of any kind."""

from __future__ import annotations

import csv
import io
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_synth.errors import SynthError
from data_synth.settings import PhantomSettings
from data_synth.study import write_study
from pipeline import caches, compiled
from pipeline.batch_plan import Plan
from pipeline.batch_table import outcome_of, write_table
from pipeline.console import BatchConsole, Console, plain, show
from pipeline.ending import guarded
from pipeline.errors import InputError
from pipeline.imaging.metaimage import read_metaimage
from pipeline.meshes import read_mesh
from pipeline.publish import locked
from pipeline.regular_files import require_text_name
from pipeline.report import pictures
from pipeline.study import open_study

ROOT = Path(__file__).parents[1]
BEATFIELD = [sys.executable, "-m", "pipeline"]


def nowhere(*_: object, **__: object) -> Path:
    raise RuntimeError("Could not determine home directory.")


def a_package_that_may_not_be_written(root: Path) -> Path:
    package = root / "package"
    package.mkdir()
    (package / "one.py").write_text("")
    (package / "__pycache__").write_text("no folder")
    return package


@pytest.mark.parametrize("home", [None, "a file"])
def test_a_user_without_a_home_compiles_in_a_folder_of_the_run(tmp_path, monkeypatch, home):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "a file").write_text("")
    monkeypatch.setattr(Path, "home", nowhere if home is None else lambda: tmp_path / home)
    caches.place_of_this_run.cache_clear()
    place = compiled._place.__wrapped__(a_package_that_may_not_be_written(tmp_path))
    caches.place_of_this_run.cache_clear()
    assert place.parent == tmp_path
    # Stored code is run: nobody else may put some there.
    assert place.stat().st_mode & 0o077 == 0


def test_where_nothing_may_be_written_it_is_said_what_to_give(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))
    (tmp_path / "a file").write_text("")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    caches.place_of_this_run.cache_clear()
    with pytest.raises(InputError, match=r"kept nowhere .*XDG_CACHE_HOME or TMPDIR"):
        compiled._place.__wrapped__(a_package_that_may_not_be_written(tmp_path))


@pytest.mark.parametrize("given", [None, ""])
@pytest.mark.parametrize("home", [None, "a file", "home"])
def test_a_compiler_that_would_find_no_place_is_given_one(tmp_path, monkeypatch, given, home):
    monkeypatch.setenv(caches.PLACE, "")
    if given is None:
        monkeypatch.delenv(caches.PLACE)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "a file").write_text("")
    monkeypatch.setattr(Path, "home", nowhere if home is None else lambda: tmp_path / home)
    caches.place_of_this_run.cache_clear()
    caches.provide_place()
    assert not os.environ.get(caches.PLACE)
    monkeypatch.setattr("os.access", lambda *_: False)
    caches.provide_place()
    place = os.environ.get(caches.PLACE)
    caches.place_of_this_run.cache_clear()
    assert bool(place) == (home != "home")
    assert not place or Path(place).parent == tmp_path
    monkeypatch.setenv(caches.PLACE, "the user's own")
    caches.provide_place()
    assert os.environ[caches.PLACE] == "the user's own"


@pytest.mark.parametrize(("ends", "code"), [(">&-", 0), ("<&- >&- 2>&-", 0), ("> /dev/full", 2)])
def test_closed_or_full_outputs_end_without_a_traceback(ends: str, code: int) -> None:
    command = f"'{sys.executable}' -m pipeline --version {ends}"
    ended = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == code
    assert "Traceback" not in ended.stderr


def test_memory_that_is_not_enough_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    def greedy() -> int:
        raise MemoryError("Unable to allocate 12 GiB")

    assert guarded(greedy) == 1
    assert "error: memory is not enough (Unable to allocate 12 GiB)" in capsys.readouterr().err


def test_a_folders_name_commands_no_terminal(tmp_path: Path) -> None:
    study = tmp_path / "s\x1b]0;mine\x07\x1b[2J\u202e"
    (study / "cine").mkdir(parents=True)
    command = [*BEATFIELD, "ingest", str(study), "--out", str(tmp_path / "out")]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "s\\x1b]0;mine\\x07\\x1b[2J\\u202e: its name is no" in ended.stderr
    assert plain("two\n\tlines: 5 µm") == "two\n\tlines: 5 µm"


def test_a_batch_says_how_long_it_will_take(
    monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = iter((0.0, 120.0, 480.0, 500.0))
    monkeypatch.setattr("pipeline.console.time.monotonic", lambda: next(now_s))
    told = BatchConsole()
    outcome = outcome_of(Plan("anna", Path("/studies/anna"), "p-1"), "done", "").outcome
    for done in (1, 4, 5):
        told.ended(outcome, done, 5)
    one, four, five = capsys.readouterr().err.splitlines()
    assert one.endswith("s, about 8 min to go")
    assert four.endswith("s, about 2 min to go")
    assert "to go" not in five


def test_what_a_library_warns_of_commands_no_terminal() -> None:
    """As DICOM files do that name a character set which nobody knows."""
    program = (
        "import warnings; from pipeline.cli import main; main(['--version']); "
        "warnings.warn('Unknown encoding \x1b[2J')"
    )
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.stderr == "warning: Unknown encoding \\x1b[2J\n"


def test_how_a_run_goes_commands_no_terminal_and_goes_to_no_other_stream(monkeypatch, capsys):
    console = Console()
    console.ended("register", "skipped: \x1b[2J", 0.0)
    assert capsys.readouterr().err == "register  skipped: \\x1b[2J\n"
    monkeypatch.setattr(sys, "stderr", None)
    console.started("bake")
    assert capsys.readouterr().out == ""


def test_a_terminal_of_few_letters_is_shown_the_others_numbers(tmp_path: Path) -> None:
    program = f"from pipeline.console import {show.__name__}; show('\xe9\\x1b')"
    plainest = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, cwd=ROOT, env=plainest, capture_output=True, check=False)
    assert ended.stdout == b"\\xe9\\x1b\n"


def test_files_are_read_and_written_alike_whatever_letters_the_system_knows(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from pipeline import products, sealing; "
        "sealing.code_digest('pipeline.stages.ingest'); "
        "row = products.FrameRow('us-\\xe9', 0, 0.0, 0.0, 0.0, True); path = Path(sys.argv[1]); "
        "products.write_frames(path, [row]); "
        "assert products.read_frames(path) == [row]"
    )
    bare = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-c", program, str(tmp_path / "frames.csv")]
    ended = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **bare}, capture_output=True, check=False
    )
    assert ended.stderr == b""
    assert "us-é" in (tmp_path / "frames.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@SUM(A1)"])
def test_a_spreadsheet_runs_no_folders_name(tmp_path: Path, name: str) -> None:
    outcome = outcome_of(Plan(name, Path("/studies") / name, "p-1"), "failed", "=cause").outcome
    assert write_table(tmp_path / "batch.csv", [outcome]) is None
    with (tmp_path / "batch.csv").open(newline="") as handle:
        [row] = csv.DictReader(handle)
    assert (row["patient"], row["cause"], row["patient_id"]) == (f"'{name}", "'=cause", "p-1")


def test_an_out_whose_name_is_too_long_is_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"cannot be written .File name too long"),
        locked(tmp_path / ("x" * 300)),
    ):
        pass


def test_a_sweeps_name_is_no_formula() -> None:
    figure = pictures.cuts_on_ultrasound(
        [np.zeros((4, 4))], ["a$\\frac{$, frame 3"], np.eye(4)[None], np.zeros(1), {}
    )
    figure.savefig(io.BytesIO())
    assert figure.axes[0].get_title() == "a$\\frac{$, frame 3, phase 0.00"


def made(*words: str) -> str:
    """What `make` would do, everything being set up."""
    command = ["make", "-n", "-o", ".venv/ready", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_make_takes_names_with_spaces_and_all_that_a_shell_obeys(tmp_path: Path) -> None:
    study, out = tmp_path / 'with spaces; $$(touch x) "quoted"', tmp_path / "my products" / "new"
    for target in ("demo", "ingest"):
        said = made(target, f"STUDY={study}", f"OUT={out}")
        assert "synth" not in said
        assert '"$STUDY" --out "$OUT"' in said
    assert str(study) not in made("demo", f"STUDY={study}")
    assert 'mkdir -p "$OUT"' in made("demo", f"OUT={out}")


def test_a_place_for_compiled_code_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / "a file").write_text("")
    monkeypatch.setenv(caches.PLACE, str(tmp_path / "a file" / "numba"))
    with pytest.raises(InputError, match=rf"a file/numba: {caches.PLACE} names it .*unset that"):
        caches.provide_place()
    monkeypatch.setenv(caches.PLACE, str(tmp_path / "numba"))
    caches.provide_place()
    assert (tmp_path / "numba").is_dir()


def test_a_place_that_takes_empty_files_alone_is_none(tmp_path):
    """As a full disk does; here by the limit of a file's length."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    assert caches.is_writable(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        writable = caches.is_writable(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not writable


def test_code_in_the_folder_where_the_user_is_is_not_run(tmp_path):
    for name in ("random", "pipeline", "data_synth", "yaml"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('mine')\n")
    command = [sys.executable, "-P", "-m", "pipeline", "synth", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "mine" not in done.stdout + done.stderr
    assert done.returncode == 0
    assert "--seed" in done.stdout


def test_names_that_are_no_text_are_refused_before_a_library_ends_the_program(tmp_path):
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/L\xfctin"))
    (odd / "cine").mkdir(parents=True)
    (odd / "cine" / "one.nii").write_bytes(b"")
    (odd / "us.mha").write_bytes(b"")
    for refused in (open_study, locked_once, read_metaimage, read_mesh):
        path = odd if refused in (open_study, locked_once) else odd / "us.mha"
        with pytest.raises(InputError, match="is no UTF-8 text; rename"):
            refused(path)
    # As Python reads a right name where the shell has no letters but ASCII's.
    with pytest.raises(InputError, match="locale lacks letters"):
        require_text_name(Path(b"caf\xc3\xa9".decode("ascii", "surrogateescape")))
    with pytest.raises(SynthError, match=r"L.xfctin/new: is no UTF-8 text"):
        write_study(odd / "new", PhantomSettings())
    assert not (odd / "new").exists()
    with pytest.raises(SynthError, match="locale lacks letters"):
        write_study(Path(b"caf\xc3\xa9".decode("ascii", "surrogateescape")), PhantomSettings())


def locked_once(folder):
    with locked(folder):
        pass


@pytest.mark.parametrize("module", ["data_synth.training", "data_synth.training.ultrasound"])
def test_training_without_what_it_needs_says_how_to_install_it(tmp_path, module):
    missing = "raise ModuleNotFoundError('No module named torch', name='torch')\n"
    (tmp_path / "torch.py").write_text(missing)
    paths = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-m", module, "--help"],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: training needs torch")
    assert "beatfield[train]" in done.stderr
    assert "Traceback" not in done.stderr
