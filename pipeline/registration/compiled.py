"""The one door to the compiled code of the clocks: detector, wave timing and phase."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from pipeline.compiled import door

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_DETECTOR = ("detector_state", "waves", "quality", "envelope", "levels", "rules", "leads", "qrs")
_SOURCES = (*_DETECTOR, "ticks")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a numeric function to machine code; the result is kept on disk between runs."""
    # Only what Python calls needs a way in from there, which would be compiled too.
    inner = function.__name__.startswith("_")
    options = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "no_cpython_wrapper": inner}
    made = door(Path(__file__).parent, _SOURCES, **options)
    return cast("Callable[Parameters, Result]", made(function))
