"""Draw training images of a tissue block: other grey values, shape and faults every time.

This is not the MR simulator of `data_synth.mr`: nothing here follows from relaxation times, so a
network that is good on simulated cine has not merely learned its simulator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import (
    IN_HEART,
    LABEL_OF,
    USUAL_CONTRAST,
    Contrast,
    draw_contrast,
)
from data_synth.training.coverings import Coverings
from data_synth.training.decor import Decor
from data_synth.training.ends import (
    far_right_ventricle,
    first_ventricle,
    low_atrium,
    lowest_atrium,
    other_tip,
    shut_tip,
)
from data_synth.training.faults import smooth_noise, spoil, spoil_little, windowed
from data_synth.training.rare import bulged, draw_scar, scarred, thick_right_walled
from data_synth.training.sizes import Places, ill_shape, other_sizes, other_span, swollen
from data_synth.training.walls import (
    laid_bare,
    last_ring,
    long_walled,
    thick_walled,
    thin_walled,
    whole_septum,
)

Float = npt.NDArray[np.floating]
Float32 = npt.NDArray[np.float32]
Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

CROP = 128
"""Pixels along each side of a training image."""

NEIGHBOUR = 3
"""Planes from a slice to its neighbour: the labels to learn lie a third of that apart."""

REACH = NEIGHBOUR + 2
"""Planes on either side of the middle one that take part in an image."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Which parts of an image are drawn at random; each can be left out to see what it is worth."""

    shape: bool = True
    """Bends, swelling, stretch, and turns of any size."""

    contrast: bool = True
    """Grey values of tissues; else those of one scanner."""

    detail: bool = True
    """Trabeculae, papillary muscles, fat, organs and vessels that the phantom lacks."""

    faults: bool = True
    """Shading, blur, motion, bands, ghosts and grey scale; else noise alone."""

    neighbours: bool = True
    """Slices that stray between breath-holds, and missing neighbours."""

    rims: bool = True
    """Thin walls, dark rims around the heart, and planes that barely cut a ventricle: what is
    easily mistaken, shown more often than it occurs."""

    bare: bool = True
    """Hearts that lung and organs touch, without fat between: else a wall's outside could be
    guessed from how far off they are."""

    fine: bool = True
    """Walls that are thick in places, fat and pericardium in layers finer than a pixel, chambers
    and aorta of any size each, jets of blood, septa without trabeculae, and a window of frequencies
    that rings at edges."""

    base: bool = True
    """Left ventricles whose walls keep their thickness up to the valves, where they stand beside
    the right atrium; and walls thicker still."""

    ends: bool = True
    """Tips of any bluntness, with no vessel that looks like one below them, and right atria that
    come down beside the left ventricle."""

    ill: bool = True
    """Hearts at their worst: right ventricles so wide that they flatten the septum and reach past
    the tip, left ones nearly shut within a thick wall, or wide and thin."""

    rare: bool = True
    """Infarcts that leave a wall thin and bulging, right ventricles with thick walls, left ones
    full of trabeculae, and fluid about the heart."""

    span: bool = True
    """Right ventricles that reach farther about the left one, or less far."""

    filters: bool = True
    """Images sharpened, smoothed or cut off by a scanner's console."""

    mishaps: bool = True
    """Metal, the body folded over, spikes, noise of uneven strength, and lossy compression."""


ALL_PARTS = Parts()


@dataclass(frozen=True, slots=True)
class Sample:
    """One thing to learn."""

    image: Float32
    """``(3, row, column)``: the neighbour towards the apex, the slice, the one towards the base."""

    labels: Label
    """``(3, row, column)``: a third of the way towards the apex, at the slice, towards the base."""


def draw_sample(rng: np.random.Generator, block: Label, parts: Parts = ALL_PARTS) -> Sample:
    """Draw one image and its labels from a ``(plane, row, column)`` tissue block."""
    planes, end = _draw_planes(rng, block, parts)
    scar = draw_scar(rng, planes[REACH]) if parts.rare and rng.random() < 0.2 else None
    if scar is not None:
        planes = scarred(rng, planes, scar)
    bare = parts.bare and rng.random() < 0.55
    if bare:
        planes = laid_bare(rng, planes, skin=not parts.fine)
    contrast = draw_contrast(rng) if parts.contrast else USUAL_CONTRAST
    if parts.rare and rng.random() < 0.12:
        planes = thick_right_walled(planes, int(rng.integers(1, 5)))
        # So thick a wall is muscle like the left one's, and shares few pixels with others.
        mean = contrast.mean.copy()
        mean[Tissue.RV_WALL] = contrast.muscle * rng.uniform(0.85, 1.15)
        contrast = replace(contrast, mean=mean)
    slices = _thick_slices(rng, planes, contrast, parts, fat=not bare or rng.random() < 0.3)
    rows, columns = _draw_positions(rng, planes[REACH], parts.shape)
    if parts.fine and parts.shape:
        rows, columns = other_sizes(rng, planes[REACH], rows, columns)
    if parts.ill and parts.shape:
        rows, columns = ill_shape(rng, planes[REACH], rows, columns)
    if parts.span and parts.shape and rng.random() < 0.4:
        rows, columns = other_span(rng, planes[REACH], rows, columns)
    if scar is not None and parts.shape and rng.random() < 0.6:
        rows, columns = bulged(rng, scar, rows, columns)
    image = _seen(rng, slices, rows, columns, parts.neighbours and rng.random() < 0.7)
    if parts.neighbours:
        _drop_neighbours(rng, image, end)
    labels = LABEL_OF[planes[REACH - 1 : REACH + 2]]
    carried = [cv2.remap(one, columns, rows, cv2.INTER_NEAREST) for one in labels]
    if parts.fine and parts.faults and rng.random() < 0.45:
        image = windowed(rng, image)
    if parts.faults:
        image = spoil(rng, image, parts.filters, parts.mishaps)
    else:
        image = spoil_little(rng, image)
    return Sample(image, np.stack(carried))


def _seen(
    rng: np.random.Generator,
    slices: Float32,
    rows: Float32,
    columns: Float32,
    stray: bool,
) -> Float32:
    """The three slices at these places. Every one is a breath-hold of its own: where they ``stray``
    the heart does not come back to the millimetre."""
    image = np.empty((3, CROP, CROP), np.float32)
    strayed_px = rng.uniform(0.0, 2.2) if stray else 0.0
    for channel in range(3):
        shift = rng.normal(0.0, strayed_px, 2) if channel != 1 else (0.0, 0.0)
        image[channel] = cv2.remap(
            slices[channel],
            columns + np.float32(shift[0]),
            rows + np.float32(shift[1]),
            cv2.INTER_LINEAR,
        )
    return image


def _draw_planes(rng: np.random.Generator, block: Label, parts: Parts) -> tuple[Label, int]:
    """Planes about the one to learn, their walls drawn anew, and whether it may end its stack."""
    middle, end = _draw_plane(rng, block)
    if parts.rims and rng.random() < 0.25:
        middle, end = _draw_grazing_plane(rng, block), 0
    chance = rng.random() if parts.ends else 1.0
    ring = last_ring(block) if parts.base and rng.random() < 0.3 else None
    if chance < 0.4:
        block, middle, end = _draw_ends(rng, block, middle, end, atrium=chance < 0.2)
    elif ring is not None and REACH <= ring < len(block) - REACH - 5:
        farther = int(rng.integers(1, 6))
        block = long_walled(block, ring, farther)
        middle, end = ring + int(rng.integers(-1, farther + 3)), 0
    if parts.ill:
        block, middle, end = _draw_ill_ends(rng, block, middle, end)
    middle = int(np.clip(middle, REACH, len(block) - REACH - 1))
    planes = block[middle - REACH : middle + REACH + 1]
    if parts.fine:
        planes = whole_septum(planes)
    if parts.rims and rng.random() < 0.4:
        planes = thin_walled(planes, int(rng.integers(1, 4)))
    if parts.fine and rng.random() < 0.45:
        planes = thick_walled(rng, planes, rng.choice([5.5, 9.0]) if parts.base else 4.0)
    return planes, end


def _draw_ends(
    rng: np.random.Generator, block: Label, middle: int, end: int, atrium: bool
) -> tuple[Label, int, int]:
    """The block with another tip or right atrium, and a plane near it, if the block shows them."""
    if atrium:
        lowest = lowest_atrium(block)
        if lowest is not None and REACH < lowest < len(block) - REACH:
            farther = int(rng.integers(1, 7))
            drawn = low_atrium(rng, block, lowest, farther)
            return drawn, lowest + int(rng.integers(-farther - 1, 3)), 0
    else:
        first = first_ventricle(block)
        if first is not None and first >= 2:
            last, height = first + int(rng.integers(0, 6)), rng.uniform(1.0, 8.0)
            drawn = other_tip(rng, block, last, height)
            return drawn, round(last - height) + int(rng.integers(-1, 5)), 0
    return block, middle, end


def _draw_ill_ends(
    rng: np.random.Generator, block: Label, middle: int, end: int
) -> tuple[Label, int, int]:
    """The block with a far right ventricle or a left one shut towards its tip, now and then."""
    chance, first = rng.random(), first_ventricle(block)
    if chance > 0.24 or first is None:
        return block, middle, end
    if chance < 0.12:
        drawn, reach = far_right_ventricle(block, int(rng.integers(1, 8))), 8
    else:
        closed, over = first + int(rng.integers(0, 12)), int(rng.integers(0, 8))
        drawn, reach = shut_tip(block, closed, over), closed + over - first + 2
    if rng.random() < 0.6:
        return drawn, first + int(rng.integers(-4, reach)), 0
    return drawn, middle, end


def _draw_plane(rng: np.random.Generator, block: Label) -> tuple[int, int]:
    """A plane, and whether it may be the first (-1) or last (+1) of its stack.

    Mostly planes through the ventricles. Those about the tip, the valves and the roof are rare
    among all planes and the hardest, and many stacks end there.
    """
    first, last = REACH, len(block) - REACH - 1
    labels = LABEL_OF[block[first : last + 1, ::8, ::8]]
    cut = labels.any(axis=(1, 2))
    ventricles = ((labels > 0) & (labels <= LABEL_OF[Tissue.RV_CAVITY])).any(axis=(1, 2))
    chance = rng.random()
    if not cut.any() or chance < 0.08:
        return int(rng.integers(first, last + 1)), 0
    planes = first + np.flatnonzero(ventricles if ventricles.any() and chance < 0.78 else cut)
    if chance < 0.4 or chance >= 0.9:
        return int(rng.choice(planes)), 0
    end = -1 if chance < 0.6 else 1
    outermost = planes[0] if end < 0 else planes[-1]
    away = rng.integers(-NEIGHBOUR - 1, NEIGHBOUR + 1) * end
    return int(np.clip(outermost + away, first, last)), end


def _draw_grazing_plane(rng: np.random.Generator, block: Label) -> int:
    """A plane that cuts little of the left ventricle's muscle or of the right ventricle."""
    first, last = REACH, len(block) - REACH - 1
    labels = LABEL_OF[block[first : last + 1, ::4, ::4]]
    tissue = Tissue.LV_MYOCARDIUM if rng.random() < 0.6 else Tissue.RV_CAVITY
    area = (labels == LABEL_OF[tissue]).sum(axis=(1, 2))
    little = first + np.flatnonzero((area > 0) & (area < 0.25 * area.max()))
    return int(rng.choice(little) if len(little) else rng.integers(first, last + 1))


def _draw_positions(rng: np.random.Generator, plane: Label, shape: bool) -> Places:
    """Where in the plane each pixel of the image lies: row and column, ``(CROP, CROP)``."""
    heart = np.argwhere(LABEL_OF[plane[::4, ::4]]) * 4.0
    near = len(heart) > 0 and rng.random() < 0.9
    centre = heart.mean(axis=0) if near else np.array(plane.shape) / 2
    centre = centre + rng.normal(0.0, 14.0 if near else 30.0, 2)
    axis = np.arange(CROP) - (CROP - 1) / 2
    if not shape:
        rows, columns = np.meshgrid(centre[0] + axis, centre[1] + axis, indexing="ij")
        return rows.astype(np.float32), columns.astype(np.float32)
    turn = rng.normal(0.0, 0.5) if rng.random() < 0.88 else rng.uniform(-np.pi, np.pi)
    size, stretch = np.exp(rng.normal(0.0, 0.12)), np.exp(rng.normal(0.0, 0.07))
    across = axis[None, :] * size * stretch
    down = axis[:, None] * size / stretch
    if rng.random() < 0.8:
        knots = int(rng.integers(3, 8))
        # Bends grow with their length, so that no fold can arise.
        strength = rng.uniform(0.3, 3.5) * 4 / knots
        across = across + strength * smooth_noise(rng, CROP, knots)
        down = down + strength * smooth_noise(rng, CROP, knots)
    columns = centre[1] + np.cos(turn) * across - np.sin(turn) * down
    rows = centre[0] + np.sin(turn) * across + np.cos(turn) * down
    if rng.random() < 0.6:
        rows, columns = swollen(rng, plane, rows, columns)
    return rows.astype(np.float32), columns.astype(np.float32)


def _thick_slices(
    rng: np.random.Generator, planes: Label, contrast: Contrast, parts: Parts, fat: bool
) -> Float32:
    """Images of the three slices, each the average over its thickness; ``fat``: may be added."""
    side = planes.shape[-1]
    half = NEIGHBOUR * rng.uniform(0.5, 1.05) / 2
    offsets = np.arange(-2, 3)
    # Overlap of each plane's cell, one plane wide, with the slice's thickness.
    weights = np.clip(half + 0.5 - np.abs(offsets), 0, 1)
    weights = (weights / weights.sum()).astype(np.float32)
    grain = 0.7 * smooth_noise(rng, side, side // int(rng.integers(3, 8)))
    grain += 0.7 * smooth_noise(rng, side, int(rng.integers(4, 24)))
    decor = None
    if parts.detail:
        own = parts.rims and not parts.fine, fat and not parts.fine
        decor = Decor(rng, side, *own, fine=parts.fine, spongy=parts.rare)
    mean = contrast.mean.copy()
    if rng.random() < (0.65 if parts.fine else 0.5):
        # Balanced steady state at usual repetition times: fat is opposed, its borders are black.
        mean[Tissue.FAT] *= -1
    border_px = rng.uniform(0.35, 0.7)
    covers = None
    if parts.fine:
        covers = Coverings(rng, side, replace(contrast, mean=mean), fluid=parts.rare)
    if covers is not None:
        mean[Tissue.PERICARDIUM] = covers.sac
    images = np.empty((3, side, side), np.float32)
    middles = [REACH - NEIGHBOUR, REACH, REACH + NEIGHBOUR]
    heart = np.asarray(IN_HEART[planes[middles]].any(axis=0)) if parts.ends else None
    for channel, middle in enumerate(middles):
        near = planes[middle - 2 : middle + 3]
        grey = mean[near]
        if covers is not None:
            for number in np.flatnonzero(weights):
                covers.paint(grey[number], near[number])
        signed = np.tensordot(weights, grey, 1)
        images[channel] = np.abs(cv2.GaussianBlur(signed, (0, 0), border_px))
        images[channel] += contrast.texture[near[2]] * grain
        if decor is not None:
            decor.paint(images[channel], near[2], contrast, heart)
    return np.maximum(images, 0)


def _drop_neighbours(rng: np.random.Generator, image: Float32, end: int) -> None:
    """Repeat the slice in place of a neighbour, as at the ends of a stack."""
    chance = 0.6 if end else 0.08
    if rng.random() < (chance if end <= 0 else 0.05):
        image[0] = image[1]
    if rng.random() < (chance if end >= 0 else 0.05):
        image[2] = image[1]
