"""Read an electrocardiogram from WFDB, CSV or DICOM waveform files."""

from __future__ import annotations

import hashlib
import importlib
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
from pipeline.imaging.dicom_files import is_bare
from pipeline.imaging.ecg_csv import read_csv
from pipeline.imaging.voltages import is_voltage, millivolts
from pipeline.study_files import names_in_header

MICRO_UNIT = re.compile(rb"^[^#\s]\S*\s+\S+\s+\S*/\S*?(?:\xb5|\xce\xbc)", re.MULTILINE)
"""A signal's line whose unit, after file and format, has a micro sign (Latin-1 or UTF-8, where
another byte stands before it) or the Greek letter."""


MOST_SIGNALS = 64
"""Of a record whose segments describe them."""


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
        is another; leave out channels that are no voltage, and those of fewer samples a second.

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
        ecg = Ecg(*read_csv(path))
    else:
        ecg = _read_dicom(path, gaps)
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
        _require_few_signals(header)
        _require_plain_units(header)
        with _quiet_wfdb() as wfdb:
            _require_one_way_of_writing(wfdb, header)
            stem = str(header.with_suffix("").absolute())
            # Frames may hold several samples of a lead: all of them, not their mean.
            record = wfdb.rdrecord(stem, return_res=64, smooth_frames=False)
    except InputError:
        raise
    # The library raises its parser's own errors (IndexError, TypeError ...) on damaged files.
    except Exception as error:
        raise InputError(
            f"{header}: cannot be read as a WFDB record ({error}); it needs a whole header and "
            "every .dat file it names, of the length it gives; copy the record again"
        ) from error
    return _wfdb_leads(record, header, gaps)


def _require_few_signals(header: Path) -> None:
    """Refuse a header whose first line promises more signals than there are lines for: the library
    makes room for all of them first."""
    lines = [line for line in header.read_bytes().splitlines() if line and line[:1] != b"#"]
    words = lines[0].split() if lines else []
    told = words[1].decode("ascii", "replace") if len(words) > 1 else ""
    # The segments of a record in parts have the same signals, and lines of their own.
    if told.isdecimal() and int(told[:9]) > max(len(lines) - 1, MOST_SIGNALS):
        raise InputError(
            f"{header}: promises {told[:9]} signals, and has {len(lines) - 1} lines that describe "
            "some; copy the record again"
        )


def _require_plain_units(header: Path) -> None:
    """Refuse a micro sign, which the library passes over: microvolts would be read as volts."""
    segments = (header.parent / f"{name}.hea" for name in names_in_header(header))
    for one in (header, *(path for path in segments if path.is_file())):
        if MICRO_UNIT.search(one.read_bytes()):
            raise InputError(
                f"{one}: has a unit with a micro sign, which a WFDB header cannot hold; write uV"
            )


def _require_one_way_of_writing(wfdb: Any, header: Path) -> None:
    """Refuse segments that the library would join wrongly, or not at all."""
    whole = wfdb.rdheader(str(header.with_suffix("").absolute()))
    names = getattr(whole, "seg_name", None) or []
    if "~" in names and whole.layout == "fixed":
        raise InputError(
            f"{header}: has a gap between its segments (~), and no layout segment with which it "
            "could be filled; write the record as one, with samples that are missing marked so, or "
            "cut it at the gap"
        )
    own = [wfdb.rdheader(str(header.parent.absolute() / name)) for name in names if name != "~"]
    # A variable layout's segments have some of its signals each.
    units = [dict(zip(one.sig_name or [], one.units or [], strict=False)) for one in own]
    told = {name: unit for one in units for name, unit in one.items()}
    if any(one[name] != told[name] for one in units for name in one):
        raise InputError(
            f"{header}: its segments give one signal in different units, by which the library "
            "would not scale them; write the record as one"
        )


def _wfdb_leads(record: Any, header: Path, gaps: bool) -> Ecg:
    """The channels of a record in millivolts."""
    if record.e_p_signal is None or not record.n_sig:
        raise InputError(f"{header}: holds no signal; a WFDB record of an ECG is needed")
    voltages = [k for k, unit in enumerate(record.units) if is_voltage(unit)]
    kept = voltages if gaps and voltages else list(range(record.n_sig))
    # A header need not name its signals.
    names = {k: record.sig_name[k] or f"signal {k + 1}" for k in kept}
    factors = {k: millivolts(record.units[k], names[k], str(header)) for k in kept}
    each = [count or 1 for count in record.samps_per_frame or [1] * record.n_sig]
    most = max(each[k] for k in kept)
    slower = [names[k] for k in kept if each[k] < most]
    if slower and not gaps:
        raise InputError(
            f"{header}: has leads of different rates: {', '.join(slower)} of fewer samples a "
            "second than the others; leave them out of the file"
        )
    kept = [k for k in kept if each[k] == most]
    # What a lead's skew has moved up leaves its end empty.
    frames = record.sig_len - max(moved or 0 for moved in record.skew or [0])
    leads = [np.asarray(record.e_p_signal[k], float)[: frames * most] * factors[k] for k in kept]
    signal_mv = np.stack(leads, axis=1)
    return Ecg(signal_mv, tuple(names[k] for k in kept), float(record.fs) * most)


def _read_dicom(path: Path, gaps: bool) -> Ecg:
    """Read the longest group of voltages in a DICOM waveform file."""
    import pydicom

    try:
        dataset = pydicom.dcmread(path, force=is_bare(path))
    except Exception as error:
        raise InputError(
            f"{path}: is neither a WFDB record, nor .csv, nor DICOM ({error}); convert it to one"
        ) from error
    groups = dataset.get("WaveformSequence")
    if not groups:
        raise InputError(f"{path}: DICOM without WaveformSequence; it needs an ECG waveform object")
    # Resting ECGs carry the recording and, beside it, a short averaged beat; monitors pressures.
    try:
        longest = max(range(len(groups)), key=lambda index: _seconds(groups[index]))
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: how long its waveforms are cannot be understood ({error}); export it again"
        ) from error
    return _dicom_group(dataset, longest, path, gaps)


def _mend_group(dataset: Any, group: Any, path: Path) -> None:
    """Make of a multiplex group what the library decodes rightly.

    Raises
    ------
    InputError
        When its samples are packed as telephones do, which the library takes for plain ones.
    """
    kind = str(group.get("WaveformSampleInterpretation", ""))
    if kind in ("MB", "AB"):
        law = {"MB": "mu-law", "AB": "A-law"}[kind]
        raise InputError(
            f"{path}: its samples are packed by {law} (WaveformSampleInterpretation {kind}); "
            "export plain ones"
        )
    size = int(group.get("WaveformBitsAllocated") or 0) // 8
    if not dataset.original_encoding[1] and size in (2, 4):
        for name in ("WaveformData", "WaveformPaddingValue"):
            if stored := group.get(name):
                swapped = np.frombuffer(stored, f"u{size}").byteswap().tobytes()
                setattr(group, name, swapped)
    for channel in group.get("ChannelDefinitionSequence") or []:
        # Present and empty says what their absence does.
        for name in ("ChannelBaseline", "ChannelSensitivityCorrectionFactor"):
            if channel.get(name, 0) is None:
                delattr(channel, name)


def _seconds(group: Any) -> tuple[bool, float]:
    """Whether a multiplex group holds voltages alone, and how long it lasts."""
    samples = float(group.get("NumberOfWaveformSamples") or 0)
    rate_hz = float(group.get("SamplingFrequency") or 0)
    coded = [
        one.get("ChannelSensitivityUnitsSequence")
        for one in group.get("ChannelDefinitionSequence") or []
    ]
    voltages = all(one and is_voltage(str(one[0].get("CodeValue", ""))) for one in coded)
    return voltages, samples / rate_hz if rate_hz > 0 else samples


def _dicom_group(dataset: Any, index: int, path: Path, gaps: bool) -> Ecg:
    """Decode one multiplex group of channels."""
    group = dataset.WaveformSequence[index]
    try:
        _mend_group(dataset, group, path)
        signal = np.array(dataset.waveform_array(index), dtype=float)
        signal[_is_padding(dataset, index)] = np.nan
        channels = list(group.ChannelDefinitionSequence)
        rate_hz = float(group.SamplingFrequency)
        # Of the acquisition's time, which is that of all groups.
        start_s = float(group.get("MultiplexGroupTimeOffset") or 0) / 1000
        names = tuple(_lead_name(channel) for channel in channels)
        units = [str(c.ChannelSensitivityUnitsSequence[0].CodeValue) for c in channels]
    except (
        AttributeError, TypeError, ValueError, IndexError, KeyError, NotImplementedError
    ) as error:  # fmt: skip
        raise InputError(
            f"{path}: the waveform cannot be decoded ({error}); it needs complete samples, a "
            "sampling frequency, and a source and a unit for each channel; export it again"
        ) from error
    voltages = [k for k, unit in enumerate(units) if is_voltage(unit)]
    kept = voltages if gaps and voltages else list(range(len(units)))
    scale = [millivolts(units[k], names[k], str(path)) for k in kept]
    patient = str(dataset.get("PatientID", "") or "").strip()
    leads = tuple(names[k] for k in kept)
    return Ecg(signal[:, kept] * scale, leads, rate_hz, start_s, patient=patient)


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
