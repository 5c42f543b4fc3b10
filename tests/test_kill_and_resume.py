"""What benchmarks/kill_and_resume.py compares of two runs."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

from pipeline.run import MEASURED

FOLDER = str(Path(__file__).parents[1] / "benchmarks")
sys.path.insert(0, FOLDER)
kill_and_resume = importlib.import_module("kill_and_resume")
sys.path.remove(FOLDER)


def products(folder: Path, measured: object, found: int):
    """Those of a run of one stage."""
    folder.mkdir()
    stages = {"ingest": dict.fromkeys(MEASURED, measured) | {"figures": {"phases": found}}}
    (folder / "run.json").write_text(json.dumps({"stages": stages}))
    return kill_and_resume.products(folder)


@pytest.mark.parametrize(("found", "code"), [(25, 0), (24, 1)])
def test_runs_differ_by_what_they_found_and_not_by_when_and_how_fast(tmp_path, found, code):
    calm = products(tmp_path / "calm", "2026-01-01T10:00:00+00:00", 25)
    other = products(tmp_path / "other", "2026-01-01T10:01:00+00:00", found)
    assert kill_and_resume.compare(calm, other) == code
