"""A part whose triangles are pressed together is opened again; the rest of the mesh stays."""

from __future__ import annotations

import numpy as np
from surface_shapes import crossing_triangles as pierced
from surface_shapes import smooth_level, two_lobes

from pipeline.geometry import Float, Surface
from pipeline.surface.crossings import crossing_triangles
from pipeline.surface.mesh import bad_triangles, extract_surface
from pipeline.surface.unfolding import make_unfolder

REST = extract_surface(smooth_level(two_lobes, (36, 30, 30)), 2.5)
UNFOLDER = make_unfolder(REST)
LOW = REST.vertices_mm[:, 0].min()


def pressed() -> Float:
    """The last 8 mm of the smaller lobe pinched flat, to a fiftieth of its width."""
    spoiled = REST.vertices_mm + np.array([3.0, -2.0, 1.0])
    tip = REST.vertices_mm[:, 0] < LOW + 8
    middle = spoiled[tip, 1].mean()
    spoiled[tip, 1] = middle + 0.02 * (spoiled[tip, 1] - middle)
    return spoiled


def test_a_pinched_part_is_opened_and_what_is_far_from_them_stays():
    """Where to act is smoothed over 2 edges, 5 mm: e^-7 of it is left 35 mm away."""
    spoiled = pressed()
    assert bad_triangles(spoiled, REST.triangles).any()

    mended = UNFOLDER.mended(spoiled, bad_triangles)

    assert not bad_triangles(mended, REST.triangles).any()
    assert pierced(Surface(mended, REST.triangles)) == 0
    far = REST.vertices_mm[:, 0] > LOW + 35
    assert np.abs(mended - spoiled)[far].max() < 0.05


def test_a_mesh_that_passes_through_itself_is_mended_by_its_crossings_alone():
    spoiled = REST.vertices_mm.copy()
    top = spoiled[:, 2].argmax()
    near = np.linalg.norm(spoiled[:, :2] - spoiled[top, :2], axis=1) < 3
    spoiled[near & (spoiled[:, 2] > spoiled[top, 2] - 3), 2] -= 45
    assert crossing_triangles(spoiled, REST.triangles).any()
    mended = UNFOLDER.mended(spoiled, crossing_triangles)
    assert pierced(Surface(mended, REST.triangles)) == 0


def test_a_sound_mesh_is_returned_as_it_is():
    moved = REST.vertices_mm * (1.1, 0.9, 1.0) + 4
    assert UNFOLDER.mended(moved, bad_triangles) is moved
