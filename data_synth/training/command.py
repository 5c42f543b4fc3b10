"""What the command lines of both trainings share."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np


def add_arguments(
    parser: argparse.ArgumentParser, name: str, hearts: int, steps: int, batch: int, threads: int
) -> None:
    """Add what a pool and a run of a network of that name are asked for, with these defaults."""
    add = parser.add_argument
    add("--out", type=Path, required=True, help="folder of pool and network")
    add("--hearts", type=whole_number, default=hearts, help="hearts in the pool")
    add("--steps", type=count, default=steps, help="batches to learn from")
    add("--batch", type=count, default=batch, help="images in a batch")
    add("--learning-rate", type=amount, default=2e-3, help="largest step size")
    add("--start", type=Path, help=f"{name}.pt of an earlier run to go on from")
    add("--pool", type=Path, help="folder of hearts; default: pool in --out")
    add("--minutes", type=amount, default=math.inf, help="stop after this time")
    add("--export-minutes", type=amount, default=5.0, help="time between exports")
    add("--threads", type=count, default=threads, help="threads of the network's own")
    add(
        "--workers",
        type=whole_number,
        default=2,
        help="processes that draw; 0: the one that learns",
    )
    add("--seed", type=whole_number, default=0)
    add("--pool-only", action="store_true", help="fill the pool and stop")


def need_extra(error: ModuleNotFoundError) -> NoReturn:
    """End the program where what only training needs is not installed."""
    if error.name not in ("torch", "onnx"):
        raise error
    sys.stderr.write(
        f"error: training needs {error.name}, which is not installed: pip install "
        "'beatfield[train]', or `make train`, which does that\n"
    )
    sys.exit(2)


def whole_number(text: str) -> int:
    """A number of things, of which there may be none."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text}: give 0 or more")
    return number


def count(text: str) -> int:
    """A number of things, of which there must be one."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: give 1 or more")
    return number


def amount(text: str) -> float:
    """A number above 0."""
    number = float(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text}: give a number above 0")
    return number


def say_pool(done: int, total: int) -> None:
    """Tell how many hearts there are, now and then."""
    if done % 10 == 0 or done == total:
        write(f"pool: {done} of {total} hearts")


def mean_losses(every: int) -> Callable[[int, float, float], None]:
    """What tells the mean loss of so many steps, each time that they are over."""
    recent: list[float] = []

    def say(step: int, value: float, minutes: float) -> None:
        recent.append(value)
        if step % every == 0:
            write(f"step {step}: loss {np.mean(recent):.4f}, {minutes:.1f} min")
            recent.clear()

    return say


def write(line: str) -> None:
    """Print a line at once, into a file too."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
