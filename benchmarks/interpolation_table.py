"""What each way to interpolate a field would give: the table of docs/field.md, measured anew.

``python benchmarks/interpolation_table.py [--spacing 1 2] [--structure NAME] [--seed N]
[--pathology NAME] [--rate BPM] [--fit]``

A beating surface of the phantom is baked at its phases; every way then answers at vertices of the
true surface midway between phases, and in the band about it, where VTK's closest point on the true
mesh is the truth. All ways run through the same plain kernel, so their times compare with each
other but not with beatfield.h, which does the one chosen in a third of the time.

``--fit``: the chosen way alone, before and after its fit to the surface, asked at all vertices and
anywhere on triangles. The way to the zero is what lies between a point of the true surface and the
field's zero, along the field's gradient: where that is short, as on a sharp rim, a small distance
is a longer way.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import dataclass

import numpy as np
import pyvista
from numba import njit
from scipy.ndimage import spline_filter1d

from data_synth.population import draw_heart
from pipeline.exact import points_about
from pipeline.field.distance import distance_of_closed
from pipeline.field.fixture import BakeSettings
from pipeline.field.spline import space_coefficients
from pipeline.field.surface_fit import fit_to_surface
from pipeline.geometry import Float, Grid, MovingSurface, Surface

LINEAR, CATMULL_ROM, QUADRATIC, CUBIC = range(4)
NAMES = ("linear", "Catmull-Rom", "quadratic B-spline", "cubic B-spline")
TAPS = (2, 4, 3, 4)
CHOSEN = (QUADRATIC, QUADRATIC)
BAND_MM = 12.0
F_MAX_N = 3.0


@njit(cache=True)
def _weigh(kind, x, w, s):  # type: ignore[no-untyped-def]
    """Weights and slopes of a place between nodes; the first node's number."""
    if kind == QUADRATIC:
        first = int(np.floor(x + 0.5)) - 1
        t = x - first - 1
        w[0], w[1], w[2] = (0.5 - t) ** 2 / 2, 0.75 - t * t, (0.5 + t) ** 2 / 2
        s[0], s[1], s[2] = t - 0.5, -2 * t, t + 0.5
        return first
    first = int(np.floor(x))
    t = x - first
    u = 1 - t
    if kind == LINEAR:
        w[0], w[1], s[0], s[1] = u, t, -1.0, 1.0
        return first
    if kind == CATMULL_ROM:
        w[0], w[3] = -t * u * u / 2, -u * t * t / 2
        w[1], w[2] = ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2
        s[0], s[3] = ((4 - 3 * t) * t - 1) / 2, (3 * t - 2) * t / 2
        s[1], s[2] = (9 * t - 10) * t / 2, ((8 - 9 * t) * t + 1) / 2
    else:
        w[0], w[3] = u * u * u / 6, t * t * t / 6
        w[1], w[2] = (3 * t * t * t - 6 * t * t + 4) / 6, (3 * u * u * u - 6 * u * u + 4) / 6
        s[0], s[3], s[1], s[2] = -u * u / 2, t * t / 2, (3 * t - 4) * t / 2, (4 - 3 * u) * u / 2
    return first - 1


@njit(cache=True)
def _answer(stored, low, step, places, moments, ways, taps, found):  # type: ignore[no-untyped-def]
    """Distance, gradient (3) and rate a cycle of ``(n, 3)`` points into ``(n, 5)``."""
    phases = stored.shape[0]
    w, s, first = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros(4, np.int64)
    for n in range(len(places)):
        for axis in range(3):
            x = (places[n, axis] - low[axis]) / step
            first[axis] = _weigh(ways[0], x, w[axis], s[axis])
        first[3] = _weigh(ways[1], moments[n] * phases, w[3], s[3])
        v = gx = gy = gz = r = 0.0
        for t in range(taps[1]):
            box = stored[(first[3] + t) % phases]
            vt = xt = yt = zt = 0.0
            for c in range(taps[0]):
                for b in range(taps[0]):
                    line = slope = 0.0
                    for a in range(taps[0]):
                        node = box[first[2] + c, first[1] + b, first[0] + a]
                        line += w[0, a] * node
                        slope += s[0, a] * node
                    vt += w[2, c] * w[1, b] * line
                    xt += w[2, c] * w[1, b] * slope
                    yt += w[2, c] * s[1, b] * line
                    zt += s[2, c] * w[1, b] * line
            v, gx, gy, gz = (
                v + w[3, t] * vt,
                gx + w[3, t] * xt,
                gy + w[3, t] * yt,
                gz + w[3, t] * zt,
            )
            r += s[3, t] * vt
        found[n] = v, gx / step, gy / step, gz / step, r * phases


@dataclass(frozen=True)
class Truth:
    """Where to ask, when, and what is true there."""

    points_mm: Float
    moments: Float
    distance_mm: Float
    gradient: Float


def prepared(distance_mm: Float, space: int, in_time: int) -> Float:
    """What a way stores instead of ``(phase, z, y, x)`` distances; float32, as in a store."""
    values = distance_mm
    if space == QUADRATIC:
        values = np.stack([space_coefficients(one).astype(np.float32) for one in values])
    elif space == CUBIC:
        for axis in (1, 2, 3):
            values = spline_filter1d(values, 3, axis=axis, mode="mirror", output=np.float32)
    if in_time in (QUADRATIC, CUBIC):
        order = 2 if in_time == QUADRATIC else 3
        values = spline_filter1d(values, order, axis=0, mode="grid-wrap", output=np.float64)
    return np.ascontiguousarray(values, dtype=np.float32)


def ask(stored: Float, grid: Grid, way: tuple[int, int], points: Float, moments: Float) -> Float:
    """``(n, 5)``: distance, gradient, rate a cycle."""
    found = np.empty((len(points), 5))
    taps = np.array([TAPS[way[0]], TAPS[way[1]]])
    low = np.array(grid.origin_mm)
    _answer(stored, low, grid.spacing_mm[0], points, moments, np.array(way), taps, found)
    return found


def truth_at(
    meshes: list[Surface], moments: Float, rng: np.random.Generator, anywhere: int
) -> tuple[Truth, Truth]:
    """On the surface, and in the band about it, at moments that nothing was stored for; on the
    surface at some vertices, or at all of them and at so many places a triangle."""
    on, near = [], []
    for mesh, moment in zip(meshes, moments, strict=True):
        vertices = mesh.vertices_mm
        chosen = vertices[rng.choice(len(vertices), min(1500, len(vertices)), replace=False)]
        asked = chosen
        if anywhere:
            asked = points_about(mesh, rng, anywhere * len(mesh.triangles), 0.0)
            asked = np.concatenate([vertices, asked])
        on.append((asked, np.full(len(asked), moment)))
        points = chosen[:400] + rng.uniform(-1, 1, (400, 3)) * BAND_MM / np.sqrt(3)
        near.append((points, np.full(400, moment), *_closest(mesh, points)))
    places, times = (np.concatenate(part) for part in zip(*on, strict=True))
    nothing = np.zeros((len(places), 3))
    return Truth(places, times, np.zeros(len(places)), nothing), Truth(
        *(np.concatenate(part) for part in zip(*near, strict=True))
    )


def _closest(mesh: Surface, points: Float) -> tuple[Float, Float]:
    """Signed distance by VTK and its gradient, ``(n,)`` and ``(n, 3)``."""
    solid = pyvista.PolyData.from_regular_faces(mesh.vertices_mm, mesh.triangles)
    distance = pyvista.PolyData(points).compute_implicit_distance(solid)["implicit_distance"]
    _, foot = solid.find_closest_cell(points, return_closest_point=True)
    away = np.asarray(points - foot) * np.sign(distance)[:, None]
    return np.asarray(distance, float), away / np.linalg.norm(away, axis=1, keepdims=True)


def steps(stored: Float, grid: Grid, way: tuple[int, int], near: Truth) -> tuple[float, float]:
    """Largest step of a force of ``F_MAX_N`` along the gradient where a knot in space is crossed
    (N), and of the distance's rate where a knot in time is (mm a cycle)."""
    low, step, phases = np.array(grid.origin_mm), grid.spacing_mm[0], len(stored)
    # Knots lie at nodes, those of the quadratic spline halfway.
    shift = [0.5 if one == QUADRATIC else 0.0 for one in way]
    jump = 0.0
    for axis in range(3):
        sides = []
        for side in (-1e-7, 1e-7):
            place = near.points_mm.copy()
            whole = np.floor((place[:, axis] - low[axis]) / step) + shift[0]
            place[:, axis] = low[axis] + step * (whole + side)
            sides.append(ask(stored, grid, way, place, near.moments)[:, 1:4])
        jump = max(jump, float(np.linalg.norm(sides[1] - sides[0], axis=1).max()))
    knots = (np.floor(near.moments * phases) + shift[1]) / phases
    rates = [ask(stored, grid, way, near.points_mm, knots + side)[:, 4] for side in (-1e-7, 1e-7)]
    return F_MAX_N * jump, float(np.abs(rates[1] - rates[0]).max())


def way_to_zero(stored: Float, grid: Grid, way: tuple[int, int], on: Truth) -> Float:
    """How far from points of the true surface the field's zero is, mm: Newton's steps to it."""
    places = on.points_mm.copy()
    for _ in range(6):
        found = ask(stored, grid, way, places, on.moments)
        slope = found[:, 1:4]
        steep = np.maximum(np.square(slope).sum(axis=1), 0.05)
        places -= (found[:, 0] / steep)[:, None] * slope
    return np.asarray(np.linalg.norm(places - on.points_mm, axis=1))


def bake(surfaces: list[Surface], spacing_mm: float) -> tuple[Grid, Float]:
    """Exact distances of all phases, ``(phase, z, y, x)``."""
    every = np.concatenate([one.vertices_mm for one in surfaces])
    low, high = every.min(axis=0) - BAND_MM - 3, every.max(axis=0) + BAND_MM + 3
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / spacing_mm) + 1)
    grid = Grid((nz, ny, nx), tuple(low.tolist()), (spacing_mm,) * 3)
    return grid, np.stack([distance_of_closed(one, grid) for one in surfaces])


def nanoseconds(stored: Float, grid: Grid, way: tuple[int, int]) -> float:
    """Time of the processor for one question on a path of 0.1 mm steps."""
    count, middle = 20_000, (np.array(grid.origin_mm) + grid.upper_mm) / 2
    path = middle + 15 * np.sin(0.1 * np.arange(count)[:, None] / 15 * (0.7, 0.8, 0.9) + (0, 1, 2))
    moments, spent = np.arange(count) / 800 % 1, []
    for _ in range(7):
        start = time.thread_time_ns()
        ask(stored, grid, way, path, moments)
        spent.append((time.thread_time_ns() - start) / count)
    return float(np.median(spent))


def judged(stored: Float, grid: Grid, way: tuple[int, int], on: Truth, near: Truth) -> str:
    """The columns of accuracy."""
    here = np.abs(ask(stored, grid, way, on.points_mm, on.moments)[:, 0])
    band = ask(stored, grid, way, near.points_mm, near.moments)
    off = np.abs(band[:, 0] - near.distance_mm)
    slope = np.linalg.norm(band[:, 1:4] - near.gradient, axis=1)
    return (
        f"{here.max():.3f} / {np.percentile(here, 99):.3f} / {np.mean(here > 0.1):.1e} | "
        f"{np.percentile(off, 99):.3f} | {np.median(slope):.3f} / {np.percentile(slope, 95):.3f}"
    )


def rows(surfaces: list[Surface], between: list[Surface], spacing_mm: float, seed: int) -> None:
    """Print the table of one spacing."""
    grid, distance_mm = bake(surfaces, spacing_mm)
    rng = np.random.default_rng(seed)
    on, near = truth_at(between, midway(surfaces, between), rng, anywhere=0)
    megabytes, count = distance_mm.size * 4e-6, len(surfaces)
    print(f"\n{spacing_mm:g} mm, {grid.shape[::-1]} nodes x {count} phases: {megabytes:.1f} MB\n")
    print(
        "| space | time | on the surface, max / 99 % (mm) / share beyond 0.1 mm | band, 99 % (mm) "
        "| gradient, median / 95 % | step of force (N) | step of rate (mm/cycle) | ns |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for way in itertools.product(range(4), range(4)):
        if way[0] != CHOSEN[0] and way[1] != CHOSEN[1]:
            continue
        stored = prepared(distance_mm, *way)
        jump, rate = steps(stored, grid, way, near)
        mark = "**" if way == CHOSEN else ""
        print(
            f"| {mark}{NAMES[way[0]]}{mark} | {mark}{NAMES[way[1]]}{mark} | "
            f"{judged(stored, grid, way, on, near)} | {jump:.4f} | {rate:.3f} | "
            f"{nanoseconds(stored, grid, way):.0f} |",
            flush=True,
        )


def fit_rows(surfaces: list[Surface], between: list[Surface], spacing_mm: float, seed: int) -> None:
    """Print what the fit to the surface makes of the chosen way at one spacing."""
    grid, distance_mm = bake(surfaces, spacing_mm)
    rng = np.random.default_rng(seed)
    on, near = truth_at(between, midway(surfaces, between), rng, anywhere=5)
    print(f"\n{spacing_mm:g} mm\n")
    print(
        "| rounds | on the surface, max / 99 % (mm) / share beyond 0.1 mm | band, 99 % (mm) "
        "| gradient, median / 95 % | way to the zero, max (mm) / share beyond 0.1 mm | core-s |"
    )
    print("|---|---|---|---|---|---|")
    for rounds in (0, BakeSettings().fit_rounds):
        stored = prepared(distance_mm, *CHOSEN)
        start = time.process_time()
        fit_to_surface(list(stored), *_moving(surfaces, grid), rounds)
        spent = time.process_time() - start
        there = way_to_zero(stored, grid, CHOSEN, on)
        print(
            f"| {rounds} | {judged(stored, grid, CHOSEN, on, near)} | "
            f"{there.max():.3f} / {np.mean(there > 0.1):.1e} | {spent:.1f} |",
            flush=True,
        )


def midway(surfaces: list[Surface], between: list[Surface]) -> Float:
    """Moments of the surfaces between the phases."""
    count = len(surfaces)
    return (np.arange(len(between)) * (count // len(between)) + 0.5) / count


def _moving(surfaces: list[Surface], grid: Grid) -> tuple[Float, Grid, MovingSurface]:
    phases = np.arange(len(surfaces)) / len(surfaces)
    vertices_mm = np.stack([one.vertices_mm for one in surfaces])
    return phases, grid, MovingSurface(vertices_mm, surfaces[0].triangles, phases)


def main() -> None:
    """Read the command and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--spacing", type=float, nargs="+", default=[0.75, 1.0, 1.5, 2.0])
    parser.add_argument("--structure", default="epicardium")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--pathology", default="healthy")
    parser.add_argument("--rate", type=float, default=70.0, help="beats a minute")
    parser.add_argument("--phases", type=int, default=25)
    parser.add_argument("--fit", action="store_true", help="the chosen way alone")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    heart = draw_heart(rng, pathology=chosen.pathology, heart_rate_bpm=chosen.rate)
    every = np.arange(chosen.phases) / chosen.phases
    name = chosen.structure
    surfaces, between = (
        [Surface(*heart.surfaces(float(phase), [name])[name]) for phase in phases]
        for phases in (every, every + 0.5 / chosen.phases)
    )
    for spacing_mm in chosen.spacing:
        (fit_rows if chosen.fit else rows)(surfaces, between, spacing_mm, chosen.seed)


if __name__ == "__main__":
    main()
