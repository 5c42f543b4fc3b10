"""Asking a field, in C and in Python, beside peers in one run: a table with ratios.

``python benchmarks/bench_query.py [FIELD]`` prints it, on the field of the default study where
none is given; ``make bench`` does the same. All figures but latencies are time of the processor,
so that other programs on the machine count for little; it still weighs on its caches, so compare
with the plain trilinear kernel of the same run: 30 ns on a path and 125 ns at random places and
phases is what that took on a quiet machine.
"""

from __future__ import annotations

import argparse
import subprocess
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

from pipeline.field import ForceField, batches, get_include, kernels
from pipeline.field.threads import processors
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
    axes = [np.append(phases, phases[0] + 1), *field.grid.axes_mm[::-1]]
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


def in_batches(field: ForceField, questions: dict[str, tuple[Float, Float]]) -> list[Row]:
    """Nanoseconds a point of batches on one thread, and of the same by the reader on all."""
    rows = []
    law = (field._addresses["epicardium"], field._line, field._numbers)
    for where, (points, moments) in questions.items():
        found = np.empty(len(points)), np.empty((len(points), 3))
        ways = {
            "batch, one thread, as they come": kernels.sample,
            "batch, one thread": batches.sample,
        }
        for what, ask in ways.items():
            spent = used_ns(lambda p=points, m=moments, f=found, a=ask: a(*law, p, m, *f))
            rows.append(Row(f"Python, {where}", what, spent / len(points)))
        for name, peer in peers(field).items():
            some = slice(0, 20_000)
            each = moments if len(moments) == 1 else moments[some]
            spent = used_ns(lambda p=points[some], m=each, a=peer: a(p, m), 3) / 20_000
            rows.append(Row(f"Python, {where}", f"{name} (one thread, no gradient)", spent))
        rows += by_the_reader(field, where, np.tile(points, (5, 1)), moments)
    return rows


def by_the_reader(field: ForceField, where: str, points: Float, moments: Float) -> list[Row]:
    """With its checks on all processors: what they spend, and the rate that this makes."""
    moments = moments if len(moments) == 1 else np.tile(moments, 5)
    field.gradient(points, moments, "epicardium")
    seconds, spent_s = [], []
    for _ in range(9):
        start, used = time.perf_counter(), time.process_time()
        field.gradient(points, moments, "epicardium")
        seconds.append(time.perf_counter() - start)
        spent_s.append(time.process_time() - used)
    spent, count = min(spent_s) * 1e9 / len(points), processors()
    where = f"Python, {where}"
    return [
        Row(where, "batch with its checks, time of all processors", spent),
        Row(where, f"the same: points on {count} free processors", 1e3 * count / spent, "M/s"),
        Row(where, "the same, by the clock", len(points) / min(seconds) / 1e6, "M/s"),
    ]


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
    rows = in_c(path) + in_batches(field, questions)
    rows += singles(field, *questions["coherent path"])
    return rows + tools(field)


WANTED = {
    ("C, coherent path", "batch"): "60",
    ("C, coherent path", "one by one"): "60",
    ("C, random places and phases", "batch of 1,000,000 with scratch"): "120",
    ("Python, one call, 50 %", "force_at"): "2",
    ("Python, coherent path", "the same: points on 2 free processors"): "30",
    ("tool", "torus of 2 cm, us (median of 60 phases)"): "20",
    ("tool", "line of 1000 pieces, Hz"): "10000",
}
"""Bounds that the readers are held to, where the plain kernel takes 30 and 125 ns."""


def table(rows: list[Row]) -> str:
    """Rows as text, with bounds and ratios to the plain trilinear kernel on the same questions."""
    plain = {row.where.removeprefix("C, "): row.value for row in rows if row.what == PLAIN}
    head = f"{'where':47s} {'what':48s} {'':>10s} {'':4s} {'bound':>6s} trilinear = 1"
    lines = [head]
    for row in rows:
        where = row.where.removeprefix("C, ").removeprefix("Python, ")
        ratio = f"{row.value / plain[where]:.2f}" if where in plain and row.unit == "ns" else ""
        bound = WANTED.get((row.where, row.what), "")
        lines.append(
            f"{row.where:47s} {row.what:48s} {row.value:10.2f} {row.unit:4s} {bound:>6s} {ratio}"
        )
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
    parser = argparse.ArgumentParser(description="Time questions to a field beside peers.")
    parser.add_argument("field", type=Path, nargs="?", help="default: one of the default study")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        chosen = options.field or Path(place) / "field.zarr"
        if options.field is None:
            bake_study(chosen, 25)
        print(table(measure(chosen)))
