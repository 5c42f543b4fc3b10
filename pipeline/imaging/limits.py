"""How much a file may claim to hold: what is larger is damaged, or made to use up the memory."""

from __future__ import annotations

from pipeline.errors import InputError

MOST_VALUES = 1 << 30
"""Grey values of a file; 40 phases of 30 slices of 512 x 512 are 300 million."""

MOST_PIXELS = 1 << 24
"""Of one image of a slice: 4096 x 4096."""

FARTHEST_MM = 1e6
"""From the scanner's origin: no bore is as long, even told in micrometres."""


def require_bounded(values: int, where: str, most: int = MOST_VALUES) -> None:
    """Refuse a file before its pixels are unpacked, which a few kilobytes can make gigabytes.

    Raises
    ------
    InputError
        When it claims more values than ``most``.
    """
    if values > most:
        raise InputError(
            f"{where}: its header tells of {values:.3g} values, which take {values * 4e-9:.3g} GB "
            f"of memory; at most {most:.3g} are read: copy it again if the header is "
            "damaged, or store fewer phases, frames or pixels"
        )
