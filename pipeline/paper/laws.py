"""Figures 2 and 3: what m, gamma and delta do to potential and force."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluation.places import on_surface
from pipeline.field.fixture import DEVICES, Fixture, delta_from_gamma, steepest_slope
from pipeline.field.potential import potential
from pipeline.geometry import Float
from pipeline.paper.subject import Subject
from pipeline.report.page import Section, Table, picture
from pipeline.report.style import as_svg

POWERS = (1, 2, 4, 8, 16)
DELTA_MM = 5.0
FORCE_N = 2.0
LEVEL = 0.01
REACH_MM = 10.0
STEP_MM = 0.01
LINES = 24

# Okabe and Ito's colours from dark to light, with line styles for greyscale.
LOOKS = (("#000000", "-"), ("#0072B2", "--"), ("#D55E00", "-."), ("#009E73", ":"), ("#CC79A7", "-"))


@dataclass(frozen=True, slots=True)
class Slope:
    """How steeply a fixture's force rises, per m."""

    m: int
    analytic_n_per_mm: float
    """``f_max m sqrt(2) s^s exp(-s) / delta`` with ``s = (2m - 1) / (2m)``."""

    formula_n_per_mm: float
    """Largest quotient of differences of the formula itself."""

    field_n_per_mm: Float
    """``(line,)``, the largest along each line through the baked surface."""


def law_of(m: int, structure: str) -> Fixture:
    """The guidance of one m that the figures compare."""
    return Fixture(
        structure=structure, kind="guidance", delta_mm=DELTA_MM, m=m, f_max_n=FORCE_N,
        device=DEVICES["omega7"],
    )  # fmt: skip


def read_profiles(subject: Subject) -> tuple[Float, Float, dict[int, Float]]:
    """Forces along lines that leave the surface, as the reader gives them.

    Returns
    -------
    Place along the lines ``(place,)`` mm from the surface outwards, the distances that the field
    has there ``(line, place)`` mm, and by m the forces' sizes ``(line, place)`` N.
    """
    feet_mm, out = on_surface(subject.field, subject.structure, LINES, seed=2)
    along_mm = np.arange(0.0, REACH_MM, STEP_MM)
    points = feet_mm[:, None] + along_mm[:, None] * out[:, None]
    flat = points.reshape(-1, 3)
    field = subject.with_fixtures({f"m{m}": law_of(m, subject.structure) for m in POWERS})
    distance_mm = field.distance_mm(flat, 0.0, subject.structure).reshape(points.shape[:2])
    forces = {
        m: np.linalg.norm(field.force_n(flat, 0.0, f"m{m}"), axis=1).reshape(points.shape[:2])
        for m in POWERS
    }
    return along_mm, distance_mm, forces


def slopes(subject: Subject) -> list[Slope]:
    """Steepest slopes: by the closed form, of the formula, and read from the field."""
    along_mm, distance_mm, forces = read_profiles(subject)
    found = []
    for m in POWERS:
        formula = FORCE_N * potential(along_mm, DELTA_MM, m)
        # Per millimetre of the field's own distance: what the law sees.
        quotient = np.diff(forces[m], axis=1) / np.diff(distance_mm, axis=1)
        found.append(
            Slope(
                m,
                FORCE_N * steepest_slope(m) / DELTA_MM,
                float(np.diff(formula).max() / STEP_MM),
                np.nanmax(quotient, axis=1),
            )
        )
    return found


def smallest_delta_mm(force_n: float, m: int, stiffness_n_per_m: float) -> float:
    """Narrowest potential that a device of a stiffness can render at a largest force.

    >>> round(smallest_delta_mm(2.0, 2, 400.0), 3)
    5.384
    """
    return 1000 * force_n * steepest_slope(m) / stiffness_n_per_m


def effect_of_m(subject: Subject) -> Section:
    """Figure 2."""
    along_mm, distance_mm, forces = read_profiles(subject)
    found = slopes(subject)
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    heights, pulls, steep = figure.subplots(1, 3)
    _potentials(heights)
    _forces(pulls, distance_mm[0], forces)
    _slopes(steep, along_mm, found)
    return Section(
        "Figure 2: the effect of m",
        "Potential f(q) = 1 - exp(-(q²/(2delta²))^m) for rising m, the force that the reader gives "
        f"along a line through the baked surface (marks) over the formula's (lines), and how "
        f"steeply the force rises. delta = {DELTA_MM:g} mm, f_max = {FORCE_N:g} N. All curves "
        "pass through 1 - 1/e at q = √2 delta; the larger m, the closer to a switch that is "
        "off below it and on above, and the stiffer the wall.",
        [picture("Potential, force and stiffness for m = 1, 2, 4, 8, 16", as_svg(figure), "svg")],
        [_slope_table(found)],
    )


def _potentials(axis: Axes) -> None:
    q_mm = np.linspace(0, 2.4 * DELTA_MM, 500)
    for m, (colour, style) in zip(POWERS, LOOKS, strict=True):
        wide = 2.6 if m == POWERS[-1] else 1.6
        axis.plot(
            q_mm,
            potential(q_mm, DELTA_MM, m),
            style,
            color=colour,
            label=f"m = {m}",
            linewidth=wide,
        )
    edge = math.sqrt(2) * DELTA_MM
    axis.plot([0, edge, edge, 2.4 * DELTA_MM], [0, 0, 1, 1], color="0.7", linewidth=5, zorder=0)
    axis.annotate("m → ∞", (edge, 0.12), (edge + 1.0, 0.12), fontsize=8, va="center")
    axis.set(xlabel="q, distance to the surface (mm)", ylabel="potential f", title="potential")
    axis.legend(fontsize=7, loc="upper left")
    axis.grid(alpha=0.3)


def _forces(axis: Axes, distance_mm: Float, forces: dict[int, Float]) -> None:
    q_mm = np.linspace(0, REACH_MM, 400)
    for m, (colour, style) in zip(POWERS, LOOKS, strict=True):
        axis.plot(q_mm, FORCE_N * potential(q_mm, DELTA_MM, m), style, color=colour, linewidth=1.2)
        axis.plot(distance_mm[::50], forces[m][0, ::50], "o", color=colour, markersize=3)
    axis.set(
        xlabel="distance in the field (mm)", ylabel="force (N)", title="force read and formula"
    )
    axis.set_xlim(0, REACH_MM)
    axis.grid(alpha=0.3)


def _slopes(axis: Axes, along_mm: Float, found: list[Slope]) -> None:
    for slope, (colour, style) in zip(found, LOOKS, strict=True):
        steep = np.diff(FORCE_N * potential(along_mm, DELTA_MM, slope.m)) / STEP_MM
        middle = (along_mm[1:] + along_mm[:-1]) / 2
        axis.plot(middle, steep, style, color=colour, linewidth=1.6)
        place = middle[steep.argmax()]
        axis.plot(place, slope.analytic_n_per_mm, "s", color=colour, markersize=5, fillstyle="none")
        axis.plot(place, np.median(slope.field_n_per_mm), "x", color=colour, markersize=7)
    axis.plot([], [], "ks", fillstyle="none", label="analytic")
    axis.plot([], [], "kx", label="read from the field")
    limit = DEVICES["touch"].stiffness_n_per_m
    assert limit is not None
    axis.axhline(limit / 1000, color="0.4", linewidth=1)
    axis.text(0.1, limit / 1000 * 1.03, "Touch: 0.4 N/mm", fontsize=7, color="0.3")
    axis.set(xlabel="q (mm)", ylabel="slope of the force (N/mm)", title="stiffness", ylim=(0, None))
    axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(0, 0.9))
    axis.grid(alpha=0.3)


def _slope_table(found: list[Slope]) -> Table:
    head = ["m", "steepest slope, analytic (N/mm)", "of the formula, differences"]
    head += [f"read from the field, {LINES} lines, median (range)", "smallest delta, Touch at 2 N"]
    head += ["smallest delta, omega.7 at 12 N"]
    touch, omega = (DEVICES[name].stiffness_n_per_m for name in ("touch", "omega7"))
    assert touch is not None
    assert omega is not None
    rows = []
    for one in found:
        read = one.field_n_per_mm
        middle = np.median(read)
        rows.append(
            (
                str(one.m),
                f"{one.analytic_n_per_mm:.4f}",
                f"{one.formula_n_per_mm:.4f}",
                f"{middle:.4f} ({read.min():.4f} to {read.max():.4f})",
                f"{smallest_delta_mm(2.0, one.m, touch):.2f} mm",
                f"{smallest_delta_mm(12.0, one.m, omega):.2f} mm",
            )
        )
    return Table(head, rows)


def effect_of_widths() -> Section:
    """Figure 3."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    widths, ratio, narrowest = figure.subplots(1, 3)
    _widths(widths)
    _ratio(ratio)
    _rendered_range(narrowest)
    rows = [
        (
            str(m),
            f"{1 / delta_from_gamma(1.0, LEVEL, m):.3f}",
            f"{smallest_delta_mm(FORCE_N, m, 400) / delta_from_gamma(1.0, LEVEL, m):.2f} mm",
            f"{smallest_delta_mm(3.3, m, 400) / delta_from_gamma(1.0, LEVEL, m):.2f} mm",
            f"{smallest_delta_mm(12.0, m, 5000) / delta_from_gamma(1.0, LEVEL, m):.2f} mm",
        )
        for m in POWERS
    ]
    head = [
        "m",
        "gamma / delta",
        "smallest gamma, Touch at 2 N",
        "Touch at 3.3 N",
        "omega.7 at 12 N",
    ]
    return Section(
        "Figure 3: the effect of gamma and delta",
        "gamma is the half-width of the workspace in which next to nothing is felt: f(gamma) = "
        "0.01, so delta = gamma / (√2 (-ln 0.99)^(1/(2m))). Left: the same m, wider delta (marks "
        "at gamma). Middle: what share of delta is workspace; it grows with m. Right: the "
        "narrowest delta that each device can render at a given largest force, by its maker's "
        "stiffness: what lies above and left of its lines, in a loop without delay "
        "(Touch: 3.3 N and 400 N/m; omega.7: 12 N and 5000 N/m; of the Falcon only its 8.9 N are "
        "known).",
        [picture("Workspace, and what devices can render", as_svg(figure), "svg")],
        [Table(head, rows)],
    )


def _widths(axis: Axes) -> None:
    q_mm = np.linspace(-16, 16, 801)
    for delta_mm, (colour, style) in zip((2.0, 4.0, 6.0, 8.0), LOOKS, strict=False):
        axis.plot(
            q_mm,
            potential(q_mm, delta_mm, 2),
            style,
            color=colour,
            label=f"delta = {delta_mm:g} mm",
        )
        gamma = delta_mm / delta_from_gamma(1.0, LEVEL, 2)
        axis.plot([-gamma, gamma], [LEVEL, LEVEL], "|", color=colour, markersize=12)
    axis.set(xlabel="signed distance (mm)", ylabel="potential f", title="m = 2; bars at ±gamma")
    axis.legend(fontsize=7, loc="lower left")
    axis.grid(alpha=0.3)


def _ratio(axis: Axes) -> None:
    m = np.arange(1, 17)
    for level, (colour, style) in zip((0.001, 0.01, 0.05), LOOKS, strict=False):
        share = [1 / delta_from_gamma(1.0, level, int(one)) for one in m]
        axis.plot(
            m, share, style, marker="o", markersize=3, color=colour, label=f"f(gamma) = {level}"
        )
    axis.axhline(math.sqrt(2), color="0.5", linewidth=1)
    axis.text(1, math.sqrt(2) * 1.01, "√2: the switch's edge", fontsize=7)
    axis.set(
        xlabel="m", ylabel="gamma / delta", title="workspace as a share of delta", ylim=(0, 1.6)
    )
    axis.legend(fontsize=7, loc="lower right")
    axis.grid(alpha=0.3)


def _rendered_range(axis: Axes) -> None:
    for name, shown in (("touch", "Touch"), ("omega7", "omega.7")):
        device = DEVICES[name]
        assert device.stiffness_n_per_m is not None
        force_n = np.linspace(0.05, device.force_n, 50)
        for m, (colour, style) in zip((1, 2, 4, 8), LOOKS, strict=False):
            narrow = [smallest_delta_mm(f, m, device.stiffness_n_per_m) for f in force_n]
            axis.plot(force_n, narrow, style, color=colour, linewidth=1.4)
            axis.plot(force_n[-1], narrow[-1], "o", color=colour, markersize=3)
        axis.axvline(device.force_n, color="0.7", linewidth=1)
        axis.text(
            device.force_n, 0.06, f" {shown}", fontsize=7, rotation=90, va="bottom", ha="right"
        )
    axis.axvline(DEVICES["falcon"].force_n, color="0.7", linewidth=1)
    axis.text(DEVICES["falcon"].force_n, 0.06, " Falcon", fontsize=7, rotation=90, ha="right")
    for m, (colour, style) in zip((1, 2, 4, 8), LOOKS, strict=False):
        axis.plot([], [], style, color=colour, label=f"m = {m}")
    axis.set(xlabel="largest force (N)", ylabel="smallest delta (mm)", yscale="log")
    axis.set(title="what devices can render", ylim=(0.05, 60), xlim=(0, 12.5))
    axis.legend(fontsize=7, ncols=2, loc="upper right")
    axis.grid(alpha=0.3, which="both")
