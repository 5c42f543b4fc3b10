"""MetaImage files: their pixels and headers, and what is wrong with damaged ones."""

from __future__ import annotations

import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.imaging.limits import require_bounded
from pipeline.regular_files import require_text_name

# Bytes of one value, by its name in a MetaImage header; others are the library's to check.
_VALUE_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip
_HEADER_LINE = re.compile(r"\s*(\w+)\s*[=:](.*)")
_HEADER_ENDS = "ElementDataFile"
SPACING = "ElementSpacing"
"""Field of the header: width and height of a pixel, 1 where it has none."""
_SEVERAL_FILES = re.compile(r"%|^LIST\b|\s\d+\s+\d+")
# A file a frame, numbered from, to and by: the library hands the name to C's printf.
_NUMBERED = re.compile(r"[^%]*%0?\d{0,3}d[^%]*(\s+\d{1,6}){2,3}")
# Of digits.
_LONGEST_NUMBER = 12
# A file of another kind may have no lines at all.
_LONGEST_LINE = 65536
_PART_BYTES = 1 << 20
_COPY = "copy it again from the tracking computer"

Fields = dict[str, str]


def read_metaimage(path: Path) -> tuple[Any, Fields]:
    """Pixels ``(n, rows, columns)`` of a sequence, and the header's custom fields and `SPACING`.

    Raises
    ------
    InputError
        When the file is damaged, or its frames are not 2D images of one grey value a pixel.
    """
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file; a sweep is a .mha, or a .mhd with its raw file")
    require_text_name(path)
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
    try:
        fields = {key: image.GetMetaData(key).strip() for key in image.GetMetaDataKeys()}
    except (TypeError, UnicodeError) as error:
        raise InputError(f"{path}: a name in its header is no text ({error}); {_COPY}") from error
    fields[SPACING] = " ".join(f"{size:.9g}" for size in image.GetSpacing()[:2])
    return _grey_frames(path, image, sitk.GetArrayFromImage(image)), fields


def _require_all_bytes(path: Path) -> None:
    """Refuse a file whose pixels are missing, end before they should, or cannot be unpacked.

    The library tells the terminal of it, not what is wrong, and takes damaged ones as they are.
    """
    header, start = _header_of(path)
    whole, where = _bytes_told(path, header), header.get(_HEADER_ENDS, "")
    if "%" in where and not _NUMBERED.fullmatch(where):
        raise InputError(
            f"{path}: {_HEADER_ENDS} = {where} names no files; it needs LOCAL, the name of one, or "
            "a pattern such as image%03d.raw 0 9 1"
        )
    if _SEVERAL_FILES.search(where):
        return
    pixels = path if where.upper() == "LOCAL" else path.parent / where
    if not pixels.is_file():
        raise InputError(f"{path}: its pixels are in {pixels}, which is no file; copy it beside it")
    start = start if pixels == path else 0
    packed = header.get("CompressedData", "False").upper() == "TRUE"
    needed = _number(header.get("CompressedDataSize")) if packed else whole
    # Of a file of its own the library takes all there is.
    if needed is None and pixels == path:
        raise InputError(
            f"{path}: does not say how long its compressed pixels are (CompressedDataSize); save "
            "it again, or uncompressed"
        )
    found = pixels.stat().st_size - start
    if needed is not None and found < needed:
        raise InputError(
            f"{pixels}: ends too early: its pixels need {needed} bytes, it holds {found} of them; "
            f"{_COPY}"
        )
    if packed:
        _require_unpacked(pixels, start, whole)


def _bytes_told(path: Path, header: Fields) -> int:
    """How many bytes the pixels take, unpacked; refuse a header that is none of grey frames."""
    values, kind = _values(header), header.get("ElementType", "")
    if values is None:
        raise InputError(f"{path}: its header tells no DimSize in whole numbers; {_COPY}")
    require_bounded(values, str(path))
    if kind not in _VALUE_BYTES:
        raise InputError(
            f"{path}: ElementType is {kind or 'missing'}; it needs one of {', '.join(_VALUE_BYTES)}"
        )
    axes = len(header["DimSize"].split())
    if header.get("Kinds", "").startswith("vector"):
        count = header["DimSize"].split()[0]
        raise InputError(
            f"{path}: has {count} values a pixel (Kinds begins with vector), as PLUS stores "
            "colour; record or export grey values, one a pixel"
        )
    if header.get("NDims", "") != str(axes) or not 2 <= axes <= 4:
        raise InputError(
            f"{path}: NDims is {header.get('NDims', 'missing')} and DimSize has {axes} numbers; a "
            f"sequence has three of both; {_COPY}"
        )
    return values * _VALUE_BYTES[kind]


def _require_unpacked(path: Path, start: int, needed: int) -> None:
    """Refuse compressed pixels that are damaged, or more than the header says."""
    # Of zlib or gzip, whichever it says.
    unpacking, found = zlib.decompressobj(32 + zlib.MAX_WBITS), 0
    try:
        with path.open("rb") as file:
            file.seek(start)
            while not unpacking.eof and (
                part := unpacking.unconsumed_tail or file.read(_PART_BYTES)
            ):
                found += len(unpacking.decompress(part, _PART_BYTES))
                if found > needed:
                    # Gigabytes may be packed into little: not unpacked any further.
                    raise InputError(
                        f"{path}: its compressed pixels are more than the {needed} bytes that its "
                        f"header says; {_COPY}"
                    )
    except zlib.error as error:
        raise InputError(f"{path}: its compressed pixels are damaged ({error}); {_COPY}") from error
    if found < needed:
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
    return int(word) if word and word.isdecimal() and len(word) <= _LONGEST_NUMBER else None


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
