"""Baking a field, beside peers in one run: a group's table gives the ratios."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista
from pytest_benchmark.fixture import BenchmarkFixture

from pipeline.exact import ExactSurface
from pipeline.field import BakeSettings, ForceField
from pipeline.field.bake import bake_field
from pipeline.field.distance import distance_of_closed
from pipeline.field.fixture import DEFAULT_FIXTURES
from pipeline.geometry import Grid, MovingSurface, Surface

# VTK would need minutes for the whole grid: it gets one node in so many, so its ratio is as many
# times what the table says.
# No divisor of a row's nodes, or all would lie in a few planes.
VTK_SHARE = 61


def heart_like(level: int) -> Surface:
    """An uneven ball of about 100 mm: 20 * 4^level triangles."""
    ball = pyvista.Icosphere(radius=1.0, nsub=level)
    unit = np.asarray(ball.points, dtype=float)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    bumps = 1 + 0.08 * np.sin(5 * unit[:, 0] + 1) * np.cos(4 * unit[:, 1]) * np.sin(6 * unit[:, 2])
    vertices = 45 * unit * bumps[:, None] * (0.8, 0.9, 1.1)
    return Surface(vertices, np.asarray(ball.regular_faces, dtype=np.int64))


def bake_study(folder: Path, phase_count: int) -> ForceField:
    """Two structures, three fixtures, the default settings."""
    phases = np.arange(phase_count) / phase_count
    size = 1 - 0.08 * np.sin(np.pi * phases)[:, None, None] ** 2
    large, small = heart_like(5), heart_like(4)
    atrium = 0.5 * small.vertices_mm * size + (10, 20, 40)
    surfaces = {
        "epicardium": MovingSurface(large.vertices_mm * size, large.triangles, phases),
        "left_atrium": MovingSurface(atrium, small.triangles, phases),
    }
    bake_field(folder, surfaces, DEFAULT_FIXTURES, BakeSettings(), rr_s=0.8)
    return ForceField.open(folder)


# 5k triangles: the tree is small; 20k: a heart of 2 mm edges; 80k: one of 1 mm.
@pytest.mark.parametrize("level", [4, 5, 6])
@pytest.mark.parametrize("who", ["ours", f"VTK, one node in {VTK_SHARE}"])
def test_mesh_to_grid(benchmark: BenchmarkFixture, who: str, level: int) -> None:
    """Exact signed distance on 80 x 80 x 90 nodes."""
    surface = heart_like(level)
    benchmark.group = f"mesh of {len(surface.triangles)} triangles to 576,000 nodes"
    grid = Grid((90, 80, 80), (-50.0, -52.0, -60.0), (1.25, 1.3, 1.35))
    some = grid.nodes_mm().reshape(-1, 3)[::VTK_SHARE]
    ours = benchmark.pedantic(
        (lambda: distance_of_closed(surface, grid).ravel()[::VTK_SHARE])
        if who == "ours"
        else (lambda: ExactSurface(surface).distance_mm(some)),
        rounds=3,
        warmup_rounds=1,
    )
    assert np.isfinite(ours).all()


def test_bake(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """The default study: 25 phases, two structures, three fixtures, certified and sealed."""
    benchmark.group = "bake"
    field = benchmark.pedantic(bake_study, args=(tmp_path / "field.zarr", 25), rounds=1)
    assert field.accuracy["sign_errors"] == 0
    benchmark.extra_info |= {"accuracy": field.accuracy, "grid": field.grid.shape}
