"""What speaks against labels, surfaces and their times, in sentences for terminal and report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from pipeline.imaging.settings import LOW_CONFIDENCE, THIN_MM

TOLD_BELOW = 0.7
"""Confidence at which labels are told beside the report, too: of 40 sound studies 2 had less."""

TOLD_FLICKER = 0.1
"""Share of a beat over which a ventricle's labels are averaged from which on that is told: of the
slices of twenty phantoms one was over so much, near a tip; of a patient's those at the valves."""

MUSCLE_RANGE = 1.4
"""Largest over smallest volume of heart muscle, which hardly changes through a beat, beyond which
its labels are told to be doubtful: the most was 1.09 in 23 studies of the phantom, and 1.29 in 24
stacks of a second renderer, noisy or of thick slices; images with inverted contrast gave 1.89."""

MOST_EJECTED = 0.85
"""Share of its largest volume that a left ventricle ejects at most: of 20 phantoms the
most was 0.75, and labels of a ventricle that metal had half erased 0.94."""

LEAST_AGREEING = 0.5
"""Share of the lines where a long-axis view crosses slices along which both are to agree: views of
ten phantoms did along 0.87 and more, at other phases along 0.4 to 0.7, mirrored or exchanged along
0.15 at most."""

UNEQUAL_STROKES = 0.15
"""By what share of the larger one stroke volumes may differ: those found in nine studies of the
phantom, whose valves are tight, did by 0.08 at most."""

EARLIEST_SYSTOLE, LATEST_SYSTOLE = 0.17, 0.15
"""Share of the beat by which the left ventricle's end of systole may lie before and after its usual
place (`pipeline.registration.clock.systole_s`). A pulse reaches the finger a fifth of a beat after
the R peak or later; phases in reverse lie as far off in slow hearts, in fast ones by less."""

LEAST_EJECTION = 0.15
"""Of a heart that ejects less than this share, noise decides when it is smallest."""

UNSURE_MM = 1.0
"""How unsure the walls' places between phases may be, untold: surfaces found in a study of 25
phases were to 0.3 mm, in one of 10 to 0.8 mm, in one of 6 to 3 mm."""

FEW, HINT_MM = 7, 0.25
"""Of fewer phases than so many the epicardia of nine phantoms were 1.2 mm and more off between
them, in 99 places of 100, where 0.5 mm and more were told, as phases fell. What moves so little
that half of that is told is taken to rest."""

HARDLY = 0.25
"""Of the other slices' swing: a slice that swings less hardly moves."""


def doubts(segment: dict[str, Any], surface: dict[str, Any]) -> list[str]:
    """Sentences on what speaks against labels or times, of the figures of two stages."""
    of_slices = *low_confidence(segment), *blurred(segment), *flickering(segment)
    of_slices = *of_slices, *astray(segment), *out_of_step(segment)
    of_views = disagreeing_views(segment)
    of_surfaces = *unequal_strokes(segment, surface), *odd_systole(surface)
    of_labels = *of_slices, *of_views, *muscle_changes(segment), *odd_ejection(segment)
    of_meshes = *lost_pieces(surface), *off_labels(surface), *misfits(surface)
    return [*of_labels, *of_surfaces, *of_meshes, *crossings(surface)]


def reformatted(segment: dict[str, Any]) -> list[str]:
    """A sentence where slices were drawn across the left ventricle through the cine's own.

    >>> reformatted({"reformatted": {"tilt_deg": 55.2, "step_mm": 2.0}})
    ['seen in slices drawn across the left ventricle: those of the cine lie 55 degrees off']
    """
    if not segment.get("reformatted"):
        return []
    return [
        "seen in slices drawn across the left ventricle: those of the cine lie "
        f"{segment['reformatted']['tilt_deg']:.0f} degrees off"
    ]


def blurred(segment: dict[str, Any]) -> list[str]:
    """A sentence where slices were drawn through thick ones.

    >>> blurred({"reformatted": {"tilt_deg": 55.2, "step_mm": 10.0}})
    ['slices lie along the left ventricle, 10 mm apart: those drawn across it through them are \
blurred by as much, and breath-holds are not told apart; look at the contours']
    """
    step_mm = segment.get("reformatted", {}).get("step_mm", 0.0)
    if step_mm <= THIN_MM:
        return []
    return [
        f"slices lie along the left ventricle, {step_mm:.0f} mm apart: those drawn across it "
        "through them are blurred by as much, and breath-holds are not told apart; look at the "
        "contours"
    ]


def flickering(segment: dict[str, Any]) -> list[str]:
    """A sentence where a ventricle's labels came and went from phase to phase.

    >>> flickering({"flicker_beats": {"8": 0.045, "9": 0.1}})
    ['labels of slice 9 came and went from phase to phase, and are a mean over 10 % of the beat; \
look at its contours']
    >>> drawn = {"reformatted": {"tilt_deg": 55.0, "step_mm": 2.0}, "flicker_beats": {"8": 0.1}}
    >>> flickering(drawn)[0][:52]
    'labels of slice 8 drawn across the left ventricle ca'
    """
    widths = {int(k): width for k, width in segment.get("flicker_beats", {}).items()}
    told = sorted(k for k, width in widths.items() if width >= TOLD_FLICKER)
    if not told:
        return []
    drawn = " drawn across the left ventricle" if segment.get("reformatted") else ""
    return [
        f"labels of slice {ranges(told)}{drawn} came and went from phase to phase, and are a mean "
        f"over {100 * max(widths.values()):.0f} % of the beat; look at "
        f"{'their' if told[1:] else 'its'} contours"
    ]


def astray(segment: dict[str, Any]) -> list[str]:
    """A sentence where slices lay farther aside than another usual breath-hold takes them.

    >>> astray({"astray_mm": {"5": 19.4}})
    ['slice 5 showed the heart 19 mm beside where the others show it, and was moved back: it was \
held in another breath, or labelled wrongly']
    """
    return [
        f"slice {number} showed the heart {aside_mm:.0f} mm beside where the others show it, and "
        "was moved back: it was held in another breath, or labelled wrongly"
        for number, aside_mm in segment.get("astray_mm", {}).items()
    ]


def out_of_step(segment: dict[str, Any]) -> list[str]:
    """Sentences on slices that do not beat with the others.

    >>> late, still = {"swing": 1.0, "in_step": -0.9, "late": 0.4}, {"swing": 0.01, "in_step": 0.0}
    >>> for sentence in out_of_step({"out_of_step": {"6": late, 5: still, "4": late}}):
    ...     print(sentence)
    slice 4, 6 out of step with the others' heartbeat: as if 0.40 of a beat late; look at its \
times, order and contours
    slice 5 out of step with the others' heartbeat: hardly moving, as a scar may, or one image for \
several phases; look at its times, order and contours
    """
    told = segment.get("out_of_step", {})
    late = {int(number): found["late"] for number, found in told.items() if "late" in found}
    ways: dict[str, list[int]] = {_how_late(sorted(late.values())): sorted(late)} if late else {}
    for number, found in told.items():
        if "late" not in found:
            ways.setdefault(_way(found), []).append(int(number))
    return [
        f"slice {ranges(sorted(numbers))} out of step with the others' heartbeat: {how}; look at "
        "its times, order and contours"
        for how, numbers in ways.items()
    ]


def _how_late(late: list[float]) -> str:
    """The least and the most of rising shares of a beat, in words.

    >>> _how_late([0.38, 0.4]), _how_late([-0.2]), _how_late([-0.11, 0.14])
    ('as if 0.38 to 0.40 of a beat late', 'as if 0.20 of a beat early', \
'as if 0.11 of a beat early to 0.14 late')
    """
    first, last = (f"{abs(one):.2f}" for one in (late[0], late[-1]))
    if late[0] < 0 < late[-1]:
        return f"as if {first} of a beat early to {last} late"
    both = first if first == last else " to ".join(sorted([first, last]))
    return f"as if {both} of a beat {'late' if late[0] > 0 else 'early'}"


def _way(found: dict[str, float]) -> str:
    if found["swing"] < HARDLY:
        return "hardly moving, as a scar may, or one image for several phases"
    return (
        "moving against them, as a bulging scar may" if found["in_step"] < 0 else "moving otherwise"
    )


def disagreeing_views(segment: dict[str, Any]) -> list[str]:
    """A sentence for each long-axis view that does not show what the slices show.

    >>> disagreeing_views({"views_agree": {"two_chamber": [14, 15], "four_chamber": [1, 13]}})
    ['long-axis view four_chamber agrees with the slices along 1 of 13 lines where it crosses \
them: is it mirrored, of other times, another place or another patient? Where it does not agree \
it moves no slice']
    """
    return [
        f"long-axis view {name} agrees with the slices along {agree} of {lines} lines where it "
        "crosses them: is it mirrored, of other times, another place or another patient? Where "
        "it does not agree it moves no slice"
        for name, (agree, lines) in segment.get("views_agree", {}).items()
        if agree < LEAST_AGREEING * lines
    ]


def lost_pieces(surface: dict[str, Any]) -> list[str]:
    """A sentence for each surface that leaves out a good part of its labels, which lies apart.

    >>> lost_pieces({"left_out_ml": {"rv_endocardium": {"4": 9.1}}})
    ['surfaces: rv_endocardium leaves out up to 9.1 ml of its labels, which lie apart, in phase 4']
    """
    return [
        f"surfaces: {name} leaves out up to {max(by_phase.values()):.1f} ml of its labels, which "
        f"lie apart, in phase {', '.join(map(str, by_phase))}"
        for name, by_phase in surface.get("left_out_ml", {}).items()
    ]


def off_labels(surface: dict[str, Any]) -> list[str]:
    """A sentence for each surface that lies beside its labels, as where these jump.

    >>> off_labels({"off_mm": {"lv_endocardium": {"7": 1.8, "8": 1.6}}})
    ['surfaces: lv_endocardium lies 1.8 mm or more beside its labels at a twentieth of its \
vertices, in phase 7, 8; look at the contours there']
    """
    return [
        f"surfaces: {name} lies {max(by_phase.values()):.1f} mm or more beside its labels at a "
        f"twentieth of its vertices, in phase {', '.join(map(str, by_phase))}; look at the "
        "contours there"
        for name, by_phase in surface.get("off_mm", {}).items()
    ]


def misfits(surface: dict[str, Any]) -> list[str]:
    """A sentence for each surface that encloses more or less than its labels do.

    >>> misfits({"misfit_ml": {"rv_endocardium": {"13": [160.1, 169.0], "14": [168.8, 178.2]}}})
    ['surfaces: rv_endocardium encloses 168.8 ml in phase 14, its labels 178.2 ml; look at the \
contours in phase 13, 14']
    """
    told = []
    for name, by_phase in surface.get("misfit_ml", {}).items():
        worst = max(by_phase, key=lambda k: abs(by_phase[k][0] / by_phase[k][1] - 1))
        encloses_ml, labelled_ml = by_phase[worst]
        told.append(
            f"surfaces: {name} encloses {encloses_ml:.1f} ml in phase {worst}, its labels "
            f"{labelled_ml:.1f} ml; look at the contours in phase {', '.join(map(str, by_phase))}"
        )
    return told


def crossings(surface: dict[str, Any]) -> list[str]:
    """A sentence where surfaces pass through themselves.

    >>> crossings({"crossing_triangles": {"epicardium": 0, "heart": 4}})
    ['surfaces: heart passes through itself (4 triangles over all phases); look before you use it']
    """
    counts = surface.get("crossing_triangles", {})
    return [
        f"surfaces: {name} passes through itself ({count} triangles over all phases); look before "
        "you use it"
        for name, count in counts.items()
        if count
    ]


def low_confidence(segment: dict[str, Any]) -> list[str]:
    """A sentence where the least certain labels are far below the others."""
    lowest = segment.get("lowest_confidence", 1.0)
    if lowest >= TOLD_BELOW:
        return []
    at = segment["least_certain"]
    return [
        f"labels of slice {at['slice']} in phase {at['phase']}, whose confidence of "
        f"{lowest:.2f} is the lowest; the report shows all below {LOW_CONFIDENCE:g}"
    ]


def muscle_changes(segment: dict[str, Any]) -> list[str]:
    """A sentence where the muscle's volume changes through the beat as muscle does not."""
    volumes_ml = segment.get("volumes_ml", {}).get("lv_myocardium", [])
    if not volumes_ml or max(volumes_ml) <= MUSCLE_RANGE * min(volumes_ml):
        return []
    least, most = (volumes_ml.index(pick(volumes_ml)) for pick in (min, max))
    return [
        f"labels: of heart muscle phase {least} has {volumes_ml[least]:.0f} ml and phase {most} "
        f"{volumes_ml[most]:.0f} ml, though muscle keeps its volume; look at the contours"
    ]


def odd_ejection(segment: dict[str, Any]) -> list[str]:
    """A sentence where the left ventricle empties as none does.

    >>> odd_ejection({"volumes_ml": {"lv_cavity": [150.0, 9.0]}})
    ['labels: the left ventricle ejects 94 % of its 150 ml; look at the contours of phase 1']
    """
    volumes_ml = segment.get("volumes_ml", {}).get("lv_cavity", [])
    if not volumes_ml or min(volumes_ml) >= (1 - MOST_EJECTED) * max(volumes_ml):
        return []
    share = 1 - min(volumes_ml) / max(volumes_ml)
    return [
        f"labels: the left ventricle ejects {100 * share:.0f} % of its {max(volumes_ml):.0f} ml; "
        f"look at the contours of phase {volumes_ml.index(min(volumes_ml))}"
    ]


def unequal_strokes(segment: dict[str, Any], surface: dict[str, Any]) -> list[str]:
    """A sentence where one ventricle ejects clearly more than the other, which it fills."""
    volumes_ml = surface.get("volumes_ml", {})
    both = [volumes_ml.get(name) for name in ("lv_endocardium", "rv_endocardium")]
    cut = {*segment.get("cut_off", {}), *segment.get("cut_sideways", {})}
    if not all(both) or cut & {"left ventricle", "right ventricle"}:
        return []
    left_ml, right_ml = (max(one) - min(one) for one in both)
    if abs(left_ml - right_ml) <= UNEQUAL_STROKES * max(left_ml, right_ml):
        return []
    return [
        f"volumes: the left ventricle ejects {left_ml:.0f} ml and the right one {right_ml:.0f} ml; "
        "where no valve leaks and no shunt is known, look at the contours at base and tip"
    ]


def odd_systole(surface: dict[str, Any]) -> list[str]:
    """A sentence where the left ventricle is smallest when it cannot be after an R peak.

    Phases that do not begin at the R peak move with the heart as well as others do, and ultrasound
    fits them at an offset of its clock: nothing else tells, and each force comes at another time.
    """
    found = surface.get("end_systole")
    if not found or surface.get("lv_ejection_fraction", 0.0) < LEAST_EJECTION:
        return []
    late = (found["phase"] - found["usual"] + 0.5) % 1 - 0.5
    if -EARLIEST_SYSTOLE <= late <= LATEST_SYSTOLE:
        return []
    return [
        f"times: the left ventricle is smallest at phase {found['phase']:.2f}, where "
        f"{found['usual']:.2f} is usual at this heart rate; were images gated by the pulse at a "
        "finger, by another wave than R, or stored in reverse? Then forces come at the wrong time: "
        "give times after the R peak"
    ]


def few_phases(accuracy: Mapping[str, Any]) -> list[str]:
    """A sentence where phases are too few to tell where the walls are between them.

    >>> for unsure_mm, phases in (1.54, 8), (0.8, 6), (0.1, 6), (None, 1), (None, 2), (None, 3):
    ...     parts = {"structures": {"heart": {"sign_errors_by_phase": phases * [0]}}}
    ...     few_phases({"motion_unsure_p99_mm": unsure_mm, **parts})
    ['between phases: walls may lie 1.5 mm from where the field has them, by what the few phases \
tell of each other']
    ['between phases: nobody knows where the walls are to a millimetre, for there are but 6 phases']
    []
    []
    ['between phases: nobody knows where the walls are, for there are but two phases']
    ['between phases: nobody knows where the walls are, for vertices do not correspond']
    """
    if "motion_unsure_p99_mm" not in accuracy:
        return []
    unsure_mm = accuracy["motion_unsure_p99_mm"]
    phases = len(next(iter(accuracy["structures"].values()))["sign_errors_by_phase"])
    unknown = "between phases: nobody knows where the walls are"
    if phases == 1:
        # It is held still.
        return []
    if unsure_mm is None:
        why = "there are but two phases" if phases == 2 else "vertices do not correspond"
        return [f"{unknown}, for {why}"]
    if unsure_mm > UNSURE_MM:
        return [
            f"between phases: walls may lie {unsure_mm:.1f} mm from where the field has them, by "
            "what the few phases tell of each other"
        ]
    few = phases < FEW and unsure_mm > HINT_MM
    return [f"{unknown} to a millimetre, for there are but {phases} phases"] if few else []


def odd_orientation(segment: dict[str, Any]) -> list[str]:
    """A sentence where the heart lies otherwise than the file says.

    >>> odd_orientation({"orientation": "other than the file says: mirrored in the plane"})
    ["lies other than the file says: mirrored in the plane; check the file's orientation and order \
of slices"]
    >>> odd_orientation({"orientation": "as the file says"})
    []
    """
    orientation = segment.get("orientation", "")
    if not orientation.startswith("other"):
        return []
    return [f"lies {orientation}; check the file's orientation and order of slices"]


def of_registration(register: dict[str, Any]) -> list[str]:
    """A sentence where a registration is not good.

    >>> of_registration({"verdict": "good", "reason": ""})
    []
    >>> of_registration({"verdict": "doubtful", "reason": "expected error 1.9 mm over the heart"})
    ['registration is doubtful: expected error 1.9 mm over the heart']
    """
    if register["verdict"] == "good":
        return []
    return [f"registration is {register['verdict']}: {register['reason']}"]


def ranges(numbers: Sequence[int]) -> str:
    """Rising numbers in words.

    >>> ranges((0, 1, 2, 5, 7, 8))
    '0 to 2, 5, 7 to 8'
    """
    starts = [numbers[0], *(b for a, b in pairwise(numbers) if b > a + 1)]
    ends = [*(a for a, b in pairwise(numbers) if b > a + 1), numbers[-1]]
    parts = [f"{a} to {b}" if b > a else f"{a}" for a, b in zip(starts, ends, strict=True)]
    return ", ".join(parts)
