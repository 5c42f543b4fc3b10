"""Labels in, moving surfaces out: names, frames, volumes, and what is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest
import pyvista
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from surface_shapes import SPACING_MM, MovingBody, box, ellipsoid, voxel_centres, voxel_noise_mm

from pipeline.errors import InputError, StageError
from pipeline.evaluation.metrics import closedness
from pipeline.geometry import Float, Label, MovingSurface, nearest_phase, transform_points
from pipeline.imaging.labels import LABELS
from pipeline.surface import extraction
from pipeline.surface.bodies import Body, _without_tunnels, joined
from pipeline.surface.extraction import STRUCTURES, _misfit_ml, extract
from pipeline.surface.level_set import LevelSet
from pipeline.surface.measures import volumes_ml
from pipeline.surface.mesh import extract_surface
from pipeline.surface.settings import SurfaceSettings

PHASES = np.array([0.0, 0.15, 0.35, 0.5, 0.7, 0.85])
LV = MovingBody(ellipsoid((15, 15, 27)), strain=(0.25, 0.25, 0.1), shift_mm=(0, 0, 4))
MUSCLE = MovingBody(ellipsoid((22, 22, 34)), strain=(0.1, 0.1, 0.1), shift_mm=(0, 0, 4))
SETTINGS = SurfaceSettings(edge_mm=2.5)


def surfaces_of(*arguments) -> dict[str, MovingSurface]:
    """Surfaces alone, without what had to be mended."""
    return extract(*arguments).surfaces


def placed(body: MovingBody, centre: tuple[float, float, float], points: Float, phase: float):
    return body.inside(points - np.array(centre), phase)


def heart_labels() -> tuple[Label, Float]:
    """A left ventricle, and chambers of other makes beside it; and mr_from_index."""
    points, first = voxel_centres((60, 40, 52))
    heart = np.zeros((len(PHASES), *points.shape[:3]), np.uint8)
    beside = {
        "rv_cavity": (MovingBody(ellipsoid((18, 20, 26)), (0.2, 0.2, 0.1)), (-33, 0, 0)),
        "left_atrium": (MovingBody(ellipsoid((12, 12, 12)), (-0.1, -0.1, -0.1)), (15, 12, 26)),
        "right_atrium": (MovingBody(ellipsoid((13, 13, 13)), (-0.1, -0.1, -0.1)), (-28, 4, 26)),
    }
    for volume, phase in zip(heart, PHASES, strict=True):
        # The muscle comes last and cuts into its neighbours: all chambers touch in all phases.
        for name, (body, centre) in beside.items():
            volume[placed(body, centre, points, phase)] = LABELS[name]
        volume[MUSCLE.inside(points, phase)] = LABELS["lv_myocardium"]
        volume[LV.inside(points, phase)] = LABELS["lv_cavity"]
    frame = np.diag([SPACING_MM] * 3 + [1.0])
    frame[:3, 3] = first
    return heart, frame


HEART, FRAME = heart_labels()


@pytest.fixture(scope="module")
def surfaces() -> dict[str, MovingSurface]:
    return surfaces_of(HEART, FRAME, PHASES, SETTINGS)


def test_every_structure_that_is_there_gets_a_surface_and_no_other(surfaces):
    """There is no aorta in these labels."""
    assert list(surfaces) == [name for name in STRUCTURES if name != "aorta"]


def test_surfaces_are_solids_in_every_phase(surfaces):
    for moving in surfaces.values():
        assert moving.vertices_mm.shape[0] == len(PHASES)
        np.testing.assert_array_equal(moving.phases, PHASES)
        for k in range(len(PHASES)):
            assert closedness(moving.at(k)).is_solid


@pytest.mark.parametrize(("name", "body"), [("lv_endocardium", LV), ("epicardium", MUSCLE)])
def test_volume_is_kept_to_half_a_percent(surfaces, name, body):
    """The closed form: 4/3 pi a b c times the determinant of the motion."""
    axes = (15, 15, 27) if body is LV else (22, 22, 34)
    rest_ml = 4 / 3 * np.pi * np.prod(axes) / 1000
    exact = [rest_ml * np.linalg.det(body.motion(phase)[0]) for phase in PHASES]
    np.testing.assert_allclose(volumes_ml(surfaces[name]), exact, rtol=5e-3)


@pytest.mark.parametrize(("name", "body"), [("lv_endocardium", LV), ("epicardium", MUSCLE)])
def test_vertices_lie_on_the_true_surface_in_patient_millimetres(surfaces, name, body):
    for vertices, phase in zip(surfaces[name].vertices_mm, PHASES, strict=True):
        noise_mm = voxel_noise_mm(SPACING_MM, SETTINGS.smoothing_voxels)
        assert np.abs(body.distance(vertices, phase)).mean() < noise_mm


def test_the_heart_encloses_its_chambers(surfaces):
    """Seams are filled, nothing is taken away: more than the parts, by less than a fifth."""
    parts = ("epicardium", "rv_endocardium", "left_atrium", "right_atrium")
    apart = sum(volumes_ml(surfaces[name]) for name in parts)
    whole = volumes_ml(surfaces["heart"])
    assert (whole > apart).all()
    assert (whole < 1.2 * apart).all()


def balls(gap_mm: float) -> tuple[Label, Float]:
    """A left ventricle and a right one, both round, a gap apart in the second of two phases."""
    points, first = voxel_centres((54, 30, 30))
    heart = np.zeros((2, *points.shape[:3]), np.uint8)
    for volume, apart in zip(heart, (0.0, gap_mm), strict=True):
        far = np.linalg.norm(points - (18, 0, 0), axis=-1)
        volume[far < 16] = LABELS["lv_myocardium"]
        volume[far < 10] = LABELS["lv_cavity"]
        right = np.linalg.norm(points - (18 - 16 - 14 - apart, 0, 0), axis=-1) < 14
        volume[right] = LABELS["rv_cavity"]
    frame = np.diag([SPACING_MM] * 3 + [1.0])
    frame[:3, 3] = first
    return heart, frame


def test_the_heart_bridges_a_gap_that_opens_in_one_phase():
    """Two faces 4 mm apart are 2 mm from the middle: 8 mm fill 1.4 mm, twice as many 2.8 mm."""
    heart, frame = balls(4.0)
    found = surfaces_of(heart, frame, np.array([0.0, 0.5]), SETTINGS)
    low, high = found["heart"].vertices_mm[1].min(axis=0), found["heart"].vertices_mm[1].max(axis=0)
    assert high[0] - low[0] == pytest.approx(2 * 16 + 2 * 14 + 4, abs=SPACING_MM)
    assert closedness(found["heart"].at(1)).is_solid


def test_a_heart_in_pieces_has_no_outer_surface():
    heart, frame = balls(11.0)
    found = extract(heart, frame, np.array([0.0, 0.5]), SETTINGS)
    assert set(found.surfaces) == {"lv_endocardium", "epicardium", "rv_endocardium"}
    assert re.search(r"pieces in phase 1 .at 0\.500", found.left_out["heart"])


@pytest.mark.parametrize(("apart_mm", "is_told"), [(3.0, False), (9.0, True)])
def test_what_of_its_labels_a_surface_leaves_out_is_told_with_its_phase(apart_mm, is_told):
    """A ball beside the right ventricle in phase 1 holds (8/14)^3, a fifth, of its volume."""
    heart, frame = balls(0.0)
    points, _ = voxel_centres((54, 30, 30))
    middle_mm = 18 - 16 - 2 * 14 - apart_mm - 8
    piece = np.linalg.norm(points - (middle_mm, 0, 0), axis=-1) < 8
    if not is_told:
        piece = np.linalg.norm(points - (middle_mm, 0, 0), axis=-1) < 4
    heart[1][piece] = LABELS["rv_cavity"]
    found = extract(heart, frame, np.array([0.0, 0.5]), SETTINGS)
    piece_ml = np.count_nonzero(piece) * SPACING_MM**3 / 1000
    told = {"rv_endocardium": {1: pytest.approx(piece_ml, abs=0.06)}} if is_told else {}
    assert found.left_out_ml == told


@pytest.mark.parametrize("is_bowl", [False, True])
def test_a_surface_that_lies_beside_labels_that_leap_is_told_with_its_phase(is_bowl):
    """For one phase of eight the cavity, a ball, is a bowl with a wall thinner than two voxels, as
    where a plane near the valve is taken for the atrium for a moment."""
    heart, frame = balls(0.0)
    points, _ = voxel_centres((54, 30, 30))
    heart = np.repeat(heart[:1], 8, axis=0)
    x, y, z = np.moveaxis(points - (18, 0, 0), -1, 0)
    if is_bowl:
        heart[3][(np.hypot(x, z) < 10 - 2.5) & (y > -4) & (x**2 + y**2 + z**2 < 100)] = LABELS[
            "left_atrium"
        ]
    found = extract(heart, frame, np.arange(8) / 8, SETTINGS)
    if not is_bowl:
        assert found.off_mm == {}
        return
    assert list(found.off_mm) == ["lv_endocardium"]
    assert list(found.off_mm["lv_endocardium"]) == [3]
    # Farther than the middle of the bowl's mouth is from its wall nothing can lie.
    assert SPACING_MM < found.off_mm["lv_endocardium"][3] < 7.5


def test_a_slit_between_two_parts_is_plugged_for_the_mesh_too() -> None:
    """Two slabs 4 mm apart, held by two bars, turned two ways: their surface has no tunnel.

    Marching cubes at 2.3 mm does not see plugs of one voxel. A closed surface without tunnels has
    V - F / 2 = 2 vertices and triangles.
    """
    points, _ = voxel_centres((36, 36, 36))
    for turn in Rotation.random(2, random_state=3):
        turned = points @ turn.as_matrix()
        slabs = [box(turned, (side * 10, 0, 0), (8, 18, 14)) for side in (-1, 1)]
        bars = [box(turned, (0, side * 14, 0), (10, 4, 10)) for side in (-1, 1)]
        parts = [
            Body((LevelSet(part.astype(np.float32), SPACING_MM),), (0.0,), (0.0,), np.zeros(3, int))
            for part in (slabs[0], np.minimum.reduce([slabs[1], *bars]))
        ]
        level = joined(parts, np.zeros(1), SurfaceSettings(), map).levels[0]
        surface = extract_surface(level, 2.0)
        assert len(surface.vertices_mm) - len(surface.triangles) / 2 == 2
        assert _without_tunnels(level, 2.0) is level
        # Nothing is added beyond the slabs.
        hull_mm = box(turned, (0, 0, 0), (18, 18, 14))
        assert (hull_mm[level.distance_mm < 0] < SPACING_MM).all()


def one_ventricle(phases: int = 2) -> Label:
    """A small left ventricle, lopsided so that no mirror image of it is the same."""
    points, _ = voxel_centres((24, 24, 24))
    lopsided = points + 0.15 * np.abs(points[..., [1, 2, 0]])
    inner, outer = (np.linalg.norm(lopsided, axis=-1) < radius for radius in (9, 15))
    volume = outer * np.uint8(LABELS["lv_myocardium"])
    volume[inner] = LABELS["lv_cavity"]
    return np.stack([volume] * phases)


VENTRICLE = one_ventricle()
angles = st.tuples(*[st.floats(-3, 3)] * 3)


@settings(max_examples=8)
@given(angles, angles, st.booleans(), st.floats(0.7, 2.5))
def test_surfaces_move_with_the_frame_of_the_grid(turn, place, mirrored, spacing_mm):
    """Oblique or left-handed: vertices are where the frame puts them, and normals point out.

    A spacing scales everything, so the settings in mm are scaled along.
    """
    frame = np.eye(4)
    frame[:3, :3] = spacing_mm * Rotation.from_rotvec(turn).as_matrix()
    if mirrored:
        frame[:3, 2] *= -1
    frame[:3, 3] = 50 * np.array(place)
    phases = np.array([0.0, 0.5])
    scaled = SurfaceSettings(edge_mm=2 * spacing_mm, heart_blend_mm=5 * spacing_mm)
    unit = SurfaceSettings(edge_mm=2.0, heart_blend_mm=5.0)

    found = surfaces_of(VENTRICLE, frame, phases, scaled)

    plain = surfaces_of(VENTRICLE, np.eye(4), phases, unit)
    for name, moving in found.items():
        expected = transform_points(frame, plain[name].vertices_mm)
        # Distances are kept in 32 bits, and settings in mm round: 1e-3 voxels.
        np.testing.assert_allclose(moving.vertices_mm, expected, atol=1e-3 * spacing_mm)
        assert all(closedness(moving.at(k)).is_solid for k in range(2))


def test_a_body_that_touches_the_border_of_the_grid_is_closed():
    """A ball's half at the border: the flat side closes it, with the volume of the voxels."""
    cut = VENTRICLE[:, 17:]
    found = surfaces_of(cut, FRAME, np.array([0.0, 0.5]), SETTINGS)["epicardium"]
    assert closedness(found.at(0)).is_solid
    voxels_ml = np.count_nonzero(cut[0]) * SPACING_MM**3 / 1000
    assert volumes_ml(found)[0] == pytest.approx(voxels_ml, rel=5e-3)


def test_the_same_labels_give_the_same_bytes():
    phases = np.array([0.0, 0.5])
    runs = [surfaces_of(VENTRICLE, FRAME, phases, SETTINGS) for _ in range(2)]
    for name in runs[0]:
        assert runs[0][name].vertices_mm.tobytes() == runs[1][name].vertices_mm.tobytes()


def test_one_phase_is_enough():
    found = surfaces_of(VENTRICLE[:1], FRAME, np.array([0.4]), SETTINGS)
    assert found["lv_endocardium"].vertices_mm.shape[0] == 1


def test_progress_is_told_for_each_structure():
    calls: list[tuple[int, int]] = []
    surfaces_of(VENTRICLE, FRAME, np.array([0.0, 0.5]), SETTINGS, lambda *call: calls.append(call))
    assert calls == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("label", ["lv_cavity", "lv_myocardium"])
def test_a_heart_without_left_ventricle_is_refused(label):
    without = np.where(LABELS[label] == VENTRICLE, np.uint8(0), VENTRICLE)
    with pytest.raises(StageError, match=f"no {label} in any phase"):
        surfaces_of(without, FRAME, np.array([0.0, 0.5]), SETTINGS)


def test_a_structure_that_one_phase_lacks_is_left_out_and_the_phase_named():
    """Where a stack ends at the valves, the atria come into it only while ventricles are short."""
    broken = HEART.copy()
    broken[3][broken[3] == LABELS["right_atrium"]] = 0
    found = extract(broken, FRAME, PHASES, SETTINGS)
    assert set(STRUCTURES) - set(found.surfaces) == {"right_atrium", "aorta"}
    assert "phase 3 (at 0.500 of the beat) 0 voxels" in found.left_out["right_atrium"]
    assert found.left_out["aorta"] == "no phase shows it"
    # What is seen of it still takes part in nothing: the others are as they are without it.
    without = np.where(broken == LABELS["right_atrium"], np.uint8(0), broken)
    others = surfaces_of(without, FRAME, PHASES, SETTINGS)
    for name, moving in found.surfaces.items():
        np.testing.assert_array_equal(moving.vertices_mm, others[name].vertices_mm)


def test_a_structure_without_a_surface_is_left_out_but_the_left_ventricle_is_needed():
    """Of single voxels that touch nothing no body is left to follow."""
    heart = HEART.copy()
    heart[0][heart[0] == LABELS["rv_cavity"]] = 0
    heart[0, 2:12:2, 2:12:2, 2:12:2] = LABELS["rv_cavity"]
    found = extract(heart, FRAME, PHASES, SETTINGS)
    assert "too small for a surface" in found.left_out["rv_endocardium"]
    assert {"left_atrium", "epicardium"} <= set(found.surfaces)

    lost = HEART.copy()
    lost[2][np.isin(lost[2], [LABELS["lv_cavity"], LABELS["lv_myocardium"]])] = 0
    with pytest.raises(StageError, match=r"lv_endocardium: in phase 2 \(at 0\.350"):
        extract(lost, FRAME, PHASES, SETTINGS)


@pytest.mark.parametrize(("least", "is_kept"), [(0.15, False), (0.5, True)])
def test_an_atrium_that_one_phase_shows_a_sliver_of_is_left_out(least: float, is_kept: bool):
    """What a stack shows that ends at the valves: at end-diastole they stand above its last slice.

    The sliver is as thick as makes it hold a given share of the largest phase's voxels.
    """
    cut = HEART.copy()
    atrium = cut == LABELS["left_atrium"]
    counts = atrium.sum(axis=(1, 2, 3))
    low = np.flatnonzero(atrium[0].any(axis=(1, 2)))
    kept = np.cumsum(atrium[0].sum(axis=(1, 2)))
    top = int(np.searchsorted(kept, least * counts.max()))
    cut[0, top:][atrium[0, top:]] = 0
    share = (cut[0] == LABELS["left_atrium"]).sum() / counts.max()
    assert low[0] < top < low[-1]
    assert (share >= 0.2) == is_kept
    found = extract(cut, FRAME, PHASES, SETTINGS)
    assert ("left_atrium" in found.surfaces) == is_kept
    if not is_kept:
        assert "ml in phase 0 (at 0.000 of the beat)" in found.left_out["left_atrium"]
    assert {"right_atrium", "heart"} <= set(found.surfaces)


def test_no_surface_encloses_other_than_its_labels():
    """A ball that leaps by more than its radius from one phase to the next cannot be followed."""
    heart, frame = balls(15.0)
    found = extract(heart, frame, np.array([0.0, 0.5]), SETTINGS)
    assert "its labels 11.4 ml" in found.left_out["rv_endocardium"]
    assert set(found.surfaces) == {"lv_endocardium", "epicardium", "heart"}


def test_what_smoothing_in_time_takes_off_its_labels_is_refused(monkeypatch):
    """Moved by 5 mm, a ball's surface is off by 5 mm times a cosine that is even in [-1, 1]
    (Archimedes): by 4.75 mm or more at a twentieth of it."""

    def moved(path_mm, _phases, _width_beats):
        path_mm[1, :, 0] += 5
        return path_mm

    heart, frame = balls(0.0)
    monkeypatch.setattr(extraction, "smooth_in_time", moved)
    with pytest.raises(StageError, match=r"could not follow to phase 1 .* 4\.\d mm or more"):
        extract(heart, frame, np.array([0.0, 0.5]), SETTINGS)


@pytest.mark.parametrize(
    ("share", "told"), [(1.04, False), (0.96, False), (1.07, True), (0.87, True), (1.17, None)]
)
def test_what_a_surface_encloses_beside_its_labels_is_told_or_refused(share, told):
    ball = pyvista.Icosphere(radius=20, nsub=3)
    triangles = ball.regular_faces
    path = np.stack([ball.points, ball.points * share ** (1 / 3)]).astype(float)
    moving = MovingSurface(path, triangles, np.array([0.0, 0.5]))
    volume_mm3 = moving.at(0).volume_mm3()
    if told is None:
        with pytest.raises(StageError, match=r"encloses 3\d\.\d ml in phase 1 \(at 0.500"):
            _misfit_ml(moving, [volume_mm3, volume_mm3])
        return
    found = _misfit_ml(moving, [volume_mm3, volume_mm3])
    labelled_ml = pytest.approx(volume_mm3 / 1000, abs=0.06)
    enclosed_ml = pytest.approx(share * volume_mm3 / 1000, abs=0.06)
    assert found == ({1: (enclosed_ml, labelled_ml)} if told else {})


def test_specks_of_a_structure_are_no_structure():
    """A few voxels of aorta in all phases are left out rather than made a surface of."""
    specked = VENTRICLE.copy()
    specked[:, 1:3, 1:3, 1:3] = LABELS["aorta"]
    found = surfaces_of(specked, FRAME, np.array([0.0, 0.5]), SETTINGS)
    assert "aorta" not in found


SHEARED = FRAME.copy()
SHEARED[0, 1] = 0.5
FLAT = np.diag([1.5, 1.5, 8.0, 1.0])


@pytest.mark.parametrize(
    ("heart", "frame", "phases", "words"),
    [
        (VENTRICLE[0], FRAME, [0.0, 0.5], r"must be \(phase, z, y, x\) for 2"),
        (VENTRICLE, FRAME, [0.0, 0.3, 0.6], r"for 3 phases, got \(2,"),
        (VENTRICLE, FRAME, [0.5, 0.1], "must rise"),
        (VENTRICLE, FRAME, [0.5, 1.0], "must rise"),
        (VENTRICLE, FRAME[:3], [0.0, 0.5], "4x4"),
        (VENTRICLE, FRAME * np.nan, [0.0, 0.5], "finite"),
        (VENTRICLE, SHEARED, [0.0, 0.5], "right angles"),
        (VENTRICLE, FLAT, [0.0, 0.5], "resample"),
    ],
)
def test_input_that_does_not_fit_is_refused(heart, frame, phases, words):
    with pytest.raises(InputError, match=words):
        surfaces_of(heart, frame, np.array(phases), SETTINGS)


@pytest.mark.parametrize("bad", [{"edge": 2}, {"edge_mm": 0}, {"reference_phase": 1.0}])
def test_unknown_or_senseless_settings_fail(bad):
    with pytest.raises(ValidationError):
        SurfaceSettings.model_validate(bad)


def test_the_nearest_phase_is_sought_around_the_cycle():
    assert nearest_phase(np.array([0.02, 0.5, 0.9]), 0.98) == 0
    assert nearest_phase(np.array([0.02, 0.5, 0.9]), 0.95) == 2
