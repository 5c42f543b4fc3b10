"""By how much the clock of the ultrasound is off that of the ECG, by the motion in its frames.

Frames are compared with the moving model where they lie, at the phases that their times, shifted by
a trial offset, have by the R peaks. One offset within a beat fits best, for the heart moves through
every place at its own times. The probe's own motion is no matter: frames are compared with the
model, not with one another. A wrong offset also draws the pose a little, so the pose is sought anew
at each offset: the summit is that of the profile. How sure it is comes from the frames' own slopes
along that profile and from its bending (the sandwich of ``uncertainty``, in one dimension).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.geometry import Float, Integer
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.search import Best, Level, Search
from pipeline.registration.time import doubts_of_rate, median_rr_s, phases_at
from pipeline.registration.uncertainty import REACH, long_run

Choice = Literal["apply", "measure", "ignore"]

LEAST_FRAMES = 20
"""Fewer frames say too little about how much they differ."""
LARGEST_SD_S = 0.020
"""An offset less sure than this is none: phases by it could be worse than by no correction."""
MODEL_SD_S = 0.005
"""Standard deviation of what all frames share: phases of a cine are 20 to 40 ms apart, and the
surfaces' motion is smoothed over more than that. No spread between frames shows it."""
SIGNIFICANT = 3.0
"""An offset of fewer standard deviations than this may be none."""
LEAST_APART_S = 0.050
"""Clocks of sweeps that are nearer than this are one."""
# So many frames of a sweep tell its own clock to some milliseconds.
_OWN_FRAMES = 40
# Trial offsets: fine enough not to step over a summit, which is some 100 ms wide.
_SCAN_S = 0.020
# Half the profile's width by which it is followed to its summit: more than half the time between
# two phases of the model, between which motion is taken as even.
_PROFILE_S = 0.025
_ROUNDS = 4
# Share of the best score that an offset elsewhere may reach; beyond, the frames do not tell which.
_ELSEWHERE_S, _EQUAL_RIVAL = 0.100, 0.95


@dataclass(frozen=True, slots=True)
class Timing:
    """When frames were taken, on a clock that may be off that of the R peaks."""

    times_s: Sequence[Float]
    """For each sweep ``(n,)`` time stamps of its frames."""

    r_times_s: Float
    """``(beats,)`` rising R times."""

    cycle_rr_s: float | None
    """Length of the nominal beat; None where it is unknown."""

    def phases(self, offset_s: float = 0.0) -> list[Float]:
        """For each sweep the phases ``(n,)`` of its frames, whose clock is ahead by an offset.

        A frame that an offset puts outside the R peaks stays at their end, as in `at`.

        Raises
        ------
        InputError
            When frames, as they are stamped, lie more than a beat outside the R peaks.
        """
        stamped = [phases_at(one, self.r_times_s, self.cycle_rr_s) for one in self.times_s]
        if offset_s == 0.0:
            return stamped
        ends = np.cumsum([len(one) for one in stamped])
        return np.split(self.at(np.arange(ends[-1]), offset_s), ends[:-1])

    def at(self, number: Integer, offset_s: float) -> Float:
        """Phases of frames, counted through all sweeps, at a trial offset.

        A frame that the offset puts outside the R peaks stays at their end.
        """
        rr_s = median_rr_s(self.r_times_s)
        first, last = self.r_times_s[0] - 0.999 * rr_s, self.r_times_s[-1] + 0.999 * rr_s
        times_s = np.concatenate(self.times_s)[number] - offset_s
        return phases_at(np.clip(times_s, first, last), self.r_times_s, self.cycle_rr_s)

    def doubts(self) -> list[str]:
        """What speaks against the R times being those of the heart in the cine, in sentences."""
        if self.cycle_rr_s is None:
            return []
        return doubts_of_rate(self.r_times_s, self.cycle_rr_s)


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """By how much the clock of the frames is ahead of that of the R peaks."""

    offset_s: float | None
    """Time stamp less time on the ECG's clock, within half a beat; None where the frames do not
    tell: too few of them, two offsets that fit alike, an unsure one, or R times in doubt."""

    sd_s: float
    """Its standard deviation; infinite where there is no summit."""

    mr_from_tracker: Float
    """4x4, the pose that fits best at that offset; the one given where there is none."""

    applied_s: float = 0.0
    """What of it was taken off the frames' times: all or nothing."""

    @property
    def significant(self) -> bool:
        """Whether the clocks are apart beyond doubt."""
        return self.offset_s is not None and abs(self.offset_s) > SIGNIFICANT * self.sd_s


@dataclass(frozen=True, slots=True)
class Settled:
    """A search on the clock of the ECG, as far as that is asked for."""

    search: Search
    best: Best
    clock: ClockOffset | None
    """None where it was not looked at."""


def settle_clock(
    search: Search,
    best: Best,
    sweeps: Sequence[TrackedSweep],
    timing: Timing | None,
    choice: Choice,
) -> Settled:
    """Estimate the offset and, where it is beyond doubt and so chosen, take it off.

    Phases that are wrong by a quarter of a beat may have led the search astray, and then the offset
    is wrong as well. So the pose is sought again at the phases that an offset gives, and the offset
    estimated again there, until both agree; where they do not, there is none.

    Parameters
    ----------
    search, best
        The search at the phases of the times as they are, and what it found.
    timing
        None: there is nothing to settle.
    choice
        ``apply``: take it off; ``measure``: only say what it is; ``ignore``: do not look.
    """
    if timing is None or choice == "ignore":
        return Settled(search, best, None)
    unknown = ClockOffset(None, np.inf, best.pose)
    if timing.doubts():
        # By beats of another length some offset always fits best, and it means nothing.
        return Settled(search, best, unknown)
    level = search.fine_level(sweeps).thinned(search.settings.max_frames)
    clock = estimate_offset(level, best.pose, search.pivot, timing)
    if clock.offset_s is None or not clock.significant:
        return Settled(search, best, clock)
    for _ in range(_ROUNDS):
        tried_s = clock.offset_s
        there = replace(search, phases=timing.phases(tried_s))
        found = there.best(sweeps)
        clock = estimate_offset(level, found.pose, search.pivot, timing, tried_s)
        if clock.offset_s is None:
            break
        if abs(clock.offset_s - tried_s) < 2 * clock.sd_s:
            if choice == "measure" or not clock.significant:
                return Settled(search, best, clock)
            there = replace(search, phases=timing.phases(clock.offset_s))
            return Settled(there, found, replace(clock, applied_s=clock.offset_s))
    return Settled(search, best, unknown)


def estimate_offset(
    level: Level, pose: Float, pivot: Pivot, timing: Timing, tried_s: float = 0.0
) -> ClockOffset:
    """The offset at which frames fit the moving model best, and how sure it is.

    Parameters
    ----------
    level
        The frames, at any phases, and the model.
    pose
        4x4 ``mr_from_tracker``, the best at the phases that an offset of ``tried_s`` gives. One
        that is wrong by a quarter of a beat draws it by some millimetres, which is near enough.
    """
    unknown = ClockOffset(None, np.inf, pose)
    if level.samples.frames < LEAST_FRAMES:
        return unknown
    profile = _Profile(level, pivot, timing)
    near = profile.nearest(pose, tried_s)
    if near is None:
        return unknown
    offset_s, best = near
    for _ in range(_ROUNDS):
        poses = [profile.climb(best, one) for one in around(offset_s)]
        summit = profile.summit(poses, offset_s)
        if summit is None:
            return unknown
        before_s, (offset_s, sd_s) = offset_s, summit
        best = profile.climb(best, offset_s)
        if abs(offset_s - before_s) < _SCAN_S / 2:
            break
    sd_s = float(np.hypot(sd_s, MODEL_SD_S))
    return ClockOffset(offset_s, sd_s, best) if sd_s <= LARGEST_SD_S else unknown


@dataclass(frozen=True, slots=True)
class ClocksApart:
    """Two sweeps, counted from 1, that were not stamped by one clock."""

    ahead: int
    behind: int
    by_s: float


def clocks_apart(
    level: Level, pose: Float, pivot: Pivot, timing: Timing | None
) -> ClocksApart | None:
    """The sweeps whose clocks are furthest apart by the motion in each one's own frames.

    Parameters
    ----------
    level
        The frames, at any phases, and the model.
    pose
        4x4 ``mr_from_tracker`` of all frames, at which every sweep is looked at: frames at wrong
        phases fit the better the nearer they come to right ones, whatever the pose is drawn by.
    timing
        None: nothing is known.

    Returns
    -------
    None where fewer than two sweeps tell, and where no two are apart beyond doubt.
    """
    if timing is None or timing.doubts():
        return None
    sweep = level.samples.sweep
    told: dict[int, tuple[float, float]] = {}
    for number in np.unique(sweep).tolist():
        # Each sweep by itself, or of many none would have frames enough.
        own = level.only(np.flatnonzero(sweep == number)).thinned(_OWN_FRAMES)
        found = _own_offset(own, pose, pivot, timing)
        if found is not None:
            told[number + 1] = found
    if len(told) < 2:
        return None
    beat_s, (first_s, _) = median_rr_s(timing.r_times_s), next(iter(told.values()))
    off_s = {number: math.remainder(own_s - first_s, beat_s) for number, (own_s, _) in told.items()}
    ahead, behind = max(off_s, key=off_s.__getitem__), min(off_s, key=off_s.__getitem__)
    by_s = off_s[ahead] - off_s[behind]
    beyond_s = SIGNIFICANT * math.hypot(told[ahead][1], told[behind][1])
    return ClocksApart(ahead, behind, by_s) if by_s > max(LEAST_APART_S, beyond_s) else None


def _own_offset(
    level: Level, pose: Float, pivot: Pivot, timing: Timing
) -> tuple[float, float] | None:
    """Offset and its standard deviation by one sweep's frames at a given pose."""
    if level.samples.frames < LEAST_FRAMES:
        return None
    profile = _Profile(level, pivot, timing)
    offset_s, rival = profile.scan(pose)
    summit = profile.summit([pose] * 3, offset_s)
    if summit is None or rival > _EQUAL_RIVAL:
        return None
    offset_s, sd_s = summit[0], math.hypot(summit[1], MODEL_SD_S)
    return (offset_s, sd_s) if sd_s <= LARGEST_SD_S else None


def around(offset_s: float) -> tuple[float, float, float]:
    """The offsets from which a profile's slope and bending are taken."""
    return offset_s - _PROFILE_S, offset_s, offset_s + _PROFILE_S


@dataclass(frozen=True, slots=True)
class _Profile:
    """How well frames fit at any offset, at the pose that is best there."""

    level: Level
    pivot: Pivot
    timing: Timing

    def at(self, offset_s: float) -> Level:
        """The frames at the phases that they have by an offset."""
        samples = self.level.samples
        phases = self.timing.at(samples.number, offset_s)
        return replace(self.level, samples=replace(samples, phases=phases))

    def climb(self, pose: Float, offset_s: float) -> Float:
        """The best pose near one, at an offset."""
        return climb(self.at(offset_s), pose, self.pivot)

    def nearest(self, pose: Float, offset_s: float) -> tuple[float, Float] | None:
        """The best of a row of offsets, and the pose there; None where two fit alike."""
        for _ in range(_ROUNDS):
            here_s, rival = self.scan(pose)
            if abs(here_s - offset_s) <= _SCAN_S / 2:
                break
            offset_s, pose = here_s, self.climb(pose, here_s)
        return (offset_s, pose) if rival <= _EQUAL_RIVAL else None

    def scan(self, pose: Float) -> tuple[float, float]:
        """The best offset within half a beat to either side, at one pose; and the share of its
        score that an offset elsewhere reaches."""
        beat_s = median_rr_s(self.timing.r_times_s)
        count = math.ceil(beat_s / _SCAN_S)
        offsets_s = beat_s / count * (np.arange(count) - count // 2)
        scores = np.array([self.at(float(one)).score(pose) for one in offsets_s])
        top = int(scores.argmax())
        # Frames beside the heart fit at no time, and at all of them alike.
        if not scores[top] > 0:
            return 0.0, 1.0
        # A beat on all is as it was: the ends, half a beat to either side, are neighbours.
        peak = (scores >= np.roll(scores, 1)) & (scores >= np.roll(scores, -1))
        apart_s = np.abs(offsets_s - offsets_s[top])
        far = peak & (np.minimum(apart_s, beat_s - apart_s) > _ELSEWHERE_S)
        return float(offsets_s[top]), float((scores[far] / scores[top]).max(initial=0.0))

    def summit(self, poses: Sequence[Float], offset_s: float) -> tuple[float, float] | None:
        """Where the profile peaks near an offset, and the standard deviation of that place by the
        frames' slopes, by the poses `around` it; None where it does not bend down."""
        before, here, after = (
            self.at(one).losses(pose) for pose, one in zip(poses, around(offset_s), strict=True)
        )
        slopes = (after - before) / (2 * _PROFILE_S)
        bending = (before + after - 2 * here).sum() / _PROFILE_S**2
        if bending <= 0:
            return None
        step_s = float(np.clip(-slopes.sum() / bending, -2 * _PROFILE_S, 2 * _PROFILE_S))
        return offset_s + step_s, float(np.sqrt(self._spread(slopes)) / bending)

    def _spread(self, slopes: Float) -> float:
        """Variance of the sum of the frames' slopes; neighbours of one sweep err together."""
        away = slopes - slopes.mean()
        together = long_run(away[:, None], self.level.samples.sweep, REACH)[0, 0]
        return max(float(together), float(away @ away))
