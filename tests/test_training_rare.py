"""Training images show what few hearts and scanners do: scars, thick right walls, filters, and
what spoils one image in many."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from data_synth.tissue import Tissue
from data_synth.training import faults, render
from data_synth.training.faults import filtered, folded_over, in_blocks, with_metal, with_spikes
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


@pytest.mark.slow
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
    # Three deviations of 0.2 drawn 300 times are 0.07, of 0.12 0.06; six in ten scars bulge.
    assert counts["scarred"] == pytest.approx(0.2 * rare, abs=0.07 * rare)
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


@given(st.integers(0, 10_000))
def test_metal_blots_out_one_place_and_piles_its_signal_up_around_it(seed):
    plain = np.ones((3, SIDE, SIDE), np.float32)
    found = with_metal(np.random.default_rng(seed), plain)
    assert (found == found[0]).all()
    # A pixel lies within 1.3 pixels of the middle even in a corner: 0.64 radii at the most, where
    # next to nothing is left.
    assert found.min() < 0.1
    assert 0 <= found.min() <= found.max() <= 1 + 1.5
    # 25 pixels are its longest half, and its rim is gone 1.7 radii from the middle.
    rows, columns = np.nonzero(np.abs(found[0] - 1) > 0.02)
    assert np.hypot(np.ptp(rows), np.ptp(columns)) < 2 * 25 * 1.7


@given(st.integers(0, 10_000))
def test_what_folds_over_is_the_other_side_of_the_picture_and_the_rest_stays(seed):
    image = np.random.default_rng(0).uniform(1, 2, (3, SIDE, SIDE)).astype(np.float32)
    added = folded_over(np.random.default_rng(seed), image) - image
    reached = added[0] > 0
    rows, columns = reached.all(axis=1), reached.all(axis=0)
    band = rows if rows.any() and not rows.all() else columns
    assert (reached == (rows[:, None] if band is rows else columns)).all()
    width = band.sum()
    assert 0.09 * SIDE < width <= 0.3 * SIDE
    assert band[:width].all() or band[-width:].all()
    # The band of as many lines at the other side is what was added, by one factor.
    lines = image if band is rows else image.swapaxes(1, 2)
    shown = added if band is rows else added.swapaxes(1, 2)
    factor = shown[:, band] / lines[:, band[::-1]]
    np.testing.assert_allclose(factor, factor[0, 0, 0], rtol=1e-3)
    assert 0.3 <= factor[0, 0, 0] <= 1.0


def test_spikes_put_few_waves_into_one_image_or_into_all_three():
    plain = np.full((3, SIDE, SIDE), 10, np.float32)
    spoilt = []
    for seed in range(60):
        added = with_spikes(np.random.default_rng(seed), plain) - 10
        # Three spikes of a quarter each.
        assert np.abs(added).max() <= 0.75
        shown = np.abs(added).max(axis=(1, 2)) > 0.01
        spoilt.append(int(shown.sum()))
        # On so bright a ground a wave adds its real part: two peaks, each spread over some
        # frequencies of the grid, out of 9,216.
        power = np.sort(np.abs(np.fft.fft2(added[shown][0])).ravel() ** 2)
        assert power[-150:].sum() > 0.8 * power.sum()
    assert set(spoilt) == {1, 3}
    # Three deviations of a half of 60 are 0.19.
    assert spoilt.count(3) / 60 == pytest.approx(0.5, abs=0.2)


def test_compression_keeps_even_greys_and_changes_fine_grain():
    even = np.full((3, SIDE, SIDE), 0.7, np.float32)
    grain = np.random.default_rng(1).uniform(-0.2, 1.6, (3, SIDE, SIDE)).astype(np.float32)
    for seed in range(20):
        # The coarsest step of a block's mean at quality 8 is an eighth of 100 grey levels.
        kept = in_blocks(np.random.default_rng(seed), even)
        np.testing.assert_allclose(kept, 0.7, atol=(100 / 8 / 2 + 1) * 1.8 / 255)
        found = in_blocks(np.random.default_rng(seed), grain)
        assert found.min() >= -0.2 - 1e-6
        assert found.max() <= 1.6 + 1e-6
        assert 0.05 < np.abs(found - grain).mean() < 0.6


def test_uneven_noise_is_stronger_in_some_places_than_in_others():
    plain = np.full((3, SIDE, SIDE), 10, np.float32)

    def strengths(uneven):
        """Standard deviations in 16 patches of the picture, as shares of their mean, by seed."""
        for seed in range(40):
            found = faults._noisy(np.random.default_rng(seed), plain, uneven)
            patches = found.reshape(3, 4, SIDE // 4, 4, SIDE // 4).std(axis=(0, 2, 4))
            yield patches / patches.mean()

    assert max(np.ptp(one) for one in strengths(uneven=False)) < 0.35
    assert np.median([np.ptp(one) for one in strengths(uneven=True)]) > 0.8


@pytest.mark.parametrize("asked", [True, False])
def test_mishaps_are_among_what_is_drawn_where_asked_for(monkeypatch, asked):
    counts = dict.fromkeys(("with_metal", "folded_over", "with_spikes", "in_blocks"), 0)
    for name in counts:

        def noted(rng, image, name=name):
            counts[name] += 1
            return image

        monkeypatch.setattr(faults, name, noted)
    plain = np.random.default_rng(0).uniform(0, 1, (3, SIDE, SIDE)).astype(np.float32)
    for seed in range(300):
        faults.spoil(np.random.default_rng(seed), plain, filters=False, mishaps=asked)
    for name, count in counts.items():
        usual = 0.08 if name == "with_spikes" else 0.06
        # Three deviations of 0.08 drawn 300 times are 0.047.
        assert count / 300 == pytest.approx(usual * asked, abs=0.047 * asked), name
