"""Detail in training images that the phantom's tissue blocks lack."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, IS_BLOOD, Contrast
from data_synth.training.faults import smooth_noise

Float = npt.NDArray[np.floating]
Float32 = npt.NDArray[np.float32]
Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


MOST_IN_HEART = 0.3
"""Share of a vessel's or bowel's oval that may lie where another slice shows the heart."""


class Decor:
    """Detail that the tissue block lacks, the same through the three slices of an image.

    Trabeculae and papillary muscles lie inside the cavities' labels: the contour to learn is the
    smooth one that a reader draws.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        side: int,
        rims: bool,
        fat: bool,
        fine: bool = True,
        spongy: bool = False,
    ) -> None:
        self.fine = smooth_noise(rng, side, side // int(rng.integers(3, 9)))
        self.coarse = [smooth_noise(rng, side, int(rng.integers(4, 20))) for _ in range(3)]
        self.organ = rng.uniform(0.0, 1.4, 3)
        self.organ_level = rng.uniform(0.5, 2.5, 3)
        self.organs = int(rng.integers(0, 4))
        self.fat_px = rng.uniform(-6.0, 8.0) if fat else 0.0
        # Mostly fat; an effusion, an organ or lung may lie against the heart as well.
        self.fat = rng.uniform(0.3, 1.6) if rng.random() < 0.75 else rng.uniform(0.0, 1.2)
        self.tubes = rng.uniform(0.0, 1.0, (int(rng.integers(0, 5)), 5))
        self.strands = {
            Tissue.LV_CAVITY: _Strands.draw(rng, 6.0),
            Tissue.RV_CAVITY: _Strands.draw(rng, 12.0),
        }
        self.papillaries = _draw_papillaries(rng)
        self.edge_px = rng.uniform(0.4, 1.0)
        self.flow = rng.uniform(0.0, 0.25) if rng.random() < 0.5 else 0.0
        self.rims = rng.uniform(0.0, 0.5, 2) * (rng.random(2) < 0.5) if rims else np.zeros(2)
        self.rim_px = rng.uniform(0.8, 1.6, 2) if rims else np.ones(2)
        self.jets = (
            rng.uniform(0.0, 1.0, (int(rng.integers(1, 5)), 5)) if fine else np.empty((0, 5))
        )
        if fine and rng.random() < 0.7:
            self.jets = self.jets[:0]
        self.septum_bare = fine and rng.random() < 0.5
        if spongy and rng.random() < 0.12:
            self.strands[Tissue.LV_CAVITY] = _Strands.dense(rng)

    def paint(
        self, image: Float32, tissue: Label, contrast: Contrast, heart: Mask | None = None
    ) -> None:
        """Add the detail to one slice in place.

        Parameters
        ----------
        tissue
            That of the slice's middle plane.
        heart
            Where any of the image's slices shows the heart; by default where this one does.
        """
        inside = IN_HEART[tissue]
        outside = ~inside & (tissue != Tissue.AIR)
        for number in range(self.organs):
            blob = outside & (self.coarse[number] > self.organ_level[number])
            image[blob] = 0.3 * image[blob] + 0.7 * self.organ[number]
        if self.fat_px > 0 and inside.any():
            away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 3)
            reach_px = self.fat_px + 3 * self.coarse[0]
            image[outside & (away < reach_px)] = self.fat
            # The pericardium around the fat, and the black line where fat meets muscle.
            around = (away >= reach_px, away < reach_px + self.rim_px[0])
            self._darken(image, outside & around[0] & around[1], self.rims[0])
            self._darken(image, outside & (away < self.rim_px[1]), self.rims[1])
        self._add_tubes(image, outside, contrast, inside if heart is None else heart)
        blood = IS_BLOOD[tissue]
        image[blood] *= (1 + self.flow * self.coarse[1])[blood]
        _darken_jets(image, blood, self.jets)
        muscle = np.zeros_like(image)
        for chamber, strands in self.strands.items():
            cavity = tissue == chamber
            # Most trabeculae of the right ventricle spring from its free wall.
            bare = self.septum_bare and chamber == Tissue.RV_CAVITY
            beside = cavity | (tissue == Tissue.LV_MYOCARDIUM) if bare else cavity
            strands.paint(muscle, cavity, beside, self.fine, self.coarse[2])
        _paint_papillaries(muscle, tissue == Tissue.LV_CAVITY, self.papillaries)
        if muscle.any():
            muscle = cv2.GaussianBlur(muscle, (0, 0), self.edge_px)
            image += np.where(blood, muscle, 0) * (contrast.muscle - image)

    def _darken(self, image: Float32, where: Mask, grey: float) -> None:
        if grey > 0:
            image[where] = np.minimum(image[where], grey)

    def _add_tubes(self, image: Float32, outside: Mask, contrast: Contrast, heart: Mask) -> None:
        """Bright ovals with a dark rim: vessels and bowels that belong to no structure.

        One that would lie where another slice shows the heart is left out of this one: it would
        look just as the heart's tip does.
        """
        side = image.shape[0]
        for row, column, size, shape, grey in self.tubes:
            centre = (column * side, row * side)
            axes = ((2 + 12 * size) * 2, (2 + 12 * size) * (0.8 + shape))
            drawn = []
            for grown in (3.0, 0.0):
                oval = np.zeros(image.shape, np.uint8)
                box = (centre, (axes[0] + grown, axes[1] + grown), 180 * grey)
                cv2.ellipse(oval, box, 1, cv2.FILLED)
                drawn.append((oval > 0) & outside)
            if np.count_nonzero(drawn[0] & heart) > MOST_IN_HEART * np.count_nonzero(drawn[0]):
                continue
            image[drawn[0]] = contrast.muscle * 0.8
            image[drawn[1]] = 0.5 + 0.7 * grey


@dataclass(frozen=True, slots=True)
class _Strands:
    """Trabeculae along a chamber's wall."""

    depth_px: float
    """How far they reach into the cavity; 0 where there are none."""

    level: float
    """Of a smooth noise of unit variance, above which muscle stands; rises with depth."""

    share: float
    """Of muscle in a pixel."""

    most: float = 0.6
    """How far they reach at most, of the way to the chamber's middle."""

    @classmethod
    def draw(cls, rng: np.random.Generator, deepest_px: float) -> _Strands:
        """Draw them for one chamber; three in four have some, a few are nearly filled."""
        depth_px = rng.uniform(0.5, deepest_px) if rng.random() < 0.75 else 0.0
        if rng.random() < 0.05:
            depth_px = 2 * deepest_px
        return cls(depth_px, rng.uniform(-0.7, 1.2), rng.uniform(0.2, 1.0))

    @classmethod
    def dense(cls, rng: np.random.Generator) -> _Strands:
        """Draw those of a wall that never became compact."""
        return cls(*rng.uniform((5.0, -0.5, 0.6, 0.6), (16.0, 0.6, 1.0, 1.3)))

    def paint(
        self, muscle: Float32, cavity: Mask, beside: Mask, fine: Float32, coarse: Float32
    ) -> None:
        """Raise the share of muscle in place where strands stand in ``cavity``.

        They spring from the outline of ``beside``, which holds the cavity.
        """
        if self.depth_px == 0 or not cavity.any():
            return
        depth = cv2.distanceTransform(beside.astype(np.uint8), cv2.DIST_L2, 3)
        deepest_px = self.most * float(depth[cavity].max())
        limit = min(self.depth_px, deepest_px) * (1 + 0.5 * coarse)
        above = self.level + 0.5 * (depth / np.maximum(limit, 0.3) - 0.5)
        muscle[cavity & (depth < limit) & (fine > above)] = self.share


def _draw_papillaries(rng: np.random.Generator) -> Float:
    """Papillary muscles ``(n, 5)``: angle, depth, length, width (shares of radius), turn."""
    count = int(rng.integers(1, 5)) if rng.random() < 0.65 else 0
    low, high = (0.0, 0.35, 0.12, 0.06, -0.6), (2 * np.pi, 1.0, 0.4, 0.26, 0.6)
    return rng.uniform(low, high, (count, 5))


def _paint_papillaries(muscle: Float32, cavity: Mask, papillaries: Float) -> None:
    """Fill ovals that point to the middle of the cavity with muscle, in place."""
    if not len(papillaries) or not cavity.any():
        return
    where = np.argwhere(cavity)
    centre, radius = where.mean(axis=0), np.sqrt(len(where) / np.pi)
    for angle, depth, length, width, turn in papillaries:
        row, column = centre + depth * radius * np.array([np.sin(angle), np.cos(angle)])
        oval = np.zeros(muscle.shape, np.uint8)
        box = ((column, row), (2 * length * radius, 2 * width * radius), np.degrees(angle + turn))
        cv2.ellipse(oval, box, 1, cv2.FILLED)
        muscle[(oval > 0) & cavity] = 1.0


def _darken_jets(image: Float32, blood: Mask, jets: Float) -> None:
    """Darken ovals of blood that flows too fast for its signal, in place.

    ``jets`` is ``(n, 5)``: which of the pixels of blood, length, width, darkness, turn; 0 to 1.
    """
    where = np.argwhere(blood) if len(jets) else jets
    if not len(where):
        return
    dark = np.zeros_like(image)
    for place, length, width, darkness, turn in jets:
        row, column = where[int(place * (len(where) - 1))]
        box = ((float(column), float(row)), (4 + 16 * length, 2 + 6 * width), 180 * turn)
        oval = np.zeros(image.shape, np.uint8)
        cv2.ellipse(oval, box, 1, cv2.FILLED)
        dark[oval > 0] = 0.8 * darkness
    image[blood] *= (1 - cv2.GaussianBlur(dark, (0, 0), 1.5))[blood]
