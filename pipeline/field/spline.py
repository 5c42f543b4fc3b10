"""The quadratic B-spline through the baked distances: its coefficients, and its weights in time.

Between the nodes a field is a tensor product of quadratic B-splines along x, y, z and the phase,
the smallest interpolation whose gradient and rate have no step anywhere: three nodes an axis
(Unser, IEEE Signal Process. Mag. 16(6):22-38, 1999). Its coefficients are solved for once, at
baking, such that the spline takes the exact distance at every node and stored phase; about the
surface they are moved once more (`pipeline.field.surface_fit`).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float, Grid


def space_coefficients(values: Float) -> Float:
    """Coefficients of the spline through ``(z, y, x)`` node values, of the same shape.

    Along each axis ``(c[i-1] + 6 c[i] + c[i+1]) / 8`` is the value at node i. Beyond both ends
    the coefficients go on in a straight line, which makes the first and the last coefficient
    the value itself.
    """
    coefficients = np.array(values, dtype=np.float64)
    _solve(coefficients)
    _solve(coefficients.swapaxes(0, 1))
    # Whole planes are solved for at once, and whole lines of memory at that.
    turned = np.ascontiguousarray(coefficients.transpose(2, 0, 1))
    _solve(turned)
    return np.ascontiguousarray(turned.transpose(1, 2, 0))


def _solve(values: Float) -> None:
    """Turn values into coefficients along the first axis, in place.

    Gauss elimination of three diagonals (Golub, Van Loan, Matrix Computations, section 4.3); each
    row is dominated by its diagonal, so none need change places.
    """
    last = len(values) - 1
    diagonal = np.full(last + 1, 0.75)
    diagonal[[0, last]] = 1.0
    part = np.empty_like(values[0])
    # Above and below the first and the last there is nothing.
    for row in range(1, last):
        above = 0.125 if row > 1 else 0.0
        share = 0.125 / diagonal[row - 1]
        diagonal[row] -= share * above
        values[row] -= np.multiply(values[row - 1], share, out=part)
    for row in range(last - 1, 0, -1):
        values[row] -= np.multiply(values[row + 1], 0.125, out=part)
        values[row] /= diagonal[row]


def node_values(coefficients: Float) -> Float:
    """Values at the nodes of the spline with these ``(z, y, x)`` coefficients."""
    values = np.array(coefficients, dtype=np.float64)
    for axis in range(3):
        lines = np.moveaxis(values, axis, 0)
        between = (lines[:-2] + 6 * lines[1:-1] + lines[2:]) / 8
        values = np.moveaxis(np.concatenate([lines[:1], between, lines[-1:]]), 0, axis)
    return values


def grid_numbers(grid: Grid) -> Float:
    """Origin, spacing, node counts and nodes a millimetre, each ``x, y, z``, for the kernels."""
    spacing_mm = np.array(grid.spacing_mm)
    return np.array([*grid.origin_mm, *spacing_mm, *grid.shape[::-1], *(1 / spacing_mm)])


def timeline(phases: Float) -> Float:
    """Where in the cycle which weights hold: ``(phase, 4)``.

    Interval k reaches from the middle between stored phases k - 1 and k to that between k and
    k + 1. At a phase p inside, ``w[k-1] = (end - p)^2 * early``, ``w[k+1] = (p - start)^2 * late``
    and ``w[k]`` is what is missing to 1; the first phase follows the last.

    Parameters
    ----------
    phases
        ``(phase,)`` in [0, 1), rising; steps may differ.

    Returns
    -------
    Columns ``start``, ``end``, ``early``, ``late``. The first interval may begin below 0; the
    intervals together are one cycle long.
    """
    count = len(phases)
    around = np.concatenate([phases[[-1]] - 1, phases, phases[[0]] + 1])
    start = (around[:-1] + around[1:])[:count] / 2
    knots = np.concatenate([start[[-1]] - 1, start, start[[0]] + 1, start[[1 % count]] + 1])
    if count == 1:
        knots = start[0] + np.arange(-1.0, 3.0)
    before, begin, end, after = knots[:-3], knots[1:-2], knots[2:-1], knots[3:]
    early = 1 / ((end - begin) * (end - before))
    late = 1 / ((end - begin) * (after - begin))
    return np.stack([begin, end, early, late], axis=1)


def phase_weights(line: Float, phase: float) -> tuple[int, tuple[float, float, float]]:
    """Number of the interval that a phase lies in, and the weights of k - 1, k and k + 1.

    >>> phase_weights(timeline(np.arange(4) / 4), 0.25)
    (1, (0.125, 0.75, 0.125))
    """
    first = line[0, 0]
    turned = phase - np.floor(phase - first)
    if turned >= first + 1:
        turned -= 1
    elif turned < first:
        turned += 1
    k = max(int(np.searchsorted(line[:, 0], turned, side="right")) - 1, 0)
    start, end, early, late = line[k]
    before = float((end - turned) ** 2 * early)
    after = float((turned - start) ** 2 * late)
    return k, (before, 1 - before - after, after)


def time_solver(phases: Float) -> Float:
    """``(phase, phase)`` matrix that turns values at the stored phases into coefficients."""
    count = len(phases)
    line = timeline(phases)
    values_of = np.zeros((count, count))
    for row, phase in enumerate(phases):
        k, weights = phase_weights(line, float(phase))
        for step, weight in zip((-1, 0, 1), weights, strict=True):
            values_of[row, (k + step) % count] += weight
    return np.asarray(np.linalg.inv(values_of), dtype=np.float64)
