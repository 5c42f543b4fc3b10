"""One question to a field, answered for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.field.reader import ForceField


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
        Place in the heartbeat, [0, 1).
    fixture
        Name of the only one to ask; all of them when None.

    Returns
    -------
    By fixture: ``structure``, ``distance_mm``, ``potential``, ``force_n`` (x, y, z) and
    ``inside_grid``, False where the answer is that of the grid's nearest boundary point.

    Raises
    ------
    InputError
        When the field cannot be read, the fixture is unknown or a number is not finite.
    """
    field = ForceField.open(path)
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
        }
        for name, law in field.fixtures.items()
        if fixture in (None, name)
    }
