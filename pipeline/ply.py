"""What a PLY file must hold for VTK's reader, which else ends the whole process."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.errors import InputError

_CODES = {
    name: code
    for code, names in {
        "b": "char int8",
        "B": "uchar uint8",
        "h": "short int16",
        "H": "ushort uint16",
        "i": "int int32",
        "I": "uint uint32",
        "f": "float float32",
        "d": "double float64",
    }.items()
    for name in names.split()
}


class _Element(NamedTuple):
    """What a header says of one kind of thing, and of each of its properties."""

    name: str
    things: int
    kinds: list[list[str]]


def require_sound_ply(path: Path, content: bytes) -> None:
    """Refuse a file that ends too soon, or whose faces name vertices that are none.

    Raises
    ------
    InputError
        When it does so, or has no header of a PLY file.
    """
    head, found, body = content.partition(b"end_header")
    if not found:
        raise InputError(f"{path}: is no whole PLY file: its header does not end; copy it again")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    try:
        elements = _elements(lines)
        # The line of `end_header` may end with two characters.
        values = _Text(body) if form == "ascii" else _Bytes(body.partition(b"\n")[2], form)
        _require_known_vertices(path, elements, values)
    except (struct.error, StopIteration) as error:
        raise InputError(
            f"{path}: is cut off: its body has fewer values than the header promises; copy it again"
        ) from error
    except (KeyError, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: cannot be read as a PLY file ({error})") from error


def _elements(lines: list[list[str]]) -> list[_Element]:
    elements: list[_Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1].kinds.append(words[1:])
    return elements


def _require_known_vertices(path: Path, elements: list[_Element], values: _Text | _Bytes) -> None:
    vertices = next((one.things for one in elements if one.name == "vertex"), 0)
    for element in elements:
        if not any(kind[0] == "list" for kind in element.kinds):
            values.skip(element)
            continue
        for number in range(element.things):
            for kind in element.kinds:
                found = values.read(kind)
                corners = element.name == "face" and kind[-1].startswith("vertex_ind")
                if corners and not (len(found) > 2 and 0 <= min(found) <= max(found) < vertices):
                    raise InputError(
                        f"{path}: face {number} has the corners {[int(one) for one in found]}, of "
                        f"{vertices} vertices; export the surface again"
                    )


class _Text:
    """Values of a body in text, one after another."""

    def __init__(self, body: bytes) -> None:
        self.words: Iterator[bytes] = iter(body.split())

    def skip(self, element: _Element) -> None:
        for _ in range(element.things * len(element.kinds)):
            next(self.words)

    def read(self, kind: list[str]) -> Sequence[float]:
        count = int(next(self.words)) if kind[0] == "list" else 1
        return [float(next(self.words)) for _ in range(count)]


class _Bytes:
    """Values of a binary body, one after another."""

    def __init__(self, body: bytes, form: str) -> None:
        self.body, self.at = body, 0
        self.order = {"binary_little_endian": "<", "binary_big_endian": ">"}[form]

    def skip(self, element: _Element) -> None:
        each = struct.calcsize("=" + "".join(_CODES[kind[0]] for kind in element.kinds))
        self.at += element.things * each
        if self.at > len(self.body):
            raise struct.error

    def read(self, kind: list[str]) -> Sequence[float]:
        count = int(self._take(_CODES[kind[1]])[0]) if kind[0] == "list" else 1
        return self._take(f"{count}{_CODES[kind[-2]]}")

    def _take(self, code: str) -> Sequence[float]:
        found = struct.unpack_from(self.order + code, self.body, self.at)
        self.at += struct.calcsize(self.order + code)
        return found
