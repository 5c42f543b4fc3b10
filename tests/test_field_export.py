"""Exports of a field, read again by independent libraries and compared at places in the patient."""

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import nibabel
import numpy as np
import pytest
import pyvista
import SimpleITK
from field_baked import PHASES, RR_S, bake_small, edit
from field_random import ORIGIN_MM, SPACING_MM, write_random

from pipeline.cli import main
from pipeline.errors import InputError
from pipeline.field import ForceField
from pipeline.field.export import WRITERS, export_field

ARRAYS = [f"distance_{name}" for name in ("ball", "core")]
ARRAYS += [f"potential_{name}" for name in ("guide", "stay_in", "stay_out")]
LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture(scope="module")
def folders(path):
    return {form: export_field(path, form, path.parent / form) for form in WRITERS}


@pytest.fixture(scope="module")
def nodes(path):
    """Some nodes, none on a plane of symmetry: indices (x, y, z) and places in LPS mm."""
    grid = ForceField.open(path).grid
    index = np.random.default_rng(0).integers(0, grid.shape[::-1], (200, 3))
    return index, np.array(grid.origin_mm) + index * np.array(grid.spacing_mm)


def stored(path: Path, name: str, index: int, nodes: np.ndarray) -> np.ndarray:
    """What the store's own file holds at nodes."""
    grid = ForceField.open(path).grid
    kind, _, part = name.partition("_")
    chunk = path / kind / part / "c" / str(index) / "0" / "0" / "0"
    values = np.fromfile(chunk, dtype="<f4").reshape(grid.shape)
    return values[nodes[:, 2], nodes[:, 1], nodes[:, 0]]


def itk_values(image: SimpleITK.Image, places: np.ndarray) -> np.ndarray:
    """By physical points, all axes of which the image knows."""
    index = [image.TransformPhysicalPointToContinuousIndex(place.tolist()) for place in places]
    whole = np.rint(index).astype(int)
    np.testing.assert_allclose(index, whole, atol=1e-6)
    return SimpleITK.GetArrayFromImage(image)[tuple(whole.T[::-1])]


@pytest.mark.parametrize("name", ARRAYS)
def test_nrrd_by_itk(path, folders, nodes, name):
    image = SimpleITK.ReadImage(folders["nrrd"] / f"{name}.seq.nrrd")
    # ITK makes a list axis, which has no place in space, the components of its voxels.
    assert image.GetNumberOfComponentsPerPixel() == len(PHASES)
    found = itk_values(image, nodes[1])
    for index in range(len(PHASES)):
        np.testing.assert_array_equal(found[:, index], stored(path, name, index, nodes[0]))


def test_nrrd_says_what_slicer_asks(folders):
    head = (folders["nrrd"] / "distance_ball.seq.nrrd").read_bytes().split(b"\n\n")[0].decode()
    lines = head.splitlines()
    assert lines[0] == "NRRD0005"
    said = dict(line.split(":=" if ":=" in line else ": ", 1) for line in lines[1:])
    assert said["kinds"] == "domain domain domain list"
    assert said["space"] == "left-posterior-superior"
    assert said["space directions"].endswith(" none")
    assert said["axis 3 index type"] == "numeric"
    times = [float(word) for word in said["axis 3 index values"].split()]
    np.testing.assert_allclose(times, RR_S * PHASES, rtol=1e-15)
    assert said["labels"].split()[3] == '"time"'


@pytest.mark.parametrize("name", ARRAYS)
def test_nifti_by_nibabel_and_itk(path, folders, nodes, name):
    file = folders["nifti"] / f"{name}.nii"
    image = nibabel.load(file)
    header = image.header
    assert header.get_xyzt_units() == ("mm", "sec")
    # Single precision is all that the header has room for.
    np.testing.assert_allclose(header.get_zooms()[3], RR_S / len(PHASES), rtol=1e-6)
    np.testing.assert_allclose(image.get_qform(), image.get_sform(), atol=1e-5)
    ras_mm = np.column_stack([nodes[1] * (-1, -1, 1), np.ones(len(nodes[1]))])
    index = np.rint(np.linalg.solve(image.affine, ras_mm.T)[:3]).astype(int)
    np.testing.assert_allclose(image.affine @ np.vstack([index, 0 * index[:1] + 1]), ras_mm.T)
    values = np.asarray(image.dataobj)
    by_itk = SimpleITK.ReadImage(file)
    for k in range(len(PHASES)):
        expected = stored(path, name, k, nodes[0])
        np.testing.assert_array_equal(values[(*index, k)], expected)
        np.testing.assert_array_equal(itk_values(by_itk[:, :, :, k], nodes[1]), expected)


def test_vti_by_vtk(path, folders, nodes):
    tree = ElementTree.parse(folders["vti"] / "field.pvd")
    rows = tree.findall("Collection/DataSet")
    np.testing.assert_allclose([float(row.get("timestep")) for row in rows], RR_S * PHASES)
    for index, row in enumerate(rows):
        image = pyvista.read(folders["vti"] / row.get("file"))
        number = [image.FindPoint(place) for place in nodes[1]]
        np.testing.assert_allclose(image.points[number], nodes[1], atol=1e-4)
        for name in ARRAYS:
            found = image.point_data[name][number]
            np.testing.assert_array_equal(found, stored(path, name, index, nodes[0]))


@pytest.mark.parametrize("name", ARRAYS)
def test_mhd_points_into_the_store(path, folders, nodes, name):
    whole = SimpleITK.ReadImage(folders["mhd"] / f"{name}.mhd")
    assert whole.GetDimension() == 4
    np.testing.assert_allclose(whole.GetSpacing()[3], RR_S / len(PHASES))
    for index in range(len(PHASES)):
        expected = stored(path, name, index, nodes[0])
        one = SimpleITK.ReadImage(folders["mhd"] / f"{name}_{index:03d}.mhd")
        np.testing.assert_array_equal(itk_values(one, nodes[1]), expected)
        np.testing.assert_array_equal(itk_values(whole[:, :, :, index], nodes[1]), expected)
    size = sum(file.stat().st_size for file in folders["mhd"].iterdir())
    assert size < 1000 * len(list(folders["mhd"].iterdir())), "no values are copied"


def test_sofa_is_float64_with_x_fastest(path, folders, nodes):
    """As SOFA's DistanceGrid reads it: nx * ny * nz numbers, number x + nx (y + ny z)."""
    grids = ElementTree.parse(folders["sofa"] / "grids.xml").getroot()
    assert len(grids) == 2 * len(PHASES)
    for number, grid in enumerate(grids):
        nx, ny, nz = (int(grid.get(key)) for key in ("nx", "ny", "nz"))
        values = np.fromfile(folders["sofa"] / grid.get("filename"), dtype="<f8")
        assert len(values) == nx * ny * nz
        low, high = np.array(grid.get("box").split(), float).reshape(2, 3)
        at = (nodes[1] - low) / (high - low) * (np.array([nx, ny, nz]) - 1)
        x, y, z = np.rint(at).astype(int).T
        np.testing.assert_allclose(at, np.stack([x, y, z], axis=1), atol=1e-9)
        name, index = ("distance_ball", "distance_core")[number // 5], number % 5
        expected = stored(path, name, index, nodes[0])
        np.testing.assert_array_equal(values[x + nx * (y + ny * z)], expected)


@pytest.mark.parametrize("form", WRITERS)
def test_the_same_bytes_every_time(path, folders, form):
    """At a sibling of the first export, so that relative paths are the same."""
    again = export_field(path, form, path.parent / f"{form}-again")

    def digests(folder):
        return {
            file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()
        }

    assert digests(again) == digests(folders[form])
    shutil.rmtree(again)


def test_without_a_heartbeat_times_are_phases(path, tmp_path):
    field = tmp_path / "field.zarr"
    shutil.copytree(path, field)
    edit(field, lambda told: told.update(rr_s=None))

    export_field(field, "nrrd", tmp_path / "nrrd")
    export_field(field, "nifti", tmp_path / "nifti")

    head = (tmp_path / "nrrd" / "distance_ball.seq.nrrd").read_bytes()[:2000].decode("latin1")
    assert f"index values:={' '.join(map(str, PHASES))}" in head
    assert '"phase"' in head
    assert nibabel.load(tmp_path / "nifti" / "distance_ball.nii").header.get_zooms()[
        3
    ] == pytest.approx(1 / len(PHASES))


def test_command_writes_and_says_where(path, tmp_path, capsys):
    assert main(["export", str(path), "--to", "mhd", "--out", str(tmp_path / "out")]) == 0
    assert str(tmp_path / "out") in capsys.readouterr().out
    assert (tmp_path / "out" / "distance_ball.mhd").exists()


def test_command_writes_where_one_is_unless_told_where(path, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(path), "--to", "mhd"]) == 0
    assert "field-mhd" in capsys.readouterr().out
    assert (tmp_path / "field-mhd" / "distance_ball.mhd").exists()
    assert main(["export", str(path), "--to", "mhd"]) == 2
    assert "--out field-mhd: exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("phases", "form", "off"),
    [
        ((0.1, 0.15, 0.8), "nifti", "0.255 s"),
        ((0.1, 0.15, 0.8), "mhd", "0.255 s"),
        ((0.1, 0.15, 0.8), "nrrd", None),
        ((0.1, 0.35, 0.6, 0.85), "nifti", None),
        ((0.4,), "mhd", None),
    ],
)
def test_times_that_a_format_cannot_say_are_told(tmp_path, capsys, phases, form, off):
    """Of 0.9 s a beat: the second of three even phases would be at 0.39 s, and is at 0.135 s."""
    write_random(tmp_path / "f.zarr", 7, np.array(phases))
    edit(tmp_path / "f.zarr", lambda told: told.update(rr_s=0.9))
    assert main(["export", str(tmp_path / "f.zarr"), "--to", form, "--out", f"{tmp_path}/o"]) == 0
    said = capsys.readouterr().out
    assert ("not evenly spaced" in said) == (off is not None)
    assert off is None or f"up to {off} off" in said


def test_what_is_wrong_is_said_and_nothing_is_written(path, tmp_path, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine.txt").write_text("keep")
    shutil.copytree(path, tmp_path / "50%.zarr")
    shutil.copytree(path, tmp_path / "two\nlines.zarr")
    broken = tmp_path / "broken.zarr"
    shutil.copytree(path, broken)
    (broken / "potential" / "guide" / "c" / "3" / "0" / "0" / "0").write_bytes(b"short")
    new = str(tmp_path / "new")
    for field, form, out, words in [
        (path, "stl", new, "no such format; there are nrrd, nifti, vti, mhd, sofa"),
        (path, "nrrd", str(taken), "exists already"),
        (tmp_path / "none.zarr", "nrrd", new, "no such folder"),
        (broken, "nrrd", new, "bytes"),
        (broken, "mhd", new, "bytes"),
        (path, "mhd", str(path / "inside"), "lies inside the field"),
        (tmp_path / "50%.zarr", "mhd", new, "take a % in the path"),
        (tmp_path / "two\nlines.zarr", "mhd", new, "ends where the path"),
    ]:
        assert main(["export", str(field), "--to", form, "--out", out]) == 2
        assert words in capsys.readouterr().err
    left = sorted(one.name for one in tmp_path.iterdir())
    assert left == ["50%.zarr", "broken.zarr", "taken", "two\nlines.zarr"]
    assert (taken / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("form", [one for one in WRITERS if one != "mhd"])
def test_files_that_cannot_be_written_whole_are_refused_and_leave_nothing(path, form, tmp_path):
    """Of headers that point into the store alone, as mhd has them, no file is long."""
    script = (
        "import resource, sys\n"
        "from pipeline.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))\n"
        f"sys.exit(main(['export', {str(path)!r}, '--to', {form!r}, '--out', 'new']))"
    )
    # A place for compiled code that the user names is tried before anything else.
    surroundings = {key: one for key, one in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    ended = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.startswith("error: new: a file would be larger than `ulimit -f`")
    assert len(ended.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_what_a_killed_export_left_is_cleared_away_and_a_living_ones_is_not(path, tmp_path):
    for name in (f".new.partial-{os.getppid()}", ".newer.partial-1"):
        (tmp_path / name).mkdir()
    living = tmp_path / ".new.partial-1"
    living.mkdir()
    handle = os.open(living, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    export_field(path, "sofa", tmp_path / "new")
    os.close(handle)
    left = sorted(one.name for one in tmp_path.iterdir())
    assert left == [".new.partial-1", ".newer.partial-1", "new"]


def test_a_link_at_the_target_is_not_followed(path, tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="exists already"):
        export_field(path, "mhd", tmp_path / "link")


def test_an_oblong_grid_keeps_its_axes(tmp_path):
    """Counts, steps and origin differ along x, y and z: none can stand for another."""
    values = write_random(tmp_path / "field.zarr", 7, PHASES).astype(np.float32)
    out = {form: export_field(tmp_path / "field.zarr", form, tmp_path / form) for form in WRITERS}
    origin, steps = np.array(ORIGIN_MM), np.array(SPACING_MM)
    whole = SimpleITK.ReadImage(out["nrrd"] / "distance_s.seq.nrrd")
    images = [SimpleITK.VectorIndexSelectionCast(whole, k) for k in range(5)]
    images += [SimpleITK.ReadImage(out["mhd"] / f"distance_s_{k:03d}.mhd") for k in range(5)]
    nifti = SimpleITK.ReadImage(out["nifti"] / "distance_s.nii")
    images += [nifti[:, :, :, k] for k in range(5)]
    for number, image in enumerate(images):
        assert image.GetSize() == (7, 5, 3)
        np.testing.assert_allclose(image.GetSpacing(), steps, rtol=1e-6)
        np.testing.assert_allclose(np.reshape(image.GetDirection(), (3, 3)), np.eye(3), atol=1e-6)
        np.testing.assert_allclose(image.GetOrigin(), origin, atol=1e-6)
        np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), values[number % 5])
    for k in range(5):
        image = pyvista.read(out["vti"] / f"phase_{k:03d}.vti")
        assert image.dimensions == (7, 5, 3)
        np.testing.assert_allclose((image.origin, image.spacing), (origin, steps))
        np.testing.assert_array_equal(image.point_data["distance_s"], values[k].ravel())
    grid = ElementTree.parse(out["sofa"] / "grids.xml").getroot()[0]
    assert [grid.get(key) for key in ("nx", "ny", "nz")] == ["7", "5", "3"]
    box = np.array(grid.get("box").split(), float).reshape(2, 3)
    np.testing.assert_allclose(box, [origin, origin + (6, 4, 2) * steps])


def test_nifti_says_when_the_first_phase_is(folders):
    header = nibabel.load(folders["nifti"] / "distance_ball.nii").header
    assert float(header["toffset"]) == pytest.approx(RR_S * PHASES[0])


def test_shares_of_a_beat_have_no_unit_in_nrrd(tmp_path):
    write_random(tmp_path / "field.zarr", 7, PHASES)
    export_field(tmp_path / "field.zarr", "nrrd", tmp_path / "nrrd")
    head = (tmp_path / "nrrd" / "distance_s.seq.nrrd").read_bytes().partition(b"\n\n")[0]
    assert b'units: "" "" "" ""' in head.splitlines()
