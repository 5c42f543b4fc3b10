"""Single images of a cine as files give them, and what sets of them have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

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
LONGEST_RR_MS = 3000.0
"""Where nothing tells the RR interval, what takes longer is no heartbeat."""
MANY_BEATS = 1.5
"""Times beyond so many RR intervals are of more than one beat, not of one that was long."""

LEAVE_OUT = "take the other's files out, or name its number in cine.leave_out_series in study.yaml"
SEVERAL = "which takes several, as [12, 15]"


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

    born: str = ""
    """The patient's date of birth, YYYYMMDD; empty when the file does not tell."""

    study: str = ""
    """What tells apart a patient's examinations; empty when the file does not."""

    number: int | None = None
    """Its number within its series; None when the file does not tell."""

    acquisition: int | None = None
    """Number of the acquisition within its series; None when the file does not tell."""

    other_rr_ms: float | None = None
    """RR interval by the heart rate, where another attribute tells ``rr_ms``."""

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


def slice_positions(frames: Sequence[Frame]) -> Float:
    """Where the slices lie along the first frame's normal, rising, in mm."""
    along_mm = np.sort(places_along_mm(frames, frames[0].normal))
    return np.asarray(along_mm[np.diff(along_mm, prepend=-np.inf) > NEAREST_SLICES_MM])


def places_along_mm(frames: Sequence[Frame], normal: Float) -> Float:
    """Where each frame ``(n,)`` lies along a normal."""
    return np.array([frame.middle_mm @ normal for frame in frames], float)


def sets_alike(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Sets of images that could be stacked: same pixel axes, matrix, spacing and kind."""
    return grouped(
        frames, lambda first, frame: first.kind == frame.kind and fit_each_other(first, frame)
    )


def grouped(frames: Iterable[Frame], belongs: Callable[[Frame, Frame], bool]) -> list[list[Frame]]:
    """Each frame with the first set to whose first frame it belongs, or in one of its own."""
    sets: list[list[Frame]] = []
    for frame in frames:
        own = next((one for one in sets if belongs(one[0], frame)), None)
        if own is None:
            sets.append([frame])
        else:
            own.append(frame)
    return sets


def fit_each_other(first: Frame, frame: Frame) -> bool:
    """Whether two images could be stacked: same matrix, pixel axes and spacing."""
    return (
        first.pixels.shape == frame.pixels.shape
        and have_same_axes(first, frame)
        and np.allclose(frame.spacing_mm, first.spacing_mm, rtol=1e-3)
    )


def have_same_axes(first: Frame, frame: Frame) -> bool:
    """Whether columns and rows of two images run along the same directions."""
    return float((first.axes * frame.axes).sum(axis=1).min()) > PARALLEL_COSINE


def are_parallel(first: Frame, frame: Frame) -> bool:
    """Whether two images lie in one direction, as slices of a stack do."""
    return abs(float(first.normal @ frame.normal)) > PARALLEL_COSINE


def by_slice(frames: Sequence[Frame]) -> list[list[Frame]]:
    """The frames of each slice, the slices in order along the first frame's normal."""
    # Half the least distance of two slices: rounded positions fall on the right side.
    starts_mm = slice_positions(frames) - NEAREST_SLICES_MM / 2
    slices: list[list[Frame]] = [[] for _ in starts_mm]
    for frame, along_mm in zip(frames, places_along_mm(frames, frames[0].normal), strict=True):
        slices[int(np.searchsorted(starts_mm, along_mm)) - 1].append(frame)
    return slices


def by_series(frames: Iterable[Frame]) -> dict[str, list[Frame]]:
    """The frames of each series, by what tells it apart."""
    series: dict[str, list[Frame]] = {}
    for frame in frames:
        series.setdefault(frame.series_uid, []).append(frame)
    return series


def count_moments(frames: Sequence[Frame]) -> list[int]:
    """Number of different times that each slice shows."""
    return [len({tuple(frame.times_ms.values()) for frame in one}) for one in by_slice(frames)]


def is_cine(frames: Sequence[Frame]) -> bool:
    """Whether most of the slices are seen at two moments or more, of different parts of a beat."""
    return float(np.median(count_moments(frames))) >= MIN_PHASES and span_beat(frames)


def span_beat(frames: Sequence[Frame]) -> bool:
    """Whether most slices are seen through a beat rather than at nearly one moment of it, as in
    perfusion and mapping, which show a slice many times."""
    beat_ms = next((frame.rr_ms for frame in frames if frame.rr_ms), USUAL_RR_MS)
    spans_ms = [last_ms - first_ms for first_ms, last_ms in map(_time_range_ms, by_slice(frames))]
    return float(np.median(spans_ms)) >= LEAST_OF_A_BEAT * beat_ms


def are_in_one_beat(frames: Sequence[Frame]) -> bool:
    """Whether most slices' times lie within about one RR interval, as those of images in real time
    do not."""
    beats = [[_beats(frame) for frame in one] for one in by_slice(frames)]
    return float(np.median([max(one) - min(one) for one in beats])) < MANY_BEATS


def _beats(frame: Frame) -> float:
    """In which heartbeat an image was taken, counted from 0."""
    rr_ms = frame.rr_ms or LONGEST_RR_MS / MANY_BEATS
    return next(iter(frame.times_ms.values()), 0.0) / rr_ms


def _time_range_ms(frames: Sequence[Frame]) -> tuple[float, float]:
    """First and last time by the attribute that tells the frames furthest apart."""
    return max(time_ranges_ms(frames).values(), key=span_ms, default=(0.0, 0.0))


def time_ranges_ms(frames: Sequence[Frame]) -> dict[str, tuple[float, float]]:
    """First and last time by each attribute that all frames have, in the order of the first's."""
    ranges_ms = {}
    for name in frames[0].times_ms:
        if all(name in frame.times_ms for frame in frames):
            times_ms = [frame.times_ms[name] for frame in frames]
            ranges_ms[name] = min(times_ms), max(times_ms)
    return ranges_ms


def span_ms(first_and_last_ms: tuple[float, float]) -> float:
    """From the first time to the last."""
    return first_and_last_ms[1] - first_and_last_ms[0]


def is_stack(frames: Sequence[Frame]) -> bool:
    """Whether images alike make up a cine of several slices."""
    return is_cine(frames) and len(slice_positions(frames)) >= MIN_SLICES
