"""Command line of the training: `python -m data_synth.training --out training`."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np

from data_synth.training.loop import TrainSettings, draw_from, load_weights, mean_of, train
from data_synth.training.network import WIDTHS, HeartNet, take_over
from data_synth.training.pool import PoolSettings, fill_pool
from data_synth.training.render import Parts


def main(arguments: list[str] | None = None) -> int:
    """Fill the pool, train, and leave `heart.onnx` in the folder given by `--out`."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.kept < options.batch:
        parser.error(f"--kept: {options.kept} images cannot fill batches of {options.batch}")
    # Before hearts are made, which takes most of an hour.
    for path in options.mean:
        if not path.is_file():
            parser.error(f"--mean: {path} is no file; give the heart.pt of earlier runs")
    if options.start is not None and not options.start.is_file():
        parser.error(f"--start: {options.start} is no file; give the heart.pt of an earlier run")
    if options.start is not None:
        try:
            take_over(HeartNet(options.widths), load_weights(options.start))
        except ValueError as error:
            parser.error(f"--start: {options.start}: {error}; give --widths as wide or wider")
    options.out.mkdir(parents=True, exist_ok=True)
    pool = PoolSettings(hearts=options.hearts, spread=options.spread, seed=options.seed)
    folder = options.pool or options.out / "pool"
    paths = fill_pool(folder, pool, _say_pool, options.workers)
    for seed, hearts in options.more:
        others = PoolSettings(hearts=hearts, spread=options.spread, seed=seed)
        paths += fill_pool(folder, others, _say_pool, options.workers)
    if options.pool_only:
        return 0
    blocks = [block for path in paths for block in np.load(path)]
    settings = TrainSettings(
        steps=options.steps,
        minutes=options.minutes,
        batch=options.batch,
        fresh=options.fresh,
        kept=options.kept,
        learning_rate=options.learning_rate,
        widths=tuple(options.widths),
        start=options.start,
        parts=Parts(**dict.fromkeys(options.without, False)),
        seed=options.seed,
        export_minutes=options.export_minutes,
        threads=options.threads,
        workers=options.workers,
    )
    if options.mean:
        try:
            mean_of(options.mean, draw_from(blocks, settings.parts), settings, options.out)
        except ValueError as error:
            parser.error(f"--mean: {error}; give --widths that all have")
        return 0
    recent: list[float] = []

    def say(step: int, value: float, minutes: float) -> None:
        recent.append(value)
        if step % 50 == 0:
            _write(f"step {step}: loss {np.mean(recent):.4f}, {minutes:.1f} min")
            recent.clear()

    train(blocks, settings, options.out, say)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m data_synth.training", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of pool and network")
    parser.add_argument("--hearts", type=int, default=600, help="hearts in the pool")
    parser.add_argument(
        "--more", action="append", default=[], nargs=2, type=int, metavar=("SEED", "HEARTS"),
        help="hearts of another seed besides",
    )  # fmt: skip
    parser.add_argument("--spread", type=float, default=1.6, help="how far hearts are from mean")
    parser.add_argument("--steps", type=int, default=100_000, help="batches to learn from")
    parser.add_argument("--batch", type=int, default=64, help="images in a batch")
    parser.add_argument("--fresh", type=int, default=8, help="of them drawn anew")
    parser.add_argument("--kept", type=int, default=60_000, help="images kept to be seen again")
    parser.add_argument("--learning-rate", type=float, default=2e-3, help="largest step size")
    parser.add_argument(
        "--start", type=Path, help="heart.pt of an earlier run, as wide or narrower, to go on from"
    )
    parser.add_argument(
        "--mean", action="append", default=[], type=Path, metavar="HEART.PT",
        help="learn nothing, but write the mean of earlier runs' weights; give it for each",
    )  # fmt: skip
    parser.add_argument(
        "--widths", nargs=len(WIDTHS), type=int, default=WIDTHS, metavar="CHANNELS",
        help="channels of the network at full, half, ... resolution",
    )  # fmt: skip
    parser.add_argument(
        "--without", action="append", default=[], choices=[part.name for part in fields(Parts)],
        help="leave a part of the randomisation out, to see what it is worth",
    )  # fmt: skip
    parser.add_argument("--pool", type=Path, help="folder of hearts; default: pool in --out")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this time")
    parser.add_argument("--export-minutes", type=float, default=5.0, help="time between exports")
    parser.add_argument("--threads", type=int, default=1, help="threads of the network's own")
    parser.add_argument(
        "--workers", type=int, default=2, help="processes that draw hearts and images"
    )
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
