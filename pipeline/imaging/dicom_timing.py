"""When a DICOM frame was taken within its heartbeat, and how long that lasted."""

from __future__ import annotations

import itertools
from typing import Any

TRIGGER_TIMES = ("TriggerTime", "NominalCardiacTriggerDelayTime")
"""The same moment in classic and in Enhanced objects."""


def times_ms(timing: Any, rr_ms: float | None) -> dict[str, float]:
    """What tells the frame's moment, the most trusted first.

    The trigger time comes first; where it does not tell frames apart, the actual delay or the
    percentage of the cycle may.
    """
    times: dict[str, float] = {}
    trigger = next((name for name in TRIGGER_TIMES if _given(timing, name)), None)
    if trigger:
        times["trigger time"] = float(timing.get(trigger))
    if _given(timing, "ActualCardiacTriggerDelayTime"):
        times["ActualCardiacTriggerDelayTime"] = float(timing.ActualCardiacTriggerDelayTime)
    if _given(timing, "NominalPercentageOfCardiacPhase") and rr_ms is not None:
        share = float(timing.NominalPercentageOfCardiacPhase) / 100
        times["NominalPercentageOfCardiacPhase"] = share * rr_ms
    return times


def _given(item: Any, name: str) -> bool:
    return item.get(name) not in (None, "")


def rr_intervals_ms(timing: Any, dataset: Any) -> dict[str, float]:
    """Length of the beat by each attribute that tells it, the best first, of the frame or, behind
    that, of its whole object."""
    names = ("NominalInterval", "RRIntervalTimeNominal", "HeartRate", "CardiacRRIntervalSpecified")
    told: dict[str, float] = {}
    for name, item in itertools.product(names, (timing, dataset)):
        if _given(item, name) and float(item.get(name)) > 0:
            value = float(item.get(name))
            told.setdefault(name, 60000 / value if name == "HeartRate" else value)
    return told
