"""How well phantoms that nobody trained on are segmented, and how truly their surfaces move.

    python benchmarks/segmentation_figures.py OUT [--patients 20] [--phases 6] [--seed 701]
        [--workers 2] [--config FILE] [--long-axis] [--breath-holds 1.5] [--volume AXES] [--redraw]

Writes cine-only studies, one seed each: every pathology in turn, signal-to-noise ratios spread
over 10 to 40; ``--long-axis`` adds the 2-, 3- and 4-chamber views, ``--breath-holds 0`` draws all
slices and views in one place, and ``--volume transverse`` (or sagittal, coronal, short_axis) makes
isotropic volumes of 2 mm instead of stacks. Runs the pipeline on each until
evaluate, and prints, as Markdown, each patient, each structure, what was asked and whether it is
reached, and how wrong slices of low confidence are. It goes on where it was interrupted: studies
that are there are used again unless they were drawn with other settings (``--redraw`` draws all
anew, for when the phantom's code has changed), and the pipeline runs again those stages whose code,
weights or settings have changed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import segmentation_tables as tables
import yaml

from data_synth.pathology import PATHOLOGIES
from data_synth.settings import PhantomSettings, read_settings
from data_synth.study import write_study

LOWEST_SNR, HIGHEST_SNR = 10.0, 40.0
GOLDEN = (5**0.5 - 1) / 2

QUICK_FIELD: dict[str, Any] = {
    "bake": {"spacing_mm": 4.0, "fit_rounds": 0, "bounds": {"surface_error_p99_spacings": 1.0}},
    "fixtures": {
        "epicardium_guidance": {
            "structure": "epicardium",
            "kind": "guidance",
            "device": "touch",
            "gamma_mm": 3.0,
            "m": 2,
            "f_max_n": 2.0,
        }
    },
}
"""One coarse fixture: the field is baked before evaluate, and is not looked at here."""


@dataclass(frozen=True)
class Order:
    """One patient to be made and measured."""

    out: Path
    number: int
    seed: int
    phases: int
    redraw: bool
    long_axis: bool = False
    """With 2-, 3- and 4-chamber views beside the stack."""

    breath_holds_mm: float = 1.5
    """Standard deviation of the heart's place from one breath-hold to another."""

    volume: str | None = None
    """Planes of an isotropic volume in place of the stack."""

    @property
    def pathology(self) -> str:
        """Every one in turn."""
        return PATHOLOGIES[self.number % len(PATHOLOGIES)]

    @property
    def snr(self) -> float:
        """Multiples of the golden section, modulo 1: however many there are, they are spread."""
        share = (0.5 + self.number * GOLDEN) % 1
        return round(LOWEST_SNR + (HIGHEST_SNR - LOWEST_SNR) * share, 1)

    @property
    def name(self) -> str:
        """Of the study and its products."""
        return f"{self.seed + self.number}-{self.pathology}"

    def settings(self) -> PhantomSettings:
        """Of the phantom."""
        mr: dict[str, Any] = {"snr": self.snr, "breath_hold_shift_mm": self.breath_holds_mm}
        if self.volume is not None:
            mr = {"acquisition": "volume", "volume_axes": self.volume, "volume_snr": self.snr}
        changes = {
            "seed": self.seed + self.number, "pathology": self.pathology, "patient_id": self.name,
            "cine_only": True, "long_axis": self.long_axis,
            "mr": mr | {"phases": self.phases},
        }  # fmt: skip
        return read_settings(None, changes)


def draw(order: Order) -> Path:
    """The study's folder, written if it is missing or was drawn with other settings."""
    study, settings = order.out / "studies" / order.name, order.settings()
    try:
        known = json.loads((study / "truth" / "truth.json").read_text())["settings"]
    except (OSError, ValueError, KeyError):
        known = None
    if order.redraw or known != settings.model_dump(mode="json"):
        write_study(study, settings, overwrite=True)
    return study


def measure(order: Order) -> tuple[tables.Patient, float]:
    """Make a patient, run the pipeline, and read what evaluate found; seconds taken."""
    begun = time.perf_counter()
    study, products = draw(order), order.out / "products"
    command = [sys.executable, "-m", "pipeline", "run", str(study), "--out", str(products)]
    command += ["--until", "evaluate", "--config", str(order.out / "settings.yaml")]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    said = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    found = tables.Patient(order.name, order.pathology, order.snr)
    if said.returncode != 0:
        cause = said.stderr.rpartition("error: ")[2].strip() or f"exit code {said.returncode}"
        found = tables.Patient(order.name, order.pathology, order.snr, failure=cause[-300:])
        return found, time.perf_counter() - begun
    folder = products / order.name
    found = tables.Patient(
        order.name,
        order.pathology,
        order.snr,
        json.loads((folder / "evaluate" / "metrics.json").read_text()),
        json.loads((folder / "segment" / "confidence.json").read_text())["confidence"],
    )
    return found, time.perf_counter() - begun


def write_settings(out: Path, config: Path | None) -> None:
    """The run's settings: a user's over the quick field's."""
    own: dict[str, Any] = yaml.safe_load(config.read_text()) or {} if config else {}
    out.mkdir(parents=True, exist_ok=True)
    (out / "settings.yaml").write_text(yaml.safe_dump(QUICK_FIELD | own, sort_keys=False))


def measure_all(orders: list[Order], workers: int) -> list[tables.Patient]:
    """Measure patients, several at a time, and print a row of each in order."""
    print(tables.table((*tables.PATIENT_HEAD, "s"), []), flush=True)
    patients = []
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
        for one, seconds in pool.map(measure, orders):
            row = [*tables.patient_row(one), f"{seconds:.0f}"]
            print("| " + " | ".join(row) + " |", flush=True)
            patients.append(one)
    return patients


def report(patients: list[tables.Patient]) -> str:
    """All tables over all patients."""
    if not any(one.metrics for one in patients):
        return "No patient was segmented."
    parts = [
        ("What was asked", tables.requirements(patients)),
        ("Structures", tables.structures(patients)),
        ("By pathology", tables.groups(patients, lambda one: one.pathology, "pathology")),
        ("By signal-to-noise ratio", tables.groups(patients, tables.snr_band, "SNR")),
        ("Confidence against error", tables.calibration(patients)),
        ("Worst slices", tables.worst_slices(patients)),
    ]
    return "\n\n".join(f"### {title}\n\n{text}" for title, text in parts)


def main() -> None:
    """Run all patients and print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--patients", type=int, default=20)
    parser.add_argument("--phases", type=int, default=6)
    parser.add_argument("--seed", type=int, default=701, help="of the first patient")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--config", type=Path, help="settings of the pipeline")
    parser.add_argument("--long-axis", action="store_true", help="with long-axis views")
    parser.add_argument(
        "--breath-holds", type=float, default=1.5, metavar="MM", help="apart by this"
    )
    axes = ("short_axis", "transverse", "sagittal", "coronal")
    parser.add_argument("--volume", choices=axes, help="isotropic volumes in these planes")
    parser.add_argument("--redraw", action="store_true", help="draw all studies anew")
    options = parser.parse_args()
    begun = time.perf_counter()
    write_settings(options.out, options.config)
    of_all = (options.seed, options.phases, options.redraw, options.long_axis)
    of_all = (*of_all, options.breath_holds, options.volume)
    orders = [Order(options.out, number, *of_all) for number in range(options.patients)]
    patients = measure_all(orders, options.workers)
    print("\n" + report(patients))
    print(f"\n{len(patients)} patients in {time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
