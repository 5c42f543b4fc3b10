"""The muscle's outside by the dark line: discs whose signal is known before it is averaged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from skimage.measure import find_contours

from pipeline.imaging.cine import Cine
from pipeline.imaging.dark_line import BEYOND_PX, STEP_PX, end_at_dark_line
from pipeline.imaging.inference import PlaneProbability
from pipeline.imaging.labels import LABELS
from pipeline.imaging.view import view_of

SIDE, PIXEL_MM, FINE = 64, 1.5, 10
CAVITY, MUSCLE, RIGHT = (LABELS[name] for name in ("lv_cavity", "lv_myocardium", "rv_cavity"))
BLOOD_GREY, MUSCLE_GREY, LUNG_GREY = 1.0, 0.3, 0.05
WALL_MM = 9.0


def away_mm(centre_mm, fine=1):
    """Distance of every pixel, or of ``fine`` points along each of its sides, from a point."""
    axis = (np.arange(SIDE * fine) - (fine - 1) / 2) / fine * PIXEL_MM
    return np.hypot(axis[:, None] - centre_mm[0], axis[None, :] - centre_mm[1])


def image(radius_mm, centre_mm, fat_grey, fat_mm=9.0, sharp=0.0):
    """What a magnitude image shows of a ventricle with fat about it, whose signal is opposed."""
    away = away_mm(centre_mm, FINE)
    signal = np.select(
        [away < radius_mm - WALL_MM, away < radius_mm, away < radius_mm + fat_mm],
        [BLOOD_GREY, MUSCLE_GREY, -fat_grey],
        LUNG_GREY,
    )
    signal = ndimage.gaussian_filter(signal, sharp * FINE)
    return np.abs(signal.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3)))


def drawn(outside_mm, radius_mm, centre_mm, right=None):
    """Probabilities of a network that puts the muscle's outside elsewhere."""
    away = away_mm(centre_mm)
    chance = np.zeros((1 + len(LABELS), SIDE, SIDE), np.float32)
    body = 1 / (1 + np.exp((away - outside_mm) / 0.4))
    cavity = 1 / (1 + np.exp((away - radius_mm + WALL_MM) / 0.4))
    chance[CAVITY], chance[MUSCLE], chance[0] = cavity, body - cavity, 1 - body
    if right is not None:
        chance[RIGHT, right], chance[0, right] = chance[0, right], 0
    return chance


def study(pictures, planes):
    """A cine of so many slices of one phase, and probabilities on as many planes each as given."""
    frame = np.diag([PIXEL_MM, PIXEL_MM, 10.0, 1.0])
    cine = Cine(np.stack(pictures)[None].astype(np.float32), frame, np.zeros(1), 1.0)
    view = view_of(cine)
    assert view.order == tuple(range(len(pictures)))
    assert view.image_from_view(0) == pytest.approx(np.eye(2, 3), abs=1e-9)
    value = np.concatenate(planes)[None].copy()
    return PlaneProbability(value, view, len(planes[0])), cine


def outside_mm(plane, centre_mm):
    """Distances from the centre at which the plane's muscle ends, all about it."""
    contour = max(find_contours(plane[CAVITY] + plane[MUSCLE], 0.5), key=len)
    return np.linalg.norm(contour * PIXEL_MM - centre_mm, axis=1)


def line_px(fat_grey, sharp):
    """How far outside a straight edge a picture of pixels is darkest, in one dimension.

    Pixels average over their width and lose their sign; between their centres, which lie anywhere,
    grey values run straight: the mean of all such pictures is what a triangle blurs.
    """
    fine = 200
    x = np.arange(-6, 6, 1 / fine)
    signal = ndimage.gaussian_filter1d(np.where(x < 0, MUSCLE_GREY, -fat_grey), sharp * fine)
    pixel = np.abs(ndimage.uniform_filter1d(signal, fine))
    shown = ndimage.uniform_filter1d(ndimage.uniform_filter1d(pixel, fine), fine)
    return x[shown.argmin()]


@given(
    radius_mm=st.floats(22, 30),
    offset=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    error_mm=st.floats(-0.4, 1.6),
    fat_grey=st.floats(0.4, 1.0),
    sharp=st.floats(0.2, 0.5),
)
@settings(max_examples=25, deadline=None)
def test_muscle_ends_half_a_pixel_beyond_where_signals_cancel(
    radius_mm, offset, error_mm, fat_grey, sharp
):
    """Whatever outline was given: to half a step of the search on average, to two all about."""
    centre_mm = PIXEL_MM * (SIDE / 2 + np.array(offset))
    picture = image(radius_mm, centre_mm, fat_grey, sharp=sharp)
    planes = np.stack([drawn(radius_mm + error_mm, radius_mm, centre_mm)] * 3)
    found, cine = study([picture], [planes])

    end_at_dark_line(found, cine)

    for plane in found.value[0]:
        off_px = (outside_mm(plane, centre_mm) - radius_mm) / PIXEL_MM
        wanted_px = BEYOND_PX + line_px(fat_grey, sharp)
        assert off_px.mean() == pytest.approx(wanted_px, abs=STEP_PX / 2)
        assert off_px == pytest.approx(wanted_px, abs=2 * STEP_PX)
        np.testing.assert_allclose(plane.sum(axis=0), 1, atol=1e-5)


@pytest.mark.parametrize("brighter", [2.0, 2.5, 3.0])
def test_half_a_pixel_is_what_fat_of_cine_makes_of_an_edge(brighter):
    """Of fat two to three times as bright as muscle, in a scanner's pixels."""
    assert line_px(brighter * MUSCLE_GREY, 0.45) == pytest.approx(-BEYOND_PX, abs=0.2)


def test_without_fat_nothing_moves():
    """Dark muscle against darker lung has no line, whatever the outline."""
    centre_mm = np.full(2, PIXEL_MM * SIDE / 2)
    picture = image(26, centre_mm, fat_grey=0.5, fat_mm=0.0)
    planes = np.stack([drawn(27.5, 26, centre_mm)])
    found, cine = study([picture], [planes])
    before = found.value.copy()

    end_at_dark_line(found, cine)

    np.testing.assert_array_equal(found.value, before)


def test_only_the_side_on_fat_moves_and_neither_cavity_nor_other_chambers():
    centre_mm = np.full(2, PIXEL_MM * SIDE / 2)
    left = np.arange(SIDE)[None, :] * PIXEL_MM < centre_mm[1]
    with_fat = image(26, centre_mm, 0.8)
    picture = np.where(left, image(26, centre_mm, -BLOOD_GREY), with_fat)
    right = left & (away_mm(centre_mm) > 27.2)
    planes = np.stack([drawn(27.2, 26, centre_mm, right)] * 3)
    found, cine = study([picture], [planes])
    before = found.value.copy()

    end_at_dark_line(found, cine)

    changed = (np.abs(found.value - before) > 0.05).any(axis=(0, 1, 2))
    assert changed[:, SIDE // 2 + 8 :].any()
    assert not changed[:, : SIDE // 2 - 8].any()
    in_cavity = away_mm(centre_mm) < 26 - WALL_MM
    np.testing.assert_array_equal(found.value[..., in_cavity], before[..., in_cavity])
    # But for where all three meet.
    right_pixels = (before[..., RIGHT, :, :] > 0.5).sum()
    gained = found.value[..., RIGHT, :, :] - before[..., RIGHT, :, :]
    assert np.abs(gained).sum() < 0.005 * right_pixels


def test_each_slice_moves_its_own_planes_by_its_own_image():
    centre_mm = np.full(2, PIXEL_MM * SIDE / 2)
    planes = np.stack([drawn(27.5, 26, centre_mm)] * 3)
    fat, lung = image(26, centre_mm, 0.8), image(26, centre_mm, 0.8, fat_mm=0.0)
    found, cine = study([lung, fat, lung], [planes] * 3)
    before = found.value.copy()

    end_at_dark_line(found, cine)

    moved = (found.value != before).any(axis=(0, 2, 3, 4))
    assert moved.tolist() == [False] * 3 + [True] * 3 + [False] * 3


@pytest.mark.parametrize("fat_mm", [0.0, 9.0])
def test_greys_that_were_shifted_give_the_same(fat_mm):
    """As research formats have them: muscle is as good as 0 then, or as bright as blood, and no
    measure of what it was; and one pixel may be darker than nothing, as splines make it."""
    centre_mm = np.full(2, PIXEL_MM * SIDE / 2)
    noise = 0.02 * np.random.default_rng(1).normal(size=(SIDE, SIDE))
    picture = np.abs(image(26, centre_mm, 0.8, fat_mm) + noise)
    # Signal and nothing else is what the darkest pixel shows.
    picture -= picture.min()
    planes = np.stack([drawn(27.5, 26, centre_mm)])
    moved = []
    for shift, lowest in ((0.0, 0.0), (MUSCLE_GREY, 0.0), (-20.0, 0.0), (0.0, -20.0)):
        shown = picture - shift
        shown[0, 0] += lowest
        found, cine = study([shown], [planes])
        end_at_dark_line(found, cine)
        moved.append(found.value)

    for other in moved[1:]:
        np.testing.assert_allclose(moved[0], other, atol=1e-3)


def test_images_without_muscle_and_constant_ones_stay_as_they_are():
    centre_mm = np.full(2, PIXEL_MM * SIDE / 2)
    empty = np.zeros((1, 1 + len(LABELS), SIDE, SIDE), np.float32)
    empty[:, 0] = 1
    found, cine = study(
        [image(26, centre_mm, 0.8), np.ones((SIDE, SIDE))],
        [empty, np.stack([drawn(27.5, 26, centre_mm)])],
    )
    before = found.value.copy()

    end_at_dark_line(found, cine)

    np.testing.assert_array_equal(found.value, before)
