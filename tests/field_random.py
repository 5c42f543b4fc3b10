"""A store of random numbers on a grid of which no axis is like another."""

from pathlib import Path

import numpy as np

from pipeline.field.fixture import Fixture
from pipeline.field.metadata import FieldMetadata, FixturePart, GridPart, StructurePart
from pipeline.field.store import FieldWriter
from pipeline.geometry import Float

ORIGIN_MM = (-3.0, 4.0, 5.5)
SPACING_MM = (1.5, 2.0, 0.7)
EVEN = np.arange(25) / 25


def write_random(path: Path, width: int, phases: Float, height: int = 5, depth: int = 3) -> Float:
    """A store with random coefficients; no surface has such a distance, but no weight can hide."""
    shape = (depth, height, width)
    law = Fixture(structure="s", kind="guidance", delta_mm=3.0, f_max_n=1.0)
    about = FieldMetadata(
        phases=phases.tolist(),
        rr_s=None,
        mr_from_tracker=None,
        grid=GridPart(shape_zyx=shape, origin_mm=ORIGIN_MM, spacing_mm=SPACING_MM),
        structures={
            "s": StructurePart(
                path="distance/s",
                spline="spline/s",
                triangles=[0] * len(phases),
                volume_ml=[0.0] * len(phases),
            )
        },
        fixtures={"f": FixturePart.of("f", law)},
        source={},
        accuracy={},
    )
    values = np.random.default_rng(width).normal(size=(len(phases), *shape)).astype(np.float32)
    writer = FieldWriter(path, about)
    for index, one in enumerate(values):
        for part in about.arrays:
            writer.write(part, index, one)
    writer.finish(about)
    return values.astype(float)
