"""Pictures of images: slices and ultrasound frames with the truth drawn on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from data_synth.heart import BeatingHeart
from data_synth.kernels import Label
from data_synth.mr import SyntheticCine
from data_synth.preview.style import STYLES, edged, encode, words
from data_synth.tissue import TRUTH_LABELS, truth_values
from data_synth.truth import mr_from_image
from data_synth.ultrasound import Sweep

Window = tuple[slice, slice]

MARGIN_MM = 25.0
COLUMNS = 6
TILE_INCH = 1.9
FRAMES_SHOWN = 5
OUTLINE_STEP = 2
"""Every how many pixels of an ultrasound frame its truth is looked up."""
MOVIE_PIXELS = 340


def stack_grid(cine: SyntheticCine, number: int) -> Figure:
    """Slices of the stack at one phase number, apex first, with truth contours: all, or 18 evenly
    chosen of more."""
    count = cine.intensity.shape[1]
    # An isotropic volume has far more slices than a page has room for.
    shown = np.unique(np.linspace(0, count - 1, min(count, 3 * COLUMNS)).round().astype(int))
    rows = -(-len(shown) // COLUMNS)
    figure = Figure(figsize=(COLUMNS * TILE_INCH, rows * TILE_INCH * 1.12), layout="constrained")
    axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    window = heart_window(cine)
    for axis, z in zip(axes, shown, strict=False):
        _slice(axis, cine, number, int(z), window)
        axis.set_title(f"slice {z}", fontsize=8, pad=2)
    for axis in axes[len(shown) :]:
        axis.set_axis_off()
    _legend(figure)
    return figure


def long_axis_row(
    views: Mapping[str, SyntheticCine], moments: Mapping[str, int], drawn: bool = True
) -> Figure:
    """Each long-axis view at each named phase number: a row a moment, a column a view."""
    figure = Figure(figsize=(3.6 * len(views), 3.7 * len(moments)), layout="constrained")
    axes = figure.subplots(len(moments), len(views), squeeze=False)
    for row, (moment, number) in enumerate(moments.items()):
        for column, (name, view) in enumerate(views.items()):
            _slice(axes[row, column], view, number, 0, heart_window(view), drawn)
            axes[row, column].set_title(f"{words(name)}, {moment}", fontsize=9)
    if drawn:
        _legend(figure)
    return figure


def ultrasound_row(sweep: Sweep, heart: BeatingHeart) -> Figure:
    """Frames of one sweep as recorded, and the same frames with truth outlines below."""
    chosen = np.unique(np.linspace(0, len(sweep.images) - 1, FRAMES_SHOWN).round().astype(int))
    rows, columns = sweep.images.shape[1:]
    height = 2.5 * rows / columns
    figure = Figure(figsize=(2.5 * len(chosen), 2 * height + 0.9), layout="constrained")
    axes = figure.subplots(2, len(chosen), squeeze=False)
    for column, k in enumerate(chosen):
        labels = frame_labels(sweep, heart, int(k))
        for axis in axes[:, column]:
            axis.imshow(sweep.images[k], cmap="gray", vmin=0, vmax=255)
            axis.set_axis_off()
        places = np.arange(0, columns, OUTLINE_STEP), np.arange(0, rows, OUTLINE_STEP)
        _contours(axes[1, column], labels, *places)
        title = f"frame {k}, phase {sweep.phases[k]:.2f}"
        axes[0, column].set_title(title, fontsize=8)
    _legend(figure)
    return figure


def frame_labels(sweep: Sweep, heart: BeatingHeart, k: int) -> Label:
    """Truth labels on every second pixel of frame ``k``, as the picture's plane cuts them."""
    rows, columns = sweep.images.shape[1:]
    j, i = np.mgrid[:rows:OUTLINE_STEP, :columns:OUTLINE_STEP]
    index = np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=1).astype(float)
    place = mr_from_image(sweep)[k]
    points_mm = index @ place[:3, :3].T + place[:3, 3]
    points_mm -= sweep.displacement_mm[k]
    tissue = heart.heart_tissue(points_mm, float(sweep.nominal_phases[k]))
    labels = truth_values()[tissue].reshape(i.shape)
    return np.asarray(np.where(sector_mask(sweep)[::OUTLINE_STEP, ::OUTLINE_STEP], labels, 0))


def sector_mask(sweep: Sweep) -> npt.NDArray[np.bool_]:
    """``(rows, columns)`` pixels that the fan reaches: between the outermost that ever light up."""
    lit = sweep.images.max(axis=0) > 0
    return np.asarray(
        np.logical_or.accumulate(lit, axis=1)
        & np.logical_or.accumulate(lit[:, ::-1], axis=1)[:, ::-1]
    )


def movie(cines: Sequence[tuple[SyntheticCine, int]], seconds: float) -> bytes:
    """Slices side by side through the beat, a bar below them for the phase: animated WebP."""
    columns = [_reel(cine, z) for cine, z in cines]
    frames = np.concatenate(columns, axis=2)
    count, _, width = frames.shape
    bar = np.zeros((count, 8, width), np.uint8)
    for k in range(count):
        bar[k, 2:6, : round(width * (k + 1) / count)] = 255
    grey = np.concatenate([frames, bar], axis=1)
    return encode([np.repeat(frame[:, :, None], 3, axis=2) for frame in grey], seconds)


def _reel(cine: SyntheticCine, z: int) -> npt.NDArray[np.uint8]:
    """One slice through the beat, cropped to the heart and brought to a common size."""
    from PIL import Image

    images = cine.intensity[:, z][(slice(None), *heart_window(cine))]
    low, high = _grey_window(images)
    grey = np.clip((images - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    size = (MOVIE_PIXELS, MOVIE_PIXELS)
    return np.stack(
        [np.asarray(Image.fromarray(one).resize(size, Image.Resampling.BICUBIC)) for one in grey]
    )


def heart_window(cine: SyntheticCine) -> Window:
    """The square part of the slices in which the heart lies, with a margin."""
    heart = cine.labels.max(axis=(0, 1)) > 0
    pixel_mm = float(np.linalg.norm(cine.mr_from_index[:3, 0]))
    if not heart.any():
        return slice(0, heart.shape[0]), slice(0, heart.shape[1])
    spans = [np.flatnonzero(heart.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    half = max(np.ptp(span) for span in spans) / 2 + MARGIN_MM / pixel_mm
    parts = []
    for span, size in zip(spans, heart.shape, strict=True):
        side = min(2 * int(half) + 1, size)
        low = int(np.clip(round(span.mean() - side / 2), 0, size - side))
        parts.append(slice(low, low + side))
    return parts[0], parts[1]


def middle_slice(cine: SyntheticCine) -> int:
    """The slice in the middle of the left ventricle's cavity."""
    value = TRUTH_LABELS["lv_cavity"][0]
    inside = np.flatnonzero((cine.labels[0] == value).any(axis=(1, 2)))
    return int(inside[len(inside) // 2]) if len(inside) else cine.labels.shape[1] // 2


def _slice(
    axis: Axes, cine: SyntheticCine, number: int, z: int, window: Window, drawn: bool = True
) -> None:
    image = cine.intensity[number, z][window]
    low, high = _grey_window(image)
    axis.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="bilinear")
    if drawn:
        labels = cine.labels[number, z][window]
        _contours(axis, labels, np.arange(labels.shape[1]), np.arange(labels.shape[0]))
    axis.set_axis_off()


def _grey_window(images: Any) -> tuple[float, float]:
    low, high = np.percentile(images, (1, 99.5))
    return float(low), float(max(high, low + 1))


def _contours(axis: Axes, labels: Label, x: Any, y: Any) -> None:
    # The muscle first: its inner border is the cavity's, whose colour is to be seen there.
    for name in sorted(TRUTH_LABELS, key=lambda name: name != "lv_myocardium"):
        mask = labels == TRUTH_LABELS[name][0]
        if mask.any() and min(mask.shape) > 1:
            colour, style = STYLES[name]
            axis.contour(x, y, mask, levels=[0.5], colors=colour, linestyles=style, linewidths=1.1)


def _legend(figure: Figure) -> None:
    handles = [
        Line2D([], [], color=colour, linestyle=style, label=words(name), path_effects=edged(1.5))
        for name, (colour, style) in STYLES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8)
