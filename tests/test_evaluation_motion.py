"""Errors of motion against motions whose size is known in closed form, and the stage's files."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import SimpleITK
from scipy.integrate import quad
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.evaluation.metrics import pooled_dice
from pipeline.evaluation.motion import material_points, motion_error
from pipeline.geometry import Float, MovingSurface, Surface
from pipeline.imaging.labels import LABELS
from pipeline.imaging.nifti import write_image
from pipeline.job import Job
from pipeline.products import read_labels, write_labels, write_surfaces, write_table
from pipeline.stages import evaluate
from pipeline.stages.evaluate import _labels

RADIUS_MM = 30.0
PHASES = np.array([0.0, 0.5])


def unit_sphere(count: int) -> Surface:
    """Fibonacci sphere of radius 1, normals outwards."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    points = np.stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1
    )
    hull = ConvexHull(points)
    triangles = hull.simplices.astype(np.int64)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward, ::-1]
    return Surface(points, triangles)


FINE, COARSE = unit_sphere(4000), unit_sphere(1500)
# No point of a mesh's facet is farther than its longest edge from its corners, so an
# interpolated normal leans less than that edge's angle.
EDGE = max(
    np.linalg.norm(np.diff(FINE.vertices_mm[FINE.triangles[:, pair]], axis=1), axis=2).max()
    for pair in ([0, 1], [1, 2], [2, 0])
)


def moving(surface: Surface, *places: Float) -> MovingSurface:
    return MovingSurface(np.stack(places), surface.triangles, PHASES[: len(places)])


def truth(later: Any) -> MovingSurface:
    start = RADIUS_MM * FINE.vertices_mm
    return moving(FINE, start, later(start))


def found(later: Any, beside_mm: float = 0.0) -> MovingSurface:
    start = (RADIUS_MM + beside_mm) * COARSE.vertices_mm
    return moving(COARSE, start, later(start))


def test_a_surface_beside_the_truth_that_moves_with_it_has_no_error() -> None:
    """The same shift all over needs no correspondence: exact but for rounding."""

    def shifted(points: Float) -> Float:
        return points + np.array([3.0, -4.0, 12.0])

    error = motion_error(found(shifted, beside_mm=2.0), truth(shifted))
    np.testing.assert_allclose([error.normal_mm, error.tangential_mm], 0, atol=1e-9)


def test_a_still_surface_misses_a_shift_by_half_across_and_a_quarter_pi_along() -> None:
    """Means of |cos| and sin over a sphere: 1/2 and pi/4."""
    shift_mm = 8.0
    error = motion_error(found(lambda p: p), truth(lambda p: p + np.array([0, 0, shift_mm])))
    slack_mm = shift_mm * EDGE
    assert error.mean_mm()[0] == pytest.approx(shift_mm / 2, abs=slack_mm)
    assert error.mean_mm()[1] == pytest.approx(shift_mm * np.pi / 4, abs=slack_mm)
    assert error.normal_mm[0] == error.tangential_mm[0] == 0


def test_a_spin_that_is_not_followed_is_an_error_along_the_surface() -> None:
    """A point at angle t to the axis falls R sin^2 t (1 - cos a) below the sphere where it went.

    So says the chord's product with the normal there; the rest of the chord 2 R sin t sin(a/2) is
    tangential. The height has a mean of 2/3 R (1 - cos a).
    """
    angle = 0.3
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    error = motion_error(found(lambda p: p), truth(lambda p: p @ turn.T))

    def along(t: float) -> float:
        chord = 2 * RADIUS_MM * np.sin(t) * np.sin(angle / 2)
        height = RADIUS_MM * np.sin(t) ** 2 * (1 - np.cos(angle))
        return float(np.sqrt(chord**2 - height**2) * np.sin(t) / 2)

    slack_mm = 2 * RADIUS_MM * np.sin(angle / 2) * EDGE
    assert error.mean_mm()[0] == pytest.approx(
        2 / 3 * RADIUS_MM * (1 - np.cos(angle)), abs=slack_mm
    )
    assert error.mean_mm()[1] == pytest.approx(quad(along, 0, np.pi)[0], abs=slack_mm)
    assert error.tangential_mm[1] > 5 * error.normal_mm[1]


def test_too_much_growth_is_an_error_across_the_surface() -> None:
    """From 32 mm by a quarter is 8 mm of way, from 30 mm 7.5 mm."""
    error = motion_error(found(lambda p: 1.25 * p, beside_mm=2.0), truth(lambda p: 1.25 * p))
    # Foot points on flat facets lie below the sphere by at most edge^2 / 8 of the radius, and
    # beside their vertex by the lean of the facet.
    slack_mm = 0.25 * RADIUS_MM * EDGE**2 + 0.5 * EDGE
    assert error.normal_mm[1] == pytest.approx(0.5, abs=slack_mm)
    assert error.tangential_mm[1] < 0.25 * 2 * EDGE + slack_mm


@pytest.mark.parametrize("reference", [0, 1])
def test_the_mean_leaves_the_reference_out_wherever_it_is(reference: int) -> None:
    error = motion_error(found(lambda p: p), truth(lambda p: p + np.array([0, 0, 1.0])), reference)
    assert error.normal_mm[reference] == error.tangential_mm[reference] == 0
    assert error.normal_mm[1 - reference] > 0.4
    assert error.mean_mm() == (error.normal_mm[1 - reference], error.tangential_mm[1 - reference])


def test_vertices_count_by_the_area_around_them() -> None:
    """Half the sphere meshed ten times as densely does not weigh more."""
    k = np.arange(6000) + 0.5
    height = np.where(k < 5500, 1 - k / 5500, -(k - 5500) / 500)
    turn = np.pi * (1 + 5**0.5) * k
    side = np.sqrt(1 - height**2)
    points = np.stack([np.cos(turn) * side, np.sin(turn) * side, height], axis=1)
    uneven = Surface(points, ConvexHull(points).simplices.astype(np.int64))
    start = RADIUS_MM * points
    upper = np.where(points[:, 2:] > 0, 1.0, 0.0) * [0, 0, 4.0]
    wrong = moving(uneven, start, start + upper)
    error = motion_error(wrong, truth(lambda p: p))
    # Upper half: mean |cos| is 1/2; lower half: nothing. Border triangles are two edges wide.
    sparse_edge = np.sqrt(4 * np.pi / 1000) * 2
    assert error.normal_mm[1] == pytest.approx(1.0, abs=4 * sparse_edge / 2)
    assert error.normal_mm[1] < 1.5 < 4 * 0.5 * 5500 / 6000


def test_material_points_are_the_nearest_of_a_cube() -> None:
    """Nearest point of a cube in closed form: coordinates clipped to it."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * 10
    cube = Surface(corners, ConvexHull(corners).simplices.astype(np.int64))
    points = np.random.default_rng(3).uniform(-8, 18, (400, 3))
    points = points[((points < 0) | (points > 10)).any(axis=1)]
    vertices, shares = material_points(points, cube)
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-12)
    assert shares.min() >= 0
    nearest = np.einsum("nc,nck->nk", shares, cube.vertices_mm[vertices])
    np.testing.assert_allclose(nearest, np.clip(points, 0, 10), atol=1e-9)


def test_surfaces_of_other_phases_are_refused() -> None:
    still = truth(lambda p: p)
    alone = MovingSurface(still.vertices_mm[:1], still.triangles, PHASES[:1])
    with pytest.raises(InputError, match="two phases or more, got 2 and 1"):
        motion_error(still, alone)
    with pytest.raises(InputError, match="two phases or more"):
        motion_error(alone, alone)


def test_pooled_dice_counts_a_wrong_structure_as_wrong() -> None:
    found_labels, true_labels = np.zeros((2, 3, 4, 4), np.uint8)
    true_labels[0, :2], found_labels[0, :2] = 1, 1  # all of 8 right
    true_labels[1, :2], found_labels[1, :2, :2], found_labels[1, :2, 2:] = 1, 1, 2  # 4 of 8
    np.testing.assert_array_equal(pooled_dice(found_labels, true_labels), [1.0, 0.5, np.nan])
    with pytest.raises(InputError, match="share a shape"):
        pooled_dice(found_labels, true_labels[:2])


@pytest.fixture
def job(tmp_path: Path) -> Job:
    """Spheres: truth of radius 30 then 20 mm, found 1 mm larger, which is 31 then 21 mm."""
    truth_folder, products = tmp_path / "truth", tmp_path / "products"
    for name in ("ingest", "segment", "surface", "evaluate"):
        (products / name).mkdir(parents=True)
    (truth_folder / "surfaces").mkdir(parents=True)
    names = ("lv_endocardium", "epicardium", "rv_endocardium")
    for folder, larger_mm, mesh in ((truth_folder / "surfaces", 0.0, FINE),
                                    (products / "surface", 1.0, COARSE)):  # fmt: skip
        path = np.stack([(r + larger_mm) * mesh.vertices_mm for r in (30.0, 20.0)])
        one = MovingSurface(path, mesh.triangles, PHASES)
        write_surfaces(folder, dict.fromkeys(names, one))
    labels = np.zeros((2, 3, 8, 8), np.uint8)
    labels[:, :2, 2:6, 2:6] = 1
    write_labels(truth_folder, "labels", labels, np.eye(4))
    labels[1, 1, 2:4] = 0
    write_labels(products / "segment", "labels", labels, np.eye(4))
    write_table(products / "ingest" / "phases.json", {"phases": PHASES.tolist()})
    write_table(products / "surface" / "measures.json", {"lv_mass_g": [101.0, 103.0]})
    volumes = [4 / 3 * np.pi * r**3 / 1000 for r in (30, 20)]
    known = {"phases": PHASES.tolist(), "volumes_ml": dict.fromkeys(names, volumes)}
    write_table(truth_folder / "truth.json", known | {"lv_mass_g": 100.0})
    study: Any = SimpleNamespace(truth=truth_folder, us=None)
    return Job(study, Settings(), products, products / "evaluate", lambda done, total: None)


def test_the_stage_measures_what_was_put_there(job: Job) -> None:
    evaluate.run(job)
    metrics = json.loads((job.folder / "metrics.json").read_text())
    # 31 and 21 mm against 30 and 20; facets lie below their sphere by less than R edge^2 / 6.
    sag_mm = 31 * (2 * EDGE) ** 2 / 6
    for one in metrics["structures"].values():
        np.testing.assert_allclose(one["mean_surface_distance_mm"], 1, atol=sag_mm)
        np.testing.assert_allclose(one["hausdorff_95_mm"], 1, atol=sag_mm)
        motion = one["motion_error_mm"]
        # Ways of 10 mm each: nothing is wrong but for the lean of facets.
        assert motion["normal"][0] == 0
        assert motion["normal_mean"] == motion["normal"][1] < 10 * EDGE**2
        assert motion["tangential_mean"] < 10 * EDGE
    assert metrics["structures"]["lv_endocardium"]["dice"] == [1.0, round(2 * 24 / 56, 4)]
    # Its muscle, that is, which these labels do not show.
    assert metrics["structures"]["epicardium"]["dice"] == []
    assert metrics["slice_dice"] == [[1.0, 1.0, None], [1.0, round(2 * 8 / 24, 4), None]]
    for side in ("lv", "rv"):
        fraction = metrics[f"{side}_ejection_fraction"]
        assert fraction["truth"] == round(1 - (2 / 3) ** 3, 4)
        # Both spheres are cut alike by flat facets, so the ratio stands.
        assert fraction["found"] == pytest.approx(1 - (21 / 31) ** 3, abs=1e-4)
    assert metrics["lv_mass_g"] == {"found": 102.0, "truth": 100.0}


def test_what_truth_never_shows_is_not_held_against_labels(job: Job) -> None:
    """As of truth drawn by hand, which has no atria."""
    labels, mr_from_index = read_labels(job.products / "segment", "labels")
    labels[:, 2] = LABELS["left_atrium"]
    write_labels(job.products / "segment", "labels", labels, mr_from_index)
    evaluate.run(job)
    metrics = json.loads((job.folder / "metrics.json").read_text())
    assert metrics["slice_dice"] == [[1.0, 1.0, None], [1.0, round(2 * 8 / 24, 4), None]]
    assert metrics["labels_without_truth"] == [name for name, value in LABELS.items() if value > 1]


def test_labels_are_on_the_files_slices_and_measured_on_those_that_show_something(job: Job) -> None:
    """Two blank slices before the cine's three and one after them."""
    assert job.study.truth is not None
    evaluate.run(job)
    without = json.loads((job.folder / "metrics.json").read_text())
    ingest = job.products / "ingest" / "phases.json"
    write_table(ingest, {**json.loads(ingest.read_text()), "blank_ends": [2, 1]})
    for folder in (job.products / "segment", job.study.truth):
        labels, mr_from_index = read_labels(folder, "labels")
        write_labels(folder, "labels", labels, mr_from_index, (2, 1))
        whole, mr_from_whole = read_labels(folder, "labels")
        np.testing.assert_array_equal(whole[:, 2:-1], labels)
        assert not whole[:, [0, 1, -1]].any()
        np.testing.assert_allclose(mr_from_whole @ [5, 4, 2, 1], mr_from_index @ [5, 4, 0, 1])
    evaluate.run(job)
    assert json.loads((job.folder / "metrics.json").read_text()) == without


def test_truth_of_another_cine_is_refused(job: Job) -> None:
    assert job.study.truth is not None
    write_labels(job.study.truth, "labels", np.zeros((2, 4, 8, 8), np.uint8), np.eye(4))
    with pytest.raises(InputError, match=r"\(2, 4, 8, 8\).*truth and cine must be of one study"):
        evaluate.run(job)


def test_truth_in_another_place_or_order_is_refused(job: Job) -> None:
    """Of another patient with as many slices, or of a stack that is stored mirrored."""
    assert job.study.truth is not None
    mirrored = np.diag([-1.0, 1, 1, 1])
    mirrored[0, 3] = 7
    write_labels(job.study.truth, "labels", np.zeros((2, 3, 8, 8), np.uint8), mirrored)
    with pytest.raises(InputError, match=r"up to 7\.0 mm beside those found.*one study"):
        evaluate.run(job)


def test_a_chamber_without_a_surface_has_no_ejection_fraction(job: Job) -> None:
    for path in (job.products / "surface").glob("rv_*"):
        path.unlink()
    evaluate.run(job)
    metrics = json.loads((job.folder / "metrics.json").read_text())
    assert metrics["rv_ejection_fraction"] == {"found": None, "truth": round(1 - (2 / 3) ** 3, 4)}
    assert set(metrics["structures"]) == {"lv_endocardium", "epicardium"}


def test_truth_of_other_phases_is_refused(job: Job) -> None:
    phases = [*PHASES.tolist(), 0.9]
    write_table(job.products / "ingest" / "phases.json", {"phases": phases})
    with pytest.raises(InputError, match="its phases are not those of the cine"):
        evaluate.run(job)


def test_truth_whose_meshes_do_not_correspond_has_no_motion(job: Job) -> None:
    """Distances remain."""
    assert job.study.truth is not None
    other = moving(COARSE, 20 * COARSE.vertices_mm)
    write_surfaces(job.study.truth, {"lv_endocardium": other})
    made = job.study.truth / "lv_endocardium_000.vtp"
    made.rename(job.study.truth / "surfaces" / "lv_endocardium_001.vtp")
    evaluate.run(job)
    metrics = json.loads((job.folder / "metrics.json").read_text())["structures"]
    assert "motion_error_mm" not in metrics["lv_endocardium"]
    assert "motion_error_mm" in metrics["rv_endocardium"]
    assert len(metrics["lv_endocardium"]["mean_surface_distance_mm"]) == 2


def test_phases_that_are_off_by_a_frame_are_not_those_of_the_truth(job: Job) -> None:
    write_table(job.products / "ingest" / "phases.json", {"phases": (PHASES + 0.03).tolist()})
    with pytest.raises(InputError, match="its phases are not those of the cine"):
        evaluate.run(job)


@pytest.mark.parametrize("values", [(0.0, 0.999999, 2.0), (0.0, 257.0, 2.0), (0.0, 9.0, 2.0)])
def test_truth_that_holds_no_labels_is_refused(tmp_path: Path, values: tuple[float, ...]) -> None:
    volume = np.resize(np.array(values, np.float32), (3, 4, 5))
    write_image(tmp_path / "labels_000.nii.gz", volume, np.diag([1.5, 1.5, 8, 1]))
    with pytest.raises(InputError, match=r"labels_000\.nii\.gz: holds .*, which is no label"):
        read_labels(tmp_path, "labels")
    with pytest.raises(InputError, match=r"holds no heart_000\.nii\.gz"):
        read_labels(tmp_path, "heart")


def test_what_is_written_opens_elsewhere_however_its_axes_are_rounded(tmp_path: Path) -> None:
    """ITK takes no affine whose axes lean by more than 1e-4, and 3 decimals make them lean more."""
    turn = Rotation.from_rotvec([0.5, -0.4, 0.7]).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = np.round(turn, 3) * [1.4, 1.4, 8.0]
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    assert 2e-4 < np.abs(axes.T @ axes - np.eye(3)).max() < 1e-3
    write_image(tmp_path / "image.nii.gz", np.zeros((4, 5, 6), np.uint8), affine)
    image = SimpleITK.ReadImage(str(tmp_path / "image.nii.gz"))
    far = image.TransformContinuousIndexToPhysicalPoint((5.0, 4.0, 3.0))
    np.testing.assert_allclose(far, affine[:3, :3] @ [5, 4, 3], atol=0.02)


def test_a_structure_that_truth_shows_in_one_phase_alone_counts(job: Job) -> None:
    """As an atrium that comes into the stack while the ventricles are short."""
    assert job.study.truth is not None
    labels, mr_from_index = read_labels(job.study.truth, "labels")
    labels[1, 2] = LABELS["left_atrium"]
    write_labels(job.study.truth, "labels", labels, mr_from_index)
    evaluate.run(job)
    metrics = json.loads((job.folder / "metrics.json").read_text())
    assert "left_atrium" not in metrics["labels_without_truth"]
    assert metrics["slice_dice"][1][2] == 0.0


@pytest.mark.parametrize(("off_mm", "refused"), [(0.4, False), (0.6, True)])
def test_truth_that_lies_more_than_rounding_aside_is_refused(
    job: Job, off_mm: float, refused: bool
) -> None:
    found = read_labels(job.products / "segment", "labels")
    known = found[0], found[1] + np.outer([0, 1, 0, 0], [0, 0, 0, off_mm])
    assert job.study.truth is not None
    write_labels(job.study.truth, "labels", *known)
    if not refused:
        _labels(job, job.study.truth)
        return
    with pytest.raises(InputError, match=r"up to 0\.6 mm beside those found"):
        _labels(job, job.study.truth)


def test_errors_are_across_where_the_wall_has_turned_to() -> None:
    """A sphere turned by a quarter and found 1 mm larger: across it all over, along it nowhere."""
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    larger = 1 + 1 / RADIUS_MM
    error = motion_error(found(lambda p: larger * p @ turn.T), truth(lambda p: p @ turn.T))
    assert error.normal_mm[1] == pytest.approx(1, abs=2 * EDGE)
    assert error.tangential_mm[1] < 2 * EDGE
