"""What a NIfTI file's header and voxels leave open, in words, for a person to judge."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry import Float, Float32, corners_apart_mm

MOST_LABELS = 10
"""No image of a scanner has so few grey values."""
SAME_PLACE_MM = 0.5
"""By which two placements of one stack may differ: less than a pixel."""

SAME_SIZE = 0.01
"""Share by which two sizes of one voxel may differ."""

LEAST_HEIGHT_MM = 60
"""No stack of fewer millimetres holds a heart from tip to valves."""


def doubts_of_size(edges_mm: Float, slices: int) -> tuple[str, ...]:
    """What speaks against the size of the voxels, in words: slices 1 mm apart are what becomes of
    arrays that are saved without a header, or with that of a single slice."""
    if slices >= LEAST_HEIGHT_MM or not np.isclose(edges_mm[2], 1, atol=1e-6):
        return ()
    return (
        f"the NIfTI header tells of voxels of {' x '.join(f'{edge:.4g}' for edge in edges_mm)} mm, "
        f"so of a heart in {slices} mm, as programs do that save an array alone; pixels of a cine "
        "are 1 to 2 mm wide, and its slices 5 to 10 mm apart: if so here, write the affine of the "
        "images that these were made of",
    )


def doubts_of_values(phase: Float32) -> tuple[str, ...]:
    """What speaks against the images of one phase ``(z, y, x)`` being images, in words."""
    values = np.unique(phase)
    few = 1 < len(values) <= MOST_LABELS
    if not few or not np.equal(np.mod(values, 1), 0).all():
        return ()
    held = ", ".join(f"{value:g}" for value in values)
    return (f"its voxels hold {held} alone, as a map of labels does: is it the cine?",)


def doubts_of_place(image: Any) -> tuple[str, ...]:
    """What the header's placements leave open, in words."""
    return (*_doubts_of_edges(image), *_doubts_of_placements(image))


def _doubts_of_edges(image: Any) -> tuple[str, ...]:
    """What the header's matrix and its list of sizes leave open: programs take either."""
    by_matrix = np.linalg.norm(image.affine[:3, :3], axis=0)
    by_list = np.array(image.header.get_zooms()[:3], dtype=float)
    if np.allclose(by_matrix, by_list, rtol=SAME_SIZE, atol=0):
        return ()
    taken, other = (" x ".join(f"{one:.4g}" for one in edges) for edges in (by_matrix, by_list))
    return (
        f"the NIfTI header's matrix has voxels of {taken} and its pixdim of {other}: the matrix is "
        "taken, and volumes go with it; which is right?",
    )


def _doubts_of_placements(image: Any) -> tuple[str, ...]:
    """What the header's sform and qform leave open."""
    by_sform, sform = image.get_sform(coded=True)
    by_qform, qform = image.get_qform(coded=True)
    if sform == 0 and qform == 0:
        return (
            "the NIfTI header places the images nowhere (its sform and qform codes are 0); they "
            "are taken to lie about the origin, so a tracker's or planner's own coordinates do "
            "not fit the field",
        )
    if sform == 0 or qform == 0:
        return ()
    off_mm = corners_apart_mm(by_sform, by_qform, image.shape[:3])
    if off_mm <= SAME_PLACE_MM:
        return ()
    return (
        f"the NIfTI header's sform and qform place the images up to {off_mm:.1f} mm apart; the "
        "sform is taken, and other programs may take the other",
    )


def doubts_of_step(step_ms: float, notes: Path) -> tuple[str, ...]:
    """What a converter's notes, a JSON file, say against the header's time step, in words."""
    try:
        repetition_s = float(json.loads(notes.read_text())["RepetitionTime"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ()
    if not math.isclose(1000 * repetition_s, step_ms, rel_tol=1e-3):
        return ()
    return (
        f"the header's time step of {step_ms:g} ms, by which the beat is told, is the "
        f"repetition time of {notes.name}: of a cine that is not always the time from phase to "
        "phase; give cine.rr_ms in study.yaml",
    )
