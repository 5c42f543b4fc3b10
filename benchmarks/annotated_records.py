"""Detector and phase clock in records whose beats people have annotated.

    python benchmarks/annotated_records.py RECORD ... [--each-lead]

A RECORD is the path of a WFDB header without its ending; beside it lie the annotations, ``.atr`` or
``.qrs``. All leads are given together, or every one alone. A beat is found within 0.15 s of its
annotation (ANSI/AAMI EC57); what is found before the first annotation or after the last does not
count. Annotations mark a complex by a point of the annotator's choice, in a lead of his choice: the
median way from it to R is taken off before the spread is told. The clock is asked at every sample
of a stream; its phase is compared, where it is valid and after the first ten seconds, with that
between the annotated beats about the moment, on the axis of a beat of the record's median interval.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from bench_clock import true_phase

from pipeline.geometry import Float
from pipeline.registration.clock import PhaseClock
from pipeline.registration.rpeaks import RPeakDetector, find_beats

sys.path.append(str(Path(__file__).parent.parent / "tests"))

from arrhythmia_records import matched

BEATS = set("NLRBAaJSVrFejnE/fQ?")
MARGIN_S, LEARNT_S = 0.5, 10.0


def beats_of(record: Path) -> Float:
    """Times of the annotated beats, s."""
    import wfdb  # calls deprecated parts of pandas, which no test run may meet

    kind = next((one for one in ("atr", "qrs") if Path(f"{record}.{one}").exists()), None)
    if kind is None:
        raise SystemExit(f"{record}: no .atr or .qrs beside it; annotations are needed")
    read = wfdb.rdann(str(record), kind)
    told = [at for at, symbol in zip(read.sample, read.symbol, strict=True) if symbol in BEATS]
    if len(told) < 2:
        raise SystemExit(f"{record}.{kind}: {len(told)} beats are annotated; two are needed")
    return np.array(told) / wfdb.rdheader(str(record)).fs


def found_and_missed(true_s: Float, signal_mv: Float, rate_hz: float) -> tuple[str, float]:
    """Cells of the table about beats; and how long after its annotation R is, in the median, s."""
    found_s = np.array([beat.time_s for beat in find_beats(signal_mv, rate_hz)])
    within = (found_s > true_s[0] - MARGIN_S) & (found_s < true_s[-1] + MARGIN_S)
    pairs = matched(found_s[within], true_s)
    hit = pairs >= 0
    missed, added = int((~hit).sum()), int(within.sum() - hit.sum())
    off_ms = 1000 * (found_s[within][pairs[hit]] - true_s[hit])
    late_ms = float(np.median(off_ms)) if hit.any() else np.nan
    spread_ms = np.abs(off_ms - late_ms) if hit.any() else np.full(1, np.nan)
    shares = f"{100 * hit.mean():.2f} | {100 * hit.sum() / max(hit.sum() + added, 1):.2f}"
    times = f"{np.median(spread_ms):.1f} | {np.percentile(spread_ms, 99):.1f}"
    return f"{len(true_s)} | {missed} | {added} | {shares} | {times}", late_ms / 1000


def phases(true_s: Float, signal_mv: Float, rate_hz: float) -> str:
    """Cells of the table about the clock: share of time valid, and the phase's error then."""
    cycle_s = float(np.median(np.diff(true_s)))
    detector, clock = RPeakDetector(rate_hz, signal_mv.shape[1]), PhaseClock(cycle_s)
    rows = []
    for number, sample in enumerate(signal_mv):
        for beat in detector.push(sample):
            if beat.instead:
                clock.take_back()
            clock.beat(beat.time_s, beat.strange)
        tick = clock.at(number / rate_hz, detector.usable)
        rows.append((number / rate_hz, tick.phase, tick.valid))
    table = np.array(rows, dtype=float)
    truth = true_phase(table[:, 0], true_s, cycle_s)
    asked = np.isfinite(truth) & (table[:, 0] > LEARNT_S)
    used = asked & (table[:, 2] > 0)
    off_ms = 1000 * cycle_s * np.abs((table[used, 1] - truth[used] + 0.5) % 1 - 0.5)
    middle, most = np.percentile(off_ms, [50, 95]) if used.any() else (np.nan, np.nan)
    return f"{100 * used.sum() / asked.sum():.1f} | {middle:.1f} | {most:.0f}"


def main() -> None:
    """Read the command line and print the table."""
    import wfdb

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("record", nargs="+", type=Path)
    parser.add_argument("--each-lead", action="store_true", help="every lead alone")
    arguments = parser.parse_args()
    heads = "record | beats | missed | added | sensitivity % | predictivity % | spread ms | 99 %"
    clock = "" if arguments.each_lead else " | valid % | phase off ms | 95 %"
    print(f"| {heads}{clock} |\n" + "|---" * (8 if arguments.each_lead else 11) + "|")
    for record in arguments.record:
        read, true_s = wfdb.rdrecord(str(record)), beats_of(record)
        signal_mv, rate_hz = np.asarray(read.p_signal, dtype=np.float64), float(read.fs)
        if arguments.each_lead:
            for k, lead in enumerate(read.sig_name):
                cells, _ = found_and_missed(true_s, signal_mv[:, k : k + 1], rate_hz)
                print(f"| {record.name} {lead} | {cells} |", flush=True)
            continue
        cells, late_s = found_and_missed(true_s, signal_mv, rate_hz)
        clock = phases(true_s + late_s, signal_mv, rate_hz)
        print(f"| {record.name} | {cells} | {clock} |", flush=True)


if __name__ == "__main__":
    main()
