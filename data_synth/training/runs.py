"""What a run of the training is asked for, and how far it has come: cut short, it goes on."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from data_synth.errors import SynthError
from data_synth.training.network import WIDTHS
from data_synth.training.render import ALL_PARTS, Parts


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """How long and how fast to learn; steps or minutes, whichever ends first."""

    steps: int = 100_000
    minutes: float = math.inf
    batch: int = 64
    fresh: int = 8
    """Images of a batch that are drawn anew; the others are seen again. Drawing takes longer than
    learning on a graphics processor (Choi et al., "Faster neural network training with data
    echoing", 2019)."""

    kept: int = 60_000
    """Images kept to be seen again, the last ones drawn: 147 KB each."""

    learning_rate: float = 2e-3
    overlap_weight: tuple[float, float] = (1.0, 0.2)
    """Of the Dice term at the start and at the end: it makes small structures appear early, and
    would make the network too sure of itself late. A run that goes on from a checkpoint has the
    second all along."""

    widths: tuple[int, ...] = WIDTHS
    """Channels of the network of MR."""

    start: Path | None = None
    """Checkpoint to go on from, of as wide a network or a narrower one; by default weights are
    drawn at random."""

    parts: Parts = ALL_PARTS
    """What is drawn at random in the images."""

    hearts: str = ""
    """Which hearts are drawn from: a run that was cut short goes on with the same alone."""

    seed: int = 0
    export_minutes: float = 5.0
    threads: int = 1
    workers: int = 0
    """Processes that draw; 0: the one that learns draws, too. Their number changes no image."""


def load_weights(checkpoint: Path) -> dict[str, Any]:
    """Weights by name, as `save` wrote them."""
    weights: dict[str, Any] = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return weights


def has_ended(out: Path, settings: TrainSettings) -> bool:
    """Whether a run of these settings has ended, and left ``out`` as ``.onnx`` and ``.pt``.

    Raises
    ------
    SynthError
        When what is there is of a run of other settings.
    """
    kept = out.with_suffix(".run")
    return (
        kept.is_file()
        and left_of(out, settings) is None
        and all(out.with_suffix(suffix).is_file() for suffix in (".onnx", ".pt"))
    )


def left_of(out: Path, settings: TrainSettings) -> dict[str, Any] | None:
    """The state that a run of these settings had when it was kept last; None of one that has not
    begun, or has ended.

    Raises
    ------
    SynthError
        When what is there is of a run of other settings.
    """
    kept = out.with_suffix(".run")
    if not kept.is_file():
        return None
    run = torch.load(kept, map_location="cpu", weights_only=True)
    asked = _asked(settings)
    if other := [name for name in asked if run["asked"].get(name) != asked[name]]:
        told = "; ".join(f"{name} {run['asked'].get(name)}, now {asked[name]}" for name in other)
        raise SynthError(
            f"{kept} is of a run of other settings ({told}); give another folder, or remove that "
            "file to begin anew"
        )
    state: dict[str, Any] | None = run["state"]
    return state


def keep(out: Path, settings: TrainSettings, state: dict[str, Any] | None) -> None:
    """Write what `left_of` reads, at once or not at all; no state of a run that has ended."""
    part = out.with_suffix(".run.part")
    torch.save({"asked": _asked(settings), "state": state}, part)
    part.replace(out.with_suffix(".run"))


def _asked(settings: TrainSettings) -> dict[str, str]:
    """What decides on the network that a run ends with."""
    free = ("export_minutes", "threads", "workers", "start")
    asked = {name: str(value) for name, value in asdict(settings).items() if name not in free}
    start = settings.start
    begin = "random weights" if start is None else hashlib.sha256(start.read_bytes()).hexdigest()
    return {**asked, "start": begin}
