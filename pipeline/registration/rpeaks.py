"""R peaks of an electrocardiogram, sample by sample: what a force server and the pipeline both use.

``RPeakDetector`` takes samples as they come and says of every beat when its R peak was, at the
latest ``LATENCY_S`` after it; ``find_beats`` runs the same over a recording. The design is told in
``qrs``.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import numpy.typing as npt

from pipeline.errors import InputError
from pipeline.geometry import Float
from pipeline.registration import detector_state as at
from pipeline.registration.detector_state import Plan, State
from pipeline.registration.qrs import feed
from pipeline.registration.waves import ALIKE

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 100.0, 2000.0
LATENCY_S = 0.15
"""A beat is known this long after the middle of its QRS complex, and is final then. Two beats are
known later: those while levels are learnt, and overdue ones whose energy was low (``late``)."""
LEARN_S = 2.0
"""Levels are learnt for so long, and on to 6 s while no beat stands out."""
KEPT_LIKENESSES, LEAST_LIKENESSES = 16, 6
"""A beat's likeness is compared with those of so many beats before it, and with no fewer."""
LEAST_MARGIN, SCATTERS = 0.06, 3.0
"""Less alike than the median by both this and so many standard deviations is another shape."""
# Of a normal distribution, by its median absolute deviation.
_DEVIATION = 1.4826
# The wavelet's standard deviation: its band is 6 to 33 Hz at half height, 19 Hz in the middle.
_WAVELET_S = 0.016
_HALF_S, _MEAN_S, _CONFIRM_S = 0.050, 0.025, 0.055
# Near the width of a QRS complex, which times it best in noise; and one that keeps its summit.
_COARSE_S, _FINE_S = 0.008, 0.004
_MEMORY_S = 8.0
_CHUNK_S = 5.0


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
        if not LOWEST_RATE_HZ <= sampling_rate_hz <= HIGHEST_RATE_HZ:
            raise InputError(
                f"ECG: {sampling_rate_hz:g} samples a second; R peaks are found at "
                f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g}; record or resample it so"
            )
        if leads < 1:
            raise InputError(f"ECG: {leads} leads; at least one is needed")
        self._plan = _plan(sampling_rate_hz)
        self._state = _state(self._plan, leads)
        self._leads = leads
        self._likenesses: deque[float] = deque(maxlen=KEPT_LIKENESSES)

    def push(self, samples_mv: npt.ArrayLike) -> list[Beat]:
        """Take the next sample ``(leads,)``, or several ``(n, leads)``; beats that became known.

        Raises
        ------
        InputError
            When the number of leads is another.
        """
        block = np.atleast_2d(np.ascontiguousarray(samples_mv, dtype=np.float64))
        if block.ndim != 2 or block.shape[1] != self._leads:
            raise InputError(
                f"ECG: samples of shape {np.shape(samples_mv)}; needs (n, {self._leads})"
            )
        rows = [row for part in self._parts(block) for row in self._feed(part)]
        return [self._beat(row) for row in rows]

    @property
    def usable(self) -> bool:
        """Whether some lead is connected, by the last sample; not 0.1 s after all fell silent."""
        return bool(self._state.counters[at.USABLE])

    def _feed(self, block: Float) -> Float:
        feed(block, self._plan, self._state)
        return np.asarray(self._state.found[: self._state.counters[at.FOUND]]).copy()

    def _parts(self, block: Float) -> Iterator[Float]:
        """Pieces short enough for the list of found beats."""
        step = int(_CHUNK_S * self._plan.rate_hz)
        return (block[start : start + step] for start in range(0, len(block), step))

    def _beat(self, row: Float) -> Beat:
        likeness = float(row[at.LIKENESS])
        strange = _is_strange(likeness, self._likenesses)
        self._likenesses.append(likeness)
        return Beat(
            float(row[at.TIME]),
            float(row[at.KNOWN] / self._plan.rate_hz),
            int(row[at.LEAD]),
            float(row[at.HEIGHT]),
            likeness,
            bool(row[at.LATE]),
            strange,
            bool(row[at.INSTEAD]),
        )


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
    if len(others) < LEAST_LIKENESSES:
        return likeness < ALIKE
    usual = statistics.median(others)
    scatter = _DEVIATION * statistics.median(abs(other - usual) for other in others)
    return likeness < max(ALIKE, usual - max(LEAST_MARGIN, SCATTERS * scatter))


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
    counters = np.zeros(at.COUNTERS, dtype=np.int64)
    counters[at.LAST_BEAT] = -plan.length
    counters[at.USABLE] = 1
    numbers = np.zeros(at.NUMBERS)
    numbers[[at.BEST, at.LAST_HEIGHT, at.BETWEEN, at.USUAL_RR]] = -1, 1, 0.1, plan.rate_hz
    numbers[[at.LAST_LIKENESS, at.LAST_STEEP, at.LAST_TALL]] = 1
    rows, shapes = np.zeros((leads, at.LEAD_FIELDS)), np.zeros((leads, at.SHAPE_POINTS))
    intervals = np.zeros(at.KEPT_INTERVALS)
    rows[:, [at.SMALLEST_STEP, at.LOWEST, at.LOWEST_OLD, at.LOWEST_OLDER, at.STILLEST]] = np.inf
    return State(
        even, odd, _bell(_COARSE_S, plan.rate_hz), _bell(_FINE_S, plan.rate_hz),
        raw=np.zeros((leads, 2 * plan.length)), power=np.zeros((leads, 2 * plan.length)),
        energy=np.zeros((leads, plan.length)), fused=np.zeros(plan.length),
        waves=np.zeros((at.KEPT_WAVES, 4)), intervals=intervals,
        leads=rows, shapes=shapes, seen=np.zeros((leads, at.SHAPE_POINTS)),
        found=np.zeros((64, at.FIELDS)), counters=counters, numbers=numbers,
        before=at.Learnt(
            rows.copy(), shapes.copy(), intervals.copy(), counters.copy(), numbers.copy()
        ),
    )  # fmt: skip


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
