"""Tools that are not points: lines whose every part feels the field.

A tool is described in YAML by its shape and sizes, and becomes lines of straight pieces in the
tool's own frame (mm): z along the shaft or axis, the tip (or the middle of a ring) at the origin.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, TypeAdapter, ValidationError

from pipeline.errors import InputError
from pipeline.geometry import (
    Float,
    Grid,
    area_vectors,
    require_rigid,
    spread_over_triangle,
    transform_points,
)
from pipeline.meshes import require_whole
from pipeline.validation import Section

Point = tuple[float, float, float]

# A polygon of n corners is nowhere farther from its circle than r (1 - cos(pi / n)): 0.2 %.
CORNERS = 48
# Lines along a cylinder's wall: no fewer, and no farther apart. On cylinders of 3 to 20 mm radius
# they come within 3 mN of 100,000 points on the wall.
LEAST_LINES, LINES_APART_MM = 12, 2.0


@dataclass(frozen=True, slots=True)
class Lines:
    """All lines of a tool, as the compiled kernel takes them."""

    points_mm: Float
    """``(n, 3)`` points of one line after the other, in the tool's frame."""

    starts: npt.NDArray[np.int64]
    """Number of each line's first point, and n."""


class _Tool(Section):
    handle_mm: Point = (0.0, 0.0, 0.0)
    """Where the hand holds it, in the tool's frame: torque is about this point."""

    @abstractmethod
    def lines_mm(self) -> list[Float]:
        """Its lines, ``(n, 3)`` each, in the tool's frame."""

    @cached_property
    def lines(self) -> Lines:
        """All its lines, made once: a loop asks about the same tool again and again."""
        parts = self.lines_mm()
        starts = np.concatenate([[0], np.cumsum([len(part) for part in parts])])
        return Lines(np.ascontiguousarray(np.concatenate(parts)), starts.astype(np.int64))


def _ring_mm(radius_mm: float, count: int) -> Float:
    """Points of a circle about z, evenly spaced."""
    angles = 2 * math.pi * np.arange(count) / count
    return radius_mm * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])


class Needle(_Tool):
    """A straight line from the tip up."""

    shape: Literal["needle"]
    length_mm: float = Field(gt=0)

    def lines_mm(self) -> list[Float]:
        """Its one line, ``(2, 3)``."""
        return [np.array([[0.0, 0, 0], [0, 0, self.length_mm]])]


class Cylinder(_Tool):
    """A rod: its wall feels the field, along lines around the axis."""

    shape: Literal["cylinder"]
    length_mm: float = Field(gt=0)
    radius_mm: float = Field(gt=0)

    def lines_mm(self) -> list[Float]:
        """Lines along the wall, ``(2, 3)`` each."""
        up_mm = np.array([0.0, 0.0, self.length_mm])
        count = max(LEAST_LINES, math.ceil(2 * math.pi * self.radius_mm / LINES_APART_MM))
        feet = _ring_mm(self.radius_mm, count)
        return [np.stack([foot, foot + up_mm]) for foot in feet]


class Torus(_Tool):
    """A ring about z, as its centre line."""

    shape: Literal["torus"]
    radius_mm: float = Field(gt=0)

    def lines_mm(self) -> list[Float]:
        """Its one closed line, the first point repeated."""
        ring_mm = _ring_mm(self.radius_mm, CORNERS)
        return [np.concatenate([ring_mm, ring_mm[:1]])]


class Polyline(_Tool):
    """Any line through given points."""

    shape: Literal["polyline"]
    points_mm: tuple[Point, ...] = Field(min_length=1)
    closed: bool = False

    def lines_mm(self) -> list[Float]:
        """Its one line; a closed one repeats its first point."""
        points = np.array(self.points_mm, dtype=float)
        return [np.concatenate([points, points[:1]]) if self.closed else points]


class Mesh(_Tool):
    """Any closed or open triangle mesh, by points spread evenly over its surface."""

    shape: Literal["mesh"]
    path: Path
    """VTP, STL, PLY or OBJ in the tool's frame, mm; a relative path starts at the YAML file."""
    samples: int = Field(default=1000, ge=10, le=100_000)

    def lines_mm(self) -> list[Float]:
        """``samples`` lines of one point each.

        Raises
        ------
        InputError
            When there is no such file, or it is no triangle mesh.
        """
        if not self.path.is_file():
            raise InputError(f"{self.path}: no such mesh; give a VTP, STL, PLY or OBJ file")
        corners_mm = _corners_mm(self.path)
        if not len(corners_mm):
            raise InputError(f"{self.path}: holds no triangles; a tool's mesh is made of them")
        return [point[None] for point in spread_points(corners_mm, self.samples, str(self.path))]


Tool = Annotated[Needle | Cylinder | Torus | Polyline | Mesh, Field(discriminator="shape")]


def outside_share(grid: Grid, tool: Tool, mr_from_tool: Float) -> float:
    """Share of a tool's length that lies outside the grid, 0 to 1; 1 where there is no telling.

    There ``ForceField.tool_force`` is answered by the grid's boundary: the more, the less it tells.

    Parameters
    ----------
    grid
        ``ForceField.grid``.
    tool
        A line of one point weighs as much as 1 mm.
    mr_from_tool
        4x4, the tool's pose in LPS mm.

    Raises
    ------
    InputError
        When the pose is not rigid.
    """
    pose = np.asarray(mr_from_tool, dtype=np.float64)
    require_rigid(pose, "mr_from_tool")
    points, starts = transform_points(pose, tool.lines.points_mm), tool.lines.starts
    # Pieces go from each point but a line's last to the next; an only point is a piece, too.
    alone = starts[:-1][np.diff(starts) == 1]
    start = np.union1d(np.setdiff1d(np.arange(len(points)), starts[1:] - 1), alone)
    end = start + ~np.isin(start, alone)
    from_mm, way_mm = points[start], points[end] - points[start]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        faces = (np.stack([grid.origin_mm, grid.upper_mm])[:, None] - from_mm) / way_mm
        length_mm = np.linalg.norm(way_mm, axis=1)
    if not np.isfinite(length_mm).all():
        return 1.0
    # Along an axis on which a piece does not move it is between the faces all the way, or never.
    between = (from_mm >= grid.origin_mm) & (from_mm <= grid.upper_mm)
    enters = np.where(way_mm == 0, 0, faces.min(axis=0)).max(axis=1).clip(min=0)
    leaves = np.where(way_mm == 0, between, faces.max(axis=0)).min(axis=1).clip(max=1)
    line = np.searchsorted(starts, start, "right")
    points_only = np.bincount(line, length_mm)[line] == 0
    weight = np.where(points_only, 1 / np.bincount(line)[line], length_mm)
    inside = np.where(points_only, between.all(axis=1), (leaves - enters).clip(min=0))
    return float(1 - (weight * inside).sum() / weight.sum())


def _corners_mm(path: Path) -> Float:
    """``(n, 3, 3)`` corners of a mesh file's triangles."""
    import pyvista

    require_whole(path)
    try:
        with warnings.catch_warnings():
            # Of a damaged file VTK only warns, and goes on with what it has.
            warnings.simplefilter("error", UserWarning)
            mesh = pyvista.read(path).extract_surface(algorithm=None).triangulate()
        return np.asarray(np.asarray(mesh.points, float)[mesh.regular_faces])
    except Exception as error:  # VTK's readers raise whatever the format's parser raises
        said = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: cannot be read as a tool's mesh ({said}); give a whole VTP, STL, PLY or OBJ "
            "file"
        ) from error


def spread_points(corners_mm: Float, count: int, where: str) -> Float:
    """``(count, 3)`` points that cover triangles ``(n, 3, 3)`` evenly, the same ones every time.

    Raises
    ------
    InputError
        When the triangles have no area; it begins with ``where``.
    """
    area = np.linalg.norm(area_vectors(corners_mm), axis=1)
    if not area.sum() > 0:
        raise InputError(f"{where}: has no area; give triangles that have some")
    chosen = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(count) + 0.5) / count)
    corners_mm = corners_mm[np.minimum(chosen, len(area) - 1)]
    points: Float = np.einsum("nk,nkd->nd", spread_over_triangle(count), corners_mm)
    return points


def read_tool(path: Path | str) -> Tool:
    """Read a tool's YAML file, and the mesh that it may name.

    Raises
    ------
    InputError
        When either cannot be read, or a key or value is wrong.
    """
    from pipeline.validation import describe_validation
    from pipeline.yaml_files import read_yaml

    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs keys and values, such as `shape: needle`")
    try:
        tool: Tool = TypeAdapter(Tool).validate_python(content)
    except ValidationError as error:
        raise InputError(describe_validation(error, str(path))) from error
    if isinstance(tool, Mesh):
        tool = tool.model_copy(update={"path": path.parent / tool.path})
    try:
        # Made here, where a wrong mesh can still be mended, and not in a force server's loop.
        _ = tool.lines
    except InputError as error:
        raise InputError(f"{path}: path: {error}") from error
    return tool
