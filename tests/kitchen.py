"""Three small stages in place of the real ones; what the runner does with them it does with all."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pipeline import run as runner
from pipeline.config import Settings
from pipeline.job import Job
from pipeline.study import Study, open_study

Body = Callable[[Job], dict[str, Any]]


class Silent:
    """A watcher that only remembers."""

    def __init__(self) -> None:
        self.outcomes: dict[str, str] = {}

    def started(self, stage: str) -> None: ...

    def progress(self, done: int, total: int) -> None: ...

    def ended(self, stage: str, outcome: str, seconds: float) -> None:
        self.outcomes[stage] = outcome


class Kitchen:
    """Three stages, a after nothing, b after a, c after a and b, whose bodies can be swapped."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = root / "studies" / "p1"
        (self.folder / "cine").mkdir(parents=True)
        (self.folder / "cine" / "image").write_text("first")
        self.out = root / "out"
        self.calls: list[str] = []
        self.bodies: dict[str, Body] = {}
        stages = (
            runner.Stage("a", inputs=("cine",)),
            runner.Stage("b", after=("a",), settings=("bake",)),
            runner.Stage("c", after=("a", "b")),
        )
        monkeypatch.setattr(runner, "STAGES", stages)
        monkeypatch.setattr(runner, "STAGE_NAMES", tuple(stage.name for stage in stages))
        for stage in stages:
            self._register(stage, monkeypatch)

    def _register(self, stage: runner.Stage, monkeypatch: pytest.MonkeyPatch) -> None:
        def run(job: Job) -> dict[str, Any]:
            self.calls.append(stage.name)
            if stage.name in self.bodies:
                return self.bodies[stage.name](job)
            before = [(job.products / name / "text").read_text() for name in stage.after]
            before += [(job.study.cine.path / "image").read_text()] if stage.inputs else []
            (job.folder / "text").write_text(f"{stage.name}({','.join(before)})")
            return {"figure": 1.5}

        module = ModuleType(f"pipeline.stages.{stage.name}")
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)

    def study(self) -> Study:
        return open_study(self.folder)

    def run(
        self, settings: Settings | None = None, watcher: Silent | None = None, **keys: Any
    ) -> dict[str, str]:
        """Run; return which stages did what."""
        self.calls.clear()
        watcher = watcher or Silent()
        runner.run_study(self.study(), settings or Settings(), self.out, watcher, **keys)
        return watcher.outcomes

    def text(self, stage: str) -> str:
        return (self.out / "p1" / stage / "text").read_text()

    def record(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.out / "p1" / "run.json").read_text())
        return content
