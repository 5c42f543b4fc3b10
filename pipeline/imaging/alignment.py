"""Breath-hold shifts: slices moved so that the heart's axis runs smoothly again.

Every slice is held in a breath of its own, and the heart lies elsewhere each time, mostly along
head and feet. Tilt and slow curvature of the heart's axis are anatomy and stay; what jumps from
slice to slice is taken for breathing. Long-axis views, where there are any, tell both apart. A
breath moves the heart along one way more than along others, so a shift in a slice's plane tells of
the one along its normal as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from pipeline.geometry import Float, Integer, Label, Mask
from pipeline.imaging.labels import LABELS
from pipeline.imaging.long_axis import LEAST_STEP_MM, NO_CROSSINGS, Crossings

BREATH_MM = (0.6, 1.0, 2.2)
"""Standard deviation of a breath-hold's place along x, y, z (LPS): along head and feet above all
(McLeish et al., IEEE Trans. Med. Imaging 21(9):1142-1150, 2002)."""

BENDS_MM: tuple[tuple[tuple[str, ...], float], ...] = (
    (("lv_cavity",), 0.7),
    (("lv_cavity", "lv_myocardium"), 1.0),
    (("right_atrium",), 1.5),
    (("left_atrium",), 3.0),
)
"""Bodies whose centres run nearly straight from slice to slice, and how much they bend: standard
deviation of a centre from the chord of its neighbours at slices 10 mm apart. The right ventricle
wraps around the left and the aorta turns, so they tell nothing."""

OUTLIER = 2.0
"""A bend this many deviations large counts half: at the base a slice cuts through part of a wall
and the centre of what is left jumps, shift or no shift."""

ASTRAY_MM = 8.0
"""A slice moved in its plane by more was held in no usual breath: over three standard deviations
of `BREATH_MM` along head and feet."""

ROUNDS = 8
"""Of reweighting; more change little but where one chord alone tells of a slice."""

FIRST_HOLDS = (1.0, 0.05)
"""Weights of what is known of breath-holds in the first round of two tries: slices held in their
places, and nearly free of them."""

LEAST_AREA_MM2, LEAST_SHARE = 150.0, 0.3
"""A smaller cut through a structure, or one of a smaller share of a neighbouring slice's, says
little of where the slice lies: it is the rim of a valve's opening or the roof of an atrium."""


VIEW_MM = 6.0
"""Standard deviation of a long-axis view's place: a breath-hold, or a patient who has moved."""

LEAST_GAP = 0.5
"""Of the distance between slices: two neighbours that are moved along their normal come no nearer
to one another."""

TRUSTED = 3.0
"""A view is voted out when more than a third of its lines lie farther off what all say, in
deviations."""


def slice_shifts_mm(
    labels: Label,
    pixel_mm: float,
    heights_mm: Float,
    axes: Float,
    crossings: Crossings = NO_CROSSINGS,
) -> Float:
    """Shift of every slice that best explains where structures and views lie.

    The shifts are the most probable ones given normal curvature of the anatomy, normal shifts
    between breath-holds and, where there are long-axis views, how far each slice lies from each
    view: linear least squares, outliers weighted down (Cauchy's weights). So is what is known of
    breath-holds, beyond its usual range and where more than one chord or view tells: one slice far
    aside is brought back to the others, which stay. Every view has a shift of its own.
    Along its normal a slice is moved where a view cuts it; elsewhere the shift is too uncertain to
    tell, and it is left but for what keeps it apart from its neighbours.
    Slices nearer to one another than `LEAST_STEP_MM` are of one volume: none is moved.

    Parameters
    ----------
    labels
        ``(phase, slice, row, column)``, apex first.
    heights_mm
        ``(slice,)`` heights of the slices along their normal, rising.
    axes
        ``(3, 3)`` rows: LPS directions of columns, rows and slices.
    crossings
        How far slices lie from views (`pipeline.imaging.long_axis.find_crossings`). Views that
        the others contradict are left out.

    Returns
    -------
    (slice, 3) array
        How far the heart in each slice is displaced along columns, rows and normal, mm; to be taken
        back.
    """
    if np.diff(heights_mm).min() < LEAST_STEP_MM:
        return np.zeros((len(heights_mm), 3))
    bends = _observations(labels, pixel_mm, heights_mm)
    if not len(bends.offsets_mm) and not crossings.slices:
        return np.zeros((len(heights_mm), 3))
    # The breathing ellipsoid is what is known of a shift beforehand.
    of_a_slice = axes @ np.diag(1 / np.square(BREATH_MM)) @ axes.T
    while True:
        known = _joined(bends, _equations(crossings, len(heights_mm)))
        shifts_mm, left = _solved(known, of_a_slice, len(heights_mm))
        doubted = _doubted_view(crossings, left[len(bends.offsets_mm) :])
        if doubted is None:
            cut = np.isin(np.arange(len(heights_mm)), crossings.slices)
            # A slice far aside gives way to the others.
            _, weights = _usual(shifts_mm, of_a_slice)
            shifts_mm[:, 2] = _in_order(heights_mm, np.where(cut, shifts_mm[:, 2], 0), weights)
            # Products by BLAS differ in their last digits with the number of processors.
            return np.round(shifts_mm, 6)
        crossings = crossings.without(doubted)


def _in_order(heights_mm: Float, normal_mm: Float, weights: Float) -> Float:
    """The shifts ``(slice,)`` nearest to those given that keep `LEAST_GAP` between neighbours."""
    least_mm = np.concatenate([[0], np.cumsum(LEAST_GAP * np.diff(heights_mm))])
    above_mm = isotonic_regression(heights_mm - normal_mm - least_mm, weights=weights).x
    return np.asarray(heights_mm - least_mm - above_mm)


def _usual(shifts_mm: Float, of_a_slice: Float) -> tuple[Float, Float]:
    """Squared deviations of shifts ``(slice, 3)`` from usual breath-holds, and what they count.

    Cauchy's distribution in three directions, and no more than a normal one near its middle.
    """
    squared = np.einsum("si,ij,sj->s", shifts_mm, of_a_slice, shifts_mm)
    return squared, np.minimum(4 / (1 + squared), 1)


@dataclass(frozen=True, slots=True)
class _Equations:
    """Linear equations for the shifts of slices and views."""

    matrix: Float
    """``(n, slice + view)``, the same for all directions."""

    offsets_mm: Float
    """``(n, 3)``."""

    precision: Float
    """``(n, 3, 3)`` inverse covariance, 1/mm2."""


def _joined(bends: _Equations, seen: _Equations) -> _Equations:
    wide = np.zeros((len(bends.matrix), seen.matrix.shape[1]))
    wide[:, : bends.matrix.shape[1]] = bends.matrix
    return _Equations(
        np.concatenate([wide, seen.matrix]),
        np.concatenate([bends.offsets_mm, seen.offsets_mm]),
        np.concatenate([bends.precision, seen.precision]),
    )


def _equations(crossings: Crossings, slices: int) -> _Equations:
    count = max(crossings.views, default=-1) + 1
    matrix = np.zeros((len(crossings.slices), slices + count))
    for row, number, view in zip(matrix, crossings.slices, crossings.views, strict=True):
        row[number], row[slices + view] = 1, -1
    return _Equations(matrix, crossings.offsets_mm, crossings.precision)


def _solved(known: _Equations, of_a_slice: Float, slices: int) -> tuple[Float, Float]:
    """Shifts ``(slice, 3)``, and how many deviations each equation is off, ``(n,)``.

    Of what two starts come to, slices held in their places and free of them, the more probable.
    """
    settled = [_settled(known, of_a_slice, slices, first) for first in FIRST_HOLDS]
    _, shifts_mm, left = min(settled, key=lambda one: one[0])
    return shifts_mm, left


def _settled(
    known: _Equations, of_a_slice: Float, slices: int, first: float
) -> tuple[float, Float, Float]:
    """How improbable, shifts and deviations that reweighting from one start comes to."""
    count = known.matrix.shape[1]
    prior = np.kron(np.eye(count), np.eye(3) / VIEW_MM**2)
    shifts_mm, left = np.zeros((count, 3)), np.zeros(len(known.matrix))
    usual = np.zeros(slices)
    # One chord alone may be bent by any of its three slices.
    told = _chords_of_each(known, slices) > 1
    held = np.where(told, first, 1.0)
    for _ in range(ROUNDS):
        prior[: 3 * slices, : 3 * slices] = np.kron(np.diag(held), of_a_slice)
        weight = known.precision / (1 + (left / OUTLIER) ** 2)[:, None, None]
        normal = np.einsum("na,nij,nb->aibj", known.matrix, weight, known.matrix, optimize=True)
        right = np.einsum("na,nij,nj->ai", known.matrix, weight, known.offsets_mm)
        both = normal.reshape(3 * count, 3 * count) + prior
        shifts_mm = np.linalg.solve(both, right.ravel()).reshape(count, 3)
        left_mm = known.offsets_mm - known.matrix @ shifts_mm
        left = np.sqrt(np.einsum("ni,nij,nj->n", left_mm, known.precision, left_mm))
        usual, counts = _usual(shifts_mm[:slices], of_a_slice)
        held = np.where(told, counts, 1.0)
    # Minus the logarithms whose slopes are the weights above.
    of_slices = np.where(~told | (usual < 3), usual / 2, 1.5 + 2 * np.log((1 + usual) / 4))
    of_views = np.square(shifts_mm[slices:] / VIEW_MM) / 2
    of_known = OUTLIER**2 / 2 * np.log1p((left / OUTLIER) ** 2)
    cost = float(of_slices.sum() + of_views.sum() + of_known.sum())
    return cost, shifts_mm[:slices], left


def _chords_of_each(known: _Equations, slices: int) -> Integer:
    """How many chords and views ``(slice,)`` tell of each slice."""
    chords = np.unique(known.matrix, axis=0)[:, :slices]
    return np.asarray(np.count_nonzero(chords, axis=0))


def _doubted_view(crossings: Crossings, left: Float) -> int | None:
    """The view that lies farthest off what all say, if it is too far off to be one of them."""
    of = np.array(crossings.views, int)
    off = {int(view): float(np.quantile(left[of == view], 2 / 3)) for view in np.unique(of)}
    worst = max(off, key=lambda view: off[view], default=None)
    return worst if worst is not None and off[worst] > TRUSTED else None


def _observations(labels: Label, pixel_mm: float, heights_mm: Float) -> _Equations:
    """What the centres of structures say of the shifts of slices."""
    rows, bends_mm, deviations_mm = [], [], []
    steps_mm = np.diff(heights_mm)
    for names, deviation_mm in BENDS_MM:
        body = np.isin(labels, [LABELS[name] for name in names])
        found_mm = _bends(_centres_mm(body, pixel_mm), heights_mm)
        for middle in np.flatnonzero(np.isfinite(found_mm[:, 0])):
            before_mm, after_mm = steps_mm[middle - 1], steps_mm[middle]
            share = before_mm / (before_mm + after_mm)
            row = np.zeros(labels.shape[1])
            row[[middle - 1, middle, middle + 1]] = share - 1, 1.0, -share
            rows.append(row)
            bends_mm.append(found_mm[middle])
            # A smooth axis leaves the chord by half its curvature times both parts of the chord.
            deviations_mm.append(deviation_mm * before_mm * after_mm / 10.0**2)
    in_plane = np.pad(np.array(bends_mm).reshape(-1, 2), ((0, 0), (0, 1)))
    precision = np.array([np.diag([1.0, 1.0, 0.0]) / deviation**2 for deviation in deviations_mm])
    return _Equations(
        np.array(rows).reshape(-1, labels.shape[1]), in_plane, precision.reshape(-1, 3, 3)
    )


def _centres_mm(mask: Mask, pixel_mm: float) -> Float:
    """Centre of a structure, ``(phase, slice, 2)`` as (column, row); NaN where it is small."""
    rows, columns = (np.arange(side) * pixel_mm for side in mask.shape[2:])
    over_columns, over_rows = mask.sum(axis=2), mask.sum(axis=3)
    area = over_rows.sum(axis=2).astype(float)
    beside = np.pad(area, ((0, 0), (1, 1)))
    most = np.maximum(beside[:, :-2], beside[:, 2:])
    area[(area * pixel_mm**2 < LEAST_AREA_MM2) | (area < LEAST_SHARE * most)] = np.nan
    return np.stack([over_columns @ columns / area, over_rows @ rows / area], axis=-1)


def _bends(centres_mm: Float, heights_mm: Float) -> Float:
    """How far centres lie from the chord of their neighbours, averaged over phases: ``(slice, 2)``.

    NaN where there is none; a phase counts where the structure is cut by three slices in a row.
    """
    bends = np.full(centres_mm.shape[1:], np.nan)
    share = ((heights_mm[1:-1] - heights_mm[:-2]) / (heights_mm[2:] - heights_mm[:-2]))[:, None]
    chord_mm = (1 - share) * centres_mm[:, :-2] + share * centres_mm[:, 2:]
    inner = centres_mm[:, 1:-1] - chord_mm
    known = np.isfinite(inner[..., 0])
    total = np.where(known[..., None], inner, 0).sum(axis=0)
    count = known.sum(axis=0)
    often = count >= max(1, centres_mm.shape[0] // 2)
    bends[1:-1][often] = total[often] / count[often, None]
    return bends
