"""The stack as the network wants to see it: patient's left to the right, apex first, 1.5 mm.

Images of any orientation in the patient come out alike, because the file says how the patient
lies; so the network never has to tell a left atrium from a mirrored right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry import Float, Float32
from pipeline.imaging.cine import Cine

PIXEL_MM = 1.5
"""Pixel spacing that the network was trained on."""


def canonical_axes(normal: Float) -> Float:
    """Axes of an image plane, the same for every patient lying in the scanner.

    The third axis is ``normal``, turned to run from the apex towards the base: right, posterior
    and up. The first is the patient's left seen in the plane (in a sagittal plane, posterior);
    the second makes the three right-handed.

    Parameters
    ----------
    normal
        ``(3,)`` normal of the plane, LPS, of any length and sign.

    Returns
    -------
    (3, 3) array
        Rows are unit vectors: along columns, along rows, from slice to slice.
    """
    towards_base = normal / np.linalg.norm(normal)
    if towards_base @ (-1.0, 1.0, 1.0) < 0:
        towards_base = -towards_base
    left = np.array([1.0, 0.0, 0.0])
    # Within 17 degrees of the normal, left projects onto too short a shadow to give a direction.
    if abs(towards_base[0]) > np.cos(np.radians(17)):
        left = np.array([0.0, 1.0, 0.0])
    across = left - (left @ towards_base) * towards_base
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards_base, across), towards_base])


@dataclass(frozen=True, slots=True)
class View:
    """A canonical pixel grid over all slices of one cine."""

    mr_from_index: Float
    """The cine's own geometry: 4x4, voxel indices to LPS mm."""

    axes: Float
    """``(3, 3)`` rows: unit vectors along columns, along rows, from slice to slice."""

    corner_mm: Float
    """``(3,)`` LPS position of the pixel (0, 0) on the slice nearest the apex."""

    shape: tuple[int, int]
    """Rows and columns."""

    order: tuple[int, ...]
    """The cine's slice numbers, from the apex to the base."""

    @property
    def slice_step_mm(self) -> float:
        """Distance between slices along the normal."""
        return abs(float(self.mr_from_index[:3, 2] @ self.axes[2]))

    def cropped(self, first: tuple[int, int], shape: tuple[int, int]) -> View:
        """The same view of a part: from pixel ``first`` (row, column) on, ``shape`` pixels."""
        shift_mm = PIXEL_MM * (first[1] * self.axes[0] + first[0] * self.axes[1])
        return View(self.mr_from_index, self.axes, self.corner_mm + shift_mm, shape, self.order)

    def image_from_view(self, number: int) -> Float:
        """``(2, 3)`` affine map: (column, row) here to (x, y) pixels of the cine's slice.

        ``number`` counts slices from the apex.
        """
        origin_mm = self.mr_from_index[:3, 3] + self.order[number] * self.mr_from_index[:3, 2]
        height_mm = (origin_mm - self.corner_mm) @ self.axes[2]
        start_mm = self.corner_mm + height_mm * self.axes[2] - origin_mm
        in_plane = np.linalg.pinv(self.mr_from_index[:3, :2])
        columns = [PIXEL_MM * self.axes[0], PIXEL_MM * self.axes[1], start_mm]
        return np.asarray(in_plane @ np.stack(columns, axis=1))

    def sample(self, image: Float32, number: int) -> Float32:
        """Resample one slice's image, ``(y, x)``, onto this view; zero outside."""
        matrix = self.image_from_view(number)
        # Pixels much finer than the view's are averaged first, lest noise and edges alias.
        ratio = PIXEL_MM / np.linalg.norm(self.mr_from_index[:3, :2], axis=0)
        if ratio.max() > 1.2:
            sigma = 0.5 * np.sqrt(np.maximum(ratio**2 - 1, 1e-4))
            image = cv2.GaussianBlur(image, (0, 0), float(sigma[0]), sigmaY=float(sigma[1]))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, matrix, self.shape[::-1], flags=flags))

    def restore(self, image: Float32, number: int, shape: tuple[int, int]) -> Float32:
        """Carry an image of this view back onto the ``(y, x)`` pixels of the cine's slice."""
        matrix = self.image_from_view(number)
        return np.asarray(cv2.warpAffine(image, matrix, shape[::-1], flags=cv2.INTER_LINEAR))


def view_of(cine: Cine) -> View:
    """The view that holds every pixel of every slice."""
    normal = np.cross(cine.mr_from_index[:3, 0], cine.mr_from_index[:3, 1])
    axes = canonical_axes(normal)
    _, slices, rows, columns = cine.intensity.shape
    rising = cine.mr_from_index[:3, 2] @ axes[2] > 0
    order = tuple(range(slices)) if rising else tuple(range(slices - 1, -1, -1))
    corners = np.array(
        [[x, y, z] for z in (0, slices - 1) for y in (0, rows - 1) for x in (0, columns - 1)], float
    )
    corners_mm = corners @ cine.mr_from_index[:3, :3].T + cine.mr_from_index[:3, 3]
    along_mm = corners_mm @ axes.T
    low_mm, high_mm = along_mm.min(axis=0), along_mm.max(axis=0)
    size = np.ceil((high_mm - low_mm)[:2] / PIXEL_MM).astype(int) + 1
    return View(cine.mr_from_index, axes, low_mm @ axes, (int(size[1]), int(size[0])), order)
