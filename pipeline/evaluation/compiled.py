"""The one door to the compiled code of the simulated dissection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numba import njit

from pipeline.compiled import kept_with
from pipeline.field.kernels import ASKED, INNER

_SOURCES = (
    *("rod", "dissection_forces", "dissection_loop", "dissection_values", "operators"),
    *(f"../field/{name}" for name in ("potential", "kernels", "tool_kernels")),
)


def asked(function: Any) -> Any:
    """Compile what Python calls."""
    with kept_with(Path(__file__).parent, _SOURCES):
        return njit(**ASKED)(function)


def inner(function: Any) -> Any:
    """Compile what only compiled code calls."""
    with kept_with(Path(__file__).parent, _SOURCES):
        return njit(**INNER)(function)
