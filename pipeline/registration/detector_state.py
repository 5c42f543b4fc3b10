"""What the R-peak detector keeps between samples, as arrays that compiled code can hold."""

from __future__ import annotations

from typing import NamedTuple

from pipeline.geometry import Float, Integer

# Rows of found beats.
TIME, KNOWN, LEAD, HEIGHT, LIKENESS, LATE, INSTEAD, FIELDS = range(8)
# Columns of the state of a lead.
(
    LEVEL, NOISE, LAST, RUN, JUMPED, BAD_UNTIL, WAY, OFFSET, SHIFT, TIMED, SIZE, WEIGHT,
    SIGN, SCATTER, LEAN, LEAN_NOW, PEAK, FINER, HEIGHT_MV,
    SMALLEST_STEP, LOWEST, LOWEST_OLD, LOWEST_OLDER, STILLEST, EPOCH_END, TALL, STEEP,
    TALL_HERE, STEEP_HERE, LEAD_FIELDS,
) = range(30)  # fmt: skip
LEARNT_OF_BEATS = (LEVEL, WAY, OFFSET, SHIFT, TIMED, SIZE, SCATTER, LEAN, TALL, STEEP)
"""What a beat changes of a lead."""
# Counters.
(
    SEEN,
    BEST_AT,
    LAST_BEAT,
    FOUND,
    WAITING,
    INTERVALS,
    STRANGE,
    LEARNT,
    LEARN_AT,
    USABLE,
    BEATS,
    TOWERS,
    COUNTERS,
) = range(13)
# Numbers.
(
    BEST, LAST_HEIGHT, BETWEEN, USUAL_RR, LAST_LIKENESS, LAST_STEEP, LAST_TALL, TALL_NOW,
    STEEP_NOW, NUMBERS,
) = range(10)  # fmt: skip
KEPT_INTERVALS, KEPT_WAVES = 8, 64
SHAPE_POINTS = 21
"""Places about R at which shapes are compared."""


class Plan(NamedTuple):
    """What a sampling rate fixes, in samples."""

    rate_hz: float
    length: int
    """Samples that the rings hold."""
    half: int
    """Half the wavelet's width."""
    mean: int
    """Half the width of the mean that follows it."""
    confirm: int
    """How long a wave must stay the highest."""
    learn: int
    """How much is seen before the first decision."""


class Learnt(NamedTuple):
    """What was known before the latest beat, to be restored where that was none."""

    leads: Float
    shapes: Float
    intervals: Float
    counters: Integer
    numbers: Float


class State(NamedTuple):
    """Everything that changes while samples come in."""

    even: Float
    odd: Float
    coarse: Float
    """Kernels ``(taps,)``: the wavelet's two parts, and two smoothings for timing."""
    fine: Float
    raw: Float
    """``(leads, 2 length)``."""
    power: Float
    """``(leads, 2 length)`` squared envelope."""
    energy: Float
    """``(leads, length)`` root of its mean."""
    fused: Float
    """``(length,)`` energy of all leads in units of a beat."""
    waves: Float
    """``(KEPT_WAVES, 4)`` latest waves that were no beats: sample, energy, steepness, height."""
    intervals: Float
    """``(KEPT_INTERVALS,)`` latest RR intervals in samples."""
    leads: Float
    shapes: Float
    """``(leads, SHAPE_POINTS)`` usual shape of a beat."""
    seen: Float
    """``(leads, SHAPE_POINTS)`` shape of the beat that was measured last."""
    found: Float
    counters: Integer
    numbers: Float
    before: Learnt
