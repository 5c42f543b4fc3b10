"""Where on each structure the surfaces are wrong: by the parts of the phantom's anatomy.

    python benchmarks/segmentation_places.py OUT [--patients 20] [--farther 3.5]

OUT is what segmentation_figures.py wrote. Points spread evenly over the surfaces found and over
truth's meshes are told by where they lie in the phantom's own frame at the R peak: which of them
lie far from the other surface, how far in the mean, and to which side. Below the table stand the
distances without what no image tells: what lies beyond the last slice, and where the phantom cuts
the pulmonary veins off.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import segmentation_tables as tables

from data_synth.heart import BeatingHeart
from data_synth.simulate import load_heart, settings_of
from pipeline.evaluation.metrics import surface_samples
from pipeline.exact import ExactSurface
from pipeline.geometry import Float, MovingSurface
from pipeline.meshes import read_mesh
from pipeline.products import read_cine, read_surfaces

Names = npt.NDArray[np.str_]
Mask = npt.NDArray[np.bool_]

SAMPLES = 2000
"""Points on each surface of each phase."""

BEYOND, STUBS = "beyond the last slice", "stubs of the veins"
AROUND_MM = 5.0
"""What lies so near to the wall of a tube counts to it."""


@dataclass(frozen=True, slots=True)
class Points:
    """Points on the surfaces of one structure in one phase."""

    places: Names
    """``(n,)`` where each lies."""

    distance_mm: Float
    """``(n,)`` outwards from truth to what was found: positive where it is too large."""

    of_truth: Mask
    """``(n,)`` whether they lie on truth's surface."""


def places(name: str, heart: BeatingHeart, points_mm: Float, phase: float) -> Names:
    """Part of a structure that each LPS point ``(n, 3)`` belongs to, at a phase."""
    rest_mm = heart.into_heart(heart.reference(points_mm, phase))
    found = np.full(len(rest_mm), "elsewhere", dtype="<U24")
    for place, where in PARTS[name](heart, rest_mm):
        found[where] = place
    return found


Parts = Iterator[tuple[str, Mask]]


def _ventricle(heart: BeatingHeart, rest_mm: Float) -> Parts:
    """Fractions of the ventricle's length below the mitral plane."""
    down = -rest_mm[:, 2] / heart.shape.lv_length
    yield "base", down < 0.12
    yield "tip", down > 0.85


def _right_ventricle(heart: BeatingHeart, rest_mm: Float) -> Parts:
    down = -rest_mm[:, 2] / heart.shape.lv_length
    yield "base", down < 0.12
    yield "tip", down > 0.7
    yield "outflow", _along(heart.tubes.outflow, rest_mm)


def _left_atrium(heart: BeatingHeart, rest_mm: Float) -> Parts:
    shape = heart.shape
    middle = np.array([shape.la_x, shape.la_y, shape.la_z])
    radii = np.array([shape.la_radius_x, shape.la_radius_y, shape.la_radius_z])
    out = np.linalg.norm((rest_mm - middle) / radii, axis=1)
    yield "roof", (rest_mm[:, 2] - shape.la_z) > 0.75 * shape.la_radius_z
    yield "valve plane", rest_mm[:, 2] < 6
    yield "appendage", _along(heart.tubes.appendage, rest_mm) & (out > 1.08)
    for vein in heart.tubes.veins:
        yield STUBS, _along(vein[:2], rest_mm) & (out > 1.05)


def _right_atrium(heart: BeatingHeart, rest_mm: Float) -> Parts:
    shape = heart.shape
    yield "roof", (rest_mm[:, 2] - shape.ra_z) > 0.75 * shape.ra_radius_z
    yield "valve plane", rest_mm[:, 2] < 6
    yield "upper cava", _along(heart.tubes.upper_cava, rest_mm)
    yield "lower cava", _along(heart.tubes.lower_cava, rest_mm)


def _aorta(heart: BeatingHeart, rest_mm: Float) -> Parts:
    yield "root", rest_mm[:, 2] < 8
    end_mm = heart.tubes.aorta[-1]
    yield "end", np.linalg.norm(rest_mm - end_mm[:3], axis=1) < end_mm[3] + AROUND_MM


def _whole(heart: BeatingHeart, rest_mm: Float) -> Parts:
    yield from _ventricle(heart, rest_mm)
    yield "atria and vessels", rest_mm[:, 2] > 0


PARTS: dict[str, Callable[[BeatingHeart, Float], Parts]] = {
    "lv_endocardium": _ventricle,
    "epicardium": _ventricle,
    "rv_endocardium": _right_ventricle,
    "left_atrium": _left_atrium,
    "right_atrium": _right_atrium,
    "aorta": _aorta,
    "heart": _whole,
}


def _along(line: Float, rest_mm: Float) -> Mask:
    """Whether points lie in a tube of ``(x, y, z, radius)`` knots, or near its wall."""
    near = np.zeros(len(rest_mm), bool)
    for start, end in pairwise(line):
        way = end[:3] - start[:3]
        share = np.clip((rest_mm - start[:3]) @ way / (way @ way), 0, 1)
        far_mm = np.linalg.norm(rest_mm - start[:3] - share[:, None] * way, axis=1)
        near |= far_mm < start[3] + share * (end[3] - start[3]) + AROUND_MM
    return near


@dataclass(frozen=True, slots=True)
class Roof:
    """The last slice of a stack: what lies beyond it no image shows."""

    middle_mm: Float
    """``(3,)`` a point of it, LPS."""

    normal: Float
    """``(3,)`` unit vector away from the apex."""

    def is_above(self, points_mm: Float) -> Mask:
        """Whether points ``(n, 3)`` lie beyond the last slice."""
        return np.asarray((points_mm - self.middle_mm) @ self.normal > 0)


def roof_of(mr_from_index: Float, slices: int, heart: BeatingHeart) -> Roof:
    """The slice of a stack that lies farthest towards the base."""
    normal = np.cross(mr_from_index[:3, 0], mr_from_index[:3, 1])
    normal *= np.sign(normal @ heart.long_axis) / np.linalg.norm(normal)
    ends_mm = mr_from_index[:3, 3] + np.array([[0], [slices - 1]]) * mr_from_index[:3, 2]
    return Roof(ends_mm[(ends_mm @ normal).argmax()], normal)


def points_of(
    name: str, moving: MovingSurface, truth: Path, heart: BeatingHeart, roof: Roof
) -> list[Points]:
    """Samples of one structure, one set a phase."""
    each = []
    for number, phase in enumerate(moving.phases):
        known, found = read_mesh(truth / f"{name}_{number:03d}.vtp"), moving.at(number)
        on_found, on_known = (surface_samples(one, SAMPLES) for one in (found, known))
        # Outside truth is too large; where truth's own point lies outside, it is too small.
        off_mm = np.concatenate(
            [ExactSurface(known).distance_mm(on_found), -ExactSurface(found).distance_mm(on_known)]
        )
        both_mm = np.concatenate([on_found, on_known])
        lies = places(name, heart, both_mm, float(phase))
        lies[roof.is_above(both_mm)] = BEYOND
        each.append(Points(lies, off_mm, np.arange(2 * SAMPLES) >= SAMPLES))
    return each


def measure(out: Path, name: str) -> dict[str, list[Points]]:
    """Samples of every structure of one patient."""
    study, products = out / "studies" / name, out / "products" / name
    heart = load_heart(settings_of(study))
    cine = read_cine(products / "ingest")
    roof = roof_of(cine.mr_from_index, cine.intensity.shape[1], heart)
    surfaces = read_surfaces(products / "surface", cine.phases)
    truth = study / "truth" / "surfaces"
    return {
        structure: points_of(structure, surfaces[structure], truth, heart, roof)
        for structure in PARTS
        if structure in surfaces
    }


def rows(name: str, each: list[Points], farther_mm: float) -> list[list[str]]:
    """A row for every part of a structure, the one with most points far off first."""
    lies, off_mm, of_truth = (
        np.concatenate([getattr(one, key) for one in each])
        for key in ("places", "distance_mm", "of_truth")
    )
    table = []
    for place in np.unique(lies):
        here = lies == place
        far = [
            100 * np.mean(np.abs(off_mm[side]) * here[side] > farther_mm)
            for side in (of_truth, ~of_truth)
        ]
        shares = [f"{100 * here.mean():.0f} %", *(f"{one:.2f} %" for one in far)]
        mean = [f"{np.abs(off_mm[here]).mean():.2f}", f"{off_mm[here].mean():+.2f}"]
        table.append((sum(far), [tables.SURFACES[name], str(place), *shares, *mean]))
    return [row for _, row in sorted(table, key=lambda pair: -pair[0])]


def where_images_tell(each: list[Points]) -> tuple[Float, Float]:
    """Mean and 95 % Hausdorff distance of each phase, mm, but for `BEYOND` and `STUBS`."""
    mean, far = [], []
    for one in each:
        kept = ~np.isin(one.places, (BEYOND, STUBS))
        sides = [np.abs(one.distance_mm[kept & side]) for side in (one.of_truth, ~one.of_truth)]
        mean.append(np.mean([side.mean() for side in sides]))
        far.append(max(np.percentile(side, 95) for side in sides))
    return np.array(mean), np.array(far)


def main() -> None:
    """Measure every patient and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--patients", type=int, default=20, help="so many, in order of their names")
    parser.add_argument("--farther", type=float, default=3.5, help="mm that count as far off")
    options = parser.parse_args()
    names = sorted(one.parent.name for one in options.out.glob("products/*/surface"))
    found = [measure(options.out, name) for name in names[: options.patients]]
    head = ["structure", "place", "of the surface", f"truth > {options.farther:g} mm off"]
    head += [f"found > {options.farther:g} mm off", "mean distance mm", "mean, + too large"]
    lines, inside = [], []
    for name in PARTS:
        each = [one for patient in found for one in patient.get(name, [])]
        if each:
            lines += rows(name, each, options.farther)
            mean_mm, far_mm = where_images_tell(each)
            sizes = [f"{one.mean():.2f} / {one.max():.2f}" for one in (mean_mm, far_mm)]
            inside.append([tables.SURFACES[name], *sizes, f"{100 * np.mean(far_mm <= 3.5):.0f} %"])
    print(tables.table(head, lines))
    print(f"\nWithout what lies {BEYOND} and the {STUBS}, mean / worst over all phases:\n")
    title = ["structure", "distance mm", "95 % Hausdorff mm", "phases within 3.5 mm"]
    print(tables.table(title, inside))


if __name__ == "__main__":
    main()
