"""What a reader may be asked: numbers of the right shape, and errors that say what came."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float


def four_floats(
    x_mm: float, y_mm: float, z_mm: float, phase: float
) -> tuple[float, float, float, float]:
    """The numbers as floats: of any other type, the kernels would be compiled anew for seconds.

    Raises
    ------
    InputError
        When one is no number.
    """
    try:
        return float(x_mm), float(y_mm), float(z_mm), float(phase)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"point ({x_mm}, {y_mm}, {z_mm}) at phase {phase} is not four numbers; "
            "give x, y and z in mm and the phase"
        ) from None


def two_floats(phase: float, bound_n: float) -> tuple[float, float]:
    """The same of the phase and the bound that a tool's force is asked with.

    Raises
    ------
    InputError
        When the phase is not finite, or the bound is not above 0.
    """
    try:
        phase, bound_n = float(phase), float(bound_n)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"phase = {phase!r}, bound_n = {bound_n!r}; give two numbers") from None
    if not 0 < bound_n < math.inf:
        raise InputError(f"bound_n = {bound_n:g}; give newtons above 0")
    if not math.isfinite(phase):
        raise InputError(f"phase = {phase:g}; give a share of the heartbeat")
    return phase, bound_n


def no_answer(path: Path, x_mm: float, y_mm: float, z_mm: float, phase: float) -> InputError:
    """What to raise when a question's answer is none: the question's fault, or the field's."""
    # The sum, as in the kernels: numbers so large that theirs is infinite are not answered either.
    if math.isfinite(float(x_mm) + float(y_mm) + float(z_mm) + float(phase)):
        return damaged(path)
    return InputError(
        f"point ({x_mm}, {y_mm}, {z_mm}) mm at phase {phase} is not finite; every number must be"
    )


def damaged(path: Path) -> InputError:
    """What to raise when a question of finite numbers has an answer that is none."""
    return InputError(
        f"{path}: is damaged: a value in it is not finite; `beatfield verify {path}` tells where"
    )


def require_answers(answers: Float, path: Path) -> None:
    """Raise InputError unless all answers of the field at ``path`` are finite."""
    if not np.isfinite(answers).all():
        raise damaged(path)


def require_finite(points: Float, phases: Float | None = None, first: int = 0) -> None:
    """Raise InputError unless all numbers are finite; ``first`` is the first point's number."""
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        where = f"point {first + bad} is not finite: {points[bad]}"
        raise InputError(f"{where}; every coordinate must be mm")
    if phases is not None and not np.isfinite(phases).all():
        raise InputError("phase must be finite: a share of the heartbeat, whose fraction counts")


def as_numbers(values: npt.ArrayLike, name: str) -> Float:
    """An array of float64; raises InputError where there is none."""
    if np.ma.is_masked(values):
        raise InputError(f"{name}: some are masked; leave those out")
    try:
        if (given := np.asarray(values).dtype).kind not in "biufO":
            raise InputError(f"{name} must be numbers, got {given}")
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} must be numbers ({error})") from None


def as_points(points_mm: npt.ArrayLike) -> Float:
    """``(n, 3)``; raises InputError for any other shape."""
    points = as_numbers(points_mm, "points")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"points must be (n, 3) in mm, got an array of shape {points.shape}; of one point give "
            "[[x, y, z]], or ask force_at or distance_at"
        )
    return points


def as_phases(phase: npt.ArrayLike, count: int) -> Float:
    """``(1,)`` or ``(count,)``; raises InputError for any other shape."""
    phases = np.atleast_1d(as_numbers(phase, "phase"))
    if phases.shape not in {(1,), (count,)}:
        raise InputError(f"phase must be one number or ({count},), got shape {phases.shape}")
    return phases
