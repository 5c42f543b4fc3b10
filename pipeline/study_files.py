"""Which files a study's folders and records are made of, without reading an image."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from typing import NoReturn

from pipeline.errors import InputError
from pipeline.regular_files import require_no_device

WFDB_ENDINGS = (".hea", ".dat")
LITTER = ("thumbs.db", "desktop.ini")
"""What systems leave in folders, beside names that begin with a dot."""

# A MetaImage header is text; pixels may follow in the same file.
_HEADER_BYTES = 1 << 24
_DATA_FILE = re.compile(rb"^[^\S\n]*ElementDataFile[ \t]*[=:](.*)$", re.MULTILINE)


def files_below(path: Path) -> list[Path]:
    """A file, or all in a folder and the folders in it, links to folders included, in order.

    Names that begin with a dot, and `LITTER`, are passed over.

    Raises
    ------
    InputError
        When a folder cannot be entered, or holds what is neither file nor folder, or a link that
        leads nowhere.
    """
    require_no_device(path)
    if not path.is_dir():
        return [path] if _is_file(path) else []
    found: list[Path] = []
    entered: set[str] = set()
    for name, folders, files in os.walk(path, onerror=_refuse, followlinks=True):
        # Links may lead to a folder that was entered, or back to one around them.
        place = os.path.realpath(name)
        if place in entered:
            folders.clear()
            continue
        entered.add(place)
        folders[:] = [one for one in folders if not is_litter(one)]
        found += [Path(name, one) for one in files if not is_litter(one)]
    for one in found:
        if one.is_symlink() and not one.exists():
            raise InputError(f"{one}: is a link that leads nowhere; mend it, or take it out")
        require_no_device(one)
    return sorted(one for one in found if _is_file(one))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError as error:
        # No file has so long a name, whatever a header says.
        if error.errno == errno.ENAMETOOLONG:
            return False
        _refuse(error)


def _in_folder(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        _refuse(error)


def is_litter(name: str) -> bool:
    """Whether a file is of those that systems leave in folders."""
    return name.startswith(".") or name.lower() in LITTER


def _refuse(error: OSError) -> NoReturn:
    raise InputError(cannot_be_entered(error)) from error


def cannot_be_entered(error: OSError) -> str:
    """What to say of a folder that the system keeps closed."""
    return (
        f"{error.filename}: cannot be entered ({error.strerror}); give yourself the right to read "
        "it, or take it out"
    )


def record_files(stem: Path | None) -> list[Path]:
    """All files of an ECG record: what begins with its name, and what a WFDB header names.

    Raises
    ------
    InputError
        When the record's folder cannot be entered, or as in `names_in_header`.
    """
    if stem is None:
        return []
    if stem.suffix in WFDB_ENDINGS:
        stem = stem.with_suffix("")
    beside = _in_folder(stem.parent)
    found = {one for one in beside if one.name.startswith(stem.name) and _is_file(one)}
    headers = [stem.parent / f"{stem.name}.hea"]
    # What a header names may be segments, which have headers of their own.
    for header in headers:
        named = [header.parent / name for name in names_in_header(header)]
        segments = [one.with_name(f"{one.name}.hea") for one in named]
        found |= {one for one in (*named, *segments) if _is_file(one)}
        headers += [one for one in segments if one not in headers]
    return sorted(found)


def is_of_record(path: Path, record: Path) -> bool:
    """Whether a file that is there is one that an ECG record, as a user names it, is read from.

    Raises
    ------
    InputError
        As in `names_in_header`.
    """
    stem = record.with_suffix("") if record.suffix in WFDB_ENDINGS else record
    header = stem.parent / f"{stem.name}.hea"
    read = [record, header, *(header.parent / name for name in names_in_header(header))]
    return path.exists() and any(one.exists() and path.samefile(one) for one in read)


def names_in_header(header: Path) -> list[str]:
    """What a WFDB header names: the files of its signals, or the records of its segments.

    Raises
    ------
    InputError
        When there is such a header, and it cannot be read, or names files in other folders.
    """
    if not _is_file(header):
        return []
    try:
        lines = header.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{header}: cannot be read ({error})") from error
    named = [line.split()[0] for line in lines if line.strip() and not line.startswith("#")]
    # The first line names the record itself; a gap between segments is called ~.
    names = [name for name in named[1:] if name != "~"]
    for name in names:
        _require_beside(header, name)
    return names


def _require_beside(header: Path, name: str) -> None:
    """Refuse a header, which may come from anywhere, that has files of this machine read.

    What is elsewhere by the user's own will, `study.yaml` names.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"{header}: names {name}, which is not beside it; copy it there")


def sweep_files(sweep: Path) -> list[Path]:
    """A MetaImage file, and what its header names as the files of its pixels.

    Of a pattern or a list of files it is all others in the folder that no header is in.

    Raises
    ------
    InputError
        When the file or its folder cannot be read, or the header names files in other folders.
    """
    try:
        with sweep.open("rb") as file:
            header = file.read(_HEADER_BYTES)
    except OSError as error:
        raise InputError(f"{sweep}: cannot be read ({error})") from error
    named = _DATA_FILE.search(header)
    name = named[1].decode(errors="replace").strip() if named else "LOCAL"
    if name.upper() == "LOCAL":
        return [sweep]
    listed = header[named.end() :] if named and name.startswith("LIST") else b""
    for one in (name, *listed.decode(errors="replace").splitlines()):
        _require_beside(sweep, one.strip())
    if _is_file(sweep.parent / name):
        return [sweep, sweep.parent / name]
    others = (one for one in _in_folder(sweep.parent) if one.suffix.lower() not in (".mha", ".mhd"))
    return [sweep, *(one for one in others if _is_file(one))]


def require_signals(header: Path) -> None:
    """Refuse a WFDB header whose signals, or whose segments and theirs, are not beside it.

    Raises
    ------
    InputError
        Naming the first that is not there; or as in `names_in_header`.
    """
    headers = [header]
    # Segments may name one another in a ring.
    for one in headers:
        for name in names_in_header(one):
            segment = one.parent / f"{name}.hea"
            if segment != one and segment.is_file():
                headers += [segment] if segment not in headers else []
            elif not (one.parent / name).is_file():
                raise InputError(f"{one}: names {name}, which is not beside it; copy it there")
