"""Error of the main field that lungs and air put into the chest, after shimming on the heart."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates

from data_synth.bssfp import PROTON_HZ_PER_T
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.protocol import MrSettings
from data_synth.tissue import Tissue

SPACING_MM = 5.0
SMOOTHING_MM = 4.0
"""Standard deviation by which the borders of the grid's cells are blurred before the field."""
HALF_MM = np.array([240.0, 190.0, 240.0])
"""Half of the box around the middle of the body in which the field is worked out."""
TISSUE_PPM, LUNG_PPM, AIR_PPM = -9.05, -4.0, 0.36
"""Volume susceptibility (SI): water and soft tissue, lungs, air.

Water and air: Schenck, Med. Phys. 23:815-850 (1996). Lungs: about -4 by Maniewski et al. (1988),
whom "Magnetic mapping of DC fields related to tissue susceptibility in the human body" (1989)
quotes. With these, the error over the left muscle spans about what Kellman et al., J. Cardiovasc.
Magn. Reson. 15:63 (2013), measured in people: 62 Hz at 1.5 T and 125 Hz at 3 T.
"""
SHIM_RADIUS_MM = 65.0
"""Radius of the ball about the middle of the heart on which the scanner shims."""


class FieldMap(NamedTuple):
    """Field error on a grid."""

    ppm: npt.NDArray[np.float32]
    """``(x, y, z)``, parts per million of the main field."""
    low_mm: Float
    """LPS place of the first node."""


def dipole_field_ppm(susceptibility_ppm: Float) -> Float:
    """Field error along z inside a body of the given susceptibility on a regular (x, y, z) grid.

    Convolution with the dipole (Lorentz-corrected) in Fourier space, ``1/3 - kz^2 / k^2``
    (Salomir et al., Concepts Magn. Reson. 19B:26-34, 2003; Marques and Bowtell, Concepts Magn.
    Reson. 25B:65-78, 2005). The body repeats beyond the grid.
    """
    kx, ky, kz = np.meshgrid(
        *(np.fft.fftfreq(n) for n in susceptibility_ppm.shape[:2]),
        np.fft.rfftfreq(susceptibility_ppm.shape[2]),
        indexing="ij",
    )
    squared = kx**2 + ky**2 + kz**2
    squared[0, 0, 0] = 1.0
    kernel = 1 / 3 - kz**2 / squared
    kernel[0, 0, 0] = 0.0
    spectrum = np.fft.rfftn(susceptibility_ppm) * kernel
    return np.asarray(np.fft.irfftn(spectrum, susceptibility_ppm.shape, axes=(0, 1, 2)))


def shim(field: Float, points_mm: Float, inside: npt.NDArray[np.bool_]) -> Float:
    """Field less the second-order polynomial of place that fits it best where ``inside``.

    ``points_mm`` are (..., 3) about the shim's centre; scanners reach second order.
    """
    x, y, z = np.moveaxis(points_mm, -1, 0) / SHIM_RADIUS_MM
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, x * z], -1)
    weights = np.linalg.lstsq(terms[inside], field[inside], rcond=None)[0]
    return np.asarray(field - terms @ weights)


@lru_cache(maxsize=4)
def field_map(heart: BeatingHeart) -> FieldMap:
    """Field error of a chest with its heart at the R peak, shimmed on the heart."""
    axes = [np.arange(-half, half, SPACING_MM) for half in HALF_MM]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    tissue = heart.tissue(points.reshape(-1, 3), 0.0).reshape(points.shape[:3])
    ppm = np.full(len(Tissue), TISSUE_PPM)
    ppm[Tissue.LUNG] = LUNG_PPM
    ppm[[Tissue.AIR, Tissue.GAS]] = AIR_PPM
    field = dipole_field_ppm(gaussian_filter(ppm[tissue], SMOOTHING_MM / SPACING_MM))
    off = points - middle_mm(heart)
    inside = np.linalg.norm(off, axis=-1) < SHIM_RADIUS_MM
    wet = inside & (tissue != Tissue.LUNG) & (tissue != Tissue.AIR) & (tissue != Tissue.GAS)
    return FieldMap(shim(field, off, wet).astype(np.float32), points[0, 0, 0])


def middle_mm(heart: BeatingHeart) -> Float:
    """Middle of the left ventricle's long axis, LPS."""
    return np.asarray(heart.centre_mm - heart.long_axis * heart.shape.lv_length / 2)


def off_resonance_hz(heart: BeatingHeart, settings: MrSettings, points_mm: Float) -> Float:
    """Frequency error (n,) of water at LPS points (n, 3)."""
    error = np.full(len(points_mm), settings.shim_error_hz)
    off_cm = (points_mm[:, 0] - middle_mm(heart)[0]) / 10
    error += settings.shim_error_hz_per_cm * off_cm
    if settings.inhomogeneity > 0:
        known = field_map(heart)
        place = ((points_mm - known.low_mm) / SPACING_MM).T
        ppm = map_coordinates(known.ppm, place, order=1, mode="nearest")
        error += settings.inhomogeneity * ppm * settings.field_strength_t * PROTON_HZ_PER_T * 1e-6
    return error
