"""A beating-heart phantom: anatomy, motion, cine MR, ECG and tracked ultrasound with exact truth.

As a library::

    from data_synth import PhantomSettings, load_heart, simulate_study, write_study

    settings = PhantomSettings(seed=7, pathology="infarct")
    heart = load_heart(settings)                      # label, place, displacement, velocity
    write_study(Path("patient-0007"), settings)       # the whole study, as files
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data_synth.errors import SynthError
    from data_synth.heart import BeatingHeart
    from data_synth.population import draw_heart
    from data_synth.preview import write_preview
    from data_synth.settings import PhantomSettings, read_settings
    from data_synth.simulate import SyntheticStudy, load_heart, settings_of, simulate_study
    from data_synth.study import write_study
    from data_synth.tissue import TRUTH_LABELS, Tissue

_HOME = {
    "BeatingHeart": "heart",
    "PhantomSettings": "settings",
    "SynthError": "errors",
    "SyntheticStudy": "simulate",
    "TRUTH_LABELS": "tissue",
    "Tissue": "tissue",
    "draw_heart": "population",
    "load_heart": "simulate",
    "read_settings": "settings",
    "settings_of": "simulate",
    "simulate_study": "simulate",
    "write_preview": "preview",
    "write_study": "study",
}
"""Public name -> module; each is imported when it is first asked for, as compilers are slow."""

__all__ = [
    "TRUTH_LABELS",
    "BeatingHeart",
    "PhantomSettings",
    "SynthError",
    "SyntheticStudy",
    "Tissue",
    "draw_heart",
    "load_heart",
    "read_settings",
    "settings_of",
    "simulate_study",
    "write_preview",
    "write_study",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'data_synth' has no attribute {name!r}")
    return getattr(import_module(f"data_synth.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
