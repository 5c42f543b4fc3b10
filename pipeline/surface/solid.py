"""Masks made into one solid each: a single piece without holes or tunnels."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from skimage.measure import euler_number

from pipeline.geometry import Mask
from pipeline.surface.level_set import euclidean_voxels

# Balls, in voxels, that plug a tunnel: the smallest that will do is taken.
PLUG_REACHES = (1.0, 2.0, 4.0)
TOUCHING = np.ones((3, 3, 3), dtype=bool)


def one_piece(mask: Mask) -> Mask:
    """Largest piece of a ``(z, y, x)`` mask, holes filled, tunnels plugged where a ball will do.

    A tunnel through a chamber is an error of its labels, and a mesh that has it in one phase could
    not follow the phases that lack it. The mask must keep clear of the array's border.
    """
    piece = filled(largest_piece(mask))
    for reach in PLUG_REACHES:
        if euler_number(piece) == 1:
            break
        piece = filled(_plugged(piece, reach))
    return piece


def closed(mask: Mask, reach_voxels: float) -> Mask:
    """Morphological closing with a ball."""
    grown = euclidean_voxels(mask) + 0.5 <= reach_voxels
    return np.asarray(euclidean_voxels(~grown) + 0.5 > reach_voxels)


def largest_piece(mask: Mask) -> Mask:
    """Largest of the pieces whose voxels share faces."""
    pieces, count = ndimage.label(mask)
    if count <= 1:
        return mask
    return np.asarray(pieces == np.bincount(pieces[mask]).argmax())


def filled(mask: Mask) -> Mask:
    """Mask with every hole that the outside does not reach through faces."""
    outside, count = ndimage.label(~mask)
    if count <= 1:
        return mask
    return np.asarray(outside != outside[0, 0, 0])


def _plugged(piece: Mask, reach_voxels: float) -> Mask:
    """Add those parts of a closing that undo a tunnel, and no others.

    The Euler number of a body is its pieces less its tunnels plus its holes; a part changes it by
    as much as within a box round the part.
    """
    parts, _ = ndimage.label(closed(piece, reach_voxels) & ~piece, structure=TOUCHING)
    mended = piece.copy()
    for number, box in enumerate(ndimage.find_objects(parts), start=1):
        wide = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in box)
        without = mended[wide]
        plugged = without | (parts[wide] == number)
        if euler_number(plugged) > euler_number(without):
            mended[wide] = plugged
    return mended
