"""The simulated dissection: pellets close to a beating heart, removed through a keyhole.

Ten pellets lie a few millimetres outside the heart and move with it. A rod through a fixed pivot
is to work on each until it is gone, without touching the heart; a haptic device renders a fixture
of the baked field, or nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.special import gammainc, gammaln
from scipy.stats import t as student

from pipeline.errors import InputError
from pipeline.evaluation.dissection_values import ENERGY_STEP_MM, SUMS, Guide, Shape, Task
from pipeline.evaluation.operators import handle_of, operator
from pipeline.evaluation.places import on_surface, settle
from pipeline.field.files import map_phase, read_metadata, readable_in_fours
from pipeline.field.fixture import DEVICES, DeviceName, Fixture
from pipeline.field.reader import ForceField
from pipeline.field.spline import grid_numbers, timeline
from pipeline.field.threads import processors
from pipeline.field.tool import Needle, Polyline, Torus
from pipeline.geometry import Float
from pipeline.progress import Progress

ToolName = Literal["point", "needle", "torus"]

PELLETS = 10
HEIGHTS_MM = (3.0, 5.0)
LIFT_MM = 4.0
"""The fixture acts from a surface this far outside the heart: where the pellets are."""

WORKSPACE_MM = 3.0
WIDTH_MM = 4.0
DWELL_S = 0.5
WITHDRAW_MM = 10.0
MOST_S = 600.0
TICK_S = 0.001

PORT = np.array([0.8, -0.55, 0.2])
"""From the heart to the port: left, front and a little up (LPS), as between the ribs."""

PATCH_MM = 25.0
APART_MM = 6.0
PIVOT_MM = 90.0
ROD_MM = 330.0
"""Shaft of a laparoscopic instrument (from memory)."""

VIEW_DEG = 35.0
"""Between the monitor's view axis and the mean normal of the pellets' places."""

MOMENTS = 100
TOOLS: dict[ToolName, Any] = {
    "point": Polyline(shape="polyline", points_mm=((0.0, 0.0, 0.0),)),
    "needle": Needle(shape="needle", length_mm=30.0),
    "torus": Torus(shape="torus", radius_mm=10.0),
}
"""Torque is about the tip, from where the rod carries it to the hand with the force."""
TOUCHING = {"needle": 7, "torus": 12}
"""Points of a tool that are watched for contact; of a point itself."""
BOUND_N = 0.1


@dataclass(frozen=True, slots=True)
class Condition:
    """One way to do the task."""

    tool: ToolName
    beating: bool
    fixture: Fixture | None = None
    """None for no force."""

    shift_mm: float = 0.0
    """How far a wrong registration moves the fixture, each operator in a direction of its own."""

    late_s: float = 0.0
    """By how much a wrong clock lets the fixture lag behind the heart."""

    scaled: Mapping[str, float] = field(default_factory=dict)
    """Factors on parameters of the operators."""

    device: DeviceName = "omega7"
    """What is in the hand where there is no fixture to say so."""

    view_deg: float = VIEW_DEG
    """Between the monitor's view axis and the heart's normal."""

    @property
    def handle(self) -> str:
        """The device in the hand."""
        return self.fixture.device.name if self.fixture else self.device


@dataclass(frozen=True, slots=True)
class Trial:
    """What one operator came to."""

    sums: Float
    """``(SUMS,)``."""

    trace: Float
    """``(n, 9)``: see ``dissection_loop.dissect``."""


class Room:
    """The place of work about one baked field, and the field's kernels' arguments for it.

    Parameters
    ----------
    path
        The ``field.zarr`` folder, of a field that knows its ``rr_s``.
    structure
        The surface that must not be touched.
    seed
        Of the pellets' places.

    Raises
    ------
    InputError
        When the field has no such surface, or too little of it is free to the outside.
    """

    def __init__(self, path: Path, structure: str, seed: int) -> None:
        self.field = ForceField.open(path)
        self.structure = structure
        metadata = read_metadata(path)
        if structure not in metadata.structures:
            raise InputError(f"{path}: has no {structure}; it has {', '.join(metadata.structures)}")
        part = path / metadata.structures[structure].spline
        grid = self.field.grid
        # The spline's weights sum to one: coefficients less the lift are those of the surface that
        # lies by the lift farther out.
        self._lifted = [
            readable_in_fours(map_phase(part, k, grid) - np.float32(LIFT_MM))
            for k in range(len(metadata.phases))
        ]
        self._line = timeline(self.field.phases)
        self._numbers = grid_numbers(grid)
        self._addresses = np.array([one.ctypes.data for one in self._lifted], dtype=np.uintp)
        feet_mm, out = _patch(self.field, structure, seed)
        self.out = out.mean(axis=0) / np.linalg.norm(out.mean(axis=0))
        heights = np.random.default_rng([seed, 1]).uniform(*HEIGHTS_MM, size=PELLETS)
        self.pellets_mm = _beating(self.field, structure, feet_mm, heights)
        self.pivot_mm = self.pellets_mm.mean(axis=(0, 1)) + PIVOT_MM * self.out

    def law(self, fixture: Fixture | None) -> tuple[Any, ...]:
        """The first seven arguments of ``kernels.force_at``, from the lifted surface."""
        fixture = fixture or guidance(self.structure, "omega7")
        return (
            self._addresses, self._line, self._numbers,
            fixture.side_code, fixture.resolved_delta_mm, fixture.m, fixture.f_max_n,
        )  # fmt: skip

    def task(self, condition: Condition, tick_s: float = TICK_S) -> Task:
        """The task's numbers."""
        assert self.field.rr_s is not None
        start_mm = self.pellets_mm.mean(axis=(0, 1)) + 20.0 * self.out
        view = _view(self.out, condition.view_deg)
        return Task(
            self.pellets_mm, start_mm, self.pivot_mm, ROD_MM, view, WIDTH_MM, DWELL_S,
            LIFT_MM, WORKSPACE_MM, WITHDRAW_MM, self.field.rr_s, 0.0, condition.beating, MOST_S,
            tick_s,
        )  # fmt: skip


def guidance(structure: str, device: DeviceName) -> Fixture:
    """Keep the tool in the shell of the pellets: as strong as each device allows with room left."""
    if device == "touch":
        return Fixture(structure=structure, kind="guidance", delta_mm=3.1, m=1, f_max_n=2.0)
    return Fixture(
        structure=structure, kind="guidance", gamma_mm=1.5, m=2, f_max_n=6.0, device=DEVICES[device]
    )


def keep_out(structure: str, device: DeviceName) -> Fixture:
    """Keep the tool from coming nearer to the heart than the pellets."""
    if device == "touch":
        return Fixture(
            structure=structure, kind="forbidden_region", side="inside", delta_mm=3.1, f_max_n=2.0
        )
    return Fixture(
        structure=structure, kind="forbidden_region", side="inside", gamma_mm=1.0, m=2, f_max_n=8.0,
        device=DEVICES[device],
    )  # fmt: skip


def stored_energy_mj(fixture: Fixture) -> Float:
    """Energy at a distance or depth of n ``ENERGY_STEP_MM``: ``f_max`` times the integral of f.

    With a = 1/(2m), the integral of exp(-(s^2 / (2 d^2))^m) from 0 to q is
    d sqrt(2) a gamma(a) P(a, (q^2 / (2 d^2))^m), P the regularised lower incomplete gamma function.
    """
    q_mm = np.arange(0.0, 60.0, ENERGY_STEP_MM)
    delta, a = fixture.resolved_delta_mm, 1 / (2 * fixture.m)
    whole = delta * np.sqrt(2) * a * np.exp(gammaln(a))
    free = whole * gammainc(a, (q_mm**2 / (2 * delta**2)) ** fixture.m)
    return np.asarray(fixture.f_max_n * (q_mm - free))


def shape_of(tool: ToolName) -> Shape:
    """A tool's lines, and the points of it that are watched for contact."""
    lines = TOOLS[tool].lines
    if tool == "needle":
        up_mm = np.linspace(0, TOOLS[tool].length_mm, TOUCHING[tool])
        touching = np.column_stack([0 * up_mm, 0 * up_mm, up_mm])
    elif tool == "torus":
        angles = 2 * np.pi * np.arange(TOUCHING[tool]) / TOUCHING[tool]
        radius = TOOLS[tool].radius_mm
        touching = radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    else:
        touching = np.zeros((1, 3))
    handle_mm = tuple(float(value) for value in TOOLS[tool].handle_mm)
    return Shape(lines.points_mm, lines.starts, handle_mm, tool != "point", touching, BOUND_N)


def _patch(field: ForceField, structure: str, seed: int) -> tuple[Float, Float]:
    """Ten places near one another on the side of the port, and their normals."""
    feet, out = on_surface(field, structure, 60, seed, PORT)
    rng = np.random.default_rng(seed)
    for centre in rng.permutation(len(feet)):
        near = np.flatnonzero(np.linalg.norm(feet - feet[centre], axis=1) < PATCH_MM)
        chosen: list[int] = []
        for one in near:
            if all(np.linalg.norm(feet[one] - feet[two]) >= APART_MM for two in chosen):
                chosen.append(int(one))
        if len(chosen) >= PELLETS:
            order = _nearest_first(feet[chosen[:PELLETS]])
            kept = np.array(chosen[:PELLETS])[order]
            return feet[kept], out[kept]
    raise InputError(
        f"{structure}: no room for {PELLETS} pellets {APART_MM:g} mm apart on its left front side"
    )


def _nearest_first(points_mm: Float) -> list[int]:
    """An order in which each is near the one before."""
    left = list(range(1, len(points_mm)))
    order = [0]
    while left:
        away = np.linalg.norm(points_mm[left] - points_mm[order[-1]], axis=1)
        order.append(left.pop(int(away.argmin())))
    return order


def _beating(field: ForceField, structure: str, feet_mm: Float, heights_mm: Float) -> Float:
    """Pellets ``(pellet, moment, 3)``, each at its height above the moving surface."""
    moments = np.arange(MOMENTS) / MOMENTS
    found = np.empty((len(feet_mm), MOMENTS, 3))
    for n, (foot, height) in enumerate(zip(feet_mm, heights_mm, strict=True)):
        at = np.repeat(foot[None], MOMENTS, axis=0)
        found[n] = settle(field, structure, at, moments, float(height))
    return found


def _view(out: Float, turned_deg: float) -> Float:
    """Into the monitor: the inward normal, turned about the axis nearest the head."""
    side = np.cross(out, (0.0, 0.0, 1.0))
    side /= np.linalg.norm(side)
    angle = np.radians(turned_deg)
    return np.asarray(-np.cos(angle) * out + np.sin(angle) * side)


def run_trial(
    room: Room, condition: Condition, seed: int, number: int, trace_rows: int = 0,
    tick_s: float = TICK_S,
) -> Trial:  # fmt: skip
    """Let operator ``number`` of a population do the task once."""
    from pipeline.evaluation.dissection_loop import dissect

    person, waves = operator(seed, number, **condition.scaled)
    rng = np.random.default_rng([seed, number, 1])
    draws = rng.standard_normal(4096)
    way = rng.standard_normal(3)
    assert room.field.rr_s is not None
    guide = Guide(
        room.law(condition.fixture),
        stored_energy_mj(condition.fixture or guidance(room.structure, "omega7")),
        condition.fixture is not None,
        condition.shift_mm * way / np.linalg.norm(way),
        -condition.late_s / room.field.rr_s,
    )
    trace = np.zeros((trace_rows, 9))
    sums = dissect(
        room.task(condition, tick_s), guide, shape_of(condition.tool), person,
        handle_of(condition.handle), waves, draws, trace,
    )  # fmt: skip
    return Trial(sums, trace)


def run_all(
    room: Room, conditions: Sequence[Condition], seed: int, operators: int,
    progress: Progress | None = None,
) -> Float:  # fmt: skip
    """All operators in all conditions.

    Returns
    -------
    ``(condition, operator, SUMS)``; the same numbers however many processors there are.
    """
    jobs = [(c, n) for c in range(len(conditions)) for n in range(operators)]
    found = np.empty((len(conditions), operators, SUMS))

    def one(job: tuple[int, int]) -> None:
        found[job] = run_trial(room, conditions[job[0]], seed, job[1]).sums

    # The first of all compiles, so that threads do not.
    one(jobs[0])
    with ThreadPoolExecutor(max_workers=processors()) as pool:
        for done, _ in enumerate(pool.map(one, jobs[1:]), start=2):
            if progress:
                progress(done, len(jobs))
    return found


def interval(values: Float) -> tuple[float, float]:
    """Mean of ``(operator,)``, and half of its 95 % interval by Student's t."""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean()), float(half)
