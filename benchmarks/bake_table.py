"""Spacing and margin of the grid: what a field costs and how exact it is, by `beatfield bake`.

    python benchmarks/bake_table.py SURFACES          # a study's products' folder `surface`

Every row is a process of its own, with the default settings but for spacing and margin. Seconds and
memory are that process's, start and certificate included. Of the surfaces those of the default
fixtures are taken, as of a study's; errors are the certificate's own, worst of the structures,
against the surfaces given.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from pipeline.field import BakeSettings, ForceField
from pipeline.field.fixture import DEFAULT_FIXTURES


def row(surfaces: Path, spacing_mm: float, margin_mm: float) -> str:
    """Bake once, and what it took."""
    with tempfile.TemporaryDirectory() as folder:
        settings, out = Path(folder) / "settings.yaml", Path(folder) / "out"
        own = Path(folder) / "surfaces"
        own.mkdir()
        for name in {fixture.structure for fixture in DEFAULT_FIXTURES.values()}:
            for file in surfaces.glob(f"{name}_*.vtp"):
                shutil.copy(file, own)
        # Rows that are less exact than a field may be published are part of the table.
        settings.write_text(
            f"bake:\n  spacing_mm: {spacing_mm}\n  margin_mm: {margin_mm}\n"
            "  largest_store_mb: 16000\n  bounds: {surface_error_p99_spacings: 1.0}\n"
        )
        command = ["bake", "--surfaces", str(own), "--out", str(out), "--config", settings]
        begun_s = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline", *map(str, command)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        assert process.stderr is not None
        said = process.stderr.read().decode()
        _, status, used = os.wait4(process.pid, 0)
        took_s = time.perf_counter() - begun_s
        if status:
            sys.exit(said)
        store = out / "field.zarr"
        megabytes = sum(file.stat().st_size for file in store.rglob("*") if file.is_file()) / 1e6
        accuracy = ForceField.open(store).accuracy
    return (
        f"| {spacing_mm:g} | {margin_mm:g} | {megabytes:.0f} | {took_s:.1f} | "
        f"{used.ru_utime + used.ru_stime:.1f} | {used.ru_maxrss / 2**20:.2f} | "
        f"{accuracy['surface_error_p99_mm']:.3f} / {accuracy['surface_error_max_mm']:.3f} | "
        f"{accuracy['distance_error_p99_mm']:.3f} | {accuracy['gradient_error_median']:.4f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surfaces", type=Path)
    parser.add_argument("--spacings", type=float, nargs="*", default=[2.0, 1.5, 1.25, 1.0, 0.75])
    parser.add_argument("--margins", type=float, nargs="*", default=[20.0, 30.0])
    given, usual = parser.parse_args(), BakeSettings()
    print(
        "| spacing (mm) | margin (mm) | MB | s | core-s | GiB | on the surface, 99 % / max (mm) | "
        "about it, 99 % (mm) | gradient, median |\n|---|---|---|---|---|---|---|---|---|"
    )
    for spacing_mm in given.spacings:
        print(row(given.surfaces, spacing_mm, usual.margin_mm), flush=True)
    for margin_mm in given.margins:
        print(row(given.surfaces, usual.spacing_mm, margin_mm), flush=True)


if __name__ == "__main__":
    main()
