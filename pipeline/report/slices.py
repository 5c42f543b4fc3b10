"""What was drawn on the slices, and how sure the segmentation is of each."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.geometry import Float, Integer, Label
from pipeline.imaging.labels import LABELS
from pipeline.report.colours import STYLES
from pipeline.report.moments import Moments
from pipeline.report.style import edged, handle, show_grey

MOST_SLICES = 24
"""More than these are not shown one by one: a choice of those with heart is."""

MOST_WORST = 4
"""So many of the least certain slices are among those chosen."""

MOST_NUMBERS = 60
"""A confidence map of no more cells has its numbers written in."""

BLACK_READS_ABOVE = 0.72
"""On the map's colours of higher confidence black stands out more than white does: by WCAG's
contrast, which is at least 4.5 so."""

SCALE_MM = 20.0

ALARM = "#C00000"

_EDGES = (("left", "right"), ("bottom", "top"))


class Doubt(NamedTuple):
    """A slice whose labels are uncertain in some phases."""

    slice: int
    phases: tuple[int, ...]
    lowest: float


def shown_slices(labels: Label, always: Sequence[int]) -> Integer:
    """Numbers of the slices to show, of ``(phase, z, y, x)`` labels, rising.

    All where there are no more than `MOST_SLICES`; else those of ``always``, and an even choice
    from the first slice with a label to the last, ends included.
    """
    count = labels.shape[1]
    if count <= MOST_SLICES:
        return np.arange(count)
    used = np.flatnonzero((labels > 0).any(axis=(0, 2, 3)))
    first, last = (used[0], used[-1]) if len(used) else (0, count - 1)
    even = np.linspace(first, last, MOST_SLICES - len(always)).round().astype(np.int64)
    return np.union1d(even, np.array(always, np.int64))


def how_it_lies(shown: Moments) -> str:
    """Sentences on which end of the stack is the apex, and which way pictures lie in the patient.

    The apex is the end that is farther from the left atrium, where that is seen.
    """
    right, down, up_the_stack = (_letters(one) for one in shown.mr_from_index[:3, :3].T)
    text = f"Right in the pictures is {right}, below {down}, higher slice numbers {up_the_stack} "
    text += "(L left, P posterior, S superior; R, A, I)."
    heights = [
        np.flatnonzero((shown.labels == LABELS[name]).any(axis=(0, 2, 3)))
        for name in ("left_atrium", "lv_myocardium")
    ]
    if not all(len(one) for one in heights):
        return text
    atrium, muscle = (float(one.mean()) for one in heights)
    last = shown.labels.shape[1] - 1
    end = 0 if atrium > muscle else last
    return f"Slice {end} is the one nearest the apex. {text}" if atrium != muscle else text


def mark_sides(axis: Axes, shown: Moments) -> None:
    """Write at the four edges of a slice's picture where they lie in the patient, in LPS."""
    right, down, _ = shown.mr_from_index[:3, :3].T
    places = {(0.02, 0.5): -right, (0.98, 0.5): right, (0.5, 0.98): -down, (0.5, 0.02): down}
    across, upright = ({0.02: low, 0.5: "center", 0.98: high} for low, high in _EDGES)
    for (x, y), direction in places.items():
        style: dict[str, Any] = {"ha": across[x], "va": upright[y], "transform": axis.transAxes}
        style |= {"color": "white", "fontsize": 8, "path_effects": edged(1, "black")}
        axis.text(x, y, _letters(direction), **style)


def mark_scale(axis: Axes, pixel_mm: float) -> None:
    """Draw `SCALE_MM` of the patient into the lower left of a picture of pixels so wide, if it has
    room."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    start, height = left + 0.06 * (right - left), bottom + 0.14 * (top - bottom)
    length = SCALE_MM / pixel_mm
    if length > 0.5 * (right - left):
        return
    line: dict[str, Any] = {"color": "white", "lw": 2, "path_effects": edged(3, "black")}
    axis.plot([start, start + length], [height] * 2, "-", scalex=False, scaley=False, **line)
    style: dict[str, Any] = {"color": "white", "fontsize": 8, "path_effects": edged(1, "black")}
    axis.text(start, height + 0.02 * (top - bottom), f"{SCALE_MM:.0f} mm", va="bottom", **style)


def _letters(direction: Float) -> str:
    """Where a direction in LPS points, such as ``LP``: what it points to most comes first.

    >>> _letters(np.array([0.8, -0.6, 0.1]))
    'LA'
    """
    share = direction / np.linalg.norm(direction)
    order = np.argsort(-np.abs(share))
    return "".join("RAI LPS"[4 * (share[k] > 0) + k] for k in order if abs(share[k]) > 0.38)


def worst_slices(confidence: Float, low: float) -> list[int]:
    """A few slices that are below ``low`` in ``(phase, z)``, to be shown whatever else is."""
    return [one.slice for one in doubts(confidence, low)[:MOST_WORST]]


def contours(
    shown: Moments, moment: int, confidence: Float | None = None, low: float = 0.0
) -> Figure:
    """The labels' outlines on every slice of one moment, in a grid.

    Parameters
    ----------
    moment
        Which of those shown.
    confidence
        ``(moment, z)``; slices below ``low`` are marked, and the worst are among those shown.
    """
    always = [] if confidence is None else worst_slices(confidence, low)
    slices, window = shown_slices(shown.labels, always), shown.window()
    columns = _columns(len(slices))
    rows = ceil(len(slices) / columns)
    high, wide = (part.stop - part.start for part in window)
    tall = high * shown.pixel_aspect / wide
    width = min(2.4, 12 / columns)
    size = (max(columns * width, 7.5), rows * (width * tall + 0.25) + 0.35)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(slices) :]:
        axis.set_axis_off()
    for axis, number in zip(axes, slices, strict=False):
        show_grey(axis, shown.intensity[moment, number][window], shown.pixel_aspect)
        _outline(axis, shown.labels[moment, number][window])
        sure = None if confidence is None else float(confidence[moment, number])
        name = f"slice {number}" + (" (interpolated)" if number in shown.interpolated else "")
        _title(axis, name, sure, low)
    # One is enough: all slices of a stack lie alike.
    mark_sides(axes[0], shown)
    mark_scale(axes[0], float(np.linalg.norm(shown.mr_from_index[:3, 0])))
    _legend(figure)
    return figure


def _columns(count: int) -> int:
    if count <= 6:
        return count
    return 6 if count <= 18 else 8


def _outline(axis: Axes, labels: Label) -> None:
    # The muscle first: its inner border is the cavity's, whose colour is to be seen there.
    for name in sorted(LABELS, key=lambda name: name != "lv_myocardium"):
        mask = labels == LABELS[name]
        if mask.any():
            colour, style = STYLES[name]
            axis.contour(mask, levels=[0.5], colors="black", linewidths=2.2)
            axis.contour(mask, levels=[0.5], colors=colour, linewidths=1.3, linestyles=[style])


def _title(axis: Axes, name: str, confidence: float | None, low: float) -> None:
    if confidence is None or not np.isfinite(confidence):
        axis.set_title(name, fontsize=8, pad=3)
        return
    doubtful = confidence < low
    text = f"{name}: {confidence:.2f}" + (" (low)" if doubtful else "")
    style: dict[str, Any] = {"color": ALARM, "weight": "bold"} if doubtful else {}
    axis.set_title(text, fontsize=8, pad=3, **style)


def _legend(figure: Figure) -> None:
    figure.legend(
        handles=[handle(name, *STYLES[name]) for name in LABELS],
        loc="outside lower center",
        ncols=len(LABELS),
        fontsize=8,
        frameon=False,
    )


def confidence_map(confidence: Float, low: float) -> Figure:
    """Confidence ``(phase, z)`` as a map, slices downwards and phases along; low ones crossed."""
    phases, slices = confidence.shape
    figure = Figure(figsize=(6.5, min(max(0.2 * slices, 1.4), 5) + 0.8), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(
        np.ma.masked_invalid(confidence.T), cmap="viridis", vmin=0.5, vmax=1, aspect="auto"
    )
    axis.set_facecolor("#cccccc")
    if confidence.size <= MOST_NUMBERS:
        _write_numbers(axis, confidence, low)
    else:
        phase, number = np.nonzero(confidence < low)
        cell_points = min(330 / phases, 72 * min(max(0.2 * slices, 1.4), 5) / slices)
        size = min(max(0.6 * cell_points, 2), 8) ** 2
        axis.scatter(phase, number, marker="x", s=size, color="white", linewidths=1)
    axis.set(xlabel="phase, by number", ylabel="slice")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=12, min_n_ticks=1))
    axis.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=10, min_n_ticks=1))
    axis.set(xlim=(-0.5, phases - 0.5), ylim=(slices - 0.5, -0.5))
    figure.colorbar(image, ax=axis, label="confidence", extend="min")
    return figure


def _write_numbers(axis: Axes, confidence: Float, low: float) -> None:
    for (phase, number), value in np.ndenumerate(confidence):
        text = f"{value:.2f}" if np.isfinite(value) else "-"
        text += " (low)" if value < low else ""
        colour = "white" if value < BLACK_READS_ABOVE else "black"
        axis.text(phase, number, text, ha="center", va="center", fontsize=8, color=colour)


def doubts(confidence: Float, low: float) -> list[Doubt]:
    """Slices that are below ``low`` in some phase of ``(phase, z)``, the worst first."""
    found = []
    for number, curve in enumerate(confidence.T):
        below = np.flatnonzero(curve < low)
        if len(below):
            found.append(Doubt(number, tuple(below.tolist()), float(curve[below].min())))
    return sorted(found, key=lambda one: (one.lowest, one.slice))


def lowest_place(confidence: Float) -> str:
    """The least certain slice and phase, in words."""
    if not np.isfinite(confidence).any():
        return "not measured"
    phase, number = np.unravel_index(np.nanargmin(confidence), confidence.shape)
    return f"{confidence[phase, number]:.2f} (slice {number}, phase {phase})"
