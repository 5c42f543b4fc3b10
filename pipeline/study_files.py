"""Which files a study's folders and records are made of, without reading an image."""

from __future__ import annotations

import os
import re
from pathlib import Path

from pipeline.errors import InputError

WFDB_ENDINGS = (".hea", ".dat")
LITTER = ("thumbs.db", "desktop.ini")
"""What systems leave in folders, beside names that begin with a dot."""

# A MetaImage header is text; pixels may follow in the same file.
_HEADER_BYTES = 1 << 24
_DATA_FILE = re.compile(rb"^\s*ElementDataFile\s*[=:][ \t]*(.*?)\s*$", re.MULTILINE)


def files_below(path: Path) -> list[Path]:
    """A file, or all in a folder and the folders in it, links to folders included, in order.

    Names that begin with a dot, and `LITTER`, are passed over.

    Raises
    ------
    InputError
        When a folder cannot be entered.
    """
    if not path.is_dir():
        return [path] if path.is_file() else []
    found: list[Path] = []
    entered: set[str] = set()
    for name, folders, files in os.walk(path, onerror=_refuse, followlinks=True):
        # A link may lead back to a folder around it.
        entered.add(os.path.realpath(name))
        folders[:] = [one for one in folders if os.path.realpath(Path(name, one)) not in entered]
        found += [Path(name, one) for one in files if not _is_litter(one)]
    return sorted(one for one in found if one.is_file())


def _is_litter(name: str) -> bool:
    return name.startswith(".") or name.lower() in LITTER


def _refuse(error: OSError) -> None:
    raise InputError(
        f"{error.filename}: cannot be entered ({error.strerror}); give yourself the right to read "
        "it, or take it out"
    ) from error


def record_files(stem: Path | None) -> list[Path]:
    """All files of an ECG record: what begins with its name, and what a WFDB header names."""
    if stem is None:
        return []
    if stem.suffix in WFDB_ENDINGS:
        stem = stem.with_suffix("")
    beside = stem.parent.iterdir() if stem.parent.is_dir() else iter(())
    found = {one for one in beside if one.name.startswith(stem.name) and one.is_file()}
    headers = [stem.parent / f"{stem.name}.hea"]
    # What a header names may be segments, which have headers of their own.
    for header in headers:
        named = [header.parent / name for name in names_in_header(header)]
        segments = [one.with_name(f"{one.name}.hea") for one in named]
        found |= {one for one in (*named, *segments) if one.is_file()}
        headers += [one for one in segments if one not in headers]
    return sorted(found)


def names_in_header(header: Path) -> list[str]:
    """What a WFDB header names: the files of its signals, or the records of its segments.

    Raises
    ------
    InputError
        When there is such a header, and it cannot be read.
    """
    if not header.is_file():
        return []
    try:
        lines = header.read_text(errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{header}: cannot be read ({error})") from error
    named = [line.split()[0] for line in lines if line.strip() and not line.startswith("#")]
    # The first line names the record itself; a gap between segments is called ~.
    return [name for name in named[1:] if name != "~"]


def sweep_files(sweep: Path) -> list[Path]:
    """A MetaImage file, and what its header names as the files of its pixels.

    Of a pattern or a list of files it is all others in the folder that no header is in.
    """
    try:
        with sweep.open("rb") as file:
            named = _DATA_FILE.search(file.read(_HEADER_BYTES))
    except OSError as error:
        raise InputError(f"{sweep}: cannot be read ({error})") from error
    name = named[1].decode(errors="replace") if named else "LOCAL"
    if name.upper() == "LOCAL":
        return [sweep]
    if (sweep.parent / name).is_file():
        return [sweep, sweep.parent / name]
    others = (one for one in sweep.parent.iterdir() if one.suffix.lower() not in (".mha", ".mhd"))
    return [sweep, *sorted(one for one in others if one.is_file())]
