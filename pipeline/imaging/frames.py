"""Single images of a cine as files give them, and which of them make up the stack.

A folder from a scanner holds more than one stack: long-axis views, localisers, derived images,
copies. What is not of the stack is left out and named, one line a series; what might be of the
stack but does not fit it is refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float

MIN_SLICES = 3
MIN_PHASES = 2
NEAREST_SLICES_MM = 0.5
"""Positions are written with few decimals; slices are never closer than half a millimetre."""
PARALLEL_COSINE = float(np.cos(np.radians(1)))
ORIGINAL, DERIVED = "original", "derived"
LEAST_OF_A_BEAT = 0.1
"""From the first phase of a cine to the last; end-diastole and end-systole are a quarter apart."""
USUAL_RR_MS = 900.0
"""Of a person at rest, where nothing tells."""

Rank = tuple[bool, int, bool, int, float]
"""Whether a set is a cine stack, the images of the largest one in its direction, whether original,
its own number of images, pixels per mm2."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One image of one slice at one moment, as a file gave it."""

    where: str
    """The file (and frame number) that it came from, for messages."""

    pixels: npt.NDArray[Any]
    """``(row, column)``, in the scanner's own units."""

    position_mm: Float
    """LPS position of the first pixel's centre."""

    axes: Float
    """``(2, 3)`` unit vectors: the direction in which columns count up, then rows."""

    spacing_mm: tuple[float, float]
    """Distance between pixel centres from column to column, then from row to row."""

    times_ms: Mapping[str, float]
    """Time after the R peak by the name of the attribute that tells it, best first."""

    rr_ms: float | None
    """RR interval of its slice; None when the file does not tell."""

    series: str = "images of an unnamed series"
    """Number and description of its series, for messages."""

    series_uid: str = ""
    """What tells the series apart."""

    kind: str = ORIGINAL
    """What sort of image it is, such as ``original``, ``derived`` or ``phase``."""

    frame_of_reference: str = ""
    """What tells apart the frames in which positions are given; empty when the file does not."""

    patient: str = ""
    """The patient's identifier; empty when the file does not tell."""

    @property
    def normal(self) -> Float:
        """Unit normal of the slice, right-handed."""
        return np.asarray(np.cross(self.axes[0], self.axes[1]))

    @property
    def middle_mm(self) -> Float:
        """LPS position of the middle of the image."""
        rows, columns = self.pixels.shape
        half = np.array([columns - 1, rows - 1]) / 2 * self.spacing_mm
        return np.asarray(self.position_mm + half @ self.axes)


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One file or frame that is not part of the stack."""

    where: str
    series: str
    series_uid: str
    reason: str
    noun: str = "image"


def choose_stack(frames: Sequence[Frame], where: str) -> tuple[list[Frame], list[LeftOut]]:
    """The frames of the stack, and the others, each with the reason why it is left out.

    The stack is the largest set of images alike (parallel, of one matrix, pixel spacing and
    kind) that is a cine: 3 slices or more, 2 moments or more in a slice, a tenth of a beat apart
    or more. In one direction original images go before derived ones, which stand in for slices of
    which there are no original ones; of two sets as large the one of smaller pixels is taken. Left
    out are copies, sets of another direction, and parallel sets that are no cine or show only
    slices that the stack has.

    Raises
    ------
    InputError
        When a parallel set shows slices that the stack lacks, but on another matrix, pixel
        spacing or pixel direction; or two stacks of different directions are equally large.
    """
    frames, copies = _without_copies(frames)
    ranked = _ranked(_alike(frames))
    _require_one_largest(ranked, where)
    stack, stills = _without_stills(ranked[0][1])
    slices_mm = slice_positions(stack)
    left_out = copies + _spared(stills, "one moment of the beat, no cine")
    for _, others in ranked[1:]:
        reason = _why_left_out(stack[0], slices_mm, others)
        if reason:
            left_out += _spared(others, reason)
        elif _joins(stack[0], others[0]):
            stack = stack + others
        else:
            _refuse(stack[0], others[0], where)
    return stack, left_out


def _first(pair: tuple[Rank, list[Frame]]) -> Rank:
    return pair[0]


def slice_positions(frames: Sequence[Frame]) -> Float:
    """Where the slices lie along the first frame's normal, rising, in mm."""
    along_mm = np.sort([float(frame.middle_mm @ frames[0].normal) for frame in frames])
    return np.asarray(along_mm[np.diff(along_mm, prepend=-np.inf) > NEAREST_SLICES_MM])


def _without_copies(frames: Sequence[Frame]) -> tuple[list[Frame], list[LeftOut]]:
    """Part images that show the same as another: same place, same time, same pixels.

    Of two series that show the same the larger one is kept, so that none is kept in pieces.
    """
    sizes = Counter(frame.series_uid for frame in frames)
    kept: list[Frame] = []
    copies: list[LeftOut] = []
    seen: dict[tuple[object, ...], list[Frame]] = {}
    for frame in sorted(frames, key=lambda one: (-sizes[one.series_uid], one.series_uid)):
        place = (*frame.position_mm.round(3), *frame.axes.ravel().round(5), *frame.spacing_mm)
        # The same image may be there as a classic and an Enhanced object, which tell more times.
        time_ms = round(next(iter(frame.times_ms.values()), -1.0), 3)
        twins = seen.setdefault((*place, time_ms, frame.kind), [])
        same = [twin for twin in twins if np.array_equal(twin.pixels, frame.pixels)]
        if same:
            copies += _spared([frame], f"a copy of {same[0].series}")
        else:
            kept.append(frame)
            twins.append(frame)
    return kept, copies


def _alike(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Sets of images that could be stacked: same pixel axes, matrix, spacing and kind."""
    sets: list[list[Frame]] = []
    for frame in frames:
        for one in sets:
            if one[0].kind == frame.kind and _fits(one[0], frame):
                one.append(frame)
                break
        else:
            sets.append([frame])
    return sets


def _fits(first: Frame, frame: Frame) -> bool:
    return (
        first.pixels.shape == frame.pixels.shape
        and _same_axes(first, frame)
        and np.allclose(frame.spacing_mm, first.spacing_mm, rtol=1e-3)
    )


def _joins(first: Frame, other: Frame) -> bool:
    """Whether original and derived images may make up one stack."""
    return _fits(first, other) and {first.kind, other.kind} == {ORIGINAL, DERIVED}


def _same_axes(first: Frame, frame: Frame) -> bool:
    return float((first.axes * frame.axes).sum(axis=1).min()) > PARALLEL_COSINE


def _parallel(first: Frame, frame: Frame) -> bool:
    return abs(float(first.normal @ frame.normal)) > PARALLEL_COSINE


def _moments(frames: Sequence[Frame]) -> dict[int, int]:
    """Number of different times that each slice shows, by the slice's place in the set."""
    slices_mm = slice_positions(frames) - NEAREST_SLICES_MM / 2
    times: dict[int, set[tuple[float, ...]]] = {}
    for frame in frames:
        along_mm = float(frame.middle_mm @ frames[0].normal)
        number = int(np.searchsorted(slices_mm, along_mm))
        times.setdefault(number, set()).add(tuple(frame.times_ms.values()))
    return {number: len(found) for number, found in times.items()}


def _is_cine(frames: Sequence[Frame]) -> bool:
    """Whether most of the slices are seen at two moments or more, of different parts of a beat."""
    many = float(np.median(list(_moments(frames).values()))) >= MIN_PHASES
    return many and _spans_beat(frames)


def _spans_beat(frames: Sequence[Frame]) -> bool:
    """Whether the times tell of a beat rather than of nearly one moment, as those of perfusion and
    mapping do, which show a slice many times."""
    first_ms, last_ms = _time_range_ms(frames)
    beat_ms = next((frame.rr_ms for frame in frames if frame.rr_ms), USUAL_RR_MS)
    return last_ms - first_ms >= LEAST_OF_A_BEAT * beat_ms


def _time_range_ms(frames: Iterable[Frame]) -> tuple[float, float]:
    times_ms = [next(iter(frame.times_ms.values()), 0.0) for frame in frames]
    return min(times_ms), max(times_ms)


def is_stack(frames: Sequence[Frame]) -> bool:
    """Whether images alike make up a cine of several slices."""
    return _is_cine(frames) and len(slice_positions(frames)) >= MIN_SLICES


def stacks_beside(frames: Sequence[Frame], stack: Sequence[Frame]) -> tuple[str, ...]:
    """Which other original images would make up a cine stack of another direction, in words."""
    others = [one for one in _alike(frames) if is_stack(one) and one[0].kind == ORIGINAL]
    return tuple(
        f"{one[0].series} ({one[0].where}, ...) is a cine of {len(slice_positions(one))} slices "
        f"too, in another direction than {stack[0].series}, which was taken for its "
        f"{len(stack)} images: if that is not the short axis, leave it out of the folder"
        for one in others
        if not _parallel(stack[0], one[0])
    )


def _ranked(sets: Sequence[list[Frame]]) -> list[tuple[Rank, list[Frame]]]:
    """Sets of images alike, each with its rank, the first one first."""
    stacks = [one for one in sets if is_stack(one)]
    ranked = []
    for one in sets:
        along = [len(other) for other in stacks if _parallel(one[0], other[0])]
        per_mm2 = 1 / (one[0].spacing_mm[0] * one[0].spacing_mm[1])
        enough = any(one is other for other in stacks)
        original = one[0].kind == ORIGINAL
        ranked.append(((enough, max(along, default=0), original, len(one), per_mm2), one))
    return sorted(ranked, key=_first, reverse=True)


def _require_one_largest(ranked: Sequence[tuple[Rank, list[Frame]]], where: str) -> None:
    rank, (first, *_) = ranked[0]
    for other_rank, (other, *_) in ranked[1:]:
        if rank[0] and other_rank[:4] == rank[:4] and not _parallel(first, other):
            raise InputError(
                f"{where}: holds two stacks of {rank[3]} images in different directions, "
                f"{first.series} ({first.where}) and {other.series} ({other.where}); "
                "keep the one to be used"
            )


def _without_stills(frames: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Part series that are no cine, but of the matrix of cines, from these."""
    by_series: dict[str, list[Frame]] = {}
    for frame in frames:
        by_series.setdefault(frame.series_uid, []).append(frame)
    moving = [one for one in by_series.values() if _most_moments(one) > 1 and _spans_beat(one)]
    cine = [frame for one in moving for frame in one]
    stills = {name for name, one in by_series.items() if cine and _is_still(one, cine)}
    return (
        [frame for frame in frames if frame.series_uid not in stills],
        [frame for frame in frames if frame.series_uid in stills],
    )


def _is_still(series: Sequence[Frame], cine: Sequence[Frame]) -> bool:
    """Whether a series shows one moment, of several slices or of slices that cines show, or many
    within a small part of the beat that cines show of these slices."""
    slices_mm, normal = slice_positions(cine), cine[0].normal
    covered = _covered(series, normal, slices_mm)
    if _most_moments(series) < MIN_PHASES:
        return covered or len(slice_positions(series)) > 1
    if _spans_beat(series) or not covered:
        return False
    # A slice that is stored in pieces has the rest of its times elsewhere.
    along_mm = np.array([float(frame.middle_mm @ normal) for frame in series])
    beside = [
        frame
        for frame in cine
        if np.abs(along_mm - float(frame.middle_mm @ normal)).min() < _half_step_mm(slices_mm)
    ]
    (first_ms, last_ms), (start_ms, end_ms) = _time_range_ms(series), _time_range_ms(beside)
    return start_ms <= first_ms and last_ms <= end_ms


def _most_moments(frames: Sequence[Frame]) -> int:
    return max(_moments(frames).values())


def _half_step_mm(slices_mm: Float) -> float:
    step_mm = float(np.diff(slices_mm).min()) if len(slices_mm) > 1 else 2 * NEAREST_SLICES_MM
    return 0.5 * step_mm


def _covered(frames: Iterable[Frame], normal: Float, slices_mm: Float) -> bool:
    """Whether the frames show only slices that are there: nearer than half a step to one."""
    along_mm = np.array([float(frame.middle_mm @ normal) for frame in frames])
    away_mm = np.abs(along_mm[:, None] - slices_mm).min(axis=1)
    return bool(away_mm.max() < _half_step_mm(slices_mm))


def _why_left_out(first: Frame, slices_mm: Float, others: Sequence[Frame]) -> str | None:
    other = others[0]
    if not _parallel(first, other):
        angle = np.degrees(np.arccos(min(abs(float(first.normal @ other.normal)), 1.0)))
        return f"not parallel to the stack, turned by {angle:.0f} degrees"
    if _most_moments(others) < MIN_PHASES:
        return "one moment a slice, no cine"
    if not _spans_beat(others):
        return "all at nearly one moment of the beat, no cine"
    if not _covered(others, first.normal, slices_mm):
        return None
    rows, columns = other.pixels.shape
    sort = "" if other.kind == first.kind else f"{other.kind} images, "
    return f"{sort}slices that the stack has already, {rows} x {columns} pixels"


def _refuse(first: Frame, other: Frame, where: str) -> None:
    """Say what keeps two parallel sets apart that show different slices."""
    if other.pixels.shape != first.pixels.shape:
        raise InputError(
            f"{where}: slices have different matrices: {first.where} has "
            f"{first.pixels.shape}, {other.where} has {other.pixels.shape} (rows, columns); "
            "give one stack of one matrix"
        )
    if not np.allclose(other.spacing_mm, first.spacing_mm, rtol=1e-3):
        raise InputError(
            f"{where}: slices have different pixel spacing: {first.where} has "
            f"{first.spacing_mm} mm, {other.where} has {other.spacing_mm} mm; "
            "give one stack of one spacing"
        )
    if not _same_axes(first, other):
        raise InputError(
            f"{where}: slices are turned in their plane: rows and columns of {other.where} run "
            f"along {other.axes.round(3).tolist()}, those of {first.where} along "
            f"{first.axes.round(3).tolist()}; give one stack of one direction"
        )
    raise InputError(
        f"{where}: {first.where} is {first.kind}, {other.where} is {other.kind} and shows a slice "
        "that the others lack; give one stack of one kind"
    )


def _spared(frames: Iterable[Frame], reason: str) -> list[LeftOut]:
    return [LeftOut(frame.where, frame.series, frame.series_uid, reason) for frame in frames]


def left_out_lines(left_out: Iterable[LeftOut], folder: str) -> tuple[str, ...]:
    """One line a series and reason, in the order of the files, which are named from ``folder``."""
    groups: dict[tuple[str, str, str, str], list[str]] = {}
    for one in sorted(left_out, key=lambda one: one.where):
        name = one.where.removeprefix(folder).lstrip("/\\")
        groups.setdefault((one.series_uid, one.series, one.reason, one.noun), []).append(name)
    return tuple(
        f"{series}: {describe(names, noun)}: {reason}"
        for (_, series, reason, noun), names in groups.items()
    )


def describe(names: Sequence[str], noun: str = "image") -> str:
    """How many there are, and where the first of them is."""
    if len(names) == 1:
        return f"1 {noun} ({names[0]})"
    return f"{len(names)} {noun}s (the first is {names[0]})"
