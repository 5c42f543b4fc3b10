"""A store of random numbers on a grid of which no axis is like another."""

from pathlib import Path

import numpy as np

from pipeline.field.fixture import Fixture
from pipeline.field.metadata import FieldMetadata, FixturePart, GridPart, StructurePart
from pipeline.field.store import FieldWriter
from pipeline.geometry import Float, Grid

ORIGIN_MM = (-3.0, 4.0, 5.5)
SPACING_MM = (1.5, 2.0, 0.7)
EVEN = np.arange(25) / 25


def described(grid: Grid, phases: Float, fixture: Fixture) -> FieldMetadata:
    """What a store says that holds one structure, ``s``, and one fixture of it, ``f``."""
    part = StructurePart(
        path="distance/s",
        spline="spline/s",
        triangles=[0] * len(phases),
        volume_ml=[0.0] * len(phases),
    )
    return FieldMetadata(
        phases=phases.tolist(),
        rr_s=None,
        mr_from_tracker=None,
        grid=GridPart(shape_zyx=grid.shape, origin_mm=grid.origin_mm, spacing_mm=grid.spacing_mm),
        structures={"s": part},
        fixtures={"f": FixturePart.of("f", fixture)},
        source={},
        accuracy={},
    )


def write_random(path: Path, width: int, phases: Float, height: int = 5, depth: int = 3) -> Float:
    """A store with random coefficients; no surface has such a distance, but no weight can hide."""
    shape = (depth, height, width)
    law = Fixture(structure="s", kind="guidance", delta_mm=3.0, f_max_n=1.0)
    about = described(Grid(shape, ORIGIN_MM, SPACING_MM), phases, law)
    values = np.random.default_rng(width).normal(size=(len(phases), *shape)).astype(np.float32)
    writer = FieldWriter(path, about)
    for index, one in enumerate(values):
        for part in about.arrays:
            writer.write(part, index, one)
    writer.finish(about)
    return values.astype(float)
