"""Label the heart in every slice and phase of a cine, and carry it to an isotropic grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Integer, Label, Mask
from pipeline.imaging.alignment import ASTRAY_MM, slice_shifts_mm
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import clean_cycle
from pipeline.imaging.confidence import slice_confidence
from pipeline.imaging.cut_off import BODIES
from pipeline.imaging.dark_line import end_at_dark_line
from pipeline.imaging.faults import require_room_for_a_heart
from pipeline.imaging.in_step import out_of_step
from pipeline.imaging.inference import (
    PlaneProbability,
    blend_phases,
    bring_to_one_axis,
    label_probability,
    settle_tricuspid,
)
from pipeline.imaging.interpolation import class_margins, isotropic_labels
from pipeline.imaging.labels import LABELS, most_probable
from pipeline.imaging.locating import locate_heart
from pipeline.imaging.long_axis import NO_CROSSINGS, find_crossings
from pipeline.imaging.lookalikes import (
    clear_apex,
    favour_left_atrium,
    favour_left_cavity,
    favour_right_ventricle,
)
from pipeline.imaging.plain_blood import settle_plain_blood
from pipeline.imaging.settings import SegmentSettings
from pipeline.imaging.unrecorded import require_finite
from pipeline.imaging.view import Orientation, View
from pipeline.progress import Progress

FEWEST_GREYS = 16
"""Grey values of one phase; fewer are labels."""

LARGEST_BARE = 0.5
"""Share of the cavity's border, over all slices, at which neither muscle nor a chamber may lie."""

LEAST_CAVITY = 0.12
"""Of the left ventricle's muscle, in the phase that shows most of it: 60 ml within 400 g of muscle
are 0.16, the thickest of two renderers' hearts show 0.44, and what is no heart may look like muscle
with hardly a cavity: a drawn head shows 0.08."""

LEAST_RIGHT = 0.1
"""Of the left ventricle with its muscle, or of the atria where they are smaller: hearts of two
renderers show 0.4 and more, and stacks of the tip alone no atrium."""

MOST_NAMED = 8
"""Images that one message names."""

LEAST_SHARE = 0.2
"""A slice with less than this share of the heart that both its neighbours show in one place is
spoilt."""

LEAST_SHARED_MM2 = 100.0
"""What both neighbours show in one place is no more than stray pixels beyond the tip if it is less:
a cut 11 mm wide."""


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
    """``(phase, z)`` in [0, 1] (`pipeline.imaging.confidence.slice_confidence`)."""

    astray_mm: dict[int, float]
    """Slices whose heart lay farther aside than another usual breath-hold takes it, and how far."""

    out_of_step: dict[int, dict[str, float]]
    """Slices that do not beat with the others (`pipeline.imaging.in_step.out_of_step`)."""

    views: tuple[tuple[int, int], ...]
    """Along how many of the lines where each long-axis view crosses slices both agree, and of how
    many (`pipeline.imaging.long_axis`)."""

    orientation: Orientation
    """How the heart was found to lie, against what the file says. All products are in the file's
    frame, whichever it is."""


def segment_cine(
    cine: Cine,
    settings: SegmentSettings,
    progress: Progress | None = None,
    views: Sequence[Cine] = (),
) -> Segmentation:
    """Label cavities, muscle, atria and aorta by a network trained on synthetic images alone.

    ``progress`` is told of the phases done; ``views`` are long-axis views, a slice each, by which
    breath-hold shifts are found.

    Raises
    ------
    InputError
        When the images hold values that are not numbers, or are too small to show a heart.
    StageError
        When no heart is found, or a slice is not understood; slice and phase are named.
    """
    require_finite(cine, "cine")
    require_room_for_a_heart(cine, "cine")
    _require_contrast(cine)
    place = locate_heart(cine)
    found = label_probability(cine, place.view, settings.most_views, progress)
    clear_apex(found.value)
    favour_right_ventricle(found.value)
    favour_left_atrium(found.value)
    favour_left_cavity(found.value)
    # Judged before phases are mixed and islands removed, which would hide a spoilt image.
    seen = _drawn(found)
    _require_ring(seen, found.view)
    confidence = slice_confidence(cine, found, seen)
    _require_understood(seen, confidence, found.view, settings)
    settle_plain_blood(found, cine)
    settle_tricuspid(found.value)
    share = settings.phase_blend * min(1.0, (len(cine.phases) / 25) ** 2)
    blend_phases(found.value, share, cine.phases)
    step_mm = found.view.slice_step_mm / found.planes_a_slice
    clean_cycle(found.value, found.view.pixel_mm, step_mm)
    end_at_dark_line(found, cine)
    drawn = _drawn(found)
    _require_ventricle(drawn, found.view, settings)
    _require_cavity(drawn)
    _require_right_ventricle(drawn)
    crossings = find_crossings(cine, views, found.view, drawn) if views else NO_CROSSINGS
    acquired = np.flatnonzero(~np.isin(found.view.order, cine.interpolated))
    labels = _on_cine(found, cine)
    if bring_to_one_axis(found, cine):
        drawn = _drawn(found)
    shifts_mm = np.zeros((len(acquired), 3))
    if settings.correct_shifts:
        heights_mm = found.view.slice_step_mm * np.asarray(acquired, float)
        shifts_mm = slice_shifts_mm(
            drawn[:, acquired], found.view.pixel_mm, heights_mm, found.view.axes, crossings
        )
    heart, heart_mr_from_index = _isotropic(found, settings, shifts_mm, acquired)
    stored = np.argsort(found.view.order)
    numbers = np.asarray(found.view.order)[acquired]
    apart = out_of_step(drawn[:, acquired], cine.phases, found.view.pixel_mm)
    return Segmentation(
        labels,
        heart,
        heart_mr_from_index,
        confidence[:, stored],
        _astray_mm(shifts_mm, numbers),
        {int(numbers[place]): apart[place] for place in sorted(apart, key=lambda k: numbers[k])},
        tuple(crossings.agreement(k) for k in range(len(views))),
        place.orientation,
    )


def _astray_mm(shifts_mm: Float, numbers: Integer) -> dict[int, float]:
    """Slices moved by more than `ASTRAY_MM` in their plane, by number, and by how much."""
    aside_mm = np.hypot(shifts_mm[:, 0], shifts_mm[:, 1])
    return {
        int(number): round(float(mm), 1)
        for number, mm in sorted(zip(numbers, aside_mm, strict=True))
        if mm > ASTRAY_MM
    }


def _require_contrast(cine: Cine) -> None:
    """StageError where an image is of one grey value, or all are of a few, as labels are.

    What to do about an empty image hangs on where its slice lies.
    """
    greys = len(np.unique(cine.intensity[0]))
    if 1 < greys < FEWEST_GREYS:
        raise StageError(
            f"no heart found: phase 0 has {greys} grey values in all, as labels do; give the "
            "images that these were drawn on as the cine"
        )
    blank = np.ptp(cine.intensity, axis=(2, 3)) == 0
    if not blank.any():
        return
    if blank.all():
        raise StageError(
            "no heart found: all pixels of every image are alike; export the images again"
        )
    empty = np.flatnonzero(blank.all(axis=1))
    if len(empty):
        raise StageError(
            f"phase {empty[0]}: no heart found: all pixels of all its slices are alike; leave "
            f"phase {', '.join(map(str, empty))} out of the files, and out of their times"
        )
    phase, number = np.argwhere(blank)[0]
    spoilt = blank.any(axis=0)
    # From each end of the stack inwards, as far as slices are blank without a break.
    at_an_end = np.logical_and.accumulate(spoilt) | np.logical_and.accumulate(spoilt[::-1])[::-1]
    outer, inner = (_numbers(spoilt & where) for where in (at_an_end, ~at_an_end))
    advice = [f"leave slice {outer}, at an end of the stack, out of the files"] * bool(outer)
    if inner:
        advice.append(
            f"do without slice {inner}: cine.spoilt_slices: [{inner}] in study.yaml draws it "
            "between its neighbours"
        )
    raise StageError(
        f"phase {phase}, slice {number}: no heart found: all its pixels are alike; export the "
        f"images again, or {', and '.join(advice)}"
    )


def _numbers(which: Mask) -> str:
    return ", ".join(map(str, np.flatnonzero(which)))


def _drawn(found: PlaneProbability) -> Label:
    """Most probable labels on the slices, ``(phase, slice, row, column)``."""
    phases = range(len(found.value))
    return np.stack([most_probable(found.at_slices(k)) for k in phases])


def _require_understood(
    drawn: Label, confidence: Float, view: View, settings: SegmentSettings
) -> None:
    """Refuse an image that shows no heart between two that do, or that the network doubts."""
    gaps = missed_hearts(drawn, view.pixel_mm)
    if len(gaps):
        phase, number = gaps[0]
        raise StageError(
            f"phase {phase}, slice {view.order[number]}: no heart found, though the slices on "
            "both sides show it; check this image. To do without the slice, draw it between its "
            f"neighbours: cine.spoilt_slices: [{view.order[number]}] in study.yaml"
        )
    if confidence.min() < settings.min_confidence:
        worst = np.unravel_index(confidence.argmin(), confidence.shape)
        low = np.argwhere(confidence < settings.min_confidence)
        others = ", ".join(f"{k}/{view.order[z]}" for k, z in low[:MOST_NAMED])
        # Rounded up it could read as the threshold that it is below.
        least = np.floor(100 * confidence.min()) / 100
        raise StageError(
            f"phase {worst[0]}, slice {view.order[worst[1]]}: the labels are not certain enough: "
            f"confidence {least:.2f}, at least {settings.min_confidence:.2f} is needed "
            f"({len(low)} images have less, phase/slice {others}"
            f"{' ...' if len(low) > MOST_NAMED else ''}); check them, do without a slice inside "
            "the stack (cine.spoilt_slices in study.yaml), or lower segment.min_confidence"
        )


def missed_hearts(drawn: Label, pixel_mm: float) -> Integer:
    """Phase and slice, ``(n, 2)``, of images without the heart that both neighbours show.

    Parameters
    ----------
    drawn
        ``(phase, slice, row, column)`` labels.
    """
    heart = drawn > 0
    # What one of them shows elsewhere, as a vessel or a bowel beyond the tip, is no heart missed;
    # nor what looks like muscle alone, as fat in line with the tip.
    blood = heart & (drawn != LABELS["lv_myocardium"])
    shown = heart & blood.any(axis=(2, 3), keepdims=True)
    both = (shown[:, :-2] & shown[:, 2:]).sum(axis=(2, 3))
    missed = heart[:, 1:-1].sum(axis=(2, 3)) < LEAST_SHARE * both
    phases, between = np.nonzero(missed & (both * pixel_mm**2 > LEAST_SHARED_MM2))
    return np.stack([phases, between + 1], axis=1)


def _require_ring(drawn: Label, view: View) -> None:
    """Refuse what has no left ventricle: a cavity that lies in its muscle or by other chambers."""
    cavity = drawn == LABELS["lv_cavity"]
    cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)[None, None]
    border = ndimage.binary_dilation(cavity, cross) & ~cavity
    bare = (border & (drawn == 0)).sum(axis=(1, 2, 3)) / np.maximum(border.sum(axis=(1, 2, 3)), 1)
    bare[~cavity.any(axis=(1, 2, 3))] = 1.0
    if bare.max() > LARGEST_BARE:
        raise StageError(
            f"phase {bare.argmax()}, slices 0 to {len(view.order) - 1}: no heart found: of what "
            f"looks like the left ventricle's cavity, {100 * bare.max():.0f} % of the border has "
            f"no heart muscle, at most {100 * LARGEST_BARE:.0f} % were expected; check that the "
            "study is a cardiac cine, and leave series of other parts of the body out"
        )


def _require_ventricle(drawn: Label, view: View, settings: SegmentSettings) -> None:
    """Refuse a phase that shows no left ventricle to speak of."""
    ventricle = (drawn == LABELS["lv_cavity"]) | (drawn == LABELS["lv_myocardium"])
    volume_ml = ventricle.sum(axis=(1, 2, 3)) * view.pixel_mm**2 * view.slice_step_mm / 1000
    if volume_ml.min() < settings.min_ventricle_ml:
        raise StageError(
            f"phase {volume_ml.argmin()}, slices 0 to {len(view.order) - 1}: no heart found: the "
            f"left ventricle is {volume_ml.min():.0f} ml, at least "
            f"{settings.min_ventricle_ml:.0f} ml were expected; check the images, or lower "
            "segment.min_ventricle_ml"
        )


def _require_cavity(drawn: Label) -> None:
    """Refuse what looks like a left ventricle that is muscle throughout in all phases."""
    cavity, muscle = (
        (drawn == LABELS[name]).sum(axis=(1, 2, 3)) for name in BODIES["left ventricle"]
    )
    share = cavity / np.maximum(muscle, 1)
    if share.max() < LEAST_CAVITY:
        raise StageError(
            f"phase {share.argmax()}, slices 0 to {drawn.shape[1] - 1}: no heart found: what looks "
            f"like the left ventricle's cavity is {100 * share.max():.1f} % of what looks like its "
            f"muscle, no more in other phases, at least {100 * LEAST_CAVITY:.0f} % were expected; "
            "check that the study is a cardiac cine, and leave series of other parts of the body "
            "out"
        )


def _require_right_ventricle(drawn: Label) -> None:
    """Refuse what shows a left ventricle and atria, and hardly a right ventricle between them."""

    def pixels(*names: str) -> int:
        return int(np.isin(drawn, [LABELS[name] for name in names]).sum())

    left, right = pixels("lv_cavity", "lv_myocardium"), pixels("rv_cavity")
    if right < LEAST_RIGHT * min(left, pixels("left_atrium", "right_atrium")):
        raise StageError(
            f"slices 0 to {drawn.shape[1] - 1}: no heart found: beside what looks like a left "
            f"ventricle and atria lies a right ventricle of {100 * right / left:.0f} % of its size,"
            f" at least {100 * LEAST_RIGHT:.0f} % were expected; check that the study is a cardiac "
            "cine, and leave series of other parts of the body out"
        )


def _isotropic(
    found: PlaneProbability, settings: SegmentSettings, shifts_mm: Float, acquired: Integer
) -> tuple[Label, Float]:
    """The heart on an isotropic grid along the view's axes, and that grid's place.

    ``acquired`` are the slices, counted from the apex, that hold more than their neighbours' mean;
    ``shifts_mm`` ``(slice, 3)`` is taken from them.
    """
    view = found.view
    heights_mm = view.slice_step_mm * np.asarray(acquired, float)
    count = found.planes_a_slice
    planes = (count * acquired[:, None] + np.arange(count)).ravel()
    # Planes between two slices stay in line with both.
    moved_mm = np.interp(found.plane_mm[planes], heights_mm, shifts_mm[:, 2])
    volume, first_mm = isotropic_labels(
        found.value if len(acquired) == len(view.order) else found.value[:, planes],
        view.pixel_mm,
        found.plane_mm[planes] - moved_mm,
        np.repeat(shifts_mm[:, :2], count, axis=0),
        # What lies beyond the outer slices is theirs to half a step, planes between included.
        view.slice_step_mm / 2 + found.plane_mm[0],
        settings.grid_mm,
        settings.margin_mm,
        count,
    )
    volume, added = _with_margin(volume, round(settings.margin_mm / settings.grid_mm))
    first_mm = first_mm - (0, 0, added * settings.grid_mm)
    axes, corner_mm = view.axes, view.corner_mm + first_mm @ view.axes
    if np.linalg.det(axes) < 0:
        # Seen mirrored; stored unmirrored, since readers of surfaces count on right-handed grids.
        volume = np.ascontiguousarray(volume[..., ::-1])
        corner_mm = corner_mm + (volume.shape[-1] - 1) * settings.grid_mm * axes[0]
        axes = np.stack([-axes[0], axes[1], axes[2]])
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = axes.T * settings.grid_mm
    mr_from_index[:3, 3] = corner_mm
    return volume, mr_from_index


def _with_margin(volume: Label, margin: int) -> tuple[Label, int]:
    """Empty planes added where the heart reaches the stack's ends, and how many in front."""
    found = np.flatnonzero(volume.any(axis=(0, 2, 3)))
    if not len(found):
        return volume, 0
    before = max(0, margin - int(found[0]))
    after = max(0, margin - (volume.shape[1] - 1 - int(found[-1])))
    return np.pad(volume, ((0, 0), (before, after), (0, 0), (0, 0))), before


def _on_cine(found: PlaneProbability, cine: Cine) -> Label:
    """Labels on the cine's pixels, in its own order of slices."""
    labels = np.zeros(cine.intensity.shape, np.uint8)
    _, _, rows, columns = cine.intensity.shape
    for phase in range(len(labels)):
        probability = found.at_slices(phase)
        for number, z in enumerate(found.view.order):
            margins = class_margins(probability[number])
            # Outside the view, where restored values are 0, lies background.
            margins[0] -= 1
            margins[1:] += 1
            carried = [found.view.restore(one, number, (rows, columns)) for one in margins]
            chance: Float32 = np.stack([carried[0] + 2, *carried[1:]])
            labels[phase, z] = most_probable(chance, axis=0)
    return labels
