"""How well frames and model agree at a pose: the share of grey values that anatomy explains.

The smoothed grey values of every frame, as ranks, are fitted by ``a + b * blood + c * wall``, by
blood carried on where the images end inside a chamber (`open_ends`), no brighter than the rest
either, and by a trend across the sector, so that no gain, no compression and no scanner needs to be
known; what the fit explains beyond the trend is the frame's correlation ratio. The trend takes in
all that changes over centimetres: fading behind tissue, shadow, haze, and how bright what lies
around the heart is. Left in, it draws the pose towards where it is strong. After W. Wein et al.,
"Automatic CT-ultrasound registration for diagnostic imaging and image-guided intervention", Med
Image Anal 12 (2008) 577-585, with surfaces in the place of CT numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from pipeline.field.threads import shared
from pipeline.geometry import Float, Integer, Mask
from pipeline.registration.frames import Samples
from pipeline.registration.kernels import PARTS, PUSHES, SUMS, add_up, bend
from pipeline.registration.tissue_map import TissueMap

# Grey values of variance 1 explained by less than this say nothing: it keeps the fit solvable
# where a frame misses the heart.
_RIDGE = 1e-3
# Fewer samples are added up before another thread would have started.
_THREADS, _SAMPLES_A_THREAD = 2, 16_384


@dataclass(frozen=True, slots=True)
class Agreement:
    """How each frame agrees with the model at one pose."""

    explained: Float
    """``(frames,)`` share of the variance of grey values that anatomy explains, 0 to 1."""

    in_view: Float
    """``(frames,)`` share of the samples in blood or at its walls, about 0 to 1."""

    @property
    def score(self) -> float:
        """Mean over the frames of -log(1 - explained): the mutual information of normal values,
        in units of half a nat a sample."""
        return float(-np.log1p(-self.explained).mean())


@dataclass(frozen=True, slots=True)
class Expansion:
    """How the frames' losses, log(1 - explained), change with a small motion of the tracker."""

    losses: Float
    """``(frames,)`` at the pose itself."""

    slopes: Float
    """``(frames, 6)`` a millimetre: shift along x, y, z of the MR frame, then turns about them by
    so much that a point at the lever's length from the centre moves by a millimetre."""

    bending: Float
    """``(6, 6)`` a square millimetre: curvature of the sum of the losses by Gauss and Newton, with
    the fitted coefficients and trend free at every pose (L. Kaufman, "A variable projection method
    for solving separable nonlinear least squares problems", BIT 15 (1975) 49-57)."""


def agreement(
    samples: Samples, tissue: TissueMap, mr_from_tracker: Float, shift_mm: Float | None = None
) -> Agreement:
    """Compare all frames with the model at one pose.

    Parameters
    ----------
    mr_from_tracker
        4x4.
    shift_mm
        ``(frames, 3)`` LPS: how much further each frame lies in the model; nothing if None.
    """
    fit = _fitted(samples, tissue, _Place.of(samples, tissue, mr_from_tracker, shift_mm))
    return Agreement(fit.explained, fit.sums[:, :2, -1].sum(axis=1) / np.diff(samples.first))


def expansion(
    samples: Samples,
    tissue: TissueMap,
    mr_from_tracker: Float,
    centre_mm: Float,
    lever_mm: float,
    shift_mm: Float | None = None,
) -> Expansion:
    """The losses of all frames at a pose, and how they change about it.

    Parameters
    ----------
    mr_from_tracker, shift_mm
        As for `agreement`.
    centre_mm
        ``(3,)`` LPS: what is turned about.
    lever_mm
        See `Expansion.slopes`.
    """
    place = _Place.of(samples, tissue, mr_from_tracker, shift_mm)
    fit = _fitted(samples, tissue, place)
    frames = samples.frames
    coefficients, spacing_mm = fit.coefficients.astype(np.float32), np.array(tissue.grid.spacing_mm)
    centre = (np.asarray(centre_mm) - tissue.grid.origin_mm) / spacing_mm
    pushes = np.zeros((frames, 6, PUSHES))
    with_trend = np.zeros((frames, 6, samples.trend.shape[1]))

    def add(some: slice) -> None:
        arms = coefficients[some], spacing_mm, centre, 1 / lever_mm
        sums = pushes[some], with_trend[some]
        bend(*_looked_at(samples, tissue, place, some), *arms, *sums)

    _in_parts(add, samples)
    return _expanded(fit, np.diff(samples.first), pushes, with_trend)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the frames lie in the model's grid, in space and time."""

    lower: Integer
    """``(frames,)`` the stored phase at or before each."""

    weight: Float
    """``(frames,)`` of the phase after it."""

    index_from_tracker: Float
    """4x4."""

    shift: Float
    """``(frames, 3)`` nodes."""

    @classmethod
    def of(
        cls, samples: Samples, tissue: TissueMap, mr_from_tracker: Float, shift_mm: Float | None
    ) -> Self:
        """At a pose, moved on by ``shift_mm`` unless None."""
        spacing_mm = np.array(tissue.grid.spacing_mm)
        index_from_mr = np.diag([*(1 / spacing_mm), 1.0])
        index_from_mr[:3, 3] = -np.array(tissue.grid.origin_mm) / spacing_mm
        shift = np.zeros((samples.frames, 3)) if shift_mm is None else shift_mm / spacing_mm
        lower, weight = _neighbours(samples.phases, tissue.phases)
        return cls(lower, weight, index_from_mr @ mr_from_tracker, shift)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Every frame's grey values fitted by the model's parts."""

    explained: Float
    """``(frames,)``."""

    coefficients: Float
    """``(frames, parts)``."""

    normal: Float
    """``(frames, parts, parts)`` of the equations that gave them; of what is not fitted, 1 on the
    diagonal alone."""

    fitted: Mask
    """``(frames, parts)``: which are fitted."""

    sums: Float
    """``(frames, parts, SUMS)``."""

    with_trend: Float
    """``(frames, parts, columns)``."""


def _looked_at(samples: Samples, tissue: TissueMap, place: _Place, some: slice) -> tuple[Any, ...]:
    """What both kernels need of some of the frames and the model, in their order."""
    return (
        samples.points_mm,
        samples.grey,
        samples.trend,
        samples.trend_row[some],
        samples.first[some.start : some.stop + 1],
        place.lower[some],
        place.weight[some],
        tissue.share,
        place.index_from_tracker,
        place.shift[some],
    )


def _in_parts(add: Callable[[slice], None], samples: Samples) -> None:
    """Add up all frames, each by one thread, several at the same time where they are many."""
    most = int(samples.first[-1]) // _SAMPLES_A_THREAD
    shared(add, samples.frames, min(_THREADS, samples.frames, most))


def _fitted(samples: Samples, tissue: TissueMap, place: _Place) -> _Fit:
    sums = np.zeros((samples.frames, PARTS, SUMS))
    with_trend = np.zeros((samples.frames, PARTS, samples.trend.shape[1]))

    def add(some: slice) -> None:
        add_up(*_looked_at(samples, tissue, place, some), sums[some], with_trend[some])

    _in_parts(add, samples)
    return _explained(sums, with_trend, np.diff(samples.first))


def _neighbours(phases: Float, stored: Float) -> tuple[Integer, Float]:
    """The stored phase at or before each phase, and the weight of the one after; cyclic."""
    lower = np.searchsorted(stored, phases, side="right") - 1
    start = stored[lower]
    length = (np.roll(stored, -1) - stored)[lower] % 1.0
    # With one stored phase the way round the cycle has length 0: the heart stands still.
    weight = np.where(length > 0, (phases - start) % 1.0 / np.where(length > 0, length, 1.0), 0.0)
    return (lower % len(stored)).astype(np.int64), weight


def _explained(sums: Float, with_trend: Float, counts: Integer) -> _Fit:
    """Variance explained by the model's parts beyond the trend, blood darker than the rest."""
    grey = sums[..., 0]
    normal = sums[..., 1:-1] - np.einsum("fct,fdt->fcd", with_trend, with_trend)
    normal[:, range(PARTS), range(PARTS)] += _RIDGE * counts[:, None]
    fitted, every = np.ones(grey.shape, dtype=bool), normal
    # Two parts may be left out, one after the other; the last solution leaves out none.
    for _ in range(PARTS):
        normal = np.where(fitted[:, :, None] & fitted[:, None], every, np.eye(PARTS))
        coefficients = np.linalg.solve(normal, np.where(fitted, grey, 0)[..., None])[..., 0]
        # A fit that makes blood bright is one by chance: then only the walls count.
        fitted[coefficients[:, 0] > 0] = [False, True, False]
        fitted[:, 2] &= coefficients[:, 2] < 0
    explained = np.clip((coefficients * grey).sum(axis=1) / counts, 0, 0.999)
    return _Fit(explained, coefficients, normal, fitted, sums, with_trend)


def _expanded(fit: _Fit, counts: Integer, pushes: Float, with_trend: Float) -> Expansion:
    """Slopes and curvature from what `bend` has added up."""
    grey, parts, squares = pushes[..., 0], pushes[..., 1 : 1 + PARTS], pushes[..., 1 + PARTS :]
    # What the parts change where the trend is taken out of them.
    beyond = parts.swapaxes(1, 2) - np.einsum("fit,fct->fci", with_trend, fit.with_trend)
    rest = grey - np.einsum("fc,fci->fi", fit.coefficients, beyond)
    bent = squares - np.einsum("fit,fjt->fij", with_trend, with_trend)
    beyond = np.where(fit.fitted[..., None], beyond, 0)
    bent -= np.einsum("fci,fcj->fij", beyond, np.linalg.solve(fit.normal, beyond))
    worth = 2 / (counts * (1 - fit.explained))
    slopes = -worth[:, None] * rest
    return Expansion(np.log1p(-fit.explained), slopes, np.einsum("f,fij->ij", worth, bent))
