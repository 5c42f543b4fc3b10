"""The report's pictures, as PNG or SVG bytes; the same input gives the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from pipeline.field.fixture import Fixture
from pipeline.field.potential import potential
from pipeline.field.reader import ForceField
from pipeline.geometry import Float, Float32, Label, MovingSurface, Surface, transform_points
from pipeline.imaging.cine import Cine
from pipeline.imaging.labels import LABELS

# Okabe and Ito's colours, told apart by colour-blind readers; line styles serve greyscale.
STYLES: dict[str, tuple[str, Any]] = {
    "lv_cavity": ("#E69F00", "-"),
    "lv_myocardium": ("#56B4E9", "--"),
    "rv_cavity": ("#009E73", "-."),
    "left_atrium": ("#D9B800", ":"),
    "right_atrium": ("#CC79A7", "-"),
    "aorta": ("#D55E00", "--"),
}
SURFACE_STYLES = {
    "lv_endocardium": STYLES["lv_cavity"],
    "epicardium": STYLES["lv_myocardium"],
    "rv_endocardium": STYLES["rv_cavity"],
    "left_atrium": STYLES["left_atrium"],
    "right_atrium": STYLES["right_atrium"],
    "aorta": STYLES["aorta"],
}

MARGIN_PIXELS = 12


def as_svg(figure: Figure) -> bytes:
    """SVG without dates or random names."""
    buffer = BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "beatfield", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def as_png(figure: Figure, dots_per_inch: int = 80) -> bytes:
    """PNG without the name of the software."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    return buffer.getvalue()


def contours_on_slices(cine: Cine, labels: Label, moments: Mapping[str, int]) -> Figure:
    """Label contours on slices from base to apex, a row for each named phase number."""
    rows, columns, count = len(moments), 6, cine.intensity.shape[1]
    used = np.flatnonzero((labels > 0).any(axis=(0, 2, 3)))
    shown = np.unique(np.linspace(used[0], used[-1], min(columns, count)).round().astype(int))
    window = _window(labels)
    figure = Figure(figsize=(2.1 * len(shown), 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, len(shown), squeeze=False)
    for row, (name, phase) in enumerate(moments.items()):
        for column, number in enumerate(shown):
            axis = axes[row, column]
            _show(axis, cine.intensity[phase, number][window])
            _draw_labels(axis, labels[phase, number][window])
            axis.set_title(f"{name}, slice {number}", fontsize=8)
    figure.legend(
        handles=[_handle(name, *STYLES[name]) for name in LABELS],
        loc="outside lower center",
        ncols=len(LABELS),
        fontsize=8,
    )
    return figure


def volume_curves(phases: Float, volumes_ml: Mapping[str, Sequence[float]]) -> Figure:
    """Volume of each chamber through the cycle."""
    figure = Figure(figsize=(6, 3), layout="constrained")
    axis = figure.subplots()
    for name, curve in volumes_ml.items():
        if name in SURFACE_STYLES and name != "epicardium":
            colour, style = SURFACE_STYLES[name]
            axis.plot(phases, curve, style, color=colour, label=_words(name), linewidth=2)
    axis.set(xlabel="phase of the cycle (0 at the R peak)", ylabel="volume (ml)", ylim=(0, None))
    axis.legend(fontsize=8, ncols=2)
    axis.grid(alpha=0.3)
    return figure


def fixture_profiles(fixtures: Mapping[str, Fixture]) -> Figure:
    """Force of each fixture against the distance, in newtons."""
    figure = Figure(figsize=(6, 3), layout="constrained")
    axis = figure.subplots()
    reach_mm = 2.5 * max(fixture.resolved_delta_mm for fixture in fixtures.values())
    distance_mm = np.linspace(0, reach_mm, 300)
    for style, (name, fixture) in zip(("-", "--", "-.", ":") * 9, fixtures.items(), strict=False):
        value = potential(distance_mm, fixture.resolved_delta_mm, fixture.m)
        axis.plot(distance_mm, fixture.f_max_n * value, style, label=_words(name), linewidth=2)
    axis.set(
        xlabel="distance to the surface, or depth past it (mm)", ylabel="force (N)", ylim=(0, None)
    )
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    return figure


def potential_on_slice(
    cine: Cine, labels: Label, field: ForceField, fixture: str, moments: Mapping[str, int]
) -> Figure:
    """The potential over one MR slice, with lines of equal distance in mm and force arrows."""
    number = int((labels == LABELS["lv_cavity"]).sum(axis=(0, 2, 3)).argmax())
    window = _window(labels)
    figure = Figure(figsize=(5 * len(moments), 5), layout="constrained")
    axes = figure.subplots(1, len(moments), squeeze=False)[0]
    image = None
    for axis, (name, phase) in zip(axes, moments.items(), strict=True):
        _show(axis, cine.intensity[phase, number][window])
        points_mm = _pixel_positions(cine, number, window)
        image = _draw_field(axis, field, fixture, points_mm, float(cine.phases[phase]))
        axis.set_title(f"{name}: {_words(fixture)}", fontsize=9)
    assert image is not None
    figure.colorbar(image, ax=list(axes), label="potential", shrink=0.8)
    return figure


def cuts_on_ultrasound(
    images: Sequence[Float32],
    image_from_mr: Float,
    phases: Float,
    surfaces: Mapping[str, MovingSurface],
) -> Figure:
    """Registered surfaces cut by the plane of each ultrasound frame.

    Parameters
    ----------
    images
        One a frame, ``(row, column)``; sizes may differ.
    image_from_mr
        ``(frame, 4, 4)``: MR millimetres to ``(column, row, off-plane)``.
    phases
        ``(frame,)``.
    """
    figure = Figure(figsize=(3.2 * len(images), 3.4), layout="constrained")
    axes = figure.subplots(1, len(images), squeeze=False)[0]
    for axis, image, transform, phase in zip(axes, images, image_from_mr, phases, strict=True):
        _show(axis, image)
        for name, (colour, style) in SURFACE_STYLES.items():
            if name not in surfaces:
                continue
            moving = surfaces[name]
            away = np.abs((moving.phases - phase + 0.5) % 1 - 0.5)
            lines = plane_cut(moving.at(int(away.argmin())), transform)
            axis.add_collection(
                LineCollection(list(lines), colors=colour, linestyles=style, linewidths=1.2)
            )
        rows, columns = image.shape
        axis.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
        axis.set_title(f"phase {phase:.2f}", fontsize=9)
    return figure


def plane_cut(surface: Surface, image_from_mr: Float) -> Float:
    """Segments in which a surface meets the image plane, ``(k, 2, 2)`` in pixels."""
    points = transform_points(image_from_mr, surface.vertices_mm)
    # A vertex in the plane itself would make a segment of no length.
    height = np.where(points[:, 2] == 0, np.finfo(float).tiny, points[:, 2])
    crossing = surface.triangles[np.ptp(np.sign(height)[surface.triangles], axis=1) > 0]
    ends = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        a, b = crossing[:, first], crossing[:, second]
        share = height[a] / np.where(height[a] == height[b], np.inf, height[a] - height[b])
        ends.append(points[a, :2] + share[:, None] * (points[b, :2] - points[a, :2]))
    crosses = np.stack(
        [height[crossing[:, i]] * height[crossing[:, j]] < 0 for i, j in ((0, 1), (1, 2), (2, 0))],
        axis=1,
    )
    return np.asarray(np.stack(ends, axis=1)[crosses].reshape(-1, 2, 2))


def _draw_field(
    axis: Axes, field: ForceField, fixture: str, points_mm: Float, phase: float
) -> AxesImage:
    flat = points_mm.reshape(-1, 3)
    shape = points_mm.shape[:2]
    value = field.potential(flat, phase, fixture=fixture).reshape(shape)
    structure = field.fixtures[fixture].structure
    distance_mm = field.distance_mm(flat, phase, structure=structure).reshape(shape)
    # Where nothing is felt the MR shows through.
    image = axis.imshow(value, cmap="plasma", alpha=0.5 * value, vmin=0, vmax=1)
    lines = axis.contour(distance_mm, levels=np.arange(-20, 21, 5), colors="w", linewidths=0.7)
    axis.clabel(lines, fmt="%d mm", fontsize=6)
    axis.contour(distance_mm, levels=[0], colors="w", linewidths=2)
    step = 7
    force_n = field.force_n(flat, phase, fixture=fixture).reshape(*shape, 3)[::step, ::step]
    in_plane = np.stack(
        [
            force_n @ _unit(points_mm[0, 1] - points_mm[0, 0]),
            force_n @ _unit(points_mm[1, 0] - points_mm[0, 0]),
        ]
    )
    rows, columns = np.mgrid[0 : shape[0] : step, 0 : shape[1] : step]
    axis.quiver(columns, rows, *in_plane, color="#56B4E9", angles="xy", width=0.004)
    return image


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))


def _pixel_positions(cine: Cine, number: int, window: tuple[slice, slice]) -> Float:
    rows = np.arange(window[0].start, window[0].stop)
    columns = np.arange(window[1].start, window[1].stop)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    index = np.stack([x, y, np.full_like(x, number)], axis=-1).astype(float)
    return transform_points(cine.mr_from_index, index)


def _window(labels: Label) -> tuple[slice, slice]:
    """The part of the slices in which the heart lies, with a margin."""
    heart = labels.max(axis=(0, 1))
    parts = []
    for across, size in ((1, heart.shape[0]), (0, heart.shape[1])):
        inside = np.flatnonzero(heart.max(axis=across))
        low, high = int(inside[0]) - MARGIN_PIXELS, int(inside[-1]) + MARGIN_PIXELS + 1
        parts.append(slice(max(0, low), min(size, high)))
    return parts[0], parts[1]


def _show(axis: Axes, image: Any) -> None:
    low, high = np.percentile(image, (1, 99.5))
    axis.imshow(image, cmap="gray", vmin=low, vmax=max(high, low + 1e-6))
    axis.set_axis_off()


def _draw_labels(axis: Axes, labels: Label) -> None:
    for name, value in LABELS.items():
        mask = labels == value
        if mask.any():
            colour, style = STYLES[name]
            axis.contour(mask, levels=[0.5], colors=colour, linestyles=style, linewidths=1.2)


def _handle(name: str, colour: str, style: Any) -> Any:
    return Line2D([], [], color=colour, linestyle=style, label=_words(name))


def _words(name: str) -> str:
    return name.replace("_", " ").replace("lv ", "LV ").replace("rv ", "RV ")
