"""Anatomy put right: one body a structure, no islands, no holes."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.geometry import Float32, Label, Mask
from pipeline.imaging.labels import LABELS

NECK = (3, 3)
"""Rows and columns of the brush that bridges necks: parts up to two pixels apart are one body."""

OPEN_SHARE = 0.4
"""A cavity that borders on this share of background is not surrounded by its muscle."""

LEAP, LEAP_PIXELS = 1.4, 40
"""A cut through the ventricle may be so much larger, and so many pixels, than that of the plane
before it towards the tip: room for an aneurysm, which widens by degrees."""


def clean_probability(probability: Float32) -> Float32:
    """Take probability from structures where anatomy rules them out.

    The heart is one body and so is each of its structures; what lies enclosed by the heart in a
    plane belongs to it; the tip of the left ventricle is muscle. Where a structure is ruled out,
    the next most probable class takes over.

    Parameters
    ----------
    probability
        ``(plane, class, row, column)`` of one phase; class 0 is the background.

    Returns
    -------
    array of the same shape
        Sums to 1 over classes again wherever something was taken away.
    """
    labels = probability.argmax(axis=1).astype(np.uint8)
    box = _bounding_box(labels)
    if box is None:
        return probability
    cleaned = probability.copy()
    part = cleaned[box[0], :, box[1], box[2]]
    enclosed = _enclosed(labels[box] == 0)
    part[:, 1:] *= _largest_body((labels[box] > 0) | enclosed)[:, None]
    part[:, 0] *= ~enclosed
    _keep_bodies(part)
    _close_apex(part)
    # What took over where something was ruled out may be an island itself.
    _keep_bodies(part)
    total = part.sum(axis=1, keepdims=True)
    # All classes ruled out: background is what is left.
    part[:, 0] = np.where(total[:, 0] > 0, part[:, 0], 1)
    part /= np.maximum(part.sum(axis=1, keepdims=True), 1e-6)
    return cleaned


def _bounding_box(labels: Label) -> tuple[slice, slice, slice] | None:
    found = ndimage.find_objects((labels > 0).astype(np.uint8))
    if not found:
        return None
    planes, rows, columns = found[0]
    return planes, rows, columns


def _largest_body(mask: Mask) -> Mask:
    """The largest part and all that lies within `NECK` of it; the mask itself when empty."""
    # An auricle's neck may pass between two planes, or be thinner than the pixels.
    bridged = ndimage.binary_dilation(mask, np.ones((1, *NECK), bool))
    parts, count = ndimage.label(bridged, np.ones((3, 3, 3), bool))
    if count < 2:
        return mask
    parts *= mask
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == sizes.argmax())


def _keep_bodies(part: Float32) -> None:
    """Take every structure's probability outside its largest body, in place."""
    for value in LABELS.values():
        mask = part.argmax(axis=1) == value
        part[:, value] *= ~(mask & ~_largest_body(mask))


def _close_apex(part: Float32) -> None:
    """Take from the tip of the left ventricle what cannot be it, in place.

    From its widest plane towards the tip, the cavity ends where its muscle no longer surrounds
    it, and the ventricle where it would leap to a larger cut: bright fat around the tip looks
    like a cavity in a slice that only grazes the muscle, and its rim like muscle.
    """
    cavity, muscle = LABELS["lv_cavity"], LABELS["lv_myocardium"]
    labels = part.argmax(axis=1)
    inside, whole = labels == cavity, (labels == cavity) | (labels == muscle)
    widest = int((labels == muscle).sum(axis=(1, 2)).argmax())
    has_cavity = has_muscle = True
    for number in range(widest, -1, -1):
        above = min(number + 1, widest)
        border = labels[number][ndimage.binary_dilation(inside[number]) & ~inside[number]]
        surrounded = inside[number].any() and (border == 0).mean() < OPEN_SHARE
        has_muscle = has_muscle and not _leaps(whole[number], whole[above])
        leaps = _leaps(inside[number], inside[above])
        has_cavity = has_cavity and has_muscle and surrounded and not leaps
        # Nothing but muscle or background lies there: no other chamber reaches the tip.
        if not has_cavity:
            others = [value for value in LABELS.values() if value != muscle]
            part[number, others] *= ~inside[number]
        if not has_muscle:
            part[number, muscle] *= ~whole[number]


def _leaps(cut: Mask, above: Mask) -> bool:
    """Whether a body's cut is larger than the neighbouring one by more than anatomy allows."""
    return bool(cut.sum() > LEAP * above.sum() + LEAP_PIXELS)


def _enclosed(background: Mask) -> Mask:
    """Background that the heart encloses in its plane."""
    return np.stack([ndimage.binary_fill_holes(~plane) & plane for plane in background])
