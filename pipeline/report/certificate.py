"""The certificate of a field as people read it: its distances, and each fixture's forces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.report.page import Table, figure_row, flat_table

COLUMNS = {
    "stiffness_n_per_m": ("by its law, N/m", "{:.0f}"),
    "stiffness_measured_n_per_m": ("measured, N/m", "{:.0f}"),
    "stiffness_any_direction_p99_n_per_m": ("in any direction, p99, N/m", "{:.0f}"),
    "stiffness_any_direction_max_n_per_m": ("the most, N/m", "{:.0f}"),
    "stiffness_limit_n_per_m": ("device renders, N/m", "{:.0f}"),
    "beyond_limit_share": ("places beyond that", "{:.2%}"),
    "force_step_max_n_per_0_1_mm": ("most over 0.1 mm, N", "{:.2f}"),
    "force_change_max_n_per_ms": ("most over 1 ms, N", "{:.3f}"),
}
"""What is told of each fixture, in this order: a head, and how the figure is written."""


def tables(accuracy: Mapping[str, Any], allowed: Mapping[str, float]) -> list[Table]:
    """Forces by fixture, each beside its own law and device; then what had to be kept, beside the
    most that was ``allowed``; then what else is told of the surfaces.

    The largest force figures over all fixtures, which the field's description holds as well, are
    left out: side by side they would be those of different fixtures.
    """
    fixtures: Mapping[str, Mapping[str, Any]] = accuracy["fixtures"]
    of_forces = {name for one in fixtures.values() for name in one}
    told = of_forces | set(allowed)
    rest = {name: value for name, value in accuracy.items() if name not in told}
    rows = [
        (name, *(_written(one[column], style) for column, (_, style) in COLUMNS.items()))
        for name, one in fixtures.items()
    ]
    head = ["stiffness and steps of force", *(head for head, _ in COLUMNS.values())]
    kept = [
        (*figure_row(name, accuracy[name]), figure_row(name, most)[1])
        for name, most in allowed.items()
    ]
    return [
        Table(head, rows),
        Table(["accuracy certificate", "measured", "at most"], kept),
        flat_table("beside it", rest),
    ]


def _written(value: float | None, style: str) -> str:
    return "unknown" if value is None else style.format(value)
