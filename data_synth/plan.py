"""Where images are taken: the short-axis stack, the long-axis views, the isotropic volume."""

from __future__ import annotations

import math

import numpy as np

from data_synth.heart import BeatingHeart
from data_synth.kernels import Float
from data_synth.protocol import MrSettings

LONG_AXIS_VIEWS = ("two_chamber", "three_chamber", "four_chamber")

LEFT, BACK, UP = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
RIGHT, DOWN = (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
SCANNER_AXES = {
    "transverse": (LEFT, BACK, UP),
    "sagittal": (BACK, DOWN, RIGHT),
    "coronal": (LEFT, DOWN, BACK),
}
"""Along an image row, down a column, and from slice to slice, as readers expect them."""


def tilt(rng: np.random.Generator, settings: MrSettings) -> Float:
    """Rotation (3, 3) by which an operator misses the wanted plane."""
    from scipy.spatial.transform import Rotation

    turn = np.deg2rad(settings.planning_error_deg) * rng.standard_normal(3)
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


def image_frame(axes: Float, corner: Float, steps_mm: tuple[float, float, float]) -> Float:
    """4x4 LPS mm from voxel indices: unit ``axes`` in columns, first voxel, voxel sizes."""
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = axes * steps_mm
    mr_from_index[:3, 3] = corner
    return mr_from_index


def plan_stack(rng: np.random.Generator, heart: BeatingHeart, settings: MrSettings) -> Float:
    """Place a short-axis stack as an operator would: 4x4 LPS mm from voxel indices.

    Columns run from the right ventricle to the lateral wall, rows from the anterior wall down,
    slices from apex to base.
    """
    axes = tilt(rng, settings) @ heart.rotation @ np.diag([-1.0, -1.0, 1.0])
    step = settings.slice_step_mm
    first = lowest_point(heart) + 0.3 * step + rng.uniform(-1, 1)
    half = (settings.matrix - 1) / 2 * settings.pixel_mm
    middle = np.array([8.0, 4.0, 0.0]) + np.append(rng.normal(0, 4, 2), 0.0)
    middle_mm = heart.centre_mm + heart.rotation @ middle
    corner = middle_mm + axes @ np.array([-half, -half, first])
    return image_frame(axes, corner, (settings.pixel_mm, settings.pixel_mm, step))


def lowest_point(heart: BeatingHeart) -> float:
    """Height of the outside of the apex over the mitral plane, mm (negative)."""
    return -heart.shape.lv_length - heart.shape.apex_wall


def highest_point(heart: BeatingHeart) -> float:
    """Height of the atrial roof with its wall over the mitral plane, mm."""
    shape = heart.shape
    return max(shape.la_z + shape.la_radius_z, shape.ra_z + shape.ra_radius_z) + 6


def count_slices(heart: BeatingHeart, settings: MrSettings) -> int:
    """Slices that reach from the apex over the roof of the atria."""
    if settings.slices is not None:
        return settings.slices
    reach = highest_point(heart) - lowest_point(heart)
    return math.ceil(reach / settings.slice_step_mm) + 1


def view_direction(heart: BeatingHeart, view: str) -> float:
    """Angle about the long axis, in the heart frame, of the half-plane a long-axis view shows.

    The 4-chamber plane passes through the middle of the tricuspid valve, the 3-chamber plane
    through the aortic root, and the 2-chamber plane lies across the line from the left to the
    middle of the right ventricle, so that it shows the anterior and the inferior wall alone.
    """
    shape = heart.shape
    if view == "four_chamber":
        return math.atan2(shape.ra_y, shape.ra_x)
    if view == "three_chamber":
        x, y = np.mean(heart.tubes.aorta[:3, :2], axis=0)
        return math.atan2(float(y), float(x))
    return shape.rv_angle + math.pi / 2


def plan_long_axis(
    rng: np.random.Generator, heart: BeatingHeart, view: str, settings: MrSettings
) -> Float:
    """Place one long-axis slice through apex and mitral centre: 4x4 LPS mm from voxel indices.

    Rows and columns lie as :func:`display_axes` says.
    """
    angle = view_direction(heart, view)
    across = heart.rotation @ np.array([math.cos(angle), math.sin(angle), 0.0])
    normal = np.cross(heart.long_axis, across)
    axes = tilt(rng, settings) @ display_axes(normal, view)
    # The image's middle: half-way between apex and atrial roof.
    height = (lowest_point(heart) + highest_point(heart)) / 2
    middle_mm = heart.centre_mm + height * heart.long_axis
    half = (settings.matrix - 1) / 2 * settings.pixel_mm
    corner = middle_mm - half * (axes[:, 0] + axes[:, 1])
    steps = (settings.pixel_mm, settings.pixel_mm, settings.slice_thickness_mm)
    return image_frame(axes, corner, steps)


def display_axes(normal: Float, view: str) -> Float:
    """Unit axes (3, 3), columns: along an image row, down a column, and the slice normal.

    As readers expect them: the four-chamber view like a transverse plane, with the patient's left
    on the right and the back below; the others like sagittal planes, with the back on the right.
    """
    left, back = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    right, down = (left, back) if view == "four_chamber" else (back, np.array([0.0, 0.0, -1.0]))
    normal = normal if normal @ np.cross(right, down) > 0 else -normal
    row = right - (right @ normal) * normal
    row /= np.linalg.norm(row)
    return np.stack([row, np.cross(normal, row), normal], axis=1)


def plan_volume(
    rng: np.random.Generator, heart: BeatingHeart, settings: MrSettings
) -> tuple[Float, tuple[int, int, int]]:
    """Place an isotropic volume that holds the heart: 4x4 frame, and voxels along (z, y, x).

    Its axes are those of the short-axis stack, or the scanner's.
    """
    missed, voxel = tilt(rng, settings), settings.volume_voxel_mm
    across = settings.matrix * settings.pixel_mm * 0.75
    if settings.volume_axes == "short_axis":
        axes = missed @ heart.rotation @ np.diag([-1.0, -1.0, 1.0])
        low, high = lowest_point(heart) - 8, highest_point(heart) + 6
        middle_mm = heart.centre_mm + heart.rotation @ np.array([8.0, 4.0, 0.0])
    else:
        axes = missed @ np.array(SCANNER_AXES[settings.volume_axes]).T
        vertices_mm, _ = heart.surfaces(0.0, ("heart",))["heart"]
        along_mm = vertices_mm @ axes
        middle_mm = axes @ (along_mm.min(axis=0) + along_mm.max(axis=0)) / 2
        reach = np.ptp(along_mm, axis=0) / 2 + 12
        low, high = -reach[2], reach[2]
        across = max(across, 2 * float(reach[:2].max()))
    side = math.ceil(across / voxel)
    depth = math.ceil((high - low) / voxel)
    half = (side - 1) / 2 * voxel
    corner = middle_mm + axes @ np.array([-half, -half, low])
    return image_frame(axes, corner, (voxel, voxel, voxel)), (depth, side, side)
