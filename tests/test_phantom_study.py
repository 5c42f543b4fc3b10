"""Whole synthetic studies on disk: readable by others, repeatable, refused when senseless."""

import json
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import pyvista
import yaml

from data_synth.__main__ import ProgressLine, main
from data_synth.dicom import unique_identifier
from data_synth.errors import SynthError
from data_synth.settings import PhantomSettings, read_settings
from data_synth.study import first_guess, publishing, slice_rr_ms, write_study

SMALL = {
    "mr": {
        "phases": 3,
        "slices": 4,
        "slice_gap_mm": 18.0,
        "pixel_mm": 4.0,
        "matrix": 48,
        "through_plane_samples": 1,
    },
    "ultrasound": {"sweeps": 1, "frames": 3, "pixel_mm": 3.0, "beams": 32},
}


def small(**changes: object) -> PhantomSettings:
    return PhantomSettings.model_validate({**SMALL, **changes})


def contents(folder: Path) -> dict[str, bytes]:
    """Every file's bytes by its path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("studies") / "patient-0001"
    write_study(folder, small(seed=4))
    return folder


@pytest.fixture(scope="module")
def truth(study) -> dict:
    return json.loads((study / "truth" / "truth.json").read_text())


def test_study_yaml_names_files_that_exist(study):
    described = yaml.safe_load((study / "study.yaml").read_text())
    assert described["patient_id"] == "patient-0001"
    assert (study / described["cine"]["path"]).is_dir()
    for stem in described["ecg"].values():
        assert (study / f"{stem}.hea").is_file()
    for sweep in described["us"]["sweeps"]:
        assert (study / sweep).is_file()


def test_dicom_files_are_valid_and_place_every_slice(study, truth):
    positions = {}
    for path in sorted((study / "cine").rglob("*.dcm")):
        data = pydicom.dcmread(path)
        assert (
            data.SOPClassUID
            == data.file_meta.MediaStorageSOPClassUID
            == "1.2.840.10008.5.1.4.1.1.4"
        )
        assert data.SOPInstanceUID == data.file_meta.MediaStorageSOPInstanceUID
        assert data.pixel_array.shape == (48, 48)
        assert data.pixel_array.dtype == np.int16
        assert data.PixelSpacing == [4.0, 4.0]
        z, k = data.SeriesNumber - 1, data.InstanceNumber - 1
        rr_ms = truth["rr_ms"][z]
        assert data.NominalInterval == rr_ms
        assert float(data.TriggerTime) == pytest.approx(rr_ms * truth["phases"][k], abs=1e-6)
        positions[z] = np.array(data.ImagePositionPatient, float)
    truth_image = nibabel.load(study / "truth" / "labels_000.nii.gz")
    lps_from_index = np.diag([-1, -1, 1, 1]) @ truth_image.affine
    axes = np.array(data.ImageOrientationPatient, float).reshape(2, 3)
    # NIfTI keeps its matrix in float32: about 1e-7 of 300 mm.
    np.testing.assert_allclose(lps_from_index[:3, :2].T / 4.0, axes, atol=1e-6)
    for z, position in positions.items():
        np.testing.assert_allclose((lps_from_index @ [0, 0, z, 1])[:3], position, atol=1e-4)
    assert np.diff([positions[z] for z in range(4)], axis=0) @ np.cross(*axes) == pytest.approx(
        26.0
    )


def test_uids_are_unique_and_series_share_their_study(study):
    files = [pydicom.dcmread(path, stop_before_pixels=True) for path in study.rglob("*.dcm")]
    assert len(files) == 12
    assert len({data.SOPInstanceUID for data in files}) == 12
    assert len({data.SeriesInstanceUID for data in files}) == 4
    assert len({data.StudyInstanceUID for data in files}) == 1
    assert len({data.FrameOfReferenceUID for data in files}) == 1


def test_uids_are_valid_and_depend_on_their_parts():
    first, second = unique_identifier("a", 1), unique_identifier("a", 2)
    assert first != second
    assert pydicom.uid.UID(first).is_valid
    number = int(first.removeprefix("2.25."))
    assert number < 2**128
    # Version 5 and the RFC 4122 variant.
    assert number >> 76 & 0xF == 5
    assert number >> 62 & 0b11 == 0b10


def test_truth_meshes_share_the_labels_frame_and_the_stated_volumes(study, truth):
    """A mesh that lay in another frame would not enclose the voxels of its label."""
    image = nibabel.load(study / "truth" / "labels_001.nii.gz")
    lps_from_index = np.diag([-1, -1, 1, 1]) @ image.affine
    index = np.argwhere(np.asarray(image.dataobj) == 1)
    voxels = index @ lps_from_index[:3, :3].T + lps_from_index[:3, 3]
    shifts = np.array(truth["slice_shifts_mm"])[index[:, 2]]
    mesh = pyvista.read(study / "truth" / "surfaces" / "lv_endocardium_001.vtp")
    inside = pyvista.PolyData(voxels - shifts).select_interior_points(mesh)
    share = np.asarray(inside["selected_points"]).mean()
    # Facets lie up to h^2 / (8 R) = 0.1 mm inside the true surface, of a cavity 20 mm in radius.
    assert share > 0.97
    assert mesh.volume / 1000 == pytest.approx(truth["volumes_ml"]["lv_endocardium"][1], rel=1e-4)


def test_truth_tells_time_and_place_of_the_ultrasound(study, truth):
    frames = truth["us_frames"]["sweep_000"]
    assert len(frames["times_s"]) == len(frames["phases"]) == 3
    described = yaml.safe_load((study / "study.yaml").read_text())
    start = np.array(described["us"]["initial_mr_from_tracker"])
    off = start @ np.linalg.inv(truth["mr_from_tracker"])
    angle = np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(10.0, abs=1e-6)
    centre = np.array(truth["mr_from_heart"])[:3, 3]
    shift = off[:3, :3] @ centre + off[:3, 3] - centre
    assert np.linalg.norm(shift) == pytest.approx(10.0, abs=1e-6)


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not(study, tmp_path):
    write_study(tmp_path / "again", small(seed=4))
    write_study(tmp_path / "other", small(seed=5))
    first, again, other = (
        contents(study),
        contents(tmp_path / "again"),
        contents(tmp_path / "other"),
    )
    assert first == again
    assert first["cine/001/IM_0001.dcm"] != other["cine/001/IM_0001.dcm"]


def test_nifti_cine_holds_the_same_images_as_dicom(study, tmp_path):
    write_study(tmp_path / "p", small(seed=4, cine="nifti", cine_only=True))
    image = nibabel.load(tmp_path / "p" / "cine" / "cine.nii.gz")
    timing = json.loads((tmp_path / "p" / "cine" / "timing.json").read_text())
    data = pydicom.dcmread(study / "cine" / "002" / "IM_0003.dcm")
    np.testing.assert_array_equal(np.asarray(image.dataobj)[:, :, 1, 2].T, data.pixel_array)
    assert timing["trigger_times_ms"][1][2] == pytest.approx(float(data.TriggerTime))
    assert timing["rr_ms"][1] == data.NominalInterval
    assert not (tmp_path / "p" / "us").exists()
    assert not (tmp_path / "p" / "ecg").exists()


def test_rr_of_a_slice_is_the_mean_over_its_breath_hold():
    r_times_s = np.concatenate([np.arange(0, 7, 0.7), np.arange(7.0, 15.0, 1.0)])
    assert slice_rr_ms(r_times_s, 2) == [700.0, 1000.0]


def test_first_guess_is_rigid():
    truth = np.eye(4)
    truth[:3, 3] = 5, 6, 7
    guess = first_guess(np.random.default_rng(0), truth, np.array([1.0, 2, 3]))
    np.testing.assert_allclose(guess[:3, :3] @ guess[:3, :3].T, np.eye(3), atol=1e-12)


def test_existing_studies_are_kept_unless_overwriting(study, tmp_path, capsys):
    config = tmp_path / "small.yaml"
    config.write_text(yaml.safe_dump(SMALL))
    command = [str(tmp_path / "out"), "--config", str(config), "--cine-only"]
    assert main(command) == 0
    before = contents(tmp_path / "out")
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert contents(tmp_path / "out") == before
    assert main([*command, "--overwrite", "--seed", "9"]) == 0
    assert contents(tmp_path / "out") != before
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["patient-0001"]


def test_a_folder_that_is_no_study_is_never_overwritten(tmp_path):
    (tmp_path / "precious").mkdir()
    with pytest.raises(SynthError, match="no study"):
        write_study(tmp_path / "precious", small(), overwrite=True)


def test_each_patient_can_be_made_alone(tmp_path):
    config = tmp_path / "small.yaml"
    config.write_text(yaml.safe_dump({**SMALL, "cine_only": True}))
    both = [str(tmp_path / "both"), "--patients", "2", "--seed", "4", "--config", str(config)]
    assert main(both) == 0
    write_study(tmp_path / "alone", small(seed=5, patient_id="patient-0002", cine_only=True))
    assert contents(tmp_path / "both" / "patient-0002") == contents(tmp_path / "alone")


def test_a_failure_leaves_nothing_behind(tmp_path):
    def interrupted() -> None:
        with publishing(tmp_path / "p") as partial:
            (partial / "half").write_text("x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SynthError, match="cannot be written"):
        write_study(tmp_path / "file" / "patient-0001", small(cine_only=True))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mr: {phases: 1}", r"mr\.phases.*greater than or equal to 2"),
        ("mr: {snr: 0}", r"mr\.snr.*greater than 0"),
        ("mr: {pixel_mm: -1}", r"mr\.pixel_mm"),
        ("mr: {snr: .nan}", r"mr\.snr"),
        ("heart_rate_bpm: -70", "heart_rate_bpm"),
        ("colour: red", "colour: unknown key"),
        ("mr: {flavour: 1}", r"mr\.flavour: unknown key"),
        ("- 1", "keys and values"),
        ("mr: [", "cannot be read as YAML"),
    ],
)
def test_bad_settings_name_file_key_and_fault(tmp_path, capsys, text, words):
    config = tmp_path / "bad.yaml"
    config.write_text(text)
    with pytest.raises(SynthError, match=words):
        read_settings(config)
    assert main([str(tmp_path / "out"), "--config", str(config)]) == 2
    assert str(config) in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_missing_settings_file_and_a_senseless_count_are_refused(tmp_path, capsys):
    assert main([str(tmp_path / "out"), "--config", str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml" in capsys.readouterr().err
    assert main([str(tmp_path / "out"), "--patients", "0"]) == 2
    assert "--patients" in capsys.readouterr().err
    assert main([str(tmp_path / "out"), "--seed", "-1"]) == 2
    assert "seed" in capsys.readouterr().err


@pytest.mark.parametrize(
    "path", sorted(Path("configs/phantoms").glob("*.yaml")), ids=lambda p: p.stem
)
def test_shipped_phantoms_are_valid(path):
    assert isinstance(read_settings(path), PhantomSettings)


def test_progress_appears_only_for_long_work(capsys):
    line = ProgressLine("patient-0001")
    line(1, 2)
    line.end()
    assert capsys.readouterr().err == ""
    line.next = 0.0
    line(1, 2)
    line.end()
    assert capsys.readouterr().err == "\rpatient-0001:  50 %\n"
