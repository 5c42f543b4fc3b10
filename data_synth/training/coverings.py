"""What covers a heart: layers of fat and pericardium, mostly thinner than a pixel.

A block's pixels are too coarse for them, yet they decide where a wall seems to end: fat whose
signal is opposed cancels the muscle's in a pixel that both share, and the dark line stands inside
the wall or outside it, as thick as the two happen to be.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, Contrast
from data_synth.training.faults import smooth_noise

Float32 = npt.NDArray[np.float32]
Label = npt.NDArray[np.uint8]


_DRY = np.isin(np.arange(256), (Tissue.BLOOD_VESSEL, Tissue.BONE, Tissue.MUSCLE))
"""Where no fluid gathers, for every tissue."""


class Coverings:
    """Layers on the outside of one heart, the same in all slices of an image."""

    def __init__(
        self, rng: np.random.Generator, side: int, contrast: Contrast, fluid: bool = False
    ) -> None:
        thick_px, chance = rng.uniform(0.0, 1.0), rng.random()
        if chance < 0.35:
            thick_px = 0.0
        elif chance < 0.75:
            thick_px *= 1.6
        else:
            thick_px = 1.6 + 6.0 * thick_px
        uneven = rng.uniform(0.0, 1.2) * smooth_noise(rng, side, int(rng.integers(3, 10)))
        self.fat_px = np.maximum(thick_px * (1 + uneven), 0)
        self.sac_px = rng.uniform(0.2, 1.3) if rng.random() < 0.6 else 0.0
        # Mostly fat; an effusion or an organ may lie against the heart as well.
        beside = rng.uniform(0.0, 1.2)
        self.fat = contrast.mean[Tissue.FAT] if rng.random() < 0.85 else beside
        # Fibrous and dark; as grey as muscle in a few, which no edge then tells apart.
        self.sac = contrast.muscle * (rng.uniform(0.0, 0.7) if rng.random() < 0.9 else 1.0)
        self.fluid_px, self.fluid = np.zeros_like(self.fat_px), 0.0
        if fluid and rng.random() < 0.12:
            # Between fat and pericardium, as bright as blood or brighter; it gathers in places.
            uneven = rng.uniform(0.0, 0.9) * smooth_noise(rng, side, int(rng.integers(2, 6)))
            self.fluid_px = np.clip(rng.uniform(1.5, 10.0) * (1 + uneven), 0, 12.0)
            self.fat_px = np.minimum(self.fat_px, rng.uniform(0.0, 3.0))
            self.fluid = contrast.mean[Tissue.LV_CAVITY] * rng.uniform(0.7, 2.0)
        self.most_px = float((self.fat_px + self.fluid_px).max()) + self.sac_px + 1

    def paint(self, signed: Float32, tissue: Label) -> None:
        """Cover the heart in one plane, in place.

        Parameters
        ----------
        signed
            ``(row, column)`` brightness, negative where the signal is opposed.
        tissue
            Of the same plane.
        """
        inside = IN_HEART[tissue]
        if not inside.any():
            return
        away_px = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 3)
        near = (away_px > 0) & (away_px < self.most_px)
        fat_px = self.fat_px[near]
        fluid_px = np.where(_DRY[tissue[near]], 0, self.fluid_px[near])
        ends_px = np.stack([fat_px, fat_px + fluid_px, fat_px + fluid_px + self.sac_px])
        # A pixel at distance d reaches from d - 1 to d beyond the outline between pixels.
        covered = np.clip(ends_px - (away_px[near] - 1), 0, 1)
        of_fat, of_fluid, of_sac = np.diff(covered, axis=0, prepend=np.float32(0))
        beyond = (1 - covered[2]) * signed[near]
        signed[near] = of_fat * self.fat + of_fluid * self.fluid + of_sac * self.sac + beyond
