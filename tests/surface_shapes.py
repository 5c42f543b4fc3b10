"""Bodies whose surface is known in closed form, and what voxels can tell of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry import Float, Mask, Surface
from pipeline.surface.level_set import LevelSet, smooth_level_set

SPACING_MM = 1.5

Implicit = Callable[[Float], Float]


def voxel_noise_mm(spacing_mm: float, smoothing_voxels: float) -> float:
    """Standard deviation of a smoothed face about the true one, from the steps of voxels alone.

    A column of voxels ends within half a voxel of the face, evenly: h / sqrt(12). Smoothing by
    2 G - G G in the two directions of the face leaves the square root of the integral of its
    square, (1 - 2/3 + 1/8) / (pi s^2), the integral of G_a G_b being 1 / (2 pi (a^2 + b^2)).
    """
    kept = (1 - 2 / 3 + 1 / 8) / (np.pi * smoothing_voxels**2)
    return float(spacing_mm / np.sqrt(12) * np.sqrt(kept))


def ellipsoid(axes_mm: tuple[float, float, float]) -> Implicit:
    """Negative inside, zero on the surface; not a distance."""
    return lambda points: np.linalg.norm(points / np.array(axes_mm), axis=-1) - 1


def box(points_mm: Float, centre_mm: tuple[float, ...], half_mm: tuple[float, ...]) -> Float:
    """Signed distance to a box."""
    beyond = np.abs(points_mm - np.array(centre_mm)) - np.array(half_mm)
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
    return np.asarray(outside + np.minimum(beyond.max(axis=-1), 0))


def two_lobes(points_mm: Float) -> Float:
    """Two balls grown into one with a round neck: -k log sum exp(-d / k), k = 4 mm."""
    first = np.linalg.norm(points_mm - (9, 0, 0), axis=-1) - 15
    second = np.linalg.norm(points_mm - (-11, 3, 5), axis=-1) - 12
    return np.asarray(-4 * np.logaddexp(-first / 4, -second / 4))


@dataclass(frozen=True)
class MovingBody:
    """A body carried by an affine motion: x = A(phase) X + b(phase), in mm."""

    shape: Implicit
    strain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Largest shortening along x, y, z."""
    turn_degrees: float = 0.0
    """Largest turn, about x."""
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def motion(self, phase: float) -> tuple[Float, Float]:
        """A and b: still at phase 0, farthest at mid-beat, with a loop in y."""
        out, loop = np.sin(np.pi * phase) ** 2, np.sin(2 * np.pi * phase)
        angle = np.deg2rad(self.turn_degrees) * out
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        shift = np.array(self.shift_mm) * (out, loop, out)
        return turn @ np.diag(1 - out * np.array(self.strain)), shift

    def carry(self, points_mm: Float, phase: float) -> Float:
        matrix, shift = self.motion(phase)
        return np.asarray(points_mm @ matrix.T + shift)

    def distance(self, points_mm: Float, phase: float) -> Float:
        """Distance to the surface to first order: f over the length of its gradient."""
        matrix, shift = self.motion(phase)
        inverse = np.linalg.inv(matrix)

        def value(points: Float) -> Float:
            return self.shape((points - shift) @ inverse.T)

        step = 1e-4 * np.eye(3)
        slope = [(value(points_mm + s) - value(points_mm - s)) / 2e-4 for s in step]
        return np.asarray(value(points_mm) / np.linalg.norm(slope, axis=0))

    def inside(self, points_mm: Float, phase: float) -> Mask:
        matrix, shift = self.motion(phase)
        return np.asarray(self.shape((points_mm - shift) @ np.linalg.inv(matrix).T) < 0)


def voxel_centres(half_mm: tuple[float, float, float]) -> tuple[Float, Float]:
    """Centres ``(z, y, x, 3)`` of a grid round the origin (off it by a third), and its corner."""
    counts = [2 * int(np.ceil(half / SPACING_MM)) for half in half_mm]
    first = np.array([-SPACING_MM * (n / 2 - 1 / 3) for n in counts])
    z, y, x = np.indices(counts[::-1])
    return first + SPACING_MM * np.stack([x, y, z], axis=-1), first


def smooth_level(shape: Implicit, half_mm: tuple[float, float, float]) -> LevelSet:
    """What labels of a shape about the origin become."""
    points, _ = voxel_centres(half_mm)
    return smooth_level_set(shape(points) < 0, SPACING_MM, 1.2)


def crossing_triangles(surface: Surface) -> int:
    """Triangles pierced by an edge that shares no vertex with them: an independent check."""
    from scipy.spatial import cKDTree

    v, t = surface.vertices_mm, surface.triangles
    edges = np.unique(np.sort(t[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    middles, centres = v[edges].mean(axis=1), v[t].mean(axis=1)
    reach = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1).max() / 2
    reach += np.linalg.norm(v[t] - centres[:, None], axis=2).max()
    near = cKDTree(middles).query_ball_tree(cKDTree(centres), reach)
    i = np.repeat(np.arange(len(edges)), [len(found) for found in near])
    j = np.concatenate([np.array(found, dtype=int) for found in near])
    apart = ~(edges[i][:, :, None] == t[j][:, None, :]).any(axis=(1, 2))
    i, j = i[apart], j[apart]
    p, q = v[edges[i, 0]], v[edges[i, 1]]
    a, b, c = (v[t[j, k]] for k in range(3))
    through = _side(a, b, c, p) * _side(a, b, c, q) < 0
    turns = np.sign([_side(p, q, a, b), _side(p, q, b, c), _side(p, q, c, a)]).sum(axis=0)
    return len(np.unique(j[through & (np.abs(turns) == 3)]))


def _side(a: Float, b: Float, c: Float, d: Float) -> Float:
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a))
