"""Distances against closed forms, VTK and brute force; signs where they are hard."""

import numpy as np
import pytest
from field_shapes import (
    BOX_TRIANGLES,
    box,
    box_distance,
    joined,
    lumpy,
    moved,
    sag,
    sphere,
    torus,
    torus_distance,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pipeline.errors import InputError
from pipeline.exact import ExactSurface
from pipeline.field.distance import distance_of_closed, require_closed
from pipeline.field.triangle_tree import plant
from pipeline.geometry import Float, Grid, Integer, Surface

EPSILON = float(np.finfo(np.float32).eps)


def cube_grid(half_mm: float, count: int) -> Grid:
    """Nodes of a cube about the origin; spacings differ a little, as a grid's may."""
    shape = (count, count + 1, count + 2)
    spacing = tuple(2 * half_mm / (n - 1) for n in shape[::-1])
    return Grid(shape, (-half_mm,) * 3, spacing)


def rounding(distance: Float) -> float:
    """Storing as float32 rounds by half a unit in the last place; twice that is allowed."""
    return EPSILON * float(np.abs(distance).max())


@pytest.mark.parametrize("level", [1, 2, 4])
def test_sphere_is_exact_to_its_facets(level):
    surface, grid = sphere(25.0, level, centre=(3, -2, 1)), cube_grid(40, 17)
    exact = np.linalg.norm(grid.nodes_mm() - (3, -2, 1), axis=-1) - 25

    error = distance_of_closed(surface, grid) - exact

    # An inscribed body: never nearer from outside, never deeper inside.
    assert error.min() >= -rounding(exact)
    assert error.max() <= sag(surface, 25.0) + rounding(exact)


def test_torus_is_exact_to_its_facets():
    surface, grid = torus(20, 8, 90, 60), cube_grid(32, 24)
    exact = torus_distance(grid.nodes_mm(), 20, 8)

    error = distance_of_closed(surface, grid) - exact

    assert np.abs(error).max() <= sag(surface, 8) + rounding(exact)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((-10, -8, -6), (11, 9, 7)),
        ((-10, -8, -0.25), (11, 9, 0.25)),  # a wall of half a millimetre
        ((-10.1, -8.3, -6.7), (10.9, 0.7, 0.3)),
    ],
)
def test_box_is_exact(low, high):
    grid = cube_grid(14, 41)
    exact = box_distance(grid.nodes_mm(), low, high)

    found = distance_of_closed(box(low, high), grid)

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))
    clear = np.abs(exact) > 1e-6
    assert (np.signbit(found) == np.signbit(exact))[clear].all()


def test_nodes_on_corners_edges_and_faces_are_exact():
    """Rays through edges and corners hit two triangles or more at once, or just touch."""
    grid = Grid((13, 13, 13), (-6.0, -6.0, -6.0), (1.0, 1.0, 1.0))
    exact = box_distance(grid.nodes_mm(), (-4, -3, -2), (2, 3, 5))

    found = distance_of_closed(box((-4, -3, -2), (2, 3, 5)), grid)

    # Whole numbers and their square roots, in double precision until they are stored.
    np.testing.assert_allclose(found, exact, rtol=EPSILON, atol=1e-14)


@pytest.mark.parametrize("gap", [0.0, 1e-9, 0.01, 0.5])
def test_nearly_touching_sheets_keep_their_signs(gap):
    """Two bodies with a slit: the distance is that to the nearer, the sign that of either."""
    left, right = ((-9, -7, -5), (-gap / 2, 7, 5)), ((gap / 2, -7, -5), (9, 7, 5))
    grid = cube_grid(11, 29)
    each = np.stack([box_distance(grid.nodes_mm(), *one) for one in (left, right)])
    exact = np.where((each < 0).any(axis=0), -1, 1) * np.abs(each).min(axis=0)

    found = distance_of_closed(joined(box(*left), box(*right)), grid)

    np.testing.assert_allclose(np.abs(found), np.abs(exact), rtol=0, atol=rounding(exact))
    clear = np.abs(exact) > 1e-6
    assert (np.signbit(found) == np.signbit(exact))[clear].all()


def test_overlapping_bodies_are_inside_as_one():
    one, two = ((-9, -7, -5), (2, 7, 5)), ((-2, -6, -4), (9, 6, 4))
    grid = cube_grid(11, 23)
    each = np.stack([box_distance(grid.nodes_mm(), *body) for body in (one, two)])

    found = distance_of_closed(joined(box(*one), box(*two)), grid)

    clear = np.abs(each).min(axis=0) > 1e-6
    assert ((found < 0) == (each < 0).any(axis=0))[clear].all()


def test_triangles_without_area_change_nothing():
    """A corner in the middle of an edge, filled with a triangle that is a line."""
    low, high = (-6, -5, -4), (6, 5, 4)
    whole = box(low, high)
    middle = 0.5 * (whole.vertices_mm[0] + whole.vertices_mm[1])
    edge_owner = next(k for k, t in enumerate(BOX_TRIANGLES) if list(t) == [0, 2, 1])
    split = np.array([[0, 2, 8], [8, 2, 1], [0, 8, 1]])
    triangles = np.concatenate([np.delete(BOX_TRIANGLES, edge_owner, axis=0), split])
    grid = cube_grid(9, 25)

    found = distance_of_closed(Surface(np.vstack([whole.vertices_mm, middle]), triangles), grid)

    np.testing.assert_array_equal(found, distance_of_closed(whole, grid))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_agrees_with_vtk(seed):
    surface, grid = lumpy(seed), cube_grid(40, 16)
    exact = ExactSurface(surface).distance_mm(grid.nodes_mm().reshape(-1, 3)).reshape(grid.shape)

    found = distance_of_closed(surface, grid)

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


def test_agrees_with_brute_force():
    """All triangles by projection and their edges by clamping; the sign by solid angles."""
    turn = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    surface = joined(
        moved(torus(9, 3, 12, 8), turn, np.zeros(3)),
        moved(box((-3, -2, -6), (2, 3, 7)), turn.T, np.array([15.0, 1, 2])),
    )
    grid = cube_grid(22, 11)
    points = grid.nodes_mm().reshape(-1, 3)

    found = distance_of_closed(surface, grid).ravel()

    exact = brute_distance(points, surface)
    np.testing.assert_allclose(np.abs(found), exact, rtol=0, atol=rounding(exact))
    assert ((found < 0) == (winding_number(points, surface) > 0.5)).all()


def brute_distance(points: Float, surface: Surface) -> Float:
    """Distance to the nearest triangle: its plane where the foot is inside, else its edges."""
    best = np.full(len(points), np.inf)
    for corners in surface.vertices_mm[surface.triangles]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        height = (points - corners[0]) @ normal / np.linalg.norm(normal)
        within = np.ones(len(points), dtype=bool)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            within &= (points - a) @ np.cross(normal, b - a) >= 0
            t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - a - t[:, None] * (b - a), axis=1))
        best = np.where(within, np.minimum(best, np.abs(height)), best)
    return best


def winding_number(points: Float, surface: Surface) -> Float:
    """Sum of the triangles' solid angles over 4 pi (van Oosterom and Strackee 1983)."""
    total = np.zeros(len(points))
    for corners in surface.vertices_mm[surface.triangles]:
        a, b, c = (corner - points for corner in corners)
        la, lb, lc = (np.linalg.norm(one, axis=1) for one in (a, b, c))
        triple = np.einsum("ij,ij->i", a, np.cross(b, c))
        dots = (
            np.einsum("ij,ij->i", a, b) * lc
            + np.einsum("ij,ij->i", b, c) * la
            + np.einsum("ij,ij->i", c, a) * lb
        )
        total += 2 * np.arctan2(triple, la * lb * lc + dots)
    return total / (4 * np.pi)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 1000),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-300, 300)] * 3),
)
def test_moving_surface_and_points_together_changes_nothing(seed, turn, shift):
    surface, rotation = lumpy(seed, level=2), Rotation.from_rotvec(turn).as_matrix()
    around = cube_grid(32, 9)
    origin = tuple(np.add(around.origin_mm, shift))
    grid = Grid(around.shape, origin, around.spacing_mm)
    carried_back = (grid.nodes_mm().reshape(-1, 3) - shift) @ rotation
    exact = ExactSurface(surface).distance_mm(carried_back).reshape(grid.shape)

    found = distance_of_closed(moved(surface, rotation, np.array(shift)), grid)

    # Rounding of coordinates of up to 400 mm is far below that of the stored distance.
    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_threads_and_repeats_give_the_same_bytes(threads):
    surface, grid = lumpy(5), cube_grid(35, 40)

    alone = distance_of_closed(surface, grid, threads=1)

    assert distance_of_closed(surface, grid, threads=threads).tobytes() == alone.tobytes()


def test_a_tree_planted_by_many_threads_is_the_same():
    surface = lumpy(5, level=6)
    # Some without area, in every thread's share, which leave gaps that are closed.
    flat = surface.triangles[::50][:, [0, 0, 1]]
    triangles = np.concatenate([surface.triangles, flat])
    around_mm = np.array([[-50.0] * 3, [50.0] * 3])

    alone = plant(surface.vertices_mm, triangles, around_mm, threads=1)

    assert len(alone.triangles) == len(surface.triangles)
    for threads in (2, 3, 7):
        shared = plant(surface.vertices_mm, triangles, around_mm, threads)
        assert all(
            one.tobytes() == other.tobytes() for one, other in zip(alone, shared, strict=True)
        )


def some_nodes(grid: Grid, count: int, seed: int = 0) -> Integer:
    """Numbers of nodes drawn at random: exact libraries are too slow for all of them."""
    return np.random.default_rng(seed).choice(int(np.prod(grid.shape)), count, replace=False)


@pytest.mark.parametrize(
    "spacing", [(1.0, 1.0, 1.0), (0.4, 1.1, 2.7), (3.1, 0.7, 0.3), (2.5, 3.0, 2.8)]
)
def test_many_small_triangles_agree_with_vtk(spacing):
    """More nodes than one block has, and boxes of triangles on several levels; at last a grid so
    coarse that the smallest blocks hold no single triangles."""
    shape = tuple(int(np.ceil(52 / step)) for step in spacing[::-1])
    surface = lumpy(11, level=5, radius=15.0)
    grid = Grid(shape, (-26.0, -25.5, -25.2), spacing)
    some = some_nodes(grid, 1500)
    exact = ExactSurface(surface).distance_mm(grid.nodes_mm().reshape(-1, 3)[some])

    found = distance_of_closed(surface, grid).ravel()[some]

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


def test_wall_of_half_a_millimetre_keeps_its_sign_and_distance():
    """Each skin alone is asked of VTK; a node in the wall is within one and outside the other."""
    outer, inner = sphere(20.0, 4), sphere(19.5, 4)
    wall = joined(outer, Surface(inner.vertices_mm, inner.triangles[:, ::-1]))
    grid = cube_grid(23, 41)
    points = grid.nodes_mm().reshape(-1, 3)
    radius = np.linalg.norm(points, axis=1)
    # All nodes about the wall, and some of the others.
    some = np.union1d(np.flatnonzero(np.abs(radius - 19.75) < 0.5), some_nodes(grid, 1000))
    in_outer, in_inner = (ExactSurface(one).distance_mm(points[some]) for one in (outer, inner))
    exact = np.maximum(in_outer, -in_inner)

    found = distance_of_closed(wall, grid).ravel()[some]

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(radius))
    assert (exact < 0).sum() > 100
    assert (np.signbit(found) == (exact < 0)).all()


def test_nodes_as_far_from_everything_find_the_nearest():
    """About the middle of a ball all 20,480 triangles are within a hair of the nearest."""
    surface, grid = sphere(25.0, 5), Grid((6, 7, 8), (-0.03, -0.02, -0.05), (0.01, 0.01, 0.01))
    exact = ExactSurface(surface).distance_mm(grid.nodes_mm().reshape(-1, 3)).reshape(grid.shape)

    found = distance_of_closed(surface, grid)

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


def test_surface_wholly_outside_the_grid():
    surface, grid = lumpy(2), Grid((9, 8, 7), (200.0, -350.0, 90.0), (1.0, 2.0, 0.5))
    exact = ExactSurface(surface).distance_mm(grid.nodes_mm().reshape(-1, 3)).reshape(grid.shape)

    found = distance_of_closed(surface, grid)

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


@pytest.mark.parametrize("sliver", [1e-3, 1e-7, 1e-12, 1e-15])
def test_slivers_are_exact(sliver):
    """A face of a box is cut into needles by a corner that all but lies on its edge."""
    low, high = (-6, -5, -4), (6, 5, 4)
    whole = box(low, high)
    near = 0.4 * whole.vertices_mm[0] + 0.6 * whole.vertices_mm[1] + (0, sliver, 0)
    kept = [list(t) for t in BOX_TRIANGLES if list(t) != [0, 2, 1]]
    surface = Surface(
        np.vstack([whole.vertices_mm, near]), np.array([*kept, [0, 2, 8], [8, 2, 1], [0, 8, 1]])
    )
    grid = cube_grid(9, 25)

    found = distance_of_closed(surface, grid)

    # Half a unit in the last place of the coordinates is all that may change.
    np.testing.assert_allclose(found, distance_of_closed(whole, grid), rtol=EPSILON, atol=1e-14)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    corners=st.integers(4, 24),
    sizes=st.tuples(*[st.floats(0.02, 20)] * 3),
    spacing=st.tuples(*[st.floats(0.3, 5)] * 3),
)
def test_random_polyhedra_agree_with_brute_force(seed, corners, sizes, spacing):
    """Two convex bodies, which may overlap, be flat, or be far larger than the grid."""
    rng = np.random.default_rng(seed)
    surface = joined(*(hull(rng.normal(size=(corners, 3)) * sizes) for _ in range(2)))
    grid = Grid((6, 7, 8), tuple(-3.3 * np.array(spacing)), spacing)
    points = grid.nodes_mm().reshape(-1, 3)
    exact, winding = brute_distance(points, surface), winding_number(points, surface)

    found = distance_of_closed(surface, grid).ravel()

    np.testing.assert_allclose(np.abs(found), exact, rtol=EPSILON, atol=1e-12)
    # Solid angles are no good on the surface itself.
    clear = exact > 1e-6
    assert ((found < 0) == (winding > 0.5))[clear].all()


def hull(points: Float) -> Surface:
    """The convex hull, facing outwards."""
    triangles = ConvexHull(points).simplices.astype(np.int64)
    corners = points[triangles] - points.mean(axis=0)
    outward = np.einsum("ij,ij->i", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) > 0
    return Surface(points, np.where(outward[:, None], triangles, triangles[:, ::-1]))


def test_surface_may_reach_beyond_the_grid():
    grid = Grid((9, 9, 9), (-4.0, -4.0, -4.0), (1.0, 1.0, 1.0))
    exact = box_distance(grid.nodes_mm(), (-30, -2.5, -30), (1.5, 30, 30))

    found = distance_of_closed(box((-30, -2.5, -30), (1.5, 30, 30)), grid)

    np.testing.assert_allclose(found, exact, rtol=0, atol=rounding(exact))


def test_uneven_triangles_are_found():
    """Triangles that shrink by a factor of four at every step would make a tree too deep."""
    steps = 4.0 ** -np.arange(40)
    bodies = [box((s, 0, 0), (1.5 * s, s / 2, s / 2)) for s in steps]
    grid = Grid((5, 5, 5), (-0.5, -0.5, -0.5), (0.4, 0.4, 0.4))
    points = grid.nodes_mm()
    each = np.stack([box_distance(points, (s, 0, 0), (1.5 * s, s / 2, s / 2)) for s in steps])

    found = distance_of_closed(joined(*bodies), grid)

    np.testing.assert_allclose(np.abs(found), np.abs(each).min(axis=0), rtol=0, atol=EPSILON)


BALL = sphere(10, 1)


def broken(**changes: Float) -> Surface:
    """The ball with other vertices or triangles."""
    given = {"vertices_mm": BALL.vertices_mm, "triangles": BALL.triangles, **changes}
    return Surface(given["vertices_mm"], given["triangles"])


NAN = BALL.vertices_mm.copy()
NAN[7, 1] = np.nan


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (broken(triangles=BALL.triangles[1:]), "not closed, 3 edges"),
        (broken(triangles=BALL.triangles[:, ::-1]), "inwards"),
        (broken(triangles=np.vstack([BALL.triangles[1:], BALL.triangles[:1, ::-1]])), "not closed"),
        (broken(triangles=np.vstack([BALL.triangles, BALL.triangles[:1]])), "not closed"),
        (broken(vertices_mm=NAN), "number 7"),
        (broken(vertices_mm=BALL.vertices_mm[:-1]), "there are 41"),
    ],
    ids=["hole", "inward", "one flipped", "one twice", "nan", "no such vertex"],
)
def test_unusable_surfaces_are_refused(surface, words):
    with pytest.raises(InputError, match=rf"my\.stl: .*{words}"):
        require_closed(surface, "my.stl")


def test_vertices_that_lie_where_others_do_are_told():
    """As VTK's cylinder and cube have them: no hole is to be found there."""
    whole = box((-4, -3, -2), (2, 3, 5))
    corners_mm = whole.vertices_mm[whole.triangles.ravel()]
    apart = Surface(corners_mm, np.arange(len(corners_mm)).reshape(-1, 3))
    with pytest.raises(InputError, match=r"is not closed, 36 edges .*; merge the 28 vertices"):
        require_closed(apart, "my.stl")


def test_a_grid_of_one_layer_is_refused():
    with pytest.raises(InputError, match="2 nodes or more"):
        Grid((1, 4, 4), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
