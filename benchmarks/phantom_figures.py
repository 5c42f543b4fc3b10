"""Print what the phantom was measured to be; `docs/phantom.md` quotes it.

python benchmarks/phantom_figures.py [--hearts 50] [--without-study]
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, rayleigh

from data_synth import BeatingHeart, draw_heart
from data_synth.echo import point_spread
from data_synth.measures import MUSCLE_G_ML
from data_synth.mr import MrSettings, acquire_cine
from data_synth.norms import NORMS
from data_synth.pathology import PATHOLOGIES
from data_synth.probe import PROBES
from data_synth.speckle import draw_scatterers, gather, hearing
from data_synth.tissue import TRUTH_LABELS, Tissue, truth_values
from data_synth.truth import chamber_function

POPULATION_SEED = 2026
PHASES = np.arange(0, 1, 0.05)
ILL_HEARTS = 6
GRID_MM = 1.25
SPECKLE_PICTURES = 12


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print everything that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hearts", type=int, default=50, help="size of the population")
    parser.add_argument("--without-study", action="store_true", help="leave out the timed study")
    options = parser.parse_args(arguments)
    # First, for the peak memory of children is that of the largest so far.
    if not options.without_study:
        print_study()
    print_population(options.hearts)
    print_pathologies()
    print_motion()
    print_volumes()
    print_noise()
    print_speckle()


def print_study() -> None:
    """Seconds and peak memory of the default study."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "data_synth", folder]
        # Once for the compiler, whose work is kept.
        subprocess.run([*command, "--cine-only"], check=True, capture_output=True)
        before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([*command, "--overwrite"], check=True, capture_output=True)
        wall_s = time.perf_counter() - start_s
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy_s = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"default study: {wall_s:.1f} s, of which processors were busy {busy_s:.1f} s "
        f"({len(os.sched_getaffinity(0))} cores); peak memory {used.ru_maxrss / 2**20:.2f} GiB"
    )


def population(count: int, pathology: str = "healthy") -> Iterator[BeatingHeart]:
    """Hearts that no setting was tuned on."""
    for k in range(count):
        yield draw_heart(np.random.default_rng([POPULATION_SEED, k]), 1.0, pathology)


def figures_of(heart: BeatingHeart) -> dict[str, float]:
    """Volumes, ejection fractions and mass as truth.json states them."""
    flat = {
        f"{chamber}.{name}": value
        for chamber, function in chamber_function(heart).items()
        for name, value in function.items()
    }
    return flat | {"lv_mass_g": MUSCLE_G_ML * heart.volumes_ml(0.0)["lv_myocardium"]}


def print_population(count: int) -> None:
    """Population table against the published ranges."""
    found = [figures_of(heart) for heart in population(count)]
    print(f"\n{count} healthy hearts, against mean +- 2 SD of women (low end) and men (high end)\n")
    print("| figure | mean | SD | smallest | largest | normal | within | source |")
    print("|---|---|---|---|---|---|---|---|")
    for name in found[0]:
        values, norm = np.array([one[name] for one in found]), NORMS.get(name)
        cells = [
            f"{v:.3g}" for v in (values.mean(), values.std(ddof=1), values.min(), values.max())
        ]
        if norm:
            share = ((values >= norm.low) & (values <= norm.high)).mean()
            cells += [f"{norm.low:.3g} to {norm.high:.3g}", f"{share:.0%}", norm.source]
        print("| " + " | ".join([name, *cells, *[""] * (7 - len(cells))]) + " |")


def print_pathologies() -> None:
    """What each illness makes of the same people."""
    print(f"\nmeans of {ILL_HEARTS} hearts each\n")
    shown = ("left_ventricle.largest_ml", "left_ventricle.ejection_fraction", "lv_mass_g")
    shown += ("right_ventricle.largest_ml", "left_atrium.largest_ml")
    print("| pathology | " + " | ".join(shown) + " |\n" + "|---" * (len(shown) + 1) + "|")
    for pathology in PATHOLOGIES:
        found = [figures_of(heart) for heart in population(ILL_HEARTS, pathology)]
        cells = [f"{np.mean([one[name] for one in found]):.3g}" for name in shown]
        print("| " + " | ".join([pathology, *cells]) + " |")


def print_motion() -> None:
    """Change of the wall's volume, closure of the cycle, and error of the inverse map."""
    ratios, closure_mm, inverse_mm = [], 0.0, 0.0
    for heart in population(5):
        vertices = np.concatenate([points for points, _ in heart.surfaces(0.0).values()])
        closure_mm = max(closure_mm, np.abs(heart.carry(vertices, 1.0) - vertices).max())
        wall = points_in(heart, Tissue.LV_MYOCARDIUM)
        for phase in PHASES[1:]:
            ratios.append(heart.volume_ratio(wall, float(phase)))
            back = heart.reference(heart.carry(vertices, float(phase)), float(phase))
            inverse_mm = max(inverse_mm, np.abs(back - vertices).max())
    ratio = np.concatenate(ratios)
    away = np.abs(ratio - 1)
    print(
        f"\nJacobian in the left muscle, 5 hearts, {len(ratio)} points: mean {ratio.mean():.6f}; "
        f"|J - 1| 99th percentile {np.percentile(away, 99):.1e}, largest {away.max():.1e}"
    )
    print(f"closure of the cycle: {closure_mm:.1e} mm; inverse map: {inverse_mm:.1e} mm")


def lattice(heart: BeatingHeart, step_mm: float) -> np.ndarray:
    """Points (n, 3) over the heart and its surroundings."""
    vertices = heart.surfaces(0.0)["heart"][0]
    low, high = vertices.min(axis=0) - 15, vertices.max(axis=0) + 15
    axes = [np.arange(a, b, step_mm) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def points_in(heart: BeatingHeart, tissue: Tissue, step_mm: float = 4.0) -> np.ndarray:
    """Lattice points of one tissue at the R peak."""
    points = lattice(heart, step_mm)
    return points[heart.heart_tissue(points, 0.0) == tissue]


def print_volumes() -> None:
    """Truth meshes against truth labels, counted on a fine lattice."""
    heart = next(population(1))
    points = lattice(heart, GRID_MM)
    print(f"\nmeshes against labels on a {GRID_MM} mm lattice\n")
    print("| label | phase | mesh, ml | labels, ml | off |\n|---|---|---|---|---|")
    for phase in (0.0, heart.pulse.end_systole):
        volumes = heart.volumes_ml(phase)
        labels = truth_values()[heart.heart_tissue(points, phase)]
        for label, (value, _) in TRUTH_LABELS.items():
            name = {"lv_cavity": "lv_endocardium", "rv_cavity": "rv_endocardium"}.get(label, label)
            mesh_ml, counted_ml = volumes[name], (labels == value).sum() * GRID_MM**3 / 1000
            off = counted_ml / mesh_ml - 1
            print(f"| {label} | {phase:.2f} | {mesh_ml:.1f} | {counted_ml:.1f} | {off:+.2%} |")


def print_noise() -> None:
    """Signal-to-noise ratio of blood in the images against the one that was asked for."""
    heart = next(population(1))
    for field_t in (1.5, 3.0):
        # No coils, no field error, no flow: all blood has the same signal.
        asked = MrSettings(
            phases=4, slices=3, slice_gap_mm=20.0, matrix=128, snr=25.0, field_strength_t=field_t,
            coil_shading=0.0, inhomogeneity=0.0, inflow=0.0, flow_dephasing=0.0,
        )  # fmt: skip
        clean, noisy = (
            acquire_cine(np.random.default_rng(3), heart, [800.0] * 3, settings)
            for settings in (asked.model_copy(update={"snr": 1e9}), asked)
        )
        ventricle = clean.labels == TRUTH_LABELS["lv_cavity"][0]
        bright = clean.intensity > 0.97 * np.percentile(clean.intensity[ventricle], 99)
        blood = ventricle & bright
        noise = noisy.intensity[blood].astype(float) - clean.intensity[blood]
        found = clean.intensity[blood].mean() / noise.std()
        print(f"SNR at {field_t} T: asked {asked.snr:.1f}, measured {found:.1f} ({blood.sum()} px)")


def print_speckle() -> None:
    """Kolmogorov-Smirnov distance of the envelope in uniform muscle from Rayleigh's law."""
    rng = np.random.default_rng(POPULATION_SEED)
    probe = PROBES["surface"]
    sector, optics = probe.sector, probe.optics
    cell_mm = max(1.2 * optics.pulse_mm, 0.4)
    heard = hearing(sector, optics, optics.slice_mm(sector.ranges_mm), cell_mm)
    spacing_mm = sector.ranges_mm * (sector.angles_rad[1] - sector.angles_rad[0])
    envelopes = []
    for _ in range(SPECKLE_PICTURES):
        turn = Rotation.random(random_state=rng).as_matrix()
        places = sector.points_mm @ turn.T + rng.uniform(-100, 100, 3)
        beside = np.gradient(places, axis=1) / spacing_mm[:, None, None]
        across = np.broadcast_to(turn[:, 2], places.shape).copy()
        scatterers = draw_scatterers(rng, cell_mm)
        echoes = gather(
            places / cell_mm, beside / cell_mm, across / cell_mm, heard.offsets_mm,
            heard.weights, scatterers.echoes,
        )  # fmt: skip
        envelopes.append(np.abs(point_spread(echoes, sector, optics)))
    # Grains are some 2 mm by 5 mm: samples farther apart than that are independent.
    grains = np.array(envelopes)[:, 40:-20:16, 8:-8:12]
    power = (grains**2).mean(axis=(0, 2), keepdims=True)
    values = (grains / np.sqrt(power / 2)).ravel()
    distance = kstest(values, rayleigh.cdf).statistic
    ratio = values.mean() / values.std()
    print(
        f"\nspeckle in uniform muscle, {values.size} grains: Kolmogorov-Smirnov distance from "
        f"Rayleigh {distance:.4f} (5 % level {1.358 / np.sqrt(values.size):.4f}); mean over "
        f"deviation {ratio:.2f} (Rayleigh 1.91)"
    )


if __name__ == "__main__":
    main()
