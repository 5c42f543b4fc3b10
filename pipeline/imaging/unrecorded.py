"""What was not recorded: values that fill images up about what was, and values that are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float32, Mask
from pipeline.imaging.cine import Cine
from pipeline.imaging.dicom_pixels import at_the_edge

FILL_GAP = 0.1
"""Share of the range of all other values, without their extremes, by which a value that fills up
images lies below them. Of what was measured the darkest has others close above it."""


def require_finite(cine: Cine, where: str) -> None:
    """Raise InputError unless all grey values are numbers."""
    bad = ~np.isfinite(cine.intensity).all(axis=(2, 3))
    if bad.any():
        phase, number = np.argwhere(bad)[0]
        wrong = np.argwhere(~np.isfinite(cine.intensity[phase, number]))
        row, column = wrong[0]
        raise InputError(
            f"{where}, phase {phase}, slice {number}: grey values must be finite numbers, got NaN "
            f"or infinity in {len(wrong)} pixels, the first in row {row}, column {column} (such "
            f"values in {int(bad.sum())} of {bad.size} images); export the images again. NaN is "
            "taken for what was not recorded only where it reaches the image's edge and is the "
            "same in all phases"
        )


def without_unrecorded(cine: Cine, where: str) -> tuple[Cine, tuple[str, ...]]:
    """The cine with its darkest value in place of what fills up about what was recorded, and a
    remark.

    Programs that turn or cut images fill up with NaN, or with a value far below all others. Such
    pixels are those that are so in all phases and reach the image's edge. What else is NaN stays.
    """
    nan, name = _filled(cine.intensity)
    if not nan.any():
        return cine, ()
    always: Mask = np.asarray(nan.all(axis=0))
    around: Mask = np.stack([at_the_edge(one) for one in always])
    # A whole slice between others is lost, not beyond what was recorded.
    whole: Mask = np.asarray(always.all(axis=(1, 2)))
    shown = np.flatnonzero(~whole)
    around[[k for k in np.flatnonzero(whole) if len(shown) and shown[0] < k < shown[-1]]] = False
    finite = cine.intensity[np.isfinite(cine.intensity) & ~nan]
    if not around.any() or not finite.size:
        return cine, ()
    dark = finite.min()
    intensity = np.where(around & nan, dark, cine.intensity)
    many, slices = float(around.mean()), int(around.any(axis=(1, 2)).sum())
    remark = (
        f"{where}: {many:.1%} of the pixels, at the edge of {slices} of {len(around)} slices, are "
        f"{name} in all phases: not recorded, and read as the darkest value, {dark:g}"
    )
    return replace(cine, intensity=intensity), (remark,)


def _filled(intensity: Float32) -> tuple[Mask, str]:
    """Where images hold what fills them up, if anything does, and its name."""
    nan = np.isnan(intensity)
    if nan.any():
        return nan, "NaN"
    fill = intensity.min()
    lowest = intensity == fill
    darkest = intensity.min(where=~lowest, initial=np.inf)
    rest = intensity[..., ::2, ::3]
    rest = rest[rest > fill]
    if not np.isfinite([fill, intensity.max()]).all() or not rest.size:
        return nan, "NaN"
    low, high = np.percentile(rest, [1, 99])
    far = darkest - fill > FILL_GAP * (high - low) > 0
    return (lowest, f"{fill:g}") if far else (nan, "NaN")
