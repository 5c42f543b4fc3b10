"""Compiled parts of the fit: what points ask of coefficients, and what acts back on them.

A point asks 27 coefficients, nine rows of three that lie beside one another in memory; a row is
read, or added to, as one vector of four, whose last weight is zero. Loops over single coefficients
take twice as long, and compilers do not make vectors of them.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pipeline.compiled import door, mixed, place_of, spread
from pipeline.geometry import Float32

# Minima and maxima aside, only the order of sums may change.
FAST = {"contract", "nnan", "nsz"}

_SOURCES = Path(__file__).parent, ("fit_kernels", "../compiled")
_ASKED: dict[str, Any] = {"nogil": True, "cache": True, "fastmath": FAST}

_FOUR = ir.VectorType(ir.FloatType(), 4)


def room(shape: tuple[int, ...]) -> Float32:
    """Zeros ``(z, y, x)`` with one more behind the last: there the last row's vector ends."""
    return np.zeros(math.prod(shape) + 1, dtype=np.float32)[:-1].reshape(shape)


@door(*_SOURCES, **_ASKED)
def mix(coefficients, interval, weights, layer, shell):  # type: ignore[no-untyped-def]
    """Coefficients at one moment: those of three phases, weighted."""
    count, into = len(coefficients), layer.ravel()
    before = coefficients[(interval - 1) % count]
    at, after = coefficients[interval], coefficients[(interval + 1) % count]
    early, middle, late = weights[0], weights[1], weights[2]
    for n in range(len(shell)):
        into[shell[n]] = early * before[n] + middle * at[n] + late * after[n]


@door(*_SOURCES, **_ASKED)
def share(target, interval, weights, acting, shell):  # type: ignore[no-untyped-def]
    """Add what acts at one moment to three phases, by their weights; nothing acts any more."""
    count, given = len(target), acting.ravel()
    before = target[(interval - 1) % count]
    at, after = target[interval], target[(interval + 1) % count]
    early, middle, late = weights[0], weights[1], weights[2]
    for n in range(len(shell)):
        one = given[shell[n]]
        given[shell[n]] = 0
        before[n] += early * one
        at[n] += middle * one
        after[n] += late * one


@door(*_SOURCES, **_ASKED, inline="always")
def _weigh(place):  # type: ignore[no-untyped-def]
    """First of the three nodes about a place on an axis, and their weights."""
    half = np.float32(0.5)
    middle = int(place + half)
    t = place - np.float32(middle)
    early, late = half - t, half + t
    return middle - 1, (half * early * early, np.float32(0.75) - t * t, half * late * late)


@door(*_SOURCES, **_ASKED, inline="always")
def _squares(weights):  # type: ignore[no-untyped-def]
    a, b, c = weights
    return a * a, b * b, c * c


@door(*_SOURCES, **_ASKED)
def carry(values, corners, shares, found):  # type: ignore[no-untyped-def]
    """What vertices have, ``(vertex, 4)``, at points that share in three of them each."""
    for n in range(len(corners)):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        p, q, r = shares[n, 0], shares[n, 1], shares[n, 2]
        for k in range(4):
            found[n, k] = p * values[a, k] + q * values[b, k] + r * values[c, k]


@door(*_SOURCES, **_ASKED)
def touch(touched, nodes):  # type: ignore[no-untyped-def]
    """Mark the nodes that points ask."""
    for n in range(len(nodes)):
        x, _ = _weigh(nodes[n, 0])
        y, _ = _weigh(nodes[n, 1])
        z, _ = _weigh(nodes[n, 2])
        for c in range(3):
            for b in range(3):
                for a in range(3):
                    touched[z + c, y + b, x + a] = True


def _row(builder: Any, weights: Any) -> Any:
    """Three weights and a zero."""
    four = ir.Constant(_FOUR, [0.0] * 4)
    for n, weight in enumerate(weights):
        four = builder.insert_element(four, weight, place_of(n))
    return four


def _rows(builder: Any, first: Any, steps: Any) -> list[Any]:
    """Where nine rows are, those of the same z together."""
    row, plane = steps
    found = []
    for _ in range(3):
        at = first
        for _ in range(3):
            found.append(builder.inttoptr(at, _FOUR.as_pointer()))
            at = builder.add(at, row)
        first = builder.add(first, plane)
    return found


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def _ask(typing_context: Any, first: Any, steps: Any, wx: Any, wy: Any, wz: Any) -> Any:
    """Weighted sum of 27 coefficients.

    Parameters
    ----------
    first
        Address of the first.
    steps
        Bytes from one row to the next, and from one plane to the next.
    wx, wy, wz
        Three weights each.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        at, *rest = arguments
        steps, x, y, z = (cgutils.unpack_tuple(builder, one) for one in rest)
        sum_of = functools.partial(mixed, builder, flags=tuple(FAST))
        y, z = ([spread(builder, one) for one in part] for part in (y, z))
        rows = [builder.load(one, align=4) for one in _rows(builder, at, steps)]
        row = sum_of(z, [sum_of(y, rows[c : c + 3]) for c in range(0, 9, 3)])
        return sum_of(x, [builder.extract_element(row, place_of(n)) for n in range(3)])

    return types.float32(first, steps, wx, wy, wz), generate


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def _add(typing_context: Any, first: Any, steps: Any, shares: Any, value: Any) -> Any:
    """Add a value to 27 coefficients by the product of three shares; see ``_ask``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        unpacked = functools.partial(cgutils.unpack_tuple, builder)
        at, steps, shares, value = arguments
        fast = tuple(FAST)
        x, y, z = (unpacked(one) for one in unpacked(shares))
        along = _row(builder, x)
        each = [
            builder.fmul(builder.fmul(value, c, flags=fast), b, flags=fast) for c in z for b in y
        ]
        for place, part in zip(_rows(builder, at, unpacked(steps)), each, strict=True):
            added = builder.fmul(along, spread(builder, part), flags=fast)
            before = builder.load(place, align=4)
            builder.store(builder.fadd(before, added, flags=fast), place, align=4)
        return context.get_dummy_value()

    return types.void(first, steps, shares, value), generate


@door(*_SOURCES, **_ASKED)
def gather(layer, nodes, found):  # type: ignore[no-untyped-def]
    """Interpolated distances at points of one moment; ``layer`` has ``room``."""
    height, width = layer.shape[1], layer.shape[2]
    start, steps = np.uintp(layer.ctypes.data), (np.uintp(4 * width), np.uintp(4 * height * width))
    for n in range(len(nodes)):
        x, wx = _weigh(nodes[n, 0])
        y, wy = _weigh(nodes[n, 1])
        z, wz = _weigh(nodes[n, 2])
        first = start + np.uintp(4 * ((z * height + y) * width + x))
        found[n] = _ask(first, steps, wx, wy, wz)


@door(*_SOURCES, **_ASKED)
def scatter(layer, nodes, values, squared):  # type: ignore[no-untyped-def]
    """Add to every coefficient the values of the points that it acts on, by its weight there or,
    where ``squared``, by that weight's square."""
    height, width = layer.shape[1], layer.shape[2]
    start, steps = np.uintp(layer.ctypes.data), (np.uintp(4 * width), np.uintp(4 * height * width))
    for n in range(len(nodes)):
        x, wx = _weigh(nodes[n, 0])
        y, wy = _weigh(nodes[n, 1])
        z, wz = _weigh(nodes[n, 2])
        if squared:
            wx, wy, wz = _squares(wx), _squares(wy), _squares(wz)
        first = start + np.uintp(4 * ((z * height + y) * width + x))
        _add(first, steps, (wx, wy, wz), values[n])
