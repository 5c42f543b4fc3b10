"""Read tracked ultrasound sweeps: PLUS / SlicerIGT sequences in MetaImage files."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, require_rigid

_FRAME_KEY = re.compile(r"Seq_Frame(\d+)_(\w+)")
# Pixels of a medical scanner, in mm: outside this the matrix is in other units, or no calibration.
_PIXEL_MM = (0.01, 4.0)

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
    images = _as_scanned(path, images, header)
    frames = _frame_fields(path, header, len(images))
    valid = [k for k, fields in enumerate(frames) if _is_valid(fields)]
    if not valid:
        raise InputError(
            f"{path}: none of its {len(frames)} frames has status OK; the probe was out of the "
            "tracker's sight; record the sweep again"
        )
    times_s = np.array([_time_s(frames[k], f"{path}, frame {k}") for k in valid])
    _require_rising(path, times_s, valid)
    links = [_links(frames[k], f"{path}, frame {k}") for k in valid]
    tracker_from_probe, probe_from_image = (np.stack(link) for link in zip(*links, strict=True))
    return Sweep(
        path.stem,
        np.asarray(images[valid], dtype=np.float32),
        times_s,
        tracker_from_probe @ probe_from_image,
        tracker_from_probe,
        len(frames) - len(valid),
    )


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
            f"ProbeToTracker looks as if it were in metres: over all sweeps the probe moves by "
            f"{spread_mm:.3g} mm, at {furthest_mm:.3g} mm from the tracker or nearer; give mm"
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
    _require_grey_frames(path, image)
    fields = {key: image.GetMetaData(key).strip() for key in image.GetMetaDataKeys()}
    return sitk.GetArrayFromImage(image), fields


def _require_all_bytes(path: Path) -> None:
    """Refuse a file whose pixels are missing, end before they should, or cannot be unpacked.

    The library tells the terminal of it, not what is wrong, and takes damaged ones as they are.
    """
    header, start = _header_of(path)
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
    needed = _number(header.get("CompressedDataSize")) if packed else _pixel_bytes(header)
    found = pixels.stat().st_size - (start if pixels == path else 0)
    if needed is not None and found < needed:
        raise InputError(
            f"{pixels}: ends too early: its pixels need {needed} bytes, it holds {found} of them; "
            f"{_COPY}"
        )
    if packed:
        _require_unpacked(pixels, start if pixels == path else 0, _pixel_bytes(header))


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


def _pixel_bytes(header: Fields) -> int | None:
    """How many bytes all pixels take; None where the header does not say."""
    sizes = [_number(word) for word in header.get("DimSize", "?").split()]
    sizes += [
        _number(header.get("ElementNumberOfChannels", "1")),
        _VALUE_BYTES.get(header.get("ElementType", "")),
    ]
    known = [size for size in sizes if size is not None]
    return math.prod(known) if len(known) == len(sizes) else None


def _number(word: str | None) -> int | None:
    return int(word) if word and word.isdecimal() else None


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


def _as_scanned(path: Path, images: Any, header: Fields) -> Any:
    """Pixels whose columns count up to the transducer's marked side, and rows away from it: MF.

    ImageToProbe belongs to pictures in this order, to which PLUS turns others when it reads them.
    """
    orientation = header.get("UltrasoundImageOrientation", "MF").upper()
    if not re.fullmatch("[MU][FN][AD]?|XX", orientation):
        raise InputError(
            f"{path}: UltrasoundImageOrientation is {orientation}; it needs MF, UF, MN or UN "
            "(columns count up to the marked or unmarked side, rows to the far or near end)"
        )
    if orientation[0] == "U":
        images = images[:, :, ::-1]
    return images[:, ::-1] if orientation[1] == "N" else images


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


def _links(fields: Fields, where: str) -> tuple[Float, Float]:
    """Probe to tracker, and pixel to probe, of one frame, each checked."""
    tracker_from_probe = _matrix(fields, "ProbeToTrackerTransform", where)
    require_rigid(tracker_from_probe, f"{where}: ProbeToTrackerTransform")
    probe_from_image = _matrix(fields, "ImageToProbeTransform", where)
    _require_calibration(probe_from_image, f"{where}: ImageToProbeTransform")
    return tracker_from_probe, probe_from_image


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
