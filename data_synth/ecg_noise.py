"""What electrodes pick up besides the heart: drift, mains, muscle, movement, the scanner's coils.

Each disturbance is drawn for the electrodes, and leads are differences of electrodes: so leads keep
Einthoven's law, and choosing other leads does not change those already chosen.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, sosfiltfilt

from data_synth.ecg_waves import Lead
from data_synth.rhythm import Breath

Float = npt.NDArray[np.float64]

# Right arm, left arm, left leg, and six on the chest.
_ELECTRODES = 9
_RA, _LA, _LL, _CHEST = 0, 1, 2, 3
# Independent noise of unit power in each limb lead: half of it comes from either electrode. A chest
# lead is taken against the mean of the limbs, which brings a sixth.
_INDEPENDENT = np.array([np.sqrt(1 / 2)] * 3 + [np.sqrt(5 / 6)] * 6)
# Mains on the limbs as a star of three phases: equal hum in I, II and III, none in their mean.
_STAR = np.array([1 / np.sqrt(3)] * 3 + [1.0] * 6)
# Height of harmonics of the mains against the fundamental; odd ones dominate in real rooms.
_HARMONICS = ((1, 1.0), (2, 0.05), (3, 0.2), (5, 0.1))
_RECOVERY_S = 0.4


def lead_weights(leads: tuple[Lead, ...]) -> Float:
    """``(9, leads)``: how the electrodes RA, LA, LL, V1 to V6 make up each lead."""
    ra, la, ll = np.eye(_ELECTRODES)[[_RA, _LA, _LL]]
    limbs: Mapping[Lead, Float] = {
        "I": la - ra,
        "II": ll - ra,
        "III": ll - la,
        "aVR": ra - (la + ll) / 2,
        "aVL": la - (ra + ll) / 2,
        "aVF": ll - (ra + la) / 2,
    }
    centre = (ra + la + ll) / 3
    chest = np.eye(_ELECTRODES)[_CHEST:]
    rows = [limbs[lead] if lead in limbs else chest[int(lead[1]) - 1] - centre for lead in leads]
    return np.stack(rows, axis=1)


def wander(rng: np.random.Generator, times_s: Float, breath: Breath) -> Float:
    """Drift ``(n, 9)``: half a unit's swing with the breath, as much power in slower waves."""
    angle = breath.at(times_s)
    columns = []
    for _ in range(_ELECTRODES):
        slow_hz = rng.uniform(0.03, 0.2, 3)
        heights = rng.dirichlet(np.ones(3)) ** 0.5 * 0.5
        slow = np.sin(2 * np.pi * slow_hz * times_s[:, None] + rng.uniform(0, 2 * np.pi, 3))
        columns.append(0.5 * np.sin(angle + rng.uniform(0, 2 * np.pi)) + slow @ heights)
    return np.asarray(np.stack(columns, axis=1) * _INDEPENDENT)


def mains(rng: np.random.Generator, times_s: Float, mains_hz: float, rate_hz: float) -> Float:
    """Hum ``(n, 9)`` of unit height in limb and chest leads, with harmonics, drifting slowly.

    What lies at or above half the sampling rate is left out, as by a recorder's input filter.
    """
    hum = np.zeros((len(times_s), _ELECTRODES))
    drift = 1 + 0.2 * np.sin(2 * np.pi * 0.07 * times_s + rng.uniform(0, 2 * np.pi))
    for order, height in _HARMONICS:
        angles = rng.uniform(0, 2 * np.pi, _ELECTRODES)
        angles[:3] = angles[0] + 2 * np.pi / 3 * np.arange(3)
        if order * mains_hz >= rate_hz / 2:
            continue
        # One sine and one cosine make all phases.
        turn = 2 * np.pi * order * mains_hz * times_s
        pair = np.stack([np.sin(turn), np.cos(turn)], axis=1) * (height * drift)[:, None]
        hum += pair @ (np.stack([np.cos(angles), np.sin(angles)]) * _STAR)
    return hum


def muscle(rng: np.random.Generator, count: int, rate_hz: float) -> Float:
    """Noise ``(n, 9)`` of unit deviation in limb and chest leads, in the band of muscle, 20 to 150
    Hz or to just under half the sampling rate."""
    band = butter(2, (20.0, min(150.0, 0.45 * rate_hz)), "bandpass", fs=rate_hz, output="sos")
    noise = sosfiltfilt(band, rng.normal(size=(_ELECTRODES, count)), axis=1)
    return np.asarray((noise / noise.std(axis=1, keepdims=True)).T * _INDEPENDENT)


def motion(rng: np.random.Generator, times_s: Float, per_minute: float) -> Float:
    """Electrodes that are tugged, ``(n, 9)``: a jump that decays, and a shake of 1 to 10 Hz.

    Of the kind that the MIT-BIH noise stress test database calls electrode motion (Moody, Muldrow
    and Mark, Comput Cardiol 11 (1984) 381-384), which is hardest to tell from beats.
    """
    moved = np.zeros((len(times_s), _ELECTRODES))
    duration_s = float(times_s[-1])
    for _ in range(rng.poisson(per_minute * duration_s / 60)):
        start_s, electrode = rng.uniform(0, duration_s), rng.integers(_ELECTRODES)
        size, decay_s = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0), rng.uniform(0.2, 0.8)
        shake_hz, angle = rng.uniform(1.0, 10.0), rng.uniform(0, 2 * np.pi)
        near = slice(*np.searchsorted(times_s, (start_s, start_s + 8 * decay_s)))
        passed_s = times_s[near] - start_s
        jump = np.exp(-passed_s / decay_s) - np.exp(-passed_s / 0.03)
        moved[near, electrode] += (
            size * jump * (1 + 0.5 * np.sin(2 * np.pi * shake_hz * passed_s + angle))
        )
    return moved


def gradients(
    rng: np.random.Generator, times_s: Float, r_times_s: Float, segment_s: float, rate_hz: float
) -> Float:
    """What switched gradients induce, ``(n, 9)``, of unit height in lead II.

    A cine plays the same lines again for each picture of a beat: their phase-encoding steps form a
    saw-tooth of that period, another part of it in each beat. The single pulses, some 300 a
    second, and harmonics above the twelfth or above 0.45 of the sampling rate are left out, as by
    the recorder's input filter; the first is there at any rate.
    """
    beat = np.searchsorted(r_times_s, times_s, side="right")
    part = rng.uniform(-1.0, 1.0, len(r_times_s) + 1)[beat]
    turn = 2 * np.pi * times_s / segment_s + rng.uniform(0, 2 * np.pi)
    orders = range(1, max(1, int(0.45 * rate_hz * segment_s)) + 1)
    saw = sum(2 / np.pi * np.sin(k * turn) / k for k in orders if k <= 12)
    gains = rng.uniform(-0.7, 0.7, _ELECTRODES)
    gains[_LL] = 1 + gains[_RA]
    return np.asarray((saw * (0.6 + 0.4 * part))[:, None] * gains)


def recovery(times_s: Float, end_s: float) -> Float:
    """Share of an offset that is left after an amplifier came off its rail at ``end_s``."""
    return np.where(times_s >= end_s, np.exp(-np.maximum(times_s - end_s, 0) / _RECOVERY_S), 0.0)
