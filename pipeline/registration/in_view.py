"""Whether there are frames enough, and they cross the heart at all, wherever near its start the
tracker may stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import InputError, UnregistrableError
from pipeline.geometry import Float
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.search import Level, Search
from pipeline.registration.settings import RegisterSettings

LEAST_IN_VIEW = 0.05
"""A frame with less of its picture in blood or at its walls has too little to compare."""

_INVERTED = (
    "by its inverse they do: is the start (us.initial_mr_from_tracker, us.landmarks) given "
    "the other way round?"
)
_MISPLACED = (
    "is the start (us.initial_mr_from_tracker, us.landmarks) right? look at directions (each name "
    "tells its own: tracker to MR, "
    "ProbeToTracker, ImageToProbe), calibration, units (mm) and axes (LPS; 3D Slicer shows RAS)"
)


def require_frames(
    sweeps: Sequence[TrackedSweep], phases: Sequence[Float], settings: RegisterSettings
) -> None:
    """Refuse fewer frames than are needed.

    Raises
    ------
    InputError
        When there are phases for another number of sweeps, or too few frames.
    """
    if len(sweeps) != len(phases):
        raise InputError(f"{len(sweeps)} sweeps came with phases for {len(phases)}")
    frames = sum(len(sweep.images) for sweep in sweeps)
    if frames < settings.min_frames:
        raise UnregistrableError(
            f"{len(sweeps)} sweeps hold {frames} frames; registration needs {settings.min_frames} "
            "or more (register.min_frames): add sweeps, or write `us: null` in study.yaml"
        )


def require_heart_in_view(level: Level, search: Search) -> None:
    """Refuse frames that miss the heart wherever the tracker may stand.

    Raises
    ------
    InputError
        When too few cross it at every pose near the start; `UnregistrableError` unless they do at
        poses near its inverse.
    """
    if search.start is None:
        return
    settings, frames = search.settings, level.samples.frames
    share = settings.min_frames / sum(map(len, search.phases))
    needed, seen = max(1, int(share * frames)), _most_in_view(level, search)
    if seen < needed:
        inverse = replace(search, start=np.asarray(np.linalg.inv(search.start), dtype=float))
        inverted = _most_in_view(level, inverse) >= needed
        raise (InputError if inverted else UnregistrableError)(
            f"of {frames} frames looked at, at most {seen} cross the heart at any pose within "
            f"{settings.capture_mm:g} mm and {settings.capture_deg:g} degrees of the start; "
            + (_INVERTED if inverted else _MISPLACED)
        )


def _most_in_view(level: Level, search: Search) -> int:
    poses = search.candidates(level)
    return max(int((level.at(pose).in_view > LEAST_IN_VIEW).sum()) for pose in poses)
