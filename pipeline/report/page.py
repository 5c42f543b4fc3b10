"""One self-contained page: sections of text, tables and pictures, through a template."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml", "webp": "image/webp"}

UNITS = {
    "_n_per_0_1_mm": "N over 0.1 mm",
    "_n_per_mm": "N/mm",
    "_n_per_ms": "N/ms",
    "_n_per_m": "N/m",
    "_n": "N",
    "_mm": "mm",
    "_ml": "ml",
    "_g": "g",
    "_ms": "ms",
    "_s": "s",
    "_deg": "degrees",
}
"""What the end of a figure's name says of its unit; longer ends first."""


@dataclass(frozen=True, slots=True)
class Picture:
    """An image inside the page itself."""

    caption: str
    source: str
    """A ``data:`` address."""

    still: str = ""
    """Of what moves: the same at rest, for readers who want nothing to move, and for paper."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text under a head."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, a sentence or two, and what there is to see."""

    title: str
    text: str
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()


@dataclass(frozen=True, slots=True)
class Opening:
    """What the page says before any figure."""

    headline: str
    """What the field may be taken for."""

    warnings: Sequence[str] = ()
    """What speaks against it."""

    told: Sequence[str] = ()
    """What is to be known, and speaks neither for nor against it."""


def picture(caption: str, content: bytes, kind: str, still: bytes | None = None) -> Picture:
    """Embed an image; ``kind``, which is that of ``still`` too, is png, svg or webp."""
    return Picture(caption, _address(content, kind), _address(still, kind) if still else "")


def _address(content: bytes, kind: str) -> str:
    return f"data:{MEDIA_TYPES[kind]};base64,{base64.b64encode(content).decode()}"


def is_single(value: object) -> bool:
    """Whether a figure stands for itself and is no list or table."""
    return not isinstance(value, dict | list)


def figure_row(name: str, value: object) -> tuple[str, str]:
    """A figure as people read it: ``drift_max_mm``, 0.0123 becomes drift max, 0.0123 mm."""
    ending = next((one for one in UNITS if name.endswith(one)), "")
    text = str(value)
    if isinstance(value, float):
        text = f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    words = name.removesuffix(ending).replace("_", " ")
    if value is None:
        return words, "unknown"
    if ending in ("_n_per_0_1_mm", "_n_per_mm", "_n_per_ms"):
        # Figures that differ in what they are taken over alone have different names.
        words += ending[ending.index("_per_") :].replace("0_1", "0.1").replace("_", " ")
    return words, f"{text} {UNITS.get(ending, '')}".strip()


def flat_table(title: str, figures: Mapping[str, Any]) -> Table:
    """Single figures as rows; what is told per phase or structure stays in the JSON files."""
    rows: list[tuple[str, str]] = []
    for name, value in figures.items():
        if isinstance(value, dict):
            # The unit stands at the end of the group's name, for all of its figures.
            words, unit = figure_row(name, "")
            rows += [
                (f"{words} {part}", f"{text} {unit}".rstrip())
                for part, text in (figure_row(*one) for one in value.items() if is_single(one[1]))
            ]
        elif is_single(value):
            rows.append(figure_row(name, value))
    return Table((title, ""), rows)


def render(
    patient_id: str,
    summary: Sequence[tuple[str, str]],
    sections: Sequence[Section],
    example: Mapping[str, Any],
    opening: Opening,
) -> str:
    """The page as HTML; text is escaped."""
    return filled(
        Path(__file__).parent,
        patient_id=patient_id,
        summary=summary,
        sections=sections,
        example=example,
        opening=opening,
    )


def filled(folder: Path, **values: Any) -> str:
    """The template ``page.html.j2`` of a folder with values in it, all of which it must get."""
    templates = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    return templates.get_template("page.html.j2").render(values)
