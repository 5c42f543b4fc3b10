"""Which images beside the stack are long-axis views, and their place and time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.geometry import Float
from pipeline.imaging.cine import Cine, placement
from pipeline.imaging.frames import (
    LEAST_OF_A_BEAT,
    MIN_PHASES,
    NEAREST_SLICES_MM,
    ORIGINAL,
    PARALLEL_COSINE,
    Frame,
    by_series,
    count_moments,
    grouped,
    time_ranges_ms,
)
from pipeline.imaging.phases import PLAUSIBLE_RR_S

LEAST_ANGLE_DEG = 45.0
"""A long-axis view is turned at least this far from the stack's slices."""


@dataclass(frozen=True, slots=True)
class LongAxis:
    """One long-axis view: a slice through the heartbeat, across those of the stack."""

    name: str
    """Series, or file, that it comes from."""

    cine: Cine
    """One slice; its phases are those of its own trigger times and RR interval."""

    remarks: tuple[str, ...] = ()
    """What its file leaves open, and a person must know before the products are used."""


def long_axis_views(
    frames: Iterable[Frame], stack: Cine
) -> tuple[tuple[LongAxis, ...], tuple[str, ...]]:
    """The long-axis views among a scanner's images, and why other cines across the stack are none,
    a line each.

    Original images of one slice at `MIN_PHASES` moments or more, with trigger times within their
    RR interval, at least `LEAST_ANGLE_DEG` from the stack's slices, and in the same frame of
    reference: a patient laid down anew is somewhere else. Localisers and images of one moment are
    none. Parallel slices are views each, and so is a slice that was taken again, for each has a
    breath-hold of its own.
    """
    frames = list(frames)
    normal = np.cross(stack.mr_from_index[:3, 0], stack.mr_from_index[:3, 1])
    normal /= np.linalg.norm(normal)
    along = [frame for frame in frames if _cosine(frame, normal) > PARALLEL_COSINE]
    reference = _most(frame.frame_of_reference for frame in along)
    examination = _most(frame.study for frame in along)

    def is_elsewhere(frame: Frame) -> bool:
        if frame.frame_of_reference:
            return frame.frame_of_reference != reference
        return frame.study not in ("", examination)

    farthest = np.cos(np.radians(LEAST_ANGLE_DEG))
    across = [frame for frame in frames if _cosine(frame, normal) < farthest]
    across.sort(key=lambda one: one.where)
    original = [frame for frame in across if frame.kind == ORIGINAL]
    found = [
        _views(one)
        for one in grouped((one for one in original if not is_elsewhere(one)), _same_slice)
    ]
    views = tuple(view for some, _ in found for view in some)
    reasons = [reason for _, some in found for reason in some]
    # A series may hold velocities beside original images, which are a view, or told of themselves.
    seen = {frame.series_uid for frame in original}
    reasons += [
        f"{one[0].series}: no long-axis view: its images are {one[0].kind}, and no original ones"
        for one in by_series(frame for frame in across if frame.kind != ORIGINAL).values()
        if max(count_moments(one)) >= MIN_PHASES and one[0].series_uid not in seen
    ]
    reasons += [
        f"{one[0].series}: no long-axis view: it has another FrameOfReferenceUID than the stack, "
        "or none and another StudyInstanceUID, as of a patient laid down anew; if a program that "
        "makes files anonymous did that, let it keep one for all"
        for one in by_series(filter(is_elsewhere, original)).values()
        if len(one) >= MIN_PHASES
    ]
    return views, tuple(reasons)


def _cosine(frame: Frame, normal: Float) -> float:
    return abs(float(frame.normal @ normal))


def _most(uids: Iterable[str]) -> str:
    counted = Counter(uids)
    return max(counted, key=lambda uid: (counted[uid], uid), default="")


def _same_slice(first: Frame, frame: Frame) -> bool:
    """Whether two images show one slice on one matrix, as nearly as files write places."""
    return (
        first.pixels.shape == frame.pixels.shape
        and np.allclose(frame.spacing_mm, first.spacing_mm, rtol=1e-3)
        and np.allclose(frame.axes, first.axes, rtol=0, atol=1e-3)
        and np.allclose(frame.position_mm, first.position_mm, rtol=0, atol=NEAREST_SLICES_MM)
    )


def _views(frames: Sequence[Frame]) -> tuple[list[LongAxis], list[str]]:
    """What the images of one slice make up: a view a series, or one where these are its parts; and
    why series are none.

    Of two series of the same images, as of a classic and an Enhanced object, one is taken.
    """
    views: list[LongAxis] = []
    reasons = []
    for one in by_series(frames).values():
        view = _view(one)
        if isinstance(view, str):
            reasons.append(f"{one[0].series}: no long-axis view: {view}")
        elif view and not any(
            np.array_equal(view.cine.intensity, other.cine.intensity) for other in views
        ):
            views.append(view)
    spans = sorted((view.cine.phases[0], view.cine.phases[-1]) for view in views)
    if all(later[0] > earlier[1] for earlier, later in pairwise(spans)) and len(views) != 1:
        together = _view(frames)
        if isinstance(together, LongAxis):
            return [together], []
    return views, reasons


def _view(frames: Sequence[Frame]) -> LongAxis | str | None:
    """The images of one slice in order of time; None when they are no cine, or what in words keeps
    a cine from being a view."""
    first = frames[0]
    if len(frames) < MIN_PHASES:
        return None
    if any(frame.rr_ms is None for frame in frames):
        return "it has no RR interval; cine.rr_ms in study.yaml gives one"
    names = time_ranges_ms(frames)
    if not names:
        return "it has no trigger times"
    # The most trusted of those that tell most images apart, as for the stack.
    name = max(names, key=lambda one: len({frame.times_ms[one] for frame in frames}))
    moments: dict[float, Frame] = {}
    for frame in frames:
        other = moments.setdefault(frame.times_ms[name], frame)
        if not np.array_equal(other.pixels, frame.pixels):
            return f"it shows two images at {frame.times_ms[name]:g} ms"
    if len(moments) < MIN_PHASES:
        return None
    ordered = [moments[time_ms] for time_ms in sorted(moments)]
    rr_ms = float(np.mean([frame.rr_ms for frame in ordered if frame.rr_ms is not None]))
    low_ms, high_ms = (1000 * limit_s for limit_s in PLAUSIBLE_RR_S)
    if not low_ms < rr_ms < high_ms:
        return f"its RR interval is {rr_ms:g} ms"
    times_ms = sorted(moments)
    if not all(0 <= time_ms < rr_ms for time_ms in times_ms):
        return (
            f"its trigger times, from {times_ms[0]:g} to {times_ms[-1]:g} ms, do not fit in its RR "
            f"interval of {rr_ms:g} ms"
        )
    if times_ms[-1] - times_ms[0] < LEAST_OF_A_BEAT * rr_ms:
        return f"all at nearly one moment of the beat, {times_ms[0]:g} to {times_ms[-1]:g} ms"
    intensity = np.stack([np.asarray(frame.pixels, np.float32) for frame in ordered])[:, None]
    place = placement(first, first.normal)
    return LongAxis(first.series, Cine(intensity, place, np.array(times_ms) / rr_ms, rr_ms / 1000))
