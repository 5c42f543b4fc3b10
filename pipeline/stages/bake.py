"""Bake: 4D distance and potential grids that a force server loads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.field.bake import bake_field
from pipeline.geometry import MovingSurface
from pipeline.job import Job
from pipeline.products import read_surfaces, read_table


def run(job: Job) -> dict[str, Any]:
    """Write ``field.zarr``; its accuracy certificate is the stage's figures."""
    timing = read_table(job.products / "ingest" / "phases.json")
    surfaces = read_surfaces(job.products / "surface", np.array(timing["phases"]))
    registered = job.product("register")
    mr_from_tracker = None
    if registered:
        placed = read_table(registered / "mr_from_tracker.json")["mr_from_tracker"]
        mr_from_tracker = np.array(placed)
    certificate = bake_field(
        job.folder / "field.zarr",
        surfaces,
        job.settings.fixtures,
        job.settings.bake,
        mr_from_tracker=mr_from_tracker,
        rr_s=timing["rr_s"],
        source={"patient_id": job.study.patient_id, "beatfield": __version__},
        progress=job.progress,
    )
    return {"accuracy": certificate, "example": _example(job, surfaces)}


def _example(job: Job, surfaces: Mapping[str, MovingSurface]) -> dict[str, Any]:
    """A place to ask for a force: just off the first fixture's surface at the first phase."""
    name, fixture = next(iter(job.settings.fixtures.items()))
    moving = surfaces[fixture.structure]
    vertices_mm = moving.vertices_mm[0]
    centre_mm = vertices_mm.mean(axis=0)
    vertex_mm = vertices_mm[0]
    outward = (vertex_mm - centre_mm) / np.linalg.norm(vertex_mm - centre_mm)
    point_mm = vertex_mm + fixture.resolved_delta_mm * outward
    return {
        "fixture": name,
        "point_mm": np.round(point_mm, 1).tolist(),
        "phase": round(float(moving.phases[0]), 3),
    }
