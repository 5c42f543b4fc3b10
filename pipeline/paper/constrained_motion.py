"""Figure 6: a tip constrained to the beating surface, on registered ultrasound frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from pipeline.errors import InputError
from pipeline.evaluation.dissection import guidance
from pipeline.evaluation.places import settle
from pipeline.evaluation.tracing import trace_along
from pipeline.field.reader import ForceField
from pipeline.geometry import Float, Float32, MovingSurface, nearest_phase, transform_points
from pipeline.imaging.ultrasound import Sweep, read_sweeps
from pipeline.paper.moving import animated
from pipeline.paper.subject import Subject
from pipeline.products import FrameRow, read_frames, read_surfaces, read_table
from pipeline.registration.correction import put_right
from pipeline.report.page import Section, picture
from pipeline.report.pictures import plane_cut
from pipeline.report.style import as_webp, show_grey
from pipeline.study import open_study

STRIP = 4
TRAIL_S = 0.8
ARROW_MM_PER_N = 5.0
SHOWN_MM = 32.0
GUIDE = "guide"
NEAR_MM = 1.0
LOOKS = (("no force", "#D55E00"), ("guided", "#56B4E9"))


@dataclass(frozen=True, slots=True)
class Scene:
    """Frames of one sweep, registered, and tips that move meanwhile."""

    images: Float32
    """``(frame, row, column)``."""

    image_from_mr: Float
    """``(frame, 4, 4)``: MR mm to column, row, off-plane."""

    times_s: Float
    phases: Float
    surface: MovingSurface
    ticks_s: Float
    """``(tick,)``."""

    tips_mm: tuple[Float, Float]
    """Without and with force, ``(tick, 3)``."""

    forces_n: tuple[Float, Float]


def constrained_motion(subject: Subject) -> Section:
    """Figure 6, as a strip of four frames and as an animation of all."""
    structure = subject.structure
    guided = subject.with_fixtures({GUIDE: guidance(structure, "omega7")})
    scene = _scene(subject, guided, structure)
    chosen = np.linspace(0, len(scene.images) - 1, STRIP + 1).astype(int)[1:]
    strip = Figure(figsize=(12, 6.4), layout="constrained")
    for row, axes in enumerate(strip.subplots(2, STRIP)):
        for axis, frame in zip(axes, chosen, strict=True):
            _draw(axis, scene, int(frame), row)
    moving = animated(_frames(scene), float(scene.times_s[-1] - scene.times_s[0]) * 2, 80)
    off = [_off_mm(subject.field, structure, scene, which) for which in (0, 1)]
    return Section(
        "Figure 6: constrained motion on the beating surface",
        "A hand follows a line at rest that the surface had at the sweep's first moment; the heart "
        "beats on. Without force (above) the tip stays on that line and the wall leaves it and "
        "comes through it. Guided (below; m = 2, gamma = 1.5 mm, 6 N, omega.7) the force of the "
        "baked field (arrow) carries the hand along. Grey: registered ultrasound frames; line: the "
        "surface's cut by each frame at its own phase; trail: the tip's last 0.8 s, projected into "
        f"the frame. The tip is {off[0]:.1f} mm from the surface (root mean square) without force "
        f"and {off[1]:.1f} mm with it.",
        [
            picture(
                "Frames of one sweep, without and with the fixture", as_webp(strip, 85), "webp"
            ),
            picture("The whole sweep, at half speed", moving, "webp"),
        ],
    )


def phases_between(times_s: Float, phases: Float, at_s: Float, rr_s: float | None) -> Float:
    """Phases of moments between frames, whose own are in [0, 1): from frame to frame the heart goes
    on evenly, by so many whole beats more as come nearest to beats of ``rr_s``."""
    turned = np.diff(phases) % 1
    if rr_s is not None:
        turned += np.maximum(np.round(np.diff(times_s) / rr_s - turned), 0)
    turns = phases[0] + np.concatenate([[0.0], np.cumsum(turned)])
    return np.asarray(np.interp(at_s, times_s, turns) % 1)


def _off_mm(field: ForceField, structure: str, scene: Scene, which: int) -> float:
    """Root mean square distance of the tip from the beating surface."""
    phases = phases_between(scene.times_s, scene.phases, scene.ticks_s, field.rr_s)
    distance = field.distance_mm(scene.tips_mm[which], phases, structure)
    return float(np.sqrt(np.mean(distance**2)))


def _scene(subject: Subject, field: ForceField, structure: str) -> Scene:
    """Read one sweep and let a hand trace the surface meanwhile."""
    assert subject.products is not None
    assert subject.study is not None
    study = open_study(subject.study)
    if study.us is None:
        raise InputError(f"{subject.study}: has no us/; give a study with tracked ultrasound")
    sweep, rows = _shown(read_sweeps(study.us), subject.products / "register" / "frames.csv")
    frames = np.searchsorted(sweep.numbers, [row.frame for row in rows])
    assert field.mr_from_tracker is not None
    found = read_table(subject.products / "register" / "mr_from_tracker.json")
    tracker_from_image = put_right(sweep.tracker_from_image, sweep.name, found.get("calibration"))
    mr_from_image = field.mr_from_tracker @ tracker_from_image[frames]
    image_from_mr: Float = np.linalg.inv(mr_from_image).astype(np.float64)
    times_s, phases = np.array([r.time_s for r in rows]), np.array([r.phase for r in rows])
    line_mm = _line(field, structure, image_from_mr, sweep.images.shape[1:], float(phases[0]))

    def phase_at(passed_s: float) -> float:
        return float(phases_between(times_s, phases, times_s[:1] + passed_s, field.rr_s)[0])

    lasts_s = float(times_s[-1] - times_s[0])
    traced = [
        trace_along(field, GUIDE, line_mm, lasts_s, phase_at, force) for force in (False, True)
    ]
    surfaces = read_surfaces(subject.products / "surface", field.phases)
    return Scene(
        sweep.images[frames], image_from_mr, times_s, phases, surfaces[structure],
        times_s[0] + traced[0].times_s, (traced[0].tips_mm, traced[1].tips_mm),
        (traced[0].forces_n, traced[1].forces_n),
    )  # fmt: skip


def _shown(sweeps: Sequence[Sweep], path: Path) -> tuple[Sweep, list[FrameRow]]:
    """The first sweep of which two frames or more bear the registration out, and these."""
    valid = [row for row in read_frames(path) if row.valid]
    for sweep in sweeps:
        rows = [row for row in valid if row.sweep == sweep.name]
        if len(rows) > 1:
            return sweep, rows
    raise InputError(
        f"{path}: no sweep has two frames that bear the registration out; leave figure-6 out "
        "(--only), or register sweeps that show the heart"
    )


def _line(
    field: ForceField, structure: str, image_from_mr: Float, shape: tuple[int, ...], phase: float
) -> Float:
    """A line ``(n, 3)`` on the surface, a place in each frame that meets it.

    It begins where the first of these frames shows the surface move most, and goes on in each
    frame at the place nearest to the last.
    """
    rows, columns = np.mgrid[0.1:0.9:150j, 0.1:0.9:150j]
    pixels = np.stack([columns * shape[1], rows * shape[0], 0 * rows], axis=-1).reshape(-1, 3)
    line: list[Float] = []
    for transform in image_from_mr:
        points = transform_points(np.linalg.inv(transform), pixels)
        points = points[field.contains(points)]
        if len(points):
            points = points[np.abs(field.distance_mm(points, phase, structure)) < NEAR_MM]
        if not len(points):
            continue
        if line:
            line.append(points[np.linalg.norm(points - line[-1], axis=1).argmin()])
        else:
            moments = [field.distance_mm(points, k / 10, structure) for k in range(10)]
            line.append(points[np.ptp(moments, axis=0).argmax()])
    if not line:
        raise InputError("no ultrasound frame meets the baked surface; register the sweeps again")
    return settle(field, structure, np.array(line), phase)


def _frames(scene: Scene) -> Iterator[Figure]:
    for frame in range(len(scene.images)):
        figure = Figure(figsize=(9, 4.6), layout="constrained")
        for which, axis in enumerate(figure.subplots(1, 2)):
            _draw(axis, scene, frame, which)
        yield figure


def _draw(axis: Axes, scene: Scene, frame: int, which: int) -> None:
    image, transform = scene.images[frame], scene.image_from_mr[frame]
    show_grey(axis, image)
    nearest = nearest_phase(scene.surface.phases, scene.phases[frame])
    cut = plane_cut(scene.surface.at(nearest), transform)
    axis.add_collection(LineCollection(list(cut), colors="w", linewidths=1.6))
    now = int(np.searchsorted(scene.ticks_s, scene.times_s[frame]))
    now = min(now, len(scene.ticks_s) - 1)
    since = int(np.searchsorted(scene.ticks_s, scene.times_s[frame] - TRAIL_S))
    tips = transform_points(transform, scene.tips_mm[which][since : now + 1])
    name, colour = LOOKS[which]
    axis.plot(tips[:, 0], tips[:, 1], color="k", linewidth=3.5)
    axis.plot(tips[:, 0], tips[:, 1], color=colour, linewidth=1.8)
    axis.plot(tips[-1, 0], tips[-1, 1], "o", color=colour, markeredgecolor="k", markersize=7)
    force = scene.forces_n[which][now] @ transform[:3, :3].T
    pixels = force[:2] * ARROW_MM_PER_N
    if np.hypot(*pixels) > 2:
        axis.annotate(
            "", (tips[-1, 0] + pixels[0], tips[-1, 1] + pixels[1]), (tips[-1, 0], tips[-1, 1]),
            arrowprops={"arrowstyle": "-|>", "color": "w", "linewidth": 2},
        )  # fmt: skip
    reach = SHOWN_MM * np.linalg.norm(transform[:3, :3], axis=1)[:2]
    middle = transform_points(transform, scene.tips_mm[0]).mean(axis=0)
    axis.set(xlim=(middle[0] - reach[0], middle[0] + reach[0]))
    axis.set(ylim=(middle[1] + reach[1], middle[1] - reach[1]))
    newton = np.linalg.norm(scene.forces_n[which][now])
    axis.set_title(f"{name}, phase {scene.phases[frame]:.2f}, {newton:.2f} N", fontsize=9)
