"""The networks: small U-Nets. That of MR labels a slice and the planes a third of a spacing
beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from data_synth.training.contrast import CLASSES

WIDTHS = (24, 56, 120, 224, 352)
"""Channels at full, half, ... resolution."""

PLANES = 3


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class UNet(nn.Module):  # type: ignore[misc]  # torch is not type-checked
    """Images of so many channels in, so many scores for every pixel out.

    Skips are added, not concatenated, after a 1x1 convolution on the way up: half the arithmetic
    of the usual U-Net at the same number of levels, which matters on a CPU.
    """

    def __init__(self, channels: int, scores: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.down = nn.ModuleList([nn.Sequential(_block(channels, widths[0]))])
        for inputs, outputs in pairwise(widths):
            self.down.append(nn.Sequential(_block(inputs, outputs), _block(outputs, outputs)))
        self.narrow, self.up = nn.ModuleList(), nn.ModuleList()
        for inputs, outputs in zip(widths[:0:-1], widths[-2::-1], strict=True):
            self.narrow.append(nn.Conv2d(inputs, outputs, 1))
            count = 1 if outputs == widths[0] else 2
            self.up.append(nn.Sequential(*[_block(outputs, outputs) for _ in range(count)]))
        self.head = nn.Conv2d(widths[0], scores, 1)

    def forward(self, images: Any) -> Any:
        """Scores ``(n, scores, row, column)`` of images ``(n, channels, row, column)``."""
        skips = []
        features = images
        for number, block in enumerate(self.down):
            features = block(functional.max_pool2d(features, 2) if number else features)
            skips.append(features)
        skips.pop()
        for narrow, block in zip(self.narrow, self.up, strict=True):
            features = functional.interpolate(narrow(features), scale_factor=2.0, mode="nearest")
            features = block(features + skips.pop())
        return self.head(features)


class HeartNet(UNet):
    """Three neighbouring slices in, seven classes on three planes out, plane by plane."""

    def __init__(self, widths: Sequence[int] = WIDTHS) -> None:
        super().__init__(3, PLANES * CLASSES, widths)


def take_over(network: UNet, weights: Mapping[str, Any]) -> None:
    """Give the network the weights of another, as wide or narrower, whose scores it then returns.

    A wider network's other channels keep what they were drawn with, but nothing that was there
    before listens to them yet: the first steps tell them apart, and bring them in.

    Raises
    ------
    ValueError
        When the weights are not of a network of the same shape, as wide or narrower.
    """
    own = network.state_dict()
    if own.keys() != weights.keys():
        raise ValueError("the checkpoint is of another kind of network")
    for name, held in own.items():
        given = weights[name]
        if given.ndim != held.ndim or any(
            few > many for few, many in zip(given.shape, held.shape, strict=True)
        ):
            shapes = f"{tuple(given.shape)} into {tuple(held.shape)}"
            raise ValueError(f"the checkpoint's {name} does not fit: {shapes}")
        if held.ndim == 0:
            held.copy_(given)
            continue
        outputs = slice(len(given))
        if held.ndim > 1:
            held[outputs] = 0
            held[outputs, : given.shape[1]] = given
        else:
            held[outputs] = given


def loss(scores: Any, labels: Any, overlap_weight: float = 1.0) -> Any:
    """Cross-entropy plus, weighted, one minus soft Dice of the structures.

    Dice makes small structures count from the first step; cross-entropy alone lets the more
    probable class win in every pixel.

    Parameters
    ----------
    scores
        ``(n, plane * class, row, column)``.
    labels
        ``(n, plane, row, column)`` int64.
    overlap_weight
        Of the second term.
    """
    rows, columns = scores.shape[2:]
    scores = scores.float().reshape(-1, CLASSES, rows * columns)
    labels = labels.reshape(-1, 1, rows * columns)
    log_chance = torch.log_softmax(scores, dim=1)
    chance = log_chance.exp()
    truth = labels == torch.arange(CLASSES, device=labels.device)[None, :, None]
    overlap = torch.where(truth, chance, 0).sum((0, 2))
    dice = (2 * overlap + 1) / (chance.sum((0, 2)) + truth.sum((0, 2)) + 1)
    return -log_chance.gather(1, labels).mean() + overlap_weight * (1 - dice[1:].mean())
