"""Training images show chambers of other sizes, and hearts at their worst; nothing folds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from data_synth.tissue import Tissue
from data_synth.training.ends import far_right_ventricle, first_ventricle, shut_tip
from data_synth.training.render import ALL_PARTS, draw_sample
from data_synth.training.sizes import (
    flat_septum,
    ill_shape,
    other_sizes,
    other_span,
    swollen,
)

SIDE, MIDDLE = 96, 48
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(np.float64)
AWAY = np.hypot(ROWS - MIDDLE, COLUMNS - MIDDLE)
OUTER, INNER = 22, 12
"""Radii of the left ventricle and its cavity, pixels."""


def short_axis(turn=0.0):
    """A left ventricle in the middle, the right one to the left of it, or ``turn`` from there."""
    there = MIDDLE - 20 * np.array([np.sin(turn), np.cos(turn)])
    aside = np.hypot(ROWS - there[0], COLUMNS - there[1])
    plane = np.full((SIDE, SIDE), Tissue.FAT)
    plane[aside < 24] = Tissue.RV_CAVITY
    plane[AWAY < OUTER] = Tissue.LV_MYOCARDIUM
    plane[AWAY < INNER] = Tissue.LV_CAVITY
    return plane.astype(np.uint8)


def seen(plane, rows, columns):
    """What the plane shows at the pixels nearest to the places."""
    near = np.rint([rows, columns]).astype(int).clip(0, SIDE - 1)
    return plane[tuple(near)]


def areas(rows, columns):
    """How much of the plane each pixel takes in: negative where it folds."""
    found = np.diff(rows, axis=0)[:, :-1] * np.diff(columns, axis=1)[:-1]
    return found - np.diff(rows, axis=1)[:-1] * np.diff(columns, axis=0)[:, :-1]


def test_other_structures_change_size_and_nothing_folds():
    plane = short_axis()
    plane[np.hypot(ROWS - 20, COLUMNS - 70) < 6] = Tissue.AORTA
    sizes = []
    for seed in range(80):
        places = other_sizes(np.random.default_rng(seed), plane, ROWS, COLUMNS)
        assert areas(*places).min() > 0
        sizes.append((seen(plane, *places) == Tissue.AORTA).sum())
    assert np.std(sizes) > 0.1 * np.mean(sizes)


@given(st.integers(0, 1000), st.floats(-0.9, 2.1))
def test_a_cavity_changes_as_asked_and_nothing_folds(seed, factor):
    plane = short_axis()
    places = swollen(np.random.default_rng(seed), plane, ROWS, COLUMNS, factor=factor, offset=0.0)
    assert areas(*places).min() > 0
    # About the middle everything is seen 1 + a times as small; a pixel from it, where reach is 8 of
    # them, 0.03 less.
    steps = np.diff(places[0], axis=0)[MIDDLE - 1 : MIDDLE + 1, MIDDLE]
    assert steps.mean() == pytest.approx(1 + factor, abs=0.03)
    taken_at = np.hypot(places[0] - MIDDLE, places[1] - MIDDLE)
    assert ((taken_at - AWAY) * factor > -1e-9).all()
    # The least reach, 0.7 radii, leaves 0.13 of the change at the border.
    border = np.abs(taken_at - AWAY)[(AWAY > INNER - 1) & (AWAY < INNER)]
    assert (border > 0.1 * INNER * abs(factor) - 1e-9).all()


@given(st.floats(0.05, 0.95), st.floats(-np.pi, np.pi), st.booleans())
def test_a_flat_septum_is_a_chord_as_thick_as_the_arc(flatness, turn, thin):
    plane = short_axis(turn)
    # A right ventricle less deep than the push is long.
    thin_right = plane.copy()
    thin_right[(plane == Tissue.RV_CAVITY) & (AWAY > OUTER + 5)] = Tissue.FAT
    towards = -np.array([np.sin(turn), np.cos(turn)])
    # All moves go one way: nothing folds if places keep their order along it, and nothing is seen
    # more than three times as large.
    way, beside = np.meshgrid(np.linspace(-40, 40, 161), np.linspace(-30, 30, 61), indexing="ij")
    rows = MIDDLE + way * towards[0] + beside * towards[1]
    columns = MIDDLE + way * towards[1] - beside * towards[0]
    moved = flat_septum(thin_right if thin else plane, rows, columns, flatness)
    order = (moved[0] - MIDDLE) * towards[0] + (moved[1] - MIDDLE) * towards[1]
    assert np.diff(order, axis=0).min() > 0.99 * 0.5 / 3
    shown = seen(plane, *flat_septum(plane, ROWS, COLUMNS, flatness))
    along = (ROWS - MIDDLE) * towards[0] + (COLUMNS - MIDDLE) * towards[1]
    across = np.abs((COLUMNS - MIDDLE) * towards[0] - (ROWS - MIDDLE) * towards[1])
    chord = (1 - flatness) * OUTER
    # Clear of the corner where the chord ends. Pixels are half a diagonal off where drawn and where
    # looked up: 1.4 pixels, and 2.4 along the way where the arc is as steep as at 0.8 radii.
    facing = across < np.minimum(np.sqrt(OUTER**2 - chord**2) - 2, 0.8 * OUTER)
    # Along the way: off the middle the arc's wall is longer, by half a pixel here.
    inner, near = chord - (OUTER - INNER), across < 3
    assert (
        shown[near & (along < chord - 1.5) & (along > inner + 1.5)] == Tissue.LV_MYOCARDIUM
    ).all()
    beneath = near & (along < inner - 2) & (along > -INNER + 1.5)
    assert (shown[beneath] == Tissue.LV_CAVITY).all()
    beyond = facing & (along > chord + 2.5) & (along < OUTER)
    assert (shown[beyond] == Tissue.RV_CAVITY).all()
    # The side wall stays, and so does what the septum does not face.
    other = (along < -OUTER) | (across > OUTER + 1)
    np.testing.assert_array_equal(shown[other], plane[other])
    for tissue, change in ((Tissue.RV_CAVITY, 1), (Tissue.LV_CAVITY, -1)):
        grown = (shown == tissue).sum() - (plane == tissue).sum()
        assert change * grown > -10


@given(st.integers(0, 10_000), st.floats(-np.pi, np.pi))
def test_a_right_ventricle_spans_another_angle_and_nothing_folds(seed, turn):
    plane = short_axis(turn)
    places = other_span(np.random.default_rng(seed), plane, ROWS, COLUMNS)
    # Where angles are most shrunk or stretched, kinks between pixels cost up to half of an area.
    assert areas(*places).min() > 0
    # The left ventricle is turned within itself; nothing comes nearer or goes farther away.
    away = np.hypot(places[0] - MIDDLE, places[1] - MIDDLE)
    np.testing.assert_allclose(away, AWAY, atol=0.1)
    # Clear of borders, which pixels show within one of them.
    clear = (AWAY < OUTER - 1) & (np.abs(AWAY - INNER) > 1)
    np.testing.assert_array_equal(seen(plane, *places)[clear], plane[clear])


def test_right_ventricles_reach_farther_more_often_than_less_far():
    plane = short_axis()
    before = (plane == Tissue.RV_CAVITY).sum()
    sizes = []
    for seed in range(200):
        shown = seen(plane, *other_span(np.random.default_rng(seed), plane, ROWS, COLUMNS))
        sizes.append((shown == Tissue.RV_CAVITY).sum() / before)
    # Each end is drawn 15 degrees nearer to 45 farther: both together span more in 1 - 30^2 / (2
    # 60^2) of all, 0.875. Three deviations of a share of 200 are 0.07; ends are not equally wide.
    assert np.mean(np.array(sizes) > 1) == pytest.approx(0.875, abs=0.1)
    assert min(sizes) < 0.95
    assert max(sizes) > 1.3


def test_a_plane_along_the_ventricle_or_without_both_keeps_its_septum_and_span():
    long_axis = short_axis()
    long_axis[(np.abs(COLUMNS - MIDDLE) < 8) & (ROWS < MIDDLE)] = Tissue.LV_MYOCARDIUM
    no_right, no_left = short_axis(), short_axis()
    no_right[no_right == Tissue.RV_CAVITY] = Tissue.LUNG
    no_left[AWAY < OUTER] = Tissue.LUNG
    for plane in (long_axis, no_right, no_left):
        spanned = other_span(np.random.default_rng(0), plane, ROWS, COLUMNS)
        for rows, columns in (flat_septum(plane, ROWS, COLUMNS, 0.5), spanned):
            np.testing.assert_array_equal(rows, ROWS)
            np.testing.assert_array_equal(columns, COLUMNS)


def test_hearts_at_their_worst_are_a_third_of_all_and_of_all_kinds():
    plane, shown = short_axis(), []
    for seed in range(400):
        places = ill_shape(np.random.default_rng(seed), plane, ROWS, COLUMNS)
        assert areas(*places).min() > -1e-3
        found = seen(plane, *places)
        shown.append([(found == t).sum() for t in (Tissue.LV_CAVITY, Tissue.RV_CAVITY)])
    left, right = np.array(shown).T / [[(plane == Tissue.LV_CAVITY).sum()],
                                       [(plane == Tissue.RV_CAVITY).sum()]]  # fmt: skip
    # Three deviations of a share of 400 drawn are 7 points at most.
    changed = (left != 1) | (right != 1)
    assert changed.mean() == pytest.approx(0.34, abs=0.07)
    for some in (right > 1.1, left < 0.6, left > 1.3):
        assert 0.02 < some.mean() < 0.2


def test_a_nearly_shut_ventricle_has_a_thick_wall_thicker_on_one_side():
    plane, walls_px, off = short_axis(), [], []
    for seed in range(400):
        found = seen(plane, *ill_shape(np.random.default_rng(seed), plane, ROWS, COLUMNS))
        cavity, muscle = (found == t for t in (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM))
        if cavity.sum() < 0.6 * np.pi * INNER**2:
            walls_px.append(
                np.sqrt((cavity | muscle).sum() / np.pi) - np.sqrt(cavity.sum() / np.pi)
            )
            middles = [np.argwhere(one).mean(axis=0) for one in (cavity, cavity | muscle)]
            off.append(np.linalg.norm(middles[0] - middles[1]))
    assert np.mean(walls_px) > 1.2 * (OUTER - INNER)
    # An offset of 0.3 radii a coordinate is 4.5 pixels on average, and part of it remains.
    assert np.mean(off) > 1


RIGHT = (Tissue.RV_CAVITY, Tissue.RV_TRABECULA)


def tapering():
    """Planes from below the tip to the base: both ventricles widen, the right one from later on."""
    planes = np.full((24, SIDE, SIDE), Tissue.LUNG, np.uint8)
    planes[:, :28] = Tissue.MUSCLE
    for number in range(6, 24):
        plane, size = planes[number], np.sqrt((number - 5) / 18)
        if number > 8:
            there = np.hypot(ROWS - MIDDLE, COLUMNS - MIDDLE + 20 * size)
            plane[there < 24 * size + 2] = Tissue.RV_WALL
            plane[there < 24 * size] = Tissue.RV_CAVITY
            plane[(there < 24 * size) & (ROWS % 6 == 0) & (COLUMNS % 6 == 0)] = Tissue.RV_TRABECULA
        plane[size * OUTER > AWAY] = Tissue.LV_MYOCARDIUM
        plane[size * OUTER - 6 > AWAY] = Tissue.LV_CAVITY
    return planes


@pytest.mark.parametrize("farther", [1, 3, 7])
def test_a_far_right_ventricle_lies_against_the_left_one_in_a_wall_of_its_own(farther):
    planes = tapering()
    lower = far_right_ventricle(planes, farther)
    was, first = (np.isin(one, RIGHT).any(axis=(1, 2)).argmax() for one in (planes, lower))
    assert first == max(was - farther, 0) if farther < 3 else first <= was - farther + 1
    np.testing.assert_array_equal(lower[-2:], planes[-2:])
    left = np.isin(planes, (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM))
    np.testing.assert_array_equal(lower[left], planes[left])
    np.testing.assert_array_equal(lower[planes == Tissue.MUSCLE], Tissue.MUSCLE)
    assert (lower[first : first + 2] == Tissue.RV_TRABECULA).any()
    for plane, before, ventricle in zip(lower, planes, left, strict=True):
        right = np.isin(plane, RIGHT)
        assert right.sum() >= np.isin(before, RIGHT).sum()
        # One body; of its own border nothing lies against lung; no wall lies inside it.
        assert ndimage.label(right | ventricle)[1] <= 1
        if right.any():
            around = ndimage.binary_dilation(right) & ~right
            assert not (around & np.isin(plane, (Tissue.LUNG, Tissue.PERICARDIUM))).any()
            # The septum has blood on its other side.
            beside = ndimage.binary_dilation(ventricle, iterations=2) & ~ventricle
            assert np.isin(plane[beside & (COLUMNS < MIDDLE - 6) & (ROWS == MIDDLE)], RIGHT).all()
            whole = right | ventricle
            assert (ndimage.binary_fill_holes(whole) == whole).all()


@pytest.mark.parametrize(("closed", "over"), [(9, 0), (9, 4), (14, 7)])
def test_a_shut_tip_is_solid_and_opens_over_the_planes_asked_for(closed, over):
    planes = tapering()
    shut = shut_tip(planes, closed, over)
    was, cavity = (one == Tissue.LV_CAVITY for one in (planes, shut))
    np.testing.assert_array_equal(
        shut[planes != Tissue.LV_CAVITY], planes[planes != Tissue.LV_CAVITY]
    )
    assert (shut[was & ~cavity] == Tissue.LV_MYOCARDIUM).all()
    assert not cavity[:closed].any()
    np.testing.assert_array_equal(cavity[closed + over :], was[closed + over :])
    share = (
        cavity.sum(axis=(1, 2))[closed : closed + over]
        / was.sum(axis=(1, 2))[closed : closed + over]
    )
    assert (share < 1).all()
    assert (np.diff(share) > 0).all()
    # Linear in the radius: k / (over + 1) of it, and a rim of a pixel.
    wanted = ((np.arange(over) + 1) / (over + 1)) ** 2
    np.testing.assert_allclose(share, wanted, atol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("ill", [True, False])
def test_hearts_at_their_worst_are_among_what_is_drawn_where_asked_for(monkeypatch, ill):
    asked, tips = {"far_right_ventricle": [], "shut_tip": [], "ill_shape": []}, []

    def noted(name):
        def drawn(first, *others):
            asked[name].append(others)
            if name == "shut_tip":
                tips.append(first)
            return first if name != "ill_shape" else others[1:]

        return drawn

    for name in asked:
        monkeypatch.setattr(f"data_synth.training.render.{name}", noted(name))
    block = np.concatenate([tapering()[:6], np.repeat(tapering()[6:], 2, axis=0)])
    for seed in range(200):
        draw_sample(np.random.default_rng(seed), block, replace(ALL_PARTS, ill=ill))
    assert len(asked["ill_shape"]) == 200 * ill
    # Three deviations of 0.12 drawn 200 times are 0.07.
    for name in ("far_right_ventricle", "shut_tip"):
        assert len(asked[name]) / 200 == pytest.approx(0.12 * ill, abs=0.07 * ill)
    if ill:
        farther = [by for (by,) in asked["far_right_ventricle"]]
        assert 1 <= min(farther) < max(farther) <= 7
        closed, over = np.array(asked["shut_tip"]).T
        # From the first plane that shows much of the cavity; tips may have been drawn anew before.
        first = [first_ventricle(planes) for planes in tips]
        assert 0 <= (closed - first).min() < (closed - first).max() <= 11
        assert 0 <= over.min() < over.max() <= 7
