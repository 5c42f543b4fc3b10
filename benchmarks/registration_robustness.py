"""What registration does with ultrasound unlike that it was trained on: tables of errors.

    python benchmarks/registration_robustness.py OUT [--hearts 20] [--seed 701] [--people 12]
        [--first 136] [--frames 40]

The same sweeps of the phantom's hearts, registered to the phantom's own surfaces, with its own
pictures and with those of a renderer that shares nothing with it (`tests.outside_ultrasound`);
then people who share nothing with the phantom (`tests.outside_heart`), scanned by their own cine,
segmented and followed by the pipeline, and seen by the other renderer: nothing of theirs was ever
trained on. Pictures have other noise, haze, shadows, filters and grey curves from study to study.
Starts are up to 20 mm and 20 degrees off. Dice is that of blood in what is read from a sweep.
What OUT/results.jsonl holds, line by line, is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from registration_figures import SHARES, registered
from registration_studies import SWEEPS, Study, require_same, start_of, stream_of, true_surfaces
from registration_tables import HEAD, calibration, line

sys.path.insert(0, str(Path(__file__).parents[1]))

from data_synth.heart import BeatingHeart
from data_synth.pathology import PATHOLOGIES
from data_synth.probe import EXAMINATIONS
from data_synth.settings import PhantomSettings
from data_synth.simulate import SWEEP_PAUSE_S, ULTRASOUND, ULTRASOUND_ECG, load_heart, record_ecg
from data_synth.tissue import Tissue
from data_synth.ultrasound import Sweep, simulate_sweeps
from pipeline.errors import BeatfieldError
from pipeline.geometry import Float, MovingSurface
from pipeline.imaging.cine import Cine
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import SegmentSettings
from pipeline.registration.frames import DisplacedSweep
from pipeline.registration.reading import Reader
from pipeline.registration.settings import RegisterSettings
from pipeline.surface.extraction import extract
from pipeline.surface.settings import SurfaceSettings
from tests import outside_sweeps
from tests.outside_anatomy import Kind, Stuff
from tests.outside_heart import Scan, render
from tests.outside_people import ILLNESSES
from tests.outside_ultrasound import FANS, Console, StuffAt, picture

PHASES = 16
"""Of the other cine."""

VERDICTS = 6
"""Lines of the table of what verdicts are worth."""

LEAST_SHOWN = 0.03
"""Share of a picture that blood must fill for its Dice to count."""

AS_OUTSIDE: dict[Tissue, Stuff] = {
    Tissue.AIR: Stuff.NONE, Tissue.FAT: Stuff.FAT, Tissue.MUSCLE: Stuff.MUSCLE,
    Tissue.LUNG: Stuff.LUNG, Tissue.BONE: Stuff.MARROW, Tissue.LIVER: Stuff.LIVER,
    Tissue.BLOOD_VESSEL: Stuff.BLOOD, Tissue.LV_CAVITY: Stuff.LV_BLOOD,
    Tissue.LV_MYOCARDIUM: Stuff.LV_MUSCLE, Tissue.RV_CAVITY: Stuff.RV_BLOOD,
    Tissue.RV_WALL: Stuff.WALL, Tissue.LEFT_ATRIUM: Stuff.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM: Stuff.RIGHT_ATRIUM, Tissue.ATRIAL_WALL: Stuff.WALL,
    Tissue.AORTA: Stuff.AORTA, Tissue.VESSEL_WALL: Stuff.WALL, Tissue.STOMACH: Stuff.STOMACH,
    Tissue.PAPILLARY_MUSCLE: Stuff.LV_PAPILLARY, Tissue.RV_TRABECULA: Stuff.RV_TRABECULA,
    Tissue.PERICARDIUM: Stuff.PERICARDIUM, Tissue.GAS: Stuff.NONE, Tissue.SPLEEN: Stuff.SPLEEN,
    Tissue.LEAFLET: Stuff.WALL, Tissue.SCAR: Stuff.LV_MUSCLE,
}  # fmt: skip
STUFF = np.array([AS_OUTSIDE[one] for one in Tissue], np.uint8)

Truth = list[np.ndarray]
"""Of each sweep ``(n, h, w)`` True where blood of a cavity is."""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description="Registration of pictures from elsewhere.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--hearts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=701)
    parser.add_argument("--people", type=int, default=12)
    parser.add_argument("--first", type=int, default=136)
    parser.add_argument("--frames", type=int, default=40, help="of each of the two sweeps")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    require_same(arguments.out, {"frames": arguments.frames})
    path = arguments.out / "results.jsonl"
    results = [json.loads(one) for one in path.read_text().splitlines()] if path.exists() else []
    with path.open("a") as handle:
        for one in studies(arguments, {one["study"] for one in results}):
            results.append(one)
            handle.write(json.dumps(one) + "\n")
            handle.flush()
    print(tables(results))


def studies(arguments: argparse.Namespace, done: set[str]) -> Iterator[dict[str, Any]]:
    """Lines of the results that are not there yet."""
    for k in range(arguments.hearts):
        seed, illness = arguments.seed + k, PATHOLOGIES[k % len(PATHOLOGIES)]
        for number, probe in enumerate(outside_sweeps.EXAMINATIONS):
            name = f"{seed}-{illness}-{probe}"
            if not {f"{name}-phantom", f"{name}-other"} <= done:
                yield from of_phantom(seed, illness, probe, 3 * k + number, arguments.frames, done)
    for k in range(arguments.people):
        # Healthy or ill as drawn, and every third with an illness at its worst.
        seed, illness = (
            arguments.first + k,
            ILLNESSES[k // 3 % len(ILLNESSES)] if k % 3 == 2 else "",
        )
        yield from of_person(seed, illness, k, arguments.frames, done)


def of_phantom(
    seed: int, illness: str, probe: str, number: int, frames: int, done: set[str]
) -> Iterator[dict[str, Any]]:
    """The same sweeps of the phantom with both renderers' pictures."""
    shown = {"probe": probe, "sweeps": SWEEPS, "frames": frames}
    settings = PhantomSettings.model_validate(
        {"seed": seed, "pathology": illness, "ultrasound": shown}
    )
    heart, preset = load_heart(settings), settings.ultrasound
    needed_s = preset.sweeps * (preset.frames / preset.frame_rate_hz + SWEEP_PAUSE_S)
    r_times_s = record_ecg(settings, ULTRASOUND_ECG, needed_s).r_times_s
    sweeps = simulate_sweeps(stream_of(settings, ULTRASOUND), heart, r_times_s, preset)
    targets_mm = heart.surfaces(0.0)["heart"][0]
    phases = [one.nominal_phases % 1.0 for one in sweeps]
    surfaces = true_surfaces(settings)
    rng = np.random.default_rng([seed, len(probe), 9])
    consoles = {kind: Console.drawn(rng, fan) for kind, fan in FANS.items()}
    for renderer in ("phantom", "other"):
        name, blood = f"{seed}-{illness}-{probe}-{renderer}", None
        if name in done:
            continue
        tracked = [as_recorded(one) for one in sweeps]
        if renderer == "other":
            kinds = [kind for kind, _ in EXAMINATIONS[probe]]
            pairs = [
                seen_otherwise(rng, one, heart, kind, consoles[kind])
                for one, kind in zip(sweeps, kinds, strict=False)
            ]
            tracked, blood = [one for one, _ in pairs], [truth for _, truth in pairs]
        study = Study(tracked, phases, sweeps[0].mr_from_tracker, targets_mm)
        yield about(name, probe, f"phantom, {renderer}", study, surfaces, None, number, blood)


def as_recorded(sweep: Sweep) -> DisplacedSweep:
    """What the pipeline is given of a sweep."""
    poses = sweep.probe_to_tracker @ sweep.image_to_probe
    return DisplacedSweep(sweep.name, sweep.images.astype(np.float32), poses)


def seen_otherwise(
    rng: np.random.Generator, sweep: Sweep, heart: BeatingHeart, kind: str, console: Console
) -> tuple[DisplacedSweep, np.ndarray]:
    """The sweep as the other renderer shows it, with all errors of its tracking; and its blood."""
    fan, own = FANS[kind], sweep.image_to_probe
    true = sweep.mr_from_tracker @ sweep.true_probe_to_tracker @ sweep.true_image_to_probe
    told = sweep.probe_to_tracker @ own
    # Both pictures begin at the tip, with another number of columns before it and other pixels.
    pixel_mm, columns = np.linalg.norm(own[:3, 0]), sweep.images.shape[2]
    image_from_transducer = np.diag([1 / pixel_mm, 1 / pixel_mm, 1 / pixel_mm, 1.0])
    image_from_transducer[0, 3] = columns // 2
    shown = [
        picture(rng, console, fan, stuff_of(heart, float(phase), moved_mm), pose)
        for phase, moved_mm, pose in zip(
            sweep.nominal_phases, sweep.displacement_mm, true @ image_from_transducer, strict=True
        )
    ]
    images = np.stack([one.grey for one in shown]).astype(np.float32)
    poses = told @ image_from_transducer @ fan.transducer_from_image
    return DisplacedSweep(sweep.name, images, poses), np.stack([one.blood for one in shown])


def stuff_of(heart: BeatingHeart, phase: float, moved_mm: Float) -> StuffAt:
    """The phantom's tissues by the other renderer's names; the chest does not breathe."""

    def at(points_mm: Float) -> Kind:
        tissue = np.array(heart.heart_tissue(points_mm - moved_mm, phase))
        rest = tissue == 0
        tissue[rest] = heart.chest_tissue(points_mm[rest])
        return np.asarray(STUFF[tissue])

    return at


def of_person(
    seed: int, illness: str, k: int, frames: int, done: set[str]
) -> Iterator[dict[str, Any]]:
    """A person who shares nothing with the phantom, by every examination."""
    names = [f"{seed}-{illness or 'drawn'}-{probe}-people" for probe in outside_sweeps.EXAMINATIONS]
    if done.issuperset(names):
        return
    times = tuple((np.arange(PHASES) / PHASES).tolist())
    cine = render(seed, Scan(times), illness=illness).cine
    try:
        found = segment_cine(cine, SegmentSettings())
        moving = extract(found.heart, found.heart_mr_from_index, cine.phases, SurfaceSettings())
    except BeatfieldError as refusal:
        print(f"{seed} {illness}: {refusal}", file=sys.stderr)
        return
    body = outside_sweeps.person(seed, illness)
    for number, (name, probe) in enumerate(zip(names, outside_sweeps.EXAMINATIONS, strict=True)):
        if name not in done:
            made = outside_sweeps.record(seed, body, probe, frames)
            study = Study(made.sweeps, made.phases, made.mr_from_tracker, made.targets_mm)
            yield about(name, probe, "people, other", study, moving.surfaces, cine, 3 * k + number,
                        made.blood)  # fmt: skip


def about(
    name: str,
    probe: str,
    source: str,
    study: Study,
    surfaces: dict[str, MovingSurface],
    cine: Cine | None,
    number: int,
    blood: Truth | None,
) -> dict[str, Any]:
    """One line of the results."""
    share = SHARES[number % len(SHARES)]
    start = start_of(study, 100 * number + 7, 20 * share, 20 * share)
    measured, _ = registered(study, surfaces, cine, start, RegisterSettings())
    count = sum(len(one.images) for one in study.sweeps)
    kept = {"study": name, "method": "beatfield", "source": source, "probe": probe, "frames": count}
    overlap = [] if blood is None else [
        read_overlap(one, truth) for one, truth in zip(study.sweeps, blood, strict=True)
    ]  # fmt: skip
    return kept | {"dice": overlap} | measured


def read_overlap(sweep: Any, truth: np.ndarray) -> float:
    """Mean Dice of blood in the pictures of a sweep that show enough of it."""
    reader = Reader.of(sweep)
    read = reader.sweep(sweep)
    found = read.images > 0.5
    rows, columns = found.shape[1:]
    across, down = np.meshgrid(np.arange(columns), np.arange(rows))
    # Pixels of both begin in the same place.
    there = [
        (axis * step).astype(np.float32)
        for axis, step in zip((across, down), reader.step, strict=True)
    ]
    seen = np.stack([cv2.remap(one.astype(np.float32), *there, cv2.INTER_LINEAR) for one in truth])
    scores = [
        2 * (a & b).sum() / (a.sum() + b.sum())
        for a, b in zip(found, seen > 0.5, strict=True)
        if b.mean() > LEAST_SHOWN
    ]
    return float(np.mean(scores)) if scores else float("nan")


def tables(results: list[dict[str, Any]]) -> str:
    """All as Markdown."""
    text = []
    for source in dict.fromkeys(one["source"] for one in results):
        some = [one for one in results if one["source"] == source]
        text += [f"{source}'s pictures:", "", HEAD, line("all", some)]
        for probe in dict.fromkeys(one["probe"] for one in some):
            text.append(line(probe, [one for one in some if one["probe"] == probe]))
        dice = [score for one in some for score in one["dice"] if np.isfinite(score)]
        if dice:
            text += ["", f"Dice of blood, by sweep: median {np.median(dice):.3f}, tenth percentile "
                     f"{np.quantile(dice, 0.1):.3f}, worst {min(dice):.3f}."]  # fmt: skip
        text += ["", *calibration(some)[:VERDICTS], ""]
    return "\n".join(text)


if __name__ == "__main__":
    main()
