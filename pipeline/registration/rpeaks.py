"""R peaks of an electrocardiogram, sample by sample: what a force server and the pipeline both use.

``RPeakDetector`` takes samples as they come and says of every beat when its R peak was, at the
latest ``LATENCY_S`` after it; ``find_beats`` runs the same over a recording. The design is told in
``qrs``.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.registration.detector_state import (
    KEPT_FOUND,
    KEPT_WAVES,
    Found,
    Lead,
    Now,
    Plan,
    State,
    Wave,
    records,
)
from pipeline.registration.qrs import feed
from pipeline.registration.waves import ALIKE

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 100.0, 2000.0
# A rate as little beyond is one of these: times are rounded, and recorders' clocks not exact.
_GRACE = 1.0001
LATENCY_S = 0.15
"""A beat is known this long after the middle of its QRS complex, and is final then. Two beats are
known later: those while levels are learnt, and overdue ones whose energy was low (``late``)."""
LEARN_S = 2.0
"""Levels are learnt for so long, and on to 6 s while no beat stands out."""
KEPT_SHAPES, LEAST_SHAPES = 16, 6
"""A beat's likeness and breadth are compared with those of so many beats before it, and with no
fewer."""
LEAST_MARGIN, SCATTERS = 0.06, 3.0
"""Less alike than the median by both this and so many standard deviations is another shape."""
WIDER, WIDE_SCATTERS = 1.4, 4.0
"""So is what is broader for its height than the median by both so many times and so many standard
deviations of the logarithm: complexes of 0.08 s, and of 0.12 s as the narrowest from the ventricle,
are 1.5 apart."""
# Of a normal distribution, by its median absolute deviation.
_DEVIATION = 1.4826
# The wavelet's standard deviation: its band is 7 to 23 Hz at half height, the summit at 15 Hz.
_WAVELET_S = 0.016
_HALF_S, _MEAN_S, _CONFIRM_S = 0.050, 0.025, 0.055
# Near the width of a QRS complex, which times it best in noise; and one that keeps its summit.
_COARSE_S, _FINE_S = 0.008, 0.004
_MEMORY_S = 8.0
_CHUNK_S = 5.0

Kind = TypeVar("Kind")


@dataclass(frozen=True, slots=True)
class Beat:
    """One heartbeat, as it became known."""

    time_s: float
    """R time, seconds after the first sample."""

    known_s: float
    """Time of the sample with which it became known."""

    lead: int
    """Number of the lead that showed it best."""

    height: float
    """Energy of its QRS complex; 1 is usual."""

    likeness: float
    """Correlation of its shape with the usual one."""

    late: bool
    """Found only when it was overdue, or while the first beats were learnt."""

    strange: bool
    """Whether it looks unlike the usual beat, as those from the ventricle do."""

    instead: bool = False
    """Told in the place of the beat told before it, which was this one's P wave."""


class RPeakDetector:
    """Finds R peaks in samples as they come; memory and time for a sample are bounded.

    Leads may have either polarity and any gain and offset, and may come and go: a sample that is
    not a number, a voltage that stays the same after a jump, less of a swing than the heart ever
    lets it have (``quality``), and noise all take a lead's say.

    Make it before a loop begins: the first one on a machine compiles for some 20 s.

    Parameters
    ----------
    sampling_rate_hz
        Samples a second, 100 to 2000.
    leads
        Number of leads.

    Raises
    ------
    InputError
        When the rate lies outside, or there is no lead.
    """

    def __init__(self, sampling_rate_hz: float, leads: int = 1) -> None:
        if not is_fit_rate(sampling_rate_hz):
            raise InputError(
                f"ECG: {sampling_rate_hz:g} samples a second; R peaks are found at "
                f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g}; record or resample it so"
            )
        if leads < 1:
            raise InputError(f"ECG: {leads} leads; at least one is needed")
        self._plan = _plan(float(sampling_rate_hz))
        self._state = _state(self._plan, leads)
        self._leads = leads
        self._likenesses: deque[float] = deque(maxlen=KEPT_SHAPES)
        self._breadths: deque[float] = deque(maxlen=KEPT_SHAPES)
        # Compiled now, where a machine has not done so: the first sample cannot wait for it.
        self._feed(np.empty((0, leads)))

    def push(self, samples_mv: npt.ArrayLike) -> list[Beat]:
        """Take the next sample ``(leads,)``, or several ``(n, leads)``; beats that became known.

        Raises
        ------
        InputError
            When the number of leads is another, or samples are words. Samples may be NaN: missing.
        """
        try:
            block = np.atleast_2d(np.ascontiguousarray(samples_mv, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise InputError(f"ECG: samples must be numbers ({error})") from error
        if block.ndim != 2 or block.shape[1] != self._leads:
            raise InputError(
                f"ECG: samples of shape {np.shape(samples_mv)}; needs (n, {self._leads})"
            )
        return [beat for part in self._parts(block) for beat in self._feed(part)]

    @property
    def usable(self) -> bool:
        """Whether some lead is connected, by the last sample; not 0.1 s after all fell silent."""
        return bool(np.asarray(self._state.now)["usable"][0])

    def _feed(self, block: Float) -> list[Beat]:
        count = feed(block, self._plan, self._state)
        return [self._beat(found) for found in _by_name(self._state.found, count)] if count else []

    def _parts(self, block: Float) -> Iterator[Float]:
        """Pieces short enough for the list of found beats."""
        step = int(_CHUNK_S * self._plan.rate_hz)
        return (block[start : start + step] for start in range(0, len(block), step))

    def _beat(self, found: Found) -> Beat:
        likeness = float(found.likeness)
        breadth = math.log(max(float(found.breadth), 1e-3))
        strange = _is_strange(likeness, self._likenesses) or _is_wide(breadth, self._breadths)
        self._likenesses.append(likeness)
        self._breadths.append(breadth)
        return Beat(
            time_s=float(found.time_s),
            known_s=float(found.known_at / self._plan.rate_hz),
            lead=int(found.lead),
            height=float(found.height),
            likeness=likeness,
            late=bool(found.late),
            strange=strange,
            instead=bool(found.instead),
        )


def is_fit_rate(rate_hz: float) -> bool:
    """Whether R peaks are found at so many samples a second: 100 to 2000, as told by a clock."""
    return LOWEST_RATE_HZ / _GRACE <= rate_hz <= HIGHEST_RATE_HZ * _GRACE


def find_beats(signal_mv: Float, sampling_rate_hz: float) -> list[Beat]:
    """All beats of a recording ``(n, leads)``, in order, by the detector that a stream would use,
    without those that others were told instead of.

    The last value is held for ``LATENCY_S``, so that the last beats become known too.

    Raises
    ------
    InputError
        When the rate is outside 100 to 2000 Hz or there is no lead.
    """
    if signal_mv.ndim != 2:
        raise InputError(f"ECG: needs an array (samples, leads), got {signal_mv.shape}")
    detector = RPeakDetector(sampling_rate_hz, signal_mv.shape[1])
    beats: list[Beat] = []
    for beat in detector.push(with_end_held(signal_mv, sampling_rate_hz)):
        if beat.instead:
            del beats[-1:]
        beats.append(beat)
    end_s = (len(signal_mv) - 1) / sampling_rate_hz
    # The few that were overdue became known after a later one.
    return sorted((beat for beat in beats if 0 <= beat.time_s <= end_s), key=attrgetter("time_s"))


def with_end_held(signal_mv: Float, sampling_rate_hz: float) -> Float:
    """The recording ``(n, leads)``, its last sample repeated for as long as a beat needs."""
    held = np.repeat(signal_mv[-1:], math.ceil(LATENCY_S * sampling_rate_hz), axis=0)
    return np.concatenate([signal_mv, held])


def _is_strange(likeness: float, others: Collection[float]) -> bool:
    """Whether a beat's likeness to the usual shape is less than the scatter of ``others`` explains.

    A wide beat that begins as the usual one does is about as alike as a usual one in noise: what
    tells them apart is how alike the beats before were.
    """
    if len(others) < LEAST_SHAPES:
        return likeness < ALIKE
    usual, scatter = _spread(others)
    return likeness < max(ALIKE, usual - max(LEAST_MARGIN, SCATTERS * scatter))


def _is_wide(breadth: float, others: Collection[float]) -> bool:
    """Whether a beat's breadth, a logarithm, is more than the scatter of ``others`` explains.

    Shapes are compared in the band of the usual complex, in which a wide one about the same peak
    looks much like it.
    """
    if len(others) < LEAST_SHAPES:
        return False
    usual, scatter = _spread(others)
    return breadth > usual + max(math.log(WIDER), WIDE_SCATTERS * scatter)


def _spread(values: Collection[float]) -> tuple[float, float]:
    """Median, and standard deviation by the median absolute deviation."""
    usual = statistics.median(values)
    return usual, _DEVIATION * statistics.median(abs(value - usual) for value in values)


def _plan(rate_hz: float) -> Plan:
    return Plan(
        rate_hz=rate_hz,
        length=math.ceil(_MEMORY_S * rate_hz),
        half=max(3, round(_HALF_S * rate_hz)),
        mean=max(1, round(_MEAN_S * rate_hz)),
        confirm=max(3, round(_CONFIRM_S * rate_hz)),
        learn=round(LEARN_S * rate_hz),
    )


def _state(plan: Plan, leads: int) -> State:
    """Nothing seen yet."""
    even, odd = _wavelet(plan)
    state = State(
        even=even, odd=odd,
        coarse=_bell(_COARSE_S, plan.rate_hz), fine=_bell(_FINE_S, plan.rate_hz),
        raw=np.zeros((leads, 2 * plan.length)), power=np.zeros((leads, 2 * plan.length)),
        energy=np.zeros((leads, plan.length)), fused=np.zeros(plan.length),
        leads=records(Lead, leads), now=records(Now, 1),
        waves=records(Wave, KEPT_WAVES), found=records(Found, KEPT_FOUND),
    )  # fmt: skip
    for lead in _by_name(state.leads):
        lead.smallest_step = lead.stillest = math.inf
        lead.lowest = lead.lowest_old = lead.lowest_older = math.inf
    for now in _by_name(state.now):
        now.usable, now.best, now.between = True, -1.0, 0.1
        for rhythm in (now.rhythm, now.before):
            rhythm.last_at, rhythm.usual_rr = -plan.length, plan.rate_hz
            rhythm.last_height = rhythm.last_likeness = 1.0
            rhythm.last_tall = rhythm.last_steep = 1.0
    return state


def _by_name(kept: Sequence[Kind], count: int | None = None) -> Iterable[Kind]:
    """Records whose fields have names in Python too; the compiler would take them too slowly."""
    named: Iterable[Kind] = np.asarray(kept).view(np.recarray)[:count]
    return named


def _wavelet(plan: Plan) -> tuple[Float, Float]:
    """A Gaussian's second derivative and its Hilbert transform, from their common spectrum.

    Both lose what little mean the cut at their ends leaves, so that an offset has no energy.
    """
    times_s = np.arange(-plan.half, plan.half + 1) / plan.rate_hz
    hz = np.arange(0.0, min(90.0, plan.rate_hz / 2), 0.25)
    spectrum = hz**2 * np.exp(-0.5 * (2 * np.pi * hz * _WAVELET_S) ** 2)
    turns = 2 * np.pi * times_s[:, None] * hz
    even, odd = np.cos(turns) @ spectrum, np.sin(turns) @ spectrum
    taper = np.cos(0.5 * np.pi * np.arange(-plan.half, plan.half + 1) / (plan.half + 1)) ** 2
    even -= taper * even.sum() / taper.sum()
    scale = np.abs(even).sum()
    return np.asarray(even / scale), np.asarray(odd / scale)


def _bell(width_s: float, rate_hz: float) -> Float:
    """Gaussian smoothing of unit sum, three deviations to either side."""
    # Narrower than 0.6 samples would be no smoothing at all.
    width = max(width_s * rate_hz, 0.6)
    places = np.arange(-math.ceil(3 * width), math.ceil(3 * width) + 1)
    bell = np.exp(-0.5 * (places / width) ** 2)
    return np.asarray(bell / bell.sum())
