"""Metrics against shapes whose distances, overlaps and volumes are known in closed form."""

from __future__ import annotations

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.evaluation.metrics import (
    closedness,
    dice,
    phase_error,
    surface_distance,
    surface_samples,
    target_registration_error_mm,
)
from pipeline.exact import ExactSurface
from pipeline.geometry import Float, MovingSurface, Surface, transform_points
from pipeline.products import (
    FrameRow,
    read_labels,
    write_frames,
    write_labels,
    write_surfaces,
    write_table,
)
from pipeline.stages.evaluate import (
    _frame_phase_errors,
    _headline,
    _read_truth,
    _registration,
    _structure,
)
from pipeline.surface.measures import (
    distances_mm,
    ejection_fraction,
    volumes_ml,
)

SPHERE_POINTS = 6000


def outward_hull(points_mm: Float) -> Surface:
    """Convex hull as a surface; independent of the code under test."""
    hull = ConvexHull(points_mm)
    triangles = hull.simplices.astype(np.int64)
    a, b, c = (points_mm[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward, ::-1]
    return Surface(points_mm, triangles)


def sphere(radius_mm: float, centre_mm: tuple[float, float, float] = (0, 0, 0)) -> Surface:
    """Fibonacci sphere: nearly equal triangles."""
    k = np.arange(SPHERE_POINTS) + 0.5
    polar, turn = np.arccos(1 - 2 * k / SPHERE_POINTS), np.pi * (1 + 5**0.5) * k
    unit = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)
    return outward_hull(radius_mm * unit + np.array(centre_mm))


def sag(radius_mm: float) -> float:
    """Depth of the deepest flat facet below its sphere: R - sqrt(R^2 - e^2/3), longest edge e."""
    surface = sphere(radius_mm)
    corners = surface.vertices_mm[surface.triangles]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    return float(radius_mm - np.sqrt(radius_mm**2 - edge**2 / 3))


def box(side_mm: float, corner_mm: tuple[float, float, float] = (0, 0, 0)) -> Surface:
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    return outward_hull(side_mm * corners + np.array(corner_mm))


@pytest.mark.parametrize(("inner_mm", "outer_mm"), [(20.0, 25.0), (30.0, 30.5), (10.0, 40.0)])
def test_concentric_spheres_are_apart_by_the_difference_of_radii(inner_mm, outer_mm):
    """Facets sag below either sphere, so the gap is known to one sag of the outer."""
    found = surface_distance(sphere(inner_mm), sphere(outer_mm), samples=3000)

    gap_mm, slack_mm = outer_mm - inner_mm, sag(outer_mm)
    for value in (found.mean_mm, found.hausdorff95_mm, found.largest_mm):
        assert value == pytest.approx(gap_mm, abs=slack_mm)


def test_shifted_spheres_follow_the_closed_form():
    """From x on one sphere, at angle t to the shift s, the other is | |x - s| - R | away.

    cos t is uniform on a sphere, so mean and percentile are integrals over one variable. The two
    directions are mirror images. Stratified samples err by less than range / sqrt(samples).
    """
    radius_mm, shift_mm, samples = 30.0, 8.0, 20_000
    found = surface_distance(sphere(radius_mm), sphere(radius_mm, (0, 0, shift_mm)), samples)

    cosine = (np.arange(200_000) + 0.5) / 100_000 - 1
    far = np.sqrt(radius_mm**2 + shift_mm**2 - 2 * radius_mm * shift_mm * cosine)
    exact = np.abs(far - radius_mm)
    slack_mm = 2 * sag(radius_mm) + shift_mm / np.sqrt(samples)
    assert found.mean_mm == pytest.approx(exact.mean(), abs=slack_mm)
    assert found.hausdorff95_mm == pytest.approx(np.percentile(exact, 95), abs=slack_mm)
    assert found.largest_mm == pytest.approx(shift_mm, abs=slack_mm)


def test_a_surface_is_no_distance_from_itself():
    found = surface_distance(box(10.0), box(10.0))
    assert found.largest_mm < 1e-9


def test_distance_to_a_cube_is_exact_and_signed():
    """A box's distance in closed form: |max(q, 0)| + min(max q, 0), q = |x - centre| - half."""
    points = np.random.default_rng(1).uniform(-20, 30, (500, 3))
    q = np.abs(points - 5.0) - 5.0
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    np.testing.assert_allclose(ExactSurface(box(10.0)).distance_mm(points), exact, atol=1e-9)


def test_distances_survive_coordinates_that_single_precision_would_round():
    """At 1e5 mm a float32 steps by 8 um; double precision keeps 1e-9 mm."""
    corner = (1e5, 1e5, 1e5)
    point = np.array([[1e5 + 5, 1e5 + 5, 1e5 + 10 + 1e-4]])
    assert distances_mm(point, box(10.0, corner))[0] == pytest.approx(1e-4, abs=1e-9)


def test_samples_fall_on_faces_in_the_measure_of_their_area():
    """A bar of 1 x 1 x 8: each end has 1/34 of the area; stratified, so within two strata."""
    bar = Surface(box(1.0).vertices_mm * (1, 1, 8), box(1.0).triangles)
    points = surface_samples(bar, 3400)
    ends = np.isclose(points[:, 2], 0) | np.isclose(points[:, 2], 8)
    # Two triangles an end are four runs of strata, each cut off at both its ends.
    assert abs(np.count_nonzero(ends) - 200) <= 8
    assert distances_mm(points, bar).max() < 1e-12


def test_samples_are_the_same_for_the_same_seed():
    surface = sphere(10.0)
    np.testing.assert_array_equal(surface_samples(surface, 50, 3), surface_samples(surface, 50, 3))
    assert not np.array_equal(surface_samples(surface, 50, 3), surface_samples(surface, 50, 4))


def test_dice_of_boxes_that_overlap_by_half():
    found, truth = np.zeros((2, 10, 10, 10), np.uint8)
    found[:, :, :4], truth[:, :, 2:6] = 2, 2
    truth[0, 0, 9], found[0, 0, 9] = 3, 4
    assert dice(found, truth, {"muscle": 2, "lost": 3, "made_up": 4, "absent": 5}) == {
        "muscle": 0.5,
        "lost": 0.0,
        "made_up": 0.0,
    }


def test_dice_refuses_arrays_of_different_shape():
    with pytest.raises(InputError, match="share a shape"):
        dice(np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8), {"a": 1})


def rigid(turn: Float, shift: Float) -> Float:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    transform[:3, 3] = shift
    return transform


vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@settings(max_examples=30, deadline=None)
@given(vectors, vectors, vectors)
def test_target_registration_error_of_a_shift_is_its_length(turn, place, shift):
    """Whatever the true pose, a shift in the MR frame misses every target by its length."""
    truth = rigid(turn, 100 * place)
    targets = np.random.default_rng(0).normal(0, 50, (9, 3))
    found = rigid(np.zeros(3), shift) @ truth
    errors = target_registration_error_mm(found, truth, targets)
    np.testing.assert_allclose(errors, np.linalg.norm(shift), atol=1e-9)


def test_target_registration_error_of_a_turn_is_the_chord():
    """A turn by a about the z axis moves a point at radius r by 2 r sin(a / 2)."""
    angle, radius = 0.1, 50.0
    errors = target_registration_error_mm(
        rigid(np.array([0, 0, angle]), np.zeros(3)), np.eye(4), np.array([[radius, 0, 7.0]])
    )
    assert errors[0] == pytest.approx(2 * radius * np.sin(angle / 2), abs=1e-12)


@given(st.floats(0, 0.999), st.floats(-0.499, 0.499))
def test_phase_error_knows_no_seam(phase, late):
    """A known lateness comes back with its sign on either side of the R peak."""
    found = phase_error(np.array([(phase + late) % 1.0]), np.array([phase]))
    assert found[0] == pytest.approx(late, abs=1e-12)


def test_half_a_beat_early_and_late_are_one_value():
    np.testing.assert_array_equal(phase_error(np.array([0.5, 0.0]), np.array([0.0, 0.5])), -0.5)


def test_a_cube_is_a_solid():
    found = closedness(box(1.0, (50, 60, 70)))
    assert (found.boundary_edges, found.components, found.outward) == (0, 1, True)
    assert found.is_solid


def test_a_missing_triangle_leaves_three_open_edges():
    cube = box(1.0)
    found = closedness(Surface(cube.vertices_mm, cube.triangles[1:]))
    assert found.boundary_edges == 3
    assert not found.is_solid


def test_a_cube_inside_out_is_not_outward():
    cube = box(1.0)
    found = closedness(Surface(cube.vertices_mm, cube.triangles[:, ::-1]))
    assert (found.boundary_edges, found.outward) == (0, False)


def test_a_piece_inside_out_shows_beside_a_large_good_one():
    """The sum of volumes would hide it."""
    large, small = box(10.0), box(1.0, (20, 0, 0))
    both = Surface(
        np.concatenate([large.vertices_mm, small.vertices_mm]),
        np.concatenate([large.triangles, small.triangles[:, ::-1] + 8]),
    )
    found = closedness(both)
    assert (found.boundary_edges, found.components, found.outward) == (0, 2, False)


def test_volumes_and_ejection_fraction_of_a_cube_that_shrinks():
    """Sides 50, 40 and 30 mm: 125, 64 and 27 ml; the fraction is 98 / 125."""
    cube = box(1.0)
    sides = np.array([50.0, 40.0, 30.0])
    path = sides[:, None, None] * cube.vertices_mm
    found = volumes_ml(MovingSurface(path, cube.triangles, np.array([0.0, 0.3, 0.6])))
    np.testing.assert_allclose(found, [125, 64, 27], rtol=1e-12)
    assert ejection_fraction(found) == pytest.approx(98 / 125)


@settings(max_examples=15, deadline=None)
@given(vectors, vectors)
def test_moving_both_surfaces_together_changes_no_distance(turn, place):
    """Distances belong to the pair, not to the frame."""
    pose = rigid(turn, 50 * place)
    first, second = box(10.0), box(14.0, (-1, -2, -3))
    moved = [Surface(transform_points(pose, s.vertices_mm), s.triangles) for s in (first, second)]
    here, there = surface_distance(first, second, 500), surface_distance(*moved, 500)
    assert there.mean_mm == pytest.approx(here.mean_mm, abs=1e-9)
    assert there.hausdorff95_mm == pytest.approx(here.hausdorff95_mm, abs=1e-9)


def test_truth_of_sweeps_by_other_names_is_told(tmp_path):
    (tmp_path / "register").mkdir()
    row = FrameRow("left", 0, 3.0, 0.25, 0.1, valid=True)
    write_frames(tmp_path / "register" / "frames.csv", [row])
    job = SimpleNamespace(products=tmp_path, study=SimpleNamespace(folder=tmp_path))
    one = {"times_s": [2.9, 3.0], "mechanical_phases": [0.1, 0.2]}
    assert _frame_phase_errors(job, {"us_frames": {"left": one}}) == pytest.approx([0.05])
    with pytest.raises(InputError, match=r"truth\.json: knows no sweep left, only sweep_000; give"):
        _frame_phase_errors(job, {"us_frames": {"sweep_000": one}})


@pytest.mark.parametrize(
    ("change", "registered", "words"),
    [
        ({"lv_mass_g": None}, False, "has no lv_mass_g; it needs phases, volumes_ml, lv_mass_g"),
        ({}, True, "has no mr_from_tracker, us_frames"),
        ({"volumes_ml": {"lv_endocardium": [1]}}, False, "volumes_ml has no rv_endocardium"),
    ],
)
def test_truth_that_lacks_what_is_compared_is_told(tmp_path, change, registered, words):
    whole = {"phases": [0], "lv_mass_g": 1}
    whole["volumes_ml"] = {"lv_endocardium": [1], "rv_endocardium": [1]}
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(whole))
    assert _read_truth(tmp_path, registered=False) == whole
    known = {name: value for name, value in (whole | change).items() if value is not None}
    path.write_text(json.dumps(known))
    with pytest.raises(InputError, match=f"truth.json: {words}"):
        _read_truth(tmp_path, registered)


def test_target_registration_error_is_counted_where_the_mr_has_the_targets():
    """A turn about z in the MR frame, after a true pose that takes the tracker elsewhere."""
    truth = rigid(np.array([0.4, -1.1, 0.7]), np.array([200.0, -90.0, 35.0]))
    off = rigid(np.array([0, 0, 0.1]), np.zeros(3))
    targets = np.array([[50.0, 0, 7.0], [0, 0, 90.0]])
    errors = target_registration_error_mm(off @ truth, truth, targets)
    np.testing.assert_allclose(errors, [100 * np.sin(0.05), 0], atol=1e-9)


def test_hausdorff_is_the_larger_of_both_ways():
    """A piece of 7 % of one surface's area, of 3.5 % of both, that the other lacks."""
    near, far = sphere(10.0), sphere(2.75, (100, 0, 0))
    both = Surface(
        np.concatenate([near.vertices_mm, far.vertices_mm]),
        np.concatenate([near.triangles, far.triangles + len(near.vertices_mm)]),
    )
    for one, other in ((near, both), (both, near)):
        found = surface_distance(one, other, 2000)
        assert found.hausdorff95_mm > 87
        assert found.largest_mm > 87
        # 7 % of one surface lie some 90 mm off and of the other none: the mean of both ways.
        assert found.mean_mm == pytest.approx(0.5 * 0.07 * 90, rel=0.2)


def test_registration_and_phases_of_frames_are_held_against_truth(tmp_path):
    """A quarter turn about z and 10 mm along x too much, of three points known by hand.

    (10, 0, 0) is taken to (10, 10, 0), (0, 20, 0) to (-10, 0, 0) and (0, 0, 30) to (10, 0, 30):
    missed by 10, by the root of 500 and by 10 mm. The start was 7 mm off everywhere.
    """
    true, off, beside = np.eye(4), np.eye(4), np.eye(4)
    true[:3, 3] = 5, -6, 7
    off[:2] = [[0, -1, 0, 10], [1, 0, 0, 0]]
    beside[2, 3] = 7
    for name in ("register", "surfaces"):
        (tmp_path / name).mkdir()
    table = {"mr_from_tracker": (off @ true).tolist()}
    write_table(tmp_path / "register" / "mr_from_tracker.json", table)
    corners = np.array([[10.0, 0, 0], [0, 20, 0], [0, 0, 30]])
    heart = MovingSurface(corners[None], np.array([[0, 1, 2]]), np.zeros(1))
    write_surfaces(tmp_path / "surfaces", {"heart": heart})
    # Frame k is k hundredths of a beat early; truth knows one frame more, and lists the last first.
    times_s, true_phases = 3 + 0.04 * np.arange(22), np.linspace(0.95, 1.15, 22) % 1
    rows = [
        FrameRow("fan", k, times_s[k] + 0.004, (true_phases[k] - k / 100) % 1, 0.1, valid=True)
        for k in range(21)
    ]
    write_frames(tmp_path / "register" / "frames.csv", rows)
    fan = {"times_s": times_s[::-1].tolist(), "mechanical_phases": true_phases[::-1].tolist()}
    known = {"mr_from_tracker": true.tolist(), "us_frames": {"fan": fan}}
    us = SimpleNamespace(start=lambda: beside @ true)
    job = SimpleNamespace(products=tmp_path, study=SimpleNamespace(folder=tmp_path, us=us))
    found = _registration(job, tmp_path, known)
    mean_mm, largest_mm = round((20 + 500**0.5) / 3, 3), round(500**0.5, 3)
    assert found == {
        "target_registration_error_mm": {
            "start_mean": 7.0, "mean": mean_mm, "largest": largest_mm
        },
        "frame_phase_error": {
            "mean": 0.1, "percentile_95": 0.19, "largest": 0.2
        },
    }  # fmt: skip
    headline = _headline({"structures": {}} | found)
    assert headline["target_registration_error_mm"] == mean_mm
    assert headline["largest_frame_phase_error"] == 0.2


def test_phases_of_truth_are_brought_to_the_beat_of_the_mr(tmp_path):
    """Systole lasts 547.5 - 2.05 HR ms (Weissler 1968) less 40 ms from Q to R, so 405 ms of the
    MR's beat of 1.2 s and 353.75 ms of truth's of 0.8 s; atria contract 120 ms before R."""
    for name in ("ingest", "register"):
        (tmp_path / name).mkdir()
    write_table(tmp_path / "ingest" / "phases.json", {"rr_s": 1.2})
    found, true = [0.0, 0.405 / 1.2, 1.08 / 1.2], [0.0, 0.35375 / 0.8, 0.68 / 0.8]
    rows = [FrameRow("fan", k, float(k), phase, 0.1, valid=True) for k, phase in enumerate(found)]
    write_frames(tmp_path / "register" / "frames.csv", rows)
    known = {"us_frames": {"fan": {"times_s": [0, 1, 2], "mechanical_phases": true}}}
    job = SimpleNamespace(products=tmp_path, study=SimpleNamespace(folder=tmp_path))
    apart = np.array(found) - true
    assert np.abs(apart).max() > 0.05
    np.testing.assert_allclose(_frame_phase_errors(job, known), apart, atol=1e-6)
    known["settings"] = {"heart_rate_bpm": 75.0}
    for turns in (0, 1, -1):
        known["us_frames"]["fan"]["mechanical_phases"] = [one + turns for one in true]
        np.testing.assert_allclose(_frame_phase_errors(job, known), 0, atol=1e-6)
    known["us_frames"]["fan"]["mechanical_phases"] = [-1e-17, *true[1:]]
    np.testing.assert_allclose(_frame_phase_errors(job, known), 0, atol=1e-6)
    for wrong in ("75", [75], True, -75, 0, float("nan"), float("inf")):
        known["settings"] = {"heart_rate_bpm": wrong}
        with pytest.raises(InputError, match=r"truth\.json: settings\.heart_rate_bpm is"):
            _frame_phase_errors(job, known)
    for without in (None, [], "x", {}):
        known["settings"] = without
        np.testing.assert_allclose(_frame_phase_errors(job, known), apart, atol=1e-6)


def test_the_headline_is_the_worst_phase_and_every_structure_sound():
    good = {"mean_surface_distance_mm": [0.4, 1.2, 0.7]}
    good |= dict.fromkeys(("closed", "one_component", "outward"), True)
    assert _headline({"structures": {"aorta": good}}) == {
        "worst_mean_surface_distance_mm": {"aorta": 1.2}, "all_closed": True,
    }  # fmt: skip
    for lacking in ("closed", "one_component", "outward"):
        bad = good | {lacking: False}
        assert not _headline({"structures": {"aorta": bad, "heart": good}})["all_closed"]


def test_each_distance_is_told_by_its_own_name():
    """A piece of 3 % of the truth's area that the surface lacks, some 90 mm away."""
    near, far = sphere(10.0), sphere(1.76, (100, 0, 0))
    both = Surface(
        np.concatenate([near.vertices_mm, far.vertices_mm]),
        np.concatenate([near.triangles, far.triangles + len(near.vertices_mm)]),
    )
    found = _structure(MovingSurface(near.vertices_mm[None], near.triangles, np.zeros(1)), [both])
    assert found["mean_surface_distance_mm"] == [pytest.approx(0.5 * 0.03 * 90, rel=0.1)]
    assert found["hausdorff_95_mm"][0] < 0.1
    assert found["largest_distance_mm"][0] > 87


def test_a_surface_that_one_phase_turns_inside_out_is_not_outward():
    cube = box(10.0)
    path = np.stack([cube.vertices_mm, cube.vertices_mm * (-1, 1, 1)])
    found = _structure(MovingSurface(path, cube.triangles, np.array([0, 0.5])), [cube, cube])
    assert (found["closed"], found["outward"]) == (True, False)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"volumes_ml": None}, "volumes_ml is no JSON object"),
        ({"us_frames": []}, "us_frames is no JSON object"),
        ({"phases": ["a"]}, "phases needs a list of finite numbers"),
        ({"phases": [[0.0], [0.5, 0.7]]}, "phases needs a list of finite numbers"),
        ({"lv_mass_g": None}, "lv_mass_g needs a finite number"),
        ({"volumes_ml": {"lv_endocardium": [], "rv_endocardium": [1]}}, "lv_endocardium needs"),
        ({"mr_from_tracker": np.eye(3).tolist()}, "no 4x4 matrix with an inverse"),
        ({"mr_from_tracker": np.zeros((4, 4)).tolist()}, "no 4x4 matrix with an inverse"),
    ],
)
def test_truth_of_another_kind_is_refused_in_words(tmp_path, change, words):
    whole = {
        "phases": [0.0, 0.5],
        "volumes_ml": {"lv_endocardium": [2, 1], "rv_endocardium": [2, 1]},
        "lv_mass_g": 80,
        "mr_from_tracker": np.eye(4).tolist(),
        "us_frames": {},
    }
    write_table(tmp_path / "truth.json", whole)
    assert _read_truth(tmp_path, registered=True) == whole
    write_table(tmp_path / "truth.json", whole | change)
    with pytest.raises(InputError, match=words):
        _read_truth(tmp_path, registered=True)


def test_truth_that_is_no_object_is_refused_in_words(tmp_path):
    (tmp_path / "truth.json").write_text("3")
    with pytest.raises(InputError, match="no JSON object"):
        _read_truth(tmp_path, registered=False)


def test_labels_of_phases_that_differ_in_shape_are_refused(tmp_path):
    write_labels(tmp_path, "labels", np.zeros((2, 2, 3, 4), np.uint8), np.eye(4))
    write_labels(tmp_path, "other", np.zeros((1, 2, 3, 5), np.uint8), np.eye(4))
    (tmp_path / "other_000.nii.gz").replace(tmp_path / "labels_001.nii.gz")
    with pytest.raises(InputError, match=r"labels_001.*\(2, 3, 5\).*\(2, 3, 4\)"):
        read_labels(tmp_path, "labels")
