"""Read tracked ultrasound sweeps: PLUS / SlicerIGT sequences in MetaImage files."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer
from pipeline.imaging.limits import require_bounded
from pipeline.imaging.stuck import without_stuck
from pipeline.imaging.sweep_poses import (
    TRACKER,
    frame_of_poses,
    image_calibration,
    is_tracked,
    probe_pose,
    reference_pose,
    require_resting,
)

if TYPE_CHECKING:
    # For types only: a stage's product must not depend on how a study's folder is understood.
    from pipeline.study import UltrasoundFiles

_FRAME_KEY = re.compile(r"Seq_Frame(\d+)_(\w+)")
# A sweep goes over centimetres, and no tracker sees a probe at its own place: what stays within
# these is in metres.
_STILL_MM, _TOO_NEAR_MM = 1.0, 10.0
# Bytes of one value, by its name in a MetaImage header; others are the library's to check.
_VALUE_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip
_HEADER_LINE = re.compile(r"\s*(\w+)\s*[=:](.*)")
_HEADER_ENDS = "ElementDataFile"
_SEVERAL_FILES = re.compile(r"%|^LIST\b|\s\d+\s+\d+")
# A file of another kind may have no lines at all.
_LONGEST_LINE = 65536
_PART_BYTES = 1 << 20
_COPY = "copy it again from the tracking computer"

Fields = dict[str, str]


@dataclass(frozen=True, slots=True)
class Sweep:
    """Frames of one sweep whose pose is known."""

    name: str
    """Stem of the file."""

    images: Float32
    """``(n, rows, columns)`` grey values."""

    times_s: Float
    """``(n,)`` strictly rising, on the clock of the ECG recorded beside it."""

    tracker_from_image: Float
    """``(n, 4, 4)`` from pixel ``(i = column, j = row, 0)`` to tracker mm."""

    tracker_from_probe: Float
    """``(n, 4, 4)`` what of it the tracker saw: the pose of the marker on the probe."""

    numbers: Integer
    """``(n,)`` which frames of the file these are, counted from 0."""

    pose_frame: str = TRACKER
    """What the tracker's millimetres are counted from: itself, or the patient's reference."""

    tracker_from_reference: tuple[Float, ...] = ()
    """4x4 each: where the patient's reference was seen, in those frames that tell."""

    remarks: tuple[str, ...] = ()
    """What a person should know of how the file was read."""


def read_sweeps(files: UltrasoundFiles) -> list[Sweep]:
    """All sweeps of a study.

    Raises
    ------
    InputError
        When one cannot be read (`read_sweep`), when their poses are in different frames, or when
        the patient's reference moves and nothing says whether poses are to follow it.
    """
    given = files.probe_from_image
    calibration = None if given is None else np.array(given, dtype=float)
    sweeps = [read_sweep(path, files.pose_frame, calibration) for path in files.sweeps]
    folder, first = files.sweeps[0].parent, sweeps[0]
    other = next((one for one in sweeps if one.pose_frame != first.pose_frame), None)
    if other:
        raise InputError(
            f"{folder}: poses of {first.name} are in the frame {first.pose_frame}, those of "
            f"{other.name} in {other.pose_frame}; name one as us.pose_frame in study.yaml"
        )
    if files.pose_frame is None and first.pose_frame == TRACKER:
        seen = [pose for sweep in sweeps for pose in sweep.tracker_from_reference]
        probe_mm = np.concatenate([sweep.tracker_from_probe[:, :3, 3] for sweep in sweeps])
        require_resting(seen, probe_mm.mean(axis=0), str(folder))
    return sweeps


def read_sweep(
    path: Path, pose_frame: str | None = None, probe_from_image: Float | None = None
) -> Sweep:
    """Read a ``.mha`` or ``.mhd`` sequence of 2D frames with a pose and a time for each.

    Frames whose image or transforms carry a status other than OK, or a pose of zeros, are left out
    and told; so are those that repeat a picture or a pose that is not theirs (`without_stuck`).
    Transforms may stand once for the whole file instead of in each frame.

    Parameters
    ----------
    pose_frame
        The frame of the poses, such as ``Tracker`` or ``Reference`` (the patient's marker); None:
        the tracker's where the file has ProbeToTracker, else that of the reference.
    probe_from_image
        4x4 from pixels to the probe's marker, mm, in place of the file's ImageToProbe.

    Raises
    ------
    InputError
        When the file is missing, truncated or no sequence of grey 2D frames, when a time or a
        transform is missing, not finite, not rigid or not a calibration in mm, when time stamps
        do not rise, or when no valid frame is left.
    """
    path = Path(path)
    images, header = _read_image(path)
    images, turned = _as_scanned(path, images, header)
    frames = _frame_fields(path, header, len(images))
    frame = frame_of_poses(frames, pose_frame)
    own = probe_from_image is None
    valid = [k for k, fields in enumerate(frames) if is_tracked(fields, frame, own)]
    if not valid:
        raise InputError(
            f"{path}: none of its {len(frames)} frames has status OK; the probe was out of the "
            "tracker's sight; record the sweep again"
        )
    times_s = np.array([_time_s(frames[k], f"{path}, frame {k}") for k in valid])
    _require_rising(path, times_s, valid)
    places = [(frames[k], f"{path}, frame {k}") for k in valid]
    tracker_from_probe = np.stack([probe_pose(one, frame, where) for one, where in places])
    calibrated = [image_calibration(one, probe_from_image, where) for one, where in places]
    seen = (reference_pose(one) for one, _ in places)
    sweep = Sweep(
        path.stem,
        np.asarray(images[valid], dtype=np.float32),
        times_s,
        tracker_from_probe @ np.stack(calibrated),
        tracker_from_probe,
        np.array(valid),
        frame,
        tuple(pose for pose in seen if pose is not None),
        (*turned, *_left_out(len(frames) - len(valid), len(frames))),
    )
    return without_stuck(sweep)


def _left_out(missing: int, frames: int) -> list[str]:
    if not missing:
        return []
    return [f"{missing} of {frames} frames left out, which the tracker marked as not valid"]


def remarks_on(sweeps: Sequence[Sweep]) -> list[str]:
    """What a person should know of the sweeps before a registration is used."""
    told = [f"{sweep.name}: {text}" for sweep in sweeps for text in sweep.remarks]
    frame = sweeps[0].pose_frame
    if frame != TRACKER:
        told.append(
            f"poses are those in the frame {frame}: mr_from_tracker starts from there, so give "
            "the tool's poses in it, too"
        )
    return told


def odd_transforms(sweeps: Sequence[Sweep]) -> str:
    """What the transforms of sweeps that do not fit their heart look like; empty if like nothing.

    Each may be right by itself, so nothing is refused for it.
    """
    probe_mm = np.concatenate([sweep.tracker_from_probe[:, :3, 3] for sweep in sweeps])
    spread_mm = float(np.linalg.norm(np.ptp(probe_mm, axis=0)))
    furthest_mm = float(np.linalg.norm(probe_mm, axis=1).max())
    found = []
    if spread_mm < _STILL_MM and furthest_mm < _TOO_NEAR_MM:
        found.append(
            f"ProbeTo{sweeps[0].pose_frame} looks as if it were in metres: over all sweeps the "
            f"probe moves by {spread_mm:.3g} mm, at {furthest_mm:.3g} mm from there or nearer; "
            "give mm"
        )
    if all(_is_uncalibrated(sweep) for sweep in sweeps):
        found.append(
            "ImageToProbe is the identity, pixels for millimetres: give the probe's calibration"
        )
    return "; ".join(found)


def _is_uncalibrated(sweep: Sweep) -> bool:
    return np.allclose(sweep.tracker_from_image, sweep.tracker_from_probe, rtol=0, atol=1e-9)


def _read_image(path: Path) -> tuple[Any, Fields]:
    """Pixels ``(n, rows, columns)`` and the header's custom fields."""
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file; a sweep is a .mha, or a .mhd with its raw file")
    _require_all_bytes(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(str(path))
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise InputError(
            f"{path}: cannot be read as a MetaImage sequence ({_gist(error)}); {_COPY}"
        ) from error
    fields = {key: image.GetMetaData(key).strip() for key in image.GetMetaDataKeys()}
    return _grey_frames(path, image, sitk.GetArrayFromImage(image)), fields


def _require_all_bytes(path: Path) -> None:
    """Refuse a file whose pixels are missing, end before they should, or cannot be unpacked.

    The library tells the terminal of it, not what is wrong, and takes damaged ones as they are.
    """
    header, start = _header_of(path)
    values, each = _values(header), _VALUE_BYTES.get(header.get("ElementType", ""))
    if values is None:
        raise InputError(f"{path}: its header tells no DimSize in whole numbers; {_COPY}")
    require_bounded(values, str(path))
    whole = values * each if each else None
    where = header.get(_HEADER_ENDS, "")
    if _SEVERAL_FILES.search(where):
        return
    pixels = path if where.upper() == "LOCAL" else path.parent / where
    if not pixels.is_file():
        raise InputError(f"{path}: its pixels are in {pixels}, which is no file; copy it beside it")
    packed = header.get("CompressedData", "False").upper() == "TRUE"
    # Of a file of its own the library takes all there is.
    if packed and pixels == path and _number(header.get("CompressedDataSize")) is None:
        raise InputError(
            f"{path}: does not say how long its compressed pixels are (CompressedDataSize); save "
            "it again, or uncompressed"
        )
    needed = _number(header.get("CompressedDataSize")) if packed else whole
    found = pixels.stat().st_size - (start if pixels == path else 0)
    if needed is not None and found < needed:
        raise InputError(
            f"{pixels}: ends too early: its pixels need {needed} bytes, it holds {found} of them; "
            f"{_COPY}"
        )
    if packed:
        _require_unpacked(pixels, start if pixels == path else 0, whole)


def _require_unpacked(path: Path, start: int, needed: int | None) -> None:
    """Refuse compressed pixels that are damaged."""
    # Of zlib or gzip, whichever it says.
    unpacking, found = zlib.decompressobj(32 + zlib.MAX_WBITS), 0
    try:
        with path.open("rb") as file:
            file.seek(start)
            while not unpacking.eof and (part := file.read(_PART_BYTES)):
                found += len(unpacking.decompress(part))
    except zlib.error as error:
        raise InputError(f"{path}: its compressed pixels are damaged ({error}); {_COPY}") from error
    if needed is not None and found < needed:
        raise InputError(
            f"{path}: its pixels need {needed} bytes, {found} of them can be unpacked; {_COPY}"
        )


def _header_of(path: Path) -> tuple[Fields, int]:
    """The fields of a header and the place where it ends."""
    header: Fields = {}
    with path.open("rb") as file:
        while _HEADER_ENDS not in header:
            line = file.readline(_LONGEST_LINE)
            if not line:
                raise InputError(
                    f"{path}: is no whole MetaImage file: its header does not end with a line "
                    f"{_HEADER_ENDS} within its {file.tell()} bytes; {_COPY}"
                )
            text = line.decode("utf-8", errors="replace")
            field = _HEADER_LINE.match(text)
            if field:
                header[field[1]] = field[2].strip()
            elif not header:
                raise InputError(
                    f"{path}: is no MetaImage file: it begins with {text[:20].strip()!r}, not "
                    "with a line KEY = VALUE; name a .mha, or a .mhd with its raw file"
                )
        return header, file.tell()


def _values(header: Fields) -> int | None:
    """How many values all pixels have; None where the header does not say in whole numbers."""
    words = [*header.get("DimSize", "?").split(), header.get("ElementNumberOfChannels", "1")]
    return math.prod(_number(word) or 0 for word in words) or None


def _number(word: str | None) -> int | None:
    return int(word) if word and word.isdecimal() else None


def _gist(error: RuntimeError) -> str:
    """The last line of SimpleITK's report, which says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else "no reason given"


def _grey_frames(path: Path, image: Any, values: Any) -> Any:
    """Pixels ``(n, rows, columns)``; frames one pixel thick and colours that are all grey pass."""
    size, components = image.GetSize(), image.GetNumberOfComponentsPerPixel()
    if len(size) == 4 and size[2] == 1:
        values = values[:, 0]
    elif len(size) != 3:
        raise InputError(
            f"{path}: has {len(size)} dimensions {size}; a sweep is a stack of 2D frames "
            "(columns, rows, frames); 3D probes are not supported"
        )
    if components == 3 and (values == values[..., :1]).all():
        return values[..., 0]
    if components != 1:
        raise InputError(
            f"{path}: has {components} values a pixel; export grey values, one a pixel"
        )
    spoilt = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
    if len(spoilt):
        raise InputError(
            f"{path}: frame {spoilt[0]} has pixels that are no numbers ({len(spoilt)} of "
            f"{len(values)} frames do); export grey values from 0 to 255"
        )
    return values


def _as_scanned(path: Path, images: Any, header: Fields) -> tuple[Any, tuple[str, ...]]:
    """Pixels whose columns count up to the transducer's marked side, and rows away from it: MF;
    and what is to be told of it.

    ImageToProbe belongs to pictures in this order, to which PLUS turns others when it reads them.
    """
    orientation = header.get("UltrasoundImageOrientation", "MF").upper()
    if not re.fullmatch("[MU][FN][AD]?|XX|", orientation):
        raise InputError(
            f"{path}: UltrasoundImageOrientation is {orientation}; it needs MF, UF, MN or UN "
            "(columns count up to the marked or unmarked side, rows to the far or near end)"
        )
    if orientation in ("", "XX"):
        return images, ("UltrasoundImageOrientation is unknown, taken for MF",)
    if orientation[0] == "U":
        images = images[:, :, ::-1]
    return images[:, ::-1] if orientation[1] == "N" else images, ()


def _frame_fields(path: Path, header: Fields, slices: int) -> list[Fields]:
    """The fields of each frame; those of the whole file stand in where a frame has none."""
    shared = {key: value for key, value in header.items() if not _FRAME_KEY.fullmatch(key)}
    frames: dict[int, Fields] = {}
    for key, value in header.items():
        if match := _FRAME_KEY.fullmatch(key):
            frames.setdefault(int(match[1]), {})[match[2]] = value
    if sorted(frames) != list(range(slices)):
        raise InputError(
            f"{path}: holds {slices} images but describes {len(frames)} frames "
            f"({_span(frames)}); a sequence has Seq_Frame0000_... fields for every image, numbered "
            "from 0; export it again from PLUS or 3D Slicer"
        )
    return [shared | frames[k] for k in range(slices)]


def _span(frames: dict[int, Fields]) -> str:
    return f"numbers {min(frames)} to {max(frames)}" if frames else "no Seq_Frame fields"


def _time_s(fields: Fields, where: str) -> float:
    text = fields.get("Timestamp", "nothing")
    try:
        time_s = float(text)
    except ValueError:
        time_s = np.nan
    if not np.isfinite(time_s):
        raise InputError(f"{where}: Timestamp is {text}; it needs seconds on the ECG's clock")
    return time_s


def _require_rising(path: Path, times_s: Float, numbers: list[int]) -> None:
    back = np.flatnonzero(np.diff(times_s) <= 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{path}: time does not rise from frame {numbers[k]} ({times_s[k]} s) to frame "
            f"{numbers[k + 1]} ({times_s[k + 1]} s); {len(back)} such steps; time stamps must rise "
            "from frame to frame; sort the frames or mend the recorder's clock"
        )
