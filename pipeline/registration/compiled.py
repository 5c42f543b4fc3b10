"""The one door to the compiled code of the clocks: detector, wave timing and phase."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from numba import config, njit

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_SOURCES = ("detector_state", "waves", "quality", "qrs", "ticks")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a numeric function to machine code; the result is kept on disk between runs.

    The compiler looks at a function's own file alone to tell whether its stored code still holds,
    not at those of the functions it calls. So the folder is named by the sources of all.
    """
    usual = config.CACHE_DIR
    config.CACHE_DIR = str(Path(usual or Path(__file__).parent / "__pycache__") / _digest())
    try:
        # Only what Python calls needs a way in from there, which would be compiled too.
        inner = function.__name__.startswith("_")
        made = njit(cache=True, nogil=True, no_cpython_wrapper=inner, no_cfunc_wrapper=True)
        return cast("Callable[Parameters, Result]", made(function))
    finally:
        config.CACHE_DIR = usual


@cache
def _digest() -> str:
    sources = [Path(__file__).with_name(f"{name}.py").read_bytes() for name in _SOURCES]
    return "numba-" + hashlib.sha256(b"".join(sources)).hexdigest()[:12]
