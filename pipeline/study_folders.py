"""What a study's folders ``cine/``, ``ecg/`` and ``us/`` hold, by the names of their files.

What a user seems to have meant for one of them, and nothing would read, is refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.study_files import files_below

NIFTI_ENDINGS = (".nii", ".nii.gz")
DICOM_ENDINGS = (".dcm", ".ima", "")
SWEEP_ENDINGS = (".mha", ".mhd")
UNREAD_SWEEP_ENDINGS = (".nrrd", ".nhdr", ".mkv", ".webm")
"""What PLUS and 3D Slicer write as well."""

MEANT = {"us": ("ultrasound", "sweeps"), "ecg": ("ekg", "ecgs")}
"""Names that a user may give a folder, by the one that is read."""


def found_cine(folder: Path, given: Any) -> Any:
    """The cine's section: a folder that holds a NIfTI file stands for it, with its timing.

    Raises
    ------
    InputError
        When the folder holds several NIfTI files, one beside DICOM files, a timing of none or one
        by another name, or as in `files_below`.
    """
    path = given.get("path", "cine") if isinstance(given, dict) else None
    if not isinstance(path, str):
        return given
    cine = folder / path
    images = [one for one in files_below(cine) if one.name.lower().endswith(NIFTI_ENDINGS)]
    if len(images) > 1:
        raise InputError(
            f"{cine}: holds {len(images)} NIfTI files ({images[0].name}, {images[1].name}), one 4D "
            "file is needed: name it under cine.path in study.yaml, or, where each file is one "
            "phase, join them into one and write timing.json beside it, as docs/study.md shows; "
            "where each is one slice, as converters make of a series a slice, give the DICOM files"
        )
    if images and cine.is_dir():
        _require_no_dicom(cine, images[0])
    if not images and (cine / "timing.json").exists():
        raise InputError(
            f"{cine}: holds timing.json, but no NIfTI file (.nii, .nii.gz) that it would be of; "
            "put that beside it, or, of DICOM files, take timing.json out"
        )
    timing = images[0].with_name("timing.json") if images else None
    if timing and "timing" not in given:
        _require_name_of_timing(timing, folder)
    found = {"timing": timing if timing and timing.exists() else None}
    return {**found, **given, "path": images[0] if images else cine}


def _require_name_of_timing(timing: Path, folder: Path) -> None:
    """Refuse a file that a user took for the cine's timing, and that nothing would read."""
    for one in [*timing.parent.glob("*.json"), *folder.glob("*.json")]:
        if "timing" in one.name.lower() and one != timing:
            raise InputError(
                f"{one}: would not be read; name it {timing}, or under cine.timing in study.yaml"
            )


def _require_no_dicom(cine: Path, image: Path) -> None:
    """Refuse a folder in which one NIfTI file would stand for what may be another cine."""
    for one in files_below(cine):
        if one.suffix.lower() in DICOM_ENDINGS:
            raise InputError(
                f"{cine}: holds {image.name}, a NIfTI file, and {one.name}, as of DICOM; keep "
                "one sort there, or name the NIfTI file under cine.path in study.yaml"
            )


def found_ecg(folder: Path, inside: str = "ecg") -> dict[str, Any]:
    """The records of the section ``ecg``, None where there is none."""
    return {name: _record(folder / inside / name) for name in ("mr", "us")}


def found_us(folder: Path, inside: str = "us") -> dict[str, Any] | None:
    """The section ``us``: all sweeps in its folder; None where there are none."""
    beside = (one for one in files_below(folder / inside) if one.parent == folder / inside)
    sweeps = tuple(one for one in beside if one.suffix.lower() in SWEEP_ENDINGS)
    return {"sweeps": sweeps} if sweeps else None


def require_names_of_folders(folder: Path, given: dict[str, Any]) -> None:
    """Refuse files that would be read but for their folder's name, which is nearly right.

    Raises
    ------
    InputError
        When there is such a folder, and study.yaml does not say what stands in its place.
    """

    def holds(name: str, inside: str) -> bool:
        found = found_us(folder, inside) if name == "us" else found_ecg(folder, inside)
        return any((found or {}).values())

    for path in sorted(one for one in folder.iterdir() if one.is_dir()):
        for name, others in MEANT.items():
            near = path.name != name and path.name.lower() in (name, *others)
            # Where capitals do not matter, US is us itself.
            if near and name not in given and holds(name, path.name) and not holds(name, name):
                raise InputError(
                    f"{path}: would not be read; rename it to {name}/, or name its files under "
                    f"{name} in study.yaml (`{name}: null` for none)"
                )


def require_no_other_sweep(us: Path, found: dict[str, Any] | None) -> None:
    """Refuse files that a user took for sweeps, and that nothing would read.

    Raises
    ------
    InputError
        When the folder ``us`` holds such files beside the section ``found``.
    """
    taken = found["sweeps"] if found else ()
    for one in files_below(us):
        recorded = one.suffix.lower() in (*SWEEP_ENDINGS, *UNREAD_SWEEP_ENDINGS)
        if found is None or (recorded and one not in taken):
            raise InputError(
                f"{us}: {one.relative_to(us)} would not be read; sweeps are .mha or .mhd files "
                "directly in this folder: convert, move or remove it, name all sweeps under "
                "us.sweeps in study.yaml, or write `us: null` there"
            )


def require_no_other_record(ecg: Path, found: dict[str, Any]) -> None:
    """Refuse a file that a user took for the record made with the cine, and that nothing would
    read; that ultrasound needs its own is told elsewhere.

    Raises
    ------
    InputError
        When the folder ``ecg`` holds such a file beside the section ``found``.
    """
    unread = [] if found["mr"] else sorted(ecg.glob("mr.*"))
    if unread:
        raise InputError(
            f"{unread[0]}: would not be read; convert it to WFDB (mr.hea with its data), CSV or "
            "DICOM, take it out, or write `ecg: {mr: null}` into study.yaml"
        )


def _record(stem: Path) -> Path | None:
    if stem.with_suffix(".hea").exists():
        return stem
    # Some systems write endings in capitals.
    ends = (".csv", ".CSV", ".dcm", ".DCM")
    return next((stem.with_suffix(end) for end in ends if stem.with_suffix(end).exists()), None)
