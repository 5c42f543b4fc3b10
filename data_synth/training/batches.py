"""Batches that are drawn, and those that are seen again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional
from torch.utils.data import Dataset

Label = npt.NDArray[np.uint8]

Sample = tuple[npt.NDArray[np.float32], Label]
"""Image ``(channel, row, column)`` and labels, ``(..., row, column)``."""

Draw = Callable[[np.random.Generator], Sample]
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
        # Two sizes in all: the best way to compute is sought anew for each.
        count = size - fresh if held >= size - fresh else 0
        both, of_both = images, labels
        if count:
            again = torch.randint(held, (count,), generator=self.picks).to(images.device)
            seen, of_seen = self.images[again].float(), self.labels[again]
            if self.vary is not None:
                seen, of_seen = self.vary(seen, of_seen)
            both, of_both = torch.cat([images, seen]), torch.cat([labels, of_seen])
        self.keep(images, labels)
        return both, of_both

    def keep(self, images: Any, labels: Any) -> None:
        """Have images seen again, in the place of those that were drawn first."""
        if self.images is None:
            shape, device = (self.kept,), images.device
            self.images = torch.empty(shape + images.shape[1:], dtype=torch.float16, device=device)
            self.labels = torch.empty(shape + labels.shape[1:], dtype=labels.dtype, device=device)
        places = torch.arange(self.drawn, self.drawn + len(images)) % self.kept
        places = places.to(images.device)
        self.images[places], self.labels[places] = images.half(), labels
        self.drawn += len(images)


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
