"""Labels made smooth: a signed distance whose zero level is the surface of a structure.

Points are ``(x, y, z)`` in millimetres from the first voxel of the field, along the axes of the
grid; the caller knows where the grid lies in the patient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from scipy import ndimage, spatial, special

from pipeline.geometry import Float, Float32, Mask
from pipeline.surface.kernels import sample

# A blurred mask tells the distance out to about 3 standard deviations, where 32 bits run out.
NEAR, FAR = 1.5, 2.5
# Voxels out to which a distance is of use: the room that is left round a body.
OF_USE_VOXELS = 8


@dataclass(frozen=True, slots=True)
class LevelSet:
    """Signed distance to a structure on an isotropic grid, negative inside."""

    distance_mm: Float32
    """``(z, y, x)`` values at the voxels."""

    spacing_mm: float
    """Edge of a voxel."""

    def sample(self, points_mm: Float) -> tuple[Float, Float]:
        """Distance ``(n,)`` in mm and its gradient ``(n, 3)`` at ``(n, 3)`` points.

        Both are of the trilinear interpolant. Points beyond the grid read its border.
        """
        values, gradients = sample(self.distance_mm, points_mm / self.spacing_mm)
        return values, gradients / self.spacing_mm

    def newton_step(self, points_mm: Float, longest_mm: float) -> Float:
        """Displacements ``(n, 3)`` in mm that bring points onto the zero level to first order."""
        distance, gradient = self.sample(points_mm)
        # A ridge of the distance has no direction; the bound keeps points there where they are.
        square = np.maximum(np.einsum("ij,ij->i", gradient, gradient), 0.25)
        step = np.clip(-distance / square, -longest_mm, longest_mm)
        return np.asarray(step[:, None] * gradient)


def smooth_level_set(mask: Mask, spacing_mm: float, smoothing_voxels: float) -> LevelSet:
    """Smooth signed distance to a ``(z, y, x)`` mask, its zero level enclosing the mask's volume.

    Across a flat face a mask blurred by a Gaussian of width s reads Phi(-d / s) at the distance d,
    so the inverse of Phi gives d below the size of a voxel; farther off the Euclidean distance
    takes over. A curved face is moved inwards by s^2 times its mean curvature, which is
    s^2 / 2 times the Laplacian of d; that is what 2 d - G d takes back, G being the same Gaussian.
    What is left is taken back by one constant: the zero level encloses the volume of the voxels.
    """
    solid = mask.astype(np.float32)
    blurred = ndimage.gaussian_filter(solid, smoothing_voxels, truncate=4.0)
    far = euclidean_voxels(mask)
    weight = np.clip((np.abs(far) / smoothing_voxels - NEAR) / (FAR - NEAR), 0, 1)
    distance, close = far.copy(), weight < 1
    near = -smoothing_voxels * special.ndtri(np.clip(blurred[close], 1e-6, 1 - 1e-6))
    distance[close] = (1 - weight[close]) * near + weight[close] * far[close]
    distance = 2 * distance - ndimage.gaussian_filter(distance, smoothing_voxels, truncate=4.0)
    distance -= volume_shift(distance, float(np.count_nonzero(mask)))
    return LevelSet((distance * spacing_mm).astype(np.float32), spacing_mm)


def with_necks(level: LevelSet, mask: Mask, radius_mm: float, fewest_voxels: int) -> LevelSet:
    """The level set with those necks kept that are thinner than the smoothing.

    Smoothing may part a mask of one piece where it is a voxel or two thin, as an auricle's neck.
    Parts of ``fewest_voxels`` or more are joined again to the largest by a tube along the shortest
    way through the mask.

    Parameters
    ----------
    level
        What `smooth_level_set` made of ``mask``.
    mask
        ``(z, y, x)``, one piece.
    radius_mm
        Of the tubes.
    """
    # Imported where few need it, for it takes a while.
    from skimage.graph import MCP_Geometric

    pieces, count = ndimage.label(level.distance_mm < 0)
    sizes = np.bincount(pieces.ravel())[1:]
    if count < 2 or np.sort(sizes)[-2] < fewest_voxels:
        return level
    body = int(sizes.argmax()) + 1
    inside = mask | (pieces == body)
    ways = MCP_Geometric(np.where(inside, 1 + np.maximum(level.distance_mm, 0), np.inf))
    costs, _ = ways.find_costs(np.argwhere(pieces == body))
    for number in np.flatnonzero(sizes >= fewest_voxels) + 1:
        ends = np.argwhere((pieces == number) & np.isfinite(costs))
        if number == body or not len(ends):
            continue
        nearest = ends[costs[tuple(ends.T)].argmin()]
        way = ndimage.gaussian_filter1d(
            np.array(ways.traceback(nearest), float), 1.0, axis=0, mode="nearest"
        )
        centres = np.concatenate([way, (way[1:] + way[:-1]) / 2])
        level = with_balls(level, level.spacing_mm * centres[:, ::-1], radius_mm)
    return level


def with_balls(level: LevelSet, centres_mm: Float, radius_mm: float) -> LevelSet:
    """The level set with balls of one radius about points ``(n, 3)`` joined smoothly to it.

    Farther from them than a distance is of use, it stays as it is.
    """
    distance_mm, spacing_mm = level.distance_mm.copy(), level.spacing_mm
    centres = centres_mm[:, ::-1] / spacing_mm
    room = radius_mm / spacing_mm + OF_USE_VOXELS
    low = np.maximum(np.floor(centres.min(axis=0) - room).astype(int), 0)
    high = np.minimum(np.ceil(centres.max(axis=0) + room).astype(int) + 1, distance_mm.shape)
    box = tuple(slice(start, stop) for start, stop in zip(low, high, strict=True))
    voxels = np.indices(tuple(high - low)).reshape(3, -1).T + low
    away = np.asarray(spatial.cKDTree(centres).query(voxels)[0]).reshape(high - low)
    balls_mm = np.asarray(spacing_mm * away - radius_mm, np.float32)
    distance_mm[box] = smooth_union([distance_mm[box], balls_mm], spacing_mm)
    return LevelSet(distance_mm, spacing_mm)


def volume_shift(distance_voxels: Float | Float32, volume_voxels: float) -> float:
    """Level of a signed distance (voxels) that encloses a volume (voxels), found by Newton.

    A voxel counts as filled in the measure in which the level passes it: clip(1/2 - d, 0, 1).
    """
    near = distance_voxels[np.abs(distance_voxels) < 3]
    inside = float(np.count_nonzero(distance_voxels <= -3))
    level = 0.0
    for _ in range(5):
        filled = np.clip(0.5 - (near - level), 0, 1)
        area = max(float(np.count_nonzero((filled > 0) & (filled < 1))), 1.0)
        level += float(np.clip((volume_voxels - inside - float(filled.sum())) / area, -0.5, 0.5))
    return level


def smooth_union(distances_mm: Sequence[Float32], blend_mm: float) -> Float32:
    """Signed distance to bodies taken together, the seams between them filled smoothly.

    -k log sum exp(-d / k), k = blend_mm / 4: a seam where two bodies are equally near is filled to
    a depth of k log 2, one body alone is left as it is. With ``blend_mm`` 0, the smallest distance.

    Parameters
    ----------
    distances_mm
        Signed distances on one grid.
    blend_mm
        Width about which two bodies act on each other.
    """
    nearest = np.min(distances_mm, axis=0)
    if blend_mm == 0:
        return np.asarray(nearest)
    reach = blend_mm / 4
    total = sum(np.exp((nearest - distance) / reach) for distance in distances_mm)
    return np.asarray(nearest - reach * np.log(total), dtype=np.float32)


def with_sign_of(distance_mm: Float32, solid: Mask, spacing_mm: float) -> Float32:
    """Distances with the sign that a mended mask asks for: a quarter voxel where they differ."""
    sign = np.where(solid, np.float32(-0.25), np.float32(0.25)) * np.float32(spacing_mm)
    return np.where((distance_mm < 0) == solid, distance_mm, sign)


def enclosed_mm3(level: LevelSet) -> float:
    """Volume inside the zero level: each voxel counts as clip(1/2 - d / spacing, 0, 1)."""
    filled = np.clip(0.5 - level.distance_mm / level.spacing_mm, 0, 1)
    return float(filled.sum(dtype=np.float64)) * level.spacing_mm**3


def euclidean_voxels(mask: Mask) -> Float32:
    """Signed distance in voxels from voxel centres to the face of the mask, by Maurer's sweep."""
    sweep = sitk.SignedMaurerDistanceMapImageFilter()
    sweep.SetNumberOfThreads(1)
    sweep.SetSquaredDistance(False)
    to_rim = sitk.GetArrayFromImage(sweep.Execute(sitk.GetImageFromArray(mask.astype(np.uint8))))
    # The sweep measures to the centres of the outermost voxels inside; the face is half a voxel on.
    return np.asarray(to_rim - 0.5, dtype=np.float32)
