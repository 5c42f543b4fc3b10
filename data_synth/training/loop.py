"""The training loop: draw, learn, average, export; and go on where a run was cut short."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Subset

from data_synth.training.batches import Batches, Draw, Echo, Label, Sample, Vary, varied
from data_synth.training.export import write_onnx
from data_synth.training.network import HeartNet, UNet, loss, take_over
from data_synth.training.render import ALL_PARTS, Parts, draw_sample
from data_synth.training.runs import TrainSettings, has_ended, keep, left_of, load_weights

Report = Callable[[int, float, float], None]
Net = TypeVar("Net", bound=UNet)

HEART_STREAM = 7002
"""Keeps what is drawn for this network apart from what is drawn for others of the same seed."""

MEAN_BATCHES, MEAN_IMAGES = 40, 32
"""Batches, and images of each, from which a mean network's features are normalised."""


Loss = Callable[[Any, Any, float], Any]
"""Of scores and labels, with the weight of the Dice term."""


class Average:
    """Running mean of weights: smoother than the last step's, and what is exported."""

    def __init__(self, network: UNet) -> None:
        self.network = copy.deepcopy(network)

    def update(self, network: UNet, steps: int) -> None:
        """Take in the weights after so many steps."""
        keep = min(0.997, steps / (steps + 20))
        means, news = (one.state_dict().values() for one in (self.network, network))
        pairs = list(zip(means, news, strict=True))
        with torch.no_grad():
            numbers = [pair for pair in pairs if pair[0].dtype.is_floating_point]
            torch._foreach_lerp_(*map(list, zip(*numbers, strict=True)), 1 - keep)
            for mean, new in pairs:
                if not mean.dtype.is_floating_point:
                    mean.copy_(new)


def train(
    blocks: Sequence[Label], settings: TrainSettings, out: Path, report: Report | None = None
) -> HeartNet:
    """Train the network of MR, writing ``out/heart.onnx`` and ``out/heart.pt``: see `learn`."""
    draw = draw_from(blocks, settings.parts)

    def make() -> HeartNet:
        return HeartNet(settings.widths)

    return learn(make, draw, HEART_STREAM, loss, settings, out / "heart", report, varied)


def mean_of(
    checkpoints: Sequence[Path], draw: Draw, settings: TrainSettings, out: Path
) -> HeartNet:
    """Write ``out/heart.onnx`` and ``.pt`` with the mean of earlier runs' weights.

    Runs that went on from one another lie in one valley of the loss, and between an earlier and a
    later one a network keeps what the later learned and loses less on images of another kind
    (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022). What features' means and
    deviations are is found anew, from `MEAN_BATCHES` batches of images.

    Raises
    ------
    ValueError
        When a checkpoint is not of a network of the widths in ``settings``.
    """
    network = HeartNet(settings.widths)
    own = network.state_dict()
    given = [load_weights(path) for path in checkpoints]
    for path, weights in zip(checkpoints, given, strict=True):
        if {name: held.shape for name, held in weights.items()} != {
            name: held.shape for name, held in own.items()
        }:
            raise ValueError(f"{path} is not of a network of widths {settings.widths}")
    for name, held in own.items():
        if held.dtype.is_floating_point:
            held.copy_(torch.stack([weights[name] for weights in given]).mean(0))
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.reset_running_stats()
            module.momentum = None
    torch.set_num_threads(settings.threads)
    drawn = Batches(draw, MEAN_BATCHES, MEAN_IMAGES, settings.seed, HEART_STREAM)
    network.train()
    with torch.no_grad():
        for images, _ in _ahead(drawn, settings):
            network(images)
    save(out / "heart", network)
    return network


def draw_from(blocks: Sequence[Label], parts: Parts = ALL_PARTS) -> Draw:
    """What draws an image of any of the blocks, and its labels."""

    def draw(rng: np.random.Generator) -> Sample:
        sample = draw_sample(rng, blocks[int(rng.integers(len(blocks)))], parts)
        return sample.image, sample.labels

    return draw


def learn(
    make: Callable[[], Net],
    draw: Draw,
    stream: int,
    loss_of: Loss,
    settings: TrainSettings,
    out: Path,
    report: Report | None = None,
    vary: Vary | None = None,
) -> Net:
    """Train a network, writing ``out`` as ``.onnx`` and ``.pt`` now and then and at the end.

    A graphics processor learns where torch finds one. The result depends on what is drawn, the
    seed and the number of steps alone (on one kind of processor; a graphics processor's sums come
    in no fixed order) when ``minutes`` does not cut it short. All that it needs to go on is kept
    beside the network, as ``.run``: a run of the same settings that was stopped goes on from
    there, to the same result, and one that has ended is not begun again.

    Parameters
    ----------
    make
        The network, with weights drawn at random by torch's own generator.
    draw
        One image and its labels.
    stream
        Keeps what is drawn apart from what is drawn for another network.
    loss_of
        What is made small.
    vary
        What an image goes through each time it is seen again.

    Raises
    ------
    SynthError
        When ``out`` is of a run of other settings.
    """
    if has_ended(out, settings):
        network = make()
        network.load_state_dict(load_weights(out.with_suffix(".pt")))
        return network
    left = left_of(out, settings)
    torch.set_num_threads(settings.threads)
    torch.backends.cudnn.benchmark = True
    fresh = min(settings.fresh, settings.batch)
    first = left["step"] if left else 0
    # What was kept to be seen again is drawn again.
    again = min(first, -(-settings.kept // fresh)) if fresh < settings.batch else 0
    numbers = range(first - again, settings.steps)
    drawn = Batches(draw, settings.steps, fresh, settings.seed, stream)
    batches = _ahead(Subset(drawn, numbers), settings)
    # After the processes that draw have started, which takes a random number.
    torch.manual_seed(settings.seed)
    learner = Learner(make(), settings, loss_of, vary)
    if left:
        learner.take_up(left, (first - again) * fresh)
    started_s = exported_s = time.monotonic()
    waiting: tuple[int, Any, float] | None = None
    for step, (images, labels) in zip(numbers, batches, strict=True):
        images, labels = (one.to(learner.device, non_blocking=True) for one in (images, labels))
        if step < first:
            learner.echo.keep(images, labels)
            started_s = exported_s = time.monotonic()
            continue
        minutes = learner.minutes + (time.monotonic() - started_s) / 60
        done = max(step / settings.steps, minutes / settings.minutes)
        if done >= 1:
            break
        value = learner.learn(step, done, images, labels)
        # A step late: to wait for a loss is to leave the graphics processor idle meanwhile.
        _report(report, waiting)
        waiting = step + 1, value, minutes
        if time.monotonic() - exported_s > 60 * settings.export_minutes:
            exported_s = time.monotonic()
            save(out, learner.average.network)
            keep(out, settings, learner.state(step + 1, minutes))
    _report(report, waiting)
    save(out, learner.average.network)
    keep(out, settings, None)
    return learner.average.network


class Learner(Generic[Net]):
    """A network that learns, and all that changes as it does."""

    def __init__(
        self, network: Net, settings: TrainSettings, loss_of: Loss, vary: Vary | None
    ) -> None:
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        network = network.to(memory_format=torch.channels_last)
        if settings.start is not None:
            take_over(network, load_weights(settings.start))
        self.network = network.to(self.device)
        self.average = Average(self.network)
        self.echo = Echo(settings.kept, settings.seed, vary)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=1.0, weight_decay=1e-3, fused=True
        )
        self.settings, self.loss_of = settings, loss_of
        self.minutes = 0.0

    def state(self, step: int, minutes: float) -> dict[str, Any]:
        """All of it after so many steps and minutes, but for the images that are kept."""
        return {
            "step": step,
            "minutes": minutes,
            "network": self.network.state_dict(),
            "average": self.average.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "picks": self.echo.picks.get_state(),
            "random": torch.get_rng_state(),
            "random_there": torch.cuda.get_rng_state_all(),
        }

    def take_up(self, state: dict[str, Any], drawn: int) -> None:
        """Be as it was in that state; the images that were kept after ``drawn`` are yet to come."""
        self.network.load_state_dict(state["network"])
        self.average.network.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.echo.picks.set_state(state["picks"])
        self.echo.drawn = drawn
        self.minutes = state["minutes"]
        torch.set_rng_state(state["random"])
        if self.device.type == "cuda" and state["random_there"]:
            torch.cuda.set_rng_state_all(state["random_there"])

    def learn(self, step: int, done: float, images: Any, labels: Any) -> Any:
        """Take one step, with a share of the way done; returns the loss."""
        settings = self.settings
        rate = _rate(done, step) * settings.learning_rate
        first, final = settings.overlap_weight
        first = final if settings.start else first
        weight = first + done * (final - first)
        batch = self.echo.joined(images, labels, settings.batch)
        value = _learn(self.network, self.optimiser, *batch, rate, weight, self.loss_of)
        self.average.update(self.network, step + 1)
        return value


def _report(report: Report | None, learned: tuple[int, Any, float] | None) -> None:
    """Tell the number, loss and minutes of a step, where there is one to tell."""
    if report is not None and learned is not None:
        step, value, minutes = learned
        report(step, float(value.item()), minutes)


def _ahead(batches: Dataset, settings: TrainSettings) -> Iterator[tuple[Any, Any]]:
    """All batches in turn, drawn ahead by other processes where there are any."""
    if settings.workers == 0:
        return iter(batches)
    # Forked processes share the blocks that are drawn from, but not OpenCV's threads.
    cv2.setNumThreads(1)
    return iter(
        DataLoader(
            batches,
            batch_size=None,
            num_workers=settings.workers,
            multiprocessing_context="fork",
            prefetch_factor=8,
        )
    )


def save(out: Path, network: UNet) -> None:
    """Write the network as ``out.onnx`` and as a checkpoint of torch's, ``out.pt``."""
    network = copy.deepcopy(network).cpu().eval()
    write_onnx(out.with_suffix(".onnx"), network)
    torch.save(network.state_dict(), out.with_suffix(".pt"))


def _rate(done: float, step: int) -> float:
    """Learning rate as a share of the largest: a short rise, then half a cosine down."""
    return max(0.5 * (1 + math.cos(math.pi * done)), 0.005) * min(1.0, (step + 1) / 60)


def _learn(
    network: UNet,
    optimiser: Any,
    images: Any,
    labels: Any,
    rate: float,
    overlap_weight: float,
    loss_of: Loss,
) -> Any:
    """One step of gradient descent; returns the loss."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    network.train()
    with torch.autocast(images.device.type, torch.bfloat16):
        scores = network(images.contiguous(memory_format=torch.channels_last))
    value = loss_of(scores, labels.long(), overlap_weight)
    optimiser.zero_grad(set_to_none=True)
    value.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
    optimiser.step()
    return value.detach()
