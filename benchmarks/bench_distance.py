"""Closed mesh to signed grid: seconds and errors beside exact libraries, and the curve of cost.

    python benchmarks/bench_distance.py                    # the table, 2-3 minutes on 2 cores
    python benchmarks/bench_distance.py --triangles 100000 --nodes 256
    python benchmarks/bench_distance.py --curve            # ours alone, a minute
    python benchmarks/bench_distance.py --mesh cup.npz     # arrays v (n, 3) and f (m, 3)

Peers are libigl, Open3D and VTK; one that cannot be imported is left out. They are no
dependencies of this project: install them into an environment of their own that has numba, SciPy
and scikit-image too (``pip install libigl open3d vtk numba scipy scikit-image``), and run this
file with its Python. Everybody uses all processors that it would use by itself, and pays for its
own tree, signs and query points; compilation, imports and meshes are outside. All take turns,
equally often, and the least time of each counts. ``core-s`` is processor time of
all threads: where others use the machine, its ratios are the ones to trust. ``error`` is the
largest difference to the first peer's distance, within 15 mm and beyond; ``signs`` counts nodes
with another sign.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

sys.path.insert(0, str(Path(__file__).parents[1]))

from pipeline.field.distance import distance_of_closed
from pipeline.field.threads import processors
from pipeline.geometry import Float, Float32, Grid, Surface

CUBE_MM = 128.0
BAND_MM = 15.0
# VTK would need a minute or more: it is asked for every 61st node, and the time of that multiplied.
# Of a number that divides the nodes of a row all would lie in one plane or two, far from the mesh.
VTK_SHARE = 61


def cup(x: Float, y: Float, z: Float) -> Float:
    """A thick-walled bumpy cup with lobes, about 100 mm across: negative inside, no distance."""

    def ellipsoid(at: tuple[float, ...], radii: tuple[float, ...]) -> Float:
        places = zip((x, y, z), at, radii, strict=True)
        scaled = np.sqrt(sum(((p - c) / r) ** 2 for p, c, r in places))
        return (scaled - 1) * min(radii)

    def blend(p: Float, q: Float, width: float) -> Float:
        t = np.clip(0.5 + 0.5 * (q - p) / width, 0, 1)
        return q + (p - q) * t - width * t * (1 - t)

    body = ellipsoid((0, 0, -4), (36, 33, 46))
    for at, radii in (
        ((26, 6, 2), (22, 26, 34)),
        ((14, -14, 32), (20, 19, 18)),
        ((-16, 12, 34), (19, 18, 16)),
    ):
        body = blend(body, ellipsoid(at, radii), 6.0)
    body = -blend(-body, ellipsoid((-2, 0, 14), (21, 19, 44)), 4.0)
    coarse = np.sin(0.31 * x + 0.4) * np.sin(0.27 * y) * np.sin(0.29 * z + 1)
    fine = np.sin(0.9 * x) * np.sin(0.8 * y + 0.3) * np.sin(0.85 * z)
    return body + 1.1 * coarse + 0.35 * fine


def cup_surface(triangles: int) -> Surface:
    """The cup by marching cubes, of about so many triangles."""
    from skimage.measure import marching_cubes

    step = 2.12 * np.sqrt(20108 / triangles)
    count = int(np.ceil(120 / step))
    axis = (np.arange(count) - 0.5 * (count - 1)) * step
    values = cup(axis[:, None, None], axis[None, :, None], axis[None, None, :]).astype(np.float32)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(step,) * 3)
    surface = Surface(vertices.astype(np.float64) + axis[0], faces.astype(np.int64))
    if surface.volume_mm3() < 0:
        surface = Surface(surface.vertices_mm, surface.triangles[:, ::-1].copy())
    return surface


def read_surface(path: Path) -> Surface:
    """The mesh of a .npz file."""
    with np.load(path) as arrays:
        return Surface(arrays["v"].astype(np.float64), arrays["f"].astype(np.int64))


def cube(nodes: int) -> Grid:
    """A grid of so many nodes a side."""
    step = CUBE_MM / nodes
    return Grid((nodes,) * 3, (0.5 * step - 0.5 * CUBE_MM,) * 3, (step,) * 3)


@dataclass(frozen=True, slots=True)
class Way:
    """How somebody finds the distances of all nodes."""

    ask: Callable[[Any], Float | Float32]
    """With what was made ready."""

    share: int = 1
    """It is asked for one node in so many."""

    ready: Callable[[], Any] = lambda: None
    """What is done once, however many nodes are asked for."""


def libigl(surface: Surface, grid: Grid) -> Way:
    """libigl's tree, sign by pseudonormals."""
    import igl

    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    return Way(
        lambda _: igl.signed_distance(
            grid.nodes_mm().reshape(-1, 3), surface.vertices_mm, surface.triangles, kind
        )[0]
    )


def open3d(surface: Surface, grid: Grid) -> Way:
    """Open3D's ray-casting scene (Embree), sign by one ray."""
    import open3d as o3d

    def solve(_: Any) -> Float32:
        scene = o3d.t.geometry.RaycastingScene()
        vertices = o3d.core.Tensor(surface.vertices_mm.astype(np.float32))
        scene.add_triangles(vertices, o3d.core.Tensor(surface.triangles.astype(np.uint32)))
        points = o3d.core.Tensor(grid.nodes_mm().reshape(-1, 3).astype(np.float32))
        found: Float32 = scene.compute_signed_distance(points, nsamples=1).numpy()
        return found

    return Way(solve)


def vtk(surface: Surface, grid: Grid) -> Way:
    """VTK's implicit distance, for every 61st node."""
    import vtkmodules.vtkFiltersCore  # noqa: F401

    from pipeline.exact import ExactSurface

    def ready() -> tuple[ExactSurface, Float]:
        exact, points = ExactSurface(surface), grid.nodes_mm().reshape(-1, 3)[::VTK_SHARE]
        # The first question builds what is not built yet.
        exact.distance_mm(points[:1])
        return exact, points

    return Way(lambda made: made[0].distance_mm(made[1]), VTK_SHARE, ready)


PEERS = {"libigl": libigl, "open3d": open3d, "vtk": vtk}


def timed(way: Way) -> tuple[Float, Float | Float32]:
    """Seconds by the clock and of all processors together; and what came out, as one row."""
    start = np.array([time.perf_counter(), time.process_time()])
    made = way.ready()
    middle = np.array([time.perf_counter(), time.process_time()])
    found = way.ask(made)
    end = np.array([time.perf_counter(), time.process_time()])
    return middle - start + way.share * (end - middle), found.reshape(-1)


def compare(surface: Surface, grid: Grid, rounds: int, peers: Sequence[str]) -> None:
    """Print a row for ours and for every peer."""
    print(f"\n{len(surface.triangles)} triangles, {grid.shape[0]}^3 nodes, {processors()} cores")
    print("| method | s | times ours | core-s | times ours | error <= 15 mm | beyond | signs |")
    print("|---" * 8 + "|")
    distance_of_closed(surface, cube(8))
    ways = {"ours": Way(lambda _: distance_of_closed(surface, grid))}
    for peer in peers:
        with suppress(ImportError):
            ways[peer] = PEERS[peer](surface, grid)
    least, found = {name: np.full(2, np.inf) for name in ways}, {}
    for _ in range(rounds):
        for name, way in ways.items():
            seconds, found[name] = timed(way)
            least[name] = np.minimum(least[name], seconds)
    exact = next(((found[name], ways[name].share) for name in ways if name != "ours"), None)
    for name, seconds in least.items():
        ratios = zip(seconds, seconds / least["ours"], strict=True)
        cells = [f"{one:.3f} | {ratio:.1f}" for one, ratio in ratios]
        said = errors(found[name], ways[name].share, exact)
        print(f"| {name} | {' | '.join(cells)} | {said} |", flush=True)


def errors(found: Float | Float32, share: int, exact: tuple[Float | Float32, int] | None) -> str:
    """Differences to the exact distances, as cells of the table."""
    if exact is None:
        return "- | - | -"
    truth, truth_share = exact
    if share < truth_share:
        found = found[:: truth_share // share]
    else:
        truth = truth[:: share // truth_share]
    difference = np.abs(found - truth)
    near = np.abs(truth) <= BAND_MM
    signs = ((found < 0) != (truth < 0)) & (np.abs(truth) > 1e-9)
    return f"{difference[near].max():.1e} | {difference[~near].max():.1e} | {signs.sum()}"


def curve(rounds: int) -> None:
    """Print our time against nodes and triangles, and a sum of shares that describes it.

    The share of triangles times nodes a side is felt where triangles are finer than the grid: every
    block then measures all those that lie within a node's spacing of its nearest.
    """
    cases = [(100_000, n) for n in (64, 96, 128, 192, 256)]
    cases += [(t, 128) for t in (5_000, 20_000, 50_000, 200_000, 400_000)]
    cases += [(400_000, 64), (400_000, 192), (20_000, 192)]
    print("\n| triangles | nodes | s | core-s | core-ns a node |\n" + "|---" * 5 + "|")
    terms, seconds = [], []
    for wanted, nodes in cases:
        surface, grid = cup_surface(wanted), cube(nodes)
        distance_of_closed(surface, cube(8))
        way = Way(lambda _, s=surface, g=grid: distance_of_closed(s, g))
        runs = [timed(way)[0] for _ in range(rounds)]
        clock, least = (float(one) for one in np.min(runs, axis=0))
        terms.append((nodes**3, len(surface.triangles), nodes * len(surface.triangles)))
        seconds.append(least)
        print(
            f"| {terms[-1][1]} | {nodes}^3 | {clock:.3f} | {least:.3f} "
            f"| {least / nodes**3 * 1e9:.0f} |",
            flush=True,
        )
    share, _ = nnls(np.array(terms) / np.array(seconds)[:, None], np.ones(len(cases)))
    off = np.array(terms) @ share / seconds - 1
    print(
        f"core-s = {share[0] * 1e9:.0f}e-9 nodes + {share[1] * 1e6:.2f}e-6 triangles "
        f"+ {share[2] * 1e9:.0f}e-9 triangles x nodes a side, "
        f"off by {off.min():+.0%} to {off.max():+.0%}"
    )


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--triangles", type=int, nargs="*", default=[20_000, 100_000, 400_000])
    parser.add_argument("--mesh", type=Path, nargs="*", help="files instead of the cup")
    parser.add_argument("--nodes", type=int, default=128, help="a side of the grid")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each")
    parser.add_argument("--peers", nargs="*", choices=PEERS, default=list(PEERS))
    parser.add_argument("--curve", action="store_true", help="ours alone, against size")
    args = parser.parse_args()
    if args.curve:
        curve(args.rounds)
        return
    for what in args.mesh or args.triangles:
        surface = read_surface(what) if isinstance(what, Path) else cup_surface(what)
        compare(surface, cube(args.nodes), args.rounds, args.peers)


if __name__ == "__main__":
    main()
