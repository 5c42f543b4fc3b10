"""Read tracked ultrasound sweeps: PLUS / SlicerIGT sequences in MetaImage files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, require_rigid

_FRAME_KEY = re.compile(r"Seq_Frame(\d+)_(\w+)")
# Pixels of a medical scanner, in mm: outside this the matrix is in other units, or no calibration.
_PIXEL_MM = (0.01, 4.0)

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

    dropped: int = 0
    """Frames of the file left out because the tracker marked them as not valid."""


def read_sweep(path: Path) -> Sweep:
    """Read a ``.mha`` or ``.mhd`` sequence of 2D frames with a pose and a time for each.

    Frames whose image or transforms carry a status other than OK are left out and counted. The
    pose is ``ProbeToTrackerTransform @ ImageToProbeTransform``; either may stand once for the
    whole file instead of in each frame.

    Raises
    ------
    InputError
        When the file is missing, truncated or no sequence of grey 2D frames, when a time or a
        transform is missing, not finite, not rigid or not a calibration in mm, when time stamps
        do not rise, or when no valid frame is left.
    """
    path = Path(path)
    images, header = _read_image(path)
    frames = _frame_fields(path, header, len(images))
    valid = [k for k, fields in enumerate(frames) if _is_valid(fields)]
    if not valid:
        raise InputError(
            f"{path}: none of its {len(frames)} frames has status OK; the probe was out of the "
            "tracker's sight; record the sweep again"
        )
    times_s = np.array([_time_s(frames[k], f"{path}, frame {k}") for k in valid])
    _require_rising(path, times_s, valid)
    poses = [_tracker_from_image(frames[k], f"{path}, frame {k}") for k in valid]
    kept = np.asarray(images[valid], dtype=np.float32)
    return Sweep(path.stem, kept, times_s, np.stack(poses), len(frames) - len(valid))


def _read_image(path: Path) -> tuple[Any, Fields]:
    """Pixels ``(n, rows, columns)`` and the header's custom fields."""
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file; a sweep is a .mha, or a .mhd with its raw file")
    reader = sitk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(str(path))
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise InputError(
            f"{path}: cannot be read as a MetaImage sequence, or ends too early ({_gist(error)}); "
            "copy it again from the tracking computer"
        ) from error
    _require_grey_frames(path, image)
    fields = {key: image.GetMetaData(key).strip() for key in image.GetMetaDataKeys()}
    return sitk.GetArrayFromImage(image), fields


def _gist(error: RuntimeError) -> str:
    """The last line of SimpleITK's report, which says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else "no reason given"


def _require_grey_frames(path: Path, image: Any) -> None:
    size, components = image.GetSize(), image.GetNumberOfComponentsPerPixel()
    if len(size) != 3:
        raise InputError(
            f"{path}: has {len(size)} dimensions {size}; a sweep is a stack of 2D frames "
            "(columns, rows, frames); 3D probes are not supported"
        )
    if components != 1:
        raise InputError(
            f"{path}: has {components} values a pixel; export grey values, one a pixel"
        )


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


def _is_valid(fields: Fields) -> bool:
    """Whether no status that concerns the pose or the picture says otherwise."""
    names = ("ProbeToTrackerTransformStatus", "ImageToProbeTransformStatus", "ImageStatus")
    return all(fields.get(name, "OK").upper() == "OK" for name in names)


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


def _tracker_from_image(fields: Fields, where: str) -> Float:
    """Pixel to tracker of one frame, each link of the chain checked."""
    tracker_from_probe = _matrix(fields, "ProbeToTrackerTransform", where)
    require_rigid(tracker_from_probe, f"{where}: ProbeToTrackerTransform")
    probe_from_image = _matrix(fields, "ImageToProbeTransform", where)
    _require_calibration(probe_from_image, f"{where}: ImageToProbeTransform")
    return np.asarray(tracker_from_probe @ probe_from_image)


def _matrix(fields: Fields, name: str, where: str) -> Float:
    """The 4x4 matrix in field ``name``, row by row."""
    if name not in fields:
        others = sorted(key for key in fields if key.endswith("Transform"))
        raise InputError(
            f"{where}: has no {name}; its transforms are {', '.join(others) or 'none'}; a sweep "
            "needs ProbeToTracker (the marker's pose) and ImageToProbe (the calibration)"
        )
    try:
        values = np.array([float(word) for word in fields[name].split()])
    except ValueError:
        values = np.array([np.nan])
    if values.shape != (16,) or not np.isfinite(values).all():
        raise InputError(f"{where}: {name} needs 16 finite numbers, got {fields[name]!r}")
    return values.reshape(4, 4)


def _require_calibration(probe_from_image: Float, where: str) -> None:
    """Refuse a matrix that does not spread the pixels over a plane in millimetres."""
    across, down = probe_from_image[:3, 0], probe_from_image[:3, 1]
    pixel_mm = np.linalg.norm(across), np.linalg.norm(down)
    flat = np.linalg.norm(np.cross(across, down)) > 0.9 * pixel_mm[0] * pixel_mm[1]
    sized = _PIXEL_MM[0] <= min(pixel_mm) and max(pixel_mm) <= _PIXEL_MM[1]
    if not (flat and sized and np.allclose(probe_from_image[3], (0, 0, 0, 1))):
        raise InputError(
            f"{where}: is no calibration of pixels in mm: its pixels are {pixel_mm[0]:.3g} by "
            f"{pixel_mm[1]:.3g} mm; it needs two crossing axes of {_PIXEL_MM[0]} to "
            f"{_PIXEL_MM[1]} mm a pixel and a last row of 0 0 0 1, got\n{probe_from_image}"
        )
