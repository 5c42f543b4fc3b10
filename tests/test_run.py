"""The runner: whole products or none, nothing done twice, nothing stale, nothing lost.

The stages here are three small ones of the tests' own; what the runner does with them is what it
does with the real ones.
"""

from __future__ import annotations

import ast
import errno
import json
import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from kitchen import Kitchen, Silent

from pipeline import run as runner
from pipeline import sealing
from pipeline.config import Settings
from pipeline.errors import InputError, StageError
from pipeline.job import Job, Skipped
from pipeline.publish import (
    PARTIAL,
    only_run_in,
    publishing,
    readable_write_errors,
    remove_partials,
    write_json,
)
from pipeline.sealing import LIBRARIES, code_digest
from pipeline.study import open_study


@pytest.fixture
def kitchen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kitchen]:
    return Kitchen(tmp_path, monkeypatch)


def test_a_second_run_does_nothing(kitchen: Kitchen) -> None:
    kitchen.run()
    assert kitchen.text("c") == "c(a(first),b(a(first)))"
    first = kitchen.record()
    assert kitchen.run() == dict.fromkeys("abc", "unchanged")
    assert kitchen.calls == []
    assert kitchen.record() == first


def test_a_changed_input_runs_all_that_follows_from_it(kitchen: Kitchen) -> None:
    kitchen.run()
    (kitchen.folder / "cine" / "image").write_text("other")
    kitchen.run()
    assert kitchen.calls == ["a", "b", "c"]
    assert kitchen.text("c") == "c(a(other),b(a(other)))"


def test_what_a_stage_noticed_counts_for_those_that_repeat_it(kitchen: Kitchen) -> None:
    """A header that now says where the images lie changes no image."""
    noticed = {"remarks": ["nowhere"]}

    def first(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text("the same images")
        return dict(noticed)

    def last(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text(" ".join(job.figures("a")["remarks"]))
        return {}

    kitchen.bodies |= {"a": first, "c": last}
    kitchen.run()
    assert kitchen.text("c") == "nowhere"
    (kitchen.folder / "cine" / "image").write_text("mended header")
    noticed["remarks"] = ["all is well"]
    kitchen.run()
    assert kitchen.text("c") == "all is well"


def test_a_changed_setting_runs_only_the_stages_that_read_it(kitchen: Kitchen) -> None:
    kitchen.run()
    changed = Settings.model_validate({"bake": {"spacing_mm": 3.0}})
    assert kitchen.run(changed) == {"a": "unchanged", "b": "done", "c": "unchanged"}
    # b's product came out the same, so c still holds.


@pytest.mark.parametrize(
    "key", ["rr_ms: 800", "fill_gaps: true", "spoilt_slices: [2]", "leave_out_series: [3]"]
)
def test_what_study_yaml_says_of_the_cine_counts_as_input(kitchen: Kitchen, key: str) -> None:
    kitchen.run()
    (kitchen.folder / "study.yaml").write_text(f"cine: {{{key}}}\n")
    assert kitchen.run()["a"] == "done"


def test_another_study_of_the_same_patient_id_replaces_nothing(kitchen: Kitchen) -> None:
    kitchen.run()
    before = kitchen.record()
    other = kitchen.folder.parent.parent / "elsewhere" / "p1"
    (other / "cine").mkdir(parents=True)
    (other / "cine" / "image").write_text("of another patient")
    with pytest.raises(InputError, match=r"holds the products of another study, .*studies/p1"):
        runner.run_study(open_study(other), Settings(), kitchen.out, Silent())
    assert kitchen.record() == before
    # Moved with its images it is the same study.
    (other / "cine" / "image").write_text("first")
    moved = Silent()
    runner.run_study(open_study(other), Settings(), kitchen.out, moved)
    assert moved.outcomes == dict.fromkeys("abc", "unchanged")


@pytest.mark.parametrize("known", [[], {"cine": ["image"]}, {"cine": {"image": []}}, {"cine": {}}])
def test_inputs_in_a_damaged_record_stop_no_run(kitchen: Kitchen, known: Any) -> None:
    """What cannot be compared is no reason to refuse, but other images are: a list is no digest."""
    kitchen.run()
    record = kitchen.record() | {"study": "/elsewhere", "inputs": known}
    (kitchen.out / "p1" / "run.json").write_text(json.dumps(record))
    if known == {"cine": {"image": []}}:
        with pytest.raises(InputError, match=r"products of another study, /elsewhere"):
            kitchen.run()
    else:
        assert kitchen.run() == dict.fromkeys("abc", "unchanged")


def test_changed_code_runs_again(kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch) -> None:
    kitchen.run()
    monkeypatch.setattr(runner, "code_digest", lambda module: "other code")
    kitchen.run()
    assert kitchen.calls == ["a", "b", "c"]


def test_a_product_that_was_taken_out_is_made_again(kitchen: Kitchen) -> None:
    kitchen.run()
    (kitchen.out / "p1" / "b" / "text").unlink()
    kitchen.run()
    assert kitchen.calls == ["b"]


def test_from_runs_a_stage_and_those_after_it(kitchen: Kitchen) -> None:
    kitchen.run()
    kitchen.run(first="b")
    assert kitchen.calls == ["b", "c"]


def test_until_ends_the_run_and_marks_later_products_stale(kitchen: Kitchen) -> None:
    assert list(kitchen.run(last="b")) == ["a", "b"]
    kitchen.run()
    (kitchen.folder / "cine" / "image").write_text("other")
    kitchen.run(last="a")
    statuses = {name: stage["status"] for name, stage in kitchen.record()["stages"].items()}
    assert statuses == {"a": "done", "b": "stale", "c": "stale"}


def test_a_failure_tells_of_products_that_an_earlier_run_left(kitchen: Kitchen) -> None:
    """A force server would load them, and they are not what was asked for."""
    kitchen.run()
    (kitchen.folder / "cine" / "image").write_text("another")

    def fail(job: Job) -> dict[str, Any]:
        raise StageError("slice 3: no heart")

    kitchen.bodies["b"] = fail
    with pytest.raises(StageError, match="slice 3") as caught:
        kitchen.run()
    [note] = caught.value.__notes__
    assert note.startswith(f"b, c in {kitchen.out / 'p1'} came of an earlier run")


def test_a_failure_repeats_what_finished_stages_noticed(
    kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Slices out of order may be why a later stage fails."""

    def noticed(stages: dict[str, Any]) -> list[tuple[str, str]]:
        return [("input", f"{name} is odd") for name in stages if name == "a"]

    def fail(job: Job) -> dict[str, Any]:
        raise StageError("not exact enough")

    monkeypatch.setattr(runner, "remarks", noticed)
    kitchen.bodies["b"] = fail
    with pytest.raises(StageError) as caught:
        kitchen.run()
    assert caught.value.__notes__ == ["input: a is odd"]


def test_a_stage_without_room_for_temporary_files_has_failed(kitchen: Kitchen) -> None:
    """The system's error goes on to the command line; the record does not say running."""

    def fail(job: Job) -> dict[str, Any]:
        raise OSError(5, "Input/output error")

    kitchen.bodies["b"] = fail
    with pytest.raises(OSError, match="Input/output"):
        kitchen.run()
    record = kitchen.record()
    assert record["status"] == record["stages"]["b"]["status"] == "failed"


def test_a_run_whose_progress_nobody_reads_any_more_is_over(kitchen: Kitchen) -> None:
    """As `beatfield run ... 2>&1 | head` ends it, between two stages."""

    class Closed(Silent):
        def ended(self, stage: str, outcome: str, seconds: float) -> None:
            raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        kitchen.run(watcher=Closed())
    assert kitchen.record()["status"] == "failed"


def test_a_stage_without_memory_failed(kitchen: Kitchen) -> None:
    def fail(job: Job) -> dict[str, Any]:
        raise MemoryError

    kitchen.bodies["b"] = fail
    with pytest.raises(MemoryError):
        kitchen.run()
    record = kitchen.record()
    assert record["status"] == record["stages"]["b"]["status"] == "failed"


def test_a_failing_stage_publishes_nothing_and_keeps_what_was_finished(kitchen: Kitchen) -> None:
    def fail(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text("half")
        raise StageError("slice 3: no heart")

    kitchen.bodies["b"] = fail
    with pytest.raises(StageError, match="slice 3"):
        kitchen.run()
    assert sorted(path.name for path in (kitchen.out / "p1").iterdir()) == [
        ".lock",
        "a",
        "run.json",
    ]
    record = kitchen.record()
    assert record["status"] == "failed"
    entry = record["stages"]["b"]
    assert (entry["status"], entry["cause"]) == ("failed", "slice 3: no heart")
    assert entry["seconds"] >= 0
    kitchen.bodies.clear()
    kitchen.run()
    assert kitchen.calls == ["b", "c"]


def test_a_failing_stage_leaves_its_earlier_product(kitchen: Kitchen) -> None:
    kitchen.run()
    before = kitchen.text("a")
    (kitchen.folder / "cine" / "image").write_text("other")

    def interrupted(job: Job) -> dict[str, Any]:
        raise KeyboardInterrupt

    kitchen.bodies["a"] = interrupted
    with pytest.raises(KeyboardInterrupt):
        kitchen.run()
    assert kitchen.text("a") == before
    assert not list((kitchen.out / "p1").glob(f".*{PARTIAL}*"))
    assert kitchen.record()["status"] == "interrupted"


def test_a_skipped_stage_says_why_and_removes_what_it_once_made(kitchen: Kitchen) -> None:
    kitchen.run()

    def skip(job: Job) -> dict[str, Any]:
        raise Skipped("no ultrasound")

    kitchen.bodies["b"] = skip
    kitchen.bodies["c"] = lambda job: {"without b": job.product("b") is None}
    kitchen.run(first="b")
    skipped = kitchen.record()["stages"]["b"]
    assert (skipped["status"], skipped["cause"]) == ("skipped", "no ultrasound")
    assert kitchen.record()["stages"]["c"]["figures"] == {"without b": True}
    assert not (kitchen.out / "p1" / "b").exists()


def test_a_stage_that_was_skipped_is_not_tried_again_until_something_changes(
    kitchen: Kitchen,
) -> None:
    def skip(job: Job) -> dict[str, Any]:
        raise Skipped("no ultrasound")

    kitchen.bodies |= {"b": skip, "c": lambda job: {}}
    kitchen.run()
    assert kitchen.run() == {"a": "unchanged", "b": "skipped: no ultrasound", "c": "unchanged"}
    assert kitchen.calls == []
    kitchen.run(first="b")
    assert kitchen.calls == ["b", "c"]
    kitchen.run(Settings.model_validate({"bake": {"spacing_mm": 2.5}}))
    assert kitchen.calls == ["b"]


def test_a_folder_that_a_system_will_not_make_is_named_and_a_lost_input_is_not_taken_for_one(
    tmp_path: Path,
) -> None:
    def missing(path: Path) -> None:
        with readable_write_errors(tmp_path / "out" / "p1"):
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))

    with pytest.raises(InputError, match=r"p1: cannot be written \(No such file"):
        missing(tmp_path / "out")
    with pytest.raises(FileNotFoundError):
        missing(tmp_path / "study" / "sweep.mha")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_named_and_nothing_is_half_written(kitchen: Kitchen, number: int) -> None:
    def full(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text("half")
        raise OSError(number, os.strerror(number))

    kitchen.bodies["b"] = full
    with pytest.raises(InputError, match="disk is full"):
        kitchen.run()
    assert not (kitchen.out / "p1" / "b").exists()
    assert not list((kitchen.out / "p1").glob(f".*{PARTIAL}*"))
    assert kitchen.text("a") == "a(first)"


def test_an_output_folder_that_cannot_be_written(kitchen: Kitchen, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    kitchen.out = tmp_path / "file" / "out"
    with pytest.raises(InputError, match="cannot be written"):
        kitchen.run()


def test_products_inside_the_study_are_refused(kitchen: Kitchen) -> None:
    kitchen.out = kitchen.folder
    with pytest.raises(InputError, match="inside the study"):
        kitchen.run()


def test_two_runs_in_one_folder_are_refused(kitchen: Kitchen) -> None:
    with only_run_in(kitchen.out / "p1"), pytest.raises(InputError, match="another run"):
        kitchen.run()


def test_killed_while_writing_leaves_the_old_product_and_is_cleared_away(tmp_path: Path) -> None:
    """kill -9 between the first and the last byte of a product."""
    target = tmp_path / "stage"
    with publishing(target) as folder:
        (folder / "text").write_text("old")
    script = (
        "import sys, time; from pathlib import Path; from pipeline.publish import publishing\n"
        "with publishing(Path(sys.argv[1])) as folder:\n"
        "    (folder / 'text').write_text('new'); print('writing', flush=True); time.sleep(60)\n"
    )
    command = [sys.executable, "-c", script, str(target)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (target / "text").read_text() == "old"
    assert list(tmp_path.glob(f".*{PARTIAL}*"))
    # What is being written, as by an export beside the run, is not in its way; a leftover is, also
    # of a process that had the number of one that lives.
    with publishing(tmp_path / "export") as alive:
        (tmp_path / f".other{PARTIAL}{os.getppid()}").mkdir()
        with only_run_in(tmp_path):
            assert list(tmp_path.glob(f".*{PARTIAL}*")) == [alive]


def test_what_was_killed_within_a_swap_is_in_nobodys_way(tmp_path: Path) -> None:
    """In a container every run has the same number: the old product lies where the next one's
    is to go."""
    target = tmp_path / "stage"
    for name in (f".stage{PARTIAL}old-{os.getpid()}", f".stage{PARTIAL}{os.getpid()}"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "text").write_text("left")
    for content in ("old", "new"):
        with publishing(target) as folder:
            (folder / "text").write_text(content)
        assert (target / "text").read_text() == content
    assert [one.name for one in tmp_path.iterdir()] == ["stage"]


def test_killed_between_the_renames_of_a_swap_costs_no_product(tmp_path: Path) -> None:
    """The next run puts the old one back before it begins, and may then fail."""
    script = (
        "import os, signal, sys; from pathlib import Path\n"
        "from pipeline.publish import publishing\n"
        "target, rename = Path(sys.argv[1]), Path.rename\n"
        "def dying(self, other):\n"
        "    rename(self, other)\n"
        "    if self == target: os.kill(os.getpid(), signal.SIGKILL)\n"
        "for content in ('old', 'new'):\n"
        "    with publishing(target) as folder: (folder / 'text').write_text(content)\n"
        "    Path.rename = dying\n"
    )
    target = tmp_path / "stage"
    ended = subprocess.run([sys.executable, "-c", script, str(target)], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert not target.exists()
    with pytest.raises(RuntimeError), publishing(target):
        raise RuntimeError
    assert (target / "text").read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["stage"]


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError(errno.EACCES, "Permission denied", "x"), InputError), (KeyboardInterrupt(), None)],
)
def test_a_swap_that_fails_half_way_leaves_the_old_product(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    told: type[Exception] | None,
) -> None:
    target, rename = tmp_path / "stage", Path.rename
    with publishing(target) as folder:
        (folder / "text").write_text("old")

    def refused(path: Path, to: Path) -> Path:
        if to == target and "old-" not in path.name:
            raise error
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(told or type(error)), publishing(target) as folder:
        (folder / "text").write_text("new")
    assert (target / "text").read_text() == "old"
    assert not list(tmp_path.glob(f".*{PARTIAL}*"))


def test_a_refusal_of_the_system_is_noticed_whatever_writes(tmp_path: Path) -> None:
    """The system refuses files over 100 kB: every writer of products must hear of it."""
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "import numpy as np; from pathlib import Path\n"
        "from pipeline.geometry import Surface; from pipeline.errors import InputError\n"
        "from pipeline.imaging.nifti import write_image; from pipeline.meshes import write_vtp\n"
        "from pipeline.publish import publishing\n"
        "rng = np.random.default_rng(0); vertices = rng.normal(size=(20000, 3))\n"
        "def image(f):\n"
        "    write_image(f / 'i.nii.gz', rng.normal(size=(9, 99, 99)), np.eye(4))\n"
        "def mesh(f):\n"
        "    write_vtp(f / 'm.vtp', Surface(vertices, rng.integers(0, 20000, (9000, 3))))\n"
        "for write in (image, mesh):\n"
        "    try:\n"
        "        with publishing(Path(sys.argv[1])) as folder:\n"
        "            write(folder)\n"
        "    except InputError as error:\n"
        "        print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "stage")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("larger than `ulimit -f`") == 2, done.stderr
    assert not list(tmp_path.iterdir())


def test_code_digest_follows_imports_but_not_those_of_other_stages() -> None:
    from pipeline.sealing import _import_closure

    names = {path.name for path in _import_closure("pipeline.stages.ingest")}
    assert {"ingest.py", "dicom.py", "nifti.py", "cine.py", "job.py", "errors.py"} <= names
    assert "fixture.py" not in names
    assert code_digest("pipeline.stages.ingest") != code_digest("pipeline.stages.surface")


def test_what_compilers_leave_beside_the_code_does_not_count() -> None:
    """Nor the files that they are writing, which other processes see come and go."""
    before = code_digest.__wrapped__("pipeline.stages.bake")
    beside = Path(runner.__file__).parent / "field" / "__pycache__" / "x.nbc.tmp.0123456789abcdef"
    beside.parent.mkdir(exist_ok=True)
    beside.touch()
    try:
        assert code_digest.__wrapped__("pipeline.stages.bake") == before
    finally:
        beside.unlink()


def test_every_library_that_stages_import_counts_for_their_products() -> None:
    """But for those that read settings and words of the command line, which count themselves."""
    root = Path(runner.__file__).parent
    sources = [*root.glob("*.py"), *(p for p in root.glob("*/**/*.py") if "paper" not in p.parts)]
    nodes = [node for path in sources for node in ast.walk(ast.parse(path.read_text()))]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    makers = metadata.packages_distributions()
    found = {maker.lower() for name in names for maker in makers.get(name.split(".")[0], ())}
    assert {"vtk", "nibabel", "matplotlib"} <= found
    elsewhere = {"pyyaml", "pydantic", "cyclopts", "beatfield"}
    assert found - elsewhere <= {one.lower() for one in LIBRARIES}


def test_peak_memory_is_that_of_the_stretch_and_not_of_the_past() -> None:
    from pipeline.memory import CLEAR_REFS, PeakMemory

    if not CLEAR_REFS.exists():
        pytest.skip("only Linux resets its high-water mark")
    before = PeakMemory().megabytes()
    # From the system: what earlier tests have freed may lie in the process yet.
    with mmap.mmap(-1, 300_000_000, flags=mmap.MAP_PRIVATE) as large:
        large[::4096] = b"x" * len(large[::4096])
        grown = PeakMemory()
    time.sleep(0.01)
    assert grown.megabytes() >= before + 250
    assert PeakMemory().megabytes() < before + 250


def test_other_libraries_run_again(kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch) -> None:
    kitchen.run()
    monkeypatch.setattr(runner, "library_versions", lambda: {"numpy": "0"})
    kitchen.run()
    assert kitchen.calls == ["a", "b", "c"]


def test_products_are_not_taken_over_under_another_patient_id(kitchen: Kitchen) -> None:
    """The field and the report carry it: renamed folders are not renamed products."""
    kitchen.run()
    (kitchen.out / "p1").rename(kitchen.out / "p2")
    (kitchen.folder / "study.yaml").write_text("patient_id: p2\n")
    assert kitchen.run() == dict.fromkeys("abc", "done")
    assert kitchen.calls == ["a", "b", "c"]


def test_another_reason_for_none_runs_the_stage_that_tells_it(
    kitchen: Kitchen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing was made before and nothing is now; a report would go on telling the old cause."""
    last = runner.Stage("c", after=("a", "b"), repeats_reasons=True)
    monkeypatch.setattr(runner, "STAGES", (*runner.STAGES[:2], last))

    def tell(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text(job.skipped["b"])
        return {}

    kitchen.bodies["c"] = tell
    for cause, spacing_mm in (("no ultrasound", 2.0), ("no heart in view", 3.0)):

        def skip(job: Job, cause: str = cause) -> dict[str, Any]:
            raise Skipped(cause)

        kitchen.bodies["b"] = skip
        kitchen.run(Settings.model_validate({"bake": {"spacing_mm": spacing_mm}}))
        assert kitchen.text("c") == cause


def test_what_lies_where_a_stage_made_nothing_is_not_left_for_later_ones(kitchen: Kitchen) -> None:
    """A folder that somebody put there is no product, and later stages would read it."""

    def skip(job: Job) -> dict[str, Any]:
        raise Skipped("no ultrasound")

    kitchen.bodies |= {"b": skip, "c": lambda job: {"without b": job.product("b") is None}}
    kitchen.run()
    (kitchen.out / "p1" / "b").mkdir()
    (kitchen.out / "p1" / "b" / "text").write_text("of another patient")
    kitchen.run(first="c")
    assert kitchen.record()["stages"]["c"]["figures"] == {"without b": True}


def test_a_product_altered_while_the_study_runs_goes_into_no_other(kitchen: Kitchen) -> None:
    """When the run came to it, it was as it had been sealed."""

    def alter(job: Job) -> dict[str, Any]:
        (job.products / "a" / "text").write_text("altered")
        return {}

    kitchen.bodies["b"] = alter
    with pytest.raises(InputError, match=r"a/text: is not what the stage a wrote"):
        kitchen.run()
    assert kitchen.calls == ["a", "b"]
    assert not (kitchen.out / "p1" / "c").exists()


def test_nobody_clears_up_within_a_swap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process that did would put the old product back into the new one's place."""
    target, rename = tmp_path / "stage", Path.rename
    with publishing(target) as folder:
        (folder / "text").write_text("old")

    def looked_at(path: Path, to: Path) -> Path:
        moved = rename(path, to)
        if path == target:
            remove_partials(tmp_path)
            assert not target.exists()
        return moved

    monkeypatch.setattr(Path, "rename", looked_at)
    with publishing(target) as folder:
        (folder / "text").write_text("new")
    assert (target / "text").read_text() == "new"
    assert [one.name for one in tmp_path.iterdir()] == ["stage"]


def test_killed_behind_the_renames_of_a_swap_leaves_the_new_product(tmp_path: Path) -> None:
    """The old one is cleared away, and stops no later run."""
    for name, content in ((f".stage{PARTIAL}old-{os.getppid()}", "old"), ("stage", "new")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "text").write_text(content)
    with only_run_in(tmp_path):
        assert (tmp_path / "stage" / "text").read_text() == "new"
        assert not list(tmp_path.glob(f".*{PARTIAL}*"))


def test_what_a_killed_run_left_and_nobody_may_clear_away_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f".stage{PARTIAL}0").mkdir()

    def refused(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr("pipeline.publish.remove", refused)
    with pytest.raises(InputError, match="cannot be written"), only_run_in(tmp_path):
        pytest.fail("nothing runs here")


def test_who_reads_a_record_while_it_is_written_reads_a_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    write_json(path, {"status": "running"})
    with path.open() as reader:
        write_json(path, {"status": "done"})
        assert json.load(reader) == {"status": "running"}
    assert json.loads(path.read_text()) == {"status": "done"}


def test_networks_beside_the_code_count_for_what_it_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other weights make other labels, of the same code."""
    weights = tmp_path / "imaging" / "weights" / "network.onnx"
    weights.parent.mkdir(parents=True)
    (tmp_path / "imaging" / "labels.py").write_text("import numpy\n")
    monkeypatch.setattr(sealing, "PACKAGE", tmp_path)
    found = []
    for content in (b"trained", b"trained longer", b"trained"):
        weights.write_bytes(content)
        found.append(code_digest.__wrapped__("pipeline.imaging.labels"))
    assert found[0] == found[2] != found[1]
