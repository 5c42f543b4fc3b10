"""A simulated electrocardiogram whose R peaks are known.

Each beat is a sum of Gaussian waves (P, Q, R, S, T) placed on a list of R times, after McSharry,
Clifford, Tarassenko and Smith, "A dynamical model for generating synthetic electrocardiogram
signals", IEEE Trans Biomed Eng 50 (2003) 289-294. On top come what electrodes pick up besides:
baseline wander, mains, muscle and, inside the scanner, the voltage that blood flowing through the
static field induces (the magnetohydrodynamic effect: it swells the ST segment and the T wave).
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy.signal import butter, sosfiltfilt

from data_synth.errors import SynthError

Float = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LEADS = ("I", "II", "V1")

# Offset from the R peak (s, at an RR interval of 1 s), width (s, standard deviation) and height
# (mV) in each lead. Two T waves of different width make the slow rise and quick fall of a real T.
_WAVES: dict[str, tuple[float, float, tuple[float, float, float]]] = {
    "P": (-0.165, 0.022, (0.08, 0.13, 0.06)),
    "Q": (-0.027, 0.008, (-0.06, -0.10, 0.00)),
    "R": (0.000, 0.0105, (0.70, 1.10, 0.24)),
    "S": (0.028, 0.0100, (-0.12, -0.20, -0.95)),
    "T rise": (0.260, 0.055, (0.12, 0.18, -0.04)),
    "T fall": (0.300, 0.032, (0.10, 0.15, -0.04)),
}
# A beat from the ventricle's own muscle spreads slowly: wide, tall, no P, T against the QRS.
_ECTOPIC_WAVES: dict[str, tuple[float, float, tuple[float, float, float]]] = {
    "R": (0.000, 0.030, (-0.80, 1.50, 1.20)),
    "S": (0.085, 0.030, (0.20, -0.50, -0.40)),
    "T": (0.300, 0.060, (0.25, -0.45, -0.35)),
}
# Flow through the aortic arch: offset (s), width (s) and share of a wave whose sum peaks at 1.
# Peak 0.15 to 0.2 s after R, a weak reflected wave in diastole.
_FLOW_WAVES = ((0.15, 0.045, 0.86), (0.25, 0.060, 0.52), (0.42, 0.060, -0.22))
_FLOW_BY_LEAD = (0.8, 1.0, -0.6)


class EcgSettings(BaseModel):
    """How regular the heart beats and how clean the recording is."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    respiration_hz: float = Field(default=0.25, gt=0, lt=1)
    respiratory_variation: float = Field(default=0.04, ge=0, le=0.2)
    """Respiratory sinus arrhythmia: swing of the RR interval as a fraction of its mean."""
    jitter: float = Field(default=0.015, ge=0, le=0.1)
    """Standard deviation of the rest of the RR variation, as a fraction of the mean."""
    ectopic_probability: float = Field(default=0.0, ge=0, le=0.3)
    """Chance that a beat comes early from the ventricle and is followed by a pause."""
    baseline_mv: float = Field(default=0.12, ge=0)
    mains_mv: float = Field(default=0.02, ge=0)
    mains_hz: float = Field(default=50.0, gt=0)
    muscle_mv: float = Field(default=0.015, ge=0)
    magnetohydrodynamic_mv: float = Field(default=0.0, ge=0)
    """Height of the flow artefact in lead II; about 0.5 at 1.5 T, 1 at 3 T, 0 off the scanner.
    In a study it shows in the record made during MR alone."""


@dataclass(frozen=True, slots=True)
class EcgSignal:
    """A recording and the truth about its beats; the first sample is at 0 s."""

    signal_mv: Float
    """``(n, leads)`` millivolts."""

    leads: tuple[str, ...]
    """Name of each column."""

    sampling_rate_hz: float
    """Samples a second."""

    r_times_s: Float
    """``(beats,)`` rising times of the R waves inside the recording."""

    ectopic: Mask
    """``(beats,)`` True where the beat came from the ventricle."""


def simulate_ecg(
    rng: np.random.Generator,
    duration_s: float,
    mean_rr_s: float,
    sampling_rate_hz: float = 500.0,
    settings: EcgSettings | None = None,
) -> EcgSignal:
    """Record the leads I, II and V1 of a heart that beats every ``mean_rr_s`` on average.

    Raises
    ------
    SynthError
        When the recording is too short for two beats, or the rates are not physiological.
    """
    settings = settings or EcgSettings()
    _require_sensible(duration_s, mean_rr_s, sampling_rate_hz, settings)
    r_times_s, ectopic = _beats(rng, duration_s, mean_rr_s, settings)
    times_s = np.arange(round(duration_s * sampling_rate_hz)) / sampling_rate_hz
    signal_mv = _electrical(times_s, r_times_s, ectopic, settings)
    signal_mv += _flow_artefact(rng, times_s, r_times_s, settings.magnetohydrodynamic_mv)
    signal_mv += _disturbances(rng, times_s, sampling_rate_hz, settings)
    inside = (r_times_s >= 0) & (r_times_s <= times_s[-1])
    return EcgSignal(signal_mv, LEADS, sampling_rate_hz, r_times_s[inside], ectopic[inside])


def phase_at(times_s: Float, r_times_s: Float) -> Float:
    """Phase in [0, 1) of each time: the share of its own RR interval that has passed.

    Parameters
    ----------
    times_s
        Any shape, seconds.
    r_times_s
        ``(beats,)`` rising R times, seconds.

    Raises
    ------
    SynthError
        When a time lies before the first or at or after the last R peak, where the phase is not
        known.

    >>> phase_at(np.array([1.0, 1.25, 2.5]), np.array([1.0, 2.0, 4.0]))
    array([0.  , 0.25, 0.25])
    """
    times_s = np.asarray(times_s, dtype=float)
    beat = np.searchsorted(r_times_s, times_s, side="right") - 1
    if len(r_times_s) < 2 or (beat < 0).any() or (beat >= len(r_times_s) - 1).any():
        raise SynthError(
            f"times from {times_s.min():.3f} to {times_s.max():.3f} s are not all between two of "
            f"the {len(r_times_s)} R peaks; simulate a longer ECG"
        )
    start_s = r_times_s[beat]
    phase: Float = (times_s - start_s) / (r_times_s[beat + 1] - start_s)
    # Rounding may lift a time one ulp before the next R to exactly 1.
    return np.where(phase < 1, phase, 0.0)


def write_wfdb(folder: Path, name: str, signal: EcgSignal) -> None:
    """Write ``name.hea`` and ``name.dat`` (16 bit, 1 microvolt a step, no date) into ``folder``.

    Raises
    ------
    SynthError
        When the signal leaves the 16-bit range of +-32.7 mV.
    """
    largest_mv = float(np.abs(signal.signal_mv).max())
    if not largest_mv < 32.7:
        raise SynthError(f"{folder / name}: {largest_mv:.1f} mV does not fit +-32.7 mV of WFDB")
    folder.mkdir(parents=True, exist_ok=True)
    channels = len(signal.leads)
    with _quiet_wfdb() as wfdb:
        wfdb.wrsamp(
            name,
            fs=signal.sampling_rate_hz,
            units=["mV"] * channels,
            sig_name=list(signal.leads),
            p_signal=signal.signal_mv,
            fmt=["16"] * channels,
            adc_gain=[1000.0] * channels,
            baseline=[0] * channels,
            write_dir=str(folder),
        )


@contextmanager
def _quiet_wfdb() -> Iterator[Any]:
    """The library, imported when first needed: it brings pandas, and calls deprecated parts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield importlib.import_module("wfdb")


def _require_sensible(
    duration_s: float, mean_rr_s: float, sampling_rate_hz: float, settings: EcgSettings
) -> None:
    """Refuse rates that would fold waves or leave no beat to see."""
    if not 0.3 <= mean_rr_s <= 2.5:
        raise SynthError(f"mean_rr_s = {mean_rr_s} is no heart rate; choose 0.3 to 2.5 s")
    if not duration_s >= 3 * mean_rr_s:
        raise SynthError(f"duration_s = {duration_s} is under three beats of {mean_rr_s} s")
    if not sampling_rate_hz > 2 * max(settings.mains_hz, 50.0):
        raise SynthError(
            f"sampling_rate_hz = {sampling_rate_hz} cannot carry {settings.mains_hz} Hz mains; "
            "choose more than twice that, and more than 100"
        )


def _beats(
    rng: np.random.Generator, duration_s: float, mean_rr_s: float, settings: EcgSettings
) -> tuple[Float, Mask]:
    """R times from before 0 to past the end, and which beats are ectopic."""
    breath = rng.uniform(0, 2 * np.pi)
    times = [-mean_rr_s * rng.uniform(1.0, 2.0)]
    ectopic = [False]
    while times[-1] < duration_s + mean_rr_s:
        angle = 2 * np.pi * settings.respiration_hz * times[-1] + breath
        swing = settings.respiratory_variation * np.sin(angle)
        jitter = settings.jitter * np.clip(rng.normal(), -3, 3)
        early = not ectopic[-1] and rng.random() < settings.ectopic_probability
        # The sinus rhythm goes on under an early beat: early and pause add up to two beats.
        factor = 0.65 if early else 1.35 if ectopic[-1] else 1.0
        times.append(times[-1] + mean_rr_s * factor * (1 + swing + jitter))
        ectopic.append(early)
    return np.array(times), np.array(ectopic)


def _electrical(times_s: Float, r_times_s: Float, ectopic: Mask, settings: EcgSettings) -> Float:
    """The heart's own voltage, ``(n, leads)`` mV."""
    signal_mv = np.zeros((len(times_s), len(LEADS)))
    rr_s = np.diff(r_times_s, prepend=2 * r_times_s[0] - r_times_s[1])
    for r_s, beat_rr_s, early in zip(r_times_s, rr_s, ectopic, strict=True):
        near = slice(*np.searchsorted(times_s, (r_s - 0.7, r_s + 1.2)))
        # Breathing tilts the heart and with it the height of the waves.
        tilt = 1 + 0.06 * np.sin(2 * np.pi * settings.respiration_hz * r_s)
        # Bazett: repolarisation shortens with the root of the interval before it.
        stretch = np.sqrt(beat_rr_s)
        waves = _ECTOPIC_WAVES if early else _WAVES
        for name, (offset_s, width_s, height_mv) in waves.items():
            scale = 1.0 if name in "QRS" else stretch
            bump = _gaussian(times_s[near] - r_s, offset_s * scale, width_s * scale)
            signal_mv[near] += tilt * bump[:, None] * np.array(height_mv)
    return signal_mv


def _flow_artefact(
    rng: np.random.Generator, times_s: Float, r_times_s: Float, height_mv: float
) -> Float:
    """Voltage of the blood that flows through the static field, ``(n, leads)`` mV."""
    one_lead = np.zeros(len(times_s))
    for r_s in r_times_s:
        near = slice(*np.searchsorted(times_s, (r_s - 0.2, r_s + 1.0)))
        strength = height_mv * (1 + 0.1 * rng.normal())
        shift_s = 0.008 * rng.normal()
        for offset_s, width_s, share in _FLOW_WAVES:
            bump = _gaussian(times_s[near] - r_s, offset_s + shift_s, width_s)
            one_lead[near] += strength * share * bump
    return np.asarray(one_lead[:, None] * np.array(_FLOW_BY_LEAD))


def _disturbances(
    rng: np.random.Generator, times_s: Float, sampling_rate_hz: float, settings: EcgSettings
) -> Float:
    """Baseline wander, mains and muscle, ``(n, leads)`` mV; each lead has its own share."""
    columns = [
        settings.baseline_mv * _wander(rng, times_s, settings.respiration_hz)
        + settings.mains_mv * _mains(rng, times_s, settings.mains_hz)
        + settings.muscle_mv * _muscle(rng, len(times_s), sampling_rate_hz)
        for _ in LEADS
    ]
    return np.stack(columns, axis=1)


def _wander(rng: np.random.Generator, times_s: Float, respiration_hz: float) -> Float:
    """Slow drift of about unit amplitude: breathing and three slower waves."""
    rates_hz = np.array([respiration_hz, *rng.uniform(0.03, 0.2, 3)])
    heights = np.array([0.5, *rng.uniform(0.1, 0.4, 3)])
    angles = 2 * np.pi * rates_hz * times_s[:, None] + rng.uniform(0, 2 * np.pi, 4)
    return np.asarray(np.sin(angles) @ heights)


def _mains(rng: np.random.Generator, times_s: Float, mains_hz: float) -> Float:
    """Hum of unit amplitude whose strength drifts slowly."""
    drift = 1 + 0.2 * np.sin(2 * np.pi * 0.07 * times_s + rng.uniform(0, 2 * np.pi))
    return np.asarray(drift * np.sin(2 * np.pi * mains_hz * times_s + rng.uniform(0, 2 * np.pi)))


def _muscle(rng: np.random.Generator, count: int, sampling_rate_hz: float) -> Float:
    """Noise of unit standard deviation in the band of skeletal muscle, 20 Hz upwards."""
    upper_hz = min(150.0, 0.45 * sampling_rate_hz)
    band = butter(2, (20.0, upper_hz), "bandpass", fs=sampling_rate_hz, output="sos")
    noise = np.asarray(sosfiltfilt(band, rng.normal(size=count)))
    return np.asarray(noise / noise.std())


def _gaussian(offset_s: Float, centre_s: float, width_s: float) -> Float:
    """Bell of unit height."""
    return np.asarray(np.exp(-0.5 * ((offset_s - centre_s) / width_s) ** 2))
