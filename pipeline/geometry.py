"""Values with a place in space: grids, surfaces and rigid motions, all in LPS millimetres.

Points are ``(x, y, z)``; arrays are ``(z, y, x)`` or ``(phase, z, y, x)``. A transform is a 4x4
matrix on column points, named target first: ``mr_from_index`` takes ``(x, y, z)`` indices to
patient millimetres. Nothing here opens a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Integer = npt.NDArray[np.int64]
Label = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

# How far the products of a rotation's axes may be from 0 and 1, and the last row from 0 0 0 1.
_RIGID, _LAST_ROW = 1e-3, 1e-6


def transform_points(target_from_source: Float, points: Float) -> Float:
    """Carry ``(..., 3)`` points from the source frame to the target frame.

    >>> shift = np.eye(4); shift[:3, 3] = 1, 2, 3
    >>> transform_points(shift, np.zeros((1, 3)))
    array([[1., 2., 3.]])
    """
    moved: Float = points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return moved


def corners_apart_mm(mr_from_one: Float, mr_from_other: Float, counts: Sequence[int]) -> float:
    """How far two placements put a corner of an array of ``(x, y, z)`` voxels apart, at most."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(counts) - 1)
    moved = (mr_from_one - mr_from_other)[:3]
    return float(np.linalg.norm(corners @ moved[:, :3].T + moved[:, 3], axis=1).max())


def rigid_between(target: Float, source: Float) -> Float:
    """The rigid motion (4x4) that brings ``(n, 3)`` points nearest to their partners.

    Least squares, without mirroring: S. Umeyama, "Least-squares estimation of transformation
    parameters between two point patterns", IEEE Trans Pattern Anal 13 (1991) 376-380.

    >>> corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> rigid_between(corner + (1, 2, 3), corner)[:3, 3].round(6)
    array([1., 2., 3.])
    """
    from_target, from_source = target - target.mean(axis=0), source - source.mean(axis=0)
    left, _, right = np.linalg.svd(from_target.T @ from_source)
    unmirrored = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    found = np.eye(4)
    found[:3, :3] = left @ unmirrored @ right
    found[:3, 3] = target.mean(axis=0) - found[:3, :3] @ source.mean(axis=0)
    return found


_ROUNDED = 0.02
"""Axes of numbers with two decimals miss length 1 and right angles by less."""


def require_rigid(transform: Float, where: str) -> None:
    """Raise InputError unless ``transform`` is a rotation and a shift (finite, 1e-3 in angle)."""
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise InputError(f"{where}: needs a finite 4x4 matrix, got\n{transform}")
    rotation = transform[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    last = float(np.abs(transform[3] - (0, 0, 0, 1)).sum())
    proper = off <= _RIGID
    if not proper or np.linalg.det(rotation) < 0 or last > _LAST_ROW:
        hint = ""
        if proper and np.linalg.det(rotation) < 0:
            hint = "; it mirrors: between RAS and LPS two axes turn, not one"
        elif proper and transform[3, :3].any() and not transform[:3, 3].any():
            hint = (
                "; it looks transposed: its shift stands in the last row, and belongs in the last "
                "column, above the 1"
            )
        elif off < _ROUNDED:
            hint = "; it looks rounded: write its numbers with five decimals or more"
        raise InputError(
            f"{where}: is not a rotation and a shift (its axes miss length 1 and right angles by "
            f"{off:.2g}, {_RIGID:g} is allowed), got\n{transform}{hint}"
        )


def nearest_phase(phases: Float, phase: float) -> int:
    """Number of the stored phase ``(n,)`` that is nearest to one, around the cycle."""
    return int(np.abs((phases - phase + 0.5) % 1 - 0.5).argmin())


def spread_over_triangle(count: int, first: int = 0) -> Float:
    """Shares ``(count, 3)`` of a triangle's corners that cover it evenly, the same every time:
    those of an endless row from number ``first`` on.

    Steps of the inverse plastic number and its square, even in the square (M. Roberts, "The
    unreasonable effectiveness of quasirandom sequences", 2018), folded into the triangle.
    """
    numbers = np.arange(first, first + count)[:, None]
    u, v = (numbers * (0.7548776662466927, 0.5698402909980532) % 1).T
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    return np.stack([1 - u - v, u, v], axis=1)


@dataclass(frozen=True, slots=True)
class Grid:
    """Regular axis-aligned nodes in LPS millimetres.

    Raises
    ------
    InputError
        When an axis has fewer than two nodes, or a spacing is not positive.
    """

    shape: tuple[int, int, int]
    """Number of nodes along z, y, x: the shape of the arrays that live here."""

    origin_mm: tuple[float, float, float]
    """Position ``(x, y, z)`` of the first node."""

    spacing_mm: tuple[float, float, float]
    """Distance between neighbours along ``(x, y, z)``."""

    def __post_init__(self) -> None:
        if min(self.shape) < 2:
            raise InputError(f"a grid needs 2 nodes or more on every axis, got {self.shape}")
        if not min(self.spacing_mm) > 0:
            raise InputError(f"a grid's spacing must be positive, got {self.spacing_mm} mm")

    @property
    def upper_mm(self) -> Float:
        """Position ``(x, y, z)`` of the last node."""
        steps = np.array(self.shape[::-1]) - 1
        return np.asarray(self.origin_mm + steps * np.array(self.spacing_mm))

    @property
    def axes_mm(self) -> tuple[Float, Float, Float]:
        """Coordinates of the nodes along x, y and z."""
        x, y, z = (
            np.asarray(origin + spacing * np.arange(count))
            for origin, spacing, count in zip(
                self.origin_mm, self.spacing_mm, self.shape[::-1], strict=True
            )
        )
        return x, y, z

    def nodes_mm(self) -> Float:
        """Positions of all nodes, ``(z, y, x, 3)``."""
        z, y, x = np.meshgrid(*self.axes_mm[::-1], indexing="ij")
        return np.stack([x, y, z], axis=-1)


@dataclass(frozen=True, slots=True)
class Surface:
    """A triangle mesh in LPS millimetres; normals point out of the body it encloses.

    Raises
    ------
    InputError
        When a shape is wrong, or there is no triangle.
    """

    vertices_mm: Float
    """``(n, 3)`` positions."""

    triangles: Integer
    """``(m, 3)`` vertex numbers, counter-clockwise seen from outside."""

    def __post_init__(self) -> None:
        if self.vertices_mm.ndim != 2 or self.vertices_mm.shape[1] != 3:
            raise InputError(f"vertices must be (n, 3), got {self.vertices_mm.shape}")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3 or not len(self.triangles):
            raise InputError(f"triangles must be (m, 3) with m > 0, got {self.triangles.shape}")

    def volume_mm3(self) -> float:
        """Enclosed volume by the divergence theorem; negative when normals point inwards."""
        # Far from the origin the parts would all but cancel.
        near_mm = self.vertices_mm - self.vertices_mm.mean(axis=0)
        a, b, c = (near_mm[self.triangles[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def boundary_edges(self) -> Integer:
        """Edges that break closedness, ``(k, 2)``: not shared by two opposed triangles."""
        t = self.triangles
        directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
        key = directed[:, 0] * np.int64(len(self.vertices_mm)) + directed[:, 1]
        opposed = directed[:, 1] * np.int64(len(self.vertices_mm)) + directed[:, 0]
        unique, count = np.unique(key, return_counts=True)
        good = np.isin(key, opposed) & (count[np.searchsorted(unique, key)] == 1)
        return np.asarray(directed[~good])


def area_vectors(corners: Float) -> Float:
    """Normals ``(n, 3)`` of triangles ``(n, 3, 3)``, each twice as long as its area is large."""
    first, second, third = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.asarray(np.cross(second - first, third - first))


@dataclass(frozen=True, slots=True)
class MovingSurface:
    """One surface through the beat: vertex i is the same material point in every phase.

    Raises
    ------
    InputError
        When the vertices have not three axes, the first as long as there are phases.
    """

    vertices_mm: Float
    """``(phase, n, 3)`` positions."""

    triangles: Integer
    """``(m, 3)`` vertex numbers, the same in every phase."""

    phases: Float
    """``(phase,)`` in [0, 1), rising."""

    def __post_init__(self) -> None:
        if self.vertices_mm.ndim != 3 or len(self.vertices_mm) != len(self.phases):
            raise InputError(
                f"vertices must be (phase, n, 3) for {len(self.phases)} phases, "
                f"got {self.vertices_mm.shape}"
            )

    def at(self, index: int) -> Surface:
        """The surface at stored phase number ``index``."""
        return Surface(self.vertices_mm[index], self.triangles)
