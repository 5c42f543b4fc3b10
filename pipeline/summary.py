"""What the command line says at the end of a run, from what ``run.json`` holds."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from pipeline.imaging.settings import LOW_CONFIDENCE

TOLD_BELOW = 0.7
"""Confidence at which labels are told beside the report, too: of 40 sound studies 2 had less."""


MUSCLE_RANGE = 1.4
"""Largest over smallest volume of heart muscle, which hardly changes through a beat, beyond which
its labels are told to be doubtful: the most was 1.09 in 23 studies of the phantom, and 1.29 in 24
stacks of a second renderer, noisy or of thick slices; images with inverted contrast gave 1.89."""

UNEQUAL_STROKES = 0.15
"""By what share of the larger one stroke volumes may differ: those found in nine studies of the
phantom, whose valves are tight, did by 0.08 at most."""

EARLIEST_SYSTOLE, LATEST_SYSTOLE = 0.17, 0.15
"""Share of the beat by which the left ventricle's end of systole may lie before and after its usual
place (`pipeline.registration.clock.systole_s`). A pulse reaches the finger a fifth of a beat after
the R peak or later; phases in reverse lie as far off in slow hearts, in fast ones by less."""

LEAST_EJECTION = 0.15
"""Of a heart that ejects less than this share, noise decides when it is smallest."""

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
        *_orientation(segment),
        *[("cut off", text) for text in cut_off_by(segment.get("cut_off", {}), ingest)],
        *[("cut off", text) for text in cut_sideways_by(segment.get("cut_sideways", {}), ingest)],
        *[("doubtful", text) for text in doubts(segment, figures.get("surface", {}))],
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
    numbers = ", ".join(map(str, ingest.get("interpolated_slices", [])))
    return [("input", f"slices {numbers} are drawn between their neighbours")] if numbers else []


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


def _orientation(segment: dict[str, Any]) -> list[tuple[str, str]]:
    orientation = segment.get("orientation", "")
    if not orientation.startswith("other"):
        return []
    return [("heart", f"lies {orientation}; check the file's orientation and order of slices")]


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


def doubts(segment: dict[str, Any], surface: dict[str, Any]) -> list[str]:
    """Sentences on what speaks against labels or times, of the figures of two stages."""
    of_labels = *low_confidence(segment), *astray(segment), *muscle_changes(segment)
    of_surfaces = *unequal_strokes(segment, surface), *odd_systole(surface)
    return [*of_labels, *of_surfaces, *lost_pieces(surface), *crossings(surface)]


def astray(segment: dict[str, Any]) -> list[str]:
    """A sentence where slices lay farther aside than another usual breath-hold takes them.

    >>> astray({"astray_mm": {"5": 19.4}})
    ['slice 5 showed the heart 19 mm beside where the others show it, and was moved back: it was \
held in another breath, or labelled wrongly']
    """
    return [
        f"slice {number} showed the heart {aside_mm:.0f} mm beside where the others show it, and "
        "was moved back: it was held in another breath, or labelled wrongly"
        for number, aside_mm in segment.get("astray_mm", {}).items()
    ]


def lost_pieces(surface: dict[str, Any]) -> list[str]:
    """A sentence for each surface that leaves out a good part of its labels, which lies apart.

    >>> lost_pieces({"left_out_ml": {"rv_endocardium": {"4": 9.1}}})
    ['surfaces: rv_endocardium leaves out up to 9.1 ml of its labels, which lie apart, in phase 4']
    """
    return [
        f"surfaces: {name} leaves out up to {max(by_phase.values()):.1f} ml of its labels, which "
        f"lie apart, in phase {', '.join(map(str, by_phase))}"
        for name, by_phase in surface.get("left_out_ml", {}).items()
    ]


def crossings(surface: dict[str, Any]) -> list[str]:
    """A sentence where surfaces pass through themselves.

    >>> crossings({"crossing_triangles": {"epicardium": 0, "heart": 4}})
    ['surfaces: heart passes through itself (4 triangles over all phases); look before you use it']
    """
    counts = surface.get("crossing_triangles", {})
    return [
        f"surfaces: {name} passes through itself ({count} triangles over all phases); look before "
        "you use it"
        for name, count in counts.items()
        if count
    ]


def low_confidence(segment: dict[str, Any]) -> list[str]:
    """A sentence where the least certain labels are far below the others."""
    lowest = segment.get("lowest_confidence", 1.0)
    if lowest >= TOLD_BELOW:
        return []
    at = segment["least_certain"]
    return [
        f"labels of slice {at['slice']} in phase {at['phase']}, whose confidence of "
        f"{lowest:.2f} is the lowest; the report shows all below {LOW_CONFIDENCE:g}"
    ]


def muscle_changes(segment: dict[str, Any]) -> list[str]:
    """A sentence where the muscle's volume changes through the beat as muscle does not."""
    volumes_ml = segment.get("volumes_ml", {}).get("lv_myocardium", [])
    if not volumes_ml or max(volumes_ml) <= MUSCLE_RANGE * min(volumes_ml):
        return []
    least, most = (volumes_ml.index(pick(volumes_ml)) for pick in (min, max))
    return [
        f"labels: of heart muscle phase {least} has {volumes_ml[least]:.0f} ml and phase {most} "
        f"{volumes_ml[most]:.0f} ml, though muscle keeps its volume; look at the contours"
    ]


def unequal_strokes(segment: dict[str, Any], surface: dict[str, Any]) -> list[str]:
    """A sentence where one ventricle ejects clearly more than the other, which it fills."""
    volumes_ml = surface.get("volumes_ml", {})
    both = [volumes_ml.get(name) for name in ("lv_endocardium", "rv_endocardium")]
    cut = {*segment.get("cut_off", {}), *segment.get("cut_sideways", {})}
    if not all(both) or cut & {"left ventricle", "right ventricle"}:
        return []
    left_ml, right_ml = (max(one) - min(one) for one in both)
    if abs(left_ml - right_ml) <= UNEQUAL_STROKES * max(left_ml, right_ml):
        return []
    return [
        f"volumes: the left ventricle ejects {left_ml:.0f} ml and the right one {right_ml:.0f} ml; "
        "where no valve leaks and no shunt is known, look at the contours at base and tip"
    ]


def odd_systole(surface: dict[str, Any]) -> list[str]:
    """A sentence where the left ventricle is smallest when it cannot be after an R peak.

    Phases that do not begin at the R peak move with the heart as well as others do, and ultrasound
    fits them at an offset of its clock: nothing else tells, and each force comes at another time.
    """
    found = surface.get("end_systole")
    if not found or surface.get("lv_ejection_fraction", 0.0) < LEAST_EJECTION:
        return []
    late = (found["phase"] - found["usual"] + 0.5) % 1 - 0.5
    if -EARLIEST_SYSTOLE <= late <= LATEST_SYSTOLE:
        return []
    return [
        f"times: the left ventricle is smallest at phase {found['phase']:.2f}, where "
        f"{found['usual']:.2f} is usual at this heart rate; were images gated by the pulse at a "
        "finger, by another wave than R, or stored in reverse? Then forces come at the wrong time: "
        "give times after the R peak"
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
    return stage.get("seconds") is not None
