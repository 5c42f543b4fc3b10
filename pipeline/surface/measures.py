"""What cardiologists read off the surfaces: volumes, ejection, muscle mass, wall thickness.

Pure functions of corresponding surfaces. ``measures`` gathers them into the table that the surface
stage writes as ``measures.json``::

    {"phases": [...],                      # (phase,) in [0, 1)
     "end_diastole": 0,                    # number of the phase of the largest left cavity
     "end_systole": 9,                     # and of the smallest
     "volumes_ml": {structure: [...]},     # what each surface encloses, one value a phase
     "lv_ejection_fraction": 0.6,          # stroke volume over largest volume
     "rv_ejection_fraction": 0.55,         # null where there is no right ventricle
     "lv_mass_g": [...],                   # left muscle, one value a phase; told is their mean
     "lv_wall_thickness_mm": {
         "mean": [...],                    # over the whole wall, one value a phase
         "segments": {name: [...]}}}       # the same by segment; only those with a wall to measure

Segments are the seventeen of the American Heart Association (Cerqueira et al., Circulation 105,
2002), named as there: "basal anterior" ... "apical lateral", "apex". Without a right ventricle
nothing tells the septum, and there are four: "basal", "mid", "apical", "apex".
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.exact import ExactSurface
from pipeline.geometry import Float, Mask, MovingSurface, Surface
from pipeline.surface.mesh import vertex_areas, vertex_normals

MUSCLE_G_ML = 1.05
"""Density of heart muscle."""

# Cavity and outer surface share the lid at the valve plane: there they are this near at most.
LID_MM = 2.5
# The lid looks along the axis, within 60 degrees, and lies this near its own height.
LID_FACING, LID_HEIGHT_MM = 0.5, 5.0
# What looks less than 20 degrees away belongs to one lid; so many directions are tried.
LID_FLAT, TRIED = 0.94, 300
# Share of the cavity's length below which a wall belongs to the apical cap.
APEX_SHARE = 0.1
RING = ("anteroseptal", "anterior", "anterolateral", "inferolateral", "inferior", "inferoseptal")
APICAL_RING = ("septal", "anterior", "lateral", "inferior")
# The standard counts from the anterior wall towards the septum: 1 to 6, and 13 to 16.
AHA_RING = (
    "anterior",
    "anteroseptal",
    "inferoseptal",
    "inferior",
    "inferolateral",
    "anterolateral",
)
AHA_APICAL_RING = ("anterior", "septal", "inferior", "lateral")

Names = npt.NDArray[np.str_]


def measures(surfaces: Mapping[str, MovingSurface], mirrored: bool = False) -> dict[str, Any]:
    """Table of volumes, ejection fractions, mass and wall thickness; see the module's text.

    Parameters
    ----------
    surfaces
        Closed surfaces by name, LPS mm, of the same phases; ``lv_endocardium`` and ``epicardium``
        must be there.
    mirrored
        Whether they are a mirror image of the heart, as of slices stored in the wrong order.
    """
    volumes = {name: volumes_ml(moving) for name, moving in surfaces.items()}
    inner, right = surfaces["lv_endocardium"], surfaces.get("rv_endocardium")
    muscle_ml = volumes["epicardium"] - volumes["lv_endocardium"]
    mean, segments = wall_thickness_mm(inner, surfaces["epicardium"], right, mirrored)
    return {
        "phases": inner.phases.tolist(),
        "end_diastole": int(volumes["lv_endocardium"].argmax()),
        "end_systole": int(volumes["lv_endocardium"].argmin()),
        "volumes_ml": {name: np.round(one, 2).tolist() for name, one in volumes.items()},
        "lv_ejection_fraction": round(ejection_fraction(volumes["lv_endocardium"]), 4),
        "rv_ejection_fraction": None
        if right is None
        else round(ejection_fraction(volumes["rv_endocardium"]), 4),
        "lv_mass_g": np.round(MUSCLE_G_ML * muscle_ml, 1).tolist(),
        "lv_wall_thickness_mm": {
            "mean": np.round(mean, 2).tolist(),
            "segments": {name: np.round(one, 2).tolist() for name, one in segments.items()},
        },
    }


def volumes_ml(moving: MovingSurface) -> Float:
    """Enclosed volume ``(phase,)`` in ml."""
    return np.array([moving.at(k).volume_mm3() / 1000 for k in range(len(moving.phases))])


def end_systole(phases: Float, volume_ml: Float) -> float:
    """Phase in [0, 1) in the middle of those at which the cavity is nearly at its smallest.

    Within a quarter of the stroke volume of it: a few noisy millilitres move the very smallest by
    several phases.

    >>> phases = np.arange(20) / 20
    >>> round(end_systole(phases, 100 + 40 * np.cos(2 * np.pi * (phases - 0.9))), 3)
    0.4
    """
    least, most = float(volume_ml.min()), float(volume_ml.max())
    small = volume_ml <= least + 0.25 * (most - least)
    turned = np.exp(2j * np.pi * phases[small]).sum()
    return float(np.angle(turned) / (2 * np.pi) % 1)


def ejection_fraction(volume_ml: Float) -> float:
    """Stroke volume over the largest volume, in [0, 1]."""
    return float(1 - volume_ml.min() / volume_ml.max())


def mean_lv_mass_g(table: Mapping[str, Any]) -> float:
    """Mass of the left muscle: the mean over the phases, for it does not change with them."""
    return float(np.mean(table["lv_mass_g"]))


def wall_thickness_mm(
    inner: MovingSurface,
    outer: MovingSurface,
    right: MovingSurface | None,
    mirrored: bool = False,
) -> tuple[Float, dict[str, Float]]:
    """Thickness ``(phase,)`` of the left wall in mm: mean, and by segment.

    Thickness is the distance from a point of the cavity's surface to the nearest point of the
    outer surface, the lid at the valve plane being left out of both. Means are over area at the
    first phase, whose segments the material keeps through the beat. Where no lid tells the axis
    there are no segments.
    """
    first = inner.at(0)
    weights = vertex_areas(first.vertices_mm, first.triangles)
    axis = base_direction(first, outer.at(0))
    walled = np.ones(len(weights), bool)
    names = np.full(len(weights), "")
    if axis is not None:
        walled = ~on_lid(first, axis)
        names = segment_names(first, walled, axis, right.at(0) if right else None, mirrored)
    phases = range(len(inner.phases))
    thickness = np.stack(
        [_to_wall(inner.vertices_mm[k, walled], outer.at(k), axis) for k in phases]
    )
    weights, names = weights[walled], names[walled]
    return np.average(thickness, axis=1, weights=weights), {
        name: _mean(thickness, weights, names == name) for name in _ordered(names)
    }


def base_direction(inner: Surface, outer: Surface) -> Float | None:
    """Unit vector ``(3,)`` from apex to base: the mean normal of the lid; None without a lid.

    The lid is where the cavity's surface touches the outer one, and is flat: a scar so thin that
    it seems to touch, too, is curved, and most of what touches looks the lid's way.
    """
    touching = distances_mm(inner.vertices_mm, outer) < LID_MM
    if not touching.any():
        return None
    areas = vertex_areas(inner.vertices_mm, inner.triangles)
    normals = vertex_normals(inner.vertices_mm, inner.triangles)
    tried = normals[touching][:: max(1, int(touching.sum()) // TRIED)]
    alike = (normals @ tried.T > LID_FLAT) * (areas * touching)[:, None]
    mean = alike[:, alike.sum(axis=0).argmax()] @ normals
    # A ring of thin wall looks in all directions; a lid looks in one.
    if np.linalg.norm(mean) < 0.02 * areas.sum():
        return None
    return np.asarray(mean / np.linalg.norm(mean))


def on_lid(surface: Surface, axis: Float) -> Mask:
    """Which vertices ``(n,)`` close a ventricle's surface at the valve plane."""
    normals = vertex_normals(surface.vertices_mm, surface.triangles)
    areas = vertex_areas(surface.vertices_mm, surface.triangles)
    height = surface.vertices_mm @ axis
    facing = normals @ axis > LID_FACING
    upper = facing & (height > (height.min() + height.max()) / 2)
    if not upper.any():
        return np.asarray(upper)
    lid_height = np.average(height[upper], weights=areas[upper])
    return np.asarray(upper & (height > lid_height - LID_HEIGHT_MM))


def segment_names(
    inner: Surface, walled: Mask, axis: Float, right: Surface | None, mirrored: bool = False
) -> Names:
    """Name ``(n,)`` of the segment of each vertex of the cavity's surface; "" on the lid.

    Basal, mid and apical are thirds of the cavity's length along its axis, the apex the lowest
    tenth. The septum's middle looks at the centre of the right ventricle beside the middle third,
    which lies half-way between where that ventricle is attached (its outflow leans over the
    anterior wall); seen from the apex the anterior wall follows clockwise, at axis x septum, but in
    a mirror image.
    """
    points = inner.vertices_mm - np.average(
        inner.vertices_mm, axis=0, weights=vertex_areas(inner.vertices_mm, inner.triangles)
    )
    height = points @ axis
    low, high = height[walled].min(), height[walled].max()
    share = (height - low) / (high - low)
    level = np.select([share < 1 / 3, share < 2 / 3], ["apical", "mid"], "basal")
    if right is not None:
        beside = right.vertices_mm - inner.vertices_mm.mean(axis=0)
        part = (points.mean(axis=0) + beside) @ axis
        middle = (part > low + (high - low) / 3) & (part < high - (high - low) / 3)
        centre = beside[middle if middle.any() else slice(None)].mean(axis=0)
        septum = centre - (centre @ axis) * axis
        septum /= np.linalg.norm(septum)
        anterior = np.cross(axis, septum) * (-1 if mirrored else 1)
        degrees = np.degrees(np.arctan2(points @ anterior, points @ septum)) % 360
        six = np.array(RING)[(degrees // 60).astype(int) % 6]
        four = np.array(APICAL_RING)[((degrees + 45) // 90).astype(int) % 4]
        around = np.where(level == "apical", four, six)
        level = np.char.add(np.char.add(level, " "), around)
    names = np.where(share < APEX_SHARE, "apex", level)
    return np.asarray(np.where(walled, names, ""))


def distances_mm(points_mm: Float, surface: Surface) -> Float:
    """Distance ``(n,)`` from points to the nearest point of a surface's triangles, unsigned."""
    return np.abs(ExactSurface(surface).distance_mm(points_mm))


def _to_wall(points_mm: Float, outer: Surface, axis: Float | None) -> Float:
    """Distance of points to the outer surface without its lid."""
    if axis is not None:
        lid = on_lid(outer, axis)
        kept = ~lid[outer.triangles].all(axis=1)
        outer = Surface(outer.vertices_mm, outer.triangles[kept])
    return distances_mm(points_mm, outer)


def _mean(values: Float, weights: Float, chosen: Mask) -> Float:
    return np.asarray(np.average(values[:, chosen], axis=1, weights=weights[chosen]))


def _ordered(names: Names) -> list[str]:
    """Segments that are there, base first, in the order of the standard."""
    rings = [f"{level} {name}" for level in ("basal", "mid") for name in AHA_RING]
    rings += [f"apical {name}" for name in AHA_APICAL_RING]
    return [name for name in (*rings, "basal", "mid", "apical", "apex") if name in names]
