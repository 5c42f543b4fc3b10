"""The same hearts with what few have: infarcts that bulge, right walls as thick as left ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from data_synth.tissue import Tissue
from data_synth.training.contrast import IN_HEART, among
from data_synth.training.walls import closed_ring

Float = npt.NDArray[np.floating]
Label = npt.NDArray[np.uint8]

_INSIDE = (Tissue.LV_CAVITY, Tissue.PAPILLARY_MUSCLE)
_LEFT = (*_INSIDE, Tissue.LV_MYOCARDIUM, Tissue.SCAR)
_RIGHT = (Tissue.RV_CAVITY, Tissue.RV_TRABECULA, Tissue.RV_WALL)
_KEPT = (Tissue.AIR, Tissue.MUSCLE, Tissue.BONE, Tissue.BLOOD_VESSEL)
"""What a right ventricle's wall does not push aside, beside the heart itself."""

_LEAST_AREA = 150
"""Pixels of a ventricle that is well in the plane."""


def thick_right_walled(planes: Label, layers: int) -> Label:
    """The same heart with a right ventricle's wall thicker by some pixels on the outside.

    Under load it grows as thick as the left one's, and looks like it; it belongs to no structure.
    Chest wall, left ventricle, atria and vessels stay.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue.
    layers
        Pixels by which it grows.
    """
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * layers + 1, 2 * layers + 1))
    thicker = planes.copy()
    for plane in thicker:
        right = among(plane, _RIGHT).astype(np.uint8)
        grown = cv2.dilate(right, brush) > 0
        plane[grown & ~IN_HEART[plane] & ~among(plane, _KEPT)] = Tissue.RV_WALL
    return thicker


@dataclass(frozen=True, slots=True)
class Scar:
    """Where an infarct lies in a plane, in pixels, rows and columns."""

    middle: Float
    """Of the left ventricle."""

    way: Float
    """From there to the scar, a unit vector."""

    radius: float
    """Of the left ventricle with its wall."""


def draw_scar(rng: np.random.Generator, plane: Label) -> Scar | None:
    """A scar on any side of the left ventricle, if the plane cuts it well."""
    left = np.argwhere(among(plane, _LEFT))
    if len(left) < _LEAST_AREA:
        return None
    angle = rng.uniform(0, 2 * np.pi)
    way = np.array([np.sin(angle), np.cos(angle)])
    return Scar(left.mean(axis=0), way, float(np.sqrt(len(left) / np.pi)))


def scarred(rng: np.random.Generator, planes: Label, scar: Scar) -> Label:
    """The same heart with part of the left ventricle's wall thin, its cavity reaching into it.

    As an old infarct leaves it: what is left of the wall is some pixels thick within a place on
    the wall, and grows to what it was around it. Planes whose ring is open stay as they are.

    Parameters
    ----------
    planes
        ``(plane, row, column)`` tissue; the scar lies about the middle one.
    """
    thinner = planes.copy()
    place = scar.middle + rng.uniform(0.7, 1.1) * scar.radius * scar.way
    reach_px, wall_px = scar.radius * rng.uniform(0.7, 1.6), rng.uniform(1.5, 3.5)
    centre, through = len(planes) // 2 + rng.normal(0, 2.0), rng.uniform(5, 14)
    rows, columns = np.indices(planes.shape[1:])
    away = np.hypot(rows - place[0], columns - place[1])
    for number, plane in enumerate(thinner):
        size = 1 - ((number - centre) / through) ** 2
        left, inside = among(plane, _LEFT), among(plane, _INSIDE)
        if size <= 0 or not closed_ring(plane):
            continue
        # Thin over the inner six tenths of its reach; from there to its rim all of the wall stays.
        share = (away / (reach_px * np.sqrt(size)) - 0.6) / 0.4
        depth_px = cv2.distanceTransform(left.astype(np.uint8), cv2.DIST_L2, 5)
        wall = wall_px + np.maximum(share, 0) * scar.radius
        thin = left & ~inside & (share < 1) & (depth_px > wall)
        # Pockets within the wall are no part of the cavity.
        _, part = cv2.connectedComponents((thin | inside).astype(np.uint8), connectivity=4)
        plane[thin & np.isin(part, np.unique(part[inside]))] = Tissue.LV_CAVITY
    return thinner


def bulged(
    rng: np.random.Generator, scar: Scar, rows: Float, columns: Float
) -> tuple[Float, Float]:
    """Positions that push the left ventricle outwards where its scar lies.

    Parameters
    ----------
    rows, columns
        Where in the plane each pixel of the image lies.
    """
    place = scar.middle + 0.5 * scar.radius * scar.way
    reach_px = scar.radius * rng.uniform(0.5, 0.9)
    away_rows, away_columns = rows - place[0], columns - place[1]
    # Below half, positions follow one another as before: nothing folds.
    change = -rng.uniform(0.1, 0.5) * np.exp(-(away_rows**2 + away_columns**2) / reach_px**2)
    rows, columns = rows + change * away_rows, columns + change * away_columns
    return rows.astype(np.float32), columns.astype(np.float32)
