"""How deep pixels lie in a mask."""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry import Float32, Mask


def depth_px(mask: Mask) -> Float32:
    """Distance from each pixel of a mask to the nearest beside it, pixels; 0 beside it.

    Where there is none beside it all are larger than any image.

    Parameters
    ----------
    mask
        ``(row, column)``.
    """
    found = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Its roots differ in the last bit with where arrays lie in memory; their squares are whole.
    squares = np.rint(np.square(found, dtype=np.float64))
    return np.asarray(np.sqrt(squares), np.float32)
