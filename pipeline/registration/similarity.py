"""How well frames and model agree at a pose: the share of grey values that anatomy explains.

The smoothed grey values of every frame are fitted by ``a + b * blood + c * wall`` and a smooth
trend across the sector, so that no gain, no compression and no scanner needs to be known; what
the fit explains beyond the trend is the frame's correlation ratio. After W. Wein et al.,
"Automatic CT-ultrasound registration for diagnostic imaging and image-guided intervention", Med
Image Anal 12 (2008) 577-585, with surfaces in the place of CT numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from pipeline.geometry import Float, Integer
from pipeline.registration.frames import TREND_COLUMNS, Samples
from pipeline.registration.tissue_map import TissueMap

# Per frame: grey with blood and wall (0, 1), the trend's columns with blood and with wall, blood
# with itself, blood with wall, wall with itself, and the sum of blood and wall.
_WITH_TREND = 2
_SQUARES = _WITH_TREND + 2 * TREND_COLUMNS
_IN_VIEW = _SQUARES + 3
_SUMS = _IN_VIEW + 1
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


def agreement(samples: Samples, tissue: TissueMap, mr_from_tracker: Float) -> Agreement:
    """Compare all frames with the model at one pose."""
    lower, weight = _neighbours(samples.phases, tissue.phases)
    index_from_mr = np.diag([*(1 / np.array(tissue.grid.spacing_mm)), 1.0])
    index_from_mr[:3, 3] = -np.array(tissue.grid.origin_mm) / tissue.grid.spacing_mm
    sums = np.zeros((samples.frames, _SUMS))
    _add_up(
        samples.points_mm,
        samples.grey,
        samples.trend,
        samples.first,
        lower,
        weight,
        tissue.share,
        index_from_mr @ mr_from_tracker,
        sums,
    )
    counts = np.diff(samples.first)
    return Agreement(_explained(sums, counts), sums[:, _IN_VIEW] / counts)


def _neighbours(phases: Float, stored: Float) -> tuple[Integer, Float]:
    """The stored phase at or before each phase, and the weight of the one after; cyclic."""
    lower = np.searchsorted(stored, phases, side="right") - 1
    start = stored[lower]
    length = (np.roll(stored, -1) - stored)[lower] % 1.0
    # With one stored phase the way round the cycle has length 0: the heart stands still.
    weight = np.where(length > 0, (phases - start) % 1.0 / np.where(length > 0, length, 1.0), 0.0)
    return (lower % len(stored)).astype(np.int64), weight


def _explained(sums: Float, counts: Integer) -> Float:
    """Variance explained by blood and walls beyond the trend, blood darker than the rest."""
    blood_grey, wall_grey = sums[:, 0], sums[:, 1]
    trend_b, trend_w = np.split(sums[:, _WITH_TREND:_SQUARES], 2, axis=1)
    ridge = _RIDGE * counts
    bb = sums[:, _SQUARES] - (trend_b**2).sum(axis=1) + ridge
    bw = sums[:, _SQUARES + 1] - (trend_b * trend_w).sum(axis=1)
    ww = sums[:, _SQUARES + 2] - (trend_w**2).sum(axis=1) + ridge
    # Normal equations of two unknowns, solved by hand for all frames at once.
    determinant = bb * ww - bw**2
    blood = (ww * blood_grey - bw * wall_grey) / determinant
    wall = (bb * wall_grey - bw * blood_grey) / determinant
    both = blood * blood_grey + wall * wall_grey
    # A fit that makes blood bright is one by chance: then only the walls count.
    fitted = np.where(blood < 0, both, wall_grey**2 / ww)
    return np.asarray(np.clip(fitted / counts, 0, 0.999))


@njit(cache=True, nogil=True)
def _add_up(points, grey, trend, first, lower, weight, share, index_from_tracker, sums):  # type: ignore[no-untyped-def]
    """Per frame: products of the shares with grey, trend and each other, and their own sum."""
    phases, depth, height, width, _ = share.shape
    m = index_from_tracker
    for f in range(len(first) - 1):
        before, after, late = lower[f], (lower[f] + 1) % phases, weight[f]
        for s in range(first[f], first[f + 1]):
            px, py, pz = points[s, 0], points[s, 1], points[s, 2]
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            i, j, k = math.floor(x), math.floor(y), math.floor(z)
            if 0 <= i < width - 1 and 0 <= j < height - 1 and 0 <= k < depth - 1:
                u, v, w = np.float32(x - i), np.float32(y - j), np.float32(z - k)
                blood, wall = _interpolate(share, before, k, j, i, w, v, u)
                blood_late, wall_late = _interpolate(share, after, k, j, i, w, v, u)
                blood += late * (blood_late - blood)
                wall += late * (wall_late - wall)
                _accumulate(sums, f, blood, wall, grey[s], trend, s)


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
def _accumulate(sums, f, blood, wall, grey, trend, s):  # type: ignore[no-untyped-def]
    """Add one sample to the sums of frame ``f``."""
    sums[f, 0] += blood * grey
    sums[f, 1] += wall * grey
    for c in range(TREND_COLUMNS):
        sums[f, _WITH_TREND + c] += blood * trend[s, c]
        sums[f, _WITH_TREND + TREND_COLUMNS + c] += wall * trend[s, c]
    sums[f, _SQUARES] += blood * blood
    sums[f, _SQUARES + 1] += blood * wall
    sums[f, _SQUARES + 2] += wall * wall
    sums[f, _IN_VIEW] += blood + wall
