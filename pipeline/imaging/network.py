"""The trained network: from slices to the probability of every structure."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float32
from pipeline.imaging.labels import LABELS

WEIGHTS = Path(__file__).parent / "weights" / "heart.onnx"

CLASSES = 1 + len(LABELS)
PLANES = 3
"""Planes labelled for each slice: towards the apex, at the slice, towards the base."""

MULTIPLE = 32
"""Images need sides that divide by this."""

BATCH = 8

NEIGHBOUR_MM = 9.0
"""Distance of neighbours that the network was trained around."""


@cache
def load_network() -> Any:
    """The network, read once.

    Raises
    ------
    StageError
        When the weights that come with the package are missing or cannot be read.
    """
    try:
        return cv2.dnn.readNetFromONNX(str(WEIGHTS))
    except cv2.error as error:
        raise StageError(
            f"{WEIGHTS}: the segmentation weights cannot be read ({error}); install the package "
            "again, or make them anew with `python -m data_synth.training`"
        ) from error


def predict(images: Float32) -> Float32:
    """Probability of every class on the planes of a batch of slices.

    Parameters
    ----------
    images
        ``(n, 3, row, column)`` grey values from `normalise`: the neighbour towards the apex, the
        slice, the neighbour towards the base; sides divide by `MULTIPLE`.

    Returns
    -------
    (n, 3, 7, row, column) array
        On the plane a third of the way towards the apex-side neighbour, at the slice, and a third
        of the way towards the base-side neighbour.
    """
    network = load_network()
    parts = []
    for start in range(0, len(images), BATCH):
        network.setInput(np.ascontiguousarray(images[start : start + BATCH]), "images")
        parts.append(network.forward("scores").copy())
    scores = np.concatenate(parts)
    n, _, rows, columns = scores.shape
    scores = scores.reshape(n, PLANES, CLASSES, rows, columns)
    scores -= scores.max(axis=2, keepdims=True)
    chance = np.exp(scores, out=scores)
    chance /= chance.sum(axis=2, keepdims=True)
    return np.asarray(chance, np.float32)


def normalise(images: Float32) -> Float32:
    """Grey values of one slice with the 1st percentile at 0 and the 99th at 1, cut off outside.

    An image without contrast comes out as zeros.
    """
    low, high = np.percentile(images[..., ::4], [1, 99])
    scaled = (images - low) / max(float(high - low), 1e-6)
    return np.asarray(np.clip(scaled, -0.2, 1.6), np.float32)


def neighbour_steps(slice_step_mm: float) -> int:
    """How many slices away the neighbours are taken: about `NEIGHBOUR_MM`, never none."""
    return max(1, round(NEIGHBOUR_MM / slice_step_mm))


def with_neighbours(images: Float32, step: int) -> Float32:
    """Stack each slice with its neighbours; where the stack ends, the slice stands in for one.

    Parameters
    ----------
    images
        ``(slice, row, column)`` from the apex to the base.

    Returns
    -------
    (slice, 3, row, column) array
        What `predict` takes.
    """
    number = np.arange(len(images))
    below = np.where(number - step >= 0, number - step, number)
    above = np.where(number + step < len(images), number + step, number)
    return np.stack([images[below], images, images[above]], axis=1)
