"""What the paper asks for as future work: how good must registration in space and time be."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.evaluation import dissection as task
from pipeline.evaluation.dissection import Condition, Room, interval
from pipeline.evaluation.dissection_values import Sum
from pipeline.field.reader import ForceField
from pipeline.geometry import Float
from pipeline.paper.laws import LOOKS
from pipeline.paper.subject import Subject
from pipeline.progress import Progress
from pipeline.report.page import Section, Table, picture
from pipeline.report.style import as_svg, words

SHIFTS_MM = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
LATE_MS = (0.0, 10.0, 25.0, 50.0, 75.0, 100.0)
PLACES = 1500
BAND_MM = 10.0

BREATH_MM = 4.9
"""Mean caudal movement of the heart in free breathing (Shechter et al., IEEE Trans. Med. Imaging
23:1046-1056, 2004: 4.9 mm, 2.4 to 8.0)."""

BREATH_S = 4.0
UP = np.array([0.0, 0.0, 1.0])
"""Towards the head, LPS."""

RR_SPREAD = 0.05
"""Standard deviation of beat-to-beat intervals over their mean, at rest (assumed)."""

OPERATORS = 30


def near_places(field: ForceField, structure: str, seed: int) -> tuple[Float, Float]:
    """Places ``(n, 3)`` about the beating surface, within ``BAND_MM``, and phases ``(n,)``."""
    rng = np.random.default_rng(seed)
    found, moments = np.empty((0, 3)), np.empty(0)
    while len(found) < PLACES:
        points = rng.uniform(np.array(field.grid.origin_mm) + 6, field.grid.upper_mm - 6, (4000, 3))
        phases = rng.uniform(size=len(points))
        near = np.abs(field.distance_mm(points, phases, structure)) < BAND_MM
        found = np.concatenate([found, points[near]])
        moments = np.concatenate([moments, phases[near]])
    return found[:PLACES], moments[:PLACES]


def force_errors(
    field: ForceField, fixture: str, shift_mm: float, late_s: float, seed: int
) -> Float:
    """Length of the difference of force ``(n,)`` N that wrong places or moments make.

    Parameters
    ----------
    shift_mm
        Length of a shift, in a random direction at each place.
    late_s
        By how much the clock is behind.
    """
    ways = np.random.default_rng([seed, 2]).standard_normal((PLACES, 3))
    ways *= shift_mm / np.linalg.norm(ways, axis=1, keepdims=True)
    return _errors(field, fixture, seed, ways, late_s)


def _errors(
    field: ForceField, fixture: str, seed: int, shift_mm: Float, late_s: float | Float
) -> Float:
    """As `force_errors`, of tools that seem to be by ``(3,)`` or ``(n, 3)`` elsewhere."""
    assert field.rr_s is not None
    points, phases = near_places(field, field.fixtures[fixture].structure, seed)
    right = field.force_n(points, phases, fixture)
    wrong = field.force_n(points + shift_mm, phases - late_s / field.rr_s, fixture)
    return np.asarray(np.linalg.norm(wrong - right, axis=1))


def future_work(subject: Subject, seed: int, operators: int, progress: Progress) -> Section:
    """Force error at the tool against errors of registration, and what it does to the task."""
    field = subject.field
    room = Room(subject.field_path, subject.structure, seed)
    fixture = task.guidance(subject.structure, "omega7")
    conditions = [Condition("point", True, fixture, shift_mm=shift) for shift in SHIFTS_MM]
    conditions += [Condition("point", True, fixture, late_s=late / 1000) for late in LATE_MS]
    conditions += [Condition("point", True)]
    found = task.run_all(room, conditions, seed, min(operators, OPERATORS), progress)
    figure = Figure(figsize=(10.5, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    _against_shift(axes[0, 0], field, seed)
    _against_late(axes[0, 1], field, seed)
    _lost_ecg(axes[1, 0], field, seed)
    _lost_ultrasound(axes[1, 1], field, seed)
    _task(axes[0, 2], SHIFTS_MM, found[: len(SHIFTS_MM)], found[-1], "registration error (mm)")
    _task(axes[1, 2], LATE_MS, found[len(SHIFTS_MM) : -1], found[-1], "phase error (ms)")
    return Section(
        "Future work: how good must registration be",
        "Difference of the force between a field in its right place and moment and one that is "
        f"off, at {PLACES} places within {BAND_MM:g} mm of each fixture's surface and at all "
        "phases: median (line) and 95th percentile (thin). Without ECG the phase runs on at the "
        f"mean heart rate while beats vary by {RR_SPREAD:.0%} (assumed); without ultrasound the "
        f"registration stays while breathing moves the heart by {BREATH_MM} mm (Shechter et al. "
        "2004) in 4 s. Right: contacts in the simulated dissection, guided, against the same "
        "errors; the band is the mean without any force. Where the curve meets the band, the "
        "fixture no longer protects.",
        [picture("Force error against errors in space and time", as_svg(figure), "svg")],
        [_shift_table(field, seed)],
    )


def _curves(axis: Axes, field: ForceField, x: Float, errors: Callable[[str, int], Float]) -> None:
    for name, (colour, style) in zip(field.fixtures, cycle(LOOKS), strict=False):
        values = [errors(name, n) for n in range(len(x))]
        middle = [np.median(one) for one in values]
        high = [np.percentile(one, 95) for one in values]
        axis.plot(x, middle, style, color=colour, linewidth=2, label=words(name))
        axis.plot(x, high, style, color=colour, linewidth=0.8)
    axis.set(ylabel="force error (N)", ylim=(0, None), xlim=(0, max(x)))
    axis.grid(alpha=0.3)


def _against_shift(axis: Axes, field: ForceField, seed: int) -> None:
    x = np.array(SHIFTS_MM)
    _curves(axis, field, x, lambda name, n: force_errors(field, name, float(x[n]), 0.0, seed))
    axis.set(xlabel="registration error (mm)", title="space")
    axis.legend(fontsize=7)


def _against_late(axis: Axes, field: ForceField, seed: int) -> None:
    x = np.array(LATE_MS)
    _curves(axis, field, x, lambda name, n: force_errors(field, name, 0.0, x[n] / 1000, seed))
    axis.set(xlabel="phase error (ms)", title="time")


def _lost_ecg(axis: Axes, field: ForceField, seed: int) -> None:
    """Beats vary independently: the clock is off by their spread times the root of their count."""
    assert field.rr_s is not None
    rr_s = field.rr_s
    x = np.array([0.0, 1.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0])

    def errors(name: str, n: int) -> Float:
        off = np.random.default_rng([seed, 3]).standard_normal(PLACES)
        late_s = off * RR_SPREAD * rr_s * np.sqrt(x[n] / rr_s)
        return _errors(field, name, seed, np.zeros(3), late_s)

    _curves(axis, field, x, errors)
    axis.set(xlabel="seconds since the ECG was lost", title="no ECG")


def _lost_ultrasound(axis: Axes, field: ForceField, seed: int) -> None:
    """The heart goes down and comes back with each breath; the registration does not follow."""
    x = np.linspace(0, 2 * BREATH_S, 17)

    def errors(name: str, n: int) -> Float:
        down_mm = BREATH_MM * (1 - np.cos(2 * np.pi * x[n] / BREATH_S)) / 2
        # The tool seems to be where it would be if the heart had stayed: LPS, head up.
        return _errors(field, name, seed, -down_mm * UP, 0.0)

    _curves(axis, field, x, errors)
    axis.set(xlabel="seconds since the ultrasound was lost", title="no ultrasound, free breathing")


def _task(axis: Axes, x: tuple[float, ...], found: Float, free: Float, label: str) -> None:
    means, halves = np.array([interval(values[:, Sum.CONTACTS]) for values in found]).T
    axis.errorbar(x, means, yerr=halves, fmt="ko-", markersize=4, label="guided")
    mean, half = interval(free[:, Sum.CONTACTS])
    axis.axhspan(mean - half, mean + half, color="0.8", label="no force")
    axis.set(xlabel=label, ylabel="contacts a task", ylim=(0, None), title="dissection")
    axis.legend(fontsize=7)
    axis.grid(alpha=0.3)


def _shift_table(field: ForceField, seed: int) -> Table:
    """Median errors of each fixture's force for fields out of place and late."""
    head = ["fixture", "stiffness (N/m)"]
    head += [f"median force error at {shift:g} mm" for shift in (1.0, 2.0, 5.0)]
    head += [f"at {late:g} ms" for late in (25.0, 100.0)]
    rows = []
    for name, fixture in field.fixtures.items():
        cells = [np.median(force_errors(field, name, shift, 0.0, seed)) for shift in (1, 2, 5)]
        cells += [np.median(force_errors(field, name, 0.0, late, seed)) for late in (0.025, 0.1)]
        texts = [f"{cell:.3f} N" for cell in cells]
        rows.append((words(name), f"{fixture.stiffness_n_per_m:.0f}", *texts))
    return Table(head, rows)
