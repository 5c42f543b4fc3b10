"""Anatomy put right: one body a structure, no islands, no holes, a closed and smooth ventricle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate, pairwise

import cv2
import numpy as np
from scipy import ndimage

from pipeline.geometry import Float32, Label, Mask
from pipeline.imaging.auricle import join_auricle
from pipeline.imaging.depth import depth_px
from pipeline.imaging.labels import CAVITY, LABELS, MUSCLE, most_probable
from pipeline.imaging.lookalikes import OPENINGS, part_from_right_heart, ventricle_cuts

THREADS = 2
"""The interpreter lock leaves nothing for more."""

NECK = (3, 3)
"""Rows and columns of the brush that bridges necks: parts up to two pixels apart are one body."""

HELD_BEATS, HELD_SHARE, HELD_MM3 = 0.12, 0.5, 300.0
"""Pieces beside a structure's body are no islands if within so much of the beat that body lies in
their place, by this share, both before and after, and if they are so large together: a slice taken
far aside, in another breath-hold, parts a right ventricle while it is thin."""

OPEN_SHARE = 0.4
"""A cavity that borders on this share of background is not surrounded by its muscle."""

LEAP, LEAP_MM2 = 1.4, 90.0
"""A cut through the ventricle may be so much larger, and by so much, than that of the plane before
it towards the tip: room for an aneurysm, which widens by degrees."""

GOES_ON = 0.25
"""A cavity does not end where rings beyond hold so much of what those before hold: fat beyond the
tip holds less."""

NOTCH_MM = 15.0
"""Muscle that a disc of this radius, rolled along the cavity's outline, cannot reach is drawn as
cavity: readers leave papillary muscles and trabeculae inside a smooth contour (Petersen et al.,
J. Cardiovasc. Magn. Reson. 19:18, 2017). A septum that bows inwards is wider, and stays."""

LEAST_WALL_MM = 3.0
"""Thickness at which a wall that the labels interrupt is closed; also what smoothing the cavity
leaves of one."""

CLOSED_SHARE = 0.6
"""A cavity with this share of muscle about it is taken for a ring that must be closed."""

STRAY_SHARE, BARE_SHARE = 0.3, 0.1
"""A cavity with less muscle about it is another chamber's, beside a ring and where none is."""


def clean_cycle(value: Float32, pixel_mm: float, step_mm: float) -> None:
    """Put the anatomy of all phases right, in place.

    The heart is one body and so is each of its structures; what lies enclosed by the heart in a
    plane belongs to it; the tip of the left ventricle is muscle; its cavity is drawn smooth, goes
    on from plane to plane without leaps, lies by its muscle, and has muscle all around it where it
    has muscle around most of it. Where a structure is ruled out, the next most probable class
    takes over; there all sum to 1 again.

    The plane at which the left ventricle ends is one for all phases, for its tip hardly moves while
    the base comes towards it. What falls apart in a phase, and is one body before it and after it,
    is kept whole.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)``, planes from the apex to the base; class 0 is the
        background.
    pixel_mm
        Distance between rows and between columns.
    step_mm
        Distance between planes.
    """
    tip = ventricle_tip(value, pixel_mm)
    fewest = HELD_MM3 / (pixel_mm**2 * step_mm)
    with ThreadPoolExecutor(THREADS) as pool:
        drawn = list(pool.map(most_probable, value))
        bodies = list(pool.map(_bodies, drawn))

        def clean(phase: int) -> None:
            held = _held(bodies, phase)
            parted = (held > 0) & (drawn[phase] == held) & (bodies[phase] != held)
            if np.bincount(held[parted], minlength=1).max() < fewest:
                held[:] = 0
            _clean_phase(value[phase], pixel_mm, tip, held)

        list(pool.map(clean, range(len(value))))


def _bodies(labels: Label) -> Label:
    """Labels of every structure's largest body alone."""
    bodies = np.zeros_like(labels)
    for value in LABELS.values():
        bodies[_largest_body(labels == value)] = value
    return bodies


def _held(bodies: Sequence[Label], phase: int) -> Label:
    """Structures whose bodies lie at a place both before a phase and after it; else 0."""
    count = len(bodies)
    reach = min(max(round(HELD_BEATS * count), 1), (count - 1) // 2)
    held = np.zeros_like(bodies[phase])
    if reach == 0:
        return held
    for value in LABELS.values():
        # Within so many steps on either side.
        before, after = (
            list(
                accumulate(
                    (bodies[(phase + way * step) % count] == value for step in range(1, reach + 1)),
                    np.logical_or,
                )
            )
            for way in (-1, 1)
        )
        # What falls apart for longer is held in none of its phases.
        for one, other in zip(before, reversed(after), strict=True):
            held[one & other] = value
    return held


def ventricle_tip(value: Float32, pixel_mm: float) -> int:
    """The plane nearest the apex that can hold the left ventricle, seen over all phases.

    From its widest plane towards the tip the ventricle ends where it would leap to a larger cut:
    bright fat around the tip looks like a cavity, and its rim like muscle.
    """
    cuts = ventricle_cuts(value)
    for number in range(int(cuts.argmax()) - 1, -1, -1):
        if _leaps(pixel_mm**2 * cuts[number], pixel_mm**2 * cuts[number + 1]):
            return number + 1
    return 0


def _clean_phase(probability: Float32, pixel_mm: float, tip: int, held: Label) -> None:
    """Take probability from structures where anatomy rules them out, in place.

    Parameters
    ----------
    probability
        ``(plane, class, row, column)``.
    tip
        First plane that can hold the left ventricle (`ventricle_tip`).
    held
        ``(plane, row, column)`` where structures lie before and after this phase: pieces of theirs
        that lie there are no islands.
    """
    found = ndimage.find_objects((most_probable(probability) > 0).view(np.uint8))
    if not found:
        return
    _, rows, columns = found[0]
    part, held = probability[:, :, rows, columns], held[:, rows, columns]
    join_auricle(part)
    part_from_right_heart(part, pixel_mm)
    labels = most_probable(part)
    enclosed = _enclosed(labels == 0)
    whole = (labels > 0) | enclosed
    # Beside the body what is less probable than the background stays: it tells where borders lie.
    part[:, 1:] *= ~(whole & ~_largest_body(whole, held > 0))[:, None]
    part[:, 0] *= ~enclosed
    _hold_cavity(part, pixel_mm)
    # Before islands are taken away: a papillary muscle is one, and its place is the cavity's.
    _smooth_cavity(part, pixel_mm)
    _bridge_cavity(part)
    _keep_bodies(part, held)
    _keep_ringed(part)
    _close_apex(part, tip, pixel_mm)
    # What took over where something was ruled out may be an island itself.
    _keep_bodies(part, held)
    _close_ring(part, pixel_mm)
    total = part.sum(axis=1, keepdims=True)
    # All classes ruled out: background is what is left.
    part[:, 0] = np.where(total[:, 0] > 1e-6, part[:, 0], 1)
    part /= np.maximum(part.sum(axis=1, keepdims=True), 1e-6)


def _largest_body(mask: Mask, held: Mask | None = None) -> Mask:
    """The largest part and all that lies within `NECK` of it; the mask itself when empty.

    Parts that lie where ``held`` tells stay, too.
    """
    found = ndimage.find_objects(mask.view(np.uint8))
    if not found:
        return mask
    # Parts that are bridged beyond this box are bridged within it too.
    inside = mask[found[0]]
    # An auricle's neck may pass between two planes, or be thinner than the pixels.
    bridged = ndimage.binary_dilation(inside, np.ones((1, *NECK), bool))
    parts, count = ndimage.label(bridged, np.ones((3, 3, 3), bool))
    if count < 2:
        return mask
    parts *= inside
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    largest = np.zeros_like(mask)
    kept = np.flatnonzero(sizes == sizes.max())[:1]
    if held is not None and held.any():
        shares = np.bincount(parts[held[found[0]]], minlength=len(sizes)) / np.maximum(sizes, 1)
        kept = np.append(kept, 1 + np.flatnonzero(shares[1:] >= HELD_SHARE))
    largest[found[0]] = np.isin(parts, kept)
    return largest


def _keep_bodies(part: Float32, held: Label) -> None:
    """Take every structure's probability outside its largest body, in place."""
    labels, unsettled = most_probable(part), set(LABELS.values())
    while unsettled:
        unsettled.remove(value := min(unsettled))
        mask = labels == value
        beside = mask & ~_largest_body(mask, held == value)
        if beside.any():
            part[:, value] *= ~beside
            labels[beside] = part.transpose(0, 2, 3, 1)[beside].argmax(axis=-1)
            # What takes over may be an island, too.
            unsettled.update(set(np.unique(labels[beside]).tolist()) & set(LABELS.values()))


def _keep_ringed(part: Float32) -> None:
    """Take from each plane the cavity that has next to no muscle about it, in place.

    What goes on from the plane before it towards the tip stays: up to the valves the ring opens.
    """
    before = np.zeros(part.shape[2:], bool)
    for chance, plane in zip(part, most_probable(part), strict=True):
        pieces, count = ndimage.label(plane == CAVITY, np.ones((3, 3), bool))
        numbers = range(1, count + 1)
        shares = np.array([_muscle_about(pieces == k, plane) for k in numbers])
        ring = count > 1 and shares.max() > CLOSED_SHARE
        goes_on = np.array([before[pieces == k].mean() >= 0.5 for k in numbers], bool)
        stray = (shares < (STRAY_SHARE if ring else BARE_SHARE)) & ~goes_on
        before = (pieces > 0) & ~np.isin(pieces, 1 + np.flatnonzero(stray))
        chance[CAVITY] *= before | (pieces == 0)


def _close_apex(part: Float32, tip: int, pixel_mm: float) -> None:
    """Take from the tip of the left ventricle what cannot be it, in place.

    Nothing of it lies before plane ``tip``; its cavity ends where muscle no longer surrounds it,
    or where it would leap to a larger cut (`_end_of_cavity`).
    """
    labels = most_probable(part)
    inside, whole = labels == CAVITY, (labels == CAVITY) | (labels == MUSCLE)
    # The widest ring: a thick wall of the right ventricle may be taken for more muscle than any.
    rings = np.array([_ringed(plane) > CLOSED_SHARE for plane in labels])
    rings[:tip] = False
    size = (inside * rings[:, None, None] if rings.any() else labels == MUSCLE).sum(axis=(1, 2))
    widest = int(size.argmax())
    end = _end_of_cavity(labels, rings, widest, tip, pixel_mm)
    for number in range(widest, -1, -1):
        # Nothing but muscle or background lies there: no other chamber reaches the tip.
        if number < end:
            others = [value for value in LABELS.values() if value != MUSCLE]
            part[number, others] *= ~inside[number]
        if number < tip:
            part[number, MUSCLE] *= ~whole[number]


def _end_of_cavity(labels: Label, rings: Mask, widest: int, tip: int, pixel_mm: float) -> int:
    """The plane nearest the tip that holds the cavity; ``widest + 1`` where none does.

    A plane in which much of the wall or of the cavity was missed, as papillary muscles that fill
    it or the void about metal make it, is no tip while rings go on beyond it.
    """
    cuts_mm2 = pixel_mm**2 * (labels == CAVITY).sum(axis=(1, 2))
    end, number = widest + 1, widest
    while number >= tip:
        last, inside = min(end, widest), labels[number] == CAVITY
        border = labels[number][ndimage.binary_dilation(inside) & ~inside]
        surrounded = inside.any() and (border == 0).mean() < OPEN_SHARE
        if surrounded and not _leaps(cuts_mm2[number], cuts_mm2[last]):
            end, number = number, number - 1
            continue
        beyond = np.flatnonzero(rings[:number])
        if cuts_mm2[beyond].sum() <= GOES_ON * cuts_mm2[last:].sum():
            break
        number = int(beyond[-1])
    return end


def _leaps(cut_mm2: float, above_mm2: float) -> bool:
    """Whether a body's cut is larger than the neighbouring one by more than anatomy allows."""
    return cut_mm2 > LEAP * above_mm2 + LEAP_MM2


def _hold_cavity(part: Float32, pixel_mm: float) -> None:
    """Hold the cavity within the ventricle of the rings on both sides where it leaps, in place."""
    labels = most_probable(part)
    cavity = labels == CAVITY
    ventricle = cavity | (labels == MUSCLE)
    cuts_mm2 = pixel_mm**2 * cavity.sum(axis=(1, 2))
    for number, below, above in _between_rings(labels):
        # An aneurysm, too, may lie between two rings, but widens by degrees.
        beside = (below + 1, below), (above - 1, above)
        sudden = any(_leaps(cuts_mm2[near], cuts_mm2[ring]) for near, ring in beside)
        if sudden and _leaps(cuts_mm2[number], max(cuts_mm2[below], cuts_mm2[above])):
            part[number, CAVITY] *= ventricle[below] | ventricle[above]


def _bridge_cavity(part: Float32) -> None:
    """Give muscle without a cavity the cavity that rings on both sides of it share, in place."""
    labels = most_probable(part)
    cavity = labels == CAVITY
    for number, below, above in _between_rings(labels):
        if not cavity[number].any():
            shared = cavity[below] & cavity[above] & (most_probable(part[number], axis=0) == MUSCLE)
            _hand_over(part[number], shared, CAVITY)


def _between_rings(labels: Label) -> Iterator[tuple[int, int, int]]:
    """Planes that show no ring, and for each the next on either side that does."""
    # Bright fat beyond the tip is no ring.
    rings = [k for k, plane in enumerate(labels) if _ringed(plane) > CLOSED_SHARE]
    for below, above in pairwise(rings):
        for number in range(below + 1, above):
            yield number, below, above


def _ringed(plane: Label) -> float:
    """Share of muscle in what the cavity borders on in a plane; 0 where there is no cavity."""
    return _muscle_about(plane == CAVITY, plane)


def _muscle_about(piece: Mask, plane: Label) -> float:
    """Share of muscle in what a piece of a plane borders on; 0 for an empty one."""
    # Beyond the planes' edge, which is the heart's box, there is no muscle.
    inside = np.pad(piece, 1)
    border = np.pad(plane, 1)[ndimage.binary_dilation(inside) & ~inside]
    return float((border == MUSCLE).mean()) if len(border) else 0.0


def _smooth_cavity(part: Float32, pixel_mm: float) -> None:
    """Draw as cavity the muscle in notches of the cavity's outline, in place."""
    disc = _disc(NOTCH_MM / pixel_mm)
    room = disc.shape[0]
    labels = most_probable(part)
    for number, plane in enumerate(labels):
        cavity = _largest_body((plane == CAVITY)[None])[0].astype(np.uint8)
        if not cavity.any():
            continue
        closed = cv2.morphologyEx(np.pad(cavity, room), cv2.MORPH_CLOSE, disc)[
            room:-room, room:-room
        ]
        ventricle = np.pad((plane == CAVITY) | (plane == MUSCLE), 1)
        deep = depth_px(ventricle)[1:-1, 1:-1] * pixel_mm > LEAST_WALL_MM
        _hand_over(part[number], (closed > 0) & (plane == MUSCLE) & deep, CAVITY)


def _close_ring(part: Float32, pixel_mm: float) -> None:
    """Put muscle where it is missing between a cavity that it surrounds and what is no cavity.

    Planes in which the cavity borders on an atrium or the aorta are left alone: there the ring is
    open.
    """
    disc = _disc(LEAST_WALL_MM / pixel_mm)
    for chance, plane in zip(part, most_probable(part), strict=True):
        cavity = plane == CAVITY
        if not cavity.any():
            continue
        around = (cv2.dilate(cavity.astype(np.uint8), disc) > 0) & ~cavity
        beside = plane[around]
        opens = np.isin(beside, [LABELS[name] for name in OPENINGS]).any()
        if not opens and (beside == MUSCLE).mean() > CLOSED_SHARE:
            gap = around & (plane != MUSCLE)
            chance[:, gap] = 0
            chance[MUSCLE, gap] = 1


def _hand_over(chance: Float32, where: Mask, value: int) -> None:
    """Give one class all that the ventricle's two have, ``(class, row, column)``, in place."""
    both = chance[CAVITY] + chance[MUSCLE]
    for one in (CAVITY, MUSCLE):
        chance[one][where] = both[where] if one == value else 0


def _disc(radius: float) -> Label:
    """A brush of ones within ``radius`` pixels."""
    reach = int(np.ceil(radius))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(np.hypot(rows, columns) <= radius, np.uint8)


def _enclosed(background: Mask) -> Mask:
    """Background that the heart encloses in its plane."""
    return np.stack([ndimage.binary_fill_holes(~plane) & plane for plane in background])
