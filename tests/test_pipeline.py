"""The main job from real files on disk: a study goes in, a force field comes out.

The study has few phases and frames and the field coarse nodes, so that the tests are quick; nothing
is made easier.
"""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
import pytest
from scipy.ndimage import correlate1d

from pipeline.cli import main
from pipeline.config import Settings
from pipeline.doubts import of_registration
from pipeline.field import ForceField
from pipeline.geometry import Float
from pipeline.imaging.nifti import write_image
from pipeline.job import Job
from pipeline.products import read_cine
from pipeline.stages import bake as bake_stage
from pipeline.study import open_study
from pipeline.summary import remarks

PHASES = 4

STUDY_CONFIG = f"mr: {{phases: {PHASES}}}\nultrasound: {{frames: 12}}\n"
RUN_CONFIG = "segment: {most_views: 2}\nbake: {spacing_mm: 2.5}\n"


def beatfield(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, as a user starts it."""
    command = [sys.executable, "-m", "pipeline", *(str(one) for one in arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def done(*arguments: object) -> str:
    """What a command printed; it must have succeeded."""
    finished = beatfield(*arguments)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command told that found its input wrong; here, for it takes seconds to start one."""
    capsys.readouterr()
    assert main([str(one) for one in arguments]) == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study, and the products of a run over it."""
    root = tmp_path_factory.mktemp("pipeline")
    (root / "phantom.yaml").write_text(STUDY_CONFIG)
    done("synth", root / "studies", "--seed", 5, "--config", root / "phantom.yaml")
    (root / "run.yaml").write_text(RUN_CONFIG)
    study = root / "studies" / "patient-0001"
    done("run", study, "--out", root / "out", "--config", root / "run.yaml")
    return root


@pytest.fixture(scope="module")
def products(work: Path) -> Path:
    return work / "out" / "patient-0001"


def metrics_of(products: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((products / "evaluate" / "metrics.json").read_text())
    return content


def test_every_stage_publishes_what_the_design_promises(products: Path) -> None:
    for name in (
        "ingest/cine.nii.gz",
        "ingest/phases.json",
        "segment/labels_000.nii.gz",
        f"segment/heart_{PHASES - 1:03d}.nii.gz",
        "segment/labels.json",
        "surface/lv_endocardium_000.vtp",
        f"surface/epicardium_{PHASES - 1:03d}.vtp",
        "surface/left_atrium_000.vtp",
        "surface/heart_000.vtp",
        "register/mr_from_tracker.json",
        "register/frames.csv",
        "register/TrackerToRAS.tfm",
        "bake/field.zarr/manifest.json",
        "bake/field.zarr/zarr.json",
        "evaluate/metrics.json",
        "report/index.html",
    ):
        assert (products / name).is_file(), name
    record = json.loads((products / "run.json").read_text())
    assert [stage["status"] for stage in record["stages"].values()] == ["done"] * 7
    assert all(stage["seconds"] > 0 for stage in record["stages"].values())
    assert record["settings"]["bake"]["spacing_mm"] > 0


def test_ultrasound_that_cannot_be_used_is_refused_before_it_is_needed(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, out = tmp_path / "patient-0009", tmp_path / "out"
    shutil.copytree(work / "studies" / "patient-0001", study)
    assert main(["run", str(study), "--out", str(out), "--until", "ingest"]) == 0
    sweep = min((study / "us").iterdir())
    whole = sweep.read_bytes()
    sweep.write_bytes(whole[: len(whole) // 2])
    # What does not need it is not held up.
    assert main(["run", str(study), "--out", str(out), "--until", "ingest"]) == 0
    said = refused(capsys, "run", study, "--out", out)
    assert sweep.name in said
    assert "earlier run" not in said
    (products,) = (path.parent for path in out.glob("*/run.json"))
    record = json.loads((products / "run.json").read_text())
    assert record["status"] == record["stages"]["register"]["status"] == "failed"
    assert sweep.name in record["stages"]["register"]["cause"]
    assert record["stages"]["ingest"]["status"] == "done"
    assert set(record["stages"]) == {"ingest", "register"}
    assert not (products / "segment").exists()
    sweep.write_bytes(whole)
    (tmp_path / "more.yaml").write_text("register: {min_frames: 25}\n")
    said = refused(capsys, "run", study, "--out", out, "--config", tmp_path / "more.yaml")
    assert "needs 25 or more (register.min_frames)" in said
    assert not (products / "segment").exists()


def test_surfaces_are_within_two_millimetres_of_truth_and_closed(products: Path) -> None:
    structures = metrics_of(products)["structures"]
    for name in ("lv_endocardium", "epicardium", "left_atrium"):
        assert len(structures[name]["mean_surface_distance_mm"]) == PHASES
        assert max(structures[name]["mean_surface_distance_mm"]) < 2.0, name
    for name, one in structures.items():
        assert one["closed"], name
        assert one["one_component"], name
        assert one["outward"], name


def test_registration_ends_within_three_millimetres_from_ten_off(products: Path) -> None:
    metrics = metrics_of(products)
    registered = metrics["target_registration_error_mm"]
    assert registered["start_mean"] > 8.0
    assert registered["mean"] < 3.0
    assert metrics["frame_phase_error"]["largest"] < 0.05


def test_the_field_says_what_its_registration_is_worth(products: Path) -> None:
    told = ForceField.open(products / "bake" / "field.zarr").source["registration"]
    assert told["verdict"] in ("good", "doubtful")


def test_the_field_says_what_speaks_against_it(
    work: Path, products: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = ForceField.open(products / "bake" / "field.zarr").source
    stages = json.loads((products / "run.json").read_text())["stages"]
    told = [text for word, text in remarks(stages) if word == "doubtful"]
    # Of so few phases at least that is.
    assert told
    assert source["doubts"] == told + of_registration(stages["register"]["figures"])

    def baked(*_: object, doubts_of: Callable[[object], list[str]], **__: object) -> object:
        parts = {"epicardium": {"sign_errors_by_phase": PHASES * [0]}}
        return doubts_of({"motion_unsure_p99_mm": 1.7, "structures": parts})

    monkeypatch.setattr(bake_stage, "bake_field", baked)
    monkeypatch.setattr(bake_stage, "doubts", lambda _, surface: list(surface["volumes_ml"])[:1])
    monkeypatch.setattr(bake_stage, "of_registration", lambda found: [found["tracker"]])
    monkeypatch.setattr(bake_stage, "odd_orientation", lambda segment: [segment["orientation"]])
    study = open_study(work / "studies" / "patient-0001")
    job = Job(study, Settings(), products, products / "bake", lambda done, total: None)
    lies, of_surfaces, between, of_pose = bake_stage.run(job)["accuracy"]
    assert lies == "the heart as the file says"
    assert (of_surfaces, of_pose) == ("lv_endocardium", source["tracker"])
    assert between.startswith("between phases: walls may lie 1.7 mm")


def at_stored_phase(store: Path, structure: str, phase: int, shape: tuple[int, ...]) -> Float:
    """Coefficients ``(z, y, x)`` at a stored phase: 1/8, 6/8 and 1/8 of three phases'."""
    chunks = store / "spline" / structure / "c"
    each = [
        np.memmap(chunks / str(phase + step) / "0/0/0", "<f4", "r", shape=shape[1:])
        for step in (-1, 0, 1)
    ]
    return np.asarray(np.tensordot(np.array([1, 6, 1]) / 8, np.asarray(each, dtype=float), 1))


def at_nodes(coefficients: Float, along: int | None = None) -> Float:
    """A quadratic spline at its nodes, or its slope a node along one axis."""
    values = coefficients
    for axis in range(3):
        weights = [-0.5, 0, 0.5] if axis == along else [1 / 8, 6 / 8, 1 / 8]
        values = correlate1d(values, weights, axis=axis)
    return np.asarray(values)


def test_a_server_reads_the_field_with_json_and_memory_maps_alone(products: Path) -> None:
    store = products / "bake" / "field.zarr"
    field = ForceField.open(store)
    described = json.loads((store / "zarr.json").read_text())["attributes"]["beatfield"]
    name, fixture = next(iter(described["fixtures"].items()))
    array = json.loads((store / "distance" / fixture["structure"] / "zarr.json").read_text())
    shape = tuple(array["shape"])
    assert len(described["phases"]) == shape[0] == PHASES
    phase = PHASES - 2
    chunk = store / "distance" / fixture["structure"] / "c" / str(phase) / "0" / "0" / "0"
    stored = np.memmap(chunk, dtype="<f4", mode="r", shape=shape[1:])
    rng = np.random.default_rng(0)
    index = np.stack([rng.integers(1, size - 1, 200) for size in shape[1:]], axis=1)
    points_mm = field.grid.nodes_mm()[tuple(index.T)]
    at = described["phases"][phase]
    coefficients = at_stored_phase(store, fixture["structure"], phase, shape)
    values = at_nodes(coefficients)
    distance_mm = values[tuple(index.T)]
    np.testing.assert_allclose(field.distance_mm(points_mm, at), distance_mm, atol=1e-4)
    corrected_mm = described["structures"][fixture["structure"]]["correction_mm"]
    exact_mm = stored[tuple(index.T)]
    np.testing.assert_allclose(distance_mm, exact_mm, rtol=0, atol=corrected_mm + 1e-4)

    # The paper's formula, in NumPy, on what was mapped.
    delta, m, f_max_n = fixture["delta_mm"], fixture["m"], fixture["f_max_n"]
    expected = 1 - np.exp(-((distance_mm**2 / (2 * delta**2)) ** m))
    np.testing.assert_allclose(field.potential(points_mm, at, fixture=name), expected, atol=1e-5)
    slopes = [
        at_nodes(coefficients, along=axis)[tuple(index.T)] / field.grid.spacing_mm[2 - axis]
        for axis in (2, 1, 0)
    ]
    gradient = np.stack(slopes, axis=-1)
    length = np.linalg.norm(gradient, axis=1)
    clear = length > 0.6  # off the medial axis, where the direction is defined
    unit = np.sign(distance_mm)[:, None] * gradient / length[:, None]
    force_n = -f_max_n * expected[:, None] * unit
    found_n = field.force_n(points_mm, at, fixture=name)
    assert clear.sum() > 100
    np.testing.assert_allclose(found_n[clear], force_n[clear], atol=1e-3 * f_max_n)


def test_query_and_verify_answer_from_the_shell(
    products: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = products / "bake" / "field.zarr"
    record = json.loads((products / "run.json").read_text())
    example = record["stages"]["bake"]["figures"]["example"]
    said = done(
        "query", store, "--json", "--phase", example["phase"], "--point", *example["point_mm"]
    )
    answers = json.loads(said)
    field = ForceField.open(store)
    for name, answer in answers.items():
        expected = field.force_n([example["point_mm"]], example["phase"], fixture=name)[0]
        np.testing.assert_allclose(answer["force_n"], expected)
    assert len(answers) == 3
    outside = "query", store, "--phase", 0, "--point", 999, 0, 0
    assert "outside the baked grid" in refused(capsys, *outside)
    late = "query", store, "--phase", 300, "--point", *example["point_mm"]
    assert "phase 300: is told in shares of the heartbeat" in refused(capsys, *late)
    done("verify", store)


def test_the_report_needs_no_other_file(products: Path) -> None:
    page = (products / "report" / "index.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(source.startswith("data:") for source in sources)
    for title in ("Segmentation", "Surfaces", "Registration", "Force field", "Against truth"):
        assert f"<h2>{title}</h2>" in page


def test_a_second_run_changes_nothing(work: Path, products: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in products.rglob("*") if path.is_file()}
    clock = time.perf_counter()
    study = work / "studies" / "patient-0001"
    said = beatfield("run", study, "--out", work / "out", "--config", work / "run.yaml")
    assert said.returncode == 0
    assert said.stderr.count("unchanged") == 7
    assert time.perf_counter() - clock < 30
    after = {path: path.stat().st_mtime_ns for path in products.rglob("*") if path.is_file()}
    changed = {path.name for path in after if after[path] != before.get(path)}
    assert changed <= {"run.json", ".lock"}


def write_as_nifti(series: list[Path], path: Path, timing: Path) -> None:
    """Series of single slices as one 4D NIfTI and its timing, by pydicom and nibabel alone.

    Places are those of DICOM PS3.3 C.7.6.2.1.1; NIfTI's frame is RAS.
    """
    frames = [
        sorted(map(pydicom.dcmread, one.iterdir()), key=lambda data: int(data.InstanceNumber))
        for one in series
    ]
    first = frames[0][0]
    along_row, along_column = np.reshape(first.ImageOrientationPatient, (2, 3)).astype(float)
    below_mm, beside_mm = map(float, first.PixelSpacing)
    corners_mm = np.array([one[0].ImagePositionPatient for one in frames], dtype=float)
    step_mm = float(first.SliceThickness) * np.cross(along_row, along_column)
    if len(series) > 1:
        step_mm = (corners_mm[-1] - corners_mm[0]) / (len(series) - 1)
    place = np.eye(4)
    place[:3] = np.column_stack(
        [beside_mm * along_row, below_mm * along_column, step_mm, corners_mm[0]]
    )
    pixels = np.array([[data.pixel_array.T for data in one] for one in frames], dtype=np.int16)
    image = nibabel.Nifti1Image(pixels.transpose(2, 3, 0, 1), np.diag([-1, -1, 1, 1]) @ place)
    image.header.set_xyzt_units("mm", "sec")
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(image, path)
    triggers_ms = [[float(data.TriggerTime) for data in one] for one in frames]
    rr_ms = [float(one[0].NominalInterval) for one in frames]
    timing.write_text(json.dumps({"trigger_times_ms": triggers_ms, "rr_ms": rr_ms}))


@pytest.mark.slow
def test_a_cine_alone_as_nifti_is_baked_in_the_frame_of_the_mr(
    work: Path, products: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Killed once on the way: the run after goes on and ends like any other."""
    study = work / "nifti" / "patient-0001"
    *stack, one, two, three = sorted((work / "studies" / "patient-0001" / "cine").iterdir())
    write_as_nifti(stack, study / "cine" / "cine.nii.gz", study / "cine" / "timing.json")
    for view in (one, two, three):
        name = study / "long_axis" / view.name
        write_as_nifti([view], name.with_suffix(".nii.gz"), Path(f"{name}_timing.json"))
    run = ["run", str(study), "--out", str(work / "only"), "--config", str(work / "run.yaml")]
    command = [sys.executable, "-m", "pipeline", *run]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("segment"):
                break
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    found = work / "only" / "patient-0001"
    assert (found / "ingest" / "cine.nii.gz").exists()
    assert not (found / "segment").exists()

    assert main([*run, "--until", "bake"]) == 0

    assert "ingest    unchanged" in capsys.readouterr().err
    stages = json.loads((found / "run.json").read_text())["stages"]
    assert stages["register"]["status"] == "skipped"
    assert ForceField.open(found / "bake" / "field.zarr").mr_from_tracker is None
    # The same heart as the DICOM study's, so the same bytes from here on.
    name = "surface/lv_endocardium_003.vtp"
    assert (found / name).read_bytes() == (products / name).read_bytes()


@pytest.mark.slow
def test_a_stack_that_ends_at_the_valves_is_baked_without_atria(
    work: Path, products: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """End-diastole and end-systole of the ventricles alone, as research sets have them."""
    cine = read_cine(products / "ingest")
    study = work / "short" / "patient-0001"
    (study / "cine").mkdir(parents=True)
    images = np.ascontiguousarray(cine.intensity[:2, :7])
    write_image(study / "cine" / "cine.nii.gz", images, cine.mr_from_index)
    times_ms = (1000 * cine.rr_s * cine.phases[:2]).tolist()
    timing = {"trigger_times_ms": times_ms, "rr_ms": 1000 * cine.rr_s}
    (study / "cine" / "timing.json").write_text(json.dumps(timing))

    run = ["run", study, "--out", work / "ventricles", "--config", work / "run.yaml"]
    assert main([str(one) for one in run]) == 0
    said = capsys.readouterr().out

    assert "left out  surface left_atrium, right_atrium, aorta: no phase shows it" in said
    assert "left out  fixture left_atrium_guidance: needs left_atrium" in said
    found = work / "ventricles" / "patient-0001"
    field = ForceField.open(found / "bake" / "field.zarr")
    assert set(field.fixtures) == {"epicardium_guidance", "left_ventricle_forbidden"}
    assert "No surface of left atrium" in (found / "report" / "index.html").read_text()

    # What a user asks for by name is not left out: the bake fails and says why.
    one = "atrium: {structure: left_atrium, kind: guidance, gamma_mm: 3, m: 2, f_max_n: 2}"
    (work / "atrium.yaml").write_text(f"{RUN_CONFIG}fixtures:\n  {one}\n")
    said = refused(capsys, *run[:-1], work / "atrium.yaml")
    assert "fixture atrium needs left_atrium, which has no surface: no phase shows it" in said


def test_a_users_own_surfaces_bake_the_same_field(work: Path, products: Path) -> None:
    folder = work / "own"
    folder.mkdir()
    for name in ("epicardium", "left_atrium"):
        for path in sorted((products / "surface").glob(f"{name}_*.vtp")):
            shutil.copy(path, folder)
    shutil.copy(products / "ingest" / "phases.json", work)
    timing = json.loads((work / "phases.json").read_text())
    (folder / "phases.json").write_text(
        json.dumps({"phases": timing["phases"], "rr_s": timing["rr_s"]})
    )
    done("bake", "--surfaces", folder, "--out", work / "own-out", "--config", work / "run.yaml")
    own = work / "own-out" / "field.zarr"
    chunk = "distance/epicardium/c/2/0/0/0"
    assert (own / chunk).read_bytes() == (products / "bake" / "field.zarr" / chunk).read_bytes()


def test_a_missing_slice_ends_with_exit_code_2_and_publishes_nothing(
    work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = work / "broken" / "patient-0001"
    shutil.copytree(work / "studies" / "patient-0001" / "cine", study / "cine")
    series = sorted(path for path in (study / "cine").iterdir() if path.is_dir())
    shutil.rmtree(series[5])
    assert "missing slice" in refused(capsys, "run", study, "--out", work / "broken-out")
    left = sorted(path.name for path in (work / "broken-out" / "patient-0001").iterdir())
    assert left == [".lock", "run.json"]


@pytest.mark.parametrize(
    ("record", "seconds", "words"),
    [("mr", 3.0, "shorter than the cine"), ("us", 3.5, "outside the R peaks")],
)
def test_an_ecg_that_does_not_cover_the_images_is_refused(
    work: Path,
    products: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    record: str,
    seconds: float,
    words: str,
) -> None:
    """A record as long as its header says, but cut before the images end."""
    study = tmp_path / "patient-0001"
    shutil.copytree(work / "studies" / "patient-0001", study)
    header = study / "ecg" / f"{record}.hea"
    first, *leads = header.read_text().splitlines()
    name, count, rate, _ = first.split()[:4]
    samples = int(seconds * float(rate))
    header.write_text("\n".join([f"{name} {count} {rate} {samples}", *leads]) + "\n")
    data = study / "ecg" / f"{record}.dat"
    data.write_bytes(data.read_bytes()[: samples * int(count) * 2])
    out = tmp_path / "out"
    shutil.copytree(products, out / "patient-0001")
    config = work / "run.yaml"
    given = "run", study, "--out", out, "--until", "register", "--config", config
    assert words in refused(capsys, *given)
