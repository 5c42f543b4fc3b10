"""The tables of benchmarks/segmentation_places.py: points whose place and distance are known."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from data_synth.population import draw_heart

FOLDER = str(Path(__file__).parents[1] / "benchmarks")
sys.path.insert(0, FOLDER)
places = importlib.import_module("segmentation_places")
sys.path.remove(FOLDER)


@pytest.fixture(scope="module")
def heart():
    return draw_heart(np.random.default_rng(3))


@pytest.mark.parametrize("phase", [0.0, 0.4])
@pytest.mark.parametrize(
    ("name", "place", "rest_mm"),
    [
        ("lv_endocardium", "tip", lambda s, t: (0, 0, -0.95 * s.lv_length)),
        ("lv_endocardium", "elsewhere", lambda s, t: (s.lv_radius, 0, -0.5 * s.lv_length)),
        ("lv_endocardium", "base", lambda s, t: (s.lv_radius, 0, -0.05 * s.lv_length)),
        ("rv_endocardium", "outflow", lambda s, t: t.outflow[-1, :3]),
        ("left_atrium", "appendage", lambda s, t: t.appendage[-1, :3]),
        ("left_atrium", places.STUBS, lambda s, t: t.veins[2, 1, :3]),
        ("left_atrium", "roof", lambda s, t: (s.la_x, s.la_y, s.la_z + s.la_radius_z)),
        ("right_atrium", "valve plane", lambda s, t: (s.ra_x, s.ra_y, 1.0)),
        ("aorta", "end", lambda s, t: t.aorta[-1, :3]),
        ("aorta", "elsewhere", lambda s, t: t.aorta[4, :3]),
        ("heart", "atria and vessels", lambda s, t: t.aorta[4, :3]),
    ],
)
def test_material_keeps_its_place_through_the_beat(heart, name, place, rest_mm, phase):
    point = np.array([rest_mm(heart.shape, heart.tubes)], float)
    here_mm = heart.carry(heart.into_patient(point), phase)
    assert places.places(name, heart, here_mm, phase) == [place]


@pytest.mark.parametrize("order", [1, -1])
def test_the_last_slice_is_the_one_at_the_base_whichever_way_slices_run(heart, order):
    frame = np.eye(4)
    frame[:3, :3] = heart.rotation * (1.4, 1.4, 10.0 * order)
    frame[:3, 3] = heart.centre_mm - order * 45 * heart.long_axis
    roof = places.roof_of(frame, 10, heart)
    above_mm = heart.centre_mm + np.array([[44.0], [46.0]]) * heart.long_axis
    np.testing.assert_array_equal(roof.is_above(above_mm), [False, True])


def found_and_true(off_mm, lies):
    """Equal distances on either surface."""
    both = np.concatenate([off_mm, off_mm])
    return places.Points(np.tile(lies, 2), both, np.arange(len(both)) >= len(off_mm))


def test_shares_and_signs_are_those_of_the_points():
    one = found_and_true(np.array([0.0, 0.0, 4.0, -5.0]), np.array(["wall", "wall", "tip", "tip"]))
    tip, wall = places.rows("aorta", [one], 3.5)
    # Two of four points of either surface are far off, both at the tip.
    assert tip == ["aorta", "tip", "50 %", "50.00 %", "50.00 %", "4.50", "-0.50"]
    assert wall == ["aorta", "wall", "50 %", "0.00 %", "0.00 %", "0.00", "+0.00"]


@pytest.mark.parametrize("unknown", [places.BEYOND, places.STUBS])
def test_what_no_image_tells_is_left_out_of_the_distances(unknown):
    lies = np.array(["wall"] * 50 + [unknown] * 50)
    one = found_and_true(np.array([1.0] * 50 + [-19.0] * 50), lies)
    mean_mm, far_mm = places.where_images_tell([one])
    np.testing.assert_allclose([mean_mm, far_mm], 1.0)
