"""How truly, how surely and how fast tracked ultrasound is registered, over unseen studies.

    python benchmarks/registration_figures.py OUT [--hearts 20] [--seed 3001] [--starts 1]
        [--probes combined,intracardiac,epicardial] [--surfaces truth|PRODUCTS] [--phases 20]
        [--peer 20] [--global 0] [--calibration-error MM DEG] [--mr-pixels 1] [--reading grey]
        [--frames 48,24,40,12,48,32,16]

Each heart is examined with each probe, every time with another number of frames, share of frames
lost and level of noise, and registered from starts of up to 20 mm and 20 degrees off.
``--surfaces`` names a folder of products, one a patient named ``<seed>-<pathology>`` as
benchmarks/segmentation_figures.py leaves them: its hearts are registered to what the pipeline found
in the cine, and to the cine itself, rather than to the phantom's own meshes at ``--phases`` moments
of the beat. ``--peer N`` runs SimpleITK's mutual information beside it on the first N studies,
``--global N`` registers the first N without any start. ``--calibration-error MM DEG`` puts the
pictures of each sweep so far beside their place, and registers with ``calibration: per_sweep`` too
(0 0: right). ``--frames`` are the frames of the studies, in turn. ``--mr-pixels 1.05`` tells larger
pixels of the cine. What OUT/results.jsonl holds, line by line, is not done again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from registration_peer import compounded, mr_volume, mutual_information
from registration_studies import (
    RECORDED,
    SWEEPS,
    Order,
    Study,
    found_surfaces,
    make_study,
    miscalibrated,
    require_same,
    start_of,
    true_surfaces,
)
from scipy.stats import chi2

from data_synth.pathology import PATHOLOGIES
from data_synth.simulate import load_heart
from pipeline.errors import BeatfieldError
from pipeline.geometry import Float, MovingSurface, transform_points
from pipeline.imaging.cine import Cine
from pipeline.products import read_cine
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import Size, planes_of
from pipeline.registration.space import find
from pipeline.registration.uncertainty import motion_between
from pipeline.registration.verdict import Evidence, judge

FRAMES = "48,24,40,12,48,32,16"
DROPOUT = (0.0, 0.2, 0.0, 0.4, 0.6)
SNR_DB = (None, 20.0, 10.0)
CAPTURED_MM = 2.0
Model = tuple[dict[str, MovingSurface], Cine | None]
SHARES = (1.0, 0.5, 0.75, 0.25)
"""Of 20 mm and 20 degrees: how far off the starts of a study are, in turn."""


def orders(arguments: argparse.Namespace) -> Iterator[Order]:
    """The studies; what varies goes round with periods that share no factor, or nearly so."""
    hearts = [
        (arguments.seed + k, PATHOLOGIES[k % len(PATHOLOGIES)]) for k in range(arguments.hearts)
    ]
    if arguments.surfaces != "truth":
        names = [one.name.split("-", 1) for one in Path(arguments.surfaces).iterdir()]
        hearts = sorted((int(seed), illness) for seed, illness in names)[: arguments.hearts]
    frames = [int(count) for count in arguments.frames.split(",")]
    examined = ((heart, probe) for heart in hearts for probe in arguments.probes.split(","))
    for k, ((seed, illness), probe) in enumerate(examined):
        yield Order(
            seed=seed,
            pathology=illness,
            probe=probe,
            frames=frames[k % len(frames)],
            dropout=DROPOUT[k % len(DROPOUT)],
            snr_db=SNR_DB[(k // 2) % len(SNR_DB)],
            recorded=max(RECORDED, -(-max(frames) // SWEEPS)),
        )


def error_mm(study: Study, pose: Float) -> Float:
    """Target registration error at the points of the heart."""
    tracker = transform_points(np.asarray(np.linalg.inv(study.mr_from_tracker)), study.targets_mm)
    shown_mm = transform_points(study.shown_from_mr, study.targets_mm)
    return np.asarray(np.linalg.norm(transform_points(pose, tracker) - shown_mm, axis=1))


def with_pixels_wrong(
    study: Study, surfaces: dict[str, MovingSurface], cine: Cine, factor: float
) -> tuple[Study, dict[str, MovingSurface], Cine]:
    """The same with MR pixels that are told to be larger by a factor, and so the heart in them."""
    linear = np.eye(3) + (factor - 1) * planes_of(cine)
    stretch = np.eye(4)
    stretch[:3, :3] = linear
    stretch[:3, 3] = (np.eye(3) - linear) @ study.targets_mm.mean(axis=0)
    shown = {
        name: replace(one, vertices_mm=transform_points(stretch, one.vertices_mm))
        for name, one in surfaces.items()
    }
    told = replace(cine, mr_from_index=stretch @ cine.mr_from_index)
    return replace(study, shown_from_mr=stretch), shown, told


def registered(
    study: Study,
    surfaces: dict[str, MovingSurface],
    cine: Cine | None,
    start: Float | None,
    settings: RegisterSettings,
) -> dict[str, Any]:
    """One registration: errors, verdict and seconds."""
    began = time.perf_counter(), time.process_time()
    try:
        found = find(study.sweeps, study.phases, surfaces, start, settings, cine=cine)
    except BeatfieldError as refusal:
        return {"verdict": "refused", "reason": str(refusal)}
    wall_s, cpu_s = time.perf_counter() - began[0], time.process_time() - began[1]
    error = error_mm(study, found.mr_from_tracker)
    return {
        "mean_mm": float(error.mean()),
        "quantiles_mm": np.quantile(error, np.linspace(0, 1, 21)).tolist(),
        "expected_mm": found.expected_mm,
        "chance_under_2_mm": found.chance_under_2_mm,
        "error": motion_between(
            found.mr_from_tracker, study.mr_from_tracker, found.centre_mm
        ).tolist(),
        "covariance": found.covariance.tolist(),
        "confidence": found.confidence,
        "rival": found.rival,
        "larger": found.size.larger,
        "better_by_size": found.size.gain,
        "valid": float(found.valid.sum() / max((found.residual < 1).sum(), 1)),
        "verdict": found.verdict,
        "reason": found.reason,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
    }


def peer(order: Order, study: Study, start: Float) -> dict[str, Any]:
    """The same by mutual information."""
    heart = load_heart(order.settings())
    moving = mr_volume(heart, np.random.default_rng([order.seed, 5]))
    began = time.perf_counter()
    try:
        fixed, mask = compounded(
            [sweep.images.astype(float) for sweep in study.sweeps],
            [sweep.tracker_from_image for sweep in study.sweeps],
            study.phases,
        )
        pose = mutual_information(fixed, mask, moving, start, heart.centre_mm)
    except (ValueError, RuntimeError) as refusal:
        return {"verdict": "refused", "reason": str(refusal).splitlines()[-1]}
    error = error_mm(study, pose)
    return {
        "mean_mm": float(error.mean()),
        "quantiles_mm": np.quantile(error, np.linspace(0, 1, 21)).tolist(),
        "wall_s": time.perf_counter() - began,
    }


def work(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Do what has not been done yet; all results."""
    path = arguments.out / "results.jsonl"
    arguments.out.mkdir(parents=True, exist_ok=True)
    decisive = ("surfaces", "phases", "calibration_error", "mr_pixels", "reading")
    require_same(arguments.out, {name: getattr(arguments, name) for name in decisive})
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(one["study"], one["method"], one["start"]) for one in results}
    products = None if arguments.surfaces == "truth" else Path(arguments.surfaces)
    with path.open("a") as handle:
        for number, order in enumerate(orders(arguments)):
            for method, start in tasks(arguments, number):
                if (order.name, method, start) not in done:
                    one = result_of(order, method, start, arguments, products)
                    results.append(one)
                    handle.write(json.dumps(one) + "\n")
                    handle.flush()
    return results


def tasks(arguments: argparse.Namespace, number: int) -> list[tuple[str, int]]:
    """Methods and numbers of starts for one study."""
    # Starts are numbered through all studies, so that how far off they are goes round.
    first = number * arguments.starts
    ours = [("beatfield", start) for start in range(first, first + arguments.starts)]
    wrong = arguments.calibration_error is not None
    ours += [("per_sweep", start) for start in range(first, first + arguments.starts) if wrong]
    ours += [("global", first)] if number < arguments.without_start else []
    return ours + ([("peer", first)] if number < arguments.peer else [])


def result_of(
    order: Order, method: str, start: int, arguments: argparse.Namespace, products: Path | None
) -> dict[str, Any]:
    """One line of the results."""
    study = make_study(order, arguments.out / "studies")
    if arguments.calibration_error is not None:
        study = miscalibrated(study, order.seed, *arguments.calibration_error)
    share = SHARES[start % len(SHARES)]
    guess = start_of(study, 100 * order.seed + start, 20 * share, 20 * share)
    if method == "peer":
        measured = peer(order, study, guess)
    else:
        surfaces, cine = _model(order, products, arguments.phases)
        if cine is not None and arguments.mr_pixels != 1:
            study, surfaces, cine = with_pixels_wrong(study, surfaces, cine, arguments.mr_pixels)
        known = None if method == "global" else guess
        corrected = "per_sweep" if method == "per_sweep" else "fixed"
        settings = RegisterSettings(calibration=corrected, reading=arguments.reading)
        measured = registered(study, surfaces, cine, known, settings)
    about = {"study": order.name, "method": method, "start": start, "share": share}
    keys = ("probe", "frames", "dropout", "snr_db", "pathology")
    return about | {key: getattr(order, key) for key in keys} | measured


def _model(order: Order, products: Path | None, phases: int) -> Model:
    """The moving surfaces, and the cine that they were found in."""
    if products is None:
        return true_surfaces(order.settings(), phases), None
    folder = products / f"{order.seed}-{order.pathology}"
    return found_surfaces(folder), read_cine(folder / "ingest")


def line(name: str, some: list[dict[str, Any]]) -> str:
    """One row of a table."""
    whole = [one for one in some if "mean_mm" in one]
    if not whole:
        return f"| {name} | {len(some)} | | | | | |"
    points = np.concatenate([one["quantiles_mm"] for one in whole])
    means = np.array([one["mean_mm"] for one in whole])
    seconds = [one.get("cpu_s", one["wall_s"]) for one in whole]
    # What is refused at the door ends nowhere: it counts as not captured.
    captured = (means < CAPTURED_MM).sum() / len(some)
    return (
        f"| {name} | {len(some)} | {np.median(points):.2f} | {np.quantile(points, 0.95):.2f} | "
        f"{np.median(means):.2f} | {captured:.1%} | {np.median(seconds):.1f} |"
    )


HEAD = (
    "| | runs | median TRE (mm) | 95th percentile | median of means | under 2 mm | CPU s |\n"
    "|---|---|---|---|---|---|---|"
)


def tables(results: list[dict[str, Any]]) -> str:
    """All results as Markdown."""
    ours = [one for one in results if one["method"] == "beatfield"]
    text = [HEAD]
    names = {
        "beatfield": "beatfield",
        "per_sweep": "calibration: per_sweep",
        "global": "without a start",
        "peer": "SimpleITK MI",
    }
    for method, name in names.items():
        some = [one for one in results if one["method"] == method]
        text += [line(name, some)] if some else []
    trusted = [one for one in ours if graded(one) in ("good", "doubtful")]
    text.append(line("beatfield, verdict not failed", trusted))
    both = {(one["study"], one["start"]) for one in results if one["method"] == "peer"}
    if both:
        same = [one for one in ours if (one["study"], one["start"]) in both]
        text.append(line("beatfield, the same as SimpleITK MI", same))
    for key in ("share", "probe", "frames", "dropout", "snr_db", "pathology"):
        text += ["", f"By {key}:", "", HEAD]
        for value in sorted({one[key] for one in ours}, key=_rank):
            text.append(line(str(value), [one for one in ours if one[key] == value]))
    text += ["", *calibration(ours)]
    corrected = [one for one in results if one["method"] == "per_sweep"]
    if corrected:
        text += ["", "With calibration: per_sweep:", "", HEAD]
        for probe in sorted({one["probe"] for one in corrected}):
            text.append(line(probe, [one for one in corrected if one["probe"] == probe]))
        text += ["", *calibration(corrected)]
    return "\n".join(text)


def _rank(value: float | str | None) -> tuple[float, str]:
    """Sorts numbers by size, after none, and names by letter."""
    return (value, "") if isinstance(value, (int, float)) else (-np.inf, str(value or ""))


def calibration(results: list[dict[str, Any]]) -> list[str]:
    """What the verdicts and the expected errors are worth."""
    text = ["| verdict | runs | under 2 mm | median expected (mm) | root mean square error (mm) |"]
    text.append("|---|---|---|---|---|")
    for verdict in ("good", "doubtful", "failed", "refused"):
        some = [one for one in results if graded(one) == verdict]
        whole = [one for one in some if "mean_mm" in one]
        if not whole:
            text.append(f"| {verdict} | {len(some)} | | | |")
            continue
        means = np.array([one["mean_mm"] for one in whole])
        expected = np.median([one["expected_mm"] for one in whole])
        rms = np.sqrt((means**2).mean())
        under = f"{(means < CAPTURED_MM).mean():.1%}"
        text.append(f"| {verdict} | {len(some)} | {under} | {expected:.2f} | {rms:.2f} |")
    parts = (chances(results), thresholds(results), coverage(results), sizes(results))
    for part in parts:
        text += ["", *part]
    return text


def sizes(results: list[dict[str, Any]]) -> list[str]:
    """How many results fit another size of the heart clearly better."""
    gains = np.array([one["better_by_size"] for one in results if "better_by_size" in one])
    if not len(gains):
        return []
    told = sum(Size(0.0, gain).in_doubt for gain in gains)
    best = ", ".join(f"{gain:.1%}" for gain in np.sort(gains)[::-1][:3])
    return [f"Size in doubt: {told} of {len(gains)}; the largest gains are {best}."]


def chances(results: list[dict[str, Any]]) -> list[str]:
    """The chance that results give themselves to be under 2 mm, and how many are."""
    trusted = [one for one in results if graded(one) in ("good", "doubtful")]
    text = ["| chance of under 2 mm | runs | mean chance | under 2 mm |", "|---|---|---|---|"]
    for low, high in ((0.0, 0.7), (0.7, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.01), (0.0, 1.01)):
        some = [one for one in trusted if low <= one["chance_under_2_mm"] < high]
        if some:
            mean = np.mean([one["chance_under_2_mm"] for one in some])
            under = np.mean([one["mean_mm"] < CAPTURED_MM for one in some])
            text.append(
                f"| {low:.2f} to {min(high, 1):.2f} | {len(some)} | {mean:.2f} | {under:.2f} |"
            )
    return text


def graded(one: dict[str, Any], good_tre_mm: float | None = None) -> str:
    """The verdict on a kept result as today's settings give it; failures stay failures."""
    if one["verdict"] not in ("good", "doubtful"):
        return str(one["verdict"])
    settings = RegisterSettings()
    limit_mm = {"good_tre_mm": good_tre_mm or settings.good_tre_mm}
    sure = one["confidence"], one["rival"], one["expected_mm"]
    valid = round(one["valid"] * one["frames"])
    size = Size(one.get("larger", 0.0), one.get("better_by_size", 0.0))
    return judge(
        Evidence(*sure, valid, one["frames"], shift_mm=0.0, turn_deg=0.0, size=size),
        settings.model_copy(update=limit_mm),
    ).grade


def thresholds(results: list[dict[str, Any]]) -> list[str]:
    """Results that are good under each threshold, and how many of them are under 2 mm, on seeds
    that are even, to choose by, and odd, to see whether the choice holds."""
    text = ["| good_tre_mm | even seeds: good | under 2 mm | odd seeds: good | under 2 mm |"]
    text.append("|---|---|---|---|---|")
    for limit_mm in np.arange(1.5, 2.01, 0.05):
        cells = [f"{limit_mm:.2f}"]
        for odd in (0, 1):
            means = [
                one["mean_mm"]
                for one in results
                if int(one["study"].split("-")[0]) % 2 == odd
                and graded(one, float(limit_mm)) == "good"
            ]
            cells += [str(len(means)), str(sum(mean < CAPTURED_MM for mean in means))]
        text.append("| " + " | ".join(cells) + " |")
    return text


def coverage(results: list[dict[str, Any]]) -> list[str]:
    """Errors of what did not fail, in units of what was expected."""
    some = [one for one in results if one["verdict"] in ("good", "doubtful")]
    ratios = np.array([one["mean_mm"] / one["expected_mm"] for one in some])
    squares = np.array(
        [
            np.array(one["error"]) @ np.linalg.solve(np.array(one["covariance"]), one["error"])
            for one in some
        ]
    )
    within = [(squares < chi2.ppf(share, 6)).mean() for share in (0.5, 0.8, 0.95, 0.99)]
    return [
        f"Of the {len(some)} that did not fail: mean error over expected, median "
        f"{np.median(ratios):.2f}, 95th percentile {np.quantile(ratios, 0.95):.2f}; six-parameter "
        "errors within the ellipsoids of 50, 80, 95 and 99 %: "
        + ", ".join(f"{share:.0%}" for share in within)
        + f"; squared error in units of the covariance {squares.mean():.1f} (6 if it is right)."
    ]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description="Figures of registration over unseen studies.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--hearts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=3001)
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--probes", default="combined,intracardiac,epicardial")
    parser.add_argument("--surfaces", default="truth")
    parser.add_argument("--phases", type=int, default=20, help="of the phantom's own surfaces")
    parser.add_argument("--peer", type=int, default=20)
    parser.add_argument("--frames", default=FRAMES, help="of the studies, in turn")
    parser.add_argument("--calibration-error", nargs=2, type=float, metavar=("MM", "DEG"))
    parser.add_argument("--mr-pixels", type=float, default=1.0, metavar="FACTOR")
    parser.add_argument("--reading", choices=["network", "grey"], default="network")
    parser.add_argument("--global", dest="without_start", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.mr_pixels != 1 and arguments.surfaces == "truth":
        parser.error("--mr-pixels needs --surfaces PRODUCTS, which have a cine")
    print(tables(work(arguments)))


if __name__ == "__main__":
    main()
