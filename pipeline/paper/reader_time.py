"""How long the reader takes for a tick of 1 ms."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pipeline.evaluation.dissection import TOOLS
from pipeline.geometry import Float
from pipeline.paper.robustness import near_places
from pipeline.paper.subject import Subject
from pipeline.report.page import Section, Table

TICKS = 100_000
SHARES = (50.0, 99.0, 99.9, 99.99, 100.0)


def percentiles_us(work: Callable[[int], object], ticks: int) -> Float:
    """Percentiles ``SHARES`` of the time of one call, microseconds; the first call is left out."""
    work(0)
    spent = np.empty(ticks)
    clock = time.perf_counter_ns
    for n in range(ticks):
        began = clock()
        work(n)
        spent[n] = clock() - began
    return np.percentile(spent, SHARES) / 1000


def reader_time(subject: Subject, seed: int) -> Section:
    """Percentiles of one question, as a loop in Python asks it."""
    field = subject.field
    fixture = next(iter(field.fixtures))
    points, phases = near_places(field, field.fixtures[fixture].structure, seed)
    places = [
        (*point, phase) for point, phase in zip(points.tolist(), phases.tolist(), strict=True)
    ]
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, 3] = points
    rows = [("point", percentiles_us(lambda n: field.force_at(*places[n % len(places)]), TICKS))]
    for name in ("needle", "torus"):
        tool = TOOLS[name]

        def whole(n: int, tool: object = tool) -> object:
            k = n % len(places)
            return field.tool_force(tool, poses[k], places[k][3])  # type: ignore[arg-type]

        rows.append((name, percentiles_us(whole, TICKS // 10)))
    head = ["tool", *[f"{share:g} %" if share < 100 else "longest" for share in SHARES]]
    lines = [(name, *[f"{value:.1f} µs" for value in found]) for name, found in rows]
    return Section(
        "The loop's budget",
        "Time of one question to the reader from Python, measured while this page was made, on a "
        f"machine that may have had other work: {TICKS:,} ticks at scattered places (a tenth for "
        "tools). A tick of 1 kHz is 1000 µs. The longest are the system's interruptions, which a "
        "real-time system would not have.",
        tables=[Table(head, lines)],
    )
