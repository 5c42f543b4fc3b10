"""Command line of the training: `python -m data_synth.training --out training`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np

from data_synth.errors import SynthError
from data_synth.training.command import (
    add_arguments,
    count,
    mean_losses,
    need_extra,
    say_pool,
    whole_number,
    write,
)

try:
    from data_synth.training.loop import draw_from, mean_of, train
    from data_synth.training.network import WIDTHS, HeartNet, take_over
    from data_synth.training.pool import PoolSettings, fill_pool
    from data_synth.training.render import Parts
    from data_synth.training.runs import TrainSettings, has_ended, load_weights
except ModuleNotFoundError as error:
    need_extra(error)


def main(arguments: list[str] | None = None) -> int:
    """Fill the pool, train, and leave `heart.onnx` in the folder given by `--out`."""
    parser = _parser()
    options = parser.parse_args(arguments)
    _require_sense(parser, options)
    try:
        return _run(parser, options)
    except SynthError as error:
        parser.error(str(error))


def _require_sense(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse what cannot work before hearts are made, which takes most of an hour."""
    if options.kept < options.batch:
        parser.error(f"--kept: {options.kept} images cannot fill batches of {options.batch}")
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


def _run(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    options.out.mkdir(parents=True, exist_ok=True)
    pools = [
        PoolSettings(hearts=hearts, spread=options.spread, seed=seed)
        for seed, hearts in [(options.seed, options.hearts), *options.more]
    ]
    settings = _settings(options, pools)
    if not options.mean and not options.pool_only and has_ended(options.out / "heart", settings):
        write(f"{options.out / 'heart.onnx'}: this run has ended before; nothing to do")
        return 0
    folder = options.pool or options.out / "pool"
    paths = [path for pool in pools for path in fill_pool(folder, pool, say_pool, options.workers)]
    if options.pool_only:
        return 0
    blocks = [block for path in paths for block in np.load(path)]
    if options.mean:
        try:
            mean_of(options.mean, draw_from(blocks, settings.parts), settings, options.out)
        except ValueError as error:
            parser.error(f"--mean: {error}; give --widths that all have")
        return 0
    train(blocks, settings, options.out, mean_losses(50))
    return 0


def _settings(options: argparse.Namespace, pools: list[PoolSettings]) -> TrainSettings:
    return TrainSettings(
        steps=options.steps,
        minutes=options.minutes,
        batch=options.batch,
        fresh=options.fresh,
        kept=options.kept,
        learning_rate=options.learning_rate,
        widths=tuple(options.widths),
        start=options.start,
        parts=Parts(**dict.fromkeys(options.without, False)),
        hearts=" and ".join(f"{pool.hearts} of seed {pool.seed}" for pool in pools)
        + f", spread {options.spread:g}",
        seed=options.seed,
        export_minutes=options.export_minutes,
        threads=options.threads,
        workers=options.workers,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m data_synth.training", description=__doc__)
    add_arguments(parser, "heart", hearts=600, steps=100_000, batch=64, threads=1)
    parser.add_argument(
        "--more", action="append", default=[], nargs=2, type=whole_number,
        metavar=("SEED", "HEARTS"), help="hearts of another seed besides",
    )  # fmt: skip
    parser.add_argument("--spread", type=float, default=1.6, help="how far hearts are from mean")
    parser.add_argument("--fresh", type=count, default=8, help="of a batch, images drawn anew")
    parser.add_argument("--kept", type=count, default=60_000, help="images kept to be seen again")
    parser.add_argument(
        "--mean", action="append", default=[], type=Path, metavar="HEART.PT",
        help="learn nothing, but write the mean of earlier runs' weights; give it for each",
    )  # fmt: skip
    parser.add_argument(
        "--widths", nargs=len(WIDTHS), type=count, default=WIDTHS, metavar="CHANNELS",
        help="channels of the network at full, half, ... resolution, at least --start's",
    )  # fmt: skip
    parser.add_argument(
        "--without", action="append", default=[], choices=[part.name for part in fields(Parts)],
        help="leave a part of the randomisation out, to see what it is worth",
    )  # fmt: skip
    return parser


if __name__ == "__main__":
    sys.exit(main())
