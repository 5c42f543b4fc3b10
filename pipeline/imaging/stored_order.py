"""Whether slices or phases were stored in the order in which they lie and follow one another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

import cv2
import numpy as np

from pipeline.geometry import Float, Float32
from pipeline.imaging.cine import Cine

SLICES_GAIN, PHASES_GAIN = 0.04, 0.12
"""Share by which another order of images must shorten the way through them before it is told. In
61 stacks of two renderers, up to 20 mm apart, noisy or astray, no way through slices in their order
was shortened at all, and that through two neighbours exchanged by 0.06 and more; that through 25
phases by 0.07 at most, and by 0.13 and more when sorted by names without leading zeros."""

LEAST_PHASES = 16
"""Fewer are so far apart that systole and diastole are easily taken for each other: of all orders
that of names without leading zeros alone is looked for, by a gain of `NAMES_GAIN`."""

NAMES_GAIN = 0.02
"""Of phases in their order, the way through them in that of names is longer by 0.06 and more; of
twelve and more that were sorted so, the way in their order is shorter by 0.03 and more."""

MOST_ORDERED = 60
"""More slices are those of a volume, which is acquired as one."""

ORDER_PIXELS = 64
"""About so many pixels of the smaller side are compared."""


def doubts_of_order(cine: Cine) -> tuple[str, ...]:
    """Whether slices or phases look as if another order were right, in words.

    Files that were sorted by names without leading zeros come as 0, 1, 10, 11, 2, ... Each image
    resembles its neighbours most; the right order is about the shortest way through all of them.
    """
    images = small_images(cine)
    phases, slices = images.shape[:2]
    doubts = []
    if slices <= MOST_ORDERED:
        plain = of_one_contrast(images)
        # A blank slice is as unlike one neighbour as another.
        shown = np.flatnonzero(plain.any(axis=(0, 2)))
        unlike = 1 - np.einsum("kip,kjp->ij", plain[:, shown], plain[:, shown]) / phases
        order, gain = _shortest(unlike, closed=False)
        if gain > SLICES_GAIN:
            right = _listed(shown[order].tolist())
            doubts.append(
                f"slices look as if their order were {right}; if it is, surfaces and "
                "forces are wrong: store them from one end of the heart to the other"
            )
    if phases <= MOST_ORDERED:
        rows = images.reshape(phases, -1).astype(float)
        products = rows @ rows.T
        squares = products.diagonal()
        apart = np.sqrt(np.maximum(squares[:, None] + squares - 2 * products, 0))
        few = phases < LEAST_PHASES
        order, gain = _by_names(apart) if few else _shortest(apart, closed=True)
        if gain > (NAMES_GAIN if few else PHASES_GAIN):
            doubts.append(
                f"phases look as if their order were {_listed(order)}; if it is, the motion is "
                "wrong: store them in the order of time"
            )
    return tuple(doubts)


def _listed(order: Sequence[int]) -> str:
    return " ".join(map(str, order))


def small_images(cine: Cine) -> Float32:
    """Images some `ORDER_PIXELS` pixels wide, ``(phase, slice, pixel)``."""
    rows, columns = cine.intensity.shape[2:]
    factor = max(1, round(min(rows, columns) / ORDER_PIXELS))
    size = columns // factor, rows // factor
    return np.array(
        [
            [cv2.resize(image, size, interpolation=cv2.INTER_AREA).ravel() for image in phase]
            for phase in cine.intensity
        ],
        np.float32,
    )


def of_one_contrast(images: Float32) -> Float32:
    """Images ``(phase, slice, pixel)`` of mean 0 and length 1; blank ones are 0."""
    plain = images - images.mean(axis=2, keepdims=True)
    return np.asarray(plain / np.maximum(np.linalg.norm(plain, axis=2, keepdims=True), 1e-9))


def _by_names(apart: Float) -> tuple[list[int], float]:
    """The order of time of what was sorted by the digits of its numbers, counted from 0 or from 1,
    and by what share the way round through all is shorter in it."""
    count = len(apart)
    ways = []
    for first in (0, 1):
        stored = sorted(range(first, first + count), key=str)
        ways.append([stored.index(number) for number in range(first, first + count)])
    lengths = [float(apart[way, np.roll(way, -1)].sum()) for way in ways]
    given = float(apart[np.arange(count), np.roll(np.arange(count), -1)].sum())
    best = int(np.argmin(lengths))
    return ways[best], 1 - lengths[best] / given if given > 0 else 0.0


def _shortest(apart: Float, closed: bool) -> tuple[list[int], float]:
    """A shorter way through all, and by what share: swaps, moves and reversals until none helps.

    Of the two directions that which begins with the lower number.

    Parameters
    ----------
    apart
        ``(n, n)`` distances.
    closed
        Whether the last is followed by the first.
    """
    rows = apart.tolist()

    def length(order: list[int]) -> float:
        steps = sum(rows[a][b] for a, b in pairwise(order))
        return float(steps + (rows[order[-1]][order[0]] if closed else 0.0))

    best = list(range(len(rows)))
    shortest = given = length(best)
    improved = True
    while improved:
        improved = False
        for i, j in combinations(range(len(rows)), 2):
            for way in _changed(best, i, j):
                if length(way) < shortest - 1e-9 * given:
                    best, shortest, improved = way, length(way), True
    if closed:
        start = best.index(0)
        best = [*best[start:], *best[:start]]
        best = best if best[1] < best[-1] else [0, *best[:0:-1]]
    elif best[0] > best[-1]:
        best.reverse()
    return best, 1 - shortest / given if given > 0 else 0.0


def _changed(order: list[int], i: int, j: int) -> Iterator[list[int]]:
    """The order with two places swapped, one moved to the other, or what lies between reversed."""
    before, between, after = order[:i], order[i + 1 : j], order[j + 1 :]
    yield [*before, order[j], *between, order[i], *after]
    yield [*before, *between, order[j], order[i], *after]
    yield [*before, order[j], order[i], *between, *after]
    yield [*before, order[j], *between[::-1], order[i], *after]
