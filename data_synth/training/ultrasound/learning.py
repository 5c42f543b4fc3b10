"""What the network that finds blood in ultrasound is shown, and how far off its answers are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional

from data_synth.training.loop import Report, learn
from data_synth.training.network import UNet
from data_synth.training.runs import TrainSettings
from data_synth.training.ultrasound.pictures import (
    BLOOD,
    CLASSES,
    OUTSIDE,
    WALL,
    Picture,
    normalise,
)

Float32 = npt.NDArray[np.float32]
Byte = npt.NDArray[np.uint8]

WIDTHS = (12, 24, 48, 96, 128)
"""Channels at full, half, ... resolution."""

BLOOD_STREAM = 7003
"""Keeps what is drawn for this network apart from what is drawn for others of the same seed."""

CROP = 128
"""Pixels along each side of the images that are learned from."""


class BloodNet(UNet):
    """Grey values and where there are any in, four classes out."""

    def __init__(self) -> None:
        super().__init__(2, CLASSES, WIDTHS)


def draw_sample(rng: np.random.Generator, picture: Picture) -> tuple[Float32, Byte]:
    """Images ``(2, CROP, CROP)`` and labels of a part of a picture, seen otherwise: another curve
    of grey, more noise, turned, scaled, mirrored."""
    grey = picture.grey.astype(np.float32) / 255
    inside = picture.label != OUTSIDE
    if rng.random() < 0.8:
        grey = np.where(inside, grey ** np.exp(rng.normal(scale=0.3)), 0)
    if rng.random() < 0.4:
        haze, noise = rng.normal(scale=rng.uniform(0, 0.08)), rng.uniform(0, 0.08)
        grey = np.clip(grey + haze + noise * rng.normal(size=grey.shape), 0, 1)
    height, width = grey.shape
    scale, turn_deg = np.exp(rng.normal(scale=0.08)), rng.normal(scale=6.0)
    across = width / 2 + rng.uniform(-0.5, 0.5) * max(width * scale - CROP, 10)
    down = height / 2 + rng.uniform(-0.5, 0.5) * max(height * scale - CROP, 10)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, scale)
    matrix[:, 2] += CROP / 2 - across, CROP / 2 - down
    seen = cv2.warpAffine(grey.astype(np.float32), matrix, (CROP, CROP), flags=cv2.INTER_LINEAR)
    label = cv2.warpAffine(
        picture.label, matrix, (CROP, CROP), flags=cv2.INTER_NEAREST, borderValue=OUTSIDE
    )
    images = normalise(seen, label != OUTSIDE)
    if rng.random() < 0.5:
        images, label = images[..., ::-1], label[:, ::-1]
    return np.ascontiguousarray(images), np.ascontiguousarray(label)


def loss(scores: Any, labels: Any, overlap_weight: float) -> Any:
    """Cross-entropy within the sector plus, weighted, one minus soft Dice of blood and walls."""
    scores = scores.float()
    away = functional.cross_entropy(scores, labels, ignore_index=OUTSIDE)
    inside = labels != OUTSIDE
    chance = torch.softmax(scores, dim=1)
    dice = 0.0
    for number in (BLOOD, WALL):
        found, truth = chance[:, number] * inside, labels == number
        dice += (2 * (found * truth).sum() + 1) / (found.sum() + truth.sum() + 1)
    return away + overlap_weight * (1 - dice / 2)


def train(
    pictures: Sequence[Picture], settings: TrainSettings, out: Path, report: Report | None = None
) -> BloodNet:
    """Train the network, writing ``out/blood.onnx`` and ``out/blood.pt``: see `learn`."""

    def draw(rng: np.random.Generator) -> tuple[Float32, Byte]:
        return draw_sample(rng, pictures[int(rng.integers(len(pictures)))])

    return learn(BloodNet, draw, BLOOD_STREAM, loss, settings, out / "blood", report)
