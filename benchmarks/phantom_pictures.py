"""Make the pictures of docs/phantom.md from the default study of one seed.

python benchmarks/phantom_pictures.py [--seed 1] [--out docs/phantom]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from data_synth import PhantomSettings, simulate_study
from data_synth.mr import SyntheticCine
from data_synth.preview import curves, images, scene
from data_synth.preview.style import as_svg, as_webp, encode
from data_synth.simulate import SyntheticStudy

FRAMES_OF_A_SWEEP = 3


def main(arguments: Sequence[str] | None = None) -> None:
    """Write every picture into the folder asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("docs/phantom"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    study = simulate_study(PhantomSettings(seed=options.seed))
    for name, content in pictures(study).items():
        (options.out / name).write_bytes(content)
        print(options.out / name, f"{len(content) / 1000:.0f} kB")


def pictures(study: SyntheticStudy) -> dict[str, bytes]:
    """File name -> content, nothing drawn on the images but what is seen."""
    middle = images.middle_slice(study.cine)
    row = images.long_axis_row(study.views, {"end-diastole": 0}, drawn=False)
    made = {
        "short-axis.webp": as_webp(slices(study.cine, middle), 100),
        "long-axis.webp": as_webp(row, 90),
        "ultrasound.webp": as_webp(frames(study), 100),
        "ecg.svg": as_svg(curves.ecg_strip(study.mr_ecg, 0.0)),
    }
    if study.us_ecg is not None:
        made["ecg-away.svg"] = as_svg(curves.ecg_strip(study.us_ecg, 0.0))
    surfaces = {"end-diastole": study.heart.surfaces(0.0)}
    drawn = scene.draw_scenes(surfaces, study.heart.rotation, {})
    if drawn:
        sides = [drawn[f"end-diastole/{side}"] for side in ("front", "back", "cut")]
        made["heart.webp"] = encode([np.concatenate(sides, axis=1)])
    return made


def slices(cine: SyntheticCine, middle: int) -> Figure:
    """An apical, the middle and a basal slice at end-diastole, whole as the scanner shows them."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axis, z in zip(figure.subplots(1, 3), (middle - 2, middle, middle + 3), strict=True):
        low, high = np.percentile(cine.intensity[0, z], (1, 99.7))
        axis.imshow(cine.intensity[0, z], cmap="gray", vmin=low, vmax=high)
        axis.set_title(f"slice {z}", fontsize=9)
        axis.set_axis_off()
    return figure


def frames(study: SyntheticStudy) -> Figure:
    """A few frames of every sweep: a row a sweep."""
    count = len(study.sweeps)
    figure = Figure(figsize=(9, 2.4 * count), layout="constrained")
    axes = figure.subplots(count, FRAMES_OF_A_SWEEP, squeeze=False)
    for row, sweep in zip(axes, study.sweeps, strict=True):
        chosen = np.linspace(0, len(sweep.images) - 1, FRAMES_OF_A_SWEEP).round().astype(int)
        for axis, k in zip(row, chosen, strict=True):
            axis.imshow(sweep.images[k], cmap="gray", vmin=0, vmax=255)
            axis.set_title(f"{sweep.name}, frame {k}", fontsize=9)
            axis.set_axis_off()
    return figure


if __name__ == "__main__":
    main()
