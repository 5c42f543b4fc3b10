"""Frames whose pictures are the same but in the wrong place: how well they agree is chance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from pipeline.geometry import Float, Float32
from pipeline.registration.frames import BloodSweep, DisplacedSweep, TrackedSweep, sector_of
from pipeline.registration.search import Search


def mirrored(sweep: TrackedSweep) -> TrackedSweep:
    """The sweep with left and right exchanged: the same pictures and sector, no anatomy."""
    return _turned_over(sweep, "mirrored", 0)


def upside_down(sweep: TrackedSweep) -> TrackedSweep:
    """The sweep with near and far exchanged."""
    return _turned_over(sweep, "upside down", 1)


def backwards(sweep: TrackedSweep) -> TrackedSweep:
    """The sweep with its pictures in reverse order: each at the pose and phase of another."""
    return _displaced(sweep, "backwards", sweep.images[::-1], sweep.tracker_from_image)


def _turned_over(sweep: TrackedSweep, how: str, axis: int) -> TrackedSweep:
    """With the sector's columns (axis 0) or rows (1) in the opposite order."""
    shown = np.flatnonzero(sector_of(sweep).any(axis=axis))
    swap = np.eye(4)
    swap[axis, axis], swap[axis, 3] = -1, shown[0] + shown[-1]
    return _displaced(sweep, how, sweep.images, sweep.tracker_from_image @ swap)


def _displaced(
    sweep: TrackedSweep, how: str, images: Float32, tracker_from_image: Float
) -> TrackedSweep:
    name = f"{sweep.name} {how}"
    if isinstance(sweep, BloodSweep):
        return BloodSweep(name, images, tracker_from_image, sweep.sector)
    return DisplacedSweep(name, images, tracker_from_image)


_WRONG_PLACES: Mapping[str, Callable[[TrackedSweep], TrackedSweep]] = {
    "mirrored from left to right (ImageToProbe, UltrasoundImageOrientation)": mirrored,
    "turned upside down (ImageToProbe, UltrasoundImageOrientation)": upside_down,
    "in reverse order (time stamps)": backwards,
}
"""How frames are misplaced, and what to look at where they fit better so."""


def by_chance(search: Search, pose: Float, sweeps: Sequence[TrackedSweep]) -> tuple[float, str]:
    """The best score that frames in the wrong place reach, and which place that is."""
    # Turned at will, mirrored frames fit a heart seen from behind: they are sought near the result.
    nearby = replace(search, start=pose) if search.start is None else search

    def reached(displaced: Callable[[TrackedSweep], TrackedSweep]) -> float:
        return nearby.best([displaced(sweep) for sweep in sweeps]).score

    # At the same time: sums over samples let others run while they count.
    with ThreadPoolExecutor(2) as pool:
        scores = pool.map(reached, _WRONG_PLACES.values())
        return max(zip(scores, _WRONG_PLACES, strict=True))
