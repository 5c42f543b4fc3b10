"""Studies of tracked ultrasound with known truth, made one by one and kept on disk.

Only what registration needs is made: the phantom's sweeps, their phases, and the moving surfaces,
either the phantom's own or those that the pipeline found in the cine of the same seed.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.echo import Optics
from data_synth.probe import EXAMINATIONS
from data_synth.settings import PhantomSettings
from data_synth.simulate import SWEEP_PAUSE_S, ULTRASOUND, ULTRASOUND_ECG, load_heart, record_ecg
from data_synth.simulate import stream as stream_of
from data_synth.ultrasound import Sweep, fitted_probe, simulate_sweeps
from pipeline.geometry import Float, Float32, MovingSurface
from pipeline.products import read_surfaces, read_table

PATHOLOGIES = (
    "healthy",
    "dilated_cardiomyopathy",
    "hypertrophic_cardiomyopathy",
    "rv_dilation",
    "infarct",
    "enlarged_atrium",
)
SETUPS = tuple(EXAMINATIONS)
TRUTH_PHASES = np.arange(20) / 20


@dataclass(frozen=True)
class Order:
    """One study to be made."""

    seed: int
    pathology: str
    probe: str
    frames: int
    """Of all sweeps together."""

    dropout: float
    """Share of the frames that show nothing, for the probe is off the body."""

    snr_db: float | None
    """Level of muscle over added noise in the middle of the picture; None: the scanner's own."""

    @property
    def name(self) -> str:
        """Of the file it is kept in."""
        noise = "own" if self.snr_db is None else f"{self.snr_db:g}"
        lost = round(100 * self.dropout)
        return f"{self.seed}-{self.pathology}-{self.probe}-{self.frames}-{lost}-{noise}"

    def settings(self) -> PhantomSettings:
        """Of the phantom."""
        per_sweep = max(1, self.frames // 2)
        return PhantomSettings.model_validate(
            {
                "seed": self.seed,
                "pathology": self.pathology,
                "ultrasound": {
                    "probe": self.probe,
                    "frames": per_sweep,
                    "lifted": float(self.dropout > 0),
                    "lifted_frames": max(1, round(self.dropout * per_sweep)),
                },
            }
        )


@dataclass(frozen=True)
class TrackedSweep:
    """What the pipeline reads of a sweep."""

    name: str
    images: Float32
    tracker_from_image: Float


@dataclass(frozen=True)
class Study:
    """Frames, their phases, the truth, and points of the heart to measure at."""

    sweeps: list[TrackedSweep]
    phases: list[Float]
    mr_from_tracker: Float
    targets_mm: Float
    """``(n, 3)`` vertices of the heart's surface at the R peak, LPS mm."""


def make_study(order: Order, folder: Path) -> Study:
    """The study of this order: from ``folder`` where it has been made before."""
    path = folder / f"{order.name}.npz"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        arrays: dict[str, Any] = _simulated(order)
        np.savez_compressed(partial, **arrays)
        partial.rename(path)
    with np.load(path) as kept:
        sweeps = [
            TrackedSweep(
                f"sweep_{k:03d}", kept[f"images_{k}"].astype(np.float32), kept[f"poses_{k}"]
            )
            for k in range(2)
        ]
        phases = [kept[f"phases_{k}"] for k in range(2)]
        return Study(sweeps, phases, kept["mr_from_tracker"], kept["targets_mm"])


def _simulated(order: Order) -> dict[str, np.ndarray]:
    settings = order.settings()
    preset = settings.ultrasound
    heart = load_heart(settings)
    needed_s = preset.sweeps * (preset.frames / preset.frame_rate_hz + SWEEP_PAUSE_S)
    ecg = record_ecg(settings, ULTRASOUND_ECG, needed_s)
    sweeps = simulate_sweeps(stream_of(settings, ULTRASOUND), heart, ecg.r_times_s, preset)
    rng = np.random.default_rng([order.seed, 99])
    kept: dict[str, np.ndarray] = {
        "mr_from_tracker": sweeps[0].mr_from_tracker,
        "targets_mm": heart.surfaces(0.0)["heart"][0],
        "order": np.array(json.dumps(asdict(order))),
    }
    for k, sweep in enumerate(sweeps):
        name = EXAMINATIONS[order.probe][k][0]
        optics = fitted_probe(name, preset).optics
        kept[f"images_{k}"] = noisier(rng, sweep, optics, order.snr_db)
        kept[f"poses_{k}"] = sweep.probe_to_tracker @ sweep.image_to_probe
        kept[f"phases_{k}"] = sweep.nominal_phases % 1.0
    return kept


def noisier(
    rng: np.random.Generator, sweep: Sweep, optics: Optics, snr_db: float | None
) -> np.ndarray:
    """The sweep's pictures with an amplifier's noise on top of its own.

    The grey values' compression is undone, a circular complex Gaussian is added to the amplitude
    (its level follows the gain over depth, so that it stands ``snr_db`` under muscle's nominal
    grey in the middle row), and the sum is compressed again. The echo's phase is not kept in a
    picture, but a circular sum does not depend on it.
    """
    if snr_db is None:
        return sweep.images
    muscle = 255 * optics.grey_of_muscle
    sector = sweep.images.max(axis=0) > 0
    pixel_mm = np.linalg.norm(sweep.image_to_probe[:3, 1])
    depth_cm = np.arange(sector.shape[0]) * pixel_mm / 10
    lift_db = optics.compensation * (depth_cm - depth_cm[len(depth_cm) // 2])
    noise = 10 ** ((np.minimum(lift_db, 30.0) - snr_db) / 20)[:, None]
    images = []
    for image in sweep.images.astype(float):
        amplitude = 10 ** ((image - muscle) / 255 * optics.dynamic_range_db / 20)
        real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, *image.shape)) * noise
        level_db = 20 * np.log10(np.hypot(amplitude + real, imaginary) + 1e-9)
        grey = muscle + 255 * level_db / optics.dynamic_range_db
        images.append(np.where(sector, np.clip(grey, 0, 255).round(), 0).astype(np.uint8))
    return np.stack(images)


def true_surfaces(order: Order) -> dict[str, MovingSurface]:
    """The phantom's own meshes through the beat."""
    heart = load_heart(order.settings())
    meshes = [heart.surfaces(float(phase)) for phase in TRUTH_PHASES]
    return {
        name: MovingSurface(np.array([mesh[name][0] for mesh in meshes]), triangles, TRUTH_PHASES)
        for name, (_, triangles) in meshes[0].items()
    }


def found_surfaces(products: Path) -> dict[str, MovingSurface]:
    """What the pipeline left in ``products`` (a patient's folder) after its surface stage."""
    phases = np.array(read_table(products / "ingest" / "phases.json")["phases"])
    return read_surfaces(products / "surface", phases)


def start_of(study: Study, seed: int, shift_mm: float, turn_deg: float) -> Float:
    """A first guess this far off: turned about the heart's middle, and shifted."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng([seed, 7])
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    middle = study.targets_mm.mean(axis=0)
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    off[:3, 3] = middle - off[:3, :3] @ middle + shift_mm * way
    return np.asarray(off @ study.mr_from_tracker)
