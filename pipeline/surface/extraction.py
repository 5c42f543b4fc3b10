"""Labels of a beating heart to closed surfaces that move with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.errors import InputError, StageError
from pipeline.geometry import Float, Integer, Label, MovingSurface, nearest_phase, transform_points
from pipeline.imaging.labels import LABELS
from pipeline.progress import Progress
from pipeline.surface.bodies import FEWEST_VOXELS, Body, cut_out, joined
from pipeline.surface.correspondence import (
    Across,
    carry_along,
    carry_through_cycle,
    distance_off_mm,
    drawn_along,
    require_arrival,
    restore_volume,
    smooth_in_time,
)
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.decimation import decimated
from pipeline.surface.mesh import bad_triangles, extract_surface, uncrossed, untangled
from pipeline.surface.settings import SurfaceSettings
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

# Least volume of a structure of ``GROWN_ON`` in a share of its largest. Atria keep a quarter or
# more of theirs, great vessels nearly all; less tells that a stack which ends at the valves shows
# slivers of them.
LEAST_KEPT = 0.2
# By what share a surface may enclose more or less than its labels untold, and by what it may at
# all; what offsetting leaves is under a hundredth.
VOLUME_TOLERANCE, LARGEST_MISFIT = 0.05, 0.15
# Tries at a mesh that passes through itself.
UNCROSSINGS = 4
# The interpreter lock leaves nothing for more.
THREADS = 2


@dataclass(frozen=True, slots=True)
class _Followed:
    """A body and its surface through the beat, in mm from the body's first voxel."""

    body: Body
    moving: MovingSurface
    mended_phases: int = 0
    crossing_triangles: int = 0
    off_mm: dict[int, float] = field(default_factory=dict)
    misfit_ml: dict[int, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Extraction:
    """Surfaces of a beating heart, and what had to be mended."""

    surfaces: dict[str, MovingSurface]
    """By name, as in ``STRUCTURES``."""

    mended_phases: dict[str, int]
    """In how many phases each had passed through itself before it was mended."""

    crossing_triangles: dict[str, int]
    """How many triangles of each, over all phases, still pass through others; 0 as it should be."""

    left_out_ml: dict[str, dict[int, float]]
    """What of its labels a surface leaves out, by phase: pieces that lie apart from the rest, where
    they hold more than ``VOLUME_TOLERANCE`` of it."""

    off_mm: dict[str, dict[int, float]]
    """How far, by phase, a twentieth of a surface's vertices lie off its labels or farther, where
    that is more than a voxel: labels that change from phase to phase as no heart does."""

    misfit_ml: dict[str, dict[int, tuple[float, float]]]
    """What a surface encloses and what its labels do, by phase, where these differ by more than
    ``VOLUME_TOLERANCE``, for the same cause."""

    left_out: dict[str, str]
    """Structures that have no surface, and why."""


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
        A structure is left out where no phase or not every one shows it at a usable size (a stack
        that ends at the valves reaches the atria only while the ventricles are short), where it
        cannot be followed through the beat, or where its surface does not enclose what its labels
        do; the left ventricle never is.

    Raises
    ------
    InputError
        When shapes disagree, phases do not rise, or the grid is not isotropic.
    StageError
        When the left ventricle is missing in some phase, or its shape there has nothing to do with
        its shape at the reference phase, or its surface does not enclose what its labels do.
    """
    spacing_mm = _require_grid(heart, mr_from_index, phases)
    absent = _absent(_label_counts(heart), phases, spacing_mm)
    parts = [name for name in STRUCTURES if name != "heart" and name not in absent]
    tell = progress or (lambda done, total: None)

    def carry(name: str) -> _Followed | StageError:
        try:
            return _carried(
                cut_out(heart, STRUCTURES[name], spacing_mm, settings), phases, settings
            )
        except StageError as error:
            return error

    def finish(name: str) -> _Followed | StageError:
        grown_on = [carried[other] for other in GROWN_ON.get(name, ()) if other in carried]
        drawn = _drawn(carried[name], grown_on, phases, settings)
        try:
            return _finished(drawn, phases, settings, map)
        except StageError as error:
            return error

    with ThreadPoolExecutor(THREADS) as pool:
        carried, lost = _told_apart(parts, pool.map(carry, parts))
        finished: list[_Followed | StageError] = []
        for one in pool.map(finish, carried):
            finished.append(one)
            tell(len(finished), len(carried) + 1)
        followed, also_lost = _told_apart(carried, finished)
        lost |= also_lost
        outer = [one for name, one in followed.items() if name != "lv_endocardium"]
        try:
            followed["heart"] = _follow_heart(outer, phases, settings, pool.map)
        except StageError as error:
            lost["heart"] = error
        placed = [_placed(one, mr_from_index) for one in followed.values()]
        fewer = pool.map(lambda one: decimated(one, settings.decimation_error_mm), placed)
        surfaces = dict(zip(followed, fewer, strict=True))
    tell(len(carried) + 1, len(carried) + 1)
    return Extraction(
        surfaces,
        {name: one.mended_phases for name, one in followed.items()},
        {name: one.crossing_triangles for name, one in followed.items()},
        {name: pieces for name, one in followed.items() if (pieces := _pieces_ml(one.body))},
        {name: one.off_mm for name, one in followed.items() if one.off_mm},
        {name: one.misfit_ml for name, one in followed.items() if one.misfit_ml},
        absent | {name: str(one) for name, one in lost.items()},
    )


def _told_apart(
    names: Iterable[str], tried: Iterable[_Followed | StageError]
) -> tuple[dict[str, _Followed], dict[str, StageError]]:
    """What was followed and what was lost; StageError for one that must be there."""
    by_name = dict(zip(names, tried, strict=True))
    lost = {name: one for name, one in by_name.items() if isinstance(one, StageError)}
    for name in REQUIRED_STRUCTURES:
        if name in lost:
            raise StageError(f"{name}: {lost[name]}") from lost[name]
    return {name: one for name, one in by_name.items() if isinstance(one, _Followed)}, lost


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


def _absent(label_counts: Integer, phases: Float, spacing_mm: float) -> dict[str, str]:
    """Structures that are not there in all phases, and where; StageError for one that must be."""
    voxel_ml = spacing_mm**3 / 1000
    absent = {}
    for name in STRUCTURES:
        counts = label_counts[:, [LABELS[label] for label in STRUCTURES[name]]].sum(axis=1)
        short, k = counts < FEWEST_VOXELS, int(counts.argmin())
        few = f"in phase {k} (at {phases[k]:.3f} of the beat) {counts[k]} voxels show it"
        if name in REQUIRED_STRUCTURES:
            _require_seen(label_counts, name)
            if short.any():
                raise StageError(
                    f"{name}: {few}, {FEWEST_VOXELS} or more are needed; look at the labels of "
                    "that phase"
                )
        elif short.all():
            absent[name] = "no phase shows it"
        elif short.any():
            absent[name] = f"not every phase shows it: {few}, {FEWEST_VOXELS} or more are needed"
        elif name in GROWN_ON and counts[k] < LEAST_KEPT * counts.max():
            largest = int(counts.argmax())
            absent[name] = (
                f"not every phase shows it whole: {voxel_ml * counts[k]:.1f} ml in phase {k} (at "
                f"{phases[k]:.3f} of the beat), {voxel_ml * counts[largest]:.1f} ml in phase "
                f"{largest}; slices that go on beyond the valves would show it"
            )
    return absent


def _require_seen(label_counts: Integer, name: str) -> None:
    for label in STRUCTURES[name]:
        if not label_counts[:, LABELS[label]].any():
            raise StageError(f"segmentation shows no {label} in any phase; look at its labels")


def _carried(body: Body, phases: Float, settings: SurfaceSettings) -> _Followed:
    """One structure's surface through the beat by its own shape."""
    reference = nearest_phase(phases, settings.reference_phase)
    template = extract_surface(body.levels[reference], settings.edge_mm)
    path = carry_through_cycle(template, body.levels, reference, phases)
    return _Followed(body, MovingSurface(path, template.triangles, phases))


def _drawn(
    one: _Followed, grown_on: Sequence[_Followed], phases: Float, settings: SurfaceSettings
) -> _Followed:
    """The same, sliding with the structures that it has grown on."""
    if not grown_on:
        return one
    reference, moving = nearest_phase(phases, settings.reference_phase), one.moving
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
    body = joined([part.body for part in parts], phases, settings, across)
    reference = nearest_phase(phases, settings.reference_phase)
    within_mm = _vertices_in(body, parts)
    template = extract_surface(body.levels[reference], settings.edge_mm)
    path = carry_along(template, body.levels, reference, phases, within_mm, across)
    carried = _Followed(body, MovingSurface(path, template.triangles, phases))
    return _finished(carried, phases, settings, across)


def _finished(
    one: _Followed, phases: Float, settings: SurfaceSettings, across: Across
) -> _Followed:
    """Smooth in time, sound in every phase, of the volume of the labels; StageError where not."""
    body, triangles = one.body, one.moving.triangles
    unfolder = make_unfolder(one.moving.at(nearest_phase(phases, settings.reference_phase)))
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
            apart = untangled(uncrossed(apart, triangles, level), triangles, level)
            vertices = restore_volume(apart, triangles, volume_mm3)
            crossing = int(np.count_nonzero(crossing_triangles(vertices, triangles)))
        return vertices, True, crossing

    places, mended, left = zip(*across(sound, range(len(path_mm))), strict=True)
    moving = MovingSurface(np.stack(places), triangles, phases)
    misfit_ml = _misfit_ml(moving, body.volumes_mm3)
    for k, vertices_mm in enumerate(moving.vertices_mm):
        # Smoothing in time may take it off again where labels leap.
        require_arrival(vertices_mm, body.levels[k], k, phases[k])
    off_mm = map(distance_off_mm, moving.vertices_mm, body.levels)
    far_mm = {k: round(one, 1) for k, one in enumerate(off_mm) if one > body.levels[k].spacing_mm}
    return _Followed(body, moving, sum(mended), sum(left), far_mm, misfit_ml)


def _pieces_ml(body: Body) -> dict[int, float]:
    """Phases in which much of a body's labels lies apart from the rest, and how much, ml."""
    each = zip(body.volumes_mm3, body.left_out_mm3, strict=True)
    return {
        k: round(apart_mm3 / 1000, 1)
        for k, (kept_mm3, apart_mm3) in enumerate(each)
        if apart_mm3 > VOLUME_TOLERANCE * (kept_mm3 + apart_mm3)
    }


def _misfit_ml(
    moving: MovingSurface, volumes_mm3: Sequence[float]
) -> dict[int, tuple[float, float]]:
    """Phases in which a surface encloses more or less than its labels do, and what both do, ml.

    StageError where it is quite another volume.
    """
    enclosed = np.array([moving.at(k).volume_mm3() for k in range(len(volumes_mm3))])
    off = np.abs(enclosed / np.array(volumes_mm3) - 1)
    k = int(off.argmax())
    # Written so that what is not a number fails too.
    if not off[k] <= LARGEST_MISFIT:
        raise StageError(
            f"its surface encloses {enclosed[k] / 1000:.1f} ml in phase {k} (at "
            f"{moving.phases[k]:.3f} of the beat), its labels {volumes_mm3[k] / 1000:.1f} ml: the "
            "shape of the reference phase could not be carried there; look at the labels of both"
        )
    return {
        one: (round(float(enclosed[one]) / 1000, 1), round(volumes_mm3[one] / 1000, 1))
        for one in np.flatnonzero(off > VOLUME_TOLERANCE).tolist()
    }


def _placed(followed: _Followed, mr_from_index: Float) -> MovingSurface:
    """The surface in LPS mm, its normals outward even when the grid is left-handed."""
    moving, body = followed.moving, followed.body
    index = moving.vertices_mm / body.levels[0].spacing_mm + body.first_index
    triangles = moving.triangles
    if np.linalg.det(mr_from_index[:3, :3]) < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return MovingSurface(transform_points(mr_from_index, index), triangles, moving.phases)
