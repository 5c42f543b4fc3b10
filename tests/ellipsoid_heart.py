"""A beating heart of ellipsoids, and ultrasound frames of it: truth that needs no phantom.

The ellipsoids are drawn into the frames by their own inequality at each pixel and the frame's own
phase, with other grey values, gain and speckle than registration assumes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pyvista as pv
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from pipeline.geometry import Float, Float32, MovingSurface, transform_points

PHASES = np.arange(16) / 16
CENTRE_MM = np.array([15.0, -30.0, 40.0])
TILT = Rotation.from_euler("zyx", [20, -35, 15], degrees=True).as_matrix()


@dataclass(frozen=True)
class Sweep:
    name: str
    images: Float32
    tracker_from_image: Float


@dataclass(frozen=True)
class Recording:
    """Frames of one heart, and where the tracker truly stands."""

    sweeps: tuple[Sweep, ...]
    phases: tuple[Float, ...]
    mr_from_tracker: Float


def ellipsoids(phase: float) -> dict[str, tuple[Float, Float]]:
    """Centre and semi-axes of every chamber; the base comes down while the ventricles shrink."""
    pulse = np.exp(-(((phase - 0.38) / 0.16) ** 2))
    squeeze, base = 1 - 0.22 * pulse, 8 * pulse
    return {
        "lv_endocardium": ([0, 0, -0.4 * base], [24 * squeeze, 24 * squeeze, 42 - 5 * pulse]),
        "rv_endocardium": ([-52, 4, 5 - 0.4 * base], [16 * squeeze, 30 * squeeze, 38]),
        "left_atrium": ([4, 8, 70 - base], [22 / squeeze, 20 / squeeze, 22]),
        "right_atrium": ([-42, 10, 62 - base], [20 / squeeze, 22 / squeeze, 20]),
        "aorta": ([-14, -26, 66 - base], [11, 11, 26]),
    }


def tissue(points_mm: Float, phase: float) -> Float:
    """0 outside, 1 in muscle and wall, 2 in blood."""
    local = (points_mm - CENTRE_MM) @ TILT
    found = np.zeros(len(local), dtype=np.int64)
    for value, wall_mm in ((1, 4.0), (2, 0.0)):
        for name, (centre, axes) in ellipsoids(phase).items():
            thickness = wall_mm * (3 if name == "lv_endocardium" else 1)
            inside = (((local - centre) / (np.array(axes) + thickness)) ** 2).sum(axis=1) < 1
            found[inside] = value
    return found


def moving_surfaces() -> dict[str, MovingSurface]:
    sphere = pv.Icosphere(nsub=4)
    triangles = np.asarray(sphere.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
    unit = np.asarray(sphere.points, float)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    shapes = [ellipsoids(phase) for phase in PHASES]
    return {
        name: MovingSurface(
            np.array([(unit * s[name][1] + s[name][0]) @ TILT.T + CENTRE_MM for s in shapes]),
            triangles,
            PHASES,
        )
        for name in shapes[0]
    }


def random_motion(rng: np.random.Generator, shift_mm: float, turn_deg: float) -> Float:
    """A turn about the heart's centre by, and a shift of, exactly these sizes."""
    axis, way = rng.normal(size=(2, 3))
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(
        np.radians(turn_deg) * axis / np.linalg.norm(axis)
    ).as_matrix()
    motion[:3, 3] = CENTRE_MM - motion[:3, :3] @ CENTRE_MM + shift_mm * way / np.linalg.norm(way)
    return motion


def speckle(rng: np.random.Generator, shape: tuple[int, int]) -> Float:
    """Log-compressed Rayleigh speckle about 0, some 20 grey values strong."""
    echo = sum(unit * gaussian_filter(rng.normal(size=shape), (0.8, 1.5)) for unit in (1.0, 1.0j))
    return 44 * np.log10(np.abs(echo) / np.abs(echo).mean() + 1e-3)


def draw_frame(
    rng: np.random.Generator, mr_from_image: Float, phase: float, shape: tuple[int, int]
) -> Float32:
    """Tissue's grey in a sector of 84 degrees, with speckle, depth loss and uneven gain."""
    j, i = np.mgrid[: shape[0], : shape[1]]
    across = i - shape[1] / 2
    reach = np.hypot(across, j)
    sector = (reach > 8) & (reach < 150) & (np.abs(np.arctan2(across, j)) < np.radians(42))
    pixels = np.stack([i[sector], j[sector], 0 * i[sector]], axis=-1).astype(float)
    grey = np.zeros(shape)
    grey[sector] = np.array([85.0, 110.0, 30.0])[
        tissue(transform_points(mr_from_image, pixels), phase)
    ]
    uneven = gaussian_filter(rng.normal(size=shape), 20)
    grey += speckle(rng, shape) + 15 * uneven / uneven.std() - 0.15 * j
    return (np.clip(grey, 1, 255).round() * sector).astype(np.float32)


@cache
def record(seed: int, frames: int = 14) -> Recording:
    """An apical and a parasternal fan of 1 mm pixels, each swung through 50 degrees.

    Tests share it: whoever changes an array makes a copy.
    """
    rng = np.random.default_rng(seed)
    mr_from_tracker = random_motion(rng, 200, 120)
    views = [([5, -5, -75], [-0.1, 0.1, 1]), ([10, -90, -5], [-0.15, 1, 0.15])]
    sweeps, phases = [], []
    for number, (tip, aim) in enumerate(views):
        along = TILT @ np.array(aim) / np.linalg.norm(aim)
        across = TILT @ np.array([1.0, 0.2, 0.1])
        across -= along * (across @ along)
        across /= np.linalg.norm(across)
        own = (rng.uniform() + 0.11 * np.arange(frames)) % 1
        images, poses = [], []
        for k in range(frames):
            swing = Rotation.from_rotvec(np.radians(-25 + 50 * k / (frames - 1)) * across)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([across, swing.apply(along), np.cross(across, along)], axis=1)
            pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
            pose[:3, 3] = CENTRE_MM + TILT @ np.array(tip) - 75 * across
            images.append(draw_frame(rng, pose, own[k], (160, 150)))
            poses.append(np.linalg.inv(mr_from_tracker) @ pose)
        sweeps.append(Sweep(f"sweep_{number:03d}", np.stack(images), np.stack(poses)))
        phases.append(own)
    return Recording(tuple(sweeps), tuple(phases), mr_from_tracker)


def target_error_mm(found: Float, truth: Float, points_mm: Float) -> Float:
    """How far ``found`` puts points of the heart from where they are."""
    tracker = transform_points(np.linalg.inv(truth), points_mm)
    return np.linalg.norm(transform_points(found, tracker) - points_mm, axis=1)


def start_off(recording: Recording, seed: int, shift_mm: float, turn_deg: float) -> Float:
    motion = random_motion(np.random.default_rng(seed), shift_mm, turn_deg)
    return motion @ recording.mr_from_tracker
