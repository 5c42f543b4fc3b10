"""Outflows and atria taken for a second aorta, stomachs for an atrium, and ventricles for one."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.imaging.lookalikes import (
    ATRIUM_TOO_OFTEN,
    ATRIUM_TOO_SELDOM,
    CAVITY_TOO_SELDOM,
    clear_apex,
    favour_left_atrium,
    favour_left_cavity,
    favour_right_ventricle,
    part_from_right_heart,
)

SIDE, PIXEL_MM = 64, 1.5
CAVITY, MUSCLE, RV, LA, RA, AORTA = 1, 2, 3, 4, 5, 6
Y, X = np.mgrid[:SIDE, :SIDE]


def disc(row, column, radius):
    return np.hypot(Y - row, X - column) < radius


ROOT, BESIDE = disc(36, 37, 8), disc(26, 22, 9)
BOTH = np.where(ROOT | BESIDE, AORTA, 0)
ALONE = np.where(ROOT, AORTA, 0)


def one_hot(labels, second=0):
    """Probabilities that are fairly certain of these labels, and think of ``second`` next."""
    value = np.moveaxis(np.eye(7, dtype=np.float32)[labels], -1, -3) * 0.6
    value[..., second, :, :] += 0.2
    return value + 0.2 / 7


def below(beside=RV):
    """A ventricle's ring, on whose cavity the root stands, and the right heart before it."""
    ring = np.where(disc(36, 37, 10), CAVITY, np.where(disc(36, 37, 13), MUSCLE, 0))
    return np.where(BESIDE, beside, ring)


def parted(planes, second=0):
    part = one_hot(np.stack(planes), second)
    part_from_right_heart(part, PIXEL_MM)
    np.testing.assert_allclose(part.sum(axis=1), 1, atol=1e-5)
    return part.argmax(axis=1)


@pytest.mark.parametrize("kind", [RV, RA])
def test_a_disc_on_the_right_heart_is_the_right_hearts(kind):
    found = parted([below(kind), BOTH, BOTH], second=kind)
    for plane in found[1:]:
        np.testing.assert_array_equal(plane[ROOT], AORTA)
        np.testing.assert_array_equal(plane[BESIDE], kind)


def test_what_is_likelier_no_heart_becomes_none_and_never_an_atrium_of_the_left():
    np.testing.assert_array_equal(parted([below(), BOTH])[1][BESIDE], 0)
    found = parted([below(), BOTH], second=LA)[1][BESIDE]
    assert np.isin(found, (0, RV)).all()


def test_discs_that_melt_into_one_are_parted_where_they_part_below():
    points = np.argwhere(BOTH)[:, ::-1].astype(np.int32)
    melted = cv2.fillConvexPoly(np.zeros((SIDE, SIDE), np.uint8), cv2.convexHull(points), AORTA)
    found = parted([below(), BOTH, melted, ALONE, ALONE], second=RV)
    for plane in found[1:]:
        np.testing.assert_array_equal(plane[ROOT], AORTA)
    assert (found[2][BESIDE] == RV).all()


def test_a_root_that_leans_over_the_right_heart_beside_its_disc_stays_whole():
    leaning, aside = disc(32, 32, 8), disc(22, 18, 8)
    assert 0.15 < BESIDE[leaning].mean() < 0.5 * ROOT[leaning].mean()
    assert BESIDE[aside].mean() > 0.5
    alone = np.where(leaning, AORTA, 0)
    found = parted([below(), BOTH, np.where(aside, AORTA, alone), alone, alone], second=RV)
    for plane in found[2:]:
        np.testing.assert_array_equal(plane[leaning], AORTA)
    np.testing.assert_array_equal(found[2][aside], RV)


def test_an_aorta_alone_stays_whatever_lies_beneath_it():
    alone = np.where(BESIDE, AORTA, 0)
    spotted = alone.copy()
    spotted[50:54, 50:54] = AORTA
    for planes in ([below(), alone, alone], [below(), spotted, alone]):
        np.testing.assert_array_equal(parted(planes) == AORTA, np.stack(planes) == AORTA)


def test_an_aorta_that_leans_over_the_right_heart_stays_whole():
    leaning = np.where(disc(31, 31, 9), AORTA, 0)
    beneath = leaning > 0
    assert 0.1 < (below() == RV)[beneath].mean() < 0.5
    planes = [below(), leaning, leaning]
    np.testing.assert_array_equal(parted(planes), np.stack(planes))


def test_neither_atrium_nor_aorta_lies_beside_the_tip():
    rings = [
        np.where(disc(32, 32, 2 + 3 * k), CAVITY, np.where(disc(32, 32, 8 + 3 * k), MUSCLE, 0))
        for k in range(5)
    ]
    fat = np.where(disc(40, 40, 2), MUSCLE, 0)
    # The tip is plane 3, the widest cut plane 7: plane 5 is the first that may show them.
    heart = np.stack([np.zeros_like(fat), fat, np.zeros_like(fat), *rings])
    thing = disc(6, 6, 5)
    for kind in (LA, AORTA):
        for plane in range(len(heart)):
            marked = heart.copy()
            marked[plane, thing] = kind
            value = one_hot(np.stack([marked, heart]))
            clear_apex(value)
            np.testing.assert_array_equal(value.argmax(axis=2)[0], marked if plane >= 5 else heart)
            np.testing.assert_allclose(value.sum(axis=2), 1, atol=1e-5)


def test_where_no_ventricle_is_nothing_is_cleared():
    labels = np.zeros((1, 3, SIDE, SIDE), int)
    labels[:, :, BESIDE] = LA
    value = one_hot(labels)
    clear_apex(value)
    np.testing.assert_array_equal(value.argmax(axis=2), labels)


@pytest.mark.parametrize(
    ("favour", "gains", "loses", "factor"),
    [
        (favour_right_ventricle, RV, RA, ATRIUM_TOO_OFTEN),
        (favour_left_cavity, CAVITY, MUSCLE, CAVITY_TOO_SELDOM),
    ],
)
@given(
    one=st.floats(0, 1, width=32),
    other=st.floats(0, 1, width=32),
    rest=st.floats(0.125, 1, width=32),
)
def test_odds_of_two_structures_change_by_the_factor_and_nothing_else(
    favour, gains, loses, factor, one, other, rest
):
    value = np.zeros((1, 1, 7, 1, 1), np.float32)
    value[0, 0, [gains, loses, 0], 0, 0] = np.array([one, other, rest]) / (one + other + rest)
    before = value[0, 0, :, 0, 0].copy()
    favour(value)
    after = value[0, 0, :, 0, 0]
    two = [gains, loses]
    np.testing.assert_array_equal(np.delete(after, two), np.delete(before, two))
    assert after.min() >= 0
    assert after[two].sum() == pytest.approx(before[two].sum(), abs=1e-6)
    # Bayes' rule: odds after = odds before times the ratio of the priors.
    ours, theirs = after[gains] * before[loses], factor * before[gains] * after[loses]
    assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-6)


@given(st.lists(st.floats(0, 1), min_size=7, max_size=7).filter(lambda shares: sum(shares) > 0.1))
def test_the_left_atriums_odds_rise_by_one_factor_and_the_others_keep_theirs(shares):
    value = np.array(shares, np.float32)[None, None, :, None, None] / np.float32(sum(shares))
    before = value[0, 0, :, 0, 0].copy()
    favour_left_atrium(value)
    after = value[0, 0, :, 0, 0]
    assert after.sum() == pytest.approx(1, abs=1e-5)
    # Odds of the atrium against each other structure, cross-multiplied: either may be nothing.
    others = np.delete(np.arange(7), LA)
    np.testing.assert_allclose(
        after[LA] * before[others],
        ATRIUM_TOO_SELDOM * before[LA] * after[others],
        rtol=1e-4,
        atol=1e-6,
    )
    # Among themselves they stay as they were.
    np.testing.assert_allclose(
        after[others] * before[others[0]], before[others] * after[others[0]], rtol=1e-4, atol=1e-6
    )
