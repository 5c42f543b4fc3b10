"""A cine whose files do not tell when its images were taken, such as one made anonymous."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.imaging.frames import ORIGINAL, Frame, by_slice, is_stack, sets_alike

ORDER = "InstanceNumber"


def spread_evenly(frames: Sequence[Frame], rr_ms: float) -> tuple[list[Frame], str]:
    """Images with the times of a regular beat where their own tell none, and a remark on it.

    Each series' images of a slice are spread over the RR interval in the order of their
    InstanceNumber, which scanners count in the order of time within a slice. Nothing is changed,
    and the remark is empty, where the times tell of a cine, or no images of a cine are untimed.

    Parameters
    ----------
    rr_ms
        RR interval that a person has given.
    """
    if any(is_stack(one) for one in sets_alike(frames) if one[0].kind == ORIGINAL):
        return list(frames), ""
    timed = {
        id(frame): {ORDER: place * rr_ms / len(one)}
        for alike in sets_alike(frames)
        for one in _of_slice_and_series(alike)
        for place, frame in enumerate(_in_order(one))
    }
    spread = [
        replace(frame, times_ms=timed[id(frame)]) if id(frame) in timed else frame
        for frame in frames
    ]
    if not any(is_stack(one) for one in sets_alike(spread)):
        return list(frames), ""
    return spread, (
        "the files do not tell when in the heartbeat images were taken: each slice's are taken in "
        "the order of their InstanceNumber, evenly over the RR interval of cine.rr_ms"
    )


def _of_slice_and_series(alike: Sequence[Frame]) -> list[list[Frame]]:
    parts: dict[tuple[int, str], list[Frame]] = {}
    for number, one in enumerate(by_slice(alike)):
        for frame in one:
            parts.setdefault((number, frame.series_uid), []).append(frame)
    return list(parts.values())


def _in_order(frames: Sequence[Frame]) -> list[Frame]:
    """Images by number; none where times or numbers do not leave that open and tell it."""
    times = {tuple(frame.times_ms.values()) for frame in frames}
    numbers = {frame.number for frame in frames if frame.number is not None}
    if len(frames) < 2 or len(times) > 1 or len(numbers) < len(frames):
        return []
    return sorted(frames, key=lambda frame: frame.number or 0)
