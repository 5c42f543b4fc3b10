"""How well phantoms that nobody trained on are segmented: the table of docs/segmentation-model.md.

    python benchmarks/segmentation_figures.py OUT [--seed 31] [--phases 6] [--patients 8]

Writes cine-only studies, one seed each, healthy and ill in turn, runs the pipeline until evaluate,
and prints the figures of each patient and over all. Studies that are there already are used again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.pathology import PATHOLOGIES
from data_synth.settings import read_settings
from data_synth.study import write_study

STRUCTURES = (
    *("lv_endocardium", "epicardium", "rv_endocardium"),
    *("left_atrium", "right_atrium", "aorta", "heart"),
)


def run(folder: Path, seed: int, pathology: str, phases: int) -> dict[str, Any]:
    """Make one patient if it is missing, run the pipeline on it, and return its metrics."""
    study = folder / f"{seed}-{pathology}"
    changes = {
        "seed": seed, "pathology": pathology, "patient_id": study.name,
        "cine_only": True, "long_axis": False, "mr": {"phases": phases},
    }  # fmt: skip
    if not study.exists():
        write_study(study, read_settings(None, changes))
    products = folder / "products"
    command = [sys.executable, "-m", "pipeline", "run", str(study), "--out", str(products)]
    subprocess.run([*command, "--until", "evaluate"], check=True, capture_output=True)
    metrics: dict[str, Any] = json.loads(
        (products / study.name / "evaluate" / "metrics.json").read_text()
    )
    return metrics


def main() -> None:
    """Run all patients and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--phases", type=int, default=6)
    parser.add_argument("--patients", type=int, default=8)
    options = parser.parse_args()
    found = {}
    print("| patient | EF found / true | " + " | ".join(STRUCTURES) + " |")
    print("|---" * (2 + len(STRUCTURES)) + "|")
    for k in range(options.patients):
        seed, pathology = options.seed + k, PATHOLOGIES[k % len(PATHOLOGIES)]
        metrics = run(options.out, seed, pathology, options.phases)
        found[seed] = metrics
        fraction = metrics["lv_ejection_fraction"]
        worst = [
            f"{max(metrics['structures'][name]['mean_surface_distance_mm']):.2f}"
            for name in STRUCTURES
        ]
        said = f"{fraction['found']:.3f} / {fraction['truth']:.3f}"
        print(f"| {seed} {pathology} | {said} | " + " | ".join(worst) + " |", flush=True)
    print("\n| structure | mean distance, mean / worst (mm) | 95 % Hausdorff, worst (mm) | Dice |")
    print("|---|---|---|---|")
    for name in STRUCTURES:
        parts = [metrics["structures"][name] for metrics in found.values()]
        near = np.concatenate([part["mean_surface_distance_mm"] for part in parts])
        far = np.concatenate([part["hausdorff_95_mm"] for part in parts])
        dice = np.concatenate([part["dice"] for part in parts])
        overlap = f"{dice.mean():.3f} / {dice.min():.3f}" if len(dice) else ""
        print(f"| {name} | {near.mean():.2f} / {near.max():.2f} | {far.max():.1f} | {overlap} |")


if __name__ == "__main__":
    main()
