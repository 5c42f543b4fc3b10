"""Fewer triangles where a moving surface is flat, with the error known in every phase.

A vertex is taken out by drawing it into one of its neighbours, so that those that stay remain the
same material points. It may go if the fan that closes the gap passes all that lay there, first
vertices and middles of first edges, within the bound, keeps its triangles' shape, and faces as
before, in every phase. Hoppe, Progressive meshes (SIGGRAPH 1996), calls the step an edge collapse.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pipeline.geometry import Float, Integer, MovingSurface
from pipeline.surface.correspondence import restore_volume
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.measures import distances_mm
from pipeline.surface.mesh import adjacency

# Triangles at a vertex, and shape (1 equilateral, 0 a line) that a collapse must respect.
MOST_TRIANGLES = 9
LEAST_QUALITY = 0.35
# Cosine of the most that a triangle may turn away from the surface that it replaces.
FACING = 0.7
# A round that takes out less than this share of the vertices is the last.
WORTHWHILE = 0.01
# Vertices keep to less than the bound, for between them the two surfaces part a little more.
TIGHTER = 0.8
TRIES = 6


def decimated(moving: MovingSurface, error_mm: float) -> MovingSurface:
    """A surface of fewer triangles that stays within ``error_mm`` of the given one in all phases.

    It encloses the same volume in every phase, to which end its vertices are moved along their
    normals by one small length a phase.

    The deviation is measured both ways, at corners, edge middles and triangle middles; where it is
    above the bound, or the result passes through itself, all is done again with a tighter one. If
    that does not help the surface is returned as it is; it also is for a bound of 0.

    Parameters
    ----------
    moving
        Closed surface, corresponding vertices, mm.
    error_mm
        Largest deviation allowed.
    """
    bound_mm = TIGHTER * error_mm
    for _ in range(TRIES if error_mm > 0 else 0):
        kept, triangles = _collapsed(moving, bound_mm)
        fewer = _with_volumes(moving, moving.vertices_mm[:, kept], triangles)
        if deviation_mm(moving, fewer) <= error_mm and not _crosses(fewer):
            return fewer
        bound_mm *= TIGHTER
    return moving


def _with_volumes(moving: MovingSurface, vertices_mm: Float, triangles: Integer) -> MovingSurface:
    """Fewer vertices ``(phase, k, 3)`` of a surface, made to enclose what it does."""
    places = [
        restore_volume(vertices, triangles, moving.at(k).volume_mm3())
        for k, vertices in enumerate(vertices_mm)
    ]
    return MovingSurface(np.stack(places), triangles, moving.phases)


def deviation_mm(first: MovingSurface, second: MovingSurface) -> float:
    """Largest distance between two surfaces over all phases, at the samples of both."""
    largest = 0.0
    for k in range(len(first.phases)):
        one, other = first.at(k), second.at(k)
        there = distances_mm(_samples(one.vertices_mm, one.triangles), other).max()
        back = distances_mm(_samples(other.vertices_mm, other.triangles), one).max()
        largest = max(largest, float(there), float(back))
    return largest


def _samples(vertices_mm: Float, triangles: Integer) -> Float:
    """Corners, edge middles and triangle middles."""
    corners = vertices_mm[triangles]
    edges = (corners + np.roll(corners, 1, axis=1)) / 2
    return np.concatenate([vertices_mm, edges.reshape(-1, 3), corners.mean(axis=1)])


def _crosses(moving: MovingSurface) -> bool:
    return any(
        crossing_triangles(vertices, moving.triangles).any() for vertices in moving.vertices_mm
    )


def _collapsed(moving: MovingSurface, bound_mm: float) -> tuple[Integer, Integer]:
    """Numbers of the vertices that stay, and triangles between them, renumbered."""
    count, triangles = moving.vertices_mm.shape[1], moving.triangles.copy()
    alive = np.ones(len(triangles), np.bool_)
    edges, beside = _edges(triangles)
    middles = moving.vertices_mm[:, edges].mean(axis=2)
    points = np.concatenate([moving.vertices_mm, middles], axis=1)
    # Of a vertex taken out and of the middles of the first edges: a triangle that passes them
    # within the bound; -1 for a vertex that stays.
    host = np.concatenate([np.full(count, -1), beside])
    while True:
        roughness = _roughness(moving.vertices_mm, triangles[alive])
        order = np.argsort(roughness, kind="stable")
        gone = _round(points, triangles, alive, host, order, bound_mm)
        staying = host[:count] < 0
        if gone < WORTHWHILE * np.count_nonzero(staying):
            break
    number = np.cumsum(staying) - 1
    return np.flatnonzero(staying), number[triangles[alive]]


def _edges(triangles: Integer) -> tuple[Integer, Integer]:
    """Edges ``(k, 2)`` of a closed mesh, each once, and a triangle beside each."""
    directed = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    once = directed[:, 0] < directed[:, 1]
    return directed[once], np.flatnonzero(once) // 3


def _roughness(path_mm: Float, triangles: Integer) -> Float:
    """Largest way over the phases from each vertex ``(n,)`` to the mean of its neighbours, mm."""
    neighbours = adjacency(triangles, path_mm.shape[1])
    degree = np.maximum(neighbours.sum(axis=1), 1)[:, None]
    ways = [np.linalg.norm(neighbours @ one / degree - one, axis=1) for one in path_mm]
    return np.asarray(np.max(ways, axis=0))


@njit(nogil=True, cache=True)
def _round(path, triangles, alive, host, order, bound):  # type: ignore[no-untyped-def]
    """Try to take out each vertex once, none beside another of the same round; how many went."""
    count = len(order)
    ring, degree = np.full((count, MOST_TRIANGLES + 8), -1), np.zeros(count, np.int64)
    for t in range(len(triangles)):
        if alive[t]:
            for corner in range(3):
                n = triangles[t, corner]
                if degree[n] < ring.shape[1]:
                    ring[n, degree[n]] = t
                degree[n] += 1
    guests = _guests(host, len(triangles))
    busy, gone = np.zeros(count, np.bool_), 0
    for n in order:
        if host[n] >= 0 or busy[n] or degree[n] < 3 or degree[n] > MOST_TRIANGLES:
            continue
        if _take_out(path, triangles, alive, host, ring, degree, guests, n, bound):
            gone += 1
            for at in range(degree[n]):
                for corner in range(3):
                    busy[triangles[ring[n, at], corner]] = True
    return gone


@njit(nogil=True, cache=True)
def _guests(host, count):  # type: ignore[no-untyped-def]
    """Points, by the triangle that passes them: start of each triangle's, and their numbers."""
    starts = np.zeros(count + 1, np.int64)
    for n in range(len(host)):
        if host[n] >= 0:
            starts[host[n] + 1] += 1
    starts = np.cumsum(starts)
    members, free = np.empty(starts[-1], np.int64), starts[:-1].copy()
    for n in range(len(host)):
        if host[n] >= 0:
            members[free[host[n]]] = n
            free[host[n]] += 1
    return starts, members


@njit(nogil=True, cache=True)
def _take_out(path, triangles, alive, host, ring, degree, guests, n, bound):  # type: ignore[no-untyped-def]
    """Draw vertex n into the neighbour that costs least, if one will do; whether it went."""
    star = ring[n, : degree[n]]
    passed = _passed(star, guests, n)
    hosts, best_hosts = np.empty(len(passed), np.int64), np.empty(len(passed), np.int64)
    best, least = -1, bound * bound
    for t in star:
        u = _after(triangles[t], n)
        if _joins(triangles, ring, degree, n, u) and _keeps_shape(path, triangles, star, n, u):
            cost = _cost(path, triangles, star, n, u, passed, least, hosts)
            if cost < least:
                best, least = u, cost
                for one in range(len(hosts)):
                    best_hosts[one] = hosts[one]
    if best < 0:
        return False
    for t in star:
        corners = triangles[t]
        if best in (corners[0], corners[1], corners[2]):
            alive[t] = False
        else:
            for corner in range(3):
                if corners[corner] == n:
                    triangles[t, corner] = best
    for one in range(len(passed)):
        host[passed[one]] = best_hosts[one]
    return True


@njit(nogil=True, cache=True)
def _passed(star, guests, n):  # type: ignore[no-untyped-def]
    """Points that the fan in place of a star must pass: n, and those that the star passes."""
    starts, members = guests
    total = 1
    for t in star:
        total += starts[t + 1] - starts[t]
    passed, at = np.empty(total, np.int64), 1
    passed[0] = n
    for t in star:
        for place in range(starts[t], starts[t + 1]):
            passed[at] = members[place]
            at += 1
    return passed


@njit(nogil=True, cache=True)
def _after(corners, n):  # type: ignore[no-untyped-def]
    """The corner that follows n in a triangle."""
    if corners[0] == n:
        return corners[1]
    return corners[2] if corners[1] == n else corners[0]


@njit(nogil=True, cache=True)
def _joins(triangles, ring, degree, n, u):  # type: ignore[no-untyped-def]
    """Whether drawing n into u leaves a surface: two common neighbours, fair rings."""
    if degree[n] + degree[u] - 4 > MOST_TRIANGLES:
        return False
    common = 0
    for at in range(degree[n]):
        other = _after(triangles[ring[n, at]], n)
        if other == u:
            continue
        for beside in range(degree[u]):
            if _after(triangles[ring[u, beside]], u) == other:
                common += 1
                if degree[other] < 5:
                    return False
    return common == 2


@njit(nogil=True, cache=True)
def _keeps_shape(path, triangles, star, n, u):  # type: ignore[no-untyped-def]
    """Whether the fan from u faces as the star of n did, without slivers, in every phase."""
    for t in star:
        a, b, c = triangles[t]
        if u in (a, b, c):
            continue
        i, j, k = u if a == n else a, u if b == n else b, u if c == n else c
        for phase in range(len(path)):
            v = path[phase]
            x, y, z, area = _normal(v, a, b, c)
            p, q, r, fan_area = _normal(v, i, j, k)
            if x * p + y * q + z * r < FACING * area * fan_area:
                return False
            squares = 0.0
            for axis in range(3):
                squares += (v[i, axis] - v[j, axis]) ** 2 + (v[j, axis] - v[k, axis]) ** 2
                squares += (v[k, axis] - v[i, axis]) ** 2
            if 2 * math.sqrt(3) * fan_area < LEAST_QUALITY * squares:
                return False
    return True


@njit(nogil=True, cache=True)
def _normal(v, a, b, c):  # type: ignore[no-untyped-def]
    """Normal of a triangle, twice its area long, and that length."""
    ux, uy, uz = v[b, 0] - v[a, 0], v[b, 1] - v[a, 1], v[b, 2] - v[a, 2]
    wx, wy, wz = v[c, 0] - v[a, 0], v[c, 1] - v[a, 1], v[c, 2] - v[a, 2]
    x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return x, y, z, math.sqrt(x * x + y * y + z * z)


@njit(nogil=True, cache=True)
def _cost(path, triangles, star, n, u, passed, limit, hosts):  # type: ignore[no-untyped-def]
    """Largest squared distance over the phases from the passed vertices to the fan; fills hosts.

    Stops early with infinity at ``limit``.
    """
    worst = 0.0
    for at in range(len(passed)):
        g, closest_ever = passed[at], math.inf
        for phase in range(len(path)):
            nearest = math.inf
            for t in star:
                a, b, c = triangles[t]
                if u in (a, b, c):
                    continue
                i, j, k = u if a == n else a, u if b == n else b, u if c == n else c
                away = _distance2(path[phase], g, i, j, k)
                nearest = min(nearest, away)
                if phase == 0 and away < closest_ever:
                    closest_ever = away
                    hosts[at] = t
            worst = max(worst, nearest)
            if worst >= limit:
                return math.inf
    return worst


@njit(nogil=True, cache=True)
def _distance2(v, g, a, b, c):  # type: ignore[no-untyped-def]
    """Squared distance from vertex g to a triangle.

    Inside the triangle's prism it is that to the plane, else the least of those to the edges.
    """
    x, y, z, area = _normal(v, a, b, c)
    inside, nearest, first, second, third = True, math.inf, a, b, c
    for _ in range(3):
        ux, uy, uz = (
            v[second, 0] - v[first, 0],
            v[second, 1] - v[first, 1],
            v[second, 2] - v[first, 2],
        )
        wx, wy, wz = v[g, 0] - v[first, 0], v[g, 1] - v[first, 1], v[g, 2] - v[first, 2]
        turn = (uy * wz - uz * wy) * x + (uz * wx - ux * wz) * y + (ux * wy - uy * wx) * z
        inside &= turn >= 0
        share = (ux * wx + uy * wy + uz * wz) / (ux * ux + uy * uy + uz * uz)
        share = min(max(share, 0.0), 1.0)
        wx, wy, wz = wx - share * ux, wy - share * uy, wz - share * uz
        nearest = min(nearest, wx * wx + wy * wy + wz * wz)
        first, second, third = second, third, first
    if inside:
        wx, wy, wz = v[g, 0] - v[a, 0], v[g, 1] - v[a, 1], v[g, 2] - v[a, 2]
        return ((wx * x + wy * y + wz * z) / area) ** 2
    return nearest
