"""Read an electrocardiogram from WFDB, CSV or DICOM waveform files."""

from __future__ import annotations

import hashlib
import importlib
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Mask
from pipeline.study_files import names_in_header

MILLIVOLTS = {"v": 1e3, "mv": 1.0, "uv": 1e-3, "nv": 1e-6}
"""Millivolts in one unit, by its name in lower case."""

MICRO_UNIT = re.compile(rb"^[^#\s]\S*\s+\S+\s+\S*/\S*?(?:\xb5|\xce\xbc)", re.MULTILINE)
"""A signal's line whose unit, after file and format, has a micro sign (Latin-1 or UTF-8, where
another byte stands before it) or the Greek letter."""

UNIT_OF_LEAD = re.compile(r"[(\[]\s*([^\W\d_]{1,2})\s*[)\]]$")
"""A unit behind a lead's name, as in ``I (uV)``."""

# Samples a second of an ECG: no two units of time that are a thousandfold apart both fit.
_RATES_HZ = (100.0, 2000.0)
# Steps by which times of samples that were taken in order may stray from an even grid.
_JITTER_STEPS = 5.0


@dataclass(frozen=True, slots=True)
class Ecg:
    """A recording of one or more leads, evenly sampled."""

    signal_mv: Float
    """``(n, leads)`` millivolts; unless gaps were asked for, finite, and no lead constant."""

    leads: tuple[str, ...]
    """Name of each column."""

    sampling_rate_hz: float
    """Samples a second."""

    start_s: float = 0.0
    """Time of the first sample on the recording's own clock."""

    patient: str = ""
    """The patient's identifier; empty where the file does not tell, as of all formats but DICOM."""

    @property
    def recorded_s(self) -> tuple[float, float]:
        """Times of the first and of the last sample."""
        lasts_s = (len(self.signal_mv) - 1) / self.sampling_rate_hz
        return self.start_s, self.start_s + lasts_s


def read_ecg(path: Path, *, gaps: bool = False) -> Ecg:
    """Read one recording.

    Parameters
    ----------
    path
        A WFDB record (its stem, or its ``.hea`` or ``.dat`` file), a ``.csv`` table (a header row,
        first column ``time_s``, then one column of millivolts a lead), or a DICOM waveform file.
    gaps
        Take leads with missing samples (not a number then) and constant ones too, as long as there
        is another; leave out channels of a WFDB record that are no voltage.

    Raises
    ------
    InputError
        When the recording is missing, truncated, in an unknown unit, unevenly sampled, or has a
        lead that is constant or not finite.
    """
    path = Path(path)
    header = path.with_suffix(".hea") if path.suffix == ".dat" else Path(f"{path}.hea")
    if path.suffix == ".hea" or header.is_file():
        ecg = _read_wfdb(path if path.suffix == ".hea" else header, gaps)
    elif path.is_dir():
        inside = sorted(one.name for end in ("hea", "csv", "dcm") for one in path.glob(f"*.{end}"))
        raise InputError(
            f"{path}: is a folder; name one ECG in it: {', '.join(inside) or 'there is none'}"
        )
    elif not path.is_file():
        raise InputError(
            f"{path}: no such ECG; neither this file nor {header.name} exists; name a WFDB record, "
            "a .csv table or a DICOM waveform file"
        )
    elif path.suffix.lower() == ".csv":
        ecg = _read_csv(path)
    else:
        ecg = _read_dicom(path)
    _require_usable(ecg, path, gaps)
    return ecg


@contextmanager
def _quiet_wfdb() -> Iterator[Any]:
    """The library, imported when first needed: it brings pandas, and calls deprecated parts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield importlib.import_module("wfdb")


def _read_wfdb(header: Path, gaps: bool) -> Ecg:
    """Read a record by its ``.hea`` file."""
    if not header.is_file():
        raise InputError(f"{header}: no such file; a WFDB record needs its .hea and .dat files")
    try:
        _require_plain_units(header)
        with _quiet_wfdb() as wfdb:
            record = wfdb.rdrecord(str(header.with_suffix("").absolute()), return_res=64)
    except InputError:
        raise
    # The library raises its parser's own errors (IndexError, TypeError ...) on damaged files.
    except Exception as error:
        raise InputError(
            f"{header}: cannot be read as a WFDB record ({error}); it needs a whole header and "
            "every .dat file it names, of the length it gives; copy the record again"
        ) from error
    return _wfdb_leads(record, header, gaps)


def _require_plain_units(header: Path) -> None:
    """Refuse a micro sign, which the library passes over: microvolts would be read as volts."""
    segments = (header.parent / f"{name}.hea" for name in names_in_header(header))
    for one in (header, *(path for path in segments if path.is_file())):
        if MICRO_UNIT.search(one.read_bytes()):
            raise InputError(
                f"{one}: has a unit with a micro sign, which a WFDB header cannot hold; write uV"
            )


def _wfdb_leads(record: Any, header: Path, gaps: bool) -> Ecg:
    """The channels of a record in millivolts."""
    if record.p_signal is None or not record.n_sig:
        raise InputError(f"{header}: holds no signal; a WFDB record of an ECG is needed")
    voltages = [k for k, unit in enumerate(record.units) if _is_voltage(unit)]
    kept = voltages if gaps and voltages else list(range(record.n_sig))
    factors = [_millivolts(record.units[k], str(header)) for k in kept]
    signal_mv = np.asarray(record.p_signal, dtype=float)[:, kept] * factors
    # A header need not name its signals.
    names = tuple(record.sig_name[k] or f"signal {k + 1}" for k in kept)
    return Ecg(signal_mv, names, float(record.fs))


def _read_csv(path: Path) -> Ecg:
    """Read a table of times and millivolts."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").strip().splitlines()
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if len(names) < 2 or names[0] != "time_s":
        raise InputError(
            f"{path}: the first row is {names}; it needs time_s and then the name of each lead, "
            f"separated by commas{_remedy(lines[0] if lines else '')}"
        )
    for name in names[1:]:
        unit = UNIT_OF_LEAD.search(name)
        if unit and _is_voltage(unit[1]) and _unit(unit[1]) != "mv":
            raise InputError(
                f"{path}: lead {name!r} is in {unit[1]}; a CSV file holds millivolts: write the "
                "values so, and (mV) or nothing behind the name"
            )
    rows = [_csv_row(path, number, line, len(names)) for number, line in enumerate(lines[1:], 2)]
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} rows of samples; it needs 2 or more")
    table = np.array(rows)
    step_s = _even_step_s(table[:, 0], path)
    return Ecg(table[:, 1:], tuple(names[1:]), 1 / step_s, float(table[0, 0]))


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
    """The numbers of one line."""
    cells = line.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) == columns and not any(map(math.isinf, values)) and math.isfinite(values[0]):
        return values
    remedy = "mend it, and delete no line: a gap in time is refused"
    if len(cells) == columns and not all(cell.strip() for cell in cells[1:]):
        remedy = "write nan where a sample is missing"
    elif "." not in line and len(cells) == 2 * columns:
        remedy = "decimal commas look like separators: write points"
    raise InputError(
        f"{path}, line {number}: needs {columns} numbers separated by commas, got {line!r}; "
        f"{remedy}"
    )


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
        mend = "take out the copy" if steps_s.min() == 0 else "sort the rows by time"
        raise InputError(
            f"{path}: time_s does not rise from {times_s[worst]} to {times_s[worst + 1]} s "
            f"(line {worst + 3}); {mend}"
        )
    _require_seconds(even_s, path)
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


def _read_dicom(path: Path) -> Ecg:
    """Read the longest group of channels of a DICOM waveform file."""
    import pydicom

    try:
        dataset = pydicom.dcmread(path)
    except Exception as error:
        raise InputError(
            f"{path}: is neither a WFDB record, nor .csv, nor DICOM ({error}); convert it to one"
        ) from error
    groups = dataset.get("WaveformSequence")
    if not groups:
        raise InputError(f"{path}: DICOM without WaveformSequence; it needs an ECG waveform object")
    # Resting ECGs carry the recording and, beside it, a short averaged beat.
    lengths = [int(group.get("NumberOfWaveformSamples") or 0) for group in groups]
    return _dicom_group(dataset, int(np.argmax(lengths)), path)


def _dicom_group(dataset: Any, index: int, path: Path) -> Ecg:
    """Decode one multiplex group of channels."""
    group = dataset.WaveformSequence[index]
    try:
        signal = np.array(dataset.waveform_array(index), dtype=float)
        signal[_is_padding(dataset, index)] = np.nan
        channels = list(group.ChannelDefinitionSequence)
        rate_hz = float(group.SamplingFrequency)
        names = tuple(_lead_name(channel) for channel in channels)
        units = [str(c.ChannelSensitivityUnitsSequence[0].CodeValue) for c in channels]
    except (
        AttributeError, TypeError, ValueError, IndexError, KeyError, NotImplementedError
    ) as error:  # fmt: skip
        raise InputError(
            f"{path}: the waveform cannot be decoded ({error}); it needs complete samples, a "
            "sampling frequency, and a source and a unit for each channel; export it again"
        ) from error
    scale = [_millivolts(unit, str(path)) for unit in units]
    patient = str(dataset.get("PatientID", "") or "").strip()
    return Ecg(signal * scale, names, rate_hz, patient=patient)


def patient_mark(patient: str) -> str:
    """What tells patients apart without naming them: products are shown to others; '' of ''.

    So short that thousands of a hospital's numbers share it: who tries them all finds no patient.
    """
    return hashlib.sha256(patient.encode()).hexdigest()[:3] if patient else ""


def other_patient(ecg: Ecg, cine_mark: str, path: Path) -> list[str]:
    """A sentence where an ECG is of another patient than the one marked; else none.

    Told, not refused: systems that write one patient under two identifiers are common.
    """
    if not ecg.patient or not cine_mark or patient_mark(ecg.patient) == cine_mark:
        return []
    return [f"{path} has another PatientID than the cine: make sure that both are of one patient"]


def _is_padding(dataset: Any, index: int) -> Mask:
    """Samples that stand for none ``(n, channels)``, which the library gives as they are."""
    from pydicom.waveforms import multiplex_array

    stored = multiplex_array(dataset, index, as_raw=True)
    padding = dataset.WaveformSequence[index].get("WaveformPaddingValue")
    # A record of zeros for padding says so of every sample without voltage, too.
    if not any(padding or b""):
        return np.zeros(stored.shape, bool)
    return np.asarray(stored == np.frombuffer(padding, stored.dtype)[0])


def _lead_name(channel: Any) -> str:
    """``II`` for a channel whose source is coded ``Lead II``."""
    return str(channel.ChannelSourceSequence[0].CodeMeaning).removeprefix("Lead ").strip()


def _unit(unit: str) -> str:
    return unit.strip().replace("µ", "u").replace("μ", "u").lower()


def _is_voltage(unit: str) -> bool:
    return _unit(unit) in MILLIVOLTS


def _millivolts(unit: str, where: str) -> float:
    """Millivolts in one ``unit``."""
    if not _is_voltage(unit):
        raise InputError(
            f"{where}: a lead is in {unit!r}; it needs a voltage: V, mV, uV or nV (of a record "
            "that was not calibrated, write mV: the scale of a lead changes no R peak)"
        )
    return MILLIVOLTS[_unit(unit)]


def _require_usable(ecg: Ecg, path: Path, gaps: bool) -> None:
    """Refuse leads that hold no heartbeat, naming each of them."""
    if not ecg.sampling_rate_hz > 0 or not np.isfinite(ecg.sampling_rate_hz):
        raise InputError(f"{path}: sampling rate is {ecg.sampling_rate_hz} Hz; it must be positive")
    if not ecg.signal_mv.size:
        raise InputError(f"{path}: holds no samples; it needs an ECG of several beats")
    problems = []
    for name, lead in zip(ecg.leads, ecg.signal_mv.T, strict=True):
        missing = int((~np.isfinite(lead)).sum())
        if missing:
            problems.append(f"lead {name}: {missing} of {len(lead)} samples are not a number")
        elif np.ptp(lead) == 0:
            problems.append(f"lead {name}: constant at {lead[0]:g} mV, as of a loose electrode")
    if problems and not (gaps and any(_varies(lead) for lead in ecg.signal_mv.T)):
        what = "; ".join(problems)
        raise InputError(f"{path}: {what}; leave such leads out of the file, or cut the gaps")


def _varies(lead: Float) -> bool:
    seen = lead[np.isfinite(lead)]
    return len(seen) > 0 and bool(np.ptp(seen) > 0)
