"""The fan that a phased array scans: where its samples lie, and the picture drawn from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Sector:
    """The fan that a phased array scans, and the picture it is drawn into.

    Transducer frame (mm): origin at the tip, x across the picture, y along the middle beam away
    from the tip, z across the plane. Pixel ``(i, j)`` is at ``((i - centre) * pixel, j * pixel)``.
    """

    depth_mm: float
    angle_deg: float
    pixel_mm: float
    beams: int
    range_step_mm: float = 0.5
    tip_mm: float = 3.0
    """Blind range in front of the tip, where the ringing transducer hears nothing."""

    @cached_property
    def ranges_mm(self) -> Float:
        """Distances from the tip of the samples along every beam."""
        return np.arange(self.tip_mm, self.depth_mm + self.range_step_mm, self.range_step_mm)

    @cached_property
    def angles_rad(self) -> Float:
        """Angles of the beams off the middle one."""
        half = np.deg2rad(self.angle_deg) / 2
        return np.linspace(-half, half, self.beams)

    @cached_property
    def picture_shape(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        half = self.depth_mm * np.sin(np.deg2rad(self.angle_deg) / 2)
        return round(self.depth_mm / self.pixel_mm) + 1, 2 * round(half / self.pixel_mm) + 1

    @cached_property
    def points_mm(self) -> Float:
        """``(ranges, beams, 3)`` samples in the transducer frame."""
        across = np.outer(self.ranges_mm, np.sin(self.angles_rad))
        along = np.outer(self.ranges_mm, np.cos(self.angles_rad))
        return np.stack([across, along, np.zeros_like(along)], axis=-1)

    @cached_property
    def transducer_from_image(self) -> Float:
        """4x4 from pixel ``(i, j, 0)`` to transducer mm."""
        matrix = np.diag([self.pixel_mm, self.pixel_mm, self.pixel_mm, 1.0])
        matrix[0, 3] = -(self.picture_shape[1] // 2) * self.pixel_mm
        return matrix

    @cached_property
    def _polar_of_pixels(self) -> Float:
        """``(2, rows, columns)`` fractional range and beam number of every pixel."""
        rows, columns = self.picture_shape
        along, across = np.mgrid[0:rows, 0:columns] * self.pixel_mm
        across -= (columns // 2) * self.pixel_mm
        sample = (np.hypot(across, along) - self.tip_mm) / self.range_step_mm
        step = self.angles_rad[1] - self.angles_rad[0]
        beam = (np.arctan2(across, along) - self.angles_rad[0]) / step
        return np.stack([sample, beam])

    @cached_property
    def inside(self) -> npt.NDArray[np.bool_]:
        """``(rows, columns)`` True for the pixels that the beams reach."""
        sample, beam = self._polar_of_pixels
        last = len(self.ranges_mm) - 1
        heard = (sample >= 0) & (sample <= last) & (beam >= 0) & (beam <= self.beams - 1)
        return np.asarray(heard)

    def draw(self, polar: Float) -> Byte:
        """Scan-convert ``(ranges, beams)`` grey values in [0, 255]; 0 outside the fan."""
        picture = map_coordinates(polar, self._polar_of_pixels, order=1, mode="nearest")
        grey = np.clip(np.rint(picture), 0, 255)
        return np.where(self.inside, grey, 0).astype(np.uint8)
