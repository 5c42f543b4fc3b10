"""What the R-peak detector misses and adds in the records that detectors fail on, kind by kind.

    python benchmarks/arrhythmia_figures.py [--seeds 6]

Records of two minutes and two leads, drawn by tests/arrhythmia_records.py.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from pipeline.registration.rpeaks import find_beats

sys.path.append(str(Path(__file__).parent.parent / "tests"))

from arrhythmia_records import CASES, matched, record


def counted(case: str, seeds: int) -> tuple[int, int, int]:
    """True beats of a kind, those missed, and what was found besides."""
    true = missed = added = 0
    for seed in range(seeds):
        drawn = record(case, seed)
        found = find_beats(drawn.signal_mv, drawn.rate_hz)
        pairs = matched(np.array([beat.time_s for beat in found]), drawn.r_times_s)
        borne_out = int((pairs >= 0).sum())
        true += len(pairs)
        missed += len(pairs) - borne_out
        added += len(found) - borne_out
    return true, missed, added


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Beats missed and added in arrhythmia.")
    parser.add_argument("--seeds", type=int, default=6, help="records of each kind")
    seeds = parser.parse_args().seeds
    rows = []
    for case in sorted(CASES):
        rows.append(counted(case, seeds))
        print("{:30s} {:5d} beats, {:4d} missed, {:4d} added".format(case, *rows[-1]), flush=True)
    beats, missed, added = np.sum(rows, axis=0).tolist()
    hit = beats - missed
    print(f"{beats} beats: sensitivity {hit / beats:.2%}, predictivity {hit / (hit + added):.2%}")
