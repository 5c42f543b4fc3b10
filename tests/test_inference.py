"""The network by either engine; phases mixed with their neighbours: what is kept and what goes."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_synth.beat import end_systole_phase, kick_onset_phase, warp_phase
from pipeline.imaging import inference, network
from pipeline.imaging.cine import Cine, Stack
from pipeline.imaging.inference import (
    PlaneProbability,
    blend_phases,
    bring_to_one_axis,
    settle_tricuspid,
)
from pipeline.imaging.labels import LABELS, MUSCLE
from pipeline.imaging.network import WEIGHTS, predict, read_onnx
from pipeline.imaging.view import View
from pipeline.products import read_cine, write_cine


@pytest.mark.parametrize(("count", "share"), [(25, 0.25), (8, 0.1), (3, 0.2), (2, 0.25)])
def test_blending_is_the_cyclic_low_pass_that_its_formula_says(count, share):
    value = np.random.default_rng(1).uniform(0.4, 0.6, (count, 2, 7, 1, 3)).astype(np.float32)
    mean = 1 - 2 * share + 2 * share * np.cos(2 * np.pi * np.fft.fftfreq(count))
    kept = (2 * mean - mean**2)[:, None, None, None, None]
    expected = np.fft.ifft(kept * np.fft.fft(value, axis=0), axis=0).real
    blend_phases(value, share, np.arange(count) / count)
    np.testing.assert_allclose(value, expected, atol=1e-6)


def test_blending_leaves_the_turn_at_end_systole_where_it_is():
    """A border that comes in, turns and goes out as a parabola, and a pixel that flickers."""
    time = np.arange(12.0)
    value = np.zeros((12, 1, 2, 1, 1), np.float32)
    value[:, 0, 0, 0, 0], value[:, 0, 1, 0, 0] = (
        0.2 + 0.02 * (time - 5) ** 2,
        0.5 + 0.1 * (-1) ** time,
    )
    parabola = value[2:10, 0, 0].copy()
    blend_phases(value, 0.25, np.arange(len(value)) / len(value))
    np.testing.assert_allclose(value[2:10, 0, 0], parabola, atol=1e-6)
    np.testing.assert_allclose(value[:, 0, 1], 0.5, atol=1e-6)


def test_blending_leaves_no_probability_below_nothing():
    value = np.zeros((6, 1, 1, 1, 1), np.float32)
    value[0] = 1
    blend_phases(value, 0.25, np.arange(len(value)) / len(value))
    np.testing.assert_allclose(value.ravel(), [0.625, 0.25, 0, 0, 0, 0.25], atol=1e-7)


def test_blending_mixes_nothing_across_a_gap_of_the_beat():
    """Phases of a scanner that stops at 0.76 of the beat; the heart is elsewhere when it starts."""
    phases = 0.76 * np.arange(20) / 19
    value = np.cos(2 * np.pi * phases).astype(np.float32)[:, None, None, None, None] + 2
    blended = value.copy()
    blend_phases(blended, 0.25, phases)
    beside = [0, 1, 18, 19]
    np.testing.assert_array_equal(blended[beside], value[beside])
    # Elsewhere a cosine loses share^2 (2 - 2 cos(step))^2 of itself.
    kept = 1 - 0.25**2 * (2 - 2 * np.cos(2 * np.pi * 0.04)) ** 2
    np.testing.assert_allclose(blended[2:18] - 2, kept * (value[2:18] - 2), atol=1e-6)


def seen_by_slices(phases, rr_s, cycle_rr_s):
    """A wave ``(phase, slice)`` where the phantom's heart is in each slice's own beat."""

    def landmarks(length_s):
        rate = 60 / length_s
        return 0.0, end_systole_phase(rate), kick_onset_phase(rate)

    moments = [
        [warp_phase(one, landmarks(rr), landmarks(cycle_rr_s)) for rr in rr_s] for one in phases
    ]
    return np.cos(2 * np.pi * np.array(moments))


def found_in(wave, cine):
    """Probabilities of three planes a slice, all of one wave, the last slice nearest the apex."""
    order = tuple(range(wave.shape[1]))[::-1]
    planes = np.repeat(wave[:, order], 3, axis=1)[..., None, None, None]
    view = View(np.eye(4), np.eye(3), np.zeros(3), (1, 1), order)
    return PlaneProbability(np.repeat(planes.astype(np.float32), 2, axis=2), view, 3)


def cine_of(phases, rr_s, folder):
    """Five slices as they are kept between stages, their trigger times shares of their beats."""
    rr_ms = 1000 * np.array(rr_s)
    bare = Cine(np.zeros((len(phases), 5, 1, 1), np.float32), np.eye(4), phases, 0.9)
    write_cine(folder, Stack(bare, phases * rr_ms[:, None], rr_ms, "", ()))
    return read_cine(folder)


def test_slices_of_long_and_short_beats_come_to_the_moments_of_the_mean_beat(tmp_path):
    """Against the phantom's own law of how systole keeps its length."""
    phases, rr_s = np.arange(25) / 25, (0.7, 0.8, 0.9, 1.0, 1.1)
    wave = seen_by_slices(phases, rr_s, 0.9)
    cine = cine_of(phases, rr_s, tmp_path)
    found = found_in(wave, cine)
    before = found.value.copy()

    assert bring_to_one_axis(found, cine)

    expected = np.cos(2 * np.pi * phases)[:, None]
    # Straight lines over steps of 0.04 to 0.06 of the cycle; both laws part by 0.01 of it.
    allowed = (2 * np.pi * 0.06) ** 2 / 8 + 2 * np.pi * 0.01
    assert np.abs(found.value[:, :, 0, 0, 0] - expected).max() <= allowed
    assert np.abs(wave - expected).max() > 4 * allowed
    np.testing.assert_array_equal(found.value[:, 6:9], before[:, 6:9])


@pytest.mark.parametrize(
    ("phases", "rr_s"),
    [
        (np.arange(25) / 25, (0.89, 0.9, 0.9, 0.9, 0.91)),
        (np.array([0.0, 0.4]), (0.7, 0.8, 0.9, 1.0, 1.1)),
    ],
    ids=["alike", "two phases"],
)
def test_slices_stay_as_they_are_where_nothing_is_to_be_moved(phases, rr_s, tmp_path):
    cine = cine_of(phases, rr_s, tmp_path)
    found = found_in(seen_by_slices(phases, rr_s, 0.9), cine)
    before = found.value.copy()
    bring_to_one_axis(found, cine)
    np.testing.assert_array_equal(found.value, before)


def test_slices_taken_at_the_same_times_after_the_r_peak_are_not_moved_in_systole(tmp_path):
    """As by a scanner that waits for each R peak: in a longer beat systole is hardly longer."""
    times_ms, rr_ms = 36.0 * np.arange(12), np.array([870.0, 885, 900, 915, 930])
    cine = Cine(np.zeros((12, 5, 1, 1), np.float32), np.eye(4), times_ms / 900, 0.9)
    write_cine(tmp_path, Stack(cine, np.tile(times_ms, (5, 1)), rr_ms, "", ()))
    moments = read_cine(tmp_path).moments
    assert moments is not None
    systolic = times_ms < 1000 * 0.9 * end_systole_phase(60 / 0.9) - 20
    # In a beat 30 ms longer systole is 5 ms longer: 0.005 of the cycle. Shares of the beat part by
    # 0.015.
    assert np.abs(moments - times_ms / 900)[:, systolic].max() <= 0.01


RIGHT = [LABELS["right_atrium"], LABELS["rv_cavity"]]


def _right_heart(of_atrium):
    """``(phase, 1, 7, 1, place)``: whose blood each place is in each phase, little is muscle."""
    share = np.where(of_atrium, 0.9, 0.05).astype(np.float32)
    value = np.zeros((len(share), 1, 7, 1, share.shape[1]), np.float32)
    value[:, 0, RIGHT[0], 0], value[:, 0, RIGHT[1], 0] = share, np.float32(0.95) - share
    value[:, 0, MUSCLE] = 0.05
    return value


def test_slices_whose_labels_come_and_go_are_looked_at_in_all_ways(monkeypatch):
    """Of 24 phases of 12 slices there is time for two looks at each. In these two of the three
    planes of slice 4 are taken for the atrium twice a beat, in the other three never."""
    frame = np.diag([1.3, 1.3, 8.0, 1.0])
    cine = Cine(np.zeros((24, 12, 60, 60), np.float32), frame, np.arange(24) / 24, 1.0)
    view = View(frame, np.eye(3), np.zeros(3), (60, 60), tuple(range(12)))
    disc = np.hypot(*(np.mgrid[:60, :60] - 30)) < 20
    cavity, atrium = LABELS["lv_cavity"], LABELS["left_atrium"]
    looks = []

    def predicted(_cine, view, phase, chosen, turn_deg, _alone):
        chance = np.zeros((len(chosen), 3, 7, *view.shape), np.float32)
        chance[:, :, 0] = 1
        for place, number in enumerate(chosen):
            astray = (
                number == 4 and phase % 12 == 0 and abs(turn_deg) in (10, 20) and len(chosen) > 1
            )
            chance[place, :, :, disc] = np.eye(7)[cavity]
            if astray:
                chance[place, :2, :, disc] = np.eye(7)[atrium]
        looks.append((phase, tuple(chosen), turn_deg))
        return chance

    monkeypatch.setattr(inference, "_predicted", predicted)
    found = inference.label_probability(cine, view, 5).value[:, :, :, 30, 30]
    halves = [
        [look for look in looks if look[1] == tuple(range(*half))] for half in ((0, 6), (6, 12))
    ]
    more = [look for look in looks if look[1] == (4,)]
    assert len(halves[0]) + len(halves[1]) + len(more) == len(looks)
    for phase in range(24):
        ways = [[turn for k, _, turn in kind if k == phase] for kind in (halves[0], more)]
        assert len(ways[0]) == 2
        assert sorted(turn for k, _, turn in halves[1] if k == phase) == sorted(ways[0])
        assert sorted(ways[0] + ways[1]) == sorted(inference.turns_deg(phase, 5))
    of_slice = found.reshape(24, 12, 3, 7)
    np.testing.assert_allclose(of_slice[::12, 4, :2, atrium], 2 / 5, atol=1e-6)
    np.testing.assert_allclose(of_slice[::12, 4, :2, cavity], 3 / 5, atol=1e-6)
    np.testing.assert_allclose(of_slice[1::12, 4, :, cavity], 1, atol=1e-6)
    np.testing.assert_allclose(np.delete(of_slice, 4, axis=1)[..., cavity], 1, atol=1e-6)


@given(
    phase=st.integers(0, 3),
    most=st.integers(1, 5),
    data=st.data(),
)
def test_more_looks_are_others_and_as_many_as_there_is_time_for(phase, most, data):
    count = data.draw(st.integers(1, most))
    images = data.draw(st.integers(1, 20_000))
    first, more = (
        inference.turns_deg(phase, count),
        inference.more_turns_deg(phase, count, most, images),
    )
    assert not set(first) & set(more)
    assert set(more) <= set(inference.turns_deg(phase, most))
    others = len(set(inference.turns_deg(phase, most)) - set(first))
    assert len(more) <= 1 or len(more) * images <= 2 * inference.LOOKS + images / 2
    assert len(more) == others or (len(more) + 1) * images > 2 * inference.LOOKS - images / 2


@given(
    phases=st.integers(12, 60),
    starts=st.lists(st.integers(0, 59), min_size=1, max_size=8),
    data=st.data(),
)
def test_the_right_atrium_reaches_a_place_for_longer_than_a_twelfth_of_the_beat_or_not_at_all(
    phases, starts, data
):
    reach = phases // 12
    phase = np.arange(phases)[:, None]
    last = np.array([data.draw(st.integers(reach + 1, phases)) for _ in starts])
    long = (phase - starts) % phases < last
    brief = (phase - starts) % phases < data.draw(st.integers(1, reach))
    # The ventricle may come for a moment: at end-diastole it is largest for no longer.
    for of_atrium, expected in ((long, long), (brief, brief & False), (~brief, ~brief)):
        value = _right_heart(of_atrium)
        settle_tricuspid(value)
        np.testing.assert_allclose(value, _right_heart(expected), atol=1e-6)


def test_the_right_ventricle_takes_from_its_atrium_alone_and_never_gives():
    rng = np.random.default_rng(3)
    value = rng.dirichlet(np.full(7, 0.3), (24, 2, 5, 6)).astype(np.float32)
    value = value.transpose(0, 1, 4, 2, 3).copy()
    before, few = value.copy(), value[:11].copy()
    settle_tricuspid(value)
    settle_tricuspid(few)
    np.testing.assert_array_equal(few, before[:11])
    others = [k for k in range(7) if k not in RIGHT]
    np.testing.assert_array_equal(value[:, :, others], before[:, :, others])
    gained = value - before
    assert (gained[:, :, RIGHT[1]] >= 0).all()
    assert (gained[:, :, RIGHT[1]] > 0).any()
    np.testing.assert_allclose(gained[:, :, RIGHT].sum(axis=2), 0, atol=1e-6)
    elsewhere = before[:, :, RIGHT].sum(axis=2) < 0.5
    assert not gained[:, :, RIGHT[1]][elsewhere].any()


def test_the_network_says_the_same_where_opencv_has_no_classic_engine(monkeypatch):
    """The newer engine shares no convolution with the classic one."""
    images = np.random.default_rng(4).uniform(0, 1, (3, 3, 64, 96)).astype(np.float32)
    found = predict(images)
    monkeypatch.delattr(cv2.dnn, "ENGINE_CLASSIC", raising=False)
    newer = read_onnx(WEIGHTS)
    monkeypatch.setattr(network, "idle", [newer])
    # Single precision, some 20 layers deep with sums of up to 2448 terms; Winograd's rounds more.
    np.testing.assert_allclose(predict(images), found, atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 12, 33, 200])
def test_slices_are_shared_out_in_parts_that_memory_holds(count):
    parts = inference._parts(np.arange(count) + 5)
    assert [one for part in parts for one in part] == list(range(5, 5 + count))
    sizes = [len(part) for part in parts]
    assert len(parts) >= min(2, count)
    assert not count or 1 <= min(sizes) <= max(sizes) <= min(16, min(sizes) + 1)


def test_threads_that_ask_at_once_are_answered_as_one_alone_is(monkeypatch):
    monkeypatch.setattr(network, "idle", [])
    images = np.random.default_rng(5).uniform(0, 1, (6, 1, 3, 64, 64)).astype(np.float32)
    alone = [predict(one) for one in images]
    threads = cv2.getNumThreads()
    with network.side_by_side() as pool:
        together = list(pool.map(predict, images))
        assert cv2.getNumThreads() == 1
    np.testing.assert_array_equal(together, alone)
    assert cv2.getNumThreads() == threads
    assert len(network.idle) == 1
