"""What training images show more finely than tissue blocks do, and what is made to vary."""

import numpy as np
import pytest
from scipy import ndimage

from data_synth.tissue import Tissue
from data_synth.training.contrast import IS_BLOOD, USUAL_CONTRAST
from data_synth.training.coverings import Coverings
from data_synth.training.decor import Decor
from data_synth.training.ends import first_ventricle, low_atrium, lowest_atrium, other_tip
from data_synth.training.faults import windowed
from data_synth.training.render import REACH, _draw_ends
from data_synth.training.walls import last_ring, long_walled, thick_walled, whole_septum

SIDE = 64
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE]
AWAY = np.hypot(ROWS - 32, COLUMNS - 32)


def short_axis(outside=Tissue.LUNG):
    """A left ventricle of 12 to 18 pixels' radius, the right one to the left of it."""
    plane = np.full((SIDE, SIDE), outside)
    plane[(np.hypot(ROWS - 32, COLUMNS - 20) < 18)] = Tissue.RV_WALL
    plane[(np.hypot(ROWS - 32, COLUMNS - 20) < 16)] = Tissue.RV_CAVITY
    plane[AWAY < 18] = Tissue.LV_MYOCARDIUM
    plane[AWAY < 12] = Tissue.LV_CAVITY
    return plane.astype(np.uint8)


def layers(seed, fat_px, sac_px, fluid_px=0.0):
    """Coverings of a set, even thickness, in the usual contrast."""
    found = Coverings(np.random.default_rng(seed), SIDE, USUAL_CONTRAST)
    found.fat_px = np.full((SIDE, SIDE), fat_px)
    found.sac_px = sac_px
    found.fluid_px, found.fluid = np.full((SIDE, SIDE), fluid_px), 1.4
    return found


@pytest.mark.parametrize(
    ("fat_px", "sac_px", "fluid_px"),
    [(0.0, 0.4, 0.0), (0.3, 0.0, 0.0), (0.7, 0.9, 0.0), (3.5, 1.2, 0.0), (0.6, 0.8, 4.7)],
)
def test_layers_take_their_thickness_of_the_signal_and_leave_the_heart_alone(
    fat_px, sac_px, fluid_px
):
    """Beside a straight wall pixels end at whole distances: what they hold is plain arithmetic."""
    plane = np.where(COLUMNS < 32, Tissue.LV_MYOCARDIUM, Tissue.LUNG).astype(np.uint8)
    covers = layers(1, fat_px, sac_px, fluid_px)
    signed = np.where(COLUMNS < 32, 0.3, 0.1).astype(np.float32)

    covers.paint(signed, plane)

    np.testing.assert_array_equal(signed[:, :32], np.float32(0.3))
    added = (signed[:, 32:].astype(float) - 0.1).sum(axis=1)
    expected = fat_px * (covers.fat - 0.1) + sac_px * (covers.sac - 0.1)
    expected += fluid_px * (covers.fluid - 0.1)
    # A chamfer distance counts 0.955 for a step along rows: each layer's two ends may lie 4.5 % of
    # their way, and of a pixel, farther out.
    farther_px = 0.045 * (fat_px + sac_px + fluid_px + 1)
    allowed = abs(covers.fat - 0.1) + 2 * abs(covers.sac - 0.1)
    allowed = farther_px * (allowed + 2 * abs(covers.fluid - 0.1) * (fluid_px > 0))
    np.testing.assert_allclose(added, expected, atol=allowed)


def test_opposed_fat_thinner_than_a_pixel_darkens_it_below_both_neighbours():
    plane = np.where(COLUMNS < 32, Tissue.LV_MYOCARDIUM, Tissue.LUNG).astype(np.uint8)
    covers = layers(2, 0.5, 0.0)
    covers.fat = -0.3
    signed = np.where(COLUMNS < 32, 0.35, 0.2).astype(np.float32)
    covers.paint(signed, plane)
    assert (np.abs(signed[:, 32]) < 0.1).all()


def test_coverings_are_drawn_absent_thin_and_thick():
    drawn = [
        Coverings(np.random.default_rng(k), SIDE, USUAL_CONTRAST).fat_px.mean() for k in range(300)
    ]
    assert 0.25 < np.mean(np.equal(drawn, 0)) < 0.45
    assert np.mean(np.greater(drawn, 2)) > 0.15
    thin = [one for one in drawn if 0 < one < 1]
    assert len(thin) > 50


def test_fluid_is_drawn_now_and_then_where_asked_for_and_never_in_vessels_or_bone():
    drawn = {True: [], False: []}
    for asked, found in drawn.items():
        for seed in range(300):
            covers = Coverings(np.random.default_rng(seed), SIDE, USUAL_CONTRAST, fluid=asked)
            found.append(covers.fluid_px.max())
            assert covers.fluid_px.min() >= 0
    assert max(drawn[False]) == 0
    # Three deviations of 0.12 drawn 300 times are 0.06.
    assert np.mean(np.greater(drawn[True], 0)) == pytest.approx(0.12, abs=0.06)
    assert 8 < max(drawn[True]) <= 12
    plane = np.where(COLUMNS < 32, Tissue.LV_MYOCARDIUM, Tissue.LUNG).astype(np.uint8)
    plane[(COLUMNS > 34) & (ROWS < 20)] = Tissue.BLOOD_VESSEL
    plane[(COLUMNS > 34) & (ROWS > 40)] = Tissue.BONE
    signed = np.full((SIDE, SIDE), 0.1, np.float32)
    layers(1, 0.0, 0.0, 6.0).paint(signed, plane)
    wet = signed > 0.5
    assert wet[20:41, 33:37].all()
    assert not wet[np.isin(plane, (Tissue.BLOOD_VESSEL, Tissue.BONE, Tissue.LV_MYOCARDIUM))].any()


def test_a_wall_that_never_became_compact_fills_much_of_the_cavity_now_and_then():
    plane = short_axis(Tissue.FAT)
    cavity = plane == Tissue.LV_CAVITY
    filled = {True: [], False: []}
    for spongy, found in filled.items():
        for seed in range(120):
            decor = Decor(np.random.default_rng(seed), SIDE, rims=False, fat=False, spongy=spongy)
            decor.flow, decor.jets, decor.papillaries = 0.0, decor.jets[:0], np.empty((0, 5))
            image = np.ones((SIDE, SIDE), np.float32)
            decor.paint(image, plane, USUAL_CONTRAST)
            found.append((image[cavity] < 0.7).mean())
    much = {spongy: np.mean(np.greater(found, 0.3)) for spongy, found in filled.items()}
    assert much[True] > much[False] + 0.05
    assert max(filled[True]) < 1


def test_thick_walls_grow_outwards_alone_and_unevenly():
    plane = short_axis()
    rng = np.random.default_rng(3)
    found = np.stack([thick_walled(rng, plane[None])[0] for _ in range(40)])
    changed = found != plane
    assert (found[changed] == Tissue.LV_MYOCARDIUM).all()
    assert set(np.unique(plane[changed.any(axis=0)])) == {Tissue.LUNG}
    # Six pixels at most, counted from the muscle's last one.
    assert AWAY[changed.any(axis=0)].max() < 18 + 6 + 1
    grown = [one[32, 50:].sum() for one in changed]
    assert min(grown) == 0
    assert max(grown) >= 4
    above, below = changed[:, :32, 32].sum(axis=1), changed[:, 33:, 32].sum(axis=1)
    assert (above != below).mean() > 0.3


def base_planes():
    """Three closed rings, then the left atrium with the aorta beside it, and the right atrium."""
    plane = short_axis(Tissue.FAT)
    above = np.full((SIDE, SIDE), Tissue.FAT, np.uint8)
    above[np.hypot(ROWS - 32, COLUMNS - 12) < 12] = Tissue.RIGHT_ATRIUM
    above[AWAY < 16] = Tissue.LEFT_ATRIUM
    above[np.hypot(ROWS - 12, COLUMNS - 32) < 9] = Tissue.AORTA
    return np.stack([plane] * 3 + [above] * 4)


def test_last_ring_is_the_last_plane_with_muscle_all_around_the_cavity():
    planes = base_planes()
    assert last_ring(planes) == 2
    planes[2][(COLUMNS > 40) & (planes[2] == Tissue.LV_MYOCARDIUM)] = Tissue.FAT
    assert last_ring(planes) == 1
    assert last_ring(planes[3:]) is None


def test_a_long_walled_ventricle_goes_on_as_it_was_beside_what_lies_there():
    planes = base_planes()
    longer = long_walled(planes, 2, 2)
    np.testing.assert_array_equal(longer[[0, 1, 2, 5, 6]], planes[[0, 1, 2, 5, 6]])
    ventricle = np.isin(planes[2], (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM))
    for plane in longer[3:5]:
        np.testing.assert_array_equal(plane[ventricle], planes[2][ventricle])
        assert not (plane == Tissue.LEFT_ATRIUM).any()
        # Most of the aorta stands free of the ring, and all of the right atrium's rest.
        for tissue in (Tissue.AORTA, Tissue.RIGHT_ATRIUM):
            kept = (planes[3] == tissue) & ~ventricle
            np.testing.assert_array_equal(plane == tissue, kept)


def valve_planes():
    """Six rings, then both atria with the right ventricle's outflow before the right one."""
    below = short_axis(Tissue.FAT)
    above = np.full((SIDE, SIDE), Tissue.FAT, np.uint8)
    above[np.hypot(ROWS - 42, COLUMNS - 12) < 12] = Tissue.RIGHT_ATRIUM
    above[np.hypot(ROWS - 14, COLUMNS - 18) < 8] = Tissue.RV_CAVITY
    above[AWAY < 16] = Tissue.LEFT_ATRIUM
    return np.stack([below] * 6 + [above] * 3)


@pytest.mark.parametrize("seed", range(8))
def test_a_low_right_atrium_takes_the_ventricle_from_behind_and_nothing_else(seed):
    planes = valve_planes()
    assert lowest_atrium(planes) == 6
    lower = low_atrium(np.random.default_rng(seed), planes, 6, 3)

    np.testing.assert_array_equal(lower[[0, 1, 2, 6, 7, 8]], planes[[0, 1, 2, 6, 7, 8]])
    left = np.isin(planes, (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM, Tissue.LEFT_ATRIUM))
    np.testing.assert_array_equal(lower[left], planes[left])
    areas = [np.count_nonzero(plane == Tissue.RIGHT_ATRIUM) for plane in lower[3:7]]
    assert areas[0] > 0
    assert (np.diff(areas[:3]) > 0).all()
    for plane in lower[3:6]:
        atrium, ventricle = (plane == one for one in (Tissue.RIGHT_ATRIUM, Tissue.RV_CAVITY))
        # A leaflet of one pixel may cut a corner off.
        leaflet = plane == Tissue.LEAFLET
        assert ndimage.label(ventricle | leaflet, np.ones((3, 3)))[1] == 1
        gone = (planes[5] == Tissue.RV_CAVITY) & ~ventricle
        assert set(np.unique(plane[gone])) <= {Tissue.RIGHT_ATRIUM, Tissue.LEAFLET}
    # Seen from the outflow, at the upper right, the atrium lies behind.
    behind = ROWS - COLUMNS / 4
    assert behind[atrium].mean() > behind[ventricle].mean() + 8
    assert behind[atrium].max() > behind[ventricle].max()


@pytest.mark.parametrize("seed", range(8))
def test_no_right_ventricle_is_left_behind_a_small_atrium(seed):
    planes = valve_planes()
    planes[planes == Tissue.RIGHT_ATRIUM] = Tissue.FAT
    # Aside, so that it does not cut off what lies behind it.
    planes[6:, np.hypot(ROWS - 36, COLUMNS - 7) < 7.5] = Tissue.RIGHT_ATRIUM
    # What lies farther back than the atrium's own middle by its own radius.
    back = (ROWS > 44) & (planes[5] == Tissue.RV_CAVITY)
    assert back.any()
    lower = low_atrium(np.random.default_rng(seed), planes, 6, 3)
    assert not (lower[5][back] == Tissue.RV_CAVITY).any()
    np.testing.assert_array_equal(lower[2][back], Tissue.RV_CAVITY)


def test_an_atrium_comes_down_where_both_ventricles_lie_below_it():
    planes = valve_planes()
    assert lowest_atrium(planes[6:]) is None
    assert lowest_atrium(np.concatenate([planes[6:], planes[:1]])) is None
    assert lowest_atrium(planes[:6]) is None
    for tissue in (Tissue.LV_CAVITY, Tissue.RV_CAVITY):
        lacking = planes.copy()
        lacking[5][lacking[5] == tissue] = Tissue.FAT
        assert lowest_atrium(lacking) is None
    small = planes.copy()
    small[6:][(small[6:] == Tissue.RIGHT_ATRIUM) & (COLUMNS > 5)] = Tissue.FAT
    assert lowest_atrium(small) is None


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("height", [1.5, 4.0, 7.5])
def test_another_tip_ends_where_it_was_asked_to_with_muscle_around_the_cavity(seed, height):
    planes = np.stack([short_axis()] * 10)
    assert first_ventricle(planes) == 0
    drawn = other_tip(np.random.default_rng(seed), planes, 8, height)

    np.testing.assert_array_equal(drawn[8:], planes[8:])
    whole = np.isin(drawn, (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM))
    inside = drawn == Tissue.LV_CAVITY
    areas = whole.sum(axis=(1, 2))
    # A tip's last plane may be thinner than half a pixel.
    assert areas[int(8 - np.ceil(height)) + 2 :].all()
    assert not areas[: 8 - int(np.ceil(height)) + 1].any()
    # Masks are moved by whole pixels: half a pixel all around is rounding.
    assert (np.diff(areas[:9]) >= -np.pi * 18).all()
    for plane, cavity in zip(whole, inside, strict=True):
        np.testing.assert_array_equal(ndimage.binary_fill_holes(plane), plane)
        assert not (cavity & ~ndimage.binary_erosion(plane)).any()
    heart = np.isin(drawn, (Tissue.RV_CAVITY, Tissue.RV_WALL)).any(axis=(1, 2))
    ended = int(np.ceil(8 - 0.8 * height))
    assert not heart[:ended].any()
    assert heart[ended:].all()
    assert set(np.unique(drawn[0])) <= {Tissue.LUNG}


@pytest.mark.parametrize("seed", range(20))
def test_other_ends_are_shown_where_they_are(seed):
    below, above = valve_planes()[0], valve_planes()[-1]
    lung = np.full((SIDE, SIDE), Tissue.LUNG, np.uint8)
    block = np.stack([lung] * 10 + [below] * 20 + [above] * 18)
    rng = np.random.default_rng(seed)

    drawn, middle, end = _draw_ends(rng, block, 40, 1, atrium=True)
    shown = (drawn == Tissue.RIGHT_ATRIUM).any(axis=(1, 2))
    # It comes down by six planes at most, and the image lies about where it does.
    assert 30 - 6 <= shown.argmax() < 30
    assert shown.argmax() - 1 <= middle <= 32
    assert end == 0

    drawn, middle, end = _draw_ends(rng, block, 40, 1, atrium=False)
    tip = np.isin(drawn, (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM)).any(axis=(1, 2)).argmax()
    assert 10 - 8 <= tip <= 10 + 5
    assert tip - 3 <= middle <= tip + 5
    assert end == 0


def test_a_block_without_valves_or_tip_stays_as_it_is():
    block = np.stack([short_axis()] * (4 * REACH))
    for atrium in (True, False):
        drawn, middle, end = _draw_ends(np.random.default_rng(1), block, 9, -1, atrium)
        assert drawn is block
        assert (middle, end) == (9, -1)


def test_septum_has_no_wall_of_the_right_ventricle():
    plane = short_axis()
    stray = (AWAY >= 17.2) & (AWAY < 18) & (COLUMNS < 20) & (np.abs(ROWS - 32) < 8)
    assert stray.any()
    mixed = np.where(stray, Tissue.RV_WALL, plane).astype(np.uint8)
    found = whole_septum(mixed[None])[0]
    assert (found[stray] == Tissue.LV_MYOCARDIUM).all()
    # The free wall stays, but where it meets the septum.
    free = (plane == Tissue.RV_WALL) & (COLUMNS < 12)
    assert (found[free] == Tissue.RV_WALL).all()
    assert (found[plane != Tissue.RV_WALL] == plane[plane != Tissue.RV_WALL]).all()


def test_jets_darken_blood_alone():
    plane = short_axis(Tissue.AIR)
    shown = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        decor = Decor(rng, SIDE, rims=False, fat=False)
        decor.flow, decor.papillaries = 0.0, np.empty((0, 5))
        for strands in decor.strands:
            decor.strands[strands] = type(decor.strands[strands])(0.0, 0.0, 0.0)
        image = np.ones((SIDE, SIDE), np.float32)
        decor.paint(image, plane, USUAL_CONTRAST)
        blood = IS_BLOOD[plane]
        np.testing.assert_array_equal(image[~blood], 1)
        assert image.max() <= 1
        assert image.min() > 0.15
        shown += image[blood].min() < 0.9
    assert 3 <= shown <= 20


def test_no_vessel_is_drawn_where_another_slice_shows_the_heart():
    """Bright ovals elsewhere, but none that could be the tip of a heart beyond the slice."""
    plane = np.full((SIDE, SIDE), Tissue.LUNG, np.uint8)
    beyond = AWAY < 18
    seen = {True: 0, False: 0}
    for seed in range(80):
        decor = Decor(np.random.default_rng(seed), SIDE, rims=False, fat=False)
        decor.organs = 0
        decor.tubes = decor.tubes[:1]
        for known in seen:
            image = np.zeros((SIDE, SIDE), np.float32)
            decor.paint(image, plane, USUAL_CONTRAST, beyond if known else None)
            drawn = image > 0
            seen[known] += drawn.any()
            if known and drawn.any():
                assert (drawn & beyond).sum() <= 0.3 * drawn.sum()
    assert 0.3 * seen[False] < seen[True] < 0.95 * seen[False]


def test_septum_without_trabeculae_still_has_them_on_the_free_wall():
    plane = short_axis(Tissue.FAT)
    cavity = plane == Tissue.RV_CAVITY
    septum = cavity & (AWAY < 21)
    found = {True: [], False: []}
    for seed in range(60):
        decor = Decor(np.random.default_rng(seed), SIDE, rims=False, fat=False)
        decor.flow, decor.jets = 0.0, decor.jets[:0]
        image = np.ones((SIDE, SIDE), np.float32)
        decor.paint(image, plane, USUAL_CONTRAST)
        # Away from the ends of the septum, where it meets the free wall.
        middle = np.abs(ROWS - 32) < 8
        dark = image < 0.9
        found[decor.septum_bare].append((dark[septum & middle].any(), dark[cavity].any()))
    bare, usual = np.mean(found[True], axis=0), np.mean(found[False], axis=0)
    assert bare[1] > 0.4
    assert bare[0] < 0.5 * usual[0]


def test_window_of_frequencies_keeps_the_mean_and_rings_at_edges():
    disc = np.where(AWAY < 14, 1.0, 0.2).astype(np.float32)
    image = np.broadcast_to(disc, (3, SIDE, SIDE))
    over = []
    for seed in range(20):
        found = windowed(np.random.default_rng(seed), image)
        # The middle of k-space is the sum; magnitude can only add where the ringing is negative.
        assert found.mean() == pytest.approx(image.mean(), rel=0.02)
        over.append(found.max())
    # Gibbs: a sharply cut edge overshoots by 9 % of its height, here 0.8, a soft one by less.
    assert max(over) > 1.04
    assert max(over) < 1.3
