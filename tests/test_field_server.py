"""What a force server meets beside good questions: spoilt files, no tracker, endless tools."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from c_program import HERE, SANITIZE, build, run
from field_baked import bake_small, edit
from field_random import EVEN, ORIGIN_MM, write_random
from scipy.spatial.transform import Rotation

from pipeline.cli import main
from pipeline.errors import InputError
from pipeline.field import ForceField, files, get_include
from pipeline.field.passivity import EnergyTank
from pipeline.field.spline import phase_weights, timeline
from pipeline.field.tool import Needle, Polyline, outside_share
from pipeline.field.verify import verify_field

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("server") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    target = tmp_path_factory.mktemp("c") / "server"
    return build(HERE / "field_server_driver.c", target, "-std=c99", *SANITIZE)


def described(path, target, **changes):
    """The store with other words in its description, sealed anew."""

    def change(told):
        for key, value in changes.items():
            *parents, last = key.split("__")
            part = told
            for name in parents:
                part = part[name]
            part[last] = value

    shutil.copytree(path, target)
    edit(target, change)
    return target


def test_opening_and_verifying_often_leaves_no_file_open(path, program):
    limited = run("/bin/sh", "-c", f"ulimit -n 16; exec {program} {path} often")
    assert limited.stdout == b"done\n"


def test_gradients_may_be_left_out(path, program):
    assert run(program, path, "gradients").stdout == b"1\n"


def test_a_tank_of_nonsense_holds_nothing_and_no_number_passes_it(path, program):
    assert run(program, path, "tank").stdout == b"1\n"
    tank = EnergyTank(1.0, 20.0)
    assert tank.passed((0, 0, 0), (2, 0, 0)) == (2, 0, 0)
    assert tank.passed((float("nan"), 0, 0), (2, 0, 0)) == (0, 0, 0)
    assert tank.passed((0, 0, 0), (float("inf"), 0, 0)) == (0, 0, 0)
    assert tank.level_mj == 1
    assert tank.passed((1, 0, 0), (2, 0, 0)) == (1, 0, 0)


def test_after_a_place_too_large_for_its_square_a_tank_gives_what_it_held():
    tank, x_mm, given_mj, force_n = EnergyTank(5.0, 20.0), 0.0, 0.0, (0.0, 0.0, 0.0)
    tank.passed((0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert tank.passed((-1e308, 0.0, 0.0), (3.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
    assert tank.passed((0.0, 0.0, 0.0), (0.0, 1e308, 0.0)) == (0.0, 0.0, 0.0)
    for _ in range(1000):
        x_mm += 0.1
        given_mj += 0.1 * force_n[0]
        force_n = tank.passed((x_mm, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert 4.0 < given_mj <= 5.0


def test_a_field_that_is_not_open_contains_nothing_and_is_not_locked(path, program):
    assert run(program, path, "closed").stdout == b"1\n"


def test_a_tracker_that_comes_and_goes_drains_no_more_than_the_tank_held():
    """Every second place is unknown, and the force pushes the hand on all the while."""
    tank, given_mj = EnergyTank(1.0, 20.0), 0.0
    for tick in range(2000):
        place = float("nan") if tick % 2 else 0.1 * tick
        held = tank.passed((place, 0, 0), (2, 0, 0))[0]
        given_mj += 0.1 * held
    # One step that could not be foreseen, and the first, before any way was seen.
    assert given_mj <= 1.0 + 2 * 2 * 0.2 + 1e-9
    # What the hand gave meanwhile fills nothing.
    level_mj = tank.level_mj
    tank.passed((0, 0, 0), (2, 0, 0))
    tank.passed((float("nan"), 0, 0), (2, 0, 0))
    before_mj = tank.level_mj
    tank.passed((-50, 0, 0), (2, 0, 0))
    assert tank.level_mj <= before_mj
    assert level_mj <= 1.0


@pytest.mark.parametrize("spoil", ["cut", "overwritten"])
def test_locked_values_are_not_those_of_the_files_any_more(path, program, tmp_path, spoil):
    store = tmp_path / "field.zarr"
    shutil.copytree(path, store)
    running = subprocess.Popen(
        [program, store, "lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert running.stdout.readline() == "locked\n"
    for chunk in store.glob("spline/*/c/*/0/0/0"):
        if spoil == "cut":
            os.truncate(chunk, 0)
        else:
            with chunk.open("r+b") as file:
                file.write(b"\xff" * chunk.stat().st_size)
    said, _ = running.communicate("go\n", timeout=60)
    assert (said, running.returncode) == ("1\n", 0)


def test_points_and_forces_go_between_tracker_and_mr(path, program, tmp_path):
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, (3.0, -2.0, 1.0)
    store = described(path, tmp_path / "f.zarr", mr_from_tracker=pose.tolist())
    head, vector = run(program, store, "tracker").stdout.splitlines()
    assert head == b"1 0"
    moved = turn @ (9, 4, 2) + pose[:3, 3]
    np.testing.assert_allclose([float(x) for x in vector.split()], turn.T @ moved, atol=1e-12)


def test_without_a_registration_no_trackers_point_gets_a_force(path, program, tmp_path):
    store = described(path, tmp_path / "f.zarr", mr_from_tracker=None)
    not_finite = 8
    # And what is turned back to a device is no force, not no number.
    said = run(program, store, "tracker").stdout.splitlines()
    assert said == [b"0 %d" % not_finite, b"0 0 0"]


def test_a_tool_too_long_for_the_grid_is_refused_at_once(path, program):
    field = ForceField.open(path)
    longest_mm = 20 * float(np.linalg.norm(field.grid.upper_mm - field.grid.origin_mm))
    lengths = (0.99 * longest_mm, 1.01 * longest_mm, 1e12, 1e150)
    given = " ".join(map(str, lengths)).encode()
    fine, wrong_size = b"0", b"3"
    said = run(program, path, "long", given=given).stdout.split()
    assert said == [fine, wrong_size, wrong_size, wrong_size]
    field.tool_force(Needle(shape="needle", length_mm=lengths[0]), np.eye(4), 0.0)
    for length_mm in lengths[1:3]:
        with pytest.raises(InputError, match=r"longer than 20 diagonals"):
            field.tool_force(Needle(shape="needle", length_mm=length_mm), np.eye(4), 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"frame": "RAS"},
        {"unit": "m"},
        {"periodic": False},
        {"rr_s": -3.0},
        {"rr_s": 0.0},
        {"rr_s": 10**400},
        {"fixtures__guide__m": 100},
        {"fixtures__guide__device_limits__force_n": 0.0},
        {"mr_from_tracker": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1 + 2e-6]]},
        {"mr_from_tracker": [[1.001, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"mr_from_tracker": np.diag([1e3, 1e3, 1e3, 1]).tolist()},
        {"mr_from_tracker": np.diag([-1.0, 1, 1, 1]).tolist()},
        {"mr_from_tracker": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [9, 9, 9, 9]]},
        {"fixtures__guide__kind": "attract"},
        {"fixtures__guide__side": "outside"},
        {"fixtures__stay_out__side": None},
        {"fixtures__guide__f_max_n": 50.0},
    ],
)
def test_c_and_python_refuse_the_same_descriptions(path, program, tmp_path, changes):
    assert run(program, described(path, tmp_path / "same.zarr")).stdout == b"opened\n"
    store = described(path, tmp_path / "f.zarr", **changes)
    with pytest.raises(InputError):
        ForceField.open(store)
    assert run(program, store).stdout.startswith(b"no complete field")


def replaced(path, other, at):
    """A folder in the place of another, as baking anew puts it there."""
    shutil.copytree(path, at / "live.zarr")
    shutil.copytree(other, at / "new.zarr")

    def swap() -> None:
        (at / "live.zarr").rename(at / "old.zarr")
        (at / "new.zarr").rename(at / "live.zarr")

    return at / "live.zarr", swap


@pytest.mark.parametrize(
    "pose",
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1 + 5e-7]],
        [[1.0004, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    ],
)
def test_c_and_python_take_the_same_roundings(path, program, tmp_path, pose):
    store = described(path, tmp_path / "f.zarr", mr_from_tracker=pose)
    assert run(program, store).stdout == b"opened\n"
    np.testing.assert_array_equal(ForceField.open(store).mr_from_tracker, pose)


def test_a_store_that_is_replaced_meanwhile_is_not_mixed_with_the_other(
    path, tmp_path, monkeypatch
):
    other = described(path, tmp_path / "other.zarr", rr_s=1.7)
    live, swap = replaced(path, other, tmp_path)
    read = files.read_metadata

    def read_late(store: Path):
        about = read(store)
        swap()
        return about

    monkeypatch.setattr("pipeline.field.reader.read_metadata", read_late)
    with pytest.raises(InputError, match="was replaced while it was opened"):
        ForceField.open(live)
    monkeypatch.undo()
    assert ForceField.open(live).rr_s == 1.7


WATCHED = r"""
#include <fcntl.h>
#include <unistd.h>
#define openat own_openat
int own_openat(int folder, const char *name, int how);
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
#undef openat
int own_openat(int folder, const char *name, int how)
{
    static int asked;
    if (asked++ == 3 && system(getenv("SWAP")) != 0) return -1;
    return openat(folder, name, how);
}
int main(int count, char **words)
{
    bf_field field;
    bf_status status = count > 1 ? bf_open(&field, words[1]) : BF_CANNOT_READ;
    printf("%s %g\n", bf_text(status), status == BF_OK ? field.rr_s : 0);
    if (status == BF_OK) bf_close(&field);
    return 0;
}
"""


def test_c_opens_one_store_however_it_is_swapped_meanwhile(path, tmp_path):
    """Links turned, folders renamed, and files written over, after three of them were opened."""
    other = described(path, tmp_path / "other.zarr", rr_s=1.7)
    (tmp_path / "watched.c").write_text(WATCHED)
    program = build(tmp_path / "watched.c", tmp_path / "watched", "-std=gnu99")
    link = tmp_path / "link.zarr"
    link.symlink_to(path)
    first = run(program, link, SWAP="true").stdout
    assert first == b"done %g\n" % ForceField.open(path).rr_s
    assert run(program, link, SWAP=f"ln -sfn {other} {link}").stdout == first
    assert run(program, link, SWAP="true").stdout == b"done 1.7\n"
    live, _ = replaced(path, other, tmp_path)
    swap = f"mv {live} {tmp_path}/old.zarr && mv {tmp_path}/new.zarr {live}"
    assert run(program, live, SWAP=swap).stdout == first
    assert run(program, live, SWAP=f"cp -r {path}/. {live}").stdout == (
        b"the store was replaced while it was opened: open it again 0\n"
    )


def test_a_compiler_that_takes_no_numbers_for_numbers_is_refused(tmp_path):
    command = ["gcc", "-Ofast", f"-I{get_include()}", "-c", str(HERE / "field_driver.c")]
    done = run(*command, "-o", tmp_path / "out.o")
    assert done.returncode != 0
    assert b"compile without -ffast-math" in done.stderr


NO_NUMBERS = """
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
int main(int count, char **words)
{
    bf_field field;
    double nowhere = strtod("nan", NULL), endless = strtod("inf", NULL), force_n[3];
    double point_mm[3] = {1, nowhere, 3}, far_mm[3] = {endless, 2, 3}, one[3] = {1, 1, 1};
    bf_tank tank = bf_full_tank(5, 20);
    int n, wrong = count != 2 || bf_open(&field, words[1]) != BF_OK;
    wrong += bf_force(&field, 0, point_mm, 0.3, force_n) != BF_NOT_FINITE || force_n[0] > 0;
    wrong += bf_force(&field, 0, far_mm, 0.3, force_n) != BF_NOT_FINITE;
    wrong += bf_force(&field, 0, one, nowhere, force_n) != BF_NOT_FINITE;
    bf_pass(&tank, point_mm, one);
    for (n = 0; n < 3; n++) wrong += one[n] < 0 || one[n] > 0;
    bf_transform(field.mr_from_tracker, one, point_mm); /* not known */
    wrong += bf_force(&field, 0, point_mm, 0.3, force_n) != BF_NOT_FINITE;
    one[0] = 1;
    bf_turn_back(field.mr_from_tracker, one, one);
    for (n = 0; n < 3; n++) wrong += !(one[n] >= 0 && one[n] <= 0);
    printf("%d\\n", wrong);
    bf_close(&field);
    return 0;
}
"""


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(
    "options", [["-funsafe-math-optimizations"], ["-ffast-math", "-fno-finite-math-only"]]
)
def test_what_is_no_number_is_refused_where_sums_may_be_reordered(
    path, tmp_path, compiler, options
):
    """Options that the header cannot see: Clang then takes x - x for 0 whatever x is."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    field = described(path, tmp_path / "field.zarr", mr_from_tracker=None)
    (tmp_path / "own.c").write_text(NO_NUMBERS)
    program = build(tmp_path / "own.c", tmp_path / "own", "-std=gnu99", *options, compiler=compiler)
    assert run(program, field).stdout == b"0\n"


@pytest.mark.parametrize("standard", [pytest.param("gnu99", marks=pytest.mark.slow), "gnu17"])
def test_other_declarations_are_left_to_the_program(tmp_path, standard):
    source = tmp_path / "own.c"
    source.write_text(
        '#define BEATFIELD_IMPLEMENTATION\n#include "beatfield.h"\n#include <unistd.h>\n'
        "int main(void) { return usleep(0) || M_PI < 3; }\n"
    )
    build(source, tmp_path / "own", f"-std={standard}")


UNLOCKED = """
#define _GNU_SOURCE
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
#include <malloc.h>

/* Parts of the heap that may be paged out, -1 where no heap is told of. */
static int unlocked(void)
{
    FILE *maps = fopen("/proc/self/smaps", "r");
    char line[1024];
    int heap = 0, heaps = 0, count = 0;
    while (maps && fgets(line, sizeof line, maps)) {
        if (strstr(line, "[heap]")) heap = 1;
        if (strncmp(line, "VmFlags:", 8) != 0) continue;
        count += heap && !strstr(line, " lo");
        heaps += heap;
        heap = 0;
    }
    if (maps) fclose(maps);
    return heaps ? count : -1;
}

int main(int count, char **words)
{
    bf_field field;
    if (count < 2 || !mallopt(M_MMAP_MAX, 0) || !mallopt(M_TRIM_THRESHOLD, -1)) return 1;
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) return 77;
    if (bf_open(&field, words[1]) != BF_OK || bf_lock(&field) != BF_OK) return 77;
    bf_close(&field);
    printf("%d\\n", unlocked());
    return 0;
}
"""


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs Linux")
def test_what_the_program_has_locked_stays_locked_when_a_field_is_closed(path, tmp_path):
    (tmp_path / "own.c").write_text(UNLOCKED)
    program = build(tmp_path / "own.c", tmp_path / "own", "-std=gnu99", "-O0")
    done = run(program, path)
    if done.returncode == 77:
        pytest.skip("not allowed to lock memory")
    assert (done.returncode, done.stdout) == (0, b"0\n")


@pytest.mark.parametrize("phase", [1e17, 1e19, -1e19, 1e300])
def test_of_any_phase_only_the_fraction_counts(path, phase):
    field = ForceField.open(path)
    assert field.force_at(9.0, 4.0, 2.0, phase) == field.force_at(9.0, 4.0, 2.0, 0.0)


FORCE_AT_ANY_PHASE = """
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
int main(int count, char **words)
{
    bf_field field;
    double point_mm[3] = {9, 4, 2}, force_n[3];
    if (count != 3 || bf_open(&field, words[1]) != BF_OK) return 1;
    if (bf_force(&field, 0, point_mm, strtod(words[2], NULL), force_n) != BF_OK) return 1;
    printf("%.17g %.17g %.17g", force_n[0], force_n[1], force_n[2]);
    bf_close(&field);
    return 0;
}
"""


@pytest.mark.parametrize("phase", [1e17, pytest.param(-1e300, marks=pytest.mark.slow)])
def test_nor_does_more_count_where_the_first_interval_begins_past_0(path, tmp_path, phase):
    late = described(path, tmp_path / "late.zarr", phases=[0.3, 0.35, 0.4, 0.5, 0.9])
    field = ForceField.open(late)
    expected = field.force_at(9.0, 4.0, 2.0, 0.0)
    assert field.force_at(9.0, 4.0, 2.0, phase) == expected
    assert phase_weights(timeline(field.phases), phase) == phase_weights(
        timeline(field.phases), 0.0
    )
    (tmp_path / "force.c").write_text(FORCE_AT_ANY_PHASE)
    force = build(tmp_path / "force.c", tmp_path / "force", "-std=c99")
    said = [run(force, late, one).stdout for one in (phase, 0)]
    assert said[0] == said[1] != b""


def test_both_languages_tell_the_same_share_outside_the_grid(path, program):
    """Of a bent line, the same line closed, and its first point alone; in poses of all kinds."""
    corners = ((0.0, 0, 0), (5, 0, 0), (5, 40, 0), (5, 40, -70))
    tools = [
        Polyline(shape="polyline", points_mm=points, closed=closed)
        for points, closed in ((corners, False), (corners, True), (corners[:1], True))
    ]
    rng, field, poses = np.random.default_rng(3), ForceField.open(path), []
    for number in range(60):
        pose = np.eye(4)
        if number % 3:
            pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-70, 70, 3)
        poses.append(pose)
    poses[0][:3, 3] = field.grid.upper_mm
    poses[3][:3, 3] = field.grid.upper_mm + 1e-9
    given = " ".join(repr(float(value)) for value in np.ravel(poses)).encode()
    found = np.array(run(program, path, "outside", given=given).stdout.split(), float)
    known = [outside_share(field.grid, tool, pose) for pose in poses for tool in tools]
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-12)
    assert found.min() == 0
    assert found.max() == 1
    by_columns, in_metres = np.eye(4), np.diag([1e-3, 1e-3, 1e-3, 1])
    by_columns[3, :3] = field.grid.upper_mm / 2
    for refused in (np.full((4, 4), np.nan), by_columns, in_metres):
        given = " ".join(map(repr, map(float, refused.ravel()))).encode()
        assert run(program, path, "outside", given=given).stdout.split() == [b"1", b"1", b"1"]


def test_numbers_are_read_as_python_reads_them(path, program):
    """As JSON writers write numbers of 17 digits; to the last bit where long double has 64 bits."""
    rng = np.random.default_rng(11)
    numbers = rng.normal(0, 100, 3000)
    numbers[::3] *= 10.0 ** rng.integers(-200, 200, 1000)
    texts = [repr(float(one)) for one in numbers]
    texts += ["0", "-0.0", "1e400", "-1e400", "1e-400", "0e999", "0.0001234567890123456789012345"]
    texts += ["123456789012345678901234567890", "1" + 40 * "0" + "e-40", "0." + 30 * "0" + "1e31"]
    said = run(program, path, "numbers", given=" ".join(texts).encode()).stdout.split()
    found, known = np.array(said[:-1], float), np.array(texts, float)
    assert said[-1] == b"0"
    whole = np.abs(known) < 1e27
    np.testing.assert_allclose(found, known, rtol=2e-15)
    if np.finfo(np.longdouble).nmant >= 63:
        assert np.mean(found[whole] == known[whole]) > 0.995
    assert str(found[len(numbers) + 1]) == "-0.0"
    for bad in ("-", "1e", "e5", ".", "x"):
        assert run(program, path, "numbers", given=bad.encode()).stdout.split()[-1] == b"1"


@pytest.mark.parametrize(
    ("source", "said", "doubts"),
    [
        (
            {"use": "x", "patient_id": "patient-0007", "inputs": {"patient_id": "no"}},
            "patient-0007",
            None,
        ),
        ({"patient_id": "A" * 100, "doubts": []}, "A" * 63, []),
        ({"shape": "ball", "doubts": ["[one]", 'two, "or" not']}, "", ["[one]", 'two, "or" not']),
        ({"patient_id": None, "doubts": {"a": "b"}, "registration": {"doubts": ["c"]}}, "", None),
        ({"doubts": "one"}, "", None),
        ({}, "", None),
    ],
)
def test_c_is_told_whose_field_it_is_and_what_speaks_against_it(
    path, program, tmp_path, source, said, doubts, capsys
):
    named = described(path, tmp_path / "f.zarr", source=source)
    told = run(program, named, "patient").stdout.decode()
    assert told == f"{said}, {-1 if doubts is None else len(doubts)} doubts\n"
    words = str(verify_field(named))
    assert words.startswith(f"whole, of {source['patient_id']}: " if said else "whole: ")
    assert main(["verify", str(named)]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        f"doubtful  {text}" for text in doubts or []
    ]


def test_a_tool_of_which_a_number_is_none_is_nowhere(path, program):
    assert run(program, path, "nowhere").stdout.split() == [b"1"] * 27


def test_a_tool_leaves_an_oblong_grid_where_its_axis_ends(tmp_path, program):
    """From the grid's first corner 40 mm along y, of which the grid has 8."""
    write_random(tmp_path / "f.zarr", 7, EVEN)
    # The driver's lines, longest piece 70 mm along -z: turned so that y of the tool is y of the MR.
    pose = np.eye(4)
    pose[:3, 3] = np.array(ORIGIN_MM) - (5, 0, 0)
    given = " ".join(map(repr, map(float, pose.ravel()))).encode()
    found = float(run(program, tmp_path / "f.zarr", "outside", given=given).stdout.split()[0])
    # 5 mm before the grid, 8 of 40 mm within it, 70 mm beside it.
    assert found == pytest.approx(1 - 8 / 115, abs=1e-9)
