"""Single images of a cine as files give them, and which of them make up the stack.

A folder from a scanner holds more than one stack: long-axis views, localisers, derived images,
copies. What is not of the stack is left out and named, one line a series; what might be of the
stack but does not fit it is refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.left_out import LeftOut, inside

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
LONGEST_RR_MS = 3000.0
"""Where nothing tells the RR interval, what takes longer is no heartbeat."""
MANY_BEATS = 1.5
"""Times beyond so many RR intervals are of more than one beat, not of one that was long."""

LEAVE_OUT = "take the other's files out, or name its number in cine.leave_out_series in study.yaml"

Rank = tuple[bool, int, bool, bool, int, float]
"""Whether a set is a cine stack, the images of the largest one in its direction, whether it shows
one beat, whether original, its own number of images, pixels per mm2."""


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

    study: str = ""
    """What tells apart a patient's examinations; empty when the file does not."""

    number: int | None = None
    """Its number within its series; None when the file does not tell."""

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


def choose_stack(frames: Sequence[Frame], where: str) -> tuple[list[Frame], list[LeftOut]]:
    """The frames of the stack, and the others, each with the reason why it is left out.

    The stack is the largest set of images alike (parallel, of one matrix, pixel spacing and
    kind) that is a cine: 3 slices or more, 2 moments or more in a slice, a tenth of a beat apart
    or more. In one direction sets within one beat go before images in real time, and original
    images before derived ones, which stand in for slices of which there are no original ones; of
    two sets as large the one of smaller pixels is taken. Left out are copies, sets of another
    direction, and parallel sets that are no cine or show only slices that the stack has.

    Raises
    ------
    InputError
        When a parallel set shows slices that the stack lacks, but on another matrix, pixel
        spacing or pixel direction; or two stacks of different directions are equally large.
    """
    frames, copies = _without_copies(frames)
    ranked = _ranked(sets_alike(frames))
    _require_one_largest(ranked, where)
    stack, stills = _without_stills(ranked[0][1])
    left_out = copies + _spared(stills, "one moment of the beat, no cine")
    # What joins the stack comes first: a set of its slices is not to be judged without them.
    rest = sorted((one for _, one in ranked[1:]), key=lambda one: not _joins(stack[0], one[0]))
    for others in rest:
        reason = _why_left_out(stack[0], slice_positions(stack), others)
        if reason:
            left_out += _spared(others, reason)
        elif _joins(stack[0], others[0]):
            stack = stack + others
        else:
            _refuse(stack[0], others[0], where)
    return stack, left_out


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


def sets_alike(frames: Sequence[Frame]) -> list[list[Frame]]:
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


def are_parallel(first: Frame, frame: Frame) -> bool:
    """Whether two images lie in one direction, as slices of a stack do."""
    return abs(float(first.normal @ frame.normal)) > PARALLEL_COSINE


def by_slice(frames: Sequence[Frame]) -> list[list[Frame]]:
    """The frames of each slice, the slices in order along the first frame's normal."""
    # Half the least distance of two slices: rounded positions fall on the right side.
    starts_mm = slice_positions(frames) - NEAREST_SLICES_MM / 2
    slices: list[list[Frame]] = [[] for _ in starts_mm]
    for frame in frames:
        along_mm = float(frame.middle_mm @ frames[0].normal)
        slices[int(np.searchsorted(starts_mm, along_mm)) - 1].append(frame)
    return slices


def _moments(frames: Sequence[Frame]) -> list[int]:
    """Number of different times that each slice shows."""
    return [len({tuple(frame.times_ms.values()) for frame in one}) for one in by_slice(frames)]


def _is_cine(frames: Sequence[Frame]) -> bool:
    """Whether most of the slices are seen at two moments or more, of different parts of a beat."""
    return float(np.median(_moments(frames))) >= MIN_PHASES and _spans_beat(frames)


def _spans_beat(frames: Sequence[Frame]) -> bool:
    """Whether most slices are seen through a beat rather than at nearly one moment of it, as in
    perfusion and mapping, which show a slice many times."""
    beat_ms = next((frame.rr_ms for frame in frames if frame.rr_ms), USUAL_RR_MS)
    spans_ms = [last_ms - first_ms for first_ms, last_ms in map(_time_range_ms, by_slice(frames))]
    return float(np.median(spans_ms)) >= LEAST_OF_A_BEAT * beat_ms


def _in_one_beat(frames: Sequence[Frame]) -> bool:
    """Whether most slices' times lie within about one RR interval, as those of images in real time
    do not."""
    return float(np.median([max(map(_beats, one)) for one in by_slice(frames)])) < MANY_BEATS


def _beats(frame: Frame) -> float:
    """In which heartbeat an image was taken, counted from 0."""
    rr_ms = frame.rr_ms or LONGEST_RR_MS / MANY_BEATS
    return next(iter(frame.times_ms.values()), 0.0) / rr_ms


def _time_range_ms(frames: Sequence[Frame]) -> tuple[float, float]:
    """First and last time by the attribute that tells the frames furthest apart."""
    return max(_time_ranges_ms(frames).values(), key=_span_ms, default=(0.0, 0.0))


def _time_ranges_ms(frames: Sequence[Frame]) -> dict[str, tuple[float, float]]:
    """First and last time by each attribute that all frames have, in the order of the first's."""
    ranges_ms = {}
    for name in frames[0].times_ms:
        if all(name in frame.times_ms for frame in frames):
            times_ms = [frame.times_ms[name] for frame in frames]
            ranges_ms[name] = min(times_ms), max(times_ms)
    return ranges_ms


def _span_ms(first_and_last_ms: tuple[float, float]) -> float:
    return first_and_last_ms[1] - first_and_last_ms[0]


def is_stack(frames: Sequence[Frame]) -> bool:
    """Whether images alike make up a cine of several slices."""
    return _is_cine(frames) and len(slice_positions(frames)) >= MIN_SLICES


def stacks_beside(frames: Sequence[Frame], stack: Sequence[Frame], folder: str) -> tuple[str, ...]:
    """Which other original images would make up a cine stack of another direction, in words."""
    others = [one for one in sets_alike(frames) if one[0].kind == ORIGINAL and is_stack(one)]
    return tuple(
        f"{one[0].series} ({inside(one[0].where, folder)}, ...) is a cine of "
        f"{len(slice_positions(one))} slices too, in another direction than {stack[0].series}, "
        f"which was taken for its {len(stack)} images: if that is not the short axis, take its "
        "files out, or name its number in cine.leave_out_series in study.yaml"
        for one in others
        if not are_parallel(stack[0], one[0])
    )


def _ranked(sets: Sequence[list[Frame]]) -> list[tuple[Rank, list[Frame]]]:
    """Sets of images alike, each with its rank, the first one first."""
    stacks = [one for one in sets if is_stack(one) and one[0].kind in (ORIGINAL, DERIVED)]
    ranked = []
    for one in sets:
        along = [_weight(other) for other in stacks if are_parallel(one[0], other[0])]
        per_mm2 = 1 / (one[0].spacing_mm[0] * one[0].spacing_mm[1])
        enough = any(one is other for other in stacks)
        original = one[0].kind == ORIGINAL
        rank = (enough, max(along, default=0), _in_one_beat(one), original, len(one), per_mm2)
        ranked.append((rank, one))
    return sorted(ranked, key=itemgetter(0), reverse=True)


def _weight(frames: Sequence[Frame]) -> int:
    """Images of a stack; derived ones count half beside those of another direction."""
    return len(frames) // (1 if frames[0].kind == ORIGINAL else 2)


def _require_one_largest(ranked: Sequence[tuple[Rank, list[Frame]]], where: str) -> None:
    rank, (first, *_) = ranked[0]
    for other_rank, (other, *_) in ranked[1:]:
        if rank[0] and other_rank[:5] == rank[:5] and not are_parallel(first, other):
            raise InputError(
                f"{where}: holds two stacks of {rank[4]} images in different directions, "
                f"{first.series} ({first.where}) and {other.series} ({other.where}); "
                f"keep the one to be used: {LEAVE_OUT}"
            )


def _without_stills(frames: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Part series that are no cine, but of the matrix of cines, from these."""
    by_series: dict[str, list[Frame]] = {}
    for frame in frames:
        by_series.setdefault(frame.series_uid, []).append(frame)
    single = {name for name, one in by_series.items() if max(_moments(one)) < MIN_PHASES}
    moving = {name for name, one in by_series.items() if name not in single and _spans_beat(one)}
    cine = [frame for frame in frames if frame.series_uid in moving]
    if not cine:
        return list(frames), []
    slices_mm, normal = slice_positions(cine), cine[0].normal
    elsewhere = {name for name in single if not _covered(by_series[name], normal, slices_mm)}
    # A cine may be stored with a series for each phase, and some of its slices otherwise.
    beyond = [frame for frame in frames if frame.series_uid in elsewhere]
    if beyond and _is_cine(beyond):
        single -= elsewhere
    elif len(single - elsewhere) <= len(elsewhere):
        # Late enhancement may have a series for each slice, most of them slices of the cine.
        single -= {name for name in elsewhere if len(slice_positions(by_series[name])) == 1}
    short = by_series.keys() - moving - single - elsewhere
    stills = single | {name for name in short if _within(by_series[name], cine, slices_mm)}
    return (
        [frame for frame in frames if frame.series_uid not in stills],
        [frame for frame in frames if frame.series_uid in stills],
    )


def _within(series: Sequence[Frame], cine: Sequence[Frame], slices_mm: Float) -> bool:
    """Whether a series lies within what a cine shows of its slices, in place and time. A slice that
    is stored in pieces has the rest of its times elsewhere."""
    normal = cine[0].normal
    if not _covered(series, normal, slices_mm):
        return False
    near_mm = _half_step_mm(slices_mm)
    places_mm = np.array([float(frame.middle_mm @ normal) for frame in series])
    beside = [
        frame
        for frame in cine
        if np.abs(places_mm - float(frame.middle_mm @ normal)).min() < near_mm
    ]
    own_ms, theirs_ms = _time_ranges_ms(series), _time_ranges_ms(beside)
    # By one attribute for both: times of acquisition and of triggers count from other moments.
    shared = [name for name in theirs_ms if name in own_ms]
    if not shared:
        # Without any time it is no piece of a cine that has them.
        return not own_ms
    told = max(shared, key=lambda name: _span_ms(theirs_ms[name]))
    (first_ms, last_ms), (start_ms, end_ms) = own_ms[told], theirs_ms[told]
    return start_ms <= first_ms and last_ms <= end_ms


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
    if not are_parallel(first, other):
        angle = np.degrees(np.arccos(min(abs(float(first.normal @ other.normal)), 1.0)))
        return f"not parallel to the stack, turned by {angle:.0f} degrees"
    if max(_moments(others)) < MIN_PHASES:
        return "one moment a slice, no cine"
    if not _spans_beat(others):
        return "all at nearly one moment of the beat, no cine"
    if not _in_one_beat(others):
        return "many beats in real time, no cine"
    if not _covered(others, first.normal, slices_mm):
        return None
    rows, columns = other.pixels.shape
    sort = "" if other.kind == first.kind else f"{other.kind} images, "
    return f"{sort}slices that the stack has already, {rows} x {columns} pixels"


def _refuse(first: Frame, other: Frame, where: str) -> None:
    """Say what keeps two parallel sets apart that show different slices."""
    one, two = (f"{frame.series} ({frame.where})" for frame in (first, other))
    if other.pixels.shape != first.pixels.shape:
        what = (
            f"slices have different matrices: {one} has {first.pixels.shape}, {two} has "
            f"{other.pixels.shape} (rows, columns); give one stack of one matrix"
        )
    elif not np.allclose(other.spacing_mm, first.spacing_mm, rtol=1e-3):
        what = (
            f"slices have different pixel spacing: {one} has {first.spacing_mm} mm, {two} has "
            f"{other.spacing_mm} mm; give one stack of one spacing"
        )
    elif not _same_axes(first, other):
        what = (
            f"slices are turned in their plane: rows and columns of {two} run along "
            f"{other.axes.round(3).tolist()}, those of {one} along "
            f"{first.axes.round(3).tolist()}; give one stack of one direction"
        )
    else:
        what = (
            f"{one} is {first.kind}, {two} is {other.kind} and shows a slice that the others lack; "
            "give one stack of one kind"
        )
    raise InputError(f"{where}: {what}: {LEAVE_OUT}")


def _spared(frames: Iterable[Frame], reason: str) -> list[LeftOut]:
    return [LeftOut(frame.where, frame.series, frame.series_uid, reason) for frame in frames]
