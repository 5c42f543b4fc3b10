"""Baking: the grid, the certificate, what is refused; and surfaces of one's own."""

import json
import math
import shutil

import numpy as np
import pytest
import pyvista
from field_baked import FIXTURES, PHASES, RADII_MM, RR_S, SETTINGS, bake_small, ball_and_core, edit
from field_shapes import beating, box, lumpy, sag, sphere

from pipeline.cli import main
from pipeline.config import Settings
from pipeline.errors import InputError, StageError
from pipeline.exact import ExactSurface, points_about
from pipeline.field import BakeSettings, Fixture, ForceField
from pipeline.field.bake import SurfaceSeries, bake_field, grid_around
from pipeline.field.certificate import _answered_errors, _largest, certify, require_bounds
from pipeline.field.fixture import Bounds
from pipeline.field.steps import largest_change, largest_steps
from pipeline.field.verify import verify_field
from pipeline.geometry import MovingSurface
from pipeline.own_surfaces import (
    _fixtures_for,
    bake_own_surfaces,
    measure_field,
    what_was_baked,
)
from pipeline.surface_folders import odd_sizes, read_own_surfaces

BOX_FIXTURE = {"hold": Fixture(structure="box", kind="guidance", delta_mm=8.0, f_max_n=2.0)}


def test_grid_holds_all_phases_with_the_margin():
    moving = ball_and_core()["ball"]

    grid = grid_around([moving], BakeSettings(spacing_mm=3.0, margin_mm=16))

    reach = RADII_MM.max() + 16
    low, high = np.array(grid.origin_mm), grid.upper_mm
    # An icosphere's corners do not all reach the radius along the axes.
    assert (low <= -reach + 0.5).all()
    assert (high >= reach - 0.5).all()
    assert (high - low < 2 * reach + 3).all()
    np.testing.assert_allclose(low, -high, atol=1e-9)


def test_certificate_is_what_an_independent_check_finds(tmp_path):
    """The whole field against VTK at other points than the certificate's own."""
    surface = lumpy(3)
    moving = {"lump": SurfaceSeries((surface,), np.array([0.0]))}
    fixture = Fixture(structure="lump", kind="guidance", delta_mm=8.0, f_max_n=2.0)
    settings = BakeSettings(spacing_mm=2.0, samples=4000)

    said = bake_field(tmp_path / "f.zarr", moving, {"hold": fixture}, settings)

    field = ForceField.open(tmp_path / "f.zarr")
    asked = points_about(surface, np.random.default_rng(99), 4000, 15.0)
    error = np.abs(field.distance_mm(asked, 0) - ExactSurface(surface).distance_mm(asked))
    assert said == field.accuracy
    assert said["sign_errors"] == 0
    # Stored as float32 of at most 40 mm.
    assert max(said["node_error_near_mm"], said["node_error_far_mm"]) <= 40 * 2.0**-23
    # Percentiles of 4000 draws: 1 % +- 0.16 % lie above; the density there lets that be 30 %.
    assert np.percentile(error, 99) == pytest.approx(said["distance_error_p99_mm"], rel=0.3)
    assert 0.3 < error.max() / said["distance_error_max_mm"] < 3
    nodes_mm = field.grid.nodes_mm().reshape(-1, 3)
    found = _answered_errors(field, "lump", 0, nodes_mm)
    nodes_mm = nodes_mm[np.abs(field.stored_distance_mm("lump", 0).ravel()) <= 2 * 2.0]
    exact_mm, answered_mm = (
        ExactSurface(surface).distance_mm(nodes_mm),
        field.distance_mm(nodes_mm, 0),
    )
    largest_mm = np.abs(answered_mm - exact_mm).max()
    assert found["answered"] == pytest.approx(largest_mm, abs=1e-5)
    assert largest_mm <= said["distance_error_max_mm"] + 1e-5
    beside_mm = np.abs(exact_mm[np.signbit(exact_mm) != np.signbit(answered_mm)])
    assert said["wrong_side_max_mm"] == pytest.approx(beside_mm.max(initial=0), abs=1e-5)
    # The interpolant of an exact field of slope 1 errs by less than half a voxel anywhere.
    assert said["distance_error_max_mm"] < 1.0
    on_mm = np.abs(field.distance_mm(points_about(surface, np.random.default_rng(98), 4000, 0), 0))
    assert np.percentile(on_mm, 99) == pytest.approx(said["surface_error_p99_mm"], rel=0.3)


def test_certificate_has_a_figure_for_each_part(tmp_path):
    said = bake_small(tmp_path / "f.zarr")

    assert set(said["structures"]) == {"ball", "core"}
    assert set(said["fixtures"]) == set(FIXTURES)
    for parts in (said["structures"], said["fixtures"]):
        for one in parts.values():
            by_phase = {name: values for name, values in one.items() if name.endswith("_by_phase")}
            assert {len(values) for values in by_phase.values()} == {len(PHASES)}
            for name, values in by_phase.items():
                over_all = one[name.removesuffix("_by_phase")]
                assert min(values) <= over_all
                assert "median" in name or over_all == max(values)
    largest = max(one["distance_error_max_mm"] for one in said["structures"].values())
    assert said["distance_error_max_mm"] == largest
    for figure in ("force_step_max_n", "force_step_max_n_per_0_1_mm", "stiffness_n_per_m"):
        assert said[figure] == max(one[figure] for one in said["fixtures"].values())
    for name, one in said["fixtures"].items():
        law = FIXTURES[name]
        assert one["stiffness_limit_n_per_m"] == 400
        assert one["stiffness_n_per_m"] == law.stiffness_n_per_m
        # Along the gradient the slope is the law's; across it the direction turns as well.
        assert 0.5 * law.stiffness_n_per_m < one["stiffness_measured_n_per_m"]


def test_directions_and_drift_of_a_ball_are_small(tmp_path):
    """Truth: on a ball every gradient points away from the middle; facets turn it by half the
    angle between them, 10 degrees for 3 levels of an icosphere."""
    phases = np.arange(12) / 12
    swing = beating(sphere(1.0, 3), 20 + 2 * np.cos(2 * np.pi * phases), phases)
    fixture = Fixture(structure="ball", kind="guidance", delta_mm=8.0, f_max_n=1.0)
    said = bake_field(tmp_path / "f.zarr", {"ball": swing}, {"hold": fixture}, SETTINGS, rr_s=0.8)
    assert 0 < said["direction_error_median_deg"] < 5
    # The error is at least as long as the turn makes it, a chord of the unit circle.
    chord = 2 * np.sin(np.radians(said["direction_error_median_deg"]) / 2)
    assert 0.9 * chord < said["gradient_error_median"] < 0.1
    # In time 2 mm * (2 pi / 12)^3 / 24; in space what the corners, the sharpest places of the
    # facets, are off by at the phases themselves.
    in_space = 2 * said["surface_error_max_mm"]
    assert said["drift_max_mm"] < 2 * (2 * np.pi / 12) ** 3 / 24 + in_space
    assert said["drift_max_mm"] > 0
    # And at the cosine's own places in the middle between phases.
    field, off_mm = ForceField.open(tmp_path / "f.zarr"), []
    for moment in phases + 0.5 / 12:
        ball = sphere(20 + 2 * np.cos(2 * np.pi * moment), 3)
        asked_mm = [ball.vertices_mm, ball.vertices_mm[ball.triangles].mean(axis=1)]
        off_mm.append(np.abs(field.distance_mm(np.concatenate(asked_mm), moment)))
    assert said["drift_p99_mm"] == pytest.approx(np.percentile(off_mm, 99), rel=0.02)


def test_the_step_near_the_surface_is_between_nodes_within_two_widths_of_the_law(tmp_path):
    """Truth: differences between neighbouring nodes by NumPy."""
    said = bake_small(tmp_path / "f.zarr")["fixtures"]
    field = ForceField.open(tmp_path / "f.zarr")
    nodes_mm = field.grid.nodes_mm().reshape(-1, 3)
    for name, law in FIXTURES.items():
        largest = 0.0
        for index, phase in enumerate(field.phases):
            force_n = field.force_n(nodes_mm, phase, name).reshape(*field.grid.shape, 3)
            stored = field.stored_distance_mm(law.structure, index)
            near = np.abs(stored) <= 2 * law.resolved_delta_mm
            for axis in range(3):
                step_n = np.linalg.norm(np.diff(force_n, axis=axis), axis=-1)
                pairs = np.lib.stride_tricks.sliding_window_view(near, 2, axis).all(axis=-1)
                spacing_mm = field.grid.spacing_mm[2 - axis]
                largest = max(largest, float(step_n[pairs].max()) / spacing_mm)
        assert said[name]["force_step_near_surface_n_per_mm"] == pytest.approx(largest, rel=1e-6)


def test_a_field_less_exact_than_its_bounds_is_not_published(tmp_path):
    bounds = Bounds(surface_error_p99_spacings=1e-6)
    with pytest.raises(StageError, match=r"surface_error_p99_mm is .* finer bake\.spacing_mm"):
        bake_field(
            tmp_path / "f.zarr",
            ball_and_core(),
            FIXTURES,
            SETTINGS.model_copy(update={"bounds": bounds}),
        )
    with pytest.raises(InputError, match="no complete field"):
        ForceField.open(tmp_path / "f.zarr")


def test_drift_is_unknown_where_vertices_do_not_correspond(tmp_path):
    moving = {
        "box": SurfaceSeries((box((-9, -8, -7), (9, 8, 7)), sphere(9, 2)), np.array([0, 0.5]))
    }
    said = bake_field(tmp_path / "f.zarr", moving, BOX_FIXTURE, SETTINGS)
    assert said["drift_max_mm"] is None
    assert said["motion_unsure_p99_mm"] is None


def test_force_change_is_bounded_by_stiffness_and_motion(tmp_path):
    """Truth: at a node the force changes by stiffness times motion, and its direction turns only
    where facets or the middle of the ball make it."""
    said = bake_small(tmp_path / "f.zarr")["fixtures"]["stay_in"]
    motion_mm = np.abs(np.diff(RADII_MM, append=RADII_MM[0]))
    gap_ms = np.diff(PHASES, append=PHASES[0] + 1) * RR_S * 1000
    stiffness = FIXTURES["stay_in"].stiffness_n_per_m / 1000

    # Turning of the facets' normals within the largest force: an edge over the radius.
    turning = 1.5 * 0.3
    assert said["force_change_max_n"] <= stiffness * motion_mm.max() + turning
    assert said["force_change_max_n_per_ms"] <= ((stiffness * motion_mm + turning) / gap_ms).max()
    # The fastest motion, 3 mm in a quarter beat, is felt where the potential is steepest.
    assert said["force_change_max_n"] >= 0.5 * stiffness * motion_mm.max()


def test_the_change_from_the_last_phase_to_the_first_counts(tmp_path):
    """Truth: the forces at all nodes. The ball grows from phase to phase and falls back at once."""
    ball = beating(sphere(1.0, 2), np.array([15.0, 17.0, 19.0]), np.arange(3) / 3)
    settings = SETTINGS.model_copy(update={"bounds": Bounds(surface_error_p99_spacings=1)})
    laws = {"g": FIXTURES["guide"]}
    said = bake_field(tmp_path / "f.zarr", {"ball": ball}, laws, settings, rr_s=RR_S)
    field = ForceField.open(tmp_path / "f.zarr")
    nodes_mm = field.grid.nodes_mm().reshape(-1, 3)
    forces_n = [field.force_n(nodes_mm, phase) for phase in field.phases]
    changes_n = [
        np.linalg.norm(after - before, axis=1).max()
        for before, after in zip(forces_n, forces_n[1:] + forces_n[:1], strict=True)
    ]
    assert changes_n[2] > 1.2 * max(changes_n[:2])
    assert said["force_change_max_n"] == pytest.approx(changes_n[2], rel=1e-6)
    # Fastest halfway back; of random places and moments some come near.
    late_n = field.force_n(nodes_mm, 5 / 6 + 0.001 / RR_S) - field.force_n(nodes_mm, 5 / 6)
    fastest_n = np.linalg.norm(late_n, axis=1).max()
    assert 0.8 * fastest_n < said["force_change_max_n_per_ms"] < 1.25 * fastest_n
    assert said["force_rate_max_n_per_mm"] == pytest.approx(
        10 * said["force_step_max_n_per_0_1_mm"]
    )


def test_what_is_unknown_of_one_part_is_unknown_of_all():
    known, unknown = (
        {"drift_max_mm": 0.1, "sign_errors": 2},
        {"drift_max_mm": None, "sign_errors": 3},
    )
    for parts in ((known, unknown), (unknown, known)):
        largest = _largest(dict(zip("ab", parts, strict=True)))
        assert largest == {"drift_max_mm": None, "sign_errors": 5}


def test_rates_are_unknown_without_a_heart_rate(tmp_path):
    said = bake_small(tmp_path / "f.zarr", rr_s=None)

    assert said["force_change_max_n_per_ms"] is None
    assert said["force_change_max_n"] > 0
    assert ForceField.open(tmp_path / "f.zarr").rr_s is None


def test_steps_between_nodes_are_plain_differences():
    """The compiled measures against NumPy on random values."""
    rng = np.random.default_rng(0)
    distance = rng.normal(scale=4, size=(6, 7, 8)).astype(np.float32)
    force, other = rng.normal(size=(2, 6, 7, 8, 3)).astype(np.float32)
    near = np.abs(distance) <= 3
    found = np.empty((2, 3))
    largest_steps(force, distance, 3.0, found)

    for axis in range(3):
        along = 2 - axis
        steps = np.linalg.norm(np.diff(force.astype(float), axis=along), axis=-1)
        low, high = np.delete(near, -1, along), np.delete(near, 0, along)
        assert found[0, axis] == pytest.approx(steps.max(), rel=1e-6)
        assert found[1, axis] == pytest.approx(steps[low & high].max(), rel=1e-6)
    changes = np.linalg.norm(force.astype(float) - other, axis=-1)
    assert largest_change(force, other) == pytest.approx(changes.max(), rel=1e-6)


def test_only_what_is_needed_is_baked(tmp_path):
    settings = SETTINGS.model_copy(update={"structures": ("core",)})
    fixtures = {"guide": FIXTURES["guide"]}
    seen = []

    bake_field(
        tmp_path / "f.zarr",
        ball_and_core(),
        fixtures,
        settings,
        progress=lambda done, total: seen.append((done, total)),
    )

    assert ForceField.open(tmp_path / "f.zarr").structures == ("ball", "core")
    assert seen == [(k + 1, 2 * len(PHASES)) for k in range(2 * len(PHASES))]
    assert sorted(one.name for one in (tmp_path / "f.zarr" / "potential").iterdir()) == [
        "guide",
        "zarr.json",
    ]


def test_triangles_may_differ_between_phases(tmp_path):
    """A coarse and a fine ball: between them lies the mean of both."""
    series = SurfaceSeries((sphere(20, 2), sphere(16, 4)), np.array([0.0, 0.5]))
    fixtures = {"g": Fixture(structure="ball", kind="guidance", delta_mm=8.0, f_max_n=2.0)}

    bake_field(tmp_path / "f.zarr", {"ball": series}, fixtures, SETTINGS)

    field = ForceField.open(tmp_path / "f.zarr")
    near = np.array([[18.0, 0, 0], [0, 0, -18.0]])
    # Voxels of 3 mm at radius 16: h^2 / 8 * 2 / 16, and the facets.
    bound = 9 / 8 * 2 / 16 + sag(sphere(20, 2), 20)
    np.testing.assert_allclose(field.distance_mm(near, 0.25), 0, atol=bound)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"fixtures": {"g": FIXTURES["guide"].model_copy(update={"structure": "heart"})}},
            "fixture g needs 'heart'; the surfaces that exist are ball, core, unused",
        ),
        ({"settings": BakeSettings(structures=("aorta",))}, "bake.structures aorta needs 'aorta'"),
        ({"fixtures": {}}, "no fixture"),
        ({"fixtures": {"../up": FIXTURES["guide"]}}, r"fixture name '\.\./up'"),
        ({"settings": BakeSettings(spacing_mm=0.1)}, r"would take \d+ MB .* spacing_mm = 0\.\d+ w"),
        ({"mr_from_tracker": np.diag([2.0, 1, 1, 1])}, "mr_from_tracker"),
    ],
)
def test_wrong_requests_are_refused_before_anything_is_written(tmp_path, change, words):
    given = {"surfaces": ball_and_core(), "fixtures": FIXTURES, "settings": SETTINGS, **change}
    with pytest.raises(InputError, match=words):
        bake_field(tmp_path / "f.zarr", **given)
    assert not (tmp_path / "f.zarr").exists()


def test_the_spacing_that_is_named_would_do():
    """The message for a field that is too large helps: one try is enough."""
    settings = BakeSettings(spacing_mm=1.0, largest_store_mb=20)
    with pytest.raises(InputError) as refusal:
        bake_field(None, ball_and_core(), FIXTURES, settings)
    spacing = float(str(refusal.value).split("; spacing_mm = ")[1].split()[0])

    coarser = settings.model_copy(update={"spacing_mm": spacing})
    grid = grid_around([ball_and_core()["ball"]], coarser)

    assert math.prod(grid.shape) * 4 * len(PHASES) * 5 <= 20e6


def test_a_size_beyond_all_numbers_is_refused():
    settings = BakeSettings(spacing_mm=1.0)
    far = {"ball": MovingSurface(ball_and_core()["ball"].vertices_mm * 1e6,
                                 ball_and_core()["ball"].triangles, PHASES)}  # fmt: skip
    with pytest.raises(InputError, match="more than largest_store_mb"):
        bake_field(None, far, {"stay_in": FIXTURES["stay_in"]}, settings)


def test_unusable_surfaces_are_refused_by_phase(tmp_path):
    surfaces = ball_and_core()
    core = surfaces["core"].vertices_mm.copy()
    core[3, 5] = np.nan
    surfaces["core"] = MovingSurface(core, surfaces["core"].triangles, PHASES)
    with pytest.raises(InputError, match="core, phase 3: 1 vertices are not finite"):
        bake_field(tmp_path / "f.zarr", surfaces, FIXTURES, SETTINGS)

    surfaces["core"] = beating(sphere(1, 1), RADII_MM[:3], PHASES[:3])
    with pytest.raises(InputError, match="core has 3 phases, ball 5"):
        bake_field(tmp_path / "f.zarr", surfaces, FIXTURES, SETTINGS)

    turned = {"ball": beating(sphere(1, 1), RADII_MM, PHASES[::-1])}
    with pytest.raises(InputError, match="must rise"):
        bake_field(tmp_path / "f.zarr", turned, {"guide": FIXTURES["guide"]}, SETTINGS)


@pytest.fixture
def folder(tmp_path):
    """Three phases of a box that grows, in three file formats, and a ball that rests."""
    folder = tmp_path / "own"
    (folder / "ball").mkdir(parents=True)
    for number, ending in enumerate(("vtp", "stl", "ply")):
        save(folder / f"box_{number:03d}.{ending}", box((-19, -18, -17), (19 + number, 18, 17)))
    save(folder / "ball" / "000.vtp", sphere(8, 2))
    return folder


def save(path, surface):
    pyvista.PolyData.from_regular_faces(surface.vertices_mm, surface.triangles).save(path)


def own_settings(fit_rounds: int = 12) -> Settings:
    bake = BakeSettings(spacing_mm=4.0, samples=100, fit_rounds=fit_rounds)
    return Settings(bake=bake, fixtures=BOX_FIXTURE)


def test_surfaces_of_ones_own(folder, tmp_path):
    settings = own_settings(fit_rounds=0)
    field = ForceField.open(bake_own_surfaces(folder, tmp_path / "out", settings))

    np.testing.assert_allclose(field.phases, [0, 1 / 3, 2 / 3])
    assert field.structures == ("box",)
    # Far from edges the distance of a flat wall is linear: nothing to interpolate wrongly. The
    # spline feels the kink in the middle of the box, n = 4 nodes of 4 mm away, where the slope
    # turns by 2, by less than 2 * 4 mm * (3 - sqrt 8)^n.
    for number in range(3):
        found = field.distance_mm([[20.0 + number, 0, 0]], number / 3)
        assert found[0] == pytest.approx(1.0, abs=8 * (3 - math.sqrt(8)) ** 4)
    assert "own_surfaces" not in field.source
    assert set(field.source["surfaces"]) == {
        "box_000.vtp",
        "box_001.stl",
        "box_002.ply",
        "ball/000.vtp",
    }
    verify_field(tmp_path / "out" / "field.zarr")
    assert {one.name for one in (tmp_path / "out").iterdir()} == {".lock", "field.zarr"}


def test_a_field_is_measured_anew_on_demand(folder, tmp_path, capsys):
    """The same figures as at baking; surfaces of another field are refused."""
    baked = bake_own_surfaces(folder, tmp_path / "out", own_settings())
    said, measured = ForceField.open(baked).accuracy, measure_field(baked, folder)

    # More samples than at baking, so larger errors may be found, of the same order.
    assert measured["sign_errors"] == 0
    assert said["surface_error_p99_mm"] / 2 < measured["surface_error_p99_mm"] < 1.0
    assert main(["verify", str(baked), "--surfaces", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "surface_error_p99_mm" in printed
    # Each fixture's own figures on its own line, and no largest over all of them.
    assert "\nforce_" not in printed
    for name, one in measured["fixtures"].items():
        law, most = one["stiffness_n_per_m"], one["stiffness_measured_n_per_m"]
        line = next(line for line in printed.splitlines() if line.startswith(name))
        assert f"{law:.0f} N/m by its law, at most {most:.0f} along the force as measured" in line
    for way_mm, size, words in (
        (0.0, 1.01, r"box, phase 0: 12 triangles around .* ml, not 12 around"),
        (1.0, 1.0, "up to 1.00 mm beside what"),
        # The grid ends some 16 mm beyond the box.
        (30.0, 1.0, "box, phase 0: reaches out of the field's grid"),
        (500.0, 1.0, "box, phase 0: reaches out of the field's grid"),
    ):
        other = shutil.copytree(folder, tmp_path / str(way_mm))
        box_mm = pyvista.read(other / "box_000.vtp").scale(size).translate((way_mm, 0, 0))
        box_mm.save(other / "box_000.vtp")
        with pytest.raises(InputError, match=words):
            measure_field(baked, other)
    other = shutil.copytree(folder, tmp_path / "finer")
    pyvista.read(other / "box_000.vtp").subdivide(1).save(other / "box_000.vtp")
    with pytest.raises(InputError, match=r"box, phase 0: 48 triangles around .* ml, not 12 around"):
        measure_field(baked, other)
    (folder / "box_002.ply").unlink()
    with pytest.raises(InputError, match="box has 2 files, for 3 phases"):
        measure_field(baked, folder)
    with pytest.raises(InputError, match="has no box"):
        measure_field(baked, folder / "ball")


@pytest.mark.parametrize("said", [None, "x", {"samples": 1}, {"samples": 200, "new": 1}])
def test_how_a_field_was_baked_may_be_said_otherwise(folder, tmp_path, said):
    """By another version, or by another program: it is measured by default bounds then."""
    baked = bake_own_surfaces(folder, tmp_path / "out", own_settings())
    edit(baked, lambda told: told["source"].update(bake=said))
    assert measure_field(baked, folder)["sign_errors"] == 0


def test_a_field_is_measured_anew_by_the_bounds_that_it_was_baked_to(folder, tmp_path):
    baked = bake_own_surfaces(folder, tmp_path / "out", own_settings(fit_rounds=0))
    tight = {"surface_error_p99_spacings": 1e-6}
    edit(baked, lambda told: told["source"]["bake"]["bounds"].update(tight))
    with pytest.raises(StageError, match=r"surface_error_p99_mm is .* allowed is 4e-06"):
        measure_field(baked, folder)


def test_what_was_baked_is_told_with_the_figures_of_its_certificate(folder, tmp_path):
    baked = bake_own_surfaces(folder, tmp_path / "out", own_settings(fit_rounds=0))
    said = ForceField.open(baked).accuracy
    on, about = (f"{said[f'{one}_error_p99_mm']:.2g} mm" for one in ("surface", "distance"))
    assert on != about
    told = what_was_baked(baked)
    assert told[1].startswith(
        f"accuracy  {on} off on the surfaces at most and {about} within 15 mm"
    )
    assert told[2].startswith(
        "fixture   hold: guidance of box, 2 N at most, next to nothing within"
    )
    doubts = ForceField.open(baked).source["doubts"]
    # An STL file has triangles of its own order.
    assert doubts == [
        "between phases: nobody knows where the walls are, for vertices do not correspond"
    ]
    assert told[3:] == [f"doubtful  {text}" for text in doubts]


def test_a_field_holds_what_is_doubtful_by_its_certificate(tmp_path):
    def doubts_of(accuracy):
        return (f"{accuracy['samples_per_phase']} places",)

    for name, given in (("told", doubts_of), ("untold", None)):
        bake_small(tmp_path / name, source={"shape": "box"}, doubts_of=given)
    told, untold = (ForceField.open(tmp_path / name).source for name in ("told", "untold"))
    assert told == untold | {"doubts": ["200 places"]}


def test_default_fixtures_stay_and_every_other_surface_is_guided_to():
    fixtures = _fixtures_for(["left_atrium", "mine"], Settings())
    assert {name: one.structure for name, one in fixtures.items()} == {
        "left_atrium_guidance": "left_atrium",
        "mine_guidance": "mine",
    }
    assert fixtures["left_atrium_guidance"].resolved_gamma_mm == 2.5
    both = _fixtures_for(["epicardium"], Settings())
    assert set(both) == {"epicardium_guidance", "left_ventricle_forbidden"}


def test_timing_and_tracker_of_ones_own(folder, tmp_path):
    timing = {"phases": [0.1, 0.2, 0.6], "rr_s": 0.9, "mr_from_tracker": np.eye(4).tolist()}
    (folder / "phases.json").write_text(json.dumps(timing))

    field = ForceField.open(bake_own_surfaces(folder, tmp_path / "out", own_settings()))

    np.testing.assert_array_equal(field.phases, [0.1, 0.2, 0.6])
    assert field.rr_s == 0.9
    np.testing.assert_array_equal(field.mr_from_tracker, np.eye(4))
    assert what_was_baked(tmp_path / "out" / "field.zarr")[0] == "phases    0.1, 0.2, 0.6"
    (folder / "phases.json").unlink()
    bare = bake_own_surfaces(folder, tmp_path / "bare", own_settings())
    assert what_was_baked(bare)[0] == (
        "phases    3, evenly spaced from 0; the length of the beat (rr_s) and a tracker "
        "(mr_from_tracker) not known: phases.json may tell"
    )


@pytest.mark.parametrize(
    ("scales", "said"),
    [
        ((1, 1), None),
        # Nobody's heart, but it may be of something else.
        ((0.1, 0.1), "box: measures 8 mm from end to end: if that is a heart's centimetres"),
        ((1, 0.1), "box: measures 8 mm from end to end in phase 1 and 80 mm in phase 0"),
    ],
)
def test_surfaces_that_may_be_in_centimetres_are_told(tmp_path, scales, said):
    folder = tmp_path / "own"
    folder.mkdir()
    for number, scale in enumerate(scales):
        corner = scale * np.array([40.0, 30.0, 20.0])
        save(folder / f"box_{number:03d}.ply", box(-corner, corner))
    doubts = odd_sizes(read_own_surfaces(folder).surfaces)
    assert len(doubts) == (said is not None)
    if said:
        assert doubts[0].startswith(said)
    if scales == (0.1, 0.1):
        field = bake_own_surfaces(folder, tmp_path / "out", own_settings(fit_rounds=0))
        assert f"doubtful  {doubts[0]}" in what_was_baked(field)


def test_a_single_file_is_a_surface_at_rest(tmp_path):
    (tmp_path / "own").mkdir()
    save(tmp_path / "own" / "box.ply", box((-9, -8, -7), (9, 8, 7)))

    field = ForceField.open(bake_own_surfaces(tmp_path / "own", tmp_path / "out", own_settings()))

    still = field.force_n(np.tile([[12.0, 1, 1]], (3, 1)), [0.0, 0.4, 0.9])
    # Weights in time sum to 1 but for rounding.
    assert np.ptp(still, axis=0).max() < 1e-15
    assert field.accuracy["force_change_max_n"] == 0


def open_box(folder):
    mesh = pyvista.read(folder / "box_000.vtp")
    mesh.remove_cells([0, 1]).save(folder / "box_000.vtp")


def inward_box(folder):
    one = box((-9, -8, -7), (9, 8, 7))
    mesh = pyvista.PolyData.from_regular_faces(one.vertices_mm, one.triangles[:, ::-1])
    mesh.save(folder / "box_001.stl")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (open_box, r"box_000\.vtp: is not closed, 4 edges"),
        (inward_box, r"box_001\.stl: faces inwards"),
        (lambda f: (f / "box_001.stl").unlink(), "box has 2 files, but none numbered 1"),
        (lambda f: (f / "box_002.ply").write_text("ply\nnothing"), r"box_002\.ply"),
        (lambda f: save(f / "box_000.stl", box((0, 0, 0), (1, 1, 1))), "same structure and phase"),
        (lambda f: save(f / "ball" / "001.vtp", sphere(5, 2)), "ball has 2 files, for 3 phases"),
        (lambda f: save(f / "ball" / "x.vtp", sphere(5, 2)), r"x\.vtp: in a structure's folder"),
        (lambda f: (f / "phases.json").write_text('{"phases": [0, 0.5]}'), "2 phases for 3"),
        (lambda f: (f / "phases.json").write_text('{"phase": []}'), "unknown key"),
        (lambda f: (f / "phases.json").write_text('{"rr_s": true}'), "rr_s: true is no number"),
        (lambda f: (f / "phases.json").write_text('{"phases": [0, 30, 60]}'), r"s\.json: .*rise"),
        (lambda f: (f / "phases.json").write_text('{"rr_s": 800}'), "rr_s: .* equal to 60"),
        (
            lambda f: save(f / "ball" / "000.vtp", sphere(0.03, 2)),
            r"000\.vtp: measures 0\.06 mm .*milli",
        ),
        (lambda f: (f / "phases.json").write_text("{"), r"phases\.json: cannot be read as JSON"),
        (
            lambda f: (f / "phases.json").write_text('{"rr_s": 0.8, "rr_s": 0.9}'),
            r"phases\.json: cannot be read as JSON \(rr_s is given a second time",
        ),
        (lambda f: shutil.rmtree(f), "no such folder"),
        (lambda f: (shutil.rmtree(f), f.mkdir()), r"holds no \.vtp"),
        (
            lambda f: [one.unlink() for one in f.glob("box*")],
            "fixture hold needs 'box'; the surfaces that exist are ball",
        ),
    ],
)
def test_unusable_folders_are_refused_and_nothing_is_left(folder, tmp_path, damage, words):
    damage(folder)
    with pytest.raises(InputError, match=words):
        bake_own_surfaces(folder, tmp_path / "out", own_settings())
    assert {one.name for one in (tmp_path / "out").glob("*")} <= {".lock"}


def test_in_a_beat_of_half_the_length_a_force_changes_twice_as_much_in_a_millisecond(tmp_path):
    slow, fast = (
        bake_small(tmp_path / f"{rr_s}.zarr", rr_s=rr_s)["force_change_max_n_per_ms"]
        for rr_s in (0.8, 0.4)
    )
    assert fast == pytest.approx(2 * slow, rel=0.05)


def test_nodes_on_the_wrong_side_are_counted_however_near_the_surface(tmp_path):
    bake_small(tmp_path / "f.zarr")
    field = ForceField.open(tmp_path / "f.zarr")
    chunk = tmp_path / "f.zarr" / "distance" / "ball" / "c" / "0" / "0" / "0" / "0"
    values = np.memmap(chunk, "<f4", "r+")
    values[np.abs(values) < 2] *= -1
    surfaces = {name: ball_and_core()[name] for name in field.structures}
    said = certify(field, surfaces, 2000, lambda: None)
    assert said["sign_errors"] > 0
    # Their distances were told with the other sign, so what is answered there is twice as far off.
    ball = said["structures"]["ball"]
    assert 1.8 < ball["wrong_side_max_mm"] < 2
    assert ball["wrong_side_max_mm_by_phase"][0] == ball["wrong_side_max_mm"]
    assert 3.6 < ball["distance_error_max_mm"] < 4.2
    assert said["structures"]["core"]["wrong_side_max_mm"] < 0.2


@pytest.mark.parametrize(
    "name", ["node_error_near_mm", "node_error_far_mm", "sign_errors", "surface_error_p99_mm"]
)
@pytest.mark.parametrize("beyond", [1.01, float("nan")])
def test_every_bound_holds_its_own_figure(name, beyond):
    """What the settings say, on a grid of 1.5 mm; a figure that is none keeps to nothing."""
    at = {
        "node_error_near_mm": 1e-3,
        "node_error_far_mm": 0.02,
        "sign_errors": 0,
        "surface_error_p99_mm": 0.25 * 1.5,
    }
    require_bounds({**at, "structures": {"ball": at, "core": at}}, Bounds(), 1.5)
    over = at | {name: beyond * (at[name] or 1)}
    with pytest.raises(StageError, match=rf"must be: {name} is [^;]*most at core[^;]*; choose"):
        require_bounds({**over, "structures": {"ball": at, "core": over}}, Bounds(), 1.5)


@pytest.mark.parametrize(
    ("least", "most", "near", "far"),
    [(3.0, 14.0, 0.05, 0.0), (16.0, 99.0, 0.0, 0.05)],
)
def test_an_error_of_one_phase_and_structure_is_the_certificates(tmp_path, least, most, near, far):
    bake_small(tmp_path / "f.zarr")
    field = ForceField.open(tmp_path / "f.zarr")
    chunk = tmp_path / "f.zarr" / "distance" / "ball" / "c" / "1" / "0" / "0" / "0"
    values = np.memmap(chunk, "<f4", "r+")
    values[(values > least) & (values < most)] += 0.05
    values.flush()
    surfaces = {name: ball_and_core()[name] for name in field.structures}
    said = certify(field, surfaces, 4000, lambda: None)
    for one in (said, said["structures"]["ball"]):
        assert one["node_error_near_mm"] == pytest.approx(near, abs=1e-4)
        assert one["node_error_far_mm"] == pytest.approx(far, abs=1e-4)
    assert said["structures"]["core"]["node_error_near_mm"] < 1e-4


def test_wrong_signs_of_all_structures_and_phases_are_added(tmp_path):
    bake_small(tmp_path / "f.zarr")
    field = ForceField.open(tmp_path / "f.zarr")
    for name, phase in (("ball", 1), ("ball", 3), ("core", 2)):
        chunk = tmp_path / "f.zarr" / "distance" / name / "c" / str(phase) / "0" / "0" / "0"
        values = np.memmap(chunk, "<f4", "r+")
        values[np.abs(values) < 2] *= -1
        values.flush()
    surfaces = {name: ball_and_core()[name] for name in field.structures}
    said = certify(field, surfaces, 4000, lambda: None)
    ball, core = (said["structures"][name] for name in ("ball", "core"))
    assert [one > 0 for one in ball["sign_errors_by_phase"]] == [False, True, False, True, False]
    assert ball["sign_errors"] == sum(ball["sign_errors_by_phase"])
    assert said["sign_errors"] == ball["sign_errors"] + core["sign_errors"] > ball["sign_errors"]
