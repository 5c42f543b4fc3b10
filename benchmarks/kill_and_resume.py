"""Kill a run at random moments, run it again, and compare every byte with an undisturbed run.

    python benchmarks/kill_and_resume.py STUDY [--kills 10] [--seed 0]

Prints the moment and stage of each kill, and ends with exit code 1 where a byte differs. Times
and memory in run.json are left out of the comparison.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from pipeline.run import MEASURED


def command(study: Path, out: Path) -> list[str]:
    """The run, as a user starts it."""
    return [sys.executable, "-m", "pipeline", "run", str(study), "--out", str(out)]


def products(out: Path) -> dict[str, Any]:
    """Every file below ``out``; run.json without what was measured."""
    content: dict[str, Any] = {}
    for path in sorted(out.rglob("*")):
        if path.is_file():
            content[path.relative_to(out).as_posix()] = path.read_bytes()
    for name in [name for name in content if name.endswith("run.json")]:
        record = json.loads(content[name])
        for stage in record["stages"].values():
            for measured in MEASURED:
                stage.pop(measured, None)
        content[name] = record
    return content


def stage_in_flight(out: Path) -> str:
    """The stage whose folder was left unfinished."""
    partial = next(iter(sorted(out.rglob(".*.partial-*"))), None)
    return partial.name.split(".")[1] if partial else "between stages"


def main() -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        calm, disturbed = Path(folder) / "calm", Path(folder) / "disturbed"
        clock = time.perf_counter()
        subprocess.run(command(given.study, calm), check=True, capture_output=True)
        whole_s = time.perf_counter() - clock
        print(f"undisturbed run: {whole_s:.1f} s")
        for number in range(given.kills):
            # Each run goes on from the last, so short stretches reach every stage.
            after_s = rng.uniform(0.5, max(1.0, 2.5 * whole_s / given.kills))
            process = subprocess.Popen(
                command(given.study, disturbed),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            try:
                process.wait(after_s)
                print(f"kill {number + 1}: the run had ended before {after_s:.1f} s")
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                print(f"kill {number + 1}: after {after_s:.1f} s, in {stage_in_flight(disturbed)}")
        subprocess.run(command(given.study, disturbed), check=True, capture_output=True)
        return compare(products(calm), products(disturbed))


def compare(calm: dict[str, Any], disturbed: dict[str, Any]) -> int:
    """Print what differs; 1 where anything does."""
    names = sorted(calm.keys() | disturbed.keys())
    different = [name for name in names if calm.get(name) != disturbed.get(name)]
    print(f"{len(names)} files, {len(different)} differ", *different[:20], sep="\n  ")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
