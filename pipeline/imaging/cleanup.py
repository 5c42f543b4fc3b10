"""Anatomy put right: one body a structure, no islands, no holes."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.geometry import Float32, Label, Mask
from pipeline.imaging.labels import LABELS

NECK = (3, 3)
"""Rows and columns of the brush that bridges necks: parts up to two pixels apart are one body."""

AURICLE_VOXELS = 40
"""A smaller part of the left atrium beside its body is no auricle, but an island."""

NECK_STEPS = 10
"""Longest way, in voxels, from the body to an auricle through what is likely its neck."""

NECK_PROBABILITY = 0.15
"""Least geometric mean along that way of the probability of left atrium."""

NECK_BRUSH = np.zeros((3, 5, 5), bool)
NECK_BRUSH[1] = np.hypot(*np.mgrid[-2:3, -2:3]) < 2.5
NECK_BRUSH[[0, 2], 1:4, 1:4] = True
"""What is painted about the way: two pixels in its plane, one in the planes beside it."""

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
    _join_auricle(part)
    labels = part.argmax(axis=1).astype(np.uint8)
    enclosed = _enclosed(labels == 0)
    part[:, 1:] *= _largest_body((labels > 0) | enclosed)[:, None]
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


def _join_auricle(part: Float32) -> None:
    """Join parts of the left atrium that a thin neck parts, along the neck's likeliest way.

    The auricle's neck is thinner than the slices are apart, so that no slice may show it, yet the
    network gives it some probability. Other chambers are never taken from.
    """
    from skimage.graph import MCP_Geometric

    value = LABELS["left_atrium"]
    labels = part.argmax(axis=1)
    parts, count = ndimage.label(labels == value, np.ones((3, 3, 3), bool))
    sizes = np.bincount(parts.ravel())[1:]
    if count < 2 or np.sort(sizes)[-2] < AURICLE_VOXELS:
        return
    body = int(sizes.argmax()) + 1
    passable = (labels == 0) | (labels == value)
    likely = np.clip(part[:, value], 1e-3, 1)
    ways = MCP_Geometric(np.where(passable, 0.02 - np.log(likely), np.inf))
    costs, _ = ways.find_costs(np.argwhere(parts == body))
    for number in np.flatnonzero(sizes >= AURICLE_VOXELS) + 1:
        if number == body:
            continue
        ends = np.argwhere(parts == number)
        nearest = ends[costs[tuple(ends.T)].argmin()]
        if not np.isfinite(costs[tuple(nearest)]):
            continue
        way = np.array(ways.traceback(nearest))
        between = way[parts[tuple(way.T)] == 0]
        mean = np.exp(np.log(likely[tuple(between.T)]).mean()) if len(between) else 1.0
        if len(between) <= NECK_STEPS and mean >= NECK_PROBABILITY:
            neck = np.zeros(labels.shape, bool)
            neck[tuple(way.T)] = True
            neck = ndimage.binary_dilation(neck, NECK_BRUSH) & passable
            part[:, value][neck] = 1.0


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
