"""The stack as the network wants to see it: patient's left to the right, apex first.

Images of any orientation in the patient come out alike, because the file says how the patient
lies, or, where it says it wrongly, because the heart itself shows it (`Orientation`); so the
network never has to tell a left atrium from a mirrored right one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.geometry import Float, Float32, Mask
from pipeline.imaging.cine import Cine

PIXEL_MM = 1.5
"""Pixel spacing in which hearts are sought: that of the blocks of which training images are cut."""


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
class Orientation:
    """How the heart lies in a stack, against what the file's own directions say.

    Only what the network is shown is turned by it: the frame of all products stays the file's.
    """

    turn_deg: float = 0.0
    """The heart is turned in its plane by this, from columns towards rows, once unmirrored."""

    mirrored: bool = False
    """The images show a mirror image of what the file's directions say."""

    upside_down: bool = False
    """Slices run from the base to the apex where the file says from the apex to the base."""

    @property
    def is_the_files(self) -> bool:
        """Whether the file's directions are right."""
        return self == AS_THE_FILE_SAYS

    @property
    def is_mirror_image(self) -> bool:
        """Whether the images are a mirror image of what the file says: two mirrorings are a turn,
        which a tracker's pose undoes; one is undone by none."""
        return self.mirrored != self.upside_down

    def applied(self, axes: Float) -> Float:
        """Axes of the view, ``(3, 3)`` rows, that the file's canonical ones become."""
        columns, rows, towards_base = axes
        columns = -columns if self.mirrored else columns
        towards_base = -towards_base if self.upside_down else towards_base
        return np.stack([*_turned(columns, rows, self.turn_deg), towards_base])

    def __str__(self) -> str:
        """For people."""
        if self.is_the_files:
            return "as the file says"
        parts = [
            f"turned by {self.turn_deg:.0f} degrees in the plane" if self.turn_deg else "",
            "mirrored in the plane" if self.mirrored else "",
            "base and apex exchanged" if self.upside_down else "",
        ]
        mirror = "a mirror image, to which no tracker's pose fits"
        parts.append(mirror if self.is_mirror_image else "")
        return "other than the file says: " + ", ".join(part for part in parts if part)


AS_THE_FILE_SAYS = Orientation()


def _turned(columns: Float, rows: Float, turn_deg: float) -> tuple[Float, Float]:
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return cosine * columns + sine * rows, cosine * rows - sine * columns


@dataclass(frozen=True, slots=True)
class View:
    """A pixel grid over all slices of one cine."""

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

    pixel_mm: float = PIXEL_MM
    """Distance between rows and between columns."""

    @property
    def slice_step_mm(self) -> float:
        """Distance between slices along the normal."""
        return abs(float(self.mr_from_index[:3, 2] @ self.axes[2]))

    def cropped(self, first: tuple[int, int], shape: tuple[int, int]) -> View:
        """The same view of a part: from pixel ``first`` (row, column) on, ``shape`` pixels."""
        shift_mm = self.pixel_mm * (first[1] * self.axes[0] + first[0] * self.axes[1])
        return replace(self, corner_mm=self.corner_mm + shift_mm, shape=shape)

    def varied(self, turn_deg: float = 0.0, scale: float = 1.0) -> View:
        """The same view turned in its plane about its middle, its pixels scaled."""
        rows, columns = self.shape
        middle = np.array([columns - 1, rows - 1]) / 2
        middle_mm = self.corner_mm + self.pixel_mm * middle @ self.axes[:2]
        axes = np.stack([*_turned(self.axes[0], self.axes[1], turn_deg), self.axes[2]])
        pixel_mm = self.pixel_mm * scale
        corner_mm = middle_mm - pixel_mm * middle @ axes[:2]
        return replace(self, axes=axes, corner_mm=corner_mm, pixel_mm=pixel_mm)

    def pixels_of(self, other: View) -> Float:
        """``(2, 3)`` affine map: (column, row) here to (column, row) of ``other``, in one plane."""
        steps = self.pixel_mm / other.pixel_mm * other.axes[:2] @ self.axes[:2].T
        start = other.axes[:2] @ (self.corner_mm - other.corner_mm) / other.pixel_mm
        return np.column_stack([steps, start])

    def image_from_view(self, number: int) -> Float:
        """``(2, 3)`` affine map: (column, row) here to (x, y) pixels of the cine's slice.

        ``number`` counts slices from the apex.
        """
        origin_mm = self.mr_from_index[:3, 3] + self.order[number] * self.mr_from_index[:3, 2]
        height_mm = (origin_mm - self.corner_mm) @ self.axes[2]
        start_mm = self.corner_mm + height_mm * self.axes[2] - origin_mm
        in_plane = np.linalg.pinv(self.mr_from_index[:3, :2])
        columns = [self.pixel_mm * self.axes[0], self.pixel_mm * self.axes[1], start_mm]
        return np.asarray(in_plane @ np.stack(columns, axis=1))

    def sample(self, image: Float32, number: int) -> Float32:
        """Resample one slice's image, ``(y, x)``, onto this view; zero outside."""
        matrix = self.image_from_view(number)
        # Pixels much finer than the view's are averaged first, lest noise and edges alias.
        ratio = self.pixel_mm / np.linalg.norm(self.mr_from_index[:3, :2], axis=0)
        if ratio.max() > 1.2:
            sigma = 0.5 * np.sqrt(np.maximum(ratio**2 - 1, 1e-4))
            image = cv2.GaussianBlur(image, (0, 0), float(sigma[0]), sigmaY=float(sigma[1]))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, matrix, self.shape[::-1], flags=flags))

    def holds(self, number: int, shape: tuple[int, int]) -> Mask:
        """Which pixels of this view lie on the ``(y, x)`` pixels of the cine's slice."""
        return self.sample(np.ones(shape, np.float32), number) > 0.5

    def restore(self, image: Float32, number: int, shape: tuple[int, int]) -> Float32:
        """Carry an image of this view back onto the ``(y, x)`` pixels of the cine's slice."""
        matrix = self.image_from_view(number)
        return np.asarray(cv2.warpAffine(image, matrix, shape[::-1], flags=cv2.INTER_LINEAR))


def view_of(cine: Cine, orientation: Orientation = AS_THE_FILE_SAYS) -> View:
    """The view that holds every pixel of every slice, the heart lying as ``orientation`` says."""
    normal = np.cross(cine.mr_from_index[:3, 0], cine.mr_from_index[:3, 1])
    axes = orientation.applied(canonical_axes(normal))
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
