"""Phases of a cine: trigger times of its slices over their RR intervals, brought to one axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.frames import LEAST_OF_A_BEAT

ALIKE = 0.05
"""Share of a beat, some 45 ms, by which a slice may be seen earlier or later than others, however
many phases there are: RR intervals of breath-holds are told no better by some scanners."""

PLAUSIBLE_RR_S = (0.2, 3.0)
"""300 to 20 beats a minute: an RR interval outside is a unit mistaken, not a heart."""


def common_phases(
    trigger_times_ms: Float, rr_ms: Float, where: str, numbers: Sequence[int] | None = None
) -> Float:
    """One phase axis for all slices: trigger time over the slice's own RR interval.

    Parameters
    ----------
    trigger_times_ms
        ``(slice, phase)``.
    rr_ms
        ``(slice,)``.
    numbers
        ``(slice,)`` the slices' numbers in the stack, for messages; counted from 0 when left out.

    Raises
    ------
    InputError
        When an RR interval is implausible, a trigger time is no number or lies outside its
        heartbeat, phases do not rise, all lie within a small part of the beat, or of n phases those
        of a slice are over half an n-th of a cycle and over `ALIKE` away from the others'.
    """
    numbers = range(len(rr_ms)) if numbers is None else numbers
    _require_heartbeats(rr_ms, where)
    phases = trigger_times_ms / rr_ms[:, None]
    _require_within_beats(phases, trigger_times_ms, rr_ms, where, numbers)
    common = phases.mean(axis=0)
    _require_rising(common, trigger_times_ms, rr_ms, where)
    _require_alike(phases, rr_ms, where, numbers)
    return np.asarray(common)


def around_phases(asked: Float, phases: Float) -> tuple[Integer, Integer, Float32]:
    """Where phases ``(n,)`` lie among others, ``(phase,)`` in [0, 1) and rising, of a cycle.

    Returns
    -------
    before, after, share
        ``(n,)`` each: the two numbers between which they lie, and the part of the way.
    """
    count = len(phases)
    times = np.append(phases, phases[0] + 1)
    place = np.interp((asked - phases[0]) % 1 + phases[0], times, np.arange(count + 1))
    before = np.floor(place).astype(int)
    return before % count, (before + 1) % count, (place - before).astype(np.float32)


def _require_heartbeats(rr_ms: Float, where: str) -> None:
    low_ms, high_ms = (1000 * limit for limit in PLAUSIBLE_RR_S)
    if not ((rr_ms > low_ms) & (rr_ms < high_ms)).all():
        worst = rr_ms[np.argmax(np.abs(np.log(np.maximum(rr_ms, 1e-6) / 900)))]
        seconds = " it looks as if told in seconds;" if low_ms < 1000 * worst < high_ms else ""
        raise InputError(
            f"{where}: RR interval {worst:g} ms, a heartbeat lasts {low_ms:g} to {high_ms:g} ms;"
            f"{seconds} correct the timing, or cine.rr_ms in study.yaml, which goes before it"
        )


def _require_within_beats(
    phases: Float, trigger_times_ms: Float, rr_ms: Float, where: str, numbers: Sequence[int]
) -> None:
    if not np.isfinite(phases).all():
        number, phase = np.argwhere(~np.isfinite(phases))[0]
        raise InputError(
            f"{where}: the trigger time of slice {numbers[number]}, phase {phase}, is "
            f"{trigger_times_ms[number, phase]:g}; give a number of milliseconds"
        )
    outside = ((phases < 0) | (phases >= 1)).any(axis=1)
    if outside.any():
        number = int(outside.argmax())
        first_ms, last_ms = trigger_times_ms[number].min(), trigger_times_ms[number].max()
        remedy = "correct them, or give cine.rr_ms in study.yaml"
        if first_ms < 0:
            remedy = "they count from the R peak: give times of 0 and more"
        elif first_ms >= 0.5 * rr_ms[number] and last_ms - first_ms < rr_ms[number]:
            remedy = (
                "they seem to count from an earlier R peak: give times since the last one; or give "
                "cine.rr_ms in study.yaml, if the beat is as long as that"
            )
        raise InputError(
            f"{where}: trigger times from {first_ms:g} to {last_ms:g} ms do not fit in an RR "
            f"interval of {rr_ms[number]:g} ms (slice {numbers[number]}); {remedy}"
        )


def _require_rising(common: Float, trigger_times_ms: Float, rr_ms: Float, where: str) -> None:
    """Refuse phases in another order than that of time, or at nearly one moment."""
    if (np.diff(common) <= 0).any():
        raise InputError(
            f"{where}: trigger times must rise from phase to phase, they are "
            f"{trigger_times_ms.mean(axis=0).round(1).tolist()} ms (mean of the slices); put the "
            "phases in the order of time"
        )
    if common[-1] - common[0] < LEAST_OF_A_BEAT:
        raise InputError(
            f"{where}: trigger times go from {trigger_times_ms.min():g} to "
            f"{trigger_times_ms.max():g} ms, {common[-1] - common[0]:.2g} of an RR interval of "
            f"{rr_ms.mean():g} ms; a beat's phases lie further apart: are both in milliseconds?"
        )


def _require_alike(phases: Float, rr_ms: Float, where: str, numbers: Sequence[int]) -> None:
    """Refuse slices that are seen at other phases than the rest."""
    away, allowed = _away(phases), max(ALIKE, 0.5 / phases.shape[1])
    if away.max() > allowed:
        remedy = "correct its times, or leave the slice out"
        if np.ptp(rr_ms) > 0:
            remedy = (
                "where times after the R peak are the same in all slices and RR intervals differ, "
                "cine.rr_ms in study.yaml puts all on one"
            )
        raise InputError(
            f"{where}: slice {numbers[int(away.argmax())]} lies {away.max():.3f} of a cycle off "
            f"the other slices' phases; of {phases.shape[1]} phases those that are at most "
            f"{allowed:.3f} off can be used; all slices need the same phases; {remedy}"
        )


def _away(phases: Float) -> Float:
    """How far each slice's phases ``(slice, phase)`` are off the common ones at most."""
    return np.asarray(np.abs(phases - phases.mean(axis=0)).max(axis=1))


def doubts_of_phases(
    trigger_times_ms: Float, rr_ms: Float, numbers: Sequence[int]
) -> tuple[str, ...]:
    """What speaks against slices being seen at the same phases, in words; see `common_phases`."""
    away = _away(trigger_times_ms / rr_ms[:, None])
    half_step = 0.5 / trigger_times_ms.shape[1]
    if away.max() <= half_step:
        return ()
    return (
        f"slice {numbers[int(away.argmax())]} lies {away.max():.3f} of a cycle off the other "
        f"slices' phases, more than half the step from phase to phase ({half_step:.3f}): its "
        "trigger times or its RR interval may be inexact",
    )
