"""Cine MR of hearts that no training ever used: other anatomy, other contrast, other noise.

A renderer for tests and benchmarks alone, to see what the segmenter does with images that come
from elsewhere. It shares nothing with the project's phantom: bodies are ellipsoids and tubes
(`tests.outside_anatomy`), grey values follow from published relaxation times, the image is formed
by sampling finer than its pixels and cutting a window out of k-space.

What a reader would draw is the truth, by these rules:

- A pixel belongs to what fills most of it through the slice's thickness.
- Papillary muscles and trabeculae belong to the cavity in which they stand.
- The right ventricle reaches to the plane of the tricuspid and the pulmonary valve; its wall is
  nobody's.
- The left ventricle's outflow tract is its cavity up to the mitral plane, the aorta from there on
  up to its arch; the arch and the descending aorta are nobody's.
- Where muscle surrounds less than half of the left cavity's border, a slice shows no left
  ventricle: neither cavity nor muscle is drawn there.
- The left atrium has its auricle and no veins, the right atrium neither cava.

Relaxation times. Muscle of the heart: Granitz et al., Wien. Klin. Wochenschr. 131:143-155 (2019).
Blood's T1 at 3 T: Lu et al., Magn. Reson. Med. 52:679-682 (2004). Liver, spleen, marrow, fat at
3 T: de Bazelaire et al., Radiology 230:652-659 (2004), whose T1 at 1.5 T are shorter by a factor
of 1.21 on average, which is used here. Blood at 1.5 T, blood's T2, flesh and all else: set from
memory so that images look right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from pipeline.imaging.cine import Cine
from pipeline.imaging.labels import LABELS
from tests.outside_anatomy import (
    BASE_MM,
    Kind,
    Stuff,
    bent,
    heart_axes,
    heart_stuff,
    left_ventricle,
)
from tests.outside_chest import chest_stuff
from tests.outside_people import Body, draw_body, made_ill
from tests.outside_shapes import Array, Waves

Float = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex64]

LONGER = 1.21
"""T1 at 3 T over T1 at 1.5 T, on average (de Bazelaire et al., 2004)."""

RELAXATION_MS: dict[float, dict[Stuff, tuple[float, float, float]]] = {
    1.5: {
        Stuff.BLOOD: (1500, 250, 1.0), Stuff.LV_MUSCLE: (995.8, 55.8, 0.92),
        Stuff.MUSCLE: (900, 44, 0.9), Stuff.LIVER: (809 / LONGER, 42, 0.85),
        Stuff.SPLEEN: (1328 / LONGER, 70, 0.85), Stuff.FAT: (382 / LONGER, 68, 1.0),
        Stuff.MARROW: (586 / LONGER, 49, 0.6), Stuff.STOMACH: (1100, 90, 0.8),
        Stuff.SPINAL_FLUID: (4000, 1500, 1.0), Stuff.LUNG: (1250, 40, 0.15),
        Stuff.PERICARDIUM: (900, 22, 0.4),
    },
    3.0: {
        Stuff.BLOOD: (1664, 180, 1.0), Stuff.LV_MUSCLE: (1183.8, 51.6, 0.92),
        Stuff.MUSCLE: (1100, 38, 0.9), Stuff.LIVER: (809, 34, 0.85),
        Stuff.SPLEEN: (1328, 61, 0.85), Stuff.FAT: (382, 68, 1.0),
        Stuff.MARROW: (586, 49, 0.6), Stuff.STOMACH: (1300, 80, 0.8),
        Stuff.SPINAL_FLUID: (4100, 1400, 1.0), Stuff.LUNG: (1300, 35, 0.15),
        Stuff.PERICARDIUM: (1000, 20, 0.4),
    },
}  # fmt: skip
"""Field (T) -> T1, T2 (ms) and protons relative to blood's."""

SHINES_LIKE: dict[Stuff, Stuff] = {
    Stuff.LV_BLOOD: Stuff.BLOOD,
    Stuff.RV_BLOOD: Stuff.BLOOD,
    Stuff.LEFT_ATRIUM: Stuff.BLOOD,
    Stuff.RIGHT_ATRIUM: Stuff.BLOOD,
    Stuff.AORTA: Stuff.BLOOD,
    Stuff.LV_PAPILLARY: Stuff.LV_MUSCLE,
    Stuff.RV_TRABECULA: Stuff.LV_MUSCLE,
    Stuff.WALL: Stuff.LV_MUSCLE,
}

DRAWN_AS: dict[Stuff, str] = {
    Stuff.LV_BLOOD: "lv_cavity",
    Stuff.LV_PAPILLARY: "lv_cavity",
    Stuff.LV_MUSCLE: "lv_myocardium",
    Stuff.RV_BLOOD: "rv_cavity",
    Stuff.RV_TRABECULA: "rv_cavity",
    Stuff.LEFT_ATRIUM: "left_atrium",
    Stuff.RIGHT_ATRIUM: "right_atrium",
    Stuff.AORTA: "aorta",
}

LEAST_SURROUNDED = 0.5
"""Share of the left cavity's border that must be muscle for a reader to draw the ventricle."""

FAT_PPM = -3.4
PROTON_MHZ_PER_T = 42.577

BEYOND_MM = 45.0
"""Slices across the body reach so far below the ventricle's tip and above the mitral plane."""

OFF_HZ = np.linspace(-200.0, 200.0, 81)
"""Field errors for which signals are worked out."""


@dataclass(frozen=True, slots=True)
class Scan:
    """How a stack is taken."""

    phases: tuple[float, ...] = (0.0, 0.35)
    slices: int | None = None
    """From below the apex; by default as many as reach 12 to 36 mm above the mitral plane."""
    transverse: bool = False
    """Slices across the body, from `BEYOND_MM` below the ventricle to as much above it."""
    step_mm: float = 10.0
    thickness_mm: float = 8.0
    pixel_mm: float = 1.5
    field_mm: float = 330.0
    field_t: float = 1.5
    snr: float = 30.0
    """Blood's signal at the heart over the noise's deviation in each channel."""
    shift_sd_mm: float = 1.0
    """Breath-hold shifts, mostly along head and feet."""
    shading: float = 0.5
    """Share of the coils' profile, in the logarithm, that stays in the image."""
    depths: int = 4
    """Points through the slice in each of the four parts of a pixel."""


@dataclass(frozen=True, slots=True)
class Outside:
    """A stack and what a reader would draw on it."""

    cine: Cine
    labels: Kind
    """``(phase, z, y, x)``."""


@dataclass(frozen=True, slots=True)
class Look:
    """One scanner's way with one person."""

    signal: Complex
    """``(stuff, frequency)`` of `OFF_HZ`."""
    off_hz: Float
    """Field error at the chest's middle, and its slope (Hz per mm) along x, y, z."""
    sharp: float
    """Share of k-space that was measured along each axis."""
    coils_mm: Float

    @classmethod
    def drawn(cls, rng: np.random.Generator, scan: Scan) -> Look:
        """Flip angle, TR, shim, sharpness and coils at random."""
        fresh = rng.uniform(0.96, 1.12, len(Stuff))
        off_hz = np.array([rng.normal(0, 15), *rng.normal(0, 0.25, 3)])
        signal = steady_state(scan.field_t, rng.uniform(40, 65), rng.uniform(2.6, 3.4), OFF_HZ)
        coils_mm = np.array([[40.0, -130, -40], [-60, -120, 40], [20, 140, 0]])
        coils_mm += rng.normal(0, 25, (3, 3))
        signal *= fresh[:, None].astype(np.float32)
        return cls(signal, off_hz, rng.uniform(0.62, 0.9), coils_mm)


def steady_state(field_t: float, angle_deg: float, tr_ms: float, off_hz: Float) -> Complex:
    """Balanced steady state half a TR after the pulse, ``(stuff, frequency)``.

    Pulses alternate in sign. Formula: Scheffler and Lehnhardt, Eur. Radiol. 13:2409-2418 (2003).
    """
    found = np.zeros((len(Stuff), len(off_hz)), np.complex64)
    a = np.radians(angle_deg)
    for kind in Stuff:
        values = RELAXATION_MS[field_t].get(SHINES_LIKE.get(kind, kind))
        if values is None:
            continue
        t1, t2, density = values
        fatty = kind in (Stuff.FAT, Stuff.MARROW)
        turn = off_hz + fatty * FAT_PPM * PROTON_MHZ_PER_T * field_t
        turn = 2 * np.pi * turn * tr_ms / 1000
        e1, e2 = np.exp(-tr_ms / t1), np.exp(-tr_ms / t2)
        theta = turn + np.pi
        c = e2 * (e1 - 1) * (1 + np.cos(a))
        d = (1 - e1 * np.cos(a)) - (e1 - np.cos(a)) * e2**2
        after = density * (1 - e1) * np.sin(a) * (1 - e2 * np.exp(-1j * theta))
        found[kind] = after / (c * np.cos(theta) + d) * np.exp(-tr_ms / 2 / t2 + 0.5j * turn)
    return found


def render(seed: int, scan: Scan, heart: bool = True, illness: str = "") -> Outside:
    """The person that ``seed`` draws, scanned; without ``heart``, only what surrounds it.

    ``illness``: one of `tests.outside_people.ILLNESSES` that the same person has.

    The same seed gives the same person, plan and shifts whatever the scan's phases are.
    """
    rng = np.random.default_rng([seed, 77])
    body = draw_body(rng)
    if illness:
        body = made_ill(np.random.default_rng([seed, 78]), body, illness)
    frame, count, side = _plan(rng, body, scan)
    deviation_mm = scan.shift_sd_mm * np.array([0.1, 0.35, 0.93])
    shifts_mm = rng.standard_normal((count, 1)) * deviation_mm
    look = Look.drawn(rng, scan)
    shape = (len(scan.phases), count, side, side)
    image: Array = np.zeros(shape, np.float32)
    labels: Kind = np.zeros(shape, np.uint8)
    for z in range(count):
        points = _points(frame, z, side, scan) - shifts_mm[z].astype(np.float32)
        stuffs = _slice_stuff(body, points, scan.phases if heart else ())
        for k, stuff in enumerate(stuffs if heart else [next(stuffs)] * len(scan.phases)):
            image[k, z] = _acquired(rng, stuff, points, scan, look)
            labels[k, z] = _as_drawn(stuff, points.shape[:3])
    cine = Cine(900 * image, frame, np.array(scan.phases), 0.85)
    return Outside(cine, labels)


def _plan(rng: np.random.Generator, body: Body, scan: Scan) -> tuple[Float, int, int]:
    """4x4 frame of the stack, number of slices, and pixels along a side."""
    axes = heart_axes(body)
    tilt = np.radians(4) * rng.standard_normal(3)
    tilt[2] = np.radians(rng.uniform(-25, 25))
    for k, angle in enumerate(tilt):
        turn = np.eye(3)
        i, j = (k + 1) % 3, (k + 2) % 3
        turn[[i, j], [i, j]] = np.cos(angle)
        turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
        axes = turn @ axes
    side = round(scan.field_mm / scan.pixel_mm / 2) * 2
    now = left_ventricle(body, 0.0)
    if scan.transverse:
        apex_mm = BASE_MM - axes[2] * (now.length + now.wall)
        height_mm = BASE_MM[2] - apex_mm[2] + 2 * BEYOND_MM
        frame = np.diag([scan.pixel_mm, scan.pixel_mm, scan.step_mm, 1.0])
        frame[:3, 3] = (apex_mm + BASE_MM) / 2 - scan.pixel_mm * (side - 1) / 2
        frame[2, 3] = apex_mm[2] - BEYOND_MM
        return frame, scan.slices or int(np.ceil(height_mm / scan.step_mm)), side
    low_mm = -now.length - 0.6 * now.wall - rng.uniform(0, 8)
    reach_mm = rng.uniform(12, 36) - low_mm
    off_mm = rng.normal((8, 0), 8)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1] = -axes[0] * scan.pixel_mm, -axes[1] * scan.pixel_mm
    frame[:3, 2] = axes[2] * scan.step_mm
    middle_mm = BASE_MM + axes[2] * low_mm + off_mm @ axes[:2]
    frame[:3, 3] = middle_mm - frame[:3, :2].sum(axis=1) * (side - 1) / 2
    return frame, scan.slices or int(np.ceil(reach_mm / scan.step_mm)), side


def _points(frame: Float, z: int, side: int, scan: Scan) -> Array:
    """``(depth, 2 side, 2 side, 3)`` LPS points, two a pixel each way."""
    place = ((np.arange(2 * side) - 0.5) / 2).astype(np.float32)
    deep = (np.arange(scan.depths) + 0.5) / scan.depths - 0.5
    columns = frame.astype(np.float32)
    along = z + (deep * scan.thickness_mm / scan.step_mm).astype(np.float32)
    # Each part of a pixel has depths of its own, so that all together lie four times as close.
    part = np.add.outer(2 * (np.arange(2 * side) % 2), np.arange(2 * side) % 2)
    share = scan.thickness_mm / scan.step_mm / scan.depths
    deeper = (along[:, None, None] + (part / 4 - 0.375) * share).astype(np.float32)
    return np.asarray(
        deeper[..., None] * columns[:3, 2]
        + place[:, None, None] * columns[:3, 1]
        + place[:, None] * columns[:3, 0]
        + columns[:3, 3]
    )


def _slice_stuff(body: Body, points: Array, phases: tuple[float, ...]) -> Iterator[Kind]:
    """What the slice's points are made of, phase by phase; once without heart if no phase."""
    depths = len(points)
    # Nobody asks for the chest's edges: a point a pixel and two depths are enough.
    some = points[:: max(depths // 2, 1), ::2, ::2]
    chest = chest_stuff(body, bent(body, some.reshape(-1, 3))).reshape(some.shape[:3])
    chest = chest.repeat(2, axis=1).repeat(2, axis=2)
    still: Kind = chest.repeat(-(-depths // len(chest)), axis=0)[:depths].ravel()
    if not phases:
        yield still
    flat, axes = points.reshape(-1, 3), heart_axes(body).T.astype(np.float32)
    own = (flat - BASE_MM.astype(np.float32)) @ axes
    # Beyond what is drawn of healthy hearts, a wide right ventricle's reach is added.
    wide_mm = 85 + max(0.0, 1.5 * (body.rv_reach - 50))
    near = np.flatnonzero((np.abs(own[:, 0] - 18) < wide_mm) & (np.abs(own[:, 1]) < 80))
    own = (bent(body, flat[near]) - BASE_MM.astype(np.float32)) @ axes
    for phase in phases:
        stuff = still.copy()
        heart = heart_stuff(body, own, phase)
        stuff[near[heart > 0]] = heart[heart > 0]
        yield stuff


def _acquired(
    rng: np.random.Generator, stuff: Kind, points: Array, scan: Scan, look: Look
) -> Array:
    """What the scanner makes of it: signals summed, a window of k-space, coils, noise."""
    hz = look.off_hz[0] + points.reshape(-1, 3) @ look.off_hz[1:].astype(np.float32)
    step_hz = OFF_HZ[1] - OFF_HZ[0]
    which = np.clip((hz - OFF_HZ[0]) / step_hz, 0, len(OFF_HZ) - 1).astype(np.intp)
    value = look.signal[stuff, which].reshape(points.shape[:3]).mean(axis=0)
    half = len(value) // 4
    spectrum = np.fft.fftshift(np.fft.fft2(value))[half:-half, half:-half] / 4
    # The window's edge is soft, as scanners filter it; the rest of k-space is filled with zeros.
    k = np.arange(-half, half) / half
    window = np.clip((look.sharp + 0.15 - np.abs(k)) / 0.3, 0, 1)
    # A pixel lies in the middle of its two points: half a point, a quarter pixel, from the first.
    window = window * np.exp(0.25j * np.pi * k)
    image = np.fft.ifft2(np.fft.ifftshift(spectrum * window[:, None] * window))
    image = image * _shading(look, points, scan)
    deviation = abs(look.signal[Stuff.LV_BLOOD, len(OFF_HZ) // 2]) / scan.snr
    noise = deviation * rng.standard_normal((2, *image.shape))
    return np.asarray(np.abs(image + noise[0] + 1j * noise[1]), np.float32)


def _shading(look: Look, points: Array, scan: Scan) -> Array:
    """Coils' sensitivity on the pixels, 1 at the heart."""
    middle = points[len(points) // 2, ::2, ::2]

    def seen(places: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        away = np.linalg.norm(places[..., None, :] - look.coils_mm.astype(np.float32), axis=-1)
        return np.asarray((1 / (1 + (away / 90) ** 2)).sum(axis=-1))

    return np.asarray((seen(middle) / seen(BASE_MM)) ** scan.shading, np.float32)


def _as_drawn(stuff: Kind, shape: tuple[int, ...]) -> Kind:
    """The label that most of each pixel's points have, and no left ventricle without muscle."""
    table = np.zeros(len(Stuff), np.uint8)
    for kind, name in DRAWN_AS.items():
        table[kind] = LABELS[name]
    depths, rows, columns = shape
    label = table[stuff].reshape(depths, rows // 2, 2, columns // 2, 2)
    label = label.transpose(1, 3, 0, 2, 4).reshape(-1, 4 * depths)
    voted = np.zeros(len(label), np.uint8)
    some = np.flatnonzero(label.any(axis=1))
    votes = np.stack([(label[some] == v).sum(axis=1) for v in range(1 + len(LABELS))])
    voted[some] = votes.argmax(axis=0)
    drawn: Kind = voted.reshape(rows // 2, columns // 2)
    inside, muscle = drawn == LABELS["lv_cavity"], drawn == LABELS["lv_myocardium"]
    border = binary_dilation(inside) & ~inside
    if inside.any() and muscle[border].mean() < LEAST_SURROUNDED:
        drawn[inside | muscle] = 0
    return drawn


def without_heart(kind: str, seed: int = 3, phases: int = 2, slices: int = 8) -> Cine:
    """Images that show no heart: "noise", "constant", "gradient", "brain" or "chest"."""
    rng, side = np.random.default_rng(seed), 160
    frame = np.diag([1.6, 1.6, 10.0, 1.0])
    shape = (phases, slices, side, side)
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape[1:]), indexing="ij")
    if kind == "chest":
        times = tuple(np.arange(phases) / phases)
        return render(seed, Scan(times, slices, depths=2), heart=False).cine
    if kind == "noise":
        image = np.abs(rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    elif kind == "constant":
        image = np.ones(shape)
    elif kind == "gradient":
        image = np.broadcast_to(2 + x + 0.5 * y, shape)
    elif kind == "brain":
        head = _brain(rng, np.stack([x, y, z], axis=-1))
        noise = 0.03 * rng.standard_normal((2, *shape))
        image = np.abs(head + noise[0] + 1j * noise[1])
    else:
        raise ValueError(f"no images of kind {kind!r}")
    return Cine(100 * image.astype(np.float32), frame, np.arange(phases) / phases, 0.85)


def _brain(rng: np.random.Generator, places: Float) -> Float:
    """A head in steady-state contrast; ``places`` in [-1, 1] of a 256 mm box, axial slices."""
    mm = places * (100, 118, 60)
    folds = Waves.drawn(rng, 22, 6).at(mm.reshape(-1, 3).astype(np.float32)).reshape(mm.shape[:3])
    away = np.sqrt((mm[..., 0] / 72) ** 2 + ((mm[..., 1] + 4) / 90) ** 2 + (mm[..., 2] / 85) ** 2)
    grey = np.zeros(away.shape)
    for edge, value in ((1.12, 0.7), (1.07, 0.05), (1.0, 1.0)):
        grey[away < edge] = value
    grey[away + 0.03 * folds < 0.95] = 0.45
    grey[away + 0.07 * folds < 0.85] = 0.35
    for side in (-1, 1):
        horn = ((mm[..., 0] - 11 * side) / 8) ** 2 + (mm[..., 1] / 30) ** 2 + (mm[..., 2] / 22) ** 2
        grey[horn < 1] = 1.0
    return grey


def moved(found: Outside, sd_mm: float, seed: int) -> Outside:
    """Every slice and its drawing shifted in its plane by whole pixels, about ``sd_mm``."""
    rng = np.random.default_rng(seed)
    image, labels = found.cine.intensity.copy(), found.labels.copy()
    for z in range(image.shape[1]):
        steps = np.rint(rng.normal(0, sd_mm, 2) / found.cine.spacing_mm[:2]).astype(int)
        for stack in (image, labels):
            stack[:, z] = np.roll(stack[:, z], tuple(steps), axis=(1, 2))
    return Outside(replace(found.cine, intensity=image), labels)
