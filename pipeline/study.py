"""A patient study on disk: what is there, and where.

The folders ``cine/``, ``ecg/`` and ``us/`` speak for themselves; ``study.yaml`` names what lies
elsewhere, key by key. Nothing here reads an image.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError, field_validator

from pipeline.errors import InputError
from pipeline.geometry import Float, require_rigid, rigid_between, transform_points
from pipeline.regular_files import require_no_device, require_text_name
from pipeline.sealing import sha256_of
from pipeline.study_files import files_below, record_files, require_signals, sweep_files
from pipeline.study_folders import (
    NIFTI_ENDINGS,
    found_cine,
    found_ecg,
    found_us,
    require_names_of_folders,
    require_no_other_record,
    require_no_other_sweep,
)
from pipeline.validation import Section, describe_validation
from pipeline.yaml_files import read_yaml

PATIENT_ID = "[A-Za-z0-9][A-Za-z0-9_.-]{0,99}"

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Place = Annotated[list[float], Field(min_length=3, max_length=3)]

# Root mean square distance from their common line that tells the turn about it, to some 20 degrees
# by landmarks that are some millimetres off, as those of a beating heart are.
_LEAST_WIDTH_MM = 10.0
# Root mean square by which landmarks may miss each other: beyond it the start is no better than
# none, and they were exchanged, mirrored, or given in another unit.
_MOST_MISSED_MM = 15.0


class CineFiles(Section):
    """The cine MR: a folder of DICOM files, or one 4D NIfTI file."""

    path: Path
    timing: Path | None = None
    rr_ms: float | None = Field(None, gt=0)
    """Overrides the files' own RR interval."""

    leave_out_series: tuple[int, ...] = ()
    """Numbers of DICOM series that are not to be used."""

    fill_gaps: bool = False
    """Let the mean of both neighbours stand in for a slice that is missing from DICOM files."""

    spoilt_slices: tuple[int, ...] = ()
    """Slices, counted from 0 as messages and pictures do, whose images are not to be used: the mean
    of both neighbours stands in for each."""


class EcgFiles(Section):
    """ECG records during MR and during ultrasound; WFDB records are named by their stem."""

    mr: Path | None = None
    us: Path | None = None


class Landmark(Section):
    """A point that was found in the MR and touched or seen with the tracker, mm."""

    mr_mm: Place
    tracker_mm: Place


class UltrasoundFiles(Section):
    """Tracked sweeps, and the first guess of where the tracker stands."""

    sweeps: tuple[Path, ...] = Field(min_length=1)
    initial_mr_from_tracker: list[Row] | None = Field(None, min_length=4, max_length=4)
    landmarks: tuple[Landmark, ...] | None = Field(None, min_length=3)
    """In place of that transform: three or more, which it brings nearest to each other."""

    probe_from_image: list[Row] | None = Field(None, min_length=4, max_length=4)
    """Calibration in place of the files' ImageToProbe: from pixels to the probe's marker, mm."""

    pose_frame: str | None = None
    """Name of the marker or device in whose frame poses are taken, such as Reference."""

    @field_validator("pose_frame")
    @classmethod
    def _named_as_in_sequences(cls, name: str | None) -> str | None:
        if name is not None and not re.fullmatch("[A-Za-z][A-Za-z0-9]*", name):
            raise ValueError("needs letters and digits alone, a letter first, as Reference has")
        return name

    def start(self) -> Float | None:
        """Where the tracker roughly stands, ``mr_from_tracker``; None where nothing tells it."""
        if self.landmarks is not None:
            return rigid_between(*_places(self.landmarks))
        given = self.initial_mr_from_tracker
        return None if given is None else np.array(given, dtype=float)


def _places(landmarks: Sequence[Landmark]) -> tuple[Float, Float]:
    """In the MR and in the tracker's frame, ``(n, 3)`` each."""
    in_mr = np.array([one.mr_mm for one in landmarks], dtype=float)
    return in_mr, np.array([one.tracker_mm for one in landmarks], dtype=float)


class Described(Section):
    """What ``study.yaml`` may say."""

    patient_id: str = Field(pattern=f"^{PATIENT_ID}$")
    cine: CineFiles
    ecg: EcgFiles = EcgFiles()
    us: UltrasoundFiles | None = None


class Study(Described):
    """One patient's files; paths are absolute."""

    folder: Path

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
        sweeps = [one for path in (self.us.sweeps if self.us else ()) for one in sweep_files(path)]
        us = record_files(self.ecg.us) + sweeps
        cine = files_below(self.cine.path) + ([self.cine.timing] if self.cine.timing else [])
        if self.long_axis.is_dir() and not self.cine.path.is_dir():
            cine += files_below(self.long_axis)
        return {
            "cine": cine,
            "mr_ecg": record_files(self.ecg.mr),
            "us": us,
            "truth": files_below(self.truth) if self.truth else [],
        }

    def input_digests(self, kinds: Sequence[str] | None = None) -> dict[str, dict[str, str]]:
        """SHA-256 of the input files by kind and path, of all kinds or of some."""
        return {
            kind: {
                path.relative_to(self.folder).as_posix()
                if path.is_relative_to(self.folder)
                else path.as_posix(): sha256_of(path)
                for path in paths
            }
            for kind, paths in self.input_files().items()
            if kinds is None or kind in kinds
        }


def open_study(folder: Path) -> Study:
    """Understand a study's folder; a folder that holds exactly one study stands for it.

    Raises
    ------
    InputError
        When there is no such folder, no cine in it, ``study.yaml`` is wrong, a file that it names
        does not exist, tracked ultrasound has no ECG, or there is what a user seems to have meant
        for a part of the study and nothing would read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such study; give the folder that holds cine/ or study.yaml")
    if not is_study(folder):
        inside = studies_in(folder)
        if len(inside) != 1:
            raise InputError(_no_study_message(folder, inside))
        folder = inside[0]
    # A link has a name of its own, and many may lead to folders of one name.
    called, folder = folder.name if folder.is_symlink() else "", folder.resolve()
    require_text_name(folder)
    _require_name_of_description(folder)
    described = folder / "study.yaml"
    require_no_device(described)
    if described.is_symlink() and not described.exists():
        raise InputError(
            f"{described}: is a link to {described.readlink()}, where nothing is; mend it, or take "
            "it out"
        )
    given = _read_yaml(described) if described.exists() else {}
    try:
        study = _understood(
            folder, called or folder.name, given, str(described if given else folder)
        )
        _require_files(study)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENAMETOOLONG:
            raise
        raise InputError(
            f"{described}: names a place that cannot be looked at ({error}); correct it"
        ) from error
    return study


def studies_in(folder: Path) -> list[Path]:
    """The folders directly below ``folder`` that are studies, in order of their names.

    Hidden ones are not: in them programs write what is not yet whole.
    """
    seen = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in seen if path.is_dir() and is_study(path))


def is_study(folder: Path) -> bool:
    """Whether a folder holds a study itself, not in a folder below."""
    return (folder / "study.yaml").is_file() or (folder / "cine").is_dir()


def _require_name_of_description(folder: Path) -> None:
    for path in folder.iterdir():
        # Windows hides the last ending, and editors add it.
        name = path.name.lower().removesuffix(".txt")
        if name in ("study.yml", "study.yaml") and path.name != "study.yaml":
            raise InputError(f"{path}: would not be read; rename it to study.yaml")


def _no_study_message(folder: Path, inside: list[Path]) -> str:
    if inside:
        return (
            f"{folder}: holds {len(inside)} studies ({inside[0].name}, ...), one is needed; "
            "name one of them, or use `beatfield batch`"
        )
    return f"{folder}: is no study: it has neither cine/ nor study.yaml; {how_to_name_cine(folder)}"


def how_to_name_cine(folder: Path) -> str:
    """What makes a study of a folder that is none; of NIfTI files the largest is most often it."""
    files = [one for one in folder.iterdir() if one.is_file()]
    images = [one for one in files if one.name.lower().endswith(NIFTI_ENDINGS)]
    name = max(images, key=lambda one: one.stat().st_size).name if images else "FOLDER"
    return (
        f"put its cine MR into cine/, or a line such as `cine: {{path: {name}}}` into "
        f"{folder / 'study.yaml'} (docs/study.md)"
    )


def _read_yaml(path: Path) -> dict[str, Any]:
    content = read_yaml(path)
    # All that is left out is what the folders hold, and an empty file leaves out everything.
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs keys and values, such as `patient_id: NAME`")
    return content


def _understood(folder: Path, called: str, given: dict[str, Any], where: str) -> Study:
    """What the folders hold, each key that is given in its place."""
    if "patient_id" not in given and not re.fullmatch(PATIENT_ID, called):
        raise InputError(
            f"{folder}: its name is no patient id, which has letters, digits and '_ . -' alone, a "
            "letter or digit first; rename the folder, or give patient_id in study.yaml"
        )
    content = {"patient_id": called, **given}
    for name, found in (("ecg", found_ecg(folder)), ("us", found_us(folder))):
        content[name] = _overridden(found, given[name]) if name in given else found
    if content["ecg"] is None:
        content["ecg"] = {}
    if "ecg" not in given:
        require_no_other_record(folder / "ecg", content["ecg"])
    if "us" not in given:
        require_no_other_sweep(folder / "us", content["us"])
    require_names_of_folders(folder, given)
    content["cine"] = found_cine(folder, given.get("cine", {}))
    try:
        described = Described.model_validate(content)
    except ValidationError as error:
        # Only to name the place of a key that belongs there.
        from pipeline.config import Settings

        other = ("the configuration (--config)", Settings)
        raise InputError(describe_validation(error, where, Described, other)) from error
    return _absolute(Study(folder=folder, **dict(described)))


def _overridden(found: dict[str, Any] | None, given: Any) -> Any:
    return {**(found or {}), **given} if isinstance(given, dict) else given


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


def _require_files(study: Study) -> None:
    if study.cine.path == study.folder / "cine" and not study.cine.path.exists():
        raise InputError(
            f"{study.folder}: has no cine/; put the cine MR there, or name its place as cine.path "
            "in study.yaml"
        )
    missing = [study.cine.path, study.cine.timing, *(study.us.sweeps if study.us else ())]
    for path in missing:
        if path is not None and not path.exists():
            raise InputError(f"{study.folder}: {path} does not exist; study.yaml names it")
        if path is not None:
            require_no_device(path)
    if not files_below(study.cine.path):
        raise InputError(
            f"{study.cine.path}: is empty; it needs the cine's DICOM files, or a 4D NIfTI file"
        )
    _require_what_fits_the_cine(study)
    for stem in filter(None, (study.ecg.mr, study.ecg.us)):
        files = record_files(stem)
        if not files:
            raise InputError(
                f"{study.folder}: no ECG record {stem}, which study.yaml names; add its .hea and "
                "data, .csv or .dcm, name the right one, or write null there"
            )
        for header in files:
            if header.suffix == ".hea" and header.stem == stem.stem:
                require_signals(header)
    if study.us and study.ecg.us is None:
        beside = sorted(one.relative_to(study.folder).as_posix() for one in
                        files_below(study.folder / "ecg"))  # fmt: skip
        there = f" (there are {', '.join(beside[:6])})" if beside else ""
        raise InputError(
            f"{study.folder}: has tracked ultrasound but no ECG recorded with it{there}; add "
            "ecg/us.hea with its data, ecg/us.csv or ecg/us.dcm, or name it under ecg.us in "
            "study.yaml; to go on without the ultrasound write `us: null` there"
        )
    names = [one.stem for one in study.us.sweeps] if study.us else []
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(
            f"{study.folder}: {names.count(twice)} sweeps are called {twice}, by which frames are "
            "told apart; rename or move one of the files, or name the one to be used under "
            "us.sweeps in study.yaml"
        )
    if study.us and study.us.initial_mr_from_tracker:
        start = np.array(study.us.initial_mr_from_tracker, dtype=float)
        require_rigid(start, f"{study.folder}/study.yaml: us.initial_mr_from_tracker")
    if study.us and study.us.landmarks:
        _require_start(study.us, study.us.landmarks, f"{study.folder}/study.yaml: us.landmarks")


def _require_start(us: UltrasoundFiles, landmarks: Sequence[Landmark], where: str) -> None:
    """Refuse landmarks that tell no start."""
    if us.initial_mr_from_tracker:
        raise InputError(f"{where}: tell the same as us.initial_mr_from_tracker; take one out")
    in_mr, in_tracker = _places(landmarks)
    for name, places in (("mr_mm", in_mr), ("tracker_mm", in_tracker)):
        widths = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if (width_mm := float(np.hypot(*widths[1:3])) / len(places) ** 0.5) < _LEAST_WIDTH_MM:
            raise InputError(
                f"{where}: by {name} they lie {width_mm:.1f} mm beside a common line, root mean "
                f"square, which leaves the turn about it open; {_LEAST_WIDTH_MM:g} mm are needed: "
                "add one that lies far beside it"
            )
    missed = in_mr - transform_points(rigid_between(in_mr, in_tracker), in_tracker)
    apart_mm = np.linalg.norm(missed, axis=1)
    if (mean_mm := float(np.sqrt((apart_mm**2).mean()))) > _MOST_MISSED_MM:
        raise InputError(
            f"{where}: no rigid motion brings them together: they miss each other by {mean_mm:.0f} "
            f"mm, root mean square ({', '.join(f'{one:.0f}' for one in apart_mm)} mm), and "
            f"{_MOST_MISSED_MM:g} are allowed; are all in millimetres, and does each mr_mm stand "
            "beside the tracker_mm of the same point?"
        )


def _require_what_fits_the_cine(study: Study) -> None:
    """Refuse what is meant for DICOM files beside NIfTI, and the reverse: it would do nothing."""
    cine, described = study.cine, study.folder / "study.yaml"
    if cine.path.is_file() and not cine.path.name.lower().endswith(NIFTI_ENDINGS):
        raise InputError(
            f"{described}: cine.path: {cine.path} is no NIfTI file (.nii, .nii.gz); of DICOM "
            "files, even of a single one, name the folder"
        )
    if cine.path.is_file() and cine.leave_out_series:
        raise InputError(
            f"{described}: cine.leave_out_series: applies to DICOM only, and {cine.path} is NIfTI, "
            "which has no series; take the key out"
        )
    if cine.path.is_file() and cine.fill_gaps:
        raise InputError(
            f"{described}: cine.fill_gaps: applies to DICOM only, and {cine.path} is NIfTI; take "
            "the key out; of a slice that is in the file but unusable, give the number under "
            "cine.spoilt_slices"
        )
    if cine.path.is_dir() and cine.timing:
        raise InputError(
            f"{described}: cine.timing: applies to NIfTI only, and {cine.path} is a folder of "
            "DICOM files, which tell their own times; take the key out, or give cine.rr_ms"
        )
    if cine.path.is_dir() and files_below(study.long_axis):
        raise InputError(
            f"{study.long_axis}: is read beside a NIfTI cine only, and {cine.path} is a folder of "
            "DICOM files; put DICOM files of the views there, or take this folder out"
        )
