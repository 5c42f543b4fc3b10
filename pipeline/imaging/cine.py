"""Cine MR as the pipeline sees it: one stack of parallel slices through one heartbeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32
from pipeline.imaging.frames import (
    LEAVE_OUT,
    MIN_PHASES,
    MIN_SLICES,
    SEVERAL,
    Frame,
    by_series,
    by_slice,
    is_stack,
    slice_positions,
)
from pipeline.imaging.left_out import LeftOut, describe, left_out_lines
from pipeline.imaging.phases import common_phases
from pipeline.imaging.spacing import MOST_TOLD, fill_gaps, regular_places
from pipeline.imaging.stack_choice import choose_stack, stacks_beside

EVENLY = (
    ", or give cine.rr_ms in study.yaml, by which phases are spread evenly in the order of "
    "InstanceNumber where each image has one and none of a slice tells its time"
)
NOT_SPREAD = (
    "; cine.rr_ms alone does not do, for it spreads only images that are original, or derived "
    "throughout, and whose order within each slice their InstanceNumbers tell"
)
OTHER_RATE = 1.3
"""Times by which a heart may beat faster or slower than its images tell, by another of their
attributes or by the ECG beside them."""


@dataclass(frozen=True, slots=True)
class Cine:
    """A stack of slices through the cycle, in patient LPS millimetres."""

    intensity: Float32
    """``(phase, z, y, x)``, in the scanner's own units."""

    mr_from_index: Float
    """4x4: ``(x, y, z)`` voxel indices to millimetres."""

    phases: Float
    """``(phase,)`` in [0, 1), rising: trigger time over RR interval."""

    rr_s: float
    """RR interval, averaged over the slices."""

    interpolated: tuple[int, ...] = ()
    """Slices never acquired, or spoilt: the mean of their two neighbours stands in for each. They
    keep the stack evenly spaced; nothing is to be measured on them."""

    moments: Float | None = None
    """``(z, phase)`` in [0, 1): where in the mean beat each slice shows the heart, by its own
    trigger times and RR interval; None where they are not told apart."""

    @property
    def spacing_mm(self) -> Float:
        """Distance between voxel centres along the array's ``x, y, z``."""
        return np.asarray(np.linalg.norm(self.mr_from_index[:3, :3], axis=0))


@dataclass(frozen=True, slots=True)
class Stack:
    """A cine with what the reader noticed on the way."""

    cine: Cine
    trigger_times_ms: Float
    """``(slice, phase)``."""

    rr_ms: Float
    """``(slice,)``."""

    timing_source: str
    left_out: tuple[str, ...]
    """What is not part of the stack, such as long-axis views: a line a series, with the reason."""

    timed: tuple[int, ...] = ()
    """Which slices the times are of, where some are drawn between others; empty: of all."""

    remarks: tuple[str, ...] = ()
    """What the files leave open, and a person must know before the products are used."""

    patient: str = ""
    """The patient's identifier; empty where the files do not tell."""

    blank_ends: tuple[int, int] = (0, 0)
    """Slices of the files before the cine's and after them, which show nothing in any phase."""


def stack_frames(
    frames: Sequence[Frame],
    where: str,
    rr_source: str | None = None,
    others: Sequence[LeftOut] = (),
    fill: bool = False,
) -> Stack:
    """Sort images, in any order, into one regular stack.

    Images that are not of the stack, such as long-axis views, are listed in ``left_out``, a line
    a series (``pipeline.imaging.stack_choice.choose_stack`` says which those are).

    Parameters
    ----------
    rr_source
        Where the RR interval comes from when the files do not tell it.
    others
        What was no image of a slice; it is listed with the rest in ``left_out``.
    fill
        Let the mean of both neighbours stand in for a slice that is missing.

    Raises
    ------
    InputError
        When patient, matrix, pixel spacing or direction differ, a slice or phase lacks or is given
        twice, there are fewer than 3 slices or 2 phases, or the timing is not that of one
        heartbeat.
    """
    for name, keyword in (("patient", "PatientIDs"), ("born", "PatientBirthDates")):
        if patients := _unlike(frames, name):
            raise InputError(
                f"{where}: {patients} have different {keyword}; a study is of one patient: take "
                "the other's images out"
            )
    chosen, left_out = choose_stack(frames, where)
    evenly = EVENLY if rr_source is None else NOT_SPREAD
    _require_timing(chosen, evenly)
    slices, time_name = _in_time(by_slice(chosen), where, evenly)
    lines = left_out_lines([*left_out, *others], where)
    try:
        _require_complete(slices, where)
        places = regular_places(slices, where, fill)
    except InputError as error:
        # A slice that is missed may be there, and be none of the stack for a reason.
        raise InputError("; not taken: ".join([str(error), *lines])) from error
    triggers = np.array([[frame.times_ms[time_name] for frame in one] for one in slices])
    rr_ms = np.array([np.mean([_rr_ms(frame) for frame in one]) for one in slices])
    said = where if rr_source is None else f"{where}, with cine.rr_ms {rr_ms[0]:g}"
    phases = common_phases(triggers, rr_ms, said, places.numbers.tolist())
    mr_from_index = placement(slices[0][0], places.step_mm)
    mr_from_index[:3, 3] = places.origin_mm
    intensity, missing = fill_gaps(_intensity(slices), places.numbers)
    cine = Cine(intensity, mr_from_index, phases, float(rr_ms.mean()) / 1000, missing)
    source = rr_source or f"DICOM {time_name} and RR interval"
    doubts = (
        *places.remarks,
        *_doubts_of_place(chosen),
        *_doubts_of_rate(chosen),
        *_doubts_of_series(chosen),
        *stacks_beside(frames, chosen, where),
    )
    patient = next((frame.patient for frame in chosen if frame.patient), "")
    timed = tuple(places.numbers.tolist()) if missing else ()
    return Stack(cine, triggers, rr_ms, source, lines, timed, doubts, patient)


def _unlike(frames: Sequence[Frame], name: str) -> str:
    """Two images that tell an attribute differently, in words; empty where all that tell agree."""
    told = [frame for frame in frames if getattr(frame, name)]
    others = [one for one in told if getattr(one, name) != getattr(told[0], name)]
    return f"{told[0].where} and {others[0].where}" if others else ""


def _doubts_of_place(frames: Sequence[Frame]) -> tuple[str, ...]:
    doubts = []
    if places := _unlike(frames, "frame_of_reference"):
        doubts.append(
            f"{places} have different FrameOfReferenceUIDs: if the patient was moved between them, "
            "slices do not fit one another"
        )
    if studies := _unlike(frames, "study"):
        doubts.append(
            f"{studies} have different StudyInstanceUIDs: if they are of two examinations, slices "
            "do not fit one another"
        )
    return tuple(doubts)


def _doubts_of_rate(frames: Sequence[Frame]) -> tuple[str, ...]:
    """A sentence where images tell two RR intervals, one by the heart rate."""
    both = [(frame.rr_ms, frame.other_rr_ms) for frame in frames if frame.other_rr_ms]
    if not both:
        return ()
    own_ms, other_ms = np.median(np.array(both, dtype=float), axis=0)
    if 1 / OTHER_RATE <= own_ms / other_ms <= OTHER_RATE:
        return ()
    return (
        f"the images' RR interval is {own_ms:.0f} ms, but by their HeartRate {other_ms:.0f} ms; "
        "the first is taken: if it is not the length of a beat, give cine.rr_ms in study.yaml",
    )


def _doubts_of_series(frames: Sequence[Frame]) -> tuple[str, ...]:
    """A sentence where slices of one stack lie between those of another, as of rest and stress."""
    stacks = [(one, slice_positions(one)) for one in by_series(frames).values() if is_stack(one)]
    for (one, its_mm), (other, others_mm) in combinations(stacks, 2):
        if max(its_mm[0], others_mm[0]) < min(its_mm[-1], others_mm[-1]):
            return (
                f"slices of {other[0].series} lie between those of {one[0].series}, and each is a "
                "cine stack by itself: if they show two states of the heart, such as rest and "
                "stress, name one's number in cine.leave_out_series in study.yaml",
            )
    return ()


def _require_timing(frames: Sequence[Frame], evenly: str) -> None:
    untimed = [frame for frame in frames if not frame.times_ms]
    if untimed and len(untimed) < len(frames):
        raise InputError(
            f"{untimed[0].where}: has no trigger time, as {len(untimed)} of the stack's "
            f"{len(frames)} images; the others have: export these again with TriggerTime "
            f"(0018,1060), or do without {untimed[0].series}: name its number in "
            "cine.leave_out_series in study.yaml, with cine.fill_gaps: true inside the stack"
        )
    if untimed:
        raise InputError(
            f"{untimed[0].where}: has no trigger time; export the cine with TriggerTime "
            f"(0018,1060){evenly}"
        )
    for frame in frames:
        _rr_ms(frame)


def _rr_ms(frame: Frame) -> float:
    if frame.rr_ms is None:
        raise InputError(
            f"{frame.where}: has no RR interval (NominalInterval (0018,1062) or HeartRate "
            "(0018,1088)); give cine.rr_ms in study.yaml, or, if it is none of the cine, "
            "leave its series out: cine.leave_out_series takes its number"
        )
    return frame.rr_ms


def _in_time(
    slices: Sequence[Sequence[Frame]], where: str, evenly: str
) -> tuple[list[list[Frame]], str]:
    """Each slice sorted by the first attribute that tells all of its frames apart; ``evenly`` says
    what to do where none does."""
    names = _shared_time_names(slices, where)
    for name in names:
        ordered = _sorted_by(slices, name)
        if not any(_tie(one, name) for one in ordered):
            break
    else:
        name = names[0]
        ordered = _sorted_by(slices, name)
    _require_given_once(ordered, name, where)
    for one in ordered:
        if tie := _tie(one, name):
            raise InputError(
                f"{where}: {tie[0].where} and {tie[1].where} show the same slice at the same "
                f"trigger time {tie[0].times_ms[name]:g} ms; {_remedy(one, name, tie, evenly)}"
            )
    return ordered, name


def _sorted_by(slices: Sequence[Sequence[Frame]], name: str) -> list[list[Frame]]:
    return [sorted(one, key=lambda frame: frame.times_ms[name]) for one in slices]


def _shared_time_names(slices: Sequence[Sequence[Frame]], where: str) -> list[str]:
    """The attributes that time every frame, the most trusted first."""
    first = slices[0][0]
    names = list(first.times_ms)
    for frame in (frame for one in slices for frame in one):
        names = [name for name in names if name in frame.times_ms]
        if not names:
            raise InputError(
                f"{where}: {first.where} is timed by {', '.join(first.times_ms)}, "
                f"{frame.where} by {', '.join(frame.times_ms)}; export all images in one way"
            )
    return names


def _remedy(one: Sequence[Frame], name: str, tie: tuple[Frame, Frame], evenly: str) -> str:
    """What to do about frames of a slice of which two have the same time."""
    if len({frame.times_ms[name] for frame in one}) > 1:
        if tie[0].series_uid == tie[1].series_uid:
            return (
                f"both are of {tie[0].series}, as of two echoes, two image types or a slice that "
                "was taken twice: take the files of one out"
            )
        return "keep one series a slice"
    return (
        f"its times do not tell its phases apart: export them with TriggerTime (0018,1060){evenly}"
    )


def _tie(ordered: Sequence[Frame], name: str) -> tuple[Frame, Frame] | None:
    for earlier, later in pairwise(ordered):
        if later.times_ms[name] == earlier.times_ms[name]:
            return earlier, later
    return None


def _require_given_once(slices: Sequence[Sequence[Frame]], name: str, where: str) -> None:
    """Refuse slices that two series, or two acquisitions of one, show over the same part of the
    heartbeat; all of them at once, for each is mended by the same hand."""
    found: dict[tuple[object, object], list[int]] = {}
    firsts: list[tuple[Sequence[Frame], Sequence[Frame]]] = []
    for number, one in enumerate(slices):
        for first, second in _given_twice(one, name):
            pair = _source(first[0]), _source(second[0])
            if pair not in found:
                firsts.append((first, second))
            found.setdefault(pair, []).append(number)
    if not found:
        return
    told = [
        f"{_slices_are(numbers)} given twice: by {_origin(first)}, and by {_origin(second)}"
        for numbers, (first, second) in zip(found.values(), firsts, strict=True)
    ]
    more = len(told) - MOST_TOLD
    rest = [f"and so on, {more} more"] if more > 0 else []
    # Of two series all numbers may be left out in one line; of one series only files can be.
    remedies = dict.fromkeys(_keep_one(first[0], second[0]) for first, second in firsts)
    raise InputError(
        f"{where}: {'; '.join([*told[:MOST_TOLD], *rest])}; they show the same trigger time or "
        f"overlap; {'; '.join(remedies)}"
    )


def _given_twice(one: Sequence[Frame], name: str) -> list[tuple[Sequence[Frame], Sequence[Frame]]]:
    """Pairs of series or acquisitions that show one slice over the same part of the heartbeat."""
    together: dict[object, list[Frame]] = {}
    for frame in one:
        together.setdefault(_source(frame), []).append(frame)
    spans = sorted(
        (found for found in together.values() if len(found) >= MIN_PHASES),
        key=lambda found: (found[0].times_ms[name], found[0].series),
    )
    return [
        (first, second)
        for first, second in pairwise(spans)
        if second[0].times_ms[name] < first[-1].times_ms[name]
    ]


def _source(frame: Frame) -> object:
    """What tells apart the series, and acquisitions of one, that show a slice."""
    return frame.series_uid, frame.acquisition


def _slices_are(numbers: Sequence[int]) -> str:
    """Rising numbers of slices, runs as their ends, as the subject of a sentence."""
    if len(numbers) == 1:
        return f"slice {numbers[0]} is"
    breaks = np.flatnonzero(np.diff(numbers) > 1) + 1
    runs = np.split(np.array(numbers), breaks)
    told = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    more = [f"{len(told) - MOST_TOLD} more"] if len(told) > MOST_TOLD else []
    return f"slices {', '.join([*told[:MOST_TOLD], *more])} are"


def _origin(frames: Sequence[Frame]) -> str:
    first = frames[0]
    part = "" if first.acquisition is None else f", acquisition {first.acquisition}"
    return f"{first.series}{part}, {describe([frame.where for frame in frames])}"


def _keep_one(first: Frame, second: Frame) -> str:
    """What to do about a slice that two sets of images show."""
    if first.series == second.series:
        return "keep one acquisition a slice: take the other's files out"
    return f"keep one series a slice: {LEAVE_OUT}, {SEVERAL}"


def _intensity(slices: Sequence[Sequence[Frame]]) -> Float32:
    """All pixels as ``(phase, z, y, x)``, without a second copy on the way."""
    shape = (len(slices[0]), len(slices), *slices[0][0].pixels.shape)
    intensity = np.empty(shape, np.float32)
    for z, one in enumerate(slices):
        for k, frame in enumerate(one):
            intensity[k, z] = frame.pixels
    return intensity


def placement(first: Frame, step_mm: Float) -> Float:
    """4x4 from the first slice's image, and from one slice to the next: ``(x, y, z)`` to mm."""
    mr_from_index = np.eye(4)
    mr_from_index[:3, 0] = first.axes[0] * first.spacing_mm[0]
    mr_from_index[:3, 1] = first.axes[1] * first.spacing_mm[1]
    mr_from_index[:3, 2] = step_mm
    mr_from_index[:3, 3] = first.position_mm
    return mr_from_index


def _require_complete(slices: Sequence[Sequence[Frame]], where: str) -> None:
    counts = [len(one) for one in slices]
    if len(slices) < MIN_SLICES or max(counts) < MIN_PHASES:
        raise InputError(
            f"{where}: {len(slices)} slices of {max(counts)} phases; "
            f"at least {MIN_SLICES} slices of {MIN_PHASES} phases are needed"
        )
    usual = max(counts, key=lambda count: (counts.count(count), count))
    short = [number for number, count in enumerate(counts) if count != usual]
    if short:
        told = [f"slice {one} ({slices[one][0].where}) has {counts[one]}" for one in short]
        more = [f"and so on, {len(told) - MOST_TOLD} more"] if len(told) > MOST_TOLD else []
        raise InputError(
            f"{where}: missing phase: of {usual} phases, {', '.join([*told[:MOST_TOLD], *more])}; "
            "complete or remove such slices, or leave out what is mixed in: cine.leave_out_series "
            "in study.yaml takes its number, with cine.fill_gaps: true inside the stack"
        )
