"""What a study's folder is understood to be, and what is refused."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.ecg import read_ecg
from pipeline.study import EcgFiles, open_study
from pipeline.study_files import files_below


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


def test_study_yaml_overrides_only_the_keys_it_gives(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    found = open_study(folder)
    (folder / "study.yaml").write_text("patient_id: robot-01\n")
    assert open_study(folder) == found.model_copy(update={"patient_id": "robot-01"})
    start = [[1.0, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (folder / "study.yaml").write_text(f"us: {{initial_mr_from_tracker: {start}}}\n")
    study = open_study(folder)
    assert study.us is not None
    assert found.us is not None
    assert study.us.sweeps == found.us.sweeps
    assert study.us.initial_mr_from_tracker == start
    (folder / "ecg" / "mr.hea").rename(folder / "other.hea")
    (folder / "study.yaml").write_text("ecg: {mr: other}\n")
    assert open_study(folder).ecg.mr == folder / "other"
    assert open_study(folder).ecg.us == folder / "ecg" / "us"


# Of no plane, some 40 mm about their middle, as apex, valves and the insertions of a ventricle.
TOUCHED_MM = np.array([[40.0, 0, 10], [-30, 25, 0], [-20, -35, 5], [0, 10, -45]])


def study_with_landmarks(root: Path, in_mr: Float, in_tracker: Float, more: str = "") -> Path:
    folder = study_folder(root)
    pairs = zip(in_mr.tolist(), in_tracker.tolist(), strict=True)
    told = [{"mr_mm": one, "tracker_mm": other} for one, other in pairs]
    (folder / "study.yaml").write_text(f"us: {{landmarks: {told}{more}}}\n")
    return folder


@pytest.mark.parametrize("count", [3, 4])
def test_landmarks_tell_where_the_tracker_stands(tmp_path: Path, count: int) -> None:
    truth = Rotation.from_rotvec([100, -70, 150], degrees=True)
    in_tracker = TOUCHED_MM[:count]
    in_mr = np.array([150, -40, 300]) + truth.apply(in_tracker)
    study = open_study(study_with_landmarks(tmp_path, in_mr, in_tracker))
    assert study.us is not None
    start = study.us.start()
    assert start is not None
    np.testing.assert_allclose(start[:3, :3], truth.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(start[:3, 3], (150, -40, 300), atol=1e-6)
    assert np.array_equal(start[3], (0, 0, 0, 1))


def test_landmarks_some_millimetres_off_are_a_start_within_capture(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    truth = Rotation.from_rotvec([20, 160, -30], degrees=True)
    in_mr = truth.apply(TOUCHED_MM) + rng.normal(scale=5, size=TOUCHED_MM.shape)
    study = open_study(study_with_landmarks(tmp_path, in_mr, TOUCHED_MM))
    assert study.us is not None
    start = study.us.start()
    assert start is not None
    # By another solver, which is given the same points about their middle.
    turn, _ = Rotation.align_vectors(in_mr - in_mr.mean(0), TOUCHED_MM - TOUCHED_MM.mean(0))
    np.testing.assert_allclose(start[:3, :3], turn.as_matrix(), atol=1e-9)
    assert np.degrees((turn * truth.inv()).magnitude()) < 20
    assert np.linalg.norm(start[:3, 3]) < 20


@pytest.mark.parametrize(
    ("in_mr", "in_tracker", "more", "words"),
    [
        (TOUCHED_MM[:2], TOUCHED_MM[:2], "", r"us\.landmarks"),
        (TOUCHED_MM * (1, 0, 0), TOUCHED_MM * (1, 0, 0), "", "by mr_mm they lie 0.0 mm beside"),
        (TOUCHED_MM, TOUCHED_MM * (1, 0.1, 0.1), "", "by tracker_mm they lie"),
        (TOUCHED_MM, TOUCHED_MM[[1, 0, 2, 3]], "", "no rigid motion brings them together"),
        (TOUCHED_MM, TOUCHED_MM * (1, -1, 1), "", "no rigid motion brings them together"),
        (TOUCHED_MM, TOUCHED_MM * 10, "", "are all in millimetres"),
        (TOUCHED_MM * np.nan, TOUCHED_MM, "", "finite number"),
        (TOUCHED_MM, TOUCHED_MM, f", initial_mr_from_tracker: {np.eye(4).tolist()}", "take one"),
    ],
)
def test_landmarks_that_tell_no_start_are_refused(
    tmp_path: Path, in_mr: Float, in_tracker: Float, more: str, words: str
) -> None:
    folder = study_with_landmarks(tmp_path, in_mr, in_tracker, more)
    text = (folder / "study.yaml").read_text().replace("nan", ".nan")
    (folder / "study.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        open_study(folder)


@pytest.mark.parametrize("name", ["mr.edf", "mr.dat"])
def test_a_record_of_a_kind_that_is_not_read_is_refused(tmp_path: Path, name: str) -> None:
    folder = study_folder(tmp_path)
    for one in (folder / "ecg").glob("mr.*"):
        one.unlink()
    assert open_study(folder).ecg.mr is None
    (folder / "ecg" / name).write_text("x")
    with pytest.raises(InputError, match=rf"{name}: would not be read; convert it to WFDB"):
        open_study(folder)
    (folder / "study.yaml").write_text("ecg: {mr: null}\n")
    assert open_study(folder).ecg.mr is None


def test_null_takes_out_what_the_folders_hold(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "study.yaml").write_text("us: null\necg: {mr: null}\n")
    study = open_study(folder)
    assert study.us is None
    assert study.ecg.mr is None


@pytest.mark.parametrize("text", ["", "# patient_id: robot-01\n"])
def test_an_empty_study_yaml_changes_nothing(tmp_path: Path, text: str) -> None:
    folder = study_folder(tmp_path)
    found = open_study(folder)
    (folder / "study.yaml").write_text(text)
    assert open_study(folder) == found


@pytest.mark.parametrize("name", ["study.yml", "Study.yaml", "Study.yaml.txt"])
def test_a_description_under_another_name_is_not_overlooked(tmp_path: Path, name: str) -> None:
    folder = study_folder(tmp_path)
    (folder / name).write_text("patient_id: robot-01\n")
    with pytest.raises(InputError, match=rf"{name}: would not be read; rename it to study\.yaml"):
        open_study(folder)


@pytest.mark.parametrize("name", ["cine/cine_timing.json", "timing.json", "cine/Timing.json"])
def test_timing_under_another_name_is_not_overlooked(tmp_path: Path, name: str) -> None:
    (tmp_path / "p1" / "cine").mkdir(parents=True)
    (tmp_path / "p1" / "cine" / "cine.nii.gz").write_bytes(b"0")
    (tmp_path / "p1" / name).write_text("{}")
    with pytest.raises(InputError, match=f"{name}: would not be read; name it .*cine/timing.json"):
        open_study(tmp_path / "p1")
    (tmp_path / "p1" / "study.yaml").write_text(f"cine: {{timing: {name}}}\n")
    timing = open_study(tmp_path / "p1").cine.timing
    assert timing is not None
    assert timing.samefile(tmp_path / "p1" / name)


def test_a_study_may_have_no_ecg_at_all(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "study.yaml").write_text("us: null\necg: null\n")
    assert open_study(folder).ecg == EcgFiles()


@pytest.mark.parametrize("ending", ["", ".hea", ".dat"])
def test_a_wfdb_record_is_all_its_files_however_it_is_named(tmp_path: Path, ending: str) -> None:
    """Or else a change of the signal would leave products standing that were made of another."""
    folder = study_folder(tmp_path)
    (folder / "study.yaml").write_text(f"ecg: {{mr: ecg/mr{ending}}}\n")
    files = open_study(folder).input_files()["mr_ecg"]
    assert [path.name for path in files] == ["mr.dat", "mr.hea"]


@pytest.mark.parametrize("there", [True, False])
def test_signals_that_a_wfdb_header_names_are_looked_for(tmp_path: Path, there: bool) -> None:
    folder = study_folder(tmp_path)
    header = (
        "# by hand\nus 2 500 1000\nother.dat 16 200 16 0 0 0 0 I\nother.dat 16 200 16 0 0 0 0 II\n"
    )
    (folder / "ecg" / "us.hea").write_text(header)
    if there:
        (folder / "ecg" / "other.dat").touch()
        assert open_study(folder).ecg.us == folder / "ecg" / "us"
    else:
        with pytest.raises(InputError, match=r"us\.hea: names other\.dat, which is not beside it"):
            open_study(folder)


@pytest.mark.parametrize(
    ("name", "right"), [("ultrasound", "us"), ("US", "us"), ("ECG", "ecg"), ("ekg", "ecg")]
)
def test_a_folder_whose_name_is_nearly_right_is_told(tmp_path: Path, name: str, right: str) -> None:
    folder = study_folder(tmp_path)
    # In two steps, for file systems to which US and us are one.
    (folder / right).rename(folder / "moved")
    (folder / "moved").rename(folder / name)
    if not (folder / right).exists():
        with pytest.raises(InputError, match=rf"{name}: would not be read; rename it to {right}/"):
            open_study(folder)
        (folder / right).mkdir()
        with pytest.raises(InputError, match=rf"{name}: would not be read"):
            open_study(folder)
    (folder / "study.yaml").write_text("us: null\necg: null\n")
    assert open_study(folder).us is None
    (folder / "study.yaml").unlink()
    shutil.rmtree(folder / name)
    (folder / "sweeps").mkdir()
    study_folder(tmp_path)
    assert open_study(folder).us is not None


@pytest.mark.parametrize("name", ["us/sweep.nrrd", "us/left/sweep.mha", "us/left/sweep.MHD"])
def test_ultrasound_that_is_not_found_is_not_taken_for_none(tmp_path: Path, name: str) -> None:
    folder = study_folder(tmp_path, us=False)
    (folder / name).parent.mkdir(parents=True)
    (folder / "us" / ".DS_Store").touch()
    assert open_study(folder).us is None
    (folder / name).touch()
    said = rf"us: {Path(name).relative_to('us')} would not be read"
    with pytest.raises(InputError, match=said):
        open_study(folder)
    (folder / "study.yaml").write_text("us: null\n")
    assert open_study(folder).us is None


def test_a_sweep_in_a_folder_of_its_own_beside_others_is_not_passed_over(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "us" / "sweep_002.MHA").touch()
    assert len(open_study(folder).us.sweeps) == 3
    (folder / "us" / "notes.txt").touch()
    assert len(open_study(folder).us.sweeps) == 3
    (folder / "us" / "left").mkdir()
    for name in ("left/sweep_003.mha", "sweep.seq.nrrd"):
        (folder / "us" / name).touch()
        with pytest.raises(InputError, match=rf"{name} would not be read"):
            open_study(folder)
        (folder / "us" / name).unlink()


@pytest.mark.parametrize("name", ["us.csv", "us.CSV", "us.dcm", "us.DCM"])
def test_a_record_is_found_whatever_letters_its_ending_has(tmp_path: Path, name: str) -> None:
    folder = study_folder(tmp_path)
    for ending in (".hea", ".dat"):
        (folder / "ecg" / f"us{ending}").unlink()
    (folder / "ecg" / name).touch()
    assert open_study(folder).ecg.us == folder / "ecg" / name


def test_two_sweeps_of_one_name_are_refused(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "us" / "sweep_001.mhd").write_text("ElementDataFile = sweep_001.raw\n")
    with pytest.raises(InputError, match=r"2 sweeps are called sweep_001, .* rename or move"):
        open_study(folder)
    (folder / "us" / "sweep_001.mhd").unlink()
    (folder / "study.yaml").write_text("us: {sweeps: [us/sweep_000.mha, us/sweep_000.mha]}\n")
    with pytest.raises(InputError, match="2 sweeps are called sweep_000"):
        open_study(folder)


def test_files_that_headers_name_are_input_too(tmp_path: Path) -> None:
    """Or else a change of them would leave products standing that were made of others."""
    folder = study_folder(tmp_path)
    ecg, us = folder / "ecg", folder / "us"
    (ecg / "us.hea").write_text("us/3 2 500 2000\nfirst 1000\n~ 500\nus_second 500\n")
    (ecg / "first.hea").write_text("first 1 500 1000\nfirst_signal.dat 16 200 16 0 0 0 0 I\n")
    (ecg / "us_second.hea").write_text("us_second 1 500 500\nlate.dat 16 200 16 0 0 0 0 I\n")
    for name in ("first_signal.dat", "late.dat"):
        (ecg / name).touch()
    (us / "sweep_000.mha").write_text("ObjectType = Image\nElementDataFile = LOCAL\n")
    (us / "sweep_002.mhd").write_text("ObjectType = Image\nElementDataFile = left.zraw\n")
    (us / "sweep_003.mhd").write_text("ObjectType = Image\nElementDataFile: part%03d.raw 1 2 1\n")
    for name in ("left.zraw", "part001.raw", "part002.raw"):
        (us / name).touch()
    files = [path.name for path in open_study(folder).input_files()["us"]]
    of_ecg = {"us.hea", "us.dat", "first.hea", "first_signal.dat", "us_second.hea", "late.dat"}
    assert of_ecg < set(files)
    assert {"sweep_002.mhd", "left.zraw", "sweep_003.mhd", "part002.raw"} < set(files)
    (ecg / "first.hea").unlink()
    with pytest.raises(InputError, match=r"us\.hea: names first, which is not beside it"):
        open_study(folder)


def test_records_that_name_each_other_are_refused(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    for name, other in (("us", "b"), ("b", "us")):
        (folder / "ecg" / f"{name}.hea").write_text(f"{name}/1 1 500 2000\n{other} 2000\n")
    assert {"us.hea", "b.hea"} < {path.name for path in open_study(folder).input_files()["us"]}
    with pytest.raises(InputError, match=r"us\.hea"):
        read_ecg(folder / "ecg" / "us")


def test_a_record_may_have_brackets_in_its_name(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    for ending in ("hea", "dat"):
        (folder / "ecg" / f"us.{ending}").rename(folder / "ecg" / f"us[1].{ending}")
    (folder / "study.yaml").write_text("ecg: {us: 'ecg/us[1]'}\n")
    assert {"us[1].hea", "us[1].dat"} < {p.name for p in open_study(folder).input_files()["us"]}


def test_folders_behind_links_are_read_and_closed_ones_told(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    elsewhere = tmp_path / "archive"
    elsewhere.mkdir()
    (elsewhere / "image").touch()
    (folder / "cine" / "slice").symlink_to(elsewhere)
    (elsewhere / "round").symlink_to(folder / "cine")
    found = open_study(folder).input_files()["cine"]
    assert folder.resolve() / "cine" / "slice" / "image" in found
    (folder / "cine" / "again").symlink_to(folder / "cine" / "slice")
    assert len(open_study(folder).input_files()["cine"]) == len(found)
    assert len({path.resolve() for path in found}) == len(found)
    (folder / "cine" / "lost").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="lost: is a link that leads nowhere"):
        open_study(folder)
    (folder / "cine" / "lost").unlink()

    def closed(*_: object, onerror: Callable[[OSError], None], **__: object) -> Iterator[None]:
        onerror(PermissionError(13, "Permission denied", str(folder / "cine")))
        yield from ()

    with (
        mock.patch.object(os, "walk", closed),
        pytest.raises(InputError, match="cine: cannot be entered"),
    ):
        files_below(folder / "cine")


def test_hidden_folders_are_passed_over(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    before = files_below(folder / "cine")
    (folder / "cine" / ".AppleDouble").mkdir()
    (folder / "cine" / ".AppleDouble" / "001").write_text("x")
    assert files_below(folder / "cine") == before


@pytest.mark.parametrize("path", ['"\\0"', "a" * 300])
def test_a_place_that_no_file_system_has_is_refused(tmp_path: Path, path: str) -> None:
    folder = study_folder(tmp_path)
    (folder / "study.yaml").write_text(f"cine: {{path: {path}}}\n")
    with pytest.raises(InputError, match=r"study\.yaml: names a place that cannot be looked at"):
        open_study(folder)


@pytest.mark.parametrize("path", [None, "cine", "cine/cine.nii.gz"])
def test_a_nifti_cine_has_its_timing_however_it_is_named(tmp_path: Path, path: str | None) -> None:
    cine = tmp_path / "p" / "cine"
    cine.mkdir(parents=True)
    for name in ("cine.nii.gz", "timing.json"):
        (cine / name).touch()
    named = f"path: {path}, " if path else ""
    (tmp_path / "p" / "study.yaml").write_text(f"cine: {{{named}rr_ms: 800}}\n")
    study = open_study(tmp_path / "p")
    assert study.cine.path == cine / "cine.nii.gz"
    assert study.cine.timing == cine / "timing.json"
    assert study.cine.rr_ms == 800


def test_of_two_nifti_files_study_yaml_names_one(tmp_path: Path) -> None:
    cine = tmp_path / "p" / "cine"
    cine.mkdir(parents=True)
    for name in ("a.nii.gz", "b.nii.gz"):
        (cine / name).touch()
    with pytest.raises(InputError, match=r"holds 2 NIfTI files .* join them into one and write"):
        open_study(tmp_path / "p")
    (tmp_path / "p" / "study.yaml").write_text("cine: {path: cine/b.nii.gz}\n")
    assert open_study(tmp_path / "p").cine.path == cine / "b.nii.gz"


@pytest.mark.parametrize("name", ["a.dcm", "B.IMA", "IM0001", "DICOMDIR"])
def test_a_nifti_file_among_dicom_files_does_not_hide_them(tmp_path: Path, name: str) -> None:
    cine = tmp_path / "p" / "cine"
    cine.mkdir(parents=True)
    for one in (name, "x.nii.gz", ".DS_Store", "notes.txt"):
        (cine / one).touch()
    with pytest.raises(InputError, match=rf"x\.nii\.gz, a NIfTI file, and {name}"):
        open_study(tmp_path / "p")
    (tmp_path / "p" / "study.yaml").write_text("cine: {path: cine/x.nii.gz}\n")
    assert open_study(tmp_path / "p").cine.path == cine / "x.nii.gz"
    (cine / name).unlink()
    (tmp_path / "p" / "study.yaml").unlink()
    assert open_study(tmp_path / "p").cine.path == cine / "x.nii.gz"


def test_gaps_of_a_nifti_cine_are_not_silently_left_open(tmp_path: Path) -> None:
    cine = tmp_path / "p" / "cine"
    cine.mkdir(parents=True)
    (cine / "x.nii").touch()
    (tmp_path / "p" / "study.yaml").write_text("cine: {fill_gaps: true}\n")
    with pytest.raises(
        InputError, match=r"cine\.fill_gaps: applies to DICOM only.*x\.nii is NIfTI"
    ):
        open_study(tmp_path / "p")
    (tmp_path / "p" / "study.yaml").write_text("cine: {leave_out_series: [3]}\n")
    with pytest.raises(InputError, match=r"cine\.leave_out_series: .*NIfTI, which has no series"):
        open_study(tmp_path / "p")
    (tmp_path / "p" / "study.yaml").write_text("cine: {fill_gaps: false}\n")
    assert open_study(tmp_path / "p").cine.path == cine / "x.nii"


def test_long_axis_views_beside_dicom_files_are_not_overlooked(tmp_path: Path) -> None:
    folder = study_folder(tmp_path)
    (folder / "long_axis").mkdir()
    assert open_study(folder).cine.path == folder / "cine"
    (folder / "long_axis" / "four_chamber.nii.gz").touch()
    with pytest.raises(InputError, match="long_axis: is read beside a NIfTI cine only"):
        open_study(folder)


def test_a_folder_whose_name_is_no_patient_id_is_refused(tmp_path: Path) -> None:
    study_folder(tmp_path).rename(tmp_path / "patient 7")
    with pytest.raises(InputError, match=r"patient 7: its name is no patient id.*rename"):
        open_study(tmp_path / "patient 7")
    (tmp_path / "patient 7" / "study.yaml").write_text("patient_id: p7\n")
    assert open_study(tmp_path / "patient 7").patient_id == "p7"


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("cien: {path: cine}", r"cien: unknown key; did you mean cine\?"),
        ("us: {pose_frame: my_marker}", r"us\.pose_frame: needs letters and digits alone"),
        ("us: {sweps: [us/sweep_000.mha]}", r"us.sweps: unknown key; did you mean sweeps\?"),
        ("qwerty: 1", "qwerty: unknown key; check its spelling"),
        ("rr_ms: 800", "rr_ms: unknown key; it belongs under cine"),
        ("breath: free", r"it belongs in the configuration \(--config\), under register"),
        ("us: {fill_gaps: true}", "us.fill_gaps: unknown key; it belongs under cine"),
        ("cine: {us: lab}", "cine.us: unknown key; it belongs at the top level or under ecg"),
        ("folder: cine", "folder: unknown key; check its spelling"),
        (
            "patient_id: 7",
            r"patient_id: needs text; put it in quotes as it stands in the file \(got 7\)",
        ),
        ("patient_id: 2024-01-02", "patient_id: needs text; put it in quotes"),
        ("patient_id: A 7", "patient_id: needs letters, digits and '_ . -' alone"),
        (
            "cine: mr",
            r"cine: needs keys below it \(path, timing, rr_ms, leave_out_series, fill_gaps, spoilt",
        ),
        (
            "cine: {}\necg: {}\ncine: {rr_ms: 9}",
            "line 3: cine is given a second time, after line 1",
        ),
        ("cine: {rr_ms: 800,\n rr_ms: 900}", "line 2: rr_ms is given a second time, after line 1"),
        ("cine: {timing: ecg/us.dat}", "cine.timing: applies to NIfTI only"),
        ("cine: {path: cine/a.dcm}", "of DICOM files, even of a single one, name the folder"),
        ("us: {initial_mr_from_tracker: [[1, 0], [0]]}", "us.initial_mr_from_tracker"),
        (
            "us: {initial_mr_from_tracker: [[2,0,0,0], [0,1,0,0], [0,0,1,0], [0,0,0,1]]}",
            r"us\.initial_mr_from_tracker: is not a rotation and a shift",
        ),
        ("cine: {path: nowhere}", "nowhere does not exist"),
        ("ecg: {us: ecg/lost}", "no ECG record"),
        ("us: {sweeps: [us/sweep_009.mha]}", "does not exist"),
        ("ecg: {us: null}", "no ECG recorded with it"),
        ("us: {sweeps: us/a.mha}", r"us\.sweeps: needs a list, such as"),
        ("us: {initial_mr_from_tracker: [[1, 0, 0]]}", r"tracker\.0: needs 4 entries, not 3"),
        ("cine: {rr_ms: fast}", r"cine\.rr_ms: needs a number \(got 'fast'\)"),
        ("cine: {rr_ms: true}", "cine: rr_ms: true is no number"),
        ("cine: {spoilt_slices: [1, true]}", "cine: spoilt_slices: true is no number"),
        ("cine: {rr_ms: .inf}", r"cine\.rr_ms: Input should be a finite number"),
        ("cine: {fill_gaps: maybe}", "needs true or false"),
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
