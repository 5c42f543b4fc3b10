"""The trained network: from slices to the probability of every structure."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import StageError
from pipeline.field.threads import processors
from pipeline.geometry import Float32, Mask
from pipeline.imaging.labels import LABELS

WEIGHTS = Path(__file__).parent / "weights" / "heart.onnx"

CLASSES = 1 + len(LABELS)
PLANES = 3
"""Planes labelled for each slice: towards the apex, at the slice, towards the base."""

MULTIPLE = 32
"""Images need sides that divide by this."""

BATCH = 2
"""Images that are labelled at once. Of more the layers' results leave the processor's cache."""

WINDOW = 128
"""Pixels along each side of the images that the network was trained on."""

NEIGHBOUR_MM = 9.0
"""Distance of neighbours that the network was trained around."""


MOST_THREADS = 8
"""Threads that run networks at the same time, at most: each needs some 100 MB."""

idle: list[Any] = []
"""Networks that were read and that no thread runs now."""


def load_network() -> Any:
    """The network, read anew: one cannot be run by two threads at once.

    Raises
    ------
    StageError
        When the weights that come with the package are missing or cannot be read.
    """
    try:
        return read_onnx(WEIGHTS)
    except cv2.error as error:
        raise StageError(
            f"{WEIGHTS}: the segmentation weights cannot be read ({error}); install the package "
            "again, with an OpenCV of version 5 or later"
        ) from error


def read_onnx(weights: Path) -> Any:
    """A network of plain convolutions, by OpenCV's classic engine where this OpenCV has it.

    That one knows Winograd's minimal filtering, which takes little more than half the time of the
    newer engine here; scores differ by some 1e-4 of the largest.

    Raises
    ------
    cv2.error
        When the file is missing or holds no such network.
    """
    classic = getattr(cv2.dnn, "ENGINE_CLASSIC", None)
    return cv2.dnn.readNetFromONNX(str(weights), *() if classic is None else (classic,))


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
        of the way towards the base-side neighbour. Threads may ask at the same time.
    """
    with _network() as network:
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


@contextmanager
def _network() -> Iterator[Any]:
    """A network for this thread alone."""
    try:
        network = idle.pop()
    except IndexError:
        network = load_network()
    try:
        yield network
    finally:
        idle.append(network)


@contextmanager
def side_by_side() -> Iterator[ThreadPoolExecutor]:
    """Threads that run networks at the same time, each on images of its own.

    OpenCV's own threads share the layers of one image and wait for each other at every one:
    meanwhile there are none.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(min(processors(), MOST_THREADS)) as pool:
            yield pool
    finally:
        cv2.setNumThreads(before)
        # Each holds the layers of the images that it saw last.
        del idle[1:]


def normalise(image: Float32, known: Mask | None = None) -> Float32:
    """Grey values of one image with the 1st percentile at 0 and the 99th at 1, cut off below -0.2
    and above 1.6.

    Percentiles are those of the `WINDOW` pixels about the middle, as many as training images have,
    where ``known``. An image without contrast comes out as zeros.
    """
    middle = tuple(
        slice(max(0, (side - WINDOW) // 2), (side + WINDOW) // 2) for side in image.shape
    )
    return _scaled(image, *_limits(image[middle], None if known is None else known[middle]))


def normalise_locally(image: Float32, known: Mask) -> Float32:
    """Like `normalise`, but every part of a large image by the percentiles of its surroundings.

    Over a whole field the fat beside the coils, or the air around a small patient, would decide
    how bright the heart is; training images show no more than `WINDOW` pixels about it.
    """
    rows, columns = (_window_starts(side) for side in image.shape)
    limits = np.empty((len(rows), len(columns), 2), np.float32)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            window = slice(row, row + WINDOW), slice(column, column + WINDOW)
            limits[i, j] = _limits(image[window], known[window])
    down, across = (
        np.interp(np.arange(side), np.add(starts, WINDOW / 2), np.arange(len(starts)))
        for side, starts in zip(image.shape, (rows, columns), strict=True)
    )
    x, y = np.meshgrid(across.astype(np.float32), down.astype(np.float32))
    low, high = (cv2.remap(limits[..., k], x, y, cv2.INTER_LINEAR) for k in (0, 1))
    return _scaled(image, low, high)


def _window_starts(side: int) -> list[int]:
    """First pixels of windows that cover a side, each overlapping the next by half or more."""
    count = 1 + max(0, -(-(side - WINDOW) // (WINDOW // 2)))
    return [round(start) for start in np.linspace(0, max(0, side - WINDOW), count)]


def _limits(image: Float32, known: Mask | None) -> tuple[float, float]:
    # Every fourth pixel in a row gives the percentiles to well under a grey level.
    values = image[:, ::4] if known is None else image[:, ::4][known[:, ::4]]
    low, high = np.percentile(values, [1, 99]) if values.size else (0.0, 0.0)
    return float(low), float(high)


def _scaled(image: Float32, low: float | Float32, high: float | Float32) -> Float32:
    scaled = (image - low) / np.maximum(np.subtract(high, low), 1e-6)
    return np.asarray(np.clip(scaled, -0.2, 1.6), np.float32)


def neighbour_steps(slice_step_mm: float) -> int:
    """How many slices away the neighbours are taken: about `NEIGHBOUR_MM`, never none."""
    return max(1, round(NEIGHBOUR_MM / slice_step_mm))


def neighbours(number: int, step: int, last: int) -> tuple[int, int, int]:
    """Slices that are shown for one: ``step`` before it, itself, ``step`` after it.

    Where the stack ends, after slice ``last``, the slice stands in for the missing one.
    """
    before = number - step if number - step >= 0 else number
    after = number + step if number + step <= last else number
    return before, number, after
