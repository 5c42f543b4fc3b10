"""Figure 4: one slice of the heart with its potential field, through the beat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.field.reader import ForceField
from pipeline.geometry import Float, transform_points
from pipeline.imaging.cine import Cine
from pipeline.paper.moving import animated
from pipeline.paper.subject import Subject
from pipeline.products import read_cine
from pipeline.report.page import Section, picture
from pipeline.report.style import as_webp, words

MARGIN_MM = 14.0
LEVELS_MM = (-10, -5, -2, 0, 2, 5, 10)
STRIP = 4


@dataclass(frozen=True, slots=True)
class Window:
    """The part of one slice that is shown."""

    number: int
    rows: slice
    columns: slice
    points_mm: Float
    """``(row, column, 3)``, LPS mm of the pixels."""

    extent_mm: tuple[float, float, float, float]
    """Left, right, bottom, top for pictures, mm within the slice."""


def window_of(cine: Cine, field: ForceField, structure: str) -> Window:
    """The slice in which the surface is widest at the R peak, cut to the surface and a margin.

    Parameters
    ----------
    cine
        ``(phase, z, y, x)`` intensities and where they lie.
    """
    depth, height, width = cine.intensity.shape[1:]
    z, y, x = np.mgrid[:depth, :height, :width]
    index = np.stack([x, y, z], axis=-1).astype(float)
    points = transform_points(cine.mr_from_index, index)
    flat = points.reshape(-1, 3)
    inside = field.distance_mm(flat, 0.0, structure).reshape(z.shape) < 0
    inside &= field.contains(flat).reshape(z.shape)
    number = int(inside.sum(axis=(1, 2)).argmax())
    size_mm = np.linalg.norm(cine.mr_from_index[:3, :3], axis=0)
    parts = []
    for across, spacing, count in ((1, size_mm[1], height), (0, size_mm[0], width)):
        found = np.flatnonzero(inside[number].any(axis=across))
        margin = round(MARGIN_MM / spacing)
        low, high = max(int(found[0]) - margin, 0), min(int(found[-1]) + margin + 1, count)
        parts.append(slice(low, high))
    rows, columns = parts
    wide = (columns.stop - columns.start) * size_mm[0]
    tall = (rows.stop - rows.start) * size_mm[1]
    extent = (0.0, float(wide), float(tall), 0.0)
    return Window(number, rows, columns, points[number, rows, columns], extent)


def slice_through_the_beat(subject: Subject) -> Section:
    """Figure 4, as a strip of four phases and as an animation of all."""
    assert subject.products is not None
    cine = read_cine(subject.products / "ingest")
    field = subject.field
    fixture = next(iter(field.fixtures))
    window = window_of(cine, field, field.fixtures[fixture].structure)
    strip = Figure(figsize=(12, 3.6), layout="constrained")
    chosen = np.linspace(0, len(cine.phases), STRIP, endpoint=False).astype(int)
    for axis, number in zip(strip.subplots(1, STRIP), chosen, strict=True):
        _draw(axis, cine, field, fixture, window, int(number))
    assert field.rr_s is not None
    frames = animated(_frames(cine, field, fixture, window), field.rr_s * 2, 90)
    return Section(
        "Figure 4: a slice and its potential field through the beat",
        f"Slice {window.number} of the cine and the potential of {words(fixture)} on it, bright "
        "where the force is greatest; lines of equal distance in mm (the surface is bold, inside "
        "dashed). The field is read at every pixel from the same store that a server maps.",
        [
            picture("Four phases of the beat", as_webp(strip, 90), "webp"),
            picture(f"All {len(cine.phases)} phases, at half speed", frames, "webp"),
        ],
    )


def _frames(cine: Cine, field: ForceField, fixture: str, window: Window) -> Iterator[Figure]:
    for number in range(len(cine.phases)):
        figure = Figure(figsize=(5.2, 5.0), layout="constrained")
        _draw(figure.subplots(), cine, field, fixture, window, number)
        yield figure


def _draw(
    axis: Axes, cine: Cine, field: ForceField, fixture: str, window: Window, number: int
) -> None:
    grey = cine.intensity[number, window.number, window.rows, window.columns]
    low, high = np.percentile(grey, (1, 99.5))
    shape = window.points_mm.shape[:2]
    flat = window.points_mm.reshape(-1, 3)
    phase = float(cine.phases[number])
    value = field.potential(flat, phase, fixture).reshape(shape)
    distance = field.distance_mm(flat, phase, field.fixtures[fixture].structure).reshape(shape)
    axis.imshow(grey, cmap="gray", vmin=low, vmax=high, extent=window.extent_mm)
    # Brightness alone tells the potential, so that nothing is lost in greyscale.
    axis.imshow(value, cmap="cividis", alpha=0.55 * value, vmin=0, vmax=1, extent=window.extent_mm)
    _lines(axis, distance, window)
    axis.set_title(f"phase {phase:.2f}", fontsize=9)
    axis.tick_params(labelsize=7)
    axis.set_xlabel("mm", fontsize=8)


def _lines(axis: Axes, distance_mm: Float, window: Window) -> None:
    wide, tall = window.extent_mm[1], window.extent_mm[2]
    rows, columns = distance_mm.shape
    x = (np.arange(columns) + 0.5) * wide / columns
    y = (np.arange(rows) + 0.5) * tall / rows
    others = [level for level in LEVELS_MM if level]
    styles = ["dashed" if level < 0 else "solid" for level in others]
    lines = axis.contour(x, y, distance_mm, others, colors="w", linewidths=0.8, linestyles=styles)
    axis.clabel(lines, fmt="%d", fontsize=6)
    axis.contour(x, y, distance_mm, [0], colors="k", linewidths=3.2)
    axis.contour(x, y, distance_mm, [0], colors="w", linewidths=1.6)
