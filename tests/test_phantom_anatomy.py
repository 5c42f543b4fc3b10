"""The phantom's bodies and tissues: closed, in their right places, without overlap."""

from functools import lru_cache

import numpy as np
import pytest
import pyvista
from scipy.ndimage import binary_dilation, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from data_synth.anatomy import BODY_NAMES, sample_bodies
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.meshes import body_volumes_ml, mesh_volume_ml, reference_meshes
from data_synth.population import draw_heart
from data_synth.thorax import Thorax, chest_points
from data_synth.tissue import Tissue, truth_values

NAMES = {
    "lv_endocardium",
    "epicardium",
    "rv_endocardium",
    "left_atrium",
    "right_atrium",
    "aorta",
    "heart",
}
LABELS_OF = {
    "lv_endocardium": (1,),
    "epicardium": (1, 2),
    "rv_endocardium": (3,),
    "left_atrium": (4,),
    "right_atrium": (5,),
    "aorta": (6,),
}
"""Values in the label files that make up each truth mesh."""
KINDS = ("healthy", "hypertrophic_cardiomyopathy", "infarct", "enlarged_atrium")
VOXEL_MM = 1.5


@lru_cache(maxsize=8)
def drawn(pathology: str) -> BeatingHeart:
    return draw_heart(np.random.default_rng(3), pathology=pathology)


@pytest.fixture(scope="module")
def heart() -> BeatingHeart:
    return drawn("healthy")


@pytest.fixture(scope="module")
def block(heart: BeatingHeart) -> np.ndarray:
    """Tissue of the healthy heart's box in its own frame at the R peak, (x, y, z) voxels."""
    axes = [np.arange(low, high, VOXEL_MM) for low, high in ((-70, 95), (-85, 110), (-115, 110))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    labels = heart.heart_tissue(heart.into_patient(points.reshape(-1, 3)), 0.0)
    return labels.reshape(points.shape[:3])


def pieces(mask: np.ndarray, at_least_ml: float) -> list[np.ndarray]:
    """Connected parts of a mask that hold at least so much."""
    numbered, _ = label(mask, np.ones((3, 3, 3), bool))
    sizes = np.bincount(numbered.ravel())[1:] * VOXEL_MM**3 / 1000
    return [numbered == k + 1 for k in np.flatnonzero(sizes >= at_least_ml)]


def tissue_in_heart_frame(heart: BeatingHeart, points: np.ndarray) -> np.ndarray:
    return heart.tissue(heart.into_patient(np.asarray(points, float)), 0.0)


def exact_mm(points: np.ndarray, mesh: pyvista.PolyData) -> np.ndarray:
    """Signed distance to a mesh by VTK, negative inside."""
    found = pyvista.PolyData(points).compute_implicit_distance(mesh)
    return np.asarray(found.point_data["implicit_distance"])


# The truth meshes.


@pytest.mark.parametrize("pathology", KINDS)
def test_meshes_are_closed_single_and_outward(pathology):
    heart = drawn(pathology)
    surfaces = heart.surfaces(heart.pulse.end_systole)
    assert set(surfaces) == NAMES
    for vertices, triangles in surfaces.values():
        directed = np.concatenate(
            [triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]
        )
        key = directed @ [len(vertices), 1]
        # Every edge is used once in each direction: closed and consistently turned.
        assert len(np.unique(key)) == len(key)
        assert np.isin(directed[:, ::-1] @ [len(vertices), 1], key).all()
        graph = coo_array((np.ones(len(directed)), directed.T), shape=(len(vertices),) * 2)
        assert connected_components(graph)[0] == 1
        # Sphere-like: two more corners and faces than edges.
        assert len(vertices) - len(directed) // 2 + len(triangles) == 2
    assert min(mesh_volume_ml(*mesh) for mesh in surfaces.values()) > 0


def test_meshes_share_triangles_between_phases_and_follow_the_map(heart):
    rest, later = heart.surfaces(0.0), heart.surfaces(0.3)
    for name, (vertices, triangles) in rest.items():
        np.testing.assert_array_equal(triangles, later[name][1])
        np.testing.assert_allclose(heart.carry(vertices, 0.3), later[name][0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("pathology", "phase"),
    [("healthy", 0.0), ("healthy", 0.43), pytest.param("infarct", 0.0, marks=pytest.mark.slow)],
)
def test_mesh_volumes_agree_with_counted_labels_within_one_percent(pathology, phase):
    """Labels and meshes come from one source by two roads: counting and marching cubes."""
    heart = drawn(pathology)
    step, surfaces = 1.25, heart.surfaces(phase)
    corners = np.concatenate([vertices for vertices, _ in surfaces.values()])
    axes = [
        np.arange(low - 0.3, high + step, step)
        for low, high in zip(corners.min(0), corners.max(0), strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = np.bincount(truth_values()[heart.heart_tissue(points, phase)], minlength=7)
    for name, values in LABELS_OF.items():
        # The noise of counting: half a voxel at each of area / step^2 places, so one deviation is
        # step^2 sqrt(area / 12), 0.1 % of the left atrium. Its facets cut off up to 0.85 %.
        counted_ml = counts[list(values)].sum() * step**3 / 1000
        assert mesh_volume_ml(*surfaces[name]) == pytest.approx(counted_ml, rel=0.01), name


def test_coarse_volumes_agree_with_the_meshes(heart):
    """Cut facets take up to 0.85 % off a mesh; the coarse sum adds half a percent of noise."""
    found = body_volumes_ml(heart.shape)
    for name, mesh in reference_meshes(heart.shape).items():
        assert found[name] == pytest.approx(mesh_volume_ml(*mesh), rel=0.015), name


@pytest.mark.parametrize("pathology", KINDS[:2])
def test_values_are_nearly_distances_close_to_the_surfaces(pathology):
    """Against exact distances to the meshes, whose facets lie up to 0.15 mm off the surface."""
    shape, tubes = drawn(pathology).shape, drawn(pathology).tubes
    rng = np.random.default_rng(1)
    for k, name in enumerate(BODY_NAMES):
        vertices, triangles = reference_meshes(shape)[name]
        mesh = pyvista.PolyData.from_regular_faces(vertices, triangles)
        points = vertices[rng.integers(0, len(vertices), 1500)] + rng.normal(0, 2, (1500, 3))
        exact = exact_mm(points, mesh)
        value = np.array([sample_bodies(*p[:, None], shape, tubes)[k, 0, 0, 0] for p in points])
        near = np.abs(exact) < 4
        error = np.abs(value - exact)[near]
        assert error.mean() < 0.15, name
        assert np.percentile(error, 99) < 1.5, name
        assert (np.abs(value) < 1.3 * np.abs(exact) + 0.3)[near].all(), name
        # No point farther from the surface than the facets' sag is on the wrong side.
        assert (np.sign(value) == np.sign(exact))[np.abs(exact) > 0.5].mean() > 0.999, name


# What is inside and around the bodies.


def test_two_papillary_muscles_stand_in_the_left_cavity(heart, block):
    heads = pieces(block == Tissue.PAPILLARY_MUSCLE, 1.0)
    assert len(heads) == 2
    low, length = -115.0, heart.shape.lv_length
    for head in heads:
        z = low + VOXEL_MM * np.argwhere(head)[:, 2]
        # From the lower half, where they join the trabeculae, towards the valve.
        assert z.min() < -0.55 * length
        assert -0.4 * length < z.max() < -0.2 * length
    y = [(-85 + VOXEL_MM * np.argwhere(head)[:, 1]).mean() for head in heads]
    # One to the front, one to the back below.
    assert min(y) < 0 < max(y)


def test_trabeculae_are_apical_and_more_in_the_right_ventricle(heart, block):
    share = {
        name: (block == muscle).sum() / np.isin(block, [muscle, cavity]).sum()
        for name, muscle, cavity in (
            ("left", Tissue.PAPILLARY_MUSCLE, Tissue.LV_CAVITY),
            ("right", Tissue.RV_TRABECULA, Tissue.RV_CAVITY),
        )
    }
    # Papillary muscles and trabeculae are some 5 to 10 % of the left cavity's contents.
    assert 0.02 < share["left"] < 0.12
    assert share["left"] < share["right"] < 0.25
    heights = np.argwhere(block == Tissue.RV_TRABECULA)[:, 2] * VOXEL_MM - 115
    assert np.median(heights) < -0.35 * heart.shape.lv_length


def test_inner_muscles_lie_inside_the_cavities_they_count_to(heart):
    """Every point of theirs is inside the smooth truth mesh, up to the sag of its facets."""
    meshes = reference_meshes(heart.shape)
    rng = np.random.default_rng(2)
    points = rng.uniform((-40, -50, -95), (75, 50, 0), (40000, 3))
    tissue = tissue_in_heart_frame(heart, points)
    for muscle, name in (
        (Tissue.PAPILLARY_MUSCLE, "lv_endocardium"),
        (Tissue.RV_TRABECULA, "rv_endocardium"),
    ):
        mesh = pyvista.PolyData.from_regular_faces(*meshes[name])
        found = points[tissue == muscle]
        assert len(found) > 50
        assert exact_mm(found, mesh).max() < 0.2


def test_leaflets_part_the_chambers(heart):
    """Going up through each valve: ventricle, leaflet, atrium and nothing else."""
    shape = heart.shape
    for x, y, ventricle, atrium in (
        (shape.la_x, shape.la_y + 1, Tissue.LV_CAVITY, Tissue.LEFT_ATRIUM),
        (shape.ra_x, shape.ra_y, Tissue.RV_CAVITY, Tissue.RIGHT_ATRIUM),
    ):
        z = np.arange(-8.0, 8.0, 0.1)
        line = tissue_in_heart_frame(heart, np.column_stack([np.full((len(z), 2), (x, y)), z]))
        steps = line[np.concatenate([[True], line[1:] != line[:-1]])]
        assert steps.tolist() == [ventricle, Tissue.LEAFLET, atrium]


def test_fat_and_pericardium_cover_the_muscle(heart):
    """Outwards from the left free wall: muscle, fat, pericardium, then the chest."""
    shape = heart.shape
    for angle in np.deg2rad([150, 180, 210]):
        r = np.arange(shape.lv_radius, shape.lv_radius + 22, 0.1)
        line = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(len(r), -40.0)])
        tissue = tissue_in_heart_frame(heart, line)
        order = [Tissue.LV_MYOCARDIUM, Tissue.FAT, Tissue.PERICARDIUM]
        first = [int(np.argmax(tissue == kind)) for kind in order]
        assert 0 <= first[0] < first[1] < first[2]
        assert (tissue[first[2] :] != Tissue.LV_MYOCARDIUM).all()


def test_fat_is_thicker_in_the_grooves(heart):
    """Between the ventricles in front, against the middle of the left free wall."""

    def fat_mm(angle: float) -> float:
        r = np.arange(15, 75, 0.1)
        line = np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(len(r), -35.0)])
        tissue = heart.heart_tissue(heart.into_patient(line), 0.0)
        return float((tissue == Tissue.FAT).sum() * 0.1)

    groove = max(fat_mm(angle) for angle in np.deg2rad(np.arange(60, 110, 5)))
    assert groove > 2 * fat_mm(np.deg2rad(180))


def test_four_pulmonary_veins_and_two_caval_veins_join_their_atria(block):
    vessels = block == Tissue.BLOOD_VESSEL
    near_left = binary_dilation(block == Tissue.LEFT_ATRIUM, iterations=2)
    near_right = binary_dilation(block == Tissue.RIGHT_ATRIUM, iterations=2)
    ends = {"left": 0, "right": 0}
    for part in pieces(vessels, 0.4):
        ends["left"] += len(pieces(part & near_left, 0.02))
        ends["right"] += len(pieces(part & near_right, 0.02))
    assert ends == {"left": 4, "right": 2}


def test_pulmonary_trunk_divides_into_two(heart, block):
    """The ends of both branches hang together with the trunk that leaves the right ventricle."""
    tubes = heart.tubes
    trunk = [
        part
        for part in pieces(block == Tissue.BLOOD_VESSEL, 1.0)
        if (part & binary_dilation(block == Tissue.RV_CAVITY, iterations=2)).any()
    ]
    assert len(trunk) == 1
    for branch in (tubes.left_branch, tubes.right_branch):
        at = np.round((branch[-2, :3] - (-70, -85, -115)) / VOXEL_MM).astype(int)
        assert trunk[0][tuple(at)]


def test_aortic_root_bulges_into_three_sinuses(heart):
    """Across the root: as wide as drawn at the sinuses, narrower above, three lobes."""
    middle = heart.tubes.sinuses[:, :3].mean(axis=0)
    spread = heart.tubes.sinuses[:, :3] - middle
    axis = np.cross(spread[0], spread[1])
    axis /= np.linalg.norm(axis) * np.sign(axis[2])
    side = np.cross(axis, (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    angles, r = np.arange(0, 2 * np.pi, 0.05), np.arange(0, 25, 0.1)

    def radii(up_mm: float) -> np.ndarray:
        ways = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
        points = middle + up_mm * axis + r[None, :, None] * ways[:, None]
        inside = tissue_in_heart_frame(heart, points.reshape(-1, 3)) == Tissue.AORTA
        return inside.reshape(len(angles), len(r)).sum(axis=1) * 0.1

    sinuses, above = radii(0.0), radii(18.0)
    assert sinuses.max() == pytest.approx(heart.shape.sinus_radius, abs=0.8)
    assert 2 * above.mean() < 2 * heart.shape.sinus_radius - 3
    assert np.argmax(np.abs(np.fft.rfft(sinuses - sinuses.mean()))) == 3


def test_scar_takes_the_infarcted_segment_only():
    heart = drawn("infarct")
    shape = heart.shape
    rng = np.random.default_rng(5)
    points = rng.uniform((-40, -40, -95), (40, 40, 0), (60000, 3))
    tissue = tissue_in_heart_frame(heart, points)
    scar = points[tissue == Tissue.SCAR]
    assert len(scar) > 200
    turned = np.angle(np.exp(1j * (np.arctan2(scar[:, 1], scar[:, 0]) - shape.scar_angle)))
    assert np.abs(turned).max() < shape.scar_half_angle
    assert np.abs(scar[:, 2] / shape.lv_length + shape.scar_height).max() < shape.scar_half_height
    # Counted as muscle.
    assert truth_values()[Tissue.SCAR] == truth_values()[Tissue.LV_MYOCARDIUM]


def test_heart_lies_as_in_a_patient(heart):
    """LPS: x to the left, y to the back, z to the head."""
    volumes = {name: mesh[0].mean(axis=0) for name, mesh in heart.surfaces(0.0).items()}
    lv, rv = volumes["lv_endocardium"], volumes["rv_endocardium"]
    la, ra, aorta = volumes["left_atrium"], volumes["right_atrium"], volumes["aorta"]
    apex_way = -heart.long_axis
    assert apex_way[0] > 0.3
    assert apex_way[1] < -0.2
    assert apex_way[2] < -0.2
    assert rv[0] < lv[0]
    assert rv[1] < lv[1]
    assert la[1] > max(lv[1], rv[1])
    assert ra[0] < la[0]
    assert aorta[2] > max(la[2], ra[2], lv[2], rv[2])


def test_tissue_travels_with_the_map(heart):
    points = heart.centre_mm + np.random.default_rng(0).uniform(-90, 90, (20000, 3))
    rest = heart.heart_tissue(points, 0.0)
    inside = rest > 0
    moved = heart.carry(points[inside], 0.36)
    # Rounding may flip points within 1e-9 mm of a border: none of these.
    np.testing.assert_array_equal(heart.heart_tissue(moved, 0.36), rest[inside])


def test_the_envelope_misses_no_point_of_the_heart(heart):
    """Points of every structure stay in it at phases between those it was made from."""
    meshes = heart.surfaces(0.0)
    for phase in np.linspace(0.03, 0.97, 12):
        for vertices, _ in meshes.values():
            assert heart.near_heart(heart.carry(vertices, phase)).all()


# The chest.


@pytest.mark.parametrize(
    ("point", "tissue"),
    [
        ((400, 0, 0), Tissue.AIR),
        ((168, 0, 0), Tissue.FAT),
        ((110, 10, 30), Tissue.LUNG),
        ((-110, 10, 30), Tissue.LUNG),
        ((-90, 0, -120), Tissue.LIVER),
        ((74, 10, -118), Tissue.STOMACH),
        ((74, -34, -118), Tissue.GAS),
        ((104, 42, -110), Tissue.SPLEEN),
        ((0, 68, 0), Tissue.BONE),
        ((0, -98, 20), Tissue.BONE),
        ((27, 51, -30), Tissue.BLOOD_VESSEL),
        ((10, 24, 119), Tissue.BLOOD_VESSEL),
    ],
)
def test_chest_organs_lie_where_they_should(point, tissue):
    """Skin, lungs, organs under the diaphragm, spine, breast bone, aorta and its arch."""
    assert chest_points(np.array([point], float), Thorax())[0] == tissue


def rib_bone(y: float, z: np.ndarray) -> np.ndarray:
    """Whether a rib is met anywhere through the wall at the right side, at each height."""
    x = np.arange(-152, -132, 0.5)
    points = np.stack(np.broadcast_arrays(x, y, z[:, None]), axis=-1).reshape(-1, 3)
    found = chest_points(points, Thorax()).reshape(len(z), len(x))
    return np.asarray((found == Tissue.BONE).any(axis=1))


def test_ribs_are_bars_with_muscle_between():
    """Ten in 270 mm, 13 mm tall."""
    z = np.arange(-135, 135, 0.25)
    bone = rib_bone(0.0, z)
    starts = np.flatnonzero(bone[1:] & ~bone[:-1])
    np.testing.assert_allclose(np.diff(z[starts]), 27, atol=0.3)
    assert bone.mean() == pytest.approx(13 / 27, abs=0.03)


def test_ribs_fall_from_the_back_to_the_front():
    z = np.arange(-135, 135, 0.25)
    wave = np.exp(2j * np.pi * z / 27)
    front, back = (np.angle((rib_bone(y, z) * wave).sum()) for y in (-10, 10))
    rise_mm = np.angle(np.exp(1j * (back - front))) * 27 / (2 * np.pi)
    assert rise_mm == pytest.approx(20 * 0.45, abs=1.0)


def test_vertebrae_and_discs_take_turns():
    z = np.arange(-99, 99, 0.5)
    line = np.column_stack([np.zeros(len(z)), np.full(len(z), 64.0), z])
    bone = chest_points(line, Thorax()) == Tissue.BONE
    assert (bone[1:] & ~bone[:-1]).sum() == 6
    assert bone.mean() == pytest.approx(25 / 33, abs=0.03)


def test_points_of_the_wrong_shape_are_refused(heart):
    with pytest.raises(SynthError, match=r"\(n, 3\)"):
        heart.tissue(np.zeros(3), 0.0)
