"""Turn moving surfaces into the grids that a force server loads."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.field.certificate import certify, require_bounds
from pipeline.field.distance import (
    distance_of_closed,
    require_no_open_edge,
    require_outward,
    require_usable_vertices,
)
from pipeline.field.fixture import BakeSettings, Fixture
from pipeline.field.metadata import (
    FieldMetadata,
    FixturePart,
    GridPart,
    StructurePart,
    require_name,
    require_phases,
)
from pipeline.field.motion import BeatingSurface
from pipeline.field.potential import offence, potential
from pipeline.field.reader import ForceField
from pipeline.field.spline import space_coefficients
from pipeline.field.store import FieldWriter
from pipeline.field.surface_fit import fit_to_surface
from pipeline.geometry import Float, Float32, Grid, Surface, require_rigid
from pipeline.progress import Progress


@dataclass(frozen=True, slots=True)
class SurfaceSeries:
    """One surface through the beat, where triangles may differ from phase to phase.

    Raises
    ------
    InputError
        When there are not as many surfaces as phases.
    """

    surfaces: tuple[Surface, ...]
    """One a phase."""

    phases: Float
    """``(phase,)`` in [0, 1), rising."""

    def __post_init__(self) -> None:
        if len(self.surfaces) != len(self.phases):
            raise InputError(f"{len(self.surfaces)} surfaces for {len(self.phases)} phases")

    def at(self, index: int) -> Surface:
        """The surface at stored phase number ``index``."""
        return self.surfaces[index]


def bake_field(
    out: Path,
    surfaces: Mapping[str, BeatingSurface],
    fixtures: Mapping[str, Fixture],
    settings: BakeSettings,
    *,
    mr_from_tracker: Float | None = None,
    rr_s: float | None = None,
    source: Mapping[str, Any] | None = None,
    doubts_of: Callable[[Mapping[str, Any]], Sequence[str]] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Bake distances and potentials of all phases into a new store, and measure it.

    Only surfaces that a fixture uses, or that ``settings.structures`` names, are baked. One phase
    is in memory at a time; while splines are fitted, all phases of a box about each surface,
    several times over. A failure leaves a store without manifest, which is none: write into a
    folder that is renamed when all is done.

    Parameters
    ----------
    out
        Where the store goes; must not exist.
    surfaces
        Moving surfaces by structure, all with the same phases, in LPS mm of the MR frame.
    fixtures
        By name; the first is the default of every question to the field.
    settings
        Grid, further structures, and how finely to measure.
    mr_from_tracker
        4x4, where the tracker is registered.
    rr_s
        Mean duration of a heartbeat, where it is known.
    source
        What the surfaces were made from, to be stored in the field; must be JSON.
    doubts_of
        Sentences on what speaks against the field, of its certificate; stored as ``source``'s
        ``doubts``.
    progress
        Called with (done, total) while phases are baked and measured.

    Returns
    -------
    The accuracy certificate that the field also carries.

    Raises
    ------
    InputError
        When there is no fixture, a fixture's surface is missing, a name can be no folder, a surface
        is open or faces inwards, or has vertices that are not finite or of no triangle, phases
        differ, do not rise in [0, 1) or lie nearer than 0.001, ``mr_from_tracker`` is not rigid, or
        the field would be larger than the settings allow.
    pydantic.ValidationError
        When ``rr_s`` is not above 0.
    StageError
        When the finished field is not as exact as ``settings.bounds`` demand.
    """
    chosen = _choose(surfaces, fixtures, settings)
    phases = _shared_phases(chosen)
    if mr_from_tracker is not None:
        require_rigid(mr_from_tracker, "mr_from_tracker")
    structures = {name: _describe(name, moving) for name, moving in chosen.items()}
    grid = grid_around(list(chosen.values()), settings)
    metadata = FieldMetadata(
        phases=phases,
        rr_s=rr_s,
        mr_from_tracker=None if mr_from_tracker is None else mr_from_tracker.tolist(),
        grid=GridPart(shape_zyx=grid.shape, origin_mm=grid.origin_mm, spacing_mm=grid.spacing_mm),
        structures=structures,
        fixtures={name: FixturePart.of(name, fixture) for name, fixture in fixtures.items()},
        source=dict(source or {}),
        accuracy={},
    )
    _require_room(metadata, settings)
    writer = FieldWriter(out, metadata)
    done = itertools.count(1)

    def step() -> None:
        if progress:
            progress(next(done), 2 * len(phases))

    for index in range(len(phases)):
        for name, values in _arrays(index, chosen, fixtures, grid):
            writer.write(name, index, values)
        step()
    writer.solve_splines_in_time()
    metadata = _fit(writer, metadata, chosen, grid, settings.fit_rounds)
    accuracy = certify(ForceField(out, metadata), chosen, settings.samples, step)
    require_bounds(accuracy, settings.bounds, settings.spacing_mm)
    told = {"doubts": list(doubts_of(accuracy))} if doubts_of else {}
    told_of = {"accuracy": accuracy, "source": metadata.source | told}
    writer.finish(metadata.model_copy(update=told_of))
    return accuracy


def _fit(
    writer: FieldWriter,
    metadata: FieldMetadata,
    surfaces: Mapping[str, BeatingSurface],
    grid: Grid,
    rounds: int,
) -> FieldMetadata:
    """Bring the splines' zeros to the surfaces; the description with what that changed."""
    phases = np.array(metadata.phases)
    structures = {
        name: part.model_copy(
            update={
                "correction_mm": fit_to_surface(
                    writer.splines(name), phases, grid, surfaces[name], rounds
                )
            }
        )
        for name, part in metadata.structures.items()
    }
    return metadata.model_copy(update={"structures": structures})


def _arrays(
    index: int, surfaces: Mapping[str, BeatingSurface], fixtures: Mapping[str, Fixture], grid: Grid
) -> Iterator[tuple[str, Float32]]:
    """All arrays of one phase, by their path in the store."""
    for structure, moving in surfaces.items():
        distance_mm = distance_of_closed(moving.at(index), grid)
        yield f"distance/{structure}", distance_mm
        yield (
            f"spline/{structure}",
            space_coefficients(distance_mm.astype(np.float64)).astype(np.float32),
        )
        for name, fixture in fixtures.items():
            if fixture.structure == structure:
                yield f"potential/{name}", potential_grid(distance_mm, fixture)


def potential_grid(distance_mm: Float32, fixture: Fixture) -> Float32:
    """Potential of a fixture on a grid of distances, rounded to what is stored."""
    q_mm = offence(distance_mm.astype(np.float64), fixture.side_code)
    rounded: Float32 = potential(q_mm, fixture.resolved_delta_mm, fixture.m).astype(np.float32)
    return rounded


def grid_around(surfaces: Sequence[BeatingSurface], settings: BakeSettings) -> Grid:
    """The smallest grid that holds all surfaces in all phases with the margin."""
    every = [
        moving.at(index).vertices_mm for moving in surfaces for index in range(len(moving.phases))
    ]
    low = np.min([vertices.min(axis=0) for vertices in every], axis=0) - settings.margin_mm
    high = np.max([vertices.max(axis=0) for vertices in every], axis=0) + settings.margin_mm
    steps = np.ceil((high - low) / settings.spacing_mm).astype(int)
    # What the last step reaches too far is shared between both sides.
    origin = low - 0.5 * (steps * settings.spacing_mm - (high - low))
    nz, ny, nx = (int(count) + 1 for count in steps[::-1])
    x, y, z = (float(value) for value in origin)
    return Grid((nz, ny, nx), (x, y, z), (settings.spacing_mm,) * 3)


def _choose(
    surfaces: Mapping[str, BeatingSurface],
    fixtures: Mapping[str, Fixture],
    settings: BakeSettings,
) -> dict[str, BeatingSurface]:
    if not fixtures:
        raise InputError("no fixture is given; a force field needs at least one")
    wanted = {f"fixture {name}": fixture.structure for name, fixture in fixtures.items()}
    wanted |= {f"bake.structures {name}": name for name in settings.structures}
    missing = [f"{who} needs {name!r}" for who, name in wanted.items() if name not in surfaces]
    if missing:
        existing = ", ".join(sorted(surfaces)) or "none"
        raise InputError(
            f"{'; '.join(missing)}; the surfaces that exist are {existing}: change the fixture's "
            "structure, or supply that surface"
        )
    for name in fixtures:
        require_name(name, "fixture")
    return {name: surfaces[name] for name in dict.fromkeys(wanted.values())}


def _shared_phases(surfaces: Mapping[str, BeatingSurface]) -> list[float]:
    first_name, first = next(iter(surfaces.items()))
    for name, moving in surfaces.items():
        if not np.array_equal(moving.phases, first.phases):
            raise InputError(
                f"{name} has {len(moving.phases)} phases, {first_name} {len(first.phases)}, and "
                "all surfaces need the same ones"
            )
    phases: list[float] = np.asarray(first.phases, dtype=np.float64).tolist()
    try:
        require_phases(phases, "phases")
    except ValueError as error:
        raise InputError(str(error)) from error
    return phases


def _describe(name: str, moving: BeatingSurface) -> StructurePart:
    """Refuse surfaces that cannot be baked; say what the others are."""
    require_name(name, "structure")
    each = [moving.at(index) for index in range(len(moving.phases))]
    for index, surface in enumerate(each):
        where = f"{name}, phase {index}"
        require_usable_vertices(surface, where)
        # Which edges are shared does not depend on where the vertices are.
        if index == 0 or surface.triangles is not each[index - 1].triangles:
            require_no_open_edge(surface, where)
            _require_no_stray_vertex(surface, where)
        require_outward(surface, where)
    return StructurePart(
        path=f"distance/{name}",
        spline=f"spline/{name}",
        triangles=[len(surface.triangles) for surface in each],
        volume_ml=[surface.volume_mm3() / 1000 for surface in each],
    )


def _require_no_stray_vertex(surface: Surface, where: str) -> None:
    """The fit would pull the field to zero there, and the certificate would ask for that zero."""
    uses = np.bincount(surface.triangles.ravel(), minlength=len(surface.vertices_mm))
    if not uses.all():
        raise InputError(
            f"{where}: {np.count_nonzero(uses == 0)} vertices belong to no triangle, the first is "
            f"number {np.argmin(uses)}; leave them out"
        )


def _require_room(metadata: FieldMetadata, settings: BakeSettings) -> None:
    nodes = math.prod(metadata.grid.shape_zyx)
    size_mb = 4e-6 * nodes * len(metadata.phases) * len(metadata.arrays)
    if size_mb > settings.largest_store_mb:
        spacing_mm = settings.spacing_mm * (size_mb / settings.largest_store_mb) ** (1 / 3)
        raise InputError(
            f"bake: the field would take {size_mb:.0f} MB with spacing_mm = "
            f"{settings.spacing_mm:g}, more than largest_store_mb = "
            f"{settings.largest_store_mb:g}; spacing_mm = {np.ceil(spacing_mm * 20) / 20:g} "
            "would do, or raise the limit"
        )
