"""Whether all slices of a cine show one heartbeat.

Each slice is put together over beats of its own. One that was gated by another wave, whose phases
were stored in another order, or that shows one image throughout, looks like any other in each
phase; but its cavity does not swing with the others'.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float, Label
from pipeline.imaging.labels import CAVITY, MUSCLE

LEAST_CAVITY, LEAST_MUSCLE = 0.2, 0.25
"""Of the largest slice's area, in each phase: what has less is near the tip or the valves, where
the ventricle's length tells as much as its width."""

FEWEST_SLICES = 3
"""Of two no one tells which is out of step."""

LEAST_SWING = 0.05
"""Of the mean area, root mean square over the beat: of what moves less noise says how it moves."""

LEAST_SHARE = 0.25
"""Of the usual swing that a slice makes with the others, the least of 28 phantoms, infarcts and
dilated hearts among them, was 0.42; of slices filled with one phase it was 0.0. A scar all around
the tip may bulge while the rest contracts: of a second renderer's such person it was -0.9."""

LEAST_LIKENESS = 0.9
"""Correlation with the usual swing: the least of those phantoms was 0.955, and 0.91 where a slice
lay far aside; a slice a tenth of a beat late has less, one in reverse order 0.85 and more."""

LEAST_APART_MM = 0.5
"""Root mean square, over the beat, of what a cavity's mean radius departs by: outlines on the
phantoms did by 0.34 mm at most, and a heart that hardly beats moves by little more."""

FEWEST_PHASES = 5
"""With fewer there is no curve to be alike or late, but a swing with the others or against them."""

LEAST_LATE = 0.05
"""Of the beat: what lies nearer beats otherwise, rather than late."""

LAGS = np.linspace(-0.5, 0.5, 100, endpoint=False)
"""Shares of the beat by which a slice may follow the others."""


def out_of_step(labels: Label, phases: Float, pixel_mm: float) -> dict[int, dict[str, float]]:
    """Slices whose left ventricle does not beat with that of the others.

    Parameters
    ----------
    labels
        ``(phase, slice, row, column)``: slices that are images of their own.
    phases
        ``(phase,)`` shares of the beat.
    pixel_mm
        Side of a pixel.

    Returns
    -------
    dict
        By slice: ``swing``, how far its area swings, in times of the usual swing (the median of
        all slices); ``in_step``, what of the usual swing it makes with the others, below 0 against
        them; and ``late``, the share of the beat by which it follows, where that tells it from the
        others.
    """
    cavity, muscle = (
        (labels == value).sum(axis=(2, 3)).astype(float) for value in (CAVITY, MUSCLE)
    )
    whole = (cavity.min(axis=0) > LEAST_CAVITY * cavity.max()) & (
        muscle.min(axis=0) > LEAST_MUSCLE * muscle.max()
    )
    numbers = np.flatnonzero(whole)
    if len(numbers) < FEWEST_SLICES:
        return {}
    areas = cavity[:, numbers]
    swings = areas / areas.mean(axis=0) - 1
    usual = np.median(swings, axis=1)
    usual -= usual.mean()
    if np.sqrt(np.mean(usual**2)) < LEAST_SWING:
        return {}
    radii_mm = pixel_mm * np.sqrt(areas.mean(axis=0) / np.pi)
    found = {}
    for number, swing, radius_mm in zip(numbers, swings.T, radii_mm, strict=True):
        share, likeness = _compared(swing, usual)
        alike = likeness >= LEAST_LIKENESS or len(phases) < FEWEST_PHASES
        away = swing - (share if share >= LEAST_SHARE else 1.0) * usual
        # An area that swings by a share swings by half of it in radius.
        apart_mm = 0.5 * radius_mm * float(np.sqrt(np.mean(away**2)))
        if (share >= LEAST_SHARE and alike) or apart_mm < LEAST_APART_MM:
            continue
        found[int(number)] = {
            "swing": round(float(np.std(swing) / np.std(usual)), 2),
            "in_step": round(share, 2),
            **_late(swing, usual, phases),
        }
    return found


def _late(swing: Float, usual: Float, phases: Float) -> dict[str, float]:
    """By which share of the beat a swing follows the usual one, if it is that one."""
    if len(phases) < FEWEST_PHASES:
        return {}
    follows = [np.interp((phases - lag) % 1, phases, usual, period=1) for lag in LAGS]
    compared = [_compared(swing, one) for one in follows]
    best = max(range(len(LAGS)), key=lambda k: compared[k][1])
    share, likeness = compared[best]
    alike = share >= LEAST_SHARE and likeness >= LEAST_LIKENESS
    late = round(float(LAGS[best]), 2)
    return {"late": late} if alike and abs(late) >= LEAST_LATE else {}


def _compared(swing: Float, usual: Float) -> tuple[float, float]:
    """What share of the usual swing one makes, and their correlation."""
    usual = usual - usual.mean()
    both = float(swing @ usual)
    lengths = float(np.linalg.norm(swing) * np.linalg.norm(usual))
    return both / max(float(usual @ usual), 1e-12), both / max(lengths, 1e-12)
