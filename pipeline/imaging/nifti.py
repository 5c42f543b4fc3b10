"""NIfTI in and out. The files are RAS; everything on this side is LPS and ``(phase, z, y, x)``."""

from __future__ import annotations

import gzip
import json
import logging
import math
import zlib
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import numpy.typing as npt
from nibabel.filebasedimages import ImageFileError
from nibabel.imageglobals import logger as _told_mends
from nibabel.openers import ImageOpener
from nibabel.spatialimages import HeaderDataError

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.frames import MIN_PHASES, MIN_SLICES
from pipeline.imaging.limits import FARTHEST_MM, MOST_PIXELS, require_bounded
from pipeline.imaging.long_axis_series import LongAxis
from pipeline.imaging.nifti_doubts import (
    doubts_of_place,
    doubts_of_size,
    doubts_of_step,
    doubts_of_values,
)
from pipeline.imaging.phases import PLAUSIBLE_RR_S, common_phases
from pipeline.validation import each_key_once, find_truth

# The library mends headers and tells people so, in words of its own; what matters of it is refused.
_told_mends.setLevel(logging.CRITICAL)

LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])

SECONDS_PER_UNIT = {"sec": 1.0, "msec": 1e-3, "usec": 1e-6}

UNREADABLE = (ImageFileError, HeaderDataError, OSError, EOFError, ValueError, OverflowError)
"""What the library raises of files that are damaged, or none of its own."""

VOXEL_MM = (0.1, 50.0)
"""Edges of a cine's voxels; outside is a unit mistaken."""

HEADER_STEP = "NIfTI time step"
"""Where the RR interval comes from when nothing better tells it."""

_PART_BYTES = 1 << 24
"""Unpacked at once."""

OBLONG = 4
"""With more slices than this times the columns or rows, the axes are in another order."""


def read_image(path: Path) -> tuple[npt.NDArray[Any], Float]:
    """Read a NIfTI file as ``(..., z, y, x)`` and ``mr_from_index`` in LPS millimetres.

    Raises
    ------
    InputError
        When the file cannot be read, or its axes are not at right angles.
    """
    image = _load(path)
    try:
        stored = np.asarray(image.dataobj)
        _require_whole(path, image.dataobj.offset + stored.nbytes)
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise InputError(
            f"{path}: its voxels cannot be read, the file is truncated or damaged ({error}); copy "
            "it again, or, where a stage made it, run that stage again (--from STAGE)"
        ) from error
    return stored.T, LPS_FROM_RAS @ _right_angled_affine(image, path)


def _require_whole(path: Path, expected_bytes: int) -> None:
    """Unpack a packed file to its end, where its checksum stands: the library stops at the last
    voxel, and what a damaged bit changed before would pass. What is not packed behind that end, as
    padding, is nobody's, as gunzip has it."""
    if path.suffix.lower() != ".gz":
        return
    left = 2 * expected_bytes + _PART_BYTES
    try:
        with gzip.open(path) as stream:
            while part := stream.read(_PART_BYTES):
                left -= len(part)
                if left < 0:
                    raise ValueError("it holds far more than its header tells of")
    except gzip.BadGzipFile as error:
        # Said of what comes after a checksum that was right, and after all voxels: they were read.
        if not str(error).startswith("Not a gzipped file"):
            raise


def write_image(
    path: Path, array: npt.NDArray[Any], mr_from_index: Float, step_s: float | None = None
) -> None:
    """Write ``(z, y, x)`` or ``(phase, z, y, x)`` as gzipped NIfTI; the same bytes every time.

    Parameters
    ----------
    step_s
        From phase to phase, on average; None where there are none, or it is not known.
    """
    image = nibabel.Nifti1Image(array.T, LPS_FROM_RAS @ mr_from_index)
    # Programs that take no affine whose axes lean by a trifle, as of rounded ones, take this.
    image.set_qform(image.affine, code=1)
    image.header.set_xyzt_units("mm", "sec")
    if array.ndim == 4:
        image.header["pixdim"][4] = step_s or 0.0
    path.write_bytes(gzip.compress(image.to_bytes(), compresslevel=1, mtime=0))


def read_nifti_cine(path: Path, timing: Path | None, rr_ms: float | None = None) -> Stack:
    """Read a 4D NIfTI file as a cine stack.

    Parameters
    ----------
    timing
        JSON file ``{"trigger_times_ms": [[per phase] per slice], "rr_ms": [per slice]}``; both
        may be given once for all slices. Without it, the phases are spread evenly over one
        heartbeat: ``rr_ms`` if given, or else as many of the header's time steps.
    rr_ms
        Overrides the RR interval.

    Raises
    ------
    InputError
        When the file is not a readable 4D image with axes at right angles, too few slices or
        phases, or no usable timing.
    """
    image = _load(path)
    _require_stack(image, path)
    intensity, mr_from_index = read_image(path)
    edges_mm = np.linalg.norm(mr_from_index[:3, :3], axis=0)
    _require_millimetres(edges_mm, path)
    triggers, own_rr_ms, source = _timing(image, path, timing, rr_ms)
    said = f"{timing or path}" + ("" if rr_ms is None else f", with cine.rr_ms {rr_ms:g}")
    phases = common_phases(triggers, own_rr_ms, said)
    cine = Cine(
        np.ascontiguousarray(intensity, np.float32),
        mr_from_index,
        phases,
        float(own_rr_ms.mean()) / 1000,
    )
    doubts = (
        *doubts_of_size(edges_mm, intensity.shape[1]),
        *doubts_of_place(image),
        *(_doubts_of_header_step(image, path) if source == HEADER_STEP else ()),
        *doubts_of_values(cine.intensity[0]),
    )
    return Stack(cine, triggers, own_rr_ms, source, (), remarks=doubts)


def _require_stack(image: Any, path: Path) -> None:
    """Refuse what is no cine of several slices, by its shape alone."""
    if len(image.shape) > 4 and 1 in image.shape:
        raise InputError(
            f"{path}: its shape is {image.shape}; store it without the axes of length 1, as "
            "(columns, rows, slices, phases)"
        )
    if len(image.shape) != 4:
        raise InputError(
            f"{path}: is not a cine, its shape is {image.shape}; 4D is needed: if this is one of "
            "several phases, join them into one 4D file and write timing.json beside it, as "
            "docs/study.md shows"
        )
    if image.shape[2] > OBLONG * min(image.shape[:2]):
        raise InputError(
            f"{path}: its shape is {image.shape}, so {image.shape[2]} slices of {image.shape[0]} "
            f"columns and {image.shape[1]} rows; store it as (columns, rows, slices, phases)"
        )
    slice_count, phase_count = image.shape[2:]
    if slice_count < MIN_SLICES or phase_count < MIN_PHASES:
        raise InputError(
            f"{path}: {slice_count} slices of {phase_count} phases; "
            f"at least {MIN_SLICES} slices of {MIN_PHASES} phases are needed"
        )


def _require_millimetres(edges_mm: Float, path: Path) -> None:
    """Refuse voxels that no cine has."""
    if edges_mm.min() < VOXEL_MM[0] or edges_mm.max() > VOXEL_MM[1]:
        raise InputError(
            f"{path}: its voxels measure {' x '.join(f'{edge:.3g}' for edge in edges_mm)} mm, a "
            f"cine's edges are {VOXEL_MM[0]:g} to {VOXEL_MM[1]:g} mm; write its affine in "
            "millimetres"
        )


def read_nifti_views(folder: Path, rr_ms: float | None = None) -> tuple[LongAxis, ...]:
    """Long-axis views ``<name>.nii.gz`` of a folder, each with ``<name>_timing.json`` beside it.

    Parameters
    ----------
    rr_ms
        RR interval of views that have no such file, over which their phases are spread evenly;
        without it, their header's time step tells.

    Raises
    ------
    InputError
        When a file is not a readable 4D image of one slice, or has no usable timing, or is neither
        a view nor the timing of one.
    """
    if not folder.is_dir():
        return ()
    found = [*folder.glob("*.nii"), *folder.glob("*.nii.gz")]
    paths = sorted(path for path in found if not path.name.startswith("."))
    read = {*paths, *(_view_timing(path) for path in paths)}
    for path in sorted(folder.iterdir()):
        if path not in read and not path.name.startswith("."):
            raise InputError(
                f"{path}: would not be read: views are NAME.nii.gz, each with NAME_timing.json; "
                "rename it, or take it out of this folder"
            )
    return tuple(_read_view(path, rr_ms) for path in paths)


def _view_name(path: Path) -> str:
    return path.name.removesuffix(".gz").removesuffix(".nii")


def _notes(path: Path) -> Path:
    """What a converter may have written of the file, beside it."""
    return path.with_name(f"{_view_name(path)}.json")


def _view_timing(path: Path) -> Path:
    return path.with_name(f"{_view_name(path)}_timing.json")


def _read_view(path: Path, rr_ms: float | None) -> LongAxis:
    image = _load(path)
    if len(image.shape) != 4 or image.shape[2] != 1 or image.shape[3] < MIN_PHASES:
        raise InputError(
            f"{path}: is no long-axis view, its shape is {image.shape}; one slice of "
            f"{MIN_PHASES} phases or more is needed (columns, rows, 1, phases); take other files "
            "out of this folder"
        )
    intensity, mr_from_index = read_image(path)
    timing = _view_timing(path)
    own = timing if timing.exists() else None
    triggers, own_rr_ms, source = _timing(image, path, own, None if own else rr_ms)
    phases = common_phases(triggers, own_rr_ms, str(own or path))
    pixels = np.ascontiguousarray(intensity, np.float32)
    return LongAxis(
        _view_name(path),
        Cine(pixels, mr_from_index, phases, float(own_rr_ms[0]) / 1000),
        _doubts_of_header_step(image, path) if source == HEADER_STEP else (),
    )


def _load(path: Path) -> Any:
    try:
        image: Any = nibabel.load(path)
        # A damaged placement shows when it is asked for.
        image.get_qform(coded=True)
        with ImageOpener(path) as stream:
            as_stored = type(image.header).from_fileobj(stream, check=False)
    except (*UNREADABLE, zlib.error) as error:
        raise InputError(
            f"{path}: cannot be read as NIfTI ({error}); copy or convert it again"
        ) from error
    sizes = [int(size) for size in image.shape]
    require_bounded(math.prod(sizes), str(path))
    require_bounded(math.prod(sizes[:2]), f"{path}: one image", MOST_PIXELS)
    edges_mm = as_stored["pixdim"][1:4]
    if as_stored["sform_code"] <= 0 and not np.all(np.abs(edges_mm) > 0):
        raise InputError(
            f"{path}: its header tells no size of voxels (pixdim {edges_mm.tolist()}, and no "
            "sform); convert the scanner's own files again"
        )
    if image.get_data_dtype().kind == "V":
        raise InputError(f"{path}: its voxels are colours; store one grey value a voxel")
    if image.get_data_dtype().kind == "c":
        raise InputError(f"{path}: its voxels are complex numbers; store their magnitude")
    return image


def _placement_name(image: Any) -> str:
    """Which of a header's placements is taken."""
    return "sform" if image.header["sform_code"] > 0 else "qform"


def _other_placement(image: Any) -> str:
    """What to do about a placement that is none."""
    if image.header["sform_code"] > 0 and image.header["qform_code"] > 0:
        return "its qform may be right: set sform_code to 0, or write the qform into the sform"
    return "convert the scanner's own files again"


def _right_angled_affine(image: Any, path: Path) -> Float:
    affine: Float = np.asarray(image.affine, dtype=float)
    lengths = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.abs(affine) <= FARTHEST_MM).all() or not (lengths > 0).all():
        raise InputError(
            f"{path}: its {_placement_name(image)} gives a voxel no size, or holds what is no "
            f"number of millimetres: {np.round(affine[:3], 3).tolist()}; {_other_placement(image)}"
        )
    axes = affine[:3, :3] / lengths
    if np.linalg.matrix_rank(axes, tol=1e-3) < 3:
        raise InputError(
            f"{path}: two axes of its {_placement_name(image)} point the same way: "
            f"{np.round(affine[:3], 3).tolist()}; {_other_placement(image)}"
        )
    lean = np.abs(axes.T @ axes - np.eye(3)).max()
    # Single-precision affines of oblique stacks are right-angled to about 1e-6.
    if lean > 1e-3:
        raise InputError(
            f"{path}: its affine is sheared (axes lean by up to "
            f"{np.degrees(np.arcsin(min(lean, 1))):.2f} degrees); resample the image to a grid "
            "with axes at right angles"
        )
    return affine


def _timing(
    image: Any, path: Path, timing: Path | None, rr_ms: float | None
) -> tuple[Float, Float, str]:
    """Trigger times ``(slice, phase)`` and RR intervals ``(slice,)``, ms, and who tells them."""
    slices, phases = image.shape[2:]
    if timing is not None:
        triggers, own_rr_ms = _timing_file(timing, phases, slices)
        if rr_ms is None:
            return triggers, own_rr_ms, timing.name
        return triggers, np.full(slices, rr_ms), "study.yaml"
    source = "study.yaml"
    if rr_ms is None:
        rr_ms, source = _header_rr_ms(image, path, phases), HEADER_STEP
    triggers = np.tile(rr_ms / phases * np.arange(phases), (slices, 1))
    return triggers, np.full(slices, rr_ms), source


def _unit_of_time(image: Any) -> str:
    try:
        return str(image.header.get_xyzt_units()[1])
    except KeyError:
        return "unknown"


def _step_ms(image: Any) -> float:
    """Time from phase to phase; of a unit that is not told the one by which phases make a
    heartbeat, but for a step of 1, which programs write that know none. 0 where there is none."""
    unit, step = _unit_of_time(image), float(image.header.get_zooms()[3])
    if unit != "unknown" or step == 1:
        return 1000 * step * SECONDS_PER_UNIT.get(unit, 0.0)
    low_s, high_s = PLAUSIBLE_RR_S
    lasts = step * image.shape[3]
    return next((1000 * step * one for one in (1.0, 1e-3) if low_s < lasts * one < high_s), 0.0)


def _doubts_of_header_step(image: Any, path: Path) -> tuple[str, ...]:
    """What speaks against the time step by which the beat is told, in words."""
    step_ms = _step_ms(image)
    doubts = doubts_of_step(step_ms, _notes(path))
    if _unit_of_time(image) != "unknown":
        return doubts
    step, beat_ms = float(image.header.get_zooms()[3]), step_ms * image.shape[3]
    return (
        *doubts,
        f"the NIfTI header's time step of {step:g} has no unit; as {step_ms:.4g} ms it makes a "
        f"beat of {beat_ms:.0f} ms, and so it was taken: else give cine.rr_ms in study.yaml",
    )


def _header_rr_ms(image: Any, path: Path, phases: int) -> float:
    """One heartbeat of evenly spread phases, as the header's time step tells it."""
    unit = _unit_of_time(image)
    step = float(image.header.get_zooms()[3])
    step_ms = _step_ms(image)
    if not step_ms > 0:
        told = "without a unit" if unit == "unknown" else f"in {unit}"
        in_header = f"a time step of {step:g} {told} in" if step > 0 else "no time step in"
        raise InputError(
            f"{path}: has no trigger times: no timing file beside it and {in_header} its "
            'header; write timing.json with "trigger_times_ms" and "rr_ms" beside it, or, for '
            "phases evenly spread over the beat, give cine.rr_ms in study.yaml"
        )
    low_ms, high_ms = (1000 * limit for limit in PLAUSIBLE_RR_S)
    if not low_ms < step_ms * phases < high_ms:
        raise InputError(
            f"{path}: RR interval {step_ms * phases:g} ms = {phases} phases x the header's time "
            f"step of {step_ms:g} ms, a heartbeat lasts {low_ms:g} to {high_ms:g} ms; write a "
            "timing file beside it, or, for phases evenly spread over the beat, give cine.rr_ms "
            "in study.yaml"
        )
    return step_ms * phases


def _timing_file(path: Path, phases: int, slices: int) -> tuple[Float, Float]:
    needed = (
        f'needs "trigger_times_ms" as {slices} lists of {phases} numbers (or one list) and '
        f'"rr_ms" as {slices} numbers (or one)'
    )
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=each_key_once)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: cannot be read as JSON ({error}); write it as docs/study.md shows, in UTF-8"
        ) from error
    if not isinstance(content, dict) or not {"trigger_times_ms", "rr_ms"} <= set(content):
        found = ", ".join(content) if isinstance(content, dict) else repr(content)
        evenly = ""
        if found == "rr_ms":
            evenly = "; for phases evenly over the beat give cine.rr_ms in study.yaml in its place"
        raise InputError(f"{path}: {needed}; it holds {found or 'nothing'}{evenly}")
    given = []
    for key, shape in (("trigger_times_ms", (slices, phases)), ("rr_ms", (slices,))):
        truth = find_truth(content[key])
        if truth is not None:
            raise InputError(f"{path}: {needed}; {key} holds {str(truth).lower()}")
        try:
            numbers = np.asarray(content[key], dtype=float)
            given.append(np.broadcast_to(numbers, shape))
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: {needed}; {key} is {_in_words(content[key])}") from error
    return given[0], given[1]


def _in_words(value: Any) -> str:
    """The shape of what stands where numbers should."""
    if not isinstance(value, list):
        return repr(value)
    inner = {len(one) for one in value if isinstance(one, list)}
    of = f" of {' or '.join(map(str, sorted(inner)))}" if inner else ""
    return f"a list of {len(value)}" + (f" lists{of}" if inner else "")
