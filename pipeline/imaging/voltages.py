"""Names of voltages, as recorders write them."""

from __future__ import annotations

from pipeline.errors import InputError

MILLIVOLTS = {"v": 1e3, "mv": 1.0, "uv": 1e-3, "nv": 1e-6}
"""Millivolts in one unit, by its name in lower case."""

UNCALIBRATED = ("", "1", "adu", "none", "?")
"""What recorders write who know no unit."""


def unit_name(unit: str) -> str:
    """A unit's name in lower case, with u for micro."""
    return unit.strip().replace("µ", "u").replace("μ", "u").lower()


def is_voltage(unit: str) -> bool:
    """Whether a unit is that of a voltage."""
    return unit_name(unit) in MILLIVOLTS


def millivolts(unit: str, lead: str, where: str) -> float:
    """Millivolts in one ``unit``.

    Raises
    ------
    InputError
        When that is no unit of a voltage.
    """
    if not is_voltage(unit):
        remedy = "take it out, for pressures and breathing have beats of their own"
        if unit_name(unit) in UNCALIBRATED:
            remedy = (
                "if it is a lead that was not calibrated, write mV: its scale changes no R peak"
            )
        raise InputError(
            f"{where}: channel {lead!r} is in {unit!r}; a lead of an ECG is a voltage, in V, mV, "
            f"uV or nV: {remedy}"
        )
    return MILLIVOLTS[unit_name(unit)]
