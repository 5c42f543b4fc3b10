"""The one door to the compiled code of the clocks: detector, wave timing and phase."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

from pipeline.compiled import door

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_DETECTOR = ("detector_state", "waves", "quality", "envelope", "levels", "rules", "leads", "qrs")
_SOURCES = (*_DETECTOR, "intervals", "ticks")


def asked(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile what Python calls; the result is kept on disk between runs."""
    return _compile(function, no_cpython_wrapper=False)


def inner(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile what only compiled code calls: a way in from Python would be compiled too."""
    return _compile(function, no_cpython_wrapper=True)


def _compile(
    function: Callable[Parameters, Result], no_cpython_wrapper: bool
) -> Callable[Parameters, Result]:
    options = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}
    made = door(Path(__file__).parent, _SOURCES, **options, no_cpython_wrapper=no_cpython_wrapper)
    return cast("Callable[Parameters, Result]", made(function))
