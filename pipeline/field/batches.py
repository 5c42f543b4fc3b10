"""Compiled kernels for many questions that do not follow one another.

Each random question to a field of many phases reads some thirty lines of memory that nobody has
read before it. Sorted by height and phase, questions find in the cache what others have read, and
what the next ones will ask for is fetched meanwhile: the same as ``bf_distances`` of the C header
does with scratch room. The answers are those of ``kernels.sample``, number by number.

Importing this module imports numba; only functions that need it do so.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.compiled import fetch
from pipeline.field import kernels
from pipeline.geometry import Float

FEW = 4096
"""Fewer questions than this are answered as they come."""

_PAIRS = 64
_BINS = 4096
# Bytes of coefficients that the questions of a bin may ask for: a part of a processor's own cache.
_CACHE = 1 << 19
_LINE = 64
_MANY_LINES = 16

_spline_at, _felt_at, _moment_of = kernels.spline_at, kernels.felt_at, kernels.moment_of
_asked, _inner = kernels.asked, kernels.inner


def follow(points_mm: Float, phases: Float, grid: Float, phase_count: int) -> bool:
    """Whether questions follow one another, as far as a few pairs of them tell.

    Parameters
    ----------
    points_mm, phases, grid
        As for ``kernels.sample``; at least two points.
    phase_count
        How many phases are stored.
    """
    first = np.arange(_PAIRS) * ((len(points_mm) - 2) // _PAIRS)
    far = (np.abs(points_mm[first + 1] - points_mm[first]) * grid[9:]).sum(axis=1) > 4
    if len(phases) > 1:
        beats = phases[first + 1] - phases[first]
        far |= np.abs(beats - np.floor(beats + 0.5)) * phase_count > 2
    return bool(far.sum() < _PAIRS // 4)


@_asked
def sort(line, grid, points_mm, phases, bins, ends, notes):  # type: ignore[no-untyped-def]
    """Copy questions into notes, those of a bin after one another.

    Parameters
    ----------
    line, grid, points_mm, phases
        As for ``kernels.sample``.
    bins
        ``(n,)`` where the number of each question's bin goes: by height first, then by phase.
    ends
        ``(bin + 1,)`` zeros: where each bin's notes end goes; a multiple of the phases, and one.
    notes
        ``(n, 4)`` where x, y, z and phase go.
    """
    count, depth = len(line), grid[8]
    slabs = (len(ends) - 1) // count
    for n in range(len(points_mm)):
        k, _ = _moment_of(line, phases[n if len(phases) > 1 else 0])
        place = (points_mm[n, 2] - grid[2]) * grid[11] / depth
        bins[n] = int(min(max(place, 0.0) * slabs, slabs - 1.0)) * count + k
        ends[bins[n] + 1] += 1
    for n in range(1, len(ends)):
        ends[n] += ends[n - 1]
    for n in range(len(points_mm)):
        to = ends[bins[n]]
        ends[bins[n]] += 1
        notes[to, 0], notes[to, 1], notes[to, 2] = points_mm[n, 0], points_mm[n, 1], points_mm[n, 2]
        notes[to, 3] = phases[n if len(phases) > 1 else 0]


@_inner
def _ahead(addresses, grid, ends, number):  # type: ignore[no-untyped-def]
    """Where the coefficients start and end that the bin after this asks for, but this does not.

    Those are the ones of one more phase in the same slab.
    """
    count, depth = len(addresses), int(grid[8])
    slabs = (len(ends) - 1) // count
    after = min(number + 1, slabs * count - 1)
    slab, layer = after // count, 4 * int(grid[6]) * int(grid[7])
    low = max(slab * depth // slabs - 1, 0)
    high = min((slab + 1) * depth // slabs + 2, depth)
    start = addresses[(after + 1) % count]
    return start + np.uintp(low * layer), start + np.uintp(high * layer)


@_inner
def _fetch_some(at, end, lines):  # type: ignore[no-untyped-def]
    """Fetch so many lines, unless they are too many to be worth it; where the next one starts."""
    if lines <= np.uintp(_MANY_LINES):
        stop = min(at + lines * np.uintp(_LINE), end)
        while at < stop:
            fetch(at)
            at += np.uintp(_LINE)
    return at


@_asked
def answer(addresses, line, grid, ends, notes):  # type: ignore[no-untyped-def]
    """Put distance and gradient in the place of the sorted questions in the notes."""
    n = 0
    for number in range(len(ends) - 1):
        at, end = _ahead(addresses, grid, ends, number)
        each = (end - at) // np.uintp(_LINE) // np.uintp(max(ends[number] - n, 1)) + np.uintp(1)
        while n < ends[number]:
            at = _fetch_some(at, end, each)
            notes[n, 0], notes[n, 1], notes[n, 2], notes[n, 3] = _spline_at(
                addresses, line, grid, notes[n, 0], notes[n, 1], notes[n, 2], notes[n, 3]
            )
            n += 1


@_asked
def answer_force(law, ends, notes):  # type: ignore[no-untyped-def]
    """Put the force (its distance behind it) in the place of the sorted questions."""
    n = 0
    for number in range(len(ends) - 1):
        at, end = _ahead(law[0], law[2], ends, number)
        each = (end - at) // np.uintp(_LINE) // np.uintp(max(ends[number] - n, 1)) + np.uintp(1)
        while n < ends[number]:
            at = _fetch_some(at, end, each)
            notes[n, 0], notes[n, 1], notes[n, 2], notes[n, 3] = _felt_at(
                law, notes[n, 0], notes[n, 1], notes[n, 2], notes[n, 3]
            )
            n += 1


@_asked
def bring_back(bins, ends, notes, first, number, vector):  # type: ignore[no-untyped-def]
    """Copy answers back in the order of the questions.

    Parameters
    ----------
    bins, ends, notes
        As ``sort`` and an answer left them; the ends are moved.
    first
        Which of a note's four numbers is the first of its vector.
    number, vector
        Where the other one, and the vector go: ``(n,)`` or of no length, and ``(n, 3)``.
    """
    for n in range(len(ends) - 1, 0, -1):
        ends[n] = ends[n - 1]
    ends[0] = 0
    for n in range(len(bins)):
        note = ends[bins[n]]
        ends[bins[n]] += 1
        if len(number) > 0:
            number[n] = notes[note, 3 - first * 3]
        for axis in range(3):
            vector[n, axis] = notes[note, first + axis]


def _sorted(line: Float, grid: Float, points_mm: Float, phases: Float) -> tuple[Any, Any, Float]:
    slabs = 1 + int(3 * 4 * grid[6] * grid[7] * grid[8]) // _CACHE
    slabs = max(min(slabs, _BINS // len(line), int(grid[8])), 1)
    bins = np.empty(len(points_mm), np.uint16)
    ends = np.zeros(slabs * len(line) + 1, np.int64)
    notes = np.empty((len(points_mm), 4))
    sort(line, grid, points_mm, phases, bins, ends, notes)
    return bins, ends, notes


def sample(
    addresses: Any, line: Float, grid: Float, points_mm: Float, phases: Float,
    distance_mm: Float, gradient: Float,
) -> None:  # fmt: skip
    """``kernels.sample``, in the order that suits the memory."""
    if len(points_mm) < FEW or follow(points_mm, phases, grid, len(line)):
        kernels.sample(addresses, line, grid, points_mm, phases, distance_mm, gradient)
        return
    bins, ends, notes = _sorted(line, grid, points_mm, phases)
    answer(addresses, line, grid, ends, notes)
    bring_back(bins, ends, notes, 1, distance_mm, gradient)


def sample_force(law: Any, points_mm: Float, phases: Float, force_n: Float) -> None:
    """``kernels.sample_force``, in the order that suits the memory."""
    line, grid = law[1], law[2]
    if len(points_mm) < FEW or follow(points_mm, phases, grid, len(line)):
        kernels.sample_force(law, points_mm, phases, force_n)
        return
    bins, ends, notes = _sorted(line, grid, points_mm, phases)
    answer_force(law, ends, notes)
    bring_back(bins, ends, notes, 0, np.empty(0), force_n)
