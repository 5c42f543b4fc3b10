"""Tools of any shape: read, divided, and felt like a plain sum over their points."""

import re
import shutil
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
import pyvista
from c_program import build
from field_baked import FIXTURES, bake_small, edit
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.field import ForceField
from pipeline.field.tool import Cylinder, Needle, Polyline, outside_share, read_tool, spread_points

ROOT = Path(__file__).parent.parent
TOOLS = sorted((ROOT / "configs" / "tools").glob("*.yaml"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tool") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture(scope="module")
def field(folder):
    return ForceField.open(folder)


def poses(count: int):
    rng = np.random.default_rng(8)
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-25, 25, 3)
        yield pose, float(rng.uniform())


def points_along(lines, count: int):
    """Evenly spaced points over all lines together; ends once."""
    lengths = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in lines]
    points = []
    for line, length in zip(lines, lengths, strict=True):
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        along = np.concatenate([[0], np.cumsum(steps)])
        share = round(count * length / sum(lengths))
        place = (np.arange(share) + 0.5) / share * length
        points.append(np.column_stack([np.interp(place, along, line[:, k]) for k in range(3)]))
    return np.concatenate(points)


@pytest.mark.parametrize("path", TOOLS, ids=lambda path: path.stem)
@pytest.mark.parametrize("bound", [0.05, 0.01])
def test_bound_holds_against_a_plain_sum(field, path, bound):
    tool = read_tool(path)
    along = points_along(tool.lines_mm(), 100_000)
    for pose, phase in poses(8):
        points = along @ pose[:3, :3].T + pose[:3, 3]
        levers = (along - tool.handle_mm) @ pose[:3, :3].T
        for name in FIXTURES:
            found = field.tool_force(tool, pose, phase, name, bound)
            forces = field.force_n(points, phase, name)
            assert np.linalg.norm(found.force_n - forces.mean(axis=0)) <= bound
            torque = np.cross(levers, forces).mean(axis=0)
            farthest = np.linalg.norm(levers, axis=1).max()
            assert np.linalg.norm(found.torque_nmm - torque) <= bound * farthest
            assert np.linalg.norm(found.force_n) <= FIXTURES[name].f_max_n


@pytest.mark.parametrize("bound", [0.05, 0.01])
@pytest.mark.parametrize("length_mm", [1.0, 2.0, 3.0, 5.0])
def test_bound_holds_for_short_needles_across_a_medial_axis(field, bound, length_mm):
    """About the middle of the ball, where the force turns about within a spacing of the grid."""
    rng = np.random.default_rng(3)
    tool = Needle(shape="needle", length_mm=length_mm)
    turns = Rotation.random(400, random_state=4).as_matrix()
    starts = rng.uniform(-4, 4, (400, 3)) - turns[:, :, 2] * length_mm / 2
    along_mm = (np.arange(2000) + 0.5) / 2000 * length_mm
    for turn, start in zip(turns, starts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, start
        found = field.tool_force(tool, pose, 0.05, "guide", bound)
        points = start + along_mm[:, None] * turn[:, 2]
        assert np.linalg.norm(found.force_n - field.force_n(points, 0.05, "guide").mean(0)) <= bound


def test_a_turn_of_the_force_between_two_places_is_not_missed(field):
    """Needles straight through the middle of the ball: nothing but the force's turn tells of it,
    and it may lie beyond the last place that a stretch was asked at."""
    for length_mm in (20.0, 40.0, 45.0, 80.0, 120.0):
        tool = Needle(shape="needle", length_mm=length_mm)
        along_mm = np.zeros((20_000, 3))
        along_mm[:, 2] = (np.arange(20_000) + 0.5) / 20_000 * length_mm
        for beside_mm in (0.0, 1.0):
            for start_mm in np.arange(-length_mm, 1.0, 1.0):
                pose = np.eye(4)
                pose[:3, 3] = beside_mm, beside_mm, start_mm
                found = field.tool_force(tool, pose, 0.8, "guide", 0.05)
                plain = field.force_n(along_mm + pose[:3, 3], 0.8, "guide").mean(0)
                assert np.linalg.norm(found.force_n - plain) <= 0.05


@pytest.mark.parametrize("radius_mm", [3.0, 20.0])
def test_a_cylinder_is_felt_over_its_whole_wall(field, radius_mm):
    tool = Cylinder(shape="cylinder", length_mm=40, radius_mm=radius_mm)
    rng = np.random.default_rng(5)
    # Points by area, a golden angle apart.
    turns, heights = np.arange(100_000) * 0.6180339887498949 % 1, (np.arange(100_000) + 0.5) / 1e5
    round_mm = [np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)]
    wall_mm = np.column_stack([*(radius_mm * np.array(round_mm)), 40 * heights])
    for pose, phase in poses(20):
        pose[:3, 3] = rng.uniform(-15, 15, 3)
        found = field.tool_force(tool, pose, phase, "guide", 0.01)
        plain = field.force_n(wall_mm @ pose[:3, :3].T + pose[:3, 3], phase, "guide").mean(0)
        assert np.linalg.norm(found.force_n - plain) <= 0.01


def test_a_path_is_no_tool(field):
    with pytest.raises(InputError, match=r"read_tool\(path\), got 'needle\.yaml'"):
        field.tool_force("needle.yaml", np.eye(4), 0.0)


def test_a_tool_far_from_all_change_costs_next_to_nothing(field):
    """A torus in the floor of a forbidden region: a few questions, no force."""
    tool = read_tool(TOOLS[[path.stem for path in TOOLS].index("torus")])
    pose = np.diag([0.2, 0.2, 0.2, 1.0])
    pose[:3, :3] = np.eye(3)
    found = field.tool_force(tool, pose, 0.05, "stay_in", 0.05)
    # The middles of stretches of nine spacings, and both ends.
    assert found.evaluations <= 63 / (9 * 3.0) + 1 + 2
    assert np.linalg.norm(found.force_n) <= 0.05


def test_a_point_feels_what_a_point_feels(field):
    tool = Polyline(shape="polyline", points_mm=((0.0, 0.0, 0.0),), handle_mm=(0.0, 0.0, -10.0))
    for pose, phase in poses(5):
        found = field.tool_force(tool, pose, phase)
        expected = field.force_n(pose[None, :3, 3], phase)[0]
        np.testing.assert_allclose(found.force_n, expected, rtol=1e-12, atol=1e-15)
        lever = pose[:3, :3] @ (0, 0, 10)
        np.testing.assert_allclose(found.torque_nmm, np.cross(lever, expected), atol=1e-12)


def test_a_mesh_is_felt_over_its_surface(field, tmp_path):
    """A small ball of samples: its mean force is near its centre's."""
    pyvista.Icosphere(radius=2.0, nsub=3).save(tmp_path / "ball.stl")
    (tmp_path / "ball.yaml").write_text("shape: mesh\npath: ball.stl\nsamples: 500\n")
    tool = read_tool(tmp_path / "ball.yaml")
    points = np.concatenate(tool.lines_mm())
    assert points.shape == (500, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.0, atol=0.03)
    assert np.abs(points.mean(axis=0)).max() < 0.1
    pose, phase = next(poses(1))
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    expected = field.force_n(moved, phase).mean(axis=0)
    np.testing.assert_allclose(field.tool_force(tool, pose, phase).force_n, expected, atol=1e-12)


def test_samples_spread_evenly_over_area():
    """Two triangles, one three times the other: samples by area, to one."""
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[5, 0, 0], [8, 0, 0], [5, 1, 0]]])
    points = spread_points(corners.astype(float), 400, "mine.stl")
    assert abs((points[:, 0] < 2).sum() - 100) <= 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("shape: spoon\n", "needs `shape:`, one of 'needle', .*, got 'spoon'"),
        ("radius_mm: 3\n", "needs `shape:`"),
        ("shape: needle\nlength_mm: -3\n", "length_mm"),
        ("shape: needle\nlength_mm: 3\ncolour: red\n", "colour"),
        ("shape: [\n", "cannot be read"),
        (
            "shape: needle\nlength_mm: 3\nlength_mm: 30\n",
            "line 3: length_mm is given a second time",
        ),
        ("shape: mesh\npath: 7\n", r"mesh\.path: "),
        ("", r"t\.yaml: needs keys and values"),
        ("shape: polyline\npoints_mm: []\n", "points_mm"),
    ],
)
def test_wrong_tools_are_refused(tmp_path, text, words):
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_tool(tmp_path / "t.yaml")


def test_wrong_questions_about_tools_are_refused(field, tmp_path):
    tool = read_tool(TOOLS[0])
    with pytest.raises(InputError, match="mr_from_tool"):
        field.tool_force(tool, 2 * np.eye(4), 0.1)
    with pytest.raises(InputError, match="bound_n"):
        field.tool_force(tool, np.eye(4), 0.1, bound_n=0)
    with pytest.raises(InputError, match="no fixture"):
        field.tool_force(tool, np.eye(4), 0.1, "none")
    far = Needle(shape="needle", length_mm=3, handle_mm=(1.5e308, 1.5e308, 1.5e308))
    with pytest.raises(InputError, match="handle_mm: is so far away"):
        field.tool_force(far, next(poses(1))[0], 0.1)


@pytest.mark.parametrize("path", TOOLS, ids=lambda path: path.stem)
def test_the_share_outside_the_grid_is_that_of_its_points(field, path):
    tool = read_tool(path)
    lines = tool.lines_mm()
    points = np.concatenate(lines) if len(lines[0]) == 1 else points_along(lines, 20_000)
    shares = []
    for pose, _ in poses(30):
        pose[:3, 3] *= 3.0
        inside = field.contains(points @ pose[:3, :3].T + pose[:3, 3])
        shares.append(outside_share(field.grid, tool, pose))
        # Each crossing of a face is seen to a point; a circle's corners cross it more than once.
        assert shares[-1] == pytest.approx(1 - inside.mean(), abs=1e-3)
    assert min(shares) < 0.5 < max(shares)


def test_a_tool_along_a_face_of_the_grid_is_inside(field):
    """Where a piece does not move along an axis there is nothing to divide by."""
    along_x, pose = Polyline(shape="polyline", points_mm=((0, 0, 0), (1, 0, 0))), np.eye(4)
    pose[:3, 3] = field.grid.origin_mm
    assert outside_share(field.grid, along_x, pose) == 0
    pose[1, 3] -= 1e-6
    assert outside_share(field.grid, along_x, pose) == 1
    still = Polyline(shape="polyline", points_mm=((0, 0, 0), (0, 0, 0)), closed=True)
    assert outside_share(field.grid, still, pose) == 1
    # Lengths that overflow tell nothing: a loop that asks for any share outside withholds.
    endless = Polyline(shape="polyline", points_mm=((1e300, 0, 0), (0, 0, 0)))
    assert outside_share(field.grid, endless, np.eye(4).tolist()) == 1
    with pytest.raises(InputError, match="mr_from_tool"):
        outside_share(field.grid, still, 2 * np.eye(4))


def test_a_tool_in_a_damaged_field_is_told_so(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "f.zarr")
    damaged = ForceField.open(tmp_path / "f.zarr")
    for phase in range(len(damaged.phases)):
        chunk = tmp_path / f"f.zarr/spline/ball/c/{phase}/0/0/0"
        np.memmap(chunk, "<f4", "r+", shape=damaged.grid.shape)[9:12, 9:12, 9:12] = np.nan
    pose = np.eye(4)
    pose[:3, 3] = damaged.grid.origin_mm + 3.0 * np.array([10, 10, 10])
    needle = Needle(shape="needle", length_mm=30)
    with pytest.raises(InputError, match=r"f\.zarr: is damaged.*`beatfield verify"):
        damaged.tool_force(needle, pose, 0.3)
    # The other structure is whole.
    assert np.isfinite(damaged.tool_force(needle, pose, 0.3, "stay_out").torque_nmm).all()


def page_code(word):
    """The one piece of C on the page of the field that has a word."""
    page = (ROOT / "docs" / "field.md").read_text()
    [code] = [part for part in re.findall("```c\n(.*?)```", page, re.DOTALL) if word in part]
    return code


@pytest.mark.parametrize("compiler", ["gcc", "g++"])
def test_the_pages_lines_of_c_are_a_program(folder, field, tmp_path, compiler):
    """Its loop, then its needle: a point's force in the tracker's frame, and Python's tool."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    head, body = page_code("bf_open").split("bf_field field;")
    body, end = body.replace("epicardium_guidance", "guide").split("bf_close(")
    (tmp_path / "page.c").write_text(
        f"{head}\nint main(int count, char **words)\n{{\n"
        "double phase = 0.37, tip_mm[3];\n"
        "for (int n = 0; n < 3 && n + 1 < count; n++) tip_mm[n] = atof(words[n + 1]);\n"
        f"bf_field field;{body}\nfwrite(force_n, sizeof(double), 3, stdout);\n"
        f"{page_code('bf_tool_force')}\nfwrite(force_n, sizeof(double), 3, stdout);\n"
        f"fwrite(torque_nmm, sizeof(double), 3, stdout);\nbf_close({end}\n"
        "return status == BF_OK ? 0 : 1;\n}\n"
    )
    build(tmp_path / "page.c", tmp_path / "page", compiler=compiler)
    place = tmp_path / "OUT/patient-0001/bake"
    place.mkdir(parents=True)
    shutil.copytree(folder, place / "field.zarr")
    mr_from_tracker = np.eye(4)
    mr_from_tracker[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    mr_from_tracker[:3, 3] = (200.0, -90.0, 35.0)
    known = {"mr_from_tracker": mr_from_tracker.tolist()}
    edit(place / "field.zarr", lambda told: told.update(known))
    needle = Needle(shape="needle", length_mm=10, handle_mm=(0, 0, 150))
    for x_mm in (4.0, 500.0):
        point_mm, pose = np.array([x_mm, -3.5, 16.25]), np.eye(4)
        tip_mm = (np.linalg.inv(mr_from_tracker) @ [*point_mm, 1])[:3]
        words = ["./page", *map(repr, tip_mm.tolist())]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, check=True)
        found = np.frombuffer(done.stdout)
        pose[:3, 3] = point_mm
        felt = field.tool_force(needle, pose, 0.37, "guide")
        point_n = field.force_at(*point_mm, 0.37, "guide") @ mr_from_tracker[:3, :3]
        np.testing.assert_allclose(found[:3], point_n, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[3:6], felt.force_n, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[6:], felt.torque_nmm, rtol=0, atol=1e-6)


def wrong_meshes(folder: Path) -> None:
    """Files of which none is a mesh with triangles."""
    ball = pyvista.Icosphere(radius=2.0, nsub=2)
    for name in ("cut.stl", "cut.vtp"):
        ball.save(folder / name)
        (folder / name).write_bytes((folder / name).read_bytes()[:-2020])
    for name in ("text.stl", "text.obj", "text.txt"):
        (folder / name).write_text("no mesh\n")
    (folder / "folder.stl").mkdir()
    pyvista.Line().save(folder / "line.vtp")
    pyvista.PolyData(np.zeros((3, 3)), [3, 0, 1, 2]).save(folder / "flat.ply")


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none.stl", "no such mesh"),
        ("folder.stl", "no such mesh"),
        ("cut.stl", "is no whole STL file"),
        ("cut.vtp", "is no whole VTP file"),
        ("text.stl", "is no whole STL file"),
        ("text.obj", "holds no triangles"),
        ("text.txt", "cannot be read as a tool's mesh"),
        ("line.vtp", "holds no triangles"),
        ("flat.ply", "has no area"),
    ],
)
def test_a_wrong_mesh_is_noticed_with_its_tool(tmp_path, name, words, strict):
    """Whether the readers' warnings are errors, as in these tests, or not, as elsewhere."""
    wrong_meshes(tmp_path)
    (tmp_path / "t.yaml").write_text(f"shape: mesh\npath: {name}\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error" if strict else "ignore")
        with pytest.raises(InputError, match=rf"t\.yaml: path: .*{re.escape(name)}: {words}"):
            read_tool(tmp_path / "t.yaml")


def test_a_wrong_key_is_named_beside_the_missing_one(tmp_path):
    (tmp_path / "t.yaml").write_text("shape: torus\nradius: 10\n")
    with pytest.raises(InputError, match=r"(?s)radius_mm: is missing.*radius: unknown key"):
        read_tool(tmp_path / "t.yaml")
