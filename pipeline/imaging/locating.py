"""Find the heart in a whole field of view, and how it lies in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.geometry import Float32, Label, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.inference import network_images
from pipeline.imaging.labels import CAVITY, MUSCLE
from pipeline.imaging.network import MULTIPLE, PLANES, WINDOW, predict
from pipeline.imaging.orientation import Look, find_orientation
from pipeline.imaging.view import AS_THE_FILE_SAYS, PIXEL_MM, Orientation, View, view_of

SURROUNDINGS_MM = 30.0
"""Room left around the heart found at first sight: what it beats into, and what tells it apart."""

SHOWN_MM = 1.3
"""Pixels in which a heart is labelled, finer than those in which it is sought: of those tried, 1.05
to 1.5 mm, these did best for right ventricles and muscle (`docs/segmentation-model.md`)."""

PIXELS_ACROSS = 80
"""A small heart is labelled in finer pixels still, so many along the longer side of the box that
holds it: children's are smaller than training images show them in `SHOWN_MM`."""

FINEST_MM = 0.8
"""No smaller pixels, however little of a heart is found at first sight."""

FIELD_MM = 144.0
"""Least side of the view: should a small heart prove to be part of a larger one, that has room."""

LEAST_FOUND_MM2 = 400.0
"""Cut area, over the slices tried, below which what was found is not a heart."""

RINGLESS = 0.05
"""Worth of a body's pixel against one of a cavity that muscle encloses, when hearts are sought."""

STILL = 0.02
"""Change of grey values, of 1 from dark to bright, that noise alone makes."""

SEEN_SLICES = 9
"""Most slices in which the heart is sought over the whole field."""

LOOKED_AT = 7
"""Most slices by which it is judged how the heart lies."""

SOUGHT = (AS_THE_FILE_SAYS, Orientation(180), Orientation(90), Orientation(-90))
"""Orientations in which a heart is sought, until one shows it."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where the heart is and how it lies."""

    view: View
    """The part of the images that holds it."""

    orientation: Orientation
    """Against what the file says."""


def locate_heart(cine: Cine) -> Found:
    """Find the heart over the whole field, and how it lies in it.

    Sought first as the file's directions have it. Where none is found, it is sought lying
    otherwise; where it is seen to lie otherwise, it is looked at again that way.

    Raises
    ------
    StageError
        When the network sees no heart anywhere.
    """
    largest_mm2 = 0.0
    for sought in SOUGHT:
        view, size_mm2 = _locate(cine, sought)
        largest_mm2 = max(largest_mm2, size_mm2)
        if view is not None:
            break
    else:
        first, second = tried_phases(cine)
        raise StageError(
            f"phases {first} and {second}, slices 0 to {cine.intensity.shape[1] - 1}: no heart "
            f"found: the largest area taken for heart is {largest_mm2:.0f} mm2 over all slices, "
            "whichever way the images are turned; check that the study is a cardiac cine, "
            "and leave series of other parts of the body out"
        )
    orientation = find_orientation(_look_about(cine, view))
    if orientation != sought:
        better, _ = _locate(cine, orientation)
        if better is not None:
            return Found(better, orientation)
    return Found(view, sought)


def tried_phases(cine: Cine) -> list[int]:
    """Phases in which the heart is sought: two that differ, near the beat's start and systole."""
    return [0, max(1, len(cine.intensity) // 3)]


def _locate(cine: Cine, orientation: Orientation) -> tuple[View | None, float]:
    """The part of the images that holds the heart, and its size (mm2 over the slices tried)."""
    view = _padded(view_of(cine, orientation))
    chosen = _spread(len(view.order), SEEN_SLICES)
    heart, ring, moved = _seen_in_field(cine, view, chosen)
    parts, count = ndimage.label(heart > 0.5)
    if not count:
        return None, 0.0
    numbers = np.arange(1, count + 1)
    sizes_mm2 = ndimage.sum_labels(heart > 0.5, parts, numbers) * PIXEL_MM**2
    if sizes_mm2.max() < LEAST_FOUND_MM2:
        return None, float(sizes_mm2.max())
    # The abdomen shows bodies as large as the heart, but no ring around a cavity, and none beats.
    worth = ndimage.sum_labels(ring, parts, numbers) + RINGLESS * sizes_mm2 / PIXEL_MM**2
    worth *= STILL + ndimage.mean(moved, parts, numbers)
    best = int(np.where(sizes_mm2 < LEAST_FOUND_MM2, -1, worth).argmax())
    _, rows, columns = ndimage.find_objects(parts)[best]
    return view_around(view, rows, columns), float(sizes_mm2[best])


def _seen_in_field(
    cine: Cine, view: View, chosen: Sequence[int]
) -> tuple[Float32, Float32, Float32]:
    """What a first look over the whole field shows, each ``(slice, row, column)``.

    The probability of heart; which pixels are cavity that muscle encloses; and by how much grey
    values change between the phases tried.
    """
    phases = tried_phases(cine)
    heart, ring, moved = (np.zeros((len(chosen), *view.shape), np.float32) for _ in range(3))
    before: Float32 | None = None
    for phase in phases:
        batch = network_images(cine, view, phase, chosen, local=True)
        # One slice at a time: over the whole field all classes would fill the memory.
        for place, one in enumerate(batch):
            chance = predict(one[None])[0, PLANES // 2]
            heart[place] += (1 - chance[0]) / len(phases)
            ring[place] += in_a_ring(chance.argmax(axis=0)) / len(phases)
        if before is not None:
            moved = np.abs(batch[:, 1] - before)
        before = batch[:, 1]
    return heart, ring, moved


def in_a_ring(labels: Label) -> Mask:
    """Left ventricle's cavity where its muscle encloses it, on one slice."""
    return np.asarray(ndimage.binary_fill_holes(labels == MUSCLE) & (labels == CAVITY))


def _look_about(cine: Cine, place: View) -> Look:
    """Labels of a few slices about a place, and the network's doubt, in any orientation."""
    rows, columns = place.shape
    to_middle_mm = place.pixel_mm / 2 * np.array([columns - 1, rows - 1]) @ place.axes[:2]
    middle_mm = place.corner_mm + to_middle_mm

    def look(orientation: Orientation) -> tuple[Label, float]:
        whole = view_of(cine, orientation)
        column, row = (middle_mm - whole.corner_mm) @ whole.axes[:2].T / PIXEL_MM
        first = round(row - (WINDOW - 1) / 2), round(column - (WINDOW - 1) / 2)
        view = whole.cropped(first, (WINDOW, WINDOW))
        batch = network_images(cine, view, 0, _spread(len(view.order), LOOKED_AT))
        chance = predict(batch)[:, PLANES // 2]
        labels = _central_body(chance.argmax(axis=1).astype(np.uint8))
        return labels, float(-(chance * np.log(chance + 1e-6)).sum())

    return look


def _central_body(labels: Label) -> Label:
    """Labels ``(slice, row, column)`` of the one body that fills most of the middle."""
    parts, count = ndimage.label(labels > 0)
    if count < 2:
        return labels
    row, column = (np.linspace(-2, 2, side) for side in labels.shape[1:])
    near = np.exp(-0.5 * (row[:, None] ** 2 + column[None, :] ** 2))
    worth = ndimage.sum_labels(np.broadcast_to(near, labels.shape), parts, np.arange(1, count + 1))
    return np.where(parts == int(worth.argmax()) + 1, labels, 0).astype(np.uint8)


def _spread(count: int, most: int) -> list[int]:
    """At most so many of ``count`` numbers, evenly from the middles of equal parts."""
    parts = min(count, most)
    return [int((k + 0.5) * count / parts) for k in range(parts)]


def _padded(view: View) -> View:
    """The view with sides that the network takes."""
    rows, columns = (-(-side // MULTIPLE) * MULTIPLE for side in view.shape)
    return view.cropped((0, 0), (rows, columns))


def view_around(view: View, rows: slice, columns: slice) -> View:
    """The view in which a heart is labelled that lies in a box of another view's pixels.

    The smaller the heart, the finer the pixels. The sides are such as the network takes, and no
    smaller than training images: grey values are normalised over as much.
    """
    sides_mm = view.pixel_mm * np.array([rows.stop - rows.start, columns.stop - columns.start])
    pixel_mm = float(np.clip(sides_mm.max() / PIXELS_ACROSS, FINEST_MM, SHOWN_MM))
    least = np.maximum(sides_mm + 2 * SURROUNDINGS_MM, FIELD_MM) / pixel_mm
    shape = np.ceil(np.maximum(least, WINDOW) / MULTIPLE).astype(int) * MULTIPLE
    middle_mm = (
        view.pixel_mm * np.array([rows.start + rows.stop - 1, columns.start + columns.stop - 1]) / 2
    )
    row_mm, column_mm = middle_mm - pixel_mm * (shape - 1) / 2
    corner_mm = view.corner_mm + column_mm * view.axes[0] + row_mm * view.axes[1]
    return replace(
        view, corner_mm=corner_mm, shape=(int(shape[0]), int(shape[1])), pixel_mm=pixel_mm
    )
