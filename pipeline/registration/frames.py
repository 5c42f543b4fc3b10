"""Turn tracked ultrasound frames into samples that can be compared with the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array
from scipy.stats import rankdata

from pipeline.errors import InputError, UnregistrableError
from pipeline.geometry import Float, Float32, Integer, Mask
from pipeline.registration.contact import Contact
from pipeline.registration.sector import shown_sector


class TrackedSweep(Protocol):
    """What registration needs of a sweep."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def images(self) -> Float32:
        """``(n, h, w)`` grey values, 0 outside the sector."""

    @property
    def tracker_from_image(self) -> Float:
        """``(n, 4, 4)``: pixel ``(i, j, 0)`` (column, row) to tracker millimetres."""


@dataclass(frozen=True, slots=True)
class BloodSweep:
    """A sweep whose pictures tell how probable blood is; see `pipeline.registration.reading`."""

    name: str
    images: Float32
    """``(n, h, w)`` from 0 to 1; 0 all over where a picture shows no body."""

    tracker_from_image: Float
    sector: Mask
    """``(h, w)``."""


@dataclass(frozen=True, slots=True)
class DisplacedSweep:
    """A sweep whose pictures stand in the wrong place; see `pipeline.registration.misplaced`."""

    name: str
    images: Float32
    tracker_from_image: Float


@dataclass(frozen=True, slots=True)
class Lattice:
    """The pixels that are looked at in pictures of one geometry."""

    at: Integer
    """``(samples, 2)`` columns and rows."""

    smoothing: csr_array
    """``(samples, h * w)``: a Gaussian mean over the sector around each."""

    trend: Float
    """``(samples, columns)``, orthonormal: see `Samples`."""

    brightest: float
    """Largest grey value of the sweep."""

    contact: Contact | None
    """Whether a picture of grey values shows a body, or a probe in air; None for blood."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Smoothed grey values of all frames at points in tracker space, frame after frame."""

    points_mm: Float32
    """``(samples, 3)`` tracker millimetres."""

    grey: Float32
    """``(samples,)``: ranks of grey values, or how far from blood; of mean 0 in each frame, free of
    its trend, of variance 1."""

    trend: Float32
    """``(rows, columns)``: orthonormal in each frame, or 0 beyond its last column; what grey values
    may do for no reason of the heart: gain, fading with depth, shadow, haze of what is bright."""

    trend_row: Integer
    """``(frames,)``: the row of ``trend`` for the frame's first sample; the others follow."""

    first: Integer
    """``(frames + 1,)``: frame k has the samples from ``first[k]`` up to ``first[k + 1]``."""

    phases: Float
    """``(frames,)`` in [0, 1)."""

    number: Integer
    """``(frames,)``: place of the frame in the study, counted through all sweeps."""

    sweep: Integer
    """``(frames,)``: number of the frame's sweep, counted from 0."""

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.phases)


def sample_frames(
    sweeps: Sequence[TrackedSweep],
    phases: Sequence[Float],
    spacing_mm: float,
    smoothing_mm: float,
    trend_mm: float,
) -> Samples:
    """Samples of every frame whose pose is known and whose picture shows a body.

    Parameters
    ----------
    sweeps, phases
        The sweeps and, for each, the ``(n,)`` phases of its frames.
    spacing_mm
        Distance between samples in the plane of a frame.
    smoothing_mm
        Standard deviation of the Gaussian that takes out speckle.
    trend_mm
        What changes over longer ways than this is trend, and is taken out.

    Raises
    ------
    InputError
        When phases do not belong to the frames, a sweep shows no sector, its transform does not
        map pixels to millimetres, or no frame shows a body.
    """
    parts: list[Samples] = []
    offset = 0
    for place, (sweep, own) in enumerate(zip(sweeps, phases, strict=True)):
        _require_sweep(sweep, own)
        lattice = lattice_of(sweep, spacing_mm, smoothing_mm, trend_mm)
        part = sample_pictures(lattice, sweep.images, sweep.tracker_from_image, own)
        parts.append(replace(part, number=part.number + offset, sweep=part.sweep + place))
        offset += len(own)
    if not any(part.frames for part in parts):
        raise UnregistrableError(
            f"none of the {offset} frames shows a body and has a finite pose: all are flat or were "
            "taken in air; was the probe in contact?"
        )
    return _join(parts)


def choose(samples: Samples, frames: Integer) -> Samples:
    """Only the frames ``frames`` (rising), in that order."""
    counts = np.diff(samples.first)[frames]
    first = np.concatenate([[0], np.cumsum(counts)])
    start = np.repeat(samples.first[frames] - first[:-1], counts)
    rows = np.arange(first[-1]) + start
    return Samples(
        samples.points_mm[rows],
        samples.grey[rows],
        samples.trend,
        samples.trend_row[frames],
        first,
        samples.phases[frames],
        samples.number[frames],
        samples.sweep[frames],
    )


def require_transforms(sweep: TrackedSweep) -> None:
    """Refuse pictures that have not a transform each.

    Raises
    ------
    InputError
        When shapes do not fit.
    """
    count = len(sweep.images)
    if sweep.images.ndim != 3 or sweep.tracker_from_image.shape != (count, 4, 4):
        raise InputError(
            f"{sweep.name}: needs images (n, h, w) and transforms (n, 4, 4), got "
            f"{sweep.images.shape} and {sweep.tracker_from_image.shape}"
        )


def _require_sweep(sweep: TrackedSweep, phases: Float) -> None:
    require_transforms(sweep)
    count = len(sweep.images)
    if phases.shape != (count,) or not ((phases >= 0) & (phases < 1)).all():
        raise InputError(
            f"{sweep.name}: needs {count} phases in [0, 1), one a frame, got {phases.shape}"
        )


def lattice_of(
    sweep: TrackedSweep, spacing_mm: float, smoothing_mm: float, trend_mm: float
) -> Lattice:
    """Where in the pictures of a sweep's geometry is looked, and how samples are taken there.

    Lengths as for `sample_frames`.

    Raises
    ------
    InputError
        When the sweep shows no sector, or its transform does not map pixels to millimetres.
    """
    pixel_mm = pixel_size_mm(sweep)
    sector = sector_of(sweep)
    lengths_mm = float(pixel_mm[0]), float(pixel_mm[1]), spacing_mm, smoothing_mm, trend_mm
    places = _places_in(sector.tobytes(), sector.shape, *lengths_mm)
    contact = None if isinstance(sweep, BloodSweep) else Contact.of(sector, pixel_mm)
    return Lattice(*places, float(sweep.images.max()), contact)


@lru_cache(maxsize=8)
def _places_in(
    sector: bytes,
    shape: tuple[int, int],
    width_mm: float,
    height_mm: float,
    spacing_mm: float,
    smoothing_mm: float,
    trend_mm: float,
) -> tuple[Integer, csr_array, Float]:
    """The first three parts of a `Lattice`; a study's sweeps, looked at often, share few."""
    shown, pixel_mm = np.frombuffer(sector, bool).reshape(shape), np.array([width_mm, height_mm])
    at = _lattice(shown, pixel_mm, spacing_mm)
    return at, _smoothing(shown, at, pixel_mm, smoothing_mm), _trend(at * pixel_mm, trend_mm)


def sample_pictures(
    lattice: Lattice, images: Float32, tracker_from_image: Float, phases: Float
) -> Samples:
    """Samples of the pictures ``(n, h, w)`` that show a body at a known pose ``(n, 4, 4)``, as of
    one sweep.

    A sample's grey value is its rank among the frame's: whatever the scanner's curve from echo to
    grey, a few glaring mirrors count for no more than their number. Blood counts as it is, and is
    dark as in grey values.
    """
    seen = (lattice.smoothing @ images.reshape(len(images), -1).T).T
    # A flat picture (a dead frame) has rounding errors for contrast.
    lively = seen.std(axis=1) > 1e-3 * max(lattice.brightest, 1e-30)
    usable = lively & np.isfinite(tracker_from_image).all(axis=(1, 2))
    if lattice.contact is None:
        kept = np.flatnonzero(usable)
        bright = 1 - seen[kept]
    else:
        kept = np.flatnonzero(usable & lattice.contact.touching(images))
        bright = rankdata(seen[kept], axis=1) / len(lattice.at)
    grey = bright - (bright @ lattice.trend) @ lattice.trend.T
    spread = np.maximum(grey.std(axis=1), 1e-9)
    pixels = np.column_stack([lattice.at, np.zeros(len(lattice.at)), np.ones(len(lattice.at))])
    points = np.einsum("fij,sj->fsi", tracker_from_image[kept, :3], pixels)
    first = np.zeros(len(kept), dtype=np.int64)
    return Samples(
        points.reshape(-1, 3).astype(np.float32),
        (grey / spread[:, None]).reshape(-1).astype(np.float32),
        lattice.trend.astype(np.float32),
        first,
        np.arange(len(kept) + 1) * len(lattice.at),
        phases[kept],
        kept,
        first,
    )


def pixel_size_mm(sweep: TrackedSweep) -> Float:
    """``(2,)`` width and height of a pixel.

    Raises
    ------
    InputError
        When no pose is finite, or pixels are not of one size above 0 in all frames, to a hundredth.
    """
    axes = sweep.tracker_from_image[:, :3, :2]
    usable = axes[np.isfinite(sweep.tracker_from_image).all(axis=(1, 2))]
    if len(usable) == 0:
        raise InputError(f"{sweep.name}: no frame has a finite pose; was the probe tracked?")
    size_mm = np.linalg.norm(usable, axis=1)
    middle = np.median(size_mm, axis=0)
    if not np.allclose(size_mm, middle, rtol=1e-2) or not (middle > 0).all():
        raise InputError(
            f"{sweep.name}: pixels measure from {size_mm.min():.4g} to {size_mm.max():.4g} mm; "
            "needs one size above 0 for all frames: is ImageToProbe right?"
        )
    return np.asarray(middle)


def sector_of(sweep: TrackedSweep) -> Mask:
    """Where the sweep shows echoes, ``(h, w)``; dark blood inside counts as shown.

    Raises
    ------
    UnregistrableError
        When that is hardly anywhere.
    """
    if isinstance(sweep, BloodSweep):
        return sweep.sector
    sector = shown_sector(sweep.images)
    if sector.mean() < 0.02:
        raise UnregistrableError(
            f"{sweep.name}: only {sector.mean():.1%} of the pixels ever show anything; "
            "needs grey values with a sector in view"
        )
    return sector


def _lattice(sector: Mask, pixel_mm: Float, spacing_mm: float) -> Integer:
    """Columns and rows of the pixels that are looked at, ``(samples, 2)``."""
    step = np.maximum(1, np.round(spacing_mm / pixel_mm)).astype(int)
    rows, columns = np.mgrid[
        step[1] // 2 : sector.shape[0] : step[1], step[0] // 2 : sector.shape[1] : step[0]
    ]
    inside = sector[rows, columns]
    return np.stack([columns[inside], rows[inside]], axis=1)


def _smoothing(sector: Mask, at: Integer, pixel_mm: Float, sigma_mm: float) -> csr_array:
    """Gaussian means over the sector around each lattice point, ``(samples, h * w)``."""
    reach = np.ceil(2.5 * sigma_mm / pixel_mm).astype(int)
    di, dj = np.meshgrid(
        np.arange(-reach[0], reach[0] + 1), np.arange(-reach[1], reach[1] + 1), indexing="xy"
    )
    weight = np.exp(-0.5 * ((di * pixel_mm[0]) ** 2 + (dj * pixel_mm[1]) ** 2) / sigma_mm**2)
    i = at[:, 0, None] + di.ravel()
    j = at[:, 1, None] + dj.ravel()
    height, width = sector.shape
    inside = (i >= 0) & (i < width) & (j >= 0) & (j < height)
    inside &= sector[np.clip(j, 0, height - 1), np.clip(i, 0, width - 1)]
    weights = np.where(inside, weight.ravel(), 0)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(at)), weights.shape[1])[inside.ravel()]
    columns = (j * width + i)[inside]
    shape = (len(at), height * width)
    return csr_array((weights[inside].astype(np.float32), (rows, columns)), shape=shape)


def _trend(position_mm: Float, shortest_mm: float) -> Float:
    """Orthonormal columns that span the cosines in the plane of the frame that go from crest to
    trough in no less than ``shortest_mm``."""
    size_mm = np.maximum(np.ptp(position_mm, axis=0), 1e-9)
    most = size_mm / shortest_mm
    x, y = np.pi * ((position_mm - position_mm.min(axis=0)) / size_mm).T
    columns = [
        np.cos(i * x) * np.cos(j * y)
        for i in range(int(most[0]) + 1)
        for j in range(int(most[1]) + 1)
        if np.hypot(i / most[0], j / most[1]) <= 1
    ]
    return np.asarray(np.linalg.qr(np.stack(columns, axis=1))[0])


def _join(parts: Sequence[Samples]) -> Samples:
    """The samples of several sweeps, one after the other."""
    counts = np.concatenate([np.diff(part.first) for part in parts])
    columns = max(part.trend.shape[1] for part in parts)
    trends = [np.pad(p.trend, ((0, 0), (0, columns - p.trend.shape[1]))) for p in parts]
    rows = np.cumsum([0, *(len(trend) for trend in trends[:-1])])
    return Samples(
        np.concatenate([part.points_mm for part in parts]),
        np.concatenate([part.grey for part in parts]),
        np.concatenate(trends),
        np.concatenate([p.trend_row + row for p, row in zip(parts, rows, strict=True)]),
        np.concatenate([[0], np.cumsum(counts)]),
        np.concatenate([part.phases for part in parts]),
        np.concatenate([part.number for part in parts]),
        np.concatenate([part.sweep for part in parts]),
    )
