"""Bake closed surfaces of one's own, from CT or any other tool, without the stages before."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError
from scipy.sparse.csgraph import connected_components

from pipeline import INTENDED_USE, __version__
from pipeline.config import Settings
from pipeline.errors import InputError, StageError
from pipeline.field.bake import SurfaceSeries, bake_field
from pipeline.field.certificate import BAND_MM, certify, require_bounds
from pipeline.field.distance import require_closed
from pipeline.field.files import read_metadata
from pipeline.field.fixture import BakeSettings, Fixture
from pipeline.field.metadata import LONGEST_NAME, Transform, require_name, require_phases
from pipeline.field.reader import ForceField
from pipeline.field.winding import winding_number
from pipeline.geometry import Surface, require_rigid
from pipeline.meshes import MESH_ENDINGS, read_mesh
from pipeline.progress import Progress
from pipeline.publish import only_run_in, publishing
from pipeline.regular_files import require_no_device
from pipeline.sealing import sha256_of
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.mesh import adjacency
from pipeline.validation import Section, describe_validation, each_key_once

SMALLEST_MM, LARGEST_MM = 1.0, 2000.0
"""From end to end; a heart in metres or micrometres lies outside."""

SAME_VOLUME, ELSEWHERE_MM = 1e-3, 0.01
"""Surfaces that differ from those baked by a larger share of volume, or lie farther off, are other
ones: single precision, in which files may hold them, does less by far."""

NUMBERED = re.compile(r"(?P<structure>.+)_(?P<number>\d+)")


class Timing(Section):
    """What ``phases.json`` beside the surfaces may say."""

    phases: tuple[float, ...] | None = None
    """Rising within [0, 1), one a file; evenly spaced from 0 when left out."""

    rr_s: float | None = Field(default=None, gt=0, le=60)
    """Mean duration of a heartbeat, or of what else makes the surfaces move: seconds."""

    mr_from_tracker: Transform | None = None
    """4x4, where a tracker is registered to the surfaces' frame."""


@dataclass(frozen=True, slots=True)
class OwnSurfaces:
    """What a folder of surfaces holds."""

    surfaces: dict[str, SurfaceSeries]
    """By structure."""

    timing: Timing
    """As given, phases resolved."""

    digests: dict[str, str]
    """SHA-256 of every surface file."""


def bake_own_surfaces(
    folder: Path,
    out: Path,
    settings: Settings,
    progress: Progress | None = None,
) -> Path:
    """Bake the surfaces in a folder into ``out/field.zarr``, whole or not at all; return it.

    Raises
    ------
    InputError
        When a file cannot be used, a fixture's surface is missing, or ``out`` not written.
    StageError
        When the field is out of its bounds, with the place where a surface crosses itself if one
        does.
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
    return [
        f"phases    {_timing_of(baked)}",
        f"accuracy  {off_mm:.2g} mm off on the surfaces at most and {about_mm:.2g} mm within "
        f"{BAND_MM:g} mm of them, in 99 places of 100",
    ] + [
        f"fixture   {name}: {one.kind.replace('_', ' ')}{f' {one.side}' if one.side else ''} of "
        f"{one.structure}, {one.f_max_n:g} N at most, next to nothing within "
        f"{one.resolved_gamma_mm:.1f} mm, for the {one.device.name}"
        for name, one in baked.fixtures.items()
    ]


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
        field,
        surfaces,
        settings.samples,
        lambda: progress(next(done), count) if progress else None,
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
    known = (
        {name: said.get(name) for name in ("samples", "bounds")} if isinstance(said, dict) else {}
    )
    try:
        return BakeSettings.model_validate({k: one for k, one in known.items() if one is not None})
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


def read_own_surfaces(
    folder: Path, only: Collection[str] | None = None, phase_count: int | None = None
) -> OwnSurfaces:
    """Read ``<structure>_000.vtp``, ``<structure>_001.vtp`` ... or ``<structure>/000.vtp`` ...

    One file a phase, VTP, STL or PLY, in LPS mm, closed, normals outwards. A structure with a
    single file, numbered or not, does not move. Triangles may differ between phases. With
    ``only``, those structures are read, and all of them must be there. ``phase_count`` is that of
    the longest of them, if it is not known otherwise.

    Raises
    ------
    InputError
        When there are none, numbers do not run from 0, phases disagree, or a surface cannot be
        read, is open, or faces inwards. Nothing is repaired.
    """
    files = _files_by_structure(folder)
    if only is not None:
        missing = sorted(set(only) - set(files))
        if missing:
            raise InputError(f"{folder}: has no {', '.join(missing)}; it has {', '.join(files)}")
        files = {name: files[name] for name in only}
    counts = {name: len(paths) for name, paths in files.items()}
    phase_count = phase_count or max(counts.values())
    odd = [f"{name} has {n}" for name, n in counts.items() if n not in (1, phase_count)]
    if odd:
        raise InputError(
            f"{folder}: {', '.join(odd)} files, for {phase_count} phases; every structure needs "
            "one a phase, or a single one if it does not move"
        )
    timing = _timing(folder / "phases.json", phase_count)
    phases = np.array(timing.phases)
    series = {}
    for name, paths in files.items():
        each = [_closed(path) for path in paths]
        # The same object for every phase of a structure that rests costs nothing.
        series[name] = SurfaceSeries(tuple(each * (phase_count // len(each))), phases)
    digests = {
        path.relative_to(folder).as_posix(): sha256_of(path)
        for paths in files.values()
        for path in paths
    }
    return OwnSurfaces(series, timing, digests)


def _closed(path: Path) -> Surface:
    surface = read_mesh(path)
    if not np.isfinite(surface.vertices_mm).all():
        raise InputError(f"{path}: has vertices that are no numbers; export the surface again")
    size_mm = float(np.ptp(surface.vertices_mm, axis=0).max())
    if not SMALLEST_MM <= size_mm <= LARGEST_MM:
        raise InputError(
            f"{path}: measures {size_mm:.3g} mm from end to end, surfaces between {SMALLEST_MM:g} "
            f"and {LARGEST_MM:g} mm are taken; is it in millimetres?"
        )
    require_closed(surface, str(path))
    return surface


def _files_by_structure(folder: Path) -> dict[str, list[Path]]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give one that holds closed surfaces")
    found: dict[str, dict[int, Path]] = {}
    for path in sorted([*folder.iterdir(), *folder.glob("*/*")]):
        if path.suffix.lower() not in MESH_ENDINGS or not path.is_file():
            continue
        if path.name.startswith("."):
            continue
        structure, number = _place(folder, path)
        phases = found.setdefault(structure, {})
        if number in phases:
            raise InputError(f"{path}: {phases[number]} is the same structure and phase; keep one")
        beside = next(iter(phases.values()), path)
        if beside.parent != path.parent:
            raise InputError(
                f"{path}: {beside} is of the same structure and lies elsewhere; name all its files "
                "in one way"
            )
        phases[number] = path
    if not found:
        raise InputError(
            f"{folder}: holds no {', '.join(MESH_ENDINGS)} files; name them STRUCTURE_000.vtp, "
            "STRUCTURE_001.vtp ..., one a phase; save others, such as OBJ, as one of these"
        )
    for structure, phases in found.items():
        # A fixture of its own is called after it.
        require_name(structure, f"{folder}: structure", LONGEST_NAME - len("_guidance"))
        missing = sorted(set(range(len(phases))) - set(phases))
        if missing:
            raise InputError(
                f"{folder}: {structure} has {len(phases)} files, but none numbered {missing[0]}; "
                "number the phases 0, 1, 2 ... without a gap"
            )
    return {name: [phases[k] for k in sorted(phases)] for name, phases in found.items()}


def _place(folder: Path, path: Path) -> tuple[str, int]:
    """Structure and phase number of a file, from its name or its folder's."""
    if path.parent != folder:
        if not path.stem.isdecimal():
            raise InputError(
                f"{path}: in a structure's folder, name files 000, 001 ... by phase; if files are "
                f"named by structure and phase, give {path.parent} itself"
            )
        return path.parent.name, int(path.stem)
    numbered = NUMBERED.fullmatch(path.stem)
    if numbered:
        return numbered["structure"], int(numbered["number"])
    return path.stem, 0


def _timing(path: Path, phase_count: int) -> Timing:
    require_no_device(path)
    timing = _read_timing(path) if path.exists() else Timing()
    if timing.mr_from_tracker is not None:
        require_rigid(np.array(timing.mr_from_tracker), f"{path}: mr_from_tracker")
    if timing.phases is None:
        evenly = tuple(k / phase_count for k in range(phase_count))
        return timing.model_copy(update={"phases": evenly})
    if len(timing.phases) != phase_count:
        raise InputError(
            f"{path}: {len(timing.phases)} phases for {phase_count} surfaces; give one each"
        )
    try:
        require_phases(list(timing.phases), f"{path}: phases")
    except ValueError as error:
        raise InputError(str(error)) from error
    return timing


def _read_timing(path: Path) -> Timing:
    try:
        return Timing.model_validate(json.loads(path.read_bytes(), object_pairs_hook=each_key_once))
    except ValidationError as error:
        raise InputError(describe_validation(error, str(path), Timing)) from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error
