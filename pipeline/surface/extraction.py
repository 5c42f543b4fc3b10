"""Labels of a beating heart to closed surfaces that move with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import InputError, StageError
from pipeline.geometry import Float, Float32, Integer, Label, Mask, MovingSurface, transform_points
from pipeline.imaging.labels import LABELS
from pipeline.surface.correspondence import carry_through_cycle, restore_volume, smooth_in_time
from pipeline.surface.level_set import (
    LevelSet,
    enclosed_mm3,
    smooth_level_set,
    smooth_union,
    with_sign_of,
)
from pipeline.surface.mesh import extract_surface, untangled
from pipeline.surface.settings import SurfaceSettings
from pipeline.surface.solid import largest_piece, one_piece

STRUCTURES: dict[str, tuple[str, ...]] = {
    "lv_endocardium": ("lv_cavity",),
    "epicardium": ("lv_cavity", "lv_myocardium"),
    "rv_endocardium": ("rv_cavity",),
    "left_atrium": ("left_atrium",),
    "right_atrium": ("right_atrium",),
    "aorta": ("aorta",),
    "heart": tuple(LABELS),
}
"""Labels that a surface encloses."""

REQUIRED_LABELS = ("lv_cavity", "lv_myocardium")
# A body below this many voxels is gone after smoothing.
FEWEST_VOXELS = 60
# Voxels of room round a body: as far as a distance is still of use.
MARGIN_VOXELS = 8
# Tries at one heart of parts that lie apart; wider seams would change the shape all over.
BLEND_WIDENINGS = (1.0, 1.5, 2.0)

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Body:
    """One structure in every phase, cut out of the grid with room round it."""

    levels: tuple[LevelSet, ...]
    """Smooth signed distance, one a phase."""

    volumes_mm3: tuple[float, ...]
    """Volume by the labels, one a phase."""

    first_index: Integer
    """Index ``(x, y, z)`` of the first voxel in the grid; negative where the body is padded."""


def extract_moving_surfaces(
    heart: Label,
    mr_from_index: Float,
    phases: Float,
    settings: SurfaceSettings,
    progress: Progress | None = None,
) -> dict[str, MovingSurface]:
    """Closed, outward, corresponding surfaces of the structures of a labelled beating heart.

    Parameters
    ----------
    heart
        ``(phase, z, y, x)`` label values on an isotropic grid.
    mr_from_index
        4x4, from ``(x, y, z)`` index to LPS mm; oblique and left-handed grids are welcome.
    phases
        ``(phase,)`` in [0, 1), rising.
    settings
        Size of triangles, smoothing.
    progress
        Called with structures done and structures in total.

    Returns
    -------
    dict
        Surfaces by name, as in ``STRUCTURES``. A structure that no phase shows at a usable size
        (a short stack may miss the aorta) is left out; the left ventricle never is.

    Raises
    ------
    InputError
        When shapes disagree, phases do not rise, or the grid is not isotropic.
    StageError
        When the left ventricle is missing, a structure is there in some phases only, its shape
        in some phase has nothing to do with its shape at the reference phase, or the parts of the
        heart lie far apart.
    """
    spacing_mm = _require_grid(heart, mr_from_index, phases)
    parts = [name for name in STRUCTURES if name != "heart" and _is_present(heart, name, phases)]
    bodies: dict[str, Body] = {}
    surfaces = {}
    for done, name in enumerate([*parts, "heart"]):
        if name == "heart":
            outer = [body for part, body in bodies.items() if part != "lv_endocardium"]
            bodies[name] = _joined(outer, settings.heart_blend_mm, phases)
        else:
            bodies[name] = _body(heart, name, spacing_mm, settings.smoothing_voxels)
        try:
            moving = _moving_mesh(bodies[name], phases, settings)
        except StageError as error:
            raise StageError(f"{name}: {error}") from error
        surfaces[name] = _placed(moving, bodies[name], mr_from_index)
        if progress:
            progress(done + 1, len(parts) + 1)
    return surfaces


def _require_grid(heart: Label, mr_from_index: Float, phases: Float) -> float:
    """Edge of a voxel in mm; InputError when labels, transform and phases do not fit."""
    if heart.ndim != 4 or len(heart) != len(phases) or not len(phases):
        raise InputError(
            f"labels must be (phase, z, y, x) for {len(phases)} phases, got {heart.shape}"
        )
    if np.any(np.diff(phases) <= 0) or phases[0] < 0 or phases[-1] >= 1:
        raise InputError(f"phases must rise within [0, 1), got {phases}")
    if mr_from_index.shape != (4, 4) or not np.isfinite(mr_from_index).all():
        raise InputError(f"mr_from_index must be a finite 4x4 matrix, got\n{mr_from_index}")
    metric = mr_from_index[:3, :3].T @ mr_from_index[:3, :3]
    spacing_mm = float(np.sqrt(np.trace(metric) / 3))
    if not np.allclose(metric, spacing_mm**2 * np.eye(3), atol=0.01 * spacing_mm**2):
        raise InputError(
            "surfaces need labels on a grid with one spacing and right angles, got mr_from_index\n"
            f"{mr_from_index}\nresample the labels first"
        )
    return spacing_mm


def _is_present(heart: Label, name: str, phases: Float) -> bool:
    """Whether a structure is there in all phases; StageError if in some, or if it must be."""
    for label in STRUCTURES[name] if name in ("lv_endocardium", "epicardium") else ():
        if not (heart == LABELS[label]).any():
            raise StageError(f"segmentation shows no {label} in any phase; look at its labels")
    counts = np.array([np.count_nonzero(_solid(volume, name)) for volume in heart])
    if (counts < FEWEST_VOXELS).all() and name not in ("lv_endocardium", "epicardium"):
        return False
    if (counts < FEWEST_VOXELS).any():
        k = int(counts.argmin())
        raise StageError(
            f"{name}: phase {k} (at {phases[k]:.3f} of the beat) has {counts[k]} voxels, "
            f"{FEWEST_VOXELS} or more are needed; look at the labels of that phase"
        )
    return True


def _solid(volume: Label, name: str) -> Mask:
    """Where one phase shows a structure."""
    chosen = np.zeros(256, dtype=bool)
    chosen[[LABELS[label] for label in STRUCTURES[name]]] = True
    return np.asarray(chosen[volume])


def _body(heart: Label, name: str, spacing_mm: float, smoothing_voxels: float) -> Body:
    """Cut a structure out, make each phase one solid piece, and smooth it."""
    solid = np.stack([_solid(volume, name) for volume in heart])
    seen = np.argwhere(solid.any(axis=0))
    low, high = seen.min(axis=0), seen.max(axis=0) + 1
    cut = solid[:, low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    padded = np.pad(cut, [(0, 0)] + [(MARGIN_VOXELS, MARGIN_VOXELS)] * 3)
    masks = [one_piece(mask) for mask in padded]
    return Body(
        tuple(smooth_level_set(mask, spacing_mm, smoothing_voxels) for mask in masks),
        tuple(float(np.count_nonzero(mask)) * spacing_mm**3 for mask in masks),
        (low - MARGIN_VOXELS)[::-1],
    )


def _joined(bodies: Sequence[Body], blend_mm: float, phases: Float) -> Body:
    """Bodies taken together, the seams between them bridged, as widely as one piece needs."""
    spacing_mm = bodies[0].levels[0].spacing_mm
    first = np.min([body.first_index for body in bodies], axis=0)
    for widening in BLEND_WIDENINGS:
        unions = _unions(bodies, first, widening * blend_mm)
        broken = [k for k, union in enumerate(unions) if _is_in_pieces(union < 0)]
        if not broken:
            break
    else:
        k = broken[0]
        raise StageError(
            f"heart: its parts lie in pieces in phase {k} (at {phases[k]:.3f} of the beat), too "
            f"far apart for seams of {blend_mm} mm to bridge; look at the labels of that phase"
        )
    for k, union in enumerate(unions):
        unions[k] = with_sign_of(union, one_piece(union < 0), spacing_mm)
    levels = tuple(LevelSet(union, spacing_mm) for union in unions)
    return Body(levels, tuple(enclosed_mm3(level) for level in levels), first)


def _unions(bodies: Sequence[Body], first: Integer, blend_mm: float) -> list[Float32]:
    """Smooth union of the bodies in an array that holds them all, one a phase."""
    ends = [body.first_index + body.levels[0].distance_mm.shape[::-1] for body in bodies]
    shape = np.max(ends, axis=0) - first
    unions = []
    for k in range(len(bodies[0].levels)):
        placed = [_in_room(body.levels[k], body.first_index - first, shape) for body in bodies]
        unions.append(smooth_union(placed, blend_mm))
    return unions


def _is_in_pieces(mask: Mask) -> bool:
    """Whether a piece that is more than a speck lies apart from the largest."""
    return int(np.count_nonzero(mask & ~largest_piece(mask))) >= FEWEST_VOXELS


def _in_room(level: LevelSet, corner: Integer, shape: Integer) -> Float32:
    """Distances of a body in a larger array; ``corner`` and ``shape`` are ``(x, y, z)``."""
    far_mm = MARGIN_VOXELS * level.spacing_mm
    room = np.full(tuple(shape[::-1]), far_mm, dtype=np.float32)
    ends = corner + level.distance_mm.shape[::-1]
    x, y, z = (slice(start, end) for start, end in zip(corner, ends, strict=True))
    room[z, y, x] = level.distance_mm
    return room


def _moving_mesh(body: Body, phases: Float, settings: SurfaceSettings) -> MovingSurface:
    """The body's surface through the beat, in mm from its first voxel."""
    late = np.abs((phases - settings.reference_phase + 0.5) % 1.0 - 0.5)
    reference = int(late.argmin())
    template = extract_surface(body.levels[reference], settings.edge_mm)
    path = carry_through_cycle(template, body.levels, reference, phases)
    path = smooth_in_time(path, phases, settings.temporal_smoothing_beats)
    places = []
    for vertices, level, volume_mm3 in zip(path, body.levels, body.volumes_mm3, strict=True):
        sound = untangled(vertices, template.triangles, level)
        places.append(restore_volume(sound, template.triangles, volume_mm3))
    return MovingSurface(np.stack(places), template.triangles, phases)


def _placed(moving: MovingSurface, body: Body, mr_from_index: Float) -> MovingSurface:
    """The surface in LPS mm, its normals outward even when the grid is left-handed."""
    index = moving.vertices_mm / body.levels[0].spacing_mm + body.first_index
    triangles = moving.triangles
    if np.linalg.det(mr_from_index[:3, :3]) < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return MovingSurface(transform_points(mr_from_index, index), triangles, moving.phases)
