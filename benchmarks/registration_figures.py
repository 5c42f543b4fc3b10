"""How truly, how surely and how fast tracked ultrasound is registered, over unseen studies.

    python benchmarks/registration_figures.py OUT [--hearts 20] [--seed 3001] [--starts 1]
        [--probes combined,intracardiac,epicardial] [--surfaces truth|PRODUCTS] [--phases 20]
        [--peer 20] [--global 0] [--calibration-error MM DEG] [--moved 0] [--mr-pixels 1]
        [--reading grey]
        [--frames 48,24,40,12,48,32,16]

Each heart is examined with each probe, every time with another number of frames, share of frames
lost and level of noise, and registered from starts of up to 20 mm and 20 degrees off.
``--surfaces`` names a folder of products, one a patient named ``<seed>-<pathology>`` as
benchmarks/segmentation_figures.py leaves them: its hearts are registered to what the pipeline found
in the cine, and to the cine itself, rather than to the phantom's own meshes at ``--phases`` moments
of the beat. ``--peer N`` runs SimpleITK's mutual information beside it on the first N studies,
``--global N`` registers the first N without any start. ``--calibration-error MM DEG`` puts the
pictures of each sweep so far beside their place, and registers with ``calibration: per_sweep`` too
(0 0: right). ``--moved 4`` moves the patient by so many millimetres between the two sweeps.
``--frames`` are the frames of the studies, in turn. ``--mr-pixels 1.05`` tells larger pixels of the
cine. What OUT/results.jsonl holds, line by line, is not done again.
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
    moved_between,
    require_same,
    start_of,
    true_surfaces,
)
from registration_tables import tables

from data_synth.heart import BeatingHeart
from data_synth.pathology import PATHOLOGIES
from data_synth.simulate import load_heart
from pipeline.errors import BeatfieldError
from pipeline.exact import ExactSurface, points_about
from pipeline.geometry import Float, MovingSurface, Surface, transform_points
from pipeline.imaging.cine import Cine
from pipeline.products import read_cine
from pipeline.registration.pose_search import Pivot
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import planes_of
from pipeline.registration.space import find

FRAMES = "48,24,40,12,48,32,16"
DROPOUT = (0.0, 0.2, 0.0, 0.4, 0.6)
SNR_DB = (None, 20.0, 10.0)
CHAMBERS = ("lv_endocardium", "epicardium", "rv_endocardium", "left_atrium", "right_atrium")
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
        if not hearts:
            raise SystemExit(
                f"{arguments.surfaces}: no products of benchmarks/segmentation_figures.py"
            )
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


def walls_mm(
    heart: BeatingHeart, study: Study, surfaces: dict[str, MovingSurface], pose: Float
) -> float:
    """How far the chambers' walls truly are from where surfaces and pose together put them: the
    mean over points all over them, at three moments of the beat. This is what a tool feels."""
    rng, away_mm = np.random.default_rng(5), []
    shown_from_true = pose @ np.linalg.inv(study.mr_from_tracker)
    for name in (one for one in CHAMBERS if one in surfaces):
        moving = surfaces[name]
        for k in np.linspace(0, len(moving.phases), 3, endpoint=False).astype(int):
            true = Surface(*heart.surfaces(float(moving.phases[k]), [name])[name])
            found = ExactSurface(Surface(moving.vertices_mm[k], moving.triangles))
            points = points_about(true, rng, 300, 0.0)
            away_mm.append(found.distance_mm(transform_points(shown_from_true, points)))
    return float(np.abs(away_mm).mean())


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
) -> tuple[dict[str, Any], Float | None]:
    """One registration: errors, verdict and seconds; and the pose."""
    began = time.perf_counter(), time.process_time()
    try:
        found = find(study.sweeps, study.phases, surfaces, start, settings, cine=cine)
    except BeatfieldError as refusal:
        return {"verdict": "refused", "reason": str(refusal)}, None
    wall_s, cpu_s = time.perf_counter() - began[0], time.process_time() - began[1]
    error = error_mm(study, found.mr_from_tracker)
    measured = {
        "mean_mm": float(error.mean()),
        "quantiles_mm": np.quantile(error, np.linspace(0, 1, 21)).tolist(),
        "expected_mm": found.expected_mm,
        "chance_under_2_mm": found.chance_under_2_mm,
        "error": Pivot(found.centre_mm, 1.0)
        .step_between(study.mr_from_tracker, found.mr_from_tracker)
        .tolist(),
        "covariance": found.covariance.tolist(),
        "confidence": found.confidence,
        "rival": found.rival,
        "larger": found.size.larger,
        "better_by_size": found.size.gain,
        "apart": found.apart,
        "valid": float(found.valid.sum() / max((found.residual < 1).sum(), 1)),
        "verdict": found.verdict,
        "reason": found.reason,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
    }
    return measured, found.mr_from_tracker


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
    decisive = ("surfaces", "phases", "calibration_error", "moved", "mr_pixels", "reading")
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
    if arguments.moved:
        study = moved_between(study, order.seed, arguments.moved)
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
        measured, pose = registered(study, surfaces, cine, known, settings)
        if products is not None and pose is not None:
            heart = load_heart(order.settings())
            true = np.asarray(study.shown_from_mr @ study.mr_from_tracker)
            measured["walls_mm"] = walls_mm(heart, study, surfaces, pose)
            measured["walls_if_true_mm"] = walls_mm(heart, study, surfaces, true)
    about = {"study": order.name, "method": method, "start": start, "share": share}
    keys = ("probe", "frames", "dropout", "snr_db", "pathology")
    return about | {key: getattr(order, key) for key in keys} | measured


def _model(order: Order, products: Path | None, phases: int) -> Model:
    """The moving surfaces, and the cine that they were found in."""
    if products is None:
        return true_surfaces(order.settings(), phases), None
    folder = products / f"{order.seed}-{order.pathology}"
    return found_surfaces(folder), read_cine(folder / "ingest")


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
    parser.add_argument("--moved", type=float, default=0.0, metavar="MM")
    parser.add_argument("--mr-pixels", type=float, default=1.0, metavar="FACTOR")
    parser.add_argument("--reading", choices=["network", "grey"], default="network")
    parser.add_argument("--global", dest="without_start", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.mr_pixels != 1 and arguments.surfaces == "truth":
        parser.error("--mr-pixels needs --surfaces PRODUCTS, which have a cine")
    print(tables(work(arguments)))


if __name__ == "__main__":
    main()
