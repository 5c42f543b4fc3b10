"""From labelled planes to an isotropic volume: shape-based interpolation along the normal.

Every class, the background included, is turned into signed distances in its plane (Herman,
Zheng & Bucholtz, IEEE Comput. Graph. Appl. 12(3):69-79, 1992); distances are interpolated from
plane to plane and the class deepest inside wins. Distances are cut off at `BAND_MM`, so that a
structure that ends between two planes ends half-way, its rim rounded, with no gap to what follows.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.geometry import Float, Float32, Label

BAND_MM = 4.0
"""Depths are cut off here. Planes are some 3 mm apart, so a wall may lean by 50 degrees and its
slope still be followed; the seam between two structures that end against each other is notched
by a third of this at its rim."""

REFINE = 2
"""In-plane refinement of the outlines: distances are exact to a quarter of a pixel."""


def isotropic_labels(
    probability: Float32,
    pixel_mm: float,
    plane_mm: Float,
    shifts_mm: Float,
    gap_mm: float,
    grid_mm: float,
    margin_mm: float,
) -> tuple[Label, Float]:
    """Labels of all phases on one isotropic grid around the heart.

    Parameters
    ----------
    probability
        ``(phase, plane, class, row, column)``; class 0 is the background.
    pixel_mm
        Distance between rows and between columns.
    plane_mm
        ``(plane,)`` heights of the planes, rising.
    shifts_mm
        ``(plane, 2)`` displacement of each plane along columns and rows, taken back here.
    gap_mm
        Distance from the outer slices at which the next would have lain: the heart ends before.
    grid_mm, margin_mm
        Spacing of the grid, and the empty space around the heart.

    Returns
    -------
    labels, first_mm
        ``(phase, z, y, x)``, and the ``(x, y, z)`` position of its first voxel: mm along columns,
        rows and heights, from the centre of pixel (0, 0) at height 0.
    """
    cut = _cut_around(probability, margin_mm, pixel_mm)
    below_mm, above_mm = plane_mm[0] - gap_mm, plane_mm[-1] + gap_mm
    height_mm = np.arange(below_mm, above_mm + grid_mm / 2, grid_mm)
    phases = []
    for one in probability[:, :, :, cut[0], cut[1]]:
        depth_mm = np.stack(
            [
                plane_depth_mm(plane, pixel_mm, shift_mm, grid_mm)
                for plane, shift_mm in zip(one, shifts_mm, strict=True)
            ]
        )
        closed_mm, closed_plane_mm = close_ends(depth_mm, plane_mm, gap_mm)
        phases.append(interpolate_planes(closed_mm, closed_plane_mm, height_mm))
    volume = np.stack(phases)
    first, last = _heights_with_heart(volume, round(margin_mm / grid_mm))
    first_mm = np.array([cut[1].start * pixel_mm, cut[0].start * pixel_mm, height_mm[first]])
    return np.ascontiguousarray(volume[:, first:last]), first_mm


def _cut_around(probability: Float32, margin_mm: float, pixel_mm: float) -> tuple[slice, slice]:
    """Rows and columns that hold the heart of all phases, and a margin as far as there is one."""
    likely = np.zeros(probability.shape[3:], bool)
    for one in probability:
        likely |= (one[:, 0] < 0.5).any(axis=0)
    margin = round(margin_mm / pixel_mm)
    cut = []
    for axis in (1, 0):
        found = np.flatnonzero(likely.any(axis=axis))
        ends = (found[0], found[-1]) if len(found) else (0, likely.shape[1 - axis] - 1)
        cut.append(slice(max(0, int(ends[0]) - margin), int(ends[1]) + margin + 1))
    return cut[0], cut[1]


def _heights_with_heart(volume: Label, margin: int) -> tuple[int, int]:
    found = np.flatnonzero(volume.any(axis=(0, 2, 3)))
    if not len(found):
        return 0, volume.shape[1]
    return max(0, int(found[0]) - margin), int(found[-1]) + margin + 1


def plane_depth_mm(
    probability: Float32, pixel_mm: float, shift_mm: Float, grid_mm: float
) -> Float32:
    """Depth of every grid point inside every class: positive inside, negative outside, mm.

    Parameters
    ----------
    probability
        ``(class, row, column)`` on one plane.
    shift_mm
        ``(2,)`` displacement of the plane along columns and rows, taken back here.
    grid_mm
        Spacing of the points; the first lies at the centre of the first pixel.

    Returns
    -------
    (class, row, column) array
        Minus infinity for a class that the plane does not have.
    """
    best_two = np.partition(probability, -2, axis=0)[-2:]
    size = [int((side - 1) * pixel_mm / grid_mm) + 1 for side in probability.shape[1:]]
    depth = np.full((len(probability), *size), -np.inf, np.float32)
    for value, chance in enumerate(probability):
        rival = np.where(chance >= best_two[1], best_two[0], best_two[1])
        margin = chance - rival
        if (margin > 0).any():
            fine = _magnified(margin, pixel_mm, shift_mm, grid_mm, size)
            depth[value] = _signed_depth_mm(fine, grid_mm)
    return depth


def _magnified(
    margin: Float32, pixel_mm: float, shift_mm: Float, grid_mm: float, size: list[int]
) -> Float32:
    """Sample ``margin`` at `REFINE` points a grid step, the shift taken back."""
    scale = grid_mm / REFINE / pixel_mm
    # The fine points lie symmetrically about each grid point.
    start = shift_mm / pixel_mm - scale * (REFINE - 1) / 2
    matrix = np.array([[scale, 0.0, start[0]], [0.0, scale, start[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    fine_size = (size[1] * REFINE, size[0] * REFINE)
    return np.asarray(
        cv2.warpAffine(margin, matrix, fine_size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    )


def _signed_depth_mm(fine: Float32, grid_mm: float) -> Float32:
    """Distance to the zero contour of values on the fine points, at grid points; + inside."""
    inside = (fine > 0).astype(np.uint8)
    within = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances run to the nearest point of the other side; the outline lies half a step before.
    signed = np.where(inside > 0, within - 0.5, 0.5 - beyond).astype(np.float32)
    size = (fine.shape[1] // REFINE, fine.shape[0] // REFINE)
    coarse = cv2.resize(signed, size, interpolation=cv2.INTER_AREA)
    return np.asarray(coarse * np.float32(grid_mm / REFINE))


def interpolate_planes(depth_mm: Float32, plane_mm: Float, height_mm: Float) -> Label:
    """Class at every height: that which lies deepest inside itself.

    Parameters
    ----------
    depth_mm
        ``(plane, class, row, column)`` from `plane_depth_mm`.
    plane_mm
        ``(plane,)`` heights of the planes, rising.
    height_mm
        ``(height,)`` heights wanted; beyond the outer planes, those planes hold.

    Returns
    -------
    (height, row, column) array
        Class values.
    """
    cut = np.clip(depth_mm, -BAND_MM, BAND_MM)
    position = np.interp(height_mm, plane_mm, np.arange(len(plane_mm)))
    lower = np.minimum(position.astype(int), max(len(plane_mm) - 2, 0))
    upper = np.minimum(lower + 1, len(plane_mm) - 1)
    volume = np.empty((len(height_mm), *depth_mm.shape[2:]), np.uint8)
    for number, (low, high) in enumerate(zip(lower, upper, strict=True)):
        share = np.float32(position[number] - low)
        volume[number] = ((1 - share) * cut[low] + share * cut[high]).argmax(axis=0)
    return volume


def close_ends(depth_mm: Float32, plane_mm: Float, gap_mm: float) -> tuple[Float32, Float]:
    """Round off what the stack cuts: planes beyond either end on which structures shrink away.

    The square of a structure's in-radius is carried on along the normal in a straight line, as in
    an ellipsoid, from its last two planes; a structure that grows towards the end keeps its size.
    Nothing reaches further than ``gap_mm``, where the next slice would have shown it.

    Returns
    -------
    depth, heights
        As given, with planes added at both ends; the outermost hold background only.
    """
    below, below_mm = _cap(depth_mm[:2], plane_mm[:2], gap_mm)
    above, above_mm = _cap(depth_mm[:-3:-1], plane_mm[:-3:-1], gap_mm)
    depth = np.concatenate([below[::-1], depth_mm, above])
    return depth, np.concatenate([below_mm[::-1], plane_mm, above_mm])


def _cap(last_two: Float32, height_mm: Float, gap_mm: float) -> tuple[Float32, Float]:
    """Planes outwards from ``last_two[0]``, the outermost plane of the stack."""
    step_mm = height_mm[0] - height_mm[1]
    count = max(1, int(np.ceil(gap_mm / abs(step_mm) - 1e-6)))
    reach_mm = gap_mm / count
    radius_mm = np.maximum(last_two.max(axis=(2, 3)), 0)
    slope = (radius_mm[0] ** 2 - radius_mm[1] ** 2) / abs(step_mm)
    planes = []
    for number in range(1, count + 1):
        square = radius_mm[0] ** 2 + np.minimum(slope, 0) * number * reach_mm
        shrunk_mm = np.sqrt(np.maximum(square, 0)) if number < count else 0 * square
        plane = last_two[0] - (radius_mm[0] - shrunk_mm)[:, None, None].astype(np.float32)
        plane[1:][shrunk_mm[1:] <= 0] = -np.inf
        plane[0] = -np.maximum(plane[1:].max(axis=0), -BAND_MM)
        planes.append(plane)
    heights = height_mm[0] + np.sign(step_mm) * reach_mm * np.arange(1, count + 1)
    return np.stack(planes), heights
