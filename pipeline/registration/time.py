"""Bring images to one clock, the heart's own: R peaks of a recording, and phases between them.

R peaks come from the detector that a force server runs on its stream (``rpeaks``). Phases are those
of one nominal beat, the MR's: systole keeps its length when the rate changes and diastole gives way
(``clock``), so that an image from a beat of another length meets the same place of the motion.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from pipeline.errors import InputError
from pipeline.geometry import Float, Mask
from pipeline.registration.clock import to_cycle
from pipeline.registration.rpeaks import HIGHEST_RATE_HZ, LOWEST_RATE_HZ, find_beats, is_fit_rate

OTHER_RATE = 1.8
"""Times by which one heart may beat faster or slower in another examination. A record told at twice
its sampling rate, or half, is beyond."""
LONGEST_BEAT = 1.75
"""Times the usual RR interval about it: a longer one may hold beats that were not found. The pause
after an extrasystole is shorter, for it and the short interval before it make two."""
# Over so many pairs of intervals the usual one is taken: rates change within a record.
_NEIGHBOURS = 9
_SHORTEST_RECORD_S = 3.0
# Three years, which no recording lasts: such times are counted from 1970.
_SINCE_1970_S = 1e8
# Pictures of a heart come faster than this; many a time divided by 1000 lies within the ECG.
_SLOWEST_FRAME_S = 1.0
# Beats of one heart resemble their usual beat; what is cut out of noise at its own maxima does so
# with 0.3 to 0.5 in the median.
_LEAST_LIKENESS = 0.7


def detect_r_peaks(signal_mv: Float, sampling_rate_hz: float) -> Float:
    """Times of the R peaks of a recording, by all leads that show them, finer than one sample.

    Leads may have either polarity, and may be lost for a while: samples that are not a number.

    Parameters
    ----------
    signal_mv
        ``(n, leads)`` millivolts; the scale does not matter.
    sampling_rate_hz
        100 to 2000 samples a second.

    Returns
    -------
    (beats,) array
        Rising, seconds after the first sample.

    Raises
    ------
    InputError
        When the record is too short or its rate is outside, or the leads do not show beats that
        resemble each other.
    """
    _require_record(signal_mv, sampling_rate_hz)
    beats = find_beats(signal_mv, sampling_rate_hz)
    likeness = float(np.median([beat.likeness for beat in beats])) if beats else 0.0
    if len(beats) < 3 or likeness < _LEAST_LIKENESS:
        raise InputError(
            f"ECG: none of {signal_mv.shape[1]} leads shows R peaks ({len(beats)} waves resemble "
            f"their usual shape with {likeness:.2f}, needs 3 or more and {_LEAST_LIKENESS}); "
            "give a cleaner record"
        )
    times_s = np.array([beat.time_s for beat in beats])
    return times_s[np.diff(times_s, prepend=-np.inf) > 0]


def phases_at(times_s: Float, r_times_s: Float, cycle_rr_s: float | None = None) -> Float:
    """Phase in [0, 1) of each time.

    Without a nominal beat it is the share of its RR interval that has passed. With one, that share
    is brought to its axis with systole and diastole scaled apart. Before the first R peak and
    after the last the interval is unknown: there, up to one median RR interval away, the median
    stands in.

    Parameters
    ----------
    times_s
        Any shape, seconds, on the clock of the ECG.
    r_times_s
        ``(beats,)`` rising R times, seconds.
    cycle_rr_s
        Length of the nominal beat, the mean RR interval of the MR.

    Raises
    ------
    InputError
        When there are fewer than two R peaks or they do not rise, or a time is further from them.

    >>> phases_at(np.array([0.25, 1.0, 1.25, 2.5]), np.array([1.0, 2.0, 3.0]))
    array([0.25, 0.  , 0.25, 0.5 ])
    """
    rr_s = median_rr_s(r_times_s)
    times = np.asarray(times_s, dtype=float)
    starts = np.concatenate([[r_times_s[0] - rr_s], r_times_s])
    ends = np.append(r_times_s, r_times_s[-1] + rr_s)
    outside = ~((times >= starts[0]) & (times < ends[-1]))
    if outside.any():
        raise InputError(
            f"{outside.sum()} of {times.size} times, from {times.min():.3f} to {times.max():.3f} "
            f"s, lie more than one beat outside the R peaks, which go from {r_times_s[0]:.3f} to "
            f"{r_times_s[-1]:.3f} s; does the ECG cover the images, on the same clock?"
            f"{_other_clock(times, float(starts[0]), float(ends[-1]))}"
        )
    beat = np.searchsorted(starts, times, side="right") - 1
    own_s = ends[beat] - starts[beat]
    phase = (times - starts[beat]) / own_s
    # Rounding may lift a time just before an R peak to exactly 1.
    share = np.asarray(np.where(phase < 1, phase, 0.0))
    return share if cycle_rr_s is None else to_cycle(share, own_s, cycle_rr_s)


def in_known_beats(
    times_s: Float, r_times_s: Float, recorded_s: tuple[float, float] | None = None
) -> Mask:
    """Whether each time ``(n,)`` lies in an RR interval that can be one beat: others have no phase.

    Before the first R peak and after the last, where the median stands in, times do. Farther out
    they do not, if they lie within ``recorded_s``, first and last time of the record: the leads
    were lost there. What lies beyond the record is left to :func:`phases_at`, which refuses it.
    """
    rr_s = np.diff(r_times_s)
    # Of neighbours together: in bigeminy one is short and the next long, beat after beat.
    pairs_s = (rr_s[:-1] + rr_s[1:]) / 2 if len(rr_s) > 1 else rr_s
    usual_s = median_filter(pairs_s, _NEIGHBOURS, mode="nearest")
    longest_s = LONGEST_BEAT * np.concatenate([usual_s[:1], usual_s])[: len(rr_s)]
    # At a record's ends the filter sees a pause several times over: one that stands alone is held
    # against the whole record.
    beside_s = np.maximum(np.append(rr_s[1:], 0.0), np.append(0.0, rr_s[:-1]))
    longest_s = np.minimum(longest_s, LONGEST_BEAT * np.maximum(beside_s, np.median(pairs_s)))
    too_long = np.concatenate([[False], rr_s > longest_s, [False]])
    known = ~too_long[np.searchsorted(r_times_s, times_s, side="right")]
    first_s, last_s = recorded_s or (np.inf, -np.inf)
    median_s = median_rr_s(r_times_s)
    before = (times_s >= first_s) & (times_s < r_times_s[0] - median_s)
    after = (times_s >= r_times_s[-1] + median_s) & (times_s <= last_s)
    return np.asarray(known & ~before & ~after)


def _other_clock(times_s: Float, start_s: float, end_s: float) -> str:
    """What times that the ECG does not cover look like, if anything."""
    first, last = float(times_s.min()), float(times_s.max())
    slow = last - first > _SLOWEST_FRAME_S * (times_s.size - 1)
    if slow and start_s <= first / 1000 and last / 1000 < end_s:
        return " divided by 1000 the times lie within: they look like milliseconds; give seconds"
    if (first > _SINCE_1970_S) != (start_s > _SINCE_1970_S):
        whose = "the times" if first > start_s else "the R peaks"
        return (
            f" {whose} look as if counted from 1970, by a computer's clock, the others do not; "
            "give both by one clock, in seconds"
        )
    return ""


def median_rr_s(r_times_s: Float) -> float:
    """Median RR interval between ``(beats,)`` R times, seconds.

    Raises
    ------
    InputError
        When there are fewer than two R peaks, or their times do not rise.
    """
    rr_s = np.diff(r_times_s)
    if len(r_times_s) < 2 or not (rr_s > 0).all():
        raise InputError(
            f"needs two R peaks or more with rising times, got {len(r_times_s)} "
            f"({(~(rr_s > 0)).sum()} of them not after the one before)"
        )
    return float(np.median(rr_s))


def doubts_of_rate(r_times_s: Float, cycle_rr_s: float) -> list[str]:
    """A sentence where the ultrasound's heart beats so much faster or slower than the MR's, whose
    interval is ``cycle_rr_s``, that one of the two is told wrongly; else none."""
    rr_s = median_rr_s(r_times_s)
    if 1 / OTHER_RATE <= rr_s / cycle_rr_s <= OTHER_RATE:
        return []
    return [
        f"the heart beats {60 / rr_s:.0f} times a minute in the ultrasound's ECG and "
        f"{60 / cycle_rr_s:.0f} times in the MR: is the record's sampling rate right, and are both "
        "of one patient?"
    ]


def _require_record(signal_mv: Float, sampling_rate_hz: float) -> None:
    if signal_mv.ndim != 2:
        raise InputError(f"ECG: needs an array (samples, leads), got {signal_mv.shape}")
    if not is_fit_rate(sampling_rate_hz):
        few = "few" if sampling_rate_hz < LOWEST_RATE_HZ else "many"
        raise InputError(
            f"ECG: {sampling_rate_hz:g} samples a second are too {few} to time an R peak; needs "
            f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g}"
        )
    if not len(signal_mv) >= _SHORTEST_RECORD_S * sampling_rate_hz:
        raise InputError(
            f"ECG: {len(signal_mv) / sampling_rate_hz:.2f} s are too short to learn what a beat "
            f"looks like; needs {_SHORTEST_RECORD_S:g} s or more"
        )
