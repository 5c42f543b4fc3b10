"""What a report was made of, so that it can be found again and repeated."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline import __version__
from pipeline.config import Settings
from pipeline.report.page import Section, Table
from pipeline.sealing import digest_of_files, library_versions, network_digests, sha256_of

TOLD = (
    "The same files, settings and versions give the same products. The digest of several files is "
    "the SHA-256 of the lines that `sha256sum` prints of them in the study's folder, sorted by "
    "name (LC_ALL=C sort -k 2). run.json, beside the folder of this page, has the digest of each "
    "file and all settings."
)
KINDS = {"cine": "cine", "mr_ecg": "ECG during MR", "us": "ultrasound and its ECG"}


def provenance(
    inputs: Mapping[str, Mapping[str, str]], settings: Settings, manifest: Path
) -> Section:
    """Input files, the field, settings that are no defaults, and versions.

    Parameters
    ----------
    inputs
        SHA-256 of the input files by kind and path.
    manifest
        Of the field: it holds the digests of the field's files.
    """
    files = [
        (name, _count(inputs[kind]), digest_of_files(inputs[kind]))
        for kind, name in KINDS.items()
        if inputs.get(kind)
    ]
    files += [
        (f"network {name} of this version", "1 file", digest)
        for name, digest in network_digests().items()
    ]
    files.append(("bake/field.zarr/manifest.json", "1 file", sha256_of(manifest)))
    versions = {"beatfield": __version__, "Python": platform.python_version(), **library_versions()}
    return Section(
        "What it was made of",
        TOLD,
        tables=[
            Table(("file", "", "SHA-256"), files),
            Table(("setting", "here", "default"), _changed(settings) or [("all", "default", "")]),
            Table(("software", "version"), list(versions.items())),
        ],
    )


def _count(files: Mapping[str, str]) -> str:
    return "1 file" if len(files) == 1 else f"{len(files)} files"


def _changed(settings: Settings) -> list[tuple[str, str, str]]:
    """Settings that differ from their defaults: name, value, default."""
    here, default = (
        dict(_flat(one.model_dump(mode="json", by_alias=True))) for one in (settings, Settings())
    )
    names = dict.fromkeys((*here, *default))
    return [
        (name, _text(here.get(name)), _text(default.get(name)))
        for name in names
        if here.get(name) != default.get(name)
    ]


def _flat(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _text(value: object) -> str:
    return "-" if value is None else str(value)
