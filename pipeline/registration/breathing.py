"""How far the heart has moved with breathing in each frame, from the pictures themselves.

Breathing shifts the heart along one axis, by millimetres that every frame shows a little. A frame's
loss at each place along the axis says how likely the place is; from one frame to the next the heart
moves but a little. The likeliest way through all frames of a sweep is found exactly, by dynamic
programming over a row of places (A. J. Viterbi, "Error bounds for convolutional codes and an
asymptotically optimum decoding algorithm", IEEE Trans Inf Theory 13 (1967) 260-269).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from pipeline.geometry import Float, Integer
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.search import Level

AXIS = np.array([0.0, -0.25644, -0.96656])
"""Unit vector, LPS, along which the heart moves on breathing in: towards the feet and forwards, by
4.9 and 1.3 mm in the mean of ten hearts (G. Shechter et al., "Respiratory motion of the heart from
free breathing coronary angiograms", IEEE Trans Med Imaging 23 (2004) 1046-1056)."""

# Where the heart may be along the axis, and how finely that is told.
_REACH_MM, _COARSE_MM, _FINE_MM = 12.0, 1.5, 0.25
# A breath of 5 mm within 2 s moves it by some tenths of a millimetre from frame to frame.
_STEP_MM = 0.5
# A weak belief that it is not far away, for frames that show nothing.
_USUAL_MM = 6.0
# Most of a breath is spent near its end: this share of the frames lies at or before it.
_AT_REST = 0.25
_ROUNDS = 3
# By what share of a breath that may be off: breaths of the form cos^2n (Lujan et al., Med Phys 26
# (1999) 715-720) have their quarter at 0.15 of their depth for n = 1, and at the end for n = 3.
_REST_SD = 0.1
# A breath this deep whose middle frame lies so far towards its end does not rest at its beginning.
_DEEP_MM, _INSPIRED = 2.0, 0.6


def follow_breath(
    level: Level, mr_from_tracker: Float, pivot: Pivot, sweep: Integer
) -> tuple[Level, Float, Float]:
    """Each frame's place in the breath, and the pose of the heart at rest between breaths.

    Parameters
    ----------
    level
        The frames, sweep after sweep, each in order of time.
    mr_from_tracker
        4x4, the pose that suits all frames as if nobody breathed.
    sweep
        ``(frames,)`` number of the sweep that each frame belongs to.

    Returns
    -------
    The level with its frames where they belong, the pose at the end of expiration, and
    ``(frames,)`` mm along `AXIS` from there.
    """
    depth_mm, pose = np.zeros(level.samples.frames), mr_from_tracker
    for _ in range(_ROUNDS):
        costs = _costs_along(level, pose)
        depth_mm = np.concatenate(
            [likeliest_way_mm(costs[sweep == number]) for number in np.unique(sweep)]
        )
        rest_mm = float(np.quantile(depth_mm, _AT_REST))
        depth_mm -= rest_mm
        # A frame in which the heart lies towards the feet is brought back by as much.
        placed = replace(level, shift_mm=-depth_mm[:, None] * AXIS)
        at_rest = np.eye(4)
        at_rest[:3, 3] = -rest_mm * AXIS
        pose = climb(placed, at_rest @ pose, pivot)
    return placed, pose, depth_mm


def rest_error_mm(breath_mm: Float) -> float:
    """Standard deviation, along `AXIS`, of where the heart rests between breaths.

    ``breath_mm``: ``(frames,)`` as `follow_breath` returns them.
    """
    return _REST_SD * float(np.ptp(np.quantile(breath_mm, [0.05, 0.95])))


def is_mostly_inspired(breath_mm: Float) -> bool:
    """Whether most frames were taken nearer to the end of inspiration, so that it is not plain
    where the heart rests."""
    low, middle, high = np.quantile(breath_mm, [0.05, 0.5, 0.95])
    return bool(high - low > _DEEP_MM and middle - low > _INSPIRED * (high - low))


def _costs_along(level: Level, pose: Float) -> Float:
    """``(frames, places)`` minus log likelihood of each frame, the heart at each place.

    That of normal values is half the logarithm of what is left unexplained, a sample; those
    outside the heart say nothing.
    """
    coarse_mm = np.arange(-_REACH_MM, _REACH_MM + _COARSE_MM / 2, _COARSE_MM)
    frames = np.ones((level.samples.frames, 1))
    losses = [
        replace(level, shift_mm=-place_mm * frames * AXIS).losses(pose) for place_mm in coarse_mm
    ]
    of_heart = level.at(pose).in_view * np.diff(level.samples.first)
    return 0.5 * of_heart[:, None] * CubicSpline(coarse_mm, losses)(_places_mm()).T


def _places_mm() -> Float:
    return np.arange(-_REACH_MM, _REACH_MM + _FINE_MM / 2, _FINE_MM)


def likeliest_way_mm(costs: Float) -> Float:
    """``(frames,)`` places, mm, of least cost in all.

    Parameters
    ----------
    costs
        ``(frames, places)`` minus log likelihood of each place, from -12 to 12 mm in steps of
        a quarter. A step from frame to frame costs its square over twice 0.5 mm squared, a place
        its square over twice 6 mm squared.
    """
    places_mm = _places_mm()
    step = 0.5 * ((places_mm[:, None] - places_mm) / _STEP_MM) ** 2
    own = costs + 0.5 * (places_mm / _USUAL_MM) ** 2
    total, came_from = own[0], []
    for cost in own[1:]:
        ways = total[:, None] + step
        came_from.append(ways.argmin(axis=0))
        total = ways.min(axis=0) + cost
    way = [int(total.argmin())]
    for before in reversed(came_from):
        way.append(int(before[way[-1]]))
    return places_mm[way[::-1]]
