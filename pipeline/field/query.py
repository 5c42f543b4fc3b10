"""One question to a field, answered for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.field.reader import ForceField

MOST_BEATS = 10
"""Nobody asks for a phase so many heartbeats away, but many a one for 300 milliseconds."""


def query_point(
    path: Path, point_mm: tuple[float, float, float], phase: float, fixture: str | None = None
) -> dict[str, dict[str, Any]]:
    """Distance, potential and force of every fixture, or of one, at a point.

    Parameters
    ----------
    path
        The ``field.zarr`` folder.
    point_mm
        ``(x, y, z)``, LPS mm of the MR frame.
    phase
        Share of the heartbeat since the R peak; only its fraction counts. From ten heartbeats on
        it is taken for milliseconds, and refused.
    fixture
        Name of the only one to ask; all of them when None.

    Returns
    -------
    By fixture: ``structure``, ``distance_mm``, ``potential``, ``force_n`` (x, y, z) and
    ``inside_grid``, False where the answer is that of the grid's nearest boundary point.
    ``force_rate_n_per_ms`` is how quickly the force changes for a tool at rest there, None where
    the heartbeat's duration is unknown; ``stiffness_n_per_m`` is the fixture's steepest slope,
    ``stiffness_measured_n_per_m`` the steepest that its certificate found, None where it has none,
    and ``stiffness_limit_n_per_m`` what its device can render, None where that is unknown.

    Raises
    ------
    InputError
        When the field cannot be read, is damaged or has a fixture that its device cannot render,
        the fixture is unknown, a number is not finite or the phase ten heartbeats away.
    """
    field = ForceField.open(path)
    if MOST_BEATS <= abs(phase) < np.inf:
        raise InputError(
            f"phase {phase:g}: is told in shares of the heartbeat, such as 0.35, not in "
            "milliseconds; divide the time since the R peak by the RR interval"
        )
    points = [point_mm]
    if fixture is not None:
        field.potential(points, phase, fixture)
    return {
        name: {
            "structure": law.structure,
            "distance_mm": float(field.distance_mm(points, phase, law.structure)[0]),
            "potential": float(field.potential(points, phase, name)[0]),
            "force_n": field.force_n(points, phase, name)[0].tolist(),
            "inside_grid": bool(field.contains(points)[0]),
            "force_rate_n_per_ms": _force_rate(field, point_mm, phase, name),
            "stiffness_n_per_m": law.stiffness_n_per_m,
            "stiffness_measured_n_per_m": _measured(field, name),
            "stiffness_limit_n_per_m": law.device.stiffness_n_per_m,
        }
        for name, law in field.fixtures.items()
        if fixture in (None, name)
    }


def query_inside(
    path: Path, point_mm: tuple[float, float, float], phase: float, fixture: str | None = None
) -> dict[str, dict[str, Any]]:
    """As :func:`query_point`, of a point within the grid.

    Raises
    ------
    InputError
        As there, and when the point lies outside.
    """
    answers = query_point(path, point_mm, phase, fixture)
    if not all(answer["inside_grid"] for answer in answers.values()):
        where = " ".join(f"{value:g}" for value in point_mm)
        raise InputError(
            f"--point {where}: lies outside the baked grid of {path}; give LPS millimetres of "
            "the MR frame, near the surfaces"
        )
    return answers


def limits_words(answer: Mapping[str, Any]) -> str:
    """What a device has to follow: how fast the force changes, and how stiff the fixture is."""
    rate = answer["force_rate_n_per_ms"]
    changing = "" if rate is None else f", changing by {rate:.4f} N/ms"
    return f"{changing}, {stiffness_words(answer)}"


def stiffness_words(figures: Mapping[str, Any]) -> str:
    """A fixture's stiffness in words: by its law, as measured, and what its device can render.

    >>> found = {"stiffness_n_per_m": 321.4, "stiffness_measured_n_per_m": 391.2}
    >>> stiffness_words({**found, "stiffness_limit_n_per_m": 400.0})
    'stiffness 321 N/m by its law, at most 391 along the force as measured; the device renders 400'
    """
    measured, limit = figures["stiffness_measured_n_per_m"], figures["stiffness_limit_n_per_m"]
    found = "" if measured is None else f", at most {measured:.0f} along the force as measured"
    most = "" if limit is None else f"; the device renders {limit:.0f}"
    if limit is not None and measured is not None and measured > limit:
        most += ", less than measured"
    return f"stiffness {figures['stiffness_n_per_m']:.0f} N/m by its law{found}{most}"


def _measured(field: ForceField, name: str) -> float | None:
    """The fixture's stiffness by the field's certificate, N/m."""
    told = field.accuracy.get("fixtures", {})
    found = told.get(name, {}) if isinstance(told, dict) else {}
    measured = found.get("stiffness_measured_n_per_m") if isinstance(found, dict) else None
    return measured if isinstance(measured, int | float) else None


def _force_rate(
    field: ForceField, point_mm: tuple[float, float, float], phase: float, name: str
) -> float | None:
    """Change of the force over the millisecond about a moment, at a place at rest, N/ms."""
    if field.rr_s is None:
        return None
    beats = 0.001 / field.rr_s
    moments = np.array([phase - beats / 2, phase + beats / 2])
    before, after = field.force_n([point_mm, point_mm], moments, name)
    return float(np.linalg.norm(after - before))
