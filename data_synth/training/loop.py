"""The training loop: draw, learn, average, export."""

from __future__ import annotations

import copy
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from data_synth.training.export import write_onnx
from data_synth.training.network import HeartNet, UNet, loss
from data_synth.training.render import ALL_PARTS, Parts, draw_sample

Label = npt.NDArray[np.uint8]
Report = Callable[[int, float, float], None]
Net = TypeVar("Net", bound=UNet)


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """How long and how fast to learn; steps or minutes, whichever ends first."""

    steps: int = 16_000
    minutes: float = math.inf
    batch: int = 8
    learning_rate: float = 2e-3
    overlap_weight: tuple[float, float] = (1.0, 0.2)
    """Of the Dice term at the start and at the end: it makes small structures appear early, and
    would make the network too sure of itself late. A run that goes on from a checkpoint has the
    second all along."""

    start: Path | None = None
    """Checkpoint to go on from; by default weights are drawn at random."""

    halfway_from: Path | None = None
    """Checkpoint to end half-way from, between its weights and those learned: what is new is
    learned and what was known kept (Wortsman et al., "Robust fine-tuning of zero-shot models",
    CVPR 2022).
    Running statistics are averaged like weights. What is exported on the way is not half-way."""

    parts: Parts = ALL_PARTS
    """What is drawn at random in the images."""

    seed: int = 0
    export_minutes: float = 5.0
    threads: int = 1


Batch = tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]
Loss = Callable[[Any, Any, float], Any]
"""Of scores and labels, with the weight of the Dice term."""


def draw_batches(blocks: Sequence[Label], settings: TrainSettings) -> Iterator[Batch]:
    """Endless batches of ``(n, 3, row, column)`` images and labels; the seed fixes them all."""
    rng = np.random.default_rng([settings.seed, 7002])
    while True:
        picks = rng.integers(len(blocks), size=settings.batch)
        samples = [draw_sample(rng, blocks[pick], settings.parts) for pick in picks]
        images = np.stack([sample.image for sample in samples])
        yield images, np.stack([sample.labels for sample in samples]).astype(np.int64)


class Average:
    """Running mean of weights: smoother than the last step's, and what is exported."""

    def __init__(self, network: UNet) -> None:
        self.network = copy.deepcopy(network)
        self.steps = 0

    def update(self, network: UNet) -> None:
        """Take in the weights after one more step."""
        self.steps += 1
        keep = min(0.997, self.steps / (self.steps + 20))
        with torch.no_grad():
            pairs = zip(self.network.state_dict().values(), network.state_dict().values())  # noqa: B905
            for mean, new in pairs:
                if mean.dtype.is_floating_point:
                    mean.mul_(keep).add_(new, alpha=1 - keep)
                else:
                    mean.copy_(new)


def train(
    blocks: Sequence[Label], settings: TrainSettings, out: Path, report: Report | None = None
) -> HeartNet:
    """Train the network of MR, writing ``out/heart.onnx`` and ``out/heart.pt``: see `learn`."""
    batches = draw_batches(blocks, settings)
    return learn(HeartNet, batches, loss, settings, out / "heart", report)


def learn(
    make: Callable[[], Net],
    batches: Iterator[Batch],
    loss_of: Loss,
    settings: TrainSettings,
    out: Path,
    report: Report | None = None,
) -> Net:
    """Train a network, writing ``out`` as ``.onnx`` and ``.pt`` now and then and at the end.

    The result depends on the batches, the seed and the number of steps alone (on one kind of
    processor) when ``minutes`` does not cut it short.
    """
    torch.manual_seed(settings.seed)
    torch.set_num_threads(settings.threads)
    network = make().to(memory_format=torch.channels_last)
    if settings.start is not None:
        network.load_state_dict(torch.load(settings.start, weights_only=True))
    # Before anything is written: it may lie where this run's own checkpoints will.
    others = torch.load(settings.halfway_from, weights_only=True) if settings.halfway_from else None
    average = Average(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1.0, weight_decay=1e-3)
    started_s = time.monotonic()
    exported_s = started_s
    for step, batch in enumerate(_ahead(batches, settings.steps)):
        minutes = (time.monotonic() - started_s) / 60
        done = max(step / settings.steps, minutes / settings.minutes)
        if done >= 1:
            break
        rate = _rate(done, step) * settings.learning_rate
        first, final = settings.overlap_weight
        first = final if settings.start else first
        weight = first + done * (final - first)
        value = _learn(network, optimiser, batch, rate, weight, loss_of)
        average.update(network)
        if report is not None:
            report(step + 1, value, minutes)
        if time.monotonic() - exported_s > 60 * settings.export_minutes:
            exported_s = time.monotonic()
            save(out, average.network)
    if others is not None:
        move_halfway(average.network, others)
    save(out, average.network)
    return average.network


def move_halfway(network: UNet, others: Mapping[str, Any]) -> None:
    """Replace weights and running statistics by their mean with ``others``."""
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if value.dtype.is_floating_point:
                value.add_(others[name]).div_(2)


def save(out: Path, network: UNet) -> None:
    """Write the network as ``out.onnx`` and as a checkpoint of torch's, ``out.pt``."""
    network.eval()
    write_onnx(out.with_suffix(".onnx"), network)
    torch.save(network.state_dict(), out.with_suffix(".pt"))


def _rate(done: float, step: int) -> float:
    """Learning rate as a share of the largest: a short rise, then half a cosine down."""
    return max(0.5 * (1 + math.cos(math.pi * done)), 0.005) * min(1.0, (step + 1) / 60)


def _learn(
    network: UNet,
    optimiser: Any,
    batch: Batch,
    rate: float,
    overlap_weight: float,
    loss_of: Loss,
) -> float:
    """One step of gradient descent; returns the loss."""
    images = torch.from_numpy(batch[0]).to(memory_format=torch.channels_last)
    labels = torch.from_numpy(batch[1])
    for group in optimiser.param_groups:
        group["lr"] = rate
    network.train()
    with torch.autocast("cpu", torch.bfloat16):
        scores = network(images)
    value = loss_of(scores, labels, overlap_weight)
    optimiser.zero_grad(set_to_none=True)
    value.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
    optimiser.step()
    return float(value.item())


def _ahead(batches: Iterator[Batch], count: int) -> Iterator[Batch]:
    """The first ``count`` batches, drawn by a second thread while the first one learns."""
    ready: queue.Queue[Batch | BaseException] = queue.Queue(maxsize=6)
    stop = threading.Event()

    def draw() -> None:
        try:
            for _, batch in zip(range(count), batches, strict=False):
                while not stop.is_set():
                    try:
                        ready.put(batch, timeout=1.0)
                        break
                    except queue.Full:
                        continue
                if stop.is_set():
                    return
        except Exception as error:
            ready.put(error)

    worker = threading.Thread(target=draw, daemon=True)
    worker.start()
    try:
        for _ in range(count):
            item = ready.get()
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        worker.join()
