"""Draw the moving surfaces on a grid as ultrasound would see them: dark blood, bright walls.

Coverage, not distance: a node holds the share of its surroundings that lies in blood. Blurred as
much as the images are smoothed it is the expected picture of blood up to two grey values. Where
blood meets tissue the wall mirrors sound: that echo is drawn apart, for its strength is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline.compiled import door
from pipeline.errors import InputError
from pipeline.field.motion import GAP, Motion, between
from pipeline.field.winding import crossing
from pipeline.geometry import Float, Float32, Grid, MovingSurface, Surface
from pipeline.imaging.cine import Cine
from pipeline.registration.cavity_muscle import VENTRICLES, CineOnGrid
from pipeline.registration.open_ends import OpenEnd, OpenLid, open_ends, open_lids

BLOOD = ("lv_endocardium", "rv_endocardium", "left_atrium", "right_atrium", "aorta")
"""The structures that hold blood."""

# The beam hears tissue this far beside it (standard deviation, there and back), and blood's echo is
# some 26 dB under muscle's: what is heard of a sixth of muscle is half as bright as all of it.
_BEAM_MM, _ECHO_OF_BLOOD = 1.0, 0.05
# Half the width of the bright line that an interface leaves: pulse, beam and slope together.
_WALL_MM = 2.0
# Room for the widest blur to fade.
_MARGIN_MM = 12.0
# Longer ways between phases are shortened: half-way between two pictures of blood a wall that moved
# by more than its blur is two faint walls.
_LONGEST_STEP = 0.06
# Phases that are worked on at the same time: NumPy and SciPy let others run while they count.
_THREADS = 2

_compiled = door(Path(__file__).parent, ("tissue_map", "../field/winding"), nogil=True, cache=True)


@dataclass(frozen=True, slots=True)
class TissueMap:
    """Blood and its walls around every node, through the beat."""

    share: Float32
    """``(phase, z, y, x, 2 or 3)``: share of blood (or how dark it looks, see `as_seen`), nearness
    of a wall, and, where images end inside a chamber, of what may be blood; each from 0 to 1."""

    phases: Float
    """``(phase,)`` in [0, 1), rising."""

    grid: Grid
    """Where the nodes are, in LPS millimetres."""


def draw_tissue(
    surfaces: Mapping[str, MovingSurface],
    spacing_mm: float,
    cine: Cine | None = None,
    muscle: bool = True,
) -> TissueMap:
    """Blood and walls on a grid that holds all cavities in all phases with a margin.

    Parameters
    ----------
    cine
        What the surfaces were found in: where its slices end inside a chamber, what lies beyond is
        open (`pipeline.registration.open_ends`). None: chambers end where their surfaces do, but
        for ventricles whose atria have no surface.
    muscle
        Whether what the cine shows of muscle inside the ventricles is no blood
        (`pipeline.registration.cavity_muscle`). Without a cine, or an epicardium to tell the grey
        of muscle by, the cavities are all blood.

    Raises
    ------
    InputError
        When there is no cavity, or surfaces and cine have not the same phases.
    """
    cavities = cavities_of(surfaces)
    phases = cavities[0].phases
    names = [name for name in BLOOD if name in surfaces]
    ends = [] if cine is None else open_ends(surfaces, cine)
    lids = open_lids(surfaces, ends)
    reached_mm = [lid.reached(surfaces[lid.ventricle].vertices_mm) for lid in lids]
    grid = _grid_around(cavities, spacing_mm, ends, reached_mm)
    beyond = [end.over(grid) for end in ends]
    share = np.empty((len(phases), *grid.shape, 3 if beyond or lids else 2), dtype=np.float32)
    seen = CineOnGrid.of(cine, phases, grid) if cine is not None and muscle else None
    grey = None if seen is None else _grey_of_muscle(seen, surfaces, names, grid)
    wall_nodes = (_WALL_MM / spacing_mm,) * 3

    def draw(index: int) -> None:
        covered = {name: coverage(surfaces[name].at(index), grid) for name in names}
        blood = np.minimum(sum(covered.values()), 1)
        if seen is not None and grey is not None:
            ventricles = np.minimum(sum(covered[name] for name in names if name in VENTRICLES), 1)
            blood = blood - seen.muscle_inside(index, blood, ventricles, grey)
        carried = np.zeros_like(blood)
        for end in beyond:
            carried = np.maximum(carried, end.carried(blood))
        soft = _softened(np.maximum(blood, carried), wall_nodes)
        wall = 4 * soft * (1 - soft)
        if lids:
            above = [_above(lid, surfaces[lid.ventricle].at(index), grid) for lid in lids]
            over = np.maximum(np.max(above, axis=0) - blood, 0)
            # A wall parts blood from tissue, a lid from what is open.
            tissue = 1 - soft - _softened(over, wall_nodes)
            wall = 4 * soft * np.maximum(tissue, 0)
            carried = np.maximum(carried, over)
        for end in beyond:
            blood, wall = np.where(end.outside, 0, blood), np.where(end.outside, 0, wall)
        share[index] = np.stack([blood, wall, carried][: share.shape[-1]], axis=-1)

    _in_turn(draw, len(phases))
    return TissueMap(share, phases, grid)


def _above(lid: OpenLid, ventricle: Surface, grid: Grid) -> Float32:
    """``(z, y, x)`` share of what a ventricle is carried on to through its lid, itself as well."""
    every = [coverage(one, grid) for one in lid.carried_to(ventricle)]
    return np.asarray(np.mean(every, axis=0), np.float32)


def _in_turn(work: Callable[[int], None], phases: int) -> None:
    """Do the work of every phase, some of them at the same time."""
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(work, range(phases)))


def _grey_of_muscle(
    seen: CineOnGrid, surfaces: Mapping[str, MovingSurface], names: Sequence[str], grid: Grid
) -> float | None:
    """Grey of the left ventricle's wall in the cine's first phase; None where that is unknown."""
    if "epicardium" not in surfaces or not any(name in VENTRICLES for name in names):
        return None
    blood = np.minimum(sum(coverage(surfaces[name].at(0), grid) for name in names), 1)
    return seen.grey_of_muscle(coverage(surfaces["epicardium"].at(0), grid), blood)


def cavities_of(surfaces: Mapping[str, MovingSurface]) -> list[MovingSurface]:
    """The surfaces that hold blood.

    Raises
    ------
    InputError
        When there is none, or they have not the same phases.
    """
    names = [name for name in BLOOD if name in surfaces]
    if not names:
        raise InputError(
            f"registration needs one or more of the surfaces {', '.join(BLOOD)}; "
            f"got {', '.join(sorted(surfaces)) or 'none'}"
        )
    phases = surfaces[names[0]].phases
    odd = [name for name in names if not np.array_equal(surfaces[name].phases, phases)]
    if odd:
        raise InputError(
            f"surfaces must share their phases; {', '.join(odd)} differ from {names[0]}"
        )
    return [surfaces[name] for name in names]


def in_short_steps(surfaces: Mapping[str, MovingSurface]) -> dict[str, MovingSurface]:
    """The surfaces at more phases where these lie further than 0.06 of a beat apart.

    In between, vertices follow their own periodic spline. Two phases, and those with a gap (as of a
    cine that ends before the beat does), tell no way: such surfaces stay as they are.
    """
    return {name: _in_short_steps(one) for name, one in surfaces.items()}


def _in_short_steps(surface: MovingSurface) -> MovingSurface:
    longest = np.diff(surface.phases, append=surface.phases[0] + 1).max()
    count = math.ceil(longest / _LONGEST_STEP)
    even = longest * len(surface.phases) <= GAP
    motion = Motion.of(surface) if count > 1 and even else None
    if motion is None:
        return surface
    moments = np.sort(between(surface.phases, count) % 1.0)
    places_mm = np.stack([motion.at(moment).vertices_mm for moment in moments])
    return MovingSurface(places_mm, surface.triangles, moments)


def as_seen(tissue: TissueMap) -> TissueMap:
    """The map with blood as dark as a picture of log-compressed echoes shows it: 0 like muscle.

    The logarithm of an echo is not linear in the share of muscle that gives it: where a beam of
    finite width touches a wall, blood looks like muscle already, and cavities look smaller.
    """
    width = [_BEAM_MM / length_mm for length_mm in tissue.grid.spacing_mm[::-1]]
    share = tissue.share.copy()

    def see(index: int) -> None:
        for part in range(0, share.shape[-1], 2):
            blood = _softened(tissue.share[index, ..., part], width)
            dark = np.log(np.maximum(1 - blood, 0) + _ECHO_OF_BLOOD) / np.log(_ECHO_OF_BLOOD)
            share[index, ..., part] = np.clip(dark, 0, 1)

    _in_turn(see, len(share))
    return TissueMap(share, tissue.phases, tissue.grid)


def blurred(tissue: TissueMap, sigma_mm: float) -> TissueMap:
    """The map seen through a Gaussian of standard deviation ``sigma_mm``.

    Nodes closer together than 0.8 of it are thinned: straight lines between nodes so far apart are
    off by 2 % of a step from blood to wall at most, and what stays fits the processor's cache.
    """
    grid = tissue.grid
    sigma = [sigma_mm / length_mm for length_mm in grid.spacing_mm[::-1]]
    every = max(1, int(0.8 * min(sigma)))
    kept = np.empty_like(tissue.share[:, ::every, ::every, ::every])

    def blur(index: int) -> None:
        soft = _softened(tissue.share[index], sigma, truncate=3)
        kept[index] = soft[::every, ::every, ::every]

    _in_turn(blur, len(kept))
    x_mm, y_mm, z_mm = (every * length_mm for length_mm in grid.spacing_mm)
    coarser = Grid(kept.shape[1:4], grid.origin_mm, (x_mm, y_mm, z_mm))
    return TissueMap(kept, tissue.phases, coarser)


def coverage(surface: Surface, grid: Grid) -> Float32:
    """Share of each node's cell that the closed surface encloses, ``(z, y, x)`` from 0 to 1.

    Rays along an axis through the nodes count their way in and out, exactly along the ray and by
    sampling across it; the mean over the three axes treats all directions alike.
    """
    vertices = (surface.vertices_mm - grid.origin_mm) / np.array(grid.spacing_mm)
    triangles = np.ascontiguousarray(surface.triangles, dtype=np.int64)
    # The last cell that is crossed may be the one after the last vertex; beyond, all is outside.
    counts = np.array(grid.shape[::-1])
    first = np.clip(np.floor(vertices.min(axis=0)).astype(int), 0, counts - 1)
    last = np.clip(np.ceil(vertices.max(axis=0)).astype(int) + 2, first + 1, counts)
    vertices -= first
    covered = np.zeros(grid.shape, dtype=np.float32)
    total = covered[tuple(slice(first[axis], last[axis]) for axis in (2, 1, 0))]
    for turn in range(3):
        # A cyclic order of the axes keeps the triangles' orientation.
        axes = np.roll(np.arange(3), -turn)
        changes = np.zeros((last - first)[axes], dtype=np.float32)
        _mark_crossings(np.ascontiguousarray(vertices[:, axes]), triangles, changes)
        inside = np.clip(np.cumsum(changes, axis=0), 0, 1)
        total += inside.transpose([int(np.flatnonzero(axes == axis)[0]) for axis in (2, 1, 0)])
    total /= 3
    return covered


def _softened(values: Float32, sigma: Sequence[float], truncate: float = 4.0) -> Float32:
    """``(z, y, x)`` or ``(z, y, x, part)`` values seen through a Gaussian, 0 beyond the grid.

    ``sigma``: standard deviations in nodes along z, y and x; cut off at ``truncate`` of them.
    """
    reaches = (int(truncate * each + 0.5) for each in sigma)
    z, y, x = map(cv2.getGaussianKernel, (2 * reach + 1 for reach in reaches), sigma)
    planes = np.stack(
        [cv2.sepFilter2D(plane, -1, x, y, borderType=cv2.BORDER_CONSTANT) for plane in values]
    )
    along = planes.reshape(len(planes), -1)
    soft = cv2.sepFilter2D(along, -1, np.ones(1), z, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(soft.reshape(values.shape), np.float32)


def _grid_around(
    surfaces: Sequence[MovingSurface],
    spacing_mm: float,
    ends: Sequence[OpenEnd],
    reached_mm: Sequence[Float],
) -> Grid:
    points_mm = np.concatenate([one.vertices_mm.reshape(-1, 3) for one in surfaces])
    points_mm = np.concatenate([points_mm, *(one.reached(points_mm) for one in ends), *reached_mm])
    lower, upper = points_mm.min(axis=0) - _MARGIN_MM, points_mm.max(axis=0) + _MARGIN_MM
    x, y, z = (int(count) for count in np.ceil((upper - lower) / spacing_mm) + 1)
    origin_mm = (float(lower[0]), float(lower[1]), float(lower[2]))
    return Grid((z, y, x), origin_mm, (spacing_mm, spacing_mm, spacing_mm))


@_compiled
def _step(changes, x, y, z, sign):  # type: ignore[no-untyped-def]
    """Let the share rise by ``sign`` from position ``x`` on along one ray."""
    cell = math.floor(x + 0.5)
    passed = x + 0.5 - cell
    if cell < 0:
        changes[0, y, z] += sign
    elif cell < changes.shape[0]:
        changes[cell, y, z] += sign * (1 - passed)
        if cell + 1 < changes.shape[0]:
            changes[cell + 1, y, z] += sign * passed


@_compiled
def _mark_triangle(vertices, a, b, c, bounds, changes):  # type: ignore[no-untyped-def]
    """Steps of one triangle on the rays that cross it."""
    for y in range(bounds[0], bounds[1] + 1):
        for z in range(bounds[2], bounds[3] + 1):
            direction, x = crossing(vertices, a, b, c, float(y), float(z))
            if direction != 0:
                # Along the ray an outward normal that points back is the way in.
                _step(changes, x, y, z, -float(direction))


@_compiled
def _mark_crossings(vertices, triangles, changes):  # type: ignore[no-untyped-def]
    """Add all triangles' steps to the running sums along axis 0 of ``changes``."""
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        ya, yb, yc = vertices[a, 1], vertices[b, 1], vertices[c, 1]
        za, zb, zc = vertices[a, 2], vertices[b, 2], vertices[c, 2]
        bounds = (
            max(0, math.ceil(min(ya, yb, yc))),
            min(changes.shape[1] - 1, math.floor(max(ya, yb, yc))),
            max(0, math.ceil(min(za, zb, zc))),
            min(changes.shape[2] - 1, math.floor(max(za, zb, zc))),
        )
        _mark_triangle(vertices, a, b, c, bounds, changes)
