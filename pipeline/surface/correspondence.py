"""One template carried through the beat, so that vertex i stays the same material point.

A shape does not tell how its points slide within its surface. What is assumed is that they slide
as little as a smooth motion allows: from phase to phase first the least affine motion, then the
smoothest displacement, that bring the surface onto the next one. The template goes through the
cycle in both directions and the two are blended, so that the end of the beat meets its start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from pipeline.errors import StageError
from pipeline.geometry import Float, Integer, Surface
from pipeline.surface.kernels import affine_equations, chebyshev
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
# Vertices that may end off the surface: a thin tip that a phase does not show has nowhere to go.
STRAY_SHARE = 0.05
# How many voxels off the others may be at most: more, and the shape of a phase has nothing to do
# with the one before.
FARTHEST_VOXELS = 2.0
# Vertices of the surfaces within that tell an outer one where to go, and how near they should be.
COMPANIONS = 12
COMPANION_MM = 4.0
# How near a surface must be to what it has grown on to slide with it, and the share of trust from
# which on that is given up for its own sliding.
GROWN_ON_MM = 8.0
DOUBT = 0.3

Smoother = Callable[[Float], Float]
Across = Callable[[Callable[[int], Any], Iterable[int]], Iterable[Any]]


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
        return self.elastic(level, start, self.smoothers)

    def elastic(self, level: LevelSet, start_mm: Float, smoothers: Sequence[Smoother]) -> Float:
        """Bring vertices onto a zero level by displacements that smoothers let through."""
        bound_mm = 4 * level.spacing_mm
        shift = np.zeros_like(start_mm)
        for smooth in smoothers:
            for _ in range(ELASTIC_STEPS):
                shift = smooth(shift + level.newton_step(start_mm + shift, bound_mm))
        return self.settle(level, start_mm + shift)

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
    starts, neighbours = matrix.indptr.astype(np.uint64), matrix.indices.astype(np.uint64)

    def smooth(values: Float) -> Float:
        found: Float = chebyshev(starts, neighbours, matrix.data, values, centre, radius, rounds)
        return found

    return smooth


def affine_step(level: LevelSet, vertices_mm: Float, weights: Float) -> Float:
    """Vertices after the least affine motion that brings them onto the zero level, in the mean.

    Gauss-Newton on sum w (d + g . u)^2 + ridge |theta|^2, where u is affine in the position and
    theta is scaled to be the displacement in mm at the size of the body. The ridge leaves out the
    motions that the shape does not show, such as the spin of a ball.
    """
    centre = weights @ vertices_mm
    size_mm = np.sqrt((weights * np.square(vertices_mm - centre).sum(axis=1)).sum())
    basis = np.column_stack([np.ones(len(vertices_mm)), (vertices_mm - centre) / size_mm])
    theta = np.zeros(12)
    ridge = _affine_ridge()
    for _ in range(AFFINE_STEPS):
        moved = vertices_mm + basis @ theta.reshape(4, 3)
        distance, gradient = level.sample(moved)
        distance = np.clip(distance, -8 * level.spacing_mm, 8 * level.spacing_mm)
        normal, right = affine_equations(basis, gradient, distance, weights)
        theta -= np.linalg.solve(normal + ridge, right + ridge @ theta)
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
        When a twentieth of the vertices end more than two voxels from the surface of some phase.
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
        # Where the two slid apart, the mean of two places on a bent surface lies off it.
        found = carrier.elastic(levels[phase], blended, carrier.smoothers)
        path[phase] = untangled(found, template.triangles, levels[phase])
        require_arrival(path[phase], levels[phase], phase, phases[phase])
    return path


def carry_along(
    template: Surface,
    levels: Sequence[LevelSet],
    reference: int,
    phases: Float,
    within_mm: Float,
    across: Across = map,
) -> Float:
    """Positions ``(phase, n, 3)`` in mm of a surface that goes where those within it go.

    Each vertex is first moved as the nearest vertices of the surfaces within are, by a mean under
    a Gaussian; what distance is left to its own zero level is taken by smooth displacements. So
    the hull of the heart slides as its chambers do, and ends the beat where they end it.

    Parameters
    ----------
    template, levels, reference, phases
        As for ``carry_through_cycle``.
    within_mm
        ``(phase, k, 3)`` corresponding vertices of the surfaces within.
    across
        Works through the phases: ``map``, or that of a pool of threads.

    Raises
    ------
    StageError
        When a twentieth of the vertices end more than two voxels from the surface of some phase.
    """
    carrier = make_carrier(template)
    way_at, _ = _companions(template.vertices_mm, within_mm, reference)

    def at(k: int) -> Float:
        if k == reference:
            return template.vertices_mm
        predicted = template.vertices_mm + carrier.smoothers[-2](way_at(k))
        found = carrier.elastic(levels[k], predicted, carrier.smoothers[1:])
        found = untangled(found, template.triangles, levels[k])
        require_arrival(found, levels[k], k, phases[k])
        return found

    return np.stack(list(across(at, range(len(levels)))))


def drawn_along(
    template: Surface, levels: Sequence[LevelSet], path_mm: Float, reference: int, beside_mm: Float
) -> Float:
    """Positions ``(phase, n, 3)`` of a surface whose sliding follows what it has grown on.

    The shape of an atrium or of the aorta hardly tells how far its lower part slides; the
    ventricles below do. Near them the sliding is theirs, further off the difference dies away
    smoothly. Motion along the normals stays as it was.

    Parameters
    ----------
    template, levels, reference
        As for ``carry_through_cycle``.
    path_mm
        What that gave.
    beside_mm
        ``(phase, k, 3)`` corresponding vertices of the surfaces that this one has grown on.
    """
    carrier = make_carrier(template)
    smooth = carrier.smoothers[0]
    start = path_mm[reference]
    way_at, far_mm = _companions(start, beside_mm, reference)
    trust = np.exp(-0.5 * np.square(far_mm / GROWN_ON_MM))[:, None] * np.ones(3)
    reach = smooth(trust) + DOUBT
    places = path_mm.copy()
    for k, level in enumerate(levels):
        if k != reference:
            pull = smooth(trust * (way_at(k) - (path_mm[k] - start))) / reach
            normals = vertex_normals(path_mm[k], template.triangles)
            pull -= np.einsum("ni,ni->n", pull, normals)[:, None] * normals
            places[k] = carrier.settle(level, path_mm[k] + pull)
    return places


def _companions(
    start_mm: Float, others_mm: Float, reference: int
) -> tuple[Callable[[int], Float], Float]:
    """Mean way ``(n, 3)`` until a phase of the others' vertices nearest each vertex; and how near.

    The mean is under a Gaussian about the nearest one.
    """
    found = cKDTree(others_mm[reference]).query(start_mm, COMPANIONS)
    far_mm, near = np.asarray(found[0]), np.asarray(found[1])
    weights = np.exp(-0.5 * (np.square(far_mm) - np.square(far_mm[:, :1])) / COMPANION_MM**2)
    weights /= weights.sum(axis=1, keepdims=True)

    def way_at(k: int) -> Float:
        ways = (others_mm[k] - others_mm[reference])[near]
        return np.asarray(np.einsum("nc,nci->ni", weights, ways))

    return way_at, np.asarray(far_mm[:, 0])


def _chain(carrier: Carrier, start_mm: Float, levels: Sequence[LevelSet]) -> list[Float]:
    """Positions on each level in turn, the first of which ``start_mm`` lies on already."""
    places = [start_mm]
    for level in levels[1:]:
        places.append(carrier.onto(level, places[-1]))
    return places


def require_arrival(vertices_mm: Float, level: LevelSet, number: int, phase: float) -> None:
    """StageError unless the vertices came to lie near the zero level, but for a few."""
    off_mm = distance_off_mm(vertices_mm, level)
    allowed_mm = FARTHEST_VOXELS * level.spacing_mm
    if off_mm > allowed_mm:
        raise StageError(
            f"the surface could not follow to phase {number} (at {phase:.3f} of the beat): "
            f"{STRAY_SHARE:.0%} of its vertices end {off_mm:.1f} mm or more from it, "
            f"{allowed_mm:.1f} mm are allowed; look at the labels of that phase"
        )


def distance_off_mm(vertices_mm: Float, level: LevelSet) -> float:
    """Distance from the zero level that all vertices ``(n, 3)`` but `STRAY_SHARE` keep within."""
    return float(np.quantile(np.abs(level.sample(vertices_mm)[0]), 1 - STRAY_SHARE))


def smooth_in_time(path_mm: Float, phases: Float, width_beats: float) -> Float:
    """Cyclic low pass over ``(phase, n, 3)`` that keeps the slow motion of the heart.

    2 G - G G with G the value at a phase of the line fitted under a Gaussian, which is the mean
    under it where phases are even (Fan and Gijbels, Local Polynomial Modelling and Its
    Applications, 1996): where G alone dulls the harmonic h of the beat by about
    (2 pi h width)^2 / 2, this does so by the square of it.
    """
    if width_beats == 0:
        return path_mm
    apart = ((phases[:, None] - phases[None] + 0.5) % 1.0 - 0.5) / width_beats
    weights = np.exp(-0.5 * np.square(apart))
    first, second = (weights * apart).sum(axis=1), (weights * apart**2).sum(axis=1)
    # A phase that stands alone has no slope: the ridge leaves it as it is.
    weights *= (second + 1e-6)[:, None] - first[:, None] * apart
    weights /= weights.sum(axis=1, keepdims=True)
    # Unlike a product by BLAS, the same to the last bit on any number of processors.
    return np.asarray(np.einsum("kl,lni->kni", 2 * weights - weights @ weights, path_mm))


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
