"""The one door to the compiled code of the clocks: detector, wave timing and phase."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from numba import njit

from pipeline.compiled import kept_with

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_SOURCES = ("detector_state", "waves", "quality", "levels", "rules", "qrs", "ticks")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a numeric function to machine code; the result is kept on disk between runs."""
    with kept_with(Path(__file__).parent, _SOURCES):
        # Only what Python calls needs a way in from there, which would be compiled too.
        inner = function.__name__.startswith("_")
        made = njit(cache=True, nogil=True, no_cpython_wrapper=inner, no_cfunc_wrapper=True)
        return cast("Callable[Parameters, Result]", made(function))
