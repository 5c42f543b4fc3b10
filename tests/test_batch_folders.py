"""What lies in the folders of a batch: ids that clash, studies one level deeper, locks, leftovers.

A program stands in for the pipeline's own process.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from batch_program import make_study, rows_of, stand_in

from pipeline.batch_ending import how_it_ended
from pipeline.batch_plan import notes_on, plan_batch
from pipeline.cli import main
from pipeline.errors import InputError
from pipeline.publish import locked

# Writes what a finished run writes; study.yaml's patient_id, and a link's name, are read as the
# pipeline does, which takes half a second to import.
PROGRAM = """
import json, os, pathlib, shutil, sys
study, out = pathlib.Path(sys.argv[4]), pathlib.Path(sys.argv[6])
patient_id, cine = study.name, study / "cine"
if study.is_symlink() or (study / "study.yaml").exists() or not cine.is_dir():
    sys.path.insert(0, ROOT)
    from pipeline.errors import InputError
    from pipeline.study import open_study
    try:
        one = open_study(study)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr); sys.exit(2)
    patient_id, cine = one.patient_id, one.cine.path
products = out / patient_id
products.mkdir(exist_ok=True)
image = (cine / "image").read_text()
inputs = {"cine": {"cine/image": image}} if image else {}
told = study / "stages"
stages = json.loads(told.read_text()) if told.exists() else {}
record = {"study": str(study.resolve()), "stages": stages, "inputs": inputs}
(products / "run.json").write_text(json.dumps(record))
if study.name == "vanishes":
    shutil.rmtree(study)
if study.name == "blocks-the-table":
    (out / "batch.csv").unlink(missing_ok=True); (out / "batch.csv").mkdir()
"""


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    root = str(Path(__file__).parent.parent)
    program = PROGRAM.replace("ROOT", repr(root))
    monkeypatch.setattr("sys.executable", stand_in(tmp_path, program))
    make_study(tmp_path / "studies" / "good")
    return tmp_path / "studies"


def batch(studies: Path, out: Path | None = None, *more: str) -> int:
    return main(["batch", str(studies), "--out", str(out or studies.parent / "out"), *more])


def test_a_row_says_where_the_study_and_its_products_are(studies: Path) -> None:
    out = studies.parent / "out"
    make_study(studies / "tenth", "patient_id: p10\n")
    assert batch(studies) == 0
    row = rows_of(out)["tenth"]
    assert row["patient_id"] == "p10"
    assert row["study"] == str(studies / "tenth")
    assert row["products"] == str(out / "p10")


@pytest.mark.parametrize("other", ["good", "Good"])
def test_studies_of_one_patient_fail_and_the_others_are_run(studies: Path, other: str) -> None:
    make_study(studies / "also", f"patient_id: {other}\n")
    make_study(studies / "well")
    assert batch(studies) == 1
    rows = rows_of(studies.parent / "out")
    assert {name: row["status"] for name, row in rows.items()} == {
        "also": "failed",
        "good": "failed",
        "well": "done",
    }
    assert f"has the patient id '{other}' of {studies / 'good'}" in rows["also"]["cause"]
    assert f"of {studies / 'also'}; give each study" in rows["good"]["cause"]


@pytest.mark.parametrize("others", [1, 3])
def test_progress_counts_studies_whatever_else_is_refused_or_none(
    studies: Path, capsys: pytest.CaptureFixture[str], others: int
) -> None:
    """Refused ones end first, and folders that are no study are none."""
    make_study(studies / "also", "patient_id: good\n")
    for number in range(others):
        (studies / f"zz{number}").mkdir()
    assert batch(studies) == 1
    counts = re.findall(r"(-?\d+)/(-?\d+)", capsys.readouterr().err)
    told = sorted({(int(done), int(total)) for done, total in counts})
    assert told == [(1, 2), (2, 2)]


@pytest.mark.parametrize("name", ["logs", "batch.csv", "Logs", "batch-2-of-4.csv"])
def test_a_patient_is_not_called_what_the_batch_writes(studies: Path, name: str) -> None:
    make_study(studies / "bad", f"patient_id: {name}\n")
    assert batch(studies) == 1
    rows = rows_of(studies.parent / "out")
    assert (rows["good"]["status"], rows["bad"]["status"]) == ("done", "failed")
    assert f"other than '{name}'" in rows["bad"]["cause"]


def test_a_study_that_is_not_yet_whole_is_none(studies: Path) -> None:
    """As it is left where the program that wrote it was killed."""
    make_study(studies / ".p2.partial-77")
    (studies / ".p2.partial-77" / "study.yaml").write_text("patient_id: p2\n")
    make_study(studies / "inner" / ".p3.partial-78")
    make_study(studies / "inner" / "p3")
    assert batch(studies) == 0
    assert rows_of(studies.parent / "out").keys() == {"good", "inner"}


def test_a_study_one_level_deeper_is_run_and_several_are_told(studies: Path) -> None:
    make_study(studies / "one" / "inner")
    for name in ("a", "b"):
        make_study(studies / "two" / name)
    assert batch(studies) == 1
    rows = rows_of(studies.parent / "out")
    assert (rows["one"]["status"], rows["one"]["patient_id"]) == ("done", "inner")
    assert rows["one"]["study"] == str(studies / "one" / "inner")
    assert rows["two"]["status"] == "failed"
    assert "holds 2 studies (a, ...)" in rows["two"]["cause"]


@pytest.mark.parametrize("place", [".", "good", "good/products"])
def test_products_are_not_put_where_they_would_be_taken_for_studies(
    studies: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(studies.rglob("*"))
    assert batch(studies, studies / place) == 2
    assert "choose another --out" in capsys.readouterr().err
    assert sorted(studies.rglob("*")) == before


@pytest.mark.parametrize("place", ["", "products"])
def test_a_link_does_not_hide_that_products_would_lie_among_the_studies(
    studies: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    link = studies.parent / "link"
    link.symlink_to(studies / "good" if place else studies)
    assert batch(studies, link / place) == 2
    assert "choose another --out" in capsys.readouterr().err


def test_folders_in_which_products_lie_are_none_of_the_studies(studies: Path) -> None:
    out = studies / "products" / "first"
    for _ in range(2):
        assert batch(studies, out) == 0
        assert rows_of(out).keys() == {"good"}


def test_what_belongs_to_no_study_is_told(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = studies.parent / "out"
    (out / "last-year").mkdir(parents=True)
    (out / "last-year" / "run.json").write_text("{}")
    # A folder of that name that is no study has no products.
    (studies / "last-year").mkdir()
    (studies / "list.txt").touch()
    (studies / ".hidden").touch()
    assert batch(studies) == 0
    notes = [one for one in capsys.readouterr().out.splitlines() if one.startswith("note ")]
    assert notes[0].endswith("files beside the studies were not looked at: list.txt")
    assert notes[1].endswith("holds products that are of no study of this batch: last-year")


def test_of_many_that_belong_to_no_study_the_first_five_are_named(studies: Path) -> None:
    (studies.parent / "out").mkdir()
    for name in "abcde":
        (studies / name).touch()
    plans = plan_batch(studies, studies.parent / "out")
    (note,) = notes_on(studies, studies.parent / "out", plans)
    assert note.endswith(": a, b, c, d, e")
    (studies / "f").touch()
    (note,) = notes_on(studies, studies.parent / "out", plans)
    assert note.endswith(": a, b, c, d, e and 1 more")


def test_products_of_a_study_that_can_no_longer_be_opened_are_still_its_own(studies: Path) -> None:
    """Told by the study that their record names, or else by its folder's name."""
    out, archive = studies.parent / "out", studies.parent / "archive"
    make_study(archive / "tenth", "nonsense: 1\n")
    (studies / "tenth").symlink_to(archive / "tenth")
    (studies / "good" / "study.yaml").write_text("nonsense: 1\n")
    for name, record in (("p10", {"study": str(archive.resolve() / "tenth")}), ("good", {})):
        (out / name).mkdir(parents=True)
        (out / name / "run.json").write_text(json.dumps(record))
    assert notes_on(studies, out, plan_batch(studies, out)) == []


def test_studies_that_are_gone_when_all_have_run_leave_notes_on_their_products(
    studies: Path,
) -> None:
    out = studies.parent / "out"
    assert batch(studies) == 0
    plans = plan_batch(studies, out)
    studies.rename(studies.parent / "elsewhere")
    assert notes_on(studies, out, plans) == []
    (out / "good").rename(out / "other")
    assert notes_on(studies, out, plans)[0].endswith("no study of this batch: other")


def test_a_link_that_leads_nowhere_is_a_study_that_failed(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of an archive that is not mounted: whoever looks for its row must find one."""
    (studies / "lost").symlink_to("/mnt/nowhere")
    assert batch(studies) == 1
    row = rows_of(studies.parent / "out")["lost"]
    assert row["status"] == "failed"
    assert row["cause"].startswith(f"{studies / 'lost'}: is a link to /mnt/nowhere, where nothing")
    # And is not told again among the files that are none.
    assert "not looked at" not in capsys.readouterr().out


def test_a_study_is_not_taken_for_a_folder_of_studies(studies: Path) -> None:
    with pytest.raises(InputError, match=r"good: is a study itself; .*beatfield run .*good --out"):
        plan_batch(studies / "good", studies.parent / "out")


def test_links_give_their_own_names_to_studies_of_one_name(studies: Path) -> None:
    for name in ("alice", "bob"):
        make_study(studies.parent / "archive" / name / "study")
        (studies / name).symlink_to(studies.parent / "archive" / name / "study")
    assert batch(studies) == 0
    rows = rows_of(studies.parent / "out")
    assert {name: rows[name]["patient_id"] for name in ("alice", "bob")} == {
        "alice": "alice",
        "bob": "bob",
    }


def test_a_study_that_ended_early_tells_of_what_is_old_behind(studies: Path) -> None:
    """--until leaves what an earlier run made of other settings where it is."""
    stages = {"bake": {"status": "stale"}, "report": {"status": "stale"}}
    (studies / "good" / "stages").write_text(json.dumps(stages))
    bake = studies.parent / "out" / "good" / "bake"
    bake.mkdir(parents=True)
    (bake / "stage.json").write_text("{}")
    assert batch(studies) == 0
    row = rows_of(studies.parent / "out")["good"]
    assert row["status"] == "done"
    assert row["cause"].startswith("bake, report in ")
    assert row["cause"].endswith("do not use them for this one")


def test_a_name_of_two_lines_forges_no_row(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_study(studies / "new\nline done", "patient_id: p2\n")
    assert batch(studies) == 0
    printed = capsys.readouterr()
    assert "new\\nline done" in printed.out
    assert "new\\nline done" in printed.err


def test_a_name_that_commands_a_terminal_is_shown_in_the_table_by_its_numbers(
    studies: Path,
) -> None:
    make_study(studies / "new\x1b[2Jname", "patient_id: p2\n")
    assert batch(studies) == 0
    assert "\x1b" not in (studies.parent / "out" / "batch.csv").read_text()
    assert "new\\x1b[2Jname" in rows_of(studies.parent / "out")


def test_the_same_images_under_two_names_are_told(studies: Path) -> None:
    for name, image in (("x", "same"), ("y", "same"), ("z", "other")):
        make_study(studies / name, image=image)
    assert batch(studies) == 0
    told = {name: row["remarks"] for name, row in rows_of(studies.parent / "out").items()}
    assert told == {"good": "", "x": "same images as y", "y": "same images as x", "z": ""}


def test_two_batches_do_not_share_a_folder(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = studies.parent / "out"
    (out / "logs").mkdir(parents=True)
    (out / "logs" / "good.log").write_text("of the first")
    with locked(out):
        assert batch(studies) == 2
    assert "another run is at work here" in capsys.readouterr().err
    assert (out / "logs" / "good.log").read_text() == "of the first"
    assert not (out / "batch.csv").exists()
    assert batch(studies) == 0


def test_shards_run_each_study_once_into_one_folder(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An id that two have is refused though they are in different shards."""
    out = studies.parent / "out"
    for name in ("a", "c", "d"):
        make_study(studies / name)
    (studies / "b").mkdir()
    make_study(studies / "zz", "patient_id: a\n")
    assert [batch(studies, None, "--shard", f"{one}/4") for one in (1, 2, 3, 4)] == [1, 1, 0, 0]
    told = [rows_of(out, f"batch-{one}-of-4.csv") for one in (1, 2, 3, 4)]
    assert [list(one) for one in told] == [["a", "good"], ["b", "zz"], ["c"], ["d"]]
    assert [one["status"] for one in told[0].values()] == ["failed", "done"]
    assert [one["status"] for one in told[1].values()] == ["no study", "failed"]
    assert {one.parent.name for one in out.glob("*/run.json")} == {"good", "c", "d"}
    assert not (out / "batch.csv").exists()
    assert f"table     {out / 'batch-4-of-4.csv'}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("at_work", "begun", "code"),
    [
        ("1-of-2", ["--shard", "2/2"], 0),
        ("1-of-2", ["--shard", "1/2"], 2),
        ("1-of-2", [], 2),
        ("", ["--shard", "1/2"], 2),
    ],
)
def test_a_shard_works_beside_others_and_not_beside_itself_or_the_whole(
    studies: Path, at_work: str, begun: list[str], code: int
) -> None:
    out = studies.parent / "out"
    with locked(out, at_work):
        assert batch(studies, None, *begun) == code
    assert batch(studies, None, *begun) == 0


@pytest.mark.parametrize("shard", ["0/4", "5/4", "1", "1/0", "-1/4", "1/4/4", "a/b", "1/", "²/4"])
def test_what_names_no_shard_is_refused(
    studies: Path, capsys: pytest.CaptureFixture[str], shard: str
) -> None:
    assert batch(studies, None, f"--shard={shard}") == 2
    assert f"--shard {shard}: I/N is needed" in capsys.readouterr().err
    assert not (studies.parent / "out").exists()


def test_a_study_that_vanishes_while_it_runs_costs_nothing(studies: Path) -> None:
    make_study(studies / "vanishes")
    assert batch(studies) == 0
    assert rows_of(studies.parent / "out")["vanishes"]["status"] == "done"


def test_a_name_that_leaves_no_room_for_an_ending(studies: Path) -> None:
    name = "n" * 255
    make_study(studies / name, "patient_id: short\n")
    assert batch(studies) == 0
    assert rows_of(studies.parent / "out")[name]["status"] == "done"


def test_a_table_that_cannot_be_written_is_printed_all_the_same(
    studies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_study(studies / "blocks-the-table")
    assert batch(studies) == 2
    printed, said = capsys.readouterr()
    assert "good" in printed
    assert "batch.csv: cannot be written" in said
    assert not list((studies.parent / "out").glob(".batch.csv*"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is full")
@pytest.mark.parametrize("stream", ["2>/dev/full", "2>&-"])
def test_progress_that_cannot_be_told_costs_no_study(studies: Path, stream: str) -> None:
    script = (
        "import sys; from pipeline.cli import main\n"
        "sys.executable = sys.argv[1]; sys.exit(main(['batch', *sys.argv[2:]]))"
    )
    python, out = sys.executable, str(studies.parent / "out")
    real = json.loads(
        subprocess.check_output(["sed", "-n", 's/^exec \\("[^"]*"\\).*/\\1/p', python], text=True)
    )
    command = [real, "-c", script, python, str(studies), "--out", out]
    shell = f'exec "$@" {stream}'
    done = subprocess.run(
        ["sh", "-c", shell, "sh", *command], stdout=subprocess.PIPE, text=True, check=False
    )
    assert done.returncode == 0
    assert rows_of(studies.parent / "out")["good"]["status"] == "done"
    assert "good" in done.stdout
    # Progress is not printed among the results in place of where it cannot be.
    assert "1/1" not in done.stdout


def test_a_study_that_cannot_be_opened_leaves_products_that_are_told(studies: Path) -> None:
    out = studies.parent / "out"
    assert batch(studies) == 0
    (out / "good" / "bake").mkdir()
    (out / "good" / "bake" / "stage.json").write_text("{}")
    (studies / "good" / "study.yaml").write_text("nonsense: 1\n")
    assert batch(studies) == 1
    row = rows_of(out)["good"]
    assert "nonsense" in row["cause"]
    assert f"{out / 'good'} holds products of another run; do not use them" in row["cause"]
    assert row["products"] == str(out / "good")


@pytest.mark.parametrize(
    ("code", "log", "status", "cause"),
    [
        (
            2,
            "error: a: wrong\nb: wrong\nnote: c\n  d\n\nleft",
            "failed",
            "a: wrong; b: wrong; c; d",
        ),
        (1, "Traceback\nMemoryError\n", "crashed", "MemoryError; memory may be short"),
        (1, "Traceback\nKeyError: 3\n", "crashed", "KeyError: 3; see"),
        (-signal.SIGKILL, "", "crashed", "SIGKILL; memory may be short: use fewer --workers"),
        (-signal.SIGSEGV, "", "crashed", "SIGSEGV; see"),
        (-40, "", "crashed", "signal 40; see"),
        (130, "interrupted\nnote: e\n", "interrupted", "what was finished is kept; e"),
        (-signal.SIGTERM, "", "interrupted", "what was finished is kept"),
    ],
)
def test_a_cause_is_all_that_the_program_said(
    tmp_path: Path, code: int, log: str, status: str, cause: str
) -> None:
    path = tmp_path / "log"
    path.write_text(log)
    found = how_it_ended(code, path, told_to_end=False)
    assert found[0] == status
    assert found[1].startswith(cause)
    assert "left" not in found[1]


def test_a_library_that_takes_an_interrupt_for_an_error_was_interrupted(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text("RuntimeError: no compiled object yet\n")
    assert how_it_ended(1, path, told_to_end=True)[0] == "interrupted"
    path.write_text("error: no heart\n")
    assert how_it_ended(1, path, told_to_end=True) == ("failed", "no heart")


def test_of_a_set_that_holds_no_study_the_line_that_makes_one_is_told(tmp_path: Path) -> None:
    """As public sets come: a folder a patient, the cine beside single phases and their labels."""
    patient = tmp_path / "set" / "patient001"
    patient.mkdir(parents=True)
    for name, size in (("a_frame01.nii.gz", 20), ("a_4d.nii.gz", 90), ("a_frame01_gt.nii.gz", 9)):
        (patient / name).write_bytes(b"x" * size)
    (patient / "gone.nii").symlink_to(tmp_path / "nowhere")
    for given in ("set", "set/patient001"):
        with pytest.raises(InputError, match=r"cine: \{path: a_4d\.nii\.gz\}.*001/study\.yaml"):
            plan_batch(tmp_path / given, tmp_path / "out")
