"""The C header: compiled without a warning, the same answers as Python, and damage survived."""

import json
import os
import random
import shutil

import numpy as np
import pytest
from c_program import HERE, SANITIZE, build, run
from field_baked import FIXTURES, PHASES, bake_small, edit, seal
from field_random import EVEN, ORIGIN_MM, SPACING_MM, write_random
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.field import ForceField
from pipeline.field.passivity import EnergyTank
from pipeline.field.tool import Needle

EXAMPLE = HERE.parent / "docs" / "examples" / "query.c"
DRIVER = HERE / "field_driver.c"

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("header") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build(DRIVER, tmp_path_factory.mktemp("c") / "driver", "-std=c99")


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """The same program, watched by the address and undefined-behaviour sanitizers."""
    target = tmp_path_factory.mktemp("c") / "watched"
    return build(DRIVER, target, "-std=c99", *SANITIZE)


@pytest.mark.parametrize(
    ("source", "compiler", "standard"),
    [
        (EXAMPLE, "gcc", "-std=c99"),
        pytest.param(EXAMPLE, "gcc", "-std=c11", marks=pytest.mark.slow),
        (EXAMPLE, "g++", "-std=c++11"),
        # As C99 the driver is built, no warning let pass, for what is asked of it below.
        pytest.param(DRIVER, "gcc", "-std=c11", marks=pytest.mark.slow),
        (DRIVER, "g++", "-std=c++11"),
    ],
)
def test_compiles_without_a_warning(tmp_path, source, compiler, standard):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    build(source, tmp_path / "program", standard, compiler=compiler)


@pytest.mark.parametrize("compiler", ["gcc", "clang", "g++", "clang++"])
def test_a_robots_strict_build_takes_the_headers(tmp_path, compiler):
    """What ROS 2 packages ask for; clang++ tells more conversions than the others.

    These are told whatever is optimized; what only an optimizer sees is told of the same source
    in `test_example_servers`.
    """
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    standard = "-std=c++17" if "++" in compiler else "-std=c99"
    # Windows' own header makes nothing of two words, and is included before ours.
    strict = ["-Wconversion", "-Wshadow", "-O0", standard, "-Dfar=", "-Dnear="]
    server = EXAMPLE.with_name("server.c")
    build(server, tmp_path / "program", *strict, compiler=compiler)


@pytest.mark.parametrize("compiler", ["gcc", "g++"])
def test_compiles_for_windows(tmp_path, compiler):
    compiler = f"x86_64-w64-mingw32-{compiler}"
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    standard = "-std=c++11" if "++" in compiler else "-std=c99"
    server = EXAMPLE.with_name("server.c")
    build(server, tmp_path / "program.exe", standard, "-include", "windows.h", compiler=compiler)


def test_a_million_answers_are_pythons(path, program):
    field = ForceField.open(path)
    rng = np.random.default_rng(0)
    # Beyond the grid too, and phases of other beats.
    questions = np.column_stack(
        [rng.uniform(-60, 60, (1_000_000 // 3, 3)), rng.uniform(-1, 2, 1_000_000 // 3)]
    )
    done = run(program, path, given=questions.tobytes())
    assert done.returncode == 0
    answers = np.frombuffer(done.stdout).reshape(len(questions), len(FIXTURES), 8)
    points, phases = questions[:, :3], questions[:, 3]
    for number, (name, law) in enumerate(FIXTURES.items()):
        found = answers[:, number]
        expected = np.column_stack(
            [
                field.force_n(points, phases, name),
                field.distance_mm(points, phases, law.structure),
                field.gradient(points, phases, law.structure),
                field.potential(points, phases, name),
            ]
        )
        # Relative to the largest of each, for differences of near equal numbers lose digits.
        scale = np.abs(expected).max(axis=0)
        assert (np.abs(found - expected) <= 1e-12 * scale).all()


def test_what_lies_in_the_grid_is_pythons(path, program):
    field = ForceField.open(path)
    low, high = np.array(field.grid.origin_mm), field.grid.upper_mm
    rng = np.random.default_rng(1)
    around = rng.uniform(low - 10, high + 10, (10_000, 3))
    middle = (low + high) / 2
    edges = [
        np.where(np.arange(3) == axis, end, middle) for axis in range(3) for end in (low, high)
    ]
    beyond = [middle + (edge - middle) * (1 + 1e-9) for edge in edges]
    points = np.array([*around, *edges, *beyond])
    done = run(program, path, "contains", given=points.tobytes())
    found = np.frombuffer(done.stdout) == 1
    np.testing.assert_array_equal(found, field.contains(points))
    np.testing.assert_array_equal(found[-12:], [True] * 6 + [False] * 6)
    assert 0.1 < found[:10_000].mean() < 0.9
    nowhere = np.array([np.nan, *middle[1:]])
    assert np.frombuffer(run(program, path, "contains", given=nowhere.tobytes()).stdout) == 0


def test_example_prints_what_query_says(path, tmp_path):
    program = build(EXAMPLE, tmp_path / "query")
    field = ForceField.open(path)
    point, phase = (14.0, -3.5, 6.25), 0.37

    lines = run(program, path, *point, phase).stdout.decode().splitlines()

    assert [line.split(":")[0] for line in lines] == list(FIXTURES)
    for line, name in zip(lines, FIXTURES, strict=True):
        said = [float(word) for word in line.split("force ")[1].split()[:3]]
        np.testing.assert_allclose(said, field.force_n([point], phase, name)[0], rtol=1e-8)
    assert run(program, path.parent / "none", *point, phase).returncode == 2
    said = run(program, path, 500, 0, 0, phase).stdout.decode().splitlines()
    assert all(line.endswith(" (outside the grid)") for line in said)
    assert not any("outside" in line for line in lines)


@pytest.mark.parametrize("word", ["refuse", "lock"])
def test_wrong_questions_have_codes(path, watched, word):
    done = run(watched, path, word)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("way", [[], ["-DBEATFIELD_PLAIN"]], ids=["wide", "plain"])
def test_a_field_that_is_damaged_gives_zeros_and_says_so(path, tmp_path, watched, way):
    """One coefficient that is no number, in a file whose size is as it should be."""
    program = watched
    if way:
        program = build(DRIVER, tmp_path / "driver", "-std=c99", *SANITIZE, *way)
    field, folder = ForceField.open(path), tmp_path / "f.zarr"
    shutil.copytree(path, folder)
    chunk = np.memmap(folder / "spline/ball/c/1/0/0/0", "<f4", "r+", shape=field.grid.shape)
    node = (9, 12, 10)
    question = np.array([*field.grid.origin_mm + 3.0 * np.array(node[::-1]), PHASES[1]]).tobytes()
    assert run(program, folder, "damaged", given=question).returncode == 100
    for value in (np.nan, np.inf, -np.inf):
        chunk[node] = value
        done = run(program, folder, "damaged", given=question)
        assert (done.returncode, done.stderr) == (0, b"")
        # Who copies it all before the loop is told then, not by a hole in the middle.
        assert run(program, folder, "lock").returncode == 100


def test_a_pose_that_is_none_is_refused_as_in_python(path, watched):
    turn = np.eye(4)
    turn[:3] = np.column_stack([Rotation.from_rotvec((0.3, -1, 2)).as_matrix(), (5, -6, 7)])
    stretched = [np.diag([1 + off, 1, 1, 1]) for off in (1, 6e-4, 4e-4, -4e-4, -6e-4)]
    sheared, last = np.eye(4) + np.eye(4, k=1) * 0.9e-3, turn.copy()
    sheared[2, 3], last[3, 3] = 0, 1 + 2e-6
    mirror, skew = np.diag([1.0, 1, -1, 1]), np.eye(4) + 2e-3 * np.diag([1, 0, 0], k=1)
    poses = [turn, turn.T, mirror, 0 * turn, skew, sheared, last, *stretched]
    field, tool = ForceField.open(path), Needle(shape="needle", length_mm=9)

    def refused(pose):
        try:
            field.tool_force(tool, pose, 0.0)
        except InputError:
            return True
        return False

    done = run(watched, path, "poses", given=np.array(poses).tobytes())

    assert (done.returncode, done.stderr) == (0, b"")
    found = np.frombuffer(done.stdout) != 0
    assert found.tolist() == [refused(pose) for pose in poses]
    assert found.tolist() == [n not in (0, 5, 9, 10) for n in range(len(poses))]


def test_a_comma_for_a_point_in_the_locale_does_not_matter(path, program):
    question = np.array([10.0, 5, 3, 0.4]).tobytes()
    plain = run(program, path, given=question, LC_ALL="C").stdout
    assert run(program, path, given=question, LC_ALL="de_DE.UTF-8").stdout == plain


def test_sanitizers_find_nothing_at_the_borders(path, watched):
    field = ForceField.open(path)
    low, high = np.array(field.grid.origin_mm), field.grid.upper_mm
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T
    near = np.concatenate([corners, corners - 1e-9, corners + 1e-9, 1e9 * corners])
    phases = np.array([0, 1 - 2**-53, -1e-300, 0.05, 1e6, -1e6])
    questions = np.column_stack([np.tile(near, (6, 1)), np.repeat(phases, len(near))])
    done = run(watched, path, given=questions.tobytes())
    assert (done.returncode, done.stderr) == (0, b"")
    assert np.isfinite(np.frombuffer(done.stdout)).all()


def ring(radius_mm: float, count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return radius_mm * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])


TOOLS = {
    "torus": (ring(10, 48), True),
    "needle": (np.array([[0.0, 0, 0], [0, 0, 60]]), False),
    "bent": (np.array([[-20.0, 0, 0], [0, 5, 0], [0, 5, 0], [3, 5, 25], [3, 5, 26]]), False),
    "point": (np.array([[1.0, 2, 3]]), False),
}


@pytest.mark.parametrize("name", TOOLS)
def test_force_on_a_tool_keeps_its_bound(path, watched, name):
    """Against the plain mean over 100,000 points along the tool, through medial axes too."""
    line, closed = TOOLS[name]
    field = ForceField.open(path)
    rng = np.random.default_rng(5)
    poses = []
    for _ in range(12):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-20, 20, 3)
        poses.append(np.append(pose.ravel(), rng.uniform()))
    given = line.tobytes() + np.concatenate(poses).tobytes()

    bounds, answers = (0.05, 0.005), []
    for bound in bounds:
        done = run(watched, path, "tool", bound, len(line), int(closed), given=given)
        assert (done.returncode, done.stderr) == (0, b"")
        answers.append(np.frombuffer(done.stdout).reshape(len(poses), len(FIXTURES), 7))

    along = points_along(line, closed, 100_000)
    for pose, *answer in zip(poses, *answers, strict=True):
        matrix = pose[:16].reshape(4, 4)
        points = along @ matrix[:3, :3].T + matrix[:3, 3]
        levers = (along - (0, 0, 100)) @ matrix[:3, :3].T
        reach_mm = np.linalg.norm(levers, axis=1).max()
        for fixture, *told in zip(FIXTURES, *answer, strict=True):
            forces = field.force_n(points, pose[16], fixture)
            torque = np.cross(levers, forces).mean(axis=0)
            for bound, found in zip(bounds, told, strict=True):
                assert np.linalg.norm(found[:3] - forces.mean(axis=0)) <= bound
                assert np.linalg.norm(found[3:6] - torque) <= bound * reach_mm
                # Far fewer questions than the sum.
                assert found[6] < 2000


@pytest.mark.parametrize("unknown", [0.0, 0.2])
def test_the_energy_tank_is_pythons(path, watched, unknown):
    """What the hand gave on a way that was not seen, for places are unknown, fills neither."""
    rng = np.random.default_rng(2)
    moves = rng.random((2000, 1)) < 0.7
    points = np.cumsum(moves * rng.normal(scale=0.3, size=(2000, 3)), axis=0)
    points[rng.random(2000) < unknown] = np.nan
    forces = rng.normal(scale=1.5, size=(2000, 3))
    tank = EnergyTank(3.0, 8.0)
    expected = [(*tank.passed(p, f), tank.level_mj) for p, f in zip(points, forces, strict=True)]

    done = run(watched, path, "tank", 3.0, 8.0, given=np.column_stack([points, forces]).tobytes())

    found = np.frombuffer(done.stdout).reshape(-1, 4)
    # The tank's level adds up 2000 roundings of a few millijoules.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert (found[:, 3] < 0).any()


def points_along(line, closed, count):
    """Evenly spaced points along straight pieces, each the middle of its share."""
    ends = np.concatenate([line, line[:1]]) if closed else line
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    if len(lengths) == 0 or lengths.sum() == 0:
        return np.repeat(line[:1], count, axis=0)
    start = np.concatenate([[0], np.cumsum(lengths)])
    keep = np.concatenate([[True], lengths > 0])
    place = (np.arange(count) + 0.5) / count * start[-1]
    return np.column_stack([np.interp(place, start[keep], ends[keep][:, k]) for k in range(3)])


def damaged(path, target, change):
    shutil.copytree(path, target)
    change(target)
    return target


def cut(file, size):
    os.truncate(file, size)


DAMAGE = {
    "no manifest": lambda f: (f / "manifest.json").unlink(),
    "empty manifest": lambda f: cut(f / "manifest.json", 0),
    "cut manifest": lambda f: cut(f / "manifest.json", 300),
    "cut description": lambda f: cut(f / "zarr.json", 500),
    "no coefficients": lambda f: (f / "spline/ball/c/2/0/0/0").unlink(),
    "short coefficients": lambda f: cut(f / "spline/ball/c/2/0/0/0", 100),
    "a folder for a file": lambda f: (
        (f / "spline/ball/c/2/0/0/0").unlink(),
        (f / "spline/ball/c/2/0/0/0").mkdir(),
    ),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_refused(path, watched, tmp_path, kind):
    broken = damaged(path, tmp_path / "f.zarr", DAMAGE[kind])
    done = run(watched, broken)
    assert 0 < done.returncode < 9
    assert done.stderr == b""


def test_verify_finds_a_flipped_bit(path, watched, tmp_path):
    assert run(watched, path, "verify").stdout == b"done\n"

    def flip(folder):
        file = folder / "potential/guide/c/1/0/0/0"
        content = bytearray(file.read_bytes())
        content[1234] ^= 1
        file.write_bytes(content)

    done = run(watched, damaged(path, tmp_path / "f.zarr", flip), "verify")
    assert b"not what the manifest says" in done.stdout


def test_verify_finds_a_file_that_the_manifest_names_no_more(path, watched, tmp_path):
    def forget(folder):
        file = folder / "manifest.json"
        content = json.loads(file.read_text())
        del content["files"]["spline/ball/c/1/0/0/0"]
        file.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")

    done = run(watched, damaged(path, tmp_path / "f.zarr", forget), "verify")
    assert b"not what the manifest says" in done.stdout


def test_any_description_is_survived(path, watched, tmp_path):
    """Descriptions with bytes changed, cut or doubled at random, sealed anew so that they are
    parsed: refused or understood, never a fault that a sanitizer sees."""
    chance = random.Random(0)  # no secret depends on it
    text = (path / "zarr.json").read_bytes()
    start = text.index(b'"beatfield"')
    folder = damaged(path, tmp_path / "f.zarr", lambda f: None)
    for _ in range(60):
        content = bytearray(text)
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(start, len(content) - 20)
            kind = chance.randrange(3)
            if kind == 0:
                content[at] = chance.choice(b'{}[],:"0123456789-.e\\ntx')
            elif kind == 1:
                del content[at : at + chance.randint(1, 30)]
            else:
                content[at:at] = content[at : at + chance.randint(1, 30)]
        (folder / "zarr.json").write_bytes(content)
        seal(folder)
        done = run(watched, folder, given=np.zeros(4).tobytes())
        assert 0 <= done.returncode < 9
        assert done.stderr == b""


def described(path, target, change):
    """A copy whose description was changed, sealed again."""
    return damaged(path, target, lambda folder: edit(folder, change))


def test_a_force_that_python_rounds_to_the_devices_is_taken(path, program, tmp_path):
    def round_up(field):
        for fixture in field["fixtures"].values():
            fixture["f_max_n"] = fixture["device_limits"]["force_n"] * (1 + 1e-10)
            fixture["delta_mm"] = 20.0

    other = described(path, tmp_path / "f.zarr", round_up)
    assert any(ForceField.open(other).force_at(25.0, 5, 3, 0.4, "stay_in"))
    assert run(program, other, given=np.array([10.0, 5, 3, 0.4]).tobytes()).returncode == 0


@pytest.mark.parametrize("share", [0.999, 1 + 1e-10, 1.001, 0.0, None])
def test_a_fixture_stiffer_than_its_device_is_refused_as_in_python(path, program, tmp_path, share):
    def limit(field):
        for fixture in field["fixtures"].values():
            fixture["device"], own = "mine", fixture["stiffness_n_per_m"]
            fixture["device_limits"]["stiffness_n_per_m"] = share and own / share

    other = described(path, tmp_path / "f.zarr", limit)
    code = run(program, other, given=np.array([10.0, 5, 3, 0.4]).tobytes()).returncode
    assert (code == 0) == (share is None or 0 < share < 1.0005)


def test_metadata_is_understood_whatever_the_order_of_its_keys(path, program, tmp_path):
    def reorder(field):
        for key in sorted(field):
            field[key] = field.pop(key)

    question = np.array([10.0, 5, 3, 0.4]).tobytes()
    other = described(path, tmp_path / "f.zarr", reorder)
    assert run(program, other, given=question).stdout == run(program, path, given=question).stdout


def test_each_axis_of_an_oblong_grid_ends_where_its_own_nodes_do(tmp_path, program):
    write_random(tmp_path / "f.zarr", 7, EVEN)
    field = ForceField.open(tmp_path / "f.zarr")
    low = np.array(ORIGIN_MM)
    size = np.array([6, 4, 2]) * SPACING_MM
    points = np.concatenate([low + size * (0.5 + share * np.eye(3)) for share in (0.49, 0.51)])
    done = run(program, tmp_path / "f.zarr", "contains", given=points.tobytes())
    expected = [True] * 3 + [False] * 3
    assert (np.frombuffer(done.stdout) == 1).tolist() == expected
    assert field.contains(points).tolist() == expected
