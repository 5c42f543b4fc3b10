"""Blood of which a network is unsure: walks with known ends, and a crescent that fades out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.imaging.cine import Cine
from pipeline.imaging.inference import PlaneProbability
from pipeline.imaging.labels import LABELS, most_probable
from pipeline.imaging.plain_blood import settle_plain_blood, walked
from pipeline.imaging.view import view_of

SIDE, PIXEL_MM = 96, 1.5
CAVITY, MUSCLE, RIGHT = (LABELS[name] for name in ("lv_cavity", "lv_myocardium", "rv_cavity"))
LEFT_ATRIUM = LABELS["left_atrium"]
BLOOD, WALL, LUNG = 1.0, 0.35, 0.08
ROWS, COLUMNS = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
AWAY, ANGLE = np.hypot(ROWS, COLUMNS), np.degrees(np.arctan2(ROWS, -COLUMNS))
"""From the left ventricle's middle, and from the way to the right one, which is 0."""

CRESCENT = (AWAY > 25) & (AWAY < 37) & (np.abs(ANGLE) < 75)


def strip(image):
    """A strip of one row that the network is unsure of but for its ends, 0 and 1."""
    share = np.full((1, len(image)), 0.5, np.float32)
    share[0, 0], share[0, -1] = 0, 1
    unsure = (share > 0) & (share < 1)
    whole = np.ones(share.shape, bool)
    return walked(share, np.array(image, np.float32)[None], whole, unsure)


def test_on_a_plain_strip_a_walk_ends_at_either_end_as_the_gambler_is_ruined():
    # The prior's weight of 1e-6 adds up to 1e-6 n^2 / 8 over a strip.
    assert strip(np.ones(21)) == pytest.approx(np.arange(1, 20) / 20, abs=1e-4)


def test_a_walk_does_not_cross_an_edge():
    image = np.where(np.arange(21) < 8, 0.0, 4.0)
    # Across an edge of four, and by leakage, a way counts exp(-8) + 1e-4 of a plain one.
    way = np.exp(-8) + 1e-4
    resistance = np.concatenate([np.ones(7), [1 / way], np.ones(12)])
    expected = np.cumsum(resistance)[:-1] / resistance.sum()
    assert strip(image) == pytest.approx(expected, abs=1e-2)
    assert expected[6] < 0.01
    assert expected[7] > 0.99


def study(slices=3, fades=True, beyond=None, noise=0.02, seed=1, chamber=RIGHT):
    """A ring of muscle with a crescent of a chamber, of which the network sees one end.

    ``beyond``: grey of what lies beyond 35 degrees instead of blood.
    """
    image = np.select([AWAY < 12, AWAY < 25, CRESCENT], [BLOOD, WALL, BLOOD], LUNG)
    if beyond is not None:
        image[CRESCENT & (ANGLE > 35)] = beyond
    chance = np.zeros((1 + len(LABELS), SIDE, SIDE), np.float32)
    certainty = np.interp(ANGLE, [0, 70], [1, 0.15 if fades else 1])
    chance[chamber] = np.where(CRESCENT, 0.999 * certainty, 0.001)
    chance[CAVITY], chance[MUSCLE] = AWAY < 12, (AWAY >= 12) & (AWAY < 25)
    chance[chamber] *= AWAY >= 25
    chance[0] = 1 - chance[1:].sum(axis=0)
    picture = image + noise * np.random.default_rng(seed).standard_normal((slices, SIDE, SIDE))
    frame = np.diag([PIXEL_MM, PIXEL_MM, 10.0, 1.0])
    cine = Cine(picture[None].astype(np.float32), frame, np.zeros(1), 1.0)
    value = np.repeat(chance[None], 3 * slices, axis=0)[None].copy()
    return PlaneProbability(value, view_of(cine), 3), cine


def dice(planes, chamber=RIGHT):
    """Dice of the chamber on each plane with the crescent."""
    drawn = most_probable(planes) == chamber
    return 2 * (drawn & CRESCENT).sum(axis=(1, 2)) / (drawn.sum(axis=(1, 2)) + CRESCENT.sum())


@pytest.mark.parametrize("chamber", [RIGHT, LEFT_ATRIUM])
def test_a_chamber_goes_on_to_where_its_blood_ends(chamber):
    found, cine = study(chamber=chamber)
    assert dice(found.value[0], chamber).max() < 0.9
    settle_plain_blood(found, cine)
    assert dice(found.value[0], chamber).min() > 0.97


@pytest.mark.parametrize("means", [-1.0, 5.0])
def test_greys_that_were_shifted_change_nothing(means):
    found, cine = study()
    shifted, other = study()
    greys = other.intensity + np.float32(means) * other.intensity.mean()
    settle_plain_blood(found, cine)
    settle_plain_blood(shifted, Cine(greys, other.mr_from_index, other.phases, 1.0))
    assert dice(shifted.value[0]) == pytest.approx(dice(found.value[0]), abs=0.01)


@pytest.mark.parametrize("beyond", [LUNG, WALL, 2.2])
def test_it_ends_where_the_image_shows_another_tissue(beyond):
    found, cine = study(beyond=beyond)
    elsewhere = CRESCENT & (ANGLE > 42)
    before = most_probable(found.value[0])[:, elsewhere]
    settle_plain_blood(found, cine)
    assert (most_probable(found.value[0])[:, elsewhere] == before).all()


def test_an_outline_that_is_merely_soft_stays():
    found, cine = study(fades=False)
    soft = 1 / (1 + np.exp((AWAY - 37) / 0.8)) * CRESCENT
    found.value[0, :, RIGHT] = np.where(CRESCENT, soft, found.value[0, :, RIGHT])
    found.value[0, :, 0] = 1 - found.value[0, :, 1:].sum(axis=1)
    before = found.value.copy()
    settle_plain_blood(found, cine)
    assert (found.value == before).all()


@pytest.mark.parametrize("chamber", [RIGHT, LEFT_ATRIUM])
def test_where_the_ring_of_muscle_is_not_whole_ventricles_stay(chamber):
    found, cine = study(chamber=chamber)
    # The last slice cuts half of the muscle; the other half is aorta there.
    half = (AWAY >= 12) & (AWAY < 25) & (ROWS > 0)
    for plane in found.value[0, 6:]:
        plane[LABELS["aorta"]][half], plane[MUSCLE][half] = 1, 0
    before = found.value.copy()
    settle_plain_blood(found, cine)
    changed = (found.value[0] != before[0]).any(axis=(1, 2, 3))
    assert changed.tolist() == [True] * 6 + [chamber != RIGHT] * 3


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([0.0, 0.02, 0.1]))
def test_only_background_becomes_chamber(seed, noise):
    found, cine = study(slices=2, noise=noise, seed=seed)
    rng = np.random.default_rng(seed)
    # Here and there a pixel is anything.
    odd = rng.random((*found.value.shape[:2], 1, SIDE, SIDE)) < 0.1
    found.value[:] = np.where(odd, rng.random(found.value.shape), found.value)
    found.value[:] /= found.value.sum(axis=2, keepdims=True)
    before = found.value.copy()
    settle_plain_blood(found, cine)
    chambers = [RIGHT, LEFT_ATRIUM]
    others = [k for k in range(1 + len(LABELS)) if k not in (0, *chambers)]
    assert (found.value[:, :, others] == before[:, :, others]).all()
    assert (found.value[:, :, chambers] >= before[:, :, chambers] - 1e-6).all()
    assert found.value.sum(axis=2) == pytest.approx(before.sum(axis=2), abs=1e-5)
    assert found.value.min() >= 0
