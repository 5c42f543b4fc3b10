"""When the heart beats: sinus rhythm with its variability, early beats, atrial fibrillation.

Sinus intervals follow McSharry, Clifford, Tarassenko and Smith, "A dynamical model for generating
synthetic electrocardiogram signals", IEEE Trans Biomed Eng 50 (2003) 289-294: a line at the
breathing rate (high frequency, HF), a band about 0.1 Hz (Mayer waves, low frequency, LF) and a
ratio of their powers. To this comes a part whose power falls with 1/frequency.

Intervals in atrial fibrillation follow Hennig, Maass, Hayano and Heinrichs, "Exponential
distribution of long heart beat intervals during atrial fibrillation and their relevance for white
noise behaviour in power spectrum", J Biol Phys 32 (2006), arXiv cond-mat/0605295: the sum of a
correlated time and of an independent one with an exponential distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.fft import next_fast_len

Float = npt.NDArray[np.float64]
Kind = Literal["normal", "premature_ventricular", "premature_atrial", "fibrillation"]

SHORTEST_RR_S = 0.25
"""No heart here beats faster: the atrioventricular node and the muscle need to recover."""

# McSharry et al. give both bands this standard deviation.
_BAND_HZ = 0.01
_MAYER_HZ = 0.1
_GRID_HZ = 8.0
_LEAST_S = 256.0
# Share of the sinus interval after which an early beat comes, and a second one after it. Their sum
# leaves the next sinus beat the shortest interval or more up to 160 beats a minute; above, that
# beat comes later, and the pause is longer than it compensates for.
_VENTRICULAR_COUPLING = 0.65
_COUPLET_COUPLING = 0.5
_ATRIAL_COUPLING = 0.7
# An early atrial beat resets the sinus node, which then takes a little longer than usual.
_RESET_DELAY = 1.1
# The node needs a moment to take over from fibrillation: room for a P wave.
_SINUS_RETURN_S = 0.4


class RhythmSettings(BaseModel):
    """How regular the heart beats."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    respiration_hz: float = Field(default=0.25, ge=0.05, lt=1)
    respiratory_variation: float = Field(default=0.04, ge=0, le=0.2)
    """Respiratory sinus arrhythmia: swing of the RR interval as a fraction of its mean."""
    lf_hf_ratio: float = Field(default=1.0, ge=0, le=5)
    """Power of the RR variation about 0.1 Hz over that at the breathing rate."""
    jitter: float = Field(default=0.015, ge=0, le=0.1)
    """Standard deviation of the rest of the RR variation (power falls with 1/frequency), as a
    fraction of the mean."""
    start_rate_bpm: float | None = Field(default=None, ge=30, le=200)
    """With `end_rate_bpm`: the rate runs evenly from one to the other over the recording, in place
    of the mean that is asked for."""
    end_rate_bpm: float | None = Field(default=None, ge=30, le=200)
    ectopic_probability: float = Field(default=0.0, ge=0, le=0.3)
    """Chance that a beat comes early from the ventricle and is followed by a pause."""
    ectopic_pattern: Literal["isolated", "couplets", "bigeminy"] = "isolated"
    """Couplets: two early beats at a time. Bigeminy: every second beat is early, whatever the
    probability."""
    atrial_probability: float = Field(default=0.0, ge=0, le=0.3)
    """Chance that a beat comes early from the atrium."""
    fibrillation: bool = False
    """Atrial fibrillation: no P waves, no sinus rhythm, intervals without order."""
    fibrillation_s: tuple[float, float] | None = None
    """Start and end of the fibrillation, in a study in both recordings; the whole recording if left
    out."""
    fibrillation_irregularity: float = Field(default=0.2, ge=0.1, le=0.35)
    """Mean and standard deviation of the exponential part of the intervals, as a fraction of their
    mean: 0.2 of 0.7 s is a rate of decay of 7 Hz, Hennig et al. found 3 to 12."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.start_rate_bpm is None) != (self.end_rate_bpm is None):
            raise ValueError("start_rate_bpm and end_rate_bpm belong together; give both or none")
        spread = np.hypot(
            self.respiratory_variation * np.sqrt((1 + self.lf_hf_ratio) / 2), self.jitter
        )
        if spread > 0.25:
            raise ValueError(
                f"respiratory_variation, lf_hf_ratio and jitter make the RR interval vary by "
                f"{spread:.2f} of its mean; lower them to 0.25 or less"
            )
        stretch = self.fibrillation_s
        if stretch is not None and not (self.fibrillation and 0 <= stretch[0] < stretch[1]):
            raise ValueError(
                f"fibrillation_s = {stretch} needs `fibrillation: true` and 0 <= start < end"
            )
        return self


@dataclass(frozen=True, slots=True)
class Breath:
    """One breathing movement, shared by all that it moves."""

    times_s: Float
    angle: Float
    """Radians, rising; a full turn is a breath."""

    def at(self, times_s: Float | float) -> Float:
        """Angle at each time."""
        return np.asarray(np.interp(times_s, self.times_s, self.angle))


@dataclass(frozen=True, slots=True)
class Rhythm:
    """Every beat that touches a recording, from before its start to past its end."""

    r_times_s: Float
    """``(beats,)`` rising."""

    rr_before_s: Float
    """``(beats,)`` interval that ended with the beat."""

    kinds: tuple[Kind, ...]
    """Where each beat came from."""

    blocked_s: Float
    """When sinus beats would have shown R, had an early beat not left the ventricle refractory:
    their P waves are there."""

    fibrillation_s: tuple[tuple[float, float], ...]
    """Stretches of atrial fibrillation, seconds."""


@dataclass(slots=True)
class _Draft:
    """Beats in the making."""

    times_s: list[float]
    kinds: list[Kind] = field(default_factory=lambda: ["normal"])
    blocked_s: list[float] = field(default_factory=list)

    def add(self, time_s: float, kind: Kind) -> None:
        self.times_s.append(time_s)
        self.kinds.append(kind)


def draw_breath(rng: np.random.Generator, duration_s: float, settings: RhythmSettings) -> Breath:
    """Breathing at `respiration_hz`, whose rate wanders by 0.01 Hz over tens of seconds."""
    times_s = _grid_s(duration_s)
    spread_hz = min(_BAND_HZ, 0.1 * settings.respiration_hz)
    # Slower than 0.02 Hz: the rate changes from breath to breath by little.
    drift_hz = spread_hz * _coloured(rng, len(times_s), lambda hz: (hz < 0.02).astype(float))
    turns = settings.respiration_hz * times_s + np.cumsum(drift_hz) / _GRID_HZ
    return Breath(times_s, 2 * np.pi * (turns + rng.uniform()))


def draw_rhythm(
    rng: np.random.Generator,
    duration_s: float,
    mean_rr_s: float,
    breath: Breath,
    settings: RhythmSettings,
) -> Rhythm:
    """Draw the beats of ``duration_s`` seconds and of two beats before and after."""
    local_s = _mean_rr(breath.times_s, duration_s, mean_rr_s, settings)
    sinus_s = local_s * (1 + _variation(rng, breath, settings))
    # Even 0.3 of deviation, five times what is usual, leaves the order of waves intact.
    sinus_s = np.maximum(sinus_s, np.maximum(SHORTEST_RR_S, 0.4 * local_s))
    draft = _Draft([-float(local_s[0]) * rng.uniform(2.0, 3.0)])
    stretch, begun = _fibrillation(settings), False
    correlated = _pink(rng, len(breath.times_s))
    while draft.times_s[-1] < duration_s + 2 * local_s[-1]:
        now_s = draft.times_s[-1]
        next_s = now_s + float(np.interp(now_s, breath.times_s, sinus_s))
        if stretch is not None and now_s < stretch[1] and next_s >= stretch[0]:
            if not begun and np.isfinite(stretch[0]):
                # An early beat and its pause may have run on into the stretch: it begins after.
                stretch = max(stretch[0], float(np.nextafter(now_s, np.inf))), stretch[1]
            begun = True
            mean_s = float(np.interp(now_s, breath.times_s, local_s))
            slow = float(np.interp(now_s, breath.times_s, correlated))
            interval_s = _fibrillating_interval_s(rng, mean_s, slow, settings)
            _fibrillating_beat(rng, draft, (interval_s, next_s, mean_s), stretch, settings)
        else:
            _sinus_beat(rng, draft, breath.times_s, sinus_s, settings)
    times_s = np.array(draft.times_s)
    before_s = np.diff(times_s, prepend=times_s[0] - local_s[0])
    stretches = () if stretch is None else (stretch,)
    return Rhythm(times_s, before_s, tuple(draft.kinds), np.array(draft.blocked_s), stretches)


def _grid_s(duration_s: float) -> Float:
    """Times at which slow quantities are drawn; 10 s more on either side hold any beat needed."""
    return np.asarray(np.arange(-10 * _GRID_HZ, (duration_s + 10) * _GRID_HZ) / _GRID_HZ)


def _mean_rr(
    times_s: Float, duration_s: float, mean_rr_s: float, settings: RhythmSettings
) -> Float:
    """Interval that belongs to each time before any variation."""
    if settings.start_rate_bpm is None or settings.end_rate_bpm is None:
        return np.full(len(times_s), mean_rr_s)
    ends = (settings.start_rate_bpm, settings.end_rate_bpm)
    return np.asarray(60.0 / np.interp(times_s, (0.0, duration_s), ends))


def _variation(rng: np.random.Generator, breath: Breath, settings: RhythmSettings) -> Float:
    """Deviation of the interval from its mean, as a fraction of it, over time."""
    count = len(breath.times_s)
    respiratory = settings.respiratory_variation * np.sin(breath.angle)
    # A sine of height a carries the power a^2 / 2.
    low_sd = settings.respiratory_variation * np.sqrt(settings.lf_hf_ratio / 2)
    mayer = _coloured(rng, count, lambda hz: np.exp(-0.25 * ((hz - _MAYER_HZ) / _BAND_HZ) ** 2))
    return np.asarray(respiratory + low_sd * mayer + settings.jitter * _pink(rng, count))


def _pink(rng: np.random.Generator, count: int) -> Float:
    """Unit variance, power falling with 1/frequency up to 0.5 Hz."""
    return _coloured(rng, count, lambda hz: np.where(hz <= 0.5, 1 / np.sqrt(hz), 0.0))


def _coloured(rng: np.random.Generator, count: int, amplitude: Callable[[Float], Float]) -> Float:
    """Series of zero mean and unit variance whose amplitude spectrum is given.

    A short one is cut from a longer: slow changes need room to show any variance at all.
    """
    length = next_fast_len(max(count, round(_LEAST_S * _GRID_HZ)), real=True)
    hz = np.fft.rfftfreq(length, 1 / _GRID_HZ).astype(np.float64)
    noise = rng.normal(size=(2, len(hz)))
    spectrum = np.zeros(len(hz), dtype=complex)
    spectrum[1:] = amplitude(hz[1:]) * (noise[0, 1:] + 1j * noise[1, 1:])
    series = np.fft.irfft(spectrum, length)
    return np.asarray((series / series.std())[:count])


def _fibrillation(settings: RhythmSettings) -> tuple[float, float] | None:
    """The stretch of fibrillation; the whole record and its margins if none is named."""
    if not settings.fibrillation:
        return None
    return settings.fibrillation_s or (-np.inf, np.inf)


def _sinus_beat(
    rng: np.random.Generator,
    draft: _Draft,
    grid_s: Float,
    sinus_s: Float,
    settings: RhythmSettings,
) -> None:
    """Append the next beat, or an early one with the beat that follows it."""
    start_s = draft.times_s[-1]
    rr_s = float(np.interp(start_s, grid_s, sinus_s))
    chances = (settings.ectopic_probability, settings.atrial_probability)
    ventricular, atrial = rng.random(2) < chances
    if draft.kinds[-1] == "premature_atrial":
        draft.add(start_s + _RESET_DELAY * rr_s, "normal")
    elif ventricular or settings.ectopic_pattern == "bigeminy":
        next_rr_s = float(np.interp(start_s + rr_s, grid_s, sinus_s))
        _early_ventricular_beat(draft, rr_s, next_rr_s, settings)
    elif atrial:
        draft.add(start_s + max(_ATRIAL_COUPLING * rr_s, SHORTEST_RR_S), "premature_atrial")
    else:
        draft.add(start_s + rr_s, "normal")


def _early_ventricular_beat(
    draft: _Draft, rr_s: float, next_rr_s: float, settings: RhythmSettings
) -> None:
    """Append early beats and the next sinus beat that reaches the ventricle.

    The sinus node goes on under them: from the sinus beat before to the one after pass exactly two
    of its intervals, the compensatory pause.
    """
    start_s = draft.times_s[-1]
    early_s = start_s + max(_VENTRICULAR_COUPLING * rr_s, SHORTEST_RR_S)
    draft.add(early_s, "premature_ventricular")
    draft.blocked_s.append(start_s + rr_s)
    if settings.ectopic_pattern == "couplets":
        draft.add(early_s + max(_COUPLET_COUPLING * rr_s, SHORTEST_RR_S), "premature_ventricular")
    draft.add(max(start_s + rr_s + next_rr_s, draft.times_s[-1] + SHORTEST_RR_S), "normal")


def _fibrillating_interval_s(
    rng: np.random.Generator, mean_s: float, slow: float, settings: RhythmSettings
) -> float:
    """Time that the atrioventricular node takes to let the next beat through."""
    # At fast rates the refractory time leaves less room for chance.
    exponential_s = min(settings.fibrillation_irregularity * mean_s, mean_s - SHORTEST_RR_S)
    spare_s = mean_s - exponential_s - SHORTEST_RR_S
    correlated_s = SHORTEST_RR_S + spare_s * max(1 + 0.2 * slow, 0.0)
    return correlated_s + float(rng.exponential(exponential_s))


def _fibrillating_beat(
    rng: np.random.Generator,
    draft: _Draft,
    choices_s: tuple[float, float, float],
    stretch: tuple[float, float],
    settings: RhythmSettings,
) -> None:
    """Append a beat of the fibrillation, an early one, or the first sinus beat after its end.

    ``choices_s`` are the interval drawn, the time of the next beat in sinus rhythm, and the mean
    interval.
    """
    interval_s, sinus_s, mean_s = choices_s
    start_s = draft.times_s[-1]
    early_s = start_s + max(_VENTRICULAR_COUPLING * mean_s, SHORTEST_RR_S)
    after_normal = draft.kinds[-1] != "premature_ventricular"
    chosen = after_normal and rng.random() < settings.ectopic_probability
    if chosen and stretch[0] <= early_s < stretch[1]:
        draft.add(early_s, "premature_ventricular")
        return
    next_s = start_s + interval_s if start_s + interval_s >= stretch[0] else sinus_s
    if next_s < stretch[1]:
        draft.add(next_s, "fibrillation")
    else:
        draft.add(max(next_s, stretch[1] + _SINUS_RETURN_S), "normal")
