"""Labels that come and go are told from labels that change once a beat, and averaged in time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter

from pipeline.imaging.flicker import WIDTHS_BEATS, excess, settle_flicker
from pipeline.imaging.labels import LABELS

SIDE, PIXEL_MM = 40, 1.3
CAVITY, ATRIUM = LABELS["lv_cavity"], LABELS["left_atrium"]

rows, columns = np.mgrid[:SIDE, :SIDE]
DISC = np.hypot(rows - 15, columns - 15) < 10


def beat(labels, where=DISC):
    """Probabilities ``(phase, 1, 7, row, column)``: a disc of the one label that each phase has."""
    value = np.zeros((len(labels), 1, 7, SIDE, SIDE), np.float32)
    value[:, :, 0] = 1
    for phase, label in enumerate(labels):
        value[phase, 0][:, where] = np.eye(7, dtype=np.float32)[label][:, None]
    return value


def mean_over(count, width_beats):
    """2 G - G G of a Gaussian over a beat of even phases, by Fourier's series."""
    apart = np.abs(np.arange(count) / count - np.round(np.arange(count) / count))
    kept = np.fft.fft(np.exp(-0.5 * (apart / width_beats) ** 2))
    kept /= kept[0]
    kernel = np.fft.ifft(2 * kept - kept**2).real
    return np.stack([np.roll(kernel, shift) for shift in range(count)])


def drawn(value):
    return value[:, 0].argmax(axis=1)


def even(count):
    return np.arange(count) / count


@given(
    areas=st.lists(st.floats(0, 1e4), min_size=1, max_size=60),
    rises=st.lists(st.booleans(), min_size=60, max_size=60),
    turned=st.integers(0, 60),
    least=st.floats(1, 1e3),
)
def test_what_grows_once_and_shrinks_once_changes_no_oftener_wherever_the_beat_begins(
    areas, rises, turned, least
):
    """Any values in any shares between the way up and the way down, the largest between them."""
    up = [one for one, rise in zip(sorted(areas), rises, strict=False) if rise]
    down = [one for one, rise in zip(sorted(areas), rises, strict=False) if not rise]
    once = np.roll(np.array(up + down[::-1]), turned)
    assert excess(once, least) == pytest.approx(0, abs=1e-9)


@given(st.lists(st.floats(0, 100), min_size=4, max_size=40), st.integers(0, 40))
def test_excess_hangs_neither_on_where_the_beat_begins_nor_on_its_direction(areas, turned):
    areas = np.array(areas)
    expected = excess(areas, 10.0)
    assert expected >= -1e-12
    assert excess(np.roll(areas, turned), 10.0) == pytest.approx(expected, abs=1e-12)
    assert excess(areas[::-1], 10.0) == pytest.approx(expected, abs=1e-12)


def test_excess_is_what_comes_and_goes_again_as_a_share_of_the_largest_area_or_the_least():
    # Up by 80, down by 40, up by 40, down by 80: 240 in all, of which 160 are once up, once down.
    assert excess(np.array([0.0, 80.0, 40.0, 80.0]), 10.0) == pytest.approx(80 / 80)
    assert excess(np.array([0.0, 80.0, 40.0, 80.0]), 320.0) == pytest.approx(80 / 320)


@given(start=st.integers(0, 24), last=st.integers(0, 25))
def test_a_valve_that_passes_once_to_and_once_fro_is_left_to_the_bit(start, last):
    of_atrium = (np.arange(25) - start) % 25 < last
    value = beat(np.where(of_atrium, ATRIUM, CAVITY))
    before = value.copy()
    assert not settle_flicker(value, even(25), PIXEL_MM).any()
    np.testing.assert_array_equal(value, before)


def test_a_ventricle_taken_for_its_atrium_at_single_moments_is_one_at_all():
    labels = np.full(24, CAVITY)
    labels[[3, 8, 14, 19]] = ATRIUM
    value = beat(labels)
    widths = settle_flicker(value, even(24), PIXEL_MM)
    assert (drawn(value)[:, DISC] == CAVITY).all()
    assert set(np.flatnonzero(widths[0])) == {CAVITY, ATRIUM}
    np.testing.assert_allclose(value.sum(axis=2), 1, atol=1e-5)
    assert value.min() >= 0


def test_the_mean_is_taken_once_over_the_cycle_and_nothing_falls_below_nothing():
    labels = np.full(24, CAVITY)
    labels[[0, 1, 8, 9]] = ATRIUM
    value = beat(labels)
    before = value[:, 0, :, 15, 15].astype(float)
    widths = settle_flicker(value, even(24), PIXEL_MM)
    assert widths[0, CAVITY] == widths[0, ATRIUM]
    expected = mean_over(24, widths[0, CAVITY]) @ before
    assert expected.min() < -1e-3
    np.testing.assert_allclose(value[:, 0, :, 15, 15], np.maximum(expected, 0), atol=1e-5)


def test_where_two_labels_meet_the_longer_mean_counts():
    """The atrium comes and goes in a part of the cavity, more of its own area than of the other."""
    value = beat(np.full(24, CAVITY))
    part = np.hypot(rows - 15, columns - 15) < 4
    for phase in (0, 1, 8, 9):
        value[phase, 0][:, part] = np.eye(7, dtype=np.float32)[ATRIUM][:, None]
    before = value[:, 0, :, 15, 15].astype(float)
    widths = settle_flicker(value, even(24), PIXEL_MM)
    assert 0 < widths[0, CAVITY] < widths[0, ATRIUM]
    of_atrium, of_cavity = (
        np.maximum(mean_over(24, widths[0, label]) @ before, 0) for label in (ATRIUM, CAVITY)
    )
    # The edge of so small a place fades out from its middle on.
    off = np.abs(value[:, 0, :, 15, 15] - of_atrium).max()
    assert off < 0.1 * np.abs(of_cavity - of_atrium).max()


def test_to_and_fro_before_a_turn_leaves_one_turn():
    """The atrium is there for half of the beat, and for a moment before and after."""
    of_atrium = np.zeros(24, bool)
    of_atrium[6:18] = True
    of_atrium[[4, 19]] = True
    value = beat(np.where(of_atrium, ATRIUM, CAVITY))
    settle_flicker(value, even(24), PIXEL_MM)
    found = drawn(value)[:, 15, 15] == ATRIUM
    assert np.count_nonzero(found != np.roll(found, 1)) == 2
    assert found[7:17].all()
    assert not found[20:].any()
    assert not found[:4].any()


def test_the_mean_is_no_longer_than_it_must_be():
    """What misses a third of its area once more than a heart does needs a shorter one than what
    misses all of it."""
    widths = []
    for share in (0.35, 1.0):
        value = beat([CAVITY] * 24)
        missed = DISC & (rows < 15 - 10 + 20 * share)
        for phase in (6, 18):
            value[phase, 0][:, missed] = np.eye(7, dtype=np.float32)[0][:, None]
        widths.append(settle_flicker(value, even(24), PIXEL_MM)[0, CAVITY])
    assert 0 < widths[0] < widths[1] <= WIDTHS_BEATS[-1]


def test_nothing_far_from_what_flickers_changes_nor_another_plane():
    labels = np.full(24, CAVITY)
    labels[[3, 8, 14, 19]] = ATRIUM
    value = np.concatenate([beat(labels), beat(np.full(24, CAVITY))], axis=1)
    # Enlarged by two pixels, and by four standard deviations of two, to all sides.
    far = ~maximum_filter(DISC, 2 * (2 + 8) + 1)
    noise = np.random.default_rng(2).dirichlet(np.ones(7), (24, far.sum())).astype(np.float32)
    value[:, 0][:, :, far] = 0.29 * noise.transpose(0, 2, 1)
    before = value.copy()
    settle_flicker(value, even(24), PIXEL_MM)
    np.testing.assert_array_equal(value[:, 1], before[:, 1])
    np.testing.assert_array_equal(value[:, 0][:, :, far], before[:, 0][:, :, far])
    assert (value[:, 0][:, :, DISC] != before[:, 0][:, :, DISC]).any()


@given(st.lists(st.sampled_from([CAVITY, ATRIUM]), min_size=2, max_size=3))
def test_two_or_three_phases_cannot_come_and_go(labels):
    value = beat(labels)
    before = value.copy()
    settle_flicker(value, even(len(labels)), PIXEL_MM)
    np.testing.assert_array_equal(value, before)
