"""Long-axis views beside the stack: which images they are, and where slices lie against them.

Every slice and every view is held in a breath of its own. Where a view's plane cuts a slice, both
show the same line through the heart at every moment of the beat; how far the slice must be moved
until the grey values along the line agree is how far its breath-hold was from the view's. In its
plane it is moved over the view's line; along its normal, which shows in no slice by itself, it is
compared with other lines of the view, above and below. Agreement along lines of intersection, over
all phases: Slomka et al., J. Magn. Reson. Imaging 25(5):965-973, 2007; IEEE Trans. Med. Imaging
29(3):868-878, 2010.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import map_coordinates, uniform_filter1d

from pipeline.geometry import Float, Float32, Integer, Label, Mask, transform_points
from pipeline.imaging.cine import Cine
from pipeline.imaging.phases import around_phases
from pipeline.imaging.view import View
from pipeline.registration.clock import to_cycle

STEP_MM = 1.0
"""Distance of the points along a line of intersection, and of the shifts tried."""

SEARCH_MM = 10
"""Largest shift tried, along the line, across it and along the slice's normal."""

BLUR_MM = 8
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

INDEPENDENT = 20.0
"""Grey values along a line over all phases that can be counted as independent of one another."""

PLACE_MM = (0.3, 0.4, 0.6)
"""Standard deviation of a place found, however sharp the agreement (inflow, thickness, tilt): along
the line, across it in the slice, across it in the view."""

LEAST_STEP_MM = 4.0
"""Slices nearer to one another are parts of one volume, with no breath-holds of their own."""


@dataclass(frozen=True, slots=True)
class Crossings:
    """How far slices lie from views."""

    slices: tuple[int, ...]
    """Number of the slice of each measurement, from the apex; interpolated ones do not count."""

    views: tuple[int, ...]
    """Number of the view of each."""

    offsets_mm: Float
    """``(n, 3)`` shift of the slice less that of the view, along columns, rows and normal."""

    precision: Float
    """``(n, 3, 3)`` inverse covariance, 1/mm2."""

    compared: tuple[int, ...] = ()
    """Number of the view of every line that was compared, whether both agree along it or not."""

    def agreement(self, view: int) -> tuple[int, int]:
        """Along how many lines a view agrees with the stack, and of how many."""
        return self.views.count(view), self.compared.count(view)

    def without(self, view: int) -> Crossings:
        """All but those of one view."""
        kept = [k for k, other in enumerate(self.views) if other != view]
        return Crossings(
            tuple(self.slices[k] for k in kept),
            tuple(self.views[k] for k in kept),
            self.offsets_mm[kept],
            self.precision[kept],
            self.compared,
        )


NO_CROSSINGS = Crossings((), (), np.zeros((0, 3)), np.zeros((0, 3, 3)))


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
    slices, numbers, compared, offsets_mm, precision = [], [], [], [], []
    acquired = np.flatnonzero(~np.isin(view.order, cine.interpolated))
    for place, number in enumerate(acquired.tolist()):
        heart_mm = _heart_mm(drawn[:, number], view.pixel_mm)
        for k, other in enumerate(views):
            line = _line(cine, other, view, number, heart_mm)
            if line is None:
                continue
            compared.append(k)
            found = _compare(cine, other, line, view.order[number])
            if found is not None:
                # Slice and view show one place where they are moved apart by what the axes sum to.
                axes = view.axes @ (line.axes * (1, 1, -1))
                slices.append(place)
                numbers.append(k)
                offsets_mm.append(axes @ found[0])
                precision.append(np.linalg.inv(axes @ found[1] @ axes.T))
    return Crossings(
        tuple(slices),
        tuple(numbers),
        np.reshape(offsets_mm, (-1, 3)),
        np.reshape(precision, (-1, 3, 3)),
        tuple(compared),
    )


@dataclass(frozen=True, slots=True)
class _Line:
    """Where a view's plane cuts a slice, as far as the heart reaches."""

    points_mm: Float
    """``(n, 3)`` LPS, `STEP_MM` apart."""

    axes: Float
    """``(3, 3)`` columns, LPS: along the line, across it in the slice, across it in the view
    towards the base."""


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
    line = along @ view.axes[:2]
    up = np.cross(across, line)
    up *= np.sign(up @ normal)
    axes = np.stack([line, inside @ view.axes[:2], up], axis=1)
    return _Line(corner_mm + flat_mm @ view.axes[:2], axes)


def _compare(cine: Cine, other: Cine, line: _Line, z: int) -> tuple[Float, Float] | None:
    """How far ``(3,)`` slice and view are moved along the line's axes where both agree best.

    With its covariance ``(3, 3)``; None where they agree nowhere clearly.
    """
    chosen = np.unique(np.linspace(0, len(cine.phases) - 1, MOST_PHASES).round().astype(int))
    seen = cine.phases if cine.moments is None else cine.moments[z]
    # Where the view's own beat is as far as the slice's was.
    theirs = _profiles(other, line, to_cycle(seen[chosen], cine.rr_s, other.rr_s))
    ours = _slice_patches(cine, line, z, chosen)
    valid: Mask = np.asarray(np.isfinite(theirs).all(axis=(0, 1)))
    if valid.sum() * STEP_MM < LEAST_LINE_MM or not np.isfinite(ours).all():
        return None
    return _place(_agreement(ours, theirs[..., valid], valid))


def _profiles(other: Cine, line: _Line, phases: Float) -> Float:
    """Grey values of a view along lines beside one another: ``(phase, 2 SEARCH_MM + 1, n)``."""
    reach = SEARCH_MM + BLUR_MM // 2
    offsets_mm = np.arange(-reach, reach + 1)[:, None, None] * line.axes[:, 2]
    images = _at_phases(other, phases)
    points_mm = line.points_mm + offsets_mm
    values = np.stack([_sampled(image, other.mr_from_index, points_mm) for image in images])
    return np.asarray(sliding_window_view(values, BLUR_MM + 1, axis=1).mean(axis=-1))


def _at_phases(other: Cine, phases: Float) -> Float32:
    """Images ``(phase, row, column)`` of a view between its own phases, which are cyclic."""
    low, high, share = around_phases(phases, other.phases)
    share, images = share[:, None, None], other.intensity[:, 0]
    return np.asarray((1 - share) * images[low] + share * images[high])


def _slice_patches(cine: Cine, line: _Line, z: int, chosen: Integer) -> Float:
    """Grey values of a slice about the line: ``(phase, across, along)``, `SEARCH_MM` beyond it."""
    reach = SEARCH_MM + BLUR_MM // 2
    before = line.points_mm[0] - SEARCH_MM * line.axes[:, 0]
    along = np.arange(len(line.points_mm) + 2 * SEARCH_MM)[None, :, None] * line.axes[:, 0]
    across = np.arange(-reach, reach + 1)[:, None, None] * line.axes[:, 1]
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
    """Correlation of both over phases and points for every shift: ``(along, across, up)``."""
    windows: Float = sliding_window_view(ours, len(valid), axis=2)[..., valid]
    model = theirs - theirs.mean(axis=(0, 2), keepdims=True)
    mean = windows.mean(axis=(0, 3))
    power = np.square(windows).mean(axis=(0, 3)) - mean**2
    product = np.einsum("patn,pun->tau", windows, model, optimize=True) / model[:, 0].size
    scale = power.T[..., None] * np.square(model).mean(axis=(0, 2))
    return np.asarray(product / np.sqrt(np.maximum(scale, 1e-12)))


def _place(agreement: Float) -> tuple[Float, Float] | None:
    """Where slice and view agree, (along, across, up), mm, and its covariance.

    The likelihood of correlated normal values falls as ``(1 - r^2)^(n/2)``; its mean and covariance
    over all shifts that were tried tell more truly than the shape of its peak where there are
    several, as about the tip. None where the peak is low, or at the end of what was tried.
    """
    peak = np.unravel_index(agreement.argmax(), agreement.shape)
    if agreement[peak] < LEAST_AGREEMENT or not all(0 < k < 2 * SEARCH_MM for k in peak):
        return None
    misfit = np.log(np.maximum(1 - np.clip(agreement, 0, 1) ** 2, 1e-6))
    chance = np.exp(-INDEPENDENT / 2 * (misfit - misfit.min()))
    chance /= chance.sum()
    tried = STEP_MM * (np.indices(agreement.shape) - SEARCH_MM).reshape(3, -1)
    mean = tried @ chance.ravel()
    away = tried - mean[:, None]
    covariance = (away * chance.ravel()) @ away.T + np.diag(np.square(PLACE_MM))
    return mean, covariance
