"""How truly the offset between the clocks of ultrasound and ECG is found, over unseen studies.

    python benchmarks/clock_offset_figures.py OUT [--studies 14] [--seed 4101] [--sweeps 2]
        [--frames 40] [--surfaces truth|PRODUCTS] [--last-late-ms 0]

Studies differ in anatomy, illness and probe; every sweep turns its fan, is held by a hand that
moves, and has its scanner's own noise, shadows, and the tracker's, the calibration's and the time
stamps' errors. The stamps are put off by up to 200 ms either way, the start by 10 mm and 10
degrees. The pose is sought at the wrong phases, as `register` does, then the offset is estimated.
``--surfaces`` names a folder of products, one a patient named ``<seed>-<pathology>``, to compare
with what the pipeline found in the cine rather than with the phantom's own meshes.
``--last-late-ms`` puts the stamps of the last sweep alone so much further off: how far apart the
sweeps' clocks are told to be is written, too. Results are kept
line by line in OUT/results.jsonl; what is there is not done again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from registration_studies import found_surfaces, require_same, true_surfaces

from data_synth.pathology import PATHOLOGIES
from data_synth.probe import EXAMINATIONS
from data_synth.settings import PhantomSettings
from data_synth.simulate import (
    START,
    SWEEP_PAUSE_S,
    ULTRASOUND,
    ULTRASOUND_ECG,
    first_guess,
    load_heart,
    record_ecg,
    stream,
)
from data_synth.ultrasound import Sweep, simulate_sweeps
from pipeline.geometry import Float, MovingSurface, transform_points
from pipeline.products import read_table
from pipeline.registration.clock_offset import Timing, clocks_apart, estimate_offset
from pipeline.registration.frames import DisplacedSweep
from pipeline.registration.reading import as_compared
from pipeline.registration.search import prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.time import detect_r_peaks

LARGEST_S = 0.2
SETUPS = tuple(EXAMINATIONS)


def studies(arguments: argparse.Namespace) -> Iterator[PhantomSettings]:
    """The phantoms; illness and probe go round with periods that share no factor."""
    for k in range(arguments.studies):
        seed, illness = arguments.seed + k, PATHOLOGIES[k % len(PATHOLOGIES)]
        if arguments.surfaces != "truth":
            match = sorted(Path(arguments.surfaces).glob(f"{seed}-*"))
            if not match:
                continue
            illness = match[0].name.split("-", 1)[1]
        asked = {
            "probe": SETUPS[k % len(SETUPS)],
            "sweeps": arguments.sweeps,
            "frames": arguments.frames,
        }
        yield PhantomSettings.model_validate(
            {"seed": seed, "pathology": illness, "ultrasound": asked}
        )


def measured(settings: PhantomSettings, surfaces: str, late_ms: float) -> dict[str, Any]:
    """One study: true and found offset, standard deviation, errors of the pose, seconds."""
    heart = load_heart(settings)
    asked = settings.ultrasound
    needed_s = asked.sweeps * (asked.frames / asked.frame_rate_hz + SWEEP_PAUSE_S)
    ecg = record_ecg(settings, ULTRASOUND_ECG, needed_s)
    recorded = simulate_sweeps(stream(settings, ULTRASOUND), heart, ecg.r_times_s, asked)
    model, cycle_rr_s = _model(settings, surfaces)
    rng = np.random.default_rng([settings.seed, 77])
    ahead_s = float(rng.uniform(-LARGEST_S, LARGEST_S))
    r_times_s = detect_r_peaks(ecg.signal_mv, ecg.sampling_rate_hz)
    times_s = [one.times_s + ahead_s for one in recorded]
    times_s[-1] = times_s[-1] + late_ms / 1e3
    timing = Timing(times_s, r_times_s, cycle_rr_s)
    truth = recorded[0].mr_from_tracker
    start = first_guess(stream(settings, START), truth, heart.centre_mm)
    begun_s = time.process_time()
    options = RegisterSettings()
    search = prepare_search(timing.phases(), model, start, options)
    sweeps = as_compared([_as_read(one) for one in recorded], options)
    best = search.best(sweeps)
    searched_s = time.process_time()
    level = search.fine_level(sweeps).thinned(options.max_frames)
    found = estimate_offset(level, best.pose, search.pivot, timing)
    apart = clocks_apart(level, found.mr_from_tracker, search.pivot, timing)
    targets_mm = heart.surfaces(0.0)["heart"][0]
    return {
        "study": f"{settings.seed}-{settings.pathology}-{asked.probe}",
        "frames": sum(len(one.images) for one in recorded),
        "true_ms": 1e3 * ahead_s,
        "found_ms": None if found.offset_s is None else 1e3 * found.offset_s,
        "sd_ms": None if found.offset_s is None else 1e3 * found.sd_s,
        "apart_ms": 0.0 if apart is None else 1e3 * apart.by_s,
        "before_mm": _error_mm(best.pose, truth, targets_mm),
        "after_mm": _error_mm(found.mr_from_tracker, truth, targets_mm),
        "search_s": searched_s - begun_s,
        "offset_s": time.process_time() - searched_s,
    }


def _model(settings: PhantomSettings, surfaces: str) -> tuple[dict[str, MovingSurface], float]:
    """The moving surfaces, and the length of the beat that their phases divide."""
    if surfaces != "truth":
        products = Path(surfaces) / f"{settings.seed}-{settings.pathology}"
        cycle = read_table(products / "ingest" / "phases.json")
        return found_surfaces(products), float(cycle["rr_s"])
    return true_surfaces(settings), 60 / settings.heart_rate_bpm


def _as_read(sweep: Sweep) -> DisplacedSweep:
    poses = sweep.probe_to_tracker @ sweep.image_to_probe
    return DisplacedSweep(sweep.name, sweep.images.astype(np.float32), poses)


def _error_mm(pose: Float, truth: Float, targets_mm: Float) -> float:
    """Mean target registration error at the points of the heart."""
    there_mm = transform_points(pose @ np.linalg.inv(truth), targets_mm)
    return float(np.linalg.norm(there_mm - targets_mm, axis=1).mean())


def summary(rows: list[dict[str, Any]]) -> str:
    """The figures over all studies."""
    known = [row for row in rows if row["found_ms"] is not None]
    off_ms = np.array([row["found_ms"] - row["true_ms"] for row in known])
    ratio = off_ms / np.array([row["sd_ms"] for row in known])
    before, after = ([row[key] for row in known] for key in ("before_mm", "after_mm"))
    return (
        f"{len(known)} of {len(rows)} studies gave an offset: off {np.median(np.abs(off_ms)):.1f} "
        f"ms (median), {np.percentile(np.abs(off_ms), 95):.1f} (95 %), mean {off_ms.mean():+.1f}; "
        f"under 10 ms in {(np.abs(off_ms) < 10).mean():.1%}; {np.sqrt((ratio**2).mean()):.2f} of "
        f"its standard deviation; pose off {np.median(before):.2f} mm before, "
        f"{np.median(after):.2f} after; {np.median([r['offset_s'] for r in known]):.1f} s of "
        f"processor beside {np.median([r['search_s'] for r in known]):.1f} for the search"
    )


def between_sweeps(rows: list[dict[str, Any]], late_ms: float) -> str:
    """How many were told that their sweeps have clocks of their own, and how truly."""
    told_ms = np.array([row["apart_ms"] for row in rows if row["apart_ms"]])
    text = f"{len(told_ms)} of {len(rows)} studies told of sweeps whose clocks are apart"
    if len(told_ms):
        text += f", by up to {np.abs(told_ms - late_ms).max():.1f} ms other than {late_ms:g} ms"
    return text


def main() -> None:
    """Print a line a study, and the figures over all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--studies", type=int, default=14)
    parser.add_argument("--seed", type=int, default=4101)
    parser.add_argument("--sweeps", type=int, default=2)
    parser.add_argument("--frames", type=int, default=40, help="of each sweep")
    parser.add_argument("--surfaces", default="truth")
    parser.add_argument("--last-late-ms", type=float, default=0.0, help="of the last sweep alone")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    decisive = ("sweeps", "frames", "surfaces", "last_late_ms")
    require_same(arguments.out, {name: getattr(arguments, name) for name in decisive})
    kept = arguments.out / "results.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    done = {row["study"] for row in rows}
    for settings in studies(arguments):
        if f"{settings.seed}-{settings.pathology}-{settings.ultrasound.probe}" in done:
            continue
        rows.append(measured(settings, arguments.surfaces, arguments.last_late_ms))
        with kept.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(json.dumps(rows[-1]), flush=True)
    print(between_sweeps(rows, abs(arguments.last_late_ms)))
    if not arguments.last_late_ms:
        print(summary(rows))


if __name__ == "__main__":
    main()
