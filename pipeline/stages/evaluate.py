"""Evaluate: how far each stage is from truth. The only stage that reads a study's ``truth/``."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.evaluation.metrics import (
    closedness,
    dice,
    phase_error,
    pooled_dice,
    surface_distance,
    target_registration_error_mm,
)
from pipeline.evaluation.motion import motion_error
from pipeline.geometry import Label, MovingSurface, Surface, corners_apart_mm
from pipeline.imaging.labels import LABELS
from pipeline.imaging.nifti_doubts import SAME_PLACE_MM
from pipeline.job import Job, Skipped
from pipeline.meshes import read_mesh
from pipeline.products import (
    read_blank_ends,
    read_frames,
    read_labels,
    read_surfaces,
    read_table,
    write_table,
)
from pipeline.registration.clock import to_cycle
from pipeline.surface.measures import ejection_fraction, mean_lv_mass_g, volumes_ml

LABEL_OF_SURFACE = {
    "lv_endocardium": "lv_cavity",
    "epicardium": "lv_myocardium",
    "rv_endocardium": "rv_cavity",
    "left_atrium": "left_atrium",
    "right_atrium": "right_atrium",
    "aorta": "aorta",
}

REFERENCE = 0
"""Number of the phase from which displacements count: the first one, next to the R peak."""

# Points per surface and phase; the mean distance of 4000 stratified samples repeats to 0.02 mm.
SAMPLES = 4000
NEEDED_OF_TRUTH = ("phases", "volumes_ml", "lv_mass_g")


def run(job: Job) -> dict[str, Any]:
    """Write ``metrics.json``."""
    truth = job.study.truth
    if truth is None:
        raise Skipped("no truth in this study")
    known = _read_truth(truth, registered=bool(job.product("register")))
    phases = np.array(read_table(job.products / "ingest" / "phases.json")["phases"])
    true_phases = np.array(known["phases"])
    if phases.shape != true_phases.shape or not np.allclose(phases, true_phases, atol=0.02):
        raise InputError(f"{truth}/truth.json: its phases are not those of the cine")
    surfaces = read_surfaces(job.products / "surface", phases)
    found, known_labels = _labels(job, truth)
    shown = [name for name, value in LABELS.items() if (known_labels == value).any()]
    # Truth that has no atria, as of most people who draw by hand, says nothing of them.
    found = np.where(np.isin(found, [LABELS[name] for name in shown]), found, 0)
    metrics: dict[str, Any] = {
        "structures": _structures(job, truth, surfaces, _overlap(found, known_labels)),
        "lv_ejection_fraction": _ejection_fractions(surfaces, known, "lv_endocardium"),
        "rv_ejection_fraction": _ejection_fractions(surfaces, known, "rv_endocardium"),
        "lv_mass_g": _masses(job, known),
        "slice_dice": _rounded(pooled_dice(found, known_labels)),
        "labels_without_truth": [name for name in LABELS if name not in shown],
    }
    if job.product("register"):
        metrics |= _registration(job, truth, known)
    write_table(job.folder / "metrics.json", metrics)
    return _headline(metrics)


def _read_truth(truth: Path, registered: bool) -> dict[str, Any]:
    try:
        known = read_table(truth / "truth.json")
    except (OSError, ValueError) as error:
        raise InputError(f"{truth}/truth.json: cannot be read ({error})") from error
    if not isinstance(known, dict):
        raise InputError(f"{truth}/truth.json: is no JSON object; give truth, or take truth/ out")
    needed = [*NEEDED_OF_TRUTH, *(("mr_from_tracker", "us_frames") if registered else ())]
    if lacking := [name for name in needed if name not in known]:
        raise InputError(
            f"{truth}/truth.json: has no {', '.join(lacking)}; it needs {', '.join(needed)}, as "
            "docs/phantom.md has them: add them, or take truth/ out"
        )
    for name in ("volumes_ml", "us_frames"):
        if name in needed and not isinstance(known[name], dict):
            raise InputError(f"{truth}/truth.json: {name} is no JSON object; mend it")
    chambers = ("lv_endocardium", "rv_endocardium")
    if lacking := [name for name in chambers if name not in known["volumes_ml"]]:
        raise InputError(f"{truth}/truth.json: volumes_ml has no {', '.join(lacking)}; add them")
    volumes = {f"volumes_ml.{name}": known["volumes_ml"][name] for name in chambers}
    for name, value in {"phases": known["phases"], **volumes}.items():
        _require_numbers(truth, name, value, 1)
    _require_numbers(truth, "lv_mass_g", known["lv_mass_g"], 0)
    if registered:
        _require_matrix(truth, "mr_from_tracker", known["mr_from_tracker"])
    return known


def _require_numbers(truth: Path, name: str, value: Any, axes: int) -> None:
    """Refuse what is no array of finite numbers with so many axes."""
    try:
        numbers = np.asarray(value, float)
        fit = numbers.ndim == axes and numbers.size > 0 and bool(np.isfinite(numbers).all())
    except (TypeError, ValueError):
        fit = False
    if not fit:
        words = ("a finite number", "a list of finite numbers", "rows of finite numbers")[axes]
        raise InputError(f"{truth}/truth.json: {name} needs {words}; mend it, or take truth/ out")


def _require_matrix(truth: Path, name: str, value: Any) -> None:
    """Refuse what is no 4x4 matrix with an inverse."""
    _require_numbers(truth, name, value, 2)
    matrix = np.array(value, float)
    if matrix.shape != (4, 4) or np.linalg.det(matrix) == 0:
        raise InputError(
            f"{truth}/truth.json: {name} is no 4x4 matrix with an inverse; mend it, or take truth/ "
            "out"
        )


def _structures(
    job: Job, truth: Path, surfaces: dict[str, MovingSurface], overlap: dict[str, list[float]]
) -> dict[str, dict[str, Any]]:
    names = [name for name in surfaces if (truth / "surfaces" / f"{name}_000.vtp").exists()]
    metrics: dict[str, dict[str, Any]] = {}
    for done, name in enumerate(names):
        moving = surfaces[name]
        known = [
            read_mesh(truth / "surfaces" / f"{name}_{number:03d}.vtp")
            for number in range(len(moving.phases))
        ]
        metrics[name] = _structure(moving, known)
        metrics[name]["dice"] = overlap.get(LABEL_OF_SURFACE.get(name, ""), [])
        metrics[name] |= _motion(moving, known)
        job.progress(done + 1, len(names))
    return metrics


def _structure(moving: MovingSurface, known: list[Surface]) -> dict[str, Any]:
    apart = [
        surface_distance(moving.at(number), truth, SAMPLES) for number, truth in enumerate(known)
    ]
    shapes = [closedness(moving.at(number)) for number in range(len(known))]
    return {
        "mean_surface_distance_mm": [round(one.mean_mm, 3) for one in apart],
        "hausdorff_95_mm": [round(one.hausdorff95_mm, 3) for one in apart],
        "largest_distance_mm": [round(one.largest_mm, 3) for one in apart],
        "closed": all(one.boundary_edges == 0 for one in shapes),
        "one_component": all(one.components == 1 for one in shapes),
        "outward": all(one.outward for one in shapes),
    }


def _motion(moving: MovingSurface, known: list[Surface]) -> dict[str, Any]:
    """Errors of motion; nothing where truth's meshes do not correspond from phase to phase."""
    triangles = known[0].triangles
    if not all(np.array_equal(one.triangles, triangles) for one in known):
        return {}
    path = np.stack([one.vertices_mm for one in known])
    error = motion_error(moving, MovingSurface(path, triangles, moving.phases), REFERENCE)
    across, along = error.mean_mm()
    return {
        "motion_error_mm": {
            "reference_phase": float(moving.phases[REFERENCE]),
            "normal": _rounded(error.normal_mm, 3),
            "tangential": _rounded(error.tangential_mm, 3),
            "normal_mean": round(across, 3),
            "tangential_mean": round(along, 3),
        }
    }


def _labels(job: Job, truth: Path) -> tuple[Label, Label]:
    """Labels found and true on the cine's own pixels, ``(phase, z, y, x)``, but for the files'
    blank ends, which have no number."""
    found, mr_from_found = read_labels(job.products / "segment", "labels")
    known, mr_from_known = read_labels(truth, "labels")
    if found.shape != known.shape:
        raise InputError(
            f"{truth}: its labels are {known.shape} (phase, slice, row, column), those found are "
            f"{found.shape}; truth and cine must be of one study"
        )
    off_mm = corners_apart_mm(mr_from_found, mr_from_known, found.shape[:0:-1])
    if off_mm > SAME_PLACE_MM:
        raise InputError(
            f"{truth}: its labels lie up to {off_mm:.1f} mm beside those found, at most "
            f"{SAME_PLACE_MM:g} mm is rounding; truth and cine must be of one study, its pixels "
            "stored in one order: give the truth of this cine, or take truth/ out"
        )
    before, after = read_blank_ends(job.products / "ingest")
    shown = slice(before, found.shape[1] - after)
    return found[:, shown], known[:, shown]


def _overlap(found: Label, known: Label) -> dict[str, list[float]]:
    """Dice of each label on the cine's own pixels, one value a phase."""
    each = [dice(one, other, LABELS) for one, other in zip(found, known, strict=True)]
    return {name: [round(one[name], 4) for one in each if name in one] for name in LABELS}


def _rounded(values: Any, digits: int = 4) -> Any:
    """Nested lists of an array's values, None in place of NaN, which JSON does not know."""
    if np.ndim(values):
        return [_rounded(one, digits) for one in values]
    return round(float(values), digits) if np.isfinite(values) else None


def _masses(job: Job, known: dict[str, Any]) -> dict[str, float]:
    """Mass of the left muscle."""
    measured = read_table(job.products / "surface" / "measures.json")
    return {
        "found": round(mean_lv_mass_g(measured), 2),
        "truth": round(float(known["lv_mass_g"]), 2),
    }


def _ejection_fractions(
    surfaces: dict[str, MovingSurface], known: dict[str, Any], chamber: str
) -> dict[str, float | None]:
    """Found and true; none is found of a chamber that has no surface."""
    truth = ejection_fraction(np.array(known["volumes_ml"][chamber]))
    if chamber not in surfaces:
        return {"found": None, "truth": round(truth, 4)}
    found = ejection_fraction(volumes_ml(surfaces[chamber]))
    return {"found": round(found, 4), "truth": round(truth, 4)}


def _registration(job: Job, truth: Path, known: dict[str, Any]) -> dict[str, Any]:
    found = read_table(job.products / "register" / "mr_from_tracker.json")["mr_from_tracker"]
    true = np.array(known["mr_from_tracker"])
    heart = read_mesh(truth / "surfaces" / "heart_000.vtp")
    targets_mm = heart.vertices_mm
    missed_mm = target_registration_error_mm(np.array(found), true, targets_mm)
    given = job.study.us.start() if job.study.us else None
    start = {}
    if given is not None:
        start_mm = target_registration_error_mm(given, true, targets_mm)
        start = {"start_mean": round(float(start_mm.mean()), 3)}
    errors = np.abs(_frame_phase_errors(job, known))
    return {
        "target_registration_error_mm": {
            **start,
            "mean": round(float(missed_mm.mean()), 3),
            "largest": round(float(missed_mm.max()), 3),
        },
        "frame_phase_error": {
            "mean": round(float(errors.mean()), 5),
            "percentile_95": round(float(np.percentile(errors, 95)), 5),
            "largest": round(float(errors.max()), 5),
        },
    }


def _frame_phase_errors(job: Job, known: dict[str, Any]) -> Any:
    """Cyclic phase error of every frame, matched to truth by its time stamp."""
    axis, errors = _axis(job, known), []
    for row in read_frames(job.products / "register" / "frames.csv"):
        sweep = known["us_frames"].get(row.sweep)
        if sweep is None:
            raise InputError(
                f"{job.study.folder / 'truth' / 'truth.json'}: knows no sweep {row.sweep}, only "
                f"{', '.join(known['us_frames'])}; give the files their names, or take truth/ out"
            )
        told = sweep if isinstance(sweep, dict) else {}
        times, phases = (told.get(one) or [] for one in ("times_s", "mechanical_phases"))
        if not times or len(times) != len(phases):
            raise InputError(
                f"{job.study.folder / 'truth' / 'truth.json'}: us_frames.{row.sweep} needs times_s "
                "and mechanical_phases, one of each a frame; mend it, or take truth/ out"
            )
        nearest = int(np.abs(np.array(times) - row.time_s).argmin())
        true = axis(phases[nearest])
        errors.append(phase_error(np.array(row.phase), true))
    return np.array(errors)


def _axis(job: Job, known: dict[str, Any]) -> Callable[[float], Any]:
    """How a phase of truth's beat, which lasts what the heart rate asked for says, is brought to
    the MR's mean beat, whose phases the frames have: as it is where one of the two is not known."""
    settings = known.get("settings")
    rate_bpm = settings.get("heart_rate_bpm") if isinstance(settings, dict) else None
    if rate_bpm is None:
        return np.asarray
    if type(rate_bpm) not in (int, float) or not 0 < rate_bpm < math.inf:
        raise InputError(
            f"{job.study.folder / 'truth' / 'truth.json'}: settings.heart_rate_bpm is "
            f"{rate_bpm!r}; give truth's beats a minute, or take it out"
        )
    cycle_rr_s = read_table(job.products / "ingest" / "phases.json")["rr_s"]
    if cycle_rr_s is None:
        return np.asarray
    # Twice, for of a little less than 0 the rest is 1.
    return lambda phase: to_cycle(phase % 1.0 % 1.0, 60 / rate_bpm, cycle_rr_s)


def _headline(metrics: dict[str, Any]) -> dict[str, Any]:
    """The figures that a table of many patients shows."""
    worst = {
        name: max(one["mean_surface_distance_mm"]) for name, one in metrics["structures"].items()
    }
    figures: dict[str, Any] = {
        "worst_mean_surface_distance_mm": worst,
        "all_closed": all(
            one["closed"] and one["one_component"] and one["outward"]
            for one in metrics["structures"].values()
        ),
    }
    if "target_registration_error_mm" in metrics:
        registered = metrics["target_registration_error_mm"]
        figures["target_registration_error_mm"] = registered["mean"]
        figures["largest_frame_phase_error"] = metrics["frame_phase_error"]["largest"]
    return figures
