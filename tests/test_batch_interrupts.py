"""A batch that is interrupted or killed: no study begins, none outlives it, the table stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from batch_program import make_study, rows_of, stand_in

# Tells through pipes of names where it has come to; the study's name says what it does.
PROGRAM = """
import json, os, pathlib, signal, sys
signal.alarm(120)  # Whatever goes wrong, nothing is left running.
study, out = pathlib.Path(sys.argv[4]), pathlib.Path(sys.argv[6])
def tell(text):
    with (out.parent / "told").open("w") as pipe:
        pipe.write(text)
def interrupted(number, frame):
    print("interrupted; what is finished is kept\\nnote: bake in p is old", file=sys.stderr)
    sys.exit(130)
if study.name == "b-waits":
    signal.signal(signal.SIGTERM, interrupted)
    tell("waits"); signal.pause()
if study.name == "b-deaf":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    tell("waits"); signal.sigwait({signal.SIGTERM}); tell("deaf"); signal.pause()
if study.name == "b-watches":
    tell("waits"); os.read(0, 1); tell("orphaned")
if study.name == "c":
    sys.exit("a study that must not begin")
(out / study.name).mkdir()
(out / study.name / "run.json").write_text(json.dumps({"study": str(study), "stages": {}}))
"""

SCRIPT = """
import signal, sys
from pipeline.cli import main
# Whoever runs the tests in the background may have let these be ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
sys.executable = sys.argv[1]
sys.exit(main(["batch", *sys.argv[2:]]))
"""


class Running:
    """A batch in a process of its own, in which one study has ended and another waits."""

    def __init__(self, root: Path, second: str) -> None:
        for name in ("a", second, "c"):
            make_study(root / "studies" / name)
        self.out = root / "out"
        self.pipe = root / "told"
        os.mkfifo(self.pipe)
        program = stand_in(root, PROGRAM)
        command = [sys.executable, "-c", SCRIPT, program, str(root / "studies"), "--out"]
        self.process = subprocess.Popen(
            [*command, str(self.out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.told() == "waits"

    def told(self) -> str:
        """What the study says next."""
        return subprocess.check_output(["cat", self.pipe], text=True, timeout=60)


@contextmanager
def running(root: Path, second: str) -> Iterator[Running]:
    batch = Running(root, second)
    try:
        yield batch
    finally:
        batch.process.kill()
        batch.process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_batch_ends_its_studies_and_keeps_its_table(
    tmp_path: Path, number: signal.Signals
) -> None:
    with running(tmp_path, "b-waits") as batch:
        batch.process.send_signal(number)
        printed, said = batch.process.communicate(timeout=60)
        assert batch.process.returncode == 130
    rows = rows_of(batch.out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "a": "done",
        "b-waits": "interrupted",
        "c": "interrupted",
    }
    assert rows["b-waits"]["cause"] == "what was finished is kept; bake in p is old"
    assert rows["c"]["cause"] == "not begun"
    assert not (batch.out / "logs" / "c.log").exists()
    assert "interrupted; waiting for 1 to end" in said
    assert all(name in printed for name in rows)


def test_a_killed_batch_leaves_a_table_that_says_so_and_its_studies_know(tmp_path: Path) -> None:
    """Not that of last night, and not one of the studies that have ended alone."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "batch.csv").write_text("patient,status\nc,done\n")
    with running(tmp_path, "b-watches") as batch:
        batch.process.kill()
        assert batch.told() == "orphaned"
    rows = rows_of(batch.out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "a": "done",
        "b-watches": "not ended",
        "c": "not ended",
    }
    assert rows["b-watches"]["cause"] == "had not ended when this was written"


def test_ctrl_c_again_ends_a_study_that_does_not_listen(tmp_path: Path) -> None:
    with running(tmp_path, "b-deaf") as batch:
        batch.process.send_signal(signal.SIGINT)
        assert batch.told() == "deaf"
        # A terminal that closes may tell so twice; that is no person who insists.
        batch.process.send_signal(signal.SIGHUP)
        batch.process.send_signal(signal.SIGINT)
        batch.process.communicate(timeout=60)
        assert batch.process.returncode == 130
    assert rows_of(batch.out)["b-deaf"]["status"] == "interrupted"


MEMBER = """
import signal, sys
from pipeline import batch_member
from pipeline.ending import guarded
def main():
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    ignored = [signal.getsignal(one) is signal.SIG_IGN for one in (signal.SIGINT, signal.SIGHUP)]
    return guarded(lambda: (print(*ignored, flush=True), signal.pause()))
batch_member.main = main
sys.exit(batch_member.run())
"""


def test_a_study_ends_with_its_batch_and_hears_the_batch_alone() -> None:
    member = subprocess.Popen(
        [sys.executable, "-c", MEMBER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert member.stdout is not None
    assert member.stdout.readline() == "True True\n"
    # communicate() closes the pipe, as the system does when the batch is no more.
    _, said = member.communicate(timeout=60)
    assert (member.returncode, said) == (130, "interrupted; what is finished is kept\n")


@pytest.mark.parametrize("ignored", [True, False])
def test_a_closed_terminal_interrupts_unless_it_is_to_be_outlived(ignored: bool) -> None:
    """As `nohup` asks for."""
    script = (
        "import signal, sys; from pipeline.cli import main; from pipeline.ending import interrupt\n"
        f"signal.signal(signal.SIGHUP, signal.SIG_IGN if {ignored} else signal.SIG_DFL)\n"
        "main(['--version'])\n"
        "heard = signal.getsignal(signal.SIGHUP) is interrupt\n"
        "sys.exit(10 + heard)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == (10 if ignored else 11)
