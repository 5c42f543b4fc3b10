"""Run the network over a cine: find the heart, then label all its slices and phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32
from pipeline.imaging.cine import Cine
from pipeline.imaging.network import (
    CLASSES,
    MULTIPLE,
    PLANES,
    neighbour_steps,
    normalise,
    predict,
    with_neighbours,
)
from pipeline.imaging.view import PIXEL_MM, View, view_of

Progress = Callable[[int, int], None]

SURROUNDINGS_MM = 30.0
"""Room left around the heart found at first sight: what it beats into, and what tells it apart."""

THICKNESS_MM = 6.0
"""Slices that lie closer are averaged over this, the thickness that the network knows."""

LEAST_FOUND_MM2 = 400.0
"""Cut area, over all slices, below which what was found is not a heart."""


@dataclass(frozen=True, slots=True)
class PlaneProbability:
    """Class probabilities on parallel planes through the cycle."""

    value: Float32
    """``(phase, plane, class, row, column)``, the plane nearest the apex first."""

    view: View
    """Where rows, columns and slices lie in the patient."""

    planes_a_slice: int
    """3 where the network's planes between slices are used, else 1."""

    @property
    def plane_mm(self) -> Float:
        """Heights of the planes along the view's normal above its corner, ``(plane,)``."""
        step_mm, count = self.view.slice_step_mm, self.planes_a_slice
        first_mm = -(count // 2) * step_mm / count
        return np.asarray(first_mm + step_mm / count * np.arange(self.value.shape[1]))

    def at_slices(self, phase: int) -> Float32:
        """Probabilities on the slices themselves, ``(slice, class, row, column)``."""
        middle = self.planes_a_slice // 2
        return self.value[phase, middle :: self.planes_a_slice]


def locate_heart(cine: Cine) -> View:
    """The part of the images that holds the heart, found in two phases over the whole field.

    Raises
    ------
    StageError
        When the network sees no heart anywhere.
    """
    view = _padded(view_of(cine))
    step = neighbour_steps(view.slice_step_mm)
    # Slices a neighbour's distance apart are enough to find it by; so are two phases.
    chosen = range(step // 2, len(view.order), step)
    seen = np.zeros((len(chosen), *view.shape), np.float32)
    tried = sorted({0, len(cine.intensity) // 3})
    for phase in tried:
        images = np.stack([normalise(image) for image in _sampled(cine, view, phase)])
        batch = with_neighbours(images, step)
        # One slice at a time: over the whole field all classes would fill the memory.
        for place, number in enumerate(chosen):
            seen[place] += 1 - predict(batch[number : number + 1])[0, PLANES // 2, 0]
    parts, found = ndimage.label(seen / len(tried) > 0.5)
    sizes = np.bincount(parts.ravel())[1:] if found else np.zeros(1)
    if sizes.max() * PIXEL_MM**2 < LEAST_FOUND_MM2:
        raise StageError(
            f"no heart found in slices 0 to {len(view.order) - 1}, phases {tried}: the largest "
            f"area taken for heart is {sizes.max() * PIXEL_MM**2:.0f} mm2 over all slices; check "
            "that the study is a cardiac cine and that its orientation is right (`inspect`)"
        )
    _, rows, columns = ndimage.find_objects((parts == sizes.argmax() + 1).astype(np.uint8))[0]
    return _around(view, rows, columns)


def _padded(view: View) -> View:
    """The view with sides that the network takes."""
    rows, columns = (-(-side // MULTIPLE) * MULTIPLE for side in view.shape)
    return view.cropped((0, 0), (rows, columns))


def _around(view: View, rows: slice, columns: slice) -> View:
    """The part of a view around a box of pixels, with sides that the network takes."""
    room = SURROUNDINGS_MM / PIXEL_MM
    first, shape = [], []
    for box in (rows, columns):
        side = int(np.ceil((box.stop - box.start + 2 * room) / MULTIPLE)) * MULTIPLE
        first.append(round((box.start + box.stop - side) / 2))
        shape.append(side)
    return view.cropped((first[0], first[1]), (shape[0], shape[1]))


def _sampled(cine: Cine, view: View, phase: int) -> Float32:
    """Images of one phase on the view, apex first, thin slices averaged: (slice, row, column)."""
    images = [view.sample(cine.intensity[phase, z], number) for number, z in enumerate(view.order)]
    together = round(THICKNESS_MM / view.slice_step_mm)
    stack = np.stack(images)
    if together > 1:
        stack = ndimage.uniform_filter1d(stack, together, axis=0, mode="nearest")
    return stack


def label_probability(cine: Cine, view: View, progress: Progress | None = None) -> PlaneProbability:
    """Probabilities of all classes in all phases on the planes that the slices give.

    Each slice gives three planes where its neighbours are the stack's own; where slices lie
    closer than that, only its own.
    """
    step = neighbour_steps(view.slice_step_mm)
    keep = slice(None) if step == 1 else slice(PLANES // 2, PLANES // 2 + 1)
    planes = PLANES if step == 1 else 1
    phases, slices = len(cine.intensity), len(view.order)
    value = np.empty((phases, slices * planes, CLASSES, *view.shape), np.float32)
    for phase in range(phases):
        images = np.stack([normalise(image) for image in _sampled(cine, view, phase)])
        chance = predict(with_neighbours(images, step))[:, keep]
        value[phase] = chance.reshape(-1, CLASSES, *view.shape)
        if progress is not None:
            progress(phase + 1, phases)
    return PlaneProbability(value, view, planes)


def blend_phases(value: Float32, share: float) -> None:
    """Mix each phase with its two neighbours in the cycle, in place."""
    first, before = value[0].copy(), value[-1].copy()
    for phase in range(len(value)):
        now = value[phase].copy()
        after = first if phase == len(value) - 1 else value[phase + 1]
        value[phase] *= 1 - 2 * share
        value[phase] += share * before
        value[phase] += share * after
        before = now
