"""Pictures of the force field, and of surfaces cut by ultrasound frames."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from pipeline.field.fixture import Fixture
from pipeline.field.potential import potential
from pipeline.field.reader import ForceField
from pipeline.geometry import Float, Float32, MovingSurface, Surface, transform_points
from pipeline.imaging.labels import LABELS
from pipeline.report.animation import vertices_at
from pipeline.report.colours import SURFACE_STYLES
from pipeline.report.moments import Moments
from pipeline.report.slices import mark_scale, mark_sides
from pipeline.report.style import edged, handle, show_grey, words


class BloodFound(NamedTuple):
    """What was read from an ultrasound frame."""

    chance: Float32
    """``(row, column)``: how probable blood of a cavity is."""

    step: Float
    """``(2,)`` columns and rows of the frame from one of its pixels to the next."""


STYLES = ("-", "--", "-.", ":")


def fixture_profiles(fixtures: Mapping[str, Fixture]) -> Figure:
    """Force of each fixture against the distance, in newtons."""
    figure = Figure(figsize=(6, 3), layout="constrained")
    axis = figure.subplots()
    reach_mm = 2.5 * max(fixture.resolved_delta_mm for fixture in fixtures.values())
    distance_mm = np.linspace(0, reach_mm, 300)
    for style, (name, fixture) in zip(itertools.cycle(STYLES), fixtures.items(), strict=False):
        value = potential(distance_mm, fixture.resolved_delta_mm, fixture.m)
        axis.plot(distance_mm, fixture.f_max_n * value, style, label=words(name), linewidth=2)
    axis.set(
        xlabel="distance to the surface, or depth past it (mm)", ylabel="force (N)", ylim=(0, None)
    )
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    return figure


def potential_on_slice(shown: Moments, field: ForceField, fixture: str) -> Figure:
    """The potential over one MR slice, with lines of equal distance in mm and force arrows."""
    number = int((shown.labels == LABELS["lv_cavity"]).sum(axis=(0, 2, 3)).argmax())
    window, points_mm = shown.window(), shown.pixels_mm(number)
    figure = Figure(figsize=(5 * len(shown.names), 5), layout="constrained")
    axes = figure.subplots(1, len(shown.names), squeeze=False)[0]
    image = None
    for moment, (axis, name) in enumerate(zip(axes, shown.names, strict=True)):
        show_grey(axis, shown.intensity[moment, number][window], shown.pixel_aspect)
        phase = float(shown.phases[moment])
        image = _draw_field(axis, field, fixture, points_mm, phase, shown.pixel_aspect)
        mark_sides(axis, shown)
        axis.set_title(f"{name}, slice {number}: {words(fixture)}", fontsize=11)
    assert image is not None
    figure.colorbar(image, ax=list(axes), label="potential", shrink=0.8)
    return figure


def cuts_on_ultrasound(
    images: Sequence[Float32],
    names: Sequence[str],
    image_from_mr: Float,
    phases: Float,
    surfaces: Mapping[str, MovingSurface],
    found: Sequence[BloodFound] = (),
) -> Figure:
    """Registered surfaces cut by the plane of each ultrasound frame.

    Parameters
    ----------
    images
        One a frame, ``(row, column)``; sizes may differ.
    names
        What each is called.
    image_from_mr
        ``(frame, 4, 4)``: MR millimetres to ``(column, row, off-plane)``.
    phases
        ``(frame,)``.
    found
        Blood in each frame, drawn in a second row; empty where grey values were compared.
    """
    tall = 2 if found else 1
    size = 3.2 * len(images), 2.5 * tall + 0.4
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(tall, len(images), squeeze=False)
    frames = zip(axes[0], images, names, image_from_mr, phases, strict=True)
    for axis, image, called, transform, phase in frames:
        wide_mm, high_mm = _pixel_mm(transform)
        show_grey(axis, image, high_mm / wide_mm)
        mark_scale(axis, wide_mm)
        _draw_cuts(axis, image.shape, transform, float(phase), surfaces)
        # Names of files may hold what would be taken for a formula.
        axis.set_title(f"{called}, phase {phase:.2f}", fontsize=9, parse_math=False)
    if found:
        below = zip(axes[1], images, found, image_from_mr, phases, strict=True)
        for axis, image, blood, transform, phase in below:
            wide_mm, high_mm = _pixel_mm(transform)
            _show_blood(axis, blood, high_mm / wide_mm)
            _draw_cuts(axis, image.shape, transform, float(phase), surfaces)
            axis.set_title("blood found (light)", fontsize=9)
    drawn = {name: style for name, style in SURFACE_STYLES.items() if name in surfaces}
    figure.legend(
        handles=[handle(name, *style) for name, style in drawn.items()],
        loc="outside lower center",
        ncols=len(drawn),
        fontsize=9,
    )
    return figure


def _pixel_mm(image_from_mr: Float) -> tuple[float, float]:
    """Width and height of a pixel."""
    wide_mm, high_mm = np.linalg.norm(np.linalg.inv(image_from_mr)[:3, :2], axis=0)
    return float(wide_mm), float(high_mm)


def _show_blood(axis: Axes, found: BloodFound, aspect: float) -> None:
    """In the frame's own columns and rows, so that the same lines fit."""
    (rows, columns), (across, down) = found.chance.shape, found.step
    ends = (-0.5 * across, (columns - 0.5) * across, (rows - 0.5) * down, -0.5 * down)
    # Certainty is light grey: on white, yellow and dotted lines are lost.
    axis.imshow(found.chance, cmap="gray", vmin=0, vmax=1.6, extent=ends, aspect=aspect)
    axis.set_axis_off()


def _draw_cuts(
    axis: Axes,
    shape: tuple[int, ...],
    image_from_mr: Float,
    phase: float,
    surfaces: Mapping[str, MovingSurface],
) -> None:
    """Lines of the surfaces in the plane of a frame of ``shape`` (rows, columns)."""
    for name, (colour, style) in SURFACE_STYLES.items():
        if name not in surfaces:
            continue
        # Joined, for dashes begin anew with every piece, and pieces are shorter than they.
        lines = joined(plane_cut(_between(surfaces[name], phase), image_from_mr))
        axis.add_collection(LineCollection(lines, colors=colour, linestyles=style, linewidths=1.2))
    rows, columns = shape
    axis.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))


def _between(moving: MovingSurface, phase: float) -> Surface:
    """The surface at any phase, its vertices on straight lines between the stored ones."""
    turned = moving.phases[0] + (phase - moving.phases[0]) % 1.0
    return Surface(vertices_at(moving, turned), moving.triangles)


def plane_cut(surface: Surface, image_from_mr: Float) -> Float:
    """Segments in which a surface meets the image plane, ``(k, 2, 2)`` in pixels."""
    points = transform_points(image_from_mr, surface.vertices_mm)
    # A vertex in the plane itself would make a segment of no length.
    height = np.where(points[:, 2] == 0, np.finfo(float).tiny, points[:, 2])
    crossing = surface.triangles[np.ptp(np.sign(height)[surface.triangles], axis=1) > 0]
    # Of each triangle's three sides.
    a, b = crossing, np.roll(crossing, -1, axis=1)
    share = height[a] / np.where(height[a] == height[b], np.inf, height[a] - height[b])
    ends = points[a, :2] + share[..., None] * (points[b, :2] - points[a, :2])
    return np.asarray(ends[height[a] * height[b] < 0].reshape(-1, 2, 2))


def joined(segments: Float) -> list[Float]:
    """Segments ``(k, 2, 2)`` whose ends meet as the lines ``(n, 2)`` that they make up.

    A closed line ends where it begins.
    """
    ends = [tuple(map(tuple, one)) for one in np.round(segments, 6).tolist()]
    at: dict[tuple[float, ...], list[int]] = {}
    for number, pair in enumerate(ends):
        for end in pair:
            at.setdefault(end, []).append(number)
    # Open lines from their ends; what is left then is closed.
    waiting = sorted(range(len(ends)), key=lambda one: min(len(at[end]) for end in ends[one]))
    left, lines = set(waiting), []
    for first in waiting:
        line = sorted(ends[first], key=lambda end: len(at[end])) if first in left else []
        left.discard(first)
        while line and (following := left.intersection(at[line[-1]])):
            number = min(following)
            left.remove(number)
            line.append(next((end for end in ends[number] if end != line[-1]), line[-1]))
        if line:
            lines.append(np.array(line))
    return lines


def _draw_field(
    axis: Axes, field: ForceField, fixture: str, points_mm: Float, phase: float, aspect: float
) -> AxesImage:
    flat = points_mm.reshape(-1, 3)
    shape = points_mm.shape[:2]
    value = field.potential(flat, phase, fixture=fixture).reshape(shape)
    structure = field.fixtures[fixture].structure
    distance_mm = field.distance_mm(flat, phase, structure=structure).reshape(shape)
    # The MR shows through where nothing is felt, and where all is: the colour says where it rises.
    alpha = 0.15 + 0.45 * 4 * value * (1 - value)
    image = axis.imshow(value, cmap="plasma", alpha=alpha, vmin=0, vmax=1, aspect=aspect)
    lines = axis.contour(distance_mm, levels=np.arange(-20, 21, 5), colors="w", linewidths=0.7)
    lines.set_path_effects(edged(0.7, "black"))
    for text in axis.clabel(lines, fmt="%d mm", fontsize=9):
        text.set_path_effects(edged(1.5, "black"))
    zero = axis.contour(distance_mm, levels=[0], colors="w", linewidths=2)
    zero.set_path_effects(edged(2, "black"))
    step = 7
    force_n = field.force_n(flat, phase, fixture=fixture).reshape(*shape, 3)[::step, ::step]
    in_plane = np.stack(
        [
            force_n @ _unit(points_mm[0, 1] - points_mm[0, 0]),
            # Rows count downwards; arrows point up where this is positive, in mm, not in pixels.
            -force_n @ _unit(points_mm[1, 0] - points_mm[0, 0]),
        ]
    )
    rows, columns = np.mgrid[0 : shape[0] : step, 0 : shape[1] : step]
    arrows = axis.quiver(
        columns, rows, *in_plane, color="#56B4E9", width=0.004, edgecolor="black", linewidth=0.4
    )
    most_n = field.fixtures[fixture].f_max_n
    key = axis.quiverkey(arrows, 0.82, 0.04, most_n, f"{most_n:g} N", labelpos="E", color="w")
    # Its label lies over arrows.
    key.text.set(color="w", path_effects=edged(4, "black"))
    return image


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))
