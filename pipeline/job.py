"""What a stage is given to work on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.progress import Progress
from pipeline.sealing import sealed

if TYPE_CHECKING:
    # For types only: a stage's product must not depend on the settings of other stages.
    from pipeline.config import Settings
    from pipeline.study import Study


class Skipped(Exception):
    """Raised by a stage that has nothing to do in this study; says why."""


@dataclass(frozen=True, slots=True)
class Job:
    """One stage's share of a run."""

    study: Study
    settings: Settings
    products: Path
    """Where the finished stages lie, each in a folder of its name."""

    folder: Path
    """Where this stage writes."""

    progress: Progress
    """Told how much is done, of how much."""

    inputs: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """SHA-256 of the study's files that the stage depends on, by kind and path."""

    fingerprint: str = ""
    """Of all that the stage's product is made of, as ``stage.json`` and ``run.json`` have it."""

    skipped: Mapping[str, str] = field(default_factory=dict)
    """Why a stage before this one made nothing, for a stage that repeats such reasons."""

    def product(self, stage: str) -> Path | None:
        """The folder of a finished stage, or None where it was skipped."""
        path = self.products / stage
        return path if path.is_dir() else None

    def figures(self, stage: str) -> dict[str, Any]:
        """What a finished stage measured."""
        content = sealed(self.products / stage)
        assert content is not None, f"{stage} is finished before this stage begins"
        figures: dict[str, Any] = content["figures"]
        return figures
