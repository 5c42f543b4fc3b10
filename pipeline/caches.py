"""Where compiled code is kept between runs, for users of all kinds: some may write nowhere."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

from pipeline.errors import InputError

PLACE = "NUMBA_CACHE_DIR"
"""By which the compiler is told of a place; processes begun by this one hear of it too."""

_SOME_BYTES = 65536


def provide_place() -> None:
    """Give the compiler a place where it would find none, and would end the program for it.

    Raises
    ------
    InputError
        When not even temporary files may be written, or the user's own place may not.
    """
    if given := os.environ.get(PLACE):
        if not is_writable(Path(given)):
            raise InputError(
                f"{given}: {PLACE} names it for compiled code, and it cannot be written; name a "
                "folder that you may write in, or unset that"
            )
        return
    if os.access(Path(__file__).parent, os.W_OK):
        return
    own = own_caches()
    if own is None or not is_writable(own):
        os.environ[PLACE] = str(place_of_this_run())


def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if need be, and something in them."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            # A full disk still takes an empty one.
            file.write(bytes(_SOME_BYTES))
            file.flush()
    except OSError:
        return False
    return True


def own_caches() -> Path | None:
    """The user's folder for what can be made again; None where the user has none."""
    caches = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(caches) if caches else Path.home() / ".cache") / "beatfield"
    except RuntimeError:
        # Neither HOME nor the system's list of users tells of one, as in many containers.
        return None


@cache
def place_of_this_run() -> Path:
    """A new folder, for stored code is run: nobody else may have put some there.

    Raises
    ------
    InputError
        When there is no place for temporary files.
    """
    try:
        folder = tempfile.mkdtemp(prefix="beatfield-")
    except OSError as error:
        raise InputError(
            f"compiled code can be kept nowhere ({error.strerror}): give a folder that you may "
            "write in as XDG_CACHE_HOME or TMPDIR"
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
