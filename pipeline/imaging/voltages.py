"""Names of voltages, as recorders write them."""

from __future__ import annotations

from pipeline.errors import InputError

MILLIVOLTS = {"v": 1e3, "mv": 1.0, "uv": 1e-3, "nv": 1e-6}
"""Millivolts in one unit, by its name in lower case."""


def unit_name(unit: str) -> str:
    """A unit's name in lower case, with u for micro."""
    return unit.strip().replace("µ", "u").replace("μ", "u").lower()


def is_voltage(unit: str) -> bool:
    """Whether a unit is that of a voltage."""
    return unit_name(unit) in MILLIVOLTS


def millivolts(unit: str, where: str) -> float:
    """Millivolts in one ``unit``."""
    if not is_voltage(unit):
        raise InputError(
            f"{where}: a lead is in {unit!r}; it needs a voltage: V, mV, uV or nV (of a record "
            "that was not calibrated, write mV: the scale of a lead changes no R peak)"
        )
    return MILLIVOLTS[unit_name(unit)]
