"""Where chambers go on beyond what the model knows: what lies there is open, not empty.

Most stacks end in the atria, and the surfaces found in them end there, too, with a lid. Ultrasound
shows the atria whole. Held against a model that ends at the lid, it draws the pose towards the
apex. So what the outermost slice shows of blood is carried on along the normal for a way, apart
from the blood that was seen: each frame tells by itself how much of it there is. So it is above
the lid of a ventricle whose atrium has no surface, though the stack goes on there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from pipeline.geometry import Float, Float32, Grid, Mask, MovingSurface, Surface, area_vectors
from pipeline.imaging.cine import Cine
from pipeline.surface.measures import LID_FACING, base_direction
from pipeline.surface.mesh import vertex_normals

CHAMBERS = ("lv_endocardium", "rv_endocardium", "left_atrium", "right_atrium")
"""What a stack should hold whole; the aorta leaves every one."""

BELOW = {"left_atrium": "lv_endocardium", "right_atrium": "rv_endocardium"}
"""The ventricle that each atrium fills."""

LEAST_CUT_MM2 = 300.0
"""A chamber of which the outermost slice cuts more than this, on average over the beat, goes on
beyond it: less is its rounded end."""

# What is carried on reaches so far, and fades over the last part of it.
_CARRIED_MM, _FADING_MM = 24.0, 12.0
# So far inside the outermost slice's middle it is looked at: surfaces round off their ends.
_INSIDE_MM = 1.0
# Of a grid that shall hold it, what lies so near to the slice is carried on.
_NEAR_MM = 10.0


@dataclass(frozen=True, slots=True)
class Beyond:
    """The nodes of a grid beyond an end."""

    outside: Mask
    """``(z, y, x)``."""

    inside: Float
    """``(3, n)`` indices (z, y, x) of the places in the outermost slice under them."""

    fading: Float
    """``(n,)`` from 1 near the slice to 0."""

    def carried(self, blood: Float32) -> Float32:
        """``(z, y, x)``: the outermost slice's blood, carried on."""
        on = np.zeros_like(blood)
        on[self.outside] = self.fading * map_coordinates(blood, self.inside, order=1)
        return on


@dataclass(frozen=True, slots=True)
class OpenEnd:
    """The middle of the outermost slice at one end of a stack, and what it cuts."""

    point_mm: Float
    outwards: Float
    """``(3,)`` unit vector."""

    chambers: tuple[str, ...] = ()
    """Those that go on beyond."""

    def height_mm(self, points_mm: Float) -> Float:
        """``(...,)`` how far points ``(..., 3)`` lie beyond, mm."""
        return np.asarray((points_mm - self.point_mm) @ self.outwards)

    def cut_mm2(self, chamber: MovingSurface) -> float:
        """Area of the cut through a chamber, mean over the beat: that of the shadow of all that
        lies beyond."""
        corners = chamber.vertices_mm[:, chamber.triangles]
        beyond = self.height_mm(corners.mean(axis=2)) > 0
        shadows = 0.5 * area_vectors(corners.reshape(-1, 3, 3)) @ self.outwards
        return float(np.where(beyond.ravel(), shadows, 0).sum() / len(corners))

    def reached(self, points_mm: Float) -> Float:
        """``(n, 3)`` how far what is carried on of ``(m, 3)`` points goes, LPS mm."""
        near = np.abs(self.height_mm(points_mm)) < _NEAR_MM
        return np.asarray(points_mm[near] + _CARRIED_MM * self.outwards)

    def over(self, grid: Grid) -> Beyond:
        """The part of a grid that lies beyond."""
        z, y, x = (np.arange(count, dtype=float) for count in grid.shape)
        places = np.stack(np.broadcast_arrays(x, y[:, None], z[:, None, None]), axis=-1)
        height_mm = self.height_mm(places * grid.spacing_mm + grid.origin_mm)
        outside = height_mm > 0
        back_mm = (height_mm[outside] + _INSIDE_MM)[:, None] * self.outwards
        inside = places[outside] - back_mm / np.array(grid.spacing_mm)
        fading = np.clip((_CARRIED_MM - height_mm[outside]) / _FADING_MM, 0, 1)
        return Beyond(outside, inside[:, ::-1].T, fading)


@dataclass(frozen=True, slots=True)
class OpenLid:
    """The end of a ventricle that its atrium, which has no surface, stands on."""

    atrium: str
    ventricle: str
    outwards: Float
    """``(3,)`` unit vector from apex to base."""

    lifted: Mask
    """``(vertex,)`` of the ventricle: those of its basal half that look outwards."""

    def carried_to(self, surface: Surface) -> list[Surface]:
        """The ventricle carried on through its lid, for ways that end one after the other."""
        ways_mm = np.arange(_CARRIED_MM - _FADING_MM, _CARRIED_MM + 1, _FADING_MM / 2)
        push = self.lifted[:, None] * self.outwards
        return [Surface(surface.vertices_mm + way * push, surface.triangles) for way in ways_mm]

    def reached(self, points_mm: Float) -> Float:
        """``(n, 3)`` how far the ventricle's ``(phase, n, 3)`` vertices are carried, LPS mm."""
        return (points_mm[:, self.lifted] + _CARRIED_MM * self.outwards).reshape(-1, 3)


def open_lids(surfaces: Mapping[str, MovingSurface], ends: Sequence[OpenEnd] = ()) -> list[OpenLid]:
    """The ventricles whose atria have no surface, but for those that the stack's ``ends`` cut.

    An empty list where the left one's lid at the valve plane cannot be told: it gives the
    direction.
    """
    cut = {name for end in ends for name in end.chambers}
    if not {"lv_endocardium", "epicardium"} <= surfaces.keys():
        return []
    outwards = base_direction(surfaces["lv_endocardium"].at(0), surfaces["epicardium"].at(0))
    if outwards is None:
        return []
    found = []
    for atrium, name in BELOW.items():
        if atrium not in surfaces and name in surfaces and name not in cut:
            first = surfaces[name].at(0)
            height = first.vertices_mm @ outwards
            looks = vertex_normals(first.vertices_mm, first.triangles) @ outwards > LID_FACING
            lifted = looks & (height > (height.min() + height.max()) / 2)
            found.append(OpenLid(atrium, name, outwards, lifted))
    return found


def open_ends(surfaces: Mapping[str, MovingSurface], cine: Cine) -> list[OpenEnd]:
    """The ends of the stack that lie inside a chamber."""
    frame, slices = cine.mr_from_index, cine.intensity.shape[1]
    normal = np.cross(frame[:3, 0], frame[:3, 1])
    normal *= np.sign(normal @ frame[:3, 2]) / np.linalg.norm(normal)
    last_mm = frame[:3, 3] + (slices - 1) * frame[:3, 2]
    found = []
    for end in (OpenEnd(frame[:3, 3], -normal), OpenEnd(last_mm, normal)):
        cut = [name for name in CHAMBERS if name in surfaces]
        cut = [name for name in cut if end.cut_mm2(surfaces[name]) > LEAST_CUT_MM2]
        if cut:
            found.append(OpenEnd(end.point_mm, end.outwards, tuple(cut)))
    return found
