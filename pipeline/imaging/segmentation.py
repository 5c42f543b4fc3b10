"""Label the heart in every slice and phase of a cine, and carry it to an isotropic grid."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Integer, Label
from pipeline.imaging.alignment import ASTRAY_MM, slice_shifts_mm
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import THREADS, clean_cycle
from pipeline.imaging.confidence import slice_confidence
from pipeline.imaging.dark_line import end_at_dark_line
from pipeline.imaging.faults import require_room_for_a_heart
from pipeline.imaging.flicker import LEAST_MM2, settle_flicker
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
from pipeline.imaging.locating import Found, locate_heart
from pipeline.imaging.long_axis import NO_CROSSINGS, find_crossings
from pipeline.imaging.lookalikes import (
    clear_apex,
    favour_left_atrium,
    favour_left_cavity,
    favour_right_ventricle,
)
from pipeline.imaging.no_heart import (
    require_contrast,
    require_no_gap,
    require_ring,
    require_understood,
    require_ventricles,
)
from pipeline.imaging.plain_blood import settle_plain_blood
from pipeline.imaging.reformat import (
    Reformation,
    clear_beyond,
    confidence_on_acquired,
    labels_on_acquired,
    mix_in_own,
    reformat_to_short_axis,
)
from pipeline.imaging.settings import THIN_MM, SegmentSettings
from pipeline.imaging.unrecorded import require_finite
from pipeline.imaging.view import Orientation
from pipeline.progress import Progress


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

    flicker_beats: dict[int, float]
    """Slices on which a ventricle's labels came and went, and the width of their mean in time
    (`pipeline.imaging.flicker`)."""

    out_of_step: dict[int, dict[str, float]]
    """Slices that do not beat with the others (`pipeline.imaging.in_step.out_of_step`)."""

    views: tuple[tuple[int, int], ...]
    """Along how many of the lines where each long-axis view crosses slices both agree, and of how
    many (`pipeline.imaging.long_axis`)."""

    orientation: Orientation
    """How the heart was found to lie, against what the file says. All products are in the file's
    frame, whichever it is."""

    reformatted_deg: float | None = None
    """Where slices do not lie across the left ventricle: angle between their normal and its axis,
    along which others were drawn through them (`pipeline.imaging.reformat`)."""


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
    require_contrast(cine)
    refused = None
    if cine.spacing_mm[2] > THIN_MM:
        # Slices drawn through thick ones are blurred: the cine's own are better where understood.
        try:
            return _segment(cine, None, settings, progress, views)
        except StageError as error:
            # Without its frames, which hold the whole study's probabilities.
            refused = error.with_traceback(None)
    through = reformat_to_short_axis(cine)
    if through is None:
        if refused is not None:
            raise refused
        return _segment(cine, None, settings, progress, views)
    try:
        return _segment(through.cine, through, settings, progress, views)
    except StageError as error:
        if refused is not None:
            raise refused from error
        raise StageError(
            f"{error}. The cine's slices lie along the left ventricle: those named here are drawn "
            f"across it through them, {through.cine.spacing_mm[2]:.0f} mm apart and counted from "
            "the apex"
        ) from error


def _segment(
    cine: Cine,
    through: Reformation | None,
    settings: SegmentSettings,
    progress: Progress | None,
    views: Sequence[Cine],
) -> Segmentation:
    """Label slices across the left ventricle: a cine's own, or those drawn through a volume."""
    place = locate_heart(cine)
    found = _looked_at(cine, place, through, settings, progress)
    clear_apex(found.value)
    favour_right_ventricle(found.value)
    favour_left_atrium(found.value)
    favour_left_cavity(found.value)
    # Judged before phases are mixed and islands removed, which would hide a spoilt image.
    seen = found.drawn()
    require_ring(seen, found.view)
    confidence = slice_confidence(cine, found, seen)
    if through is None:
        require_no_gap(seen, found.view)
    require_understood(seen, confidence, found.view, settings)
    flicker = _put_right(found, cine, settings)
    drawn = found.drawn()
    require_ventricles(drawn, found.view, settings)
    crossings = find_crossings(cine, views, found.view, drawn) if views else NO_CROSSINGS
    if through is None:
        labels = _on_cine(found, cine)
        confidence = confidence[:, np.argsort(found.view.order)]
    else:
        labels = labels_on_acquired(found, through.acquired)
        confidence = confidence_on_acquired(confidence, found, through.acquired, labels)
    if bring_to_one_axis(found, cine):
        drawn = found.drawn()
    acquired = np.flatnonzero(~np.isin(found.view.order, cine.interpolated))
    heights_mm = found.view.slice_step_mm * np.asarray(acquired, float)
    shifts_mm = np.zeros((len(acquired), 3))
    if settings.correct_shifts:
        shifts_mm = slice_shifts_mm(
            drawn[:, acquired], found.view.pixel_mm, heights_mm, found.view.axes, crossings
        )
    heart, heart_mr_from_index = _isotropic(found, settings, shifts_mm, acquired)
    numbers = np.asarray(found.view.order)[acquired]
    apart = {}
    if through is None:
        apart = out_of_step(drawn[:, acquired], cine.phases, found.view.pixel_mm)
    return Segmentation(
        labels,
        heart,
        heart_mr_from_index,
        confidence,
        _astray_mm(shifts_mm, numbers),
        _flicker_beats(flicker, found, drawn),
        {int(numbers[place]): apart[place] for place in sorted(apart, key=lambda k: numbers[k])},
        tuple(crossings.agreement(k) for k in range(len(views))),
        place.orientation,
        None if through is None else through.tilt_deg,
    )


def _put_right(found: PlaneProbability, cine: Cine, settings: SegmentSettings) -> Float:
    """Mend in place what hearts and blood do not do; the widths of means (`settle_flicker`)."""
    settle_plain_blood(found, cine)
    flicker = settle_flicker(found.value, cine.phases, found.view.pixel_mm)
    settle_tricuspid(found.value)
    share = settings.phase_blend * min(1.0, (len(cine.phases) / 25) ** 2)
    blend_phases(found.value, share, cine.phases)
    step_mm = found.view.slice_step_mm / found.planes_a_slice
    clean_cycle(found.value, found.view.pixel_mm, step_mm)
    end_at_dark_line(found, cine)
    return flicker


def _looked_at(
    cine: Cine,
    place: Found,
    through: Reformation | None,
    settings: SegmentSettings,
    progress: Progress | None,
) -> PlaneProbability:
    """What the network sees in a cine's slices; where they are drawn through thin ones, in these,
    too."""
    if through is None:
        return label_probability(cine, place.view, settings.most_views, progress)
    both = through.acquired.spacing_mm[2] <= THIN_MM
    first = _half(progress, 0) if both else progress
    found = label_probability(cine, place.view, settings.most_views, first)
    if both:
        mix_in_own(found, through.acquired, place.orientation, _half(progress, 1))
    clear_beyond(found, through.acquired)
    return found


def _half(progress: Progress | None, number: int) -> Progress | None:
    """Of work in two equal halves, who is told of the first (0) or the second (1)."""
    if progress is None:
        return None
    return lambda done, total: progress(number * total + done, 2 * total)


def _astray_mm(shifts_mm: Float, numbers: Integer) -> dict[int, float]:
    """Slices moved by more than `ASTRAY_MM` in their plane, by number, and by how much."""
    aside_mm = np.hypot(shifts_mm[:, 0], shifts_mm[:, 1])
    return {
        int(number): round(float(mm), 1)
        for number, mm in sorted(zip(numbers, aside_mm, strict=True))
        if mm > ASTRAY_MM
    }


def _flicker_beats(widths_beats: Float, found: PlaneProbability, drawn: Label) -> dict[int, float]:
    """Of each slice that shows more than a tip of a ventricle, by its number, the widest mean of
    such labels, if any."""
    ventricles = [LABELS[name] for name in ("lv_cavity", "lv_myocardium", "rv_cavity")]
    area_mm2 = np.isin(drawn, ventricles).sum(axis=(2, 3)).max(axis=0) * found.view.pixel_mm**2
    of_ventricles = widths_beats[:, ventricles].max(axis=1)
    widest = of_ventricles.reshape(-1, found.planes_a_slice).max(axis=1)
    by_number = sorted(
        zip(found.view.order, np.where(area_mm2 >= LEAST_MM2, widest, 0).tolist(), strict=True)
    )
    return {number: width for number, width in by_number if width}


def _isotropic(
    found: PlaneProbability, settings: SegmentSettings, shifts_mm: Float, acquired: Integer
) -> tuple[Label, Float]:
    """The heart on an isotropic grid along the view's axes, and that grid's place.

    ``acquired`` are the slices, counted from the apex, that hold more than their neighbours' mean;
    ``shifts_mm`` ``(slice, 3)`` is taken from them.
    """
    view = found.view
    heights_mm = view.slice_step_mm * acquired
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


def _on_cine(found: PlaneProbability, cine: Cine) -> Label:
    """Labels on the cine's pixels, in its own order of slices."""
    labels = np.zeros(cine.intensity.shape, np.uint8)
    _, _, rows, columns = cine.intensity.shape

    def draw(phase: int) -> None:
        probability = found.at_slices(phase)
        for number, z in enumerate(found.view.order):
            margins = class_margins(probability[number])
            # Outside the view, where restored values are 0, lies background.
            margins[0] -= 1
            margins[1:] += 1
            carried = [found.view.restore(one, number, (rows, columns)) for one in margins]
            chance: Float32 = np.stack([carried[0] + 2, *carried[1:]])
            labels[phase, z] = most_probable(chance, axis=0)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(draw, range(len(labels))))
    return labels
