"""What products were made of: they are known by the content that made them.

``stage.json`` in a product carries the fingerprint of all that went in (inputs, settings, code),
every file's digest and its own, so a later run can tell whether the product still holds.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
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

PHASE_FILE = re.compile(r"_\d+\.(vtp|nii\.gz)$")
"""How stages name a phase's file; copies that a person left beside them are called otherwise."""


def seal(
    folder: Path, fingerprint: str, figures: Mapping[str, Any], settings: Mapping[str, Any]
) -> None:
    """Write ``stage.json``: what went in, what was measured, and every file's digest."""
    files = {
        path.relative_to(folder).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": sha256_of(path),
        }
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    content = {
        "fingerprint": fingerprint,
        "settings": dict(settings),
        "figures": dict(figures),
        "files": files,
    }
    write_json(folder / STAGE_FILE, {**content, "sha256": _own_digest(content)})


def _own_digest(content: Mapping[str, Any]) -> str:
    """SHA-256 of what ``stage.json`` says beside it, as it is read again."""
    said = {name: value for name, value in content.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(json.loads(json.dumps(said))).encode()).hexdigest()


def sealed(folder: Path) -> dict[str, Any] | None:
    """What ``stage.json`` says, or None where it is missing or cannot be read as such, or a file of
    the product is missing."""
    try:
        content: dict[str, Any] = json.loads((folder / STAGE_FILE).read_text())
        whole = all((folder / name).is_file() for name in content["files"])
        # What an older version wrote has no digest of its own; whose it is still counts.
        whole = whole and isinstance(content["fingerprint"], str)
        whole = whole and all(isinstance(content[part], dict) for part in ("figures", "files"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return content if whole else None


def require_unaltered(folder: Path) -> None:
    """Refuse a product that holds other bytes than were sealed: nothing is to be made of it.

    Raises
    ------
    InputError
        When a file's digest is not that in ``stage.json``, that one's own is wrong, or another file
        is called as a phase's.
    """
    content = sealed(folder)
    if content is None:
        return
    anew = f"to make it anew: beatfield run STUDY --out {folder.parent.parent} --from {folder.name}"
    changed = [] if content.get("sha256") == _own_digest(content) else [STAGE_FILE]
    changed += [
        name
        for name, entry in content["files"].items()
        if not changed and sha256_of(folder / name) != _digest_said(entry)
    ]
    if changed:
        raise InputError(
            f"{folder / changed[0]}: is not what the stage {folder.name} wrote: it was edited, or "
            f"damaged on the disk; {anew}"
        )
    named = (path for path in sorted(folder.iterdir()) if PHASE_FILE.search(path.name))
    for path in named:
        if path.name not in content["files"]:
            raise InputError(
                f"{path}: was not written by the stage {folder.name}, but is called as if it were; "
                f"take it out, or {anew}"
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


def _digest_said(entry: Any) -> object:
    return entry.get("sha256") if isinstance(entry, dict) else None


def digest_of_files(files: Mapping[str, str]) -> str:
    """SHA-256 of what ``sha256sum`` prints of files, sorted by name in the order of bytes; of a
    single one its own. Names with a backslash or a line's end stand as they are, which
    ``sha256sum`` would escape.

    Parameters
    ----------
    files
        SHA-256 of each, by its path in the study.
    """
    if len(files) == 1:
        return next(iter(files.values()))
    # Names of files need be no text.
    lines = [
        f"{files[name]}  ".encode() + os.fsencode(name) + b"\n"
        for name in sorted(files, key=os.fsencode)
    ]
    return hashlib.sha256(b"".join(lines)).hexdigest()


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
def network_digests() -> dict[str, str]:
    """SHA-256 of the networks' weights by name."""
    return {path.name: sha256_of(path) for path in sorted(PACKAGE.glob("*/weights/*.onnx"))}


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
