"""Bake closed surfaces of one's own, from CT or any other tool, without the stages before."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.sparse.csgraph import connected_components

from pipeline import INTENDED_USE, __version__
from pipeline.config import Settings
from pipeline.doubts import few_phases
from pipeline.errors import InputError, StageError
from pipeline.field.bake import SurfaceSeries, bake_field
from pipeline.field.certificate import BAND_MM, certify, require_bounds
from pipeline.field.files import read_metadata
from pipeline.field.fixture import BakeSettings, Fixture
from pipeline.field.reader import ForceField
from pipeline.field.winding import winding_number
from pipeline.geometry import Surface
from pipeline.progress import Progress
from pipeline.publish import only_run_in, publishing
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.mesh import adjacency
from pipeline.surface_folders import OwnSurfaces, odd_sizes, read_own_surfaces

SAME_VOLUME, ELSEWHERE_MM = 1e-3, 0.01
"""Surfaces that differ from those baked by a larger share of volume, or lie farther off, are other
ones: single precision, in which files may hold them, does less by far."""


def bake_own_surfaces(
    folder: Path, out: Path, settings: Settings, progress: Progress | None = None
) -> Path:
    """Bake the surfaces in a folder into ``out/field.zarr``, whole or not at all; return it.

    Raises
    ------
    InputError
        When a file cannot be used, a fixture's surface is missing, or ``out`` not written; or the
        field is out of its bounds and a surface passes through itself, or a shell of it faces the
        wrong way, with the place.
    StageError
        When the field is out of its bounds and no surface is to blame.
    """
    own = read_own_surfaces(folder)
    field = out / "field.zarr"
    transform = own.timing.mr_from_tracker
    with only_run_in(out), publishing(field) as partial:
        # The store makes its own folder.
        partial.rmdir()
        try:
            bake_field(
                partial,
                own.surfaces,
                _fixtures_for(own.surfaces, settings),
                settings.bake,
                mr_from_tracker=None if transform is None else np.array(transform),
                rr_s=own.timing.rr_s,
                source={
                    "use": INTENDED_USE,
                    "surfaces": own.digests,
                    "beatfield": __version__,
                    "bake": settings.bake.model_dump(mode="json"),
                },
                doubts_of=lambda found: [*odd_sizes(own.surfaces), *few_phases(found)],
                progress=progress,
            )
        except StageError as error:
            cause = _cause(own.surfaces)
            if not cause:
                raise
            raise InputError(f"{error}. But no spacing will do: {cause}") from error
    return field


def what_was_baked(field: Path) -> list[str]:
    """How exact a field is, and what its fixtures do: some may be defaults that nobody wrote."""
    baked = ForceField.open(field)
    off_mm, about_mm = (baked.accuracy[f"{name}_error_p99_mm"] for name in ("surface", "distance"))
    told = [
        f"phases    {_timing_of(baked)}",
        f"accuracy  {off_mm:.2g} mm off on the surfaces at most and {about_mm:.2g} mm within "
        f"{BAND_MM:g} mm of them, in 99 places of 100",
    ]
    told += [
        f"fixture   {name}: {one.kind.replace('_', ' ')}{f' {one.side}' if one.side else ''} of "
        f"{one.structure}, {one.f_max_n:g} N at most, next to nothing within "
        f"{one.resolved_gamma_mm:.1f} mm, for the {one.device.name}"
        for name, one in baked.fixtures.items()
    ]
    return told + [f"doubtful  {text}" for text in baked.source["doubts"]]


def _timing_of(baked: ForceField) -> str:
    """How many phases, and what the field does not know of time and place."""
    count = len(baked.phases)
    if count == 1:
        said = "1, so nothing moves"
    elif np.allclose(baked.phases, np.arange(count) / count, atol=1e-6):
        said = f"{count}, evenly spaced from 0"
    else:
        said = ", ".join(f"{phase:.3f}".rstrip("0").rstrip(".") for phase in baked.phases)
    unknown = [] if baked.rr_s or count == 1 else ["the length of the beat (rr_s)"]
    unknown += [] if baked.mr_from_tracker is not None else ["a tracker (mr_from_tracker)"]
    told = f"; {' and '.join(unknown)} not known: phases.json may tell" if unknown else ""
    return said + told


def _cause(surfaces: Mapping[str, SurfaceSeries]) -> str:
    """Where a surface has no inside that a sign could tell; empty where all have."""
    for name, series in surfaces.items():
        for phase, surface in enumerate(series.surfaces):
            crossing = crossing_triangles(surface.vertices_mm, surface.triangles)
            if crossing.any():
                place_mm = surface.vertices_mm[surface.triangles[crossing.argmax()]].mean(axis=0)
                x, y, z = (f"{one:.1f}" for one in place_mm)
                return (
                    f"{name} passes through itself in phase {phase} ("
                    f"{np.count_nonzero(crossing)} triangles, one at {x} {y} {z} mm); unite its "
                    "parts, or remesh it"
                )
            shell = _wrong_shell(surface)
            if shell:
                return f"{name} in phase {phase} has {shell}"
    return ""


def _wrong_shell(surface: Surface) -> str:
    """A shell that does not bound what the others leave: inside one, facing the same way."""
    count, part = connected_components(
        adjacency(surface.triangles, len(surface.vertices_mm)), directed=False
    )
    for number in range(count if count > 1 else 0):
        own = part[surface.triangles[:, 0]] == number
        if not own.any():
            continue
        outwards = Surface(surface.vertices_mm, surface.triangles[own]).volume_mm3() > 0
        place_mm = surface.vertices_mm[surface.triangles[own][0, 0]]
        corners_mm = surface.vertices_mm[surface.triangles[~own]] - place_mm
        within = round(winding_number(corners_mm))
        if within != (0 if outwards else 1):
            facing = "outwards, within another" if outwards else "inwards, within no other"
            x, y, z = (f"{one:.1f}" for one in place_mm)
            return (
                f"a shell (at {x} {y} {z} mm) that faces {facing}: take it out, or turn its normals"
            )
    return ""


def measure_field(path: Path, folder: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Measure a baked field anew against the surfaces in a folder.

    Parameters
    ----------
    path
        The ``field.zarr`` folder.
    folder
        Holds the surfaces that it was baked from, as ``read_own_surfaces`` reads them; others
        beside them are left alone.
    progress
        Called with (done, total) while phases are measured.

    Returns
    -------
    A certificate like the one that the field carries.

    Raises
    ------
    InputError
        When the field cannot be opened, or a surface is missing or none of those it was baked from.
    StageError
        When the field is out of the bounds that it was baked to, or else the default ones.
    """
    field = ForceField.open(path)
    settings = _baked_with(field)
    count = len(field.phases)
    own = read_own_surfaces(folder, field.structures, count)
    _require_same_surfaces(folder, own, path, field)
    surfaces = {
        name: SurfaceSeries(series.surfaces, field.phases) for name, series in own.surfaces.items()
    }
    done = itertools.count(1)
    accuracy = certify(
        field, surfaces, settings.samples, lambda: progress(next(done), count) if progress else None
    )
    said, found = (
        max(float(one.get(key, 0)) for key in ("node_error_near_mm", "node_error_far_mm"))
        for one in (field.accuracy, accuracy)
    )
    if found > max(ELSEWHERE_MM, 2 * said):
        raise InputError(
            f"{folder}: the surfaces lie up to {found:.2f} mm beside what {path} holds, {said:.1g} "
            "mm when it was baked; verify needs the very ones that it was baked from"
        )
    require_bounds(accuracy, settings.bounds, min(field.grid.spacing_mm))
    return accuracy


def _baked_with(field: ForceField) -> BakeSettings:
    """How a field is to be measured: as its source says, or by default where that says nothing
    that this version knows."""
    said = field.source.get("bake")
    told = said if isinstance(said, dict) else {}
    known = {name: told[name] for name in ("samples", "bounds") if told.get(name) is not None}
    try:
        return BakeSettings.model_validate(known)
    except ValidationError:
        return BakeSettings()


def _require_same_surfaces(folder: Path, own: OwnSurfaces, path: Path, field: ForceField) -> None:
    """Refuse surfaces that the field was not baked from, as far as sizes and places tell."""
    parts = read_metadata(path).structures
    wanted = f"verify needs the surfaces that {path} was baked from"
    for name, series in own.surfaces.items():
        known = zip(parts[name].triangles, parts[name].volume_ml, strict=True)
        for index, (surface, (triangles, volume_ml)) in enumerate(
            zip(series.surfaces, known, strict=True)
        ):
            here_ml = surface.volume_mm3() / 1000
            same = abs(here_ml - volume_ml) <= SAME_VOLUME * volume_ml
            if len(surface.triangles) != triangles or not same:
                raise InputError(
                    f"{folder}: {name}, phase {index}: {len(surface.triangles)} triangles around "
                    f"{here_ml:.2f} ml, not {triangles} around {volume_ml:.2f} ml; {wanted}"
                )
            if not field.contains(surface.vertices_mm).all():
                raise InputError(
                    f"{folder}: {name}, phase {index}: reaches out of the field's grid; {wanted}"
                )


def _fixtures_for(surfaces: Collection[str], settings: Settings) -> dict[str, Fixture]:
    """The fixtures that a configuration asks for.

    Where none is asked for, every surface gets one: its default fixtures if it has any, or a
    guidance to it.
    """
    if "fixtures" in settings.model_fields_set:
        return settings.fixtures
    chosen = {name: one for name, one in settings.fixtures.items() if one.structure in surfaces}
    covered = {one.structure for one in chosen.values()}
    return chosen | {
        f"{name}_guidance": Fixture(structure=name, kind="guidance", gamma_mm=3.0, m=2, f_max_n=2.0)
        for name in surfaces
        if name not in covered
    }
