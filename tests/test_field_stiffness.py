"""How fast the force changes with place: the law's rates, and those of a field, on known shapes."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from field_random import described
from field_shapes import torus_distance
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pipeline.field import Fixture, ForceField
from pipeline.field.certificate import rate_bound_n_per_mm, spline_limits
from pipeline.field.spline import space_coefficients
from pipeline.field.stiffness import field_rates_n_per_m
from pipeline.field.store import FieldWriter
from pipeline.geometry import Float, Grid

RADIUS_MM = 12.0
MAJOR_MM, MINOR_MM = 14.0, 5.0
SPACING_MM = 1.0


def ball(points_mm: Float) -> Float:
    return np.linalg.norm(points_mm, axis=-1) - RADIUS_MM


def slab(points_mm: Float) -> Float:
    """Between two planes; its medial axis is the plane halfway."""
    return np.abs(points_mm @ np.array([2.0, 1.0, 2.0]) / 3) - RADIUS_MM


def ring(points_mm: Float) -> Float:
    return torus_distance(points_mm, MAJOR_MM, MINOR_MM)


def curvature_of_ball(points_mm: Float) -> Float:
    """Of the level surfaces of the distance: both 1 over the distance from the middle."""
    return np.repeat(1 / np.linalg.norm(points_mm, axis=1)[:, None], 2, axis=1)


def curvature_of_slab(points_mm: Float) -> Float:
    return np.zeros((len(points_mm), 2))


def curvature_of_ring(points_mm: Float) -> Float:
    """Around the tube, and about the axis (do Carmo, Differential Geometry of Curves and Surfaces,
    section 3-3): cos v / (major + r cos v) at r from the circle in the middle of the tube."""
    about = np.hypot(points_mm[:, 0], points_mm[:, 1])
    tube = np.hypot(about - MAJOR_MM, points_mm[:, 2])
    return np.column_stack([1 / tube, (about - MAJOR_MM) / tube / about])


def law_rates_n_per_m(fixture: Fixture, q_mm: Float, curvature_per_mm: Float) -> Float:
    """Along the force, then across it, of the law on a perfect distance, ``(n, 3)``.

    The formula of `pipeline.field.stiffness`; curvatures of the level surface of q are positive
    where it bulges towards larger q. Positive holds, negative drives apart.
    """
    delta_mm, m, most_n = fixture.resolved_delta_mm, fixture.m, fixture.f_max_n
    power = (q_mm**2 / (2 * delta_mm**2)) ** m
    slope = 2 * m / q_mm * power * np.exp(-power)
    across = -np.expm1(-power)[:, None] * curvature_per_mm
    return 1000 * most_n * np.column_stack([slope, across])


SHAPES = {
    "ball": (ball, curvature_of_ball),
    "slab": (slab, curvature_of_slab),
    "ring": (ring, curvature_of_ring),
}


def law(m: int, delta_mm: float = 5.0) -> Fixture:
    return Fixture(
        structure="s", kind="guidance", delta_mm=delta_mm, m=m, f_max_n=2.0, device="omega7"
    )


def potential_by_hand(q_mm: Float, fixture: Fixture) -> Float:
    """The formula of the fixture, written out once more."""
    return 1 - np.exp(-((q_mm**2 / (2 * fixture.resolved_delta_mm**2)) ** fixture.m))


def gradient(distance, points_mm: Float, step_mm: float) -> Float:
    ways = step_mm * np.eye(3)
    pairs = [(distance(points_mm + way), distance(points_mm - way)) for way in ways]
    return np.column_stack([(ahead - behind) / (2 * step_mm) for ahead, behind in pairs])


def forces(distance, points_mm: Float, fixture: Fixture) -> Float:
    """-f_max f(q) grad q of a guidance, q the distance without its sign, by differences."""
    d_mm = distance(points_mm)
    height = potential_by_hand(np.abs(d_mm), fixture) * np.sign(d_mm)
    return -fixture.f_max_n * height[:, None] * gradient(distance, points_mm, 1e-3)


def places(distance, curvature, rng: np.random.Generator, count: int) -> Float:
    """Random places a millimetre and more from the surface and from the medial axis."""
    points_mm = rng.uniform(-18, 18, (count, 3))
    points_mm = points_mm[np.abs(distance(points_mm)) > 1]
    points_mm = points_mm[np.abs(curvature(points_mm)).max(axis=1) < 1]
    # Where two parts are equally near the differences do not give a gradient 1 long.
    length = np.linalg.norm(gradient(distance, points_mm, 0.5), axis=1)
    return points_mm[length > 0.98]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_laws_rates_are_the_derivative_of_the_force(shape, m):
    """Truth: differences of the force in closed form, which know neither slope nor curvature."""
    distance, curvature = SHAPES[shape]
    fixture = law(m)
    points_mm = places(distance, curvature, np.random.default_rng(m), 2000)
    assert len(points_mm) > 500
    step_mm = 1e-2
    derivative = np.empty((len(points_mm), 3, 3))
    for axis, way in enumerate(step_mm * np.eye(3)):
        ahead = forces(distance, points_mm + way, fixture)
        derivative[:, :, axis] = ahead - forces(distance, points_mm - way, fixture)
    stiffness = -1000 * derivative / (2 * step_mm)
    found = np.linalg.eigvalsh((stiffness + stiffness.transpose(0, 2, 1)) / 2)

    d_mm = distance(points_mm)
    signed = curvature(points_mm) * np.sign(d_mm)[:, None]
    stated = np.sort(law_rates_n_per_m(fixture, np.abs(d_mm), signed), axis=1)
    # Central differences err by step^2 / 6 times the third derivative. The fastest scale is 1 mm
    # from an axis, where 1 / r has the third derivative 6 / r^4: 2000 N/m * step^2 = 0.2 N/m;
    # the potential's is slower. Rounding: 20 mm * 2^-52 / 1e-3 / 1e-2 * 2000 = 1e-6.
    np.testing.assert_allclose(found, stated, atol=0.4)


@given(
    m=st.integers(1, 12),
    q_mm=st.floats(1e-3, 60),
    bulge_mm=st.floats(0, 200),
    hollow_mm=st.floats(1e-3, 200),
)
def test_nothing_holds_more_than_the_law_says(m, q_mm, bulge_mm, hollow_mm):
    """The level surface's radius is that of the surface, an edge's 0, and the depth; where it is
    hollow the force drives apart."""
    fixture = law(m)
    curvature = np.array([[1 / (bulge_mm + q_mm), -1 / hollow_mm]])
    along, bulging, hollow = law_rates_n_per_m(fixture, np.array([q_mm]), curvature)[0]
    most = fixture.stiffness_n_per_m * (1 + 1e-9)
    assert max(along, bulging) <= most
    assert hollow <= 0
    assert -hollow <= 1000 * fixture.f_max_n / hollow_mm * (1 + 1e-9)


def write_field(path, distance, fixture: Fixture) -> ForceField:
    """A field whose stored distances are those of the closed form."""
    count = int(48 / SPACING_MM) + 1
    grid = Grid((count,) * 3, (-24.0,) * 3, (SPACING_MM,) * 3)
    about = described(grid, np.zeros(1), fixture)
    writer = FieldWriter(path, about)
    values_mm = distance(grid.nodes_mm())
    writer.write("distance/s", 0, values_mm.astype(np.float32))
    writer.write("potential/f", 0, potential_by_hand(values_mm, fixture).astype(np.float32))
    writer.write("spline/s", 0, space_coefficients(values_mm).astype(np.float32))
    writer.finish(about)
    return ForceField.open(path)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_field_has_the_laws_rates_away_from_the_medial_axis(tmp_path, shape):
    distance, curvature = SHAPES[shape]
    fixture = law(2)
    field = write_field(tmp_path / "f.zarr", distance, fixture)
    points_mm = places(distance, curvature, np.random.default_rng(5), 20_000)
    far = np.abs(curvature(points_mm)).max(axis=1) < 1 / (4 * SPACING_MM)
    # A node's coefficient knows of a kink k nodes away by (sqrt(8) - 3)^k: 1e-3 at 4.
    reach_mm = 5.5 * SPACING_MM * math.sqrt(3)
    for way in reach_mm * np.concatenate([np.eye(3), -np.eye(3)]):
        length = np.linalg.norm(gradient(distance, points_mm + way / 2, reach_mm / 2), axis=1)
        far &= length > 0.7
    points_mm = points_mm[far]
    assert len(points_mm) > 1000
    d_mm = distance(points_mm)
    bent = curvature(points_mm)
    stated = np.sort(
        law_rates_n_per_m(fixture, np.abs(d_mm), bent * np.sign(d_mm)[:, None]), axis=1
    )
    found = field_rates_n_per_m(field, points_mm, np.zeros(1), "f")
    # In a cell the spline's second derivative is a constant, off by up to half a spacing times the
    # third, on each of three axes. That of a distance is 3 cos t sin^2 t / r^2 along a way at an
    # angle t to it, 2 / sqrt(3) / r^2 at most, for either curvature; where both are 0, only the
    # rounding of float32 is left: 20 mm * 2^-24 * 4 / spacing^2 = 5e-6 of 2000 N/m, and a kink's
    # 1e-3 of 4 / spacing.
    third = 2 / math.sqrt(3) * np.square(bent).sum(axis=1)
    allowed = 1000 * fixture.f_max_n * (1.5 * SPACING_MM * third + 4e-3 / SPACING_MM)
    off = np.abs(found - stated).max(axis=1)
    assert (off <= allowed).all()
    assert np.median(off) < np.median(allowed) / 10


@pytest.mark.parametrize("shape", SHAPES)
def test_about_the_medial_axis_a_field_keeps_to_its_bound(tmp_path, shape):
    distance, _ = SHAPES[shape]
    fixture = law(2)
    field = write_field(tmp_path / "f.zarr", distance, fixture)
    points_mm = np.random.default_rng(6).uniform(-18, 18, (100_000, 3))
    found = field_rates_n_per_m(field, points_mm, np.zeros(1), "f")
    bound = 1000 * rate_bound_n_per_mm(fixture, *spline_limits(field, "s"))
    # It drives apart faster than any spring of the law holds.
    assert bound / 8 < -found.min() <= bound
    assert found.max() <= bound


def points_in_space(points_mm: Float) -> Float:
    """The distance from 600 random points: medial axes as near to each other as nodes are."""
    middles_mm = np.random.default_rng(7).uniform(-24, 24, (600, 3))
    return np.asarray(cKDTree(middles_mm).query(points_mm)[0]) - 1


def comb(points_mm: Float) -> Float:
    """Plates 3 mm apart, aslant."""
    return np.abs((points_mm.sum(axis=-1) / math.sqrt(3)) % 3 - 1.5) - 0.75


def checkerboard(points_mm: Float) -> Float:
    """Half a spacing more or less from node to node: no distance changes faster between nodes."""
    odd = np.round((points_mm + 24) / SPACING_MM).sum(axis=-1) % 2
    return (odd - 0.5) * SPACING_MM


@pytest.mark.parametrize("distance", [ball, slab, ring, comb, points_in_space, checkerboard])
def test_nowhere_does_a_force_change_faster_than_stated(tmp_path, distance):
    """In any direction, where medial axes lie near each other, too."""
    fixture = law(1, delta_mm=0.5)
    field = write_field(tmp_path / "f.zarr", distance, fixture)
    longest, turning_per_mm = spline_limits(field, "s")
    step_mm = 1e-3
    rng = np.random.default_rng(8)
    here = rng.uniform(-22, 22, (200_000, 3))
    way = rng.normal(size=here.shape)
    there = here + step_mm * way / np.linalg.norm(way, axis=1, keepdims=True)
    gradient = field.gradient(here, 0.0)
    turned_per_mm = np.linalg.norm(field.gradient(there, 0.0) - gradient, axis=1) / step_mm
    assert np.linalg.norm(gradient, axis=1).max() <= longest
    # The largest of each derivative, wherever it is, and of random places and ways the best met.
    assert turning_per_mm / (8 if distance is checkerboard else 4) < turned_per_mm.max()
    assert turned_per_mm.max() <= turning_per_mm
    change_n = np.linalg.norm(field.force_n(there, 0.0) - field.force_n(here, 0.0), axis=1)
    assert 0.1 < change_n.max() / step_mm <= rate_bound_n_per_mm(fixture, longest, turning_per_mm)


def test_differences_that_single_precision_rounds_are_within_the_limits(tmp_path):
    """Of numbers of unlike size, whose differences have more digits than a float32."""
    field = write_field(tmp_path / "f.zarr", points_in_space, law(1, delta_mm=0.5))
    shape, rng = field.grid.shape, np.random.default_rng(9)
    for _ in range(20):
        # A float64 holds them, and all their differences.
        values = np.zeros(shape, np.float32)
        values[:2, :2, :2] = rng.normal(size=(2, 2, 2)) * 10 ** rng.uniform(-3, 1, (2, 2, 2))
        values[2:] = values[1]
        values[:, 2:] = values[:, 1:2]
        values[:, :, 2:] = values[:, :, 1:2]
        fake = SimpleNamespace(
            phases=[0.0], grid=field.grid, stored_coefficients=lambda *_, values=values: values
        )
        longest, turning_per_mm = spline_limits(fake, "s")
        exact = values.astype(np.float64)
        steps = [np.diff(exact, axis=2 - axis) for axis in range(3)]
        length = math.hypot(*(np.abs(one).max() for one in steps)) / SPACING_MM
        bent = [[np.abs(np.diff(a, axis=2 - b)).max() for b in range(3)] for a in steps]
        turning = np.linalg.eigvalsh(np.array(bent))[-1] / SPACING_MM**2
        assert length <= longest <= length * (1 + 1e-6)
        assert turning <= turning_per_mm <= turning * (1 + 1e-5)


def test_the_stated_rate_is_that_of_the_coefficients(tmp_path):
    """Truth: the quadratic spline doubles, along each axis, what changes sign from node to node
    (Unser 1999), so the coefficients of a checkerboard are 8 times half a spacing, of either sign.
    """
    field = write_field(tmp_path / "f.zarr", checkerboard, law(2))
    longest, turning_per_mm = spline_limits(field, "s")
    assert longest == pytest.approx(math.sqrt(3) * 8)
    assert turning_per_mm == pytest.approx(3 * 16 / SPACING_MM)
    assert rate_bound_n_per_mm(law(2), 1.5, 4.0) == pytest.approx(
        2 * 2.0 * 4.0 + 1.5 * law(2).stiffness_n_per_m / 1000
    )
