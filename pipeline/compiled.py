"""Machine code that is kept between runs, and thrown away with any source that it was made from."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import config, njit, types
from numba.extending import intrinsic

from pipeline.caches import is_writable, own_caches, place_of_this_run


@contextmanager
def kept_with(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Have what is made for a compiler meanwhile kept in a place of these sources' own.

    The compiler looks at a function's own file alone to tell whether its stored code still holds,
    not at those of the functions it calls. So the place is named by the sources of all.

    Parameters
    ----------
    folder
        Where the sources are.
    names
        Theirs, without ``.py``: all files with compiled functions that call one another, and those
        of the numbers that they take for constants.
    """
    usual = config.CACHE_DIR
    config.CACHE_DIR = str(Path(usual or _place(folder)) / _digest(folder, *names))
    try:
        yield
    finally:
        config.CACHE_DIR = usual


def door(folder: Path, names: Sequence[str], **options: Any) -> Callable[[Any], Any]:
    """A decorator that compiles as numba's options say, and keeps what it made with its sources."""

    def compiled(function: Any) -> Any:
        with kept_with(folder, names):
            return njit(**options)(function)

    return compiled


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def fetch(typing_context: Any, address: Any) -> Any:
    """Bring the line at an address into the outer cache, without waiting for it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer, whole = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer, whole, whole, whole])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
        # To be read; not into the innermost cache, which is too small for it; as data.
        hints = [ir.Constant(whole, n) for n in (0, 2, 1)]
        builder.call(prefetch, [builder.inttoptr(arguments[0], pointer), *hints])
        return context.get_dummy_value()

    return types.void(types.uintp), generate


def place_of(n: int) -> Any:
    """The number of an element of a vector."""
    return ir.Constant(ir.IntType(32), n)


def spread(builder: Any, number: Any) -> Any:
    """A vector of a number four times."""
    four = ir.Constant(ir.VectorType(number.type, 4), ir.Undefined)
    for n in range(4):
        four = builder.insert_element(four, number, place_of(n))
    return four


def mixed(builder: Any, weights: Any, parts: Any, flags: tuple[str, ...]) -> Any:
    """Weighted sum of numbers or vectors, added in their order."""
    products = [builder.fmul(a, b, flags=flags) for a, b in zip(weights, parts, strict=True)]
    return functools.reduce(lambda a, b: builder.fadd(a, b, flags=flags), products)


@cache
def _place(folder: Path) -> Path:
    """Beside the sources or, where those may not be written, among the user's caches.

    Left to itself the compiler would go there too, but to one place for sources of all kinds. A
    user who has no place at all compiles anew in each run.
    """
    beside = folder / "__pycache__"
    if is_writable(beside):
        return beside
    own = own_caches()
    return own if own and is_writable(own) else place_of_this_run()


@cache
def _digest(folder: Path, *names: str) -> str:
    sources = [(folder / f"{name}.py").read_bytes() for name in names]
    return "numba-" + hashlib.sha256(b"".join(sources)).hexdigest()[:12]
