"""The same hearts with other walls: thinner, thicker, longer, other things against them."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, among
from data_synth.training.faults import smooth_noise

Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

_INSIDE = (Tissue.LV_CAVITY, Tissue.PAPILLARY_MUSCLE)
_MUSCLE = (Tissue.LV_MYOCARDIUM, Tissue.SCAR)

_COVERS = np.isin(list(Tissue), (Tissue.FAT, Tissue.PERICARDIUM))

_AROUND = np.isin(
    list(Tissue),
    (Tissue.LUNG, Tissue.LIVER, Tissue.STOMACH, Tissue.SPLEEN, Tissue.GAS, Tissue.MUSCLE),
)
"""What may lie against a heart, for every tissue."""

_LEAST_CAVITY = 60
"""Pixels of a cavity that a ring is looked for around."""

_CLOSED_SHARE = 0.9
"""Of what borders on the cavity, this share must be muscle in a ring."""


def last_ring(planes: Label) -> int | None:
    """The last plane towards the base in which muscle surrounds the left ventricle's cavity.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    """
    for number in range(len(planes) - 1, -1, -1):
        inside = among(planes[number], _INSIDE)
        if np.count_nonzero(inside) < _LEAST_CAVITY:
            continue
        if closed_ring(planes[number]):
            return number
    return None


def closed_ring(plane: Label) -> bool:
    """Whether a plane shows the left ventricle's cavity, and muscle nearly all around it."""
    inside = among(plane, _INSIDE)
    around = (cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~inside
    return bool(inside.any() and among(plane[around], _MUSCLE).mean() >= _CLOSED_SHARE)


def long_walled(planes: Label, ring: int, farther: int) -> Label:
    """The same heart with its left ventricle's last ring carried on towards the base.

    The phantom's walls taper towards the valves, and its right ventricle ends where its left does;
    a thick ventricle's walls do not, and its ring stands beside the right atrium.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue, the apex first.
    ring
        The plane whose ventricle is carried on.
    farther
        Planes by which it goes on.
    """
    longer = planes.copy()
    ventricle = among(planes[ring], (*_INSIDE, *_MUSCLE))
    for plane in longer[ring + 1 : ring + 1 + farther]:
        for tissue in (Tissue.LEFT_ATRIUM, Tissue.AORTA):
            body = plane == tissue
            # What would be left of it beside the ring is no atrium and no aorta any more.
            if np.count_nonzero(body & ~ventricle) < 0.6 * np.count_nonzero(body):
                plane[body] = Tissue.FAT
        plane[among(plane, (*_INSIDE, *_MUSCLE, Tissue.LEAFLET))] = Tissue.FAT
        plane[ventricle] = planes[ring][ventricle]
    return longer


def thin_walled(planes: Label, layers: int) -> Label:
    """The same heart with its left ventricle's muscle thinner by some pixels on the outside.

    What lies against the muscle takes the place of its outer layers, but two pixels of muscle
    stay around the cavity.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue.
    layers
        Pixels taken away along rows and columns.
    """
    found = np.argwhere((planes == Tissue.LV_MYOCARDIUM).any(axis=0))
    if not len(found):
        return planes
    (top, left), (bottom, right) = np.maximum(found.min(axis=0) - 1, 0), found.max(axis=0) + 2
    thinner = planes.copy()
    for plane in thinner:
        part = plane[top:bottom, left:right]
        cavity = among(part, _INSIDE).astype(np.uint8)
        free = (part == Tissue.LV_MYOCARDIUM) & (cv2.dilate(cavity, np.ones((5, 5), np.uint8)) == 0)
        for _ in range(layers):
            beside = part.copy()
            for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
                shifted = np.roll(beside, step, axis)
                outer = free & (part == Tissue.LV_MYOCARDIUM)
                outer &= ~among(shifted, (*_INSIDE, Tissue.LV_MYOCARDIUM, Tissue.SCAR))
                part[outer] = shifted[outer]
    return thinner


def whole_septum(planes: Label) -> Label:
    """The same heart with no wall of the right ventricle between its cavity and the left's muscle.

    Blocks have stray pixels of it there, which thinner walls would draw out to fingers.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue.
    """
    brush = np.ones((3, 3), np.uint8)
    whole = planes.copy()
    for plane in whole:
        between = plane == Tissue.RV_WALL
        for beside in ((Tissue.LV_MYOCARDIUM,), (Tissue.RV_CAVITY, Tissue.RV_TRABECULA)):
            between &= cv2.dilate(among(plane, beside).astype(np.uint8), brush) > 0
        plane[between] = Tissue.LV_MYOCARDIUM
    return whole


def thick_walled(rng: np.random.Generator, planes: Label, most_px: float = 4.0) -> Label:
    """The same heart with its left ventricle's muscle grown outwards, here more and there less.

    How thick a wall is then tells nothing of where it ends: the edge in the image has to. Muscle
    takes the place of what lies outside the heart alone.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue.
    most_px
        Largest growth, but for its unevenness.
    """
    uneven = smooth_noise(rng, planes.shape[-1], int(rng.integers(4, 9)))
    grown_px = rng.uniform(-1.0, most_px) + rng.uniform(0.0, 2.5) * uneven
    thicker = planes.copy()
    for plane in thicker:
        muscle = among(plane, _MUSCLE)
        if muscle.any():
            away_px = cv2.distanceTransform((~muscle).astype(np.uint8), cv2.DIST_L2, 3)
            free = ~IN_HEART[plane] | (plane == Tissue.PERICARDIUM)
            plane[free & (away_px < np.clip(grown_px, 0, most_px + 2) + 0.5)] = Tissue.LV_MYOCARDIUM
    return thicker


def laid_bare(rng: np.random.Generator, planes: Label, skin: bool = True) -> Label:
    """The same heart with what lies around it reaching up to it in places.

    Fat and pericardium near the heart become the nearest of lung, organs and diaphragm; with
    ``skin``, one pixel of pericardium stays in half of all hearts.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue.
    """
    reach_px, skin_px = rng.uniform(3.0, 14.0), int(rng.integers(0, 2)) * skin
    chosen = smooth_noise(rng, planes.shape[-1], int(rng.integers(2, 6))) > rng.uniform(-2.5, 0.3)
    bare = planes.copy()
    for plane in bare:
        around = _AROUND[plane]
        if not around.any():
            continue
        away = cv2.distanceTransform((~IN_HEART[plane]).astype(np.uint8), cv2.DIST_L2, 3)
        _, nearest = cv2.distanceTransformWithLabels(
            (~around).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        tissue = np.zeros(nearest.max() + 1, np.uint8)
        tissue[nearest[around]] = plane[around]
        near = _COVERS[plane] & (away < reach_px) & chosen
        if skin_px:
            plane[near & (away <= skin_px)] = Tissue.PERICARDIUM
        far = near & (away > skin_px)
        plane[far] = tissue[nearest[far]]
    return bare
