"""Faults of images that show without knowing a heart: no numbers, copies, spoilt slices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from hashlib import blake2b
from itertools import combinations

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Integer
from pipeline.imaging.cine import Cine
from pipeline.imaging.spacing import WIDEST_GAP_MM


def require_finite(cine: Cine, where: str) -> None:
    """Raise InputError unless all grey values are numbers."""
    bad = ~np.isfinite(cine.intensity).all(axis=(2, 3))
    if bad.any():
        phase, number = np.argwhere(bad)[0]
        raise InputError(
            f"{where}, phase {phase}, slice {number}: grey values must be finite numbers, got NaN "
            "or infinity; export the images again"
        )


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
    """Pairs of columns that are the same all along, and nowhere blank."""
    return [
        (one, other)
        for one, other in combinations(range(which.shape[1]), 2)
        if (which[:, one] == which[:, other]).all() and (which[:, one] >= 0).all()
    ]
