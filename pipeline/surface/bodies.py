"""Bodies cut out of labels: one structure in every phase as smooth signed distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, Integer, Label, Mask
from pipeline.imaging.labels import LABELS
from pipeline.surface.correspondence import Across
from pipeline.surface.level_set import (
    OF_USE_VOXELS,
    LevelSet,
    enclosed_mm3,
    smooth_level_set,
    smooth_union,
    with_balls,
    with_necks,
    with_sign_of,
)
from pipeline.surface.mesh import marched_nodes
from pipeline.surface.settings import SurfaceSettings
from pipeline.surface.solid import largest_piece, one_piece

# A body below this many voxels is gone after smoothing.
FEWEST_VOXELS = 60
# Tries at one heart of parts that lie apart; wider seams would change the shape all over.
BLEND_WIDENINGS = (1.0, 1.5, 2.0)
# Rounds of plugging tunnels; one is nearly always enough.
PLUGGINGS = 3
# Radius of a neck, in edges of triangles, that marching cubes is sure to find.
NECK_EDGES = 0.9


@dataclass(frozen=True, slots=True)
class Body:
    """One structure in every phase, cut out of the grid with room round it."""

    levels: tuple[LevelSet, ...]
    """Smooth signed distance, one a phase."""

    volumes_mm3: tuple[float, ...]
    """Volume by the labels, one a phase."""

    left_out_mm3: tuple[float, ...]
    """Volume of the labels that lie apart from the solid, one a phase."""

    first_index: Integer
    """Index ``(x, y, z)`` of the first voxel in the grid; negative where the body is padded."""


def cut_out(
    heart: Label, labels: Sequence[str], spacing_mm: float, settings: SurfaceSettings
) -> Body:
    """Cut a structure out, make each phase one solid piece, and smooth it."""
    chosen = np.zeros(256, dtype=bool)
    chosen[[LABELS[label] for label in labels]] = True
    solid = chosen[heart]
    seen = [np.flatnonzero(solid.any(axis=tuple({0, 1, 2, 3} - {axis}))) for axis in (1, 2, 3)]
    low, high = np.array([(lines[0], lines[-1] + 1) for lines in seen]).T
    cut = solid[:, low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    padded = np.pad(cut, [(0, 0)] + [(OF_USE_VOXELS, OF_USE_VOXELS)] * 3)
    masks = [one_piece(mask) for mask in padded]

    def smooth(mask: Mask) -> LevelSet:
        level = smooth_level_set(mask, spacing_mm, settings.smoothing_voxels)
        return with_necks(level, mask, NECK_EDGES * settings.edge_mm, FEWEST_VOXELS)

    return Body(
        tuple(smooth(mask) for mask in masks),
        tuple(float(np.count_nonzero(mask)) * spacing_mm**3 for mask in masks),
        tuple(
            float(np.count_nonzero(drawn & ~mask)) * spacing_mm**3
            for drawn, mask in zip(padded, masks, strict=True)
        ),
        (low - OF_USE_VOXELS)[::-1],
    )


def joined(
    bodies: Sequence[Body], phases: Float, settings: SurfaceSettings, across: Across
) -> Body:
    """Bodies taken together, the seams between them bridged, as widely as one piece needs.

    Tunnels between them are plugged: open in one phase and closed in the next, they would fold any
    mesh that goes through the beat.

    Raises
    ------
    StageError
        When the bodies stay in pieces in some phase.
    """
    blend_mm = settings.heart_blend_mm
    spacing_mm = bodies[0].levels[0].spacing_mm
    first = np.min([body.first_index for body in bodies], axis=0)
    for widening in BLEND_WIDENINGS:
        unions = _unions(bodies, first, widening * blend_mm, across)
        broken = [k for k, union in enumerate(unions) if _is_in_pieces(union < 0)]
        if not broken:
            break
    else:
        k = broken[0]
        raise StageError(
            f"its parts lie in pieces in phase {k} (at {phases[k]:.3f} of the beat), too far apart "
            f"for seams of {blend_mm} mm to bridge"
        )

    def mended(k: int) -> LevelSet:
        solid = with_sign_of(unions[k], one_piece(unions[k] < 0), spacing_mm)
        return _without_tunnels(LevelSet(solid, spacing_mm), settings.edge_mm)

    levels = tuple(across(mended, range(len(unions))))
    volumes_mm3 = tuple(enclosed_mm3(level) for level in levels)
    return Body(levels, volumes_mm3, (0.0,) * len(levels), first)


def _without_tunnels(level: LevelSet, edge_mm: float) -> LevelSet:
    """The level set with plugs in all tunnels that marching cubes would find, as far as it goes.

    Its grid is coarser than the voxels: a plug that is one voxel thick slips through.
    """
    for _ in range(PLUGGINGS):
        distance_mm, step_mm = marched_nodes(level, edge_mm)
        plugs = np.argwhere(one_piece(distance_mm < 0) & (distance_mm >= 0)).astype(float)
        if not len(plugs):
            break
        level = with_balls(level, step_mm * plugs[:, ::-1], step_mm)
    return level


def _unions(
    bodies: Sequence[Body], first: Integer, blend_mm: float, across: Across
) -> list[Float32]:
    """Smooth union of the bodies in an array that holds them all, one a phase."""
    ends = [body.first_index + body.levels[0].distance_mm.shape[::-1] for body in bodies]
    shape = np.max(ends, axis=0) - first

    def union(k: int) -> Float32:
        placed = [_in_room(body.levels[k], body.first_index - first, shape) for body in bodies]
        return smooth_union(placed, blend_mm)

    return list(across(union, range(len(bodies[0].levels))))


def _is_in_pieces(mask: Mask) -> bool:
    """Whether a piece that is more than a speck lies apart from the largest."""
    return int(np.count_nonzero(mask & ~largest_piece(mask))) >= FEWEST_VOXELS


def _in_room(level: LevelSet, corner: Integer, shape: Integer) -> Float32:
    """Distances of a body in a larger array; ``corner`` and ``shape`` are ``(x, y, z)``."""
    far_mm = OF_USE_VOXELS * level.spacing_mm
    room = np.full(tuple(shape[::-1]), far_mm, dtype=np.float32)
    ends = corner + level.distance_mm.shape[::-1]
    x, y, z = (slice(start, end) for start, end in zip(corner, ends, strict=True))
    room[z, y, x] = level.distance_mm
    return room
