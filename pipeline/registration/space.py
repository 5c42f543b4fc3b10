"""Bring tracked ultrasound to the MR model in space: one rigid pose for the whole study.

All frames of all sweeps, each at its own phase of the heartbeat, are compared at once with the
moving surfaces. The search goes from thick blur to thin. What its result is worth is decided by
its covariance, and by searching the same way with frames whose pictures are the same but in the
wrong place (mirrored, upside down, or in reverse order): their best score is what chance reaches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float, Mask, MovingSurface, require_rigid
from pipeline.imaging.cine import Cine
from pipeline.progress import Progress
from pipeline.registration.breathing import AXIS, follow_breath, is_mostly_inspired, rest_error_mm
from pipeline.registration.calibration import Calibration, calibrate, calibration_of, certainty
from pipeline.registration.clock_offset import (
    ClockOffset,
    ClocksApart,
    Timing,
    clocks_apart,
    settle_clock,
)
from pipeline.registration.correction import Correction
from pipeline.registration.dissent import Dissent, contradicting, dissent, longest_astray, outvoted
from pipeline.registration.frames import TrackedSweep
from pipeline.registration.in_view import LEAST_IN_VIEW, require_frames, require_heart_in_view
from pipeline.registration.misplaced import by_chance
from pipeline.registration.open_ends import open_ends, open_lids
from pipeline.registration.parts import Apart, parts_apart
from pipeline.registration.pose_search import Pivot, climb
from pipeline.registration.reading import as_compared
from pipeline.registration.search import Level, Search, prepare_search
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import Size, fitting_size, planes_of
from pipeline.registration.tissue_map import BLOOD, cavities_of
from pipeline.registration.uncertainty import (
    chance_below,
    curvature_at,
    expected_tre_mm,
    floor_of,
    in_radians,
    sandwich,
)
from pipeline.registration.verdict import APART, Evidence, Grade, Verdict, judge

# A frame that the model explains less than this share of the usual shows something else.
_LEAST_OF_USUAL = 0.25
_STEPS = 5
# By what share of its usual error a model is further off for each surface of blood that it lacks,
# and for each that goes on where the images end.
_LACKING, _CUT = 0.2, 0.1
# Of each surface, to look at the expected error.
_POINTS = 200


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the tracker stands in the MR frame, how sure that is, and what each frame says."""

    mr_from_tracker: Float
    """4x4, rigid: tracker millimetres to LPS millimetres."""

    residual: Float
    """``(frames,)`` through all sweeps: share of the variance of a frame's grey values that the
    model leaves unexplained; 1 where nothing could be compared."""

    valid: Mask
    """``(frames,)``: the frame meets the heart and agrees with the model, better than at poses
    nearby."""

    score: float
    """Mean over the valid frames of -log(1 - explained share); 0 for no agreement."""

    start_score: float
    """The same, of the same frames, at the start; 0 where there was none."""

    confidence: float
    """Score over the best that frames in the wrong place reach; 1 is chance."""

    rival: float
    """Share of the score that the best pose somewhere else reaches; 0 where none was met."""

    covariance: Float
    """``(6, 6)`` of the pose's error: shift along x, y, z (mm), then rotation vector (rad), in the
    MR frame, about ``centre_mm``."""

    centre_mm: Float
    """``(3,)`` LPS: the middle of the heart."""

    expected_mm: float
    """Root mean square of the expected error over the heart."""

    chance_under_2_mm: float
    """Probability that the mean error over the heart is under 2 mm, by the covariance."""

    breath_mm: Float
    """``(frames,)`` how far the heart has moved with breathing, along
    `pipeline.registration.breathing.AXIS`; 0 where breath was held, or the frame is not used."""

    corrections: tuple[Correction, ...]
    """Of each sweep's image calibration; none where calibrations were not looked at."""

    verdict: Grade
    """``good``, ``doubtful`` or ``failed``."""

    reason: str
    """Why it is not better; empty for a good one."""

    size: Size
    """Of the heart that the frames fit best; where that puts it in doubt, the covariance holds what
    it is off."""

    apart: float
    """By what share of the score parts of the recording agree better with poses of their own."""

    clock: ClockOffset | None
    """How far the clock of the frames is ahead of the ECG's; None where it was not asked for."""

    def expected_tre_mm(self, points_mm: Float) -> Float:
        """``(n,)`` root mean square target registration error to be expected at ``(n, 3)`` points
        (LPS mm)."""
        return expected_tre_mm(self.covariance, self.centre_mm, points_mm)


@dataclass(frozen=True, slots=True)
class _Found:
    """A pose, and what it was found with."""

    pose: Float
    level: Level
    """All frames."""

    shows: Mask
    bears_out: Mask
    breath_mm: Float
    """Of the frames of ``level``, as whether they show the heart, and bear the pose out."""

    judged: Level
    """The frames that found the pose."""

    aside: tuple[int, ...]
    """Sweeps, counted from 1, that show bodies elsewhere while another shows the heart."""

    confidence: float
    rival: float
    clock: ClockOffset | None
    calibration: Calibration | None
    size: Size
    apart: Apart
    dissent: Dissent
    clocks: ClocksApart | None
    misplaced: str
    """See `Evidence`."""


def register(
    sweeps: Sequence[TrackedSweep],
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    start: Float | None,
    settings: RegisterSettings | None = None,
    progress: Progress | None = None,
    timing: Timing | None = None,
    cine: Cine | None = None,
    doubts: Sequence[str] = (),
) -> Registration:
    """Find ``mr_from_tracker`` from tracked frames, their phases and the moving surfaces.

    Parameters
    ----------
    sweeps, phases
        The sweeps and, for each, the ``(n,)`` phases of its frames.
    surfaces
        The cavities through the beat, in LPS millimetres; other structures are not looked at.
    start
        4x4 ``mr_from_tracker``, within the settings' capture range of the truth; None: the pose is
        sought anywhere, the heart somewhere in the middle of what the sweeps cover.
    timing
        What the phases were made from, for ``clock_offset`` of the settings: how far the frames'
        clock is off the ECG's is estimated, and taken off where that is asked for. None: not.
    cine
        What the surfaces were found in, of the same phases: it shows the muscle inside the
        ventricles that their smooth surfaces count to the blood. None: that is not looked at.
    doubts
        What is known to speak against any result: none is good then.

    Raises
    ------
    InputError
        When the start is not rigid, frames are too few, show no body or never cross the heart near
        the start, phases or transforms do not fit the frames, no cavity is given, or cavities (and
        the cine, where grey values are compared) have not the same phases.
    StageError
        When the verdict is worse than the settings accept, or the network cannot be loaded.
    """
    settings = settings or RegisterSettings()
    found = find(sweeps, phases, surfaces, start, settings, progress, timing, cine, doubts)
    if found.verdict == "failed":
        raise StageError(found.reason)
    if found.verdict == "doubtful" and settings.accept == "good":
        raise StageError(f"registration is doubtful, and register.accept is good: {found.reason}")
    return found


def find(
    sweeps: Sequence[TrackedSweep],
    phases: Sequence[Float],
    surfaces: Mapping[str, MovingSurface],
    start: Float | None,
    settings: RegisterSettings,
    progress: Progress | None = None,
    timing: Timing | None = None,
    cine: Cine | None = None,
    doubts: Sequence[str] = (),
) -> Registration:
    """As `register`, but a failed registration is returned with its verdict and its reason.

    Raises
    ------
    InputError
        As in `register`.
    StageError
        When the network cannot be loaded.
    """
    tell = progress or (lambda done, total: None)
    if start is not None:
        require_rigid(start, "initial mr_from_tracker")
    require_frames(sweeps, phases, settings)
    lacking = [name for name in BLOOD if name not in surfaces]
    ends = [] if cine is None else open_ends(surfaces, cine)
    open_above = [lid.atrium for lid in open_lids(surfaces, ends)]
    cut = sorted({name for end in ends for name in end.chambers}, key=BLOOD.index)
    further = _LACKING * len(lacking) + _CUT * len(cut)
    wider_mm = settings.model_error_mm * (1 + further)
    settings = settings.model_copy(update={"model_error_mm": wider_mm})
    search = prepare_search(phases, surfaces, start, settings, cine)
    compared = as_compared(sweeps, settings)
    tell(1, _STEPS)
    require_heart_in_view(search.coarse_level(compared), search)
    best = search.best(compared)
    settled = settle_clock(search, best, compared, timing, settings.clock_offset)
    search, best = settled.search, settled.best
    tell(2, _STEPS)
    chance, misplaced = by_chance(search, best.pose, compared)
    tell(3, _STEPS)
    level, pose, calibration, breath_mm = _placed(search, best.pose, compared, sweeps)
    tell(4, _STEPS)
    tiny = np.finfo(float).tiny
    confidence, rival = best.score / max(chance, tiny), best.rival / max(best.score, tiny)
    pivot, sweep, least = search.pivot, level.samples.sweep, settings.min_frames
    shows = np.asarray(level.at(pose).in_view > LEAST_IN_VIEW)
    bears_out = _bears_out(level, pose, pivot)
    judged = _judged(level, bears_out, settings)
    size = fitting_size(judged, pose, pivot, planes_of(cine))
    shown = level.only(np.flatnonzero(shows))
    apart = parts_apart(shown, pose, pivot, shown.samples.sweep)
    against = contradicting(sweep, shows, bears_out, least)
    contradicted = dissent(search, compared, level, pose, sweep, bears_out, against)
    aside = outvoted(sweep, shows, least)
    looked_at = timing if settings.clock_offset != "ignore" else None
    clocks = clocks_apart(_of_sweeps_of_the_heart(level, aside), pose, pivot, looked_at)
    found = _Found(
        pose, level, shows, bears_out, breath_mm, judged, aside, confidence, rival, settled.clock,
        calibration, size, apart, contradicted, clocks, misplaced,
    )  # fmt: skip
    heart_mm = np.concatenate([_some(s.vertices_mm[0]) for s in cavities_of(surfaces)])
    result = _doubted(_summarise(found, search, phases, heart_mm), doubts)
    tell(_STEPS, _STEPS)
    return _naming_what_is_unknown(result, lacking, open_above, cut)


def _doubted(result: Registration, doubts: Sequence[str]) -> Registration:
    """The result, none that is good where anything is known to speak against it."""
    if not doubts:
        return result
    verdict: Grade = "failed" if result.verdict == "failed" else "doubtful"
    reasons = filter(None, [*doubts, result.reason])
    return replace(result, verdict=verdict, reason="; ".join(reasons))


def _naming_what_is_unknown(
    result: Registration, lacking: Sequence[str], open_above: Sequence[str], cut: Sequence[str]
) -> Registration:
    """The result with what its model does not know, where it is not good."""
    if lacking and result.reason:
        said = f"the model lacks {', '.join(lacking)}"
        if not set(lacking) <= set(open_above):
            said += ", whose blood it takes for tissue"
        result = replace(result, reason=f"{result.reason}; {said}")
    if cut and result.reason:
        said = f"the images end inside {', '.join(cut)}: what lies beyond is not known"
        result = replace(result, reason=f"{result.reason}; {said}")
    return result


def _placed(
    search: Search, pose: Float, compared: Sequence[TrackedSweep], sweeps: Sequence[TrackedSweep]
) -> tuple[Level, Float, Calibration | None, Float]:
    """All frames and the pose that they find; the calibration and the breath that place them."""
    level = search.fine_level(compared)
    pose = _refined(level, pose, search)
    level, pose, calibration = _calibrated(level, pose, search, sweeps)
    level, pose, breath_mm = _breathing(level, pose, search)
    return level, pose, calibration, breath_mm


def _refined(everything: Level, pose: Float, search: Search) -> Float:
    """The pose that those frames find that bear the present one out, if they suffice."""
    good = np.flatnonzero(_bears_out(everything, pose, search.pivot))
    if len(good) < search.settings.min_frames:
        return pose
    level = everything.only(good).thinned(search.settings.max_frames)
    return climb(level, pose, search.pivot)


def _bears_out(level: Level, pose: Float, pivot: Pivot) -> Mask:
    """Which frames meet the heart, agree as others do, and better here than at poses nearby."""
    here = level.at(pose)
    # Far enough to leave the optimum, near enough to see the same parts.
    steps = 12.0 * np.concatenate([np.eye(6), -np.eye(6)])
    nearby = [level.at(pivot.move(pose, step)).explained for step in steps]
    usual = here.explained > _LEAST_OF_USUAL * np.median(here.explained)
    peak = here.explained > np.quantile(nearby, 0.75, axis=0)
    return np.asarray((here.in_view > LEAST_IN_VIEW) & usual & peak)


def _judged(everything: Level, bears_out: Mask, settings: RegisterSettings) -> Level:
    """The frames that found the pose: those that bear it out, if they suffice."""
    enough = bears_out.sum() >= settings.min_frames
    level = everything.only(np.flatnonzero(bears_out)) if enough else everything
    return level.thinned(settings.max_frames)


def _some(points_mm: Float) -> Float:
    """At most some hundred of the points, evenly through their order."""
    return points_mm[:: max(1, len(points_mm) // _POINTS)]


def _calibrated(
    level: Level, pose: Float, search: Search, sweeps: Sequence[TrackedSweep]
) -> tuple[Level, Float, Calibration | None]:
    """Frames and pose with each sweep's calibration put right, if that may be wrong."""
    if search.settings.calibration == "fixed":
        return level, pose, None

    def bears_out(placed: Level, pose: Float) -> Mask:
        return _bears_out(placed, pose, search.pivot)

    given = calibration_of(sweeps, level, search.pivot, search.settings)
    found, pose = calibrate(given, level, pose, search.settings, bears_out)
    return found.placed(level), pose, found


def _breathing(level: Level, pose: Float, search: Search) -> tuple[Level, Float, Float]:
    """Frames, pose and each frame's displacement along the breathing axis, if breath was free."""
    if search.settings.breath == "hold":
        return level, pose, np.zeros(level.samples.frames)
    placed, pose, breath_mm = follow_breath(level, pose, search.pivot, level.samples.sweep)
    return placed, _refined(placed, pose, search), breath_mm


def _covariance(found: _Found, search: Search) -> tuple[Float, tuple[Correction, ...]]:
    """Covariance of the pose, mm and rad, from the frames that found it, with the model's floor
    and what corrections of calibrations leave open; and these corrections."""
    judged = found.judged
    curvature = curvature_at(lambda step: judged.losses(search.pivot.move(found.pose, step)))
    spread = in_radians(sandwich(curvature, judged.samples.sweep), search.pivot)
    floor = floor_of(search.settings.model_error_mm, curvature.bending, search.pivot)
    floor += in_radians(found.size.error_mm**2 * np.eye(6), search.pivot)
    if found.apart.gain > APART:
        floor += in_radians(found.apart.spread_mm2, search.pivot)
    floor += in_radians(found.dissent.spread_mm2, search.pivot)
    floor[:3, :3] += rest_error_mm(found.breath_mm) ** 2 * np.outer(AXIS, AXIS)
    if found.calibration is None:
        return np.asarray(spread + floor), ()
    opened, corrections = certainty(found.calibration, judged, found.pose, search.settings)
    return np.asarray(spread + floor + opened), corrections


def _summarise(
    found: _Found, search: Search, phases: Sequence[Float], heart_mm: Float
) -> Registration:
    """Judge every frame of the study, and the pose itself."""
    level, pose, centre_mm = found.level, found.pose, search.pivot.centre_mm
    covariance, corrections = _covariance(found, search)
    each_mm = expected_tre_mm(covariance, centre_mm, heart_mm)
    expected_mm = float(np.sqrt((each_mm**2).mean()))
    verdict = _verdict(found, search, expected_mm)
    valued = level.only(np.flatnonzero(found.bears_out)) if found.bears_out.any() else level
    frames, number = sum(map(len, phases)), level.samples.number
    residual, valid, breath_mm = np.ones(frames), np.zeros(frames, dtype=bool), np.zeros(frames)
    residual[number] = 1 - level.at(pose).explained
    valid[number] = found.bears_out
    breath_mm[number] = found.breath_mm
    return Registration(
        mr_from_tracker=pose,
        residual=residual,
        valid=valid,
        score=valued.score(pose),
        start_score=0.0 if search.start is None else valued.score(search.start),
        confidence=found.confidence,
        rival=found.rival,
        covariance=covariance,
        centre_mm=centre_mm,
        expected_mm=expected_mm,
        chance_under_2_mm=chance_below(covariance, centre_mm, heart_mm, 2.0),
        breath_mm=breath_mm,
        corrections=corrections,
        verdict=verdict.grade,
        reason=verdict.reason,
        size=found.size,
        apart=found.apart.gain,
        clock=found.clock,
    )


def _of_sweeps_of_the_heart(level: Level, aside: Sequence[int]) -> Level:
    """Without the frames of sweeps that lie aside: beside the heart none has a time of its own."""
    return level.only(np.flatnonzero(~np.isin(level.samples.sweep + 1, aside)))


def _verdict(found: _Found, search: Search, expected_mm: float) -> Verdict:
    shift_mm, turn_deg = (
        (0.0, 0.0) if search.start is None else search.pivot.distance(found.pose, search.start)
    )
    # A frame that shows no body, or not the heart, speaks neither for a result nor against it; a
    # sweep that shows bodies and not the heart is no sweep of this heart.
    sweep, bears_out = found.level.samples.sweep[found.shows], found.bears_out[found.shows]
    evidence = Evidence(
        confidence=found.confidence,
        rival=found.rival,
        expected_mm=expected_mm,
        valid=int(found.bears_out.sum()),
        frames=int(found.shows.sum()),
        shift_mm=shift_mm,
        turn_deg=turn_deg,
        outvoted=outvoted(sweep, bears_out, search.settings.min_frames),
        aside=found.aside,
        size=found.size,
        astray=longest_astray(sweep, bears_out),
        elsewhere_mm=found.dissent.away_mm,
        apart=found.apart.gain,
        inspired=is_mostly_inspired(found.breath_mm),
        clocks=found.clocks,
        misplaced=found.misplaced,
    )
    return judge(evidence, search.settings)
