"""Label the heart in every slice and phase of a cine, and carry it to an isotropic grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError, StageError
from pipeline.geometry import Float, Float32, Label
from pipeline.imaging.alignment import slice_shifts_mm
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import clean_probability
from pipeline.imaging.inference import (
    PlaneProbability,
    blend_phases,
    label_probability,
    locate_heart,
)
from pipeline.imaging.interpolation import isotropic_labels
from pipeline.imaging.labels import LABELS
from pipeline.imaging.settings import SegmentSettings
from pipeline.imaging.view import PIXEL_MM, View

Progress = Callable[[int, int], None]

LEAST_CUT = 0.25
"""A slice with less than this share of the largest cut through the heart is judged by the heart's
outline over all slices: where a slice grazes the tip, its few pixels are doubtful by nature."""

LEAST_SHARE = 0.2
"""A slice with less than this share of the heart that both its neighbours show has lost it."""


@dataclass(frozen=True, slots=True)
class Segmentation:
    """What `segment_cine` found."""

    labels: Label
    """``(phase, z, y, x)`` on the cine's pixels, as one would draw them on the images."""

    heart: Label
    """``(phase, Z, Y, X)`` on an isotropic grid, slice shifts corrected."""

    heart_mr_from_index: Float
    """4x4: ``(x, y, z)`` indices of ``heart`` to LPS mm."""

    confidence: Float
    """``(phase, z)`` in [0, 1]: mean probability of the labels chosen within the heart; where a
    slice shows little of it, within the heart's outline over all slices."""


def segment_cine(
    cine: Cine, settings: SegmentSettings, progress: Progress | None = None
) -> Segmentation:
    """Label cavities, muscle, atria and aorta by a network trained on synthetic images alone.

    ``progress`` is told of the phases done.

    Raises
    ------
    InputError
        When the images hold values that are not numbers.
    StageError
        When no heart is found, or a slice is not understood; slice and phase are named.
    """
    _require_finite(cine)
    found = label_probability(cine, locate_heart(cine), progress)
    # Judged before phases are mixed and islands removed, which would hide a spoilt image.
    seen = _drawn(found)
    confidence = slice_confidence(found, seen)
    _require_understood(seen, confidence, found.view, settings)
    blend_phases(found.value, settings.phase_blend * min(1.0, (len(cine.phases) / 25) ** 2))
    for phase, probability in enumerate(found.value):
        found.value[phase] = clean_probability(probability)
    drawn = _drawn(found)
    _require_ventricle(drawn, found.view, settings)
    heart, heart_mr_from_index = _isotropic(found, drawn, settings)
    labels = _on_cine(found, cine)
    stored = np.argsort(found.view.order)
    return Segmentation(labels, heart, heart_mr_from_index, confidence[:, stored])


def slice_confidence(found: PlaneProbability, drawn: Label) -> Float:
    """Mean probability of the labels chosen, ``(phase, slice)``, apex first.

    Over a slice's own heart, or, where it shows little of it, over the outline that the heart has
    in any slice of that phase: a slice beside the heart is understood if it is known as such.
    """
    confidence = np.empty(drawn.shape[:2])
    for phase, labels in enumerate(drawn):
        certainty = found.at_slices(phase).max(axis=1)
        outline = (labels > 0).any(axis=0)
        least = LEAST_CUT * (labels > 0).sum(axis=(1, 2)).max()
        for number, cut in enumerate(labels):
            mask = cut > 0
            region = mask if mask.sum() >= max(least, 1) else outline
            confidence[phase, number] = certainty[number][region].mean() if region.any() else 0.0
    return confidence


def _require_finite(cine: Cine) -> None:
    bad = ~np.isfinite(cine.intensity).all(axis=(2, 3))
    if bad.any():
        phase, number = np.argwhere(bad)[0]
        raise InputError(
            f"cine, phase {phase}, slice {number}: grey values must be finite numbers, got NaN or "
            "infinity; export the images again"
        )


def _drawn(found: PlaneProbability) -> Label:
    """Most probable labels on the slices, ``(phase, slice, row, column)``."""
    phases = range(len(found.value))
    return np.stack([found.at_slices(k).argmax(axis=1) for k in phases]).astype(np.uint8)


def _require_understood(
    drawn: Label, confidence: Float, view: View, settings: SegmentSettings
) -> None:
    """Refuse an image that shows no heart between two that do, or that the network doubts."""
    area = (drawn > 0).sum(axis=(2, 3))
    beside = np.minimum(area[:, :-2], area[:, 2:])
    gaps = np.argwhere(area[:, 1:-1] < LEAST_SHARE * beside)
    if len(gaps):
        phase, number = gaps[0]
        raise StageError(
            f"phase {phase}, slice {view.order[number + 1]}: no heart found, though the slices on "
            "both sides show it; check this image, or leave the slice out"
        )
    if confidence.min() < settings.min_confidence:
        worst = np.unravel_index(confidence.argmin(), confidence.shape)
        raise StageError(
            f"phase {worst[0]}, slice {view.order[worst[1]]}: the labels are not certain enough: "
            f"confidence {confidence.min():.2f}, at least {settings.min_confidence:.2f} is needed; "
            "check this image, or lower segment.min_confidence"
        )


def _require_ventricle(drawn: Label, view: View, settings: SegmentSettings) -> None:
    """Refuse a phase that shows no left ventricle to speak of."""
    ventricle = (drawn == LABELS["lv_cavity"]) | (drawn == LABELS["lv_myocardium"])
    volume_ml = ventricle.sum(axis=(1, 2, 3)) * PIXEL_MM**2 * view.slice_step_mm / 1000
    if volume_ml.min() < settings.min_ventricle_ml:
        raise StageError(
            f"phase {volume_ml.argmin()}, slices 0 to {len(view.order) - 1}: no heart found: the "
            f"left ventricle is {volume_ml.min():.0f} ml, at least "
            f"{settings.min_ventricle_ml:.0f} ml were expected; check the images, or lower "
            "segment.min_ventricle_ml"
        )


def _isotropic(
    found: PlaneProbability, drawn: Label, settings: SegmentSettings
) -> tuple[Label, Float]:
    """The heart on an isotropic grid along the view's axes, and that grid's place."""
    view = found.view
    shifts_mm = np.zeros((len(view.order), 2))
    if settings.correct_shifts:
        shifts_mm = slice_shifts_mm(drawn, PIXEL_MM, view.slice_step_mm, view.axes)
    volume, first_mm = isotropic_labels(
        found.value,
        PIXEL_MM,
        found.plane_mm,
        np.repeat(shifts_mm, found.planes_a_slice, axis=0),
        view.slice_step_mm,
        settings.grid_mm,
        settings.margin_mm,
    )
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = view.axes.T * settings.grid_mm
    mr_from_index[:3, 3] = view.corner_mm + first_mm @ view.axes
    return volume, mr_from_index


def _on_cine(found: PlaneProbability, cine: Cine) -> Label:
    """Labels on the cine's pixels, in its own order of slices."""
    labels = np.zeros(cine.intensity.shape, np.uint8)
    _, _, rows, columns = cine.intensity.shape
    for phase in range(len(labels)):
        probability = found.at_slices(phase)
        for number, z in enumerate(found.view.order):
            structures = [
                found.view.restore(p, number, (rows, columns)) for p in probability[number, 1:]
            ]
            # Outside the view nothing is probable: there background is what remains of 1.
            chance: Float32 = np.stack([1 - np.sum(structures, axis=0), *structures])
            labels[phase, z] = chance.argmax(axis=0)
    return labels
