"""By how much the clock of the ultrasound lags that of the ECG, from how well frames fit.

Every frame is compared with the moving model at the phase that its time, shifted by a trial offset,
has by the R peaks. The heart moves through each place twice a beat at different speeds, so one
offset within a beat fits best: the agreement over offsets, averaged over frames, has its summit
there. A sweep's own motion through the body is no matter, for frames are compared with the model
where they lie, not with one another. How sure the summit is comes from resampling whole beats
(B. Efron, "Bootstrap methods: another look at the jackknife", Ann Stat 7 (1979) 1-26), for frames
of one beat err together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Integer

LEAST_BEATS = 6
"""Fewer beats say too little about how much they differ."""
LARGEST_SD_S = 0.030
"""An offset less sure than this is none: phases by it would be worse than by no correction."""
_RESAMPLES = 200
# The summit is that of a parabola through what lies this near.
_NEAR_S = 0.060


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """What to add to the times of frames to bring them to the clock of the ECG."""

    offset_s: float | None
    """None where the frames do not tell: too few beats, no summit, or an unsure one."""

    sd_s: float
    """Its standard deviation; infinite where there is no summit within the offsets tried."""


def estimate_offset(
    offsets_s: Float, scores: Float, times_s: Float, r_times_s: Float, seed: int = 0
) -> ClockOffset:
    """The offset at which frames fit the moving model best, and how sure it is.

    Parameters
    ----------
    offsets_s
        ``(k,)`` evenly spaced, rising trial offsets, seconds, seven or more; they should span no
        more than one beat.
    scores
        ``(k, n)`` agreement of each frame with the model at each; more is better. Frames with a
        score that is not a number do not count.
    times_s
        ``(n,)`` times of the frames, seconds.
    r_times_s
        ``(beats,)`` rising R times, which tell what frames belong to one beat.
    seed
        Of the resampling.

    Raises
    ------
    InputError
        When shapes do not fit, or offsets are few or uneven.
    """
    _require(offsets_s, scores, times_s)
    known = np.isfinite(scores).all(axis=0)
    beat_of = np.searchsorted(r_times_s, times_s[known])
    sums, counts = _per_beat(scores[:, known], beat_of)
    if len(counts) < LEAST_BEATS:
        return ClockOffset(None, np.inf)
    best_s = _summit(offsets_s, sums.sum(axis=0) / counts.sum())
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(counts), size=(_RESAMPLES, len(counts)))
    resampled = [_summit(offsets_s, sums[one].sum(axis=0) / counts[one].sum()) for one in drawn]
    if best_s is None or None in resampled:
        return ClockOffset(None, np.inf)
    # Resampling finds the scatter of a mean of n beats too small by (n - 1) / n in its square.
    widen = np.sqrt(len(counts) / (len(counts) - 1))
    sd_s = float(np.std(np.array(resampled, dtype=float)) * widen)
    return ClockOffset(best_s if sd_s <= LARGEST_SD_S else None, sd_s)


def _require(offsets_s: Float, scores: Float, times_s: Float) -> None:
    if scores.shape != (len(offsets_s), len(times_s)):
        raise InputError(
            f"clock offset: scores of shape {scores.shape}; needs ({len(offsets_s)} offsets, "
            f"{len(times_s)} frames)"
        )
    steps = np.diff(offsets_s)
    if len(offsets_s) < 7 or not (steps > 0).all() or np.ptp(steps) > 1e-6 * steps.max():
        raise InputError("clock offset: needs seven or more evenly spaced, rising offsets")


def _per_beat(scores: Float, beat_of: Integer) -> tuple[Float, Float]:
    """``(beats, k)`` sums of the scores of each beat's frames, and ``(beats,)`` their number."""
    beats, index = np.unique(beat_of, return_inverse=True)
    sums = np.zeros((len(beats), len(scores)))
    np.add.at(sums, index, scores.T)
    return sums, np.bincount(index, minlength=len(beats)).astype(float)


def _summit(offsets_s: Float, score: Float) -> float | None:
    """Where a parabola about the highest score peaks; None at an end of the offsets tried."""
    top = int(np.argmax(score))
    near = np.abs(offsets_s - offsets_s[top]) <= max(_NEAR_S, 2.0 * (offsets_s[1] - offsets_s[0]))
    if top in (0, len(offsets_s) - 1):
        return None
    x = offsets_s[near] - offsets_s[top]
    bend, slope, _ = np.polyfit(x, score[near], 2)
    if bend >= 0:
        return None
    shift_s = float(np.clip(-slope / (2 * bend), x[0], x[-1]))
    return float(offsets_s[top]) + shift_s
