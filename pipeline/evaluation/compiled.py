"""The one door to the compiled code of the simulated dissection."""

from __future__ import annotations

from pathlib import Path

from pipeline.compiled import door
from pipeline.field.kernels import ASKED, INNER

_SOURCES = (
    *("rod", "dissection_forces", "dissection_loop", "dissection_values", "operators"),
    *(f"../field/{name}" for name in ("potential", "kernels", "tool_kernels")),
    "../compiled",
)


asked = door(Path(__file__).parent, _SOURCES, **ASKED)
"""Compiles what Python calls."""

inner = door(Path(__file__).parent, _SOURCES, **INNER)
"""Compiles what only compiled code calls."""
