"""How far each motion has gone at each instant of the cycle."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from data_synth.kernels import Beat, Shape
from data_synth.motion import contraction_share, descent
from data_synth.profiles import endocardium

Knots = tuple[tuple[float, float], ...]

VENTRICLE: Knots = (
    *((0.0, 0.0), (0.05, 0.04), (0.15, 0.42), (0.26, 0.85), (0.36, 1.0), (0.41, 0.97)),
    *((0.5, 0.5), (0.58, 0.25), (0.72, 0.2), (0.82, 0.18), (0.93, 0.0)),
)
TWIST: Knots = (
    *((0.0, 0.0), (0.04, -0.08), (0.15, 0.5), (0.34, 1.0), (0.42, 0.7), (0.5, 0.25)),
    (0.7, 0.05),
)
ATRIUM: Knots = (
    *((0.0, 0.0), (0.15, 0.45), (0.28, 0.85), (0.39, 1.0), (0.5, 0.55), (0.6, 0.4)),
    *((0.8, 0.42), (0.95, 0.0)),
)
"""Knots (phase, share) of contraction, twist and atrial filling for end-systole at 0.36.

The shapes follow volume curves as drawn in textbooks of physiology: ejection, rapid filling,
rest, and the atrial contraction before the next beat.
"""
NOMINAL_END_SYSTOLE = 0.36


class Pulse(NamedTuple):
    """Largest motions of one heart, reached at end-systole; see Beat for the units."""

    lv_ejection: float = 0.6
    """Share of the left ventricle's volume ejected."""
    rv: float = 0.72
    descent_lv: float = 13.0
    descent_rv: float = 19.0
    twist_apex: float = -0.16
    twist_base: float = 0.07
    la: float = 0.17
    ra: float = 0.13
    end_systole: float = 0.36
    """Phase of the smallest ventricular volume."""
    kick: float = 0.18
    """Share of the filling that the atrial contraction brings."""


def _curve(knots: Knots) -> PchipInterpolator:
    """Periodic interpolation that never overshoots, with a continuous slope."""
    place, share = np.array(knots).T
    return PchipInterpolator(
        np.concatenate([place - 1, place, place + 1]), np.concatenate([share, share, share])
    )


@lru_cache(maxsize=64)
def _curves(kick: float) -> tuple[PchipInterpolator, PchipInterpolator, PchipInterpolator]:
    scale = kick / 0.18
    late = tuple((p, v * scale if 0.7 < p < 0.9 else v) for p, v in VENTRICLE)
    return _curve(late), _curve(TWIST), _curve(ATRIUM)


def nominal_phase(phase: float, end_systole: float) -> float:
    """Phase of the nominal curves: systole is stretched or shrunk, diastole fills the rest.

    A smooth monotone warp of the circle whose slope has no step.

    >>> round(nominal_phase(0.40, 0.40), 6)
    0.36
    """
    phase %= 1.0
    place = np.array([0.0, end_systole])
    nominal = np.array([0.0, NOMINAL_END_SYSTOLE])
    warp = PchipInterpolator(
        np.concatenate([place - 1, place, place + 1, place + 2]),
        np.concatenate([nominal - 1, nominal, nominal + 1, nominal + 2]),
    )
    return float(warp(phase)) % 1.0


def radial_loss(shape: Shape, pulse: Pulse) -> float:
    """Radial contraction that, with the descent, ejects the wanted share of the cavity.

    Integrates the squared cavity radius before and after over the long axis; the radial map turns
    ``s`` into ``s * slope - loss * knot`` there, linear in the loss.
    """
    heights = np.linspace(-shape.lv_length, 0, 400)
    before = gain = loss = 0.0
    for z in heights:
        squared = endocardium(z, shape)[0]
        share = contraction_share(z)
        stretch = 1 - pulse.descent_lv * descent(z, shape)[1]
        slope = 1 + (1 / stretch - 1) * share
        before += squared
        gain += squared * slope * stretch
        loss += squared * share * stretch
    return (gain - (1 - pulse.lv_ejection) * before) / loss


def beat_at(pulse: Pulse, lv_loss: float, phase: float) -> Beat:
    """Motion at a phase (any real number, cycle 1); ``lv_loss`` comes from radial_loss."""
    place = nominal_phase(phase, pulse.end_systole)
    ventricle, twist, atrium = (float(curve(place)) for curve in _curves(pulse.kick))
    return Beat(
        lv=lv_loss * ventricle,
        rv=pulse.rv * ventricle,
        descent_lv=pulse.descent_lv * ventricle,
        descent_rv=pulse.descent_rv * ventricle,
        twist_apex=pulse.twist_apex * twist,
        twist_base=pulse.twist_base * twist,
        la=pulse.la * atrium,
        ra=pulse.ra * atrium,
    )
