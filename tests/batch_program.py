"""Programs that stand in for the pipeline's own process, and the table that a batch writes."""

from __future__ import annotations

import csv
import sys
from pathlib import Path


def stand_in(folder: Path, program: str) -> str:
    """Make what `sys.executable` is to be: it runs ``program``, whatever module it is asked for.

    To the program the study is ``sys.argv[4]``, and the folder for products ``sys.argv[6]``.
    """
    script, wrapper = folder / "program.py", folder / "python"
    script.write_text(program)
    # It is to be told not to look for modules where the user happens to be.
    only = '[ "$1" = -P ] || exit 64; shift'
    wrapper.write_text(f'#!/bin/sh\n{only}\nexec "{sys.executable}" "{script}" "$@"\n')
    wrapper.chmod(0o755)
    return str(wrapper)


def rows_of(out: Path, table: str = "batch.csv") -> dict[str, dict[str, str]]:
    """Rows of the table by the name of the patient's folder."""
    with (out / table).open(newline="", encoding="utf-8") as handle:
        return {row["patient"]: row for row in csv.DictReader(handle)}


def make_study(folder: Path, description: str = "", image: str = "") -> Path:
    """A study that can be opened, if not run."""
    (folder / "cine").mkdir(parents=True)
    (folder / "cine" / "image").write_text(image)
    if description:
        (folder / "study.yaml").write_text(description)
    return folder
