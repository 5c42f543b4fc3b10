"""What a folder of images holds beside the stack, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One file or frame that is not part of the stack."""

    where: str
    series: str
    series_uid: str
    reason: str
    noun: str = "image"


def left_out_lines(left_out: Iterable[LeftOut], folder: str) -> tuple[str, ...]:
    """One line a series and reason, in the order of the files, which are named from ``folder``."""
    groups: dict[tuple[str, str, str, str], list[str]] = {}
    for one in sorted(left_out, key=lambda one: one.where):
        name = inside(one.where, folder)
        groups.setdefault((one.series_uid, one.series, one.reason, one.noun), []).append(name)
    return tuple(
        f"{series}: {describe(names, noun)}: {reason}"
        for (_, series, reason, noun), names in groups.items()
    )


def inside(where: str, folder: str) -> str:
    """A file's name as counted from the folder that was read."""
    return where.removeprefix(folder).lstrip("/\\")


def describe(names: Sequence[str], noun: str = "image") -> str:
    """How many there are, and where the first of them is."""
    if len(names) == 1:
        return f"1 {noun} ({names[0]})"
    return f"{len(names)} {noun}s (the first is {names[0]})"
