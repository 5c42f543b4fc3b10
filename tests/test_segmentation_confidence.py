"""Confidence follows the errors of the labels; what is no heart, or spoilt, is refused by name."""

from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
from mr_phantom import as_cine
from scipy.ndimage import gaussian_filter
from skimage.data import shepp_logan_phantom

from data_synth.mr import MrSettings, acquire_cine
from data_synth.population import draw_heart
from pipeline.errors import StageError
from pipeline.imaging import confidence
from pipeline.imaging.cine import Cine
from pipeline.imaging.confidence import _without_strays, slice_confidence
from pipeline.imaging.cut_off import cut_off, cut_sideways
from pipeline.imaging.inference import PlaneProbability
from pipeline.imaging.labels import LABELS
from pipeline.imaging.no_heart import (
    _require_cavity,
    _require_right_ventricle,
    missed_hearts,
    require_understood,
)
from pipeline.imaging.segmentation import _astray_mm, segment_cine
from pipeline.imaging.settings import SegmentSettings
from pipeline.imaging.view import view_of

QUICK = SegmentSettings(most_views=1)

SLICES = 8

NAMED = r"phases? \d+.*, slices? \d+"


@pytest.fixture(scope="module")
def study():
    """A short stack of low signal to noise, two phases as research sets have them."""
    rng = np.random.default_rng(314)
    heart = draw_heart(rng, pathology="infarct")
    mr = MrSettings(
        phases=3, matrix=110, pixel_mm=2.0, snr=12.0, through_plane_samples=2, window_samples=1,
        slices=SLICES,
    )  # fmt: skip
    cine = acquire_cine(rng, heart, [800.0] * SLICES, mr)
    return as_cine(cine, 2), cine.labels[:2]


@pytest.fixture(scope="module")
def understood(study):
    return segment_cine(study[0], QUICK)


def with_image(cine, phase, number, image):
    images = cine.intensity.copy()
    images[phase, number] = image
    return replace(cine, intensity=images)


@pytest.mark.parametrize(
    ("number", "phases", "refused"),
    [(4, 1, True), (7, 1, False), (7, 10, False), (7, 11, True), (6, 1, False), (5, 1, True)],
)
def test_images_beyond_the_left_ventricle_may_be_doubted_if_they_are_few(number, phases, refused):
    """It is on slices 1 to 5 all the time, on slice 6 for less than half of the beat.

    Ten of 200 images are one in twenty.
    """
    drawn = np.zeros((25, SLICES, 64, 64), np.uint8)
    drawn[:, 1:6, 20:40, 20:40] = LABELS["lv_myocardium"]
    drawn[:12, 6, 20:40, 20:40] = LABELS["lv_cavity"]
    drawn[:, 6:, 30:50, 30:50] = LABELS["aorta"]
    confidence = np.full((25, SLICES), 0.9)
    confidence[:phases, number] = 0.39
    view = view_of(
        Cine(np.zeros((25, SLICES, 64, 64), np.float32), np.eye(4), np.arange(25) / 25, 1.0)
    )
    if not refused:
        require_understood(drawn, confidence, view, QUICK)
        return
    place = rf"phase 0, slice {view.order[number]}: .*{phases} images"
    with pytest.raises(StageError, match=place) as told:
        require_understood(drawn, confidence, view, QUICK)
    assert ("short axis?" in str(told.value)) == (phases > 10)


def test_a_good_study_of_low_signal_is_trusted(understood):
    assert understood.confidence.min() > 0.7


@pytest.mark.parametrize(
    ("number", "fault"),
    [(0, "elsewhere"), pytest.param(4, "elsewhere", marks=pytest.mark.slow), (SLICES - 1, "noise")],
)
def test_a_spoilt_image_is_refused_at_either_end_and_between(study, number, fault):
    """Noise, or another place of the body, in one phase of one slice."""
    images, _ = study
    image = images.intensity[1, number]
    if fault == "noise":
        spoilt = np.random.default_rng(number).rayleigh(image.mean(), image.shape)
    else:
        spoilt = np.roll(image, (25, 20), (0, 1))
    with pytest.raises(StageError, match=rf"phase \d, slice {number}:"):
        segment_cine(with_image(images, 1, number, spoilt.astype(np.float32)), QUICK)


@pytest.mark.slow
def test_a_blurred_slice_passes_with_a_lower_figure(study, understood):
    images, _ = study
    blurred = gaussian_filter(images.intensity[1, 4], 4.0)
    found = segment_cine(with_image(images, 1, 4, blurred), QUICK)
    assert found.confidence[1, 4] < understood.confidence[1, 4] - 0.01


def test_lower_confidence_means_more_error(study, understood):
    """Noise from none to strong on a middle slice: confidence falls as Dice does."""
    images, truth = study
    image, peak = images.intensity[0, 4], np.percentile(images.intensity, 99)
    real, imaginary = np.random.default_rng(0).normal(0, 0.25 * peak, (2, *image.shape))
    noisy = np.hypot(image + real, imaginary).astype(np.float32)
    settings = SegmentSettings(most_views=1, min_confidence=0.0)
    spoilt = segment_cine(with_image(images, 0, 4, noisy), settings)
    dices = []
    for found in (understood, spoilt):
        here, there = found.labels[0, 4], truth[0, 4]
        same = ((here == there) & (there > 0)).sum()
        dices.append(2 * same / ((here > 0).sum() + (there > 0).sum()))
    assert dices[0] > dices[1]
    assert understood.confidence[0, 4] > spoilt.confidence[0, 4]


def still(values, phases=2, slices=8, side=128):
    """The same image in every phase of slices that differ in brightness alone."""
    image = np.broadcast_to(values, (phases, slices, side, side)).astype(np.float32).copy()
    mr_from_index = np.diag([1.5, 1.5, 9.0, 1.0])
    return Cine(image, mr_from_index, np.arange(phases) / phases, 1.0)


def brain():
    """Echo-planar images of a head, which come with nibabel for its own tests."""
    path = Path(nibabel.__file__).parent / "tests" / "data" / "example4d.nii.gz"
    image = nibabel.load(path)
    intensity = np.asarray(image.dataobj, np.float32).transpose(3, 2, 1, 0)
    mr_from_index = np.diag([-1.0, -1, 1, 1]) @ image.affine
    return Cine(np.ascontiguousarray(intensity), mr_from_index, np.array([0, 0.5]), 1.0)


def head():
    drawn = shepp_logan_phantom()[::2, ::2].astype(np.float32)
    padded = np.pad(drawn, 32)[:256, :256]
    noise = np.random.default_rng(0).normal(0, 0.02, (2, 3, *padded.shape))
    return replace(still(0.0, side=256), intensity=(padded + noise).astype(np.float32))


def noise():
    return still(np.random.default_rng(1).rayleigh(100.0, (2, 8, 128, 128)))


def stripes():
    return still(np.sin(np.arange(128) / 3.0))


@pytest.mark.parametrize(
    "what",
    [
        pytest.param(brain, marks=pytest.mark.slow),
        head,
        pytest.param(noise, marks=pytest.mark.slow),
        stripes,
    ],
)
def test_what_is_no_heart_is_refused_with_phase_slice_and_advice(what):
    with pytest.raises(StageError, match=NAMED) as refused:
        segment_cine(what(), QUICK)
    assert "check" in str(refused.value)


def test_a_blank_image_is_named(study):
    images, _ = study
    with pytest.raises(StageError, match=r"phase 1, slice 7: .*alike"):
        segment_cine(with_image(images, 1, 7, 0.0), QUICK)


def test_a_phase_that_shows_nothing_is_named(study):
    images, _ = study
    intensity = images.intensity.copy()
    intensity[1] = 3.0
    words = r"phase 1: no heart found: .* leave phase 1 out.*timing\.json"
    with pytest.raises(StageError, match=words):
        segment_cine(replace(images, intensity=intensity), QUICK)


def test_images_that_are_all_empty_are_not_to_be_left_out():
    with pytest.raises(StageError, match="every image are alike; export the images again"):
        segment_cine(still(0.0), QUICK)


def beating(phases=6, slices=5, side=64):
    """A shrinking and growing bright disc in textured surroundings, and its labels' chances."""
    rng = np.random.default_rng(3)
    body = gaussian_filter(rng.normal(0, 1, (slices + 4, side, side)), (2, 2, 2))[2:-2]
    row, column = np.mgrid[:side, :side] - (side - 1) / 2
    image = np.empty((phases, slices, side, side), np.float32)
    value = np.zeros((phases, slices, 7, side, side), np.float32)
    for phase in range(phases):
        disc = np.hypot(row, column) < 15 + 3 * np.cos(2 * np.pi * phase / phases)
        image[phase] = body / body.std() + 2 * disc
        value[phase, :, LABELS["lv_cavity"]] = 0.9 * disc
        value[phase, :, 0] = 1 - value[phase, :, 1]
    mr_from_index = np.diag([1.5, 1.5, 10.0, 1.0])
    cine = Cine(image, mr_from_index, np.arange(phases) / phases, 1.0)
    return cine, PlaneProbability(value, view_of(cine), 1)


def drawn(found):
    return found.value.argmax(axis=2).astype(np.uint8)


def test_confidence_is_the_dice_to_expect_where_images_and_labels_agree(monkeypatch):
    """Truths drawn pixel by pixel from the probabilities have that Dice with the labels."""
    monkeypatch.setattr(confidence, "LEAST_CUT", 0.0)
    cine, found = beating()
    # One slice shows half of what its neighbours do, and some chance of the rest.
    heart = found.value[:, 2, 1] > 0
    heart[:, :, 32:] = False
    found.value[:, 2, 1] = np.where(heart, 0.9, found.value[:, 2, 1] / 3)
    found.value[:, 2, 0] = 1 - found.value[:, 2, 1]
    labels = drawn(found)
    trusted = slice_confidence(cine, found, labels)
    rng = np.random.default_rng(0)
    for number in (0, 2):
        chance, ours = found.value[0, number, 1], labels[0, number] > 0
        truths = rng.random((400, *chance.shape)) < chance
        dice = 2 * (truths & ours).sum(axis=(1, 2)) / (truths.sum(axis=(1, 2)) + ours.sum())
        # 400 draws of some 500 pixels: the mean is known to 0.001; the ratio of means differs by
        # the relative variance of the area, less than that.
        assert trusted[0, number] == pytest.approx(dice.mean(), abs=0.003)
    assert trusted[0, 2] < trusted[0, 0] - 0.05


def test_a_slice_that_grazes_the_tip_is_doubted_but_not_refused():
    """Few pixels, each as doubtful as can be: what is added is as sure as the outline."""
    cine, found = beating()
    row, column = np.mgrid[:64, :64] - 31.5
    tip = np.hypot(row, column) < 6
    found.value[:, 0] = 0
    trusted = []
    for chance in (0.51, 0.95):
        found.value[:, 0, 1] = np.where(tip, chance, 0)
        found.value[:, 0, 0] = 1 - found.value[:, 0, 1]
        trusted.append(slice_confidence(cine, found, drawn(found)))
    assert (trusted[0][:, 0] < trusted[1][:, 0] - 0.01).all()
    assert trusted[0].min() > 0.7


@pytest.mark.parametrize("number", [0, 2, 4])
def test_an_image_unlike_its_neighbours_is_doubted_and_they_are_not(number):
    cine, found = beating()
    z = found.view.order[number]
    cine.intensity[3, z] *= -1
    doubt = slice_confidence(cine, found, drawn(found))
    assert doubt[3, number] < 0.3
    doubt[3, number] = 0.9
    assert doubt.min() > 0.6


def test_a_slice_spoilt_in_all_phases_is_doubted():
    cine, found = beating()
    z = found.view.order[4]
    cine.intensity[:, z] *= -1
    assert slice_confidence(cine, found, drawn(found))[:, 4].max() < 0.5


def test_an_end_of_the_stack_that_resembles_nothing_is_doubted_half_as_much():
    """At the tip of a large heart muscle and fat follow on a bright cavity."""
    cine, found = beating()
    z = found.view.order[0]
    before = slice_confidence(cine, found, drawn(found))
    cine.intensity[:, z] *= -1
    after = slice_confidence(cine, found, drawn(found))
    np.testing.assert_allclose(after[:, 0], before[:, 0] / 2, rtol=0.02)


def test_a_heart_that_jumps_for_one_phase_is_doubted():
    cine, found = beating()
    found.value[2, 2] = np.roll(found.value[2, 2], (20, 24), (1, 2))
    doubt = slice_confidence(cine, found, drawn(found))
    assert doubt[2, 2] < 0.3
    doubt[2, 2] = 0.9
    assert doubt.min() > 0.6


def test_what_is_dropped_beside_the_heart_says_nothing_of_it():
    """A chest's wall taken for muscle on the slice of the tip, larger than what is there."""
    cine, found = beating()
    row, column = np.mgrid[:64, :64] - 31.5
    found.value[:, 0, 1] = 0.9 * (np.hypot(row, column) < 6)
    found.value[:, 0, 0] = 1 - found.value[:, 0, 1]
    alone = slice_confidence(cine, found, drawn(found))
    found.value[2, 0, 1, :, :6] = 0.9
    found.value[2, 0, 0] = 1 - found.value[2, 0, 1]
    np.testing.assert_allclose(slice_confidence(cine, found, drawn(found)), alone, atol=0.02)


def test_a_stomach_larger_than_any_cut_of_the_heart_is_not_taken_for_it():
    """For one phase, in the abdomen beyond the tip: the slices of the heart lose nothing by it."""
    cine, found = beating()
    found.value[:, 0, 1], found.value[:, 0, 0] = 0, 1
    alone = slice_confidence(cine, found, drawn(found))
    found.value[2, 0, 1, :, :14] = 0.9
    found.value[2, 0, 0] = 1 - found.value[2, 0, 1]
    labels = drawn(found)
    assert (labels[2, 0] > 0).sum() > (labels[2, 1:] > 0).sum(axis=(1, 2)).max()
    beside = slice_confidence(cine, found, labels)
    np.testing.assert_allclose(beside[:, 1:], alone[:, 1:], atol=0.02)


@pytest.mark.parametrize(
    ("radii", "found"),
    [
        # A paraboloid that ends a third of a slice beyond the last: cuts of 1/3, 4/3, 7/3 ...
        ((10 * np.sqrt(np.arange(8) + 1 / 3)), {"left ventricle": {7: 1}}),
        # One that ends two slices and a half beyond.
        ((8 * np.sqrt(np.arange(8) + 2.5)), {"left ventricle": {0: 1, 7: 1}}),
        # Whole: both ends within a slice.
        (np.array([8, 20, 25, 30, 30, 25, 20, 9]), {}),
        # Not in the outermost slices at all.
        (np.array([0, 25, 30, 30, 30, 30, 0, 0]), {}),
        # A speck on the outermost slice beside nothing is the tip.
        (np.array([5, 6, 30, 30, 30, 30, 0, 0]), {}),
    ],
)
def test_a_stack_that_ends_too_soon_is_known_by_its_last_cuts(radii, found):
    rows, columns = np.mgrid[-40:41, -40:41]
    disc = rows**2 + columns**2 < np.square(radii)[:, None, None]
    labels = np.where(disc, LABELS["lv_cavity"], 0).astype(np.uint8)[None]
    assert cut_off(labels) == found
    # The others are judged each for itself, and half of the phases are enough.
    both = np.concatenate([labels, np.where(disc, LABELS["aorta"], 0).astype(np.uint8)[None]])
    others = {"aorta": found["left ventricle"]} if found else {}
    assert cut_off(both) == found | others


@pytest.mark.parametrize(
    ("ends", "found"),
    [
        # Three quarters of the cut before, in a seventh and a twelfth of the largest one.
        ([(20, 15)], {7: 1}),
        ([(12, 9)], {}),
        # The neighbour's cut counts, not the one before it.
        ([(60, 45)], {7: 1}),
        # Hardly smaller in one phase of three; and no more than a tip's, but for noise.
        ([(60, 57), (60, 30), (60, 30)], {7: 1}),
        ([(60, 50), (60, 30), (60, 30)], {}),
    ],
)
def test_a_body_goes_on_by_the_share_that_its_last_cut_has_of_the_one_before(ends, found):
    """Bodies of 100 pixels a slice, but for the last two."""
    areas = np.array([[0, 100, 100, 100, 100, 100, *end] for end in ends])
    labels = np.where(np.arange(100) < areas[..., None, None], LABELS["lv_cavity"], 0)
    expected = {"left ventricle": found} if found else {}
    assert cut_off(labels.astype(np.uint8)) == expected


@pytest.mark.parametrize(("count", "step"), [(3, 2), (5, 2), (5, 3), (2, 2)])
def test_a_slice_is_compared_with_the_closer_neighbour_if_it_has_any(count, step):
    """Of three slices 5 mm apart, those 9 mm away from the middle one are not there."""
    after = np.random.default_rng(0).random((2, count - step))
    found = confidence._best_in_space(after, step)
    for phase, number in np.ndindex(2, count):
        # One after it, which is its own number in `after`, and one before it.
        both = [one for one in (number, number - step) if 0 <= one < count - step]
        assert found[phase, number] == max((after[phase, one] for one in both), default=-1)


@pytest.mark.parametrize(
    ("end_diastole", "end_systole", "refused"), [(0, 0, True), (120, 36, True), (162, 0, False)]
)
def test_muscle_without_a_cavity_in_any_phase_is_no_heart(end_diastole, end_systole, refused):
    """Thick muscle may shut its cavity at end-systole, not through the whole beat."""
    drawn = np.zeros((2, 3, 64, 64), np.uint8)
    drawn[:, :, :20, :20] = 2
    for phase, pixels in ((0, end_diastole), (1, end_systole)):
        drawn[phase].reshape(3, -1)[:, -(pixels // 3) - 1 : -1] = 1
    if not refused:
        _require_cavity(drawn)
        return
    with pytest.raises(StageError, match=r"phase 0, slices 0 to 2: no heart found: .* least 12 %"):
        _require_cavity(drawn)


@pytest.mark.parametrize(
    ("right", "atria", "refused"),
    [(0, 900, True), (60, 900, True), (400, 900, False), (0, 0, False)],
)
def test_left_ventricle_and_atria_without_a_right_ventricle_are_no_heart(right, atria, refused):
    """A stomach and a vessel beside it; a stack of the tip alone shows no atrium either."""
    drawn = np.zeros((2, 3, 64, 64), np.uint8)
    for value, pixels in ((1, 600), (2, 700), (3, right), (5, atria)):
        drawn.reshape(2, 3, -1)[:, :, 700 * value : 700 * value + pixels // 3] = value
    if not refused:
        _require_right_ventricle(drawn)
        return
    with pytest.raises(StageError, match=r"slices 0 to 2: no heart found: .* at least 10 % were"):
        _require_right_ventricle(drawn)


def test_a_heart_is_missed_between_two_and_not_above_stray_pixels():
    """Squares of 20 by 20 pixels in five slices; what the tip's slices show differs."""
    drawn = np.zeros((2, 5, 40, 40), np.uint8)
    drawn[:, :, 10:30, 10:30] = LABELS["lv_cavity"]
    assert not len(missed_hearts(drawn, 1.5))

    drawn[0, 3] = 0
    np.testing.assert_array_equal(missed_hearts(drawn, 1.5), [[0, 3]])
    # A fifth of what both show is enough.
    drawn[0, 3, 10:14, 10:30] = LABELS["lv_cavity"]
    assert not len(missed_hearts(drawn, 1.5))

    drawn[1, :2] = 0
    drawn[1, 0, 20, 18:23] = LABELS["lv_cavity"]
    assert not len(missed_hearts(drawn, 1.5))
    # Five pixels of 4.5 mm are as large as 45 of 1.5 mm.
    np.testing.assert_array_equal(missed_hearts(drawn, 4.5), [[1, 1]])

    # Muscle without a cavity, in line with the tip, is as likely fat.
    drawn[1, 0, 10:30, 10:30] = LABELS["lv_myocardium"]
    assert not len(missed_hearts(drawn, 1.5))
    drawn[1, 0, 15:25, 15:25] = LABELS["lv_cavity"]
    np.testing.assert_array_equal(missed_hearts(drawn, 1.5), [[1, 1]])


@pytest.mark.parametrize("blanked", [False, True])
@pytest.mark.parametrize(("place", "cut"), [(32, False), (9, False), (7, True), (4, True)])
def test_what_the_images_edge_cuts_off_is_told(blanked, place, cut):
    """A disc of 8 pixels, so far from the edge, in images that end there or are black beyond."""
    rng = np.random.default_rng(0)
    intensity = rng.rayleigh(50.0, (2, 3, 64, 64)).astype(np.float32)
    row, column = np.mgrid[:64, :64]
    labels = np.zeros((2, 3, 64, 64), np.uint8)
    labels[0, 1, np.hypot(row - 32, column - place) < 8] = LABELS["rv_cavity"]
    if blanked:
        labels, intensity = (np.roll(one, 20, axis=3) for one in (labels, intensity))
        intensity[..., :20] = labels[..., :20] = 0
    expected = {"right ventricle": 1} if cut else {}
    assert cut_sideways(labels, intensity) == expected
    if blanked:
        # Filled up with what is not the darkest, or by a spline that swings beside the edge.
        shifted = np.where(intensity > 0, intensity - 30, 0)
        assert cut_sideways(labels, shifted) == expected
        swings = np.zeros_like(intensity)
        swings[..., 16:20] = [0.2, -0.4, 0.8, -1.5]
        assert cut_sideways(labels, intensity + swings) == expected


def test_a_dark_lung_at_the_images_side_is_no_edge():
    """Of greys 0, 1 and 2, of 200 in blood, beside a ventricle."""
    rng = np.random.default_rng(0)
    intensity = rng.rayleigh(50.0, (8, 3, 64, 64)).astype(np.float32)
    intensity[..., :20] = rng.choice([0, 1, 2], p=[0.6, 0.3, 0.1], size=(8, 3, 64, 20))
    row, column = np.mgrid[:64, :64]
    labels = np.zeros((8, 3, 64, 64), np.uint8)
    labels[:, 1, np.hypot(row - 32, column - 28) < 8] = LABELS["rv_cavity"]
    assert cut_sideways(labels, intensity) == {}


def test_a_lung_of_noise_by_single_greys_is_no_edge():
    """Two pixels of five rest at 0; the others differ by 1 between phases, of some 150 in all."""
    rng = np.random.default_rng(0)
    intensity = rng.rayleigh(50.0, (8, 3, 64, 64)).astype(np.float32)
    for lung in (intensity[..., :20], intensity[..., 54:]):
        lung[:] = rng.random(lung.shape) < 0.1
    row, column = np.mgrid[:64, :64]
    labels = np.zeros((8, 3, 64, 64), np.uint8)
    labels[:, 1, np.hypot(row - 32, column - 28) < 8] = LABELS["rv_cavity"]
    assert cut_sideways(labels, intensity) == {}


def test_what_is_darker_than_the_fill_is_recorded():
    """Bright padding about a dark image, of what rests and has no noise."""
    rng = np.random.default_rng(0)
    intensity = np.tile(rng.uniform(0, 150, (3, 64, 64)).astype(np.float32), (4, 1, 1, 1))
    intensity[..., :20] = 200
    row, column = np.mgrid[:64, :64]
    labels = np.zeros((4, 3, 64, 64), np.uint8)
    labels[:, 1, np.hypot(row - 32, column - 31) < 8] = LABELS["rv_cavity"]
    assert cut_sideways(labels, intensity) == {}


def test_slices_far_aside_are_named_by_the_cines_own_numbers():
    """The apex is the stack's last slice; what lies along the normal is not aside."""
    shifts_mm = np.array([[0.5, -0.5, 0], [-9.0, 12.0, 0], [5, -5, 20]])
    assert _astray_mm(shifts_mm, np.array([7, 4, 2])) == {4: 15.0}


def test_a_slice_out_of_step_is_named_by_the_cines_own_number(study, understood):
    """Stored from base to tip, as the segmentation does not go through it."""
    assert understood.out_of_step == {}
    cine = study[0]
    downwards = cine.mr_from_index.copy()
    downwards[:3, 3] += (SLICES - 1) * downwards[:3, 2]
    downwards[:3, 2] *= -1
    images = cine.intensity[:, ::-1].copy()
    images[:, [4, 6]] = images[::-1, [4, 6]]
    found = segment_cine(replace(cine, intensity=images, mr_from_index=downwards), QUICK)
    assert list(found.out_of_step) == [4, 6]
    assert all(one["in_step"] < 0 for one in found.out_of_step.values())


ASIDE = (20, 24)
"""Pixels by which labels leave no pixel of the heart in its place."""


def test_a_heart_that_jumps_in_all_slices_for_a_phase_is_doubted_then_alone():
    """Labels of the phases before and after share no pixel with it; neighbouring slices agree."""
    cine, found = beating()
    found.value[2] = np.roll(found.value[2], ASIDE, (2, 3))
    doubt = slice_confidence(cine, found, drawn(found))
    np.testing.assert_array_equal(doubt[2], 0)
    assert np.delete(doubt, 2, axis=0).min() > 0.7


def test_a_heart_that_lies_aside_on_a_slice_in_all_phases_is_doubted_there_alone():
    cine, found = beating()
    found.value[:, 2] = np.roll(found.value[:, 2], ASIDE, (2, 3))
    doubt = slice_confidence(cine, found, drawn(found))
    np.testing.assert_array_equal(doubt[:, 2], 0)
    assert np.delete(doubt, 2, axis=1).min() > 0.5


def test_a_heart_that_is_missed_for_a_phase_is_doubted():
    """The network is sure that there is none; before and after it is large."""
    cine, found = beating()
    found.value[2, 2] = 0
    found.value[2, 2, 0] = 1
    doubt = slice_confidence(cine, found, drawn(found))
    assert doubt[2, 2] == 0
    assert doubt[[1, 3], 2].min() > 0.7


@pytest.mark.parametrize(("share", "doubted"), [(0.30, False), (0.40, True)])
def test_a_tip_comes_and_goes_below_35_percent_of_the_largest_cut(share, doubted):
    cine, found = beating()
    away = np.hypot(*(np.mgrid[:64, :64] - 31.5))
    body, tip = away < 15, away < 15 * share**0.5
    assert tip.sum() / body.sum() == pytest.approx(share, abs=0.03)
    found.value[:, :, 1] = 0.9 * body
    found.value[:, 0, 1] = 0.9 * tip
    found.value[2, 0, 1] = 0
    found.value[:, :, 0] = 1 - found.value[:, :, 1]
    trusted = slice_confidence(cine, found, drawn(found))
    assert (trusted[2, 0] == 0) == doubted
    assert doubted or trusted[2, 0] > 0.7


def test_what_is_added_to_a_cut_is_a_quarter_of_the_largest_as_sure_as_the_outline():
    """By hand: Dice of tip (chance c) and of what is added, a cut of known certainty."""
    cine, found = beating()
    away = np.hypot(*(np.mgrid[:64, :64] - 31.5))
    body, tip, c = away < 15, away < 6, 0.6
    found.value[:, :, 1] = 0.9 * body
    found.value[:, 0, 1] = c * tip
    found.value[:, :, 0] = 1 - found.value[:, :, 1]
    n, few = body.sum(), tip.sum()
    sure = (c * few + (n - few)) / n
    expected = (2 * c * few + n / 4 * sure) / ((1 + c) * few + n / 4)
    trusted = slice_confidence(cine, found, drawn(found))[:, 0]
    np.testing.assert_allclose(trusted, expected, rtol=1e-4)


def unlike(shape, where, cosine):
    """Unit vectors, all the same but ``where`` one has that cosine with the others."""
    images = np.zeros((*shape, 2), np.float32)
    images[..., 0] = 1
    images[where] = cosine, (1 - cosine**2) ** 0.5
    return images


@pytest.mark.parametrize(
    ("where", "cosine", "share"),
    [
        (np.s_[3], 0.15, 0.5),
        (np.s_[3], 0.31, 1.0),
        (np.s_[3], -0.1, 0.0),
        (np.s_[:, 1], 0.125, 0.5),
        (np.s_[:, 3], 0.125, 0.5),
        (np.s_[:, 2], 0.26, 1.0),
        (np.s_[:, 2], -0.1, 0.0),
        (np.s_[:, 0], 0.125, 0.75),
        (np.s_[:, 4], 0.125, 0.75),
    ],
)
def test_how_much_counts_by_the_correlation_with_the_closest_neighbour(
    monkeypatch, where, cosine, share
):
    cine, found = beating()
    shape = found.value.shape[:2]
    trusted = []
    for images in (unlike(shape, where, 1.0), unlike(shape, where, cosine)):
        monkeypatch.setattr(confidence, "_images", lambda *_, images=images: images)
        trusted.append(slice_confidence(cine, found, drawn(found)))
    np.testing.assert_allclose((trusted[1] / trusted[0])[where], share, atol=1e-5)


@pytest.mark.parametrize(("step_mm", "doubted"), [(12.0, True), (14.0, False)])
def test_slices_far_apart_need_not_look_alike(step_mm, doubted):
    cine, found = beating()
    cine = replace(cine, mr_from_index=np.diag([1.5, 1.5, step_mm, 1.0]))
    found = replace(found, view=view_of(cine))
    cine.intensity[:, found.view.order[2]] *= -1
    assert (slice_confidence(cine, found, drawn(found))[:, 2].max() < 0.1) == doubted


DISC = np.hypot(*(np.mgrid[:64, :64] - 20)) < 8
OTHER = np.hypot(*(np.mgrid[:64, :64] - 50)) < 7
NONE = np.zeros_like(DISC)


@pytest.mark.parametrize(
    ("planes", "kept"),
    [
        ("HHHHNH", "HHHHNH"),
        ("HHHHNNH", "HHHHNNN"),
        ("HNNHHHH", "NNNHHHH"),
        ("HHHHO", "HHHHN"),
        ("OHHHH", "NHHHH"),
        # Two bodies beside it, which together are larger.
        ("OOHHHNOO", "NNHHHNNN"),
    ],
)
def test_the_heart_is_the_largest_body_with_one_gap_at_most(planes, kept):
    draw = {"H": DISC, "O": OTHER, "N": NONE}
    given, expected = (np.stack([draw[one] for one in text]) for text in (planes, kept))
    np.testing.assert_array_equal(_without_strays(given), expected)
