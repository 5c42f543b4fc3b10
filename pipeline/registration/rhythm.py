"""Detector and clock together, over a recording as over a stream: which beats, of what kind."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.publish import write_whole
from pipeline.registration.clock import Kind, PhaseClock
from pipeline.registration.rpeaks import Beat, RPeakDetector, with_end_held

NOMINAL_RR_S = 0.8
# How often the clock is asked: often enough to see a lead come off for less than a beat.
_STEP_S = 0.02
_NOT_NORMAL: tuple[Kind, Kind] = ("ectopic", "irregular")
# Share of beats that are not normal, beyond which a rhythm is told of.
_MANY = 0.2
# Beats in which a rhythm is learnt, and the share of the others, if so many, at which the phase is
# to be valid: where intervals never agree, no beat is told as early.
_LEARNT, _JUDGED, _VALID = 6, 10, 0.5
_COLUMNS = ("time_s", "kind", "valid", "lead", "rr_s", "likeness", "known_s", "strange")


@dataclass(frozen=True, slots=True)
class RhythmBeat:
    """One beat of a recording and what the clock made of it when it became known."""

    time_s: float
    """R time, seconds after the first sample."""

    kind: Kind
    """``ectopic``: it came early or its shape is unlike the others'; ``irregular``: while
    intervals have no order, as in fibrillation."""

    valid: bool
    """Whether the phase could be relied on then."""

    lead: int
    """Number of the lead that showed it best."""

    rr_s: float
    """Interval since the beat before; not a number for the first, and where all leads were lost
    between the two."""

    likeness: float
    """Correlation of its shape with the usual one."""

    known_s: float
    """When it became known."""

    strange: bool
    """Whether its shape is unlike the others', as a clock must be told."""


def read_rhythm(signal_mv: Float, sampling_rate_hz: float) -> list[RhythmBeat]:
    """Run detector and clock over a recording, as a force server would.

    Parameters
    ----------
    signal_mv
        ``(n, leads)`` millivolts; the scale does not matter. Samples may be missing (not a number).
    sampling_rate_hz
        100 to 2000.

    Raises
    ------
    InputError
        When the rate is outside of that, or the signal is none.
    """
    if signal_mv.ndim != 2 or not len(signal_mv):
        raise InputError(f"ECG: needs an array (samples, leads), got {signal_mv.shape}")
    detector = RPeakDetector(sampling_rate_hz, signal_mv.shape[1])
    clock = PhaseClock(NOMINAL_RR_S)
    padded = with_end_held(signal_mv, sampling_rate_hz)
    step = max(1, round(_STEP_S * sampling_rate_hz))
    found: list[RhythmBeat] = []
    listed, lost_s = False, [-math.inf]
    end_s = (len(signal_mv) - 1) / sampling_rate_hz
    for start in range(0, len(padded), step):
        beats = detector.push(padded[start : start + step])
        kinds = [tell(clock, beat) for beat in beats]
        now_s = (min(start + step, len(padded)) - 1) / sampling_rate_hz
        valid = clock.at(now_s, detector.usable).valid
        if not detector.usable:
            lost_s.append(now_s)
        for beat, kind in zip(beats, kinds, strict=True):
            if beat.instead and listed:
                found.pop()
            last_s = found[-1].time_s if found else math.nan
            listed = kind is not None and 0 <= beat.time_s <= end_s
            if kind is not None and listed:
                whole = not any(last_s < one < beat.time_s for one in lost_s)
                found.append(_row(beat, kind, valid, beat.time_s - last_s if whole else math.nan))
                lost_s = lost_s[-1:]
    return found


def tell(clock: PhaseClock, beat: Beat) -> Kind | None:
    """Tell a clock of a beat that the detector found; what kind of beat it is, None if none."""
    if beat.instead:
        clock.take_back()
    return clock.beat(beat.time_s, beat.strange)


def _row(beat: Beat, kind: Kind, valid: bool, rr_s: float) -> RhythmBeat:
    told = beat.lead, rr_s, beat.likeness, beat.known_s, beat.strange
    return RhythmBeat(beat.time_s, kind, valid, *told)


def unordered(beats: Sequence[RhythmBeat]) -> str:
    """How many beats of a recording are ectopic or without order, if many, or that hardly any came
    as was to be expected; else empty."""
    ectopic, irregular = (sum(one.kind == kind for one in beats) for kind in _NOT_NORMAL)
    valid = [one.valid for one in beats[_LEARNT:]]
    expected = len(valid) < _JUDGED or sum(valid) >= _VALID * len(valid)
    if expected and ectopic + irregular <= _MANY * len(beats):
        return ""
    intervals_s = [one.rr_s for one in beats if math.isfinite(one.rr_s)]
    apart = f", {min(intervals_s):.2f} to {max(intervals_s):.2f} s apart" if intervals_s else ""
    return (
        f"of {len(beats)} beats {ectopic} are ectopic and {irregular} irregular, at "
        f"{sum(one.valid for one in beats)} the phase is valid{apart}"
    )


def doubt(beats: Sequence[RhythmBeat]) -> str:
    """What speaks against the beats of a whole recording, for its user; empty for sound ones."""
    if not beats:
        return "no beat was found; does the record show a heart, with its leads connected?"
    reasons = []
    if 2 * (other := sum(beat.kind != "normal" for beat in beats)) > len(beats):
        reasons.append(f"{other} of {len(beats)} beats are not normal")
    if 2 * (valid := sum(beat.valid for beat in beats)) < len(beats):
        reasons.append(f"the phase could be relied on at {valid} of {len(beats)} beats alone")
    if not reasons:
        return ""
    return (
        f"{', and '.join(reasons)}: this is noise, a heart without order, or a few seconds only; "
        "look at the record before its beats are used"
    )


def write_rhythm(
    path: Path, beats: Sequence[RhythmBeat], leads: Sequence[str], start_s: float
) -> None:
    """Write one row a beat as CSV; the file is there whole or not at all.

    Parameters
    ----------
    path
        File to write; one that is there is replaced.
    leads
        Their names.
    start_s
        Time of the first sample on the recording's own clock.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    table.writerows(_cells(one, leads, start_s) for one in beats)
    try:
        write_whole(path, text.getvalue())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); name a file in a folder that exists"
        ) from error


def _cells(one: RhythmBeat, leads: Sequence[str], start_s: float) -> list[str]:
    rr_s = "" if math.isnan(one.rr_s) else f"{one.rr_s:.5f}"
    return [
        f"{one.time_s + start_s:.5f}",
        one.kind,
        "1" if one.valid else "0",
        leads[one.lead],
        rr_s,
        f"{one.likeness:.3f}",
        f"{one.known_s + start_s:.5f}",
        "1" if one.strange else "0",
    ]
