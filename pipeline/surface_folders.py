"""Closed surfaces of one's own in a folder, and what is said of their time and place."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from pipeline.errors import InputError
from pipeline.field.bake import SurfaceSeries
from pipeline.field.distance import require_closed
from pipeline.field.metadata import LONGEST_NAME, Transform, require_name, require_phases
from pipeline.geometry import Surface, require_rigid
from pipeline.meshes import MESH_ENDINGS, read_mesh
from pipeline.regular_files import require_no_device
from pipeline.sealing import sha256_of
from pipeline.validation import Section, describe_validation, each_key_once

SMALLEST_MM, LARGEST_MM = 1.0, 2000.0
"""From end to end; a heart in metres or micrometres lies outside."""

SMALL_MM = 15.0
"""A heart in centimetres measures less from end to end."""

UNLIKE = 3.0
"""No part of a heart is so many times as long in one phase as in another."""

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


def odd_sizes(surfaces: Mapping[str, SurfaceSeries]) -> list[str]:
    """Sentences on structures that may be in centimetres, in all phases or in some."""
    told = []
    for name, series in surfaces.items():
        sizes_mm = np.array([_size_mm(one) for one in series.surfaces])
        least, most = int(sizes_mm.argmin()), int(sizes_mm.argmax())
        if sizes_mm[most] > UNLIKE * sizes_mm[least]:
            told.append(
                f"{name}: measures {sizes_mm[least]:.3g} mm from end to end in phase {least} and "
                f"{sizes_mm[most]:.3g} mm in phase {most}: are all files in millimetres, and of "
                "one structure?"
            )
        elif sizes_mm[most] < SMALL_MM:
            told.append(
                f"{name}: measures {sizes_mm[most]:.3g} mm from end to end: if that is a heart's "
                "centimetres, give millimetres"
            )
    return told


def _size_mm(surface: Surface) -> float:
    return float(np.ptp(surface.vertices_mm, axis=0).max())


def _closed(path: Path) -> Surface:
    surface = read_mesh(path)
    if not np.isfinite(surface.vertices_mm).all():
        raise InputError(f"{path}: has vertices that are no numbers; export the surface again")
    size_mm = _size_mm(surface)
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
        hidden = path.name.startswith(".")
        if hidden or path.suffix.lower() not in MESH_ENDINGS or not path.is_file():
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
