"""How sure a rigid registration is: covariance of its six parameters, and what it does to a point.

The pose minimises a sum of losses, one a frame. Where a model is only nearly right, the covariance
of such an estimate is the sandwich ``A^-1 B A^-1``: A is the curvature of the sum, B the covariance
of its slope (P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard
conditions", Proc Fifth Berkeley Symp 1 (1967) 221-233). Neighbouring frames share speckle and
anatomy, so their slopes are correlated: B counts neighbours with weights that fall linearly with
the distance between them (W. K. Newey and K. D. West, "A simple, positive semi-definite,
heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55 (1987)
703-708). What all frames share, an error of the surfaces or of the probe's calibration, no spread
between frames can show: it is added as a floor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Integer
from pipeline.registration.pose_search import Pivot

FrameLosses = Callable[[Float], Float]
"""``(frames,)`` losses, in nats or the like, after a step of six millimetres from the pose."""

# Wide enough to look past the kinks that linear interpolation leaves at every node.
STEP_MM = 1.0
REACH = 0.25
"""Up to which share of a sweep's frames neighbours count as correlated."""
# Errors that are drawn to count how many stay small.
_DRAWS = 4000
# A loss flatter than this, of all frames together, per square millimetre leaves its direction
# open: the standard deviation is then many centimetres.
_FLATTEST = 1e-4


@dataclass(frozen=True, slots=True)
class Curvature:
    """Slopes and bending of the frames' losses at a pose, per millimetre of `Pivot.move`."""

    slopes: Float
    """``(frames, 6)``: of each frame's loss."""

    bending: Float
    """``(6, 6)``: second derivatives of the sum over the frames."""


def curvature_at(losses: FrameLosses) -> Curvature:
    """Derivatives by central differences at step zero."""
    slopes, bending = frame_curvatures(losses)
    return Curvature(slopes, bending.sum(axis=0))


def slopes_at(losses: FrameLosses) -> Float:
    """``(frames, 6)`` slopes of each frame's loss by central differences at step zero."""
    ahead, behind = _either_side(losses)
    return (ahead - behind) / (2 * STEP_MM)


def frame_curvatures(losses: FrameLosses) -> tuple[Float, Float]:
    """``(frames, 6)`` slopes and ``(frames, 6, 6)`` bending of each frame's loss, alike."""
    ahead, behind = _either_side(losses)
    here = losses(np.zeros(6))
    bending = np.zeros((len(here), 6, 6))
    steps = STEP_MM * np.eye(6)
    for i in range(6):
        bending[:, i, i] = ahead[:, i] + behind[:, i] - 2 * here
        for j in range(i):
            same = losses(steps[i] + steps[j]) + losses(-steps[i] - steps[j])
            cross = losses(steps[i] - steps[j]) + losses(steps[j] - steps[i])
            bending[:, i, j] = bending[:, j, i] = (same - cross) / 4
    return (ahead - behind) / (2 * STEP_MM), bending / STEP_MM**2


def _either_side(losses: FrameLosses) -> tuple[Float, Float]:
    """``(frames, 6)`` losses a step ahead along each direction, and behind."""
    steps = STEP_MM * np.eye(6)
    ahead = np.stack([losses(step) for step in steps], axis=1)
    return ahead, np.stack([losses(-step) for step in steps], axis=1)


def sandwich(curvature: Curvature, sweep: Integer, reach: float = REACH) -> Float:
    """``(6, 6)`` covariance of the estimate, square millimetres of `Pivot.move`.

    Parameters
    ----------
    curvature
        At the estimate.
    sweep
        ``(frames,)`` number of the sweep that each frame, in order of time, belongs to: frames of
        different sweeps are independent.
    reach
        Up to which share of a sweep's frames neighbours count as correlated.
    """
    frames = len(sweep)
    slopes = curvature.slopes - curvature.slopes.mean(axis=0)
    spread = long_run(slopes, sweep, reach)
    # Six parameters were fitted to these slopes: they are smaller than true errors would be.
    spread *= frames / max(frames - 6, 1)
    inverse = _inverse(curvature.bending)
    covariance = inverse @ spread @ inverse
    return np.asarray((covariance + covariance.T) / 2)


def long_run(slopes: Float, sweep: Integer, reach: float) -> Float:
    """``(k, k)`` covariance of the sum of the frames' slopes ``(frames, k)`` of mean 0, neighbours
    of one sweep being correlated (Bartlett's weights); ``sweep`` and ``reach`` as in `sandwich`."""
    total = np.zeros((slopes.shape[1],) * 2)
    for number in np.unique(sweep):
        own = slopes[sweep == number]
        spread = own.T @ own
        lags = min(len(own) - 1, max(1, round(reach * len(own))))
        for lag in range(1, lags + 1):
            shared = own[lag:].T @ own[:-lag]
            spread += (1 - lag / (lags + 1)) * (shared + shared.T)
        total += spread
    return total


def rising(bending: Float) -> Float:
    """The symmetric part of a matrix without what bends downwards."""
    values, vectors = np.linalg.eigh((bending + bending.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)


def _inverse(bending: Float) -> Float:
    """Inverse of the curvature; a direction in which the loss does not rise stays open."""
    values, vectors = np.linalg.eigh((bending + bending.T) / 2)
    return np.asarray((vectors / np.maximum(values, _FLATTEST)) @ vectors.T)


def in_radians(covariance_mm2: Float, pivot: Pivot) -> Float:
    """Covariance of steps of `Pivot.move` as covariance of shift (mm) and rotation (rad)."""
    scale = np.repeat([1.0, 1 / pivot.lever_mm], 3)
    return np.asarray(covariance_mm2 * np.outer(scale, scale))


def floor_of(error_mm: float, bending: Float, pivot: Pivot) -> Float:
    """Covariance, mm and rad, of an error that all frames share, such as that of the surfaces.

    Borders that lie ``error_mm`` off draw the pose the further, the less the frames hold it in a
    direction: a direction of mean curvature by as much, one of a quarter of it by twice as much.
    """
    relative = bending / (np.trace(bending) / len(bending))
    return in_radians(error_mm**2 * _inverse(relative), pivot)


def expected_tre_mm(covariance: Float, centre_mm: Float, points_mm: Float) -> Float:
    """Root mean square target registration error that a covariance lets expect at points.

    The covariance is carried to each point by the rigid motion's own derivative, as A. Danilchenko
    and J. M. Fitzpatrick do for point registration ("General approach to first-order error
    prediction in rigid point registration", IEEE Trans Med Imaging 30 (2011) 679-693).

    Parameters
    ----------
    covariance
        ``(6, 6)`` of shift (mm) and rotation vector (rad) about ``centre_mm``, in the MR frame.
    centre_mm
        ``(3,)`` LPS.
    points_mm
        ``(n, 3)`` LPS.

    Returns
    -------
    ``(n,)`` mm.
    """
    arm = np.asarray(points_mm, float) - centre_mm
    jacobian = np.zeros((len(arm), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    # d(omega x arm) / d omega is minus the cross-product matrix of the arm.
    jacobian[:, 0, 4], jacobian[:, 0, 5] = arm[:, 2], -arm[:, 1]
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -arm[:, 2], arm[:, 0]
    jacobian[:, 2, 3], jacobian[:, 2, 4] = arm[:, 1], -arm[:, 0]
    variance = np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian)
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def chance_below(covariance: Float, centre_mm: Float, points_mm: Float, limit_mm: float) -> float:
    """Probability that the mean error over ``(n, 3)`` points stays below a limit.

    Counted over fixed draws of a normal error with this covariance (as in `expected_tre_mm`): its
    own standard deviation is 0.008 at most.
    """
    draws = np.random.default_rng(0).standard_normal((_DRAWS, 6))
    values, vectors = np.linalg.eigh(covariance)
    error = draws @ (vectors * np.sqrt(np.maximum(values, 0))).T
    arm = np.asarray(points_mm, float) - centre_mm
    # Point by point: all draws at all points at once would take a gigabyte.
    total = np.zeros(_DRAWS)
    for one in arm:
        total += np.linalg.norm(error[:, :3] + np.cross(error[:, 3:], one), axis=1)
    return float((total < limit_mm * len(arm)).mean())
