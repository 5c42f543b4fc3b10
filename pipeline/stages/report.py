"""Report: one page that shows what happened, for a person who looks before reading."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.field.reader import ForceField
from pipeline.geometry import MovingSurface
from pipeline.imaging.ultrasound import read_sweep
from pipeline.job import Job
from pipeline.products import read_cine, read_frames, read_labels, read_surfaces, read_table
from pipeline.publish import sealed
from pipeline.report import pictures
from pipeline.report.animation import beating_surfaces
from pipeline.report.page import Picture, Section, Table, picture, render

ULTRASOUND_FRAMES_SHOWN = 4


def run(job: Job) -> dict[str, Any]:
    """Write ``index.html``, which needs no other file."""
    cine = read_cine(job.products / "ingest")
    surfaces = read_surfaces(job.products / "surface", cine.phases)
    volumes = figures_of(job, "surface")["volumes_ml"]
    left_ventricle = volumes["lv_endocardium"]
    moments = {
        "end-diastole": int(np.argmax(left_ventricle)),
        "end-systole": int(np.argmin(left_ventricle)),
    }
    sections = [
        _segmentation(job, moments),
        _surfaces(surfaces, cine.rr_s, cine.phases, volumes),
        *_registration(job, surfaces),
        _field(job, moments),
        *_evaluation(job),
    ]
    page = render(
        job.study.patient_id,
        _summary(job, moments, left_ventricle),
        sections,
        _example(job),
        _notes(job),
    )
    (job.folder / "index.html").write_text(page)
    return {"pictures": sum(len(section.pictures) for section in sections)}


def figures_of(job: Job, stage: str) -> dict[str, Any]:
    """What a finished stage measured."""
    content = sealed(job.products / stage)
    assert content is not None, f"{stage} is finished before the report begins"
    figures: dict[str, Any] = content["figures"]
    return figures


def _summary(
    job: Job, moments: dict[str, int], left_ventricle: list[float]
) -> list[tuple[str, str]]:
    ingest, surface = figures_of(job, "ingest"), figures_of(job, "surface")
    accuracy = figures_of(job, "bake")["accuracy"]
    rows = [
        (
            "cine",
            f"{ingest['slices']} slices, {ingest['phases']} phases, {ingest['timing_source']}",
        ),
        ("heart rate", f"{60 / ingest['rr_s']:.0f} beats/min"),
        ("LV end-diastolic volume", f"{left_ventricle[moments['end-diastole']]:.0f} ml"),
        ("LV end-systolic volume", f"{left_ventricle[moments['end-systole']]:.0f} ml"),
        ("LV ejection fraction", f"{100 * surface['lv_ejection_fraction']:.0f} %"),
    ]
    if job.product("register"):
        register = figures_of(job, "register")
        rows.append(("ultrasound frames used", f"{register['valid']} of {register['frames']}"))
    largest = accuracy["distance_error_max_mm"]
    rows.append(("largest distance error of the field", f"{largest:.3f} mm"))
    return rows


def _notes(job: Job) -> list[str]:
    notes = []
    if not job.product("register"):
        notes.append("No tracked ultrasound: the field is in the frame of the MR.")
    if not job.product("evaluate"):
        notes.append("No known truth in this study: accuracy against truth was not measured.")
    return notes


def _segmentation(job: Job, moments: dict[str, int]) -> Section:
    cine = read_cine(job.products / "ingest")
    labels, _ = read_labels(job.products / "segment", "labels")
    figure = pictures.contours_on_slices(cine, labels, moments)
    lowest = figures_of(job, "segment")["lowest_confidence"]
    return Section(
        "Segmentation",
        f"Chambers and heart muscle on the cine's own slices. Lowest confidence: {lowest:.2f}.",
        [picture("Contours from apex to base", pictures.as_png(figure), "png")],
    )


def _surfaces(
    surfaces: dict[str, MovingSurface], rr_s: float, phases: Any, volumes: dict[str, list[float]]
) -> Section:
    shown: list[Picture] = []
    animation = beating_surfaces(surfaces, rr_s)
    if animation is not None:
        shown.append(picture("One heartbeat, seen from the front left", animation, "webp"))
    curves = pictures.as_svg(pictures.volume_curves(phases, volumes))
    shown.append(picture("Volumes through the cycle", curves, "svg"))
    return Section(
        "Surfaces",
        "Closed surfaces whose vertices are the same material points in every phase.",
        shown,
    )


def _registration(job: Job, surfaces: dict[str, MovingSurface]) -> list[Section]:
    folder = job.product("register")
    if folder is None or job.study.us is None:
        return []
    mr_from_tracker = np.array(read_table(folder / "mr_from_tracker.json")["mr_from_tracker"])
    rows = [row for row in read_frames(folder / "frames.csv") if row.valid]
    chosen = [rows[k] for k in np.linspace(0, len(rows) - 1, ULTRASOUND_FRAMES_SHOWN).astype(int)]
    sweeps = {path.stem: read_sweep(path) for path in job.study.us.sweeps}
    # Probes differ, and so may the sizes of their pictures.
    images = [sweeps[row.sweep].images[row.frame] for row in chosen]
    image_from_mr = np.stack(
        [
            np.linalg.inv(mr_from_tracker @ sweeps[row.sweep].tracker_from_image[row.frame])
            for row in chosen
        ]
    )
    figure = pictures.cuts_on_ultrasound(
        images, image_from_mr, np.array([row.phase for row in chosen]), surfaces
    )
    return [
        Section(
            "Registration",
            "The MR's surfaces cut by the plane of tracked ultrasound frames, each at its own "
            "phase of the heartbeat. Where the lines follow the walls, the registration holds.",
            [picture("Ultrasound with the registered surfaces", pictures.as_png(figure), "png")],
        )
    ]


def _field(job: Job, moments: dict[str, int]) -> Section:
    cine = read_cine(job.products / "ingest")
    labels, _ = read_labels(job.products / "segment", "labels")
    field = ForceField.open(job.products / "bake" / "field.zarr")
    name = next(iter(field.fixtures))
    figure = pictures.potential_on_slice(cine, labels, field, name, moments)
    profiles = pictures.fixture_profiles(job.settings.fixtures)
    rows = [
        (
            fixture_name,
            fixture.structure,
            " ".join(filter(None, (fixture.kind.replace("_", " "), fixture.side))),
            f"{fixture.resolved_gamma_mm:.2f}",
            f"{fixture.resolved_delta_mm:.2f}",
            str(fixture.m),
            f"{fixture.f_max_n:g}",
            f"{fixture.stiffness_n_per_m:.0f}",
            fixture.device,
        )
        for fixture_name, fixture in job.settings.fixtures.items()
    ]
    head = ["fixture", "surface", "kind", "gamma mm", "delta mm", "m"]
    head += ["most force N", "stiffness N/m", "device"]
    return Section(
        "Force field",
        "The potential over an MR slice, lines of equal distance every 5 mm (the surface is bold) "
        "and arrows of force.",
        [
            picture("Potential, distance and force", pictures.as_png(figure), "png"),
            picture("Force of each fixture", pictures.as_svg(profiles), "svg"),
        ],
        [Table(head, rows), _flat("accuracy certificate", figures_of(job, "bake")["accuracy"])],
    )


def _flat(title: str, figures: dict[str, Any]) -> Table:
    """Single figures as rows; what is told per phase or structure stays in the JSON files."""
    rows = []
    for name, value in figures.items():
        words = name.replace("_", " ")
        parts = value.items() if isinstance(value, dict) else [("", value)]
        rows += [
            (f"{words} {part.replace('_', ' ')}", f"{one:.6g}" if isinstance(one, float) else one)
            for part, one in parts
            if not isinstance(one, dict | list)
        ]
    return Table((title, ""), rows)


def _evaluation(job: Job) -> list[Section]:
    folder = job.product("evaluate")
    if folder is None:
        return []
    metrics = read_table(folder / "metrics.json")
    rows = [
        (
            name,
            f"{np.mean(one['mean_surface_distance_mm']):.2f}",
            f"{max(one['mean_surface_distance_mm']):.2f}",
            f"{max(one['hausdorff_95_mm']):.2f}",
            f"{np.mean(one['dice']):.3f}" if one.get("dice") else "-",
        )
        for name, one in metrics["structures"].items()
    ]
    head = ("surface", "mean distance mm", "worst phase mm", "95 % Hausdorff mm", "mean Dice")
    others = {key: value for key, value in metrics.items() if key != "structures"}
    return [
        Section(
            "Against truth",
            "This study is synthetic, so its truth is known; only this stage reads it.",
            tables=[Table(head, rows), _flat("registration and volumes", others)],
        )
    ]


def _example(job: Job) -> dict[str, Any]:
    example: dict[str, Any] = figures_of(job, "bake")["example"]
    return example
