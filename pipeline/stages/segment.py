"""Segment: chambers and heart muscle in every phase, from the images alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.imaging.cut_off import cut_off, cut_sideways
from pipeline.imaging.labels import LABELS
from pipeline.imaging.segmentation import segment_cine
from pipeline.job import Job
from pipeline.products import (
    read_blank_ends,
    read_cine,
    read_long_axis,
    write_labels,
    write_table,
)


def run(job: Job) -> dict[str, Any]:
    """Write labels on the cine's own slices and the same heart on an isotropic grid."""
    cine = read_cine(job.products / "ingest")
    views = read_long_axis(job.products / "ingest")
    images = [view.cine for view in views]
    found = segment_cine(cine, job.settings.segment, job.progress, images)
    # On the files' own slices, so that labels drawn there by hand compare voxel by voxel.
    blank_ends = read_blank_ends(job.products / "ingest")
    write_labels(job.folder, "labels", found.labels, cine.mr_from_index, blank_ends)
    write_labels(job.folder, "heart", found.heart, found.heart_mr_from_index)
    write_table(job.folder / "labels.json", LABELS)
    write_table(
        job.folder / "confidence.json",
        {"confidence": np.round(found.confidence, 4).tolist(), "axes": ["phase", "slice"]},
    )
    voxel_ml = float(np.abs(np.linalg.det(found.heart_mr_from_index[:3, :3]))) / 1000
    volumes = {
        name: [round(float((volume == value).sum()) * voxel_ml, 1) for volume in found.heart]
        for name, value in LABELS.items()
    }
    lowest = np.unravel_index(np.nanargmin(found.confidence), found.confidence.shape)
    return {
        "lowest_confidence": round(float(found.confidence[lowest]), 3),
        "least_certain": {"phase": int(lowest[0]), "slice": int(lowest[1])},
        "cut_off": cut_off(found.labels),
        "cut_sideways": cut_sideways(found.labels, cine.intensity),
        "astray_mm": found.astray_mm,
        "flicker_beats": found.flicker_beats,
        "out_of_step": found.out_of_step,
        "views_agree": {one.name: lines for one, lines in zip(views, found.views, strict=True)},
        "orientation": str(found.orientation),
        "mirror_image": found.orientation.is_mirror_image,
        "reformatted": _reformatted(found.reformatted_deg, float(cine.spacing_mm[2])),
        "volumes_ml": volumes,
    }


def _reformatted(tilt_deg: float | None, step_mm: float) -> dict[str, float]:
    """How slices lie that others were drawn through: degrees off the left ventricle's axis, and
    how far apart; empty where they lie across it."""
    if tilt_deg is None:
        return {}
    return {"tilt_deg": round(tilt_deg, 1), "step_mm": round(step_mm, 2)}
