"""A patient study on disk: what is there, and where.

``study.yaml`` names the files; without it the folders ``cine/``, ``ecg/`` and ``us/`` speak for
themselves. Nothing here reads an image.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import InputError

NIFTI_ENDINGS = (".nii", ".nii.gz")


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CineFiles(_Section):
    """The cine MR: a folder of DICOM files, or one 4D NIfTI file."""

    path: Path
    timing: Path | None = None
    rr_ms: float | None = Field(None, gt=0)
    """Overrides the files' own RR interval."""

    fill_gaps: bool = False
    """Let the mean of both neighbours stand in for a slice that is missing from DICOM files."""


class EcgFiles(_Section):
    """ECG records during MR and during ultrasound; WFDB records are named by their stem."""

    mr: Path | None = None
    us: Path | None = None


class UltrasoundFiles(_Section):
    """Tracked sweeps, and the first guess of where the tracker stands."""

    sweeps: tuple[Path, ...] = Field(min_length=1)
    initial_mr_from_tracker: list[list[float]] | None = None


class Study(_Section):
    """One patient's files; paths are absolute."""

    patient_id: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    folder: Path
    cine: CineFiles
    ecg: EcgFiles = EcgFiles()
    us: UltrasoundFiles | None = None

    @property
    def long_axis(self) -> Path:
        """Where long-axis views lie beside a cine in NIfTI, if there are any."""
        return self.folder / "long_axis"

    @property
    def truth(self) -> Path | None:
        """The folder of known answers, where the study is synthetic."""
        truth = self.folder / "truth"
        return truth if truth.is_dir() else None

    def input_files(self) -> dict[str, list[Path]]:
        """Every file that a stage may read, by kind: cine, mr_ecg, us, truth."""
        us = _record_files(self.ecg.us) + (list(self.us.sweeps) if self.us else [])
        cine = _files(self.cine.path) + ([self.cine.timing] if self.cine.timing else [])
        if self.long_axis.is_dir() and not self.cine.path.is_dir():
            cine += _files(self.long_axis)
        return {
            "cine": cine,
            "mr_ecg": _record_files(self.ecg.mr),
            "us": us,
            "truth": _files(self.truth) if self.truth else [],
        }


def open_study(folder: Path) -> Study:
    """Understand a study's folder; a folder that holds exactly one study stands for it.

    Raises
    ------
    InputError
        When there is no such folder, no cine in it, ``study.yaml`` is wrong, or a file that it
        names does not exist.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such study; give the folder that holds cine/ or study.yaml")
    if not _is_study(folder):
        inside = studies_in(folder)
        if len(inside) != 1:
            raise InputError(_no_study_message(folder, inside))
        folder = inside[0]
    folder = folder.resolve()
    described = folder / "study.yaml"
    study = _from_yaml(described) if described.exists() else _from_folders(folder)
    _require_files(study)
    return study


def studies_in(folder: Path) -> list[Path]:
    """The folders directly below ``folder`` that are studies, in order of their names."""
    return sorted(path for path in folder.iterdir() if path.is_dir() and _is_study(path))


def _is_study(folder: Path) -> bool:
    return (folder / "study.yaml").is_file() or (folder / "cine").is_dir()


def _no_study_message(folder: Path, inside: list[Path]) -> str:
    if inside:
        return (
            f"{folder}: holds {len(inside)} studies ({inside[0].name}, ...), one is needed; "
            "name one of them, or use `beatfield batch`"
        )
    return f"{folder}: is no study: it has neither cine/ nor study.yaml"


def _from_yaml(path: Path) -> Study:
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs keys and values, such as `patient_id: NAME`")
    base = path.parent
    content = {"patient_id": base.name, "cine": {"path": "cine"}, **content, "folder": base}
    try:
        return _absolute(Study.model_validate(content))
    except ValidationError as error:
        raise InputError(describe_validation(error, str(path))) from error


def describe_validation(error: ValidationError, where: str) -> str:
    """A validation error as lines that name the file, the key, and what came."""
    lines = []
    for one in error.errors():
        key = ".".join(str(part) for part in one["loc"]) or "(all)"
        message = one["msg"].removeprefix("Value error, ")
        if one["type"] == "extra_forbidden":
            message = "unknown key; check its spelling"
        came = "" if isinstance(one["input"], dict) else f" (got {one['input']!r})"
        lines.append(f"{where}: {key}: {message}{came}")
    return "\n".join(lines)


def _absolute(study: Study) -> Study:
    base = study.folder

    def full(path: Path | None) -> Path | None:
        return None if path is None else base / path

    update: dict[str, Any] = {
        "cine": study.cine.model_copy(
            update={"path": full(study.cine.path), "timing": full(study.cine.timing)}
        ),
        "ecg": EcgFiles(mr=full(study.ecg.mr), us=full(study.ecg.us)),
    }
    if study.us:
        sweeps = tuple(base / path for path in study.us.sweeps)
        update["us"] = study.us.model_copy(update={"sweeps": sweeps})
    return study.model_copy(update=update)


def _from_folders(folder: Path) -> Study:
    cine = folder / "cine"
    images = [path for path in _files(cine) if path.name.endswith(NIFTI_ENDINGS)]
    if len(images) > 1:
        raise InputError(
            f"{cine}: holds {len(images)} NIfTI files ({images[0].name}, {images[1].name}); "
            "one 4D file is needed, or study.yaml that names it under cine.path"
        )
    timing = cine / "timing.json"
    sweeps = tuple(sorted((folder / "us").glob("*.mh[ad]")))
    us_ecg = _record(folder / "ecg" / "us")
    return Study(
        patient_id=folder.name,
        folder=folder,
        cine=CineFiles(
            path=images[0] if images else cine,
            timing=timing if timing.exists() and images else None,
        ),
        ecg=EcgFiles(mr=_record(folder / "ecg" / "mr"), us=us_ecg),
        us=UltrasoundFiles(sweeps=sweeps) if sweeps else None,
    )


def _record(stem: Path) -> Path | None:
    if stem.with_suffix(".hea").exists():
        return stem
    return next(
        (stem.with_suffix(end) for end in (".csv", ".dcm") if stem.with_suffix(end).exists()), None
    )


def _record_files(stem: Path | None) -> list[Path]:
    return [] if stem is None else sorted(stem.parent.glob(stem.name + "*"))


def _require_files(study: Study) -> None:
    missing = [study.cine.path, study.cine.timing, *(study.us.sweeps if study.us else ())]
    for path in missing:
        if path is not None and not path.exists():
            raise InputError(f"{study.folder}: {path} does not exist; study.yaml names it")
    if not _files(study.cine.path):
        raise InputError(
            f"{study.cine.path}: is empty; it needs the cine's DICOM files, or a 4D NIfTI file"
        )
    for stem in (study.ecg.mr, study.ecg.us):
        if stem is not None and not _record_files(stem):
            raise InputError(f"{study.folder}: no ECG record {stem}; study.yaml names it")
    if study.us and study.ecg.us is None:
        raise InputError(
            f"{study.folder}: has tracked ultrasound but no ECG recorded with it; add ecg/us.hea "
            "with its data, or take us/ out"
        )


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(one for one in path.rglob("*") if one.is_file())
    return [path] if path.is_file() else []
