"""Machine code that is kept between runs, and thrown away with any source that it was made from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from numba import config


@contextmanager
def kept_with(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Have what is made for a compiler meanwhile kept in a place of these sources' own.

    The compiler looks at a function's own file alone to tell whether its stored code still holds,
    not at those of the functions it calls. So the place is named by the sources of all.

    Parameters
    ----------
    folder
        Where the sources are.
    names
        Theirs, without ``.py``: all files with compiled functions that call one another, and those
        of the numbers that they take for constants.
    """
    usual = config.CACHE_DIR
    config.CACHE_DIR = str(Path(usual or folder / "__pycache__") / _digest(folder, *names))
    try:
        yield
    finally:
        config.CACHE_DIR = usual


@cache
def _digest(folder: Path, *names: str) -> str:
    sources = [(folder / f"{name}.py").read_bytes() for name in names]
    return "numba-" + hashlib.sha256(b"".join(sources)).hexdigest()[:12]
