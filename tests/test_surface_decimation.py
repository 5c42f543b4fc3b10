"""Fewer triangles where a surface is flat, within a bound that holds in every phase."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from surface_shapes import SPACING_MM, box, ellipsoid, smooth_level, voxel_centres

from pipeline.evaluation.metrics import closedness, surface_samples
from pipeline.geometry import MovingSurface
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.decimation import decimated, deviation_mm
from pipeline.surface.level_set import LevelSet
from pipeline.surface.measures import distances_mm, volumes_ml
from pipeline.surface.mesh import bad_triangles, extract_surface

PHASES = np.array([0.0, 0.3, 0.6])


def rounded_box() -> LevelSet:
    """A box with flat sides, 40 x 40 x 24 mm, and edges rounded to 5 mm."""
    points, _ = voxel_centres((30, 30, 24))
    distance_mm = box(points, (0, 0, 0), (15, 15, 7)) - 5
    return LevelSet(distance_mm.astype(np.float32), SPACING_MM)


def moving(level: LevelSet) -> MovingSurface:
    """Stretched, and bent so that a side that is flat at rest is not in the last phase."""
    surface = extract_surface(level, 2.0)
    rest = surface.vertices_mm - surface.vertices_mm.mean(axis=0)
    stretched = rest * (1.2, 0.9, 1.0)
    bent = rest + np.outer(rest[:, 0] ** 2 / 60, [0, 0, 1.0])
    return MovingSurface(np.stack([rest, stretched, bent]), surface.triangles, PHASES)


BOX = moving(rounded_box())


@pytest.mark.parametrize(
    "bound_mm", [*(pytest.param(k, marks=pytest.mark.slow) for k in (0.05, 0.2)), 0.5]
)
def test_no_point_is_farther_off_than_the_bound_in_any_phase(bound_mm):
    """By VTK, from points strewn over both surfaces; these are not those it was measured at."""
    fewer = decimated(BOX, bound_mm)
    assert len(fewer.triangles) < len(BOX.triangles)
    assert deviation_mm(BOX, fewer) <= bound_mm
    for k in range(len(PHASES)):
        there = distances_mm(surface_samples(BOX.at(k), 4000, seed=k), fewer.at(k))
        back = distances_mm(surface_samples(fewer.at(k), 4000, seed=k), BOX.at(k))
        assert max(there.max(), back.max()) <= bound_mm


def test_vertices_that_stay_are_the_same_material_points():
    """They move along their normals alone, to keep the volume: by less than the bound."""
    fewer = decimated(BOX, 0.2)
    _, kept = cKDTree(BOX.vertices_mm[0]).query(fewer.vertices_mm[0])
    assert len(np.unique(kept)) == len(kept)
    away = np.linalg.norm(fewer.vertices_mm - BOX.vertices_mm[:, kept], axis=2)
    assert away.max() < 0.2
    np.testing.assert_array_equal(fewer.phases, BOX.phases)


def test_the_volume_is_kept_in_every_phase():
    """Newton's second step leaves the square of the first: (0.2 mm / 10 mm)^2."""
    fewer = decimated(BOX, 0.2)
    np.testing.assert_allclose(volumes_ml(fewer), volumes_ml(BOX), rtol=4e-4)


def test_the_surface_stays_a_sound_solid_in_every_phase():
    fewer = decimated(BOX, 0.5)
    assert fewer.vertices_mm.shape[1] - len(fewer.triangles) / 2 == 2
    assert len(np.unique(fewer.triangles)) == fewer.vertices_mm.shape[1]
    for k, vertices in enumerate(fewer.vertices_mm):
        assert closedness(fewer.at(k)).is_solid
        assert not crossing_triangles(vertices, fewer.triangles).any()
        assert not bad_triangles(vertices, fewer.triangles).any()


def test_flat_parts_lose_more_triangles_than_round_ones():
    """Of a box that keeps its shape, the middle of a side is flat and its edges are not."""
    still = MovingSurface(BOX.vertices_mm[:1], BOX.triangles, PHASES[:1])
    fewer = decimated(still, 0.1)

    def inner(surface: MovingSurface) -> int:
        middles = surface.vertices_mm[0][surface.triangles].mean(axis=1)
        return int(np.count_nonzero((np.abs(middles[:, :2]) < 12).all(axis=1)))

    flat = inner(fewer) / inner(still)
    others = (len(fewer.triangles) - inner(fewer)) / (len(still.triangles) - inner(still))
    assert flat < 0.5
    assert flat < 0.7 * others


def test_what_is_flat_in_one_phase_alone_keeps_its_triangles():
    """The bent phase holds back what the first alone would let go."""
    alone = decimated(MovingSurface(BOX.vertices_mm[:1], BOX.triangles, PHASES[:1]), 0.05)
    together = decimated(BOX, 0.05)
    assert len(alone.triangles) < len(together.triangles)


def test_no_bound_is_no_decimation():
    assert decimated(BOX, 0.0) is BOX


def test_a_tight_bound_leaves_a_ball_alone():
    """Facets of edge 2 mm sag by e^2 / 12 R = 0.02 mm on a ball of 18 mm; 0.001 mm allow none."""
    ball = extract_surface(smooth_level(ellipsoid((18, 18, 18)), (26, 26, 26)), 2.0)
    one = MovingSurface(ball.vertices_mm[None], ball.triangles, PHASES[:1])
    assert len(decimated(one, 0.001).triangles) > 0.95 * len(ball.triangles)
