"""The manifest of a store: every file's size and SHA-256, sealed with its own digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"


def write_manifest(path: Path) -> None:
    """Seal the store in the folder ``path``; nothing may be written to it afterwards."""
    files = {
        file.relative_to(path).as_posix(): entry(file)
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }
    (path / MANIFEST).write_bytes(canonical_manifest(files))


def entry(file: Path) -> dict[str, Any]:
    """What the manifest says of a file."""
    with file.open("rb") as handle:
        digest = hashlib.file_digest(handle, "sha256").hexdigest()
    return {"size": file.stat().st_size, "sha256": digest}


def canonical_manifest(files: Mapping[str, Mapping[str, Any]]) -> bytes:
    """The one way to write a manifest; ``sha256`` is the digest of the same text without it.

    A reader that writes again what it read, and compares, notices every changed byte.
    """
    content: dict[str, Any] = {"format": "beatfield manifest", "version": 1, "files": files}
    digest = hashlib.sha256(_text(content)).hexdigest()
    return _text({**content, "sha256": digest})


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, sort_keys=True) + "\n").encode("ascii")
