"""What the segmenter does with images unlike those it was trained on: tables of Dice.

    python benchmarks/segmentation_robustness.py [OUT] [--seeds 3] [--first 1] [--phases 2]
        [--ill 8] [--across 8]

Two renderers, side by side: the phantom's own (`data_synth.mr`) and one that shares nothing with
it (`tests.outside_heart`). First images that show no heart, then both as they are and under the
same faults, then hearts of the second one at their worst, and in slices across the body. With
no people a part is left out. With OUT, every figure goes into OUT/robustness.json as well.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).parents[1]))

from data_synth.mr import MrSettings, acquire_cine, count_slices
from data_synth.population import draw_heart
from pipeline.errors import BeatfieldError
from pipeline.imaging.cine import Cine
from pipeline.imaging.labels import LABELS
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import SegmentSettings
from tests.outside_anatomy import Kind
from tests.outside_heart import Outside, Scan, moved, render, without_heart
from tests.outside_people import ILLNESSES

SNR = 30.0
"""Of both renderers' images as they are."""

LARGEST_LOSS = 0.04

Change = Callable[[Outside], Outside]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one study."""

    dice: dict[str, list[float]]
    """Of each structure in each phase that shows it; empty if the study was refused."""
    lowest_confidence: float
    refused: str = ""
    ejection_off: tuple[float, float] = (float("nan"), float("nan"))
    """Points by which the left and the right ventricle's ejection fractions are too large, as the
    slices that are there show them."""


def phantom(seed: int, phases: int, slices: int | None = None) -> Outside:
    """A healthy or ill heart of the phantom, as its own scanner simulation shows it."""
    rng = np.random.default_rng([seed, 4242])
    heart = draw_heart(rng)
    mr = MrSettings(phases=phases, slices=slices, matrix=160, pixel_mm=1.7, snr=SNR,
                    through_plane_samples=4)  # fmt: skip
    found = acquire_cine(rng, heart, [850.0] * (slices or count_slices(heart, mr)), mr)
    cine = Cine(found.intensity.astype(np.float32), found.mr_from_index, found.phases, 0.85)
    return Outside(cine, found.labels)


def outside(seed: int, phases: int, slices: int | None = None, illness: str = "") -> Outside:
    """A heart that shares nothing with the phantom; phase 1 of 3 is near end-systole."""
    return render(seed, Scan(moments(phases), slices, snr=SNR), illness=illness)


def moments(phases: int) -> tuple[float, ...]:
    """End-diastole and about end-systole, or as many phases, evenly spaced."""
    return (0.0, 0.35) if phases == 2 else tuple((np.arange(phases) / phases).tolist())


def inverted(study: Outside) -> Outside:
    """Bright for dark."""
    image = study.cine.intensity
    return with_image(study, image.max() - image)


def noisier(study: Outside) -> Outside:
    """Noise of twice the deviation: independent noise of sqrt(3) times what is there is added."""
    image = study.cine.intensity
    blood = np.median(image[study.labels == LABELS["lv_cavity"]])
    noise = np.random.default_rng(9).standard_normal((2, *image.shape)) * blood / SNR * np.sqrt(3)
    return with_image(study, np.hypot(image + noise[0], noise[1]).astype(np.float32))


def sharpened(study: Outside) -> Outside:
    """As a console shows it: what is finer than 1.2 pixels counts twice."""
    image = study.cine.intensity
    soft = gaussian_filter(image, (0, 0, 1.2, 1.2))
    return with_image(study, np.maximum(2 * image - soft, 0))


def cut_off(study: Outside) -> Outside:
    """Of one white from 0.8 of where the brightest half per cent begins."""
    image = study.cine.intensity
    return with_image(study, np.minimum(image, 0.8 * np.percentile(image, 99.5)))


def coarser(study: Outside) -> Outside:
    """Pixels of twice the side, means of four; labels by vote."""
    image, frame = study.cine.intensity, study.cine.mr_from_index.copy()
    frame[:3, 3] += frame[:3, :2].sum(axis=1) / 2
    frame[:3, :2] *= 2
    votes = np.stack([_in_fours(study.labels == v) for v in range(1 + len(LABELS))])
    cine = replace(study.cine, intensity=_in_fours(image), mr_from_index=frame)
    return Outside(cine, votes.argmax(axis=0).astype(np.uint8))


def smaller(study: Outside) -> Outside:
    """A heart of 0.7 times the size, a child's, in a chest and in pixels as small."""
    frame = study.cine.mr_from_index.copy()
    frame[:3, :3] *= 0.7
    return replace(study, cine=replace(study.cine, mr_from_index=frame))


def _in_fours(values: np.ndarray) -> np.ndarray:
    phases, slices, rows, columns = values.shape
    return np.asarray(
        values[:, :, : rows // 2 * 2, : columns // 2 * 2]
        .reshape(phases, slices, rows // 2, 2, columns // 2, 2)
        .mean(axis=(3, 5), dtype=np.float32)
    )


def third_left_out(study: Outside) -> Outside:
    """Every third slice left out and the rest passed for evenly spaced: the header lies."""
    count = study.labels.shape[1]
    return chosen(study, [z for z in range(count) if z % 3 != 1], 1.5)


def second_left_out(study: Outside) -> Outside:
    """Every second slice left out, as the header says."""
    return chosen(study, list(range(0, study.labels.shape[1], 2)), 2.0)


def three_slices(study: Outside) -> Outside:
    """Apical, middle and basal slice of the left ventricle, as the header says."""
    seen = np.flatnonzero((study.labels[0] == LABELS["lv_cavity"]).any(axis=(1, 2)))
    step = max(1, (seen[-1] - seen[0] - 1) // 2)
    return chosen(study, [seen[-1] - 1 - 2 * step, seen[-1] - 1 - step, seen[-1] - 1], step)


def chosen(study: Outside, numbers: list[int], step: float) -> Outside:
    """Only some slices, said to lie ``step`` times as far apart."""
    frame = study.cine.mr_from_index.copy()
    frame[:3, 3] += numbers[0] * frame[:3, 2]
    frame[:3, 2] *= step
    image = np.ascontiguousarray(study.cine.intensity[:, numbers])
    return Outside(replace(study.cine, intensity=image, mr_from_index=frame),
                   study.labels[:, numbers])  # fmt: skip


def without_header(turn: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Images turned in their plane by ``turn``, with directions along the axes."""

    def change(study: Outside) -> Outside:
        image, labels = (
            np.ascontiguousarray(turn(a)) for a in (study.cine.intensity, study.labels)
        )
        frame = np.diag([*study.cine.spacing_mm, 1.0])
        return Outside(replace(study.cine, intensity=image, mr_from_index=frame), labels)

    return change


def with_image(study: Outside, image: np.ndarray) -> Outside:
    """The same study with other grey values."""
    return Outside(replace(study.cine, intensity=image), study.labels)


CHANGES: dict[str, Change] = {
    "as it is": lambda study: study,
    "contrast inverted": inverted,
    "noise doubled": noisier,
    "edges sharpened": sharpened,
    "brightest cut off": cut_off,
    "resolution halved": coarser,
    "three tenths smaller": smaller,
    "every third slice missing, header even": third_left_out,
    "every second slice missing": second_left_out,
    "three slices": three_slices,
    "shifts 1 mm more": lambda study: moved(study, 1.0, 1),
    "shifts 2 mm more": lambda study: moved(study, 2.0, 2),
    "shifts 3 mm more": lambda study: moved(study, 3.0, 3),
    "orientation lost": without_header(lambda a: a),
    "orientation lost, mirrored": without_header(lambda a: a[..., ::-1]),
    "orientation lost, quarter turn": without_header(lambda a: np.rot90(a, axes=(2, 3))),
    "orientation lost, base first": without_header(lambda a: a[:, ::-1]),
}


def judge(study: Outside) -> Outcome:
    """Segment a study with the default settings and compare with its truth."""
    try:
        found = segment_cine(study.cine, SegmentSettings())
    except BeatfieldError as error:
        return Outcome({}, float("nan"), str(error))
    off = [ejection(found.labels, name) - ejection(study.labels, name)
           for name in ("lv_cavity", "rv_cavity")]  # fmt: skip
    return Outcome(
        overlap(found.labels, study.labels),
        float(np.nanmin(found.confidence)),
        "",
        (off[0], off[1]),
    )


def ejection(labels: Kind, name: str) -> float:
    """Percent that the emptiest phase has less than the fullest, by pixels; NaN without any."""
    pixels = (labels == LABELS[name]).sum(axis=(1, 2, 3))
    return float(100 * (1 - pixels.min() / pixels.max())) if pixels.any() else float("nan")


def overlap(found: Kind, truth: Kind) -> dict[str, list[float]]:
    """Dice of each structure, over all slices of each phase in which the truth shows it."""
    scores: dict[str, list[float]] = {name: [] for name in LABELS}
    for ours, wanted in zip(found, truth, strict=True):
        for name, value in LABELS.items():
            a, b = ours == value, wanted == value
            if b.any():
                scores[name].append(float(2 * (a & b).sum() / (a.sum() + b.sum())))
    return scores


def mean(outcomes: list[Outcome], name: str) -> float:
    """Mean Dice of a structure over what was not refused."""
    scores = [score for outcome in outcomes for score in outcome.dice.get(name, [])]
    return float(np.mean(scores)) if scores else float("nan")


def cell(outcomes: list[Outcome], name: str) -> str:
    """Mean and worst Dice of a structure."""
    scores = [score for outcome in outcomes for score in outcome.dice.get(name, [])]
    return f"{np.mean(scores):.3f} / {min(scores):.3f}" if scores else "-"


def print_row(title: str, outcomes: list[Outcome]) -> None:
    """A row: what was refused, lowest confidence, how far off volumes' changes are, and Dice."""
    refused = [outcome for outcome in outcomes if outcome.refused]
    sure = [outcome.lowest_confidence for outcome in outcomes if not outcome.refused]
    lowest = f"{min(sure):.2f}" if sure else "-"
    off = np.abs([outcome.ejection_off for outcome in outcomes if not outcome.refused])
    ejected = "{:.1f} / {:.1f}".format(*np.nanmean(off, axis=0)) if len(off) else "-"
    cells = " | ".join([ejected, *(cell(outcomes, name) for name in LABELS)])
    print(f"| {title} | {len(refused)} of {len(outcomes)} | {lowest} | {cells} |", flush=True)


def print_refusals(rows: dict[str, list[Outcome]]) -> None:
    """Why studies were refused, a line each."""
    print()
    for title, outcomes in rows.items():
        for outcome in outcomes:
            if outcome.refused:
                print(f"- {title}: {outcome.refused}")


def print_head(title: str) -> None:
    """A table's title and first lines."""
    columns = ["refused", "lowest confidence", "LV / RV ejection fraction off (points)", *LABELS]
    print(f"\n{title}\n\n| | " + " | ".join(columns) + " |")
    print("|---" * (1 + len(columns)) + "|")


def variations(seeds: range, phases: int) -> dict[str, dict[str, list[Outcome]]]:
    """Both renderers under all changes; printed as they come."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    for source, make in (("phantom", phantom), ("outside", outside)):
        studies = [make(seed, phases) for seed in seeds]
        print_head(f"{source}: Dice mean / worst over {len(seeds)} seeds, {phases} phases each")
        found[source] = {}
        for title, change in CHANGES.items():
            outcomes = [judge(change(study)) for study in studies]
            print_row(title, outcomes)
            found[source][title] = outcomes
        found[source]["60 phases, 4 slices"] = [judge(_many_phases(make, seeds[0]))]
        print_row("60 phases, 4 slices", found[source]["60 phases, 4 slices"])
        print_refusals(found[source])
    return found


def illnesses(seeds: range, phases: int) -> dict[str, list[Outcome]]:
    """Hearts from outside at their worst; printed as they come."""
    print_head(f"outside, ill: Dice mean / worst over {len(seeds)} seeds, {phases} phases each")
    found = {}
    for illness in ILLNESSES:
        found[illness] = [judge(outside(seed, phases, illness=illness)) for seed in seeds]
        print_row(illness, found[illness])
    print_refusals(found)
    return found


ACROSS = {
    "volume, voxels of 2.5 mm": {
        "step_mm": 2.5, "thickness_mm": 2.5, "pixel_mm": 2.5, "depths": 2, "shift_sd_mm": 0.0
    },
    "slices of 8 mm": {"step_mm": 8.0},
}  # fmt: skip
"""Scans that do not lie across the left ventricle."""


def across_the_body(seeds: range, phases: int) -> dict[str, list[Outcome]]:
    """Hearts from outside in transverse slices; printed as they come."""
    print_head(f"outside, transverse: Dice mean / worst over {len(seeds)} seeds, {phases} phases")
    found = {}
    for title, how in ACROSS.items():
        scan = Scan(moments(phases), snr=SNR, transverse=True, **how)
        found[title] = [judge(render(seed, scan)) for seed in seeds]
        print_row(title, found[title])
    print_refusals(found)
    return found


def _many_phases(make: Callable[..., Outside], seed: int) -> Outside:
    """The middle of a heart in 60 phases: those of ten times, each shown six times over.

    Drawing 60 different ones would take minutes; noise of each is its own.
    """
    study = make(seed, 10)
    middle = study.labels.shape[1] // 2
    part = chosen(study, list(range(middle - 2, middle + 2)), 1.0)
    image = part.cine.intensity.repeat(6, axis=0)
    noise = np.random.default_rng(2).standard_normal(image.shape) * image.max() / 100
    cine = replace(part.cine, intensity=(image + noise).astype(np.float32),
                   phases=np.arange(60) / 60)  # fmt: skip
    return Outside(cine, part.labels.repeat(6, axis=0))


def print_loss(found: dict[str, dict[str, list[Outcome]]]) -> None:
    """What the step from the phantom's images to those from outside costs."""
    print(f"\nLoss from phantom to outside, as they are (at most {LARGEST_LOSS} wanted)\n")
    print("| structure | phantom | outside | loss |\n|---|---|---|---|")
    for name in LABELS:
        own, other = (mean(found[source]["as it is"], name) for source in ("phantom", "outside"))
        print(f"| {name} | {own:.3f} | {other:.3f} | {own - other:+.3f} |")


def no_heart() -> dict[str, str]:
    """What is said of images that show no heart."""
    said = {}
    print("\nImages without a heart\n\n| images | answer |\n|---|---|")
    kinds = [("constant", 1), ("gradient", 1)]
    kinds += [(kind, seed) for kind in ("noise", "brain", "chest") for seed in (1, 2, 3)]
    for kind, seed in kinds:
        title = f"{kind} {seed}"
        try:
            found = segment_cine(without_heart(kind, seed), SegmentSettings())
            said[title] = f"LABELLED, lowest confidence {np.nanmin(found.confidence):.2f}"
        except BeatfieldError as error:
            said[title] = f"{type(error).__name__}: {error}"
        print(f"| {title} | {said[title]} |", flush=True)
    return said


def main() -> None:
    """Run everything and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--phases", type=int, default=2)
    parser.add_argument("--ill", type=int, default=8, help="people with each illness")
    parser.add_argument("--across", type=int, default=8, help="people in transverse slices")
    options = parser.parse_args()
    start = time.monotonic()
    said: dict[str, str] = {}
    found: dict[str, dict[str, list[Outcome]]] = {}

    def people(count: int) -> range:
        return range(options.first, options.first + count)

    if options.seeds:
        said = no_heart()
        found = variations(people(options.seeds), options.phases)
    if options.ill:
        found["ill"] = illnesses(people(options.ill), options.phases)
    if options.across:
        found["transverse"] = across_the_body(people(options.across), options.phases)
    if options.seeds:
        print_loss(found)
    print(f"\n{time.monotonic() - start:.0f} s")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        table = {
            source: {title: [as_json(one) for one in outcomes] for title, outcomes in rows.items()}
            for source, rows in found.items()
        }
        text = json.dumps({"dice": table, "without heart": said}, indent=1)
        (options.out / "robustness.json").write_text(text + "\n")


def as_json(outcome: Outcome) -> dict[str, object]:
    """An outcome as JSON takes it."""
    sure = None if outcome.refused else round(outcome.lowest_confidence, 4)
    off = [None if np.isnan(one) else round(one, 2) for one in outcome.ejection_off]
    return {"dice": outcome.dice, "lowest_confidence": sure, "refused": outcome.refused,
            "ejection_off": off}  # fmt: skip


if __name__ == "__main__":
    main()
