"""Cine MR as the pipeline sees it: one stack of parallel slices through one heartbeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32

PLAUSIBLE_RR_S = (0.2, 3.0)
"""300 to 20 beats a minute: an RR interval outside is a unit mistaken, not a heart."""

MIN_SLICES = 3
MIN_PHASES = 2


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

    @property
    def spacing_mm(self) -> Float:
        """Distance between voxel centres along the array's ``x, y, z``."""
        return np.asarray(np.linalg.norm(self.mr_from_index[:3, :3], axis=0))


@dataclass(frozen=True, slots=True)
class Frame:
    """One image of one slice at one moment, as a file gave it."""

    where: str
    """The file (and frame number) that it came from, for messages."""

    pixels: Float32
    """``(row, column)``."""

    position_mm: Float
    """LPS position of the first pixel's centre."""

    axes: Float
    """``(2, 3)`` unit vectors: the direction in which columns count up, then rows."""

    spacing_mm: tuple[float, float]
    """Distance between pixel centres from column to column, then from row to row."""

    trigger_time_ms: float
    rr_ms: float

    @property
    def normal(self) -> Float:
        """Unit normal of the slice, right-handed."""
        return np.asarray(np.cross(self.axes[0], self.axes[1]))


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
    """Images that are not part of the stack, such as long-axis views, each with its reason."""


def stack_frames(frames: Sequence[Frame], timing_source: str, where: str) -> Stack:
    """Sort frames along the slice normal, then by trigger time, into one regular stack.

    The stack is the largest set of parallel slices; slices of another orientation are listed in
    ``left_out``.

    Raises
    ------
    InputError
        When matrix or pixel spacing differ, a slice or a phase is missing or given twice, there
        are fewer than 3 slices or 2 phases, or the timing is not that of one heartbeat.
    """
    parallel, left_out = _largest_parallel_set(frames)
    _require_same_pixels(parallel, where)
    slices = _slices_in_order(parallel, where)
    step_mm = _require_regular_steps(slices, where)
    triggers = np.array([[frame.trigger_time_ms for frame in one] for one in slices])
    rr_ms = np.array([np.mean([frame.rr_ms for frame in one]) for one in slices])
    phases = common_phases(triggers, rr_ms, where)
    first = slices[0][0]
    mr_from_index = np.eye(4)
    mr_from_index[:3, 0] = first.axes[0] * first.spacing_mm[0]
    mr_from_index[:3, 1] = first.axes[1] * first.spacing_mm[1]
    mr_from_index[:3, 2] = step_mm
    mr_from_index[:3, 3] = first.position_mm
    intensity = np.stack([[frame.pixels for frame in one] for one in slices], axis=1)
    cine = Cine(intensity.astype(np.float32), mr_from_index, phases, float(rr_ms.mean()) / 1000)
    return Stack(cine, triggers, rr_ms, timing_source, left_out)


def common_phases(trigger_times_ms: Float, rr_ms: Float, where: str) -> Float:
    """One phase axis for all slices: trigger time over the slice's own RR interval.

    Parameters
    ----------
    trigger_times_ms
        ``(slice, phase)``.
    rr_ms
        ``(slice,)``.

    Raises
    ------
    InputError
        When an RR interval is implausible, a trigger time lies outside its heartbeat, or a
        slice is over half a phase step away from the others.
    """
    low_ms, high_ms = (1000 * limit for limit in PLAUSIBLE_RR_S)
    if not ((rr_ms > low_ms) & (rr_ms < high_ms)).all():
        worst = rr_ms[np.argmax(np.abs(np.log(np.maximum(rr_ms, 1e-6) / 900)))]
        raise InputError(
            f"{where}: RR interval {worst:g} ms, a heartbeat lasts {low_ms:g} to {high_ms:g} ms; "
            "correct the timing, or give cine.rr_ms in study.yaml"
        )
    phases = trigger_times_ms / rr_ms[:, None]
    if phases.min() < 0 or phases.max() >= 1:
        raise InputError(
            f"{where}: trigger times from {trigger_times_ms.min():g} to "
            f"{trigger_times_ms.max():g} ms do not fit in an RR interval of "
            f"{rr_ms[np.argmax(phases.max(axis=1))]:g} ms; correct them, or give cine.rr_ms "
            "in study.yaml"
        )
    common = phases.mean(axis=0)
    if (np.diff(common) <= 0).any():
        raise InputError(f"{where}: trigger times must rise from phase to phase, got {common}")
    away = np.abs(phases - common).max(axis=1)
    if away.max() > 0.5 / phases.shape[1]:
        raise InputError(
            f"{where}: slice {int(away.argmax())} lies {away.max():.3f} of a cycle off the other "
            f"slices' phases, at most half a step ({0.5 / phases.shape[1]:.3f}) can be used; "
            "all slices need the same phases"
        )
    return np.asarray(common)


def _largest_parallel_set(frames: Sequence[Frame]) -> tuple[list[Frame], tuple[str, ...]]:
    groups: list[list[Frame]] = []
    for frame in frames:
        for group in groups:
            if abs(float(group[0].normal @ frame.normal)) > np.cos(np.radians(1)):
                group.append(frame)
                break
        else:
            groups.append([frame])
    groups.sort(key=len, reverse=True)
    left_out = tuple(
        f"{frame.where}: not parallel to the stack" for group in groups[1:] for frame in group
    )
    return groups[0], left_out


def _require_same_pixels(frames: Sequence[Frame], where: str) -> None:
    first = frames[0]
    for frame in frames:
        if frame.pixels.shape != first.pixels.shape:
            raise InputError(
                f"{where}: slices have different matrices: {first.where} has "
                f"{first.pixels.shape}, {frame.where} has {frame.pixels.shape} (rows, columns); "
                "give one stack of one matrix"
            )
        if not np.allclose(frame.spacing_mm, first.spacing_mm, rtol=1e-3):
            raise InputError(
                f"{where}: slices have different pixel spacing: {first.where} has "
                f"{first.spacing_mm} mm, {frame.where} has {frame.spacing_mm} mm; "
                "give one stack of one spacing"
            )


def _slices_in_order(frames: Sequence[Frame], where: str) -> list[list[Frame]]:
    normal = frames[0].normal
    along_mm = np.array([frame.position_mm @ normal for frame in frames])
    order = np.argsort(along_mm, kind="stable")
    slices: list[list[Frame]] = []
    last_mm = -np.inf
    for number in order:
        # Positions are written with few decimals; slices are never closer than half a millimetre.
        if along_mm[number] - last_mm > 0.5:
            slices.append([])
        slices[-1].append(frames[number])
        last_mm = along_mm[number]
    for one in slices:
        one.sort(key=lambda frame: frame.trigger_time_ms)
        for earlier, later in pairwise(one):
            if later.trigger_time_ms == earlier.trigger_time_ms:
                raise InputError(
                    f"{where}: {earlier.where} and {later.where} show the same slice at the same "
                    f"trigger time {later.trigger_time_ms:g} ms; keep one series a slice"
                )
    _require_complete(slices, where)
    return slices


def _require_complete(slices: Sequence[Sequence[Frame]], where: str) -> None:
    counts = [len(one) for one in slices]
    if len(slices) < MIN_SLICES or max(counts) < MIN_PHASES:
        raise InputError(
            f"{where}: {len(slices)} slices of {max(counts)} phases; "
            f"at least {MIN_SLICES} slices of {MIN_PHASES} phases are needed"
        )
    usual = int(np.median(counts))
    short = [number for number, count in enumerate(counts) if count != usual]
    if short:
        raise InputError(
            f"{where}: missing phase: slice {short[0]} ({slices[short[0]][0].where}) has "
            f"{counts[short[0]]} phases, the others have {usual}; complete or remove the slice"
        )


def _require_regular_steps(slices: Sequence[Sequence[Frame]], where: str) -> Float:
    """Check that the slices are evenly spaced; return the step from one to the next in mm."""
    positions = np.array([one[0].position_mm for one in slices])
    steps_mm = np.diff(positions, axis=0)
    lengths_mm = steps_mm @ slices[0][0].normal
    usual_mm = float(lengths_mm.min())
    ratio = lengths_mm / usual_mm
    wide = np.flatnonzero((ratio > 1.5) & (np.abs(ratio - np.rint(ratio)) < 0.1))
    if len(wide):
        raise InputError(
            f"{where}: missing slice between {slices[wide[0]][0].where} and "
            f"{slices[wide[0] + 1][0].where}: {lengths_mm[wide[0]]:.2f} mm apart, the others are "
            f"{usual_mm:.2f} mm apart; add the missing slice"
        )
    off_mm = np.abs(steps_mm - np.median(steps_mm, axis=0)).max()
    if off_mm > max(0.1, 0.02 * usual_mm):
        raise InputError(
            f"{where}: slices have different spacing: steps along the normal are "
            f"{lengths_mm.round(2).tolist()} mm, or the slices are shifted sideways by "
            f"{off_mm:.2f} mm; an evenly spaced stack is needed"
        )
    return np.asarray(steps_mm.mean(axis=0))
