"""Signal of tissues in a balanced steady-state free precession sequence, on and off resonance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from data_synth.kernels import Float
from data_synth.protocol import MrSettings
from data_synth.tissue import Tissue

Complex = npt.NDArray[np.complex128]

PROTON_MHZ_PER_T = 42.577478518
"""Gyromagnetic ratio of the proton over 2 pi (CODATA 2018)."""
PROTON_HZ_PER_T = 1e6 * PROTON_MHZ_PER_T
FAT_SHIFT_PPM = -3.4
"""Chemical shift of fat's main resonance against water."""
FATTY = (Tissue.FAT, Tissue.BONE)
"""Tissues whose signal comes from fat; the marrow of ribs and spine is taken for fatty."""
BLOOD_TISSUES = (
    Tissue.LV_CAVITY,
    Tissue.RV_CAVITY,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.AORTA,
    Tissue.BLOOD_VESSEL,
)


class Relaxation(NamedTuple):
    """What the contrast of a tissue follows from."""

    t1_ms: float
    t2_ms: float
    density: float
    """Protons that give signal, relative to blood's."""


def _table(
    blood: tuple[float, float],
    heart: tuple[float, float],
    flesh: tuple[float, float],
    liver: tuple[float, float],
    fat: tuple[float, float],
    marrow: tuple[float, float],
    spleen: tuple[float, float],
) -> dict[Tissue, Relaxation]:
    """Table of every tissue from the measured (T1, T2); the rest is set by eye."""
    table = {tissue: Relaxation(*blood, 1.0) for tissue in BLOOD_TISSUES}
    for tissue in (Tissue.LV_MYOCARDIUM, Tissue.RV_WALL, Tissue.PAPILLARY_MUSCLE):
        table[tissue] = Relaxation(*heart, 0.95)
    table |= {
        Tissue.RV_TRABECULA: Relaxation(*heart, 0.95),
        Tissue.ATRIAL_WALL: Relaxation(*heart, 0.9),
        Tissue.SCAR: Relaxation(heart[0] * 1.07, heart[1] * 1.25, 0.95),
        Tissue.MUSCLE: Relaxation(*flesh, 0.9),
        Tissue.VESSEL_WALL: Relaxation(*flesh, 0.9),
        Tissue.LIVER: Relaxation(*liver, 0.85),
        Tissue.SPLEEN: Relaxation(*spleen, 0.85),
        Tissue.FAT: Relaxation(*fat, 0.9),
        Tissue.BONE: Relaxation(*marrow, 0.6),
        Tissue.STOMACH: Relaxation(900.0, 70.0, 0.8),
        Tissue.PERICARDIUM: Relaxation(1000.0, 20.0, 0.4),
        Tissue.LEAFLET: Relaxation(1000.0, 25.0, 0.6),
        Tissue.LUNG: Relaxation(1200.0, 40.0, 0.17),
        Tissue.GAS: Relaxation(1000.0, 40.0, 0.0),
        Tissue.AIR: Relaxation(1000.0, 40.0, 0.0),
    }
    return table


RELAXATION: dict[float, dict[Tissue, Relaxation]] = {
    1.5: _table(
        blood=(1441.0, 290.0),
        heart=(1030.0, 40.0),
        flesh=(1008.0, 44.0),
        liver=(576.0, 46.0),
        fat=(343.0, 58.0),
        marrow=(549.0, 49.0),
        spleen=(1057.0, 79.0),
    ),
    3.0: _table(
        blood=(1932.0, 275.0),
        heart=(1471.0, 47.0),
        flesh=(1412.0, 50.0),
        liver=(812.0, 42.0),
        fat=(382.0, 68.0),
        marrow=(586.0, 49.0),
        spleen=(1328.0, 61.0),
    ),
}
"""Field strength (T) -> T1 (ms), T2 (ms) and relative proton density of every tissue.

Blood, heart, skeletal muscle and liver: Stanisz et al., Magn. Reson. Med. 54:507-512 (2005).
Fat, bone marrow and spleen: de Bazelaire et al., Radiology 230:652-659 (2004). The heart's T1 by
mapping in people is shorter at 3 T (1159 ms, T2 45 ms in mid-ventricle: von Knobelsdorff-
Brenkenhoff et al., J. Cardiovasc. Magn. Reson. 15:53, 2013); such maps underestimate it.
Scar, densities, and every other tissue are set by eye: they only have to look right.
"""


def relaxation_table(field_strength_t: float) -> tuple[Float, Float, Float]:
    """T1 (ms), T2 (ms) and density of every tissue at 1.5 or 3 T, indexed by tissue value."""
    known = RELAXATION[field_strength_t]
    t1, t2, density = np.array([known[tissue] for tissue in Tissue]).T
    return t1, t2, density


def chemical_shift_hz(field_strength_t: float) -> Float:
    """Frequency of every tissue against water, indexed by tissue value."""
    shift = np.zeros(len(Tissue))
    shift[list(FATTY)] = FAT_SHIFT_PPM * 1e-6 * PROTON_HZ_PER_T * field_strength_t
    return shift


def steady_state(
    t1_ms: Float, t2_ms: Float, precession: Float, angle: float, repetition_ms: float
) -> Complex:
    """Transverse magnetisation at TE = TR / 2 for M0 = 1 and pulses of alternating sign.

    Closed solution of Freeman and Hill, J. Magn. Reson. 4:366-383 (1971), as written by
    Hargreaves, J. Magn. Reson. Imaging 36:1300-1313 (2012), in the frame that turns with the
    pulses' sign; real on resonance.

    Parameters
    ----------
    t1_ms, t2_ms, precession
        Arrays of one shape; ``precession`` is the free turn within one TR (radians).
    angle
        Flip angle (radians).
    repetition_ms
        TR.
    """
    e1, e2 = np.exp(-repetition_ms / t1_ms), np.exp(-repetition_ms / t2_ms)
    turn = precession + math.pi
    c, cosine = math.cos(angle), np.cos(turn)
    below = (1 - e1 * c) * (1 - e2 * cosine) - e2 * (e1 - c) * (e2 - cosine)
    after_pulse = (1 - e1) * math.sin(angle) * (1 - e2 * np.exp(-1j * turn)) / below
    halfway = np.exp(-repetition_ms / 2 / t2_ms + 0.5j * precession)
    return np.asarray(after_pulse * halfway)


def steady_state_signal(settings: MrSettings, off_resonance_hz: npt.ArrayLike = 0.0) -> Complex:
    """Complex signal of every tissue: ``(tissue value, *shape of off_resonance_hz)``.

    ``off_resonance_hz`` is the field's error; fat's chemical shift comes on top of it.
    """
    offset = np.asarray(off_resonance_hz, dtype=float)
    t1, t2, density = (
        values.reshape(-1, *[1] * offset.ndim)
        for values in relaxation_table(settings.field_strength_t)
    )
    shift = chemical_shift_hz(settings.field_strength_t).reshape(t1.shape)
    turn = 2 * math.pi * (shift + offset) * settings.repetition_ms / 1000
    angle = math.radians(settings.flip_angle_deg)
    signal = steady_state(t1 + 0 * turn, t2 + 0 * turn, turn, angle, settings.repetition_ms)
    return np.asarray(density * signal)


class Freshness(NamedTuple):
    """How blood that just entered the slice differs from blood that stayed."""

    gain: float
    """Signal of fresh blood over that of blood in the steady state."""
    memory_s: float
    """Time in which the difference decays to 1 / e under the pulses."""


def fresh_blood(settings: MrSettings) -> Freshness:
    """Transient of blood that enters at thermal equilibrium, on resonance.

    With alternating pulses, the part of the magnetisation along the steady state's direction
    (half the flip angle off the field) decays as ``(E1 cos^2(a/2) + E2 sin^2(a/2))^n`` from
    ``M0 sin(a) / 2``; the rest oscillates and averages out (Scheffler, Magn. Reson. Med.
    49:781-783, 2003; Markl et al., Magn. Reson. Med. 50:892-903, 2003 for flow).
    """
    t1, t2, density = RELAXATION[settings.field_strength_t][Tissue.LV_CAVITY]
    half = math.radians(settings.flip_angle_deg) / 2
    tr = settings.repetition_ms
    e1, e2 = math.exp(-tr / t1), math.exp(-tr / t2)
    decay = e1 * math.cos(half) ** 2 + e2 * math.sin(half) ** 2
    first = density * math.sin(2 * half) / 2 * math.exp(-tr / 2 / t2)
    steady = float(abs(steady_state_signal(settings)[Tissue.LV_CAVITY]))
    return Freshness(first / steady, -tr / 1000 / math.log(decay))
