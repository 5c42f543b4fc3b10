"""Write what is known of a phantom: meshes, labels, times and transforms."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.ecg import write_annotations
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.measures import MUSCLE_G_ML
from data_synth.meshes import Mesh, enclosed_ml
from data_synth.mr import SyntheticCine
from data_synth.simulate import SyntheticStudy
from data_synth.ultrasound import Sweep

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
CHAMBERS = {
    "left_ventricle": "lv_endocardium",
    "right_ventricle": "rv_endocardium",
    "left_atrium": "left_atrium",
    "right_atrium": "right_atrium",
}
"""Chamber -> truth mesh that encloses its cavity."""


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
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    vertices_mm, triangles = mesh
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(
        pyvista.PolyData.from_regular_faces(vertices_mm.astype(np.float32), triangles)
    )
    writer.SetDataModeToBinary()
    # Into a file of its own the library does not say that a disk is full, and may end the process.
    writer.WriteToOutputStringOn()
    writer.Write()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(writer.GetOutputString())


def write_truth(
    folder: Path, study: SyntheticStudy, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write truth.json, surfaces, labels and the ECG's beats into ``folder``.

    Meshes are written at the cine's phases, labels on its pixels. ``progress`` is told (phases
    done, phases in all).
    """
    cine = study.cine
    volumes: dict[str, list[float]] = {}
    for k, phase in enumerate(cine.phases):
        surfaces = study.heart.surfaces(float(phase))
        for name, mesh in surfaces.items():
            write_mesh(folder / "surfaces" / f"{name}_{k:03d}.vtp", mesh)
        for name, volume in enclosed_ml(surfaces).items():
            volumes.setdefault(name, []).append(volume)
        write_nifti(folder / f"labels_{k:03d}.nii.gz", cine.labels[k], cine.mr_from_index)
        if progress:
            progress(k + 1, len(cine.phases))
    for name, view in study.views.items():
        for k, labels in enumerate(view.labels):
            path = folder / "long_axis" / f"{name}_{k:03d}.nii.gz"
            write_nifti(path, labels, view.mr_from_index)
    write_json(folder / "truth.json", _described(study, volumes) | _recorded(folder, study))


def _described(study: SyntheticStudy, volumes: dict[str, list[float]]) -> dict[str, Any]:
    """Entries about the patient and the images."""
    settings, heart, cine = study.settings, study.heart, study.cine
    return {
        "seed": settings.seed,
        "settings": settings.model_dump(mode="json"),
        "pathology": settings.pathology,
        "phases": cine.phases.tolist(),
        "rr_ms": cine.rr_ms.tolist(),
        "mechanical_phases": mechanical_phases(heart, cine).tolist(),
        "slice_shifts_mm": cine.shifts_mm.tolist(),
        "long_axis": {name: _view(heart, view) for name, view in study.views.items()},
        "volumes_ml": volumes,
        "chambers": chamber_function(heart),
        "lv_mass_g": MUSCLE_G_ML * volumes["lv_myocardium"][0],
        "mr_from_heart": np.array(heart.mr_from_heart).tolist(),
    }


def _view(heart: BeatingHeart, view: SyntheticCine) -> dict[str, Any]:
    return {
        "rr_ms": float(view.rr_ms[0]),
        "shift_mm": view.shifts_mm[0].tolist(),
        "mechanical_phases": mechanical_phases(heart, view)[0].tolist(),
    }


def mechanical_phases(heart: BeatingHeart, cine: SyntheticCine) -> Float:
    """``(z, phase)``: phase of the truth meshes' cycle that each image shows.

    It differs from the image's own phase where the slice's RR interval is not the heart's nominal
    one, for systole keeps its duration.
    """
    rows = [
        [heart.nominal_phase(float(phase), rr_ms / 1000) for phase in cine.phases]
        for rr_ms in cine.rr_ms
    ]
    return np.array(rows)


def chamber_function(heart: BeatingHeart) -> dict[str, dict[str, float]]:
    """Largest and smallest volume of each chamber (ml), and the share that it empties.

    Ventricles are fullest at the R peak and emptiest at end-systole, atria the reverse.
    """
    at_r, at_end_systole = heart.volumes_ml(0.0), heart.volumes_ml(heart.pulse.end_systole)
    function = {}
    for chamber, name in CHAMBERS.items():
        smallest, largest = sorted((at_r[name], at_end_systole[name]))
        function[chamber] = {
            "largest_ml": largest,
            "smallest_ml": smallest,
            "ejection_fraction": 1 - smallest / largest,
        }
    return function


def _recorded(folder: Path, study: SyntheticStudy) -> dict[str, Any]:
    """Entries about ECG and ultrasound; writes the beats as WFDB annotations beside."""
    if study.us_ecg is None:
        return {}
    ecgs = {"mr": study.mr_ecg, "us": study.us_ecg}
    for name, ecg in ecgs.items():
        write_annotations(folder / "ecg", name, ecg)
    return {
        "r_times_s": {name: ecg.r_times_s.tolist() for name, ecg in ecgs.items()},
        "beat_kinds": {name: list(ecg.kinds) for name, ecg in ecgs.items()},
        "lost_leads": {
            name: [one.model_dump(mode="json") for one in ecg.lost] for name, ecg in ecgs.items()
        },
        "mr_from_tracker": study.sweeps[0].mr_from_tracker.tolist(),
        "us_clock_offset_s": study.sweeps[0].clock_offset_s,
        "us_image_to_probe": study.sweeps[0].true_image_to_probe.tolist(),
        "us_frames": {sweep.name: _frames(sweep) for sweep in study.sweeps},
    }


def _frames(sweep: Sweep) -> dict[str, Any]:
    return {
        "times_s": sweep.times_s.tolist(),
        "ecg_times_s": sweep.true_times_s.tolist(),
        "phases": sweep.phases.tolist(),
        "mechanical_phases": sweep.nominal_phases.tolist(),
        "heart_shift_mm": sweep.displacement_mm.tolist(),
        "mr_from_image": mr_from_image(sweep).tolist(),
        "outlier": sweep.outlier.tolist(),
        "lost": sweep.lost.tolist(),
        "untracked": sweep.untracked.tolist(),
    }


def mr_from_image(sweep: Sweep) -> Float:
    """``(frames, 4, 4)`` true LPS mm from pixel ``(i, j, 0)`` of each frame."""
    from_probe = sweep.mr_from_tracker @ sweep.true_probe_to_tracker
    return np.asarray(from_probe @ sweep.true_image_to_probe)
