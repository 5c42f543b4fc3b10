"""Wall thickness, mass and ejection of a ventricle of which all is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from data_synth.population import draw_heart
from pipeline.geometry import Float, MovingSurface, Surface
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.measures import (
    base_direction,
    ejection_fraction,
    end_systole,
    measures,
    on_lid,
    segment_names,
)
from pipeline.surface.mesh import vertex_areas

PHASES = np.array([0.0, 0.4])
INNER_MM, OUTER_MM = (25.0, 20.0), (33.0, 31.0)
SEGMENTS = 17


def half_ball(radius_mm: float, pole: Float) -> tuple[Float, Float]:
    """Half a ball with a flat lid through its centre, which faces ``pole``; LPS mm."""
    import pyvista

    ball = pyvista.Icosphere(radius=radius_mm, nsub=4)
    points, triangles = np.array(ball.points, float), np.array(ball.regular_faces)
    points[:, 2] = np.minimum(points[:, 2], 0)
    third = np.asarray(pole) / np.linalg.norm(pole)
    first = np.cross([0.3, 1.0, 0.2], third)
    first /= np.linalg.norm(first)
    return points @ np.stack([first, np.cross(third, first), third]), triangles


def moving(radii_mm: tuple[float, ...], pole: Float, place=(0.0, 0, 0)) -> MovingSurface:
    shapes = [half_ball(radius, pole) for radius in radii_mm]
    return MovingSurface(
        np.stack([points + np.array(place) for points, _ in shapes]), shapes[0][1], PHASES
    )


POLE = np.array([0.4, -0.5, 0.8]) / np.linalg.norm([0.4, -0.5, 0.8])
SEPTUM = np.cross(POLE, [1.0, 0, 0]) / np.linalg.norm(np.cross(POLE, [1.0, 0, 0]))
ANTERIOR = np.cross(POLE, SEPTUM)
SURFACES = {
    "lv_endocardium": moving(INNER_MM, POLE),
    "epicardium": moving(OUTER_MM, POLE),
    "rv_endocardium": moving((20.0, 18.0), POLE, tuple(50 * SEPTUM)),
}


@pytest.fixture(scope="module")
def table():
    return measures(SURFACES)


def test_the_table_is_plain_json_with_the_promised_keys(table):
    assert json.loads(json.dumps(table)) == table
    assert set(table) == {
        "phases", "end_diastole", "end_systole", "volumes_ml", "lv_ejection_fraction",
        "rv_ejection_fraction", "lv_mass_g", "lv_wall_thickness_mm",
    }  # fmt: skip
    assert table["phases"] == PHASES.tolist()
    assert (table["end_diastole"], table["end_systole"]) == (0, 1)


def test_volumes_ejection_and_mass_are_those_of_half_balls(table):
    """2/3 pi r^3, less the mean sag e^2 / 8 r of facets all over: 0.21 % at e = 0.075 r.

    As much again is allowed for the rim of the lid, which facets cut.

    Ejection fractions are ratios, in which that cancels; values are rounded.
    """
    half = 2 / 3 * np.pi / 1000
    np.testing.assert_allclose(
        table["volumes_ml"]["lv_endocardium"], half * np.array(INNER_MM) ** 3, rtol=4e-3
    )
    assert table["lv_ejection_fraction"] == pytest.approx(1 - (20 / 25) ** 3, abs=1e-3)
    assert table["rv_ejection_fraction"] == pytest.approx(1 - (18 / 20) ** 3, abs=1e-3)
    mass = 1.05 * half * (np.array(OUTER_MM) ** 3 - np.array(INNER_MM) ** 3)
    np.testing.assert_allclose(table["lv_mass_g"], mass, rtol=4e-3)


def test_thickness_is_the_difference_of_radii_everywhere(table):
    """The lid of the outer surface is no wall: without it even the basal ring reads 8 and 11 mm.

    Facets sag by e^2 / 12 r, 0.01 mm; next to the lid the wall is cut by a facet's edge, 2.4 mm.
    """
    thickness = table["lv_wall_thickness_mm"]
    np.testing.assert_allclose(thickness["mean"], [8, 11], atol=0.1)
    for name, curve in thickness["segments"].items():
        np.testing.assert_allclose(curve, [8, 11], atol=0.2, err_msg=name)


def test_there_are_seventeen_segments_in_the_order_of_the_standard(table):
    names = list(table["lv_wall_thickness_mm"]["segments"])
    assert len(names) == SEGMENTS
    assert names[:6] == [
        "basal anterior", "basal anteroseptal", "basal inferoseptal",
        "basal inferior", "basal inferolateral", "basal anterolateral",
    ]  # fmt: skip
    assert names[12:] == [
        "apical anterior", "apical septal", "apical inferior", "apical lateral", "apex",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("direction", "name"),
    [
        (ANTERIOR, "mid anterior"),
        (-ANTERIOR, "mid inferior"),
        (0.9 * SEPTUM + 0.4 * ANTERIOR, "mid anteroseptal"),
        (0.9 * SEPTUM - 0.4 * ANTERIOR, "mid inferoseptal"),
        (-0.9 * SEPTUM + 0.4 * ANTERIOR, "mid anterolateral"),
        (-0.9 * SEPTUM - 0.4 * ANTERIOR, "mid inferolateral"),
    ],
)
def test_a_dent_shows_in_its_own_segment(direction, name):
    """The outer wall pressed in by 3 mm at one place, half-way down.

    Anterior is the axis (from apex to base) times the direction of the right ventricle, as in a
    patient whose heart points left, down and forwards.
    """
    direction = direction / np.linalg.norm(direction) - 0.55 * POLE
    direction /= np.linalg.norm(direction)
    outer = SURFACES["epicardium"].vertices_mm.copy()
    unit = outer / np.maximum(np.linalg.norm(outer, axis=2, keepdims=True), 1e-9)
    depth = 3 * np.exp(-0.5 * ((1 - unit @ direction) / 0.03) ** 2)
    outer -= depth[..., None] * unit
    dented = SURFACES | {
        "epicardium": MovingSurface(outer, SURFACES["epicardium"].triangles, PHASES)
    }
    segments = measures(dented)["lv_wall_thickness_mm"]["segments"]
    assert min(segments, key=lambda one: segments[one][0]) == name


def test_where_a_patient_lies_changes_nothing(table):
    """The vectors to the scanner's centre are as long as a patient's are: no share of a height."""
    shift_mm = np.array([40.0, -120.0, 300.0])
    far = {
        name: MovingSurface(one.vertices_mm + shift_mm, one.triangles, one.phases)
        for name, one in SURFACES.items()
    }
    # Values are rounded to 0.01.
    found, expected = measures(far)["lv_wall_thickness_mm"], table["lv_wall_thickness_mm"]
    assert list(found["segments"]) == list(expected["segments"])
    for name, curve in expected["segments"].items():
        np.testing.assert_allclose(found["segments"][name], curve, atol=0.011)


def test_without_a_right_ventricle_segments_are_levels():
    left = {name: one for name, one in SURFACES.items() if name != "rv_endocardium"}
    found = measures(left)
    assert found["rv_ejection_fraction"] is None
    assert list(found["lv_wall_thickness_mm"]["segments"]) == ["basal", "mid", "apical", "apex"]


def test_without_a_lid_there_is_a_mean_alone():
    """A shell between two balls has no valve plane; its wall is 8 mm thick all round."""
    import pyvista

    both = []
    for radius in (25.0, 33.0):
        ball = pyvista.Icosphere(radius=radius, nsub=4)
        both.append(
            MovingSurface(np.array([ball.points], float), np.array(ball.regular_faces), PHASES[:1])
        )
    found = measures({"lv_endocardium": both[0], "epicardium": both[1]})["lv_wall_thickness_mm"]
    assert found["segments"] == {}
    # A facet of edge e sags e^2 / (6 R) at its middle: 0.03 mm at e = 2.4 mm.
    np.testing.assert_allclose(found["mean"], [8], atol=0.05)


def test_the_shapes_of_these_tests_are_sound():
    for one in SURFACES.values():
        assert not one.at(0).boundary_edges().size
        assert one.at(0).volume_mm3() > 0
        assert not crossing_triangles(one.vertices_mm[0], one.triangles).any()


def test_ejection_is_nothing_for_a_still_heart():
    assert ejection_fraction(np.array([100.0, 100.0])) == 0.0


@pytest.mark.parametrize("begins", [0.0, 0.3, 0.9])
def test_end_of_systole_is_found_wherever_the_phases_begin(begins: float) -> None:
    phases = np.arange(25) / 25
    since_r = (phases + begins) % 1
    volume_ml = 120 - 70 * np.exp(-(((since_r - 0.42) / 0.15) ** 2))
    noisy_ml = volume_ml + np.random.default_rng(3).normal(0, 1.5, 25)
    apart = (end_systole(phases, noisy_ml) - (0.42 - begins) + 0.5) % 1 - 0.5
    assert abs(apart) < 0.03


def test_the_middle_of_a_plateau_ends_systole_not_the_very_smallest_volume() -> None:
    phases = np.arange(20) / 20
    volume_ml = np.where((phases >= 0.3) & (phases <= 0.5), 50.0, 120.0)
    volume_ml[6] -= 1
    assert end_systole(phases, volume_ml) == pytest.approx(0.4)


def test_end_systole_is_within_a_quarter_of_the_stroke_volume():
    volume_ml = np.full(20, 100.0)
    volume_ml[6:10] = 60, 69, 71, 79
    assert end_systole(np.arange(20) / 20, volume_ml) == pytest.approx(0.325)


@pytest.mark.parametrize("pathology", ["healthy", "hypertrophic_cardiomyopathy", "rv_dilation"])
def test_septal_segments_lie_between_the_attachments_of_the_right_ventricle(pathology):
    """As the American Heart Association's model has them, by which muscle lies at the right
    ventricle half-way up: the two septal segments lie evenly about the middle of that."""
    heart = draw_heart(np.random.default_rng(6), pathology=pathology)
    inner, outer, right = (
        Surface(*heart.surfaces(0.0, [name])[name])
        for name in ("lv_endocardium", "epicardium", "rv_endocardium")
    )
    axis = base_direction(inner, outer)
    names = segment_names(inner, ~on_lid(inner, axis), axis, right)
    middle_mm = inner.vertices_mm.mean(axis=0)
    septal = np.isin(names, ["mid anteroseptal", "mid inferoseptal"])
    height = inner.vertices_mm[septal] @ axis
    at_mid = np.abs(outer.vertices_mm @ axis - height.mean()) < np.ptp(height) / 2
    touching = at_mid & (cKDTree(right.vertices_mm).query(outer.vertices_mm)[0] < 4)
    across = np.cross(axis, [1.0, 0.3, 0.2])
    across /= np.linalg.norm(across)
    beside = np.cross(axis, across)

    def turned_deg(points_mm, about_deg=0.0):
        off = points_mm - middle_mm
        angle = np.degrees(np.arctan2(off @ beside, off @ across)) - about_deg
        return (angle + 180) % 360 - 180

    about = turned_deg(inner.vertices_mm[septal].mean(axis=0))
    ends = np.percentile(turned_deg(outer.vertices_mm[touching], about), [2, 98])
    # Half-way between the attachments, which each are known to a few degrees.
    assert abs(ends.mean()) < 5
    assert ends[0] < -50
    assert ends[1] > 50


def test_levels_are_thirds_of_the_length():
    inner = SURFACES["lv_endocardium"].at(0)
    height = inner.vertices_mm @ POLE
    walled = height < height.max() - 0.1
    share = (height - height.min()) / np.ptp(height[walled])
    names = segment_names(inner, walled, POLE, None)
    for name, low, high in (("apical", 0.1, 1 / 3), ("mid", 1 / 3, 2 / 3), ("basal", 2 / 3, 1)):
        assert set(names[walled & (share > low + 1e-6) & (share < high - 1e-6)]) == {name}


def test_in_a_mirror_image_anterior_and_inferior_keep_their_places():
    flip = np.diag([1.0, -1.0, 1.0])
    turned = {
        name: MovingSurface(moving.vertices_mm @ flip, moving.triangles[:, ::-1], moving.phases)
        for name, moving in SURFACES.items()
    }
    found = measures(turned, mirrored=True)["lv_wall_thickness_mm"]["segments"]
    for name, expected in measures(SURFACES)["lv_wall_thickness_mm"]["segments"].items():
        np.testing.assert_allclose(found[name], expected, atol=0.02)


def test_a_thin_scar_does_not_turn_the_axis():
    """Of 8 mm of wall 2 are left over a part of it of two thirds of the area of the lid."""
    inner, outer = (SURFACES[name].at(0) for name in ("lv_endocardium", "epicardium"))
    points = inner.vertices_mm
    outwards = points / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    scarred = (outwards @ ANTERIOR > 0.2) & (points @ POLE < -2)
    thinned = Surface(points + 6 * scarred[:, None] * outwards, inner.triangles)
    areas = vertex_areas(points, inner.triangles)
    assert areas[scarred].sum() > 0.65 * areas[points @ POLE > -1e-6].sum()
    for shape in (inner, thinned):
        axis = base_direction(shape, outer)
        assert axis is not None
        assert np.degrees(np.arccos(min(axis @ POLE, 1))) < 3


@pytest.mark.parametrize(
    ("direction", "name"),
    [
        (ANTERIOR, "apical anterior"), (SEPTUM, "apical septal"),
        (-ANTERIOR, "apical inferior"), (-SEPTUM, "apical lateral"),
    ],
)  # fmt: skip
def test_apical_quarters_lie_about_their_walls(direction, name):
    inner, right = (SURFACES[one].at(0) for one in ("lv_endocardium", "rv_endocardium"))
    names = segment_names(inner, ~on_lid(inner, POLE), POLE, right)
    middle = inner.vertices_mm[names == name].mean(axis=0)
    middle -= (middle @ POLE) * POLE
    # A quarter's vertices are some fifty, of 3 degrees each.
    assert middle @ direction > np.cos(np.radians(5)) * np.linalg.norm(middle)


def test_the_mean_thickness_does_not_depend_on_where_triangles_are_small():
    """A ball in an ellipsoid, thick at the poles, where a globe's meridians crowd."""
    import pyvista

    globe = pyvista.Sphere(radius=25, theta_resolution=60, phi_resolution=60)
    even = pyvista.Icosphere(radius=25, nsub=4)
    outer = pyvista.Icosphere(radius=1, nsub=5)
    shell, found = np.array(outer.points, float) * (33, 33, 41), []
    for ball in (globe, even):
        inner = np.array(ball.points, float)
        pair = [
            MovingSurface(points[None], np.array(mesh.regular_faces), PHASES[:1])
            for points, mesh in ((inner, ball), (shell, outer))
        ]
        table = measures({"lv_endocardium": pair[0], "epicardium": pair[1]})
        found.append(table["lv_wall_thickness_mm"]["mean"][0])
    assert found[0] == pytest.approx(found[1], abs=0.05)
