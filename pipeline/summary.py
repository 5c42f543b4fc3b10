"""What the command line says at the end of a run, from what ``run.json`` holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def summary(record: dict[str, Any], products: Path) -> str:
    """A line for each stage, then what to look at.

    Parameters
    ----------
    record
        What ``run.json`` says.
    products
        The patient's folder of products.
    """
    lines = [
        f"{name:9s} {stage['status']:8s}"
        + (f" {stage['seconds']:7.1f} s {stage['peak_memory_mb']:6d} MB" if _timed(stage) else "")
        + (f" {stage['cause']}" if "cause" in stage else "")
        for name, stage in record["stages"].items()
    ]
    seconds = sum(stage["seconds"] for stage in record["stages"].values() if _timed(stage))
    lines.append(f"{'total':9s} {record['status']:8s} {seconds:7.1f} s")
    lines += _orientation(record["stages"].get("segment", {}))
    lines += _left_out(record["stages"])
    lines += _verdict(record["stages"].get("register", {}))
    bake = record["stages"].get("bake", {})
    example = bake.get("figures", {}).get("example")
    if example and bake["status"] != "stale":
        point = " ".join(f"{value:g}" for value in example["point_mm"])
        field = products / "bake" / "field.zarr"
        lines.append(
            f"query     beatfield query {field} --point {point} --phase {example['phase']}"
        )
    page = products / "report" / "index.html"
    lines.append(f"products  {products}")
    if page.exists():
        stale = record["stages"].get("report", {}).get("status") == "stale"
        lines.append(f"report    {page}" + (" (stale: `beatfield run` renews it)" if stale else ""))
    return "\n".join(lines)


def _orientation(segment: dict[str, Any]) -> list[str]:
    """A line where the heart lies otherwise than the file says."""
    orientation = segment.get("figures", {}).get("orientation", "")
    if not orientation.startswith("other") or segment["status"] == "stale":
        return []
    return [f"heart     lies {orientation}; check the file's orientation and order of slices"]


def _left_out(stages: dict[str, Any]) -> list[str]:
    """A line for each surface and default fixture that this study's images do not give."""
    lines = []
    for stage, what in (("surface", "surface"), ("bake", "fixture")):
        if stages.get(stage, {}).get("status") != "stale":
            left_out = stages.get(stage, {}).get("figures", {}).get("left_out", {})
            for why, names in by_reason(left_out).items():
                lines.append(f"left out  {what} {', '.join(names)}: {why}")
    return lines


def by_reason(left_out: dict[str, str]) -> dict[str, list[str]]:
    """Names that share a reason, by reason.

    >>> by_reason({"aorta": "unseen", "left_atrium": "unseen"})
    {'unseen': ['aorta', 'left_atrium']}
    """
    names: dict[str, list[str]] = {}
    for name, why in left_out.items():
        names.setdefault(why, []).append(name)
    return names


def _verdict(register: dict[str, Any]) -> list[str]:
    """What the registration is worth, in a line; none where there is none that still holds."""
    figures = register.get("figures", {})
    if "verdict" not in figures or register["status"] == "stale":
        return []
    line = (
        f"{figures['verdict']}, expected error over the heart {figures['expected_tre_mm']:.1f} mm"
        f" (under 2 mm with a chance of {figures['chance_under_2_mm']:.0%})"
    )
    # Corrections are named only where the settings let calibrations be wrong.
    wider = ", widened by calibration: per_sweep" if figures["calibration"] else ""
    because = f", because: {figures['reason']}" if figures["reason"] else ""
    return [f"verdict   registration {line}{wider}{because}"]


def _timed(stage: dict[str, Any]) -> bool:
    return stage.get("seconds") is not None
