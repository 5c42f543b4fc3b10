"""Measures against truth: surfaces, labels, transforms, phases and volumes.

Pure functions; lengths in mm, volumes in ml, frame LPS.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import connected_components

from pipeline.errors import InputError
from pipeline.geometry import Float, Surface, area_vectors, transform_points
from pipeline.surface.measures import distances_mm
from pipeline.surface.mesh import adjacency


@dataclass(frozen=True, slots=True)
class SurfaceDistance:
    """How far two surfaces lie apart, mm."""

    mean_mm: float
    """Mean of the two directed mean distances."""

    hausdorff95_mm: float
    """Larger of the two directed 95th percentiles."""

    largest_mm: float
    """Larger of the two directed maxima, over the samples."""


@dataclass(frozen=True, slots=True)
class Closedness:
    """Whether a mesh bounds a solid."""

    boundary_edges: int
    """Edges that are not shared by exactly two opposed triangles."""

    components: int
    """Pieces that share no vertex."""

    outward: bool
    """Whether every piece has its normals pointing out: each encloses a positive volume."""

    @property
    def is_solid(self) -> bool:
        """Closed, in one piece, and outward."""
        return self.boundary_edges == 0 and self.components == 1 and self.outward


def surface_distance(
    first: Surface, second: Surface, samples: int = 20_000, seed: int = 0
) -> SurfaceDistance:
    """Symmetric distance between two surfaces, sampled evenly over their area.

    Each surface is sampled where area is, not where vertices are, and each sample is measured to
    the nearest point of the other surface's triangles. Mean and 95 % Hausdorff distance as in
    Taha and Hanbury, BMC Medical Imaging 15:29 (2015), both symmetric.

    Parameters
    ----------
    first, second
        Surfaces in one frame.
    samples
        Points on each surface.
    seed
        Of the sampling.
    """
    there = distances_mm(surface_samples(first, samples, seed), second)
    back = distances_mm(surface_samples(second, samples, seed), first)
    return SurfaceDistance(
        mean_mm=float(there.mean() + back.mean()) / 2,
        hausdorff95_mm=float(max(np.percentile(there, 95), np.percentile(back, 95))),
        largest_mm=float(max(there.max(), back.max())),
    )


def surface_samples(surface: Surface, count: int, seed: int = 0) -> Float:
    """Points ``(count, 3)`` spread over a surface evenly by area, mm.

    The cumulated area is cut into equal shares with one point in each (stratified sampling, less
    noise than independent draws); within its triangle the point is uniform.
    """
    a, b, c = (surface.vertices_mm[surface.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(area_vectors(surface.vertices_mm[surface.triangles]), axis=1)
    rng = np.random.default_rng(seed)
    share = (np.arange(count) + rng.random(count)) / count
    edges = np.cumsum(area) / area.sum()
    chosen = np.minimum(np.searchsorted(edges, share, side="right"), len(area) - 1)
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return np.asarray(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen])


def dice(
    found: npt.NDArray[np.integer], truth: npt.NDArray[np.integer], values: Mapping[str, int]
) -> dict[str, float]:
    """Overlap 2 |A and B| / (|A| + |B|) of label arrays by structure, in [0, 1].

    A structure that neither array shows has no overlap to speak of and is left out.

    Raises
    ------
    InputError
        When the arrays differ in shape.

    >>> dice(np.array([1, 1, 0]), np.array([1, 0, 0]), {"lv_cavity": 1, "aorta": 6})
    {'lv_cavity': 0.6666666666666666}
    """
    if found.shape != truth.shape:
        raise InputError(f"labels to compare must share a shape, got {found.shape}, {truth.shape}")
    overlap = {}
    for name, value in values.items():
        ours, theirs = found == value, truth == value
        total = np.count_nonzero(ours) + np.count_nonzero(theirs)
        if total:
            overlap[name] = float(2 * np.count_nonzero(ours & theirs) / total)
    return overlap


def pooled_dice(
    found: npt.NDArray[np.integer], truth: npt.NDArray[np.integer]
) -> npt.NDArray[np.float64]:
    """Overlap of all structures together in every slice of ``(..., y, x)`` labels, ``(...)``.

    2 (pixels that bear the same label) / (pixels labelled in one + in the other); NaN where
    neither shows anything. A pixel of the wrong structure counts as wrong.

    Raises
    ------
    InputError
        When the arrays differ in shape.
    """
    if found.shape != truth.shape:
        raise InputError(f"labels to compare must share a shape, got {found.shape}, {truth.shape}")
    same = ((found == truth) & (found > 0)).sum(axis=(-2, -1))
    total = (found > 0).sum(axis=(-2, -1)) + (truth > 0).sum(axis=(-2, -1))
    return np.asarray(np.where(total > 0, 2 * same / np.maximum(total, 1), np.nan))


def target_registration_error_mm(
    found_mr_from_tracker: Float, true_mr_from_tracker: Float, targets_mr_mm: Float
) -> Float:
    """How far ``(n, 3)`` targets of the MR frame are missed, ``(n,)`` mm.

    A target is carried to the tracker by the true transform and back by the one found
    (Fitzpatrick and West, IEEE Trans Med Imaging 20, 2001).
    """
    missed = found_mr_from_tracker @ np.linalg.inv(true_mr_from_tracker)
    return np.asarray(
        np.linalg.norm(transform_points(missed, targets_mr_mm) - targets_mr_mm, axis=1)
    )


def phase_error(found: Float, truth: Float) -> Float:
    """Cyclic difference of phases, in [-1/2, 1/2): positive when ``found`` is late.

    >>> phase_error(np.array([0.05]), np.array([0.95])).round(9)
    array([0.1])
    """
    return np.asarray((found - truth + 0.5) % 1.0 - 0.5)


def closedness(surface: Surface) -> Closedness:
    """Count what keeps a mesh from being the outward boundary of one solid."""
    vertices, triangles = surface.vertices_mm, surface.triangles
    _, part = connected_components(adjacency(triangles, len(vertices)), directed=False)
    used = np.unique(part[triangles[:, 0]])
    a, b, c = (vertices[triangles[:, k]] - vertices.mean(axis=0) for k in range(3))
    volume = np.bincount(part[triangles[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
    return Closedness(
        boundary_edges=len(surface.boundary_edges()),
        components=len(used),
        outward=bool((volume[used] > 0).all()),
    )
