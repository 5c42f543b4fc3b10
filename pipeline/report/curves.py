"""Curves through the heartbeat: volumes, mass and wall thickness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.geometry import Float
from pipeline.report.colours import STYLES, SURFACE_STYLES
from pipeline.report.style import edged, words

CHAMBERS = ("lv_endocardium", "rv_endocardium", "left_atrium", "right_atrium")
MUSCLE_COLOUR = STYLES["lv_myocardium"][0]
LINE_POINTS = 2.0
FEW_PHASES = 12
PHASE_AXIS = "phase of the cycle (0 at the R peak)"

Curve = Sequence[float | None]


def volume_curves(phases: Float, volumes_ml: Mapping[str, Curve]) -> Figure:
    """Volume of each chamber, and of the aorta's part that is shown, through the cycle."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    axis = figure.subplots()
    for name in (*CHAMBERS, "aorta"):
        if name in volumes_ml:
            colour, style = SURFACE_STYLES[name]
            _cyclic(axis, phases, volumes_ml[name], colour, style, words(name))
    axis.set(xlabel=PHASE_AXIS, ylabel="volume (ml)", ylim=(0, None), xlim=(0, 1))
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    axis.grid(alpha=0.3)
    return figure


def muscle_curves(phases: Float, mass_g: Curve, thickness_mm: Curve) -> Figure:
    """Mass and mean wall thickness of the left muscle through the cycle."""
    figure = Figure(figsize=(6.5, 2.6), layout="constrained")
    for axis, curve, name in zip(
        figure.subplots(1, 2),
        (mass_g, thickness_mm),
        ("LV mass (g)", "mean wall thickness (mm)"),
        strict=True,
    ):
        _cyclic(axis, phases, curve, MUSCLE_COLOUR, "-", None)
        axis.set(xlabel="phase of the cycle", ylabel=name, xlim=(0, 1))
        axis.set_ylim(0, 1.15 * axis.get_ylim()[1])
        axis.grid(alpha=0.3)
    return figure


def thickness_map(phases: Float, segments_mm: Mapping[str, Curve]) -> Figure:
    """Wall thickness of each segment through the cycle, a row each; gaps are grey."""
    values = np.array([list(curve) for curve in segments_mm.values()], float)
    count = len(segments_mm)
    figure = Figure(figsize=(6.5, 0.2 * count + 0.9), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(
        np.ma.masked_invalid(values), cmap="magma", vmin=0, aspect="auto", interpolation="nearest"
    )
    axis.set_facecolor("#cccccc")
    axis.set_yticks(range(count), [words(name) for name in segments_mm], fontsize=7)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=12, min_n_ticks=1))
    axis.set(xlabel="phase, by number", xlim=(-0.5, len(phases) - 0.5))
    figure.colorbar(image, ax=axis, label="wall thickness (mm)")
    return figure


def _cyclic(
    axis: Axes, phases: Float, curve: Curve, colour: str, style: Any, label: str | None
) -> None:
    """A curve that comes back to its start one beat later; few phases show where they are."""
    values = np.array(list(curve), float)
    # A beat before and one after, so that the lines cross the borders where they should.
    time = np.concatenate([phases - 1, phases, phases + 1])
    marker = "o" if len(phases) <= FEW_PHASES else ""
    axis.plot(
        time,
        np.tile(values, 3),
        linestyle=style,
        color=colour,
        label=label,
        linewidth=LINE_POINTS,
        path_effects=edged(LINE_POINTS),
        marker=marker,
        markersize=4,
    )
