"""Meshes that pass through themselves are found, and mended where their level set does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from field_shapes import flipped, sphere
from hypothesis import given, settings
from hypothesis import strategies as st
from surface_shapes import crossing_triangles as independent
from surface_shapes import ellipsoid, smooth_level

from pipeline.config import Settings
from pipeline.errors import InputError
from pipeline.field import BakeSettings
from pipeline.field.fixture import Bounds
from pipeline.geometry import Float, Surface
from pipeline.meshes import write_vtp
from pipeline.own_surfaces import bake_own_surfaces
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.level_set import LevelSet
from pipeline.surface.mesh import adjacency, extract_surface, uncrossed

BESIDE = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
TWO = np.array([[0, 1, 2], [3, 4, 5]])


def thin_body() -> tuple[Surface, LevelSet]:
    """A lens 8 mm thick and 40 mm wide."""
    level = smooth_level(ellipsoid((20, 20, 4)), (30, 30, 14))
    return extract_surface(level, 2.5), level


@pytest.mark.parametrize(
    ("other", "crosses"),
    [
        ([[1, 1, -1], [1, 1, 1], [9, 9, 0]], True),
        ([[1, 1, 0.01], [1, 1, 1], [9, 9, 1]], False),
        ([[5, 5, -1], [5, 5, 1], [9, 9, 0]], False),
        ([[-1, 1, -1], [9, 1, -1], [1, 1, 9]], True),
    ],
    ids=["pierces", "hovers", "passes by", "is pierced"],
)
def test_two_triangles_cross_or_not(other, crosses):
    vertices = np.concatenate([BESIDE, np.array(other, float)])
    np.testing.assert_array_equal(crossing_triangles(vertices, TWO), [crosses, crosses])


def test_neighbours_that_touch_do_not_cross():
    """Triangles that share a corner or an edge meet there and nowhere else."""
    surface, _ = thin_body()
    assert not crossing_triangles(surface.vertices_mm, surface.triangles).any()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(4, 30))
def test_it_agrees_with_solving_for_the_point_of_meeting(seed, count):
    """Random triangles of all sizes, each pair asked on its own."""
    rng = np.random.default_rng(seed)
    corners = 10 * rng.random((count, 1, 3)) + rng.normal(0, 2, (count, 3, 3))
    expected = np.zeros(count, bool)
    for i in range(count):
        for j in range(i):
            if meets(corners[i], corners[j]) or meets(corners[j], corners[i]):
                expected[[i, j]] = True
    found = crossing_triangles(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))
    np.testing.assert_array_equal(found, expected)


def meets(one: Float, other: Float) -> bool:
    """Whether an edge of one triangle meets another, from a 3x3 system for the point of meeting."""
    for k in range(3):
        p, q = one[k], one[(k + 1) % 3]
        system = np.stack([q - p, other[0] - other[1], other[0] - other[2]], axis=1)
        if abs(np.linalg.det(system)) < 1e-12:
            continue
        t, u, v = np.linalg.solve(system, other[0] - p)
        if 0 < t < 1 and u > 0 and v > 0 and u + v < 1:
            return True
    return False


def test_a_vertex_pushed_through_the_other_side_is_found_and_mended():
    surface, level = thin_body()
    spoiled = surface.vertices_mm.copy()
    top = int(spoiled[:, 2].argmax())
    ring = adjacency(surface.triangles, len(spoiled))[[top]].indices
    spoiled[top, 2] -= 12
    spoiled[ring, 2] -= 9.5
    crossing = crossing_triangles(spoiled, surface.triangles)
    assert crossing.any()
    assert independent(Surface(spoiled, surface.triangles)) > 0

    mended = uncrossed(spoiled, surface.triangles, level)

    assert independent(Surface(mended, surface.triangles)) == 0
    assert not crossing_triangles(mended, surface.triangles).any()
    away = np.linalg.norm(spoiled - spoiled[top], axis=1) > 20
    np.testing.assert_array_equal(mended[away], spoiled[away])


def test_a_sound_mesh_is_returned_as_it_is():
    surface, level = thin_body()
    assert uncrossed(surface.vertices_mm, surface.triangles, level) is surface.vertices_mm


def together(one: Surface, other: Surface) -> Surface:
    return Surface(
        np.concatenate([one.vertices_mm, other.vertices_mm]),
        np.concatenate([one.triangles, other.triangles + len(one.vertices_mm)]),
    )


def test_a_bake_that_fails_names_the_surface_that_passes_through_itself(tmp_path: Path) -> None:
    """Two balls that overlap: inside both, no distance has the sign of the outer face."""
    both = together(sphere(15, 3), sphere(15, 3, (18, 0.3, 0.7)))
    folder = tmp_path / "own"
    folder.mkdir()
    write_vtp(folder / "lv.vtp", both)
    # They meet half-way, at x = 9 mm, to within a triangle's size and the tilt of that plane.
    with pytest.raises(
        InputError, match=r"lv passes through itself in phase 0 .* at ([789]|1[01])\."
    ):
        bake_own_surfaces(folder, tmp_path / "out", Settings(bake=BakeSettings(spacing_mm=3.0)))
    assert not (tmp_path / "out" / "field.zarr").exists()


INNER = sphere(8, 3, (0, 1, 2))
COARSE = Settings(bake=BakeSettings(spacing_mm=3.0, bounds=Bounds(surface_error_p99_spacings=1)))


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        (INNER, r"lv in phase 0 has a shell \(at .* mm\) that faces outwards, within another"),
        (flipped(sphere(8, 3, (60, 0, 0))), "faces inwards, within no other: take it out, or turn"),
    ],
)
def test_a_bake_that_fails_names_the_shell_that_faces_the_wrong_way(inner, words, tmp_path) -> None:
    write_vtp(tmp_path / "lv.vtp", together(sphere(20, 3), inner))
    with pytest.raises(InputError, match=words):
        bake_own_surfaces(tmp_path, tmp_path / "out", COARSE)


@pytest.mark.parametrize("inner", [flipped(INNER), sphere(8, 3, (60, 0, 0))])
def test_a_hollow_body_and_one_of_two_parts_are_baked(inner: Surface, tmp_path: Path) -> None:
    write_vtp(tmp_path / "lv.vtp", together(sphere(20, 3), inner))
    assert bake_own_surfaces(tmp_path, tmp_path / "out", COARSE).exists()


def test_vertices_that_are_no_numbers_are_named(tmp_path: Path) -> None:
    ball = sphere(20, 3)
    ball.vertices_mm[7, 1] = np.nan
    write_vtp(tmp_path / "lv.vtp", ball)
    with pytest.raises(InputError, match=r"lv\.vtp: has vertices that are no numbers"):
        bake_own_surfaces(tmp_path, tmp_path / "out", COARSE)


def test_phases_named_in_two_ways_are_refused(tmp_path: Path) -> None:
    (tmp_path / "lv").mkdir()
    write_vtp(tmp_path / "lv_000.vtp", sphere(20, 3))
    write_vtp(tmp_path / "lv" / "001.vtp", sphere(18, 3))
    with pytest.raises(InputError, match="is of the same structure and lies elsewhere"):
        bake_own_surfaces(tmp_path, tmp_path / "out", COARSE)
