"""Write what is known of a phantom: meshes, labels, times and transforms."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.meshes import Mesh, enclosed_ml
from data_synth.mr import SyntheticCine

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def write_json(path: Path, content: Any) -> None:
    """Write JSON with sorted keys; floats keep all their digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")


def write_nifti(path: Path, array: Any, mr_from_index: Float, step_s: float = 0.0) -> None:
    """Write ``(z, y, x)`` or ``(phase, z, y, x)`` values as compressed NIfTI, without a date.

    NIfTI's own frame is RAS with the first index fastest; the axes and signs are turned here.
    """
    import nibabel

    image = nibabel.Nifti1Image(np.ascontiguousarray(array.T), RAS_FROM_LPS @ mr_from_index)
    image.header.set_xyzt_units("mm", "sec")
    image.set_qform(image.affine, code=1)
    image.set_sform(image.affine, code=1)
    if array.ndim == 4:
        image.header["pixdim"][4] = step_s
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(image.to_bytes(), compresslevel=6, mtime=0))


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write one mesh as VTK XML PolyData, LPS mm; float32 rounds by 1e-5 mm at most."""
    import pyvista

    path.parent.mkdir(parents=True, exist_ok=True)
    vertices_mm, triangles = mesh
    surface = pyvista.PolyData.from_regular_faces(vertices_mm.astype(np.float32), triangles)
    surface.save(str(path), binary=True)


def write_truth(
    folder: Path,
    heart: BeatingHeart,
    cine: SyntheticCine,
    extra: dict[str, Any],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write truth.json, surfaces and labels into ``folder``.

    Parameters
    ----------
    folder
        Made if missing.
    heart
        The phantom.
    cine
        Its images: labels are written on their pixels, meshes at their phases.
    extra
        Further entries of truth.json, such as seed, transforms and R times.
    progress
        Told (phases done, phases in all).
    """
    volumes: dict[str, list[float]] = {}
    for k, phase in enumerate(cine.phases):
        surfaces = heart.surfaces(float(phase))
        for name, mesh in surfaces.items():
            write_mesh(folder / "surfaces" / f"{name}_{k:03d}.vtp", mesh)
        for name, volume in enclosed_ml(surfaces).items():
            volumes.setdefault(name, []).append(volume)
        write_nifti(folder / f"labels_{k:03d}.nii.gz", cine.labels[k], cine.mr_from_index)
        if progress:
            progress(k + 1, len(cine.phases))
    content = {
        "phases": cine.phases.tolist(),
        "rr_ms": cine.rr_ms.tolist(),
        "slice_shifts_mm": cine.shifts_mm.tolist(),
        "volumes_ml": volumes,
        "mr_from_heart": np.array(heart.mr_from_heart).tolist(),
    }
    write_json(folder / "truth.json", content | extra)
