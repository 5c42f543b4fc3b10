"""Colours, words and encodings that all pictures of the page share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from PIL import Image

# Okabe and Ito's colours, told apart by colour-blind readers; line styles serve greyscale.
STYLES: dict[str, tuple[str, Any]] = {
    "lv_cavity": ("#D55E00", "-"),
    "lv_myocardium": ("#56B4E9", "--"),
    "rv_cavity": ("#009E73", "-."),
    "left_atrium": ("#F0E442", ":"),
    "right_atrium": ("#CC79A7", "-"),
    "aorta": ("#0072B2", "--"),
}
QUALITY = 82
"""Of lossy WebP: no difference from lossless is seen at this size."""


@contextmanager
def own_style() -> Iterator[None]:
    """Figures that are made within do not depend on the user's own ``matplotlibrc``."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


def edged(width: float) -> list[AbstractPathEffect]:
    """A thin grey edge on both sides of a line: without it yellow is lost on white."""
    return [Stroke(linewidth=width + 1, foreground="#555555"), Normal()]


def as_svg(figure: Figure) -> bytes:
    """SVG without dates or random names."""
    buffer = BytesIO()
    with matplotlib.rc_context(
        {"svg.hashsalt": "beatfield", "svg.fonttype": "none", "path.simplify_threshold": 0.4}
    ):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def as_webp(figure: Figure, dots_per_inch: int = 110) -> bytes:
    """A picture of pixels, as small as it can be without looking so."""
    buffer = BytesIO()
    figure.savefig(buffer, format="rgba", dpi=dots_per_inch)
    width, height = figure.canvas.get_width_height()
    scale = dots_per_inch / figure.dpi
    size = (int(width * scale), int(height * scale))
    image = Image.frombytes("RGBA", size, buffer.getvalue()).convert("RGB")
    return encode([np.asarray(image)])


def encode(frames: Sequence[npt.NDArray[np.uint8]], seconds: float = 1.0) -> bytes:
    """Frames (rows, columns, 3) as WebP: a still, or a loop that lasts so many seconds."""
    images = [Image.fromarray(frame) for frame in frames]
    buffer = BytesIO()
    loop: dict[str, Any] = {}
    if len(images) > 1:
        duration = round(1000 * seconds / len(images))
        loop = {"save_all": True, "append_images": images[1:], "duration": duration, "loop": 0}
    images[0].save(buffer, format="WEBP", quality=QUALITY, method=4, **loop)
    return buffer.getvalue()


def words(name: str) -> str:
    """A name as people write it.

    >>> words("lv_cavity")
    'LV cavity'
    """
    text = name.replace("_", " ")
    for small, large in (("lv ", "LV "), ("rv ", "RV ")):
        text = text.replace(small, large)
    return text
