"""From labelled planes to an isotropic volume: shape-based interpolation along the normal.

Every class, the background included, is turned into signed distances in its plane (Herman,
Zheng & Bucholtz, IEEE Comput. Graph. Appl. 12(3):69-79, 1992); distances are interpolated from
plane to plane and the class deepest inside wins. Distances are cut off at `BAND_MM`, so that a
structure that ends between two planes ends half-way, its rim rounded, with no gap to what follows.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from pipeline.geometry import Float, Float32, Label, Mask
from pipeline.imaging.cleanup import THREADS
from pipeline.imaging.depth import depth_px
from pipeline.imaging.labels import CAVITY, MUSCLE, most_probable
from pipeline.imaging.tapering import BAND_MM, LID_MM, taper_ventricle

TAPER_MM = 10.0
"""How a structure tapers towards an end of the stack is told by its areas this near to it."""

CAP_STEP_MM = 1.5
"""Distance of the planes by which ends are rounded off."""

EDGE_PX = 0.8
"""Standard deviation, pixels, by which class margins are smoothed: what they decide has stairs."""

REFINE = 2
"""In-plane refinement of the outlines: distances are exact to a quarter of a pixel."""

TIE_MM = np.float32(1e-3)
"""Where an outline halves a point's cell, its depths in two classes are both nil: the margin, times
this, tells which is deeper. Else all such points would be the lower class's, and that too large."""


def isotropic_labels(
    probability: Float32,
    pixel_mm: float,
    plane_mm: Float,
    shifts_mm: Float,
    reach_mm: float,
    grid_mm: float,
    margin_mm: float,
    planes_a_slice: int = 1,
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
    reach_mm
        How far beyond the outer planes the heart reaches at the most. Half a step beyond the
        outer slice is what volumes summed slice by slice assume.
    grid_mm, margin_mm
        Spacing of the grid, and the empty space around the heart; in the planes as far as there is.
    planes_a_slice
        The middle one of so many planes is a slice.

    Returns
    -------
    labels, first_mm
        ``(phase, z, y, x)``, and the ``(x, y, z)`` position of its first voxel: mm along columns,
        rows and heights, from the centre of pixel (0, 0) at height 0.
    """
    # Depths need what lies about the outline, and a displaced heart room to be moved back in.
    room_mm = BAND_MM + float(np.abs(shifts_mm).max())
    cut = _cut_around(probability, max(margin_mm, room_mm), pixel_mm)
    below_mm, above_mm = plane_mm[0] - reach_mm, plane_mm[-1] + reach_mm
    height_mm = np.arange(below_mm, above_mm + grid_mm, grid_mm)
    slices = np.arange(planes_a_slice // 2, len(plane_mm), planes_a_slice)

    def labels(one: Float32) -> Label:
        depth_mm = np.stack(
            [
                plane_depth_mm(plane, pixel_mm, shift_mm, grid_mm)
                for plane, shift_mm in zip(one, shifts_mm, strict=True)
            ]
        )
        closed_mm, closed_plane_mm = close_ends(depth_mm, plane_mm, reach_mm)
        ventricle_mm = np.stack(
            [ventricle_depth_mm(one[k], pixel_mm, shifts_mm[k], grid_mm) for k in slices]
        )
        added = int(np.searchsorted(closed_plane_mm, plane_mm[0]))
        tapered_mm, tapered_plane_mm = taper_ventricle(
            closed_mm, closed_plane_mm, slices + added, ventricle_mm
        )
        return interpolate_planes(tapered_mm, tapered_plane_mm, height_mm)

    with ThreadPoolExecutor(THREADS) as pool:
        volume = np.stack(list(pool.map(labels, probability[:, :, :, cut[0], cut[1]])))
    volume, first = _with_margin(volume, round(margin_mm / grid_mm))
    lowest_mm = height_mm[max(first, 0)] + min(first, 0) * grid_mm
    return volume, np.array([cut[1].start * pixel_mm, cut[0].start * pixel_mm, lowest_mm])


def _cut_around(probability: Float32, margin_mm: float, pixel_mm: float) -> tuple[slice, slice]:
    """Rows and columns that hold the heart of all phases, and a margin as far as there is one."""
    likely = np.zeros(probability.shape[3:], bool)
    for one in probability:
        likely |= (one[:, 0] < 0.5).any(axis=0)
    return around(likely, round(margin_mm / pixel_mm))


def around(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Rows and columns that hold a mask and a margin, as far as there is one; all, of an empty one.

    Parameters
    ----------
    mask
        ``(row, column)``.
    margin
        Pixels.
    """
    cut = []
    for axis in (1, 0):
        found = np.flatnonzero(mask.any(axis=axis))
        ends = (found[0], found[-1]) if len(found) else (0, mask.shape[1 - axis] - 1)
        cut.append(slice(max(0, int(ends[0]) - margin), int(ends[1]) + margin + 1))
    return cut[0], cut[1]


def _with_margin(volume: Label, margin: int) -> tuple[Label, int]:
    """Planes cut off or empty ones added, so that ``margin`` lie on either side of the heart; and
    which of the volume's is the first, below 0 where planes were added before them."""
    found = np.flatnonzero(volume.any(axis=(0, 2, 3)))
    if not len(found):
        return volume, 0
    first, beyond = int(found[0]) - margin, int(found[-1]) + margin + 1
    added = max(-first, 0), max(beyond - volume.shape[1], 0)
    inside = volume[:, max(first, 0) : beyond]
    return np.pad(inside, ((0, 0), added, (0, 0), (0, 0))), first


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
    size = [int((side - 1) * pixel_mm / grid_mm) + 1 for side in probability.shape[1:]]
    depth = np.full((len(probability), *size), -np.inf, np.float32)
    for value, margin in enumerate(class_margins(probability)):
        if (margin > 0).any():
            fine = _magnified(margin, pixel_mm, shift_mm, grid_mm, size)
            depth[value] = _signed_depth_mm(fine, grid_mm)
    return depth


def ventricle_depth_mm(
    probability: Float32, pixel_mm: float, shift_mm: Float, grid_mm: float
) -> Float32:
    """As `plane_depth_mm`, of the left ventricle, cavity and muscle as one: ``(row, column)``."""
    margin = ventricle_margin(probability)
    size = [int((side - 1) * pixel_mm / grid_mm) + 1 for side in margin.shape]
    return _signed_depth_mm(_magnified(margin, pixel_mm, shift_mm, grid_mm, size), grid_mm)


def ventricle_margin(probability: Float32) -> Float32:
    """As `class_margins`, of the left ventricle, cavity and muscle as one: ``(row, column)``."""
    others = [k for k in range(len(probability)) if k not in (CAVITY, MUSCLE)]
    return np.asarray(-class_margins(probability)[others].max(axis=0))


def class_margins(probability: Float32) -> Float32:
    """How clearly each class is the most probable one: from -1, it is not, to 1; 0 at its border.

    Parameters
    ----------
    probability
        ``(class, row, column)`` on one plane.

    Returns
    -------
    (class, row, column) array
        What can be resampled: a probability has no border of its own where three classes meet.
    """
    first, second = probability[0], np.full_like(probability[0], -np.inf)
    # Through few classes at many pixels this is quicker than a partition.
    for one in probability[1:]:
        second = np.maximum(second, np.minimum(first, one))
        first = np.maximum(first, one)
    rival = np.where(probability >= first, second, first)
    return np.stack([cv2.GaussianBlur(one, (0, 0), EDGE_PX) for one in probability - rival])


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
    inside = fine > 0
    # Distances run to the nearest point of the other side; the outline lies half a step before.
    signed = np.where(inside, depth_px(inside) - 0.5, 0.5 - depth_px(~inside)).astype(np.float32)
    size = (fine.shape[1] // REFINE, fine.shape[0] // REFINE)
    coarse, margin = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (signed, fine))
    return np.asarray(coarse * np.float32(grid_mm / REFINE) + TIE_MM * margin)


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
        volume[number] = most_probable((1 - share) * cut[low] + share * cut[high], axis=0)
    return volume


def close_ends(depth_mm: Float32, plane_mm: Float, reach_mm: float) -> tuple[Float32, Float]:
    """Round off what the stack cuts: planes beyond either end on which structures shrink away.

    The area of a structure is carried on along the normal in a straight line, as in a paraboloid,
    from what it was within `TAPER_MM` of the end; nothing reaches further than ``reach_mm``. The
    left ventricle shrinks as one body, and at the apex, where the planes begin, its cavity ends
    `LID_MM` before its muscle does.

    Returns
    -------
    depth, heights
        As given, with planes added at both ends; the outermost hold background only.
    """
    rising = np.concatenate([[True], plane_mm[1:] - plane_mm[0] < TAPER_MM + 1e-6])
    rising[:2] = True
    falling = np.concatenate([plane_mm[-1] - plane_mm[:-1] < TAPER_MM + 1e-6, [True]])
    falling[-2:] = True
    below, below_mm = _cap(depth_mm[rising], plane_mm[rising], reach_mm, LID_MM)
    above, above_mm = _cap(depth_mm[falling][::-1], plane_mm[falling][::-1], reach_mm, 0.0)
    depth = np.concatenate([below[::-1], depth_mm, above])
    return depth, np.concatenate([below_mm[::-1], plane_mm, above_mm])


def _cap(outer: Float32, height_mm: Float, reach_mm: float, lid_mm: float) -> tuple[Float32, Float]:
    """Planes outwards from ``outer[0]``, the outermost plane of the stack."""
    bodies, walled = _bodies(outer)
    away_mm = np.abs(height_mm - height_mm[0])
    ends_mm = np.minimum(reach_mm, _ends_mm(bodies, away_mm))
    if walled:
        ends_mm[CAVITY] = min(ends_mm[CAVITY], max(ends_mm[MUSCLE] - lid_mm, 0.0))
    count = max(2, int(np.ceil(reach_mm / CAP_STEP_MM)))
    beyond_mm = reach_mm * np.arange(1, count + 1) / count
    radius_mm = np.maximum(bodies[0].max(axis=(1, 2)), 0)
    planes = []
    for way_mm in beyond_mm:
        left = np.maximum(1 - way_mm / np.maximum(ends_mm, 1e-6), 0)
        plane = bodies[0] - (radius_mm * (1 - np.sqrt(left)))[:, None, None].astype(np.float32)
        plane[1:][left[1:] <= 0] = -np.inf
        if walled:
            plane[MUSCLE] = np.minimum(plane[MUSCLE], -plane[CAVITY])
        plane[0] = -np.maximum(plane[1:].max(axis=0), -BAND_MM)
        planes.append(plane)
    outwards = np.sign(height_mm[0] - height_mm[1])
    return np.stack(planes), height_mm[0] + outwards * beyond_mm


def _bodies(depth_mm: Float32) -> tuple[Float32, bool]:
    """Depths with the left ventricle's cavity counted to its muscle, where there is muscle."""
    classes = depth_mm.shape[1]
    walled = classes > max(CAVITY, MUSCLE) and bool((depth_mm[0, MUSCLE] > 0).any())
    if not walled:
        return depth_mm, False
    bodies = depth_mm.copy()
    bodies[:, MUSCLE] = np.maximum(depth_mm[:, MUSCLE], depth_mm[:, CAVITY])
    return bodies, True


def _ends_mm(bodies: Float32, away_mm: Float) -> Float:
    """How far beyond the first plane each body's area, falling in a straight line, is nil."""
    area = (bodies > 0).sum(axis=(2, 3)).astype(float)
    from_mean_mm = away_mm - away_mm.mean()
    growth = from_mean_mm @ area / (from_mean_mm @ from_mean_mm)
    return np.asarray(area[0] / np.maximum(growth, 1e-9))
