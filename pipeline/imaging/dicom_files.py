"""Which files of a folder are DICOM, and which are kept beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydicom.misc import is_dicom

from pipeline.errors import InputError

DIRECTORY, DIRECTORY_NAMES = "1.2.840.10008.1.3.10", ("DICOMDIR", "DICOMDIR;1")
"""Media Storage Directory Storage, and what systems make of its file's name."""

OTHER_IMAGES = (".nrrd", ".nhdr", ".mha", ".mhd", ".hdr", ".img", ".img.gz", ".mgz", ".mat", ".par")
"""Ends of names of images that other programs write."""

NOTES = (
    *(".txt", ".csv", ".tsv", ".xml", ".json", ".yaml", ".yml", ".md", ".html", ".htm", ".log"),
    *(".pdf", ".rtf", ".doc", ".docx", ".xls", ".xlsx", ".png", ".jpg", ".jpeg", ".gif", ".bmp"),
    *(".ppt", ".pptx", ".tif", ".tiff", ".avi", ".mp4", ".mov", ".wmv", ".mpg"),
)
"""Ends of names of what people keep beside images; no scanner's file is called so."""

OF_SCANNERS = (".dcm", ".ima")
"""Ends of names of scanners' own files: one that is text is damaged."""

VIEWERS = (
    *(".exe", ".dll", ".msi", ".bat", ".cmd", ".inf", ".ini", ".cfg", ".jar", ".class", ".ico"),
    *(".lnk", ".chm", ".css", ".js", ".svg", ".ttf", ".sys", ".so", ".dylib", ".properties"),
    *(".dat", ".db", ".ocx", ".config", ".manifest", ".swf", ".icns", ".plist", ".nib", ".lic"),
    *(".xsl", ".xsd", ".dtd", ".hlp", ".bin", ".cab", ".sh", ".md5", ".url", ".identifier"),
)
"""Ends of names of the programs that archives put on a disc with the images."""

BARE_BEGINNINGS = tuple(bytes((element, 0)) for element in (0x00, 0x01, 0x05, 0x08, 0x12, 0x16))
"""Elements of group 0008 that an object may begin with: its length, CharacterSet, ImageType, ..."""

META_BEGINNINGS = tuple(bytes((element, 0)) for element in (0x00, 0x01, 0x02))
"""Elements of group 0002 that it may begin with: its length, its version, class of the object."""

TEXT_BYTES = 4096
"""Of a file without an ending, these many tell whether it is text, as a disc's README."""

ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".rar", ".7z")


def told_from_notes(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """DICOM files, and what is kept beside them; InputError, for all at once, where one is neither.

    A file without an ending of its own that does not begin as DICOM does may be a damaged image.
    """
    images = [path for path in paths if _begins_as_dicom(path)]
    known = set(images)
    strange = [path for path in paths if path not in known]
    notes = [path for path in strange if _is_note(path)]
    others = [path for path in strange if not _is_note(path)]
    if not others:
        return images, notes
    more = f" and {len(others) - 1} more ({_names(others[1:])})" if len(others) > 1 else ""
    image = next((one for one in others if one.name.lower().endswith(OTHER_IMAGES)), None)
    if image:
        raise InputError(
            f"{image}: is an image, but neither DICOM nor .nii or .nii.gz; save the cine as "
            "one 4D .nii.gz, as docs/study.md shows, or give the scanner's own files"
        )
    archive = next((one for one in others if one.name.lower().endswith(ARCHIVES)), None)
    if archive:
        raise InputError(f"{archive}: is an archive; unpack it, and take it out of the folder")
    raise InputError(
        f"{others[0]}{more}: is not DICOM, or damaged; copy it again from the scanner, or take "
        "it out of the folder where it does not belong there"
    )


def _is_note(path: Path) -> bool:
    name = path.name.lower()
    if name.endswith((*NOTES, *VIEWERS)):
        return True
    if name.endswith((*OF_SCANNERS, *OTHER_IMAGES, *ARCHIVES)):
        return False
    with path.open("rb") as handle:
        begins = handle.read(TEXT_BYTES)
    # An image that lost its beginning holds bytes that no text does.
    return bool(begins) and begins.isascii() and not set(begins) & set(range(9))


def _names(paths: Sequence[Path]) -> str:
    return ", ".join([*(path.name for path in paths[:8]), *(["..."] * (len(paths) > 8))])


def _begins_as_dicom(path: Path) -> bool:
    try:
        return bool(is_dicom(path)) or is_bare(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its rights") from error


def is_bare(path: Path) -> bool:
    """Whether a file begins with a DICOM object itself, as old archives store them: without
    preamble, its first elements those of group 0008, or of the file meta information."""
    with path.open("rb") as handle:
        group, element = handle.read(2), handle.read(2)
    if group == b"\x02\x00":
        return element in META_BEGINNINGS
    return group == b"\x08\x00" and element in BARE_BEGINNINGS
