"""The heart's electric vector beat by beat, and what electrodes on the chest see of it.

Each wave is a vector whose length rises and falls as a Gaussian, as in Sameni, Clifford, Jutten and
Shamsollahi, "Multichannel ECG and noise modeling: application to maternal and fetal ECG signals",
EURASIP J Adv Signal Process (2007) 43407. Dower's coefficients for Frank's torso (Dower, Machado
and Osborne, "On deriving the electrocardiogram from vectorcardiographic leads", Clin Cardiol 3
(1980) 87-95) turn the vector into leads. The vectors of the waves themselves are chosen so that
the twelve leads show what they show in health: axes near 55 degrees, rS in V1, transition in
V3 to V4, a two-sided P in V1.

Axes are Frank's: x to the patient's left, y to the feet, z to the back; lengths in mV.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from data_synth.rhythm import Breath, Kind, Rhythm

Float = npt.NDArray[np.float64]
Lead = Literal["I", "II", "III", "aVR", "aVL", "aVF", "V1", "V2", "V3", "V4", "V5", "V6"]
Focus = Literal["right_ventricle", "left_ventricle"]

_DOWER: Mapping[Lead, tuple[float, float, float]] = {
    "I": (0.632, -0.235, 0.059),
    "II": (0.235, 1.066, -0.132),
    "V1": (-0.515, 0.157, -0.917),
    "V2": (0.044, 0.164, -1.387),
    "V3": (0.882, 0.098, -1.277),
    "V4": (1.213, 0.127, -0.601),
    "V5": (1.125, 0.127, -0.086),
    "V6": (0.831, 0.076, 0.230),
}
# Einthoven's law and Goldberger's leads in terms of I and II.
_FROM_LIMBS: Mapping[Lead, tuple[float, float]] = {
    "III": (-1.0, 1.0),
    "aVR": (-0.5, -0.5),
    "aVL": (1.0, -0.5),
    "aVF": (-0.5, 1.0),
}

QRS_ONSET_S = -0.040
"""Start of a normal QRS complex against its R time."""


@dataclass(frozen=True, slots=True)
class Wave:
    """One wave: time of its peak against R (s), width before and after it (s), vector (mV)."""

    peak_s: float
    before_s: float
    after_s: float
    vector_mv: tuple[float, float, float]


# The septum to the right and forward, the free walls to the left and down, the base to the back.
_QRS = (
    Wave(-0.024, 0.008, 0.008, (-0.12, -0.05, -0.25)),
    Wave(0.000, 0.0105, 0.0105, (1.20, 0.75, -0.02)),
    Wave(0.015, 0.009, 0.009, (-0.06, 0.03, 0.45)),
    Wave(0.028, 0.010, 0.011, (-0.15, -0.15, 0.75)),
)
# The right atrium, in front, before the left, behind: against R at an interval of 1 s.
_P = (
    Wave(-0.165, 0.016, 0.018, (0.03, 0.09, -0.07)),
    Wave(-0.137, 0.018, 0.016, (0.08, 0.06, 0.03)),
)
# From a focus low in the atrium the front runs upwards, and reaches the node sooner.
_EARLY_P = (Wave(-0.135, 0.017, 0.017, (0.07, -0.11, 0.02)),)
_T_VECTOR_MV = (0.38, 0.22, -0.18)
# An ectopic front creeps through muscle: wide, no P, T against the QRS.
_ECTOPIC_QRS: Mapping[Focus, tuple[Wave, ...]] = {
    # The free wall of the right ventricle: as left bundle branch block, axis near 45 degrees.
    "right_ventricle": (
        Wave(-0.038, 0.014, 0.016, (0.20, 0.15, -0.25)),
        Wave(0.000, 0.024, 0.022, (1.25, 0.75, 0.80)),
        Wave(0.048, 0.020, 0.024, (0.45, 0.20, 0.75)),
    ),
    # The left ventricle's free wall: as right bundle branch block, axis to the right.
    "left_ventricle": (
        Wave(-0.036, 0.014, 0.016, (-0.20, 0.25, 0.10)),
        Wave(0.000, 0.027, 0.027, (-0.95, 0.95, -0.65)),
        Wave(0.050, 0.022, 0.024, (-0.35, 0.20, -0.70)),
    ),
}
_ECTOPIC_T_MV: Mapping[Focus, tuple[float, float, float]] = {
    "right_ventricle": (-0.45, -0.32, -0.42),
    "left_ventricle": (0.42, -0.36, 0.36),
}
# Blood crosses the field in the aortic arch, from the front and right to the back and left; the
# field runs from feet to head. Their cross product points to the left and forward. It is seen
# from above the heart, so some of it looks upright in the leads of the feet (a chosen share).
_FLOW_VECTOR = (0.75, 0.40, -0.50)
# Offset from R (s), width (s) and share of waves whose sum peaks at 1, 0.16 s after R; in diastole
# a weak wave is reflected.
_FLOW = ((0.15, 0.045, 0.86), (0.25, 0.060, 0.52), (0.42, 0.060, -0.22))
# Radians by which the heart turns for each unit of modulation.
_TURN = 0.5
# Fibrillating atria: largest in V1, half as large in II; the second source keeps its own time.
_FIBRILLATION = ((-0.32, 0.40, -0.74), (0.20, 0.30, -0.30))


def lead_vectors(leads: tuple[Lead, ...]) -> Float:
    """``(3, leads)`` coefficients that turn a heart vector (mV) into voltages."""
    limbs = np.array([_DOWER["I"], _DOWER["II"]])
    rows = [
        np.array(_DOWER[lead]) if lead in _DOWER else np.array(_FROM_LIMBS[lead]) @ limbs
        for lead in leads
    ]
    return np.stack(rows, axis=1)


def qt_interval_s(rr_s: float, qtc_s: float, correction: str) -> float:
    """QT from QRS onset to the end of T at an RR interval.

    Bazett takes the root (Heart 7 (1920) 353-370), Fridericia the cubic root (Acta Med Scand 53
    (1920) 469-486) of the interval in seconds.
    """
    return float(qtc_s * rr_s ** (1 / 2 if correction == "bazett" else 1 / 3))


@cache
def qrs_waves(kind: Kind, focus: Focus) -> tuple[Wave, ...]:
    """The waves of a QRS complex, placed so that lead II is farthest from the baseline at 0 s."""
    waves = _ECTOPIC_QRS[focus] if kind == "premature_ventricular" else _QRS
    times_s = np.linspace(-0.03, 0.03, 60001)
    height = np.abs(_sum(times_s, waves) @ np.array(_DOWER["II"]))
    peak_s = float(times_s[np.argmax(height)])
    return tuple(Wave(w.peak_s - peak_s, w.before_s, w.after_s, w.vector_mv) for w in waves)


def t_wave(kind: Kind, qt_s: float, focus: Focus) -> Wave:
    """The T wave that ends a QT interval; it rises slowly and falls quickly.

    The tangent at the steepest point of a falling Gaussian meets the baseline two widths after the
    peak: by this usual measure T ends at QRS onset + QT.
    """
    if kind == "premature_ventricular":
        # The wide complex starts earlier and repolarises later.
        return Wave(
            QRS_ONSET_S + 0.03 + 0.80 * qt_s, 0.17 * qt_s, 0.11 * qt_s, _ECTOPIC_T_MV[focus]
        )
    fall_s = 0.1 * qt_s
    return Wave(QRS_ONSET_S + qt_s - 2 * fall_s, 0.15 * qt_s, fall_s, _T_VECTOR_MV)


def p_waves(kind: Kind, rr_s: float) -> tuple[Wave, ...]:
    """The P wave of a beat; conduction to the ventricle shortens at fast rates."""
    if kind not in ("normal", "premature_atrial"):
        return ()
    pull = min(max(rr_s, 0.3), 1.5) ** 0.2
    waves = _P if kind == "normal" else _EARLY_P
    return tuple(Wave(w.peak_s * pull, w.before_s, w.after_s, w.vector_mv) for w in waves)


def heart_vector(
    rng: np.random.Generator,
    times_s: Float,
    rhythm: Rhythm,
    breath: Breath,
    *,
    qtc_s: float,
    qt_correction: str,
    focus: Focus,
    modulation: float,
) -> Float:
    """The heart's vector ``(n, 3)`` in mV.

    Breathing turns the heart in the frontal plane and moves it to and from the electrodes
    (``modulation``: swing of the length of the vector); successive beats differ by a hundredth.
    """
    vector_mv = np.zeros((len(times_s), 3))
    steady_s = _repolarisation_rr(rhythm.rr_before_s)
    turn_of_beat = np.sin(breath.at(rhythm.r_times_s))
    for r_s, rr_s, qt_rr_s, kind, turn in zip(
        rhythm.r_times_s, rhythm.rr_before_s, steady_s, rhythm.kinds, turn_of_beat, strict=True
    ):
        qt_s = qt_interval_s(qt_rr_s, qtc_s, qt_correction)
        waves = p_waves(kind, rr_s) + qrs_waves(kind, focus) + (t_wave(kind, qt_s, focus),)
        seen = _turned(_TURN * modulation * turn) * (1 + modulation * turn)
        noise = 1 + 0.01 * rng.normal(size=len(waves))
        for wave, size in zip(waves, noise, strict=True):
            _add(vector_mv, times_s, r_s, wave, size * seen @ np.array(wave.vector_mv))
    for r_s in rhythm.blocked_s:
        for wave in p_waves("normal", 1.0):
            _add(vector_mv, times_s, r_s, wave, np.array(wave.vector_mv))
    return vector_mv


def flow_vector(
    rng: np.random.Generator, times_s: Float, rhythm: Rhythm, height_mv: float
) -> Float:
    """Voltage of blood that flows through the static field, as a vector ``(n, 3)``.

    It peaks at ``height_mv`` in lead II for a beat of usual filling; a beat that comes early
    ejects less, one after a pause more. Successive beats differ by a tenth.
    """
    along = np.zeros(len(times_s))
    usual_s = np.median(rhythm.rr_before_s)
    filling = np.clip(np.sqrt(rhythm.rr_before_s / usual_s), 0.4, 1.3)
    for r_s, share in zip(rhythm.r_times_s, filling, strict=True):
        strength, shift_s = share * (1 + 0.1 * rng.normal()), 0.008 * rng.normal()
        for offset_s, width_s, part in _FLOW:
            centre_s = r_s + offset_s + shift_s
            near = slice(
                *np.searchsorted(times_s, (centre_s - 6 * width_s, centre_s + 6 * width_s))
            )
            along[near] += strength * part * _bell(times_s[near] - centre_s, width_s, width_s)
    direction = np.array(_FLOW_VECTOR) / (np.array(_FLOW_VECTOR) @ np.array(_DOWER["II"]))
    return np.asarray(height_mv * along[:, None] * direction)


def fibrillation_vector(
    rng: np.random.Generator,
    times_s: Float,
    stretches_s: tuple[tuple[float, float], ...],
    rate_hz: float,
    height_mv: float,
) -> Float:
    """The f waves ``(n, 3)``: a saw-tooth of five harmonics whose rate and height wander.

    After Stridh and Sornmo, "Spatiotemporal QRST cancellation techniques for analysis of atrial
    fibrillation", IEEE Trans Biomed Eng 48 (2001) 105-111. ``height_mv`` is the height in V1.
    """
    vector_mv = np.zeros((len(times_s), 3))
    for vector in _FIBRILLATION:
        # Two wandering sources: their sum never repeats.
        rate_noise, height_noise = (_slow_noise(rng, times_s) for _ in range(2))
        turns = np.cumsum(rate_hz + 0.8 * rate_noise) * (times_s[1] - times_s[0])
        angle = 2 * np.pi * (turns + rng.uniform())
        height = height_mv * np.clip(1 + 0.4 * height_noise, 0, 2)
        saw = sum(np.sin(k * angle) / k for k in range(1, 6))
        vector_mv += (height * saw / 1.7)[:, None] * np.array(vector)
    shown = np.zeros(len(times_s))
    for start_s, end_s in stretches_s:
        # Half a wave's time to set in and to end.
        shown += np.clip((times_s - start_s) / 0.1, 0, 1) * np.clip((end_s - times_s) / 0.1, 0, 1)
    return vector_mv * shown[:, None]


def _slow_noise(rng: np.random.Generator, times_s: Float) -> Float:
    """Noise of about unit deviation that changes over half a second."""
    nodes_s = np.arange(times_s[0], times_s[-1] + 2.0, 0.5)
    return np.asarray(CubicSpline(nodes_s, rng.normal(size=len(nodes_s)))(times_s))


def _repolarisation_rr(rr_s: Float) -> Float:
    """The interval to which QT has adapted: it follows a change over some ten beats, not at once.

    Lag of QT behind RR: Pueyo et al., "Characterization of QT interval adaptation to RR interval
    changes", IEEE Trans Biomed Eng 51 (2004) 1511-1520.
    """
    steady = np.empty(len(rr_s))
    state = float(np.median(rr_s[:10]))
    for i, one_s in enumerate(rr_s):
        state += 0.15 * (one_s - state)
        steady[i] = state
    return steady


def _turned(angle: float) -> Float:
    """Rotation in the frontal plane (about z)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _add(vector_mv: Float, times_s: Float, r_s: float, wave: Wave, seen_mv: Float) -> None:
    """Add a wave where it is above a millionth of its height."""
    centre_s = r_s + wave.peak_s
    ends_s = (centre_s - 5.3 * wave.before_s, centre_s + 5.3 * wave.after_s)
    near = slice(*np.searchsorted(times_s, ends_s))
    bump = _bell(times_s[near] - centre_s, wave.before_s, wave.after_s)
    vector_mv[near] += bump[:, None] * seen_mv


def _sum(times_s: Float, waves: tuple[Wave, ...]) -> Float:
    """Vector ``(n, 3)`` of waves about an R peak at 0 s."""
    vector_mv = np.zeros((len(times_s), 3))
    for wave in waves:
        _add(vector_mv, times_s, 0.0, wave, np.array(wave.vector_mv))
    return vector_mv


def _bell(offset_s: Float, before_s: float, after_s: float) -> Float:
    """Bell of unit height with a width on either side."""
    width_s = np.where(offset_s < 0, before_s, after_s)
    return np.asarray(np.exp(-0.5 * (offset_s / width_s) ** 2))
