"""Labels of a beating heart to closed surfaces that move with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import InputError, StageError
from pipeline.geometry import Float, Float32, Integer, Label, Mask, MovingSurface, transform_points
from pipeline.imaging.labels import LABELS
from pipeline.surface.correspondence import (
    Across,
    carry_along,
    carry_through_cycle,
    drawn_along,
    restore_volume,
    smooth_in_time,
)
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.decimation import decimated
from pipeline.surface.level_set import (
    LevelSet,
    enclosed_mm3,
    smooth_level_set,
    smooth_union,
    with_necks,
    with_sign_of,
)
from pipeline.surface.mesh import bad_triangles, extract_surface, uncrossed, untangled
from pipeline.surface.settings import SurfaceSettings
from pipeline.surface.solid import largest_piece, one_piece
from pipeline.surface.unfolding import make_unfolder

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

GROWN_ON = dict.fromkeys(("left_atrium", "right_atrium", "aorta"), ("epicardium", "rv_endocardium"))
"""Structures that slide with others where they touch them."""

REQUIRED_STRUCTURES = ("lv_endocardium", "epicardium")
# A body below this many voxels is gone after smoothing.
FEWEST_VOXELS = 60
# Voxels of room round a body: as far as a distance is still of use.
MARGIN_VOXELS = 8
# Tries at one heart of parts that lie apart; wider seams would change the shape all over.
BLEND_WIDENINGS = (1.0, 1.5, 2.0)

# Radius of a neck, in edges of triangles, that marching cubes is sure to find.
NECK_EDGES = 0.9

Progress = Callable[[int, int], None]
# Tries at a mesh that passes through itself.
UNCROSSINGS = 4
# The interpreter lock leaves nothing for more.
THREADS = 2


@dataclass(frozen=True, slots=True)
class Body:
    """One structure in every phase, cut out of the grid with room round it."""

    levels: tuple[LevelSet, ...]
    """Smooth signed distance, one a phase."""

    volumes_mm3: tuple[float, ...]
    """Volume by the labels, one a phase."""

    first_index: Integer
    """Index ``(x, y, z)`` of the first voxel in the grid; negative where the body is padded."""


@dataclass(frozen=True, slots=True)
class _Followed:
    """A body and its surface through the beat, in mm from the body's first voxel."""

    body: Body
    moving: MovingSurface
    mended_phases: int = 0
    crossing_triangles: int = 0


@dataclass(frozen=True, slots=True)
class Extraction:
    """Surfaces of a beating heart, and what had to be mended."""

    surfaces: dict[str, MovingSurface]
    """By name, as in ``STRUCTURES``."""

    mended_phases: dict[str, int]
    """In how many phases each had passed through itself before it was mended."""

    crossing_triangles: dict[str, int]
    """How many triangles of each, over all phases, still pass through others; 0 as it should be."""


def extract(
    heart: Label,
    mr_from_index: Float,
    phases: Float,
    settings: SurfaceSettings,
    progress: Progress | None = None,
) -> Extraction:
    """Closed, outward, corresponding surfaces of the structures of a labelled beating heart.

    Structures are worked on side by side in ``THREADS`` threads; the result does not depend on it.

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
    Extraction
        A structure that no phase shows at a usable size (a short stack may miss the aorta) is left
        out; the left ventricle never is.

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
    counts = _label_counts(heart)
    parts = [name for name in STRUCTURES if name != "heart" and _is_present(counts, name, phases)]
    tell = progress or (lambda done, total: None)

    def carry(name: str) -> _Followed:
        body = _body(heart, name, spacing_mm, settings)
        return _carried(name, body, phases, settings)

    def finish(name: str) -> _Followed:
        grown_on = [carried[other] for other in GROWN_ON.get(name, ()) if other in carried]
        return _finished(_drawn(carried[name], grown_on, phases, settings), phases, settings, map)

    followed: dict[str, _Followed] = {}
    with ThreadPoolExecutor(THREADS) as pool:
        carried = dict(zip(parts, pool.map(carry, parts), strict=True))
        for name, one in zip(parts, pool.map(finish, parts), strict=True):
            followed[name] = one
            tell(len(followed), len(parts) + 1)
        outer = [one for name, one in followed.items() if name != "lv_endocardium"]
        followed["heart"] = _follow_heart(outer, phases, settings, pool.map)
        placed = [_placed(one, mr_from_index) for one in followed.values()]
        fewer = pool.map(lambda one: decimated(one, settings.decimation_error_mm), placed)
        surfaces = dict(zip(followed, fewer, strict=True))
    tell(len(followed), len(followed))
    return Extraction(
        surfaces,
        {name: one.mended_phases for name, one in followed.items()},
        {name: one.crossing_triangles for name, one in followed.items()},
    )


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


def _label_counts(heart: Label) -> Integer:
    """Voxels ``(phase, 256)`` of each label value."""
    return np.stack([np.bincount(volume.ravel(), minlength=256) for volume in heart])


def _is_present(label_counts: Integer, name: str, phases: Float) -> bool:
    """Whether a structure is there in all phases; StageError if in some, or if it must be."""
    for label in STRUCTURES[name] if name in REQUIRED_STRUCTURES else ():
        if not label_counts[:, LABELS[label]].any():
            raise StageError(f"segmentation shows no {label} in any phase; look at its labels")
    counts = label_counts[:, [LABELS[label] for label in STRUCTURES[name]]].sum(axis=1)
    if (counts < FEWEST_VOXELS).all() and name not in REQUIRED_STRUCTURES:
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


def _body(heart: Label, name: str, spacing_mm: float, settings: SurfaceSettings) -> Body:
    """Cut a structure out, make each phase one solid piece, and smooth it."""
    solid = np.stack([_solid(volume, name) for volume in heart])
    seen = [np.flatnonzero(solid.any(axis=tuple({0, 1, 2, 3} - {axis}))) for axis in (1, 2, 3)]
    low, high = np.array([(lines[0], lines[-1] + 1) for lines in seen]).T
    cut = solid[:, low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    padded = np.pad(cut, [(0, 0)] + [(MARGIN_VOXELS, MARGIN_VOXELS)] * 3)
    masks = [one_piece(mask) for mask in padded]

    def smooth(mask: Mask) -> LevelSet:
        level = smooth_level_set(mask, spacing_mm, settings.smoothing_voxels)
        return with_necks(level, mask, NECK_EDGES * settings.edge_mm, FEWEST_VOXELS)

    return Body(
        tuple(smooth(mask) for mask in masks),
        tuple(float(np.count_nonzero(mask)) * spacing_mm**3 for mask in masks),
        (low - MARGIN_VOXELS)[::-1],
    )


def _joined(bodies: Sequence[Body], blend_mm: float, phases: Float, across: Across) -> Body:
    """Bodies taken together, the seams between them bridged, as widely as one piece needs."""
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
            f"heart: its parts lie in pieces in phase {k} (at {phases[k]:.3f} of the beat), too "
            f"far apart for seams of {blend_mm} mm to bridge; look at the labels of that phase"
        )

    def mended(k: int) -> Float32:
        return with_sign_of(unions[k], one_piece(unions[k] < 0), spacing_mm)

    levels = tuple(LevelSet(union, spacing_mm) for union in across(mended, range(len(unions))))
    return Body(levels, tuple(enclosed_mm3(level) for level in levels), first)


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
    far_mm = MARGIN_VOXELS * level.spacing_mm
    room = np.full(tuple(shape[::-1]), far_mm, dtype=np.float32)
    ends = corner + level.distance_mm.shape[::-1]
    x, y, z = (slice(start, end) for start, end in zip(corner, ends, strict=True))
    room[z, y, x] = level.distance_mm
    return room


def _carried(name: str, body: Body, phases: Float, settings: SurfaceSettings) -> _Followed:
    """One structure's surface through the beat by its own shape; StageError names the structure."""
    reference = _reference(phases, settings)
    try:
        template = extract_surface(body.levels[reference], settings.edge_mm)
        path = carry_through_cycle(template, body.levels, reference, phases)
    except StageError as error:
        raise StageError(f"{name}: {error}") from error
    return _Followed(body, MovingSurface(path, template.triangles, phases))


def _drawn(
    one: _Followed, grown_on: Sequence[_Followed], phases: Float, settings: SurfaceSettings
) -> _Followed:
    """The same, sliding with the structures that it has grown on."""
    if not grown_on:
        return one
    reference, moving = _reference(phases, settings), one.moving
    beside_mm = _vertices_in(one.body, grown_on)
    path = drawn_along(
        moving.at(reference), one.body.levels, moving.vertices_mm, reference, beside_mm
    )
    return replace(one, moving=replace(moving, vertices_mm=path))


def _vertices_in(body: Body, others: Sequence[_Followed]) -> Float:
    """Vertices ``(phase, k, 3)`` of others, in mm from a body's first voxel."""
    spacing_mm = body.levels[0].spacing_mm
    shifts_mm = [spacing_mm * (other.body.first_index - body.first_index) for other in others]
    return np.concatenate(
        [one.moving.vertices_mm + shift for one, shift in zip(others, shifts_mm, strict=True)],
        axis=1,
    )


def _follow_heart(
    parts: Sequence[_Followed], phases: Float, settings: SurfaceSettings, across: Across
) -> _Followed:
    """The outer surface of all parts, which goes where they go."""
    body = _joined([part.body for part in parts], settings.heart_blend_mm, phases, across)
    reference = _reference(phases, settings)
    within_mm = _vertices_in(body, parts)
    try:
        template = extract_surface(body.levels[reference], settings.edge_mm)
        path = carry_along(template, body.levels, reference, phases, within_mm, across)
    except StageError as error:
        raise StageError(f"heart: {error}") from error
    carried = _Followed(body, MovingSurface(path, template.triangles, phases))
    return _finished(carried, phases, settings, across)


def _reference(phases: Float, settings: SurfaceSettings) -> int:
    """Number of the phase that is nearest to the reference, cyclically."""
    late = np.abs((phases - settings.reference_phase + 0.5) % 1.0 - 0.5)
    return int(late.argmin())


def _finished(
    one: _Followed, phases: Float, settings: SurfaceSettings, across: Across
) -> _Followed:
    """Smooth in time, sound in every phase, and of the volume of the labels."""
    body, triangles = one.body, one.moving.triangles
    unfolder = make_unfolder(one.moving.at(_reference(phases, settings)))
    unfolded = [unfolder.mended(vertices, bad_triangles) for vertices in one.moving.vertices_mm]
    path_mm = smooth_in_time(np.stack(unfolded), phases, settings.temporal_smoothing_beats)

    def sound(k: int) -> tuple[Float, bool, int]:
        level, volume_mm3 = body.levels[k], body.volumes_mm3[k]
        vertices = untangled(unfolder.mended(path_mm[k], bad_triangles), triangles, level)
        vertices = restore_volume(vertices, triangles, volume_mm3)
        vertices = untangled(vertices, triangles, level)
        crossing = 0
        for tries in range(UNCROSSINGS):
            apart = unfolder.mended(vertices, crossing_triangles)
            if apart is vertices:
                return vertices, tries > 0, 0
            # Bringing the volume back may press together what was just opened.
            apart = uncrossed(apart, triangles, level)
            vertices = restore_volume(apart, triangles, volume_mm3)
            crossing = int(np.count_nonzero(crossing_triangles(vertices, triangles)))
        return vertices, True, crossing

    places, mended, left = zip(*across(sound, range(len(path_mm))), strict=True)
    moving = MovingSurface(np.stack(places), triangles, phases)
    return _Followed(body, moving, sum(mended), sum(left))


def _placed(followed: _Followed, mr_from_index: Float) -> MovingSurface:
    """The surface in LPS mm, its normals outward even when the grid is left-handed."""
    moving, body = followed.moving, followed.body
    index = moving.vertices_mm / body.levels[0].spacing_mm + body.first_index
    triangles = moving.triangles
    if np.linalg.det(mr_from_index[:3, :3]) < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return MovingSurface(transform_points(mr_from_index, index), triangles, moving.phases)
