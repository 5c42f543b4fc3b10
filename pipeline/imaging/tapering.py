"""The left ventricle's outside between the slices and at its tip, round as it is.

A slice averages over its thickness, and where the wall leans it shows the epicardium at its
widest: what the network draws a third of the spacing to either side is nearly the same outline,
so that labels rise in steps. Below its widest cut the ventricle is therefore drawn from the
slices themselves: its outline runs from slice to slice as a cubic in height, and beyond the last
one it shrinks to nothing as a paraboloid does, whose cuts fall in a straight line.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.labels import CAVITY, MUSCLE

BAND_MM = 4.0
"""Depths are cut off here. Planes are some 3 mm apart, so a wall may lean by 50 degrees and its
slope still be followed; the seam between two structures that end against each other is notched
by a third of this at its rim."""

TAPER_MM = 20.0
"""How a body tapers towards the tip is told by its cuts this near to the last one."""

LID_MM = 2.0
"""Muscle between the cavity and the outside, at the least, where no slice shows it."""

STEP_MM = 1.5
"""Planes are added until they lie no farther apart than this: between planes outlines run straight,
and no faster than depths that are cut off can follow."""


class _Dome(NamedTuple):
    """A body's last cut and where it ends."""

    depth_mm: Float32
    """``(row, column)`` of the last cut, positive inside."""

    height_mm: float
    end_mm: float
    """Height at which nothing is left, below ``height_mm``."""

    def at(self, height_mm: float) -> Float32:
        """Depth in the plane at a height below the last cut: the cut, shrunk from all sides."""
        left = (height_mm - self.end_mm) / max(self.height_mm - self.end_mm, 1e-6)
        if left <= 0:
            return np.full_like(self.depth_mm, -np.inf)
        radius_mm = float(self.depth_mm.max())
        return self.depth_mm - np.float32(radius_mm * (1 - np.sqrt(left)))


def taper_ventricle(
    depth_mm: Float32, height_mm: Float, slices: Integer, ventricle_mm: Float32
) -> tuple[Float32, Float]:
    """Planes on which the left ventricle is drawn from the slices, from its widest cut to its tip.

    The tip lies no farther than the next slice, which does not show it, or than half a step beyond
    the last slice of the stack. What the ventricle gives up between slices falls to what lies
    nearest, at the tip to the background; other chambers lose nothing to the tip.

    Parameters
    ----------
    depth_mm
        ``(plane, class, row, column)``, positive inside, the plane nearest the apex first; both
        ends hold background only.
    height_mm
        ``(plane,)`` heights of the planes, rising.
    slices
        ``(slice,)`` which of the planes are slices.
    ventricle_mm
        ``(slice, row, column)`` depth in the ventricle, cavity and muscle together.

    Returns
    -------
    depth, heights
        As given, with planes added up to the widest slice; as given where nothing tapers.
    """
    cuts = (ventricle_mm > 0).sum(axis=(1, 2)).astype(float)
    widest = int(cuts.argmax())
    first = int((cuts > 0).argmax())
    walled = depth_mm.shape[1] > MUSCLE and (depth_mm[slices, MUSCLE] > 0).any()
    if not walled or first == widest or not cuts[first:widest].all():
        return depth_mm, height_mm
    slice_mm = height_mm[slices]
    lowest_mm = float(slice_mm[first - 1] if first else height_mm[0])
    cavities_mm = depth_mm[slices, CAVITY]
    # A cavity that the last slice shows has muscle under it.
    lid_mm = LID_MM if (cavities_mm[first] > 0).any() else 0.0
    outside = _dome(ventricle_mm, slice_mm, first, lowest_mm, lid_mm)
    inside = _inside(cavities_mm, slice_mm, outside)
    between = _Between(slice_mm[first : widest + 1], ventricle_mm[first : widest + 1])

    depth_mm, height_mm = _with_planes(
        np.clip(depth_mm, -BAND_MM, BAND_MM), height_mm, outside.end_mm, slice_mm[widest]
    )
    for plane, at_mm in zip(depth_mm, height_mm, strict=True):
        if at_mm >= slice_mm[widest] or at_mm in slice_mm[first:]:
            continue
        cavity_mm = inside.at(at_mm) if at_mm < inside.height_mm else plane[CAVITY]
        if at_mm < outside.height_mm:
            _draw_tip(plane, outside.at(at_mm), cavity_mm)
        else:
            _draw_between(plane, between.at(at_mm), cavity_mm)
    return depth_mm, height_mm


def _dome(
    cut_mm: Float32, slice_mm: Float, first: int, lowest_mm: float, lid_mm: float = 0.0
) -> _Dome:
    """The end of a body whose last cut is on slice ``first``, at ``lowest_mm`` or above."""
    cuts = (cut_mm[first:] > 0).sum(axis=(1, 2)).astype(float)
    away_mm = slice_mm[first:] - slice_mm[first]
    near = away_mm < TAPER_MM + 1e-6
    growth = np.polyfit(away_mm[near], cuts[near], 1)[0] if near.sum() > 1 else 0.0
    end_mm = slice_mm[first] - max(cuts[0] / max(growth, 1e-9), lid_mm)
    return _Dome(cut_mm[first], float(slice_mm[first]), float(max(end_mm, lowest_mm)))


def _inside(cavity_mm: Float32, slice_mm: Float, outside: _Dome) -> _Dome:
    """The cavity's end: within the muscle, and before the next slice, which does not show it."""
    shown = np.flatnonzero((cavity_mm > 0).any(axis=(1, 2)))
    if not len(shown):
        return _Dome(cavity_mm[0], -np.inf, -np.inf)
    first = int(shown[0])
    lowest_mm = outside.end_mm + LID_MM
    if first:
        lowest_mm = max(lowest_mm, float(slice_mm[first - 1]))
    dome = _dome(cavity_mm, slice_mm, first, lowest_mm)
    return dome._replace(end_mm=min(dome.end_mm, dome.height_mm))


def _with_planes(
    depth_mm: Float32, height_mm: Float, from_mm: float, to_mm: float
) -> tuple[Float32, Float]:
    """Planes added wherever two lie more than `STEP_MM` apart between two heights."""
    wanted_mm = [height_mm]
    for low_mm, high_mm in pairwise(np.r_[from_mm, height_mm[height_mm > from_mm]]):
        if low_mm < to_mm:
            count = int(np.ceil((high_mm - low_mm) / STEP_MM - 1e-6))
            wanted_mm.append(low_mm + (high_mm - low_mm) * np.arange(count) / max(count, 1))
    wanted = np.unique(np.concatenate(wanted_mm))
    position = np.interp(wanted, height_mm, np.arange(len(height_mm)))
    lower = np.minimum(position.astype(int), len(height_mm) - 2)
    share = (position - lower).astype(np.float32)
    found = depth_mm[lower]
    for plane, low, part in zip(found, lower, share, strict=True):
        if part > 0:
            plane += part * (depth_mm[low + 1] - plane)
    return found, wanted


class _Between:
    """Depth by height between slices, cubic, with the slopes of parabolas through three of them."""

    def __init__(self, slice_mm: Float, cut_mm: Float32) -> None:
        self.slice_mm, self.cut_mm = slice_mm, cut_mm
        slopes = np.gradient(cut_mm, slice_mm, axis=0, edge_order=2 if len(slice_mm) > 2 else 1)
        self.cubic = CubicHermiteSpline(slice_mm, cut_mm, slopes)

    def at(self, height_mm: float) -> Float32:
        """Depth in the plane at a height, within what the slices on both sides have."""
        upper = int(np.searchsorted(self.slice_mm, height_mm))
        low, high = self.cut_mm[upper - 1], self.cut_mm[upper]
        found = np.clip(self.cubic(height_mm), np.minimum(low, high), np.maximum(low, high))
        return np.asarray(found, np.float32)


def _draw_tip(plane: Float32, body_mm: Float32, cavity_mm: Float32) -> None:
    """Put the ventricle's end into a plane ``(class, row, column)``, background around it."""
    others = [k for k in range(1, len(plane)) if k not in (CAVITY, MUSCLE)]
    body_mm = np.minimum(body_mm, -plane[others].max(axis=0, initial=-np.inf))
    plane[CAVITY] = np.minimum(cavity_mm, body_mm - LID_MM)
    plane[MUSCLE] = np.minimum(body_mm, -plane[CAVITY])
    plane[0] = -plane[1:].max(axis=0)


def _draw_between(plane: Float32, body_mm: Float32, cavity_mm: Float32) -> None:
    """Put the ventricle into a plane between two slices in place of what it was there."""
    others = [k for k in range(len(plane)) if k not in (CAVITY, MUSCLE)]
    around = plane[others]
    nearest = around.max(axis=0)
    given_up = (body_mm < 0) & (nearest < 0)
    left = around - nearest + np.minimum(-body_mm, BAND_MM)
    plane[others] = np.where(given_up, left, np.minimum(around, -body_mm))
    # Where it opens into an atrium or the aorta there is no muscle.
    lid_mm = np.where(around[0] >= nearest, LID_MM, 0)
    plane[CAVITY] = np.minimum(cavity_mm, body_mm - lid_mm)
    plane[MUSCLE] = np.minimum(body_mm, -plane[CAVITY])
