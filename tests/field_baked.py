"""A small baked field with known truth, for the tests of reader, store and baking."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from field_shapes import beating, sphere

from pipeline.field import BakeSettings, Fixture
from pipeline.field.bake import bake_field
from pipeline.field.manifest import write_manifest

PHASES = np.array([0.05, 0.2, 0.45, 0.5, 0.8])
"""Unevenly spaced, and not from 0."""

RADII_MM = np.array([20.0, 18.0, 15.0, 15.5, 19.0])
RR_S = 0.8
TRACKER = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])

FIXTURES = {
    "guide": Fixture(structure="ball", kind="guidance", gamma_mm=2.5, m=2, f_max_n=2.0),
    "stay_in": Fixture(
        structure="ball", kind="forbidden_region", side="outside", delta_mm=4.0, f_max_n=1.5
    ),
    "stay_out": Fixture(
        structure="core", kind="forbidden_region", side="inside", delta_mm=4.0, m=1, f_max_n=1.5
    ),
}

# The plain interpolation, which takes the stored distances at the nodes: readers are held to it.
SETTINGS = BakeSettings(spacing_mm=3.0, samples=200, fit_rounds=0)


def ball_and_core() -> dict[str, Any]:
    """A ball that beats, one half its size in it, and one that no fixture needs."""
    ball = sphere(1.0, 3)
    return {
        "ball": beating(ball, RADII_MM, PHASES),
        "core": beating(ball, RADII_MM / 2, PHASES),
        "unused": beating(ball, RADII_MM * 9, PHASES),
    }


def bake_small(path: Path, **changes: Any) -> dict[str, Any]:
    """Bake the small field; its certificate."""
    given = {"mr_from_tracker": TRACKER, "rr_s": RR_S, "source": {"shape": "ball"}, **changes}
    return bake_field(path, ball_and_core(), FIXTURES, SETTINGS, **given)


def edit(path: Path, change: Callable[[Any], object]) -> None:
    """Change a store's description and seal it again, as a wrong program would."""
    described = json.loads((path / "zarr.json").read_text())
    change(described["attributes"]["beatfield"])
    (path / "zarr.json").write_text(json.dumps(described))
    seal(path)


def seal(path: Path) -> None:
    """Write the manifest of a changed store anew."""
    (path / "manifest.json").unlink()
    write_manifest(path)
