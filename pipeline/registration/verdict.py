"""What a registration is worth: good, doubtful or failed, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.registration.clock_offset import ClocksApart
from pipeline.registration.dissent import IN_A_ROW
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import AS_IT_IS, Size

Grade = Literal["good", "doubtful", "failed"]

APART = 0.06
"""By what share of the score parts of a recording may agree better with poses of their own: those
of 60 in 61 studies that were right did by 0.042 at most, and by more than 0.06 in 63 of 66 whose
patient had drifted by 6 mm or more, or moved by 4 mm or turned by 6 degrees between the sweeps."""

# Of the frames that show the heart, the share below which those that bear a pose out leave it in
# doubt, and are a minority. Nine in ten did in each of 123 studies of two renderers.
_FEW, _MINORITY = 0.75, 0.5

_BETTER_START = (
    "; give a better start (in LPS, where 3D Slicer shows RAS; of landmarks, the same point each "
    "time) or widen capture_mm and capture_deg"
)

_WHERE_TO_LOOK = (
    "is the ECG of this recording, and are the calibration (were pictures cropped?), the "
    "transforms and the patient right?"
)

# Share of the best score that another pose may reach before the answer is in doubt, or open.
_DOUBTFUL_RIVAL, _EQUAL_RIVAL = 0.75, 0.9


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for and against a registration."""

    confidence: float
    """Score over the best that frames in the wrong place reach; 1 is chance."""

    rival: float
    """Share of the score that the best pose somewhere else reaches."""

    expected_mm: float
    """Root mean square of the expected error over the heart."""

    valid: int
    """Frames that bear the pose out."""

    frames: int
    """All that show the heart."""

    shift_mm: float
    """From the start; 0 without one."""

    turn_deg: float
    """From the start; 0 without one."""

    outvoted: tuple[int, ...] = ()
    """Sweeps, counted from 1, few frames of which bear out what another sweep does."""

    aside: tuple[int, ...] = ()
    """Sweeps, counted from 1, few frames of which show the heart where it lies by the pose, of all
    that show bodies, while most of another sweep's do."""

    size: Size = AS_IT_IS
    """Of the heart that the frames fit best."""

    astray: tuple[int, int] = (0, 0)
    """The most frames of a sweep in a row that show the heart and do not bear the pose out, and the
    sweep's number, counted from 1."""

    elsewhere_mm: float = 0.0
    """How far the pose on which frames that do not bear this one out agree moves the heart."""

    apart: float = 0.0
    """By what share of the score parts of the recording agree better with poses of their own."""

    inspired: bool = False
    """Whether most frames lie far from the end of expiration, where the heart should rest."""

    clocks: ClocksApart | None = None
    """Two sweeps that were stamped by different clocks."""

    misplaced: str = ""
    """How frames in the wrong place were displaced that reach the best score."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A grade, and the reasons against the next better one."""

    grade: Grade
    reason: str
    """In words; empty for a good one."""


def judge(evidence: Evidence, settings: RegisterSettings) -> Verdict:
    """The verdict on a registration.

    It has failed where its frames agree hardly better than misplaced ones do, too few of them bear
    it out, it ended outside the range that was searched, or its expected error is beyond use. It
    is good where its expected error is small, most frames bear it out and none of that is near.
    """
    failures = _failures(evidence, settings)
    of_size, of_parts = _doubts_of_size(evidence.size), _doubts_of_parts(evidence)
    if failures and evidence.confidence < 1:
        # Where frames fit better in the wrong place, a size that fits better there says nothing.
        return Verdict("failed", "; ".join(failures))
    if failures:
        # A wrong size, and parts that differ or contradict, widen the expected error: where that
        # fails, they are the cause.
        return Verdict("failed", "; ".join([*of_size, *of_parts, *failures]))
    doubts = [*_doubts(evidence, settings), *of_parts, *of_size]
    return Verdict("doubtful" if doubts else "good", "; ".join(doubts))


def _failures(evidence: Evidence, settings: RegisterSettings) -> list[str]:
    reasons = []
    if evidence.confidence < settings.min_confidence:
        reasons.append(
            "registration found no pose to trust: frames agree with the model "
            f"{evidence.confidence:.2f} times as well as frames in the wrong place do, needs "
            f"{settings.min_confidence:g}; check the start, the phases (is the ECG of this "
            "recording?), the transforms and the patient" + _how_they_agree(evidence)
        )
    if evidence.rival > _EQUAL_RIVAL:
        reasons.append(
            f"two poses far apart agree alike with the frames ({evidence.rival:.0%}); give a first "
            "guess, or record sweeps from another window"
        )
    # The candidates reach as far as the capture range; an optimum may lie a little beyond.
    far = evidence.shift_mm > 1.5 * settings.capture_mm
    far = far or evidence.turn_deg > 1.5 * settings.capture_deg
    if far:
        reasons.append(
            f"registration ended {evidence.shift_mm:.1f} mm and {evidence.turn_deg:.1f} degrees "
            f"from the start, far outside the {settings.capture_mm:g} mm and "
            f"{settings.capture_deg:g} degrees that were searched"
            + ("" if _how_they_agree(evidence) else _BETTER_START)
        )
    if evidence.valid < settings.min_frames:
        reasons.append(
            f"only {evidence.valid} of {evidence.frames} frames bear the registration out, needs "
            f"{settings.min_frames}; record sweeps that cross more of the heart"
        )
    elif evidence.valid < _MINORITY * evidence.frames:
        reasons.append(
            f"only {evidence.valid} of {evidence.frames} frames that show the heart bear the "
            f"registration out, needs half; {_WHERE_TO_LOOK}"
        )
    if not evidence.expected_mm <= settings.worst_tre_mm:
        reasons.append(
            f"the frames leave the pose open: expected error {evidence.expected_mm:.1f} mm over "
            f"the heart, at most {settings.worst_tre_mm:g} mm is of use; record sweeps from "
            "another window or over more of the heart"
        )
    return reasons


def _how_they_agree(evidence: Evidence) -> str:
    """What to look at where frames in the wrong place agree better than as they came."""
    if evidence.confidence >= 1 or not evidence.misplaced:
        return ""
    return (
        f"; {evidence.misplaced} they agree {1 / max(evidence.confidence, 0.01):.1f} times better"
    )


def _doubts(evidence: Evidence, settings: RegisterSettings) -> list[str]:
    reasons = []
    if evidence.expected_mm > settings.good_tre_mm:
        reasons.append(
            f"expected error {evidence.expected_mm:.1f} mm over the heart, good is up to "
            f"{settings.good_tre_mm:g} mm"
        )
    if evidence.confidence < 1.25 * settings.min_confidence:
        reasons.append(
            f"frames agree with the model only {evidence.confidence:.2f} times as well as frames "
            "in the wrong place do"
        )
    if evidence.rival > _DOUBTFUL_RIVAL:
        reasons.append(f"a pose far from this one agrees with the frames to {evidence.rival:.0%}")
    if evidence.clocks is not None:
        ahead, behind, by_s = evidence.clocks.ahead, evidence.clocks.behind, evidence.clocks.by_s
        reasons.append(
            f"time stamps of sweep {ahead} are {by_s:.2f} s ahead of those of sweep {behind} by "
            "the motion in their frames: put both on the clock of the ECG (or is the ECG not of "
            "this recording, or the heart irregular?)"
        )
    if evidence.inspired:
        reasons.append(
            "most frames lie nearer to the end of inspiration than of expiration, where the "
            "heart is taken to rest: record whole quiet breaths, or hold the breath"
        )
    if evidence.valid < _FEW * evidence.frames:
        reasons.append(
            f"only {evidence.valid} of {evidence.frames} frames that show the heart bear the pose "
            f"out; {_WHERE_TO_LOOK}"
        )
    return reasons


def _doubts_of_parts(evidence: Evidence) -> list[str]:
    """What sweeps, and parts of them, have against each other."""
    reasons = []
    in_a_row, number = evidence.astray
    away = ""
    if evidence.elsewhere_mm > 0:
        away = f", and agree on a place {evidence.elsewhere_mm:.0f} mm away"
    if evidence.outvoted:
        named = ", ".join(map(str, evidence.outvoted))
        reasons.append(
            f"few frames of sweep {named} bear out what the others do{away}: where it shows the "
            "heart, one of them lies beside its place, by more than is expected here: look at "
            "calibration (were pictures cropped?), pixel size and whether the patient or the "
            "tracker was moved between them"
        )
    elif in_a_row >= IN_A_ROW:
        reasons.append(
            f"{in_a_row} frames in a row of sweep {number} show the heart and do not bear out what "
            f"the others do{away}: was the patient, the tracker or the reference moved meanwhile, "
            "or the depth changed? Cut them off, or record the sweep again"
        )
    if evidence.aside:
        named = ", ".join(map(str, evidence.aside))
        reasons.append(
            f"few frames of sweep {named} show the heart where another sweep places it: look at "
            "the unit of its poses (mm), its calibration and whether the patient or the tracker "
            "was moved between them; leave it out if it is of something else"
        )
    if evidence.apart > APART:
        reasons.append(
            f"parts of the recording agree {evidence.apart:.0%} better with poses of their own: "
            "was the patient, the tracker or the reference moved meanwhile, was the breath not "
            "held (register.breath), is the calibration or the pixel size off, or do images lag "
            "behind the tracker's poses?"
        )
    return reasons


def _doubts_of_size(size: Size) -> list[str]:
    if not size.in_doubt:
        return []
    way = "larger" if size.larger > 0 else "smaller"
    return [
        f"frames agree {size.gain:.0%} better with a heart {abs(size.larger):.0%} {way} than the "
        "MR's: look at the MR's pixel spacing, the ultrasound's pixel size (ImageToProbe), the "
        "tracker's unit and whether both are of one patient"
    ]
