"""A pool of tissue blocks: beating hearts of the population, frozen and cut into thin planes.

Drawing tissue is slow, drawing images of it is quick: the pool is made once and every training
step draws new images from it. A block is a stack of thin parallel planes in a frame that
`canonical_axes` fixes from the patient's own directions, so that left stays left.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import numpy.typing as npt

from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.pathology import PATHOLOGIES
from data_synth.population import draw_heart

Float = npt.NDArray[np.float64]
Label = npt.NDArray[np.uint8]
Progress = Callable[[int, int], None]
Drawn = TypeVar("Drawn")

PIXEL_MM = 1.5
PLANES = 48
SIDE = 176
PLANE_STEP_MM = (2.0, 4.2)
"""Least and largest distance between planes. A slice's neighbour lies three planes away, so
images are drawn with slices 6 to 12.6 mm apart."""

ILL_SHARE = 0.4
"""Share of hearts drawn from all pathologies alike; the others are healthy."""
HEART_RATES_BPM = (50.0, 110.0)

STREAM = 7001
"""Keeps the training hearts apart from those of studies drawn with the same seed."""


@dataclass(frozen=True, slots=True)
class PoolSettings:
    """How many hearts, how far from the mean, and the seed they come from."""

    hearts: int = 240
    blocks_per_heart: int = 3
    spread: float = 1.6
    seed: int = 0


@dataclass(frozen=True, slots=True)
class PlaneFrame:
    """Where the planes of a block lie in the patient (LPS)."""

    origin_mm: Float
    """``(3,)`` position of the first pixel of the first plane."""

    axes: Float
    """``(3, 3)`` rows: unit vectors along columns, along rows, from plane to plane."""

    plane_step_mm: float
    """Distance between planes; pixels are `PIXEL_MM` apart."""


def canonical_axes(normal: Float) -> Float:
    """Axes of an image plane, the same for every patient lying in the scanner.

    The third axis is ``normal``, turned to run from the apex towards the base: right, posterior
    and up. The first is the patient's left seen in the plane (in a sagittal plane, posterior);
    the second makes the three right-handed.

    Parameters
    ----------
    normal
        ``(3,)`` normal of the plane, LPS, of any length and sign.

    Returns
    -------
    (3, 3) array
        Rows are unit vectors: along columns, along rows, from plane to plane.
    """
    towards_base = normal / np.linalg.norm(normal)
    if towards_base @ (-1.0, 1.0, 1.0) < 0:
        towards_base = -towards_base
    left = np.array([1.0, 0.0, 0.0])
    # Within 17 degrees of the normal, left projects onto too short a shadow to give a direction.
    if abs(towards_base[0]) > np.cos(np.radians(17)):
        left = np.array([0.0, 1.0, 0.0])
    across = left - (left @ towards_base) * towards_base
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards_base, across), towards_base])


def draw_frame(rng: np.random.Generator, heart: BeatingHeart) -> PlaneFrame:
    """Draw the planes of one block: near short axis nine times in ten, else any direction."""
    if rng.random() < 0.9:
        normal = heart.long_axis + rng.normal(0.0, 0.2, 3)
    else:
        normal = rng.normal(0.0, 1.0, 3)
    axes = canonical_axes(normal)
    step_mm = rng.uniform(*PLANE_STEP_MM)
    # Planes far apart cover the heart from end to end; close ones only a part, drawn at random.
    slack_mm = max(0.0, 150.0 - PLANES * step_mm) / 2 + 10.0
    middle_mm = heart.centre_mm + axes[2] * rng.uniform(-slack_mm, slack_mm)
    middle_mm = middle_mm + axes[:2].T @ rng.normal(0.0, 8.0, 2)
    half = np.array([SIDE - 1, SIDE - 1, PLANES - 1]) / 2 * (PIXEL_MM, PIXEL_MM, step_mm)
    return PlaneFrame(middle_mm - half @ axes, axes, step_mm)


def cut_block(heart: BeatingHeart, phase: float, frame: PlaneFrame) -> Label:
    """Tissue at every pixel of every plane, ``(plane, row, column)``."""
    column, row = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    in_plane_mm = np.stack([column.ravel(), row.ravel()], axis=1) * PIXEL_MM @ frame.axes[:2]
    block = np.empty((PLANES, SIDE, SIDE), np.uint8)
    for plane in range(PLANES):
        shift_mm = frame.origin_mm + plane * frame.plane_step_mm * frame.axes[2]
        block[plane] = heart.tissue(in_plane_mm + shift_mm, phase).reshape(SIDE, SIDE)
    return block


def heart_blocks(number: int, settings: PoolSettings) -> Label:
    """The blocks of one heart, ``(block, plane, row, column)``, whatever other hearts there are."""
    rng = np.random.default_rng([STREAM, settings.seed, number])
    ill = rng.random() < ILL_SHARE
    pathology = str(rng.choice(PATHOLOGIES)) if ill else "healthy"
    heart = draw_heart(rng, settings.spread, pathology, rng.uniform(*HEART_RATES_BPM))
    # One of a heart's three moments is near end-systole, where the cavity is smallest and hardest.
    phases = [
        rng.uniform(0.0, 1.0) if k % 2 == 0 else rng.normal(heart.pulse.end_systole, 0.07)
        for k in range(settings.blocks_per_heart)
    ]
    return np.stack([cut_block(heart, phase % 1.0, draw_frame(rng, heart)) for phase in phases])


def fill_pool(
    folder: Path, settings: PoolSettings, progress: Progress | None = None, workers: int = 1
) -> list[Path]:
    """Write the hearts that the folder lacks, one file each; return all files in order.

    Each of ``workers`` processes draws whole hearts; their number changes no byte.

    Raises
    ------
    SynthError
        When the folder's hearts were drawn with another spread or number of blocks.
    """
    asked = {"blocks_per_heart": settings.blocks_per_heart, "spread": settings.spread}
    paths = [
        folder / f"seed{settings.seed}_heart{number:04d}.npy" for number in range(settings.hearts)
    ]
    fill(paths, asked, partial(heart_blocks, settings=settings), np.save, progress, workers)
    return paths


def fill(
    paths: Sequence[Path],
    asked: dict[str, Any],
    draw: Callable[[int], Drawn],
    save: Callable[[BinaryIO, Drawn], None],
    progress: Progress | None,
    workers: int,
) -> None:
    """Draw hearts, by number, whose files are not there, and note what they were asked for.

    Raises
    ------
    SynthError
        When the folder's hearts were asked for otherwise.
    """
    if not paths:
        return
    folder = paths[0].parent
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "pool.json"
    if note.exists() and (drawn_with := json.loads(note.read_text())) != asked:
        raise SynthError(f"{folder}: its hearts were drawn with {drawn_with}, not {asked}")
    note.write_text(json.dumps(asked) + "\n")
    lacking = [number for number, path in enumerate(paths) if not path.exists()]
    for number, drawn in zip(lacking, _each(draw, lacking, workers), strict=True):
        part = paths[number].with_suffix(".part")
        with part.open("wb") as file:
            save(file, drawn)
        part.rename(paths[number])
        if progress is not None:
            progress(number + 1, len(paths))


def _each(draw: Callable[[int], Drawn], numbers: Sequence[int], workers: int) -> Iterator[Drawn]:
    """What is drawn of each heart in turn."""
    if workers <= 1:
        yield from map(draw, numbers)
    else:
        with ProcessPoolExecutor(workers) as pool:
            yield from pool.map(draw, numbers)
