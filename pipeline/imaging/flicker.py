"""Labels that come and go from phase to phase, told by their areas and averaged over time.

In a plane a chamber shrinks once a beat and grows once. Where the network is not sure what it
sees, as near the valves in images unlike those of its training, it may take a plane for the
ventricle at one moment, for the atrium at the next and for the ventricle again. Then the area of a
label goes to and fro. There probabilities are averaged over time, over the shortest of several
lengths after which the area goes to and fro no more: a vote of neighbouring phases. Where labels
change as hearts do, nothing is averaged.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry import Float, Float32, Mask

WIDTHS_BEATS = (0.02, 0.03, 0.045, 0.07, 0.1)
"""Standard deviations of the means that are tried, in order."""

EXCESS = 0.25
"""Share of its largest area by which a label may grow and shrink over a beat, all in all, beyond
growing once and shrinking once."""

LEAST_MM2 = 250.0
"""A label that never has this much in a plane is judged by shares of this area."""

DOUBTED, DOUBTED_MM2 = 1.0, 800.0
"""The same two of what comes and goes wholly once too often, and is no small part of a chamber: of
stacks of phantoms hardly a slice, of a patient's most."""

REACHED = 0.3
"""Where a label ever is so probable the mean in time is taken, with what lies next to it."""

BESIDE_PX, FADE_PX = 5, 2.0
"""Width of the square by which such a place is enlarged, and standard deviation of its edge."""


def settle_flicker(value: Float32, phases: Float, pixel_mm: float) -> Float:
    """Average over time, in place, where labels come and go more often than once a beat.

    The mean is 2 G - G G with G a Gaussian over the cycle, which dulls the heart's slow motion
    less than G alone.

    Parameters
    ----------
    value
        ``(phase, plane, class, row, column)`` probabilities, class 0 being background.
    phases
        ``(phase,)`` in [0, 1).
    pixel_mm
        Side of a pixel.

    Returns
    -------
    (plane, class) array
        Standard deviation of G in beats, 0 where nothing was averaged.
    """
    means = [_mean_over(phases, width) for width in WIDTHS_BEATS]
    least_px = LEAST_MM2 / pixel_mm**2
    widths = np.zeros((value.shape[1], value.shape[2]))
    for plane in range(value.shape[1]):
        one = value[:, plane]
        areas_px = one.sum(axis=(2, 3), dtype=np.float64)
        chosen = {
            label: _shortest(means, areas_px[:, label], least_px)
            for label in range(1, value.shape[2])
            if excess(areas_px[:, label], least_px) > EXCESS
        }
        seen = one.copy() if chosen else one
        # What needs the longest mean has the last word where two labels meet.
        for label in sorted(chosen, key=lambda k: chosen[k]):
            _mix(one, seen, label, means[chosen[label]].astype(np.float32))
            widths[plane, label] = WIDTHS_BEATS[chosen[label]]
    return widths


def doubted_planes(value: Float32, pixel_mm: float) -> Mask:
    """``(plane,)``: whether some label comes and goes wholly, more often than once a beat.

    Parameters
    ----------
    value, pixel_mm
        As for `settle_flicker`.
    """
    areas_px = value[:, :, 1:].sum(axis=(3, 4), dtype=np.float64)
    least_px = DOUBTED_MM2 / pixel_mm**2
    planes = np.moveaxis(areas_px, 0, -1)
    return np.array([max(excess(one, least_px) for one in plane) >= DOUBTED for plane in planes])


def excess(areas: Float, least: float) -> float:
    """How much areas ``(phase,)`` change round the cycle beyond once up and once down, as a share
    of the largest, or of ``least`` where that is larger; 0 for whatever rises and falls once."""
    ways = float(np.abs(np.diff(areas, append=areas[0])).sum())
    return (ways - 2 * float(np.ptp(areas))) / max(float(areas.max()), least)


def _mean_over(phases: Float, width_beats: float) -> Float:
    """``(phase, phase)`` weights of 2 G - G G."""
    apart = (phases[:, None] - phases[None] + 0.5) % 1.0 - 0.5
    weights = np.exp(-0.5 * np.square(apart / width_beats))
    weights /= weights.sum(axis=1, keepdims=True)
    # Unlike a product by BLAS, the same to the last bit on any number of processors.
    return np.asarray(2 * weights - np.einsum("kl,lm->km", weights, weights))


def _shortest(means: list[Float], areas: Float, least: float) -> int:
    """Number of the first mean after which areas change no oftener than they may, or the last."""
    for number, mean in enumerate(means):
        if excess(np.einsum("kl,l->k", mean, areas), least) <= EXCESS:
            return number
    return len(means) - 1


def _mix(one: Float32, seen: Float32, label: int, mean: Float32) -> None:
    """Put the mean over time of what was ``seen`` where ``label`` ever is, in place."""
    ever = (seen[:, label].max(axis=0) > REACHED).astype(np.float32)
    reached = cv2.dilate(ever, np.ones((BESIDE_PX, BESIDE_PX), np.uint8))
    share = cv2.GaussianBlur(reached, (0, 0), FADE_PX)
    rows, columns = (np.flatnonzero(share.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return
    box = ..., slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    averaged = np.maximum(np.einsum("kl,lcyx->kcyx", mean, seen[box]), 0)
    one[box] += share[box] * (averaged - one[box])
