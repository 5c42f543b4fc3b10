"""Command line: `python -m data_synth.training.ultrasound --out training/ultrasound`."""

from __future__ import annotations

import argparse
import sys

from data_synth.errors import SynthError
from data_synth.training.command import (
    add_arguments,
    count,
    mean_losses,
    need_extra,
    say_pool,
    write,
)

try:
    from data_synth.training.runs import TrainSettings, has_ended
    from data_synth.training.ultrasound.learning import train
    from data_synth.training.ultrasound.pictures import fill_pool, read_pool
except ModuleNotFoundError as error:
    need_extra(error)


def main(arguments: list[str] | None = None) -> int:
    """Fill the pool, train, and leave `blood.onnx` in the folder given by `--out`."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.start is not None and not options.start.is_file():
        parser.error(f"--start: {options.start} is no file; give the blood.pt of an earlier run")
    try:
        return _run(options)
    except SynthError as error:
        parser.error(str(error))


def _run(options: argparse.Namespace) -> int:
    options.out.mkdir(parents=True, exist_ok=True)
    settings = _settings(options)
    if not options.pool_only and has_ended(options.out / "blood", settings):
        write(f"{options.out / 'blood.onnx'}: this run has ended before; nothing to do")
        return 0
    pool = options.pool or options.out / "pool"
    paths = fill_pool(pool, options.hearts, options.frames, say_pool, options.workers)
    if options.pool_only:
        return 0
    train(read_pool(paths), settings, options.out, mean_losses(100))
    return 0


def _settings(options: argparse.Namespace) -> TrainSettings:
    return TrainSettings(
        steps=options.steps,
        minutes=options.minutes,
        batch=options.batch,
        fresh=options.batch,
        learning_rate=options.learning_rate,
        overlap_weight=(0.3, 0.0),
        start=options.start,
        hearts=f"{options.hearts} of {options.frames} pictures",
        seed=options.seed,
        export_minutes=options.export_minutes,
        threads=options.threads,
        workers=options.workers,
    )


def _parser() -> argparse.ArgumentParser:
    name = "python -m data_synth.training.ultrasound"
    parser = argparse.ArgumentParser(prog=name, description=__doc__)
    add_arguments(parser, "blood", hearts=200, steps=30_000, batch=16, threads=2)
    parser.add_argument("--frames", type=count, default=60, help="pictures of each heart")
    return parser


if __name__ == "__main__":
    sys.exit(main())
