"""The page's sections about the heart itself: what was seen in the images, and how it moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.doubts import ranges
from pipeline.geometry import Float, MovingSurface
from pipeline.report import curves, slices
from pipeline.report.animation import NoAnimation, beating_surfaces, first_frame
from pipeline.report.moments import Moments
from pipeline.report.page import Picture, Section, Table, picture
from pipeline.report.style import as_png, as_svg, as_webp
from pipeline.surface.measures import mean_lv_mass_g

MOST_DOUBTS = 12

CONTOUR_DOTS_PER_INCH = 110


def segmentation(shown: Moments, confidence: Float, low: float) -> Section:
    """Contours on every slice at each moment, and the confidence ``(phase, z)`` of each."""
    here = confidence[list(shown.numbers)]
    pictures = []
    for moment, (name, number) in enumerate(zip(shown.names, shown.numbers, strict=True)):
        grid = as_webp(slices.contours(shown, moment, here, low), CONTOUR_DOTS_PER_INCH)
        caption = f"{name} (phase {number}): each slice with its confidence"
        pictures.append(picture(caption, grid, "webp"))
    cells = slices.confidence_map(confidence, low)
    caption = f"Confidence of each slice and phase; below {low:.2f} it is marked"
    pictures.append(picture(caption, as_png(cells, 110), "png"))
    found = slices.doubts(confidence, low)
    return Section(
        "Segmentation",
        _seen(shown, confidence, slices.worst_slices(here, low)),
        pictures,
        [_doubt_table(found)] if found else [],
    )


def _seen(shown: Moments, confidence: Float, always: list[int]) -> str:
    count = shown.labels.shape[1]
    chosen = len(slices.shown_slices(shown.labels, always))
    text = "Chambers and heart muscle on the cine's own slices, counted from 0, as phases are."
    if chosen < count:
        text += f" {chosen} of the {count} slices are shown."
    text += f" {slices.how_it_lies(shown)}"
    return f"{text} Lowest confidence: {slices.lowest_place(confidence)}."


def _doubt_table(found: list[slices.Doubt]) -> Table:
    rows = [
        (str(one.slice), ranges(one.phases), f"{one.lowest:.2f}") for one in found[:MOST_DOUBTS]
    ]
    if len(found) > MOST_DOUBTS:
        rows.append((f"and {len(found) - MOST_DOUBTS} more", "", ""))
    return Table(("doubtful slice", "in phases", "lowest confidence"), rows)


def movement(
    surfaces: Mapping[str, MovingSurface], rr_s: float, phases: Float, measures: Mapping[str, Any]
) -> Section:
    """The beating surfaces, and the curves of their ``measures.json``.

    Where the machine cannot draw in 3D the section says so in the animation's place; there is no
    map of segments where no segment was found.
    """
    shown: list[Picture] = []
    told = "Closed surfaces whose vertices are the same material points in every phase."
    try:
        animation = beating_surfaces(surfaces, rr_s)
    except NoAnimation as reason:
        told += f" They are not shown beating: {reason}."
    else:
        caption = (
            "One heartbeat, seen from the front left: left ventricle orange, right ventricle "
            "green, atria yellow (left) and pink, aorta blue"
        )
        shown.append(picture(caption, animation, "webp", first_frame(animation)))
    volumes = as_svg(curves.volume_curves(phases, measures["volumes_ml"]))
    shown.append(picture("Volumes through the cycle", volumes, "svg"))
    shown += _muscle(phases, measures)
    return Section("Surfaces", told, shown)


def _muscle(phases: Float, measures: Mapping[str, Any]) -> list[Picture]:
    thickness = measures["lv_wall_thickness_mm"]
    muscle = as_svg(curves.muscle_curves(phases, measures["lv_mass_g"], thickness["mean"]))
    shown = [picture("Left muscle: mass and mean wall thickness", muscle, "svg")]
    if thickness["segments"]:
        cells = as_png(curves.thickness_map(phases, thickness["segments"]), 110)
        told = (
            "Wall thickness by segment; the apex, which slices cut at a slant, is the least exact"
        )
        shown.append(picture(told, cells, "png"))
    return shown


def function_rows(measures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Volumes, ejection fractions and mass, for the table at the top of the page.

    A stack of the heart's tip alone may show no right ventricle.
    """
    rows = []
    for short, name in (("LV", "lv_endocardium"), ("RV", "rv_endocardium")):
        volumes = measures["volumes_ml"].get(name)
        if volumes is None:
            continue
        largest, smallest = max(volumes), min(volumes)
        rows.append((f"{short} volume, largest / smallest", f"{largest:.0f} / {smallest:.0f} ml"))
        rows.append((f"{short} ejection fraction", f"{100 * (1 - smallest / largest):.0f} %"))
        rows.append((f"{short} stroke volume", f"{largest - smallest:.0f} ml"))
    rows.append(("LV mass", f"{mean_lv_mass_g(measures):.0f} g"))
    return rows
