"""Long-axis views beside the stack: which images they are, and where slices lie against them.

Every slice and every view is held in a breath of its own. Where a view's plane cuts a slice, both
show the same line through the heart at every moment of the beat; how far the slice must be moved
in its plane until the grey values along the line agree is how far its breath-hold was from the
view's. Agreement along lines of intersection, over all phases: Slomka et al., J. Magn. Reson.
Imaging 25(5):965-973, 2007; IEEE Trans. Med. Imaging 29(3):868-878, 2010. What moves a slice along
its normal is not found here: it shows in no single slice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import map_coordinates, uniform_filter1d

from pipeline.geometry import Float, Float32, Integer, Label, Mask, transform_points
from pipeline.imaging.cine import Cine
from pipeline.imaging.view import View

STEP_MM = 1.0
"""Distance of the points along a line of intersection, and of the shifts tried."""

SEARCH_MM = 10
"""Largest shift tried, along the line and across it."""

BLUR_MM = 6
"""Slices are some 8 mm thick: along each image's own plane the other one is blurred by this much,
so that both show the same mean."""

AROUND_MM = 12.0
"""How far beyond the heart's outline grey values are compared."""

LEAST_LINE_MM = 40.0
"""A shorter line tells too little: a view grazing the heart, a slice through its tip."""

LEAST_AGREEMENT = 0.6
"""Correlation below which a line is not understood."""

MOST_PHASES = 8
"""Moments that are compared; the others tell next to nothing more."""

INDEPENDENT = 60.0
"""Grey values along a line over all phases that can be counted as independent of one another."""

PLACE_MM = 0.5
"""Standard deviation of a place found, however sharp the agreement: inflow, thickness, tilt."""

LEAST_STEP_MM = 4.0
"""Slices nearer to one another are parts of one volume, with no breath-holds of their own."""


@dataclass(frozen=True, slots=True)
class Crossings:
    """How far slices lie from views, in the slices' plane."""

    slices: tuple[int, ...]
    """Number of the slice of each measurement, from the apex; interpolated ones do not count."""

    views: tuple[int, ...]
    """Number of the view of each."""

    offsets_mm: Float
    """``(n, 2)`` shift of the slice less that of the view, along columns and rows."""

    precision: Float
    """``(n, 2, 2)`` inverse covariance, 1/mm2."""

    def without(self, view: int) -> Crossings:
        """All but those of one view."""
        kept = [k for k, other in enumerate(self.views) if other != view]
        return Crossings(
            tuple(self.slices[k] for k in kept),
            tuple(self.views[k] for k in kept),
            self.offsets_mm[kept],
            self.precision[kept],
        )


NO_CROSSINGS = Crossings((), (), np.zeros((0, 2)), np.zeros((0, 2, 2)))


def find_crossings(cine: Cine, views: Sequence[Cine], view: View, drawn: Label) -> Crossings:
    """Compare every slice with every long-axis view along their line of intersection.

    Parameters
    ----------
    cine
        The stack.
    views
        Long-axis views: cines of one slice each.
    view
        Where rows and columns of ``drawn`` lie.
    drawn
        ``(phase, slice, row, column)`` labels of the heart, apex first.

    Returns
    -------
    Crossings
        Those lines along which slice and view agree at one place clearly.
    """
    if view.slice_step_mm < LEAST_STEP_MM:
        return NO_CROSSINGS
    slices, numbers, offsets_mm, precision = [], [], [], []
    acquired = np.flatnonzero(~np.isin(view.order, cine.interpolated))
    for place, number in enumerate(acquired.tolist()):
        heart_mm = _heart_mm(drawn[:, number], view.pixel_mm)
        for k, other in enumerate(views):
            line = _line(cine, other, view, number, heart_mm)
            found = None if line is None else _compare(cine, other, line, view.order[number])
            if line is not None and found is not None:
                slices.append(place)
                numbers.append(k)
                offsets_mm.append(line.in_plane.T @ found[0])
                precision.append(line.in_plane.T @ found[1] @ line.in_plane)
    if not slices:
        return NO_CROSSINGS
    return Crossings(tuple(slices), tuple(numbers), np.array(offsets_mm), np.array(precision))


@dataclass(frozen=True, slots=True)
class _Line:
    """Where a view's plane cuts a slice, as far as the heart reaches."""

    points_mm: Float
    """``(n, 3)`` LPS, `STEP_MM` apart."""

    axes: Float
    """``(3, 3)`` rows, LPS: along the line, across it in the slice, along the slice's normal."""

    in_plane: Float
    """``(2, 2)`` rows: along the line and across it, in columns and rows of the slice."""


def _heart_mm(drawn: Label, pixel_mm: float) -> Float:
    """Places ``(n, 2)`` along columns and rows at which a slice shows the heart in any phase."""
    rows, columns = np.nonzero((drawn > 0).any(axis=0))
    return np.asarray(np.stack([columns, rows], axis=1) * pixel_mm, float)


def _line(cine: Cine, other: Cine, view: View, number: int, heart_mm: Float) -> _Line | None:
    """The line of intersection of slice ``number`` and a view; None where it misses the heart."""
    columns, rows, normal = view.axes
    origin_mm = cine.mr_from_index[:3, 3] + view.order[number] * cine.mr_from_index[:3, 2]
    corner_mm = view.corner_mm + ((origin_mm - view.corner_mm) @ normal) * normal
    across = np.cross(other.mr_from_index[:3, 0], other.mr_from_index[:3, 1])
    across /= np.linalg.norm(across)
    inside = np.array([across @ columns, across @ rows])
    length = float(np.linalg.norm(inside))
    if length < 0.5 or not len(heart_mm):
        return None
    inside /= length
    away_mm = float(across @ (other.mr_from_index[:3, 3] - corner_mm)) / length
    along = np.array([-inside[1], inside[0]])
    near = np.abs(heart_mm @ inside - away_mm) < BLUR_MM
    if not near.any():
        return None
    places_mm = heart_mm[near] @ along
    if np.ptp(places_mm) < LEAST_LINE_MM - AROUND_MM:
        return None
    t_mm = np.arange(places_mm.min() - AROUND_MM, places_mm.max() + AROUND_MM, STEP_MM)
    flat_mm = away_mm * inside + t_mm[:, None] * along
    axes = np.stack([along @ view.axes[:2], inside @ view.axes[:2], normal])
    return _Line(corner_mm + flat_mm @ view.axes[:2], axes, np.stack([along, inside]))


def _compare(cine: Cine, other: Cine, line: _Line, z: int) -> tuple[Float, Float] | None:
    """Shift ``(2,)`` along and across the line at which both agree best, and its precision."""
    chosen = np.unique(np.linspace(0, len(cine.phases) - 1, MOST_PHASES).round().astype(int))
    theirs = _profiles(other, line, cine.phases[chosen])
    ours = _slice_patches(cine, line, z, chosen)
    valid: Mask = np.asarray(np.isfinite(theirs).all(axis=0))
    if valid.sum() * STEP_MM < LEAST_LINE_MM or not np.isfinite(ours).all():
        return None
    agreement = _agreement(ours, theirs, valid)
    return _peak(agreement)


def _profiles(other: Cine, line: _Line, phases: Float) -> Float:
    """Grey values of a view along the line at the stack's phases: ``(phase, n)``."""
    offsets_mm = np.arange(-BLUR_MM / 2, BLUR_MM / 2 + 0.5)[:, None, None] * line.axes[2]
    images = _at_phases(other, phases)
    points_mm = line.points_mm + offsets_mm
    values = np.stack([_sampled(image, other.mr_from_index, points_mm) for image in images])
    return np.asarray(values.mean(axis=1))


def _at_phases(other: Cine, phases: Float) -> Float32:
    """Images ``(phase, row, column)`` of a view between its own phases, which are cyclic."""
    count = len(other.phases)
    times = np.concatenate([other.phases, [other.phases[0] + 1]])
    place = np.interp((phases - times[0]) % 1 + times[0], times, np.arange(count + 1))
    low = np.floor(place).astype(int)
    share = (place - low).astype(np.float32)[:, None, None]
    images = other.intensity[:, 0]
    return np.asarray((1 - share) * images[low % count] + share * images[(low + 1) % count])


def _slice_patches(cine: Cine, line: _Line, z: int, chosen: Integer) -> Float:
    """Grey values of a slice about the line: ``(phase, across, along)``, `SEARCH_MM` beyond it."""
    reach = SEARCH_MM + BLUR_MM // 2
    before = line.points_mm[0] - SEARCH_MM * line.axes[0]
    along = np.arange(len(line.points_mm) + 2 * SEARCH_MM)[None, :, None] * line.axes[0]
    across = np.arange(-reach, reach + 1)[:, None, None] * line.axes[1]
    mr_from_index = cine.mr_from_index.copy()
    mr_from_index[:3, 3] += z * mr_from_index[:3, 2]
    patches = np.stack(
        [_sampled(cine.intensity[k, z], mr_from_index, before + along + across) for k in chosen]
    )
    blurred = uniform_filter1d(patches, BLUR_MM + 1, axis=1, mode="nearest")
    return np.asarray(blurred[:, BLUR_MM // 2 : -(BLUR_MM // 2)])


def _sampled(image: Float32, mr_from_index: Float, points_mm: Float) -> Float:
    """Grey values at points in (or near) an image's plane; NaN outside the image."""
    index = transform_points(np.asarray(np.linalg.inv(mr_from_index), float), points_mm)
    return np.asarray(
        map_coordinates(
            np.asarray(image, float), [index[..., 1], index[..., 0]], order=1, cval=np.nan
        )
    )


def _agreement(ours: Float, theirs: Float, valid: Mask) -> Float:
    """Correlation of both over phases and points for every shift: ``(across, along)``."""
    windows: Float = sliding_window_view(ours, theirs.shape[1], axis=2)[..., valid]
    model = theirs[:, valid] - theirs[:, valid].mean()
    mean = windows.mean(axis=(0, 3))
    power = np.square(windows).mean(axis=(0, 3)) - mean**2
    product = np.einsum("patn,pn->at", windows, model) / model.size
    scale = np.sqrt(np.maximum(power * np.square(model).mean(), 1e-12))
    return np.asarray(product / scale)


def _peak(agreement: Float) -> tuple[Float, Float] | None:
    """Place of the best agreement, (along, across), mm, and the precision with which it is known.

    The likelihood of correlated normal values falls as ``(1 - r^2)^(n/2)``; a parabola through
    the eight neighbours of its peak gives the precision.
    """
    row, column = np.unravel_index(agreement.argmax(), agreement.shape)
    last = 2 * SEARCH_MM
    if agreement[row, column] < LEAST_AGREEMENT or not (0 < row < last and 0 < column < last):
        return None
    near = agreement[row - 1 : row + 2, column - 1 : column + 2]
    chance = INDEPENDENT / 2 * np.log(np.maximum(1 - np.clip(near, 0, 1) ** 2, 1e-6))
    gradient = np.array([chance[1, 2] - chance[1, 0], chance[2, 1] - chance[0, 1]]) / 2
    mixed = (chance[2, 2] - chance[2, 0] - chance[0, 2] + chance[0, 0]) / 4
    along = chance[1, 2] + chance[1, 0] - 2 * chance[1, 1]
    across = chance[2, 1] + chance[0, 1] - 2 * chance[1, 1]
    bend = np.array([[along, mixed], [mixed, across]])
    if np.linalg.eigvalsh(bend)[0] <= 1e-3:
        return None
    spread = np.linalg.inv(bend)
    refined = np.clip(-spread @ gradient, -1, 1)
    place = np.array([column - SEARCH_MM, row - SEARCH_MM]) + refined
    precision: Float = np.asarray(np.linalg.inv(spread + PLACE_MM**2 * np.eye(2)), float)
    return STEP_MM * place, precision
