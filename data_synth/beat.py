"""How far each motion has gone at each instant of the cycle."""

from __future__ import annotations

import cmath
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from data_synth.anatomy import BOX_MM, label_points
from data_synth.errors import SynthError
from data_synth.kernels import Float, Shape
from data_synth.meshes import tubes_of
from data_synth.motion import (
    Beat,
    contracting,
    infarct_around,
    infarct_share,
    muscle_slope,
    muscle_stretch,
    volume_ratios,
)
from data_synth.primitives import smooth_step
from data_synth.profiles import endocardium, is_round, unevenness
from data_synth.tissue import TRUTH_LABELS, truth_values

Steps = tuple[tuple[float, float, float, float], ...]

END_SYSTOLE = 0.435
KICK_ONSET = 0.85
"""Phases of least ventricular volume and of atrial contraction in the curves below: about those of
a heart at 75 beats a minute, for which the functions below give 0.442 and 0.85."""

EJECTION: Steps = ((0.05, END_SYSTOLE, 1.0, 0.3),)
FILLING: Steps = ((0.52, 0.76, 0.9, 0.3), (0.62, KICK_ONSET, 0.1, 0.0))
KICK: Steps = ((KICK_ONSET, 0.985, 1.0, 0.0),)
"""Left and right ventricle: isovolumic contraction, ejection, isovolumic relaxation, rapid
filling, rest with slow filling, atrial contraction. At 75 beats a minute a hundredth is ejected
66 ms after the R peak; the pre-ejection period of Weissler et al. (131 - 0.4 HR ms), less the time
from Q to R, gives 61 ms for the opening of the valve."""
RESERVOIR: Steps = ((0.02, 0.48, 1.0, 0.2),)
CONDUIT: Steps = ((0.51, 0.76, 1.0, 0.3),)
TWIST: Steps = (
    *((0.0, 0.05, -0.08, 0.0), (0.04, 0.42, 1.08, 0.2)),
    *((0.43, 0.54, -0.65, 0.0), (0.52, 0.74, -0.35, 0.3)),
)
"""Steps (start, end, amount, skew) in phase of the nominal cycle.

A curve is the sum of its steps, each a quintic with two continuous derivatives, so that curves
have no corner, never overshoot, and close exactly, because their steps sum to nothing over the
cycle. Skew is how much earlier than half-way a step is steepest.
"""
RELEASED = 0.6
"""Share of an atrium's growth given back before its own contraction."""

PLACES = (
    *(0.0, 0.13, 0.17, 0.21, 0.25, 0.29, 0.33, 0.37, 0.455, 0.48, 0.505),
    *(0.57, 0.6, 0.635, 0.665, 0.7, 0.73, 0.92),
)
"""Places in the nominal cycle, one of which every instant resembles: contraction, atrial growth and
twist all differ by less than an eighth of their range."""

R_AFTER_Q_S = 0.04
"""Time from the onset of the QRS complex to its R peak."""
SLOWEST_BPM, FASTEST_BPM = 45.0, 120.0
"""Heart rates between which the regressions of systole are used."""
KICK_S = 0.12
"""Time from the onset of atrial contraction to the R peak."""
LARGEST_LOSS = 0.82
"""Largest share of a left-ventricular cross-section that contraction can empty."""
LARGEST_GROWTH = 0.75
"""Largest growth of an atrium's width, below that of its support."""
SAMPLE_MM = 4.0
"""Spacing of the points over which chamber volumes are summed."""


class Pulse(NamedTuple):
    """Largest motions of one heart, reached at end-systole; see Beat for the units."""

    lv_ejection: float = 0.6
    """Share of the left ventricle's volume ejected, as far as it can be reached."""
    rv: float = 0.72
    """Share of the right ventricle's cross-section lost, unless ``rv_ejection`` is given."""
    descent_lv: float = 13.0
    descent_rv: float = 19.0
    twist_apex: float = -0.16
    twist_base: float = 0.07
    la: float = 0.17
    """Growth of the left atrium's width, unless ``la_emptying`` is given."""
    ra: float = 0.13
    end_systole: float = END_SYSTOLE
    """Phase of the smallest ventricular volume."""
    kick: float = 0.18
    """Share of the filling that the atrial contraction brings."""
    kick_onset: float = KICK_ONSET
    """Phase at which the atria start to contract."""
    rv_ejection: float | None = None
    """Share of the right ventricle's volume ejected."""
    la_emptying: float | None = None
    """Share of the left atrium's largest volume that it loses until the R peak."""
    ra_emptying: float | None = None
    infarct_angle: float = 0.0
    """Middle of the segment that does not contract, about the long axis from +x towards +y."""
    infarct_half_angle: float = 0.8
    infarct_height: float = 0.55
    """Its height below the mitral plane, as a share of the left cavity's length."""
    infarct_half_height: float = 0.3
    infarct_strength: float = 0.0
    """Share of contraction missing there: 0 none, 1 akinetic."""


def check_pulse(pulse: Pulse) -> None:
    """Refuse motions that no heart can make.

    Raises
    ------
    SynthError
        When a share, a phase or the size of the infarct lies outside of its range.
    """
    limits = {
        "lv_ejection": (0.0, 0.9), "rv": (0.0, 0.97), "rv_ejection": (0.0, 0.9),
        "la_emptying": (0.0, 0.9), "ra_emptying": (0.0, 0.9), "descent_lv": (0.0, 25.0),
        "descent_rv": (0.0, 35.0), "la": (0.0, LARGEST_GROWTH), "ra": (0.0, LARGEST_GROWTH),
        "end_systole": (0.1, 0.65), "kick": (0.0, 0.6), "kick_onset": (0.7, 0.98),
        "infarct_half_angle": (0.05, math.pi / 1.3), "infarct_height": (0.0, 0.9),
        "infarct_half_height": (0.05, 1.0), "infarct_strength": (0.0, 1.0),
    }  # fmt: skip
    for name, (low, high) in limits.items():
        value = getattr(pulse, name)
        if value is not None and not low <= value <= high:
            raise SynthError(f"pulse: {name} is {value}; give a number from {low:g} to {high:g}")


class Amounts(NamedTuple):
    """Motions that give the ejection asked of them, at end-systole; units of Beat."""

    lv: float
    rv: float
    la: float
    ra: float


def systole_s(rr_s: float) -> float:
    """Time from the R peak to the closure of the aortic valve at an RR interval.

    Electromechanical systole QS2 = 546 - 2.1 HR ms in men, 549 - 2.0 HR ms in women (Weissler,
    Harris and Schoenfeld, Circulation 37:149-159, 1968); the mean of both, less the time from Q to
    the R peak. Slower than SLOWEST_BPM its length is held, faster than FASTEST_BPM its share of
    the beat, for the regressions come from rates at rest.

    >>> round(systole_s(0.8), 4)
    0.3537
    """
    rate = min(max(60 / rr_s, SLOWEST_BPM), FASTEST_BPM)
    length = 0.5475 - 0.00205 * rate - R_AFTER_Q_S
    return length * min(1.0, rr_s * FASTEST_BPM / 60)


def end_systole_phase(heart_rate_bpm: float) -> float:
    """Phase of end-systole at a heart rate, from :func:`systole_s`.

    >>> round(end_systole_phase(75), 3)
    0.442
    """
    rr_s = _rr_s(heart_rate_bpm)
    return systole_s(rr_s) / rr_s


def kick_onset_phase(heart_rate_bpm: float) -> float:
    """Phase at which the atria start to contract: KICK_S before the next R peak.

    At rates above FASTEST_BPM its share of the beat is held.

    >>> kick_onset_phase(75)
    0.85
    """
    return 1 - KICK_S / max(_rr_s(heart_rate_bpm), 60 / FASTEST_BPM)


def _rr_s(heart_rate_bpm: float) -> float:
    if not (math.isfinite(heart_rate_bpm) and heart_rate_bpm > 0):
        raise SynthError(
            f"heart rate is {heart_rate_bpm}; give a positive number of beats a minute"
        )
    return 60 / heart_rate_bpm


def warp_phase(
    phase: float, source: tuple[float, float, float], target: tuple[float, float, float]
) -> float:
    """Map the circle of phases onto itself so that three phases land on three others.

    The Moebius map of the unit circle through three points: analytic, monotone, cyclic, and the
    identity when the points rest. Both triples run forwards.

    >>> round(warp_phase(0.3, (0.0, 0.3, 0.9), (0.0, 0.43, 0.85)), 12)
    0.43
    """
    if source == target:
        return phase % 1.0
    z, a, b, c = (cmath.exp(2j * math.pi * p) for p in (phase, *source))
    u, v, w = (cmath.exp(2j * math.pi * p) for p in target)
    # Cross-ratios agree: (z-a)(b-c) / ((z-c)(b-a)) = (y-u)(v-w) / ((y-w)(v-u)), solved for y.
    top, bottom = (z - a) * (b - c) * (v - u), (z - c) * (b - a) * (v - w)
    moved = (w * top - u * bottom) / (top - bottom)
    # Rounding can leave a phase just below 0, whose remainder rounds to 1.
    return cmath.phase(moved) / (2 * math.pi) % 1.0 % 1.0


def step_sum(steps: Steps, phase: float) -> float:
    """Sum of smooth steps at a phase in [0, 1)."""
    total = 0.0
    for start, end, amount, skew in steps:
        t = min(max((phase - start) / (end - start), 0.0), 1.0)
        total += amount * smooth_step(t + skew * t * (1 - t))
    return total


def contraction(phase: float, kick: float) -> float:
    """Share of the stroke volume ejected and not yet refilled, at a nominal phase."""
    filled = (1 - kick) * step_sum(FILLING, phase) + kick * step_sum(KICK, phase)
    return step_sum(EJECTION, phase) - filled


def atrial_filling(phase: float) -> float:
    """Share of an atrium's own growth, at a nominal phase."""
    released = RELEASED * step_sum(CONDUIT, phase) + (1 - RELEASED) * step_sum(KICK, phase)
    return step_sum(RESERVOIR, phase) - released


def beat_at(shape: Shape, pulse: Pulse, amounts: Amounts, phase: float) -> Beat:
    """Motion at a phase (any real number, cycle 1); ``amounts`` come from :func:`calibrate`."""
    source = (0.0, pulse.end_systole, pulse.kick_onset)
    place = warp_phase(phase, source, (0.0, END_SYSTOLE, KICK_ONSET))
    return beat_of(shape, pulse, amounts, place)


def beat_of(shape: Shape, pulse: Pulse, amounts: Amounts, place: float) -> Beat:
    """Motion at a place in [0, 1) of the nominal cycle, in which the curves are given."""
    ventricle, twist = contraction(place, pulse.kick), step_sum(TWIST, place)
    return _beat(shape, pulse, amounts, ventricle, twist, atrial_filling(place))


def _beat(
    shape: Shape, pulse: Pulse, amounts: Amounts, ventricle: float, twist: float, atrium: float
) -> Beat:
    # A cavity's length and cross-section shrink together. Dividing by the length there is at this
    # instant makes volume, their product, follow the curve.
    full = 1 - pulse.descent_lv / shape.lv_length
    share = ventricle * full / (1 - ventricle * pulse.descent_lv / shape.lv_length)
    return Beat(
        lv=amounts.lv * share,
        rv=amounts.rv * share,
        descent_lv=pulse.descent_lv * ventricle,
        descent_rv=pulse.descent_rv * ventricle,
        twist_apex=pulse.twist_apex * twist,
        twist_base=pulse.twist_base * twist,
        la=amounts.la * atrium,
        ra=amounts.ra * atrium,
        infarct_angle=pulse.infarct_angle,
        infarct_half_angle=pulse.infarct_half_angle,
        infarct_height=pulse.infarct_height,
        infarct_half_height=pulse.infarct_half_height,
        infarct_strength=pulse.infarct_strength,
    )


@lru_cache(maxsize=16)
def calibrate(shape: Shape, pulse: Pulse) -> Amounts:
    """Motions that give the ejection fractions and emptyings that ``pulse`` asks for.

    The left ventricle's is a closed integral; the others are found by bisection, their volumes
    summed over points of the chamber with the map's own Jacobian determinant. A share beyond what
    the chamber can do gives the most that it can.
    """
    amounts = Amounts(radial_loss(shape, pulse), pulse.rv, pulse.la, pulse.ra)
    asked = {
        "rv": ("rv_cavity", pulse.rv_ejection, 0.97),
        "la": ("left_atrium", pulse.la_emptying, LARGEST_GROWTH),
        "ra": ("right_atrium", pulse.ra_emptying, LARGEST_GROWTH),
    }
    asked = {name: job for name, job in asked.items() if job[1] is not None}
    if not asked:
        return amounts
    chambers = _chamber_points(shape)
    # The atria press on each other, so each is set anew once after the other.
    for _ in range(2):
        for name, (chamber, wanted, most) in asked.items():
            points = chambers[chamber]
            value = _solve(shape, pulse, amounts, name, points, float(wanted or 0.0), most)
            amounts = amounts._replace(**{name: value})
    return amounts


def _solve(
    shape: Shape, pulse: Pulse, amounts: Amounts, name: str, points: Float, wanted: float,
    most: float,
) -> float:  # fmt: skip
    """Amount of one motion at which its chamber's emptying is as wanted, or nearest to it."""
    from scipy.optimize import brentq

    def miss(value: float) -> float:
        beat = _beat(shape, pulse, amounts._replace(**{name: value}), 1.0, 1.0, 1.0)
        change = float(volume_ratios(points, shape, beat).mean())
        return (1 - change if name == "rv" else 1 - 1 / change) - wanted

    if miss(0.0) >= 0:
        return 0.0
    if miss(most) <= 0:
        return most
    return float(brentq(miss, 0.0, most, xtol=1e-4))


def _chamber_points(shape: Shape) -> dict[str, Float]:
    """Points of each labelled chamber on a regular grid at the R peak, heart frame."""
    axes = [np.arange(low, high, SAMPLE_MM) for low, high in BOX_MM]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = truth_values()[label_points(points, shape, tubes_of(shape))]
    return {name: points[values == value] for name, (value, _) in TRUTH_LABELS.items()}


def radial_loss(shape: Shape, pulse: Pulse) -> float:
    """Radial contraction that, with the descent, ejects the wanted share of the left cavity.

    Integrates the squared cavity radius before and after over long axis and angle; the radial map
    turns ``s`` into ``s * slope - loss * contracting`` at the wall, linear in the loss. The loss
    stays below LARGEST_LOSS, so that an infarcted heart ejects less than asked where its healthy
    muscle cannot make up for it.
    """
    full = _beat(shape, pulse, Amounts(0.0, 0.0, 0.0, 0.0), 1.0, 0.0, 0.0)
    plain = is_round(shape)
    turns = 1 if plain and not pulse.infarct_strength else 48
    angles = np.arange(turns) * 2 * math.pi / turns
    missing = [infarct_around(angle, full) for angle in angles]
    before = gain = loss = 0.0
    for z in np.linspace(-shape.lv_length, 0, 400):
        squared, closing = endocardium(z, shape)[0], contracting(z, shape)
        healthy = muscle_stretch(z, 0.0, shape, full), muscle_slope(z, 0.0, shape, full), 0.0
        for angle, around in zip(angles, missing, strict=True):
            stretch, slope, still = healthy
            if around > 0:
                stretch = muscle_stretch(z, around, shape, full)
                slope = muscle_slope(z, around, shape, full)
                still = infarct_share(z, angle, shape, full)
            uneven = 1.0 if plain else unevenness(z, angle, shape)[0] ** 2
            before += squared * uneven
            gain += squared * uneven * slope * stretch
            loss += closing * uneven * (1 - still) * stretch
    most = LARGEST_LOSS / (1 - pulse.descent_lv / shape.lv_length)
    return min((gain - (1 - pulse.lv_ejection) * before) / loss, most)
