"""Faults of images that show without knowing a heart: copies, spoilt, cut off, too small."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from hashlib import blake2b
from itertools import combinations

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.dicom_pixels import at_the_edge
from pipeline.imaging.frames import MIN_SLICES
from pipeline.imaging.spacing import WIDEST_GAP_MM
from pipeline.imaging.stored_order import of_one_contrast, small_images

MOST_BRIGHTEST = 0.05
"""Share of pixels that may have the largest value of their image: of what was measured few have."""

MOST_REPEATED = 3
"""Sets of phases that are named one by one."""

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
    images = of_one_contrast(small_images(cine))
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
    # Infinite values less themselves are no numbers, and refused later on.
    with np.errstate(invalid="ignore"):
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
        blank_ends=(first, len(blank) - within.stop),
    )


def require_different_images(cine: Cine, where: str) -> tuple[str, ...]:
    """Refuse a slice that is another's copy, and a heart that never moves.

    No two acquisitions have the same noise, so that equal images are one image given twice.

    Returns
    -------
    tuple of str
        Phases that are copies, in words, of all slices or of one: some exports fill up with them.
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
    everywhere = [
        f"phase {second} shows the same images as phase {first} in all slices"
        for second, first in sorted(source.items())
    ]
    own = np.delete(which, sorted(source), axis=0)
    phases = np.delete(np.arange(len(which)), sorted(source))
    return *everywhere, *_repeated(own, phases)


def _repeated(which: Integer, phases: Integer) -> Iterator[str]:
    """Slices that show one image in several phases, in words."""
    slices: dict[tuple[int, ...], list[int]] = {}
    for number, column in enumerate(which.T):
        for image in np.unique(column[column >= 0]):
            alike = tuple(phases[column == image].tolist())
            if len(alike) > 1:
                slices.setdefault(alike, []).append(number)
    for alike, numbers in list(slices.items())[:MOST_REPEATED]:
        named = f"slice {', '.join(map(str, numbers))} shows one image in phases"
        yield f"{named} {' '.join(map(str, alike))}"
    if len(slices) > MOST_REPEATED:
        yield f"slices show one image in {len(slices) - MOST_REPEATED} more sets of phases"


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


def doubts_of_range(cine: Cine) -> tuple[str, ...]:
    """Whether bright tissues share one value, as after a window that cut them off, in words."""
    images = cine.intensity
    most = images.max(axis=(2, 3), keepdims=True)
    brightest = (images == most) & (images.min(axis=(2, 3), keepdims=True) < most)
    # What is so in all phases and reaches the edge fills up about what was recorded.
    fills = np.stack([at_the_edge(one) for one in brightest.all(axis=0)])
    share = float((brightest & ~fills).sum() / max(images[:, ~fills].size, 1))
    if share <= MOST_BRIGHTEST:
        return ()
    return (
        f"{share:.0%} of the pixels have the largest value of their image, as where a window cut "
        "off what is brighter: export the images' own values, or blood and muscle may look alike",
    )
