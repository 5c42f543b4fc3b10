"""Blood in ultrasound, as a trained network sees it.

Grey values leave open what is blood: shadows, haze and noise are dark or bright as well. The
network knows how hearts look: it was trained on pictures drawn at random, and says for every pixel
how probable it is that a cavity's blood lies there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Mask
from pipeline.imaging.network import read_onnx
from pipeline.registration.contact import Contact
from pipeline.registration.frames import (
    BloodSweep,
    TrackedSweep,
    pixel_size_mm,
    require_transforms,
    sector_of,
)
from pipeline.registration.settings import RegisterSettings

WEIGHTS = Path(__file__).parent / "weights" / "blood.onnx"

PIXEL_MM = 1.25
"""Edge of the pixels that the network was trained on."""

# Of its four classes (rest, blood of cavities, walls, other vessels).
_BLOOD = 1
# Pictures need sides that divide by this.
_MULTIPLE = 16
# A picture of less contrast is normalised as one of so much, for grey values from 0 to 1.
_LEAST_CONTRAST = 0.02
# A flat picture (a dead frame) has rounding errors for contrast.
_FLAT = 1e-3


@cache
def load_network() -> Any:
    """The network, read once.

    Raises
    ------
    StageError
        When the weights that come with the package are missing or cannot be read.
    """
    try:
        return read_onnx(WEIGHTS)
    except cv2.error as error:
        raise StageError(
            f"{WEIGHTS}: the weights that read ultrasound cannot be read ({error}); install the "
            "package again, make them anew with `python -m data_synth.training.ultrasound`, or do "
            "without them (register.reading: grey)"
        ) from error


def as_compared(sweeps: Sequence[TrackedSweep], settings: RegisterSettings) -> list[TrackedSweep]:
    """The sweeps as they are compared with the model: blood, or the grey values as they are.

    Raises
    ------
    InputError
        When a sweep shows no sector, or its transform does not map pixels to millimetres.
    StageError
        When the network cannot be loaded.
    """
    if settings.reading == "grey":
        return list(sweeps)
    return [Reader.of(sweep).sweep(sweep) for sweep in sweeps]


@dataclass(frozen=True, slots=True)
class Reader:
    """How pictures of one geometry are read."""

    sector: Mask
    """``(h, w)`` of the pictures as they come."""

    step: Float
    """``(2,)`` columns and rows of theirs to a pixel of `PIXEL_MM`."""

    white: float
    """Largest grey value of the sweep."""

    contact: Contact
    """Whether a picture shows a body, or a probe in air."""

    hurried: bool = False
    """Pictures are looked at once; else so are their mirror images, which takes twice as long."""

    @classmethod
    def of(cls, sweep: TrackedSweep, hurried: bool = False) -> Self:
        """For pictures of this sweep's geometry.

        Raises
        ------
        InputError
            When the sweep shows no sector, or its transform does not map pixels to millimetres.
        """
        require_transforms(sweep)
        pixel_mm = pixel_size_mm(sweep)
        sector = sector_of(sweep)
        white = max(float(np.nanmax(sweep.images)), 1e-30)
        return cls(sector, PIXEL_MM / pixel_mm, white, Contact.of(sector, pixel_mm), hurried)

    def sweep(self, sweep: TrackedSweep) -> BloodSweep:
        """The sweep with blood for pictures."""
        blood = self.read(sweep.images)
        across, down = self._places()
        return BloodSweep(
            sweep.name, blood, self.placed(sweep.tracker_from_image), self._at(across, down)
        )

    def placed(self, tracker_from_image: Float) -> Float:
        """Transforms ``(..., 4, 4)`` of pictures as those of what is read from them."""
        return np.asarray(tracker_from_image @ np.diag([*self.step, 1.0, 1.0]))

    def read(self, images: Float32) -> Float32:
        """``(n, rows, columns)`` probability of blood in pictures ``(n, h, w)``, on pixels of
        `PIXEL_MM` from the same first one on; 0 outside the sector, and all over a picture that
        shows no body."""
        across, down = self._places()
        inside = self._at(across, down)
        weight = self._smooth(self.sector.astype(np.float32))
        shown = self.sector[None] & np.isfinite(images)
        known = shown.any(axis=(1, 2)) & (shown == self.sector).all(axis=(1, 2))
        clean = np.where(shown, images, 0).astype(np.float32)
        lively = clean[:, self.sector].std(axis=1) > _FLAT * self.white
        blood = np.zeros((len(images), *inside.shape), np.float32)
        for number in np.flatnonzero(known & lively & self.contact.touching(clean)):
            mean = self._smooth(clean[number]) / np.maximum(weight, 1e-3)
            mean = np.where(self.sector, mean, 0).astype(np.float32)
            small = cv2.remap(mean, across, down, cv2.INTER_LINEAR)
            looks = normalise(small / self.white, inside)[None]
            if not self.hurried:
                looks = np.concatenate([looks, looks[..., ::-1]])
            blood[number] = np.where(inside, _blood(looks), 0)
        return blood

    def _places(self) -> tuple[Float32, Float32]:
        """Columns and rows, in the pictures as they come, of the pixels of `PIXEL_MM`."""
        height, width = self.sector.shape
        columns = np.arange(0, width, self.step[0], dtype=np.float32)
        rows = np.arange(0, height, self.step[1], dtype=np.float32)
        across, down = np.meshgrid(np.minimum(columns, width - 1), np.minimum(rows, height - 1))
        return across, down

    def _at(self, across: Float32, down: Float32) -> Mask:
        """Where the small pictures have values."""
        shown = cv2.remap(self.sector.astype(np.float32), across, down, cv2.INTER_NEAREST)
        return np.asarray(shown > 0)

    def _smooth(self, image: Float32) -> Float32:
        """A mean over pixels of `PIXEL_MM`."""
        sigma = 0.45 * self.step
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma[0], sigmaY=sigma[1]))


def normalise(grey: Float32, inside: Mask) -> Float32:
    """``(2, row, column)``: what the network is shown of grey values from 0 to 1.

    The sector's mean is 0 and its standard deviation about 1; outside it is 0, and the second
    image tells where that is.
    """
    shown = grey[inside]
    if shown.size == 0:
        return np.zeros((2, *grey.shape), np.float32)
    scaled = np.where(inside, (grey - shown.mean()) / (shown.std() + _LEAST_CONTRAST), 0)
    return np.stack([scaled, inside]).astype(np.float32)


def _blood(images: Float32) -> Float32:
    """``(row, column)`` probability of blood in a picture ``(1, 2, row, column)``; the mean of a
    picture's and its mirror image's if both are given."""
    network = load_network()
    rows, columns = images.shape[2:]
    right = -columns % _MULTIPLE
    wide = np.pad(images, ((0, 0), (0, 0), (0, -rows % _MULTIPLE), (0, right)))
    network.setInput(np.ascontiguousarray(wide), "images")
    scores = network.forward("scores")
    chance = np.exp(scores - scores.max(axis=1, keepdims=True))
    blood = (chance[:, _BLOOD] / chance.sum(axis=1))[:, :rows, :columns]
    if len(blood) == 2:
        blood[0] = (blood[0] + blood[1, :, ::-1]) / 2
    return np.asarray(blood[0], np.float32)
