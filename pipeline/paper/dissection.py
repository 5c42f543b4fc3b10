"""Figure 5 and Table 1: the simulated tissue dissection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluation import dissection as task
from pipeline.evaluation.dissection import Condition, Room, interval
from pipeline.evaluation.dissection_values import TRACE_STEP_S, Sum
from pipeline.evaluation.operators import POPULATION
from pipeline.field.fixture import DeviceName
from pipeline.geometry import Float
from pipeline.paper.subject import Subject
from pipeline.progress import Progress
from pipeline.report.page import Section, Table, picture
from pipeline.report.style import as_svg

PAPER_S = ((211, 90), (225, 86))
"""Mean times without and with force in the paper's Table 1: 3'31", 1'30"; 3'45", 1'26"."""

SENSITIVE = {
    "delay_s": "reaction delay",
    "slope_s_per_bit": "time per bit",
    "depth_sd_mm": "depth scatter",
    "depth_bias_mm": "depth bias",
    "turn_rad": "mirror error",
    "gain": "lever error",
    "tremor_mm": "tremor",
    "stiffness_n_per_mm": "hand stiffness",
}
DEVICE_NAMES: dict[DeviceName, str] = {"omega7": "omega.7", "touch": "Touch"}

SENSITIVITY_OPERATORS = 30
TRACE_S = 60.0

PLAIN = (
    "A simulated operator shows by which mechanism a fixture helps; it is not a result about "
    "people, and none of its parameters was chosen to meet the paper's times. "
)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: a condition under its name, and the one without force beside it."""

    name: str
    condition: Condition
    beside: int
    """Number of the row without force, with the same tool and heart."""


def rows_of(structure: str) -> list[Row]:
    """The conditions of Table 1: tools, hearts and devices, each without force first."""
    guided, kept_out = ("guided", task.guidance), ("kept out", task.keep_out)
    ways: list[tuple[task.ToolName, DeviceName, list[Any]]] = [
        ("point", "omega7", [guided, kept_out]),
        ("point", "touch", [guided, kept_out]),
        ("needle", "omega7", [kept_out]),
        ("torus", "omega7", [guided]),
    ]
    rows: list[Row] = []
    for tool, device, fixtures in ways:
        for beating in (False, True):
            name = f"{tool}, {DEVICE_NAMES[device]}, {'beating' if beating else 'static'}"
            free = len(rows)
            rows.append(Row(f"{name}, no force", Condition(tool, beating, device=device), free))
            rows += [
                Row(f"{name}, {how}", Condition(tool, beating, make(structure, device)), free)
                for how, make in fixtures
            ]
    return rows


def clock(seconds: float) -> str:
    """Minutes and seconds as the paper writes them.

    >>> clock(211)
    '3\\'31"'
    """
    whole = round(seconds)
    return f"{whole // 60}'{whole % 60:02d}\""


def dissection(subject: Subject, seed: int, operators: int, progress: Progress) -> Section:
    """Figure 5, Table 1, the sensitivity figure and the energy account."""
    room = Room(subject.field_path, subject.structure, seed)
    rows = rows_of(subject.structure)
    found = task.run_all(room, [row.condition for row in rows], seed, operators, progress)
    assert subject.field.rr_s is not None
    return Section(
        "Figure 5 and Table 1: the simulated dissection",
        f"{task.PELLETS} pellets lie 3 to 5 mm outside the {subject.structure} and move with it. "
        f"A rod of {task.ROD_MM:g} mm through a pivot {task.PIVOT_MM:g} mm away is to be within "
        f"{task.WIDTH_MM / 2:g} mm of each for {task.DWELL_S:g} s in all, without touching the "
        f"heart. {operators} simulated operators, the same in every row; "
        f"{60 / subject.field.rr_s:.0f} beats/min. Guided: drawn to the shell of the "
        "pellets (4 mm outside the heart); kept out: pushed out of what lies deeper. "
        "Forces are those of the baked field through its reader's kernels, at 1 kHz. " + PLAIN,
        [
            picture("Two paths of one operator, and how near they come", _paths(room, seed), "svg"),
            picture("What each condition comes to", as_svg(_bars(rows, found)), "svg"),
        ],
        [_table(rows, found), _paper_table(rows, found), _energy_table(rows, found), _people()],
    )


def sensitivity(subject: Subject, seed: int, operators: int, progress: Progress) -> Section:
    """Which parameters of the operators matter."""
    room = Room(subject.field_path, subject.structure, seed)
    fixture = task.guidance(subject.structure, "omega7")
    changes: list[tuple[str, dict[str, Any]]] = [("as they are", {})]
    for name, called in SENSITIVE.items():
        for factor, much in ((0.5, "half"), (2.0, "twice")):
            changes.append((f"{called}, {much}", {"scaled": {name: factor}}))
    by_hand = {"delay_s": 201 / 630, "slope_s_per_bit": 86 / 250}
    changes.append(("by hand (201 ms, 86 ms/bit)", {"scaled": by_hand}))
    changes += [(f"view {deg:g}° off the normal", {"view_deg": deg}) for deg in (0.0, 70.0)]
    conditions = [
        Condition("point", True, force, **change)
        for _, change in changes
        for force in (None, fixture)
    ]
    count = min(operators, SENSITIVITY_OPERATORS)
    found = task.run_all(room, conditions, seed, count, progress)
    return Section(
        "Which parameters of an operator matter",
        "One parameter at a time, halved and doubled; point tool, beating heart, "
        f"{count} operators, without force (open marks) and guided by an omega.7 "
        "(filled), with 95 % intervals. What moves both marks alike is about the operator; what "
        "changes the distance between them is about the fixture.",
        [picture("Sensitivity", as_svg(_sensitivity([name for name, _ in changes], found)), "svg")],
    )


def _sensitivity(names: list[str], found: Float) -> Figure:
    figure = Figure(figsize=(9.5, 0.27 * len(names) + 1), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    places = np.arange(len(names))
    shown = (
        (Sum.TIME, "time (s)"),
        (Sum.CONTACTS, "contacts"),
        (Sum.DEPTH, "deepest contact (mm)"),
    )
    for axis, (which, title) in zip(axes, shown, strict=True):
        for offset, fill, first in ((-0.15, "none", 0), (0.15, "full", 1)):
            values = [interval(found[first + 2 * n, :, which]) for n in places]
            means, halves = np.array(values).T
            axis.errorbar(
                means, places + offset, xerr=halves, fmt="o", fillstyle=fill, color="k",
                markersize=5, linewidth=1,
            )  # fmt: skip
        axis.set(xlabel=title)
        axis.grid(alpha=0.3)
        axis.set_xlim(0, None)
    axes[0].set_yticks(places, names, fontsize=8)
    axes[0].invert_yaxis()
    return figure


def _paths(room: Room, seed: int) -> bytes:
    """One operator with and without force: seen along the heart, and over time."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    picture_axis, clear_axis = figure.subplots(1, 2, width_ratios=(1, 1.3))
    fixture = task.guidance(room.structure, "omega7")
    across = np.cross(room.out, (0.0, 0.0, 1.0))
    across /= np.linalg.norm(across)
    centre = room.pellets_mm.mean(axis=(0, 1))
    _draw_room(picture_axis, room, centre, across)
    looks = ((None, "no force", "#D55E00", "-"), (fixture, "guided", "#0072B2", "--"))
    for force, name, colour, style in looks:
        rows = int(TRACE_S / TRACE_STEP_S)
        trial = task.run_trial(room, Condition("point", True, force), seed, 0, rows)
        trace = trial.trace[: min(int(trial.sums[Sum.TIME] / TRACE_STEP_S), rows)]
        away = trace[:, 1:4] - centre
        picture_axis.plot(away @ across, away @ room.out, style, color=colour, linewidth=0.8)
        clear_axis.plot(trace[:, 0], trace[:, 4], style, color=colour, linewidth=0.9, label=name)
    clear_axis.axhspan(-20, 0, color="0.8")
    clear_axis.axhline(task.LIFT_MM, color="0.4", linewidth=0.8, linestyle=":")
    clear_axis.text(0.5, -1, "inside the heart", fontsize=8, va="top")
    clear_axis.set(xlabel="time (s)", ylabel="tip to heart (mm)", ylim=(-5, 25), xlim=(0, TRACE_S))
    clear_axis.legend(fontsize=8)
    clear_axis.grid(alpha=0.3)
    return as_svg(figure)


def _draw_room(axis: Axes, room: Room, centre: Float, across: Float) -> None:
    """Heart, fixture, pellets and rod in the plane of the rod and the view axis."""
    u, v = np.meshgrid(np.linspace(-30, 30, 121), np.linspace(-20, 32, 105))
    points = centre + u[..., None] * across + v[..., None] * room.out
    distance = room.field.distance_mm(points.reshape(-1, 3), 0.0, room.structure).reshape(u.shape)
    axis.contourf(u, v, distance, levels=[-100, 0], colors=["0.8"])
    lines = axis.contour(u, v, distance, levels=[0, 2, 4, 6, 8, 10], colors="0.4", linewidths=0.7)
    axis.clabel(lines, fmt="%d mm", fontsize=6)
    pellets = room.pellets_mm[:, 0] - centre
    axis.plot(pellets @ across, pellets @ room.out, "ko", markersize=4, label="pellets (R peak)")
    axis.plot([0, 0], [20, 32], color="0.3", linewidth=3)
    axis.annotate("rod, to the pivot", (0, 30), (3, 29), fontsize=7)
    axis.set(xlabel="along the heart (mm)", ylabel="away from it (mm)", aspect="equal")
    axis.set(xlim=(-30, 30), ylim=(-20, 32))
    axis.legend(fontsize=7, loc="lower left")


def _bars(rows: list[Row], found: Float) -> Figure:
    figure = Figure(figsize=(10, 0.27 * len(rows) + 1), layout="constrained")
    axes = figure.subplots(1, 4, sharey=True)
    places = np.arange(len(rows))
    shown = (
        (Sum.TIME, "time (s)"), (Sum.CONTACTS, "contacts"), (Sum.DEPTH, "deepest (mm)"),
        (Sum.OUTSIDE, "outside the workspace (s)"),
    )  # fmt: skip
    grey = ["white" if row.condition.fixture is None else "0.6" for row in rows]
    for axis, (which, title) in zip(axes, shown, strict=True):
        means, halves = np.array([interval(values) for values in found[:, :, which]]).T
        axis.barh(places, means, xerr=halves, color=grey, edgecolor="k", linewidth=0.7)
        axis.set(xlabel=title)
        axis.set_xlim(0, None)
        axis.grid(alpha=0.3, axis="x")
    axes[0].set_yticks(places, [row.name for row in rows], fontsize=8)
    axes[0].invert_yaxis()
    return figure


def _spread(values: Float, form: str = ".1f") -> str:
    mean, half = interval(values)
    return f"{mean:{form}} ± {half:{form}}"


def _table(rows: list[Row], found: Float) -> Table:
    head = ["Table 1", "time (s)", "less than without force (s)", "path (mm)", "contacts"]
    head += ["deepest (mm)", "touching (s)", "outside (s)", "operator's work (mJ)", "finished"]
    lines = []
    for row, values in zip(rows, found, strict=True):
        less = found[row.beside, :, Sum.TIME] - values[:, Sum.TIME]
        lines.append(
            (
                row.name,
                _spread(values[:, Sum.TIME]),
                "" if row.condition.fixture is None else _spread(less),
                _spread(values[:, Sum.PATH], ".0f"),
                _spread(values[:, Sum.CONTACTS]),
                _spread(values[:, Sum.DEPTH], ".2f"),
                _spread(values[:, Sum.CONTACT_TIME], ".2f"),
                _spread(values[:, Sum.OUTSIDE]),
                _spread(values[:, Sum.WORK], ".0f"),
                f"{np.mean(values[:, Sum.REMOVED] == task.PELLETS):.0%}",
            )
        )
    return Table(head, lines)


def _paper_table(rows: list[Row], found: Float) -> Table:
    """The paper's four mean times beside ours with the same heart."""
    head = [
        "mean time",
        "no force",
        "with force",
        "ratio (paper: of the means; here: mean of each operator's own)",
    ]
    lines = [
        (f"paper, {place} pair", clock(free), clock(forced), f"{forced / free:.2f}")
        for place, (free, forced) in zip(("first", "second"), PAPER_S, strict=True)
    ]
    for row, values in zip(rows, found, strict=True):
        if row.condition.fixture is None:
            continue
        free, forced = found[row.beside, :, Sum.TIME], values[:, Sum.TIME]
        ratio, half = interval(forced / free)
        lines.append(
            (row.name, clock(free.mean()), clock(forced.mean()), f"{ratio:.2f} ± {half:.2f}")
        )
    return Table(head, lines)


def _energy_table(rows: list[Row], found: Float) -> Table:
    """Where the energy came from and went: means, and how well the account closes."""
    head = ["energy (mJ)", "operator", "heart", "made by sampling", "lost in the device"]
    head += [
        "lost in the hand",
        "more in motion and fixture at the end",
        "worst misfit of a tick, relative",
    ]
    lines = []
    for row, values in zip(rows, found, strict=True):
        mean = values.mean(axis=0)
        left = mean[Sum.KINETIC] + mean[Sum.SPRING] + mean[Sum.STORED]
        turned = np.maximum(values[:, Sum.DEVICE_LOSS] + values[:, Sum.HAND_LOSS], 1e-12)
        counts = (Sum.WORK, Sum.HEART, Sum.SAMPLING, Sum.DEVICE_LOSS, Sum.HAND_LOSS)
        cells = [f"{mean[which]:.2f}" for which in counts]
        # Every tick's misfit is below the worst: all of them together stay below this.
        ticks = values[:, Sum.TIME] / task.TICK_S
        worst = (values[:, Sum.WORST] * ticks / turned).max()
        lines.append((row.name, *cells, f"{left:.3f}", f"< {worst:.0e}"))
    return Table(head, lines)


def _people() -> Table:
    rows = [
        (
            name.replace("_", " "),
            f"{about.centre:.3g}",
            f"{100 * about.spread:.0f} %" if about.relative else f"± {about.spread:.2g}",
            about.source,
        )
        for name, about in POPULATION.items()
    ]
    return Table(["operator", "centre", "spread", "source"], rows)
