"""Studies of tracked ultrasound with known truth, made one by one and kept on disk.

Only what registration needs is made: the phantom's sweeps, their phases, and the moving surfaces,
either the phantom's own or those that the pipeline found in the cine of the same seed. What takes
long, the pictures of one heart by one probe, is made once; frames are left out of it, lost or
drowned in noise afterwards.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_synth.echo import Optics, silence
from data_synth.probe import EXAMINATIONS
from data_synth.settings import PhantomSettings
from data_synth.simulate import SWEEP_PAUSE_S, ULTRASOUND, ULTRASOUND_ECG, load_heart, record_ecg
from data_synth.simulate import stream as stream_of
from data_synth.ultrasound import fitted_probe, simulate_sweeps
from pipeline.geometry import Float, Float32, MovingSurface
from pipeline.products import read_surfaces, read_table
from pipeline.registration.correction import tracker_from_picture

SWEEPS, RECORDED = 2, 24
"""How many sweeps are recorded, and frames in each where no study has more."""


def require_same(out: Path, asked: dict[str, Any]) -> None:
    """Refuse to go on in a folder whose results were made otherwise than is asked now."""
    path = out / "asked.json"
    if path.exists() and json.loads(path.read_text()) != asked:
        raise SystemExit(
            f"{out}: holds results of {path.read_text().strip()}, not of {json.dumps(asked)}; "
            "choose another folder"
        )
    path.write_text(json.dumps(asked) + "\n")


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

    recorded: int = RECORDED
    """Frames of each sweep that its own are chosen from, evenly."""

    @property
    def recording(self) -> str:
        """Name of the file of pictures it is drawn from."""
        return f"{self.seed}-{self.pathology}-{self.probe}-{SWEEPS * self.recorded}-0-own"

    @property
    def name(self) -> str:
        """Of the study."""
        noise = "own" if self.snr_db is None else f"{self.snr_db:g}"
        lost = round(100 * self.dropout)
        return f"{self.seed}-{self.pathology}-{self.probe}-{self.frames}-{lost}-{noise}"

    def settings(self) -> PhantomSettings:
        """Of the phantom."""
        ultrasound = {"probe": self.probe, "sweeps": SWEEPS, "frames": self.recorded}
        return PhantomSettings.model_validate(
            {"seed": self.seed, "pathology": self.pathology, "ultrasound": ultrasound}
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

    shown_from_mr: Float = field(default_factory=lambda: np.eye(4))
    """4x4: where the cine shows them; elsewhere than they are if its header is wrong."""


def make_study(order: Order, folder: Path) -> Study:
    """The study of this order; its recording is kept in ``folder``."""
    path = folder / f"{order.recording}.npz"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        arrays: dict[str, Any] = _simulated(order.settings())
        np.savez_compressed(partial, **arrays)
        partial.rename(path)
    rng = np.random.default_rng([order.seed, 99])
    sweeps, phases = [], []
    with np.load(path) as kept:
        for k in range(SWEEPS):
            # Of an odd number the first sweep has one more.
            count = (order.frames + SWEEPS - 1 - k) // SWEEPS
            chosen = np.linspace(0, order.recorded - 1, count).round().astype(np.int64)
            images, poses = kept[f"images_{k}"], kept[f"poses_{k}"]
            shown = worsened(rng, images, poses, chosen, order, k)
            sweeps.append(TrackedSweep(f"sweep_{k:03d}", shown, poses[chosen]))
            phases.append(kept[f"phases_{k}"][chosen])
        return Study(sweeps, phases, kept["mr_from_tracker"], kept["targets_mm"])


def _simulated(settings: PhantomSettings) -> dict[str, np.ndarray]:
    preset = settings.ultrasound
    heart = load_heart(settings)
    needed_s = preset.sweeps * (preset.frames / preset.frame_rate_hz + SWEEP_PAUSE_S)
    ecg = record_ecg(settings, ULTRASOUND_ECG, needed_s)
    sweeps = simulate_sweeps(stream_of(settings, ULTRASOUND), heart, ecg.r_times_s, preset)
    kept: dict[str, np.ndarray] = {
        "mr_from_tracker": sweeps[0].mr_from_tracker,
        "targets_mm": heart.surfaces(0.0)["heart"][0],
    }
    for k, sweep in enumerate(sweeps):
        kept[f"images_{k}"] = sweep.images
        kept[f"poses_{k}"] = sweep.probe_to_tracker @ sweep.image_to_probe
        kept[f"phases_{k}"] = sweep.nominal_phases % 1.0
    return kept


def worsened(
    rng: np.random.Generator,
    images: np.ndarray,
    poses: Float,
    chosen: np.ndarray,
    order: Order,
    number: int,
) -> Float32:
    """The chosen pictures of sweep ``number``, with noise, some lost in one stretch."""
    probe = fitted_probe(EXAMINATIONS[order.probe][number][0], order.settings().ultrasound)
    pixel_mm = float(np.linalg.norm(poses[0, :3, 1]))
    shown = noisier(rng, images, pixel_mm, probe.optics, order.snr_db)[chosen]
    lost = round(order.dropout * len(chosen))
    first = int(rng.integers(0, len(chosen) - lost + 1))
    for k in range(first, first + lost):
        shown[k] = silence(rng, probe.sector, probe.optics)
    return shown.astype(np.float32)


def noisier(
    rng: np.random.Generator,
    images: np.ndarray,
    pixel_mm: float,
    optics: Optics,
    snr_db: float | None,
) -> np.ndarray:
    """A sweep's pictures with an amplifier's noise on top of its own.

    The grey values' compression is undone, a circular complex Gaussian is added to the amplitude
    (its level follows the gain over depth, so that it stands ``snr_db`` under muscle's nominal
    grey in the middle row), and the sum is compressed again. The echo's phase is not kept in a
    picture, but a circular sum does not depend on it.
    """
    if snr_db is None:
        return images
    muscle = 255 * optics.grey_of_muscle
    sector = images.max(axis=0) > 0
    depth_cm = np.arange(sector.shape[0]) * pixel_mm / 10
    lift_db = optics.compensation * (depth_cm - depth_cm[len(depth_cm) // 2])
    noise = 10 ** ((np.minimum(lift_db, 30.0) - snr_db) / 20)[:, None]
    noisy = []
    for image in images.astype(float):
        amplitude = 10 ** ((image - muscle) / 255 * optics.dynamic_range_db / 20)
        real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, *image.shape)) * noise
        level_db = 20 * np.log10(np.hypot(amplitude + real, imaginary) + 1e-9)
        grey = muscle + 255 * level_db / optics.dynamic_range_db
        noisy.append(np.where(sector, np.clip(grey, 0, 255).round(), 0).astype(np.uint8))
    return np.stack(noisy)


def true_surfaces(settings: PhantomSettings, count: int = 20) -> dict[str, MovingSurface]:
    """The phantom's own meshes at so many phases."""
    heart, phases = load_heart(settings), np.arange(count) / count
    meshes = [heart.surfaces(float(phase)) for phase in phases]
    return {
        name: MovingSurface(np.array([mesh[name][0] for mesh in meshes]), triangles, phases)
        for name, (_, triangles) in meshes[0].items()
    }


def found_surfaces(products: Path) -> dict[str, MovingSurface]:
    """What the pipeline left in ``products`` (a patient's folder) after its surface stage."""
    phases = np.array(read_table(products / "ingest" / "phases.json")["phases"])
    return read_surfaces(products / "surface", phases)


def miscalibrated(study: Study, seed: int, shift_mm: float, turn_deg: float) -> Study:
    """The study as each sweep's own wrong calibration shows it: its pictures are so far beside
    their place, about the middle of the sector and in a random direction, wherever the probe is."""
    rng = np.random.default_rng([seed, 11])
    sweeps = []
    for sweep in study.sweeps:
        way, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
        off[:3, 3] = shift_mm * way
        middle = np.argwhere(sweep.images.max(axis=0) > 0).mean(axis=0)[::-1].round()
        planes = tracker_from_picture(sweep.tracker_from_image, middle.astype(np.int64))
        beside = planes @ off @ np.linalg.inv(planes)
        sweeps.append(replace(sweep, tracker_from_image=beside @ sweep.tracker_from_image))
    return replace(study, sweeps=sweeps)


def moved_between(study: Study, seed: int, shift_mm: float) -> Study:
    """The study of a patient who moved by so much, in a random direction, between the sweeps; the
    truth is that of half-way."""
    way = np.random.default_rng([seed, 13]).standard_normal(3)
    sweeps = []
    for sweep, share in zip(study.sweeps, np.linspace(-0.5, 0.5, len(study.sweeps)), strict=True):
        move = np.eye(4)
        move[:3, 3] = share * shift_mm * way / np.linalg.norm(way)
        sweeps.append(replace(sweep, tracker_from_image=move @ sweep.tracker_from_image))
    return replace(study, sweeps=sweeps)


def start_of(study: Study, seed: int, shift_mm: float, turn_deg: float) -> Float:
    """A first guess this far off: turned about the heart's middle, and shifted."""
    rng = np.random.default_rng([seed, 7])
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    middle = study.targets_mm.mean(axis=0)
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    off[:3, 3] = middle - off[:3, :3] @ middle + shift_mm * way
    return np.asarray(off @ study.mr_from_tracker)
