"""Both readers against the formula of docs/field.md in plain NumPy, on grids of any width."""

import shutil
import subprocess

import numpy as np
import pytest
from c_program import HERE, SANITIZE, build
from field_random import EVEN, ORIGIN_MM, SPACING_MM, write_random

from pipeline.field import ForceField
from pipeline.field.batches import FEW, follow
from pipeline.geometry import Float

WAYS = {"four at a time": [], "one at a time": ["-DBEATFIELD_PLAIN"]}
MANY = (np.arange(60) + 0.3 * np.sin(np.arange(60))) / 60 + 0.005
UNEVEN = np.array([0.01, 0.02, 0.021, 0.4, 0.97])


def weights(offset: Float) -> tuple[Float, Float]:
    """Of the node before the nearest, the nearest, and the next; and their slopes."""
    values = [(0.5 - offset) ** 2 / 2, 0.75 - offset**2, (0.5 + offset) ** 2 / 2]
    return np.array(values), np.array([offset - 0.5, -2 * offset, offset + 0.5])


def by_the_text(values: Float, phases: Float, point: Float, phase: float) -> Float:
    """Distance and gradient, as docs/field.md tells a third program to compute them."""
    ghosts = values
    for axis in (1, 2, 3):
        line = np.moveaxis(ghosts, axis, 0)
        line = np.concatenate([[2 * line[0] - line[1]], line, [2 * line[-1] - line[-2]]])
        ghosts = np.moveaxis(line, 0, axis)
    middle = (phases + np.append(phases[1:], phases[0] + 1)) / 2
    turned = phase - np.floor(phase - (middle[-1] - 1))
    knots = np.concatenate([middle + turn for turn in range(-2, 3)])
    k = int(np.searchsorted(knots, turned, side="right")) - 1
    a, b, c, d = knots[k - 1 : k + 3]
    early = (c - turned) ** 2 / ((c - b) * (c - a))
    late = (turned - b) ** 2 / ((c - b) * (d - b))
    count = len(phases)
    # Knot k of the list opens the interval about phase k + 1.
    about = (k + 1) % count
    shares = zip((early, 1 - early - late, late), (about - 1, about, about + 1), strict=True)
    moment = sum(share * ghosts[n % count] for share, n in shares)
    nodes = np.array(values.shape[:0:-1])
    place = np.clip((point - ORIGIN_MM) / SPACING_MM, 0, nodes - 1)
    nearest = np.minimum(np.floor(place + 0.5), nodes - 1).astype(int)
    (wx, wy, wz), (sx, sy, sz) = (
        [part[:, axis] for axis in range(3)] for part in weights(place - nearest)
    )
    i, j, n = nearest + 1
    box = moment[n - 1 : n + 2, j - 1 : j + 2, i - 1 : i + 2]
    sums = [(wz, wy, wx), (wz, wy, sx / SPACING_MM[0])]
    sums += [(wz, sy / SPACING_MM[1], wx), (sz / SPACING_MM[2], wy, wx)]
    return np.array([np.einsum("kji,k,j,i", box, *one) for one in sums])


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """The driver built for each way of reading, watched by sanitizers."""
    if shutil.which("gcc") is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("batch")
    for name, options in WAYS.items():
        build(HERE / "field_batch_driver.c", folder / name, "-std=c99", *SANITIZE, *options)
    return {name: folder / name for name in WAYS}


@pytest.mark.parametrize("phases", [EVEN, MANY, UNEVEN, UNEVEN[:2], UNEVEN[:1]], ids=len)
@pytest.mark.parametrize("width", [2, 3, 4, 5, 9])
def test_every_reader_follows_the_text(tmp_path, programs, width, phases):
    path = tmp_path / "field.zarr"
    values = write_random(path, width, phases)
    rng = np.random.default_rng(width)
    low = np.array(ORIGIN_MM)
    high = low + (np.array([width, 5, 3]) - 1) * SPACING_MM
    # Some beyond the grid, some on its boundary, some at the very knots of time.
    points = np.clip(rng.uniform(low - 1, high + 1, (300, 3)), low - 0.5, high + 0.5)
    moments = rng.uniform(-1, 2, len(points))
    moments[:50] = rng.choice(phases, 50)
    moments[50:100] = rng.choice((phases + np.roll(phases, 1)) / 2, 50)
    expected = np.array(
        [by_the_text(values, phases, p, t) for p, t in zip(points, moments, strict=True)]
    )
    # A few dozen products of numbers of order 1, over a spacing of 0.7 mm.
    close = {"rtol": 0, "atol": 1e-12 * np.abs(values).max()}

    field = ForceField.open(path)
    np.testing.assert_allclose(field.distance_mm(points, moments), expected[:, 0], **close)
    np.testing.assert_allclose(field.gradient(points, moments), expected[:, 1:], **close)
    questions = np.column_stack([points, moments]).tobytes()
    for program in programs.values():
        done = subprocess.run([program, path], input=questions, capture_output=True, check=False)
        assert (done.returncode, done.stderr) == (0, b"")
        found = np.frombuffer(done.stdout)
        np.testing.assert_allclose(found[: len(points)], expected[:, 0], **close)
        np.testing.assert_allclose(found[len(points) :].reshape(-1, 3), expected[:, 1:], **close)


def random_questions(count: int, shape_xyz: tuple[int, int, int]) -> Float:
    """Places in the grid and a little beyond, and phases of three beats: ``(count, 4)``."""
    rng = np.random.default_rng(count)
    high = ORIGIN_MM + (np.array(shape_xyz) - 1) * SPACING_MM
    places = rng.uniform(np.array(ORIGIN_MM) - 1, high + 1, (count, 3))
    return np.column_stack([places, rng.uniform(-1, 2, count)])


@pytest.mark.parametrize("phases", [EVEN, MANY], ids=len)
@pytest.mark.parametrize("count", [1023, 4096])
def test_sorted_answers_of_c_are_those_of_single_questions(tmp_path, programs, phases, count):
    """The driver compares bit for bit, and looks whether the scratch room was used."""
    path = tmp_path / "field.zarr"
    # Three phases take more than the 512 KB of a bin, so that there are several slabs.
    write_random(path, 40, phases, 40, 32)
    questions = random_questions(count, (40, 40, 32))
    field = ForceField.open(path)
    expected = field.distance_mm(questions[:, :3], questions[:, 3])
    for program in programs.values():
        given = questions.tobytes()
        done = subprocess.run(
            [program, path, "random"], input=given, capture_output=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, b"")
        found = np.frombuffer(done.stdout)[:count]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("one_phase", [False, True])
@pytest.mark.parametrize("phases", [EVEN, MANY, UNEVEN[:1]], ids=len)
def test_sorted_answers_of_python_are_those_of_single_questions(tmp_path, phases, one_phase):
    write_random(tmp_path / "field.zarr", 40, phases, 40, 32)
    field = ForceField.open(tmp_path / "field.zarr")
    questions = random_questions(2 * FEW, (40, 40, 32))
    places, moments = questions[:, :3], np.array([0.3]) if one_phase else questions[:, 3]
    assert not follow(places, moments, field._numbers, len(phases))

    force_n = field.force_n(places, moments)
    distance_mm = field.distance_mm(places, moments)

    each = np.broadcast_to(moments, len(places))
    for n in range(0, len(places), 7):
        where = (*places[n].tolist(), float(each[n]))
        assert field.force_at(*where) == tuple(force_n[n])
        assert field.distance_at(*where) == distance_mm[n]


def test_questions_along_a_path_are_answered_as_they_come():
    """A hand of 100 mm/s at 1 kHz, on the grid of a heart: sorting would only cost time."""
    way = 0.1 * np.arange(FEW)
    path = np.column_stack([30 * np.sin(way / 30), 30 * np.cos(way / 30), way / 100])
    grid = np.array([-50.0, -50, -50, 2, 2, 2, 50, 50, 50, 0.5, 0.5, 0.5])
    beats = np.arange(FEW) / 800

    assert follow(path, beats % 1, grid, 25)
    assert follow(path, beats % 1, grid, 100)
    assert not follow(path, np.random.default_rng(0).random(FEW), grid, 25)
    assert not follow(np.random.default_rng(0).permutation(path), np.zeros(1), grid, 25)
