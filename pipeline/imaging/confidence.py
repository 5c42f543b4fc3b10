"""How far the labels of each slice and phase can be trusted.

The network's own probability tells where an outline is vague, but not that an image is spoilt: of
noise it is certain that it is no heart. So it is weighed with what a beating heart must look like:
each image resembles its neighbours in time and space, and so do the labels on it.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
from scipy import ndimage

from pipeline.geometry import Float, Float32, Label, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.inference import PlaneProbability
from pipeline.imaging.network import neighbour_steps
from pipeline.imaging.view import View

LEAST_CUT = 0.25
"""Certainty is that of a cut larger by this share of the largest one, the part added as certain as
the heart's outline over all slices: where a slice grazes the tip, its few pixels are doubtful by
nature, and none would be left where it shows no heart."""

COMPARED_CUT = 0.35
"""The heart on a slice is compared with that on its neighbours where either shows this share of the
largest cut: the tip comes and goes with the beat."""

COARSE_MM = 3.0
"""Images are compared on pixels so large: noise and edges matter less."""

COMPARED = 48
"""Such pixels along each side of what is compared: 144 mm, the heart and what it lies in."""

FARTHEST_MM = 12.5
"""Slices farther apart than this need not look alike."""

ALIKE_IN_TIME = (0.0, 0.3)
ALIKE_IN_SPACE = (0.0, 0.25)
"""Correlation with the neighbouring image at which none of the network's certainty counts, and at
which all does. In phantoms the least of an unspoilt image was 0.59 between two phases as far apart
as end-diastole and end-systole, 0.41 between slices, and 0.33 at the ends of stacks."""

OVERLAP = (0.1, 0.4)
"""Dice of the heart with that on the neighbouring image, likewise; least unspoilt 0.53."""


def slice_confidence(cine: Cine, found: PlaneProbability, drawn: Label) -> Float:
    """Confidence in [0, 1] of each image, ``(phase, slice)``, apex first.

    The certainty of its labels, lessened where the image or the heart on it resembles neither
    that of the phase before nor of the one after, or neither neighbouring slice.

    Parameters
    ----------
    drawn
        ``(phase, slice, row, column)`` most probable labels on the slices.
    """
    heart = np.stack([_without_strays(labels > 0) for labels in drawn])
    area = heart.sum(axis=(2, 3))
    largest = np.maximum(area.max(axis=1, keepdims=True), 1)
    confidence = _certainty(found, heart)
    large = area >= COMPARED_CUT * largest
    images = _images(cine, found.view)
    before, after = np.roll(heart, 1, axis=0), np.roll(heart, -1, axis=0)
    confidence *= _ramp(_best_in_time(images), ALIKE_IN_TIME)
    overlap = np.maximum(_dice(heart, before), _dice(heart, after))
    known = large | np.roll(large, 1, axis=0) | np.roll(large, -1, axis=0)
    confidence *= np.where(known, _ramp(overlap, OVERLAP), 1)
    step = neighbour_steps(found.view.slice_step_mm)
    if step * found.view.slice_step_mm > FARTHEST_MM or step >= confidence.shape[1]:
        return confidence
    after = (images[:, step:] * images[:, :-step]).sum(axis=2)
    alike = _ramp(_best_in_space(after, step), ALIKE_IN_SPACE)
    # At an end there is one neighbour alone, and a slice that grazes the tip resembles nothing.
    number = np.arange(alike.shape[1])
    end = (number < step) | (number >= len(number) - step)
    alike[:, end] = (1 + alike[:, end]) / 2
    confidence *= alike
    overlap = _best_in_space(_dice(heart[:, step:], heart[:, :-step]), step)
    known = large & (overlap >= 0)
    return np.asarray(confidence * np.where(known, _ramp(overlap, OVERLAP), 1))


def _without_strays(heart: Mask) -> Mask:
    """What is taken for heart ``(slice, row, column)``, without what lies aside from it.

    Bowels and vessels beyond the tip, and a chest's wall or a liver beside it, are dropped later;
    they say nothing of how well the heart is understood. From its largest cut outwards a slice
    belongs to a body that overlaps the last one that does, with those of its parts alone that
    lie upon it; one in between may be spoilt, and is judged by all that it shows. The heart is the
    largest body: a stomach beyond the tip may have a larger cut, but on a slice or two.
    """
    left, best = heart.sum(axis=(1, 2)), np.zeros_like(heart)
    while left.sum() > best.sum():
        largest = int(left.argmax())
        body = heart.copy()
        first, last = (_last_reached(body, largest, step) for step in (-1, 1))
        body[:first] = False
        body[last + 1 :] = False
        left[first : last + 1] = 0
        if body.sum() > best.sum():
            best = body
    return best


def _last_reached(heart: Mask, start: int, step: int) -> int:
    """The last slice on the way from ``start`` that overlaps one before it, at most one between.

    In place, slices on the way lose the parts that lie aside from the one before.
    """
    last, number = start, start + step
    while 0 <= number < len(heart) and abs(number - last) <= 2:
        own = _parts_upon(heart[number], heart[last])
        if _dice(own[None, None], heart[None, [last]]) >= OVERLAP[0]:
            heart[number] = own
            last = number
        number += step
    return last


def _parts_upon(plane: Mask, before: Mask) -> Mask:
    """The connected parts of a plane that overlap what the plane before shows."""
    parts, _ = ndimage.label(plane, np.ones((3, 3), bool))
    return np.asarray(plane & np.isin(parts, parts[plane & before]))


def _certainty(found: PlaneProbability, heart: Mask) -> Float:
    """Dice that the network itself expects of its labels, ``(phase, slice)``.

    Twice the probability of the labels chosen, summed over the heart, over its pixels and the
    probability of any structure within its outline: what was taken for heart in vain and what was
    missed count alike.
    """
    certainty = np.empty(heart.shape[:2])
    for phase, slices in enumerate(heart):
        probability = found.at_slices(phase)
        outline = slices.any(axis=0)
        added = LEAST_CUT * slices.sum(axis=(1, 2)).max()
        for number, own in enumerate(slices):
            likely = probability[number].max(axis=0)
            sure = likely[outline].mean() if outline.any() else 0.0
            either = own.sum() + (1 - probability[number, 0][outline]).sum()
            agreed = 2 * likely[own].sum() + added * sure
            certainty[phase, number] = agreed / max(either + added, 1e-9)
    return certainty


def _images(cine: Cine, view: View) -> Float32:
    """The heart's surroundings in every image, of mean 0 and norm 1: ``(phase, slice, pixel)``."""
    coarse = view.varied(scale=COARSE_MM / view.pixel_mm)
    first = tuple((side - COMPARED) // 2 for side in view.shape)
    coarse = coarse.cropped((first[0], first[1]), (COMPARED, COMPARED))
    shape = len(cine.intensity), len(view.order)
    images = np.empty((*shape, COMPARED**2), np.float32)
    for phase, number in product(*map(range, shape)):
        image = coarse.sample(cine.intensity[phase, view.order[number]], number)
        known = coarse.holds(number, cine.intensity.shape[2:])
        # Beyond the field all images are alike, which says nothing.
        image = np.where(known, image - image[known].mean() if known.any() else 0, 0)
        images[phase, number] = cv2.GaussianBlur(image, (0, 0), 0.75).ravel()
    norm = np.linalg.norm(images, axis=2, keepdims=True)
    return np.asarray(images / np.maximum(norm, 1e-9), np.float32)


def _best_in_time(images: Float32) -> Float:
    """Correlation with the phase before or after, whichever is closer."""
    after = (images * np.roll(images, -1, axis=0)).sum(axis=2)
    return np.asarray(np.maximum(after, np.roll(after, 1, axis=0)), float)


def _best_in_space(after: Float | Float32, step: int) -> Float:
    """Likeness ``(phase, slice)`` to the slice ``step`` before or after, whichever is closer; -1
    where there is neither.

    ``after`` is that of each slice which has one to the slice ``step`` after it.
    """
    both = np.pad(after, ((0, 0), (step, step)), constant_values=-1)
    return np.asarray(np.maximum(both[:, :-step], both[:, step:]), float)


def _dice(one: Mask, other: Mask) -> Float:
    """Dice of masks ``(phase, slice, row, column)``, ``(phase, slice)``; 1 where both are empty."""
    total = one.sum(axis=(2, 3)) + other.sum(axis=(2, 3))
    both = 2 * (one & other).sum(axis=(2, 3))
    return np.where(total > 0, both / np.maximum(total, 1), 1.0)


def _ramp(value: Float, limits: tuple[float, float]) -> Float:
    low, high = limits
    return np.asarray(np.clip((value - low) / (high - low), 0, 1))
