"""A simulated electrocardiogram whose beats are known.

`rhythm` says when the heart beats, `ecg_waves` what its electric vector then does and how leads see
it, `ecg_noise` what electrodes pick up besides. Inside the scanner, blood that flows through the
static field adds a voltage (the magnetohydrodynamic effect), which swells the ST segment and the T
wave.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from data_synth import ecg_noise, ecg_waves
from data_synth.ecg_settings import ALL_LEADS, LEADS, EcgSettings, LostLead
from data_synth.errors import SynthError
from data_synth.rhythm import Breath, Kind, Rhythm, draw_breath, draw_rhythm

Float = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

__all__ = [
    "ALL_LEADS",
    "LEADS",
    "EcgSettings",
    "EcgSignal",
    "LostLead",
    "phase_at",
    "simulate_ecg",
    "write_annotations",
    "write_wfdb",
]

# Codes of the MIT-BIH arrhythmia database.
_BEAT_CODES: dict[Kind, str] = {
    "normal": "N",
    "premature_ventricular": "V",
    "premature_atrial": "A",
    "fibrillation": "N",
}


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
    """``(beats,)`` rising R times inside the recording.

    The R time of a beat of any kind is the instant at which its own QRS complex, in lead II, with
    breath at its mean and nothing else in the lead, is farthest from the baseline. Leads that look
    elsewhere peak at other times: the S wave of V1 comes some 20 ms later. The interval from one R
    time to the next, whatever their kinds, is the beat that phases divide.
    """

    ectopic: Mask
    """``(beats,)`` True where the beat came from the ventricle."""

    kinds: tuple[Kind, ...] = ()
    """``(beats,)`` where each beat came from."""

    lost: tuple[LostLead, ...] = ()
    """Stretches without signal, asked for or drawn, in order of their start."""

    fibrillation_s: tuple[tuple[float, float], ...] = ()
    """Stretches of atrial fibrillation inside the recording."""

    def valid(self) -> Mask:
        """``(n, leads)`` False where a lead is lost."""
        times_s = np.arange(len(self.signal_mv)) / self.sampling_rate_hz
        valid = np.ones(self.signal_mv.shape, dtype=bool)
        for one in self.lost:
            valid[_stretch(times_s, one), _columns(one, self.leads)] = False
        return valid


def simulate_ecg(
    rng: np.random.Generator,
    duration_s: float,
    mean_rr_s: float,
    sampling_rate_hz: float = 500.0,
    settings: EcgSettings | None = None,
) -> EcgSignal:
    """Record the leads of a heart that beats every ``mean_rr_s`` on average.

    Beats, waves and each disturbance draw from streams of their own: a change of one leaves the
    others as they were.

    Raises
    ------
    SynthError
        When the recording is too short for three beats or longer than a day, ``mean_rr_s`` lies
        outside 0.3 to 2.5 s or the sampling rate outside 100 to 2000 Hz, a lost lead ends after
        the recording, or fibrillation starts no earlier than its end.
    """
    settings = settings or EcgSettings()
    _require_sensible(duration_s, mean_rr_s, sampling_rate_hz, settings)
    streams = [np.random.default_rng(seed) for seed in rng.integers(2**63, size=10)]
    breath = draw_breath(streams[0], duration_s, settings)
    rhythm = draw_rhythm(streams[1], duration_s, mean_rr_s, breath, settings)
    times_s = np.arange(round(duration_s * sampling_rate_hz)) / sampling_rate_hz
    heart_mv = _heart(streams[2:4], times_s, rhythm, breath, settings)
    signal_mv = heart_mv @ ecg_waves.lead_vectors(settings.leads)
    signal_mv += _scanner(streams[4:6], times_s, rhythm, sampling_rate_hz, settings)
    muscle_mv = _muscle_mv(heart_mv, settings)
    signal_mv += _disturbances(streams[6:9], times_s, breath, sampling_rate_hz, settings, muscle_mv)
    lost = _lost(streams[9], duration_s, settings)
    signal_mv = _recorded(signal_mv, times_s, lost, settings)
    return _with_truth(signal_mv, sampling_rate_hz, times_s, rhythm, lost, settings)


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


def write_annotations(folder: Path, name: str, signal: EcgSignal) -> None:
    """Write the truth about the beats as WFDB annotations, ``name.atr``, into ``folder``.

    Codes are those of the MIT-BIH arrhythmia database: N, V (early from the ventricle) and A (early
    from the atrium) at the sample nearest to each R time; + with ``(N`` or ``(AFIB`` where the
    rhythm changes; ~ with ``lost LEAD`` and ``back LEAD`` where a lead comes off and comes back.
    """
    last = len(signal.signal_mv) - 1
    rows = [
        (round(time_s * signal.sampling_rate_hz), _BEAT_CODES[kind], "")
        for time_s, kind in zip(signal.r_times_s, signal.kinds, strict=True)
    ]
    marks = _rhythm_marks(signal) + _lost_marks(signal)
    rows += [(round(time_s * signal.sampling_rate_hz), code, note) for time_s, code, note in marks]
    # Of a mark and a beat at one sample the mark comes first.
    rows = sorted(((min(sample, last), code, note) for sample, code, note in rows), key=_in_order)
    folder.mkdir(parents=True, exist_ok=True)
    with _quiet_wfdb() as wfdb:
        wfdb.wrann(
            name,
            "atr",
            np.array([sample for sample, _, _ in rows]),
            symbol=[code for _, code, _ in rows],
            aux_note=[note for _, _, note in rows],
            fs=signal.sampling_rate_hz,
            write_dir=str(folder),
        )


def _in_order(row: tuple[int, str, str]) -> tuple[int, bool, str]:
    return row[0], not row[2], row[2]


def _rhythm_marks(signal: EcgSignal) -> list[tuple[float, str, str]]:
    """The rhythm at the start and wherever it changes."""
    end_s = len(signal.signal_mv) / signal.sampling_rate_hz
    changes = {0.0: "(N"}
    for start_s, stop_s in signal.fibrillation_s:
        changes |= {start_s: "(AFIB", stop_s: "(N"}
    return [(time_s, "+", note) for time_s, note in changes.items() if time_s < end_s]


def _lost_marks(signal: EcgSignal) -> list[tuple[float, str, str]]:
    """Where leads come off and come back."""
    starts = [(one.start_s, "~", f"lost {one.lead}") for one in signal.lost]
    return starts + [(one.end_s, "~", f"back {one.lead}") for one in signal.lost]


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
    if not 3 * mean_rr_s <= duration_s <= 86400:
        raise SynthError(
            f"duration_s = {duration_s} is under three beats of {mean_rr_s} s or over a day"
        )
    if not 100 <= sampling_rate_hz <= 2000:
        raise SynthError(
            f"sampling_rate_hz = {sampling_rate_hz} does not fit an ECG; choose 100 to 2000"
        )
    late = [one for one in settings.lost if one.end_s > duration_s]
    stretch = settings.fibrillation_s
    if late or (stretch is not None and stretch[0] >= duration_s):
        what = f"lost lead {late[0].lead}" if late else f"fibrillation_s = {stretch}"
        raise SynthError(f"{what}: lies past the recording of {duration_s} s; choose earlier times")


def _heart(
    streams: list[np.random.Generator],
    times_s: Float,
    rhythm: Rhythm,
    breath: Breath,
    settings: EcgSettings,
) -> Float:
    """The heart's own vector, ``(n, 3)`` mV."""
    vector_mv = ecg_waves.heart_vector(
        streams[0],
        times_s,
        rhythm,
        breath,
        qtc_s=settings.qtc_ms / 1000,
        qt_correction=settings.qt_correction,
        focus=settings.ectopic_focus,
        modulation=settings.respiratory_modulation,
    )
    return vector_mv + ecg_waves.fibrillation_vector(
        streams[1],
        times_s,
        rhythm.fibrillation_s,
        settings.fibrillation_wave_hz,
        settings.fibrillation_wave_mv,
    )


def _scanner(
    streams: list[np.random.Generator],
    times_s: Float,
    rhythm: Rhythm,
    rate_hz: float,
    settings: EcgSettings,
) -> Float:
    """What the scanner adds, ``(n, leads)`` mV."""
    height_mv = settings.magnetohydrodynamic_mv * settings.field_strength_t / 1.5
    flow_mv = ecg_waves.flow_vector(streams[0], times_s, rhythm, height_mv)
    added_mv = flow_mv @ ecg_waves.lead_vectors(settings.leads)
    if settings.gradient_mv:
        switched = ecg_noise.gradients(
            streams[1], times_s, rhythm.r_times_s, settings.gradient_segment_s, rate_hz
        )
        added_mv += settings.gradient_mv * switched @ ecg_noise.lead_weights(settings.leads)
    return np.asarray(added_mv)


def _muscle_mv(heart_mv: Float, settings: EcgSettings) -> float:
    """Standard deviation of muscle noise."""
    if settings.muscle_snr_db is None:
        return settings.muscle_mv
    lead_ii_mv = heart_mv @ ecg_waves.lead_vectors(("II",))
    return float(lead_ii_mv.std() * 10 ** (-settings.muscle_snr_db / 20))


def _disturbances(
    streams: list[np.random.Generator],
    times_s: Float,
    breath: Breath,
    rate_hz: float,
    settings: EcgSettings,
    muscle_mv: float,
) -> Float:
    """Drift, mains, muscle and movement, ``(n, leads)`` mV."""
    at_electrodes = settings.baseline_mv * ecg_noise.wander(streams[0], times_s, breath)
    if settings.mains_mv:
        hum = ecg_noise.mains(streams[1], times_s, settings.mains_hz, rate_hz)
        at_electrodes += settings.mains_mv * hum
    noisy = streams[2].spawn(2)
    at_electrodes += muscle_mv * ecg_noise.muscle(noisy[0], len(times_s), rate_hz)
    moved = ecg_noise.motion(noisy[1], times_s, settings.motion_per_minute)
    at_electrodes += settings.motion_mv * moved
    return np.asarray(at_electrodes @ ecg_noise.lead_weights(settings.leads))


def _lost(
    rng: np.random.Generator, duration_s: float, settings: EcgSettings
) -> tuple[LostLead, ...]:
    """Stretches that were asked for, and those that chance adds."""
    lost = list(settings.lost)
    for _ in range(rng.poisson(settings.lost_per_minute * duration_s / 60)):
        start_s = rng.uniform(0, duration_s)
        end_s = min(start_s + max(rng.exponential(settings.lost_mean_s), 0.05), duration_s)
        lead = settings.leads[rng.integers(len(settings.leads))]
        kind: Literal["flat", "rail"] = "rail" if rng.random() < 0.5 else "flat"
        lost.append(LostLead(lead=lead, start_s=start_s, end_s=end_s, kind=kind))
    return tuple(sorted(lost, key=lambda one: (one.start_s, one.end_s, one.lead)))


def _recorded(
    signal_mv: Float, times_s: Float, lost: tuple[LostLead, ...], settings: EcgSettings
) -> Float:
    """What the amplifier makes of the voltages: leads off, and an end to its range."""
    for one in lost:
        if one.kind == "rail":
            left = settings.range_mv * ecg_noise.recovery(times_s, one.end_s)
            signal_mv[:, _columns(one, settings.leads)] += left[:, None]
    signal_mv = np.clip(signal_mv, -settings.range_mv, settings.range_mv)
    for one in lost:
        level_mv = settings.range_mv if one.kind == "rail" else 0.0
        signal_mv[_stretch(times_s, one), _columns(one, settings.leads)] = level_mv
    return signal_mv


def _stretch(times_s: Float, one: LostLead) -> slice:
    """Samples from start to before end."""
    first, last = np.searchsorted(times_s, (one.start_s, one.end_s))
    return slice(int(first), int(last))


def _columns(one: LostLead, leads: tuple[str, ...]) -> slice:
    """Columns of the lead that is lost."""
    if one.lead == "all":
        return slice(None)
    column = leads.index(one.lead)
    return slice(column, column + 1)


def _with_truth(
    signal_mv: Float,
    rate_hz: float,
    times_s: Float,
    rhythm: Rhythm,
    lost: tuple[LostLead, ...],
    settings: EcgSettings,
) -> EcgSignal:
    """The recording with what is known of the part of the rhythm inside it."""
    inside = (rhythm.r_times_s >= 0) & (rhythm.r_times_s <= times_s[-1])
    kinds = tuple(kind for kind, here in zip(rhythm.kinds, inside, strict=True) if here)
    ectopic = np.array([kind == "premature_ventricular" for kind in kinds], dtype=bool)
    end_s = len(times_s) / rate_hz
    fibrillation_s = tuple(
        (max(start_s, 0.0), min(stop_s, end_s)) for start_s, stop_s in rhythm.fibrillation_s
    )
    r_times_s = rhythm.r_times_s[inside]
    return EcgSignal(
        signal_mv, settings.leads, rate_hz, r_times_s, ectopic, kinds, lost, fibrillation_s
    )
