"""Brightness of tissues in training images: wide random ranges, weakly those of cine MR.

Ranges are relative to the left ventricle's blood and wider than any scanner gives, so that a
network learns shapes and relations, not one machine's grey values.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import COUNTED_AS, TRUTH_LABELS, Tissue, truth_values

Float32 = npt.NDArray[np.float32]
Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

CLASSES = 1 + len(TRUTH_LABELS)

BLOOD = (Tissue.LV_CAVITY, Tissue.RV_CAVITY, Tissue.LEFT_ATRIUM, Tissue.RIGHT_ATRIUM, Tissue.AORTA)
WALLS = (
    *(Tissue.RV_WALL, Tissue.ATRIAL_WALL, Tissue.VESSEL_WALL, Tissue.LEAFLET),
    *(Tissue.PERICARDIUM, Tissue.SPLEEN),
)

_BRIGHTNESS: dict[Tissue, tuple[float, float]] = {
    Tissue.AIR: (0.0, 0.03),
    Tissue.FAT: (0.4, 1.7),
    Tissue.MUSCLE: (0.08, 0.5),
    Tissue.LUNG: (0.01, 0.25),
    Tissue.BONE: (0.05, 0.8),
    Tissue.LIVER: (0.12, 0.8),
    Tissue.BLOOD_VESSEL: (0.65, 1.25),
    Tissue.RV_CAVITY: (0.7, 1.2),
    Tissue.LEFT_ATRIUM: (0.7, 1.2),
    Tissue.RIGHT_ATRIUM: (0.65, 1.2),
    Tissue.AORTA: (0.65, 1.3),
    Tissue.STOMACH: (0.02, 1.3),
    Tissue.GAS: (0.0, 0.1),
}
"""Least and largest brightness; walls and heart muscle are drawn relative to each other."""


def _table(values: dict[Tissue, int]) -> Label:
    table = np.zeros(256, np.uint8)
    for tissue, value in values.items():
        table[tissue] = value
    return table


LABEL_OF = _table(
    {tissue: int(value) for tissue, value in zip(Tissue, truth_values(), strict=True)}
)
"""Label value of every tissue: what the network is to answer."""

IN_HEART = _table(dict.fromkeys((*BLOOD, *WALLS[:4], *COUNTED_AS, Tissue.LV_MYOCARDIUM), 1)).astype(
    bool
)
"""Whether a tissue belongs to the heart or its great vessels."""


@cache
def _chosen(tissues: tuple[Tissue, ...]) -> Label:
    return _table(dict.fromkeys(tissues, 1))


def among(tissue: Label, tissues: tuple[Tissue, ...]) -> Mask:
    """Where a tissue is one of some; many times as fast as `np.isin`."""
    flat = cv2.LUT(np.ascontiguousarray(tissue).reshape(1, -1), _chosen(tissues))
    return np.asarray(flat.reshape(tissue.shape).view(np.bool_))


IS_BLOOD = _table(dict.fromkeys(BLOOD, 1)).astype(bool)
"""Whether a tissue is blood in a chamber or the aorta."""


@dataclass(frozen=True, slots=True)
class Contrast:
    """Grey values of one training image."""

    mean: Float32
    """``(256,)`` brightness by tissue; blood of the left ventricle is near 1."""

    texture: Float32
    """``(256,)`` standard deviation of the texture by tissue."""

    muscle: float
    """Brightness of the heart muscle, which papillary muscles and trabeculae share."""


def draw_contrast(rng: np.random.Generator) -> Contrast:
    """Draw grey values: mostly bright blood, dark muscle; a few of any contrast at all."""
    mean = np.zeros(256, np.float32)
    for tissue, (low, high) in _BRIGHTNESS.items():
        mean[tissue] = rng.uniform(low, high)
    muscle = rng.uniform(0.1, 0.65)
    mean[Tissue.LV_CAVITY] = rng.uniform(0.9, 1.1)
    mean[Tissue.LV_MYOCARDIUM] = muscle
    for tissue in WALLS:
        mean[tissue] = muscle * rng.uniform(0.4, 1.5)
    for tissue in COUNTED_AS:
        mean[tissue] = muscle * rng.uniform(0.85, 1.2)
    if rng.random() < 0.5:
        # In many scanners all blood looks alike, and liver like muscle: hardest to tell apart.
        mean[list(BLOOD)] = mean[Tissue.LV_CAVITY] * rng.uniform(0.92, 1.08, len(BLOOD))
        mean[Tissue.LIVER] = muscle * rng.uniform(0.8, 1.4)
    if rng.random() < 0.3:
        # A thin wall shares its pixels with what lies on either side of it.
        for tissue in (Tissue.RV_WALL, Tissue.ATRIAL_WALL):
            beside = mean[Tissue.FAT if rng.random() < 0.5 else Tissue.RV_CAVITY]
            mean[tissue] += rng.uniform(0.0, 0.9) * (beside - mean[tissue])
    if rng.random() < 0.08:
        mean = rng.uniform(0.0, 1.4, 256).astype(np.float32)
        muscle = float(mean[Tissue.LV_MYOCARDIUM])
    texture = rng.uniform(0.005, 0.09, 256) * np.sqrt(np.maximum(mean, 0.1))
    return Contrast(mean, texture.astype(np.float32), muscle)


def _usual_contrast() -> Contrast:
    """One scanner's grey values: the middle of every range."""
    mean = np.zeros(256, np.float32)
    for tissue, (low, high) in _BRIGHTNESS.items():
        mean[tissue] = (low + high) / 2
    muscle = 0.35
    mean[Tissue.LV_CAVITY] = 1.0
    mean[[Tissue.LV_MYOCARDIUM, *WALLS, *COUNTED_AS]] = muscle
    return Contrast(mean, np.full(256, 0.02, np.float32), muscle)


USUAL_CONTRAST = _usual_contrast()
"""What images have when grey values are not drawn at random."""
