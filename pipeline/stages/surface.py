"""Surface: one closed surface a structure, whose vertices correspond through the beat."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.job import Job
from pipeline.products import read_labels, read_table, write_surfaces, write_table
from pipeline.registration.clock import systole_s
from pipeline.surface.extraction import extract
from pipeline.surface.measures import end_systole, mean_lv_mass_g, measures


def run(job: Job) -> dict[str, Any]:
    """Write ``<structure>_000.vtp`` ... and ``measures.json``; see pipeline.surface.measures."""
    heart, mr_from_index = read_labels(job.products / "segment", "heart")
    cycle = read_table(job.products / "ingest" / "phases.json")
    phases, rr_s = np.array(cycle["phases"]), float(cycle["rr_s"])
    found = extract(heart, mr_from_index, phases, job.settings.surface, job.progress)
    write_surfaces(job.folder, found.surfaces)
    table = measures(found.surfaces, job.figures("segment")["mirror_image"])
    write_table(job.folder / "measures.json", table)
    cavity_ml = np.array(table["volumes_ml"]["lv_endocardium"])
    return _headline(table) | {
        "end_systole": {
            "phase": round(end_systole(phases, cavity_ml), 3),
            "usual": round(systole_s(rr_s) / rr_s, 3),
        },
        "triangles": {name: len(moving.triangles) for name, moving in found.surfaces.items()},
        "mended_phases": found.mended_phases,
        "crossing_triangles": found.crossing_triangles,
        "left_out_ml": found.left_out_ml,
        "off_mm": found.off_mm,
        "misfit_ml": found.misfit_ml,
        "left_out": found.left_out,
    }


def _headline(table: dict[str, Any]) -> dict[str, Any]:
    """What a table of many patients shows: volumes, ejection, mass, and thickness of the wall."""
    diastole, systole = table["end_diastole"], table["end_systole"]
    thickness = table["lv_wall_thickness_mm"]["mean"]
    return {
        "volumes_ml": table["volumes_ml"],
        "lv_ejection_fraction": table["lv_ejection_fraction"],
        "rv_ejection_fraction": table["rv_ejection_fraction"],
        "lv_mass_g": round(mean_lv_mass_g(table), 1),
        "lv_wall_thickness_mm": {
            "end_diastole": thickness[diastole],
            "end_systole": thickness[systole],
        },
    }
