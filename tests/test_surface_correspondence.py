"""Material points followed on bodies whose motion is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from surface_shapes import (
    SPACING_MM,
    MovingBody,
    crossing_triangles,
    ellipsoid,
    two_lobes,
    voxel_centres,
    voxel_noise_mm,
)

from pipeline.errors import StageError
from pipeline.geometry import Float, Surface
from pipeline.surface.correspondence import (
    affine_step,
    carry_along,
    carry_through_cycle,
    drawn_along,
    make_carrier,
    make_smoother,
    restore_volume,
    smooth_in_time,
)
from pipeline.surface.level_set import LevelSet, smooth_level_set
from pipeline.surface.mesh import (
    bad_triangles,
    extract_surface,
    laplacian,
    vertex_areas,
    vertex_normals,
)

PHASES = np.arange(12) / 12
HALF_MM = (36.0, 42.0, 54.0)
NOISE_MM = voxel_noise_mm(SPACING_MM, 1.2)

BODIES = {
    "scales": MovingBody(ellipsoid((20, 24, 36)), strain=(0.25, 0.25, 0.15)),
    "travels": MovingBody(ellipsoid((20, 24, 36)), shift_mm=(4, 3, 8)),
    "all at once": MovingBody(ellipsoid((20, 24, 36)), (0.2, 0.2, 0.1), 12, (4, 3, 6)),
    "lobes": MovingBody(two_lobes, (0.2, 0.1, 0.2), 0, (3, 2, -6)),
}


class Followed:
    """A body voxelised at every phase, and its template's way through the beat."""

    def __init__(self, body: MovingBody) -> None:
        points, first = voxel_centres(HALF_MM)
        self.body, self.first = body, first
        self.levels = [
            smooth_level_set(body.inside(points, phase), SPACING_MM, 1.2) for phase in PHASES
        ]
        self.template = extract_surface(self.levels[0], 2.5)
        self.path = carry_through_cycle(self.template, self.levels, 0, PHASES) + first
        self.truth = np.stack([body.carry(self.path[0], phase) for phase in PHASES])

    def errors_mm(self) -> tuple[Float, Float]:
        """Normal (signed) and tangential error ``(phase, n)`` of the motion from phase 0."""
        normals = np.stack([vertex_normals(v, self.template.triangles) for v in self.truth])
        miss = self.path - self.truth
        along = np.einsum("pni,pni->pn", miss, normals)
        return along, np.linalg.norm(miss - along[..., None] * normals, axis=2)


@pytest.fixture(scope="module", params=BODIES)
def followed(request) -> Followed:
    return Followed(BODIES[request.param])


def test_vertices_lie_on_the_true_surface_at_every_phase(followed):
    """Within the noise of voxels: the mean of a normal error is 0.8 of its deviation."""
    for vertices, phase in zip(followed.path, PHASES, strict=True):
        distance = followed.body.distance(vertices, phase)
        assert np.abs(distance).mean() < NOISE_MM


def test_residual_to_the_level_set_is_below_a_tenth_of_a_millimetre(followed):
    for vertices, level in zip(followed.path, followed.levels, strict=True):
        residual = np.abs(level.sample(vertices - followed.first)[0])
        assert np.median(residual) < 0.1


def test_normal_motion_is_true_to_the_noise_of_two_phases(followed):
    """Both ends of a motion carry the noise of voxels: their deviations add as squares.

    A point that slides by t on a surface of curvature 1 / R leaves the tangent plane by t^2 / 2R,
    with t below 3 mm and R above 15 mm: 0.3 mm at the worst, where motion is largest.
    """
    along, _ = followed.errors_mm()
    assert np.abs(along).mean() < np.sqrt(2) * NOISE_MM
    assert np.abs(along).mean(axis=1).max() < np.sqrt(2) * NOISE_MM + 0.3


def test_no_triangle_flips_and_no_surface_crosses_itself(followed):
    for vertices in followed.path:
        assert not bad_triangles(vertices, followed.template.triangles).any()
    middle = Surface(followed.path[len(PHASES) // 2], followed.template.triangles)
    assert crossing_triangles(middle) == 0


def test_the_end_of_the_beat_meets_its_start(followed):
    """The step over the seam is as long as the true one, like any other step."""
    seam = followed.path[0] - followed.path[-1]
    true_seam = followed.truth[0] - followed.truth[-1]
    off = np.linalg.norm(seam - true_seam, axis=1).mean()
    steps = np.diff(followed.path, axis=0) - np.diff(followed.truth, axis=0)
    others = np.linalg.norm(steps, axis=2).mean(axis=1)
    assert off < others.max() + NOISE_MM


@pytest.mark.parametrize("name", ["scales", "travels", "all at once"])
def test_points_do_not_slide_where_the_shape_tells(name, record_property):
    """Sliding left is small beside the one of vertices that move along their normals only.

    That is the tangential part of the true motion, which a normal flow loses altogether.
    """
    case = Followed(BODIES[name])
    _, slide = case.errors_mm()
    normals = vertex_normals(case.path[0], case.template.triangles)
    motion = case.truth - case.truth[0]
    along = np.einsum("pni,ni->pn", motion, normals)
    lost = np.linalg.norm(motion - along[..., None] * normals, axis=2)
    record_property("tangential_error_mm", float(slide.mean()))
    record_property("tangential_motion_mm", float(lost.mean()))
    assert slide.mean() < 0.25 * lost.mean()


def test_a_still_heart_keeps_still():
    """No motion in, none out, but for the residue of the settling steps."""
    still = Followed(MovingBody(two_lobes))
    assert np.abs(still.path - still.path[0]).max() < 0.02


@pytest.mark.parametrize("gone", [1.0, 0.25], ids=["all", "a quarter"])
def test_a_body_that_jumps_away_is_refused(gone):
    """Further than the field reaches there is nothing to follow; the message names the phase.

    Above a height a share of a ball's surface lies that is the share of its diameter (Archimedes).
    """
    points, _ = voxel_centres((20, 20, 20))
    body = smooth_level_set(np.linalg.norm(points, axis=-1) < 12, SPACING_MM, 1.2)
    left = points[..., 2] < 12 - 24 * gone
    blank = LevelSet(np.where(left, body.distance_mm, np.float32(9)), SPACING_MM)
    template = extract_surface(body, 2.5)
    with pytest.raises(StageError, match=r"could not follow to phase 1 \(at 0.500.* 5% of its"):
        carry_through_cycle(template, [body, blank], 0, np.array([0.0, 0.5]))


def test_affine_step_finds_a_shift_from_the_surface_alone():
    """A shift shows in all directions of the normal, so it is found, less the ridge's share.

    The normals of a ball have n n^T = 1/3 on average; a ridge of 0.001 takes 0.3 % of the shift.
    """
    points, _ = voxel_centres((30, 30, 30))
    shift = np.array([3.0, -2.0, 4.0])
    far = np.linalg.norm(points - points[0, 0, 0] - 28 - shift, axis=-1) - 15
    near = np.linalg.norm(points - points[0, 0, 0] - 28, axis=-1) - 15
    surface = extract_surface(LevelSet(near.astype(np.float32), SPACING_MM), 2.5)
    weights = vertex_areas(surface.vertices_mm, surface.triangles)
    moved = affine_step(
        LevelSet(far.astype(np.float32), SPACING_MM),
        surface.vertices_mm,
        weights / weights.sum(),
    )
    error = moved - surface.vertices_mm - shift
    assert np.linalg.norm(error, axis=1).mean() < 0.02 * np.linalg.norm(shift)


def test_smoother_solves_its_equation():
    """Against a direct solver; the error is bounded by 1 % of the input's size."""
    points, _ = voxel_centres((24, 24, 24))
    surface = extract_surface(
        smooth_level_set(np.linalg.norm(points, axis=-1) < 15, SPACING_MM, 1.2), 2.5
    )
    stiffness = laplacian(surface.triangles, len(surface.vertices_mm))
    values = np.random.default_rng(0).normal(size=(len(surface.vertices_mm), 3))
    for reach in (1.0, 3.0, 8.0):
        system = sparse.eye_array(len(values)) + reach**2 * stiffness
        exact = spsolve(sparse.csc_array(system), values)
        found = make_smoother(stiffness, reach)(values)
        assert np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(values)


def test_smoothers_leave_a_shift_alone():
    """Constants are in the kernel of the Laplacian."""
    points, _ = voxel_centres((24, 24, 24))
    surface = extract_surface(
        smooth_level_set(np.linalg.norm(points, axis=-1) < 15, SPACING_MM, 1.2), 2.5
    )
    shift = np.broadcast_to([1.0, 2.0, 3.0], surface.vertices_mm.shape)
    for smooth in make_carrier(surface).smoothers:
        np.testing.assert_allclose(smooth(np.array(shift)), shift, rtol=0.02)


@pytest.mark.parametrize("harmonic", [0, 1, 2, 4])
def test_smoothing_in_time_dulls_a_harmonic_by_its_closed_form(harmonic):
    """On even phases the response is 2 G - G^2, G = exp(-(2 pi h width)^2 / 2)."""
    phases, width = np.arange(50) / 50, 0.04
    wave = np.cos(2 * np.pi * harmonic * phases)[:, None, None] * np.ones((1, 2, 3))
    gauss = np.exp(-0.5 * (2 * np.pi * harmonic * width) ** 2)
    found = smooth_in_time(wave, phases, width)
    np.testing.assert_allclose(found, (2 * gauss - gauss**2) * wave, atol=1e-9)


def test_smoothing_in_time_knows_no_seam():
    """Starting the beat elsewhere changes nothing but the numbering."""
    phases = np.arange(10) / 10
    path = np.random.default_rng(0).normal(size=(10, 4, 3))
    found = smooth_in_time(path, phases, 0.1)
    rolled = smooth_in_time(np.roll(path, 3, axis=0), phases, 0.1)
    np.testing.assert_allclose(rolled, np.roll(found, 3, axis=0), atol=1e-12)


@pytest.mark.parametrize(
    "phases", [0.8 * np.arange(20) / 20, np.arange(20) / 20 + 0.012 * (-1) ** np.arange(20) + 0.012]
)
def test_smoothing_in_time_bends_no_path_whose_phases_are_uneven(phases):
    """A scanner that stops before the beat ends, and triggers that come unevenly. Of a line fitted
    under a Gaussian the bias is that of the second derivative alone, at any density of phases."""
    width = 0.02
    wave = 8 * np.cos(2 * np.pi * phases)[:, None, None] * np.ones((1, 2, 3))
    off = np.abs(smooth_in_time(wave, phases, width) - wave).max()
    # G alone takes (2 pi width)^2 / 2 of the amplitude, and 2 G - G G what G misses twice.
    assert off < 8 * (2 * np.pi * width) ** 2 / 2


def test_no_width_is_no_smoothing():
    path = np.random.default_rng(0).normal(size=(5, 4, 3))
    assert smooth_in_time(path, np.arange(5) / 5, 0.0) is path


def test_restoring_a_volume_offsets_a_ball_to_the_radius_it_needs():
    """A volume 3 % larger is a radius 1 % larger; vertices move along the radius."""
    points, first = voxel_centres((24, 24, 24))
    far = np.linalg.norm(points, axis=-1) - 15
    surface = extract_surface(LevelSet(far.astype(np.float32), SPACING_MM), 2.5)
    wanted = 1.03 * surface.volume_mm3()

    found = restore_volume(surface.vertices_mm, surface.triangles, wanted)

    assert Surface(found, surface.triangles).volume_mm3() == pytest.approx(wanted, rel=1e-4)
    radius = np.linalg.norm(surface.vertices_mm + first, axis=1)
    grown = np.linalg.norm(found + first, axis=1)
    # Vertex normals deviate from the radius by the unevenness of triangles, about e / R.
    np.testing.assert_allclose(grown / radius, 1.03 ** (1 / 3), atol=2.5 / 15 * 0.01)


class Spinning:
    """A ball at rest in an inner ball that turns: only the inner one knows."""

    def __init__(self, edge_mm: float) -> None:
        points, first = voxel_centres((27, 27, 27))
        far = np.linalg.norm(points, axis=-1)
        self.levels = [LevelSet((far - 17).astype(np.float32), SPACING_MM)] * 3
        self.template = extract_surface(self.levels[0], edge_mm)
        self.phases, self.centre = np.array([0.0, 0.3, 0.6]), -first
        inner = extract_surface(LevelSet((far - 14).astype(np.float32), SPACING_MM), 2.5)
        self.inner_mm = np.stack([self.turned(inner.vertices_mm, k) for k in range(3)])

    def turned(self, points_mm: Float, k: int) -> Float:
        """Points after a turn about z by 0, 15 and -10 degrees."""
        angle = np.deg2rad((0, 15, -10)[k])
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        return np.asarray((points_mm - self.centre) @ turn.T + self.centre)

    def slide_left(self, path: Float, chosen: Float) -> Float:
        """Share ``(phase,)`` of the turn, phases but the first, that vertices do not follow."""
        truth = np.stack([self.turned(self.template.vertices_mm, k) for k in range(3)])
        missed = np.linalg.norm(path - truth, axis=2)[1:, chosen].mean(axis=1)
        return np.asarray(
            missed / np.linalg.norm(truth - truth[0], axis=2)[1:, chosen].mean(axis=1)
        )


def test_an_outer_surface_turns_with_what_is_within():
    """A vertex goes as far as points on 14/17 of its radius do, and so misses 3/17 of the turn.

    The smoother of reach r = 7.5 mm, whose Laplacian is r^2 / 4 of Laplace's, dulls a turn, a first
    harmonic, by 1 - 1 / (1 + 2 (r^2 / 4) / 17^2) = 9 %. A tenth again for the mean over neighbours.
    """
    ball = Spinning(2.5)
    path = carry_along(ball.template, ball.levels, 0, ball.phases, ball.inner_mm)
    everywhere = np.ones(path.shape[1], bool)
    assert (ball.slide_left(path, everywhere) < 1.1 * (1 - 14 / 17 * 0.91)).all()
    assert np.abs(np.linalg.norm(path - ball.centre, axis=2) - 17).max() < 0.1
    alone = carry_through_cycle(ball.template, ball.levels, 0, ball.phases)
    assert (ball.slide_left(alone, everywhere) > 0.95).all()


def test_a_surface_slides_with_what_it_has_grown_on_and_there_alone():
    """Only the lower half is beside; 3 mm off its trust is 0.93, smoothed over 10 mm at least half.

    With s of it the share s / (s + 0.3) of 14/17 of the turn is followed: half of it below, and
    ever less further up. A tenth is for neighbours that smoothing mixes in.
    """
    ball = Spinning(1.25)
    alone = carry_through_cycle(ball.template, ball.levels, 0, ball.phases)
    below = ball.inner_mm[:, ball.inner_mm[0, :, 2] < ball.centre[2] - 4]
    path = drawn_along(ball.template, ball.levels, alone, 0, below)
    height = ball.template.vertices_mm[:, 2] - ball.centre[2]
    bands = [height < -8, np.abs(height) < 4, height > 14]
    left = np.stack([ball.slide_left(path, band) for band in bands])
    assert (left[0] < 1 - 0.4).all()
    assert (np.diff(left, axis=0) > 0.02).all()
    assert (left[2] > left[0] + 0.1).all()
    assert np.abs(np.linalg.norm(path - ball.centre, axis=2) - 17).max() < 0.1
    np.testing.assert_array_equal(path[0], alone[0])


def test_vertices_lie_on_the_surface_where_the_two_ways_round_the_beat_disagree():
    """A body of four lobes that turns a quarter in a beat closes with its lobes exchanged.

    What goes through the beat forwards and what goes backwards lie up to a quarter of the ring
    apart then, and their mean up to 5 mm below the surface (1 - cos 45 degrees of its radius).
    """
    points, _ = voxel_centres((60, 60, 40))
    radius, angle = (
        np.hypot(points[..., 0], points[..., 1]),
        np.arctan2(points[..., 1], points[..., 0]),
    )

    def solid(phase: float):
        ring = 17 + 2 * np.cos(4 * angle - 2 * np.pi * phase)
        return np.square(radius / ring) + np.square(points[..., 2] / 12) < 1

    phases = np.arange(4) / 4
    levels = [smooth_level_set(solid(phase), SPACING_MM, 1.2) for phase in phases]
    path = carry_through_cycle(extract_surface(levels[0], 2.5), levels, 0, phases)
    for level, vertices in zip(levels, path, strict=True):
        assert np.abs(level.sample(vertices)[0]).max() < SPACING_MM / 4
