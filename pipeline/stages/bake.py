"""Bake: 4D distance and potential grids that a force server loads."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline import INTENDED_USE, __version__
from pipeline.doubts import doubts, few_phases, odd_orientation, of_registration
from pipeline.errors import InputError
from pipeline.field.bake import bake_field
from pipeline.field.certificate import allowed_errors
from pipeline.field.fixture import DEFAULT_FIXTURES, Fixture
from pipeline.geometry import MovingSurface
from pipeline.job import Job
from pipeline.products import read_surfaces, read_table
from pipeline.sealing import digest_of_files, network_digests

if TYPE_CHECKING:
    from pipeline.config import Settings

TOLD_OF_REGISTRATION = ("verdict", "reason", "expected_tre_mm", "chance_under_2_mm")
"""What a field's ``source`` says of the registration behind ``mr_from_tracker``."""


def run(job: Job) -> dict[str, Any]:
    """Write ``field.zarr``; its accuracy certificate is the stage's figures."""
    timing = read_table(job.products / "ingest" / "phases.json")
    surfaces = read_surfaces(job.products / "surface", np.array(timing["phases"]))
    lost = job.figures("surface")["left_out"]
    fixtures, left_out = fixtures_for(job.settings, surfaces, lost)
    registered = job.product("register")
    source: dict[str, Any] = {
        "use": INTENDED_USE,
        "patient_id": job.study.patient_id,
        "beatfield": __version__,
        "inputs": {kind: digest_of_files(files) for kind, files in job.inputs.items() if files},
        "networks": network_digests(),
        "bake": job.settings.bake.model_dump(mode="json"),
        "fingerprint": job.fingerprint,
    }
    segment = job.figures("segment")
    heart = [f"the heart {text}" for text in odd_orientation(segment)]
    doubted = [*heart, *doubts(segment, job.figures("surface"))]
    of_pose: list[str] = []
    mr_from_tracker = None
    if registered:
        found = read_table(registered / "mr_from_tracker.json")
        mr_from_tracker = np.array(found["mr_from_tracker"])
        source["tracker"] = found["tracker"]
        source["registration"] = {name: found[name] for name in TOLD_OF_REGISTRATION}
        of_pose = of_registration(found)
    certificate = bake_field(
        job.folder / "field.zarr",
        surfaces,
        fixtures,
        job.settings.bake,
        mr_from_tracker=mr_from_tracker,
        rr_s=timing["rr_s"],
        source=source,
        # Who loads the field sees neither the terminal nor the report.
        doubts_of=lambda accuracy: [*doubted, *few_phases(accuracy), *of_pose],
        progress=job.progress,
    )
    return {
        "accuracy": certificate,
        "allowed": allowed_errors(job.settings.bake.bounds, job.settings.bake.spacing_mm),
        "example": _example(fixtures, surfaces, job.settings.bake.margin_mm),
        "left_out": left_out,
    }


def fixtures_for(
    settings: Settings, surfaces: Collection[str], lost: Mapping[str, str]
) -> tuple[dict[str, Fixture], dict[str, str]]:
    """The fixtures to bake, and those that a study's images do not allow, with the reason.

    A default fixture is left out where its surface is missing, also where a configuration repeats
    it as it is; one of the user's own is not.

    Parameters
    ----------
    surfaces
        Names of those that there are.
    lost
        Those that there are not, and why.

    Raises
    ------
    InputError
        When a surface that the user asked for is missing.
    """
    given = settings.fixtures
    kept = {name: one for name, one in given.items() if one.structure in surfaces}
    lacking = {name: one.structure for name, one in given.items() if name not in kept}
    own = {name: of for name, of in lacking.items() if given[name] != DEFAULT_FIXTURES.get(name)}
    wanted = {f"fixture {name}": of for name, of in own.items()}
    wanted |= {f"bake.structures {name}": name for name in settings.bake.structures if name in lost}
    if not kept and not wanted:
        wanted = {f"fixture {name}": of for name, of in lacking.items()}
    if wanted:
        said = "; ".join(
            f"{who} needs {of}, which has no surface: {lost[of]}" for who, of in wanted.items()
        )
        raise InputError(f"{said}; take it out of the configuration, or name another structure")
    return kept, {name: f"needs {of}, which has no surface" for name, of in lacking.items()}


def _example(
    fixtures: Mapping[str, Fixture], surfaces: Mapping[str, MovingSurface], margin_mm: float
) -> dict[str, Any]:
    """A place to ask for a force: just off the first fixture's surface at the first phase, within
    the grid."""
    name, fixture = next(iter(fixtures.items()))
    moving = surfaces[fixture.structure]
    vertices_mm = moving.vertices_mm[0]
    centre_mm = vertices_mm.mean(axis=0)
    vertex_mm = vertices_mm[0]
    outward = (vertex_mm - centre_mm) / np.linalg.norm(vertex_mm - centre_mm)
    point_mm = vertex_mm + min(fixture.resolved_delta_mm, 0.9 * margin_mm) * outward
    return {
        "fixture": name,
        "point_mm": np.round(point_mm, 1).tolist(),
        "phase": round(float(moving.phases[0]), 3),
    }
