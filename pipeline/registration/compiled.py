"""The one door to the compiled code of the clocks: detector, wave timing and phase."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from pipeline.compiled import door

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_DETECTOR = (
    "detector_state",
    "waves",
    "quality",
    "envelope",
    "levels",
    "rules",
    "echoes",
    "leads",
    "qrs",
)
_SOURCES = (*_DETECTOR, "intervals", "ticks")


def asked(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile what Python calls; the result is kept on disk between runs."""
    return _compile(function, no_cpython_wrapper=False)


def inner(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile what only compiled code calls: a way in from Python would be compiled too."""
    return _compile(function, no_cpython_wrapper=True)


def within(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile as a part of what calls it, once: each level of calls that a large function lies
    below is optimised with all that it calls, and again with those above."""
    return _compile(function, no_cpython_wrapper=True, inline="always")


def _compile(function: Callable[Parameters, Result], **given: Any) -> Callable[Parameters, Result]:
    options = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, **given}
    made = door(Path(__file__).parent, _SOURCES, **options)
    return cast("Callable[Parameters, Result]", made(function))
