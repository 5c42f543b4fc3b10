"""How near the field's zero is to the moving surface, and how the force changes with place."""

import json
import math

import numpy as np
import pytest
import pyvista
from field_baked import FIXTURES, RR_S, SETTINGS, bake_small
from field_shapes import beating, box, lumpy, sphere
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from data_synth.population import draw_heart
from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.exact import points_about
from pipeline.field import BakeSettings, Fixture, ForceField, surface_fit
from pipeline.field.bake import SurfaceSeries, bake_field
from pipeline.field.certificate import BAND_MM
from pipeline.field.distance import distance_of_closed
from pipeline.field.motion import Motion, halfway
from pipeline.field.spline import space_coefficients
from pipeline.field.surface_fit import _asked, fit_to_surface
from pipeline.field.surface_points import Sheet, Spread
from pipeline.field.verify import verify_field
from pipeline.geometry import Grid, MovingSurface, Surface
from pipeline.own_surfaces import bake_own_surfaces, measure_field

BOX_FIXTURE = {"hold": Fixture(structure="box", kind="guidance", delta_mm=8.0, f_max_n=2.0)}


def test_stiffness_off_the_medial_axis_is_the_laws_and_the_rate_on_it_is_within_its_bound(tmp_path):
    """Truth: the law's slope, by its formula."""
    said = bake_small(tmp_path / "f.zarr")["fixtures"]
    field = ForceField.open(tmp_path / "f.zarr")
    rng = np.random.default_rng(3)
    for name, one in said.items():
        law = FIXTURES[name]
        # The size of the force changes by f_max f'(q) times the gradient's length. A quadratic
        # spline through the tip of a cone, as the distance is in the middle of a ball, is steepest
        # beside a tip on a node: 1.473 (SciPy's spline_filter of order 2 of |x| on 17^3 nodes).
        ratio = one["stiffness_measured_n_per_m"] / law.stiffness_n_per_m
        assert 0.9 < ratio < 1.48
        # Within a step of 0.1 mm the gradient may grow by half of it times 4 / spacing.
        longest = one["gradient_longest"] + 0.05 * 4 / SETTINGS.spacing_mm
        assert one["stiffness_measured_n_per_m"] <= longest * law.stiffness_n_per_m
        # Steps of 1 um about the middle of the balls, which is their medial axis.
        here = rng.uniform(-4, 4, (20_000, 3))
        way = rng.normal(size=here.shape)
        way *= 1e-3 / np.linalg.norm(way, axis=1, keepdims=True)
        moments = rng.uniform(size=len(here))
        change = field.force_n(here + way, moments, name) - field.force_n(here, moments, name)
        rate = np.linalg.norm(change, axis=1).max() / 1e-3
        assert max(rate, one["force_rate_max_n_per_mm"]) <= one["force_rate_bound_n_per_mm"]
        if name == "guide":
            assert rate > 5 * law.stiffness_n_per_m / 1000


def test_on_the_medial_sheets_of_a_box_the_force_keeps_to_its_rate(tmp_path):
    """Sheets along the axes and at 45 degrees to them, and their corners."""
    moving = {"box": SurfaceSeries((box((-19, -17, -15), (18, 17, 16)),), np.array([0.0]))}
    settings = BakeSettings(spacing_mm=2.5, samples=200)
    said = bake_field(tmp_path / "f.zarr", moving, BOX_FIXTURE, settings)["fixtures"]["hold"]
    field = ForceField.open(tmp_path / "f.zarr")
    rng = np.random.default_rng(4)
    bound = said["force_rate_bound_n_per_mm"]
    here = rng.uniform(-16, 16, (200_000, 3))
    way = rng.normal(size=here.shape)
    way *= 1e-3 / np.linalg.norm(way, axis=1, keepdims=True)
    change = np.linalg.norm(field.force_n(here + way, 0) - field.force_n(here, 0), axis=1)
    assert bound / 8 < change.max() / 1e-3 <= bound

    # What holds at other places than the certificate's, in steps of 1 um.
    asked = points_about(moving["box"].at(0), rng, 20_000, 2 * 8.0 + BAND_MM)
    ways = [field.force_n(asked + 1e-3 * way, 0) - field.force_n(asked, 0) for way in np.eye(3)]
    stiffness = -np.stack(ways, axis=2) / 1e-6
    holding = np.linalg.eigvalsh((stiffness + stiffness.transpose(0, 2, 1)) / 2)[:, -1]
    beyond = (holding > 400).mean()
    # Shares of 4,000 places and of 20,000, each off by 3 standard deviations at most.
    allowed = 3 * math.sqrt(beyond * (1 / 4000 + 1 / 20_000))
    assert 0 < said["beyond_limit_share"] == pytest.approx(beyond, abs=allowed)
    p99 = said["stiffness_any_direction_p99_n_per_m"]
    assert (holding > p99).mean() == pytest.approx(0.01, abs=3 * math.sqrt(0.01 * 3e-4))
    assert 400 < said["stiffness_any_direction_max_n_per_m"] <= 1000 * bound


def test_the_fit_brings_the_zero_to_the_surface(tmp_path):
    """Truth: points of the surface that the fit was not given, at distance 0; far from the
    surface nothing changes. The tips of the spheroid are curved by 8^2 / 20 = 3.2 mm."""
    ball = sphere(1.0, 4)
    surface = Surface(ball.vertices_mm * (20.0, 8.0, 8.0), ball.triangles)
    moving = {"spheroid": SurfaceSeries((surface,), np.array([0.0]))}
    fixtures = {"g": Fixture(structure="spheroid", kind="guidance", delta_mm=8.0, f_max_n=2.0)}
    fields = []
    for rounds in (0, 12):
        settings = BakeSettings(spacing_mm=4.0, samples=200, fit_rounds=rounds)
        bake_field(tmp_path / f"{rounds}.zarr", moving, fixtures, settings)
        verify_field(tmp_path / f"{rounds}.zarr")
        fields.append(ForceField.open(tmp_path / f"{rounds}.zarr"))
    asked = points_about(surface, np.random.default_rng(5), 4000, 0.0)
    plain, fitted = (np.abs(field.distance_mm(asked, 0)) for field in fields)
    assert fitted.max() < 0.7 * plain.max()
    assert np.percentile(fitted, 99) < 0.7 * np.percentile(plain, 99)

    nodes_mm = fields[0].grid.nodes_mm().reshape(-1, 3)
    moved = np.abs(fields[1].distance_mm(nodes_mm, 0) - fields[0].distance_mm(nodes_mm, 0))
    away = np.abs(fields[0].stored_distance_mm("spheroid", 0)).reshape(-1)
    # A point's nodes are 1.5 steps away along each axis at most, and reach as far again.
    assert moved[away > 4.0 * 3 * math.sqrt(3)].max() == 0
    stated = json.loads((tmp_path / "12.zarr" / "zarr.json").read_text())
    stated_mm = stated["attributes"]["beatfield"]["structures"]["spheroid"]["correction_mm"]
    assert 0 < moved.max() <= stated_mm


def test_nodes_that_are_held_keep_the_distance_about_a_rim(tmp_path, monkeypatch):
    """Truth: VTK's distance, about discs that are half a step thick at their middle and turned in
    five ways: how nodes happen to lie about a rim counts as much as whether they are held."""
    ball, held = sphere(1.0, 4), surface_fit._held
    fixtures = {"g": Fixture(structure="disc", kind="guidance", delta_mm=8.0, f_max_n=2.0)}
    settings, about_mm, on_mm = BakeSettings(spacing_mm=4.0, samples=2000), np.zeros(2), np.zeros(2)
    for turn in ([0.4, 0.4], [0.2, 0.7], [0.8, 0.1], [1.1, 0.4], [0.6, 0.9]):
        turned = Rotation.from_euler("xz", turn).apply(ball.vertices_mm * (20.0, 8.0, 1.2))
        moving = {"disc": SurfaceSeries((Surface(turned, ball.triangles),), np.array([0.0]))}
        for which, hold in enumerate((held, lambda *_: [])):
            monkeypatch.setattr(surface_fit, "_held", hold)
            path = tmp_path / f"{which}-{turn}.zarr"
            said = bake_field(path, moving, fixtures, settings)
            about_mm[which] += said["distance_error_p99_mm"]
            on_mm[which] += said["surface_error_p99_mm"]
    assert about_mm[0] < 0.98 * about_mm[1]
    # What the zero gives for it, of a rim that the grid cannot show.
    assert on_mm[0] < 1.15 * on_mm[1]


@pytest.mark.parametrize("fine", [3, 6])
def test_a_mesh_that_is_fine_in_one_place_is_fitted_in_others(tmp_path, fine):
    """Truth: points anywhere on a box of 12 triangles beside a ball of 80,000 or 1,280."""
    shape, ball = box((-19, -17, -15), (18, 17, 16)), sphere(6.0, fine, (40.0, 0, 0))
    turned = Rotation.from_euler("xyz", [0.5, 0.3, 0.2]).apply(shape.vertices_mm)
    both = Surface(
        np.vstack([turned, ball.vertices_mm]), np.vstack([shape.triangles, ball.triangles + 8])
    )
    moving = {"box": SurfaceSeries((both,), np.array([0.0]))}
    settings = BakeSettings(spacing_mm=2.5, samples=100, bounds={})
    bake_field(tmp_path / "f.zarr", moving, BOX_FIXTURE, settings)
    asked = points_about(Surface(turned, shape.triangles), np.random.default_rng(5), 50_000, 0.0)
    off_mm = np.abs(ForceField.open(tmp_path / "f.zarr").distance_mm(asked, 0))
    # It is 0.38 without a fit.
    assert np.percentile(off_mm, 99) < 0.15


def test_places_between_points_are_looked_at(tmp_path, monkeypatch):
    """Truth: points anywhere on a box, whose edges are as sharp between points as at them. At
    the corners themselves the grid has too few nodes for any choice of points."""
    shape = box((-19, -17, -15), (18, 17, 16))
    turned = Rotation.from_euler("xyz", [0.5, 0.3, 0.2]).apply(shape.vertices_mm)
    moving = {"box": SurfaceSeries((Surface(turned, shape.triangles),), np.array([0.0]))}
    asked = points_about(moving["box"].at(0), np.random.default_rng(5), 100_000, 0.0)
    settings, off_mm = BakeSettings(spacing_mm=2.5, samples=100, bounds={}), []
    for looks in (surface_fit.LOOK_BEFORE, ()):
        monkeypatch.setattr(surface_fit, "LOOK_BEFORE", looks)
        bake_field(tmp_path / f"{len(looks)}.zarr", moving, BOX_FIXTURE, settings)
        field = ForceField.open(tmp_path / f"{len(looks)}.zarr")
        off_mm.append(np.percentile(np.abs(field.distance_mm(asked, 0)), [99, 99.9]))
    assert (off_mm[0] < 0.6 * off_mm[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "pathology"), [(11, "enlarged_atrium"), (60, "infarct")])
def test_between_phases_the_surface_is_the_true_one_of_the_phantom(tmp_path, seed, pathology):
    """Truth: the phantom's surface at moments between 25 phases, which nothing was given: its
    vertices, and places anywhere on its triangles. The atrium has rims about its veins and
    appendage, where its triangles meet at up to 59 degrees."""
    structure = "left_atrium"
    heart = draw_heart(np.random.default_rng(seed), pathology=pathology, heart_rate_bpm=70.0)
    phases = np.arange(25) / 25
    each = [heart.surfaces(float(phase), [structure])[structure] for phase in phases]
    moving = MovingSurface(np.stack([one[0] for one in each]), each[0][1], phases)
    fixture = Fixture(structure=structure, kind="guidance", delta_mm=8.0, f_max_n=1.0)
    settings = BakeSettings(samples=100)
    said = bake_field(tmp_path / "f.zarr", {structure: moving}, {"g": fixture}, settings)
    field = ForceField.open(tmp_path / "f.zarr")
    stated = json.loads((tmp_path / "f.zarr" / "zarr.json").read_text())
    stated_mm = stated["attributes"]["beatfield"]["structures"][structure]["correction_mm"]
    assert 0 < stated_mm <= settings.spacing_mm
    off, rng = [], np.random.default_rng(seed)
    for moment in np.concatenate([(phases + 0.02)[::5], (phases + 0.011)[2::5]]):
        vertices_mm, triangles = heart.surfaces(float(moment), [structure])[structure]
        anywhere = points_about(Surface(vertices_mm, triangles), rng, 100_000, 0.0)
        asked = np.concatenate([vertices_mm, anywhere])
        off.append(np.abs(field.distance_mm(asked, moment)))
    off_mm = np.concatenate(off)
    # What is asked of the field.
    assert off_mm.max() < 0.1
    assert np.percentile(off_mm, 99) < 0.06
    assert said["drift_max_mm"] == pytest.approx(off_mm.max(), rel=0.5)


@pytest.mark.parametrize("count", [4, 6, 9, 10, 15])
def test_how_unsure_the_motion_is_is_what_it_misses_of_the_phantom(count):
    """Truth: the phantom's vertices halfway, along its normals. What one left out is missed by is
    over the step doubled, so it tells the order alone; of so few phases as 5 or 7 it may be a third
    or five times, as they happen to fall."""
    heart = draw_heart(np.random.default_rng(12), heart_rate_bpm=70.0)
    phases = np.arange(count) / count
    each = [heart.surfaces(phase, ["epicardium"])["epicardium"] for phase in phases.tolist()]
    motion = Motion.of(MovingSurface(np.stack([one[0] for one in each]), each[0][1], phases))
    missed = []
    for phase in (phases + 0.5 / count).tolist():
        vertices_mm, triangles = heart.surfaces(phase, ["epicardium"])["epicardium"]
        normals = pyvista.PolyData.from_regular_faces(vertices_mm, triangles).point_normals
        off_mm = motion.at(phase).vertices_mm - vertices_mm
        missed.append((off_mm * normals).sum(axis=1))
    unsure_mm = motion.unsure_mm()
    ratio = np.sqrt(np.square(missed).mean() / np.square(unsure_mm).mean())
    assert 0.4 < ratio < 2.5
    # And which parts of the beat are the least sure, where there are more than a few.
    assert (
        count < 10 or np.corrcoef(np.abs(missed).mean(axis=1), unsure_mm.mean(axis=1))[0, 1] > 0.3
    )


@pytest.mark.parametrize("phases", [np.arange(9) / 9, np.array([0.0, 0.1, 0.2, 0.45, 0.6])])
def test_the_motion_is_sure_of_what_rests_and_of_what_moves_along_the_surface(phases):
    """A ball that swings along x is unsure by the part of its way that is across the surface."""
    ball = sphere(20.0, 3)
    ways_mm = np.outer(4 * np.sin(2 * np.pi * phases), [1.0, 0, 0])[:, None]
    rest, swing = (
        Motion.of(MovingSurface(ball.vertices_mm + ways, ball.triangles, phases)).unsure_mm()
        for ways in (0 * ways_mm, ways_mm)
    )
    assert rest.max() < 1e-12
    # A sine is no spline.
    most_mm = swing.max(axis=1, keepdims=True)
    assert most_mm.min() > 1e-5
    # The mesh's normals are those of the ball to a fiftieth.
    across = np.abs(ball.vertices_mm[:, 0]) / 20
    assert np.abs(swing / most_mm - across).max() < 0.02


@pytest.mark.parametrize("count", [9, pytest.param(16, marks=pytest.mark.slow)])
def test_a_guess_between_few_phases_bends_the_distance_about_the_surface_less(
    tmp_path, monkeypatch, count
):
    """Truth: VTK's distance at the stored phases. A motion faster than nine phases can show; of
    more the field follows the vertices' spline."""
    ball = sphere(1.0, 4)
    phases = np.arange(count) / count
    long_mm = 20 + 3 * np.cos(2 * np.pi * phases) + 2 * np.cos(8 * np.pi * phases)
    radii_mm = np.stack([long_mm, np.full(count, 18.0), np.full(count, 16.0)], axis=1)
    moving = {"ball": MovingSurface(ball.vertices_mm * radii_mm[:, None], ball.triangles, phases)}
    fixtures = {"g": Fixture(structure="ball", kind="guidance", delta_mm=8.0, f_max_n=2.0)}
    settings = BakeSettings(spacing_mm=2.5, samples=200, bounds={})
    weighed = bake_field(tmp_path / "weighed.zarr", moving, fixtures, settings)
    monkeypatch.setattr(Motion, "unsure_mm", lambda self: np.zeros(self.places_mm.shape[:2]))
    alike = bake_field(tmp_path / "alike.zarr", moving, fixtures, settings)
    for name in ("gradient_error_p99", "distance_error_p99_mm"):
        if count == 9:
            assert weighed[name] < 0.7 * alike[name]
        else:
            assert weighed[name] == alike[name]
    assert weighed["motion_unsure_p99_mm"] > (0.5 if count == 9 else 0.01)


@pytest.mark.parametrize(("count", "share"), [(7, 1.0), (8, 0.2)])
def test_eight_phases_follow_a_beat_by_the_fifth_degree_and_seven_by_the_third(count, share):
    """Truth: a cosine, and what SciPy's cubic spline misses it by."""
    phases = np.arange(count) / count
    places_mm = np.zeros((count, 3, 3))
    places_mm[:, 0, 0] = np.cos(2 * np.pi * phases)
    motion = Motion.of(MovingSurface(places_mm, np.array([[0, 1, 2]]), phases))
    asked = np.linspace(0, 1, 101)
    true_mm = np.cos(2 * np.pi * asked)
    cubic = CubicSpline(np.append(phases, 1), np.append(places_mm[:, 0, 0], 1), bc_type="periodic")
    found_mm = np.array([motion.at(phase).vertices_mm[0, 0] for phase in asked])
    off_mm, cubic_mm = np.abs(found_mm - true_mm).max(), np.abs(cubic(asked) - true_mm).max()
    if share == 1:
        assert off_mm == pytest.approx(cubic_mm)
    else:
        assert off_mm < share * cubic_mm


def test_halfway_is_between_neighbours_of_the_beat_but_in_no_gap():
    np.testing.assert_allclose(halfway(np.array([0.1, 0.4, 0.7])), [0.25, 0.55, 0.9])
    np.testing.assert_allclose(halfway(np.array([0.0, 0.1, 0.2, 0.3])), [0.05, 0.15, 0.25])


@pytest.mark.parametrize("end", [1.0, 0.9, 0.8, 0.7])
def test_where_no_phase_is_for_long_errors_of_the_phases_do_not_grow(end):
    """Independent errors of the places are multiplied by the root of the summed squared weights:
    by 20 where a spline is left alone for a third of the beat."""
    phases = np.arange(25) / 25 * end
    still = MovingSurface(np.ones((25, 3, 3)), np.array([[0, 1, 2]]), phases)
    motion = Motion.of(still)
    weights = np.array([motion.weights(phase) for phase in np.linspace(0, 1, 400, endpoint=False)])
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    assert np.linalg.norm(weights, axis=1).max() < 1.4
    known = np.array([motion.weights(phase) for phase in phases])
    np.testing.assert_allclose(known, np.eye(25), atol=1e-12)


@pytest.mark.parametrize(
    "phases",
    [0.7 * np.arange(15) / 15, np.append(0.05 * np.arange(9), 0.9)],
    ids=["early", "apart"],
)
def test_the_fit_spoils_nothing_beside_a_part_of_the_beat_that_no_phase_shows(tmp_path, phases):
    """Truth: a ball that beats as a cosine does."""
    ball = beating(sphere(1.0, 3), 24 + 4 * np.cos(2 * np.pi * phases), phases)
    law = Fixture(structure="ball", kind="guidance", gamma_mm=2.5, m=2, f_max_n=2.0)
    errors, gaps_mm = [], []
    start, step = float(phases[-1]), float(phases[0] + 1 - phases[-1])
    if step < 0.2:
        start, step = float(phases[-2]), float(phases[-1] - phases[-2])
    way = sphere(1.0, 1).vertices_mm
    for rounds in (0, 12):
        settings = BakeSettings(spacing_mm=2.0, samples=300, fit_rounds=rounds)
        path = tmp_path / f"{rounds}.zarr"
        said = bake_field(path, {"ball": ball}, {"f": law}, settings)
        errors.append(said["distance_error_p99_mm"])
        field, off_mm = ForceField.open(path), []
        for moment in start + step * np.linspace(0.1, 0.9, 9):
            radius_mm = 24 + 4 * np.cos(2 * np.pi * moment)
            off_mm.append(np.abs(field.distance_mm(radius_mm * way, moment)).max())
        gaps_mm.append(max(off_mm))
    # What the fit costs an even beat: gradients a few hundredths steeper, a few millimetres off.
    assert errors[1] < errors[0] + 0.1
    assert gaps_mm[1] < gaps_mm[0] + 0.1


@pytest.mark.parametrize("count", [1, 3, 7, 17])
def test_the_fit_is_the_same_by_any_number_of_threads(count):
    """Many points, so that threads which wrote to the same phase would get in each other's way."""
    phases = np.arange(count) / count
    ball = beating(lumpy(3, level=4), 1 - 0.2 * np.sin(np.pi * phases) ** 2, phases)
    grid = Grid((28, 28, 28), (-54.0,) * 3, (4.0,) * 3)
    stored = [space_coefficients(distance_of_closed(ball.at(k), grid)) for k in range(count)]
    fitted = {}
    for threads in (1, 2, 8):
        splines = [one.astype(np.float32) for one in stored]
        assert fit_to_surface(splines, phases, grid, ball, 3, threads) > 0.1
        fitted[threads] = np.stack(splines).tobytes()
    assert fitted[1] == fitted[2] == fitted[8]


@pytest.mark.parametrize("nodes", [20, 41, 300])
def test_no_point_asks_for_a_node_beyond_the_grids_end(nodes):
    """As it is rounded to single precision, and written: three nodes about the nearest one."""
    away = np.concatenate([[0.0], np.geomspace(1e-14, 1e-2, 200)])
    ends = np.concatenate([0.5 - away, 0.5 + away, nodes - 1.5 - away, nodes - 1.5 + away])
    points = np.full((len(ends), 3), nodes / 2)
    points[:, 1] = ends
    vertices = np.column_stack([points, np.zeros(len(ends))]).astype(np.float32)
    each = np.repeat(np.arange(len(ends))[:, None], 3, axis=1)
    spread = Spread(each, np.tile(np.float32([1, 0, 0]), (len(ends), 1)))
    held, _ = _asked(Sheet(0.0, vertices, spread, spread), spread, (nodes,) * 3, 1.0)
    middle = (held + np.float32(0.5)).astype(int)
    assert middle.min() == 1
    assert middle.max() == nodes - 2
    # What lies farther within than rounding may matter is left.
    assert len(held) >= np.count_nonzero((ends >= 0.5) & (ends < nodes - 1.502))


@pytest.mark.parametrize("off_mm", 10.0 ** np.array([-23.75, -22.5, -22]))
def test_nothing_is_fitted_where_next_to_nothing_is_off(off_mm):
    """So little that its square is nought in single precision."""
    grid, phases = Grid((20,) * 3, (0.0,) * 3, (1.0,) * 3), np.arange(8) / 8
    ball = SurfaceSeries((sphere(5.0, 2, (9.5, 9.5, 9.5)),) * 8, phases)
    splines = list(np.full((8, 20, 20, 20), off_mm, dtype=np.float32))
    assert fit_to_surface(splines, phases, grid, ball, 3) < 1e-20


def test_nothing_is_fitted_to_a_surface_beside_the_grid():
    grid, phases = Grid((20,) * 3, (0.0,) * 3, (1.0,) * 3), np.arange(8) / 8
    ball = SurfaceSeries((sphere(5.0, 2, (40.0, 9.5, 9.5)),) * 8, phases)
    splines = list(np.ones((8, 20, 20, 20), np.float32))
    assert fit_to_surface(splines, phases, grid, ball, 3) == 0
    assert (np.stack(splines) == 1).all()


def test_what_rests_beside_what_moves_is_measured_anew(tmp_path):
    """A field of a resting surface alone has the phases of those beside it."""
    folder = tmp_path / "own"
    folder.mkdir()
    resting = sphere(15, 2)
    shapes = {"ball": resting, **{f"box_{k:03d}": box((-9,) * 3, (9 + k,) * 3) for k in range(3)}}
    for name, shape in shapes.items():
        mesh = pyvista.PolyData.from_regular_faces(shape.vertices_mm, shape.triangles)
        mesh.save(folder / f"{name}.vtp")
    fixture = Fixture(structure="ball", kind="guidance", delta_mm=8.0, f_max_n=2.0)
    settings = Settings(bake=BakeSettings(spacing_mm=3.0, samples=100), fixtures={"hold": fixture})
    baked = bake_own_surfaces(folder, tmp_path / "out", settings)
    assert len(ForceField.open(baked).phases) == 3
    assert measure_field(baked, folder)["sign_errors"] == 0


def test_a_motion_that_carries_all_points_out_of_the_grid_meanwhile_is_baked(tmp_path):
    """Between phases that lie close together the vertices' own spline swings far out."""
    phases, ball = np.array([0.0, 0.001, 0.5]), sphere(1.0, 2)
    moving = {"ball": beating(ball, np.array([20.0, 16.0, 18.0]), phases)}
    said = bake_field(
        tmp_path / "field.zarr", moving, {"guide": FIXTURES["guide"]},
        SETTINGS.model_copy(update={"fit_rounds": 2}), rr_s=RR_S,
    )  # fmt: skip
    assert said["surface_error_p99_mm"] < 0.25 * SETTINGS.spacing_mm


def test_points_that_no_triangle_has_are_refused(tmp_path):
    """The field would be bent towards them."""
    ball = sphere(15.0, 2)
    stray = Surface(np.vstack([ball.vertices_mm, [30.0, 0, 0]]), ball.triangles)
    moving = {"ball": beating(stray, np.array([1.0, 0.9, 0.95]), np.array([0.0, 0.3, 0.6]))}
    with pytest.raises(InputError, match=r"ball.*1 vertices belong to no triangle.*number 162"):
        bake_field(tmp_path / "field.zarr", moving, {"guide": FIXTURES["guide"]}, SETTINGS)
