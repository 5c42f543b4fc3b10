"""Bring images to one clock, the heart's own: R peaks of an ECG, and phases between them.

Detection follows J. Pan and W. J. Tompkins, "A real-time QRS detection algorithm", IEEE Trans
Biomed Eng 32 (1985) 230-236: a band-pass leaves the steep QRS complex, its energy is thresholded
between a running level of beats and one of noise. Two changes suit a scanner: the pass band lies
above the flow artefact that swells the T wave there, and the lead is chosen by how far its
beats stand out. Decisions only look back, by the little that a beat needs to pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import argrelmax, butter, sosfiltfilt

from pipeline.errors import InputError
from pipeline.geometry import Float, Integer

# The QRS of a normal beat lasts 0.08 to 0.1 s and carries power up to 40 Hz; the scanner's flow
# artefact is as slow as the T wave, under 10 Hz. Mains (50 or 60 Hz) lie above.
_DETECTION_BAND_HZ = (10.0, 35.0)
# For the instant of the peak: as wide as the disturbances allow, so that its shape survives.
_TIMING_BAND_HZ = (4.0, 40.0)
_ENERGY_WINDOW_S = 0.08
# No ventricle beats twice in 0.25 s (240 a minute).
_REFRACTORY_S = 0.25
# Until this long after a beat a lower energy peak may be its own T wave.
_T_WAVE_S = 0.40
_SHORTEST_RECORD_S = 3.0
_LOWEST_RATE_HZ = 100.0
# Leads differ by less on the R peak (the front passes in 20 ms), by more from R to S.
_SAME_WAVE_S = 0.015
# Beats of one heart resemble their median beat; noise aligned at its own maxima reaches 0.65.
_LEAST_LIKENESS = 0.8


@dataclass(frozen=True, slots=True)
class RrSummary:
    """How fast and how evenly the heart beat."""

    beats: int
    """Number of R peaks."""

    median_s: float
    """Half of the RR intervals are shorter."""

    shortest_s: float
    """The shortest RR interval."""

    longest_s: float
    """The longest RR interval."""


@dataclass(frozen=True, slots=True)
class _LeadBeats:
    """What one lead says."""

    r_times_s: Float
    contrast: float
    """Energy of a beat over the most that lies between beats."""
    likeness: float
    """Median correlation of the beats with their median."""


def detect_r_peaks(signal_mv: Float, sampling_rate_hz: float) -> Float:
    """Times of the R peaks, by the lead that shows them best, finer than one sample.

    Leads may have either polarity. A lead with a sample that is not finite is left out.

    Parameters
    ----------
    signal_mv
        ``(n, leads)`` millivolts; the scale does not matter.
    sampling_rate_hz
        Samples a second, 100 or more.

    Returns
    -------
    (beats,) array
        Rising, seconds after the first sample.

    Raises
    ------
    InputError
        When the record is too short or too coarse, has no lead without gaps, or no lead shows
        beats that resemble each other.
    """
    _require_record(signal_mv, sampling_rate_hz)
    whole = [lead for lead in signal_mv.T if np.isfinite(lead).all() and np.ptp(lead) > 0]
    found = [_beats_of_lead(lead, sampling_rate_hz) for lead in whole]
    trusted = [beats for beats in found if beats.likeness >= _LEAST_LIKENESS]
    if not trusted:
        best = max((beats.likeness for beats in found), default=0.0)
        raise InputError(
            f"ECG: none of {signal_mv.shape[1]} leads shows R peaks (beats resemble their median "
            f"with {best:.2f}, needs {_LEAST_LIKENESS}; {len(whole)} leads have no gap and are not "
            "flat); give a cleaner record"
        )
    return _best_lead(trusted).r_times_s


def phases_at(times_s: Float, r_times_s: Float) -> Float:
    """Phase in [0, 1) of each time: the share of its RR interval that has passed.

    Before the first R peak and after the last the interval is unknown: there, up to one median RR
    interval away, the median stands in.

    Parameters
    ----------
    times_s
        Any shape, seconds, on the clock of the ECG.
    r_times_s
        ``(beats,)`` rising R times, seconds.

    Raises
    ------
    InputError
        When there are fewer than two R peaks or they do not rise, or a time is further from them.

    >>> phases_at(np.array([0.25, 1.0, 1.25, 2.5]), np.array([1.0, 2.0, 3.0]))
    array([0.25, 0.  , 0.25, 0.5 ])
    """
    rr_s = summarise_rr(r_times_s).median_s
    times = np.asarray(times_s, dtype=float)
    starts = np.concatenate([[r_times_s[0] - rr_s], r_times_s])
    ends = np.append(r_times_s, r_times_s[-1] + rr_s)
    outside = ~((times >= starts[0]) & (times < ends[-1]))
    if outside.any():
        raise InputError(
            f"{outside.sum()} of {times.size} times, from {times.min():.3f} to {times.max():.3f} "
            f"s, lie more than one beat outside the R peaks, which go from {r_times_s[0]:.3f} to "
            f"{r_times_s[-1]:.3f} s; does the ECG cover the images, on the same clock?"
        )
    beat = np.searchsorted(starts, times, side="right") - 1
    phase = (times - starts[beat]) / (ends[beat] - starts[beat])
    # Rounding may lift a time just before an R peak to exactly 1.
    return np.asarray(np.where(phase < 1, phase, 0.0))


def summarise_rr(r_times_s: Float) -> RrSummary:
    """Number of beats, and the median, shortest and longest RR interval.

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
    median_s = float(np.median(rr_s))
    return RrSummary(len(r_times_s), median_s, float(rr_s.min()), float(rr_s.max()))


def _require_record(signal_mv: Float, sampling_rate_hz: float) -> None:
    if signal_mv.ndim != 2:
        raise InputError(f"ECG: needs an array (samples, leads), got {signal_mv.shape}")
    if not sampling_rate_hz >= _LOWEST_RATE_HZ:
        raise InputError(
            f"ECG: {sampling_rate_hz} samples a second are too few to time an R peak; "
            f"needs {_LOWEST_RATE_HZ:g} or more"
        )
    if not len(signal_mv) >= _SHORTEST_RECORD_S * sampling_rate_hz:
        raise InputError(
            f"ECG: {len(signal_mv) / sampling_rate_hz:.2f} s are too short to learn what a beat "
            f"looks like; needs {_SHORTEST_RECORD_S:g} s or more"
        )


def _best_lead(leads: list[_LeadBeats]) -> _LeadBeats:
    """The clearest of the leads that agree on when R is.

    Where S is deeper than R is high, as in V1, the largest deflection is S, some 30 ms late. Most
    leads show R; of two that disagree the earlier does, since S follows R.
    """
    clearest = max(leads, key=lambda beats: beats.contrast)
    offsets_s = np.array([_offset_s(beats.r_times_s, clearest.r_times_s) for beats in leads])
    consensus_s = np.sort(offsets_s)[(len(leads) - 1) // 2]
    agreeing = np.flatnonzero(np.abs(offsets_s - consensus_s) < _SAME_WAVE_S)
    return max((leads[i] for i in agreeing), key=lambda beats: beats.contrast)


def _offset_s(r_times_s: Float, reference_s: Float) -> float:
    """Median time by which the peaks of one lead follow those of another."""
    nearest = np.argmin(np.abs(r_times_s[:, None] - reference_s), axis=1)
    return float(np.median(r_times_s - reference_s[nearest]))


def _beats_of_lead(lead_mv: Float, rate_hz: float) -> _LeadBeats:
    """The R peaks in one lead ``(n,)``, and how far they can be trusted."""
    energy = _qrs_energy(lead_mv, rate_hz)
    beats = _decide(energy, rate_hz)
    if len(beats) < 3:
        return _LeadBeats(np.empty(0), 0.0, 0.0)
    shape = _band_pass(lead_mv, _TIMING_BAND_HZ, rate_hz)
    r_samples = _refine(shape, beats, rate_hz)
    likeness = _likeness(shape, r_samples, rate_hz)
    return _LeadBeats(r_samples / rate_hz, _contrast(energy, beats, rate_hz), likeness)


def _band_pass(lead_mv: Float, band_hz: tuple[float, float], rate_hz: float) -> Float:
    """Zero-phase Butterworth filter, so that no wave moves in time."""
    band = butter(2, band_hz, "bandpass", fs=rate_hz, output="sos")
    return np.asarray(sosfiltfilt(band, lead_mv))


def _qrs_energy(lead_mv: Float, rate_hz: float) -> Float:
    """Root mean square in the band of the QRS complex, over as long as one lasts."""
    power = _band_pass(lead_mv, _DETECTION_BAND_HZ, rate_hz) ** 2
    window = 2 * round(_ENERGY_WINDOW_S * rate_hz / 2) + 1
    # The running sum behind the filter may round to just below zero.
    return np.sqrt(np.maximum(uniform_filter1d(power, window), 0))


class _Levels:
    """Running levels of beats and noise; the threshold lies between them."""

    def __init__(self, energy: Float, rate_hz: float) -> None:
        # Seconds, each with a good chance of a beat; their median survives one artefact.
        opening = energy[: round(10 * rate_hz)]
        parts = np.array_split(opening, max(1, round(len(opening) / (1.5 * rate_hz))))
        self.beat = float(np.median([part.max() for part in parts]))
        self.noise = float(np.median(opening))

    @property
    def threshold(self) -> float:
        return self.noise + 0.35 * (self.beat - self.noise)

    def saw_beat(self, energy: float) -> None:
        # One artefact must not lift the threshold above the beats that follow it.
        self.beat += 0.2 * (min(energy, 2 * self.beat) - self.beat)

    def saw_noise(self, energy: float) -> None:
        self.noise += 0.1 * (energy - self.noise)


def _decide(energy: Float, rate_hz: float) -> Integer:
    """Which energy peaks are beats, ``(beats,)`` sample numbers."""
    levels = _Levels(energy, rate_hz)
    peaks = argrelmax(energy, order=max(1, round(0.05 * rate_hz)))[0]
    beats: list[int] = []
    for peak in peaks.tolist():
        if beats and peak - beats[-1] > 1.66 * _usual_rr(beats, rate_hz):
            _search_back(beats, peak, peaks, energy, levels, rate_hz)
        _judge(beats, peak, energy, levels, rate_hz)
    return np.array(beats, dtype=np.int64)


def _judge(beats: list[int], peak: int, energy: Float, levels: _Levels, rate_hz: float) -> None:
    """Take ``peak`` as a beat, as a better instant of the beat before it, or as noise."""
    height = float(energy[peak])
    since_s = (peak - beats[-1]) / rate_hz if beats else np.inf
    if since_s < _REFRACTORY_S:
        if height > energy[beats[-1]]:
            beats[-1] = peak
    elif height > levels.threshold and not (
        since_s < _T_WAVE_S and height < 0.5 * energy[beats[-1]]
    ):
        beats.append(peak)
        levels.saw_beat(height)
    else:
        levels.saw_noise(height)


def _search_back(
    beats: list[int], now: int, peaks: Integer, energy: Float, levels: _Levels, rate_hz: float
) -> None:
    """A beat is overdue: take the largest peak since the last one, if over half the threshold."""
    gap = round(_REFRACTORY_S * rate_hz)
    waiting = peaks[(peaks > beats[-1] + gap) & (peaks < now - gap)]
    if len(waiting) == 0:
        return
    best = int(waiting[np.argmax(energy[waiting])])
    if energy[best] > 0.5 * levels.threshold:
        beats.append(best)
        levels.saw_beat(float(energy[best]))


def _usual_rr(beats: list[int], rate_hz: float) -> float:
    """Median of the last eight RR intervals in samples; one second before there are two beats."""
    return float(np.median(np.diff(beats[-9:]))) if len(beats) > 1 else rate_hz


def _refine(shape: Float, beats: Integer, rate_hz: float) -> Float:
    """The extreme of the QRS complex near each beat, in samples, by a parabola through three.

    The record's own polarity decides, but a beat that plainly points the other way (an ectopic
    one) is timed at its own extreme.
    """
    half = round(0.06 * rate_hz)
    beats = beats[(beats > half) & (beats < len(shape) - half - 1)]
    windows = shape[beats[:, None] + np.arange(-half, half + 1)]
    up, down = windows.max(axis=1), -windows.min(axis=1)
    polarity = 1.0 if np.median(up - down) > 0 else -1.0
    sign = np.where(np.where(polarity > 0, down > 1.5 * up, up > 1.5 * down), -polarity, polarity)
    top = beats - half + np.argmax(sign[:, None] * windows, axis=1)
    before, at, after = (sign * shape[top + step] for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    # A maximum at the edge of the window need not be one of the signal: it stays where it is.
    bent = (curvature < 0) & (at >= before) & (at >= after)
    shift = np.where(bent, 0.5 * (before - after) / np.where(bent, curvature, 1.0), 0.0)
    return np.asarray(top + shift)


def _likeness(shape: Float, r_samples: Float, rate_hz: float) -> float:
    """Median correlation of the QRS complexes with their median, 1 for a perfect clockwork."""
    half = round(0.1 * rate_hz)
    centres = np.round(r_samples).astype(np.int64)
    centres = centres[(centres >= half) & (centres < len(shape) - half)]
    if len(centres) < 3:
        return 0.0
    windows = shape[centres[:, None] + np.arange(-half, half + 1)]
    windows = windows - windows.mean(axis=1, keepdims=True)
    middle = np.median(windows, axis=0)
    norms = np.linalg.norm(windows, axis=1) * np.linalg.norm(middle)
    return float(np.median(windows @ middle / np.maximum(norms, np.finfo(float).tiny)))


def _contrast(energy: Float, beats: Integer, rate_hz: float) -> float:
    """Median energy of the beats over what 99 % of the samples between them stay under."""
    between = np.ones(len(energy), dtype=bool)
    reach = round(0.12 * rate_hz)
    for beat in beats:
        between[max(0, beat - reach) : beat + reach + 1] = False
    if not between.any():
        return 0.0
    return float(np.median(energy[beats]) / max(np.quantile(energy[between], 0.99), 1e-12))
