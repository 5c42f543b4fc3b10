"""Correction of a sweep's image calibration: what it is, and how to put pictures right by it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.geometry import Float, Integer


@dataclass(frozen=True, slots=True)
class Correction:
    """Where the pictures of one sweep truly lie."""

    sweep: str
    """Its name."""

    corrected_from_calibrated: Float
    """4x4, rigid, mm, in the axes of `tracker_from_picture`: from where the calibration puts a
    point of the picture to where it lies."""

    origin_px: tuple[int, int]
    """Column and row of the pixel in the middle of the sector: the origin of these axes."""

    covariance: Float
    """``(6, 6)`` of its error: shift (mm), then rotation vector (rad), about the origin."""

    def table(self) -> dict[str, Any]:
        """As it is written to a file."""
        return {
            "sweep": self.sweep,
            "corrected_from_calibrated": self.corrected_from_calibrated.tolist(),
            "origin_px": list(self.origin_px),
            "covariance": self.covariance.tolist(),
        }

    def words(self) -> str:
        """Sizes of shift and turn, with the standard deviation along or about an axis."""
        shift_mm = np.linalg.norm(self.corrected_from_calibrated[:3, 3])
        turn = Rotation.from_matrix(self.corrected_from_calibrated[:3, :3]).magnitude()
        spread = np.diag(self.covariance)
        sd_mm, sd = np.sqrt(spread[:3].mean()), np.sqrt(spread[3:].mean())
        return (
            f"calibration of {self.sweep} corrected by {shift_mm:.1f} ± {sd_mm:.1f} mm and "
            f"{np.degrees(turn):.1f} ± {np.degrees(sd):.1f} degrees"
        )

    def applied(self, tracker_from_image: Float) -> Float:
        """``(n, 4, 4)`` transforms of the sweep's pixels with the calibration put right."""
        planes = tracker_from_picture(tracker_from_image, np.array(self.origin_px))
        motion = planes @ self.corrected_from_calibrated @ np.linalg.inv(planes)
        return np.asarray(motion @ tracker_from_image)


def tracker_from_picture(tracker_from_image: Float, origin_px: Integer) -> Float:
    """``(n, 4, 4)`` rigid frames of pictures in tracker millimetres.

    The origin is the pixel ``origin_px`` (column, row); x runs along a row of pixels, y down the
    columns as far as they are square to it, z is x cross y.

    Parameters
    ----------
    tracker_from_image
        ``(n, 4, 4)``: pixel ``(column, row, 0)`` to tracker millimetres.
    """
    across, down = tracker_from_image[:, :3, 0], tracker_from_image[:, :3, 1]
    x = across / np.linalg.norm(across, axis=1, keepdims=True)
    z = np.cross(x, down)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    planes = np.tile(np.eye(4), (len(x), 1, 1))
    planes[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    planes[:, :3, 3] = tracker_from_image[:, :3, :2] @ origin_px + tracker_from_image[:, :3, 3]
    return planes


def put_right(
    tracker_from_image: Float, sweep: str, written: Sequence[Mapping[str, Any]] | None
) -> Float:
    """``(n, 4, 4)`` transforms of a sweep's pixels, corrected where its correction was written.

    Parameters
    ----------
    written
        Of each sweep, as `Correction.table` gives it; None where calibrations were not looked at.
    """
    for one in written or ():
        if one["sweep"] == sweep:
            column, row = one["origin_px"]
            motion, covariance = one["corrected_from_calibrated"], one["covariance"]
            correction = Correction(sweep, np.array(motion), (column, row), np.array(covariance))
            return correction.applied(tracker_from_image)
    return tracker_from_image
