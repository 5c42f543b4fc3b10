"""What products were made of: they are known by the content that made them.

``stage.json`` in a product carries the fingerprint of all that went in (inputs, settings, code) and
every file's digest, so a later run can tell whether the product still holds.
"""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.publish import read_record, write_json

STAGE_FILE = "stage.json"

LIBRARIES = (
    "numpy",
    "scipy",
    "scikit-image",
    "SimpleITK",
    "opencv-contrib-python-headless",
    "pyvista",
    "vtk",
    "numba",
    "llvmlite",
    "zarr",
    "nibabel",
    "pydicom",
    "wfdb",
    "matplotlib",
    "pillow",
    "jinja2",
)
"""Those that read what goes into a product, or make it."""

PACKAGE = Path(__file__).parent


def seal(folder: Path, fingerprint: str, figures: Mapping[str, Any]) -> None:
    """Write ``stage.json``: what went in, what was measured, and every file's digest."""
    files = {
        path.relative_to(folder).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": sha256_of(path),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    write_json(
        folder / STAGE_FILE,
        {"fingerprint": fingerprint, "figures": dict(figures), "files": files},
    )


def sealed(folder: Path) -> dict[str, Any] | None:
    """What ``stage.json`` says, or None where a file of the product is missing or cut short."""
    try:
        content: dict[str, Any] = json.loads((folder / STAGE_FILE).read_text())
        intact = all(
            (folder / name).stat().st_size == entry["bytes"]
            for name, entry in content["files"].items()
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return content if intact else None


def require_unaltered(folder: Path) -> None:
    """Refuse a product that holds other bytes than were sealed: nothing is to be made of it.

    Raises
    ------
    InputError
        When a file's digest is not that in ``stage.json``.
    """
    content = sealed(folder)
    for name, entry in content["files"].items() if content else ():
        if sha256_of(folder / name) != entry["sha256"]:
            raise InputError(
                f"{folder / name}: is not what the stage {folder.name} wrote: it was edited, or "
                "damaged on the disk; to make it anew: beatfield run STUDY --out "
                f"{folder.parent.parent} --from {folder.name}"
            )


def require_same_study(
    study: Path,
    patient_id: str,
    inputs: Mapping[str, Mapping[str, str]],
    products: Path,
    stages: Sequence[str],
) -> None:
    """Another patient's products under the same patient id are not replaced.

    A study may be moved, or its files exchanged where they are; not both at once.

    Raises
    ------
    InputError
        When the products of any stage are those of a study that lies elsewhere, and has no image
        in common with this one.
    """
    earlier = read_record(products)
    folder, known = earlier.get("study"), earlier.get("inputs")
    if not isinstance(folder, str) or not isinstance(known, dict) or folder == str(study):
        return
    before, now = (kinds.get("cine") for kinds in (known, inputs))
    if not isinstance(before, dict) or not before or not now:
        return
    if not any(sealed(products / stage) for stage in stages):
        return
    if set(map(str, before.values())).isdisjoint(now.values()):
        raise InputError(
            f"{products}: holds the products of another study, {folder}, which has the patient id "
            f"{patient_id!r} too and no image in common with {study}; choose another "
            "--out, or give this study a patient_id of its own in study.yaml"
        )


def fingerprint(parts: Mapping[str, Any]) -> str:
    """SHA-256 of JSON-able parts; order counts, as it does for fixtures, whose first leads."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, as hexadecimal.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    try:
        with path.open("rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give yourself the right to, or take it out"
        ) from error


@cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries that shape the products."""
    return {name: metadata.version(name) for name in LIBRARIES}


@cache
def code_digest(module: str) -> str:
    """Digest of a module of the pipeline and of all that it imports from the pipeline.

    Imports inside functions count, those for types alone do not. Data files beside the imported
    modules (network weights, page templates) count, since they decide the result as code does;
    what compilers leave there does not, nor do the files that they are just writing.
    """
    digest = hashlib.sha256()
    paths = _import_closure(module)
    data = {
        path
        for folder in {path.parent for path in paths} - {PACKAGE}
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts and path.suffix != ".py" and path.is_file()
    }
    for path in sorted(paths | data):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _import_closure(module: str) -> set[Path]:
    found: set[Path] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = _source_of(name)
        if path is None or path in found:
            continue
        found.add(path)
        waiting += _pipeline_imports(path)
    return found


def _source_of(module: str) -> Path | None:
    base = PACKAGE.joinpath(*module.split(".")[1:])
    return next(
        (one for one in (base.with_suffix(".py"), base / "__init__.py") if one.exists()), None
    )


@cache
def _pipeline_imports(path: Path) -> list[str]:
    names: list[str] = []
    waiting: list[ast.AST] = [ast.parse(path.read_bytes())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return [name for name in names if name.split(".")[0] == "pipeline"]
