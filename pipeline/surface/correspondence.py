"""One template carried through the beat, so that vertex i stays the same material point.

A shape does not tell how its points slide within its surface. What is assumed is that they slide
as little as a smooth motion allows: from phase to phase first the least affine motion, then the
smoothest displacement, that bring the surface onto the next one. The template goes through the
cycle in both directions and the two are blended, so that the end of the beat meets its start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from pipeline.errors import StageError
from pipeline.geometry import Float, Integer, Surface
from pipeline.surface.level_set import LevelSet
from pipeline.surface.mesh import laplacian, untangled, vertex_areas, vertex_normals

AFFINE_STEPS = 6
# A strain costs more than a turn: a heart that a turn explains is not sheared.
RIGID_RIDGE, STRAIN_RIDGE = 1e-3, 1e-2
# Lengths of smoothing in edges, coarse to fine.
REACH_EDGES = (8.0, 3.0, 1.0)
SMOOTHER_ERROR = 0.01
ELASTIC_STEPS = 2
FINISHING_STEPS = 2

Smoother = Callable[[Float], Float]


@dataclass(frozen=True, slots=True)
class Carrier:
    """Moves one mesh from surface to surface; its smoothers are made once."""

    triangles: Integer
    """``(m, 3)`` vertex numbers."""

    smoothers: tuple[Smoother, ...]
    """Low passes on ``(n, 3)`` displacements, coarse to fine."""

    def onto(self, level: LevelSet, vertices_mm: Float) -> Float:
        """Bring ``(n, 3)`` vertices onto a zero level by a smooth displacement, mm."""
        weights = vertex_areas(vertices_mm, self.triangles)
        start = affine_step(level, vertices_mm, weights / weights.sum())
        bound_mm = 4 * level.spacing_mm
        shift = np.zeros_like(start)
        for smooth in self.smoothers:
            for _ in range(ELASTIC_STEPS):
                shift = smooth(shift + level.newton_step(start + shift, bound_mm))
        return self.settle(level, start + shift)

    def settle(self, level: LevelSet, vertices_mm: Float) -> Float:
        """Remove what distance is left with small, still smooth steps along the normals."""
        finest = self.smoothers[-1]
        for _ in range(FINISHING_STEPS):
            vertices_mm = vertices_mm + finest(level.newton_step(vertices_mm, level.spacing_mm))
        return vertices_mm + 0.5 * level.newton_step(vertices_mm, level.spacing_mm)


def make_carrier(template: Surface) -> Carrier:
    """Smoothers of a template, (1 + reach^2 L) u = v with L its Laplacian, reach in edges."""
    stiffness = laplacian(template.triangles, len(template.vertices_mm))
    return Carrier(
        template.triangles, tuple(make_smoother(stiffness, reach) for reach in REACH_EDGES)
    )


def make_smoother(stiffness: sparse.csr_array, reach_edges: float) -> Smoother:
    """Solve (1 + reach^2 L) u = v by Chebyshev's iteration to 1 % of the roughest part.

    The spectrum lies in [1, 1 + reach^2 top], top being twice the largest diagonal of L
    (Gershgorin). The number of rounds is fixed beforehand, so u is linear in v. Saad, Iterative
    Methods for Sparse Linear Systems (2003), algorithm 12.1.
    """
    top = 1 + reach_edges**2 * 2 * float(stiffness.diagonal().max())
    centre, radius = (top + 1) / 2, (top - 1) / 2
    shrink = (np.sqrt(top) - 1) / (np.sqrt(top) + 1)
    rounds = int(np.ceil(np.log(SMOOTHER_ERROR / 2) / np.log(shrink)))
    matrix = sparse.csr_array(sparse.eye_array(stiffness.shape[0]) + reach_edges**2 * stiffness)

    def smooth(values: Float) -> Float:
        found = np.zeros_like(values)
        rest, step, ratio = values, values / centre, radius / centre
        for _ in range(rounds):
            found = found + step
            rest = rest - matrix @ step
            following = 1 / (2 * centre / radius - ratio)
            step = following * ratio * step + (2 * following / radius) * rest
            ratio = following
        return found

    return smooth


def affine_step(level: LevelSet, vertices_mm: Float, weights: Float) -> Float:
    """Vertices after the least affine motion that brings them onto the zero level, in the mean.

    Gauss-Newton on sum w (d + g . u)^2 + ridge |theta|^2, where u is affine in the position and
    theta is scaled to be the displacement in mm at the size of the body. The ridge leaves out the
    motions that the shape does not show, such as the spin of a ball.
    """
    centre = weights @ vertices_mm
    size_mm = np.sqrt(weights @ np.square(vertices_mm - centre).sum(axis=1))
    basis = np.column_stack([np.ones(len(vertices_mm)), (vertices_mm - centre) / size_mm])
    theta = np.zeros(12)
    ridge = _affine_ridge()
    for _ in range(AFFINE_STEPS):
        moved = vertices_mm + basis @ theta.reshape(4, 3)
        distance, gradient = level.sample(moved)
        distance = np.clip(distance, -8 * level.spacing_mm, 8 * level.spacing_mm)
        rows = (basis[:, :, None] * gradient[:, None, :]).reshape(-1, 12)
        normal = rows.T @ (weights[:, None] * rows) + ridge
        theta -= np.linalg.solve(normal, rows.T @ (weights * distance) + ridge @ theta)
    return np.asarray(vertices_mm + basis @ theta.reshape(4, 3))


def _affine_ridge() -> Float:
    """Penalty ``(12, 12)`` on shift, spin and strain; theta is a shift and a 3x3 gradient."""
    swap = np.eye(9).reshape(3, 3, 9).transpose(1, 0, 2).reshape(9, 9)
    spin, strain = (np.eye(9) - swap) / 2, (np.eye(9) + swap) / 2
    ridge = RIGID_RIDGE * np.eye(12)
    ridge[3:, 3:] = RIGID_RIDGE * spin + STRAIN_RIDGE * strain
    return ridge


def carry_through_cycle(
    template: Surface, levels: Sequence[LevelSet], reference: int, phases: Float
) -> Float:
    """Positions ``(phase, n, 3)`` in mm of a template's vertices on the surface of each phase.

    Parameters
    ----------
    template
        Surface on the zero level of ``levels[reference]``.
    levels
        One signed distance a phase, in order; the first follows the last.
    reference
        Number of the phase the template belongs to.
    phases
        ``(phase,)`` in [0, 1), rising.

    Raises
    ------
    StageError
        When half the vertices end more than a voxel from the surface of some phase.
    """
    count = len(levels)
    carrier = make_carrier(template)
    order = [(reference + k) % count for k in range(count)]
    forward = _chain(carrier, template.vertices_mm, [levels[k] for k in order])
    backward = _chain(carrier, template.vertices_mm, [levels[order[-k]] for k in range(count)])
    path = np.empty((count, *template.vertices_mm.shape))
    path[reference] = template.vertices_mm
    for k, phase in enumerate(order[1:], start=1):
        late = (phases[phase] - phases[reference]) % 1.0
        blended = (1 - late) * forward[k] + late * backward[-k]
        settled = carrier.settle(levels[phase], blended)
        path[phase] = untangled(settled, template.triangles, levels[phase])
        _require_arrival(path[phase], levels[phase], phase, phases[phase])
    return path


def _chain(carrier: Carrier, start_mm: Float, levels: Sequence[LevelSet]) -> list[Float]:
    """Positions on each level in turn, the first of which ``start_mm`` lies on already."""
    places = [start_mm]
    for level in levels[1:]:
        places.append(carrier.onto(level, places[-1]))
    return places


def _require_arrival(vertices_mm: Float, level: LevelSet, number: int, phase: float) -> None:
    """StageError unless the vertices came to lie on the zero level, in the median."""
    off_mm = float(np.median(np.abs(level.sample(vertices_mm)[0])))
    if off_mm > level.spacing_mm:
        raise StageError(
            f"the surface could not follow to phase {number} (at {phase:.3f} of the beat): it ends "
            f"{off_mm:.1f} mm from it, one voxel is allowed; look at the labels of that phase"
        )


def smooth_in_time(path_mm: Float, phases: Float, width_beats: float) -> Float:
    """Cyclic low pass over ``(phase, n, 3)`` that keeps the slow motion of the heart.

    2 G - G G with G the mean under a Gaussian: where G alone dulls the harmonic h of the beat by
    about (2 pi h width)^2 / 2, this does so by the square of it.
    """
    if width_beats == 0:
        return path_mm
    apart = (phases[:, None] - phases[None] + 0.5) % 1.0 - 0.5
    weights = np.exp(-0.5 * np.square(apart / width_beats))
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(np.tensordot(2 * weights - weights @ weights, path_mm, axes=1))


def restore_volume(vertices_mm: Float, triangles: Integer, volume_mm3: float) -> Float:
    """Offset ``(n, 3)`` vertices along their normals by the one length that gives a volume.

    Flat triangles cut the bulge of a surface off and smoothing in time dulls its motion; both are
    small and alike all over, which is why one length suffices. Two rounds of volume over area.
    """
    for _ in range(2):
        surface = Surface(vertices_mm, triangles)
        area_mm2 = float(vertex_areas(vertices_mm, triangles).sum())
        offset_mm = (volume_mm3 - surface.volume_mm3()) / area_mm2
        vertices_mm = vertices_mm + offset_mm * vertex_normals(vertices_mm, triangles)
    return vertices_mm
