"""Pictures that move: figures drawn one after the other into an animated WebP."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from pipeline.report.style import as_moving_webp


def animated(figures: Iterable[Figure], seconds: float, dots_per_inch: int) -> bytes:
    """Animated WebP, endless, that takes ``seconds`` for all figures; the same bytes every time."""
    images = []
    for figure in figures:
        figure.set_dpi(dots_per_inch)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    return as_moving_webp(images, max(round(1000 * seconds / len(images)), 20), quality=75)
