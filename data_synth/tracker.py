"""The faults of what a tracked recording says about itself: poses, calibration, time stamps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from data_synth.window import rigid, unit

Float = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def off_by(rng: np.random.Generator, shift_mm: float, turn_deg: float) -> Float:
    """4x4 of a shift and a turn of set size, each in a random direction."""
    way, axis = (unit(one) for one in rng.normal(size=(2, 3)))
    return rigid(np.deg2rad(turn_deg) * axis, shift_mm * way)


def unsteady(rng: np.random.Generator, count: int, shift_mm: float, turn_deg: float) -> Float:
    """``(count, 4, 4)`` small motions; standard deviations along and about each axis."""
    rotvec = np.deg2rad(turn_deg) * rng.normal(size=(count, 3))
    shift = shift_mm * rng.normal(size=(count, 3))
    return np.stack([rigid(r, s) for r, s in zip(rotvec, shift, strict=True)])


def stretch(rng: np.random.Generator, count: int, chance: float, length: int) -> Mask:
    """``(count,)`` True for one stretch of ``length``, somewhere, by chance; else nowhere."""
    happens, where = rng.random(2)
    first = int(where * (max(count - length, 0) + 1))
    frames = np.arange(count)
    return np.asarray((happens < chance) & (frames >= first) & (frames < first + length))


def frozen(poses: Float, unseen: Mask) -> Float:
    """Poses ``(n, 4, 4)`` with the last seen one in place of each unseen; identity before any."""
    kept = poses.copy()
    for k in np.flatnonzero(unseen):
        kept[k] = kept[k - 1] if k else np.eye(4)
    return kept
