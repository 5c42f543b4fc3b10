"""Write a whole synthetic study: cine MR, ECG, tracked ultrasound and the truth about them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from data_synth.dicom import write_dicom
from data_synth.ecg import EcgSignal, simulate_ecg, write_wfdb
from data_synth.errors import SynthError
from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.mr import SyntheticCine, acquire_cine, count_slices
from data_synth.population import draw_heart
from data_synth.settings import PhantomSettings
from data_synth.truth import write_json, write_nifti, write_truth
from data_synth.ultrasound import Sweep, simulate_sweeps, write_sweep

Progress = Callable[[int, int], None]

BREATH_HOLD_S = 7.0
"""Time from one slice's acquisition to the next."""
SWEEP_PAUSE_S = 3.0
"""Time between two ultrasound sweeps that the recorded ECG has to leave room for."""
START_MM, START_DEG = 10.0, 10.0
"""How far the first guess of the tracker's place is from the truth."""
HEART, MR_ECG, CINE, ULTRASOUND_ECG, ULTRASOUND, START = range(6)
"""Numbers of the random streams: each part of a study draws from its own."""


def stream(settings: PhantomSettings, part: int) -> np.random.Generator:
    """Random numbers of one part of a study, whatever the other parts draw."""
    return np.random.default_rng([settings.seed, part])


def write_study(
    folder: Path,
    settings: PhantomSettings,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> None:
    """Write one study into ``folder``, whole or not at all.

    Parameters
    ----------
    folder
        The patient's own folder; it must not exist unless ``overwrite``.
    settings
        The patient.
    progress
        Told (parts done, parts in all).
    overwrite
        Replace what is there once the new study is complete.

    Raises
    ------
    SynthError
        When the folder exists or cannot be written.
    """
    require_free(folder, overwrite)
    with publishing(folder) as partial:
        _write_parts(partial, settings, progress)


def require_free(folder: Path, overwrite: bool) -> None:
    """Raise SynthError when something is in the way and must not be replaced."""
    if folder.exists() and not overwrite:
        raise SynthError(f"{folder}: exists; choose another folder or give --overwrite")
    if folder.exists() and not (folder / "study.yaml").is_file():
        raise SynthError(f"{folder}: is no study, so it is not overwritten; choose another folder")


def _write_parts(folder: Path, settings: PhantomSettings, progress: Progress | None) -> None:
    heart = draw_heart(stream(settings, HEART), settings.spread)
    slices = count_slices(heart, settings.mr)
    ecg = _ecg(settings, MR_ECG, slices * BREATH_HOLD_S)
    rr_ms = slice_rr_ms(ecg.r_times_s, slices)
    cine = acquire_cine(stream(settings, CINE), heart, rr_ms, settings.mr, share(progress, 0, 45))
    contents: dict[str, Any] = {"patient_id": settings.patient_id}
    contents["cine"] = _write_cine(folder, settings, cine)
    truth: dict[str, Any] = {"seed": settings.seed, "settings": settings.model_dump(mode="json")}
    if not settings.cine_only:
        write_wfdb(folder / "ecg", "mr", ecg)
        known, described = _write_ultrasound(folder, settings, heart, share(progress, 45, 75))
        contents |= {"ecg": {"mr": "ecg/mr", "us": "ecg/us"}, "us": described}
        truth |= known
        truth["r_times_s"]["mr"] = ecg.r_times_s.tolist()
    write_truth(folder / "truth", heart, cine, truth, share(progress, 75, 100))
    (folder / "study.yaml").write_text(yaml.safe_dump(contents, sort_keys=False))


def share(progress: Progress | None, start: int, end: int) -> Progress | None:
    """Progress of one part, told as the percentage of the whole between ``start`` and ``end``."""
    if progress is None:
        return None
    return lambda done, total: progress(start + (end - start) * done // total, 100)


def _ecg(settings: PhantomSettings, part: int, needed_s: float) -> EcgSignal:
    mean_rr_s = 60 / settings.heart_rate_bpm
    # Two beats more at each end, for a phase needs an R peak on both sides.
    duration_s = needed_s + 4 * mean_rr_s
    # Ultrasound is recorded away from the magnet, where flowing blood makes no voltage.
    away = {"magnetohydrodynamic_mv": 0.0} if part == ULTRASOUND_ECG else {}
    ecg = settings.ecg.model_copy(update=away)
    return simulate_ecg(stream(settings, part), duration_s, mean_rr_s, settings=ecg)


def _write_ultrasound(
    folder: Path, settings: PhantomSettings, heart: BeatingHeart, progress: Progress | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write sweeps and their ECG; entries for truth.json and for study.yaml."""
    preset = settings.ultrasound
    run_s = preset.frames / preset.frame_rate_hz
    ecg = _ecg(settings, ULTRASOUND_ECG, preset.sweeps * (run_s + SWEEP_PAUSE_S))
    sweeps = simulate_sweeps(stream(settings, ULTRASOUND), heart, ecg.r_times_s, preset, progress)
    write_wfdb(folder / "ecg", "us", ecg)
    for sweep in sweeps:
        write_sweep(folder / "us" / f"{sweep.name}.mha", sweep)
    mr_from_tracker = sweeps[0].mr_from_tracker
    start = first_guess(stream(settings, START), mr_from_tracker, heart.centre_mm)
    known = {
        "mr_from_tracker": mr_from_tracker.tolist(),
        "r_times_s": {"us": ecg.r_times_s.tolist()},
        "us_frames": {sweep.name: _frames(sweep) for sweep in sweeps},
    }
    described = {
        "sweeps": [f"us/{sweep.name}.mha" for sweep in sweeps],
        "initial_mr_from_tracker": start.tolist(),
    }
    return known, described


def _frames(sweep: Sweep) -> dict[str, list[float]]:
    return {"times_s": sweep.times_s.tolist(), "phases": sweep.phases.tolist()}


def first_guess(rng: np.random.Generator, mr_from_tracker: Float, centre_mm: Float) -> Float:
    """A start for registration: the truth turned about the heart's centre, then shifted.

    Turn (10 degrees) and shift (10 mm) have their set size and a random direction.
    """
    axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.deg2rad(START_DEG) * axis).as_matrix()
    off[:3, 3] = centre_mm - off[:3, :3] @ centre_mm + START_MM * way
    return np.asarray(off @ mr_from_tracker)


def slice_rr_ms(r_times_s: Float, slices: int) -> list[float]:
    """RR interval of each slice: the mean while it was acquired, in whole ms as DICOM holds it."""
    middles = (r_times_s[1:] + r_times_s[:-1]) / 2
    intervals = np.diff(r_times_s)
    which = np.clip(middles // BREATH_HOLD_S, 0, slices - 1)
    return [float(np.rint(1000 * intervals[which == z].mean())) for z in range(slices)]


def _write_cine(folder: Path, settings: PhantomSettings, cine: SyntheticCine) -> dict[str, str]:
    if settings.cine == "dicom":
        key = f"beatfield-phantom/{settings.patient_id}/{settings.seed}"
        write_dicom(folder / "cine", settings.patient_id, key, cine, settings.mr)
        return {"path": "cine"}
    step_s = float(cine.rr_ms.mean()) / 1000 / len(cine.phases)
    write_nifti(folder / "cine" / "cine.nii.gz", cine.intensity, cine.mr_from_index, step_s)
    timing = {"trigger_times_ms": cine.trigger_times_ms.tolist(), "rr_ms": cine.rr_ms.tolist()}
    write_json(folder / "cine" / "timing.json", timing)
    return {"path": "cine/cine.nii.gz", "timing": "cine/timing.json"}


@contextmanager
def publishing(target: Path) -> Iterator[Path]:
    """A hidden folder beside ``target`` to write into; it becomes ``target`` when all went well.

    Raises
    ------
    SynthError
        When the system refuses to write; what stood at ``target`` is untouched then.
    """
    partial = target.with_name(f".{target.name}.partial-{os.getpid()}")
    old = target.with_name(f".{target.name}.old-{os.getpid()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.mkdir()
        yield partial
        if target.exists():
            target.rename(old)
        partial.rename(target)
    except OSError as error:
        raise SynthError(
            f"{target}: cannot be written ({error.strerror}: {error.filename}); "
            "mend the place or choose another"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
