"""Report: one page that shows what happened, for a person who looks before reading."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from pipeline import INTENDED_USE, __version__
from pipeline.doubts import doubts, few_phases, reformatted
from pipeline.field.fixture import Fixture
from pipeline.field.manifest import MANIFEST
from pipeline.field.reader import ForceField
from pipeline.geometry import Float
from pipeline.imaging.cine import Cine
from pipeline.imaging.nifti import read_image
from pipeline.imaging.settings import LOW_CONFIDENCE
from pipeline.imaging.view import AS_THE_FILE_SAYS
from pipeline.job import Job
from pipeline.products import (
    read_blank_ends,
    read_cine,
    read_frames,
    read_surfaces,
    read_table,
)
from pipeline.report import certificate, heart, pictures, slices
from pipeline.report.moments import Moments
from pipeline.report.page import Opening, Section, Table, flat_table, picture, render
from pipeline.report.provenance import provenance
from pipeline.report.registered import registration, registration_notes
from pipeline.report.style import as_png, as_svg, own_style
from pipeline.summary import by_reason, cut_off_by, cut_sideways_by, of_timing, series_left_out

VENTRICLES = {"left ventricle", "right ventricle"}
"""Their volumes are told at the top of the page, whatever the fixtures."""
FIELD_TOLD = (
    "The epicardium is the outside of the left ventricle's muscle: its free wall, the right side "
    "of the septum, and a lid at the valves. The potential over an MR slice, lines of equal "
    "distance every 5 mm (the surface is bold) and arrows of force. Of the certificate: p99 is "
    "what 99 places in 100 keep under; sign errors are places taken for the wrong side; the "
    "gradient error is the length by which the gradient differs from the true one, which is 1 "
    "long; drift is how far the field lies, halfway between two phases, off a smooth curve through "
    "the surfaces of all; motion unsure is by about how much the heart itself may lie off that "
    "curve, as far as the phases tell when one is left out: the fewer there are, the more (both "
    "are unknown where there are two phases only: how the surface goes from one to the other is "
    "then a guess); the band is what "
    "lies within it of the surface. A device has to render the fixture's stiffness, which is "
    "below its limit; what is measured exceeds it at the share of places that is told: beside a "
    "medial axis, where two parts of the surface are equally near and the force changes with "
    "place as fast as the grid's spacing allows, and, of few phases, near walls that move fast."
)


@own_style()
def run(job: Job) -> dict[str, Any]:
    """Write ``index.html``, which needs no other file."""
    cine = read_cine(job.products / "ingest")
    phases, rr_s = cine.phases, cine.rr_s
    measures = read_table(job.products / "surface" / "measures.json")
    shown = _moments(job, cine, (measures["end_diastole"], measures["end_systole"]))
    # Pictures show two phases; a long cine of many slices need not stay in memory.
    del cine
    surfaces = read_surfaces(job.products / "surface", phases)
    confidence = _confidence(job)
    sections = [
        heart.segmentation(shown, confidence, LOW_CONFIDENCE),
        heart.movement(surfaces, rr_s, phases, measures),
        *registration(job, surfaces),
        _field(job, shown),
        *_evaluation(job),
        provenance(job.inputs, job.settings, job.products / "bake" / "field.zarr" / MANIFEST),
    ]
    page = render(
        job.study.patient_id,
        _summary(job, measures, confidence),
        sections,
        job.figures("bake")["example"],
        _opening(job, len(slices.doubts(confidence, LOW_CONFIDENCE))),
    )
    (job.folder / "index.html").write_text(page, encoding="utf-8", errors="backslashreplace")
    return {"pictures": sum(len(section.pictures) for section in sections)}


def _moments(job: Job, cine: Cine, numbers: tuple[int, int]) -> Moments:
    """End-diastole and end-systole, by the numbers of their phases."""
    folder = job.products / "segment"
    first, _ = read_blank_ends(job.products / "ingest")
    shown = slice(first, first + cine.intensity.shape[1])
    labels = [read_image(folder / f"labels_{number:03d}.nii.gz")[0][shown] for number in numbers]
    return Moments(
        names=("End-diastole", "End-systole"),
        numbers=numbers,
        phases=cine.phases[list(numbers)],
        intensity=cine.intensity[list(numbers)],
        labels=np.stack(labels).astype(np.uint8),
        mr_from_index=cine.mr_from_index,
        interpolated=cine.interpolated,
    )


def _confidence(job: Job) -> Float:
    """Confidence of each image, ``(phase, slice)``."""
    said = read_table(job.products / "segment" / "confidence.json")
    return np.array(said["confidence"], dtype=float)


def _summary(job: Job, measures: dict[str, Any], confidence: Float) -> list[tuple[str, str]]:
    ingest = job.figures("ingest")
    accuracy = job.figures("bake")["accuracy"]
    rows = [
        (
            "cine",
            f"{ingest['slices']} slices, {ingest['phases']} phases, {_views(ingest)}, "
            f"{ingest['timing_source']}",
        ),
        ("heart rate", f"{60 / ingest['rr_s']:.0f} beats/min"),
        *_of_whole_ventricles(heart.function_rows(measures), _cut(job)),
        (
            "lowest confidence of the labels",
            f"{slices.lowest_place(confidence)}; doubtful below {LOW_CONFIDENCE:.2f}",
        ),
    ]
    if job.product("register"):
        register = job.figures("register")
        rows.append(("ultrasound frames used", _frames_used(job)))
        rows.append(("breath", _breath(register)))
        said = [register["verdict"], register["reason"], register["calibration"]]
        rows.append(("registration", "; ".join(filter(None, said))))
        expected_mm, chance = register["expected_tre_mm"], register["chance_under_2_mm"]
        worth = f"{expected_mm:.2f} mm, good is up to {register['good_tre_mm']:g} mm, of use up to "
        worth += f"{register['worst_tre_mm']:g} mm; under 2 mm with a chance of {chance:.0%}"
        rows.append(("expected registration error over the heart", worth))
    off_mm = accuracy["surface_error_p99_mm"]
    rows.append(("field off the surfaces that were found, 99 places in 100", f"{off_mm:.2f} mm"))
    return rows


def _views(ingest: dict[str, Any]) -> str:
    """How many long-axis views take part: they show the base and the tip."""
    count = len(ingest["long_axis"])
    return {0: "no long-axis view", 1: "1 long-axis view"}.get(count, f"{count} long-axis views")


def _frames_used(job: Job) -> str:
    """Of all sweeps, and of each."""
    rows = read_frames(job.products / "register" / "frames.csv")
    names = dict.fromkeys(row.sweep for row in rows)
    of_each = [[row.valid for row in rows if row.sweep == name] for name in names]
    each = [f"{n} {sum(used)} of {len(used)}" for n, used in zip(names, of_each, strict=True)]
    total = f"{sum(row.valid for row in rows)} of {len(rows)}"
    return f"{total} ({', '.join(each)})" if len(each) > 1 else total


def _breath(register: dict[str, Any]) -> str:
    """Where in the breath the field belongs, and what of breathing was found."""
    there = "the field is for the heart where the MR's breath-holds had it"
    if register["breath"] == "hold":
        return f"taken as held (register.breath: hold); {there}"
    return f"free, the heart moved by {register['breath_range_mm']:.1f} mm; {there}"


def _cut(job: Job) -> set[str]:
    """Names of what ends where the images do."""
    figures = job.figures("segment")
    return {*figures["cut_off"], *figures["cut_sideways"]}


def _cut_off(job: Job, of_field: bool) -> dict[str, dict[Any, int]]:
    """What the stack's ends cut off of ventricles and of the field's structures, or of others."""
    left_out = job.figures("bake")["left_out"]
    given = job.settings.fixtures.items()
    used = {one.structure.replace("_", " ") for name, one in given if name not in left_out}
    matters = used | VENTRICLES
    return {
        body: ends
        for body, ends in job.figures("segment")["cut_off"].items()
        if (body in matters or "heart" in used) == of_field
    }


def _of_whole_ventricles(
    rows: list[tuple[str, str]], cut_off: Collection[str]
) -> list[tuple[str, str]]:
    """The figures of function, with a word beside those of a ventricle that the images cut off."""
    named = {"LV": "left ventricle", "RV": "right ventricle"}
    short = tuple(letters for letters, name in named.items() if name in cut_off)
    return [
        (name, f"{text} (of what the stack shows)" if name.startswith(short) else text)
        for name, text in rows
    ]


def _opening(job: Job, doubtful: int = 0) -> Opening:
    """Whether the field may be used, as far as the program can tell, and why not; ``doubtful`` is
    the number of slices of low confidence."""
    warnings = _warnings(job)
    where = "Not registered: no tracked ultrasound, so a field in the frame of the MR alone."
    if job.product("register"):
        where = f"Registration {job.figures('register')['verdict']}."
    elif job.study.us is not None:
        where = "NOT REGISTERED: not for use with a tracker; a field in the frame of the MR alone."
    many = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
    found = f"{many}, to be read first." if warnings else "No warnings from the program's checks."
    told = [f"{INTENDED_USE[0].upper()}{INTENDED_USE[1:]}."]
    if job.product("evaluate"):
        told.append(
            "This study comes with a truth to be compared with (below, Against truth), as "
            "synthetic ones do, which are no patient's."
        )
    else:
        told.append("No known truth in this study: accuracy against truth was not measured.")
    if doubtful:
        many = "1 slice is" if doubtful == 1 else f"{doubtful} slices are"
        told.append(f"{many} of low confidence in some phase: see Segmentation.")
    told += [f"The heart was {text}." for text in reformatted(job.figures("segment"))]
    for text in cut_off_by(_cut_off(job, of_field=False), job.figures("ingest")):
        told.append(f"Cut off by the stack's end, and of no fixture: {text}.")
    told.append(f"Made by beatfield {__version__}: of what, the end of the page tells.")
    unused = series_left_out(job.figures("ingest"))
    told += [f"Of the cine's folder nothing is made of {text}." for text in unused]
    return Opening(f"{where} {found}", warnings, told)


def _warnings(job: Job) -> list[str]:
    notes = []
    orientation = job.figures("segment")["orientation"]
    if orientation != str(AS_THE_FILE_SAYS):
        notes.append(
            f"The heart lies {orientation}. All products are in the file's frame: check the order "
            "of the slices and the orientation in the file before a field is used with a tracker."
        )
    ingest = job.figures("ingest")
    of_ultrasound = job.figures("register")["remarks"] if job.product("register") else []
    notes += [f"Of the timing: {text}." for text in of_timing(ingest)]
    notes += [f"Of the input: {text}." for text in (*ingest["remarks"], *of_ultrasound)]
    missing = ingest["interpolated_slices"]
    if missing:
        named = ", ".join(str(number) for number in missing)
        notes.append(f"Not recorded or spoilt, so drawn between their neighbours: slices {named}.")
    told = doubts(job.figures("segment"), job.figures("surface"))
    told += few_phases(job.figures("bake")["accuracy"])
    notes += [f"Doubtful {text}." for text in told]
    for text in cut_off_by(_cut_off(job, of_field=True), ingest):
        notes.append(f"Cut off by the stack's end: {text}.")
    for text in cut_sideways_by(job.figures("segment")["cut_sideways"], ingest):
        notes.append(f"Cut off: {text}.")
    for why, names in by_reason(job.figures("surface")["left_out"]).items():
        notes.append(f"No surface of {', '.join(names).replace('_', ' ')}: {why}.")
    for name, why in job.figures("bake")["left_out"].items():
        notes.append(f"Left out: the default fixture {name}, which {why}.")
    notes += registration_notes(job)
    return notes


def _field(job: Job, shown: Moments) -> Section:
    field = ForceField.open(job.products / "bake" / "field.zarr")
    name = next(iter(field.fixtures))
    figure = pictures.potential_on_slice(shown, field, name)
    profiles = pictures.fixture_profiles(field.fixtures)
    rows = [
        (
            fixture_name,
            fixture.structure,
            " ".join(filter(None, (fixture.kind.replace("_", " "), fixture.side))),
            _what_it_does(fixture),
            f"{fixture.resolved_gamma_mm:.2f}",
            f"{fixture.resolved_delta_mm:.2f}",
            str(fixture.m),
            f"{fixture.f_max_n:g}",
            f"{fixture.stiffness_n_per_m:.0f}",
            fixture.device.name,
        )
        for fixture_name, fixture in field.fixtures.items()
    ]
    head = ["fixture", "surface", "kind", "a tool", "gamma, mm", "delta, mm", "m"]
    head += ["most force, N", "stiffness, N/m", "device"]
    return Section(
        "Force field",
        FIELD_TOLD,
        [
            picture("Potential, distance and force", as_png(figure), "png"),
            picture("Force of each fixture", as_svg(profiles), "svg"),
        ],
        [
            Table(head, rows),
            *certificate.tables(job.figures("bake")["accuracy"], job.figures("bake")["allowed"]),
        ],
    )


def _what_it_does(fixture: Fixture) -> str:
    """What becomes of a tool near the surface, in words."""
    if fixture.kind == "guidance":
        return "is drawn to the surface from either side"
    return f"{fixture.side} the surface is pushed out of there"


def _evaluation(job: Job) -> list[Section]:
    folder = job.product("evaluate")
    if folder is None:
        return []
    metrics = read_table(folder / "metrics.json")
    rows = [_against_truth(name, one) for name, one in metrics["structures"].items()]
    head = ["surface", "mean distance, mm", "worst phase, mm", "95 % Hausdorff, worst phase, mm"]
    head += ["mean Dice", "worst Dice", "motion, normal, mm", "tangential, mm"]
    others = {key: value for key, value in metrics.items() if key != "structures"}
    return [
        Section(
            "Against truth",
            "What the study's truth/ tells, which only the evaluate stage reads. "
            "Dice is that of the labels: in the row of the epicardium of heart muscle, in that of "
            "the LV endocardium of the cavity. Errors of the frames' phases are shares of a beat.",
            tables=[Table(head, rows), flat_table("registration and volumes", others)],
        )
    ]


def _against_truth(name: str, one: dict[str, Any]) -> list[str]:
    overlap = one.get("dice") or []
    motion = one.get("motion_error_mm")
    return [
        name,
        f"{np.mean(one['mean_surface_distance_mm']):.2f}",
        f"{max(one['mean_surface_distance_mm']):.2f}",
        f"{max(one['hausdorff_95_mm']):.2f}",
        f"{np.mean(overlap):.3f}" if overlap else "-",
        f"{min(overlap):.3f}" if overlap else "-",
        f"{motion['normal_mean']:.2f}" if motion else "-",
        f"{motion['tangential_mean']:.2f}" if motion else "-",
    ]
