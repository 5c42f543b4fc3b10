"""What the report's pictures share: lines, names, and files that repeat to the byte."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke


@contextmanager
def own_style() -> Iterator[None]:
    """Figures that are made and written within look alike for everybody: by a user's own
    ``matplotlibrc`` pictures may stand upside down under their letters, or ask for LaTeX."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


def as_svg(figure: Figure) -> bytes:
    """SVG without dates or random names."""
    buffer = BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "beatfield", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def as_png(figure: Figure, dots_per_inch: int = 80) -> bytes:
    """PNG without the name of the software."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch, metadata={"Software": None})
    return buffer.getvalue()


def as_webp(figure: Figure, dots_per_inch: int = 100) -> bytes:
    """WebP: a quarter of a PNG's bytes where there are grey values."""
    buffer = BytesIO()
    figure.savefig(buffer, format="webp", dpi=dots_per_inch, pil_kwargs={"quality": 88})
    return buffer.getvalue()


def as_moving_webp(images: Sequence[Any], each_ms: int, quality: int) -> bytes:
    """Endless animated WebP of Pillow's images, each shown for so long."""
    buffer = BytesIO()
    images[0].save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=images[1:],
        duration=each_ms,
        loop=0,
        quality=quality,
    )
    return buffer.getvalue()


def show_grey(axis: Axes, image: Any, aspect: float = 1.0) -> None:
    """An image in grey, its darkest and brightest specks clipped; no axes around it."""
    low, high = np.percentile(image, (1, 99.5))
    axis.imshow(image, cmap="gray", vmin=low, vmax=max(high, low + 1e-6), aspect=aspect)
    axis.set_axis_off()


def edged(width: float, colour: str = "#555555") -> list[AbstractPathEffect]:
    """A thin edge on both sides of a line: without, yellow is lost on white, white on blood."""
    return [Stroke(linewidth=width + 1, foreground=colour), Normal()]


def handle(name: str, colour: str, style: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], color=colour, linestyle=style, label=words(name), path_effects=edged(1.5))


def words(name: str) -> str:
    """A name as people write it."""
    return name.replace("_", " ").replace("lv ", "LV ").replace("rv ", "RV ")
