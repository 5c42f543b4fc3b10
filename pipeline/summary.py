"""What the command line says at the end of a run, from what ``run.json`` holds."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from pipeline.doubts import doubts, few_phases, odd_orientation, reformatted

LARGEST_DELAY_S = 0.1
"""A scanner stamps its frames later than they are by tens of milliseconds."""

TOO_FAR_FOR_A_CLOCK = (
    "; far for a scanner's delay: if it is the MR's phases that do not begin at the R peak, forces "
    "come that much at the wrong time"
)


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
    lines += [f"{word:9s} {text}" for word, text in remarks(record["stages"])]
    lines += _verdict(record["stages"].get("register", {}))
    bake = record["stages"].get("bake", {})
    example = bake.get("figures", {}).get("example")
    if example and bake["status"] != "stale":
        point = " ".join(f"{value:g}" for value in example["point_mm"])
        # The line is there to be pasted, and names may hold spaces.
        field = shlex.quote(str(products / "bake" / "field.zarr"))
        lines.append(
            f"query     beatfield query {field} --point {point} --phase {example['phase']}"
        )
    page = products / "report" / "index.html"
    lines.append(f"products  {products}")
    if page.exists():
        stale = record["stages"].get("report", {}).get("status") == "stale"
        lines.append(f"report    {page}" + (" (stale: `beatfield run` renews it)" if stale else ""))
    return "\n".join(lines)


def remarks(stages: dict[str, Any]) -> list[tuple[str, str]]:
    """What a person must know of finished stages before a field is used: a word, and what it is."""
    figures = {
        name: stage.get("figures", {})
        for name, stage in stages.items()
        if stage.get("status") != "stale"
    }
    ingest, segment = figures.get("ingest", {}), figures.get("segment", {})
    return [
        *[("timing", text) for text in of_timing(ingest)],
        *[("input", text) for text in ingest.get("remarks", [])],
        *_drawn_between(ingest),
        *_series_left_out(ingest),
        *[("input", text) for text in figures.get("register", {}).get("remarks", [])],
        *[("heart", text) for text in odd_orientation(segment)],
        *[("heart", text) for text in reformatted(segment)],
        *[("cut off", text) for text in cut_off_by(segment.get("cut_off", {}), ingest)],
        *[("cut off", text) for text in cut_sideways_by(segment.get("cut_sideways", {}), ingest)],
        *[("doubtful", text) for text in doubts(segment, figures.get("surface", {}))],
        *[("doubtful", text) for text in few_phases(figures.get("bake", {}).get("accuracy", {}))],
        *_left_out(figures),
    ]


def of_timing(ingest: dict[str, Any]) -> list[str]:
    """A sentence where nothing tells when two phases are."""
    if not str(ingest.get("timing_source", "")).startswith("NIfTI") or ingest["phases"] > 2:
        return []
    return [
        f"two phases evenly over a beat of {ingest['rr_s']:g} s, for the header's time step is "
        "all that tells; write timing.json if that is not so"
    ]


def _drawn_between(ingest: dict[str, Any]) -> list[tuple[str, str]]:
    numbers = ingest.get("interpolated_slices", [])
    if not numbers:
        return []
    named = ", ".join(map(str, numbers))
    if len(numbers) == 1:
        return [("input", f"slice {named} is drawn between its neighbours")]
    return [("input", f"slices {named} are drawn between their neighbours")]


def _series_left_out(ingest: dict[str, Any]) -> list[tuple[str, str]]:
    unused = series_left_out(ingest)
    if not unused:
        return []
    others = f", and {len(unused) - 1} more that the report names" if len(unused) > 1 else ""
    return [("left out", f"of the cine's folder {unused[0]}{others}")]


def series_left_out(ingest: dict[str, Any]) -> list[str]:
    """Series of the cine's folder of which nothing is made, neither the stack nor a long-axis view.

    >>> series_left_out({"left_out": ["a: scout", "b: across"], "long_axis": ["b"]})
    ['a: scout']
    """
    views = tuple(f"{name}:" for name in ingest.get("long_axis", []))
    return [text for text in ingest.get("left_out", []) if not text.startswith(views)]


def cut_off_by(cut_off: dict[str, dict[Any, int]], ingest: dict[str, Any]) -> list[str]:
    """Sentences on the structures that end where the stack does, and not by themselves."""
    places = {
        f"{body}:{end}": f"at slice {end} in {phases} of {ingest['phases']} phases"
        for body, ends in cut_off.items()
        for end, phases in ends.items()
    }
    return [
        f"{', '.join(body.partition(':')[0] for body in bodies)} {place}: surfaces and volumes "
        "end there"
        for place, bodies in by_reason(places).items()
    ]


def cut_sideways_by(cut: dict[str, int], ingest: dict[str, Any]) -> list[str]:
    """Sentences on the structures that end where the images do at their sides."""
    places = {body: f"in {phases} of {ingest['phases']} phases" for body, phases in cut.items()}
    return [
        f"{', '.join(bodies)} at the images' edge {place}: surfaces and volumes end there"
        for place, bodies in by_reason(places).items()
    ]


def _left_out(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Surfaces and default fixtures that this study's images do not give."""
    return [
        ("left out", f"{what} {', '.join(names)}: {why}")
        for stage, what in (("surface", "surface"), ("bake", "fixture"))
        for why, names in by_reason(figures.get(stage, {}).get("left_out", {})).items()
    ]


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
    """What the registration is worth, and what it put right; nothing where none still holds."""
    figures = register.get("figures", {})
    if "verdict" not in figures or register["status"] == "stale":
        return []
    line = (
        f"{figures['verdict']}, expected error over the heart {figures['expected_tre_mm']:.1f} mm"
        f" (under 2 mm with a chance of {figures['chance_under_2_mm']:.0%}), borne out by "
        f"{figures['valid']} of {figures['frames']} frames"
    )
    # Corrections are named only where the settings let calibrations be wrong.
    wider = ", widened by calibration: per_sweep" if figures["calibration"] else ""
    because = f", because: {figures['reason']}" if figures["reason"] else ""
    lines = [f"verdict   registration {line}{wider}{because}"]
    lines += [f"clock     {text}" for text in clock_put_right(figures)]
    return lines


def clock_put_right(register: dict[str, Any]) -> list[str]:
    """A sentence where the times of the ultrasound were corrected."""
    applied_s = register.get("us_clock_applied_s", 0.0)
    if not applied_s:
        return []
    way = "ahead of" if applied_s > 0 else "behind"
    far = TOO_FAR_FOR_A_CLOCK if abs(applied_s) > LARGEST_DELAY_S else ""
    return [
        f"ultrasound {abs(applied_s):.3f} s {way} its ECG, which was put right "
        f"(register.clock_offset){far}"
    ]


def _timed(stage: dict[str, Any]) -> bool:
    return stage.get("peak_memory_mb") is not None
