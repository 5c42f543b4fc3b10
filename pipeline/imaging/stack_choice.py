"""Which of a folder's single images make up the stack.

A folder from a scanner holds more than one stack: long-axis views, localisers, derived images,
copies. What is not of the stack is left out and named, one line a series; what might be of the
stack but does not fit it is refused.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import compress
from operator import itemgetter

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Mask
from pipeline.imaging.frames import (
    DERIVED,
    LEAVE_OUT,
    MIN_PHASES,
    NEAREST_SLICES_MM,
    ORIGINAL,
    Frame,
    are_in_one_beat,
    are_parallel,
    by_series,
    count_moments,
    fit_each_other,
    have_same_axes,
    is_cine,
    is_stack,
    places_along_mm,
    sets_alike,
    slice_positions,
    span_beat,
    span_ms,
    time_ranges_ms,
)
from pipeline.imaging.left_out import LeftOut, inside

BETWEEN, NEAR = (1.0, 2 / 3), 0.05
"""How far, in half steps, every second or third slice of a stack lies from the others, and by how
much places may be off."""

ROUNDING = 1e-3
"""Part of half a step by which a slice in the very middle of two may seem farther from both."""

Rank = tuple[bool, int, bool, bool, bool, int, float]
"""Whether a set is a cine stack, the images of the largest one in its direction, whether it shows
one beat, whether it tells how long one lasts, whether original, its own number of images, pixels
per mm2."""


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
    ranked = _ranked([part for one in sets_alike(frames) for part in _by_pace(one)])
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
            slices_mm, normal = slice_positions(stack), stack[0].normal
            twice = _on_slices(others, normal, slices_mm)
            twice &= ~_are_between(others, normal, slices_mm)
            reason = f"{others[0].kind} images, slices that the stack has already"
            left_out += _spared(compress(others, twice), reason)
            stack = [*stack, *compress(others, ~twice)]
        else:
            _refuse(stack[0], others[0], where)
    return stack, left_out


def stacks_beside(frames: Sequence[Frame], stack: Sequence[Frame], folder: str) -> tuple[str, ...]:
    """Which other original images would make up a cine stack, in words: those of another direction,
    and those of finer pixels."""
    others = [one for one in sets_alike(frames) if one[0].kind == ORIGINAL and is_stack(one)]
    finer = [
        f"{one[0].series} ({inside(one[0].where, folder)}, ...) is a cine of "
        f"{len(slice_positions(one))} slices in the same direction, and of finer pixels than "
        f"{stack[0].series}, which was taken for its {len(stack)} images: if that is the better "
        "one, name the other's number in cine.leave_out_series in study.yaml"
        for one in others
        if are_parallel(stack[0], one[0])
        and are_in_one_beat(one)
        and one[0].spacing_mm[0] < 0.99 * stack[0].spacing_mm[0]
    ]
    across = [
        f"{one[0].series} ({inside(one[0].where, folder)}, ...) is a cine of "
        f"{len(slice_positions(one))} slices too, in another direction than {stack[0].series}, "
        f"which was taken for its {len(stack)} images: if that is not the short axis, take its "
        "files out, or name its number in cine.leave_out_series in study.yaml"
        for one in others
        if not are_parallel(stack[0], one[0])
    ]
    return (*across, *finer)


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


def _joins(first: Frame, other: Frame) -> bool:
    """Whether original and derived images may make up one stack."""
    return fit_each_other(first, other) and {first.kind, other.kind} == {ORIGINAL, DERIVED}


def _ranked(sets: Sequence[list[Frame]]) -> list[tuple[Rank, list[Frame]]]:
    """Sets of images alike, each with its rank, the first one first."""
    stacks = [one for one in sets if is_stack(one) and one[0].kind in (ORIGINAL, DERIVED)]
    ranked = []
    for one in sets:
        along = [_weight(other) for other in stacks if are_parallel(one[0], other[0])]
        per_mm2 = 1 / (one[0].spacing_mm[0] * one[0].spacing_mm[1])
        enough = any(one is other for other in stacks)
        original = one[0].kind == ORIGINAL
        told = any(frame.rr_ms is not None for frame in one)
        in_direction = max(along, default=0)
        rank = (enough, in_direction, are_in_one_beat(one), told, original, len(one), per_mm2)
        ranked.append((rank, one))
    return sorted(ranked, key=itemgetter(0), reverse=True)


def _weight(frames: Sequence[Frame]) -> int:
    """Images of a stack; derived ones count half beside those of another direction."""
    return len(frames) // (1 if frames[0].kind == ORIGINAL else 2)


def _require_one_largest(ranked: Sequence[tuple[Rank, list[Frame]]], where: str) -> None:
    rank, (first, *_) = ranked[0]
    for other_rank, (other, *_) in ranked[1:]:
        if rank[0] and other_rank[:6] == rank[:6] and not are_parallel(first, other):
            raise InputError(
                f"{where}: holds two stacks of {rank[5]} images in different directions, "
                f"{first.series} ({first.where}) and {other.series} ({other.where}); "
                f"keep the one to be used: {LEAVE_OUT}"
            )


def _by_pace(frames: list[Frame]) -> list[list[Frame]]:
    """Part series in real time from a cine that has slices of theirs, and their very matrix."""
    series = by_series(frames)
    slow = {name for name, one in series.items() if not are_in_one_beat(one)}
    cine = [frame for frame in frames if frame.series_uid not in slow]
    if not slow or not cine or not is_cine(cine):
        return [frames]
    slices_mm, normal = slice_positions(cine), cine[0].normal
    # A slice of which there is no other is the cine's own, and runs over its beat.
    slow = {name for name in slow if _on_slices(series[name], normal, slices_mm).any()}
    gated = [frame for frame in frames if frame.series_uid not in slow]
    running = [frame for frame in frames if frame.series_uid in slow]
    return [gated, running] if running else [gated]


def _without_stills(frames: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """Part series that are no cine, but of the matrix of cines, from these."""
    series = by_series(frames)
    single = {name for name, one in series.items() if max(count_moments(one)) < MIN_PHASES}
    moving = {name for name, one in series.items() if name not in single and span_beat(one)}
    cine = [frame for frame in frames if frame.series_uid in moving]
    if not cine:
        return list(frames), []
    slices_mm, normal = slice_positions(cine), cine[0].normal
    elsewhere = {name for name in single if not _covered(series[name], normal, slices_mm)}
    # A cine may be stored with a series for each phase, and some of its slices otherwise.
    beyond = [frame for frame in frames if frame.series_uid in elsewhere]
    if beyond and is_cine(beyond):
        single -= elsewhere
    elif len(single - elsewhere) <= len(elsewhere):
        # Late enhancement may have a series for each slice, most of them slices of the cine.
        single -= {name for name in elsewhere if len(slice_positions(series[name])) == 1}
    short = series.keys() - moving - single - elsewhere
    stills = single | {name for name in short if _within(series[name], cine, slices_mm)}
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
    apart_mm = places_along_mm(cine, normal)[:, None] - places_along_mm(series, normal)
    beside = list(compress(cine, np.abs(apart_mm).min(axis=1) < _half_step_mm(slices_mm)))
    own_ms, theirs_ms = time_ranges_ms(series), time_ranges_ms(beside)
    # By one attribute for both: times of acquisition and of triggers count from other moments.
    shared = [name for name in theirs_ms if name in own_ms]
    if not shared:
        # Without any time it is no piece of a cine that has them.
        return not own_ms
    told = max(shared, key=lambda name: span_ms(theirs_ms[name]))
    (first_ms, last_ms), (start_ms, end_ms) = own_ms[told], theirs_ms[told]
    return start_ms <= first_ms and last_ms <= end_ms


def _half_step_mm(slices_mm: Float) -> float:
    step_mm = float(np.diff(slices_mm).min()) if len(slices_mm) > 1 else 2 * NEAREST_SLICES_MM
    return 0.5 * step_mm


def _covered(frames: Sequence[Frame], normal: Float, slices_mm: Float) -> bool:
    """Whether the frames show only slices that are there: within half a step of one."""
    return bool(_on_slices(frames, normal, slices_mm).all())


def _on_slices(frames: Sequence[Frame], normal: Float, slices_mm: Float) -> Mask:
    """Which frames ``(n,)`` show slices that are there."""
    return _half_steps(frames, normal, slices_mm) < 1 + ROUNDING


def _are_between(frames: Sequence[Frame], normal: Float, slices_mm: Float) -> Mask:
    """Which frames may be every second or third slice of one stack that was stored in parts: those
    just between two slices, if the set has half as many as there are, or more, and all its other
    frames lie on slices. A stack of another step lies anywhere."""
    many = 2 * len(slice_positions(frames)) >= len(slices_mm)
    away = _half_steps(frames, normal, slices_mm)
    near = np.abs(away[:, None] - BETWEEN).min(axis=1) < NEAR
    return np.asarray(near & many & (near | (away < NEAR)).all())


def _half_steps(frames: Sequence[Frame], normal: Float, slices_mm: Float) -> Float:
    """How far each frame lies from the nearest slice, in half steps."""
    away_mm = np.abs(places_along_mm(frames, normal)[:, None] - slices_mm).min(axis=1)
    return np.asarray(away_mm / _half_step_mm(slices_mm))


def _why_left_out(first: Frame, slices_mm: Float, others: Sequence[Frame]) -> str | None:
    other = others[0]
    if not are_parallel(first, other):
        angle = np.degrees(np.arccos(min(abs(float(first.normal @ other.normal)), 1.0)))
        return f"not parallel to the stack, turned by {angle:.0f} degrees"
    if max(count_moments(others)) < MIN_PHASES:
        return "one moment a slice, no cine"
    if not span_beat(others):
        return "all at nearly one moment of the beat, no cine"
    if not are_in_one_beat(others):
        return "many beats in real time, no cine"
    if not _covered(others, first.normal, slices_mm):
        return None
    if _are_between(others, first.normal, slices_mm).any():
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
    elif not have_same_axes(first, other):
        what = (
            f"slices are turned in their plane: rows and columns of {two} run along "
            f"{other.axes.round(3).tolist()}, those of {one} along "
            f"{first.axes.round(3).tolist()}; give one stack of one direction"
        )
    elif not np.allclose(other.spacing_mm, first.spacing_mm, rtol=1e-3):
        what = (
            f"slices have different pixel spacing: {one} has {first.spacing_mm[::-1]} mm, {two} "
            f"has {other.spacing_mm[::-1]} mm (from row to row, from column to column); give one "
            "stack of one spacing"
        )
    else:
        what = (
            f"{one} is {first.kind}, {two} is {other.kind} and shows a slice that the others lack; "
            "give one stack of one kind"
        )
    raise InputError(f"{where}: {what}: {LEAVE_OUT}")


def _spared(frames: Iterable[Frame], reason: str) -> list[LeftOut]:
    return [LeftOut(frame.where, frame.series, frame.series_uid, reason) for frame in frames]
