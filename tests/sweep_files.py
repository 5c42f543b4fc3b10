"""Sweeps as PLUS writes them, small and right, to be spoilt by tests."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

FRAMES, ROWS, COLUMNS = 5, 12, 17
PIXELS = np.random.default_rng(0).integers(0, 256, (FRAMES, ROWS, COLUMNS)).astype(np.uint8)


def rigid(k):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1 * k, 0.3, -0.2]).as_matrix()
    pose[:3, 3] = [100.0 + k, -50.0, 3.0 * k]
    return pose


def calibration(pixel_mm=0.5):
    matrix = rigid(2)
    matrix[:3, :3] *= pixel_mm
    return matrix


def text(matrix):
    return " ".join(f"{value:.17g}" for value in np.asarray(matrix).ravel())


def good_fields():
    fields = {}
    for k in range(FRAMES):
        start = f"Seq_Frame{k:04d}_"
        fields[start + "Timestamp"] = f"{3.0 + 0.05 * k}"
        fields[start + "ImageStatus"] = "OK"
        fields[start + "ProbeToTrackerTransform"] = text(rigid(k))
        fields[start + "ProbeToTrackerTransformStatus"] = "OK"
        fields[start + "ImageToProbeTransform"] = text(calibration())
        fields[start + "ImageToProbeTransformStatus"] = "OK"
    return fields


def write(path, fields, pixels=PIXELS, vector=False, compress=False):
    image = sitk.GetImageFromArray(pixels, isVector=vector)
    for key, value in fields.items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), useCompression=compress)
    return path
