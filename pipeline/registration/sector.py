"""Find the sector of a sweep's pictures, as they come or as a screen shows them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_erosion,
    binary_fill_holes,
    label,
)

from pipeline.geometry import Float32, Mask

# Gaps of so many pixels in what a sweep ever shows are closed, and lines of so many are none of it.
_GAP_PX = 3
# By this share of what echoes change, or less, a compressed picture's black does around them.
_STRONG = 0.15


def shown_sector(images: Float32) -> Mask:
    """``(h, w)`` where pictures ``(n, h, w)`` show echoes; dark blood inside counts as shown.

    Echoes change strongly from frame to frame, over broad areas. What stands still around them
    (names, scales, a window's frame), thin lines and a black that is not quite black do not: the
    sector is what ever changes within the convex hull of what does so strongly.
    """
    change = _change(images)
    strong = _broad(change > _STRONG * _usual(change))
    return np.asarray(binary_fill_holes(_closed((change > 0) & _hull(strong))), dtype=bool)


def _change(images: Float32) -> Float32:
    """``(h, w)`` brightest less darkest grey value, the brightest where nothing ever changes; 0
    where one is no finite number."""
    # Of a whole sweep no copy is made: it may be most of what memory holds.
    brightest, darkest = images.max(axis=0), images.min(axis=0)
    known = np.isfinite(brightest) & np.isfinite(darkest)
    brightest, darkest = np.where(known, brightest, 0), np.where(known, darkest, 0)
    return np.asarray(brightest - darkest if (brightest > darkest).any() else brightest)


def _usual(change: Float32) -> float:
    """How much grey values of echoes change: the median of what is no weak change."""
    some = change[change > 0]
    return float(np.median(some[some > np.median(some) / 2])) if len(some) else 0.0


def _closed(mask: Mask) -> Mask:
    """With gaps of a few pixels closed; nothing is lost at the picture's edge."""
    return np.asarray(binary_closing(mask, iterations=_GAP_PX) | mask)


def _broad(mask: Mask) -> Mask:
    """Without lines of a few pixels, and without parts smaller than a tenth of the largest."""
    # Beyond the picture's edge a sector goes on.
    core = binary_erosion(_closed(mask), iterations=_GAP_PX, border_value=1)
    parts, _ = label(binary_dilation(core, iterations=_GAP_PX))
    sizes = np.bincount(parts.ravel())[1:]
    large = np.flatnonzero(sizes >= 0.1 * sizes.max(initial=0)) + 1
    return np.asarray(np.isin(parts, large))


def _hull(mask: Mask) -> Mask:
    """Convex hull, and the pixel around it that an opening may have taken off."""
    hull = np.zeros(mask.shape, np.uint8)
    if mask.any():
        corners = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
        cv2.fillConvexPoly(hull, corners, 1)
    return np.asarray(binary_dilation(hull > 0))
