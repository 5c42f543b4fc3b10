"""The files of a store as a reader meets them: found, checked, mapped into memory."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from pipeline.errors import InputError
from pipeline.field.manifest import MANIFEST
from pipeline.field.metadata import FieldMetadata, FixturePart
from pipeline.geometry import Float32, Grid
from pipeline.regular_files import require_no_device

ATTRIBUTES = "zarr.json"


def chunk_path(array: Path, index: int) -> Path:
    """The file of one phase of a stored array: raw little-endian float32 ``(z, y, x)``."""
    return array / "c" / str(index) / "0" / "0" / "0"


def map_phase(array: Path, index: int, grid: Grid) -> Float32:
    """Map one phase of a stored array into memory, read-only.

    Raises
    ------
    InputError
        When the file is missing, also where its field is just being replaced, or its size is wrong.
    """
    path = chunk_path(array, index)
    size, needed = _size(path), 4 * int(np.prod(grid.shape))
    if size != needed:
        raise InputError(f"{path}: {size} bytes, {needed} were needed; bake the field again")
    try:
        mapped = np.memmap(path, dtype="<f4", mode="r", shape=grid.shape)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be mapped ({error}); if the field was just replaced, open it again"
        ) from error
    # A plain view: subclasses of arrays make every call into a compiled kernel slower.
    return np.asarray(mapped)


def readable_in_fours(coefficients: Float32) -> Float32:
    """The same array, or on a grid narrower than the kernels read at a time a longer copy."""
    if coefficients.shape[2] >= 4:
        return coefficients
    return np.pad(coefficients.ravel(), (0, 3))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); bake it again") from error


def require_manifest(path: Path) -> bytes:
    """Raise InputError unless the folder has the manifest that is written last, and it agrees.

    Only the attributes are compared with it; this is the check that costs nothing. Returns the
    manifest's text.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give a field.zarr that bake wrote")
    for name in (MANIFEST, ATTRIBUTES):
        require_no_device(path / name)
    try:
        text = (path / MANIFEST).read_bytes()
        expected = json.loads(text)["files"][ATTRIBUTES]["sha256"]
        actual = hashlib.sha256((path / ATTRIBUTES).read_bytes()).hexdigest()
    except FileNotFoundError as error:
        missing = Path(error.filename).name
        raise InputError(
            f"{path}: has no {missing}, so it is no complete field; give "
            "the field.zarr that bake wrote, or bake it again"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path / MANIFEST}: cannot be read ({error!r}); bake again") from error
    if expected != actual:
        raise InputError(f"{path / ATTRIBUTES}: is not what the manifest says; bake it again")
    return text


def read_metadata(path: Path) -> FieldMetadata:
    """The ``beatfield`` attributes of a store.

    Raises
    ------
    InputError
        When they are missing or wrong, or a fixture is more than its haptic device can render.
    """
    source = path / ATTRIBUTES
    try:
        attributes = json.loads(source.read_bytes())["attributes"]["beatfield"]
        metadata = FieldMetadata.model_validate(attributes)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        other = place == "format_version" or first["type"] in ("missing", "extra_forbidden")
        remedy = "; of another version of beatfield? bake the field again with this one"
        said = f"{first['msg']}{remedy if other else ''}"
        raise InputError(f"{source}: beatfield.{place}: {said}") from error
    except InputError as error:
        raise InputError(f"{source}: beatfield: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{source}: holds no beatfield attributes ({error!r}); give a field.zarr"
        ) from error
    for name, part in metadata.fixtures.items():
        _require_renderable(source, name, part)
    return metadata


def _require_renderable(source: Path, name: str, part: FixturePart) -> None:
    try:
        part.fixture()
    except ValidationError as error:
        said = error.errors()[0]["msg"]
        raise InputError(f"{source}: fixture {name}: {said}; bake the field again") from error
