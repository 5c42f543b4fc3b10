"""Products published whole or not at all.

A stage writes into a hidden folder beside its place; only when it is complete is that folder
renamed.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.regular_files import require_text_name

PARTIAL = ".partial-"
OLD = "old-"

NO_SPACE = {errno.ENOSPC, errno.EDQUOT}
REFUSED = {
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST),
    *(errno.ENAMETOOLONG, errno.ELOOP),
}


@contextmanager
def publishing(target: Path) -> Iterator[Path]:
    """Give a folder to write in; on leaving without an error it becomes ``target``.

    Raises
    ------
    InputError
        When the disk is full, a file too large or the place cannot be written. Nothing is left
        behind then, and what stood at ``target`` before is untouched.
    """
    partial = target.with_name(f".{target.name}{PARTIAL}{os.getpid()}")
    with readable_write_errors(target):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            # What is another user's is theirs to clear away.
            with suppress(OSError):
                remove_partials(target.parent, target.name)
            remove(partial)
            partial.mkdir()
            with _held(partial):
                yield partial
                _swap(partial, target)
        finally:
            remove(partial)


@contextmanager
def readable_write_errors(target: Path) -> Iterator[None]:
    """Turn the system's refusal to write into words for the user."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_SPACE:
            raise InputError(
                f"{target}: the disk is full ({error.strerror}); free some space or choose "
                "another --out, then run again: finished stages are kept"
            ) from error
        if error.errno == errno.EFBIG:
            raise InputError(
                f"{target}: a file would be larger than `ulimit -f` or the file system allows "
                f"({error.strerror}); raise the limit or choose another --out, then run again: "
                "finished stages are kept"
            ) from error
        # Some file systems, such as /proc, say so of folders that they will not make.
        refused = Path(error.filename or "/")
        beside = refused.parent == target.parent and PARTIAL in refused.name
        no_folder = error.errno == errno.ENOENT and (beside or refused in target.parents)
        if beside and no_folder:
            raise InputError(
                f"{target}: cannot be written: there is no folder {target.parent}; make it first"
            ) from error
        if error.errno in REFUSED or no_folder:
            raise InputError(
                f"{target}: cannot be written ({error.strerror}: {error.filename}); "
                "choose a folder that you may write in"
            ) from error
        raise


def _swap(partial: Path, target: Path) -> None:
    """Put ``partial`` in the place of ``target``; a folder cannot be renamed over another."""
    old = target.with_name(f".{target.name}{PARTIAL}{OLD}{os.getpid()}")
    # In a container every run may have this number, and one may have been killed right here.
    remove(old)
    with _held(target):
        try:
            if target.exists():
                target.rename(old)
            partial.rename(target)
        except BaseException:
            if old.exists() and not target.exists():
                old.rename(target)
            raise
        remove(old)


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Show others that a process is at work in a folder, under whatever name; see `_in_use`."""
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        # There is none, or it is a file.
        yield
        return
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)


def _in_use(path: Path) -> bool:
    """Whether a living process holds a partial: process numbers alone tell none apart that are
    counted anew, as in containers or after a restart."""
    pid = path.name.rpartition("-")[2]
    known = pid.isdecimal() and _lives(int(pid))
    try:
        handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return known and int(pid) != os.getpid()
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        # A file system without locks of folders.
        return known
    finally:
        os.close(handle)
    return False


def remove(path: Path) -> None:
    """Delete a folder or file, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def remove_partials(folder: Path, name: str = "*") -> None:
    """Clear away what killed runs left unfinished, of one product or of all.

    A product that one had put aside, and nothing in its place yet, goes back there.
    """
    for path in folder.glob(f".{name if name == '*' else escape(name)}{PARTIAL}*"):
        if _in_use(path):
            continue
        product, _, rest = path.name[1:].rpartition(PARTIAL)
        target = path.with_name(product)
        if rest.startswith(OLD) and not os.path.lexists(target):
            # It was killed between the two renames of a swap: nothing else of the product stands.
            path.rename(target)
        else:
            remove(path)


@contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, and clear away what a killed run left in it.

    Raises
    ------
    InputError
        As `locked` does, or when what a killed run left cannot be cleared away.
    """
    with locked(folder):
        with readable_write_errors(folder):
            remove_partials(folder)
        yield


@contextmanager
def locked(folder: Path, part: str = "") -> Iterator[None]:
    """Hold the folder's lock; the system lets go of it however the process ends.

    Who does a named ``part`` of the work in a folder shares it with other parts, but neither with
    who does all, nor with another of its own name.

    Raises
    ------
    InputError
        When another run is at work in the folder, it cannot be written or locked, or its name is no
        text.
    """
    require_text_name(folder.absolute())
    with readable_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        try:
            _hold(held, folder / ".lock", fcntl.LOCK_SH if part else fcntl.LOCK_EX)
            if part:
                _hold(held, folder / f".lock-{part}", fcntl.LOCK_EX)
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: another run is at work here; wait for it, or choose another --out"
            ) from error
        except OSError as error:
            raise InputError(
                f"{folder}: its file system gives no locks ({error}); choose another --out"
            ) from error
        yield


def _hold(held: ExitStack, path: Path, how: int) -> None:
    with readable_write_errors(path):
        # Network file systems share a lock among those alone who may read.
        handle = held.enter_context(path.open("a+"))
    fcntl.flock(handle, how | fcntl.LOCK_NB)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON whole or not at all."""
    write_whole(path, json.dumps(content, indent=1) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises
    ------
    InputError
        When the disk is full or the place cannot be written; what stood there is untouched.
    """
    # A link stays one, and what is no file, such as /dev/stdout, is written to.
    path = Path(os.path.realpath(path))
    partial = path.with_name(f".{path.name}{PARTIAL}{os.getpid()}")
    with readable_write_errors(path):
        if path.exists() and not path.is_file():
            path.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
            return
        try:
            # File names may hold bytes that are no text.
            partial.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def read_record(products: Path | None) -> dict[str, Any]:
    """What ``run.json`` says; nothing where there is none that can be read."""
    try:
        content = json.loads((products / "run.json").read_bytes()) if products else {}
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def standing_products(study: Path, out: Path) -> list[Path]:
    """The folders in ``out`` with products of a study that may no longer be understood: their
    ``run.json`` names its folder."""
    folder = str(study.resolve())
    return [one for one in patients_in(out) if read_record(one).get("study") == folder]


def patients_in(out: Path) -> list[Path]:
    """The folders in ``out`` that a run wrote in, by name."""
    return sorted(path.parent for path in out.glob("*/run.json"))


def stale_words(field: Path) -> str:
    """That a field is not what the last run over its study was to make; empty where it is, or
    where nothing is said of it."""
    bake = field.resolve().parent
    stages = read_record(bake.parent).get("stages") if bake.name == "bake" else None
    entry = stages.get("bake") if isinstance(stages, dict) else None
    status = entry.get("status") if isinstance(entry, dict) else None
    if status in (None, "done"):
        return ""
    return (
        f"{field}: came of an earlier run than the last one over this study, of which run.json "
        f"says {status}: do not use it for what that one was asked for"
    )


def record_stamp(products: Path | None) -> tuple[int, int]:
    """What changes whenever ``run.json`` is written, if only to the same; (0, 0) without one."""
    try:
        found = (products / "run.json").stat() if products else None
    except OSError:
        found = None
    return (found.st_ino, found.st_mtime_ns) if found else (0, 0)
