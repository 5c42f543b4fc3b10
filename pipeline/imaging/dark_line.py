"""The muscle's outside, by the dark line that cine draws where fat begins.

In balanced steady state the signal of fat is opposed to the muscle's, and pixels that hold both are
dark. A network that has seen fat of either sign, and pericardium as dark as the line, draws the
outside about a pixel beyond it. Where the line is seen, with brighter tissue on both sides, the
outside is put where the line says.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.geometry import Float, Float32, Label, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.cleanup import THREADS
from pipeline.imaging.depth import depth_px
from pipeline.imaging.inference import PlaneProbability, darkest_grey, sampled_slice
from pipeline.imaging.interpolation import around, ventricle_margin
from pipeline.imaging.labels import CAVITY, MUSCLE, most_probable

INSIDE_PX, OUTSIDE_PX, STEP_PX = 2.0, 0.5, 0.25
"""The line is sought from so many pixels inside the outline to so many outside."""

BRIGHTENS_PX = 1.5
"""What is brighter lies within so many pixels of the line, on both sides."""

BEYOND_PX = 0.5
"""The muscle ends so many pixels outside the darkest place: beside brighter fat a pixel is darkest
while it holds more muscle than fat. By 0.4 to 0.6 for fat two to three times as bright; measured on
two renderers that share nothing, 0.4 to 0.7 where the line is plain."""

FAINT, PLAIN = 0.1, 0.2
"""How much brighter, as shares of the muscle's own grey, it must be beyond a line for this to count
for nothing, and in full; `FAINT` on the muscle's side."""

ALONG_MM = 5.0
"""Standard deviation along the outline by which grey values, and what lines say, are averaged."""

LEAST_TOLD = 0.25
"""Where lines are seen on a smaller share of the outline nearby, it is moved less."""

WHOLE_MM, NONE_MM = 1.5, 4.0
"""How far from the outline pixels move with it, and where they begin to stay."""

MARGIN_PX = 12
"""Pixels about the left ventricle on a slice that hold all that is looked at or moved."""

LEAST_POINTS = 12
"""An outline of fewer points is too small to have a side."""


def end_at_dark_line(found: PlaneProbability, cine: Cine) -> None:
    """Move the border between the left ventricle's muscle and the background, in place.

    Every slice of every phase tells of its own planes. Where the muscle borders on another
    structure, or no line is seen, nothing changes.
    """
    own_mm = float(np.linalg.norm(cine.mr_from_index[:3, :2], axis=0).max())
    pixel_px = max(own_mm / found.view.pixel_mm, 1.0)
    nothing = darkest_grey(cine.intensity)

    def one(place: tuple[int, int]) -> None:
        phase, number = place
        image = sampled_slice(cine, found.view, phase, number) - nothing
        _move_planes(found.of_slice(phase, number), image, pixel_px, found.view.pixel_mm)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(one, np.ndindex(len(found.value), len(found.view.order))))


class _Outline(NamedTuple):
    """The left ventricle's outside on a slice, closed."""

    points: Float
    """``(n, 2)`` row and column."""

    outwards: Float
    """``(n, 2)`` unit vectors."""


def _move_planes(planes: Float32, image: Float32, pixel_px: float, pixel_mm: float) -> None:
    """Move the outside on a slice's planes ``(plane, class, row, column)``, in place."""
    body = np.isin(most_probable(planes[len(planes) // 2], axis=0), (CAVITY, MUSCLE))
    rows, columns = around(body, MARGIN_PX)
    planes, image = planes[:, :, rows, columns], image[rows, columns]
    probability = planes[len(planes) // 2]
    labels = most_probable(probability, axis=0)
    outline = _outline(probability, labels)
    if outline is None:
        return
    along = ALONG_MM / pixel_mm
    move_px = _displacement_px(outline, image, labels, pixel_px, along)
    if not move_px.any():
        return
    tree = cKDTree(outline.points)
    moves = (move_px[:, None] * outline.outwards).astype(np.float32)
    for plane in planes:
        _move_plane(plane, tree, moves, pixel_mm)


def _outline(probability: Float32, labels: Label) -> _Outline | None:
    """Where the left ventricle, cavity and muscle as one, ends; its largest body alone."""
    from skimage.measure import find_contours

    if not (labels == MUSCLE).any():
        return None
    margin = ventricle_margin(probability)
    contours = [one for one in find_contours(margin, 0.0) if (one[0] == one[-1]).all()]
    points = max(contours, key=len)[:-1] if contours else np.empty((0, 2))
    if len(points) < LEAST_POINTS:
        return None
    slope = np.stack([_at(np.asarray(one), points) for one in np.gradient(margin)], axis=1)
    return _Outline(points, -slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-9)[:, None])


def _at(image: Float32, points: Float) -> Float32:
    """Values at ``(..., 2)`` rows and columns."""
    row, column = (np.ascontiguousarray(points[..., k], np.float32) for k in (0, 1))
    shape = row.shape
    flags = cv2.INTER_LINEAR
    flat = (column.reshape(len(column), -1), row.reshape(len(row), -1))
    found = cv2.remap(image.astype(np.float32), *flat, flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found.reshape(shape))


def _displacement_px(
    outline: _Outline, image: Float32, labels: Label, pixel_px: float, along: float
) -> Float:
    """How far outwards each point of the outline should move, ``(n,)``, in the view's pixels.

    Parameters
    ----------
    image, labels
        ``(row, column)`` grey values and most probable labels of the slice.
    pixel_px
        Size of the image's own pixels in the view's.
    along
        Standard deviation of what is averaged along the outline, in the view's pixels.
    """
    margin = round(BRIGHTENS_PX / STEP_PX)
    steps = np.arange(-INSIDE_PX - BRIGHTENS_PX, OUTSIDE_PX + BRIGHTENS_PX + 1e-6, STEP_PX)
    way = (steps * pixel_px)[:, None] * outline.outwards[:, None]
    apart = np.linalg.norm(np.diff(outline.points, axis=0, append=outline.points[:1]), axis=1)
    spread = along / float(apart.mean())

    def averaged(values: Float) -> Float:
        return np.asarray(ndimage.gaussian_filter1d(values, spread, axis=0, mode="wrap"))

    grey = averaged(_at(image, outline.points[:, None] + way).astype(float))
    muscle = max(float(np.median(image[labels == MUSCLE])), 1e-6)
    place, inner, outer = _darkest(grey, margin)
    ahead = np.rint(outline.points + 2 * outline.outwards).astype(int)
    ahead = np.clip(ahead, 0, np.array(labels.shape) - 1)
    told = np.clip((outer / muscle - FAINT) / (PLAIN - FAINT), 0, 1) * (inner > FAINT * muscle)
    told *= labels[ahead[:, 0], ahead[:, 1]] == 0
    wanted = (steps[0] + place * STEP_PX + BEYOND_PX) * pixel_px
    return averaged(told * wanted) / np.maximum(averaged(told), LEAST_TOLD)


def _darkest(grey: Float, margin: int) -> tuple[Float, Float, Float]:
    """Where each profile ``(n, step)`` is darkest, and how much brighter it is on either side.

    The outer ``margin`` steps hold what is compared with. Where the darkest place is the first or
    the last that is looked at, no line is seen: nothing is brighter.
    """
    rows = np.arange(len(grey))
    looked = grey[:, margin : grey.shape[1] - margin]
    first = looked.argmin(axis=1)
    darkest = first + margin
    low = grey[rows, darkest]
    near = darkest[:, None] + np.arange(1, margin + 1)
    outer = grey[rows[:, None], near].max(axis=1) - low
    inner = grey[rows[:, None], near - margin - 1].max(axis=1) - low
    ended = (first == 0) | (first == looked.shape[1] - 1)
    before, after = grey[rows, darkest - 1], grey[rows, darkest + 1]
    bend = np.maximum(before - 2 * low + after, 1e-9)
    place = darkest + np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return place, np.where(ended, 0, inner), np.where(ended, 0, outer)


def _move_plane(plane: Float32, tree: cKDTree, moves: Float32, pixel_mm: float) -> None:
    """Carry a plane's classes ``(class, row, column)`` outwards about its outline, in place."""
    labels = most_probable(plane, axis=0)
    body = np.isin(labels, (CAVITY, MUSCLE))
    if not body.any():
        return
    share = _share_moved(body, (labels > 0) & (labels != MUSCLE), pixel_mm)
    pixels = np.argwhere(share > 0)
    shift = np.zeros((*body.shape, 2), np.float32)
    _, nearest = tree.query(pixels)
    shift[tuple(pixels.T)] = moves[nearest] * share[tuple(pixels.T)][:, None]
    rows, columns = np.indices(body.shape, np.float32)
    places = columns - shift[..., 1], rows - shift[..., 0]
    for one in plane:
        one[:] = cv2.remap(one, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _share_moved(body: Mask, still: Mask, pixel_mm: float) -> Float32:
    """By which share of the outline's own move each pixel moves: all near it, ``still`` none."""
    from_outline_mm = np.where(body, depth_px(body), depth_px(~body)) * pixel_mm - pixel_mm / 2
    share = np.clip((NONE_MM - from_outline_mm) / (NONE_MM - WHOLE_MM), 0, 1)
    if still.any():
        share *= np.clip(depth_px(~still) - 0.5, 0, 1)
    return np.asarray(share, np.float32)
