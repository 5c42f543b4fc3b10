"""Anatomy put right: what is cut off, bridged, closed and smoothed, and what must stay."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, label

from pipeline.imaging.cleanup import (
    _end_of_cavity,
    clean_cycle,
    ventricle_tip,
)

SIDE, PIXEL_MM, STEP_MM = 64, 1.5, 10 / 3
CAVITY, MUSCLE, RV, ATRIUM = 1, 2, 3, 4
Y, X = np.mgrid[:SIDE, :SIDE]
RADIUS = np.hypot(X - 32, Y - 32)


def one_hot(labels):
    """Probabilities that are certain enough of these labels: ``(..., class, row, column)``."""
    return np.moveaxis(np.eye(7, dtype=np.float32)[labels], -1, -3) * 0.9 + 0.1 / 7


def ring(inner=14, outer=22):
    return np.where(inner > RADIUS, CAVITY, np.where(outer > RADIUS, MUSCLE, 0))


def cleaned_chance(chance, pixel_mm=PIXEL_MM):
    """One phase put right by itself."""
    value = chance[None].copy()
    clean_cycle(value, pixel_mm, STEP_MM)
    return value[0]


def cleaned(labels):
    return cleaned_chance(one_hot(labels)).argmax(axis=1)


def test_a_heart_without_faults_is_left_as_it_is():
    heart = np.stack([ring(8 + 2 * k, 16 + 2 * k) for k in range(5)])
    heart[:, 20:44, 50:60] = np.where(heart[:, 20:44, 50:60] == 0, RV, heart[:, 20:44, 50:60])
    np.testing.assert_array_equal(cleaned(heart), heart)


def test_what_is_less_probable_than_the_background_stays_beside_the_body():
    """Borders lie where probabilities cross: what is taken away outside would move them inwards."""
    chance = 1 / (1 + np.exp((RADIUS - 22) / 0.7))
    soft = one_hot(np.stack([ring()] * 3))
    soft[:, MUSCLE] = np.where(RADIUS >= 14, chance, soft[:, MUSCLE])
    soft[:, 0] = np.where(RADIUS >= 14, 1 - chance, soft[:, 0])
    soft[:, [CAVITY, RV, ATRIUM, 5, 6]] *= RADIUS < 14
    soft /= soft.sum(axis=1, keepdims=True)
    found = cleaned_chance(soft)
    np.testing.assert_allclose(found[:, :, RADIUS > 16], soft[:, :, RADIUS > 16], atol=1e-6)


def test_an_island_is_taken_away_and_the_body_left():
    heart = np.stack([ring()] * 3)
    heart[:, 2:8, 2:8] = ATRIUM
    np.testing.assert_array_equal(cleaned(heart), np.stack([ring()] * 3))


def test_what_takes_over_from_an_island_may_be_no_island_either():
    """Beside the left atrium: right ventricle, else atrium, else muscle, else cavity; none can."""
    right_atrium, chances = 5, (0.4, 0.3, 0.15, 0.1)
    heart = np.stack([ring()] * 3)
    heart[:, 24:40, 54:62] = ATRIUM
    heart[:, 8:14, 24:40] = RV
    heart[:, 50:56, 24:40] = right_atrium
    soft = one_hot(heart)
    island = np.s_[:, :, 40:44, 58:62]
    soft[island] = 0.05 / 3
    for value, chance in zip((RV, right_atrium, MUSCLE, CAVITY), chances, strict=True):
        soft[:, value, 40:44, 58:62] = chance
    found = cleaned_chance(soft).argmax(axis=1)
    assert not np.isin(found[:, 40:44, 58:62], (RV, right_atrium, MUSCLE, CAVITY)).any()
    heart[:, 40:44, 58:62] = found[:, 40:44, 58:62]
    np.testing.assert_array_equal(found, heart)


def test_papillary_muscles_are_drawn_inside_the_cavity():
    smooth = np.stack([ring()] * 3)
    heart = smooth.copy()
    # One stands free in the blood, one hangs on the wall.
    heart[:, np.hypot(X - 28, Y - 30) < 3] = MUSCLE
    heart[:, np.hypot(X - 44, Y - 34) < 4] = MUSCLE
    found = cleaned(heart)
    # A disc of 10 pixels rolled along a circle of 14 reaches into a notch 8 wide by its sag.
    assert (found != smooth).mean(axis=(1, 2)).max() * SIDE**2 < 12
    assert not (found[:, np.hypot(X - 28, Y - 30) < 3] == MUSCLE).any()


def test_a_septum_that_bows_inwards_stays_muscle():
    heart = np.stack([ring()] * 3)
    bowed = np.hypot(X - 56, Y - 32) < 18
    heart[:, bowed & (RADIUS < 14)] = MUSCLE
    # The bow has a radius of 27 mm, more than the 15 mm of the disc; only its two ends are
    # corners, which a lattice rounds by a pixel or two.
    changed = (cleaned(heart) != heart).sum(axis=(1, 2))
    assert changed.max() < 10


def test_smoothing_never_thins_a_wall_below_three_millimetres():
    heart = np.stack([ring(14, 17)] * 3)
    heart[:, (np.abs(X - 46) < 3) & (np.abs(Y - 32) < 2) & (RADIUS < 17)] = MUSCLE
    for plane in cleaned(heart):
        ventricle = (plane == CAVITY) | (plane == MUSCLE)
        to_outside = distance_transform_edt(ventricle)[(plane == CAVITY) & (heart[0] == MUSCLE)]
        assert (to_outside * PIXEL_MM > 3.0).all()


def test_a_gap_in_the_ring_is_closed_where_muscle_surrounds_the_rest():
    heart = np.stack([ring()] * 3)
    heart[:, (X > 32) & (np.abs(Y - 32) < 5) & (RADIUS >= 14)] = 0
    found = cleaned(heart)
    for plane in found:
        beside = (RADIUS >= 14) & (RADIUS < 15)
        assert (plane[beside] == MUSCLE).all()


def test_a_ring_that_opens_into_the_atrium_stays_open():
    heart = np.stack([ring()] * 3)
    mouth = (X > 32) & (np.abs(Y - 32) < 5) & (RADIUS >= 14) & (RADIUS < 24)
    heart[:, mouth] = ATRIUM
    np.testing.assert_array_equal(cleaned(heart)[:, mouth], ATRIUM)


def test_muscle_without_cavity_between_two_rings_gets_the_cavity_that_both_share():
    whole = np.stack([ring(10), ring(14), ring(12)])
    heart = whole.copy()
    heart[1][RADIUS < 14] = MUSCLE
    found = cleaned(heart)
    np.testing.assert_array_equal(found[1] == CAVITY, RADIUS < 10)
    np.testing.assert_array_equal(found[[0, 2]], whole[[0, 2]])


def test_more_muscle_about_a_small_basal_cavity_does_not_empty_the_rings_below():
    """As where a right ventricle's thick wall is taken for the left one's at the base."""
    rings = np.stack([ring(6 + 2 * k, 12 + 2 * k) for k in range(5)])
    base = ring(6, 28)
    assert (base == MUSCLE).sum() > (rings[-1] == MUSCLE).sum()
    assert (rings[-1] == CAVITY).sum() > 1.4 * (base == CAVITY).sum() + 40
    heart = np.concatenate([rings, base[None]])
    np.testing.assert_array_equal(cleaned(heart), heart)


def test_a_half_bare_cavity_at_the_tip_goes_though_a_wide_ring_of_fat_lies_below_it():
    rings = np.stack([ring(6 + 2 * k, 12 + 2 * k) for k in range(5)])
    bare, fat = np.where((X > 32) & (RADIUS >= 5), 0, ring(5, 12)), ring(15, 19)
    # Smaller than the widest cut, but with the widest cavity of all.
    assert (rings[-1] > 0).sum() > (fat > 0).sum()
    assert (rings[-1] == CAVITY).sum() < (fat == CAVITY).sum()
    found = cleaned(np.concatenate([[fat, bare], rings]))
    np.testing.assert_array_equal(found[2:], rings)
    assert not (found[:2] == CAVITY).any()


def rings_with_right_heart(inner):
    rings = np.stack([ring(size, size + 6) for size in inner])
    beside = (np.hypot(X - 10, Y - 32) < 9) & (rings == 0)
    return np.where(beside, RV, rings)


def test_a_right_chamber_taken_for_cavity_leaves_the_rings_below_as_they_are():
    heart = rings_with_right_heart([6, 8, 10, 11, 12])
    mistaken = heart.copy()
    mistaken[2:][heart[2:] == RV] = CAVITY
    # The septum borders on a quarter of it. In the last plane, above all rings, both are one body.
    mistaken[4][(X < 32) & (abs(Y - 32) < 9) & (heart[4] == MUSCLE)] = CAVITY
    found = cleaned(mistaken)[:4]
    np.testing.assert_array_equal(found == CAVITY, heart[:4] == CAVITY)
    np.testing.assert_array_equal(found == MUSCLE, heart[:4] == MUSCLE)


def test_a_chamber_beyond_the_base_without_muscle_is_no_cavity():
    heart = rings_with_right_heart([6, 8, 10, 11])
    # The pulmonary artery, above the right ventricle; the outflow tract, above the cavity; and
    # what has muscle on a fifth of its border.
    away = np.hypot(X - 17, Y - 32)
    artery, outflow = away < 9, np.hypot(X - 36, Y - 32) < 9
    none, some = np.zeros_like(artery), (away >= 9) & (away < 12) & (X > 22)
    for beyond, wall, stays in ((artery, none, False), (outflow, none, True), (artery, some, True)):
        more = np.where(beyond, CAVITY, np.where(wall, MUSCLE, 0))
        found = cleaned(np.concatenate([heart, [more, more]]))
        np.testing.assert_array_equal(found[:4], heart)
        np.testing.assert_array_equal(found[4:] == CAVITY, np.stack([beyond & stays] * 2))


def test_a_cavity_that_leaks_between_two_rings_is_held_within_them():
    heart = rings_with_right_heart([6, 8, 10, 11, 12])
    leaking = heart.copy()
    # The septum is missed, and most of the right chamber taken for the left one.
    right, septum = (heart[2] == RV) & (Y > 24), (heart[2] == MUSCLE) & (X < 32)
    leaking[2][right | (septum & (abs(Y - 32) < 12))] = CAVITY
    found = cleaned(leaking)
    np.testing.assert_array_equal(np.delete(found, 2, 0), np.delete(heart, 2, 0))
    held = np.isin(heart[1], (CAVITY, MUSCLE)) | np.isin(heart[3], (CAVITY, MUSCLE))
    assert not (found[2] == CAVITY)[~held].any()
    assert (found[2] == CAVITY)[(leaking[2] == CAVITY) & held].all()


def test_an_aneurysm_that_widens_by_degrees_is_left_as_it_is():
    rings = [ring(size, size + 3) for size in (11, 14, 14)]
    # Half of its wall is too thin to be seen, so that no ring is there; it lies beyond both rings.
    bulge = [ring(size, size + 3) for size in (16, 18, 20, 18, 16)]
    bulge = [np.where((X < 32) & (plane == MUSCLE), 0, plane) for plane in bulge]
    heart = np.stack([*rings[:2], *bulge, rings[2]])
    assert (heart[4] == CAVITY).sum() > 1.4 * (heart[1] == CAVITY).sum() + 40
    np.testing.assert_array_equal(cleaned(heart), heart)


def test_a_cavity_of_fair_size_beside_one_that_leaks_is_left_as_it_is():
    aside = np.hypot(X - 36, Y - 32)
    fair = np.where(aside < 12, CAVITY, np.where((aside < 15) & (X < 34), MUSCLE, 0))
    wall = (ring(10, 13) == MUSCLE) & (X < 26)
    leaking = np.where(wall, MUSCLE, np.where(RADIUS < 18, CAVITY, 0))
    heart = np.stack([ring(9, 12), ring(10, 13), leaking, fair, ring(10, 13)])
    found = cleaned(heart)
    np.testing.assert_array_equal(found[2], np.where(RADIUS < 13, leaking, 0))
    np.testing.assert_array_equal(np.delete(found, 2, 0), np.delete(heart, 2, 0))


def test_a_recess_walled_by_muscle_does_not_take_the_open_cavity_beside_it():
    base = np.where((X > 20) & (RADIUS >= 14), 0, ring(14, 20))
    recess = (X >= 15) & (X < 17) & (abs(Y - 32) < 2)
    heart = np.stack([ring(12, 20), ring(13, 20), base])
    heart[:, recess] = CAVITY
    found = cleaned(heart)
    assert (found[2] == CAVITY)[(base == CAVITY)].all()


@pytest.mark.parametrize("finer", [1, 2])
def test_how_far_a_ventricle_may_widen_does_not_depend_on_the_pixels(finer):
    heart = np.stack([ring(7.7, 14), ring(6, 14), ring(8, 14), ring(10, 16)])
    heart = heart.repeat(finer, axis=1).repeat(finer, axis=2)
    found = cleaned_chance(one_hot(heart), PIXEL_MM / finer).argmax(axis=1)
    np.testing.assert_array_equal(found > 0, heart > 0)
    assert (found == CAVITY)[heart == CAVITY].all()


def test_the_tip_is_the_same_in_every_phase():
    """Fat about the tip taken for muscle in two phases of three is cut off in all, or in none."""
    tapering = np.stack([ring(2 + 3 * k, 8 + 3 * k) for k in range(5)])
    fat = tapering.copy()
    # On average over phases 1.4 times the next cut and 60 to 80 pixels, which are 135 to 180 mm2.
    fat[0] = np.where(RADIUS < 15.9, MUSCLE, 0)
    value = one_hot(np.stack([fat, tapering, fat]))
    assert ventricle_tip(value, PIXEL_MM) == 1
    clean_cycle(value, PIXEL_MM, STEP_MM)
    ventricle = np.isin(value.argmax(axis=2), (CAVITY, MUSCLE))
    assert not ventricle[:, 0].any()
    assert ventricle[:, 1:].any(axis=(2, 3)).all()


@pytest.mark.parametrize(
    ("apart", "is_held"),
    [
        ((3,), True),
        ((3, 4), True),
        (range(3, 6), False),
        (range(3, 9), False),
        (range(1, 16), False),
    ],
    ids=["one phase", "two phases", "three", "a long part of the beat", "all but one"],
)
def test_what_falls_apart_in_a_phase_and_is_whole_about_it_is_kept(apart, is_held):
    """A ventricle with two of five planes aside is one body but for some of sixteen phases."""
    heart = np.zeros((16, 5, SIDE, SIDE), np.uint8)
    for phase in range(16):
        radius = 7 if phase in apart else 10
        for plane, place in enumerate((20, 20, 36, 36, 36)):
            heart[phase, plane][np.hypot(X - place, Y - 32) < radius] = RV
    value = np.stack([one_hot(one) for one in heart])
    clean_cycle(value, PIXEL_MM, STEP_MM)
    found = value.argmax(axis=2)
    for phase in apart:
        assert (found[phase, :2] == RV).any() == is_held
        assert (found[phase, 2:] == heart[phase, 2:]).all()
    whole = [phase for phase in range(16) if phase not in apart]
    np.testing.assert_array_equal(found[whole], heart[whole])


@pytest.mark.parametrize("phases", [1, 3])
def test_probabilities_still_sum_to_one(phases):
    rng = np.random.default_rng(0)
    value = np.moveaxis(rng.dirichlet(np.ones(7) / 3, (phases, 4, SIDE, SIDE)), -1, 2)
    value = value.astype(np.float32)
    clean_cycle(value, PIXEL_MM, STEP_MM)
    np.testing.assert_allclose(value.sum(axis=2), 1, atol=1e-4)
    assert value.min() >= 0


def test_a_cavity_that_is_narrow_half_way_goes_on_towards_the_tip():
    """Papillary muscles may nearly fill it at end-systole: what widens again is no fat."""
    inner = (0, 6, 6, 6, 9, 5, 9, 11, 12)
    heart = np.stack([ring(radius, 18) for radius in inner])
    np.testing.assert_array_equal(cleaned(heart), heart)


def test_fat_that_is_ringed_beyond_the_tip_is_no_cavity():
    bare = np.where(RADIUS < 10, CAVITY, 0)
    heart = np.stack([ring(5, 12), bare, *(ring(k, 18) for k in (4, 9, 11, 12))])
    found = cleaned(heart)
    assert not (found[:2] == CAVITY).any()
    np.testing.assert_array_equal(found[2:], heart[2:])


@pytest.mark.parametrize(("beyond", "end"), [((5,), 2), ((6, 9), 0)])
def test_a_cavity_goes_on_beyond_a_bare_plane_where_rings_hold_a_quarter_as_much(beyond, end):
    """Cuts go as the square of the radius: 25, or 36 and 81, of 64 + 81 + 121 + 144 = 410."""
    bare = np.where(RADIUS < 10, CAVITY, 0)
    heart = [*(ring(k, 14) for k in beyond), bare, *(ring(k, 18) for k in (8, 9, 11, 12))]
    rings = np.array([(plane == MUSCLE).any() for plane in heart])
    found = _end_of_cavity(np.stack(heart), rings, len(heart) - 1, 0, PIXEL_MM)
    assert found == end


def test_a_plane_without_half_of_its_wall_is_no_tip_and_is_held_within_its_neighbours():
    heart = np.stack([ring(6 + k, 14 + k) for k in range(6)])
    spoilt = heart.copy()
    spoilt[3][(X > 32) & (RADIUS < 24)] = CAVITY
    found = cleaned(spoilt)
    np.testing.assert_array_equal(found[:3], heart[:3])
    assert (found[3] == CAVITY)[RADIUS < 9].all()
    assert not (found[3] == CAVITY)[RADIUS > 18].any()


def test_a_bubble_beside_the_ventricle_does_not_end_it():
    """A dark disc with a bright rim, wider than the cavity, which is missed beside it."""
    away = np.hypot(X - 48, Y - 32)
    bubble = np.where(away < 12, CAVITY, np.where(away < 15, MUSCLE, 0))
    wall = (RADIUS < 17) & (Y < 26)
    both = np.where((RADIUS < 10) | (away < 12), CAVITY, np.where(wall, MUSCLE, 0))
    heart = np.stack([*(ring(5 + k, 12 + k) for k in range(6)), both, bubble, bubble])
    found = cleaned(heart)
    np.testing.assert_array_equal(found[:6], heart[:6])


def apart_for_a_phase(piece):
    """Two planes of a right ventricle aside, whole in 8 phases but one, which shows ``piece``."""
    heart = np.zeros((8, 5, SIDE, SIDE), np.uint8)
    for plane, place in enumerate((20, 20, 36, 36, 36)):
        heart[:, plane][:, np.hypot(X - place, Y - 32) < 10] = RV
    heart[3] = 0
    heart[3, 2:, np.hypot(X - 36, Y - 32) < 7] = RV
    heart[3, :2, piece] = RV
    value = np.stack([one_hot(one) for one in heart])
    clean_cycle(value, PIXEL_MM, STEP_MM)
    return value.argmax(axis=2)[3, :2]


@pytest.mark.parametrize(("side", "held"), [(4, False), (5, True)])
def test_pieces_of_less_than_300_cubic_millimetres_are_not_held(side, held):
    """Squares on two planes, 7.5 mm3 a pixel: 240 and 375."""
    piece = np.zeros((SIDE, SIDE), bool)
    piece[30 : 30 + side, 18 : 18 + side] = True
    assert (2 * piece.sum() * PIXEL_MM**2 * STEP_MM > 300) == held
    assert (apart_for_a_phase(piece) == RV).any() == held


@pytest.mark.parametrize(("left", "held"), [(3, False), (7, True)])
def test_a_piece_is_held_where_half_of_it_lies_in_the_bodys_place(left, held):
    piece = (np.abs(Y - 32) < 5) & (left <= X) & (left + 12 > X)
    share = (piece & (np.hypot(X - 20, Y - 32) < 10)).sum() / piece.sum()
    assert 0.3 < share < 0.7
    assert (share > 0.5) == held
    assert (apart_for_a_phase(piece) == RV).any() == held


def test_where_nothing_is_left_there_is_background():
    """An island that the network is wholly sure of: no other class has any chance."""
    heart = np.stack([ring()] * 3)
    heart[:, 2:8, 2:8] = ATRIUM
    sure = np.moveaxis(np.eye(7, dtype=np.float32)[heart], -1, -3)
    found = cleaned_chance(sure)
    np.testing.assert_array_equal(found[:, 0, 2:8, 2:8], 1)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-6)


def test_cleaning_removes_islands_and_fills_holes():
    labels = np.zeros((3, 30, 30), int)
    labels[:, 2:18, 2:18] = 2
    labels[:, 7:13, 7:13] = 1
    expected = labels.copy()
    labels[1, 9, 9] = 0
    labels[0, 26:28, 26:28] = 1
    labels[2, 3, 3] = 1
    found = cleaned(labels)
    # What stands where something was ruled out is the next guess; here all others are equal.
    assert found[1, 9, 9] != 0
    assert not found[0, 20:, 20:].any()
    assert found[2, 3, 3] != 1
    untouched = labels == expected
    np.testing.assert_array_equal(found[untouched], expected[untouched])


def test_cleaning_keeps_a_part_whose_neck_is_too_thin_to_be_seen():
    labels = np.zeros((5, 30, 30), int)
    labels[:, 4:16, 4:16] = 4
    labels[1:3, 8:14, 17:22] = 4
    np.testing.assert_array_equal(cleaned(labels), labels)


def test_cleaning_takes_a_bare_cavity_off_the_tip_but_not_off_the_base():
    labels = np.zeros((5, 24, 24), int)
    labels[1:4, 4:16, 4:16] = 2
    labels[2:4, 7:13, 7:13] = 1
    labels[[0, 4], 7:13, 7:13] = 1
    found = cleaned(labels)
    assert not (found[0] == 1).any()
    np.testing.assert_array_equal(found[1:] == 1, labels[1:] == 1)


def test_cleaning_takes_a_ventricle_off_that_leaps_in_size_below_the_tip():
    labels = np.zeros((5, 40, 40), int)
    for number, half in enumerate((14, 4, 7, 11, 15)):
        labels[number, 20 - half : 20 + half, 20 - half : 20 + half] = 2
        half = half // 2 if number else 11
        labels[number, 20 - half : 20 + half, 20 - half : 20 + half] = 1
    found = cleaned(labels)
    assert not np.isin(found[0], (1, 2)).any()
    np.testing.assert_array_equal(found[1:], labels[1:])


def test_cleaning_keeps_probabilities_and_leaves_empty_images_alone():
    chance = np.random.default_rng(0).dirichlet(np.ones(7), (2, 9, 9)).astype(np.float32)
    found = cleaned_chance(np.moveaxis(chance, -1, 1))
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-5)
    nothing = one_hot(np.zeros((2, 8, 8), int))
    np.testing.assert_array_equal(cleaned_chance(nothing), nothing)


@pytest.mark.parametrize(("neck", "joined"), [(0.4, True), (0.02, False)])
def test_an_auricle_is_joined_along_a_likely_neck_and_no_other(neck, joined):
    """A body and a finger of left atrium, four pixels of doubt between them."""
    probability = np.zeros((5, 7, 40, 60), np.float32)
    probability[:, 0] = 1.0
    place = np.zeros((5, 40, 60), np.float32)
    place[:, 10:30, 5:25] = place[1:4, 17:23, 29:45] = 0.95
    place[2, 19:21, 25:29] = neck
    probability[:, ATRIUM], probability[:, 0] = place, 1 - place

    found = cleaned_chance(probability).argmax(axis=1) == ATRIUM

    assert found[2, 20, 40] == joined
    assert found[2, 20, 27] == joined
    assert label(found, np.ones((3, 3, 3)))[1] == 1
