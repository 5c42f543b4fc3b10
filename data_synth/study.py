"""Write a whole synthetic study: cine MR, ECG, tracked ultrasound and the truth about them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from data_synth.dicom import require_room, write_dicom
from data_synth.ecg import write_wfdb
from data_synth.errors import SynthError
from data_synth.mr import SyntheticCine
from data_synth.settings import PhantomSettings
from data_synth.simulate import Progress, SyntheticStudy, share, simulate_study
from data_synth.truth import write_json, write_nifti, write_truth
from data_synth.ultrasound import write_sweep

PREVIEW = "preview.html"
"""Name of the page that shows a study, beside its study.yaml."""


def write_study(
    folder: Path,
    settings: PhantomSettings,
    progress: Progress | None = None,
    overwrite: bool = False,
    preview: bool = False,
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
    preview
        Write ``preview.html`` too, one self-contained page that shows the study.

    Raises
    ------
    SynthError
        When the folder exists, with ``overwrite`` is no study, or cannot be written, or what is
        asked for cannot be recorded: see `simulate_study`; of DICOM, `write_dicom`.
    """
    require_free(folder, overwrite)
    _require_text(folder.absolute())
    # What cannot be written is refused before a minute is spent on it.
    if settings.cine != "nifti":
        require_room(settings.patient_id)
    with publishing(folder) as partial:
        study = simulate_study(settings, progress, done=65)
        _write_recordings(partial, study)
        write_truth(partial / "truth", study, share(progress, 65, 90 if preview else 100))
        if preview:
            from data_synth.preview import write_preview

            write_preview(partial / PREVIEW, study)


def _require_text(folder: Path) -> None:
    """The library that writes images ends the program at a name that is none."""
    try:
        str(folder).encode()
    except UnicodeEncodeError as error:
        name = os.fsencode(folder)
        try:
            wrong = f"{name.decode()}: this shell's locale lacks letters of it; set LC_ALL=C.UTF-8"
        except UnicodeDecodeError:
            told = name.decode(errors="backslashreplace")
            wrong = f"{told}: is no UTF-8 text; choose another folder"
        raise SynthError(wrong) from error


def require_free(folder: Path, overwrite: bool) -> None:
    """Raise SynthError when something is in the way and must not be replaced."""
    there = _exists(folder)
    if there and not overwrite:
        raise SynthError(f"{folder}: exists; choose another folder or give --overwrite")
    if there and not (folder / "study.yaml").is_file():
        raise SynthError(f"{folder}: is no study, so it is not overwritten; choose another folder")


def _exists(path: Path) -> bool:
    """Whether something is there; of a name that is too long the path's own method would raise."""
    try:
        return path.exists()
    except OSError:
        return False


def _write_recordings(folder: Path, study: SyntheticStudy) -> None:
    """Everything that a patient's study holds, and study.yaml that names it."""
    contents: dict[str, Any] = {"patient_id": study.settings.patient_id}
    contents["cine"] = _write_cine(folder, study)
    if study.us_ecg is not None:
        write_wfdb(folder / "ecg", "mr", study.mr_ecg)
        write_wfdb(folder / "ecg", "us", study.us_ecg)
        contents["ecg"] = {"mr": "ecg/mr", "us": "ecg/us"}
    if study.initial_mr_from_tracker is not None:
        for sweep in study.sweeps:
            write_sweep(folder / "us" / f"{sweep.name}.mha", sweep)
        contents["us"] = {
            "sweeps": [f"us/{sweep.name}.mha" for sweep in study.sweeps],
            "initial_mr_from_tracker": study.initial_mr_from_tracker.tolist(),
        }
    (folder / "study.yaml").write_text(yaml.safe_dump(contents, sort_keys=False))


def _write_cine(folder: Path, study: SyntheticStudy) -> dict[str, str]:
    settings = study.settings
    if settings.cine != "nifti":
        key = f"beatfield-phantom/{settings.patient_id}/{settings.seed}"
        write_dicom(
            folder / "cine",
            settings.patient_id,
            key,
            study.cine,
            settings.mr,
            views=study.views,
            enhanced=settings.cine == "enhanced",
        )
        return {"path": "cine"}
    _write_cine_nifti(folder / "cine", "cine", "timing", study.cine)
    # Beside the stack's folder, for that holds one 4D file where nothing names it.
    for name, view in study.views.items():
        _write_cine_nifti(folder / "long_axis", name, f"{name}_timing", view)
    return {"path": "cine/cine.nii.gz", "timing": "cine/timing.json"}


def _write_cine_nifti(folder: Path, name: str, timing_name: str, cine: SyntheticCine) -> None:
    step_s = float(cine.rr_ms.mean()) / 1000 / len(cine.phases)
    write_nifti(folder / f"{name}.nii.gz", cine.intensity, cine.mr_from_index, step_s)
    timing = {"trigger_times_ms": cine.trigger_times_ms.tolist(), "rr_ms": cine.rr_ms.tolist()}
    write_json(folder / f"{timing_name}.json", timing)


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
        # What one of the same number left when it was killed, as in a container.
        if _exists(old) and not _exists(target):
            old.rename(target)
        for left in (partial, old):
            shutil.rmtree(left, ignore_errors=True)
        partial.mkdir()
        yield partial
        if _exists(target):
            target.rename(old)
        partial.rename(target)
    except OSError as error:
        raise SynthError(
            f"{target}: cannot be written ({error.strerror}: {error.filename or partial}); "
            "mend the place or choose another"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if _exists(old) and not _exists(target):
            old.rename(target)
        shutil.rmtree(old, ignore_errors=True)
