"""The picture of expected registration error: what is seen, and in which colour."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
import pyvista as pv
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection

from pipeline.geometry import MovingSurface
from pipeline.report.certainty import LEAST_TOP_MM, expected_error, seen_from

RADIUS_MM = 30.0


def ball(centre=(10.0, 20.0, 30.0)) -> MovingSurface:
    sphere = pv.Icosphere(radius=RADIUS_MM, center=centre, nsub=3)
    triangles = np.asarray(sphere.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
    return MovingSurface(np.asarray(sphere.points, float)[None], triangles, np.array([0.0]))


def corners_of(moving: MovingSurface) -> np.ndarray:
    return moving.vertices_mm[0][moving.triangles]


@pytest.mark.parametrize("towards", [(0.5, -1.0, 0.25), (-0.5, 1.0, -0.25), (3.0, 0.0, 0.0)])
def test_what_faces_the_viewer_covers_the_shadow_of_a_ball(towards):
    """A convex body hides none of its facing side: its triangles' pictures add up to a disc."""
    corners = corners_of(ball())
    facing, shape, light = seen_from(corners, np.array(towards))
    a, b, c = shape.transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    # Seen from outside an outward triangle runs anticlockwise: no area is negative.
    assert (area > 0).all()
    # 1280 flat triangles on a sphere of edge h = 5 mm lie up to h^2 / 8 r = 0.1 mm inside it:
    # 0.7 % of the disc.
    assert area.sum() == pytest.approx(np.pi * RADIUS_MM**2, rel=1e-2)
    depth = corners[facing].mean(axis=1) @ np.array(towards)
    assert (np.diff(depth) >= 0).all()
    assert light.max() == pytest.approx(1.0, abs=0.01)
    assert light.min() >= 0.7


def test_head_is_up_and_left_is_right_when_seen_from_the_front():
    """As a physician faces a patient: LPS (0, -1, 0) is in front, +z up, +x (left) on the right."""
    square = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    _, shape, _ = seen_from(square, np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(shape[0], [[0, 0], [1, 0], [0, 1]], atol=1e-12)


def test_colours_follow_the_expected_error_on_the_scale_that_is_drawn():
    surfaces = {"epicardium": ball(), "left_atrium": ball((10.0, 20.0, 80.0))}
    figure = expected_error(surfaces, lambda points_mm: points_mm[:, 2] / 10)
    painted = [one for axis in figure.axes for one in axis.collections]
    painted = [one for one in painted if isinstance(one, PolyCollection)][:2]
    # From z = 0 to z = 110 mm, less half a triangle.
    low, high = painted[1].get_clim()
    assert low == pytest.approx(0.0, abs=0.05)
    assert high == pytest.approx(11.0, abs=0.05)
    viridis = matplotlib.colormaps["viridis"]
    for one in painted:
        height = np.array([path.vertices[:3, 1].mean() for path in one.get_paths()])
        colours = one.get_facecolors()
        # The share of red, green and blue does not depend on the light.
        for place, value in ((height.argmin(), 0.0), (height.argmax(), 1.0)):
            expected = np.array(viridis(value)[:3])
            found = colours[place, :3]
            np.testing.assert_allclose(found / found.sum(), expected / expected.sum(), atol=0.05)
    label = figure.axes[-1].get_ylabel()
    assert label == "expected error (mm)"
    FigureCanvasAgg(figure).draw()


def test_a_small_error_everywhere_has_not_the_colours_of_a_large_one():
    figure = expected_error({"epicardium": ball()}, lambda points_mm: 0.4 + 0 * points_mm[:, 0])
    painted = next(one for one in figure.axes[0].collections if isinstance(one, PolyCollection))
    assert painted.get_clim() == (0, LEAST_TOP_MM)
