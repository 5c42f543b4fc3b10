"""Whole synthetic studies on disk: readable by others, repeatable, refused when senseless."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import pyvista
import SimpleITK as sitk
import yaml

from data_synth import load_heart, settings_of, simulate_study, write_study
from data_synth.__main__ import main
from data_synth.errors import SynthError
from data_synth.settings import PhantomSettings
from data_synth.settings_table import settings_table
from data_synth.simulate import BREATH_HOLD_S, first_guess, hold_rr_ms
from data_synth.study import publishing
from data_synth.tissue import TRUTH_LABELS

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
VIEWS = ("two_chamber", "three_chamber", "four_chamber")
# Meshes are stored in float32, which rounds coordinates below 512 mm by half a step of 2^-15 mm.
ROUNDING_MM = 2.0**-15


def small(**changes: object) -> PhantomSettings:
    return PhantomSettings.model_validate({**SMALL, **changes})


def contents(folder: Path) -> dict[str, bytes]:
    """Every file's bytes by its path."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def lps_from_index(image: nibabel.Nifti1Image) -> np.ndarray:
    return np.diag([-1, -1, 1, 1]) @ image.affine


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


def test_images_lie_where_and_when_the_truth_says(study, truth):
    files = [pydicom.dcmread(path) for path in sorted((study / "cine").rglob("*.dcm"))]
    stack = [data for data in files if data.SeriesNumber <= 4]
    assert len(files) == 3 * (4 + 3)
    place = lps_from_index(nibabel.load(study / "truth" / "labels_000.nii.gz"))
    for data in stack:
        z, k = data.SeriesNumber - 1, data.InstanceNumber - 1
        assert float(data.TriggerTime) == pytest.approx(truth["rr_ms"][z] * truth["phases"][k])
        # NIfTI keeps its matrix in float32: about 1e-7 of 300 mm.
        corner = (place @ [0, 0, z, 1])[:3]
        np.testing.assert_allclose(corner, np.array(data.ImagePositionPatient, float), atol=1e-4)


def test_long_axis_views_have_labels_on_their_own_pixels(study, truth):
    """Labels of another view would lie elsewhere, on pixels of other brightness."""
    for number, name in enumerate(VIEWS, start=5):
        data = pydicom.dcmread(study / "cine" / f"{number:03d}" / "IM_0001.dcm")
        image = nibabel.load(study / "truth" / "long_axis" / f"{name}_000.nii.gz")
        labels = np.asarray(image.dataobj)[:, :, 0].T
        corner = np.array(data.ImagePositionPatient, float)
        np.testing.assert_allclose(lps_from_index(image)[:3, 3], corner, atol=1e-4)
        blood = data.pixel_array[labels == TRUTH_LABELS["lv_cavity"][0]]
        muscle = data.pixel_array[labels == TRUTH_LABELS["lv_myocardium"][0]]
        assert np.median(blood) > 1.5 * np.median(muscle)
        assert data.NominalInterval == round(truth["long_axis"][name]["rr_ms"])
        # By anatomy: a four-chamber view shows the right atrium, a two-chamber view does not.
        right_atrium = (labels == TRUTH_LABELS["right_atrium"][0]).sum()
        assert name == "three_chamber" or (right_atrium > 20) == (name == "four_chamber")


def test_truth_meshes_share_the_labels_frame_and_the_stated_volumes(study, truth):
    """A mesh that lay in another frame would not enclose the voxels of its label."""
    image = nibabel.load(study / "truth" / "labels_001.nii.gz")
    place = lps_from_index(image)
    index = np.argwhere(np.asarray(image.dataobj) == 1)
    voxels = index @ place[:3, :3].T + place[:3, 3]
    shifts = np.array(truth["slice_shifts_mm"])[index[:, 2]]
    mesh = pyvista.read(study / "truth" / "surfaces" / "lv_endocardium_001.vtp")
    inside = pyvista.PolyData(voxels - shifts).select_interior_points(mesh)
    share = np.asarray(inside["selected_points"]).mean()
    # Facets lie up to h^2 / (8 R) = 0.1 mm inside the true surface, of a cavity 20 mm in radius.
    assert share > 0.97
    volumes = truth["volumes_ml"]["lv_endocardium"]
    assert mesh.volume / 1000 == pytest.approx(volumes[1], rel=1e-4)
    ventricle = truth["chambers"]["left_ventricle"]
    assert ventricle["largest_ml"] == pytest.approx(volumes[0])
    asked = load_heart(small(seed=4)).pulse.lv_ejection
    # The population's ejection fractions are met within a percent of the volume.
    assert ventricle["ejection_fraction"] == pytest.approx(asked, abs=0.01)


def test_the_truth_alone_gives_place_displacement_and_velocity(study, truth):
    """Settings in truth.json make the same heart; vertex i is one material point throughout."""
    heart = load_heart(settings_of(study))
    np.testing.assert_array_equal(truth["mr_from_heart"], heart.mr_from_heart)
    surfaces = study / "truth" / "surfaces"
    for name in heart.surfaces(0.0):
        first, later = (pyvista.read(surfaces / f"{name}_{k:03d}.vtp") for k in (0, 1))
        np.testing.assert_array_equal(first.regular_faces, later.regular_faces)
        phase = truth["phases"][1]
        moved = np.asarray(later.points, float) - np.asarray(first.points, float)
        asked = heart.displacement_mm(np.asarray(first.points, float), phase)
        # Two roundings of the files, and one of the place that is asked for, strained twofold.
        np.testing.assert_allclose(asked, moved, atol=4 * ROUNDING_MM)
    here = np.asarray(later.points, float)
    step = 1e-4
    ahead = heart.carry(heart.reference(here, phase), phase + step)
    behind = heart.carry(heart.reference(here, phase), phase - step)
    slope = (ahead - behind) / (2 * step * heart.rr_s)
    speed = np.linalg.norm(slope, axis=1).max()
    np.testing.assert_allclose(heart.velocity_mm_s(here, phase), slope, atol=1e-2 * speed)


def test_truth_tells_time_and_place_of_the_ultrasound(study, truth):
    frames = truth["us_frames"]["sweep_000"]
    described = yaml.safe_load((study / "study.yaml").read_text())
    start = np.array(described["us"]["initial_mr_from_tracker"])
    mr_from_tracker = np.array(truth["mr_from_tracker"])
    off = start @ np.linalg.inv(mr_from_tracker)
    angle = np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(10.0, abs=1e-6)
    centre = np.array(truth["mr_from_heart"])[:3, 3]
    shift = off[:3, :3] @ centre + off[:3, 3] - centre
    assert np.linalg.norm(shift) == pytest.approx(10.0, abs=1e-6)
    image = sitk.ReadImage(str(study / "us" / "sweep_000.mha"))
    for k, (stamp, known) in enumerate(
        zip(frames["times_s"], np.array(frames["mr_from_image"]), strict=True)
    ):
        head = f"Seq_Frame{k:04d}_"
        assert float(image.GetMetaData(f"{head}Timestamp")) == stamp
        chain = mr_from_tracker
        for name in ("ProbeToTracker", "ImageToProbe"):
            text = image.GetMetaData(f"{head}{name}Transform")
            chain = chain @ np.array(text.split(), float).reshape(4, 4)
        # Tracker 0.2 mm and 0.1 degrees, calibration 0.3 mm and 0.2 degrees, at a lever of up to
        # 150 mm: 0.2 * sqrt(3) * 4 + 0.3 + 150 mm * (4 * sqrt(3) * 0.1 + 0.2) degrees.
        corner = np.array([20.0, 20.0, 0.0, 1.0])
        lever = 1.4 + 0.3 + 150 * np.deg2rad(0.7 + 0.2)
        assert np.linalg.norm((chain - known) @ corner) < lever
        assert np.abs(chain - known).max() > 0


# The reading library uses a part of pandas that goes out of use.
@pytest.mark.filterwarnings("ignore:The inplace keyword:DeprecationWarning")
def test_beats_are_annotated_for_wfdb_readers(study, truth):
    import wfdb

    for name in ("mr", "us"):
        record = wfdb.rdheader(str(study / "ecg" / name))
        beats = wfdb.rdann(str(study / "truth" / "ecg" / name), "atr")
        marks = [
            sample for sample, code in zip(beats.sample, beats.symbol, strict=True) if code in "NVA"
        ]
        away_s = np.array(marks) / record.fs - truth["r_times_s"][name]
        assert np.abs(away_s).max() <= 0.5 / record.fs + 1e-9
        assert truth["beat_kinds"][name] == ["normal"] * len(marks)


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not(study, tmp_path):
    write_study(tmp_path / "again", small(seed=4))
    write_study(tmp_path / "other", small(seed=5, cine_only=True, long_axis=False))
    first, again = contents(study), contents(tmp_path / "again")
    other = contents(tmp_path / "other")
    assert first == again
    assert first["cine/001/IM_0001.dcm"] != other["cine/001/IM_0001.dcm"]


def test_nifti_cine_holds_the_same_images_as_dicom(study, tmp_path):
    write_study(tmp_path / "p", small(seed=4, cine="nifti", cine_only=True))
    cine = tmp_path / "p" / "cine"
    for path, timing_path, series, z in (
        (cine / "cine.nii.gz", cine / "timing.json", 2, 1),
        (
            cine.parent / "long_axis" / "four_chamber.nii.gz",
            cine.parent / "long_axis" / "four_chamber_timing.json",
            7,
            0,
        ),
    ):
        image, timing = nibabel.load(path), json.loads(timing_path.read_text())
        data = pydicom.dcmread(study / "cine" / f"{series:03d}" / "IM_0003.dcm")
        np.testing.assert_array_equal(np.asarray(image.dataobj)[:, :, z, 2].T, data.pixel_array)
        assert timing["trigger_times_ms"][z][2] == pytest.approx(float(data.TriggerTime))
        assert timing["rr_ms"][z] == data.NominalInterval
    assert not (tmp_path / "p" / "us").exists()
    assert not (tmp_path / "p" / "ecg").exists()


def test_enhanced_cine_holds_every_frame_once(study, tmp_path):
    write_study(tmp_path / "p", small(seed=4, cine="enhanced", cine_only=True))
    files = sorted((tmp_path / "p" / "cine").rglob("*.dcm"))
    assert [pydicom.dcmread(path).NumberOfFrames for path in files] == [12, 3, 3, 3]
    one = pydicom.dcmread(study / "cine" / "001" / "IM_0001.dcm").pixel_array
    stack = pydicom.dcmread(files[0]).pixel_array
    assert any(np.array_equal(frame, one) for frame in stack)


def test_a_volume_is_written_with_isotropic_voxels(tmp_path):
    mr = {"acquisition": "volume", "phases": 2, "volume_voxel_mm": 5.0, "through_plane_samples": 1}
    settings = PhantomSettings.model_validate(
        {"mr": mr, "cine": "nifti", "cine_only": True, "long_axis": False, "seed": 4}
    )
    write_study(tmp_path / "p", settings)
    image = nibabel.load(tmp_path / "p" / "cine" / "cine.nii.gz")
    np.testing.assert_allclose(image.header.get_zooms()[:3], 5.0, rtol=1e-6)
    assert not (tmp_path / "p" / "long_axis").exists()
    labels = np.asarray(nibabel.load(tmp_path / "p" / "truth" / "labels_000.nii.gz").dataobj)
    known = json.loads((tmp_path / "p" / "truth" / "truth.json").read_text())
    counted_ml = (labels == TRUTH_LABELS["lv_cavity"][0]).sum() * 0.125
    # Counting nodes of a lattice h in a body of surface A errs by some h * sqrt(A * h) at most:
    # 5 mm, 150 cm^2 gives 1.4 ml a standard deviation.
    assert counted_ml == pytest.approx(known["volumes_ml"]["lv_endocardium"][0], abs=7)


def test_each_part_of_a_study_draws_from_its_own_stream():
    """Leaving a part out, or changing one, leaves the others as they were."""
    full = simulate_study(small(seed=4))
    part = simulate_study(small(seed=4, cine_only=True, ecg={"baseline_mv": 0.0}))
    assert full.heart == part.heart
    np.testing.assert_array_equal(full.cine.intensity, part.cine.intensity)
    np.testing.assert_array_equal(full.mr_ecg.r_times_s, part.mr_ecg.r_times_s)
    assert part.sweeps == ()
    assert part.us_ecg is None


def test_rr_of_a_breath_hold_is_the_mean_over_it():
    r_times_s = np.concatenate([np.arange(0, 7, 0.7), np.arange(7.0, 15.0, 1.0)])
    assert hold_rr_ms(r_times_s, 0.0, 2) == [700.0, 1000.0]
    assert hold_rr_ms(r_times_s, BREATH_HOLD_S, 1) == [1000.0]


def test_first_guess_is_rigid():
    truth = np.eye(4)
    truth[:3, 3] = 5, 6, 7
    guess = first_guess(np.random.default_rng(0), truth, np.array([1.0, 2, 3]))
    np.testing.assert_allclose(guess[:3, :3] @ guess[:3, :3].T, np.eye(3), atol=1e-12)


def test_existing_studies_are_kept_unless_overwriting(tmp_path, capsys):
    config = tmp_path / "small.yaml"
    config.write_text(yaml.safe_dump({**SMALL, "long_axis": False}))
    command = [str(tmp_path / "out"), "--config", str(config), "--cine-only", "--seed", "4"]
    assert main(command) == 0
    before = contents(tmp_path / "out")
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert contents(tmp_path / "out") == before
    assert main([*command, "--overwrite", "--cine", "nifti"]) == 0
    assert contents(tmp_path / "out") != before
    assert settings_of(tmp_path / "out" / "patient-0001").cine == "nifti"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["patient-0001"]


def test_a_folder_that_is_no_study_is_never_overwritten(tmp_path):
    (tmp_path / "precious").mkdir()
    with pytest.raises(SynthError, match="no study"):
        write_study(tmp_path / "precious", small(), overwrite=True)
    with pytest.raises(SynthError, match=r"truth\.json"):
        settings_of(tmp_path / "precious")


@pytest.mark.parametrize("told", ["null", "3", "[1]", '"a"', "[" * 100_000])
def test_a_truth_without_settings_is_refused_in_words(tmp_path, told):
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "truth.json").write_text('{"settings": ' + told + "}")
    with pytest.raises(SynthError, match=r"truth\.json: holds no phantom's settings"):
        settings_of(tmp_path)


@pytest.mark.slow
def test_each_patient_can_be_made_alone(tmp_path):
    config = tmp_path / "small.yaml"
    config.write_text(yaml.safe_dump({**SMALL, "cine_only": True, "long_axis": False}))
    both = [str(tmp_path / "both"), "--patients", "2", "--seed", "4", "--config", str(config)]
    assert main(both) == 0
    alone = small(seed=5, patient_id="patient-0002", cine_only=True, long_axis=False)
    write_study(tmp_path / "alone", alone)
    assert contents(tmp_path / "both" / "patient-0002") == contents(tmp_path / "alone")


def test_a_failure_leaves_nothing_behind(tmp_path):
    def interrupted() -> None:
        with publishing(tmp_path / "p") as partial:
            (partial / "half").write_text("x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("whole_group", [True, False], ids=["Ctrl-C", "SIGTERM to the program"])
def test_an_interrupted_command_clears_away_what_is_half_done(tmp_path, whole_group):
    """Ctrl-C goes to all programs of a terminal; the work is done by a child of the command."""
    # Whoever runs the tests in the background may have let it be ignored.
    heard = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    start = f"{heard}from pipeline.cli import main; sys.exit(main(['synth', sys.argv[1]]))"
    command = [sys.executable, "-c", start, str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True) as process:
        while process.poll() is None and not list(tmp_path.iterdir()):
            time.sleep(0.05)
        if whole_group:
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_within_the_swap_leaves_the_old_study(tmp_path, monkeypatch):
    with publishing(tmp_path / "p") as partial:
        (partial / "text").write_text("old")
    rename = Path.rename

    def stopped(path, to):
        if to == tmp_path / "p" and "partial" in path.name:
            raise KeyboardInterrupt
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", stopped)
    with pytest.raises(KeyboardInterrupt), publishing(tmp_path / "p") as partial:
        (partial / "text").write_text("new")
    assert [one.name for one in tmp_path.iterdir()] == ["p"]
    assert (tmp_path / "p" / "text").read_text() == "old"


def test_what_the_short_record_cannot_hold_is_refused_at_once(tmp_path):
    """The ultrasound's ECG lasts some seconds, the MR's minutes; neither is begun."""
    told = []
    settings = small(ecg={"fibrillation": True, "fibrillation_s": [60, 80]})
    with pytest.raises(SynthError, match=r"^ECG beside ultrasound: fibrillation_s = .* lies past"):
        simulate_study(settings, lambda done, _: told.append(done))
    assert told == []


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SynthError, match="cannot be written"):
        write_study(tmp_path / "file" / "patient-0001", small(cine_only=True))


def test_a_full_disk_is_told_with_the_place(tmp_path):
    with (
        pytest.raises(SynthError, match=r"No space left on device: .*\.p\.partial-"),
        publishing(tmp_path / "p"),
    ):
        raise OSError(28, "No space left on device")


WRITE_ON_A_FULL_DISK = """
import resource, signal, sys
import numpy as np
from pathlib import Path
from types import SimpleNamespace
from data_synth.errors import SynthError
from data_synth.study import publishing
from data_synth.truth import write_mesh
from data_synth.ultrasound import write_sweep

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
corners = np.random.default_rng(0).normal(size=(30_000, 3))
mesh = corners, np.arange(30_000).reshape(-1, 3)
images = np.random.default_rng(0).integers(0, 255, (10, 200, 200)).astype(np.uint8)
pose = np.tile(np.eye(4), (10, 1, 1))
sweep = SimpleNamespace(
    images=images, times_s=np.arange(10.0), image_to_probe=np.eye(4), probe_to_tracker=pose,
    untracked=np.zeros(10, bool),
)
what = {
    "mesh": lambda folder: write_mesh(folder / "a.vtp", mesh),
    "sweep": lambda folder: write_sweep(folder / "a.mha", sweep),
}[sys.argv[1]]
with publishing(Path(sys.argv[2]) / "whole") as folder:
    what(folder)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    with publishing(Path(sys.argv[2]) / "p") as folder:
        what(folder)
except SynthError as error:
    print(error)
"""


@pytest.mark.parametrize("what", [pytest.param("mesh", marks=pytest.mark.slow), "sweep"])
def test_what_libraries_write_on_a_full_disk_is_told_too(tmp_path, what):
    """Here a limit on the size of files; libraries may end the process, or say nothing."""
    done = subprocess.run(
        [sys.executable, "-c", WRITE_ON_A_FULL_DISK, what, str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"{tmp_path / 'p'}: cannot be written" in done.stdout
    assert [one.name for one in tmp_path.iterdir()] == ["whole"]


@pytest.mark.parametrize("there", [True, False])
def test_what_a_killed_one_of_the_same_number_left_is_in_nobodys_way(tmp_path, there):
    """As in a container, where every process has the same number."""
    for left in ("partial", "old"):
        folder = tmp_path / f".p.{left}-{os.getpid()}"
        folder.mkdir()
        (folder / "a").write_text(left)
    if there:
        (tmp_path / "p").mkdir()
    with publishing(tmp_path / "p") as folder:
        assert not list(folder.iterdir())
        # Killed between two names, the study that stood there is not lost before the next stands.
        assert (tmp_path / "p" / "a").exists() is not there
        (folder / "b").write_text("")
    assert [one.name for one in tmp_path.iterdir()] == ["p"]
    assert [one.name for one in (tmp_path / "p").iterdir()] == ["b"]


def test_every_setting_and_every_entry_of_the_truth_is_documented(truth):
    page = Path("docs/phantom.md").read_text()
    # `python -m data_synth.settings_table` prints what belongs there.
    assert settings_table() in page
    named = (
        set(truth) | set(truth["us_frames"]["sweep_000"]) | set(truth["long_axis"]["two_chamber"])
    )
    named |= set(truth["chambers"]["left_ventricle"])
    assert not {key for key in named if f"`{key}`" not in page}


def test_truth_labels_are_distinct():
    values = [value for value, _ in TRUTH_LABELS.values()]
    assert sorted(values) == list(range(1, 7))
