"""Draw training images of a tissue block: other grey values, shape and faults every time.

This is not the MR simulator of `data_synth.mr`: nothing here follows from relaxation times, so a
network that is good on simulated cine has not merely learned its simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, IS_BLOOD, LABEL_OF, Contrast, draw_contrast
from data_synth.training.faults import smooth_noise, spoil

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
class Sample:
    """One thing to learn."""

    image: Float32
    """``(3, row, column)``: the neighbour towards the apex, the slice, the one towards the base."""

    labels: Label
    """``(3, row, column)``: a third of the way towards the apex, at the slice, towards the base."""


def draw_sample(rng: np.random.Generator, block: Label) -> Sample:
    """Draw one image and its labels from a ``(plane, row, column)`` tissue block."""
    middle, end = _draw_plane(rng, block)
    planes = block[middle - REACH : middle + REACH + 1]
    contrast = draw_contrast(rng)
    slices = _thick_slices(rng, planes, contrast)
    rows, columns = _draw_positions(rng, planes[REACH])
    image = np.empty((3, CROP, CROP), np.float32)
    for channel in range(3):
        # Every slice is a breath-hold of its own: the heart does not come back to the millimetre.
        shift = rng.normal(0.0, 1.2, 2) if channel != 1 and rng.random() < 0.6 else (0.0, 0.0)
        image[channel] = cv2.remap(
            slices[channel],
            columns + np.float32(shift[0]),
            rows + np.float32(shift[1]),
            cv2.INTER_LINEAR,
        )
    _drop_neighbours(rng, image, end)
    labels = LABEL_OF[planes[REACH - 1 : REACH + 2]]
    carried = [cv2.remap(one, columns, rows, cv2.INTER_NEAREST) for one in labels]
    return Sample(spoil(rng, image), np.stack(carried))


def _draw_plane(rng: np.random.Generator, block: Label) -> tuple[int, int]:
    """A plane that cuts the heart, often at its tip (-1) or roof (+1); now and then any plane (0).

    Every stack has a slice on either side of tip and roof, which are rare among all planes.
    """
    first, last = REACH, len(block) - REACH - 1
    cut = LABEL_OF[block[first : last + 1, ::8, ::8]].any(axis=(1, 2))
    chance = rng.random()
    if not cut.any() or chance < 0.1:
        return int(rng.integers(first, last + 1)), 0
    planes = first + np.flatnonzero(cut)
    if chance < 0.65:
        return int(rng.choice(planes)), 0
    end = -1 if chance < 0.88 else 1
    tip = planes[0] if end < 0 else planes[-1]
    away = rng.integers(-NEIGHBOUR - 1, NEIGHBOUR + 1) * end
    return int(np.clip(tip + away, first, last)), end


def _draw_positions(rng: np.random.Generator, plane: Label) -> tuple[Float32, Float32]:
    """Where in the plane each pixel of the image lies: row and column, ``(CROP, CROP)``."""
    heart = np.argwhere(LABEL_OF[plane[::4, ::4]]) * 4.0
    near = len(heart) > 0 and rng.random() < 0.9
    centre = heart.mean(axis=0) if near else np.array(plane.shape) / 2
    centre = centre + rng.normal(0.0, 14.0 if near else 30.0, 2)
    turn = rng.normal(0.0, 0.4) if rng.random() < 0.9 else rng.uniform(-np.pi, np.pi)
    size, stretch = np.exp(rng.normal(0.0, 0.1)), np.exp(rng.normal(0.0, 0.05))
    axis = np.arange(CROP) - (CROP - 1) / 2
    across = axis[None, :] * size * stretch
    down = axis[:, None] * size / stretch
    if rng.random() < 0.7:
        knots = int(rng.integers(3, 8))
        # Bends grow with their length, so that no fold can arise.
        strength = rng.uniform(0.3, 3.0) * 4 / knots
        across = across + strength * smooth_noise(rng, CROP, knots)
        down = down + strength * smooth_noise(rng, CROP, knots)
    columns = centre[1] + np.cos(turn) * across - np.sin(turn) * down
    rows = centre[0] + np.sin(turn) * across + np.cos(turn) * down
    return rows.astype(np.float32), columns.astype(np.float32)


def _thick_slices(rng: np.random.Generator, planes: Label, contrast: Contrast) -> Float32:
    """Images of the three slices, each the average over its thickness."""
    side = planes.shape[-1]
    half = NEIGHBOUR * rng.uniform(0.5, 1.05) / 2
    offsets = np.arange(-2, 3)
    # Overlap of each plane's cell, one plane wide, with the slice's thickness.
    weights = np.clip(half + 0.5 - np.abs(offsets), 0, 1)
    weights = (weights / weights.sum()).astype(np.float32)
    grain = 0.7 * smooth_noise(rng, side, side // int(rng.integers(3, 8)))
    grain += 0.7 * smooth_noise(rng, side, int(rng.integers(4, 24)))
    decor = _Decor(rng, side)
    mean = contrast.mean.copy()
    if rng.random() < 0.5:
        # Balanced steady state at usual repetition times: fat is opposed, its borders are black.
        mean[Tissue.FAT] *= -1
    border_px = rng.uniform(0.35, 0.7)
    images = np.empty((3, side, side), np.float32)
    for channel in range(3):
        middle = REACH + NEIGHBOUR * (channel - 1)
        near = planes[middle - 2 : middle + 3]
        signed = np.tensordot(weights, mean[near], 1)
        images[channel] = np.abs(cv2.GaussianBlur(signed, (0, 0), border_px))
        images[channel] += contrast.texture[near[2]] * grain
        decor.paint(images[channel], near[2], contrast)
    return np.maximum(images, 0)


def _drop_neighbours(rng: np.random.Generator, image: Float32, end: int) -> None:
    """Repeat the slice in place of a neighbour, as at the ends of a stack."""
    chance = 0.6 if end else 0.08
    if rng.random() < (chance if end <= 0 else 0.05):
        image[0] = image[1]
    if rng.random() < (chance if end >= 0 else 0.05):
        image[2] = image[1]


class _Decor:
    """Detail that the tissue block lacks, the same through the three slices of an image.

    Trabeculae and papillary muscles lie inside the cavities' labels: the contour to learn is the
    smooth one that a reader draws.
    """

    def __init__(self, rng: np.random.Generator, side: int) -> None:
        self.fine = smooth_noise(rng, side, side // int(rng.integers(3, 9)))
        self.coarse = [smooth_noise(rng, side, int(rng.integers(4, 20))) for _ in range(3)]
        self.organ = rng.uniform(0.0, 1.4, 3)
        self.organ_level = rng.uniform(0.5, 2.5, 3)
        self.organs = int(rng.integers(0, 4))
        self.fat_mm = rng.uniform(-6.0, 8.0)
        self.fat = rng.uniform(0.3, 1.6)
        self.trabecula_px = rng.uniform(0.5, 6.0) if rng.random() < 0.7 else 0.0
        self.trabecula_level = rng.uniform(-0.5, 1.2)
        self.trabecula = rng.uniform(0.2, 1.0)
        self.papillary = rng.uniform(0.0, 2 * np.pi, 2) if rng.random() < 0.6 else np.empty(0)
        self.papillary_depth = rng.uniform(0.35, 0.75)
        self.papillary_size = rng.uniform(0.1, 0.28)
        self.flow = rng.uniform(0.0, 0.25) if rng.random() < 0.5 else 0.0

    def paint(self, image: Float32, tissue: Label, contrast: Contrast) -> None:
        """Add the detail to one slice in place; ``tissue`` is that of its middle plane."""
        inside = IN_HEART[tissue]
        outside = ~inside & (tissue != Tissue.AIR)
        for number in range(self.organs):
            blob = outside & (self.coarse[number] > self.organ_level[number])
            image[blob] = 0.3 * image[blob] + 0.7 * self.organ[number]
        if self.fat_mm > 0 and inside.any():
            away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 3)
            image[outside & (away < self.fat_mm + 3 * self.coarse[0])] = self.fat
        blood = IS_BLOOD[tissue]
        image[blood] *= (1 + self.flow * self.coarse[1])[blood]
        for cavity in (Tissue.LV_CAVITY, Tissue.RV_CAVITY):
            self._trabeculate(image, tissue == cavity, contrast.muscle)
        self._add_papillaries(image, tissue == Tissue.LV_CAVITY, contrast.muscle)

    def _trabeculate(self, image: Float32, cavity: Mask, muscle: float) -> None:
        if self.trabecula_px == 0 or not cavity.any():
            return
        depth = cv2.distanceTransform(cavity.astype(np.uint8), cv2.DIST_L2, 3)
        depth_limit = min(self.trabecula_px, 0.5 * float(depth.max()))
        strands = cavity & (depth < depth_limit) & (self.fine > self.trabecula_level)
        image[strands] += self.trabecula * (muscle - image[strands])

    def _add_papillaries(self, image: Float32, cavity: Mask, muscle: float) -> None:
        if not len(self.papillary) or not cavity.any():
            return
        where = np.argwhere(cavity)
        centre, radius = where.mean(axis=0), np.sqrt(len(where) / np.pi)
        rows, columns = np.ogrid[: cavity.shape[0], : cavity.shape[1]]
        for angle in self.papillary:
            row, column = centre + self.papillary_depth * radius * np.array(
                [np.sin(angle), np.cos(angle)]
            )
            near = np.hypot(rows - row, columns - column) < self.papillary_size * radius
            image[near & cavity] = muscle
