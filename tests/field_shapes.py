"""Closed surfaces with known distances, for the tests of the field."""

import numpy as np

from pipeline.geometry import Float, MovingSurface, Surface

BOX_TRIANGLES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6],  # lower z, upper z
        [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7],  # lower y, upper y
        [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],  # lower x, upper x
    ]
)  # fmt: skip


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Surface:
    """An upright box of twelve triangles."""
    ends = np.array([low, high], dtype=float)
    corners = [[ends[i, 0], ends[j, 1], ends[k, 2]] for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    return Surface(np.array(corners), BOX_TRIANGLES)


def box_distance(points: Float, low: tuple[float, ...], high: tuple[float, ...]) -> Float:
    """Signed distance to an upright box, in closed form."""
    centre, half = np.add(low, high) / 2, np.subtract(high, low) / 2
    q = np.abs(points - centre) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def flipped(surface: Surface) -> Surface:
    """The same surface with its normals turned round."""
    return Surface(surface.vertices_mm, np.ascontiguousarray(surface.triangles[:, ::-1]))


def joined(*surfaces: Surface) -> Surface:
    """Several bodies as one surface."""
    starts = np.cumsum([0, *(len(one.vertices_mm) for one in surfaces[:-1])])
    triangles = [one.triangles + start for one, start in zip(surfaces, starts, strict=True)]
    return Surface(np.concatenate([one.vertices_mm for one in surfaces]), np.concatenate(triangles))


def sphere(radius: float, level: int, centre: tuple[float, ...] = (0, 0, 0)) -> Surface:
    """An icosahedron whose triangles are quartered ``level`` times, vertices on the sphere."""
    golden = (1 + 5**0.5) / 2
    ones = [(a, b) for a in (-1, 1) for b in (-golden, golden)]
    points = np.array([p for a, b in ones for p in ((0, a, b), (a, b, 0), (b, 0, a))], dtype=float)
    from scipy.spatial import ConvexHull

    triangles = ConvexHull(points).simplices
    for _ in range(level):
        points, triangles = _quartered(points, triangles)
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    corners = points[triangles]
    outward = np.einsum("ij,ij->i", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) > 0
    triangles = np.where(outward[:, None], triangles, triangles[:, ::-1])
    return Surface(points * radius + np.array(centre), triangles.astype(np.int64))


def _quartered(points: Float, triangles: Float) -> tuple[Float, Float]:
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    unique, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middle = number.reshape(-1, 3) + len(points)
    a, b, c = triangles.T
    ab, bc, ca = middle.T
    finer = np.stack([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]])
    return np.concatenate([points, points[unique].mean(axis=1)]), np.concatenate(
        finer.transpose(0, 2, 1)
    )


def torus(major: float, minor: float, around: int, across: int) -> Surface:
    """A ring about z, vertices on it."""
    u, v = np.meshgrid(
        np.arange(around) * 2 * np.pi / around,
        np.arange(across) * 2 * np.pi / across,
        indexing="ij",
    )
    ring = major + minor * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], axis=-1)
    i, j = (index.ravel() for index in np.indices((around, across)))

    def number(row: Float, column: Float) -> Float:
        return (row % around) * across + column % across

    a, b, c, d = number(i, j), number(i + 1, j), number(i + 1, j + 1), number(i, j + 1)
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(points.reshape(-1, 3), triangles)


def torus_distance(points: Float, major: float, minor: float) -> Float:
    """Signed distance to the ring, in closed form."""
    ring = np.hypot(points[..., 0], points[..., 1]) - major
    return np.hypot(ring, points[..., 2]) - minor


def sag(surface: Surface, curvature_radius: float) -> float:
    """How far a facet can be from the smooth surface that its corners lie on.

    The smooth surface's distance vanishes at the corners, and its second derivative near the
    surface is at most k = 1 / (radius - sag). Linear interpolation over a triangle errs by at
    most k / 2 times the square of its enclosing circle's radius, itself at most the longest edge
    over sqrt(3): sag <= edge^2 / (6 (radius - sag)).
    """
    corners = surface.vertices_mm[surface.triangles]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    return (curvature_radius - np.sqrt(curvature_radius**2 - 4 * edge**2 / 6)) / 2


def lumpy(seed: int, level: int = 3, radius: float = 20.0) -> Surface:
    """A ball with dents and bumps of random size and direction."""
    rng = np.random.default_rng(seed)
    ball = sphere(1.0, level)
    waves = rng.normal(size=(6, 3)) * 2
    bumps = np.sin(ball.vertices_mm @ waves.T + rng.uniform(0, 6, 6)).sum(axis=1)
    stretched = ball.vertices_mm * rng.uniform(0.6, 1.4, 3)
    return Surface(radius * stretched * (1 + 0.06 * bumps)[:, None], ball.triangles)


def moved(surface: Surface, rotation: Float, shift: Float) -> Surface:
    """The surface after a rotation about the origin and a shift."""
    return Surface(surface.vertices_mm @ rotation.T + shift, surface.triangles)


def beating(surface: Surface, sizes: Float, phases: Float) -> MovingSurface:
    """The surface, scaled about the origin by one size a phase."""
    vertices = np.stack([surface.vertices_mm * size for size in sizes])
    return MovingSurface(vertices, surface.triangles, np.asarray(phases, dtype=float))
