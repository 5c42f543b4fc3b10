"""Command line: `python -m data_synth.training.ultrasound --out training/ultrasound`."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from data_synth.training.loop import TrainSettings
from data_synth.training.ultrasound.learning import train
from data_synth.training.ultrasound.pictures import fill_pool, read_pool


def main(arguments: list[str] | None = None) -> int:
    """Fill the pool, train, and leave `blood.onnx` in the folder given by `--out`."""
    options = _parser().parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    pool = options.pool or options.out / "pool"
    paths = fill_pool(pool, options.hearts, options.frames, _say_pool, options.workers)
    if options.pool_only:
        return 0
    settings = TrainSettings(
        steps=options.steps,
        minutes=options.minutes,
        batch=options.batch,
        fresh=options.batch,
        learning_rate=options.learning_rate,
        overlap_weight=(0.3, 0.0),
        start=options.start,
        seed=options.seed,
        threads=options.threads,
        workers=options.workers,
    )
    recent: list[float] = []

    def say(step: int, value: float, minutes: float) -> None:
        recent.append(value)
        if step % 100 == 0:
            _write(f"step {step}: loss {np.mean(recent):.4f}, {minutes:.1f} min")
            recent.clear()

    train(read_pool(paths), settings, options.out, say)
    return 0


def _parser() -> argparse.ArgumentParser:
    name = "python -m data_synth.training.ultrasound"
    parser = argparse.ArgumentParser(prog=name, description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of pool and network")
    parser.add_argument("--hearts", type=int, default=200, help="hearts in the pool")
    parser.add_argument("--frames", type=int, default=60, help="pictures of each heart")
    parser.add_argument("--steps", type=int, default=30_000, help="batches to learn from")
    parser.add_argument("--batch", type=int, default=16, help="pictures in a batch")
    parser.add_argument("--learning-rate", type=float, default=2e-3, help="largest step size")
    parser.add_argument("--start", type=Path, help="blood.pt of an earlier run to go on from")
    parser.add_argument("--pool", type=Path, help="folder of hearts; default: pool in --out")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this time")
    parser.add_argument("--threads", type=int, default=2, help="threads of the network's own")
    parser.add_argument("--workers", type=int, default=2, help="processes that draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pool-only", action="store_true", help="fill the pool and stop")
    return parser


def _say_pool(done: int, total: int) -> None:
    if done % 10 == 0 or done == total:
        _write(f"pool: {done} of {total} hearts")


def _write(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
