"""How work is shared among threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from pipeline.geometry import Float

POINTS_A_WORKER = 16_384
"""Fewer points are answered before another thread would have started."""


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1


def in_parts(ask: Callable[[slice, Float], None], phases: Float, count: int) -> None:
    """Ask about ``count`` points, shared among the processors where they are many.

    Parameters
    ----------
    ask
        Answers for a slice of the points, at their phases; lets other threads run meanwhile.
    phases
        ``(count,)``, or ``(1,)`` for all.
    count
        How many points there are.
    """

    def part(start: int, end: int) -> None:
        ask(slice(start, end), phases if len(phases) == 1 else phases[start:end])

    workers = min(processors(), count // POINTS_A_WORKER)
    if workers < 2:
        part(0, count)
        return
    edges = np.linspace(0, count, workers + 1).astype(int).tolist()
    with ThreadPoolExecutor(workers - 1) as pool:
        others = pool.map(part, edges[1:-1], edges[2:])
        # One thread that need not be started.
        part(edges[0], edges[1])
        list(others)
