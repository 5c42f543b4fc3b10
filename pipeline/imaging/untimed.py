"""A cine whose files do not tell when its images were taken, such as one made anonymous."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import InputError
from pipeline.imaging.frames import (
    DERIVED,
    LEAVE_OUT,
    MIN_PHASES,
    ORIGINAL,
    Frame,
    are_parallel,
    by_slice,
    is_stack,
    sets_alike,
)

ORDER = "InstanceNumber"
ALIKE_COUNT = 1.25
"""A series across the stack is a cine as the stack is if its slices have as many images, but for
this factor; perfusion, maps and localisers have more or fewer. So have two acquisitions."""


def spread_evenly(frames: Sequence[Frame], rr_ms: float, where: str) -> tuple[list[Frame], str]:
    """Images with the times of a regular beat where their own tell none, and a remark on it.

    Each series' and acquisition's images of a slice are spread over the RR interval in the order of
    their InstanceNumber, which scanners count in the order of time within a slice. So it is with a
    stack to which none is parallel that has times, and with what lies across it and has about as
    many images a slice. The remark is empty where there is no such stack.

    Parameters
    ----------
    rr_ms
        RR interval that a person has given.

    Raises
    ------
    InputError
        When there are two such stacks of one direction: one of them may be many beats in real time.
    """
    frames = list(frames)
    # Some programs that make files anonymous call all images derived.
    kind = ORIGINAL if any(frame.kind == ORIGINAL for frame in frames) else DERIVED
    timed = [one for one in sets_alike(frames) if one[0].kind == kind and is_stack(one)]
    spread: dict[int, Frame] = {}
    stacks: list[list[Frame]] = []
    others: list[list[Frame]] = []
    for alike in sets_alike(frames):
        found = _spread(alike, rr_ms)
        if any(are_parallel(alike[0], one[0]) for one in timed) or not found:
            continue
        even = [found.get(id(frame), frame) for frame in alike]
        if alike[0].kind == kind and is_stack(even):
            stacks.append(alike)
            spread |= found
        else:
            others.append(alike)
    _require_one_a_direction(stacks, where)
    if not stacks:
        return frames, ""
    count = max(_images_a_slice(one) for one in stacks)
    for alike in others:
        spread |= _spread(alike, rr_ms, count)
    views = {
        frame.series
        for frame in frames
        if id(frame) in spread and not any(are_parallel(frame, one[0]) for one in stacks)
    }
    also = f" (in {', '.join(sorted(views))}, across it, too)" if views else ""
    return [spread.get(id(frame), frame) for frame in frames], (
        f"the files do not tell when in the heartbeat images were taken: the {count:g} of each "
        f"slice are taken in the order of their InstanceNumber, evenly over the RR interval of "
        f"cine.rr_ms{also}; of a heart seen in real time that would be wrong"
    )


def _require_one_a_direction(stacks: Sequence[Sequence[Frame]], where: str) -> None:
    for number, one in enumerate(stacks):
        for other in stacks[:number]:
            if are_parallel(one[0], other[0]):
                raise InputError(
                    f"{where}: holds two cine stacks of one direction that do not tell when their "
                    f"images were taken, {other[0].series} ({other[0].where}) with "
                    f"{_images_a_slice(other):g} images a slice and {one[0].series} "
                    f"({one[0].where}) with {_images_a_slice(one):g}; one may be in real time: "
                    f"keep the one to be used: {LEAVE_OUT}"
                )


def _images_a_slice(frames: Sequence[Frame]) -> float:
    return float(np.median([len({frame.number for frame in one}) for one in by_slice(frames)]))


def _spread(alike: Sequence[Frame], rr_ms: float, count: float | None = None) -> dict[int, Frame]:
    """Images alike, by identity, with even times; those of slices with another count left out."""
    found: dict[int, Frame] = {}
    for one in _of_slice_and_series(alike):
        ordered = _in_order(one)
        if count and not 1 / ALIKE_COUNT <= len(ordered) / count <= ALIKE_COUNT:
            continue
        for place, same in enumerate(ordered):
            time_ms = place * rr_ms / len(ordered)
            found |= {id(frame): replace(frame, times_ms={ORDER: time_ms}) for frame in same}
    return found


def _of_slice_and_series(alike: Sequence[Frame]) -> list[list[Frame]]:
    """Parts of images alike, of one slice, series and acquisition each; whole slices where no
    series shows a slice more than once."""
    slices = by_slice(alike)
    parts: dict[tuple[int, str], list[Frame]] = {}
    for number, one in enumerate(slices):
        for frame in one:
            parts.setdefault((number, frame.series_uid), []).append(frame)
    if max(map(len, parts.values())) == 1:
        return slices
    return [one for part in parts.values() for one in _acquisitions(part)]


def _acquisitions(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Images of one slice and series by acquisition, if each shows about as many, and several: a
    number that counts images tells of no slice that was taken twice."""
    found: dict[int | None, list[Frame]] = {}
    for frame in frames:
        found.setdefault(frame.acquisition, []).append(frame)
    counts = [len(one) for one in found.values()]
    twice = min(counts) >= max(MIN_PHASES, max(counts) / ALIKE_COUNT)
    return list(found.values()) if twice else [list(frames)]


def _in_order(frames: Iterable[Frame]) -> list[list[Frame]]:
    """Images by number, copies together; none where times or numbers do not leave that open and
    tell it."""
    frames = list(frames)
    if any(frame.number is None for frame in frames):
        return []
    # The same images may be there twice, as classic files and as an Enhanced object.
    images: dict[bytes, list[Frame]] = {}
    for frame in sorted(frames, key=lambda one: one.number or 0):
        images.setdefault(np.ascontiguousarray(frame.pixels).tobytes(), []).append(frame)
    numbers = {one[0].number for one in images.values()}
    times = {tuple(frame.times_ms.values()) for frame in frames}
    if len(images) < MIN_PHASES or len(times) > 1 or len(numbers) < len(images):
        return []
    return list(images.values())
