"""What the R-peak detector keeps between samples: records whose fields compiled code reads by name.

Each class below is one kind of record. ``records`` makes an array of them from its annotations, and
the compiler takes ``s.leads[k].noise`` from there. What beats have taught (``Usual``, ``Rhythm``)
is apart from what merely happens now, so that a beat that turns out to be none is unlearnt as a
whole. Times are numbers of samples since the first; energies are in a lead's own units, heights of
waves in units of the usual beat.
"""

from __future__ import annotations

from collections.abc import MutableSequence
from functools import cache
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np

from pipeline.geometry import Float

KEPT_INTERVALS, KEPT_BEATS, KEPT_WAVES, KEPT_FOUND = 8, 9, 64, 64
SHAPE_POINTS = 21
"""Places about R at which shapes are compared."""
T_STEPS, T_STEP_S = 24, 0.02
"""Times after a beat, so far apart, for which it is kept how often a T wave came then."""


class Usual:
    """A lead's usual beat, as beats have taught it."""

    level: float
    """Energy; 0 while unknown."""
    tall: float
    steep: float
    size_mv: float
    """Height of the main deflection above rest."""
    way: float
    """Side of the main deflection: 1 up, -1 down."""
    lean: float
    """By how much that side is the larger, in [-1, 1]; below 0 is down."""
    offset: float
    """How long after R, as all leads tell it, this one peaks: S does in V1."""
    shift: float
    """How far smoothing moves the peak, and how much that scatters."""
    scatter: float
    timed: float
    """How many beats taught this, up to 64."""
    shape: Annotated[Float, SHAPE_POINTS]


class Here:
    """The same of the wave that was measured last."""

    tall: float
    steep: float
    size_mv: float
    sign: float
    """Side of the deflection that times it."""
    lean: float
    peak: float
    """Its time, after the middle of the complex."""
    shift: float
    shape: Annotated[Float, SHAPE_POINTS]


class Lead:
    """A lead: whether it is connected, how noisy it is, what say it has, and its beats."""

    last: float
    """Latest sample."""
    run: int
    """For how many samples it has not changed."""
    missing: int
    """How many samples in succession were none."""
    jumped: bool
    """Whether it came to that value by a jump."""
    bad_until: float
    """When what disturbed it has left the filters."""
    smallest_step: float
    """Step of its converter, as far as seen."""
    lowest: float
    """Least swing in this epoch, in the one before, and in the one before that."""
    lowest_old: float
    lowest_older: float
    stillest: float
    """Least swing since it was lost; infinite while it is not."""
    wildest: float
    """Largest swing in this epoch."""
    quiet: float
    """Swing that it stays under in three of ten windows since it was lost; 0 while it is not."""
    quiet_from: float
    """When that is known."""
    epoch_end: float
    noise: float
    """Energy between its beats."""
    weight: float
    """Its say in what the leads tell together; 0 while it shows nothing."""
    here: Here
    wide: Annotated[Float, SHAPE_POINTS]
    """Shape of the last tall and wide wave of low energy."""
    usual: Usual
    before: Usual
    """What was usual before the latest beat, should that be none."""


class Rhythm:
    """The beats so far."""

    beats: int
    last_at: int
    last_height: float
    last_likeness: float
    last_tall: float
    last_steep: float
    last_sharp: float
    strange: int
    """Beats of another shape in succession."""
    outdone: bool
    """Whether a sharper wave followed the last beat too soon for a beat of its own."""
    outdone_before: int
    """For how many beats in succession, up to the one before that, this was so."""
    t_wave: Annotated[Float, T_STEPS]
    """How often, of late, a dull wave came so long after a beat."""
    t_wave_now: Annotated[Float, T_STEPS]
    """1 where one came after the last beat."""
    t_height: float
    """Energy that such waves have at most, on average."""
    t_height_now: float
    intervals: int
    """RR intervals so far, of which the latest are kept."""
    interval: Annotated[Float, KEPT_INTERVALS]
    usual_rr: float
    """Their mean."""
    at: Annotated[Float, KEPT_BEATS]
    """Times, energies, heights over steepness, and likenesses of the latest beats: a ring."""
    height: Annotated[Float, KEPT_BEATS]
    breadth: Annotated[Float, KEPT_BEATS]
    alike: Annotated[Float, KEPT_BEATS]
    echo_s: float
    """How long after a beat an echo of it comes; 0 where there is none."""
    echo_height: float
    """Its energy, as a share of the beat's."""
    echo_breadth: float
    """Its height over steepness, as a share of the beat's."""
    echo_share: float
    """How often, of late, one came."""
    echoed: bool
    """Whether one came after the last beat."""


class Now:
    """Where the detector stands."""

    seen: int
    """Samples taken."""
    learnt: bool
    """Whether levels are known, so that waves can be judged."""
    learn_at: int
    """When levels were learnt last, or tried to be."""
    usable: bool
    """Whether some lead is connected."""
    best: float
    """Height of what may become the next wave, and when."""
    best_at: int
    between: float
    """Height of waves between beats."""
    tall: float
    """Height and steepness of the wave measured last, as shares of the usual beat's."""
    steep: float
    sharp: float
    """How much of its steepest change half the time takes: 0.5 where it is smooth, 1 for a step."""
    overdue: bool
    """Whether waves are judged again because a beat is overdue."""
    anew: bool
    """Whether the wave judged last shows that the beats before it were none."""
    after: bool
    """Whether the wave measured last may be the T wave of the last beat."""
    towers: int
    """First beats that towered over the others."""
    waiting: int
    """Waves that were no beats since the last beat, of which the latest are kept."""
    found: int
    """Beats that became known with this block of samples."""
    rhythm: Rhythm
    before: Rhythm
    """The same before the latest beat, should that be none."""


class Wave:
    """One that was no beat, kept for when a beat is overdue."""

    at: int
    height: float
    tall: float
    steep: float


class Found:
    """A beat that became known."""

    time_s: float
    known_at: int
    lead: int
    """The one that shows it best."""
    height: float
    likeness: float
    """Correlation of its shape with the usual one."""
    breadth: float
    """How much less steep it is for its height than the usual beat."""
    late: bool
    instead: bool
    """Told in the place of the beat before, which was its P wave."""


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


class State(NamedTuple):
    """Kernels, and everything that changes while samples come in.

    Arrays of records are typed as what they behave like. They are few: each costs time with every
    call of compiled code.
    """

    even: Float
    """Kernels ``(taps,)``: the wavelet's two parts, and two smoothings for timing."""
    odd: Float
    coarse: Float
    fine: Float
    raw: Float
    """``(leads, 2 length)``."""
    power: Float
    """``(leads, 2 length)`` squared envelope."""
    energy: Float
    """``(leads, length)`` root of its mean."""
    fused: Float
    """``(length,)`` energy of all leads in units of a beat."""
    leads: MutableSequence[Lead]
    now: MutableSequence[Now]
    """One record."""
    waves: MutableSequence[Wave]
    """``KEPT_WAVES``, a ring."""
    found: MutableSequence[Found]


def records(kind: type, count: int) -> Any:
    """``(count,)`` records with the fields of a class, all zero."""
    return np.zeros(count, _layout(kind))


@cache
def _layout(kind: Any) -> Any:
    """How a field, or a class of fields, lies in memory: as in a C struct.

    One object for each: of layouts that are merely equal the compiler has to look at every field
    with every call, 2 to 4 us a sample.
    """
    if kind in (float, int, bool):
        return np.dtype(kind)
    if get_args(kind):
        _, length = get_args(kind)
        return np.dtype((float, length))
    hints = get_type_hints(kind, include_extras=True)
    return np.dtype([(name, _layout(hint)) for name, hint in hints.items()], align=True)
