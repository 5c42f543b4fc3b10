"""Training images show what few hearts and scanners do: scars, thick right walls, filters."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from data_synth.tissue import Tissue
from data_synth.training import render
from data_synth.training.faults import filtered
from data_synth.training.rare import bulged, draw_scar, scarred, thick_right_walled
from data_synth.training.render import ALL_PARTS, draw_sample

SIDE, MIDDLE = 96, 48
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(np.float64)
AWAY = np.hypot(ROWS - MIDDLE, COLUMNS - MIDDLE)
RIGHT_AWAY = np.hypot(ROWS - MIDDLE, COLUMNS - 32)
OUTER, INNER = 22, 12
"""Radii of the left ventricle and its cavity, pixels."""


def short_axis(around=Tissue.LUNG):
    """A left ventricle in the middle, the right one with a wall of two pixels to the left of it."""
    plane = np.full((SIDE, SIDE), around)
    plane[RIGHT_AWAY < 24] = Tissue.RV_WALL
    plane[RIGHT_AWAY < 22] = Tissue.RV_CAVITY
    plane[AWAY < OUTER] = Tissue.LV_MYOCARDIUM
    plane[AWAY < INNER] = Tissue.LV_CAVITY
    return plane.astype(np.uint8)


@pytest.mark.parametrize("layers", [1, 4])
def test_a_right_wall_grows_outwards_by_as_many_pixels_and_takes_nothing_that_stays(layers):
    plane = short_axis()
    plane[(ROWS < 32) & (plane == Tissue.LUNG)] = Tissue.BLOOD_VESSEL
    plane[(ROWS > 64) & (plane == Tissue.LUNG)] = Tissue.BONE
    (found,) = thick_right_walled(plane[None], layers)
    changed = found != plane
    assert set(found[changed]) == {Tissue.RV_WALL}
    assert set(plane[changed]) == {Tissue.LUNG}
    assert changed[MIDDLE, :MIDDLE].sum() == layers
    # Half a pixel each for the rim of the wall and that of the brush.
    assert RIGHT_AWAY[changed].max() < 24 + layers + 1


@given(st.integers(0, 10_000))
def test_a_scar_thins_one_side_from_inside_and_leaves_a_closed_wall(seed):
    rng = np.random.default_rng(seed)
    plane = short_axis()
    scar = draw_scar(rng, plane)
    depth_px = ndimage.distance_transform_edt(AWAY < OUTER)
    found = scarred(rng, np.repeat(plane[None], 11, axis=0), scar)
    assert scar.radius == pytest.approx(OUTER, abs=0.5)
    for one in found:
        changed = one != plane
        assert (plane[changed] == Tissue.LV_MYOCARDIUM).all()
        assert (one[changed] == Tissue.LV_CAVITY).all()
        cavity = one == Tissue.LV_CAVITY
        # A wall of 1.5 pixels at the least, which a mask of 5 x 5 measures to 2 %.
        assert depth_px[cavity].min() > 1.5 / 1.02
        assert ndimage.label(cavity)[1] == 1
        # At most 1.1 from the middle and 1.6 of the radius wide, less a tenth where it thins.
        behind = (ROWS - MIDDLE) * scar.way[0] + (COLUMNS - MIDDLE) * scar.way[1] < -0.75 * OUTER
        assert not changed[behind].any()
    middle = found[5] == Tissue.LV_CAVITY
    assert middle.sum() >= (plane == Tissue.LV_CAVITY).sum()


def test_scars_are_seen_on_any_side_and_planes_with_an_open_ring_stay():
    plane = short_axis()
    opened = plane.copy()
    opened[(np.abs(ROWS - MIDDLE) < 9) & (COLUMNS > MIDDLE) & (AWAY < OUTER)] = Tissue.LEFT_ATRIUM
    places = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        planes = np.stack([plane] * 6 + [opened] * 5)
        found = scarred(rng, planes, draw_scar(rng, plane))
        np.testing.assert_array_equal(found[6:], planes[6:])
        changed = (found != planes).any(axis=0)
        if changed.any():
            places.append(np.argwhere(changed).mean(axis=0) - MIDDLE)
    assert len(places) >= 36
    corners = {(a, b) for a in (-1, 1) for b in (-1, 1)}
    assert corners <= {tuple(np.sign(place)) for place in places}
    assert draw_scar(np.random.default_rng(0), np.zeros((SIDE, SIDE), np.uint8)) is None


@given(st.integers(0, 10_000))
def test_a_bulge_pushes_the_ventricle_outwards_at_its_scar_and_nothing_folds(seed):
    rng = np.random.default_rng(seed)
    plane = short_axis()
    scar = draw_scar(rng, plane)
    rows, columns = bulged(rng, scar, ROWS, COLUMNS)
    places = (ROWS, COLUMNS), (rows, columns)
    down, across = np.gradient(rows), np.gradient(columns)
    assert (down[0] * across[1] - down[1] * across[0]).min() > 0
    # All is seen from places nearer to the bulge's middle, half-way to the ventricle's rim: so it
    # looks farther off. A tenth of that way at the least, by 1 / e at the rim.
    place = MIDDLE + 0.5 * scar.radius * scar.way
    drawn, taken = (np.hypot(r - place[0], c - place[1]) for r, c in places)
    assert (taken <= drawn + 1e-4).all()
    rim = tuple(np.rint(MIDDLE + scar.radius * scar.way).astype(int))
    assert (drawn - taken)[rim] > 0.9 * 0.1 / np.e * 0.5 * scar.radius


def test_a_thick_right_wall_is_as_grey_as_the_left_one(monkeypatch):
    grown, greys = [], {True: [], False: []}
    slices = render._thick_slices

    def noted(planes, layers):
        grown.append(layers)
        return planes

    def seen(rng, planes, contrast, *others, **more):
        greys[bool(grown)].append(contrast.mean[Tissue.RV_WALL] / contrast.muscle)
        grown.clear()
        return slices(rng, planes, contrast, *others, **more)

    monkeypatch.setattr(render, "thick_right_walled", noted)
    monkeypatch.setattr(render, "_thick_slices", seen)
    block = np.repeat(short_axis()[None], 16, axis=0)
    for seed in range(100):
        draw_sample(np.random.default_rng(seed), block)
    assert 0.85 <= min(greys[True]) < max(greys[True]) <= 1.15
    assert min(greys[False]) < 0.6


@pytest.mark.parametrize("rare", [True, False])
def test_rare_hearts_are_among_what_is_drawn_where_asked_for(monkeypatch, rare):
    asked = {"scarred": [], "bulged": [], "thick_right_walled": []}
    for name, found in asked.items():

        def noted(*given, found=found, name=name):
            found.append(given)
            return {"scarred": given[1:2], "bulged": given[2:], "thick_right_walled": given[:1]}[
                name
            ]

        def drawn(*given, noted=noted, name=name):
            result = noted(*given)
            return result if name == "bulged" else result[0]

        monkeypatch.setattr(f"data_synth.training.render.{name}", drawn)
    block = np.repeat(short_axis()[None], 16, axis=0)
    for seed in range(300):
        draw_sample(np.random.default_rng(seed), block, replace(ALL_PARTS, rare=rare))
    counts = {name: len(found) / 300 for name, found in asked.items()}
    # Three deviations of 0.12 drawn 300 times are 0.06; six in ten of the scars bulge.
    assert counts["scarred"] == pytest.approx(0.12 * rare, abs=0.06 * rare)
    assert counts["thick_right_walled"] == pytest.approx(0.12 * rare, abs=0.06 * rare)
    if rare:
        assert 0.3 < counts["bulged"] / counts["scarred"] < 0.9
        assert {layers for _, layers in asked["thick_right_walled"]} == {1, 2, 3, 4}
    else:
        assert counts["bulged"] == 0


def test_a_console_sharpens_or_smooths_some_images():
    disc = np.where(AWAY < 28, 1.0, 0.2).astype(np.float32)
    disc[2, 2] = 0.9
    counts = np.zeros(3)
    for seed in range(300):
        found = filtered(np.random.default_rng(seed), np.broadcast_to(disc, (3, SIDE, SIDE)))
        assert found.min() >= 0
        seen = found[:, 10:]
        # A straight edge of height h overshoots by half of what is added of h, 0.64 at most.
        assert seen.max() < 1.01 + 0.64
        # Far from edges nothing changes.
        np.testing.assert_allclose(found[:, MIDDLE, MIDDLE], 1.0, atol=1e-4)
        np.testing.assert_allclose(found[:, 90, 5], 0.2, atol=1e-4)
        sharper, smoother = seen.max() > 1.01, found[0, 2, 2] < 0.3
        counts += [sharper, smoother, sharper and smoother]
    # Of three in ten that are sharpened one in eight is cut off besides, which takes the seam away.
    # Three deviations of a share of 300 are 0.08 about 0.26, 0.05 about 0.1.
    assert counts[0] / 300 == pytest.approx(0.26, abs=0.08)
    assert counts[1] / 300 == pytest.approx(0.1, abs=0.05)
    assert counts[2] == 0


def test_a_console_cuts_off_what_is_brightest_in_some_images():
    noise = np.random.default_rng(0).uniform(1, 2, (3, SIDE, SIDE)).astype(np.float32)
    shares = []
    for seed in range(300):
        found = filtered(np.random.default_rng(seed), noise)
        # What is brightest is one pixel, or where a median spreads it, a patch of 25 of 27,648.
        share = (found == found.max()).mean()
        if share > 0.01:
            shares.append(share)
    # Three deviations of a share of 300 are 0.056; 3 to 20 % of the pixels are cut off.
    assert len(shares) / 300 == pytest.approx(0.12, abs=0.06)
    assert 0.025 < min(shares) < max(shares) < 0.205
