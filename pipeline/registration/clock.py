"""The phase clock: where in the heartbeat the heart is *now*, from past beats alone.

Systole keeps its length when the rate changes and diastole gives way: electromechanical systole
lasts 546 - 2.1 HR ms in men and 549 - 2.0 HR ms in women (A. M. Weissler, W. S. Harris and C. D.
Schoenfeld, "Systolic time intervals in heart failure in man", Circulation 37 (1968) 149-159); the
mean of both less 40 ms from Q to R is taken. Atria contract a fixed 120 ms before the next R. So a
time in a beat of any length has its phase on the axis of one nominal beat, that of the MR, by a
smooth map that puts R peak, end of systole and atrial contraction on their own places.

The next R is predicted from the intervals before it by a regression on the last two, which follows
breathing and ramps. The phase runs on through the predicted R until the true one is known, and is
then corrected by running at half to one and a half times its speed: where it is valid it neither
jumps nor turns back. Every answer says whether it is valid, how sure it is, and how much of a
fixture's force should be rendered (``fade``, whose rate is bounded). The same clock in C99 is
``beatfield_clock.h``, in the folder that ``pipeline.field.get_include()`` names.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.registration import intervals, ticks

State = Literal["lost", "regular", "ectopic", "fibrillating"]
Kind = Literal["normal", "ectopic", "irregular"]

STATES: tuple[State, ...] = ("lost", "regular", "ectopic", "fibrillating")
KINDS: tuple[Kind, ...] = ("normal", "ectopic", "irregular")

# A phase known later than that is of another beat.
_LONGEST_LATENCY_S = 1.0


@dataclass(frozen=True, slots=True)
class Tick:
    """What the clock says at one moment."""

    phase: float
    """[0, 1) of the nominal beat, 0 at the R peak."""

    sd: float
    """Standard deviation of the phase, as far as intervals and R times leave it unsure."""

    state: State
    """``lost``: no lead, no rhythm yet, or a beat is overdue. ``ectopic``: a beat came early, or
    looks unlike the others, and no regular interval has passed since. ``fibrillating``: intervals
    have no order."""

    valid: bool
    """Whether the phase can be relied on. False in every state but ``regular``."""

    fade: float
    """Share of a fixture's force to render, in [0, 1]: goes to 1 while valid and not withheld."""


class PhaseClock:
    """Phase of a heart now, from the R times that are known.

    Parameters
    ----------
    cycle_rr_s
        Length of the nominal beat whose phases are asked for: ``rr_s`` of the baked field.
    f_max_n, force_rate_n_per_s
        Largest force of the fixture, and how fast it may be faded in or out.
    latency_s
        How long after its R peak a beat may be told: an overdue one is noticed so much later.

    Raises
    ------
    InputError
        When a number is not positive, the cycle is None or none of a heart, or the latency is over
        1 s.
    """

    def __init__(
        self,
        cycle_rr_s: float | None,
        *,
        f_max_n: float = 3.3,
        force_rate_n_per_s: float = 10.0,
        latency_s: float = ticks.LATENCY_S,
    ) -> None:
        cycle_rr_s, fade_per_s = _fit(cycle_rr_s, f_max_n, force_rate_n_per_s)
        if not 0 < latency_s <= _LONGEST_LATENCY_S:
            raise InputError(
                f"clock: latency_s = {latency_s:g}; give up to {_LONGEST_LATENCY_S:g} seconds"
            )
        self._state = np.empty(intervals.SIZE)
        # All that a loop calls is compiled here, where a machine has not done so: on what is reset.
        ticks.reset(self._state, cycle_rr_s, fade_per_s, float(latency_s))
        ticks.beat(self._state, 0.0, False)
        ticks.take_back(self._state)
        ticks.advance(self._state, 0.0, False, False)
        ticks.change(self._state, cycle_rr_s, fade_per_s)
        ticks.reset(self._state, cycle_rr_s, fade_per_s, float(latency_s))

    def beat(self, r_time_s: float, strange: bool = False) -> Kind | None:
        """Tell the clock of an R peak; what kind of beat it is.

        None when it does not count: it lies no later than one that was told already, or more than
        3 s after the latest time that the clock was told of, by :meth:`at` or by a beat. So far
        ahead it was timed by another clock, or in another unit. The phase goes on as if it had not
        been told; it is the last beat to :meth:`take_back`, which then takes nothing back.

        Parameters
        ----------
        r_time_s
            Seconds, on the clock of :meth:`at`.
        strange
            Whether the beat's shape is unlike the others', as of one from the ventricle.
        """
        kind = ticks.beat(self._state, float(r_time_s), bool(strange))
        return KINDS[kind] if kind >= 0 else None

    def take_back(self) -> None:
        """The last beat was none, as a P wave that its R followed (`rpeaks.Beat.instead`).

        To be told at once, before the beat that shows it. The clock knows what it knew before; the
        phase that it gave since is corrected as any other that is off.
        """
        ticks.take_back(self._state)

    def change_field(
        self, cycle_rr_s: float | None, *, f_max_n: float = 3.3, force_rate_n_per_s: float = 10.0
    ) -> None:
        """Go on for another field, with all that beats have told.

        Raises
        ------
        InputError
            When something is still rendered of the one before (withhold, until the fade is 0), or a
            number is none, as for a new clock.
        """
        cycle_rr_s, fade_per_s = _fit(cycle_rr_s, f_max_n, force_rate_n_per_s)
        if ticks.change(self._state, cycle_rr_s, fade_per_s) < 0:
            raise InputError(
                f"clock: the field changes at a fade of {self.tick.fade:g}, a step of force; ask "
                "with withheld until it is 0"
            )

    def at(self, now_s: float, usable: bool = True, *, withheld: bool = False) -> Tick:
        """Phase now.

        Where the last beat lies more than 0.02 s ahead of it, beats and questions are timed by
        different clocks: all beats are forgotten, and the rhythm is learnt anew. The fade moves by
        0.02 s' worth at most, and while it is not 0 the phase makes up for no more than that, or
        three usual turns, however long nobody asked: a phase that is then too far off is not valid
        until it was faded out and set.

        Parameters
        ----------
        now_s
            Seconds; never before the time last asked for.
        usable
            Whether any lead of the electrocardiogram is connected.
        withheld
            Whether no force is wanted now, as of a tool outside the field's grid: the fade goes to
            0, and the rhythm is followed as ever.

        Raises
        ------
        InputError
            When the time is before the last one, not a number, or beyond 1e11 s. If it is so by
            more than 0.02 s, beats are forgotten, the fade falls as in a millisecond, and time goes
            on from there: what is to be rendered then, :attr:`tick` says.
        """
        c = self._state
        before_s = c[intervals.NOW]
        if ticks.advance(c, float(now_s), bool(usable), bool(withheld)) < 0:
            raise InputError(f"clock: asked for {now_s} s after {before_s} s; time must rise")
        return self.tick

    @property
    def tick(self) -> Tick:
        """What the clock says as it stands, without a question."""
        c = self._state
        return Tick(
            float(c[intervals.PHASE]),
            float(c[intervals.SD]),
            STATES[int(c[intervals.STATE])],
            bool(c[intervals.VALID] > 0),
            float(c[intervals.FADE]),
        )

    @property
    def next_rr_s(self) -> float:
        """The RR interval that is expected now."""
        return float(self._state[intervals.RR])

    @property
    def tolerance_s(self) -> float:
        """How far from the expected time a regular beat may come, before or after."""
        return float(intervals.tolerance(self._state))


def _fit(
    cycle_rr_s: float | None, f_max_n: float, force_rate_n_per_s: float
) -> tuple[float, float]:
    """Length of the nominal beat, and share of the force that is faded in a second."""
    if cycle_rr_s is None:
        raise InputError(
            "clock: cycle_rr_s is None, as of a field that does not know its beat; give what a "
            "beat lasts usually"
        )
    if not ticks.SHORTEST_RR_S <= cycle_rr_s <= ticks.LONGEST_RR_S:
        raise InputError(
            f"clock: cycle_rr_s = {cycle_rr_s:g} is no heartbeat; give "
            f"{ticks.SHORTEST_RR_S:g} to {ticks.LONGEST_RR_S:g} seconds"
        )
    if not (0 < f_max_n < math.inf and 0 < force_rate_n_per_s < math.inf):
        raise InputError(
            f"clock: f_max_n = {f_max_n:g}, force_rate_n_per_s = {force_rate_n_per_s:g}; "
            "both must be positive"
        )
    return float(cycle_rr_s), force_rate_n_per_s / f_max_n


def systole_s(rr_s: float) -> float:
    """Time from the R peak to the closure of the aortic valve in a beat of ``rr_s``.

    Slower than 45 beats a minute its length is held, faster than 120 its share of the beat, for the
    regressions come from rates at rest.

    >>> round(systole_s(0.8), 4), round(systole_s(0.6), 4)
    (0.3537, 0.3025)
    """
    return ticks.systole_share(rr_s) * rr_s


def to_cycle(phases: npt.ArrayLike, rr_s: npt.ArrayLike, cycle_rr_s: float) -> Float:
    """Phases of beats of their own lengths on the axis of one nominal beat.

    Parameters
    ----------
    phases
        Any shape, in [0, 1): trigger time or time since R, over the RR interval of its own beat.
    rr_s
        Those intervals, seconds; one, or of a shape that fits.
    cycle_rr_s
        Length of the nominal beat: the mean RR interval of the MR.

    Raises
    ------
    InputError
        When a phase lies outside [0, 1), or an interval is not positive and finite.

    >>> to_cycle([0.0, 0.4], 0.8, 0.8)
    array([0. , 0.4])
    >>> bool(to_cycle(0.4, 0.6, 0.8) < 0.4 < to_cycle(0.4, 1.0, 0.8))
    True
    """
    own, lengths = np.broadcast_arrays(
        np.asarray(phases, dtype=float), np.asarray(rr_s, dtype=float)
    )
    if not ((own >= 0) & (own < 1)).all():
        raise InputError("phases must lie in [0, 1)")
    if not ((lengths > 0) & np.isfinite(lengths)).all() or not 0 < cycle_rr_s < np.inf:
        raise InputError(
            f"RR intervals must be positive and finite, got {np.min(lengths)} to "
            f"{np.max(lengths)} and {cycle_rr_s} s"
        )
    out = np.empty(own.size)
    ticks.to_cycle_all(own.ravel(), lengths.ravel(), float(cycle_rr_s), out)
    return out.reshape(own.shape)
