"""What looks like the aorta or an atrium and is not."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.geometry import Float, Float32, Mask
from pipeline.imaging.depth import depth_px
from pipeline.imaging.labels import CAVITY, LABELS, MUSCLE, most_probable

AORTA, RIGHT_HEART = LABELS["aorta"], (LABELS["rv_cavity"], LABELS["right_atrium"])

OPENINGS = ("left_atrium", "aorta")
"""What the left ventricle's cavity opens into."""

WAIST_MM = 1.5
"""Two discs are told apart where each is wider than the waist between them by twice this."""

SHARED = 0.15
"""Share of a disc that stands on the right heart, and on the aorta's root, where it is both."""

LEAST_DISC_MM2, LEAST_ROOT = 100.0, 0.25
"""The root must be this large beside the other disc, and this share of all that is taken: else it
is the root itself that stands on wrong labels, with a stray spot beside it."""

ATRIUM_TOO_OFTEN = 3.75
"""How much more often training shows right atrium than right ventricle where the two meet. Chosen
by Dice on 44 people of the second renderer and 8 phantoms, of 2.5 and 3.75; ten people and four
phantoms, and a network before, had told 2.5 from 1 and 6.7."""

ATRIUM_TOO_SELDOM = 1.4
"""How much more often a pixel at its border is left atrium than the network says. Chosen by Dice on
44 people of the second renderer and 8 phantoms, of 1, 1.4 and 2."""

CAVITY_TOO_SELDOM = 1.4
"""How much more often a pixel at their border is left cavity, not muscle, than the network says.
Chosen by Dice on 44 people of the second renderer and 8 phantoms, of 1, 1.4 and 2."""

LEAST_CUT = 0.1
"""A smaller share of the ventricle's widest cut does not make a plane its tip."""


def clear_apex(value: Float32) -> None:
    """Take left atrium and aorta from planes that are nearer to the tip than to the widest cut.

    A stomach beside the tip of the left ventricle is as round and grey as an atrium. Changes
    ``value`` in place; the background has what they had.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)``, planes from the apex to the base.
    """
    cuts = ventricle_cuts(value)
    widest = int(cuts.argmax())
    tip = int((cuts > LEAST_CUT * cuts[widest]).argmax())
    low = value[:, : tip + (widest - tip) // 2]
    for name in OPENINGS:
        low[:, :, 0] += low[:, :, LABELS[name]]
        low[:, :, LABELS[name]] = 0


def favour_right_ventricle(value: Float32) -> None:
    """Give back to the right ventricle what is right atrium because training showed that too often.

    For tricuspid planes that come down in systole many training images have the atrium beside the
    ventricle's last rings. A network's odds hold how often it was shown either: they are divided by
    how much too often that was (Saerens, Latinne and Decaestecker, Neural Comput 14:21-41, 2002).
    What a pixel is likely to be of the two together, and all else, stays. Changes ``value`` in
    place.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)`` probabilities.
    """
    _favour(value, "rv_cavity", "right_atrium", ATRIUM_TOO_OFTEN)


def favour_left_cavity(value: Float32) -> None:
    """Give the left ventricle's cavity the pixels at its border that the network calls muscle.

    Its odds against muscle are multiplied by one factor; what a pixel is likely to be of the two
    together, and all else, stays. Changes ``value`` in place.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)`` probabilities.
    """
    _favour(value, "lv_cavity", "lv_myocardium", CAVITY_TOO_SELDOM)


def _favour(value: Float32, favoured: str, other: str, factor: float) -> None:
    """Multiply the odds of one structure against another."""
    for part in value:
        gains, loses = (part[:, LABELS[name]] for name in (favoured, other))
        either = gains + loses
        odds = np.maximum(gains + loses / factor, np.finfo(np.float32).tiny)
        gains[:] = np.minimum(either * (gains / odds), either)
        loses[:] = either - gains


def favour_left_atrium(value: Float32) -> None:
    """Give the left atrium the pixels at its border that the network is a little too shy to give.

    Its odds against all else are multiplied by one factor. Changes ``value`` in place.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)`` probabilities.
    """
    for part in value:
        atrium = part[:, LABELS["left_atrium"]]
        whole = 1 + (ATRIUM_TOO_SELDOM - 1) * atrium
        atrium *= ATRIUM_TOO_SELDOM
        part /= whole[:, None]


def ventricle_cuts(value: Float32) -> Float:
    """Pixels of the left ventricle on each plane, mean over the phases."""
    drawn = (most_probable(probability) for probability in value)
    cuts = [np.isin(labels, (CAVITY, MUSCLE)).sum(axis=(1, 2)) for labels in drawn]
    return np.asarray(np.mean(cuts, axis=0))


def part_from_right_heart(part: Float32, pixel_mm: float) -> None:
    """Take from the aorta what goes on towards the apex as right heart, in place.

    Beside the aorta's root the right ventricle's outflow and the right atrium look like a second
    vessel: of the discs that stand side by side in a plane, those on the right heart's labels.
    Right heart or background takes over there, whichever is more probable.
    """
    labels = most_probable(part)
    right, root = np.isin(labels, RIGHT_HEART), np.zeros(labels.shape, bool)
    taken = np.zeros(labels.shape, bool)
    for number, plane in enumerate(labels == AORTA):
        beneath = right[number - 1] if number else np.zeros_like(plane)
        discs = _discs(plane, pixel_mm)
        on_right = [float(beneath[disc].mean()) for disc in discs]
        for disc, share in zip(discs, on_right, strict=True):
            on_root = float(root[number - 1][disc].mean()) if number else 0.0
            # Beside a disc that is the right heart's, another that stands on the root is it.
            if max(on_right) > 0.5 and 2 * share < on_root:
                continue
            # Where two discs have melted into one, each pixel goes with the nearer one beneath.
            if min(share, on_root) > SHARED:
                to_right = ndimage.distance_transform_edt(~beneath)
                taken[number] |= disc & (
                    to_right < ndimage.distance_transform_edt(~root[number - 1])
                )
            elif share > 0.5:
                taken[number] |= disc
        right[number] |= taken[number]
        root[number] = plane & ~taken[number]
    # A spot of aorta elsewhere is no root.
    disc_pixels = LEAST_DISC_MM2 / pixel_mm**2
    beside = (taken.sum(axis=(1, 2)) > disc_pixels) & (root.sum(axis=(1, 2)) > disc_pixels)
    if beside.any() and root.sum() > LEAST_ROOT * taken.sum():
        _hand_on(part, taken)


def _hand_on(part: Float32, taken: Mask) -> None:
    """Leave background and right heart alone, the more probable with all that others had."""
    chance = np.moveaxis(part, 1, -1)
    heirs = np.array([0, *RIGHT_HEART])
    left = np.zeros((np.count_nonzero(taken), part.shape[1]), np.float32)
    left[:, heirs] = chance[taken][:, heirs]
    left[np.arange(len(left)), heirs[left[:, heirs].argmax(axis=1)]] += 1 - left.sum(axis=1)
    chance[taken] = left


def _discs(plane: Mask, pixel_mm: float) -> list[Mask]:
    """Parts of a plane's label that waists part."""
    from skimage.morphology import h_maxima
    from skimage.segmentation import watershed

    found = ndimage.find_objects(plane.view(np.uint8))
    if not found:
        return []
    # With a rim of background, where the plane has one.
    box = tuple(slice(max(0, side.start - 1), side.stop + 1) for side in found[0])
    depth = depth_px(plane[box])
    middles, count = ndimage.label(h_maxima(depth, WAIST_MM / pixel_mm), np.ones((3, 3), bool))
    parts = np.zeros(plane.shape, np.int32)
    parts[box] = watershed(-depth, middles, mask=plane[box])
    return [parts == number for number in range(1, count + 1)]
