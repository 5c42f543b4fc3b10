"""Pictures of beating hearts as no one scanner shows them, with what every pixel truly holds.

A heart is drawn from beyond the population, a probe is put where it could be, and what sound meets
in the tissues, how the scanner is built and set, how its skin contact varies, its noise and what it
does against speckle are all drawn at random, over wider ranges than scanners have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from data_synth.echo import ECHOES, Echoes, Optics, bmode, unit_noise
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.pathology import PATHOLOGIES
from data_synth.probe import PROBES, Probe
from data_synth.sector import Sector
from data_synth.settings import PhantomSettings
from data_synth.simulate import load_heart
from data_synth.tissue import Tissue
from data_synth.training.pool import fill
from data_synth.window import aim, labels_before, opened, place, rigid

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Byte = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Progress = Callable[[int, int], None]

PIXEL_MM = 1.25
"""Edge of the pixels that the network sees, whatever the scanner's own."""

REST, BLOOD, WALL, VESSEL = range(4)
"""Classes: what is none of the others; blood of the five cavities with the leaflets that swing in
it and the papillary muscles and trabeculae that grow into it; muscle and walls; blood of other
vessels."""

CLASSES = 4
OUTSIDE = 255
"""Label of pixels that the beams do not reach."""

STREAM = 77
FIRST_SEED = 101_000
"""Hearts of training have the seeds from here on: no study that is measured does."""

VIEWS = 4
"""Places of a probe from which each heart is seen."""

_CAVITIES = (
    Tissue.LV_CAVITY,
    Tissue.RV_CAVITY,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.AORTA,
)
_MUSCLE = (
    Tissue.LV_MYOCARDIUM,
    Tissue.RV_WALL,
    Tissue.PAPILLARY_MUSCLE,
    Tissue.RV_TRABECULA,
)
_WALLS = (
    Tissue.LV_MYOCARDIUM,
    Tissue.SCAR,
    Tissue.RV_WALL,
    Tissue.ATRIAL_WALL,
    Tissue.VESSEL_WALL,
    Tissue.PERICARDIUM,
)
# Surfaces, which pictures are compared with, are smooth: what grows into a cavity is blood to them.
_IN_CAVITIES = (Tissue.PAPILLARY_MUSCLE, Tissue.RV_TRABECULA, Tissue.LEAFLET)


def _class_of_tissue() -> Byte:
    table = np.full(256, REST, np.uint8)
    for number, tissues in (
        (BLOOD, (*_CAVITIES, *_IN_CAVITIES)),
        (WALL, _WALLS),
        (VESSEL, (Tissue.BLOOD_VESSEL,)),
    ):
        table[[int(tissue) for tissue in tissues]] = number
    return table


CLASS_OF_TISSUE = _class_of_tissue()


@dataclass(frozen=True, slots=True)
class Picture:
    """What the network sees, and what it should say."""

    grey: Byte
    """``(rows, columns)``, pixels of `PIXEL_MM`."""

    label: Byte
    """``(rows, columns)`` classes; `OUTSIDE` beyond the beams."""


def normalise(grey: Float32, inside: Mask) -> Float32:
    """``(2, row, column)``: what the network is shown of grey values from 0 to 1.

    The sector's mean is 0 and its standard deviation about 1; outside it is 0, and the second
    image tells where that is.
    """
    shown = grey[inside]
    if shown.size == 0:
        return np.zeros((2, *grey.shape), np.float32)
    scaled = np.where(inside, (grey - shown.mean()) / (shown.std() + 0.02), 0)
    return np.stack([scaled, inside]).astype(np.float32)


def draw_echoes(rng: np.random.Generator) -> Echoes:
    """What sound meets, drawn about what it truly meets: muscle stays brighter than blood."""
    count = len(ECHOES.scatter)
    spread_db = 5.0 if rng.random() < 0.5 else 2.5
    scatter = ECHOES.scatter * 10 ** (rng.normal(scale=spread_db, size=count) / 20)
    muscle_db = rng.normal(scale=1.0)
    for tissue in _MUSCLE:
        scatter[tissue] = 10 ** ((muscle_db + rng.normal(scale=1.5)) / 20)
    blood = 10 ** (rng.uniform(-38, -14) / 20)
    for tissue in (Tissue.BLOOD_VESSEL, *_CAVITIES):
        scatter[tissue] = blood * 10 ** (rng.normal(scale=1.0) / 20)
    impedance = ECHOES.impedance_mrayl.copy()
    # Of soft tissues alone: bone, lung and air mirror sound whatever their exact value.
    soft = impedance > 1.2
    impedance[soft] = 1.66 + (impedance[soft] - 1.66) * rng.uniform(0.4, 2.5, size=soft.sum())
    each = np.exp(rng.normal(scale=0.3, size=count))
    return Echoes(
        scatter, impedance, ECHOES.attenuation_db_per_cm * each * np.exp(rng.normal(0, 0.2))
    )


def draw_optics(rng: np.random.Generator, usual: Optics) -> Optics:
    """A scanner of the usual one's kind, built and set otherwise."""

    def times(scale: float) -> float:
        return float(np.exp(rng.normal(scale=scale)))

    drawn = replace(
        usual,
        frequency_mhz=usual.frequency_mhz * times(0.25),
        aperture_mm=usual.aperture_mm * times(0.2),
        focus_mm=usual.focus_mm * times(0.25),
        slice_aperture_mm=usual.slice_aperture_mm * times(0.2),
        slice_focus_mm=usual.slice_focus_mm * times(0.25),
        dynamic_range_db=rng.uniform(42, 80),
        gain_db=rng.normal(scale=6),
        noise_db=usual.noise_db + rng.uniform(-8, 16),
        grey_of_muscle=rng.uniform(0.38, 0.66),
    )
    if usual.compensation_db_per_cm is None:
        return replace(drawn, compensation_db_per_cm=drawn.compensation * times(0.12))
    return replace(drawn, compensation_db_per_cm=usual.compensation * times(0.25))


def draw_picture(
    rng: np.random.Generator, heart: BeatingHeart, probe: Probe, pose: Float, phase: float
) -> Picture:
    """One picture by a scanner of this probe's kind at 4x4 ``mr_from_transducer``."""
    optics = draw_optics(rng, probe.optics)
    sector = replace(
        probe.sector,
        depth_mm=probe.sector.depth_mm * rng.uniform(0.75, 1.2),
        angle_deg=float(np.clip(probe.sector.angle_deg * rng.uniform(0.8, 1.15), 30, 110)),
    )
    echoes = draw_echoes(rng)
    local_mm = sector.points_mm.copy()
    # Scatterers lie anywhere in the thickness of the slice.
    across = np.clip(rng.normal(size=local_mm.shape[:2]), -2, 2)
    local_mm[..., 2] += optics.slice_mm(sector.ranges_mm)[:, None] * across
    labels = labels_before(heart, place(local_mm, pose), phase, np.zeros(3))
    labels = opened(labels, sector, replace(probe, optics=optics, sector=sector))
    scatterers = _scatterers(rng, sector)
    contact_db = _contact_db(rng, sector)
    grey = bmode(rng, labels, sector, contact_db, optics, scatterers, echoes).astype(np.float32)
    if rng.random() < 0.4:
        grey = _drowned(rng, grey, sector, optics)
    if rng.random() < 0.35:
        grey = _without_speckle(rng, grey)
    return _as_seen(np.where(sector.inside, grey, 0).astype(np.float32), sector, heart, pose, phase)


def _scatterers(rng: np.random.Generator, sector: Sector) -> npt.NDArray[np.complex128]:
    """Speckle; in seven of ten pictures its strength wanders over some millimetres."""
    shape = len(sector.ranges_mm), sector.beams
    scatterers = unit_noise(rng, shape)
    if rng.random() < 0.7:
        length_mm = rng.uniform(3, 20)
        wander = gaussian_filter(
            rng.normal(size=shape), (length_mm / sector.range_step_mm, length_mm)
        )
        wander_db = wander * rng.uniform(1, 4) / max(wander.std(), 1e-9)
        scatterers = scatterers * 10 ** (wander_db / 20)
    return scatterers


def _contact_db(rng: np.random.Generator, sector: Sector) -> Float:
    """Beams that are weak because the probe rests badly, or on a rib."""
    contact_db = np.zeros(sector.beams)
    for _ in range(rng.integers(0, 4)):
        middle = rng.uniform(sector.angles_rad[0], sector.angles_rad[-1])
        width = rng.uniform(0.03, 0.2)
        dip = np.exp(-0.5 * ((sector.angles_rad - middle) / width) ** 2)
        contact_db -= rng.uniform(3, 30) * dip
    return contact_db


def _drowned(rng: np.random.Generator, grey: Float32, sector: Sector, optics: Optics) -> Float32:
    """The picture with an amplifier's noise, 6 to 26 dB under muscle in its middle row."""
    muscle = 255 * optics.grey_of_muscle
    depth_cm = np.arange(len(grey)) * sector.pixel_mm / 10
    lift_db = optics.compensation * (depth_cm - depth_cm[len(depth_cm) // 2])
    noise = 10 ** ((np.minimum(lift_db, 30.0) - rng.uniform(6, 26)) / 20)[:, None]
    amplitude = 10 ** ((grey - muscle) / 255 * optics.dynamic_range_db / 20)
    real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, *grey.shape)) * noise
    level_db = 20 * np.log10(np.hypot(amplitude + real, imaginary) + 1e-9)
    drowned = np.clip(muscle + 255 * level_db / optics.dynamic_range_db, 0, 255)
    return np.asarray(drowned, np.float32)


def _without_speckle(rng: np.random.Generator, grey: Float32) -> Float32:
    """What scanners do against speckle: a median, or smoothing that keeps edges or does not."""
    kind = rng.integers(3)
    if kind == 0:
        side = int(rng.choice([3, 5]))
        return np.asarray(cv2.medianBlur(grey.astype(np.uint8), side), np.float32)
    if kind == 1:
        return np.asarray(cv2.bilateralFilter(grey, 0, rng.uniform(15, 50), rng.uniform(1, 2.5)))
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), rng.uniform(0.6, 2.0)))


def _as_seen(
    grey: Float32, sector: Sector, heart: BeatingHeart, pose: Float, phase: float
) -> Picture:
    """The picture on pixels of `PIXEL_MM`, smoothed over them, and the tissue at each."""
    columns = grey.shape[1]
    half_mm = (columns // 2) * sector.pixel_mm
    step = PIXEL_MM / sector.pixel_mm
    either_side = int(half_mm // PIXEL_MM)
    x = (np.arange(-either_side, either_side + 1) * step + columns // 2).astype(np.float32)
    y = (np.arange(int(sector.depth_mm // PIXEL_MM) + 1) * step).astype(np.float32)
    shown = sector.inside.astype(np.float32)
    weight = cv2.GaussianBlur(shown, (0, 0), 0.45 * step)
    mean = cv2.GaussianBlur(grey, (0, 0), 0.45 * step) / np.maximum(weight, 1e-3)
    mean = np.where(shown > 0, mean, 0).astype(np.float32)
    across, down = np.meshgrid(x, y)
    small = cv2.remap(mean, across, down, cv2.INTER_LINEAR)
    inside = cv2.remap(shown, across, down, cv2.INTER_NEAREST) > 0
    plane_mm = np.stack([across, down, np.zeros_like(down)], axis=-1) * sector.pixel_mm
    plane_mm[..., 0] -= half_mm
    points_mm = place(plane_mm[inside], pose)
    tissue = np.array(heart.heart_tissue(points_mm, phase))
    chest = tissue == 0
    tissue[chest] = heart.chest_tissue(points_mm[chest])
    label = np.full(inside.shape, OUTSIDE, np.uint8)
    label[inside] = CLASS_OF_TISSUE[tissue]
    return Picture(np.clip(np.rint(small), 0, 255).astype(np.uint8), label)


def heart_pictures(number: int, frames: int) -> list[Picture]:
    """Pictures of one heart at all phases from `VIEWS` places, whatever other hearts there are."""
    seed = FIRST_SEED + number
    rng = np.random.default_rng([seed, STREAM])
    pathology = PATHOLOGIES[rng.integers(len(PATHOLOGIES))]
    spread = float(rng.uniform(0.8, 1.6))
    heart = load_heart(
        PhantomSettings.model_validate({"seed": seed, "pathology": pathology, "spread": spread})
    )
    names = list(PROBES)
    views = [(names[rng.integers(len(names))], int(rng.integers(3))) for _ in range(VIEWS)]
    aimed: dict[tuple[str, int], Float] = {}
    pictures = []
    for frame in range(frames):
        view = views[frame % VIEWS]
        probe = PROBES[view[0]]
        if view not in aimed:
            try:
                aimed[view] = aim(rng, heart, probe, probe.windows[view[1]])
            except SynthError:
                # A heart drawn this far from the mean may leave no way for a beam.
                continue
        pose = aimed[view] @ _hand(rng, probe)
        pictures.append(draw_picture(rng, heart, probe, pose, float(rng.random())))
    return pictures


def _hand(rng: np.random.Generator, probe: Probe) -> Float:
    """How an operator's hand turns and moves the probe where it was put."""
    turn = np.zeros(3)
    if probe.turn_about == "beam":
        turn[1] = rng.uniform(-np.pi, np.pi)
    else:
        turn[0] = rng.uniform(-1, 1) * np.deg2rad(max(probe.turn_deg * 0.6, 25))
    sway = rigid(np.deg2rad(rng.normal(scale=8, size=3)), rng.normal(scale=4, size=3))
    return np.asarray(rigid(turn, np.zeros(3)) @ sway)


def fill_pool(
    folder: Path, hearts: int, frames: int, progress: Progress | None = None, workers: int = 1
) -> list[Path]:
    """Write the hearts that the folder lacks, one file each; return all files in order.

    Each of ``workers`` processes draws whole hearts; their number changes no byte.

    Raises
    ------
    SynthError
        When the folder's hearts were drawn with another number of frames.
    """
    paths = [folder / f"heart{number:04d}.npz" for number in range(hearts)]
    fill(
        paths, {"frames": frames}, partial(heart_pictures, frames=frames), _save, progress, workers
    )
    return paths


def _save(file: BinaryIO, pictures: list[Picture]) -> None:
    arrays: dict[str, Any] = {}
    for k, one in enumerate(pictures):
        arrays |= {f"grey{k:03d}": one.grey, f"label{k:03d}": one.label}
    np.savez_compressed(file, **arrays)


def read_pool(paths: Sequence[Path]) -> list[Picture]:
    """All pictures of the hearts in these files."""
    pictures = []
    for path in paths:
        with np.load(path) as kept:
            names = sorted(name for name in kept if name.startswith("grey"))
            pictures += [Picture(kept[one], kept[f"label{one[4:]}"]) for one in names]
    return pictures
