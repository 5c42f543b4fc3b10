"""A folder of patients: one that fails or crashes costs only itself."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from batch_program import rows_of, stand_in

from pipeline.batch_plan import Plan
from pipeline.batch_table import outcome_of, rows
from pipeline.cli import main
from pipeline.errors import NOT_TO_BE_USED as OLD

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
volumes_ml = {"lv_endocardium": [150.0, 58.5], "rv_endocardium": [160.0, 72.0]}
shape = {"lv_ejection_fraction": 0.61, "rv_ejection_fraction": 0.55, "lv_mass_g": 120.0}
figures = {"surface": {"figures": shape | {"volumes_ml": volumes_ml}},
           "register": {"figures": {"verdict": "doubtful", "expected_tre_mm": 2.125}},
           "evaluate": {"figures": {"target_registration_error_mm": 1.25}}}
(out / study.name).mkdir(exist_ok=True)
if study.name == "unbaked":
    old = figures["evaluate"] | {"status": "stale"}
    figures |= {"bake": {"status": "failed", "cause": "too steep"}, "evaluate": old}
(out / study.name / "run.json").write_text(json.dumps({"study": str(study), "stages": figures}))
(out / study.name / "options").write_text(" ".join(sys.argv[7:]))
if study.name == "unbaked":
    print("error: too steep", file=sys.stderr); sys.exit(1)
"""

BAD = ("crashes", "fails", "raises", "unbaked")

HEART = {
    "lv_ejection_fraction": "0.61",
    "rv_ejection_fraction": "0.55",
    "lv_end_diastolic_volume_ml": "150.0",
    "lv_end_systolic_volume_ml": "58.5",
    "rv_end_diastolic_volume_ml": "160.0",
    "rv_end_systolic_volume_ml": "72.0",
    "lv_mass_g": "120.0",
}


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in (*BAD, "good", "well"):
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
        "unbaked": "failed",
        "well": "done",
    }
    assert rows["fails"]["cause"] == "cine: missing slice"
    assert signal.Signals.SIGSEGV.name in rows["crashes"]["cause"]
    assert "RuntimeError: a bug" in rows["raises"]["cause"]
    assert HEART.items() <= rows["good"].items()
    assert rows["well"]["target_registration_error_mm"] == "1.25"
    assert (rows["well"]["registration"], rows["well"]["expected_tre_mm"]) == ("doubtful", "2.125")
    assert rows["fails"]["registration"] == ""
    printed = capsys.readouterr().out
    for name, row in rows.items():
        assert name in printed
        assert row["cause"] in printed


def test_what_finished_stages_measured_is_told_of_a_study_that_failed_later(
    studies: Path, tmp_path: Path
) -> None:
    """But nothing that an earlier run made of something else, and nothing of an earlier run.

    The second time all is as it was, to the byte.
    """
    out = tmp_path / "out"
    (out / "unbaked" / "surface").mkdir(parents=True)
    (out / "unbaked" / "surface" / "stage.json").touch()
    for _ in range(2):
        assert main(["batch", str(studies), "--out", str(out)]) == 1
        row = rows_of(out)["unbaked"]
        assert HEART.items() <= row.items()
        assert (row["expected_tre_mm"], row["target_registration_error_mm"]) == ("2.125", "")
        assert (
            row["cause"] == f"too steep; evaluate in {out / 'unbaked'} came of another run; {OLD}"
        )
    earlier = json.loads((out / "unbaked" / "run.json").read_text())
    (out / "fails").mkdir()
    record = json.dumps(earlier | {"study": str(studies / "fails")})
    (out / "fails" / "run.json").write_text(record)
    assert main(["batch", str(studies), "--out", str(out)]) == 1
    row = rows_of(out)["fails"]
    assert (row["products"], row["lv_mass_g"]) == (str(out / "fails"), "")


def test_until_ends_each_study_after_a_stage(
    studies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    main(["batch", str(studies), "--out", str(out), "--until", "surface"])
    assert (out / "well" / "options").read_text() == "--until surface"
    assert main(["batch", str(studies), "--out", str(out), "--until", "faces"]) == 2
    assert "no stage 'faces'" in capsys.readouterr().err


def test_all_done_is_exit_code_0(studies: Path, tmp_path: Path) -> None:
    for name in BAD:
        os.renames(studies / name, tmp_path / "elsewhere" / name)
    assert main(["batch", str(studies), "--out", str(tmp_path / "out"), "--workers", "3"]) == 0


def test_a_folder_that_is_no_study_is_listed_and_costs_nothing(
    studies: Path, tmp_path: Path
) -> None:
    for name in BAD:
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
    outcome = outcome_of(Plan("a", Path("a"), "a"), "done", "", record=record).outcome
    assert outcome.registration == verdict
    assert outcome.remarks == (f"not registered: {cause}" if verdict else "")


def test_studies_of_which_no_images_are_known_are_not_called_the_same() -> None:
    ended = [outcome_of(Plan(name, Path(name)), "failed", "no cine") for name in "ab"]
    assert [one.remarks for one in rows(ended)] == ["", ""]
