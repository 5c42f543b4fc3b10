"""Check a baked field: every byte, the description, and that the values make sense."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.field.files import ATTRIBUTES, map_phase, read_metadata
from pipeline.field.manifest import MANIFEST, canonical_manifest, entry
from pipeline.field.metadata import FieldMetadata, FixturePart, StructurePart, attributes
from pipeline.field.potential import offence, potential
from pipeline.field.query import stiffness_words
from pipeline.field.spline import node_values, phase_weights, timeline
from pipeline.geometry import Float, Grid
from pipeline.regular_files import require_no_device

# Stored potentials are rounded to float32: half a step below 1 is 2^-25. Another machine's
# exponential may differ in its last bit, which can move the rounding by one step, 2^-24.
POTENTIAL_TOLERANCE = 2.0**-23

STEEPEST = 1 + 1e-3
"""From node to node no distance changes by more than the way between them, but for rounding."""

VOLUME_SPACINGS, VOLUME_NODES = 0.3, 4
"""By how much nodes may enclose more than the surface does: its area times this many spacings (a
sheet thinner than they are takes up to 1/4), and so many nodes."""

ARRAY_MUST_HAVE: Mapping[str, Any] = {
    "zarr_format": 3,
    "node_type": "array",
    "data_type": "float32",
    "fill_value": "NaN",
    "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
    "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
}


@dataclass(frozen=True, slots=True)
class Report:
    """What was checked in a field that is whole."""

    files: int
    """Files whose size and SHA-256 agree with the manifest."""

    bytes: int
    """Their size together."""

    phases: int
    """Stored phases."""

    patient_id: str
    """Whose field it is; empty where not told."""

    structures: tuple[str, ...]
    """Surfaces whose distances are all finite."""

    fixtures: tuple[str, ...]
    """Fixtures whose potential is the formula evaluated on the distance."""

    doubts: tuple[str, ...] = ()
    """What the field says that speaks against it, whole as it is: its ``source``'s ``doubts``."""

    def __str__(self) -> str:
        return (
            f"whole{f', of {self.patient_id}' if self.patient_id else ''}: {self.files} files, "
            f"{self.bytes / 1e6:.1f} MB, {self.phases} phases, "
            f"structures {', '.join(self.structures)}; fixtures {', '.join(self.fixtures)}"
        )


def verify_field(path: Path) -> Report:
    """Check a field: manifest, files, checksums, description, values.

    Any changed, missing or added byte is found, the manifest's own included.

    Parameters
    ----------
    path
        The ``field.zarr`` folder.

    Raises
    ------
    InputError
        When anything is wrong, naming all that is.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give a field.zarr that bake wrote")
    files = _read_manifest(path / MANIFEST)
    try:
        return _verified(path, files)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        # Of a manifest and descriptions that agree, and were written by something else.
        raise InputError(f"{path}: holds what no field does ({error!r}); bake it again") from error


def _verified(path: Path, files: Mapping[str, Mapping[str, Any]]) -> Report:
    _refuse(path, list(_file_problems(path, files)))
    metadata = read_metadata(path)
    _refuse(path, [problem for name in metadata.arrays for problem in _array(path, name, metadata)])
    _refuse(path, list(_place_problems(path, metadata)))
    _refuse(path, list(_value_problems(path, metadata)))
    return Report(
        files=len(files),
        bytes=sum(one["size"] for one in files.values()),
        phases=len(metadata.phases),
        patient_id=str(metadata.source.get("patient_id") or ""),
        structures=tuple(metadata.structures),
        fixtures=tuple(metadata.fixtures),
        doubts=told_doubts(metadata.source),
    )


def told_doubts(source: Mapping[str, Any]) -> tuple[str, ...]:
    """What a field's ``source`` says that speaks against it; nothing where it does not tell."""
    told = source.get("doubts")
    return tuple(map(str, told)) if isinstance(told, list) else ()


def certificate_rows(accuracy: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A certificate in words: a name and its figures, fixture by fixture at the end.

    The largest over all fixtures are left out: side by side they are those of different fixtures.
    """
    fixtures: Mapping[str, Mapping[str, Any]] = accuracy["fixtures"]
    left_out = {"structures", "fixtures"}.union(*fixtures.values())
    rows = [
        (name, f"{value:.6g}")
        for name, value in accuracy.items()
        if name not in left_out and value is not None
    ]
    return rows + [(name, _fixture_words(one)) for name, one in fixtures.items()]


def _fixture_words(one: Mapping[str, Any]) -> str:
    beyond, late = one["beyond_limit_share"], one["force_change_max_n_per_ms"]
    holding = f"{one['stiffness_any_direction_p99_n_per_m']:.0f} in any direction at 99 % of places"
    share = "" if beyond is None else f", {beyond:.2%} are beyond the device"
    step = f"largest change of force found: {one['force_step_max_n_per_0_1_mm']:.3f} N over 0.1 mm"
    time = "" if late is None else f", {late:.3f} N over 1 ms"
    return f"{stiffness_words(one)}; {holding}{share}; {step}{time}"


def _refuse(path: Path, problems: list[str]) -> None:
    if problems:
        shown = problems[:20]
        more = [f"and {len(problems) - 20} more"] if len(problems) > 20 else []
        listed = "\n  ".join([*shown, *more])
        raise InputError(f"{path}: is damaged; bake it again\n  {listed}")


def _read_manifest(source: Path) -> dict[str, dict[str, Any]]:
    """Files by name, when the manifest is byte for byte what would be written for them."""
    require_no_device(source)
    try:
        raw = source.read_bytes()
        files: dict[str, dict[str, Any]] = json.loads(raw)["files"]
        whole = raw == canonical_manifest(files)
    except FileNotFoundError as error:
        raise InputError(
            f"{source.parent}: has no {MANIFEST}, so it is no complete field; give "
            "the field.zarr that bake wrote, or bake it again"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{source}: is damaged ({error!r}); bake the field again") from error
    if not whole or "zarr.json" not in files:
        raise InputError(f"{source}: is damaged, its own digest does not agree; bake again")
    return files


def _file_problems(path: Path, files: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    present = {
        file.relative_to(path).as_posix()
        for file in path.rglob("*")
        if file.is_symlink() or not file.is_dir()
    } - {MANIFEST}
    yield from (f"{name}: is missing" for name in sorted(set(files) - present))
    yield from (f"{name}: is not in the manifest" for name in sorted(present - set(files)))
    for name in sorted(present & set(files)):
        require_no_device(path / name)
        try:
            actual = entry(path / name)
        except OSError as error:
            yield f"{name}: cannot be read ({error.strerror})"
            continue
        if actual != files[name]:
            yield _difference(name, actual, files[name])


def _difference(name: str, actual: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    if actual["size"] != expected["size"]:
        return f"{name}: {actual['size']} bytes, the manifest says {expected['size']}"
    return f"{name}: its SHA-256 is not that of the manifest"


def _array(path: Path, name: str, metadata: FieldMetadata) -> Iterator[str]:
    """What in an array's own description disagrees with the format."""
    try:
        described = json.loads((path / name / "zarr.json").read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        yield f"{name}/zarr.json: cannot be read ({error})"
        return
    if not isinstance(described, dict):
        yield f"{name}/zarr.json: is no description of an array"
        return
    shape = list(metadata.grid.shape_zyx)
    expected = {
        **ARRAY_MUST_HAVE,
        "shape": [len(metadata.phases), *shape],
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, *shape]}},
    }
    for key, value in expected.items():
        if described.get(key) != value:
            yield f"{name}/zarr.json: {key} is {described.get(key)!r}, needed {value!r}"


def _place_problems(path: Path, metadata: FieldMetadata) -> Iterator[str]:
    """Where the description for other programs puts the arrays elsewhere than our own does."""
    told = json.loads((path / ATTRIBUTES).read_bytes())["attributes"].get("ome")
    if told != json.loads(json.dumps(attributes(metadata)["ome"])):
        yield (
            f"{ATTRIBUTES}: its parts ome and beatfield disagree on names, grid, phases or rr_s, "
            "so programs that read one or the other put the field in two places"
        )


def _value_problems(path: Path, metadata: FieldMetadata) -> Iterator[str]:
    grid = metadata.grid.nodes()
    for index in range(len(metadata.phases)):
        for name, structure in metadata.structures.items():
            values = map_phase(path / structure.path, index, grid)
            if not np.isfinite(values).all():
                yield f"{structure.path}: phase {index} holds values that are not finite"
                continue
            distance_mm = values.astype(np.float64)
            yield from _distance_problems(distance_mm, structure, index, grid)
            yield from _spline_problems(path, metadata, structure, index, distance_mm)
            for fixture in metadata.fixtures.values():
                if fixture.structure == name:
                    stored = map_phase(path / fixture.path, index, grid)
                    yield from _potential_problems(stored, distance_mm, fixture, index)


def _distance_problems(
    distance_mm: Float, part: StructurePart, index: int, grid: Grid
) -> Iterator[str]:
    """What no distance to a surface of the stated volume does, wherever the surface lies."""
    spacing_mm = np.array(grid.spacing_mm)
    for axis, step_mm in enumerate(spacing_mm[::-1]):
        change_mm = np.abs(np.diff(distance_mm, axis=axis)).max(initial=0.0)
        if change_mm > STEEPEST * step_mm:
            yield (
                f"{part.path}: phase {index} changes by {change_mm:.3g} mm between nodes that lie "
                f"{step_mm:.3g} mm apart, a distance by no more than that"
            )
            return
    step_mm, node_ml = float(spacing_mm.mean()), float(spacing_mm.prod()) / 1000
    found_ml = float(np.clip(0.5 - distance_mm / step_mm, 0, 1).sum()) * node_ml
    # Nodes nearer than a spacing fill a layer two spacings thick.
    layer_ml = float((np.abs(distance_mm) < step_mm).sum()) * node_ml / 2
    told_ml = part.volume_ml[index]
    # Bodies that overlap count twice in the stated volume: less is no sign of damage.
    if found_ml > told_ml + VOLUME_SPACINGS * layer_ml + VOLUME_NODES * node_ml:
        yield (
            f"{part.path}: phase {index} is negative over {found_ml:.4g} ml, its surface encloses "
            f"{told_ml:.4g} ml: spacing, order of phases or sign is not that of the surface"
        )


def _spline_problems(
    path: Path, metadata: FieldMetadata, part: StructurePart, index: int, distance_mm: Float
) -> Iterator[str]:
    """At the nodes of every phase the spline must take the stored distances, but for the stated
    correction: weights are positive with sum 1, so no value changes by more than a coefficient."""
    grid, phases = metadata.grid.nodes(), metadata.phases
    k, weights = phase_weights(timeline(np.array(phases)), phases[index])
    coefficients = np.zeros(grid.shape)
    for step, weight in zip((-1, 0, 1), weights, strict=True):
        mapped = map_phase(path / part.spline, (k + step) % len(phases), grid)
        coefficients += weight * mapped
    off_mm = np.abs(node_values(coefficients) - distance_mm).max()
    # Coefficients and distances are each rounded to float32, by 2^-24 of themselves at most;
    # solving along three axes and in time enlarges the former to no more than 16 of them.
    rounding_mm = 16 * 2.0**-24 * max(np.abs(coefficients).max(), 1.0)
    if not off_mm <= part.correction_mm + rounding_mm:
        yield f"{part.spline}: phase {index} misses {part.path} by {off_mm:.2g} mm at a node"


def _potential_problems(
    stored: Any, distance_mm: Any, part: FixturePart, index: int
) -> Iterator[str]:
    side = part.fixture().side_code
    formula = potential(offence(distance_mm, side), part.delta_mm, part.m)
    # A value that is not a number fails the comparison, as it should.
    if not (np.abs(stored - formula) <= POTENTIAL_TOLERANCE).all():
        yield f"{part.path}: phase {index} is not the formula evaluated on {part.structure}"
