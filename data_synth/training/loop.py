"""The training loop: draw, learn, average, export."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset

from data_synth.training.export import write_onnx
from data_synth.training.network import WIDTHS, HeartNet, UNet, loss, take_over
from data_synth.training.render import ALL_PARTS, Parts, draw_sample

Label = npt.NDArray[np.uint8]
Report = Callable[[int, float, float], None]
Net = TypeVar("Net", bound=UNet)

HEART_STREAM = 7002
"""Keeps what is drawn for this network apart from what is drawn for others of the same seed."""

MEAN_BATCHES, MEAN_IMAGES = 40, 32
"""Batches, and images of each, from which a mean network's features are normalised."""


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

    seed: int = 0
    export_minutes: float = 5.0
    threads: int = 1
    workers: int = 0
    """Processes that draw; 0: the one that learns draws, too. Their number changes no image."""


Sample = tuple[npt.NDArray[np.float32], Label]
"""Image ``(channel, row, column)`` and labels, ``(..., row, column)``."""

Draw = Callable[[np.random.Generator], Sample]
Loss = Callable[[Any, Any, float], Any]
"""Of scores and labels, with the weight of the Dice term."""

Vary = Callable[[Any, Any], tuple[Any, Any]]
"""Makes other images, and their labels, of a batch that has been seen before."""


class Batches(Dataset):  # type: ignore[misc]  # torch is not type-checked
    """Batches of what ``draw`` gives; the seed, the stream and a batch's number fix it."""

    def __init__(self, draw: Draw, count: int, size: int, seed: int, stream: int) -> None:
        self.draw, self.count, self.size, self.seeds = draw, count, size, (seed, stream)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> tuple[Any, Any]:
        """Images ``(n, channel, row, column)`` float32 and labels uint8, as tensors."""
        if number >= self.count:
            raise IndexError(number)
        rng = np.random.default_rng([*self.seeds, number])
        images, labels = zip(*(self.draw(rng) for _ in range(self.size)), strict=True)
        return torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(labels))


class Echo:
    """The last images drawn, to be seen again.

    What was drawn at the beginning is replaced first. Images are kept in half precision, which
    the network's own arithmetic is coarser than.
    """

    def __init__(self, kept: int, seed: int, vary: Vary | None = None) -> None:
        self.kept, self.drawn, self.vary = kept, 0, vary
        self.picks = torch.Generator().manual_seed(seed)
        self.images: Any = None
        self.labels: Any = None

    def joined(self, images: Any, labels: Any, size: int) -> tuple[Any, Any]:
        """A batch of ``size``, those given first, which are kept; those alone at the beginning."""
        fresh, held = len(images), min(self.drawn, self.kept)
        if size <= fresh:
            return images, labels
        if self.images is None:
            shape, device = (self.kept,), images.device
            self.images = torch.empty(shape + images.shape[1:], dtype=torch.float16, device=device)
            self.labels = torch.empty(shape + labels.shape[1:], dtype=labels.dtype, device=device)
        # Two sizes in all: the best way to compute is sought anew for each.
        count = size - fresh if held >= size - fresh else 0
        again = torch.randint(max(held, 1), (count,), generator=self.picks).to(images.device)
        seen, of_seen = self.images[again].float(), self.labels[again]
        if self.vary is not None and count:
            seen, of_seen = self.vary(seen, of_seen)
        both, of_both = torch.cat([images, seen]), torch.cat([labels, of_seen])
        places = (torch.arange(self.drawn, self.drawn + fresh) % self.kept).to(images.device)
        self.images[places], self.labels[places] = images.half(), labels
        self.drawn += fresh
        return both, of_both


def varied(images: Any, labels: Any) -> tuple[Any, Any]:
    """Images ``(n, channel, row, column)`` a little turned, larger and aside, in other greys.

    An image that comes back as it was is learnt by heart, its noise first. One in two keeps its
    place, as interpolation blurs. Labels ``(n, plane, row, column)`` go with them.
    """
    count, device = len(images), images.device
    normal = torch.randn(6, count, device=device)
    moved = (torch.rand(count, device=device) < 0.5).float()
    turn, size = 0.15 * moved * normal[0], torch.exp(0.06 * moved * normal[1])
    across, down = 0.05 * moved * normal[2], 0.05 * moved * normal[3]
    cosine, sine = size * turn.cos(), size * turn.sin()
    affine = torch.stack([cosine, -sine, across, sine, cosine, down], 1).reshape(count, 2, 3)
    places = functional.affine_grid(affine, list(images.shape), align_corners=False)

    def there(of: Any, mode: str) -> Any:
        return functional.grid_sample(
            of, places, mode=mode, padding_mode="reflection", align_corners=False
        )

    grey = there(images, "bilinear")
    grey = grey.sign() * grey.abs() ** torch.exp(0.15 * normal[4]).reshape(-1, 1, 1, 1)
    noise = 0.03 * normal[5].abs().reshape(-1, 1, 1, 1)
    grey = grey + noise * torch.randn_like(grey)
    return grey, there(labels.float(), "nearest").to(labels.dtype)


class Average:
    """Running mean of weights: smoother than the last step's, and what is exported."""

    def __init__(self, network: UNet) -> None:
        self.network = copy.deepcopy(network)
        self.steps = 0

    def update(self, network: UNet) -> None:
        """Take in the weights after one more step."""
        self.steps += 1
        keep = min(0.997, self.steps / (self.steps + 20))
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
    in no fixed order) when ``minutes`` does not cut it short.

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
    """
    torch.set_num_threads(settings.threads)
    torch.backends.cudnn.benchmark = True
    fresh = min(settings.fresh, settings.batch)
    batches = _ahead(Batches(draw, settings.steps, fresh, settings.seed, stream), settings)
    # After the processes that draw have started, which takes a random number.
    torch.manual_seed(settings.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = make().to(memory_format=torch.channels_last)
    if settings.start is not None:
        take_over(network, load_weights(settings.start))
    network = network.to(device)
    average, echo = Average(network), Echo(settings.kept, settings.seed, vary)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1.0, weight_decay=1e-3, fused=True)
    started_s = time.monotonic()
    exported_s = started_s
    waiting: tuple[int, Any, float] | None = None
    for step, (images, labels) in enumerate(batches):
        minutes = (time.monotonic() - started_s) / 60
        done = max(step / settings.steps, minutes / settings.minutes)
        if done >= 1:
            break
        rate = _rate(done, step) * settings.learning_rate
        first, final = settings.overlap_weight
        first = final if settings.start else first
        weight = first + done * (final - first)
        images, labels = (one.to(device, non_blocking=True) for one in (images, labels))
        batch = echo.joined(images, labels, settings.batch)
        value = _learn(network, optimiser, *batch, rate, weight, loss_of)
        average.update(network)
        # A step late: to wait for a loss is to leave the graphics processor idle meanwhile.
        _report(report, waiting)
        waiting = step + 1, value, minutes
        if time.monotonic() - exported_s > 60 * settings.export_minutes:
            exported_s = time.monotonic()
            save(out, average.network)
    _report(report, waiting)
    save(out, average.network)
    return average.network


def _report(report: Report | None, learned: tuple[int, Any, float] | None) -> None:
    """Tell the number, loss and minutes of a step, where there is one to tell."""
    if report is not None and learned is not None:
        step, value, minutes = learned
        report(step, float(value.item()), minutes)


def _ahead(batches: Batches, settings: TrainSettings) -> Iterator[tuple[Any, Any]]:
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


def load_weights(checkpoint: Path) -> dict[str, Any]:
    """Weights by name, as `save` wrote them."""
    weights: dict[str, Any] = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return weights


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
