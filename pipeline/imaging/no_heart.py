"""Images in which no heart is found, or one that is not understood: refused by slice and phase."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.geometry import Float, Integer, Label, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.labels import CAVITY, LABELS, MUSCLE
from pipeline.imaging.settings import SegmentSettings
from pipeline.imaging.view import View

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

MOST_DOUBTED = 0.05
"""Share of all images that may be doubted beyond the left ventricle: of a patient's stack across
the body, which shows the heart in no short axis, a fifth was."""

LEAST_SHARE = 0.2
"""A slice with less than this share of the heart that both its neighbours show in one place is
spoilt."""

LEAST_SHARED_MM2 = 100.0
"""What both neighbours show in one place is no more than stray pixels beyond the tip if it is less:
a cut 11 mm wide."""


def require_contrast(cine: Cine) -> None:
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
            f"phase {', '.join(map(str, empty))} out of the files, and out of their times; those "
            "that were spread evenly need times of their own then, in NIfTI as timing.json"
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


def require_no_gap(drawn: Label, view: View) -> None:
    """Refuse an image that shows no heart between two that do: it is spoilt."""
    gaps = missed_hearts(drawn, view.pixel_mm)
    if len(gaps):
        phase, number = gaps[0]
        raise StageError(
            f"phase {phase}, slice {view.order[number]}: no heart found, though the slices on "
            "both sides show it; check this image. To do without the slice, draw it between its "
            f"neighbours: cine.spoilt_slices: [{view.order[number]}] in study.yaml"
        )


def require_understood(
    drawn: Label, confidence: Float, view: View, settings: SegmentSettings
) -> None:
    """Refuse images that the network doubts.

    A few beyond the left ventricle, of great vessels or of the belly, are borne: its surfaces do
    not hang on them.
    """
    low = confidence < settings.min_confidence
    if (low & _shows_left_ventricle(drawn)).any() or low.mean() > MOST_DOUBTED:
        worst = np.unravel_index(confidence.argmin(), confidence.shape)
        named = np.argwhere(low)
        others = ", ".join(f"{k}/{view.order[z]}" for k, z in named[:MOST_NAMED])
        many = "; do slices lie across the left ventricle, in its short axis?"
        # Rounded up it could read as the threshold that it is below.
        least = np.floor(100 * confidence.min()) / 100
        raise StageError(
            f"phase {worst[0]}, slice {view.order[worst[1]]}: the labels are not certain enough: "
            f"confidence {least:.2f}, at least {settings.min_confidence:.2f} is needed "
            f"({len(named)} images have less, phase/slice {others}"
            f"{' ...' if len(named) > MOST_NAMED else ''}); check them, do without a slice inside "
            "the stack (cine.spoilt_slices in study.yaml), or lower segment.min_confidence"
            f"{many if low.mean() > MOST_DOUBTED else ''}"
        )


def _shows_left_ventricle(drawn: Label) -> Mask:
    """``(slice,)``: whether cavity or muscle is drawn in half of the phases."""
    left = np.isin(drawn, (CAVITY, MUSCLE)).any(axis=(2, 3))
    return np.asarray(left.mean(axis=0) >= 0.5)


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
    blood = heart & (drawn != MUSCLE)
    shown = heart & blood.any(axis=(2, 3), keepdims=True)
    both = (shown[:, :-2] & shown[:, 2:]).sum(axis=(2, 3))
    missed = heart[:, 1:-1].sum(axis=(2, 3)) < LEAST_SHARE * both
    phases, between = np.nonzero(missed & (both * pixel_mm**2 > LEAST_SHARED_MM2))
    return np.stack([phases, between + 1], axis=1)


def require_ring(drawn: Label, view: View) -> None:
    """Refuse what has no left ventricle: a cavity that lies in its muscle or by other chambers."""
    cavity = drawn == CAVITY
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


def require_ventricles(drawn: Label, view: View, settings: SegmentSettings) -> None:
    """Refuse what lacks a left ventricle, its cavity or a right ventricle beside it."""
    _require_ventricle(drawn, view, settings)
    _require_cavity(drawn)
    _require_right_ventricle(drawn)


def _require_ventricle(drawn: Label, view: View, settings: SegmentSettings) -> None:
    """Refuse a phase that shows no left ventricle to speak of."""
    ventricle = np.isin(drawn, (CAVITY, MUSCLE))
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
    cavity, muscle = ((drawn == value).sum(axis=(1, 2, 3)) for value in (CAVITY, MUSCLE))
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
