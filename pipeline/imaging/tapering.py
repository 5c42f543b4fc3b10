"""The left ventricle's outside between the slices and at its tip, round as it is.

A slice averages over its thickness, and where the wall leans it shows the epicardium at its
widest: what the network draws a third of the spacing to either side is nearly the same outline,
so that labels rise in steps. Below its widest cut the ventricle is therefore drawn from the
slices themselves: its outline runs from slice to slice as a cubic in height, and beyond the last
one it shrinks to nothing as a paraboloid does, whose cuts fall in a straight line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.labels import LABELS

CAVITY, MUSCLE = LABELS["lv_cavity"], LABELS["lv_myocardium"]

TAPER_MM = 20.0
"""How a body tapers towards the tip is told by its cuts this near to the last one."""

LID_MM = 2.0
"""Muscle between the cavity and the outside, at the least, where no slice shows it."""

STEP_MM = 1.5
"""Distance of the planes by which the tip is rounded off."""


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
        return self.depth_mm - np.float32(radius_mm * (1 - np.sqrt(min(left, 1.0))))


def taper_ventricle(
    depth_mm: Float32, height_mm: Float, slices: Integer, ventricle_mm: Float32, band_mm: float
) -> tuple[Float32, Float]:
    """Planes on which the left ventricle is drawn from the slices, from its widest cut to its tip.

    The tip lies no farther than half a step beyond the next slice towards it, or beyond the last
    slice of the stack. What the ventricle gives up between slices falls to what lies nearest, at
    the tip to the background.

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
    band_mm
        Depths are cut off here.

    Returns
    -------
    depth, heights
        As given, with planes added about the tip; as given where nothing tapers.
    """
    cuts = (ventricle_mm > 0).sum(axis=(1, 2)).astype(float)
    widest = int(cuts.argmax())
    empty = np.flatnonzero(cuts[:widest] == 0)
    first = int(empty[-1]) + 1 if len(empty) else 0
    walled = depth_mm.shape[1] > MUSCLE and (depth_mm[slices, MUSCLE] > 0).any()
    if not walled or first == widest:
        return depth_mm, height_mm
    slice_mm = height_mm[slices]
    half_mm = slice_mm[0] - height_mm[0]
    lowest_mm = slice_mm[max(first - 1, 0)] - half_mm
    outside = _dome(ventricle_mm, slice_mm, first, lowest_mm)
    inside = _inside(depth_mm[slices, CAVITY], slice_mm, outside)

    depth_mm, height_mm = _with_planes(np.clip(depth_mm, -band_mm, band_mm), height_mm, outside)
    between = _between(slice_mm[first : widest + 1], ventricle_mm[first : widest + 1])
    for plane, at_mm in zip(depth_mm, height_mm, strict=True):
        if at_mm >= slice_mm[widest] or at_mm in slice_mm[first:]:
            continue
        cavity_mm = inside.at(at_mm) if at_mm < inside.height_mm else plane[CAVITY]
        at_tip = at_mm < outside.height_mm
        body_mm = outside.at(at_mm) if at_tip else np.asarray(between(at_mm), np.float32)
        _draw(plane, body_mm, cavity_mm, at_tip)
    return depth_mm, height_mm


def _dome(cut_mm: Float32, slice_mm: Float, first: int, lowest_mm: float) -> _Dome:
    """The end of a body whose last cut is on slice ``first``, at ``lowest_mm`` or above."""
    cuts = (cut_mm[first:] > 0).sum(axis=(1, 2)).astype(float)
    away_mm = slice_mm[first:] - slice_mm[first]
    near = away_mm < TAPER_MM + 1e-6
    near[:2] = True
    growth = np.polyfit(away_mm[near], cuts[near], 1)[0] if near.sum() > 1 else 0.0
    end_mm = slice_mm[first] - cuts[0] / max(growth, 1e-9)
    return _Dome(cut_mm[first], float(slice_mm[first]), float(max(end_mm, lowest_mm)))


def _inside(cavity_mm: Float32, slice_mm: Float, outside: _Dome) -> _Dome:
    """The cavity's end: within the muscle, and before the next slice, which does not show it."""
    shown = np.flatnonzero((cavity_mm > 0).any(axis=(1, 2)))
    if not len(shown):
        return _Dome(cavity_mm[0], -np.inf, -np.inf)
    first = int(shown[0])
    lowest_mm = max(outside.end_mm + LID_MM, slice_mm[max(first - 1, 0)] if first else -np.inf)
    dome = _dome(cavity_mm, slice_mm, first, lowest_mm)
    return dome._replace(end_mm=min(dome.end_mm, dome.height_mm))


def _with_planes(depth_mm: Float32, height_mm: Float, dome: _Dome) -> tuple[Float32, Float]:
    """Planes added through the dome, between those that are there."""
    count = max(2, int(np.ceil((dome.height_mm - dome.end_mm) / STEP_MM)))
    through_mm = np.linspace(dome.end_mm, dome.height_mm, count + 1)[:-1]
    wanted_mm = np.union1d(height_mm, through_mm)
    position = np.interp(wanted_mm, height_mm, np.arange(len(height_mm)))
    lower = np.minimum(position.astype(int), len(height_mm) - 2)
    share = (position - lower)[:, None, None, None].astype(np.float32)
    return (1 - share) * depth_mm[lower] + share * depth_mm[lower + 1], wanted_mm


def _between(slice_mm: Float, cut_mm: Float32) -> CubicHermiteSpline:
    """Depth by height between slices; slopes are those of parabolas through three of them."""
    slopes = np.gradient(cut_mm, slice_mm, axis=0, edge_order=2 if len(slice_mm) > 2 else 1)
    return CubicHermiteSpline(slice_mm, cut_mm, slopes)


def _draw(plane: Float32, body_mm: Float32, cavity_mm: Float32, at_tip: bool) -> None:
    """Put the ventricle into a plane ``(class, row, column)`` in place of what it was there."""
    before = np.maximum(plane[CAVITY], plane[MUSCLE])
    others = [k for k in range(len(plane)) if k not in (CAVITY, MUSCLE)]
    around = plane[others]
    nearest = around.max(axis=0)
    given_up = (body_mm < 0) & (before > 0) & (nearest < 0)
    outside_mm = np.minimum(-body_mm, 50.0)
    left = around - nearest + outside_mm
    if at_tip:
        left[1:] = -outside_mm
        left[0] = outside_mm
    plane[others] = np.where(given_up, left, np.minimum(around, -body_mm))
    plane[CAVITY] = np.minimum(cavity_mm, body_mm - LID_MM)
    plane[MUSCLE] = np.minimum(body_mm, -plane[CAVITY])
