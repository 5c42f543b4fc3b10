"""What a study's process left when it ended: its exit code, its log, and products of others."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

from pipeline.batch_table import INTERRUPTED
from pipeline.errors import INTERRUPTED_CODE, NOT_TO_BE_USED
from pipeline.publish import read_record
from pipeline.sealing import STAGE_FILE

TOLD_TO_END = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_LIBRARIES_SAY = ("Task exception", "Traceback", "Exception ignored")
"""How what a library or Python itself tells of an error begins."""
OUT_OF_MEMORY = (signal.SIGKILL, signal.SIGABRT)
"""How the system ends a program that asks for too much memory, and how libraries end theirs."""


def how_it_ended(code: int, log: Path, told_to_end: bool) -> tuple[str, str]:
    """Status and cause, from the exit code and what the program said last."""
    if code == 0:
        return "done", ""
    lines = log.read_text(errors="replace").splitlines()
    error, notes = _said(lines)
    if error and code > 0:
        return "failed", "; ".join([error, *notes])
    # Libraries may take an interrupt for an error of their own.
    if told_to_end or code == INTERRUPTED_CODE or -code in TOLD_TO_END:
        return INTERRUPTED, "; ".join(["what was finished is kept", *notes])
    last = lines[-1] if lines else "no message (its log is empty: is the disk full?)"
    why = _signal_name(-code) if code < 0 else last
    if -code in OUT_OF_MEMORY or "MemoryError" in last or "bad_alloc" in last:
        why += "; memory may be short: use fewer --workers"
    return "crashed", f"{why}; see {log}"


def _said(lines: Sequence[str]) -> tuple[str, list[str]]:
    """The last error and the notes after it, each in one line; no error where none was told."""
    starts = [number for number, line in enumerate(lines) if line.startswith("error: ")]
    parts: list[list[str]] = []
    ended = True
    for line in lines[starts[-1] if starts else 0 :]:
        if line.startswith(("error: ", "note: ")):
            parts.append([line.partition(": ")[2]])
            ended = False
        elif not line.strip() or line.startswith(_LIBRARIES_SAY):
            ended = True
        elif not ended:
            parts[-1].append(line.strip())
    joined = ["; ".join(part) for part in parts]
    return (joined[0], joined[1:]) if starts else ("", joined)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def old_products(products: Path | None, came_to_a_stage: bool) -> str:
    """A sentence on products that a study which is not done leaves standing; empty without any."""
    if products is None or not any(products.glob(f"*/{STAGE_FILE}")):
        return ""
    if not came_to_a_stage:
        return f"{products} holds products of another run; {NOT_TO_BE_USED}"
    stages = read_record(products).get("stages", {})
    stale = ", ".join(name for name, one in stages.items() if one.get("status") == "stale")
    return f"{stale} in {products} came of another run; {NOT_TO_BE_USED}" if stale else ""
