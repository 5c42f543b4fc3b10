"""The left atrium's auricle joined to its body, where the neck is thinner than slices are apart."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pipeline.geometry import Float32
from pipeline.imaging.labels import LABELS, most_probable

AURICLE_VOXELS = 40
"""A smaller part of the left atrium beside its body is no auricle, but an island."""

NECK_STEPS = 10
"""Longest way, in voxels, from the body to an auricle through what is likely its neck."""

NECK_PROBABILITY = 0.15
"""Least geometric mean along that way of the probability of left atrium."""

NECK_BRUSH = np.zeros((3, 5, 5), bool)
NECK_BRUSH[1] = np.hypot(*np.mgrid[-2:3, -2:3]) < 2.5
NECK_BRUSH[[0, 2], 1:4, 1:4] = True
"""What is painted about the way: two pixels in its plane, one in the planes beside it."""


def join_auricle(part: Float32) -> None:
    """Join parts of the left atrium that a thin neck parts, along the neck's likeliest way.

    The auricle's neck is thinner than the slices are apart, so that no slice may show it, yet the
    network gives it some probability. Other chambers are never taken from.
    """
    from skimage.graph import MCP_Geometric

    value = LABELS["left_atrium"]
    labels = most_probable(part)
    parts, count = ndimage.label(labels == value, np.ones((3, 3, 3), bool))
    sizes = np.bincount(parts.ravel())[1:]
    if count < 2 or np.sort(sizes)[-2] < AURICLE_VOXELS:
        return
    body = int(sizes.argmax()) + 1
    passable = (labels == 0) | (labels == value)
    likely = np.clip(part[:, value], 1e-3, 1)
    ways = MCP_Geometric(np.where(passable, 0.02 - np.log(likely), np.inf))
    costs, _ = ways.find_costs(np.argwhere(parts == body))
    for number in np.flatnonzero(sizes >= AURICLE_VOXELS) + 1:
        if number == body:
            continue
        ends = np.argwhere(parts == number)
        nearest = ends[costs[tuple(ends.T)].argmin()]
        if not np.isfinite(costs[tuple(nearest)]):
            continue
        way = np.array(ways.traceback(nearest))
        between = way[parts[tuple(way.T)] == 0]
        mean = np.exp(np.log(likely[tuple(between.T)]).mean()) if len(between) else 1.0
        if len(between) <= NECK_STEPS and mean >= NECK_PROBABILITY:
            neck = np.zeros(labels.shape, bool)
            neck[tuple(way.T)] = True
            neck = ndimage.binary_dilation(neck, NECK_BRUSH) & passable
            part[:, value][neck] = 1.0
