"""What `run.json` says of products that a run has not come to: done, stale or skipped."""

from __future__ import annotations

import errno
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from kitchen import Kitchen

from pipeline import run as runner
from pipeline.cli import main
from pipeline.config import Settings
from pipeline.errors import InputError, StageError
from pipeline.job import Job, Skipped
from pipeline.publish import stale_words

CHANGED = Settings.model_validate({"bake": {"spacing_mm": 3.0}})
"""Settings that only the second stage reads."""


@pytest.fixture
def kitchen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kitchen:
    return Kitchen(tmp_path, monkeypatch)


def statuses(kitchen: Kitchen) -> dict[str, str]:
    return {name: stage["status"] for name, stage in kitchen.record()["stages"].items()}


def stopped(job: Job) -> dict[str, Any]:
    raise KeyboardInterrupt


def test_what_is_made_from_a_stale_product_is_stale(kitchen: Kitchen) -> None:
    """The third stage reads b as it was: only when b is made anew is it known to hold."""
    kitchen.run()
    kitchen.run(CHANGED, last="a")
    assert statuses(kitchen) == {"a": "done", "b": "stale", "c": "stale"}
    # Nothing was touched, so that the settings of before find all in place, with its timing.
    kitchen.run(last="a")
    assert statuses(kitchen) == dict.fromkeys("abc", "done")
    assert kitchen.record()["stages"]["c"]["seconds"] is not None


def test_nothing_is_made_of_a_product_that_was_altered(kitchen: Kitchen) -> None:
    """Of the same size: a digit of a transform, say. Its digest is what later stages trust."""
    kitchen.run()
    text = kitchen.out / "p1" / "a" / "text"
    text.write_text(text.read_text().replace("first", "f1rst"))
    with pytest.raises(InputError, match=r"a/text: is not what the stage a wrote.*--from a"):
        kitchen.run(first="b")
    assert kitchen.run(first="a") == dict.fromkeys("abc", "done")
    assert kitchen.text("c") == "c(a(first),b(a(first)))"


@pytest.mark.parametrize("by_hand", ["f1rst", "corrected", ""], ids=["same size", "longer", "cut"])
def test_an_altered_product_does_not_stand(kitchen: Kitchen, by_hand: str) -> None:
    """It is not made anew unasked either: somebody may have corrected it by hand."""
    kitchen.run()
    text = kitchen.out / "p1" / "c" / "text"
    text.write_text(text.read_text().replace("first", by_hand))
    out = kitchen.out
    with pytest.raises(InputError, match=rf"c/text: is not what .* --out {out} --from c") as caught:
        kitchen.run()
    assert not getattr(caught.value, "__notes__", [])
    assert statuses(kitchen) == {"a": "done", "b": "done", "c": "failed"}
    assert by_hand in text.read_text() != "c(a(first),b(a(first)))"
    assert kitchen.run(first="c") == {"a": "unchanged", "b": "unchanged", "c": "done"}


def test_what_a_stage_did_not_write_is_not_read_as_its_own(kitchen: Kitchen) -> None:
    """Such as a surface of another patient, where this one's images show none."""
    kitchen.run()
    foreign = kitchen.out / "p1" / "a" / "left_atrium_000.vtp"
    foreign.write_text("another heart")
    words = r"left_atrium_000\.vtp: was not written by the stage a"
    for first in ("b", None):
        with pytest.raises(InputError, match=words):
            kitchen.run(first=first)
    foreign.rename(foreign.with_name("left_atrium_000 of another.vtp"))
    assert kitchen.run() == dict.fromkeys("abc", "unchanged")


def test_figures_that_were_edited_are_not_told(kitchen: Kitchen) -> None:
    """The report repeats them, and later stages are made by them."""
    kitchen.run()
    told = kitchen.out / "p1" / "a" / "stage.json"
    told.write_text(told.read_text().replace('"figure": 1.5', '"figure": 1.25'))
    with pytest.raises(InputError, match=r"a/stage\.json: is not what the stage a wrote"):
        kitchen.run()
    assert kitchen.run(first="a")["c"] == "done"


def as_written_before(kitchen: Kitchen) -> None:
    """Products of a version whose stage.json had neither settings nor a digest of its own."""
    for path in (kitchen.out / "p1").glob("*/stage.json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps({k: content[k] for k in ("fingerprint", "figures", "files")}))


def test_products_of_an_older_version_are_still_somebodys(kitchen: Kitchen, tmp_path: Path) -> None:
    """Of another code, too: not replaced by another patient's, and told to be stale."""
    kitchen.run()
    as_written_before(kitchen)
    kitchen.run(CHANGED, last="a", first="a")
    assert statuses(kitchen) == {"a": "done", "b": "stale", "c": "stale"}
    as_written_before(kitchen)
    other = tmp_path / "elsewhere" / "p1"
    shutil.copytree(kitchen.folder, other)
    (other / "cine" / "image").write_text("another patient")
    kitchen.folder = other
    with pytest.raises(InputError, match="holds the products of another study"):
        kitchen.run()


@pytest.mark.parametrize(
    "change",
    [{"files": ["text"]}, {"figures": None}, {"figures": [1]}, {"fingerprint": 3}, {"files": {}}],
)
def test_a_record_of_another_shape_is_none(kitchen: Kitchen, change: dict[str, Any]) -> None:
    kitchen.run()
    told = kitchen.out / "p1" / "b" / "stage.json"
    told.write_text(json.dumps({**json.loads(told.read_text()), **change}))
    if change == {"files": {}}:
        with pytest.raises(InputError, match=r"b/stage\.json: is not what the stage b wrote"):
            kitchen.run()
    else:
        assert kitchen.run() == {"a": "unchanged", "b": "done", "c": "unchanged"}


def test_a_product_says_which_settings_made_it(kitchen: Kitchen) -> None:
    """Also when the last command had others, and did not come to it."""
    kitchen.run(Settings.model_validate({"bake": {"samples": 123}}))
    kitchen.run(Settings(), last="a")
    record = kitchen.record()
    assert record["settings"]["bake"]["samples"] == 500
    assert record["stages"]["b"]["status"] == "stale"
    said = json.loads((kitchen.out / "p1" / "b" / "stage.json").read_text())
    assert said["settings"]["bake"]["samples"] == 123
    assert set(said["settings"]) == {"bake"}
    assert record["stages"]["a"]["finished"].endswith("+00:00")


def test_what_holds_is_not_called_old_by_a_failure(kitchen: Kitchen) -> None:
    """Made again of the same, as from a stage on: what stands is what it would have made."""
    kitchen.run()
    kitchen.bodies["b"] = stopped_by_a_fault
    with pytest.raises(StageError) as caught:
        kitchen.run(first="b")
    assert not getattr(caught.value, "__notes__", [])


def stopped_by_a_fault(_job: Job) -> dict[str, Any]:
    raise StageError("no")


def test_an_interrupted_run_tells_of_older_products(kitchen: Kitchen) -> None:
    kitchen.run()
    kitchen.bodies["b"] = stopped
    with pytest.raises(KeyboardInterrupt) as caught:
        kitchen.run(CHANGED)
    assert kitchen.record()["status"] == "interrupted"
    assert statuses(kitchen) == {"a": "done", "b": "stale", "c": "stale"}
    [note] = caught.value.__notes__
    assert note.startswith(f"b, c in {kitchen.out / 'p1'} came of an earlier run")


def test_products_that_hold_are_not_called_old_by_an_interrupt(kitchen: Kitchen) -> None:
    kitchen.run()
    kitchen.bodies["b"] = stopped
    with pytest.raises(KeyboardInterrupt) as caught:
        kitchen.run(first="b")
    assert statuses(kitchen) == dict.fromkeys("abc", "done")
    assert not hasattr(caught.value, "__notes__")


def test_a_failure_keeps_later_stages_in_the_record(kitchen: Kitchen) -> None:
    def fail(job: Job) -> dict[str, Any]:
        raise StageError("no heart")

    kitchen.run()
    kitchen.bodies["b"] = fail
    with pytest.raises(StageError):
        kitchen.run(CHANGED)
    assert statuses(kitchen) == {"a": "done", "b": "failed", "c": "stale"}


def test_a_killed_run_has_said_which_products_are_old(kitchen: Kitchen) -> None:
    """A process that is killed says nothing: what it recorded before must do."""
    kitchen.run()
    seen = []

    def killed(job: Job) -> dict[str, Any]:
        seen.append(json.loads((job.products / "run.json").read_text()))
        raise KeyboardInterrupt

    kitchen.bodies["b"] = killed
    with pytest.raises(KeyboardInterrupt):
        kitchen.run(CHANGED)
    [record] = seen
    assert record["status"] == "running"
    assert [stage["status"] for stage in record["stages"].values()] == ["done", "stale", "stale"]


def test_a_skipped_stage_is_not_forgotten_while_it_would_be_skipped_again(
    kitchen: Kitchen,
) -> None:
    def skip(job: Job) -> dict[str, Any]:
        raise Skipped("no ultrasound")

    kitchen.bodies["b"] = skip
    kitchen.bodies["c"] = lambda job: {}
    kitchen.run()
    kitchen.run(last="a")
    assert statuses(kitchen) == {"a": "done", "b": "skipped", "c": "done"}
    # With other settings it may have something to do, and c would then be made from that.
    kitchen.run(CHANGED, last="a")
    assert statuses(kitchen) == {"a": "done", "c": "stale"}


@pytest.mark.parametrize("stage", runner.STAGES, ids=lambda stage: stage.name)
def test_a_stage_reads_no_product_that_it_is_not_made_from(stage: runner.Stage) -> None:
    """Else it would stand when that changes: a registration to another beat, for one."""
    text = (Path(runner.__file__).parent / "stages" / f"{stage.name}.py").read_text()
    used = re.findall(r'products / "(\w+)"|job\.(?:product|figures)\("(\w+)"\)', text)
    assert {one or other for one, other in used} <= set(stage.after)


def test_nothing_is_made_of_files_that_change_while_the_study_runs(kitchen: Kitchen) -> None:
    """Put back afterwards, they would pass for what the product was made of."""
    image = kitchen.folder / "cine" / "image"
    kitchen.run()

    def edited(job: Job) -> dict[str, Any]:
        image.write_text("another heart")
        (job.folder / "text").write_text(f"a({image.read_text()})")
        return {}

    kitchen.bodies["a"] = edited
    image.write_text("second")
    with pytest.raises(InputError, match=r"image: changed while the study ran.*stage a"):
        kitchen.run()
    assert kitchen.text("a") == "a(first)"
    del kitchen.bodies["a"]
    image.write_text("second")
    kitchen.run()
    assert kitchen.text("c") == "c(a(second),b(a(second)))"


@pytest.mark.parametrize("left", ["the folder", "nothing"])
def test_files_that_vanish_while_the_study_runs_are_told(kitchen: Kitchen, left: str) -> None:
    cine = kitchen.folder / "cine"
    named = cine if left == "the folder" else kitchen.folder / "heart.nii"
    if named != cine:
        (cine / "image").rename(named)
        cine.rmdir()
        (kitchen.folder / "study.yaml").write_text("patient_id: p1\ncine: {path: heart.nii}\n")

    def emptied(job: Job) -> dict[str, Any]:
        (job.folder / "text").write_text("made of what is gone")
        (cine / "image" if named == cine else named).unlink()
        return {}

    kitchen.bodies["a"] = emptied
    with pytest.raises(InputError, match=r"(image|heart\.nii): changed while the study ran"):
        kitchen.run()
    assert not (kitchen.out / "p1" / "a").exists()


def test_a_run_that_is_refused_at_once_tells_of_what_stands(
    kitchen: Kitchen,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kitchen.run()
    (kitchen.folder / "study.yaml").write_text("patient_id: p1\ncine: {path: other.nii}\n")
    assert main(["run", str(kitchen.folder), "--out", str(kitchen.out)]) == 2
    said = capsys.readouterr().err
    assert "other.nii does not exist" in said
    assert f"note: {kitchen.out / 'p1'} holds products of another run; do not use them" in said
    # Nobody knows of another folder's products, or of another study's.
    assert main(["run", str(kitchen.folder), "--out", str(tmp_path / "none")]) == 2
    other = tmp_path / "other"
    (other / "cine").mkdir(parents=True)
    (other / "study.yaml").write_text("nothing: known\n")
    assert main(["run", str(other), "--out", str(kitchen.out)]) == 2
    assert "note:" not in capsys.readouterr().err
    # A folder with one study means it; of several none was meant.
    above = kitchen.folder.parent
    assert main(["run", str(above), "--out", str(kitchen.out)]) == 2
    assert f"note: {kitchen.out / 'p1'} holds" in capsys.readouterr().err
    (above / "p2" / "cine").mkdir(parents=True)
    assert main(["run", str(above), "--out", str(kitchen.out)]) == 2
    said = capsys.readouterr().err
    assert "holds 2 studies" in said
    assert "note:" not in said

    def closed(folder: Path) -> list[Path]:
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    # What cannot be looked into hides nothing of what is wrong.
    monkeypatch.setattr("pipeline.study.studies_in", closed)
    given = [str(above), "--out", str(kitchen.out), "--config", str(tmp_path / "none.yaml")]
    assert main(["run", *given]) == 2
    assert "none.yaml" in capsys.readouterr().err


def test_a_field_of_an_earlier_run_is_told(kitchen: Kitchen, tmp_path: Path) -> None:
    products = kitchen.out / "p1"
    field = products / "bake" / "field.zarr"
    field.mkdir(parents=True)
    assert stale_words(field) == ""
    for status, told in (("done", False), ("stale", True), ("failed", True), ("running", True)):
        (products / "run.json").write_text(json.dumps({"stages": {"bake": {"status": status}}}))
        assert bool(stale_words(field)) == told
        assert stale_words(products / "field.zarr") == stale_words(Path("/field.zarr")) == ""
    for other in ("[]", '{"stages": 1}', '{"stages": {"bake": []}}', "{"):
        (products / "run.json").write_text(other)
        assert stale_words(field) == ""
