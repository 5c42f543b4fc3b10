"""Breath-hold shifts: slices moved in their plane so that the heart's axis runs smoothly again.

Every slice is held in a breath of its own, and the heart lies elsewhere each time, mostly along
head and feet. Tilt and slow curvature of the heart's axis are anatomy and stay; what jumps from
slice to slice is taken for breathing.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float, Label, Mask
from pipeline.imaging.labels import LABELS

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
deviation of half the second difference at slices 10 mm apart. The right ventricle wraps around
the left and the aorta turns, so they tell nothing."""

OUTLIER = 2.0
"""A bend this many deviations large counts half: at the base a slice cuts through part of a wall
and the centre of what is left jumps, shift or no shift."""

ROUNDS = 8
"""Of reweighting; the weights have settled well before."""

LEAST_AREA_MM2 = 150.0
"""A smaller cut through a structure says little of where the slice lies."""


def slice_shifts_mm(labels: Label, pixel_mm: float, slice_step_mm: float, axes: Float) -> Float:
    """In-plane shift of every slice that best explains the jumps of structures' centres.

    The shifts are the most probable ones given normal curvature of the anatomy and normal shifts
    between breath-holds: linear least squares, outliers weighted down (Cauchy's weights).

    Parameters
    ----------
    labels
        ``(phase, slice, row, column)``, apex first.
    axes
        ``(3, 3)`` rows: LPS directions of columns, rows and slices.

    Returns
    -------
    (slice, 2) array
        How far each slice is displaced along columns and rows, mm; to be taken back.
    """
    slices = labels.shape[1]
    differences, bends_mm, deviations_mm = _observations(labels, pixel_mm, slice_step_mm)
    if not len(bends_mm):
        return np.zeros((slices, 2))
    # The breathing ellipsoid seen in the plane is what is known of a shift beforehand.
    covariance = axes[:2] @ np.diag(np.square(BREATH_MM)) @ axes[:2].T
    prior = np.kron(np.eye(slices), np.linalg.inv(covariance))
    shifts_mm = np.zeros((slices, 2))
    for _ in range(ROUNDS):
        left = np.linalg.norm(bends_mm - differences @ shifts_mm, axis=1) / deviations_mm
        weight = 1 / (1 + (left / OUTLIER) ** 2) / deviations_mm**2
        normal = np.kron(differences.T @ (weight[:, None] * differences), np.eye(2)) + prior
        right = differences.T @ (weight[:, None] * bends_mm)
        shifts_mm = np.linalg.solve(normal, right.ravel()).reshape(slices, 2)
    return shifts_mm


def _observations(
    labels: Label, pixel_mm: float, slice_step_mm: float
) -> tuple[Float, Float, Float]:
    """Linear equations for the shifts: matrix (n, slice), bends (n, 2), deviations (n,)."""
    rows, bends_mm, deviations_mm = [], [], []
    for names, deviation_mm in BENDS_MM:
        body = np.isin(labels, [LABELS[name] for name in names])
        found_mm = _bends(_centres_mm(body, pixel_mm))
        for middle in np.flatnonzero(np.isfinite(found_mm[:, 0])):
            row = np.zeros(labels.shape[1])
            row[[middle - 1, middle, middle + 1]] = -0.5, 1.0, -0.5
            rows.append(row)
            bends_mm.append(found_mm[middle])
            # Bends of a smooth axis grow with the square of the step.
            deviations_mm.append(deviation_mm * (slice_step_mm / 10.0) ** 2)
    return np.array(rows), np.array(bends_mm), np.array(deviations_mm)


def _centres_mm(mask: Mask, pixel_mm: float) -> Float:
    """Centre of a structure, ``(phase, slice, 2)`` as (column, row); NaN where it is small."""
    rows, columns = (np.arange(side) * pixel_mm for side in mask.shape[2:])
    over_columns, over_rows = mask.sum(axis=2), mask.sum(axis=3)
    area = over_rows.sum(axis=2).astype(float)
    area[area * pixel_mm**2 < LEAST_AREA_MM2] = np.nan
    return np.stack([over_columns @ columns / area, over_rows @ rows / area], axis=-1)


def _bends(centres_mm: Float) -> Float:
    """Half second differences along the stack, averaged over phases: ``(slice, 2)``, NaN if none.

    A phase counts where the structure is cut by three slices in a row.
    """
    bends = np.full(centres_mm.shape[1:], np.nan)
    inner = centres_mm[:, 1:-1] - (centres_mm[:, :-2] + centres_mm[:, 2:]) / 2
    known = np.isfinite(inner[..., 0])
    total = np.where(known[..., None], inner, 0).sum(axis=0)
    count = known.sum(axis=0)
    often = count >= max(1, centres_mm.shape[0] // 2)
    bends[1:-1][often] = total[often] / count[often, None]
    return bends
