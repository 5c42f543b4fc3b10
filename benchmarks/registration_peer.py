"""The yardstick: mutual information with SimpleITK, as its users write it.

The gated end-diastolic frames are compounded into a volume, and that volume is registered rigidly
to an MR volume of the same phase, from coarse to fine. It is given what real scans would not give:
an isotropic MR volume without partial volume or slice shifts, in the phantom's own tissues.
"""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk

from data_synth.heart import BeatingHeart
from data_synth.tissue import Tissue
from pipeline.geometry import Float

SPACING_MM = 2.0
HALF_MM = 80.0
GATE = 0.1
"""Share of the beat, before and after the R peak, whose frames are compounded."""

# Balanced SSFP at 1.5 T: bright blood and fat, grey muscle, dark lung and air.
_BRIGHT = {Tissue.FAT: 0.9, Tissue.LUNG: 0.05, Tissue.AIR: 0.0, Tissue.GAS: 0.0, Tissue.BONE: 0.3}
_BLOOD = (
    Tissue.BLOOD_VESSEL,
    Tissue.LV_CAVITY,
    Tissue.RV_CAVITY,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.AORTA,
)
_MUSCLE = 0.35


def mr_volume(heart: BeatingHeart, rng: np.random.Generator, snr: float = 20.0) -> sitk.Image:
    """An MR volume around the heart at the R peak, ``SPACING_MM`` cubes, with Rician noise."""
    count = int(2 * HALF_MM / SPACING_MM) + 1
    axis = np.arange(count) * SPACING_MM - HALF_MM
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points_mm = np.stack([x, y, z], axis=-1).reshape(-1, 3) + heart.centre_mm
    grey = np.full(max(Tissue) + 1, _MUSCLE)
    for tissue, value in _BRIGHT.items():
        grey[tissue] = value
    grey[list(_BLOOD)] = 1.0
    signal = grey[heart.tissue(points_mm, 0.0)]
    real, imaginary = rng.normal(scale=1 / snr, size=(2, len(signal)))
    volume = np.hypot(signal + real, imaginary).reshape(count, count, count)
    image = sitk.GetImageFromArray(volume.astype(np.float32))
    image.SetSpacing([SPACING_MM] * 3)
    image.SetOrigin((heart.centre_mm - HALF_MM).tolist())
    return image


def compounded(
    images: list[Float], poses: list[Float], phases: list[Float]
) -> tuple[sitk.Image, sitk.Image]:
    """Mean grey value of the gated frames in each cell of tracker space, and where there is any."""
    points, values = [], []
    for sweep, own, at in zip(images, poses, phases, strict=True):
        rows, columns = np.nonzero(sweep.max(axis=0) > 0)
        pixels = np.stack([columns, rows, 0 * rows, 0 * rows + 1])
        for k in np.flatnonzero((at < GATE) | (at > 1 - GATE)):
            points.append((own[k] @ pixels)[:3].T)
            values.append(sweep[k][rows, columns])
    if not points:
        raise ValueError("no frame lies within the gate")
    cloud, grey = np.concatenate(points), np.concatenate(values)
    lower = cloud.min(axis=0)
    cell = np.floor((cloud - lower) / SPACING_MM).astype(int)
    shape = tuple(int(n) for n in cell.max(axis=0)[::-1] + 1)
    flat = np.ravel_multi_index((cell[:, 2], cell[:, 1], cell[:, 0]), shape)
    counts = np.bincount(flat, minlength=int(np.prod(shape)))
    total = np.bincount(flat, grey, minlength=int(np.prod(shape)))
    mean = (total / np.maximum(counts, 1)).reshape(shape).astype(np.float32)
    both = [sitk.GetImageFromArray(mean)]
    both.append(sitk.GetImageFromArray((counts > 0).reshape(shape).astype(np.uint8)))
    for image in both:
        image.SetSpacing([SPACING_MM] * 3)
        image.SetOrigin((lower + SPACING_MM / 2).tolist())
    return both[0], both[1]


def mutual_information(
    fixed: sitk.Image, mask: sitk.Image, moving: sitk.Image, start: Float, centre_mm: Float
) -> Float:
    """``mr_from_tracker`` by Mattes' mutual information over three resolutions."""
    transform = sitk.Euler3DTransform()
    transform.SetCenter(np.linalg.solve(start, [*centre_mm, 1])[:3].tolist())
    transform.SetMatrix(start[:3, :3].ravel().tolist(), 1e-6)
    middle = np.array(transform.GetCenter())
    transform.SetTranslation((start[:3, :3] @ middle + start[:3, 3] - middle).tolist())
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(numberOfHistogramBins=50)
    method.SetMetricFixedMask(mask)
    method.SetMetricSamplingStrategy(method.RANDOM)
    method.SetMetricSamplingPercentage(0.2, seed=1)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=1.0, minStep=1e-3, numberOfIterations=200
    )
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel([4, 2, 1])
    method.SetSmoothingSigmasPerLevel([4, 2, 1])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    method.SetInitialTransform(transform, inPlace=True)
    method.Execute(sitk.Cast(fixed, sitk.sitkFloat32), sitk.Cast(moving, sitk.sitkFloat32))
    found = np.eye(4)
    found[:3, :3] = np.array(transform.GetMatrix()).reshape(3, 3)
    middle = np.array(transform.GetCenter())
    found[:3, 3] = np.array(transform.GetTranslation()) + middle - found[:3, :3] @ middle
    return found
