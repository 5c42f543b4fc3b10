"""Asking a field, in C and in Python, beside peers in one run: a table with ratios.

``python benchmarks/bench_query.py [FIELD]`` prints it, on the field of the default study where
none is given; ``make bench`` does the same. All figures but latencies are time of the processor,
so that other programs on the machine count for little; it still weighs on its caches, so compare
with the plain trilinear kernel of the same run: 30 ns on a path and 125 ns at random places and
phases is what that took on a quiet machine.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_field import bake_study
from pytest_benchmark.fixture import BenchmarkFixture
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from pipeline.field import ForceField, get_include
from pipeline.field.distance import node_axes
from pipeline.field.kernels import sample
from pipeline.field.tool import Polyline, Torus
from pipeline.geometry import Float

PEERS = Path(__file__).with_name("query_peers.c")
POINTS = 200_000
SINGLE = 200_000
SHARES = (50, 90, 99, 99.9, 99.99)
PLAIN = "plain trilinear"


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    where: str
    what: str
    value: float
    unit: str = "ns"


def in_c(path: Path) -> list[Row]:
    """What query_peers.c measures, compiled as a user would."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "query_peers"
        command = ["gcc", "-O2", f"-I{get_include()}", str(PEERS), "-o", str(program), "-lm"]
        subprocess.run(command, check=True)
        said = subprocess.run([program, path], check=True, capture_output=True, text=True).stdout
    rows = []
    for line in said.splitlines():
        where, what, value = line.split("\t")
        unit = what.split(", ")[-1].split()[0] if where == "tool" else "ns"
        rows.append(Row(where, what, float(value), unit))
    return rows


def paths(field: ForceField, rng: np.random.Generator) -> dict[str, tuple[Float, Float]]:
    """Questions as in query_peers.c: points ``(n, 3)`` mm and phases ``(n,)``."""
    low = np.array(field.grid.origin_mm) + field.grid.spacing_mm
    high = field.grid.upper_mm - field.grid.spacing_mm
    reach = 0.3 * (high - low)
    way = 0.1 * np.arange(POINTS)[:, None] / reach
    path = (low + high) / 2 + reach * np.sin(way * (0.7, 0.8, 0.9) + (0, 1, 2))
    random = rng.uniform(low, high, (POINTS, 3))
    return {
        "coherent path": (path, np.arange(POINTS) / 800 % 1),
        "random places at one phase": (random, np.array([0.37])),
        "random places and phases": (random, rng.random(POINTS)),
    }


def used_ns(ask: Callable[[], object], rounds: int = 5) -> float:
    """Median time of the processor, after a first call that may compile."""
    ask()
    spent = []
    for _ in range(rounds):
        start = time.thread_time_ns()
        ask()
        spent.append(time.thread_time_ns() - start)
    return float(np.median(spent))


def peers(field: ForceField) -> dict[str, Callable[[Float, Float], object]]:
    """SciPy's answers in 4D: the distance alone, without a gradient."""
    phases = field.phases
    volume = np.stack([field.stored_distance_mm("epicardium", k) for k in range(len(phases))])
    volume = np.concatenate([volume, volume[:1]])
    axes = [np.append(phases, phases[0] + 1), *node_axes(field.grid)[::-1]]
    linear = RegularGridInterpolator(axes, volume, bounds_error=False, fill_value=None)
    origin, spacing = np.array(field.grid.origin_mm), np.array(field.grid.spacing_mm)

    def cubic(points: Float, moments: Float) -> object:
        places = ((points - origin) / spacing).T[::-1]
        time = np.broadcast_to(moments * len(phases), len(points))
        return map_coordinates(volume, [time, *places], order=3, prefilter=False)

    def by_grid(points: Float, moments: Float) -> object:
        time = np.broadcast_to(moments, len(points))
        return linear(np.column_stack([time, points[:, ::-1]]))

    return {"map_coordinates, cubic": cubic, "RegularGridInterpolator": by_grid}


def batches(field: ForceField, questions: dict[str, tuple[Float, Float]]) -> list[Row]:
    """Nanoseconds a point of batches on one thread, and points a second on all."""
    rows = []
    law = (field._addresses["epicardium"], field._line, field._numbers)
    for where, (points, moments) in questions.items():
        found = np.empty(len(points)), np.empty((len(points), 3))
        spent = used_ns(lambda p=points, m=moments, f=found: sample(*law, p, m, *f)) / len(points)
        rows.append(Row(f"Python, {where}", "batch, one thread", spent))
        for name, ask in peers(field).items():
            some = slice(0, 20_000)
            each = moments if len(moments) == 1 else moments[some]
            spent = used_ns(lambda p=points[some], m=each, a=ask: a(p, m), 3) / 20_000
            rows.append(Row(f"Python, {where}", f"{name} (one thread, no gradient)", spent))
    points, moments = (np.tile(one, (5, 1)[: one.ndim]) for one in questions["coherent path"])
    times, spent_s = [], []
    for _ in range(9):
        start, used = time.perf_counter(), time.process_time()
        field.gradient(points, moments, "epicardium")
        times.append(time.perf_counter() - start)
        spent_s.append(time.process_time() - used)
    spent = float(np.median(spent_s)) * 1e9 / len(points)
    rows.append(Row("Python, coherent path", "batch with its checks, of all threads", spent))
    rate = len(points) / min(times) / 1e6
    rows.append(
        Row("Python, coherent path", "batch, all threads, by the clock", rate, "M points/s")
    )
    return rows


def singles(field: ForceField, points: Float, moments: Float) -> list[Row]:
    """Microseconds of one call, by the clock on the wall."""
    asked = [(*map(float, p), float(t)) for p, t in zip(points, moments, strict=True)]
    ways: dict[str, Callable[..., object]] = {
        "force_at": field.force_at,
        "distance_at": field.distance_at,
        "a call that does nothing": lambda x, y, z, phase: None,
    }
    clock, rows = time.perf_counter_ns, []
    for name, ask in ways.items():
        ask(*asked[0])
        spent = np.empty(SINGLE)
        for n in range(SINGLE):
            one = asked[n % len(asked)]
            start = clock()
            ask(*one)
            spent[n] = clock() - start
        for share in SHARES:
            value = float(np.percentile(spent, share)) / 1e3
            rows.append(Row(f"Python, one call, {share} %", name, value, "us"))
    for name, ask in peers(field).items():
        spent = used_ns(lambda ask=ask: ask(points[:1], moments[:1]), 200) / 1e3
        rows.append(Row("Python, one call, 50 %", name, spent, "us"))
    return rows


def tools(field: ForceField) -> list[Row]:
    """Whole tools, from Python."""
    turn = 2 * np.pi * np.linspace(0, 1, 1001)
    line = np.column_stack([20 * np.cos(1.5 * turn), 20 * np.sin(turn), 60 * turn / 6.2832 - 30])
    shapes = {
        "torus of 2 cm": Torus(shape="torus", radius_mm=10.0),
        "line of 1000 pieces": Polyline(shape="polyline", points_mm=[tuple(one) for one in line]),
    }
    pose = np.eye(4)
    pose[:3, 3] = (np.array(field.grid.origin_mm) + field.grid.upper_mm) / 2
    while field.distance_at(*pose[:3, 3], 0.3) < 0:
        pose[0, 3] += 0.1
    rows = []
    for name, shape in shapes.items():
        spent = used_ns(lambda shape=shape: field.tool_force(shape, pose, 0.3), 50) / 1e3
        rows.append(Row("tool, Python", f"{name}, us", spent, "us"))
    return rows


def measure(path: Path) -> list[Row]:
    """All rows."""
    field = ForceField.open(path)
    questions = paths(field, np.random.default_rng(0))
    rows = in_c(path) + batches(field, questions)
    rows += singles(field, *questions["coherent path"])
    return rows + tools(field)


def table(rows: list[Row]) -> str:
    """Rows as text, with ratios to the plain trilinear kernel on the same questions."""
    plain = {row.where.removeprefix("C, "): row.value for row in rows if row.what == PLAIN}
    lines = [f"{'where':50s} {'what':48s} {'':>11s} {'':10s} trilinear = 1"]
    for row in rows:
        where = row.where.removeprefix("C, ").removeprefix("Python, ")
        ratio = f"{row.value / plain[where]:.2f}" if where in plain and row.unit == "ns" else ""
        lines.append(f"{row.where:50s} {row.what:48s} {row.value:11.2f} {row.unit:10s} {ratio}")
    return "\n".join(lines)


def test_query(benchmark: BenchmarkFixture, tmp_path: Path, capsys: object) -> None:
    """The default study's field, all figures once."""
    path = tmp_path / "field.zarr"
    bake_study(path, 25)
    rows = benchmark.pedantic(measure, args=(path,), rounds=1)
    with capsys.disabled():  # type: ignore[attr-defined]
        print("\n" + table(rows))
    assert all(np.isfinite(row.value) for row in rows)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        chosen = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(place) / "field.zarr"
        if not chosen.exists():
            bake_study(chosen, 25)
        print(table(measure(chosen)))
