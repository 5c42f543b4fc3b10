"""Even spacing of a stack: checked, and restored where single slices are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.frames import LEAVE_OUT, SEVERAL, Frame

NEARLY_ONE, NEARLY_ONE_MM = 0.4, 4.0
"""A step of less than this share of the median one, and than this, is none: with slices missing the
step may be half of the median or less."""

MOST_ASIDE = 0.5
"""Of a pixel: slices farther beside the line that they share would show a step in the wall that is
none. Breath-holds differ by more, 0.6 to 2.2 mm (`pipeline.imaging.alignment.BREATH_MM`)."""

MOST_TOLD = 16
"""Of repeated slices so many are told in one message: more than a stack usually has."""

WIDEST_GAP_MM = 25.0
"""Across a wider gap nothing is interpolated: an apex or a valve plane would fit in it."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where the slices of an evenly spaced stack lie."""

    origin_mm: Float
    """``(3,)`` LPS of the first slice's first pixel, on the line that all slices share."""

    step_mm: Float
    """``(3,)`` LPS from one slice to the next."""

    numbers: Integer
    """``(slice,)`` the place of each in the stack."""

    remarks: tuple[str, ...] = ()
    """What of the files' places is not kept, in words."""


def regular_places(slices: Sequence[Sequence[Frame]], where: str, fill: bool) -> Places:
    """The places of an evenly spaced stack, of which single slices may be missing.

    Slices may lie `MOST_ASIDE` of a pixel beside the line that they share, as where scanners
    round positions or a breath-hold is planned anew. They are drawn on that line, which is told:
    it is less than breaths differ by, and what is found of those takes most of it out.

    Parameters
    ----------
    slices
        Images by slice, in order along the normal.
    where
        What they were read from, for messages.
    fill
        Whether single slices may be missing.

    Raises
    ------
    InputError
        When slices are unevenly spaced or shifted sideways, or one is missing: always where it
        may not be, else where a gap is wider than one slice or than `WIDEST_GAP_MM`.
    """
    positions_mm = np.array([one[0].position_mm for one in slices])
    first = slices[0][0]
    lengths_mm = np.diff(positions_mm, axis=0) @ first.normal
    _require_no_second(slices, lengths_mm, where)
    usual_mm = float(lengths_mm.min())
    counts = np.maximum(np.rint(lengths_mm / usual_mm), 1).astype(int)
    numbers = np.concatenate([[0], np.cumsum(counts)])
    allowed_mm = max(0.1, 0.02 * usual_mm)
    _require_one_place(slices, allowed_mm, where)
    along_mm = (positions_mm - positions_mm[0]) @ first.normal
    step_mm = along_mm[-1] / numbers[-1]
    _require_even(slices, along_mm - numbers * step_mm, lengths_mm, allowed_mm, where)
    # Those that agree keep their places, whichever slice was moved.
    in_plane_mm = (positions_mm - positions_mm[0]) @ first.axes.T
    line_mm = np.median(in_plane_mm, axis=0)
    aside_mm = np.linalg.norm(in_plane_mm - line_mm, axis=1)
    _require_above_one_another(slices, aside_mm, allowed_mm, where)
    _require_no_wide_gap(slices, lengths_mm, counts, fill, where)
    return Places(
        positions_mm[0] + line_mm @ first.axes,
        step_mm * first.normal,
        np.asarray(numbers, np.int64),
        _told_aside(numbers, aside_mm, allowed_mm),
    )


def _require_even(
    slices: Sequence[Sequence[Frame]],
    off_mm: Float,
    lengths_mm: Float,
    allowed_mm: float,
    where: str,
) -> None:
    """Refuse slices that lie ``(slice,)`` along the normal off their places in an even stack."""
    worst = int(np.abs(off_mm).argmax())
    if abs(off_mm[worst]) > allowed_mm:
        raise InputError(
            f"{where}: slices are not evenly spaced: {slices[worst][0].where} lies "
            f"{abs(off_mm[worst]):.2f} mm along the normal from its place in an even stack from "
            f"the first to the last, {allowed_mm:.2f} mm are allowed; steps along the normal are "
            f"{lengths_mm.round(2).tolist()} mm. Keep the slices of one stack: one that was "
            "planned elsewhere may be left out, with cine.fill_gaps: true inside the stack"
        )


def _require_above_one_another(
    slices: Sequence[Sequence[Frame]], aside_mm: Float, rounded_mm: float, where: str
) -> None:
    """Refuse slices that lie ``(slice,)`` too far beside the line that they share."""
    most_mm = max(rounded_mm, MOST_ASIDE * min(slices[0][0].spacing_mm))
    worst = int(aside_mm.argmax())
    if aside_mm[worst] > most_mm:
        many = int((aside_mm > most_mm).sum())
        raise InputError(
            f"{where}: slices are shifted sideways: {many} of {len(slices)} lie too far beside the "
            f"line along their normal on which most lie, {slices[worst][0].where} by "
            f"{aside_mm[worst]:.2f} mm; {most_mm:.2f} mm, {MOST_ASIDE:g} of a pixel, are allowed. "
            "Resample the stack to a grid with axes at right angles; a slice that was planned "
            "elsewhere may be left out instead, with cine.fill_gaps: true inside the stack"
        )


def _told_aside(numbers: Integer, aside_mm: Float, rounded_mm: float) -> tuple[str, ...]:
    """A sentence where slices lie ``(slice,)`` beside the line on which they are drawn, by more
    than positions of few decimals do."""
    many = int((aside_mm > rounded_mm).sum())
    if not many:
        return ()
    worst = int(aside_mm.argmax())
    return (
        f"{many} of {len(aside_mm)} slices lie up to {aside_mm[worst]:.2f} mm (slice "
        f"{numbers[worst]}), half a pixel at most, beside the line along their normal on which all "
        "are drawn; of slices 4 mm apart or more, what outlines tell of breath-holds takes most of "
        "it out again",
    )


def _require_no_wide_gap(
    slices: Sequence[Sequence[Frame]], lengths_mm: Float, counts: Integer, fill: bool, where: str
) -> None:
    """Refuse a gap between slices: any, or where ``fill`` what is too wide to be filled."""
    too_wide = (counts > 2) | (lengths_mm > WIDEST_GAP_MM) if fill else True
    wide = np.flatnonzero((counts > 1) & too_wide)
    if not len(wide):
        return
    first = wide[0]
    remedy = (
        f"; cine.fill_gaps fills one slice in at most {WIDEST_GAP_MM:g} mm, which this is not; "
        "add the missing slice"
        if fill
        else "; add the missing slice, or, where it is one in at most "
        f"{WIDEST_GAP_MM:g} mm, let its neighbours stand in for it: cine.fill_gaps: true in "
        "study.yaml"
    )
    raise InputError(
        f"{where}: missing slice between {slices[first][0].where} and "
        f"{slices[first + 1][0].where}: {lengths_mm[first]:.2f} mm apart, the others are "
        f"{lengths_mm.min():.2f} mm apart{remedy}"
    )


def _require_one_place(slices: Sequence[Sequence[Frame]], allowed_mm: float, where: str) -> None:
    """Refuse phases of a slice that lie beside one another: one place is taken for all."""
    for number, one in enumerate(slices):
        places_mm = np.array([frame.position_mm for frame in one])
        off_mm = np.linalg.norm(places_mm - places_mm[0], axis=1)
        if off_mm.max() > allowed_mm:
            other = one[int(off_mm.argmax())]
            raise InputError(
                f"{where}: phases of slice {number} lie in different places: {other.where} "
                f"{off_mm.max():.2f} mm from {one[0].where}, {allowed_mm:.2f} mm are allowed; all "
                "phases of a slice need one place: keep those of one"
            )


def _require_no_second(slices: Sequence[Sequence[Frame]], lengths_mm: Float, where: str) -> None:
    """Refuse slices that were taken again beside their first place."""
    usual_mm = float(np.median(lengths_mm))
    short = np.flatnonzero(lengths_mm < min(NEARLY_ONE * usual_mm, NEARLY_ONE_MM)).tolist()
    if not short:
        return
    told = [
        f"slices {k} and {k + 1} lie {lengths_mm[k]:.2f} mm apart: {slices[k][0].series} "
        f"({slices[k][0].where}), and {slices[k + 1][0].series} ({slices[k + 1][0].where})"
        for k in short[:MOST_TOLD]
    ]
    rest = [f"and so on, {len(short) - MOST_TOLD} more"] if len(short) > MOST_TOLD else []
    raise InputError(
        f"{where}: nearly the same slice is given twice, for others lie {usual_mm:.2f} mm apart: "
        f"{'; '.join([*told, *rest])}; keep one of each two: {LEAVE_OUT}, {SEVERAL}"
    )


def fill_gaps(intensity: Float32, numbers: Integer) -> tuple[Float32, tuple[int, ...]]:
    """Put the mean of both neighbours where a slice is missing.

    Parameters
    ----------
    intensity
        ``(phase, slice, row, column)`` of the slices that are there.
    numbers
        ``(slice,)`` their places in the stack, rising; no two neighbours are missing.

    Returns
    -------
    intensity, missing
        Of the whole stack, and the numbers of the slices filled in.
    """
    count = int(numbers[-1]) + 1
    if count == len(numbers):
        return intensity, ()
    filled = np.empty((len(intensity), count, *intensity.shape[2:]), np.float32)
    filled[:, numbers] = intensity
    missing = sorted(set(range(count)) - set(numbers.tolist()))
    for number in missing:
        filled[:, number] = (filled[:, number - 1] + filled[:, number + 1]) / 2
    return filled, tuple(missing)
