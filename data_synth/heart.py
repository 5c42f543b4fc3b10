"""A beating heart in its chest: what is where at every phase, and how each point travels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from data_synth.anatomy import BODY_NAMES, BOX_MM, build_tubes, label_points, sample_bodies
from data_synth.beat import Pulse, beat_at, radial_loss
from data_synth.errors import SynthError
from data_synth.kernels import Beat, Float, Label, Shape, Tubes
from data_synth.motion import carry_points, reference_points
from data_synth.thorax import Thorax, chest_points

Triangles = npt.NDArray[np.int64]
Mesh = tuple[Float, Triangles]
Matrix = tuple[tuple[float, ...], ...]

MESH_SPACING_MM = 1.5
CELL_MM = 5.0
_BOX_LOW = np.array(BOX_MM)[:, 0]
EX, EZ = (-0.72, -0.66, -0.16), (-0.62, 0.58, 0.53)
"""Mean directions, LPS: towards the right ventricle, and from apex to base."""
CENTRE_MM = (18.0, -4.0, 2.0)
"""Mean place of the mitral plane in the chest."""


@dataclass(frozen=True)
class BeatingHeart:
    """One heart: sizes, motion, place. Points are LPS mm; phase is cyclic in [0, 1), 0 at R."""

    shape: Shape
    pulse: Pulse
    chest: Thorax
    mr_from_heart: Matrix
    """Rows of the rigid 4x4 (or 3x4) transform from the heart frame to LPS."""
    lv_loss: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lv_loss", radial_loss(self.shape, self.pulse))

    @property
    def rotation(self) -> Float:
        """(3, 3): columns are the heart frame's axes in LPS."""
        return np.array(self.mr_from_heart)[:3, :3]

    @property
    def centre_mm(self) -> Float:
        """Centre of the mitral plane at the R peak, LPS."""
        return np.array(self.mr_from_heart)[:3, 3]

    @property
    def long_axis(self) -> Float:
        """Unit vector from apex to base, LPS."""
        return self.rotation[:, 2]

    @property
    def tubes(self) -> Tubes:
        """Vessels and appendage in the heart frame."""
        return _tubes(self.shape)

    def beat(self, phase: float) -> Beat:
        """Amounts of motion at a phase."""
        return beat_at(self.pulse, self.lv_loss, phase)

    def into_heart(self, points_mm: Float) -> Float:
        """LPS points (n, 3) in the heart frame."""
        return np.ascontiguousarray((_points(points_mm) - self.centre_mm) @ self.rotation)

    def into_patient(self, points_mm: Float) -> Float:
        """Heart-frame points (n, 3) in LPS."""
        return np.asarray(points_mm @ self.rotation.T + self.centre_mm)

    def carry(self, reference_points_mm: Float, phase: float) -> Float:
        """Where material points (n, 3), given at the R peak, are at a phase."""
        here = carry_points(self.into_heart(reference_points_mm), self.shape, self.beat(phase))
        return self.into_patient(here)

    def reference(self, points_mm: Float, phase: float) -> Float:
        """Where points (n, 3) at a phase are at the R peak: exact inverse of carry."""
        here = reference_points(self.into_heart(points_mm), self.shape, self.beat(phase))
        return self.into_patient(here)

    def tissue(self, points_mm: Float, phase: float) -> Label:
        """Tissue value of every LPS point (n, 3): the heart where it is, else the chest."""
        labels = self.heart_tissue(points_mm, phase)
        outside = labels == 0
        labels[outside] = self.chest_tissue(_points(points_mm)[outside])
        return labels

    def heart_tissue(self, points_mm: Float, phase: float) -> Label:
        """Tissue of LPS points (n, 3) that belong to the heart; 0 elsewhere."""
        here = self.into_heart(points_mm)
        near = self._near(here)
        labels = np.zeros(len(here), np.uint8)
        rest = reference_points(here[near], self.shape, self.beat(phase))
        labels[near] = label_points(rest, self.shape, self.tubes)
        return labels

    def near_heart(self, points_mm: Float) -> npt.NDArray[np.bool_]:
        """Which LPS points (n, 3) may belong to the heart at some phase."""
        return self._near(self.into_heart(points_mm))

    def _near(self, here: Float) -> npt.NDArray[np.bool_]:
        reach = envelope(self.shape, self.pulse, self.lv_loss)
        cell = np.floor((here - _BOX_LOW) / CELL_MM).astype(np.intp)
        inside = ((cell >= 0) & (cell < reach.shape)).all(axis=1)
        i, j, k = cell[inside].T
        inside[inside] = reach[i, j, k]
        return np.asarray(inside)

    def chest_tissue(self, points_mm: Float) -> Label:
        """Tissue of LPS points (n, 3) with the heart left out: the same at every phase."""
        return chest_points(np.ascontiguousarray(points_mm, float), self.chest)

    def surfaces(self, phase: float) -> dict[str, Mesh]:
        """Closed truth meshes, normals outwards: name -> (LPS vertices (n, 3), triangles (m, 3)).

        Names: lv_endocardium, epicardium, rv_endocardium, left_atrium, right_atrium, aorta,
        heart. ``epicardium`` is the outside of the left muscle, closed by the mitral plane;
        ``heart`` the outside of all labelled parts, clefts filled, without the thin outer walls.
        Vertex i is the same material point in every phase.
        """
        beat = self.beat(phase)
        return {
            name: (self.into_patient(carry_points(vertices, self.shape, beat)), triangles)
            for name, (vertices, triangles) in reference_meshes(self.shape).items()
        }

    def volumes_ml(self, phase: float) -> dict[str, float]:
        """Volumes enclosed by the truth meshes, and the left muscle's (ml)."""
        return enclosed_ml(self.surfaces(phase))


def _points(points_mm: Float) -> Float:
    points = np.asarray(points_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SynthError(f"points must be (n, 3) LPS mm, got an array of shape {points.shape}")
    return points


@lru_cache(maxsize=8)
def _tubes(shape: Shape) -> Tubes:
    return build_tubes(shape)


@lru_cache(maxsize=8)
def envelope(shape: Shape, pulse: Pulse, lv_loss: float) -> npt.NDArray[np.bool_]:
    """Cells (x, y, z) of the heart frame's box that the heart touches at some phase.

    Cell centres are looked up at 16 phases; then the set grows by two cells, 10 mm. That covers
    half a cell's diagonal (4.4 mm) and the way of the fastest point between two of the phases
    (a descent of 20 mm at 4 descents a cycle for 1/32 of a cycle: 2.5 mm).
    """
    from scipy.ndimage import binary_dilation

    axes = [np.arange(low, high, CELL_MM) + CELL_MM / 2 for low, high in BOX_MM]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    touched = np.zeros(len(centres), bool)
    for k in range(16):
        rest = reference_points(centres, shape, beat_at(pulse, lv_loss, k / 16))
        touched |= label_points(rest, shape, _tubes(shape)) > 0
    grid = touched.reshape([len(axis) for axis in axes])
    return np.asarray(binary_dilation(grid, np.ones((3, 3, 3), bool), iterations=2))


def mesh_volume_ml(vertices_mm: Float, triangles: Triangles) -> float:
    """Volume of a closed mesh by the divergence theorem, positive for outward normals."""
    a, b, c = (vertices_mm[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6000)


def enclosed_ml(surfaces: dict[str, Mesh]) -> dict[str, float]:
    """Volume of every mesh, and the left muscle's, from a heart's surfaces."""
    volumes = {name: mesh_volume_ml(*mesh) for name, mesh in surfaces.items()}
    volumes["lv_myocardium"] = volumes["epicardium"] - volumes["lv_endocardium"]
    return volumes


@lru_cache(maxsize=2)
def reference_meshes(shape: Shape) -> dict[str, Mesh]:
    """Meshes of all bodies at the R peak in the heart frame, by marching cubes."""
    axes = _mesh_axes(shape)
    x, y, z = axes
    values = sample_bodies(x, y, z, shape, _tubes(shape))
    origin = np.array([axis[0] for axis in axes])
    return {
        name: _largest_mesh(value, origin) for name, value in zip(BODY_NAMES, values, strict=True)
    }


def _mesh_axes(shape: Shape) -> list[Float]:
    """Grid lines around all bodies at the R peak, with 10 mm to spare."""
    coarse = [np.arange(low, high, CELL_MM) for low, high in BOX_MM]
    x, y, z = coarse
    inside = sample_bodies(x, y, z, shape, _tubes(shape)).min(axis=0) < 0
    axes = []
    for axis, line in enumerate(coarse):
        filled = line[inside.any(axis=tuple({0, 1, 2} - {axis}))]
        axes.append(np.arange(filled[0] - 10, filled[-1] + 10, MESH_SPACING_MM))
    return axes


def _largest_mesh(values: Float, origin: Float) -> Mesh:
    """Largest connected zero surface of a grid; crumbs that cutting leaves are dropped."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from skimage.measure import marching_cubes

    # A node at exactly zero would make triangles without area.
    values = np.where(np.abs(values) < 1e-6, 1e-6, values)
    vertices, faces, _, _ = marching_cubes(
        values, 0.0, spacing=(MESH_SPACING_MM,) * 3, gradient_direction="descent"
    )
    triangles = faces.astype(np.int64)
    ends = triangles[:, [1, 2]].ravel()
    starts = np.repeat(triangles[:, 0], 2)
    graph = coo_array((np.ones(len(starts)), (starts, ends)), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1]
    keep = part == np.bincount(part).argmax()
    number = np.cumsum(keep) - 1
    return vertices[keep].astype(float) + origin, number[triangles[keep[triangles[:, 0]]]]


def _spread(mean: float, deviation: float, rng: np.random.Generator, spread: float) -> float:
    """Normal draw about the mean, cut at 2.2 deviations."""
    return mean + deviation * spread * float(np.clip(rng.standard_normal(), -2.2, 2.2))


def draw_heart(rng: np.random.Generator, spread: float = 1.0) -> BeatingHeart:
    """Draw a healthy heart: sizes, motion, place and chest.

    ``spread`` scales every deviation from the mean heart: 0 gives the mean, 1 a population with
    deviations near those of adult reference values (Petersen et al., J. Cardiovasc. Magn. Reson.
    19:18, 2017), 2 a wider one for training.

    Raises
    ------
    SynthError
        When ``spread`` lies outside [0, 3].
    """
    if not 0 <= spread <= 3:
        raise SynthError(f"spread is {spread}; give a number from 0 (mean heart) to 3")
    size = _spread(1.0, 0.04, rng, spread)
    shape = draw_shape(rng, spread, size)
    pulse = draw_pulse(rng, spread)
    girth = _spread(1.0, 0.05, rng, spread)
    chest = Thorax(
        half_width=172 * girth,
        half_depth=_spread(118, 5, rng, spread) * girth,
        skin_fat=max(_spread(15, 4, rng, spread), 4.0),
        mediastinum=_spread(38, 3, rng, spread),
        diaphragm_z=_spread(-72, 5, rng, spread),
    )
    return BeatingHeart(shape, pulse, chest, draw_place(rng, spread))


def draw_shape(rng: np.random.Generator, spread: float, size: float) -> Shape:
    """Draw sizes; ``size`` scales all lengths together."""
    mean = Shape()
    deviation = {
        "lv_radius": 1.2, "lv_length": 4.0, "lv_widest": 0.03, "lv_narrowing": 0.03,
        "lv_wall": 0.9, "apex_wall": 0.5, "rv_width": 1.8, "rv_half_angle": 0.05,
        "rv_angle": 0.06, "rv_reach": 0.02, "rv_wall": 0.25, "la_x": 1.5, "la_y": 1.5,
        "la_radius_x": 1.2, "la_radius_y": 1.2, "la_radius_z": 1.3, "ra_x": 1.5, "ra_y": 2.0,
        "ra_radius_x": 1.3, "ra_radius_y": 1.3, "ra_radius_z": 1.5, "mitral_radius": 0.7,
        "tricuspid_radius": 0.8, "atrial_wall": 0.15, "aorta_radius": 0.9,
        "appendage_length": 0.08, "appendage_radius": 0.7, "fat_depth": 0.8,
    }  # fmt: skip
    angles = {"rv_half_angle", "rv_angle", "lv_widest", "lv_narrowing", "rv_reach"}
    drawn = {}
    for name, sd in deviation.items():
        value = _spread(getattr(mean, name), sd, rng, spread)
        drawn[name] = value if name in angles | {"appendage_length"} else value * size
    drawn["la_z"] = drawn["la_radius_z"]
    drawn["ra_z"] = drawn["ra_radius_z"] - 5
    return mean._replace(**drawn)


def draw_pulse(rng: np.random.Generator, spread: float) -> Pulse:
    """Draw motion amplitudes and timing."""
    return Pulse(
        lv_ejection=_spread(0.605, 0.03, rng, spread),
        rv=_spread(0.72, 0.03, rng, spread),
        descent_lv=_spread(13.0, 1.2, rng, spread),
        descent_rv=_spread(18.5, 1.5, rng, spread),
        twist_apex=_spread(-0.16, 0.03, rng, spread),
        twist_base=_spread(0.07, 0.015, rng, spread),
        la=_spread(0.17, 0.02, rng, spread),
        ra=_spread(0.13, 0.02, rng, spread),
        end_systole=_spread(0.365, 0.012, rng, spread),
        kick=_spread(0.18, 0.02, rng, spread),
    )


def draw_place(rng: np.random.Generator, spread: float) -> Matrix:
    """Draw the heart's position and direction in the chest."""
    from scipy.spatial.transform import Rotation

    ez = np.array(EZ) / math.sqrt(sum(v * v for v in EZ))
    ex = np.array(EX) - np.dot(EX, ez) * ez
    ex /= np.linalg.norm(ex)
    home = np.column_stack([ex, np.cross(ez, ex), ez])
    lean = np.deg2rad([_spread(0, 5, rng, spread) for _ in range(3)])
    rotation = Rotation.from_rotvec(lean).as_matrix() @ home
    centre = np.array([_spread(mean, 4, rng, spread) for mean in CENTRE_MM])
    matrix = np.vstack([np.column_stack([rotation, centre]), (0, 0, 0, 1)])
    return tuple(tuple(float(v) for v in row) for row in matrix)
