"""Surface: one closed surface a structure, whose vertices correspond through the beat."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.job import Job
from pipeline.products import read_labels, read_table, write_surfaces
from pipeline.surface.extraction import extract_moving_surfaces


def run(job: Job) -> dict[str, Any]:
    """Write ``<structure>_000.vtp`` ... and measure volumes from the surfaces."""
    heart, mr_from_index = read_labels(job.products / "segment", "heart")
    phases = np.array(read_table(job.products / "ingest" / "phases.json")["phases"])
    surfaces = extract_moving_surfaces(
        heart, mr_from_index, phases, job.settings.surface, job.progress
    )
    write_surfaces(job.folder, surfaces)
    volumes = {
        name: [round(moving.at(k).volume_mm3() / 1000, 2) for k in range(len(phases))]
        for name, moving in surfaces.items()
    }
    return {
        "volumes_ml": volumes,
        "lv_ejection_fraction": _ejection_fraction(volumes["lv_endocardium"]),
        "triangles": {name: len(moving.triangles) for name, moving in surfaces.items()},
    }


def _ejection_fraction(volumes_ml: list[float]) -> float:
    """Stroke volume over end-diastolic volume."""
    return round(1 - min(volumes_ml) / max(volumes_ml), 4)
