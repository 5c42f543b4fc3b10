"""The baked field: distance, potential, the store, and the reader that a force server loads.

``ForceField`` reads a field with JSON and memory maps alone; everything else here is loaded only
when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.field.fixture import BakeSettings, Fixture
    from pipeline.field.reader import ForceField

__all__ = ["BakeSettings", "Fixture", "ForceField", "get_include"]

_HOMES = {"BakeSettings": "fixture", "Fixture": "fixture", "ForceField": "reader"}


def get_include() -> str:
    """Folder of ``beatfield.h``, the reader for C and C++: ``cc -I $(...)``."""
    from pathlib import Path

    return str(Path(__file__).parent / "include")


def __getattr__(name: str) -> Any:
    # Settings are read on every start of the command line; the reader's NumPy can wait.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
