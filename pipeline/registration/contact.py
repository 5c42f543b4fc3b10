"""Tell pictures of a probe in air from those of a body.

A probe that has left the body hears its own ringing, and noise that the amplifier lifts with
depth: all of it depends on range alone. A body looks different beside the middle beam than on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.sparse import csr_array
from scipy.stats import rankdata

from pipeline.geometry import Float, Float32, Mask

# Speckle and noise are averaged out over cells of this edge; chambers of the heart are wider.
_CELL_MM = 8.0
# What goes from crest to trough along the beam in no less than this counts as change with range.
_ALONG_MM = 15.0
# Share of the cells' variance that range does not explain. Of the phantom's pictures it is 0.07 or
# less in air, noise and haze alone, and 0.20 or more in a body.
_LEAST_BESIDE = 0.12
# A sector that widens by less than this a millimetre has parallel beams, which fan out from a point
# so many of its heights above it.
_PARALLEL, _FAR = 0.05, 1e3


@dataclass(frozen=True, slots=True)
class Contact:
    """How pictures of one geometry are asked whether they show a body."""

    cells: csr_array
    """``(cells, h * w)``: the mean over each cell of the sector."""

    along: Float
    """``(cells, columns)``, orthonormal: what may change with range."""

    @classmethod
    def of(cls, sector: Mask, pixel_mm: Float) -> Self:
        """For pictures whose sector is ``(h, w)``, with pixels ``pixel_mm`` wide and high."""
        rows, columns = np.nonzero(sector)
        x_mm, y_mm = columns * pixel_mm[0], rows * pixel_mm[1]
        across, down = (x_mm // _CELL_MM).astype(int), (y_mm // _CELL_MM).astype(int)
        place = down * (across.max() + 1) + across
        _, cell, counts = np.unique(place, return_inverse=True, return_counts=True)
        weights = (1 / counts[cell]).astype(np.float32)
        pixel = rows * sector.shape[1] + columns
        shape = (len(counts), sector.size)
        means = csr_array((weights, (cell, pixel)), shape=shape)
        centre_mm = (x_mm.min() + x_mm.max()) / 2
        range_mm = np.hypot(x_mm - centre_mm, y_mm - _apex_mm(sector, pixel_mm))
        mean_mm = np.bincount(cell, range_mm) / counts
        # Speckle is not averaged out in what the sector's edge leaves of a cell.
        full = counts > 0.5 * counts.max()
        return cls(means[full], _cosines(mean_mm[full]))

    def touching(self, images: Float32) -> Mask:
        """``(n,)`` whether each of the pictures ``(n, h, w)`` shows more than range explains."""
        if self.along.shape[1] * 2 > len(self.along):
            return np.ones(len(images), dtype=bool)
        seen = rankdata((self.cells @ images.reshape(len(images), -1).T).T, axis=1)
        beside = seen - (seen @ self.along) @ self.along.T
        return np.asarray(beside.var(axis=1) > _LEAST_BESIDE * seen.var(axis=1))


def _apex_mm(sector: Mask, pixel_mm: Float) -> float:
    """Height of the point from which the beams fan out; far above where they are parallel."""
    rows = np.flatnonzero(sector.any(axis=1))
    first = sector[rows].argmax(axis=1)
    last = sector.shape[1] - 1 - sector[rows, ::-1].argmax(axis=1)
    width_mm, y_mm = (last - first) * pixel_mm[0], rows * pixel_mm[1]
    # Below its widest row a fan ends in an arc, and the highest ones may be the probe's own.
    widest = int(width_mm.argmax())
    some = slice(widest // 4, widest + 1)
    slope, offset_mm = np.polyfit(y_mm[some], width_mm[some], 1) if widest >= 4 else (0.0, 0.0)
    return float(-offset_mm / slope if slope > _PARALLEL else -_FAR * (np.ptp(y_mm) + 1))


def _cosines(range_mm: Float) -> Float:
    """``(n, columns)`` orthonormal: cosines of range."""
    length_mm = max(float(np.ptp(range_mm)), 1e-9)
    order = np.arange(int(length_mm / _ALONG_MM) + 1)
    waves = np.cos(np.outer(np.pi * (range_mm - range_mm.min()) / length_mm, order))
    return np.asarray(np.linalg.qr(waves)[0])
