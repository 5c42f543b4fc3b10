"""How work is shared among threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from pipeline.geometry import Float

POINTS_A_WORKER = 16_384
"""Fewer points are answered before another thread would have started."""


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    workers = min(processors(), count // POINTS_A_WORKER)
    shared(lambda part: ask(part, phases if len(phases) == 1 else phases[part]), count, workers)


def shared(work: Callable[[slice], None], count: int, workers: int) -> None:
    """Do ``count`` pieces of work, of which ``work`` does a slice, by so many threads."""
    edges = np.linspace(0, count, max(workers, 1) + 1).astype(int).tolist()
    first, *others = (slice(*pair) for pair in pairwise(edges))
    if not others:
        work(first)
        return
    with ThreadPoolExecutor(len(others)) as pool:
        rest = pool.map(work, others)
        # One thread that need not be started.
        work(first)
        list(rest)
