"""The two moments of the beat that pictures show: end-diastole and end-systole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Float32, Label, transform_points

MARGIN_PIXELS = 12


@dataclass(frozen=True, slots=True)
class Moments:
    """Images and labels of a few phases of a cine, in LPS millimetres."""

    names: tuple[str, ...]
    """What each moment is called."""

    numbers: tuple[int, ...]
    """Which phase of the cine it is, from 0."""

    phases: Float
    """``(moment,)`` in [0, 1)."""

    intensity: Float32
    """``(moment, z, y, x)``."""

    labels: Label
    """``(moment, z, y, x)``."""

    mr_from_index: Float
    """4x4: ``(x, y, z)`` voxel indices to millimetres."""

    interpolated: tuple[int, ...] = ()
    """Slices that were not recorded but drawn between their neighbours."""

    @property
    def pixel_aspect(self) -> float:
        """Height of a pixel over its width."""
        size_mm = np.linalg.norm(self.mr_from_index[:3, :3], axis=0)
        return float(size_mm[1] / size_mm[0])

    def window(self) -> tuple[slice, slice]:
        """Rows and columns in which the heart lies, with a margin; all where there is none."""
        heart = self.labels.max(axis=(0, 1))
        parts = []
        for across, size in ((1, heart.shape[0]), (0, heart.shape[1])):
            inside = np.flatnonzero(heart.max(axis=across))
            if not len(inside):
                parts.append(slice(0, size))
                continue
            low, high = int(inside[0]) - MARGIN_PIXELS, int(inside[-1]) + MARGIN_PIXELS + 1
            parts.append(slice(max(0, low), min(size, high)))
        return parts[0], parts[1]

    def pixels_mm(self, number: int) -> Float:
        """Places ``(row, column, 3)`` of the window's pixels on a slice, LPS mm."""
        rows, columns = self.window()
        y, x = np.mgrid[rows, columns]
        index = np.stack([x, y, np.full_like(x, number)], axis=-1).astype(float)
        return transform_points(self.mr_from_index, index)
