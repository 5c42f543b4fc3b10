"""The same hearts with other ends: tips of any bluntness, right chambers that reach lower."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, among

Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_INSIDE = (Tissue.LV_CAVITY, Tissue.PAPILLARY_MUSCLE)
_LEFT = (*_INSIDE, Tissue.LV_MYOCARDIUM, Tissue.SCAR)
_RIGHT = (Tissue.RV_CAVITY, Tissue.RV_TRABECULA)
_KEPT = (*_LEFT, Tissue.LEFT_ATRIUM, Tissue.AORTA)
"""What a right atrium cannot take the place of."""

_CHEST = (Tissue.AIR, Tissue.MUSCLE, Tissue.BONE)
"""What a right ventricle does not push aside."""

_LEAST_AREA = 150
"""Pixels of a chamber that is well in the plane."""

_BRUSH = np.ones((3, 3), np.uint8)
_CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (15, 15))


def lowest_atrium(planes: Label) -> int | None:
    """The lowest plane of the right atrium, if both ventricles are cut well below it.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    """
    area = np.count_nonzero(planes == Tissue.RIGHT_ATRIUM, axis=(1, 2))
    lowest = int(np.argmax(area > 0))
    if not area.any() or lowest < 1 or area[lowest:].max() < _LEAST_AREA:
        return None
    below = planes[lowest - 1]
    cut = (np.count_nonzero(among(below, tissues)) for tissues in (_INSIDE, _RIGHT))
    return lowest if min(cut) >= _LEAST_AREA else None


def low_atrium(rng: np.random.Generator, planes: Label, lowest: int, farther: int) -> Label:
    """The same heart with its right atrium reaching down beside the left ventricle.

    The tricuspid annulus lies nearer the apex than the mitral one and moves farther in systole,
    which the phantom's does not: planes through the left ventricle's last rings show the atrium
    where the right ventricle was at end-diastole, and the right ventricle's outflow before it.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    lowest
        The lowest plane of the right atrium as it is.
    farther
        Planes by which it reaches down.
    """
    lower = planes.copy()
    area = np.count_nonzero(planes[lowest : lowest + 8] == Tissue.RIGHT_ATRIUM, axis=(1, 2))
    full = lowest + int(np.argmax(area >= 0.6 * area.max()))
    atrium = (planes[full] == Tissue.RIGHT_ATRIUM).astype(np.uint8)
    depth_px = cv2.distanceTransform(atrium, cv2.DIST_L2, 5)
    towards = _middle(among(planes[lowest - 1], _RIGHT)) - _middle(atrium)
    towards *= rng.uniform(0.0, 1.0)
    outflow = among(planes[full], _RIGHT)
    outflow = outflow if outflow.any() else among(planes[lowest - 1], _RIGHT)
    away = _middle(atrium) - _middle(outflow)
    away /= max(float(np.linalg.norm(away)), 1.0)
    rows, columns = np.indices(atrium.shape)
    along_px = columns * away[0] + rows * away[1]
    leaflet = rng.random() < 0.5
    first = max(lowest - farther, 0)
    for number in range(first, full):
        share = (full - number) / (full - first + 0.5)
        least_px = (1 - np.sqrt(1 - share**2)) * depth_px.max()
        body = _moved((depth_px > least_px).astype(np.uint8), 1.0, share * towards) > 0
        # What lies beyond the atrium, seen from the outflow, is no ventricle any more.
        beyond_px = along_px[body].mean() + (3 * share - 0.5) * depth_px.max()
        body |= among(lower[number], _RIGHT) & (along_px > beyond_px)
        _put_atrium(lower[number], body, leaflet)
    return lower


def _put_atrium(plane: Label, body: Mask, leaflet: bool) -> None:
    """Draw the right atrium into a plane, and leave the right ventricle one part of itself."""
    body = (body | (plane == Tissue.RIGHT_ATRIUM)) & ~among(plane, _KEPT)
    rest = among(plane, _RIGHT) & ~body
    count, part, sizes, _ = cv2.connectedComponentsWithStats(rest.astype(np.uint8), connectivity=4)
    if count > 1:
        body |= rest & (part != 1 + np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    plane[body] = Tissue.RIGHT_ATRIUM
    rim = (cv2.dilate(body.astype(np.uint8), _BRUSH) > 0) & ~body
    plane[rim & ~IN_HEART[plane]] = Tissue.ATRIAL_WALL
    if leaflet:
        plane[rim & among(plane, _RIGHT)] = Tissue.LEAFLET


def first_ventricle(planes: Label) -> int | None:
    """The first plane from the apex that cuts the left ventricle's cavity well.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    """
    area = np.count_nonzero(among(planes, _INSIDE), axis=(1, 2))
    return int(np.argmax(area >= _LEAST_AREA)) if (area >= _LEAST_AREA).any() else None


def far_right_ventricle(planes: Label, farther: int) -> Label:
    """The same heart with its right ventricle reaching farther towards the apex, or past it.

    What the right ventricle shows some planes above lies against the smaller left ventricle here,
    in a wall of its own. Left ventricle, atria and aorta stay, and all of the chest wall that is
    no thin sheet.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    farther
        Planes by which its tip reaches down; its widest cut stays where it is.
    """
    lower = planes.copy()
    area = np.count_nonzero(among(planes, _RIGHT), axis=(1, 2))
    widest, tip = int(area.argmax()), int(np.argmax(area > 0))
    for number in range(max(tip - farther, 0), widest):
        # The nearer to the widest cut, the less it moves.
        share = min(1.0, (widest - number) / max(widest - tip, 1))
        above = min(number + round(farther * share), widest)
        left, beside = among(planes[above], _LEFT), among(planes[above], _RIGHT)
        if above > number and left.any() and np.count_nonzero(beside) >= _LEAST_AREA:
            _put_right_ventricle(lower[number], planes[above])
    return lower


def _put_right_ventricle(plane: Label, above: Label) -> None:
    """Draw the right ventricle of the plane ``above`` against the left one of this plane."""
    left, left_above = (among(one, _LEFT) for one in (plane, above))
    right_above = among(above, _RIGHT)
    middle = _middle(left) if left.any() else _middle(left_above)
    towards = _middle(right_above) - _middle(left_above)
    towards /= max(float(np.linalg.norm(towards)), 1.0)
    nearer = np.sqrt(left_above.sum() / np.pi) - np.sqrt(left.sum() / np.pi)
    shift = middle - _middle(left_above) - nearer * towards
    put = right_above | (above == Tissue.RV_WALL)
    right = (_moved(put.astype(np.uint8), 1.0, shift) > 0) | among(plane, (*_RIGHT, Tissue.RV_WALL))
    # A crescent bent about a larger circle leaves gaps beside a smaller one.
    both = cv2.morphologyEx((right | left).astype(np.uint8), cv2.MORPH_CLOSE, _CLOSING) > 0
    # The diaphragm, a sheet of muscle, gives way.
    chest = among(plane, _CHEST).astype(np.uint8)
    chest = cv2.morphologyEx(chest, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0
    right = both & ~chest & ~among(plane, (*_KEPT, Tissue.RIGHT_ATRIUM))
    inside = right & (cv2.erode((right | left).astype(np.uint8), _BRUSH) > 0)
    knots = _moved((above == Tissue.RV_TRABECULA).astype(np.uint8), 1.0, shift) > 0
    plane[right] = Tissue.RV_WALL
    plane[inside] = Tissue.RV_CAVITY
    plane[inside & knots] = Tissue.RV_TRABECULA
    beside = (cv2.dilate((right | left).astype(np.uint8), _BRUSH) > 0) & ~IN_HEART[plane]
    beside &= ~chest
    plane[beside] = Tissue.PERICARDIUM


def other_tip(rng: np.random.Generator, planes: Label, last: int, height: float) -> Label:
    """The same heart with its tip drawn anew, pointed or blunt, with a thin wall or a thick one.

    The phantom's tips are all of one shape, and thin.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    last
        The plane from which on towards the base the heart stays as it is.
    height
        Planes from there to the end of the muscle.
    """
    drawn = planes.copy()
    whole = among(planes[last], _LEFT).astype(np.uint8)
    inside = among(planes[last], _INSIDE).astype(np.uint8)
    if not inside.any():
        return drawn
    hollow = max(height - rng.uniform(0.3, 3.5), 0.5)
    bluntness = rng.uniform(1.3, 4.0)
    drift = rng.normal(0.0, 0.8, 2)
    skin = rng.random() < 0.5
    for number in range(last):
        plane, away = drawn[number], last - number
        _clear(plane, everything=away > 0.8 * height)
        for body, end, tissue in (
            (whole, height, Tissue.LV_MYOCARDIUM),
            (inside, hollow, Tissue.LV_CAVITY),
        ):
            if away < end:
                size = np.sqrt(1 - (away / end) ** bluntness)
                put = _moved(body, size, away * drift, _middle(inside)) > 0
                plane[put] = tissue
        left = among(plane, _LEFT).astype(np.uint8)
        if skin:
            beside = (cv2.dilate(left, _BRUSH) > 0) & ~IN_HEART[plane]
            plane[beside] = Tissue.PERICARDIUM
    return drawn


def shut_tip(planes: Label, closed: int, over: int) -> Label:
    """The same heart with a left ventricle whose cavity is shut towards the tip: solid muscle.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    closed
        The first plane that shows a cavity.
    over
        Planes over which it widens to what it was.
    """
    shut = planes.copy()
    for number in range(min(closed + over, len(planes))):
        inside = among(planes[number], _INSIDE)
        depth_px = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
        share = max(number - closed + 1, 0) / (over + 1)
        shut[number][inside & (depth_px <= (1 - share) * depth_px.max())] = Tissue.LV_MYOCARDIUM
    return shut


def _clear(plane: Label, everything: bool) -> None:
    """Take the left ventricle, or the whole heart, out of a plane; what lies around fills in."""
    gone = (IN_HEART[plane] if everything else among(plane, _LEFT)) | (plane == Tissue.PERICARDIUM)
    around = ~gone & ~IN_HEART[plane]
    if not gone.any() or not around.any():
        return
    _, nearest = cv2.distanceTransformWithLabels(
        (~around).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    tissue = np.zeros(nearest.max() + 1, np.uint8)
    tissue[nearest[around]] = plane[around]
    plane[gone] = tissue[nearest[gone]]


def _middle(mask: npt.NDArray[np.generic]) -> npt.NDArray[np.float64]:
    """Column and row of the middle of a mask."""
    return np.asarray(np.argwhere(mask)[:, ::-1].mean(axis=0))


def _moved(
    mask: npt.NDArray[np.uint8],
    size: float,
    shift: npt.NDArray[np.float64],
    about: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.uint8]:
    """A mask scaled about a point and then shifted, columns and rows."""
    fixed = np.zeros(2) if about is None else about
    matrix = np.array([[size, 0.0, 0.0], [0.0, size, 0.0]])
    matrix[:, 2] = fixed * (1 - size) + shift
    moved = cv2.warpAffine(mask, matrix, mask.shape[::-1], flags=cv2.INTER_NEAREST)
    return np.asarray(moved)
