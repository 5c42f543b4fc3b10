"""Faults of images that show without knowing a heart: copies, spoilt, too small, out of order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from hashlib import blake2b
from itertools import combinations, pairwise

import cv2
import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.frames import MIN_SLICES
from pipeline.imaging.spacing import WIDEST_GAP_MM

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

LEAST_VIEW_MM = 60.0
"""Sides of images that show a left ventricle with its wall."""

LEAST_HEIGHT_MM, THIN_MM = 30.0, 2.5
"""A stack of slices thinner than the second, as those of volumes are, holds no ventricle in less
than the first: such is what is left of one whose header lost the distance of its slices."""

EXCHANGED, COMES_ROUND = 2.0, 1.5
"""Times by which neighbours are less alike than along the other axis, and the last is less like the
first than neighbours are, where an axis of phases is one of slices. In 6 stacks of 6 to 25 phases
and 6 to 23 slices, 5 to 12 mm apart, phases were more alike than slices 6 to 60 times; the last
phase was as like the first as neighbours or more, and the last slice 2 to 8 times less."""


def doubts_of_gaps(cine: Cine) -> tuple[str, ...]:
    """A remark where slices lie so far apart that what is between them is a guess."""
    step_mm = float(cine.spacing_mm[2])
    if step_mm <= WIDEST_GAP_MM:
        return ()
    return (
        f"the slices lie {step_mm:.0f} mm apart, wide enough for an apex or a valve plane between "
        "two: surfaces and volumes there are a guess",
    )


def require_room_for_a_heart(cine: Cine, where: str) -> None:
    """Raise InputError where images are too small to show a heart: lengths are in another unit."""
    rows, columns = cine.intensity.shape[2:]
    across, down = (float(mm) for mm in cine.spacing_mm[:2] * (columns, rows))
    if min(across, down) < LEAST_VIEW_MM:
        raise InputError(
            f"{where}: its images measure {across:.0f} x {down:.0f} mm, too little for a heart: at "
            f"least {LEAST_VIEW_MM:g} mm are needed; are lengths in centimetres? Write them in "
            "millimetres"
        )
    step_mm, slices = float(cine.spacing_mm[2]), cine.intensity.shape[1]
    if step_mm < THIN_MM and slices * step_mm < LEAST_HEIGHT_MM:
        raise InputError(
            f"{where}: its {slices} slices lie {step_mm:.3g} mm apart and reach over "
            f"{slices * step_mm:.3g} mm, too little for a heart: at least {LEAST_HEIGHT_MM:g} mm "
            "are needed of slices so thin. A program that saves an array alone loses the distance "
            "of its slices, 5 to 10 mm in most cines: write the affine of the images that these "
            "were made of, or convert the scanner's own files again"
        )


def require_slices_before_phases(cine: Cine, where: str) -> None:
    """Raise InputError where the axes of slices and phases are exchanged, by the images alone.

    Phases come round, so that the last is much like the first, and neighbours are nearly the same;
    slices of a stack are neither.
    """
    if min(cine.intensity.shape[:2]) < MIN_SLICES:
        return
    images = _small(cine)
    images -= images.mean(axis=2, keepdims=True)
    images /= np.maximum(np.linalg.norm(images, axis=2, keepdims=True), 1e-9)
    by_phase, by_slice = (_unlike_next(np.moveaxis(images, axis, 0)) for axis in (0, 1))
    phases, slices = (float(one[:-1].mean()) for one in (by_phase, by_slice))
    if (
        phases > EXCHANGED * slices
        and by_phase[-1] > COMES_ROUND * phases
        and by_slice[-1] < COMES_ROUND * slices
    ):
        count = cine.intensity.shape
        raise InputError(
            f"{where}: its axes of slices and phases look exchanged: its {count[1]} slices are "
            f"alike and come round as phases do, its {count[0]} phases differ as slices; store it "
            "as (columns, rows, slices, phases): of an array in Python data.swapaxes(2, 3), with "
            "the distance of the slices in the affine"
        )


def _unlike_next(images: Float32) -> Float:
    """How unlike ``(n,)`` images ``(n, other, pixel)`` of length 1 are to the next, the last to
    the first, on average."""
    following = np.roll(images, -1, axis=0)
    return np.asarray(1 - np.einsum("aip,aip->a", images, following) / images.shape[1], float)


def redraw_slices(cine: Cine, spoilt: Sequence[int], where: str) -> Cine:
    """The cine with the mean of both neighbours in place of slices whose images are spoilt.

    Raises
    ------
    InputError
        When there is no such slice, or no acquired neighbours near enough on both sides of it.
    """
    if not spoilt:
        return cine
    last = cine.intensity.shape[1] - 1
    lacking = {*spoilt, *cine.interpolated}
    gap_mm = 2 * float(cine.spacing_mm[2])
    for number in spoilt:
        if not 0 <= number <= last:
            raise InputError(f"{where}: no slice {number}; the stack has slices 0 to {last}")
        if number in (0, last):
            raise InputError(
                f"{where}: slice {number} is the stack's outermost, with a neighbour on one side "
                "only; leave it out of the files"
            )
        if lacking & {number - 1, number + 1}:
            raise InputError(
                f"{where}: slice {number} has a neighbour that is spoilt or missing itself; what "
                "lies there is not known"
            )
        if gap_mm > WIDEST_GAP_MM:
            raise InputError(
                f"{where}: the neighbours of slice {number} lie {gap_mm:.1f} mm apart, at most "
                f"{WIDEST_GAP_MM:g} mm are bridged: a valve plane would fit in it"
            )
    intensity = cine.intensity.copy()
    for number in spoilt:
        intensity[:, number] = (intensity[:, number - 1] + intensity[:, number + 1]) / 2
    return replace(cine, intensity=intensity, interpolated=tuple(sorted(lacking)))


def without_blank_ends(stack: Stack) -> Stack:
    """The stack without the slices at its ends that show nothing in any phase, as some data sets
    pad theirs; what was left out is told."""
    cine = stack.cine
    blank = (np.ptp(cine.intensity, axis=(2, 3)) == 0).all(axis=0)
    shown = np.flatnonzero(~blank)
    # Where hardly any slice shows something, that is for whoever looks at the images to say.
    if len(shown) < MIN_SLICES or not (blank[0] or blank[-1]):
        return stack
    first, kept = int(shown[0]), slice(shown[0], shown[-1] + 1)
    frame = cine.mr_from_index.copy()
    frame[:3, 3] += first * frame[:3, 2]
    within = range(*kept.indices(len(blank)))
    numbers = np.array(stack.timed or range(len(blank)))
    timed = np.isin(numbers, within)
    remark = (
        f"{len(blank) - len(within)} slices at the ends of the stack show nothing in any phase and "
        f"are left out: slice {first} of the files is slice 0 from here on"
    )
    return replace(
        stack,
        cine=replace(
            cine,
            intensity=cine.intensity[:, kept],
            mr_from_index=frame,
            interpolated=tuple(one - first for one in cine.interpolated if one in within),
        ),
        trigger_times_ms=stack.trigger_times_ms[timed],
        rr_ms=stack.rr_ms[timed],
        timed=tuple(int(one) - first for one in numbers[timed]) if stack.timed else (),
        remarks=(*stack.remarks, remark),
    )


def require_different_images(cine: Cine, where: str) -> tuple[str, ...]:
    """Refuse a slice that is another's copy, and a heart that never moves.

    No two acquisitions have the same noise, so that equal images are one image given twice.

    Returns
    -------
    tuple of str
        Phases that are copies, in words: some exports fill up with them.
    """
    which = _numbered(cine)
    slices = _equal_columns(which)
    if slices:
        first, second = slices[0]
        raise InputError(
            f"{where}: slices {first} and {second} show the same images in all phases; put the "
            "right images in, or draw the wrong slice between its neighbours, as "
            f"cine.spoilt_slices: [{second}] in study.yaml"
        )
    source: dict[int, int] = {}
    for first, second in _equal_columns(which.T):
        source.setdefault(second, first)
    if len(source) == len(which) - 1:
        raise InputError(f"{where}: all phases show the same images; a heart that beats is needed")
    return tuple(
        f"phase {second} shows the same images as phase {first} in all slices"
        for second, first in sorted(source.items())
    )


def _numbered(cine: Cine) -> Integer:
    """``(phase, slice)`` numbers that are the same where images are; -1 where they are blank."""
    numbers: dict[bytes, int] = {}
    which = np.full(cine.intensity.shape[:2], -1)
    for place in np.ndindex(*which.shape):
        image = cine.intensity[place]
        if np.ptp(image) > 0:
            which[place] = numbers.setdefault(blake2b(image.tobytes()).digest(), len(numbers))
    return which


def _equal_columns(which: Integer) -> list[tuple[int, int]]:
    """Pairs of columns that are the same all along, and not blank all along."""
    return [
        (one, other)
        for one, other in combinations(range(which.shape[1]), 2)
        if (which[:, one] == which[:, other]).all() and (which[:, one] >= 0).any()
    ]


def doubts_of_order(cine: Cine) -> tuple[str, ...]:
    """Whether slices or phases look as if another order were right, in words.

    Files that were sorted by names without leading zeros come as 0, 1, 10, 11, 2, ... Each image
    resembles its neighbours most; the right order is about the shortest way through all of them.
    """
    images = _small(cine)
    phases, slices = images.shape[:2]
    doubts = []
    if slices <= MOST_ORDERED:
        plain = images - images.mean(axis=2, keepdims=True)
        plain /= np.maximum(np.linalg.norm(plain, axis=2, keepdims=True), 1e-9)
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


def _small(cine: Cine) -> Float32:
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
