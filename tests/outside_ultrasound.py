"""Ultrasound that no training ever used: another picture of sound than the project's phantom has.

A renderer for tests and benchmarks alone, to see what registration does with pictures that come
from elsewhere. It shares no code with `data_synth`: beams and pulse are filters of a complex field
of echoes in polar coordinates, interfaces mirror what strikes them squarely, side lobes,
reverberation and haze veil what is dark, and a console of its own makes a picture of it.

Frame of a transducer (mm): origin at the tip, x across the picture, y along the middle beam, away
from the tip, z across the plane. Pixel ``(i, j)`` lies at ``((i - middle) * pixel, j * pixel)``.

Loss, impedance and speckle of the tissues are set from memory, within what textbooks give (Szabo,
Diagnostic Ultrasound Imaging, appendix B), and drawn about that for each console.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.fft import fft, ifft
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from tests.outside_anatomy import Kind, Stuff

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]
StuffAt = Callable[[Float], Kind]
"""What each of ``(n, 3)`` LPS points (mm) is made of."""


class Sound(NamedTuple):
    """What a tissue does with sound."""

    speckle_db: float
    """Echo of its inside over muscle's."""
    loss: float
    """dB per cm and MHz, one way."""
    impedance: float
    """MRayl."""


SOUND: dict[Stuff, Sound] = {
    Stuff.NONE: Sound(-20, 40, 0.02), Stuff.LUNG: Sound(2, 12, 0.3),
    Stuff.FAT: Sound(-1, 0.6, 1.38),
    Stuff.MUSCLE: Sound(-1, 0.8, 1.68), Stuff.LIVER: Sound(-1, 0.5, 1.65),
    Stuff.SPLEEN: Sound(-3, 0.5, 1.64), Stuff.STOMACH: Sound(0, 1.0, 1.55),
    Stuff.MARROW: Sound(4, 12, 4.0), Stuff.SPINAL_FLUID: Sound(-45, 0.05, 1.52),
    Stuff.BLOOD: Sound(-30, 0.15, 1.61), Stuff.WALL: Sound(4, 0.8, 1.72),
    Stuff.PERICARDIUM: Sound(9, 1.0, 1.80), Stuff.LV_BLOOD: Sound(-30, 0.15, 1.61),
    Stuff.LV_MUSCLE: Sound(0, 0.6, 1.69), Stuff.LV_PAPILLARY: Sound(3, 0.6, 1.70),
    Stuff.RV_BLOOD: Sound(-30, 0.15, 1.61), Stuff.RV_TRABECULA: Sound(3, 0.6, 1.70),
    Stuff.LEFT_ATRIUM: Sound(-30, 0.15, 1.61), Stuff.RIGHT_ATRIUM: Sound(-30, 0.15, 1.61),
    Stuff.AORTA: Sound(-30, 0.15, 1.61),
}  # fmt: skip

HARD = (Stuff.NONE, Stuff.LUNG, Stuff.MARROW)
BLOODS = (Stuff.BLOOD, Stuff.LV_BLOOD, Stuff.RV_BLOOD, Stuff.LEFT_ATRIUM, Stuff.RIGHT_ATRIUM,
          Stuff.AORTA)  # fmt: skip
CAVITIES = (Stuff.LV_BLOOD, Stuff.LV_PAPILLARY, Stuff.RV_BLOOD, Stuff.RV_TRABECULA,
            Stuff.LEFT_ATRIUM, Stuff.RIGHT_ATRIUM, Stuff.AORTA)  # fmt: skip
OF_HEART = (*CAVITIES, Stuff.LV_MUSCLE, Stuff.WALL)

LINES = 144
STEP_MM = 0.4
LARGEST_DB = 100.0


@dataclass(frozen=True, slots=True)
class Fan:
    """What a kind of probe scans."""

    depth_mm: float
    half_deg: float
    pixel_mm: float
    mhz: float
    aperture_mm: float
    clear_deg: float
    """Within this angle of the middle beam nothing hard lies before the heart."""
    pad: bool = False
    """Gel or a balloon of water lies between tip and heart, instead of the chest."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        half = int(self.depth_mm * np.sin(np.radians(self.half_deg)) / self.pixel_mm)
        return int(self.depth_mm / self.pixel_mm) + 1, 2 * half + 1

    @property
    def transducer_from_image(self) -> Float:
        """4x4 from pixel ``(i, j, 0)`` to mm."""
        frame = np.diag([self.pixel_mm, self.pixel_mm, 1.0, 1.0])
        frame[0, 3] = -(self.shape[1] // 2) * self.pixel_mm
        return frame


FANS = {
    "surface": Fan(165, 40, 0.7, 2.6, 19, 32),
    "transoesophageal": Fan(125, 42, 0.55, 5.0, 12, 90),
    "intracardiac": Fan(110, 45, 0.5, 7.5, 8, 90),
    "epicardial": Fan(110, 42, 0.5, 6.5, 13, 90, pad=True),
}


@dataclass(frozen=True, slots=True)
class Console:
    """How one machine is built, and set for one patient."""

    mhz: float
    cycles: float
    aperture_mm: float
    focus_mm: float
    slice_mm: float
    """Deviation of the beam across the plane, at its thinnest."""
    speckle: Float
    """``(stuff,)`` amplitudes."""
    loss: Float
    impedance: Float
    squarely: float
    """How sharply an interface's echo falls off with the angle."""
    mirror_db: float
    lobes_db: float
    echo_mm: float
    """Way of sound between skin and probe that comes again."""
    echo_db: float
    haze_db: float
    noise_db: float
    """Under muscle, at six tenths of the depth."""
    unequal_db: Float
    """``(line,)`` how well each line's part of the probe lies on."""
    depth_gain_db: Float
    """``(5,)`` how far off the operator's sliders are, from the skin to the deepest."""
    looks: int
    """Pictures from several directions that are added up."""
    range_db: float
    grey_of_muscle: float
    gamma: float
    curve: float
    finish: str
    jpeg: int

    @classmethod
    def drawn(cls, rng: np.random.Generator, fan: Fan) -> Console:
        """One of the many."""
        table = np.array([SOUND.get(kind, SOUND[Stuff.MUSCLE]) for kind in Stuff])
        speckle_db = table[:, 0] + rng.normal(0, 2, len(Stuff))
        speckle_db[list(BLOODS)] = rng.uniform(-40, -20)
        impedance = table[:, 2] * np.exp(rng.normal(0, 0.012, len(Stuff)))
        impedance[list(BLOODS)] = impedance[Stuff.BLOOD]
        lines = np.arange(LINES)
        unequal = gaussian_filter1d(rng.normal(0, 1, LINES), LINES / 12, mode="nearest")
        unequal *= rng.uniform(0, 4) / unequal.std()
        if rng.random() < 0.5:
            middle, wide = rng.uniform(0, LINES), rng.uniform(4, 20)
            unequal -= rng.uniform(5, 30) * np.exp(-0.5 * ((lines - middle) / wide) ** 2)
        return cls(
            mhz=fan.mhz * np.exp(rng.normal(0, 0.15)),
            cycles=rng.uniform(1.2, 3.5),
            aperture_mm=fan.aperture_mm * np.exp(rng.normal(0, 0.15)),
            focus_mm=fan.depth_mm * rng.uniform(0.35, 0.8),
            slice_mm=rng.uniform(0.8, 2.0),
            speckle=10 ** (speckle_db / 20),
            loss=table[:, 1] * np.exp(rng.normal(0, 0.2, len(Stuff))),
            impedance=impedance,
            squarely=rng.uniform(1.5, 6),
            mirror_db=rng.uniform(16, 34),
            lobes_db=rng.uniform(-48, -26),
            echo_mm=rng.uniform(4, 18),
            echo_db=rng.uniform(-50, -22),
            haze_db=rng.uniform(-45, -14),
            noise_db=rng.uniform(-42, -14),
            unequal_db=unequal,
            depth_gain_db=rng.normal(0, 3.5, 5),
            looks=int(rng.choice([1, 1, 1, 2, 4])),
            range_db=rng.uniform(45, 75),
            grey_of_muscle=rng.uniform(0.35, 0.62),
            gamma=np.exp(rng.normal(0, 0.2)),
            curve=rng.uniform(0, 0.8),
            finish=str(rng.choice(["plain", "plain", "sharp", "soft", "smooth", "median"])),
            jpeg=int(rng.choice([0, 0, 60, 80, 92])),
        )


@dataclass(frozen=True, slots=True)
class Picture:
    """What a console shows, and where blood of the cavities truly is in its plane."""

    grey: Byte
    blood: npt.NDArray[np.bool_]
    sector: npt.NDArray[np.bool_]


def picture(
    rng: np.random.Generator, console: Console, fan: Fan, stuff_at: StuffAt, pose: Float
) -> Picture:
    """One picture at 4x4 ``pose``, LPS from transducer (mm)."""
    ranges = np.arange(2.0, fan.depth_mm, STEP_MM)
    angles = np.radians(np.linspace(-fan.half_deg, fan.half_deg, LINES))
    sheets = [_stuff(console, fan, stuff_at, pose, ranges, angles, z) for z in (0.0, -1.2, 1.2)]
    passed_db = _passed_db(console, sheets[0], ranges)
    shown = np.zeros(sheets[0].shape)
    for _ in range(console.looks):
        shown += np.abs(_echoes(rng, console, sheets, passed_db, ranges, angles)) ** 2
    amplitude = np.sqrt(shown / console.looks)
    grey = _compressed(console, amplitude, ranges)
    rows, columns = fan.shape
    y, x = np.mgrid[0:rows, 0:columns] * fan.pixel_mm
    x -= columns // 2 * fan.pixel_mm
    away, turned = np.hypot(x, y), np.arctan2(x, y)
    row = (away - ranges[0]) / STEP_MM
    line = (turned - angles[0]) / (angles[1] - angles[0])
    sector = (row >= 0) & (row <= len(ranges) - 1) & (line >= 0) & (line <= LINES - 1)
    image = cv2.remap(grey.astype(np.float32), line.astype(np.float32), row.astype(np.float32),
                      cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    image = np.where(sector, np.maximum(_finished(console, image), 1), 0).astype(np.uint8)
    # At the plane's own points: what the sheet's lines show between their samples is near enough.
    near = sheets[0][np.clip(row.round().astype(int), 0, len(ranges) - 1),
                     np.clip(line.round().astype(int), 0, LINES - 1)]  # fmt: skip
    return Picture(image, np.isin(near, CAVITIES) & sector, sector)


def _stuff(
    console: Console,
    fan: Fan,
    stuff_at: StuffAt,
    pose: Float,
    ranges: Float,
    angles: Float,
    aside: float,
) -> Kind:
    """``(range, line)`` of what lies ``aside`` beam deviations beside the plane."""
    across, along = np.outer(ranges, np.sin(angles)), np.outer(ranges, np.cos(angles))
    focus = console.focus_mm
    wide = console.slice_mm * np.hypot(1, 1.5 * (ranges - focus) / focus)[:, None]
    local = np.stack([across, along, np.broadcast_to(aside * wide, across.shape)], axis=-1)
    points = local.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    stuff = stuff_at(points).reshape(across.shape).copy()
    before = np.cumsum(np.isin(stuff, OF_HEART), axis=0) == 0
    if fan.pad:
        stuff[before] = Stuff.SPINAL_FLUID
    clear = np.abs(np.degrees(angles)) < fan.clear_deg
    stuff[before & clear & np.isin(stuff, HARD)] = Stuff.MUSCLE
    return np.asarray(stuff)


def _passed_db(console: Console, stuff: Kind, ranges: Float) -> Float:
    """``(range, line)`` how much is left of sound that goes there and comes back."""
    one_way = np.cumsum(console.loss[stuff] * console.mhz * STEP_MM / 10, axis=0)
    # Compensation makes up for what muscle and blood by turns lose.
    usual = 0.4 * console.mhz * ranges / 10
    return np.asarray(np.maximum(2 * (usual[:, None] - one_way), -LARGEST_DB))


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.complex128]:
    real, imaginary = rng.standard_normal((2, *shape))
    return np.asarray((real + 1j * imaginary) * np.sqrt(0.5))


def _echoes(
    rng: np.random.Generator,
    console: Console,
    sheets: list[Kind],
    passed_db: Float,
    ranges: Float,
    angles: Float,
) -> npt.NDArray[np.complex128]:
    """``(range, line)`` complex field of echoes behind the compensation over depth."""
    shape = sheets[0].shape
    field = np.zeros(shape, np.complex128)
    # Fibres lie otherwise from place to place.
    fibres = gaussian_filter(rng.standard_normal(shape), (6 / STEP_MM, 8))
    fibres = 10 ** (3.0 * fibres / fibres.std() / 20)
    for stuff, weight in zip(sheets, (0.5, 0.25, 0.25), strict=True):
        field += np.sqrt(weight) * _noise(rng, shape) * console.speckle[stuff] * fibres
    field += _mirrored(console, sheets, ranges, angles)
    lines = _beam_mm(console, ranges) / (ranges * (angles[1] - angles[0]))
    field = _blurred(console, field * 10 ** (passed_db / 20), lines)
    # Pulse and beam add up more scatterers where they are wide: muscle's level is 1 all the way.
    level = np.sqrt(np.mean(np.abs(_blurred(console, _noise(rng, shape), lines)) ** 2, axis=1))
    field = field / level[:, None]
    veil = gaussian_filter(np.minimum(np.abs(field), 30), (1.5 / STEP_MM, LINES / 9))
    field = field + 3 * 10 ** (console.lobes_db / 20) * veil * _noise(rng, shape)
    shift = round(console.echo_mm / STEP_MM)
    field[shift:] += field[:-shift] * 10 ** (console.echo_db / 20)
    haze = gaussian_filter(rng.standard_normal(shape), (12 / STEP_MM, LINES / 8))
    haze = 10 ** ((console.haze_db + 5 * haze / haze.std()) / 20) * np.exp(-ranges / 45)[:, None]
    field = field + (haze + 12 * np.exp(-ranges / 2.5)[:, None]) * _noise(rng, shape)
    field = field * 10 ** (console.unequal_db / 20)
    deep = ranges - 0.6 * ranges[-1]
    noise_db = console.noise_db + 0.8 * console.mhz * np.clip(deep, -60, 60) / 10
    return np.asarray(field + 10 ** (noise_db[:, None] / 20) * _noise(rng, shape))


def _beam_mm(console: Console, ranges: Float) -> Float:
    """``(range,)`` deviation of the beam across its line."""
    focused = 0.45 * 1.54 / console.mhz * ranges / console.aperture_mm
    return np.asarray(focused * (1 + 0.6 * np.abs(ranges / console.focus_mm - 1)) + 0.15)


def _blurred(
    console: Console, field: npt.NDArray[np.complex128], lines: Float
) -> npt.NDArray[np.complex128]:
    """The field as pulse and beam, of so many lines in each row, show it."""
    pulse_mm = console.cycles * 1.54 / console.mhz / 4
    return _across(gaussian_filter1d(field, pulse_mm / STEP_MM, axis=0), lines)


def _mirrored(console: Console, sheets: list[Kind], ranges: Float, angles: Float) -> Float:
    """``(range, line)`` amplitudes of what interfaces send straight back."""
    impedance = np.mean([console.impedance[one] for one in sheets], axis=0)
    smooth = gaussian_filter(np.log(impedance), (0.6 / STEP_MM, 1.0))
    along = np.gradient(smooth, STEP_MM, axis=0)
    across = np.gradient(smooth, axis=1) / (ranges[:, None] * (angles[1] - angles[0]))
    square = np.abs(along) / np.maximum(np.hypot(along, across), 1e-9)
    strong = np.abs(along) * square**console.squarely
    return np.asarray(10 ** (console.mirror_db / 20) * np.minimum(strong, 1.0))


def _across(field: npt.NDArray[np.complex128], lines: Float) -> npt.NDArray[np.complex128]:
    """The field behind beams whose deviation is so many lines in each row."""
    wave = 2 * np.pi * np.fft.fftfreq(2 * LINES)
    wide = np.concatenate([field, field[:, ::-1]], axis=1)
    passed = np.exp(-0.5 * (lines[:, None] * wave) ** 2)
    return np.asarray(ifft(fft(wide, axis=1) * passed, axis=1)[:, :LINES])


def _compressed(console: Console, amplitude: Float, ranges: Float) -> Float:
    """``(range, line)`` grey values, 0 to 255."""
    sliders = np.interp(ranges, np.linspace(ranges[0], ranges[-1], 5), console.depth_gain_db)
    level_db = 20 * np.log10(np.maximum(amplitude, 1e-6)) + sliders[:, None]
    grey = np.clip(console.grey_of_muscle + level_db / console.range_db, 0, 1)
    bent = grey * grey * (3 - 2 * grey)
    return np.asarray(255 * ((1 - console.curve) * grey + console.curve * bent) ** console.gamma)


def _finished(console: Console, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The picture as the console's filters and its store leave it."""
    if console.finish == "sharp":
        image = 1.8 * image - 0.8 * cv2.GaussianBlur(image, (0, 0), 2.0)
    elif console.finish == "soft":
        image = cv2.GaussianBlur(image, (0, 0), 1.3)
    elif console.finish == "smooth":
        image = cv2.bilateralFilter(image, 7, 40, 2.5)
    elif console.finish == "median":
        image = cv2.medianBlur(np.clip(image, 0, 255).astype(np.uint8), 5).astype(np.float32)
    image = np.clip(image, 0, 255)
    if console.jpeg:
        _, packed = cv2.imencode(".jpg", image.astype(np.uint8),
                                 [cv2.IMWRITE_JPEG_QUALITY, console.jpeg])  # fmt: skip
        image = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE).astype(np.float32)
    return np.asarray(image, np.float32)
