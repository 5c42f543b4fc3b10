"""What the R-peak detector misses and adds in records whose beats people have annotated.

    python benchmarks/annotated_records.py RECORD ... [--each-lead]

A RECORD is the path of a WFDB header without its ending; beside it lie the annotations, ``.atr`` or
``.qrs``. All leads are given together, or every one alone. A beat is found within 0.15 s of its
annotation (ANSI/AAMI EC57); what is found before the first annotation or after the last does not
count. Annotations mark a complex by a point of the annotator's choice, in a lead of his choice: the
median way from it to R is taken off before the spread is told.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import wfdb

from pipeline.geometry import Float
from pipeline.registration.rpeaks import find_beats

sys.path.append(str(Path(__file__).parent.parent / "tests"))

from arrhythmia_records import matched

BEATS = set("NLRBAaJSVrFejnE/fQ?")
MARGIN_S = 0.5


def beats_of(record: Path) -> Float:
    """Times of the annotated beats, s."""
    kind = next((one for one in ("atr", "qrs") if record.with_suffix(f".{one}").exists()), None)
    if kind is None:
        raise SystemExit(f"{record}: no .atr or .qrs beside it; annotations are needed")
    read = wfdb.rdann(str(record), kind)
    told = [at for at, symbol in zip(read.sample, read.symbol, strict=True) if symbol in BEATS]
    return np.array(told) / wfdb.rdheader(str(record)).fs


def row(name: str, true_s: Float, signal_mv: Float, rate_hz: float) -> str:
    """One line of the table."""
    found_s = np.array([beat.time_s for beat in find_beats(signal_mv, rate_hz)])
    within = (found_s > true_s[0] - MARGIN_S) & (found_s < true_s[-1] + MARGIN_S)
    pairs = matched(found_s[within], true_s)
    hit = pairs >= 0
    missed, added = int((~hit).sum()), int(within.sum() - hit.sum())
    off_ms = 1000 * (found_s[within][pairs[hit]] - true_s[hit])
    spread_ms = np.abs(off_ms - np.median(off_ms)) if hit.any() else np.full(1, np.nan)
    shares = f"{100 * hit.mean():.2f} | {100 * hit.sum() / max(hit.sum() + added, 1):.2f}"
    times = f"{np.median(spread_ms):.1f} | {np.percentile(spread_ms, 99):.1f}"
    return f"| {name} | {len(true_s)} | {missed} | {added} | {shares} | {times} |"


def main() -> None:
    """Read the command line and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("record", nargs="+", type=Path)
    parser.add_argument("--each-lead", action="store_true", help="every lead alone")
    arguments = parser.parse_args()
    print("| record | beats | missed | added | sensitivity % | predictivity % | spread ms | 99 % |")
    print("|---" * 8 + "|")
    for record in arguments.record:
        read, true_s = wfdb.rdrecord(str(record)), beats_of(record)
        signal_mv = np.asarray(read.p_signal, dtype=np.float64)
        if not arguments.each_lead:
            print(row(record.name, true_s, signal_mv, float(read.fs)), flush=True)
            continue
        for k, lead in enumerate(read.sig_name):
            one_mv = signal_mv[:, k : k + 1]
            print(row(f"{record.name} {lead}", true_s, one_mv, float(read.fs)), flush=True)


if __name__ == "__main__":
    main()
