"""What each part of the randomisation is worth: the ablation table of docs/segmentation-model.md.

    python benchmarks/randomisation_parts.py OUT --start training/heart.pt --pool training/pool

Trains a network on with all parts, and one without each of them, from the same weights (those of
the first run of ``make train``, say, which is what makes 500 steps enough), on the same hearts and
seed; then labels stacks of hearts that none of them saw: the phantom's, as its own simulator
renders them, and those of another anatomy and renderer (tests/outside_heart.py). Prints how many
of them each network had refused, and the mean Dice of each structure in the stacks that none had.
Networks that are there already are used again. Needs PyTorch.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1]))

from data_synth.mr import acquire_cine
from data_synth.pathology import PATHOLOGIES
from data_synth.plan import count_slices
from data_synth.population import draw_heart
from data_synth.protocol import MrSettings
from data_synth.training.render import Parts
from pipeline.errors import StageError
from pipeline.imaging import network
from pipeline.imaging.cine import Cine
from pipeline.imaging.labels import LABELS
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import SegmentSettings
from tests.outside_heart import Scan, render

Stack = tuple[Cine, npt.NDArray[np.uint8]]

SEED = 501
"""Of the first stack; none of these hearts is in a training pool, which has its own streams."""


def train_without(part: str | None, out: Path, pool: Path, start: Path | None, steps: int) -> Path:
    """Weights of a network trained without one part, made if they are missing."""
    folder = out / f"without-{part or 'nothing'}"
    if not (folder / "heart.onnx").exists():
        command = [sys.executable, "-m", "data_synth.training", "--out", str(folder)]
        command += ["--pool", str(pool), "--steps", str(steps), "--export-minutes", "1e9"]
        command += ["--batch", "8", "--fresh", "8"]
        command += ["--start", str(start), "--learning-rate", "1e-3"] if start else []
        command += ["--without", part] if part else []
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "heart.onnx"


def phantom_stack(number: int) -> Stack:
    """Two phases of a heart of the phantom, as its simulator renders them, and its labels."""
    rng = np.random.default_rng(SEED + number)
    heart = draw_heart(rng, pathology=PATHOLOGIES[number % len(PATHOLOGIES)])
    settings = MrSettings(phases=2, snr=rng.uniform(10.0, 40.0))
    rr_ms = [1000 * heart.rr_s] * count_slices(heart, settings)
    cine = acquire_cine(rng, heart, rr_ms, settings)
    intensity = cine.intensity.astype(np.float32)
    return Cine(intensity, cine.mr_from_index, cine.phases, heart.rr_s), cine.labels


def outside_stack(number: int) -> Stack:
    """Two phases of a heart of another anatomy and renderer, and its labels."""
    seen = render(SEED + number, Scan(snr=25.0))
    return seen.cine, seen.labels


def overlaps(stack: Stack) -> list[float] | None:
    """Dice of every structure over all slices and phases; None for a stack that is refused."""
    cine, truth = stack
    try:
        found = segment_cine(cine, SegmentSettings(min_confidence=0)).labels
    except StageError:
        return None
    pairs = [(found == value, truth == value) for value in LABELS.values()]
    return [2 * float((a & b).sum()) / max(float(a.sum() + b.sum()), 1.0) for a, b in pairs]


def all_overlaps(weights: Path, stacks: list[Stack]) -> list[list[float] | None]:
    """Dice of each stack by the pipeline with other weights than its own."""
    network.WEIGHTS = weights
    network.idle.clear()
    return [overlaps(stack) for stack in stacks]


def cells(found: list[list[float] | None], shared: list[bool]) -> list[str]:
    """How many stacks were refused, and the mean Dice over those that no network refused."""
    refused = sum(one is None for one in found)
    kept = [one for one, used in zip(found, shared, strict=True) if used and one is not None]
    means = np.mean(kept, axis=0) if kept else np.full(len(LABELS), np.nan)
    return [str(refused), *(f"{value:.3f}" for value in means)]


def main() -> None:
    """Train, label, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--pool", type=Path, help="hearts to train on; made in OUT if not given")
    parser.add_argument("--start", type=Path, help="heart.pt to go on from; else random weights")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--patients", type=int, default=6)
    options = parser.parse_args()
    sets = [
        [make(number) for number in range(options.patients)]
        for make in (phantom_stack, outside_stack)
    ]
    names = [None, *(one.name for one in fields(Parts))]
    pool = options.pool or options.out / "pool"
    found = []
    for part in names:
        weights = train_without(part, options.out, pool, options.start, options.steps)
        found.append([all_overlaps(weights, stacks) for stacks in sets])
    for number, kind in enumerate(("phantom", "outside")):
        rows = [one[number] for one in found]
        shared = [all(each) for each in zip(*rows, strict=True)]
        print(f"\n{kind}: mean Dice of {sum(shared)} stacks that no network refused\n")
        print("| without | refused | " + " | ".join(LABELS) + " |")
        print("|---" * (2 + len(LABELS)) + "|")
        for part, row in zip(names, rows, strict=True):
            print(f"| {part or 'nothing'} | " + " | ".join(cells(row, shared)) + " |")


if __name__ == "__main__":
    main()
