"""Questions to a baked field: against closed forms, plain NumPy, and difference quotients."""

import json
import pickle
import shutil
import subprocess
import sys
from copy import deepcopy

import numpy as np
import pytest
from field_baked import FIXTURES, PHASES, RADII_MM, RR_S, SETTINGS, TRACKER, bake_small, edit
from field_shapes import beating, sag, sphere
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from pipeline.cli import main
from pipeline.errors import InputError
from pipeline.field import Fixture, ForceField, kernels
from pipeline.field.bake import bake_field
from pipeline.field.potential import direction_scale, offence, potential, pull
from pipeline.field.query import query_point, stiffness_words
from pipeline.geometry import Float

places = st.floats(-38, 38)
points = st.tuples(places, places, places)
phases = st.floats(0, 1, exclude_max=True)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reader") / "field.zarr"
    bake_small(folder)
    return folder


@pytest.fixture(scope="module")
def field(path):
    return ForceField.open(path)


def test_another_process_gets_a_field_by_its_path(path, field):
    for copy in (pickle.loads(pickle.dumps(field)), deepcopy(field)):
        point, phase = (9.0, -4.0, 2.0), 0.3
        assert copy.force_at(*point, phase) == field.force_at(*point, phase)
    assert len(pickle.dumps(field)) < 1000


def random_points(count: int, seed: int = 0) -> Float:
    """Points within 32 mm of the middle, all in the grid."""
    return np.random.default_rng(seed).uniform(-32, 32, (count, 3))


def test_says_what_it_holds(field):
    np.testing.assert_array_equal(field.phases, PHASES)
    np.testing.assert_array_equal(field.mr_from_tracker, TRACKER)
    assert field.rr_s == RR_S
    assert field.structures == ("ball", "core")
    assert list(field.fixtures) == list(FIXTURES)
    for name, fixture in FIXTURES.items():
        found = field.fixtures[name]
        assert found.resolved_delta_mm == fixture.resolved_delta_mm
        assert (found.kind, found.side, found.m) == (fixture.kind, fixture.side, fixture.m)
    assert field.source == {"shape": "ball"}
    assert field.accuracy["sign_errors"] == 0
    assert field.grid.spacing_mm == (3.0, 3.0, 3.0)


def test_chunk_files_are_the_field(path, field):
    """A program with a JSON parser and mmap reads the same values, at every node and phase."""
    description = json.loads((path / "zarr.json").read_text())["attributes"]["beatfield"]
    grid = description["grid"]
    axes = [
        origin + spacing * np.arange(count)
        for origin, spacing, count in zip(
            grid["origin_mm"], grid["spacing_mm"], grid["shape_zyx"][::-1], strict=True
        )
    ]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    nodes = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    for k, phase in enumerate(description["phases"]):
        chunk = path / "distance" / "ball" / "c" / str(k) / "0" / "0" / "0"
        raw = np.memmap(chunk, dtype="<f4", mode="r").astype(float)

        # The spline takes the node's value but for coefficients rounded to float32.
        rounding_mm = 4 * 2.0**-24 * np.abs(raw).max()
        np.testing.assert_allclose(field.distance_mm(nodes, phase), raw, rtol=0, atol=rounding_mm)

        law = FIXTURES["guide"]
        height = potential(np.abs(raw), law.resolved_delta_mm, law.m)
        steepest = law.stiffness_n_per_m / 1000 / law.f_max_n
        np.testing.assert_allclose(
            field.potential(nodes, phase), height, rtol=0, atol=steepest * rounding_mm
        )
        stored = np.memmap(path / "potential/guide/c" / str(k) / "0/0/0", dtype="<f4", mode="r")
        np.testing.assert_allclose(stored, height, rtol=0, atol=2**-24)


@pytest.mark.parametrize("k", range(len(PHASES)))
def test_space_is_the_quadratic_spline_of_scipy(field, k):
    """An independent spline through the stored distances of one phase."""
    stored = field.stored_distance_mm("ball", k).astype(float)
    asked = random_points(400)[np.abs(random_points(400)).max(axis=1) < 12]
    places = ((asked - field.grid.origin_mm) / 3.0).T[::-1]

    expected = map_coordinates(stored, places, order=2, mode="mirror")

    # SciPy mirrors at the boundary, at least 7 nodes away: (3 - sqrt 8)^7 of a slope of 1, 3 mm.
    np.testing.assert_allclose(
        field.distance_mm(asked, PHASES[k]), expected, rtol=0, atol=3 * (3 - 8**0.5) ** 7
    )


@pytest.mark.parametrize(("k", "phase"), list(enumerate(PHASES)))
def test_distance_is_that_of_the_ball(field, k, phase):
    asked = random_points(500)
    r = np.linalg.norm(asked, axis=1)

    error = np.abs(field.distance_mm(asked, phase) - (r - RADII_MM[k]))

    # Linear interpolation errs by at most h^2 / 8 times the sum of the second derivatives, 2 / r
    # for the distance from a point r away; the spline is better wherever that is small.
    clear = r > 9
    bound = 3.0**2 / 8 * 2 / (r[clear] - 3) + sag(sphere(20, 3), 20)
    assert (error[clear] <= bound).all()
    assert np.median(error) < 0.1


@pytest.mark.parametrize("count", [3, 8, 25])
def test_between_phases_the_error_falls_with_the_third_power_of_the_step(tmp_path, count):
    """Truth: a radius that swings as a cosine, 3 mm up and down, asked at any moment."""
    phases = (np.arange(count) + 0.3) / count
    swing = beating(sphere(1.0, 3), 20 + 3 * np.cos(2 * np.pi * phases), phases)
    fixture = Fixture(structure="ball", kind="guidance", delta_mm=8.0, f_max_n=1.0)
    bake_field(tmp_path / "f.zarr", {"ball": swing}, {"hold": fixture}, SETTINGS, rr_s=0.8)
    field = ForceField.open(tmp_path / "f.zarr")
    moments = np.linspace(0, 1, 301)
    corner = sphere(1.0, 3).vertices_mm[7]

    found = field.distance_mm(np.tile(20 * corner, (301, 1)), moments)

    # On this ray every distance is the radius's change plus what one place in space is off by.
    still = field.distance_mm([20 * corner], phases[0])[0] + 3 * np.cos(2 * np.pi * phases[0])
    error = np.abs(found - (still - 3 * np.cos(2 * np.pi * moments)))
    # The spline that interpolates between its knots errs by at most h^3 / 24 of the third
    # derivative (twice the bound of de Boor, A Practical Guide to Splines, ch. 6, for equal
    # steps); the place in space errs by h^2 / 8 * 2 / r more or less as the ball moves 3 mm.
    in_space = 3.0**2 / 8 * 2 * 6 / 17**2
    assert error.max() <= 3 * (2 * np.pi / count) ** 3 / 24 + in_space


@given(points, phases)
def test_gradient_is_the_slope_of_the_distance(field, point, phase):
    # Rounding of values of up to 50 mm and truncation meet near this step.
    step = 1e-4
    shifts = step * np.eye(3)
    around = np.array(point) + np.concatenate([shifts, -shifts])
    rise = field.distance_mm(around, phase)
    if not field.contains(around).all():
        return

    slope = (rise[:3] - rise[3:]) / (2 * step)

    # Third derivatives jump at voxel faces; in between, values of 50 mm at nodes 3 mm apart bound
    # the second derivative by 1 / mm, so that a one-sided step errs by 1e-4.
    np.testing.assert_allclose(field.gradient([point], phase)[0], slope, rtol=0, atol=1e-4)


@given(points, phases, st.sampled_from(sorted(FIXTURES)))
def test_potential_and_force_are_the_formulas_on_the_distance(field, point, phase, name):
    law = FIXTURES[name]
    distance = field.distance_mm([point], phase, law.structure)
    gradient = field.gradient([point], phase, law.structure)
    delta = law.resolved_delta_mm

    height = potential(offence(distance, law.side_code), delta, law.m)
    size = pull(distance, law.side_code, delta, law.m)
    force = -law.f_max_n * size[:, None] * gradient
    force *= direction_scale(np.linalg.norm(gradient, axis=1))[:, None]

    np.testing.assert_array_equal(field.potential([point], phase, name), height)
    np.testing.assert_allclose(field.force_n([point], phase, name), force, rtol=1e-12, atol=1e-15)
    assert np.linalg.norm(force) <= law.f_max_n * (1 + 1e-12)


@given(points, phases, st.sampled_from(sorted(FIXTURES)))
def test_force_points_down_the_potential(field, point, phase, name):
    """Where the potential is steep enough to tell, and the direction is a unit vector."""
    force = field.force_n([point], phase, name)[0]
    size = np.linalg.norm(force)
    if size < 1e-3:
        return
    step = 1e-3
    ahead = field.potential(np.array([point]) + step * force / size, phase, name)

    assert ahead <= field.potential([point], phase, name) + 1e-9


def test_forbidden_regions_push_back_and_leave_alone(field):
    outside, inside = np.array([[30.0, 1, 2]]), np.array([[12.0, 1, 2]])

    assert field.force_n(outside, 0.05, "stay_in")[0, 0] < -1
    np.testing.assert_array_equal(field.force_n(inside, 0.05, "stay_in"), 0)
    np.testing.assert_array_equal(field.force_n(inside, 0.05, "stay_out"), 0)
    assert field.force_n([[6.0, 1, 1]], 0.05, "stay_out")[0, 0] > 0.3


def longest_step(values: Float) -> float:
    """Largest change between one sample and the next."""
    return float(np.linalg.norm(np.diff(values, axis=0), axis=1).max())


@pytest.mark.parametrize("name", FIXTURES)
@pytest.mark.parametrize("seed", range(4))
def test_force_has_no_step_in_space(field, name, seed):
    """Halving the distance between samples halves the largest change: no jump at any face."""
    ends = random_points(2, seed)

    def largest(count: int) -> float:
        line = ends[0] + np.linspace(0, 1, count)[:, None] * (ends[1] - ends[0])
        return longest_step(field.force_n(line, 0.3, name))

    # A jump would stay; 0.55 leaves room for the sampling of the steepest place.
    assert largest(40_001) <= 0.55 * largest(20_001) + 1e-12


@pytest.mark.parametrize("name", FIXTURES)
def test_force_has_no_step_in_time_where_the_cycle_closes_either(field, name):
    for point in random_points(4, seed=3):

        def largest(count: int, point: Float = point) -> float:
            moments = np.linspace(-0.5, 1.5, count)
            return longest_step(field.force_n(np.tile(point, (count, 1)), moments, name))

        assert largest(20_001) <= 0.55 * largest(10_001) + 1e-12


def test_force_passes_through_zero_at_the_middle(field):
    """The medial axis of a ball is its middle: the direction turns round there."""
    line = np.linspace(-4, 4, 2001)[:, None] * np.array([1.0, 0.3, 0.1])
    force = field.force_n(line, 0.05)
    middle = field.force_n([[0.0, 0, 0]], 0.05)[0]

    assert np.linalg.norm(force[0]) > 1.9
    assert force[0, 0] * force[-1, 0] < 0
    # The nodes about the middle are not placed evenly about it, so it is near zero, not zero.
    assert np.linalg.norm(middle) < 0.7
    assert np.linalg.norm(force, axis=1).min() < 0.2
    # Stated rate: the direction is twice the gradient, and the cubic through the values h, 0, h, 2h
    # about a kink turns its slope by at most 4 / h.
    assert longest_step(force) / np.linalg.norm(line[1] - line[0]) < 2.0 * 2 * 4 / 3


@given(st.tuples(*[st.floats(-200, 200)] * 3), phases)
def test_outside_the_grid_the_nearest_boundary_point_answers(field, point, phase):
    grid = field.grid
    moved = np.clip(point, grid.origin_mm, grid.upper_mm)

    np.testing.assert_array_equal(field.force_n([point], phase), field.force_n([moved], phase))
    assert field.contains([moved])[0]
    assert field.contains([point])[0] == np.array_equal(point, moved)


@given(points, phases, st.integers(-3, 3))
def test_only_the_fraction_of_a_phase_counts(field, point, phase, beats):
    whole = field.distance_mm([point], phase)

    # Adding whole beats rounds the phase by 4e-16; the surface moves under 100 mm a beat.
    np.testing.assert_allclose(field.distance_mm([point], phase + beats), whole, atol=1e-12)


def test_a_phase_each_is_the_same_as_one_at_a_time(field):
    asked, moments = random_points(60), np.random.default_rng(1).uniform(-1, 2, 60)

    together = field.force_n(asked, moments)

    alone = [field.force_n([p], t)[0] for p, t in zip(asked, moments, strict=True)]
    np.testing.assert_array_equal(together, alone)


def test_no_points_no_answers(field):
    assert field.force_n(np.empty((0, 3)), 0.1).shape == (0, 3)
    assert field.distance_mm(np.empty((0, 3)), 0.1).shape == (0,)


@pytest.mark.parametrize("tiny", [-1e-18, -1e-300, 1 - 1e-17, 0.05 - 1e-18])
def test_phases_beside_the_seam_are_places_in_the_cycle(field, tiny):
    assert np.isfinite(field.force_n([[1.0, 2, 3]], tiny)).all()


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda f: f.force_n([1, 2, 3], 0), r"must be \(n, 3\)"),
        (lambda f: f.force_n([[1, 2]], 0), r"must be \(n, 3\)"),
        (lambda f: f.force_n([[1, 2, 3], [1, np.nan, 3]], 0), "point 1 is not finite"),
        (lambda f: f.force_n([[1, 2, 3]], np.inf), "phase must be finite"),
        (lambda f: f.force_n([[1, 2, 3]], [0.1, 0.2]), "phase must be one number"),
        (lambda f: f.force_n([[1, "two", 3]], 0), "points must be numbers"),
        (lambda f: f.force_n([[1, 2, 3], [1, 2]], 0), "points must be numbers"),
        (lambda f: f.force_at("left", 2, 3, 0), "is not four numbers"),
        (lambda f: f.force_at(1, 2, 3, 0, ""), "no fixture ''"),
        (lambda f: f.distance_at(1, 2, 3, 0, ""), "no structure ''"),
        (lambda f: f.force_n([[1, 2, 3]], 0, "gide"), "no fixture 'gide'; there are guide, stay"),
        (lambda f: f.force_n([[1, 2, 3]], 0, ["guide"]), "no fixture"),
        (lambda f: f.distance_mm([[1, 2, 3]], 0, ["ball"]), "no structure"),
        (lambda f: f.force_n([[10**400, 2, 3]], 0), "points must be numbers"),
        (lambda f: f.distance_mm([[1, 2, 3]], 0, "bal"), "no structure 'bal'; there are ball, c"),
    ],
)
def test_wrong_questions_are_refused(field, ask, words):
    with pytest.raises(InputError, match=words):
        ask(field)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_damaged_field_is_named_not_the_question(path, tmp_path, capsys, value):
    """One coefficient of the ball is no number, in a file of the right size."""
    folder = shutil.copytree(path, tmp_path / "f.zarr")
    field, phase = ForceField.open(folder), PHASES[1]
    chunk = np.memmap(folder / "spline/ball/c/1/0/0/0", "<f4", "r+", shape=field.grid.shape)
    chunk[9, 12, 10] = value
    point = (field.grid.origin_mm + 3.0 * np.array([10, 12, 9])).tolist()
    for ask in (field.force_n, field.potential, field.distance_mm, field.gradient):
        with pytest.raises(InputError, match=r"f\.zarr: is damaged.*`beatfield verify .*f\.zarr`"):
            ask([(0, 0, 30), point], phase)
    for one in (field.force_at, field.distance_at):
        with pytest.raises(InputError, match=r"f\.zarr: is damaged"):
            one(*point, phase)
        with pytest.raises(InputError, match=r"nan.* mm at phase .* is not finite"):
            one(np.nan, *point[1:], phase)
    # Far from the damage, and where another surface acts, it answers as ever.
    assert field.force_at(0, 0, 30, phase)[2] < 0
    assert np.isfinite(field.force_at(*point, phase, "stay_out")).all()
    where = ["--point", *map(str, point), "--phase", str(phase)]
    assert main(["query", str(folder), *where]) == 2
    assert "is damaged" in capsys.readouterr().err


def test_a_field_in_memory_is_what_it_was_whatever_becomes_of_its_files(path, tmp_path, field):
    folder = shutil.copytree(path, tmp_path / "f.zarr")
    kept, mapped = ForceField.open(folder, in_memory=True), ForceField.open(folder)
    points = np.array([(14.0, 2.0, 1.0), (3.0, -9.0, 20.0)])
    expected = field.force_n(points, PHASES[1])
    for chunk in folder.glob("spline/*/c/*/0/0/0"):
        np.memmap(chunk, "<f4", "r+")[:] = 0
    assert (mapped.force_n(points, PHASES[1]) != expected).any()
    assert (kept.force_n(points, PHASES[1]) == expected).all()
    assert kept.force_at(*points[0], PHASES[1]) == field.force_at(*points[0], PHASES[1])


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_field_that_is_copied_into_memory_has_no_hole(path, tmp_path, wrong):
    """As `bf_lock` of the C header finds it; mapped, it is found by the question that meets it."""
    folder = shutil.copytree(path, tmp_path / "f.zarr")
    chunk = sorted(folder.glob("spline/*/c/*/0/0/0"))[-1]
    np.memmap(chunk, "<f4", "r+")[-1] = wrong
    ForceField.open(folder)
    with pytest.raises(InputError, match=r"f\.zarr: is damaged: a value in it is not finite"):
        ForceField.open(folder, in_memory=True)


def test_numbers_of_any_type_are_answered_without_compiling_anew(field):
    """A compilation takes seconds, in which a hand would be held by a force of long ago."""
    expected = field.force_at(14.0, 2.0, 1.0, 0.0), field.distance_at(14.0, 2.0, 1.0, 0.0)
    compiled = len(kernels.force_at.signatures), len(kernels.distance_at.signatures)
    for kind in (int, np.float32, np.int16, np.array):
        where = [kind(one) for one in (14, 2, 1, 0)]
        assert (field.force_at(*where), field.distance_at(*where)) == expected
    assert (len(kernels.force_at.signatures), len(kernels.distance_at.signatures)) == compiled


def test_query_answers_for_every_fixture(path, field):
    answers = query_point(path, (14.0, 2, 1), 0.3)

    assert list(answers) == list(FIXTURES)
    for name, answer in answers.items():
        assert answer["force_n"] == field.force_n([[14, 2, 1]], 0.3, name)[0].tolist()
        assert answer["inside_grid"]
    assert list(query_point(path, (14.0, 2, 1), 0.3, "guide")) == ["guide"]
    with pytest.raises(InputError, match="no fixture 'x'"):
        query_point(path, (0.0, 0, 0), 0.3, "x")


def test_query_says_what_the_device_has_to_follow(path, field):
    """The force rate of a tool at rest: the change over the millisecond about the moment."""
    point, phase = (16.0, 2.0, 1.0), 0.3
    answer = query_point(path, point, phase)["guide"]
    moments = phase + np.array([-0.5, 0.5]) * 1e-3 / RR_S

    before, after = field.force_n([point, point], moments, "guide")

    assert answer["force_rate_n_per_ms"] == pytest.approx(np.linalg.norm(after - before))
    # The ball shrinks from 18 to 15 mm in a quarter of 0.8 s: 15 mm/s or so, at most 3 times that
    # in the spline, on a slope of 386 N/m at most.
    assert 0 < answer["force_rate_n_per_ms"] <= 3 * 0.015 * 0.386
    assert answer["stiffness_n_per_m"] == FIXTURES["guide"].stiffness_n_per_m
    assert answer["stiffness_limit_n_per_m"] == 400
    certified = field.accuracy["fixtures"]["guide"]["stiffness_measured_n_per_m"]
    assert answer["stiffness_measured_n_per_m"] == certified
    assert stiffness_words(answer) == (
        f"stiffness 386 N/m by its law, at most {certified:.0f} along the force as measured; "
        "the device renders 400"
    )
    alone = {"stiffness_n_per_m": 386.0, "stiffness_measured_n_per_m": None}
    said = stiffness_words({**alone, "stiffness_limit_n_per_m": None})
    assert said == "stiffness 386 N/m by its law"
    soft = {"stiffness_n_per_m": 321.4, "stiffness_measured_n_per_m": 400.2}
    said = stiffness_words({**soft, "stiffness_limit_n_per_m": 400.0})
    assert said.endswith("the device renders 400, less than measured")


def test_a_store_with_a_fixture_that_its_device_cannot_render_is_refused(path, tmp_path):
    folder = tmp_path / "f.zarr"
    shutil.copytree(path, folder)
    edit(folder, lambda told: told["fixtures"]["guide"].update(delta_mm=0.5))

    with pytest.raises(InputError, match=r"fixture guide: .*stiffer than the touch.* 400 N/m"):
        query_point(folder, (14.0, 2, 1), 0.3)


def test_reading_loads_no_heavy_library(path):
    """Opening needs NumPy only. A question loads numba, which loads SciPy's linear algebra."""
    code = (
        "import sys\n"
        "from pipeline.field import ForceField\n"
        "field = ForceField.open(sys.argv[1])\n"
        "assert not {'numba', 'scipy'} & set(sys.modules)\n"
        "field.force_n([[1, 2, 3]], 0.5)\n"
        "heavy = {'zarr', 'SimpleITK', 'vtk', 'vtkmodules', 'pyvista', 'skimage'}\n"
        "sys.exit(f'loaded {heavy & set(sys.modules)}' if heavy & set(sys.modules) else 0)"
    )
    subprocess.run([sys.executable, "-c", code, path], check=True)
