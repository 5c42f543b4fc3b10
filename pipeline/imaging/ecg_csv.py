"""Read an electrocardiogram from a table of times and millivolts."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.imaging.voltages import is_voltage, unit_name

UNIT_OF_LEAD = re.compile(r"[(\[]\s*([^()\[\]]*?)\s*[)\]]$|[_\s]([munµμ]V)$", re.IGNORECASE)
"""A unit behind a lead's name, as in ``I (uV)`` or ``I_uV``."""

LEAD = re.compile(r"I{1,3}|aV[RLF]|V\d?R?|MCL?\d?|ML ?I{1,3}|[XYZ]|", re.IGNORECASE)
"""What in its place is no unit but the lead, as in ``lead (II)``."""

# Samples a second of an ECG: no two units of time that are a thousandfold apart both fit.
_RATES_HZ = (100.0, 2000.0)
# Steps by which times of samples that were taken in order may stray from an even grid.
_JITTER_STEPS = 5.0
MOST_COLUMNS = 256


def read_csv(path: Path) -> tuple[Float, tuple[str, ...], float, float]:
    """Millivolts ``(n, leads)``, the leads' names, samples a second, and the first one's time.

    Raises
    ------
    InputError
        When the table is no such, or its times are uneven or no seconds.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # As Windows of western countries writes a micro sign.
        text = content.decode("cp1252", errors="replace")
    lines = text.strip().splitlines()
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if len(names) < 2 or names[0] != "time_s":
        raise InputError(
            f"{path}: the first row, of {len(names)} cells, is no header: it needs time_s and then "
            f"the name of each lead, separated by commas{_remedy(lines[0] if lines else '')}"
        )
    if len(names) > MOST_COLUMNS:
        raise InputError(
            f"{path}: has {len(names)} columns, at most {MOST_COLUMNS} are read; leave those that "
            "are no leads out"
        )
    for name in names[1:]:
        _require_millivolts(name, path)
    rows = [_csv_row(path, number, line, len(names)) for number, line in enumerate(lines[1:], 2)]
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} rows of samples; it needs 2 or more")
    table = np.array(rows)
    step_s = _even_step_s(table[:, 0], path)
    return table[:, 1:], tuple(names[1:]), 1 / step_s, float(table[0, 0])


def _require_millivolts(name: str, path: Path) -> None:
    """Refuse a column whose name says that it holds something else."""
    found = UNIT_OF_LEAD.search(name)
    unit = "mV" if found is None else found[1] or found[2] or ""
    if LEAD.fullmatch(unit) or unit_name(unit) == "mv":
        return
    remedy = (
        "take the column out, for pressures and marks have beats of their own (of a lead that was "
        "not calibrated, write mV: its scale changes no R peak)"
    )
    if is_voltage(unit):
        remedy = "write the values so, and (mV) or nothing behind the name"
    raise InputError(
        f"{path}: lead {name!r} is in {unit}; a CSV file holds the millivolts of an ECG: {remedy}"
    )


def _remedy(header: str) -> str:
    """What to do about a first row that is no header of an ECG, where that can be told."""
    if "\x00" in header:
        return "; the text is UTF-16: save it as UTF-8"
    if header.startswith("#"):
        return "; delete the lines of comments above"
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if mark in header:
            return f", not by {word}: replace them, and first of all any decimal commas by points"
    if header.lstrip('"').lower().startswith(("time", "t,", "t ", "t(", "t[")):
        return "; call the first column time_s, without quotes, and let it hold seconds"
    return ""


def _csv_row(path: Path, number: int, line: str, columns: int) -> list[float]:
    """The numbers of one line; a refusal does not repeat it, for it may name the patient."""
    cells = line.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) == columns and not any(map(math.isinf, values)) and math.isfinite(values[0]):
        return values
    remedy = "mend it, and delete no line: a gap in time is refused"
    if not any(cell.strip() for cell in cells):
        remedy = "delete it, and all behind it, if the recording ends there"
    elif ":" in cells[0]:
        remedy = "write times as seconds"
    elif number == 2 and len(cells) == columns and not any(_is_number(cell) for cell in cells):
        remedy = "delete it if it gives units: times are seconds, values millivolts"
    elif len(cells) == columns and not all(cell.strip() for cell in cells[1:]):
        remedy = "write nan where a sample is missing"
    elif "." not in line and len(cells) == 2 * columns:
        remedy = "decimal commas look like separators: write points"
    wrong = [place for place, cell in enumerate(cells, 1) if not _is_sample(cell, place == 1)]
    which = f"; no number is in cell {', '.join(map(str, wrong[:8]))}" if wrong else ""
    raise InputError(
        f"{path}, line {number}: needs {columns} numbers separated by commas, has "
        f"{len(cells)} cells{which}; {remedy}"
    )


def _is_sample(cell: str, is_time: bool) -> bool:
    """Whether a cell holds a time, or millivolts, which may be missing."""
    try:
        value = float(cell)
    except ValueError:
        return False
    return math.isfinite(value) or (math.isnan(value) and not is_time)


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"'))
    except ValueError:
        return False
    return True


def _even_step_s(times_s: Float, path: Path) -> float:
    """Time between samples; each must lie within half a step of an even grid."""
    steps_s = np.diff(times_s)
    number = np.arange(len(times_s)) - (len(times_s) - 1) / 2
    # Least squares: the ends alone would carry their own rounding into the rate.
    even_s = float(number @ (times_s - times_s[0]) / (number @ number))
    off_s = times_s - times_s.mean() - even_s * number
    if not (steps_s > 0).all():
        worst = int(np.argmin(steps_s > 0))
        _refuse_jitter(off_s, even_s, steps_s, path)
        raise InputError(
            f"{path}: time_s does not rise from {times_s[worst]} to {times_s[worst + 1]} s "
            f"(line {worst + 3}); {_mend_of_falling(steps_s)}"
        )
    _require_seconds(float(np.median(steps_s)), path)
    # Rounded times stay within half a step of the grid and no step doubles; a lost sample does it.
    if np.ptp(off_s) > even_s or steps_s.max() > 1.75 * even_s:
        _refuse_jitter(off_s, even_s, steps_s, path)
        gap = int(np.argmax(steps_s))
        raise InputError(
            f"{path}: samples are not evenly spaced: {steps_s[gap]:.6g} s after {times_s[gap]} s "
            f"(line {gap + 2}), where {even_s:.6g} s is the mean; fill the gap with rows whose "
            "leads are nan, or cut the recording there"
        )
    return even_s


def _mend_of_falling(steps_s: Float) -> str:
    """What to do about times that do not rise."""
    if steps_s.min() == 0:
        return "take one of the two rows out if it is a copy, else write the time of each"
    if (steps_s < 0).sum() > 1:
        return "sort the rows by time"
    short_s = float(np.median(steps_s) - steps_s.min())
    return (
        f"if the clock was set back there, or passed midnight, add {short_s:.6g} s to the times "
        "from that line on; else sort the rows by time"
    )


def _refuse_jitter(off_s: Float, even_s: float, steps_s: Float, path: Path) -> None:
    """Refuse times that scatter about an even grid: no row is missing or in another's place."""
    # Of a gap, or of a few rows that changed places, nearly all steps are the usual one.
    uneven = np.abs(steps_s - even_s) > 0.1 * even_s
    # Times that stand still, but never run back, are of samples that were stamped in blocks.
    near = np.abs(off_s).max() < _JITTER_STEPS * even_s or steps_s.min() == 0
    if near and uneven.mean() > 0.5:
        raise InputError(
            f"{path}: time_s scatters by up to {1e3 * np.abs(off_s).max():.3g} ms about an even "
            f"grid of {1e3 * even_s:.3g} ms, too much to tell which sample is which; no row is "
            "missing: if the samples were taken evenly, write the time of the first plus the "
            "number of the row over the sampling rate; if not, resample them"
        )


def _require_seconds(step_s: float, path: Path) -> None:
    """Refuse times that are those of an ECG in another unit."""
    for unit, count in (("milliseconds", 1e3), ("microseconds", 1e6)):
        rate_hz = count / step_s
        if _RATES_HZ[0] <= rate_hz <= _RATES_HZ[1]:
            raise InputError(
                f"{path}: time_s rises by {step_s:.6g} from row to row, which is "
                f"{1 / step_s:.3g} samples a second; is it in {unit} ({rate_hz:.4g} samples a "
                f"second)? it needs seconds: divide it by {count:.0f}"
            )
