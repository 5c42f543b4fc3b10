"""How well frames and model agree at a pose: the share of grey values that anatomy explains.

The smoothed grey values of every frame, as ranks, are fitted by ``a + b * blood + c * wall`` and a
trend across the sector, so that no gain, no compression and no scanner needs to be known; what
the fit explains beyond the trend is the frame's correlation ratio. The trend takes in all that
changes over centimetres: fading behind tissue, shadow, haze, and how bright what lies around the
heart is. Left in, it draws the pose towards where it is strong. After W. Wein et al.,
"Automatic CT-ultrasound registration for diagnostic imaging and image-guided intervention", Med
Image Anal 12 (2008) 577-585, with surfaces in the place of CT numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.geometry import Float, Integer
from pipeline.registration.frames import Samples
from pipeline.registration.tissue_map import TissueMap

# Per frame: grey with blood and with wall, blood with itself, blood with wall, wall with itself,
# and the sum of blood and wall.
_SUMS = 6
# Grey values of variance 1 explained by less than this say nothing: it keeps the fit solvable
# where a frame misses the heart.
_RIDGE = 1e-3


@dataclass(frozen=True, slots=True)
class Agreement:
    """How each frame agrees with the model at one pose."""

    explained: Float
    """``(frames,)`` share of the variance of grey values that anatomy explains, 0 to 1."""

    in_view: Float
    """``(frames,)`` share of the samples in blood or at its walls, about 0 to 1."""

    @property
    def score(self) -> float:
        """Mean over the frames of -log(1 - explained): the mutual information of normal values,
        in units of half a nat a sample."""
        return float(-np.log1p(-self.explained).mean())


def agreement(
    samples: Samples, tissue: TissueMap, mr_from_tracker: Float, shift_mm: Float | None = None
) -> Agreement:
    """Compare all frames with the model at one pose.

    Parameters
    ----------
    mr_from_tracker
        4x4.
    shift_mm
        ``(frames, 3)`` LPS: how much further each frame lies in the model; nothing if None.
    """
    lower, weight = _neighbours(samples.phases, tissue.phases)
    index_from_mr = np.diag([*(1 / np.array(tissue.grid.spacing_mm)), 1.0])
    index_from_mr[:3, 3] = -np.array(tissue.grid.origin_mm) / tissue.grid.spacing_mm
    shift = np.zeros((samples.frames, 3)) if shift_mm is None else shift_mm
    sums = np.zeros((samples.frames, _SUMS))
    with_trend = np.zeros((samples.frames, 2, samples.trend.shape[1]))
    _add_up(
        samples.points_mm,
        samples.grey,
        samples.trend,
        samples.trend_row,
        samples.first,
        lower,
        weight,
        tissue.share,
        index_from_mr @ mr_from_tracker,
        shift / np.array(tissue.grid.spacing_mm),
        sums,
        with_trend,
    )
    counts = np.diff(samples.first)
    return Agreement(_explained(sums, with_trend, counts), sums[:, -1] / counts)


def _neighbours(phases: Float, stored: Float) -> tuple[Integer, Float]:
    """The stored phase at or before each phase, and the weight of the one after; cyclic."""
    lower = np.searchsorted(stored, phases, side="right") - 1
    start = stored[lower]
    length = (np.roll(stored, -1) - stored)[lower] % 1.0
    # With one stored phase the way round the cycle has length 0: the heart stands still.
    weight = np.where(length > 0, (phases - start) % 1.0 / np.where(length > 0, length, 1.0), 0.0)
    return (lower % len(stored)).astype(np.int64), weight


def _explained(sums: Float, with_trend: Float, counts: Integer) -> Float:
    """Variance explained by blood and walls beyond the trend, blood darker than the rest."""
    blood_grey, wall_grey = sums[:, 0], sums[:, 1]
    trend_b, trend_w = with_trend[:, 0], with_trend[:, 1]
    ridge = _RIDGE * counts
    bb = sums[:, 2] - (trend_b**2).sum(axis=1) + ridge
    bw = sums[:, 3] - (trend_b * trend_w).sum(axis=1)
    ww = sums[:, 4] - (trend_w**2).sum(axis=1) + ridge
    # Normal equations of two unknowns, solved by hand for all frames at once.
    determinant = bb * ww - bw**2
    blood = (ww * blood_grey - bw * wall_grey) / determinant
    wall = (bb * wall_grey - bw * blood_grey) / determinant
    both = blood * blood_grey + wall * wall_grey
    # A fit that makes blood bright is one by chance: then only the walls count.
    fitted = np.where(blood < 0, both, wall_grey**2 / ww)
    return np.asarray(np.clip(fitted / counts, 0, 0.999))


@njit(cache=True, nogil=True)
def _add_up(  # type: ignore[no-untyped-def]
    points,
    grey,
    trend,
    trend_row,
    first,
    lower,
    weight,
    share,
    index_from_tracker,
    shift,
    sums,
    with_trend,
):
    """Per frame: products of the shares with grey, trend and each other, and their own sum."""
    phases, depth, height, width, _ = share.shape
    m = index_from_tracker
    for f in range(len(first) - 1):
        before, after, late = lower[f], (lower[f] + 1) % phases, weight[f]
        for s in range(first[f], first[f + 1]):
            px, py, pz = points[s, 0], points[s, 1], points[s, 2]
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] + shift[f, 0]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] + shift[f, 1]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3] + shift[f, 2]
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if 0 <= i < width - 1 and 0 <= j < height - 1 and 0 <= k < depth - 1:
                u, v, w = np.float32(x - i), np.float32(y - j), np.float32(z - k)
                blood, wall = _interpolate(share, before, k, j, i, w, v, u)
                blood_late, wall_late = _interpolate(share, after, k, j, i, w, v, u)
                blood += late * (blood_late - blood)
                wall += late * (wall_late - wall)
                if blood > 0 or wall > 0:
                    row = trend[trend_row[f] + s - first[f]]
                    _accumulate(sums[f], with_trend[f], blood, wall, grey[s], row)


@njit(cache=True, nogil=True)
def _interpolate(share, phase, k, j, i, w, v, u):  # type: ignore[no-untyped-def]
    """Trilinear blood and wall in one phase."""
    blood, wall = np.float32(0), np.float32(0)
    one = np.float32(1)
    for dk in range(2):
        wk = w if dk else one - w
        for dj in range(2):
            wj = wk * (v if dj else one - v)
            near, far = wj * (one - u), wj * u
            row = share[phase, k + dk, j + dj]
            blood += near * row[i, 0] + far * row[i + 1, 0]
            wall += near * row[i, 1] + far * row[i + 1, 1]
    return blood, wall


@njit(cache=True, nogil=True)
def _accumulate(sums, with_trend, blood, wall, grey, trend):  # type: ignore[no-untyped-def]
    """Add one sample to a frame's sums."""
    sums[0] += blood * grey
    sums[1] += wall * grey
    sums[2] += blood * blood
    sums[3] += blood * wall
    sums[4] += wall * wall
    sums[5] += blood + wall
    for c in range(len(trend)):
        with_trend[0, c] += blood * trend[c]
        with_trend[1, c] += wall * trend[c]
