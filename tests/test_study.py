"""What a study's folder is understood to be, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import InputError
from pipeline.study import open_study


def study_folder(root: Path, *, us: bool = True) -> Path:
    """A study of empty files: only names count here."""
    folder = root / "patient-7"
    names = ["cine/a.dcm", "ecg/mr.hea", "ecg/mr.dat"]
    names += ["ecg/us.hea", "ecg/us.dat", "us/sweep_000.mha", "us/sweep_001.mha"] if us else []
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def test_a_study_without_study_yaml_is_understood_from_its_folders(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    study = open_study(folder)
    assert study.patient_id == "patient-7"
    assert study.cine.path == folder / "cine"
    assert study.ecg.us == folder / "ecg" / "us"
    assert study.us is not None
    assert [path.name for path in study.us.sweeps] == ["sweep_000.mha", "sweep_001.mha"]
    files = study.input_files()
    assert {path.name for path in files["mr_ecg"]} == {"mr.hea", "mr.dat"}
    assert {path.name for path in files["us"]} == {
        *("us.hea", "us.dat", "sweep_000.mha", "sweep_001.mha")
    }


def test_only_a_cine_is_a_study(tmp_path: Path) -> None:
    (tmp_path / "p" / "cine").mkdir(parents=True)
    (tmp_path / "p" / "cine" / "x.nii.gz").touch()
    study = open_study(tmp_path / "p")
    assert study.us is None
    assert study.ecg.us is None
    assert study.cine.path.name == "x.nii.gz"


def test_a_folder_with_one_study_stands_for_it(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    assert open_study(tmp_path).folder == folder.resolve()


def test_a_folder_with_two_studies_is_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        study_folder(tmp_path / "x").rename(tmp_path / name)
    (tmp_path / "x").rmdir()
    with pytest.raises(InputError, match="holds 2 studies"):
        open_study(tmp_path)


def test_study_yaml_names_the_files(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "cine").rename(folder / "mr")
    (folder / "study.yaml").write_text("patient_id: Q1\ncine: {path: mr, rr_ms: 850}\n")
    study = open_study(folder)
    assert study.patient_id == "Q1"
    assert study.cine.path == folder / "mr"
    assert study.cine.rr_ms == 850
    assert study.us is None


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("cien: {path: cine}", "cien: unknown key"),
        ("cine: {path: nowhere}", "nowhere does not exist"),
        ("ecg: {us: ecg/lost}", "no ECG record"),
        ("us: {sweeps: [us/sweep_009.mha]}", "does not exist"),
        ("us: {sweeps: [us/sweep_000.mha]}", "no ECG recorded with it"),
        ("cine: {path: cine, rr_ms: -3}", "cine.rr_ms"),
        ("patient_id: ../../etc", "patient_id"),
        ("- a\n- b", "needs keys and values"),
        ("a: [", "cannot be read as YAML"),
    ],
)
def test_a_wrong_study_yaml_is_refused_with_the_key_named(
    tmp_path: Path, yaml: str, words: str
) -> None:
    folder = study_folder(tmp_path)
    (folder / "study.yaml").write_text(yaml)
    with pytest.raises(InputError, match=words):
        open_study(folder)


def test_no_such_study(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such study"):
        open_study(tmp_path / "none")


def test_a_folder_that_is_no_study(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="neither cine/ nor"):
        open_study(tmp_path)


def test_an_empty_cine_folder(tmp_path: Path) -> None:
    (tmp_path / "p" / "cine").mkdir(parents=True)
    with pytest.raises(InputError, match="is empty"):
        open_study(tmp_path / "p")


def test_ultrasound_without_its_ecg(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "ecg" / "us.hea").unlink()
    with pytest.raises(InputError, match="no ECG recorded with it"):
        open_study(folder)
