"""Cines of the phantom: without noise or faults, which voxels hold one tissue, what labels miss."""

import numpy as np
from scipy.ndimage import binary_erosion

from data_synth.mr import MrSettings
from pipeline.imaging.cine import Cine

CLEAN = MrSettings(
    phases=3,
    slices=6,
    slice_gap_mm=12.0,
    pixel_mm=2.0,
    matrix=110,
    snr=1e6,
    coil_shading=0.0,
    inhomogeneity=0.0,
    inflow=0.0,
    flow_dephasing=0.0,
    breath_hold_shift_mm=0.0,
    planning_error_deg=0.0,
    window_samples=1,
    sharpness_pixels=0.0,
)


QUICK = {"slices": 3, "slice_gap_mm": 20.0, "matrix": 64, "pixel_mm": 3.0}


def changed(**changes: object) -> MrSettings:
    return MrSettings.model_validate({**CLEAN.model_dump(), **changes})


def as_cine(made, count=None):
    """As the pipeline reads it, a beat of 0.8 s; of the first ``count`` phases alone."""
    phases = np.arange(len(made.intensity)) / len(made.intensity)
    intensity = made.intensity[:count].astype(np.float32)
    return Cine(intensity, made.mr_from_index, phases[:count], 0.8)


def dice(found, truth):
    return 2 * (found & truth).sum() / max(found.sum() + truth.sum(), 1)


def tissue_map(heart, found, k, z, depth_mm=0.0):
    """Tissue (y, x) at a depth of one slice's voxels; for cines without shifts or tilts."""
    rows, columns = found.labels.shape[2:]
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    frame = found.mr_from_index
    index = np.stack([x, y, np.full(x.size, z + depth_mm / found.slice_step_mm)], axis=1)
    points = index @ frame[:3, :3].T + frame[:3, 3]
    return heart.tissue(points, float(found.phases[k])).reshape(rows, columns)


def pure(heart, found, z, tissue, k=0):
    """Pixels (y, x) that hold one tissue alone, through the slice and one pixel around."""
    maps = [tissue_map(heart, found, k, z, depth) == tissue for depth in np.linspace(-5, 5, 6)]
    return binary_erosion(np.logical_and.reduce(maps), np.ones((3, 3)))
