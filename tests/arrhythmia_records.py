"""Two-lead Holter records with beats, rhythms and faults that R-peak detectors fail on.

Written for tests alone, apart from the phantom's electrocardiogram: every beat is a sum of Gaussian
waves, drawn at times that a rhythm gives. Sizes and widths lie within what cardiology texts call
usual for each condition; no measured record stands behind any of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.geometry import Float

# Waves of a beat: seconds from R, standard deviation (s), height in the first and second lead (mV).
Waves = tuple[tuple[float, float, float, float], ...]

P = ((-0.16, 0.020, 0.12, 0.06),)
QRS: Waves = (
    (-0.022, 0.007, -0.10, 0.20),
    (0.0, 0.010, 1.10, 0.25),
    (0.024, 0.010, -0.25, -0.80),
)
T: Waves = ((0.28, 0.050, 0.25, 0.15),)
# From a ventricle: 150 ms wide, against the usual direction, its T the other way.
WIDE: Waves = ((0.0, 0.030, -1.40, 1.20), (0.045, 0.025, -0.60, 0.70), (0.30, 0.065, 0.60, -0.50))
# Its T wave has two thirds of its energy.
WIDE_TALL_T: Waves = (
    (-0.015, 0.030, -1.30, 1.10),
    (0.05, 0.020, -0.50, 0.35),
    (0.28, 0.042, 1.10, -0.94),
)
WIDE_ON_T: Waves = (
    (-0.015, 0.030, -1.30, 1.10),
    (0.05, 0.020, -0.50, 0.35),
    (0.28, 0.060, 0.70, -0.60),
)
# An escape beat of the ventricle, whose rise is slower than an atrial wave's.
ESCAPE: Waves = (
    (-0.02, 0.022, 0.75, -0.40),
    (0.03, 0.022, 0.90, -0.80),
    (0.35, 0.060, -0.40, 0.40),
)
PACED: Waves = ((-0.045, 0.0012, 1.50, -1.00), *WIDE)
# Two summits 50 ms apart, as in bundle branch block.
NOTCHED: Waves = (
    *P,
    (-0.005, 0.014, 0.90, -0.60),
    (0.045, 0.016, 0.85, -0.70),
    (0.31, 0.055, -0.35, 0.30),
)
NORMAL: Waves = (*P, *QRS, *T)
TALL_T: Waves = (*P, *QRS, (0.27, 0.042, 1.20, 0.70))
TALL_P: Waves = ((-0.16, 0.022, 0.35, 0.20), *QRS, *T)
# QRS complexes as small as a lead along the heart's plane of turning shows them, T all but flat.
WEAK: Waves = (
    (-0.19, 0.017, 0.16, 0.14),
    *((at, 1.3 * width, 0.3 * one, 0.3 * two) for at, width, one, two in QRS),
    (0.28, 0.050, 0.05, 0.03),
)
# First-degree block: P waves more than a quarter of a second ahead of low beats.
LONG_PR: Waves = (
    (-0.28, 0.025, 0.26, 0.18),
    (0.0, 0.013, 0.55, -0.35),
    (0.035, 0.014, -0.25, 0.10),
    (0.32, 0.055, 0.12, 0.08),
)
# T waves of wide beats are large and, in a slow heart, late.
SLOW_WIDE: Waves = (*WIDE[:2], (0.41, 0.055, 0.90, -0.80))
LONE_P: Waves = ((-0.16, 0.022, 0.35, 0.20),)
# A tall beat that is narrow, and one of a ventricle beside which it is not.
TALL: Waves = (
    *P,
    (0.0, 0.0135, 1.50, 1.07),
    (0.034, 0.012, -1.00, -0.60),
    (0.28, 0.05, 0.05, 0.10),
)
WIDER: Waves = ((0.0, 0.031, -1.56, -2.05), (0.075, 0.035, -0.78, -1.02), (0.36, 0.06, 0.78, 1.02))
LOW: Waves = (
    (-0.16, 0.022, 0.085, 0.034),
    (0.0, 0.011, 0.425, 0.21),
    (0.028, 0.010, -0.085, -0.17),
    (0.30, 0.045, 0.085, 0.085),
)
TOWERING: Waves = ((0.0, 0.030, 2.0, 1.6), (0.075, 0.035, -1.0, -0.8), (0.36, 0.060, -0.8, -0.64))


@dataclass(frozen=True, slots=True)
class Record:
    """A record and where its beats are."""

    signal_mv: Float
    rate_hz: float
    r_times_s: Float


def scaled(waves: Waves, size: float) -> Waves:
    """The same beat, larger."""
    return tuple((at, width, size * one, size * two) for at, width, one, two in waves)


def steady(rng: np.random.Generator, duration_s: float, rr_s: float, share: float = 0.03) -> Float:
    """R times of a regular rhythm whose intervals scatter by a share."""
    count = int(1.5 * duration_s / rr_s) + 5
    return 0.4 + np.cumsum(rr_s * np.maximum(1 + share * rng.normal(size=count), 0.35))


def draw(
    rng: np.random.Generator,
    times_s: Float,
    beats: list[tuple[float, Waves]],
    noise_mv: float = 0.03,
    wander_mv: float = 0.15,
) -> Float:
    """``(n, 2)`` millivolts: the beats, each a little unlike the others, noise and wander."""
    signal = np.zeros((len(times_s), 2))
    for at_s, waves in beats:
        size = 1 + 0.05 * rng.normal()
        for offset_s, width_s, *heights in waves:
            near = slice(
                *np.searchsorted(
                    times_s, (at_s + offset_s - 6 * width_s, at_s + offset_s + 6 * width_s)
                )
            )
            bell = np.exp(-0.5 * ((times_s[near] - at_s - offset_s) / width_s) ** 2)
            signal[near] += size * bell[:, None] * np.array(heights)
    signal += noise_mv * rng.normal(size=signal.shape)
    for lead in range(2):
        for hz in (0.07, 0.21, 0.33):
            signal[:, lead] += wander_mv * np.sin(2 * np.pi * (hz * times_s + rng.uniform()))
    return signal


def _mixed(
    rng, duration_s, times_s, usual=NORMAL, early=WIDE, share=0.12, rr_s=0.85, ahead=(0.5, 0.65)
):
    """Beats of one kind, some replaced by early ones with a pause behind them."""
    beats, at_s = [], 0.4
    while at_s < duration_s:
        beats.append((at_s, usual))
        if rng.random() < share:
            ahead_s = rr_s * rng.uniform(*ahead)
            beats.append((at_s + ahead_s, early))
            at_s += rr_s * 2
        else:
            at_s += rr_s * (1 + 0.03 * rng.normal())
    return beats, draw(rng, times_s, beats)


def _plain(rng, duration_s, times_s, waves=NORMAL, rr_s=0.8, scatter=0.03, **kw):
    beats = [(at_s, waves) for at_s in steady(rng, duration_s, rr_s, scatter)]
    return beats, draw(rng, times_s, beats, **kw)


def _alternating(rng, duration_s, times_s, one, other, early_share, pair_s=1.7):
    beats, at_s = [], 0.4
    while at_s < duration_s:
        beats += [(at_s, one), (at_s + early_share * pair_s, other)]
        at_s += pair_s * (1 + 0.02 * rng.normal())
    return beats, draw(rng, times_s, beats)


def _runs(rng, duration_s, times_s):
    """Runs of wide beats at 170 a minute between normal ones."""
    beats, at_s = [], 0.4
    while at_s < duration_s:
        for _ in range(12):
            beats.append((at_s, NORMAL))
            at_s += 0.8
        for _ in range(int(rng.integers(4, 14))):
            beats.append((at_s, WIDE))
            at_s += 0.35 * (1 + 0.02 * rng.normal())
        at_s += 0.6
    return beats, draw(rng, times_s, beats)


def _fibrillation(rng, duration_s, times_s):
    rr_s = np.clip(rng.gamma(10, 0.068, size=int(3 * duration_s)), 0.32, 1.8)
    beats = [(at_s, (*QRS, *T)) for at_s in 0.4 + np.cumsum(rr_s)]
    signal = draw(rng, times_s, beats)
    turns = np.cumsum(6.2 + 0.6 * np.sin(2 * np.pi * 0.4 * times_s)) * (times_s[1] - times_s[0])
    signal += sum(np.sin(2 * np.pi * k * turns) / k for k in (1, 2, 3))[:, None] * [0.08, 0.12]
    return beats, signal


def _fast_fibrillation(rng, duration_s, times_s):
    """Beats of any size, often sooner than the last one's T wave is over."""
    rr_s = np.clip(rng.gamma(9, 0.047, size=int(4 * duration_s)), 0.29, 1.5)
    sizes = rng.uniform(0.4, 1.25, len(rr_s))
    beats = [
        (at_s, scaled((*QRS, *T), size))
        for at_s, size in zip(0.4 + np.cumsum(rr_s), sizes, strict=True)
    ]
    return beats, draw(rng, times_s, beats)


def _complete_block(rng, duration_s, times_s, atrial=LONE_P, own=(*QRS, *T)):
    """Atria and ventricles each keep their own time, the ventricles slowly."""
    atrial = [(at_s, atrial) for at_s in steady(rng, duration_s, 0.72, 0.02)]
    beats = [(at_s + 0.5, own) for at_s in steady(rng, duration_s, 1.6, 0.02)]
    return beats, draw(rng, times_s, sorted(atrial + beats), noise_mv=0.015)


def _blocked(rng, duration_s, times_s):
    """Every third atrial wave reaches no ventricle, and every now and then none for 4 s."""
    beats, truth, at_s, count = [], [], 0.4, 0
    while at_s < duration_s:
        arrest = rng.random() < 0.02
        conducted = count % 3 != 2 and not arrest
        beats.append((at_s, TALL_P if conducted else LONE_P))
        if conducted:
            truth.append((at_s, TALL_P))
        at_s += 4.0 if arrest else 0.75
        count += 1
    return truth, draw(rng, times_s, beats)


def _gain(rng, duration_s, times_s):
    """The gain steps up threefold and down to a third, and drifts."""
    beats, signal = _plain(rng, duration_s, times_s)
    steps = np.select([times_s < 0.3 * duration_s, times_s < 0.6 * duration_s], [1.0, 3.0], 0.5) * (
        1 + 0.3 * np.sin(2 * np.pi * times_s / 37)
    )
    return beats, signal * steps[:, None]


def _one_bad(rng, duration_s, times_s, lead=0):
    """One lead shows nothing but strong noise with tugs; the other is good."""
    beats, signal = _mixed(rng, duration_s, times_s)
    bad = 0.6 * rng.normal(size=len(times_s))
    for at_s in rng.uniform(0, duration_s, int(duration_s / 4)):
        bad += rng.normal() * 2 * np.exp(-np.clip(times_s - at_s, 0, None) / 0.2) * (times_s > at_s)
    signal[:, lead] = bad
    return beats, signal


def _bursts(rng, duration_s, times_s):
    """Muscle noise as strong as the beats for a second now and then, in either lead in turn."""
    beats, signal = _plain(rng, duration_s, times_s)
    white = rng.normal(size=signal.shape)
    for number, at_s in enumerate(np.arange(8.0, duration_s - 2, 9.0)):
        near = (times_s > at_s) & (times_s < at_s + 1.5)
        signal[near, number % 2] += 0.5 * white[near, number % 2]
    return beats, signal


def _waxing(rng, duration_s, times_s):
    """Beats that swing between a third and full height within five seconds."""
    beats = [
        (at_s, scaled(NORMAL, 0.65 + 0.35 * np.sin(2 * np.pi * at_s / 5)))
        for at_s in steady(rng, duration_s, 0.8)
    ]
    return beats, draw(rng, times_s, beats)


CASES = {
    "normal": _plain,
    "tall T": partial(_plain, waves=TALL_T),
    "tall T, slow": partial(_plain, waves=TALL_T, rr_s=1.5),
    "small beats": partial(_plain, waves=scaled(NORMAL, 0.25)),
    "fast": partial(_plain, waves=(*QRS, (0.19, 0.04, 0.2, 0.12)), rr_s=0.30, scatter=0.01),
    "slow": partial(_plain, rr_s=1.9, scatter=0.1),
    "bundle branch block": partial(_plain, waves=NOTCHED),
    "paced": partial(_plain, waves=PACED, rr_s=0.9, scatter=0.005),
    "ventricular premature": _mixed,
    "large ventricular premature": partial(_mixed, early=scaled(WIDE, 2.0)),
    "small ventricular premature": partial(_mixed, early=scaled(WIDE, 0.45)),
    "ventricular premature, tall T": partial(_mixed, early=WIDE_TALL_T),
    "ventricular on the T wave": partial(_mixed, early=WIDE_ON_T, ahead=(0.4, 0.47)),
    "ventricular at the end of the T wave": partial(
        _mixed, usual=TALL, early=WIDER, share=0.3, rr_s=0.71, ahead=(0.52, 0.56)
    ),
    "low among towering": partial(
        _mixed, usual=LOW, early=TOWERING, share=0.3, rr_s=0.83, ahead=(0.5, 0.55)
    ),
    "atrial premature": partial(_mixed, early=(*P, *QRS, *T)),
    "paced and own": partial(_mixed, usual=PACED, early=(*P, *QRS, *T), share=0.3),
    "bigeminy": partial(_alternating, one=NORMAL, other=WIDE, early_share=0.33),
    "bigeminy, large": partial(
        _alternating, one=scaled(NORMAL, 0.6), other=scaled(WIDE, 1.6), early_share=0.35
    ),
    # No pause is so long that a beat seems overdue.
    "bigeminy, small": partial(
        _alternating, one=NORMAL, other=scaled(WIDE, 0.45), early_share=0.4, pair_s=1.2
    ),
    "alternans": partial(_alternating, one=NORMAL, other=scaled(NORMAL, 0.5), early_share=0.5),
    "runs": _runs,
    "fibrillation": _fibrillation,
    "fast fibrillation": _fast_fibrillation,
    "blocked": _blocked,
    "complete block": _complete_block,
    "complete block, wide": partial(
        _complete_block, atrial=((-0.16, 0.020, 0.22, 0.12),), own=ESCAPE
    ),
    "long PR, tall P": partial(_plain, waves=LONG_PR, rr_s=1.05, scatter=0.06, noise_mv=0.02),
    "gain": _gain,
    "first lead bad": _one_bad,
    "second lead bad": partial(_one_bad, lead=1),
    "bursts": _bursts,
    "waxing": _waxing,
    "weak beats, tall P": partial(_plain, waves=WEAK, rr_s=0.95, scatter=0.08, noise_mv=0.02),
    "wide beats in a slow heart": partial(
        _alternating, one=scaled(NORMAL, 0.6), other=SLOW_WIDE, early_share=0.3
    ),
}


def record(case: str, seed: int, duration_s: float = 120.0, rate_hz: float = 360.0) -> Record:
    """One drawn record, quantised as Holter recorders do (5 microvolts a step)."""
    rng = np.random.default_rng([seed, *case.encode()])
    times_s = np.arange(round(duration_s * rate_hz)) / rate_hz
    beats, signal = CASES[case](rng, duration_s, times_s)
    r_times_s = np.array([at_s for at_s, _ in beats if at_s < duration_s - 0.05])
    return Record(np.round(signal / 0.005) * 0.005, rate_hz, r_times_s)


def matched(found_s: Float, truth_s: Float, window_s: float = 0.15) -> Float:
    """For each true beat the found one (these in order) that stands for it, or -1: one to one,
    nearest first."""
    pairs, taken = np.full(len(truth_s), -1), np.zeros(len(found_s), dtype=bool)
    near = [
        (abs(found_s[j] - one_s), i, j)
        for i, one_s in enumerate(truth_s)
        for j in range(*np.searchsorted(found_s, (one_s - window_s, one_s + window_s)))
    ]
    for _, i, j in sorted(near):
        if pairs[i] < 0 and not taken[j]:
            pairs[i], taken[j] = j, True
    return pairs
