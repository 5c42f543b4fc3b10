"""Files that can be read to their end."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

from pipeline.errors import InputError


def require_no_device(path: Path) -> None:
    """Refuse what may never end, or never begin, where a file is to be read.

    Raises
    ------
    InputError
        When it is a pipe, a socket or a device, or a link to one.
    """
    with suppress(OSError):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise InputError(
                f"{path}: is a pipe, a socket or a device, a file is needed; put the file itself "
                "there, or take it out"
            )


def require_text_name(path: Path) -> None:
    """Refuse a path that is no text: libraries that read images end the program at its sight.

    Raises
    ------
    InputError
        When a part of it is no UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        try:
            os.fsencode(path).decode()
        except UnicodeDecodeError:
            wrong = "its name is no UTF-8 text; rename that file or folder"
        else:
            wrong = "this shell's locale lacks letters of its name; set LC_ALL=C.UTF-8"
        raise InputError(f"{path}: {wrong}") from error
