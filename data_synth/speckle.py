"""Scatterers that belong to the tissue: the same material point echoes alike in every frame.

Space at rest is divided into small cells, each with a complex Gaussian echo of its own. A sample
of the picture hears the cells across the thickness of the beam and between its neighbours. So
speckle travels with the tissue, and changes as the plane leaves the tissue that it showed: by
``exp(-d^2 / (4 s^2))`` after a way d across a beam of width s (Wagner, Smith, Sandrik and Lopez,
"Statistics of speckle in ultrasound B-scans", IEEE Trans Sonics Ultrason 30, 1983, 156-163).

At 20 frames a second a fan that turns by 110 degrees in 2 s moves on by 2 mm between two frames,
40 mm beside its axis: there some 40 % of the likeness is lost. On the axis next to none is, and
speckle goes with the wall. Blood flows by centimetres in that time; its echoes are drawn anew in
every frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from data_synth.echo import Optics
from data_synth.kernels import Float, asked, inner
from data_synth.sector import Sector

Complex = npt.NDArray[np.complex128]

TABLE_BITS = 14
"""The cells share 2^14 values: two neighbours are alike once in 16 thousand."""


@dataclass(frozen=True, slots=True)
class Scatterers:
    """Echoes of all the cells of space at rest."""

    cell_mm: float
    """Edge of a cell."""

    echoes: Complex
    """``(2^14,)`` of mean power 1; each cell picks one by its number."""


def draw_scatterers(rng: np.random.Generator, cell_mm: float) -> Scatterers:
    """Scatterers of one body."""
    real, imaginary = rng.normal(scale=np.sqrt(0.5), size=(2, 1 << TABLE_BITS))
    return Scatterers(cell_mm, np.asarray(real + 1j * imaginary))


@inner
def cell_number(x: float, y: float, z: float) -> int:
    """Number of the cell that holds a point given in cells, well mixed."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    mixed = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    mixed = ((mixed & 0xFFFFFFFF) * 2654435761) & 0xFFFFFFFF
    mixed ^= mixed >> 15
    return int(mixed >> 3) & ((1 << TABLE_BITS) - 1)


@asked
def gather(
    places: Float, beside: Float, across: Float, offsets: Float, weights: Float, echoes: Complex
) -> Complex:
    """Sum of the cells that each sample hears.

    Parameters
    ----------
    places
        ``(ranges, beams, 3)`` samples at rest, in cells.
    beside, across
        ``(ranges, beams, 3)`` how the place at rest changes with a way of 1 mm across the beam,
        within the picture's plane and out of it.
    offsets, weights
        ``(ranges, n, 2)`` ways of the parts of a beam (beside, across) in mm; ``(ranges, n)``.
    echoes
        As in :class:`Scatterers`.
    """
    ranges, beams, _ = places.shape
    heard = np.empty((ranges, beams), np.complex128)
    for r in range(ranges):
        for b in range(beams):
            total = 0j
            for n in range(offsets.shape[1]):
                u, v = offsets[r, n, 0], offsets[r, n, 1]
                x = places[r, b, 0] + u * beside[r, b, 0] + v * across[r, b, 0]
                y = places[r, b, 1] + u * beside[r, b, 1] + v * across[r, b, 1]
                z = places[r, b, 2] + u * beside[r, b, 2] + v * across[r, b, 2]
                total += weights[r, n] * echoes[cell_number(x, y, z)]
            heard[r, b] = total
    return heard


@dataclass(frozen=True, slots=True)
class Hearing:
    """Which parts of a beam each sample hears, and how loudly, by range."""

    offsets_mm: Float
    """``(ranges, n, 2)`` across the beam, within the picture's plane and out of it."""

    weights: Float
    """``(ranges, n)``; such that the echo has mean power 1 once it is blurred by the beam."""


def hearing(sector: Sector, optics: Optics, slice_mm: Float, cell_mm: float) -> Hearing:
    """Parts of the beam for every range of a sector; ``slice_mm`` (ranges,) is its thickness."""
    beside = np.arange(-1, 2) / 3
    across = np.linspace(-2, 2, 9)
    grid = np.stack(np.meshgrid(beside, across, indexing="ij"), axis=-1).reshape(-1, 2)
    spacing_mm = sector.ranges_mm * (sector.angles_rad[1] - sector.angles_rad[0])
    offsets_mm = grid * np.stack([spacing_mm, slice_mm], axis=-1)[:, None, :]
    weights = np.exp(-0.25 * grid[:, 1] ** 2)
    # Power changes slowly with range: worked out at some ranges, interpolated between them.
    some = np.unique(np.geomspace(1, len(sector.ranges_mm), 24).astype(int) - 1)
    power = [_power_after_blur(offsets_mm[r], weights, r, sector, optics, cell_mm) for r in some]
    scale = 1 / np.sqrt(np.interp(np.arange(len(sector.ranges_mm)), some, power))
    return Hearing(offsets_mm, scale[:, None] * weights)


def _power_after_blur(
    offsets_mm: Float, weights: Float, r: int, sector: Sector, optics: Optics, cell_mm: float
) -> float:
    """Mean power of the blurred sum of the cells: neighbours that share cells add up.

    The blur multiplies the correlation of samples ``(m, k)`` apart, along and across the beams,
    by the correlation of its own profile, ``exp(-d^2 / (4 s^2))``, and sums.
    """
    step_rad = sector.angles_rad[1] - sector.angles_rad[0]
    width_rad = min(float(optics.beam_rad(sector.ranges_mm[r : r + 1])[0]), 0.15)
    spacing_mm = float(sector.ranges_mm[r]) * step_rad
    reach = int(min(np.ceil(2 * cell_mm / spacing_mm), np.ceil(5 * width_rad / step_rad))) + 1
    across, along = np.arange(-reach, reach + 1), np.arange(-3, 4)
    apart = offsets_mm[:, None] - offsets_mm[None]
    pair = (weights[:, None] * weights[None]).ravel()
    flat, out = apart[..., 0].ravel(), apart[..., 1].ravel()
    distances = np.arange(0, 1.8, 0.02)
    table = likeness(distances)
    power = 0.0
    for m in along:
        pulse = np.exp(-0.25 * (m * sector.range_step_mm / optics.pulse_mm) ** 2)
        for k in across:
            beam = np.exp(-0.25 * (k * step_rad / width_rad) ** 2)
            distance = np.hypot(np.hypot(flat + k * spacing_mm, out), m * sector.range_step_mm)
            alike = np.interp(distance / cell_mm, distances, table, right=0.0)
            power += float(pulse * beam * (pair @ alike))
    return power


def likeness(distance_cells: Float) -> Float:
    """Correlation of two samples of the cells, a distance apart in any direction alike.

    The mean over directions of the chance that both fall into the same cell, for cells that lie
    at random: ``(1 - |dx|)(1 - |dy|)(1 - |dz|)``, up to 1 cell along each axis.
    """
    z, azimuth = np.meshgrid((np.arange(12) + 0.5) / 12, (np.arange(24) + 0.5) / 24 * np.pi / 2)
    flat = np.sqrt(1 - z**2)
    towards = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    apart = np.asarray(distance_cells, float)[..., None, None] * towards
    return np.asarray(np.clip(1 - apart, 0, None).prod(axis=-1).mean(axis=-1))
