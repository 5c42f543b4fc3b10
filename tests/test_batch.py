"""A folder of patients: one that fails or crashes costs only itself."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from batch_program import rows_of, stand_in

from pipeline.batch_table import outcome_of
from pipeline.cli import main

# Stands in for the pipeline's own process: the patient's name says how its run ends.
PROGRAM = """
import json, os, pathlib, signal, sys
study, out = pathlib.Path(sys.argv[4]), pathlib.Path(sys.argv[6])
if study.name == "fails":
    print("error: cine: missing slice", file=sys.stderr); sys.exit(2)
if study.name == "crashes":
    os.kill(os.getpid(), signal.SIGSEGV)
if study.name == "raises":
    raise RuntimeError("a bug")
figures = {"surface": {"figures": {"lv_ejection_fraction": 0.61}},
           "register": {"figures": {"verdict": "doubtful", "expected_tre_mm": 2.125}},
           "evaluate": {"figures": {"target_registration_error_mm": 1.25}}}
(out / study.name).mkdir()
(out / study.name / "run.json").write_text(json.dumps({"study": str(study), "stages": figures}))
"""


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("crashes", "fails", "good", "raises", "well"):
        (tmp_path / "studies" / name / "cine").mkdir(parents=True)
        (tmp_path / "studies" / name / "cine" / "image").touch()
    monkeypatch.setattr("sys.executable", stand_in(tmp_path, PROGRAM))
    return tmp_path / "studies"


def test_each_patient_ends_alone_and_the_table_says_how(
    studies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["batch", str(studies), "--out", str(out), "--workers", "2"]) == 1
    rows = rows_of(out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "crashes": "crashed",
        "fails": "failed",
        "good": "done",
        "raises": "crashed",
        "well": "done",
    }
    assert rows["fails"]["cause"] == "cine: missing slice"
    assert signal.Signals.SIGSEGV.name in rows["crashes"]["cause"]
    assert "RuntimeError: a bug" in rows["raises"]["cause"]
    assert rows["good"]["lv_ejection_fraction"] == "0.61"
    assert rows["well"]["target_registration_error_mm"] == "1.25"
    assert (rows["well"]["registration"], rows["well"]["expected_tre_mm"]) == ("doubtful", "2.125")
    assert rows["fails"]["registration"] == ""
    printed = capsys.readouterr().out
    for name, row in rows.items():
        assert name in printed
        assert row["cause"] in printed


def test_all_done_is_exit_code_0(studies: Path, tmp_path: Path) -> None:
    for name in ("crashes", "fails", "raises"):
        os.renames(studies / name, tmp_path / "elsewhere" / name)
    assert main(["batch", str(studies), "--out", str(tmp_path / "out"), "--workers", "3"]) == 0


def test_a_folder_that_is_no_study_is_listed_and_costs_nothing(
    studies: Path, tmp_path: Path
) -> None:
    for name in ("crashes", "fails", "raises"):
        os.renames(studies / name, tmp_path / "elsewhere" / name)
    for name in ("cines/a", ".git"):
        (studies / name).mkdir(parents=True)
    out = studies / "products"
    assert main(["batch", str(studies), "--out", str(out)]) == 0
    rows = rows_of(out)
    assert {name: row["status"] for name, row in rows.items()} == {
        "cines": "no study",
        "good": "done",
        "well": "done",
    }
    assert "neither cine/ nor study.yaml" in rows["cines"]["cause"]


@pytest.mark.parametrize(
    ("cause", "verdict"),
    [
        ("no tracked ultrasound: the field is in the frame of the MR", ""),
        ("two poses agree alike; the field is in the frame of the MR", "failed"),
    ],
)
def test_ultrasound_that_was_not_registered_is_told_from_none(cause: str, verdict: str) -> None:
    """`on_failure: mr_frame`: the study is done, its registration is not."""
    record = {"stages": {"register": {"status": "skipped", "cause": cause}}}
    outcome = outcome_of("a", "done", "", "a", Path("a"), record=record).outcome
    assert outcome.registration == verdict
    assert outcome.remarks == (f"not registered: {cause}" if verdict else "")
