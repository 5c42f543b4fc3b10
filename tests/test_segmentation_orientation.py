"""The heart is found and seen to lie as it does, whatever the file says of directions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mr_phantom import as_cine, dice

from data_synth.mr import MrSettings, acquire_cine
from data_synth.population import draw_heart
from pipeline.imaging import inference, orientation, view
from pipeline.imaging.cine import Cine
from pipeline.imaging.inference import TURNS_DEG, count_turns, turns_deg
from pipeline.imaging.labels import LABELS
from pipeline.imaging.locating import (
    FIELD_MM,
    FINEST_MM,
    PIXELS_ACROSS,
    SHOWN_MM,
    SURROUNDINGS_MM,
    locate_heart,
    view_around,
)
from pipeline.imaging.network import MULTIPLE, WINDOW, normalise, normalise_locally
from pipeline.imaging.orientation import RIGHT_DEG, find_orientation, lie_of
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import SegmentSettings
from pipeline.imaging.view import AS_THE_FILE_SAYS, Orientation, canonical_axes, view_of

QUICK = SegmentSettings(most_views=1)

NORMAL = np.array([-0.6, 0.5, 0.62])


def drawn_heart(axes, slices=6, side=64):
    """Labels of a tapering left ventricle with the right one on its right, seen along ``axes``.

    ``axes``: rows are the view's directions in coordinates where the heart lies canonically.
    """
    middle = (side - 1) / 2
    row, column = np.mgrid[:side, :side] - middle
    labels = np.zeros((slices, side, side), np.uint8)
    towards = np.array([np.cos(np.radians(RIGHT_DEG)), np.sin(np.radians(RIGHT_DEG))])
    for number in range(slices):
        height = (number - (slices - 1) / 2) * axes[2, 2]
        size = 9 + 1.8 * height
        x = column * axes[0, 0] + row * axes[1, 0]
        y = column * axes[0, 1] + row * axes[1, 1]
        away = np.hypot(x - 1.4 * size * towards[0], y - 1.4 * size * towards[1])
        labels[number][away < 0.9 * size] = LABELS["rv_cavity"]
        labels[number][np.hypot(x, y) < size] = LABELS["lv_myocardium"]
        labels[number][np.hypot(x, y) < 0.6 * size] = LABELS["lv_cavity"]
    return labels


def looking_at(stored):
    """A look at the drawn heart through a file that stores it as ``stored`` says, unknowingly.

    Doubt grows with how far the view is from the heart's own directions, as the network's does.
    """

    def look(tried):
        axes = tried.applied(stored.applied(np.eye(3)))
        mirrored = np.linalg.det(axes[:2, :2]) < 0
        off = 1 - (axes[0, 0] * (-1 if mirrored else 1) if not mirrored else axes[1, 1])
        return drawn_heart(axes), 1000.0 * (1 + 0.5 * off + 0.4 * mirrored)

    return look


lost = st.builds(
    Orientation,
    turn_deg=st.floats(-180, 180),
    mirrored=st.booleans(),
    upside_down=st.booleans(),
)


@given(lost)
@settings(max_examples=60, deadline=None)
def test_a_lost_orientation_is_found(stored):
    look = looking_at(stored)
    found = find_orientation(look)
    axes = found.applied(stored.applied(np.eye(3)))
    assert axes[2, 2] > 0
    lie = lie_of(look(found)[0])
    # The drawn heart's right ventricle is where the file may have it, or brought to its place.
    assert lie.off_deg <= orientation.FARTHEST_DEG + 1
    if not found.is_the_files and abs(found.turn_deg) > 0:
        assert lie.off_deg < 10


@given(st.floats(-60, 60), st.floats(0.86, 1.2))
@settings(max_examples=30, deadline=None)
def test_the_file_is_believed_while_hearts_differ_as_patients_do(turn_deg, doubt):
    """Turned by less than `FARTHEST_DEG`, and the mirrored view hardly less doubtful."""
    look = looking_at(Orientation(turn_deg))

    def doubtful(tried):
        labels, _ = look(tried)
        return labels, 1000.0 * (doubt if tried.mirrored else 1.0)

    assert find_orientation(doubtful) == AS_THE_FILE_SAYS


def test_a_mirrored_image_whose_ventricles_lie_right_is_told_by_doubt():
    labels = drawn_heart(np.eye(3))

    def look(tried):
        return labels, 600.0 if tried.mirrored else 1000.0

    # Mirroring would take the right ventricle to the other side, was it not turned as well.
    assert not find_orientation(lambda tried: (labels, 1000.0)).mirrored
    assert find_orientation(look).mirrored


def test_without_a_right_ventricle_only_the_order_of_slices_can_be_told():
    labels = drawn_heart(np.diag([1.0, 1.0, -1.0]))
    labels[labels == LABELS["rv_cavity"]] = 0

    def look(tried):
        return labels[::-1] if tried.upside_down else labels, 1000.0

    found = find_orientation(look)
    assert found.upside_down
    assert found.turn_deg == 0


@given(
    first=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    size=st.tuples(st.integers(4, 160), st.integers(4, 160)),
    turn_deg=st.floats(-180, 180),
)
@settings(max_examples=60)
def test_a_heart_is_labelled_with_its_surroundings_in_finer_pixels_the_smaller_it_is(
    first, size, turn_deg
):
    stack = np.zeros((2, 3, 64, 64), np.float32)
    cine = Cine(stack, np.diag([2.0, 2, 8, 1]), np.array([0, 0.4]), 0.8)
    whole = view_of(cine, Orientation(turn_deg))
    box = [slice(start, start + side) for start, side in zip(first, size, strict=True)]
    shown = view_around(whole, *box)
    across_mm = whole.pixel_mm * max(size)
    assert FINEST_MM <= shown.pixel_mm <= SHOWN_MM
    if FINEST_MM < shown.pixel_mm < SHOWN_MM:
        assert across_mm / shown.pixel_mm == pytest.approx(PIXELS_ACROSS)
    assert min(shown.shape) >= max(WINDOW, FIELD_MM / shown.pixel_mm)
    assert np.remainder(shown.shape, MULTIPLE).tolist() == [0, 0]
    # The box's outer corners, half a pixel beyond its pixels' middles, in the new view's pixels.
    low, high = [side.start - 0.5 for side in box], [side.stop - 0.5 for side in box]
    to_shown = whole.pixels_of(shown)
    corners = [to_shown @ [corner[1], corner[0], 1] for corner in (low, high)]
    room = SURROUNDINGS_MM / shown.pixel_mm
    for corner, other, side in zip(*corners, shown.shape[::-1], strict=True):
        assert corner - room >= -0.5 - 1e-6
        assert other + room <= side - 0.5 + 1e-6
        # It lies in the middle.
        assert corner + other == pytest.approx(side - 1, abs=1e-6)


@given(lost)
@settings(max_examples=40)
def test_an_orientation_keeps_axes_a_frame_and_mirrors_as_it_says(given_orientation):
    axes = given_orientation.applied(canonical_axes(NORMAL))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    mirrored = given_orientation.mirrored != given_orientation.upside_down
    assert np.linalg.det(axes) == pytest.approx(-1 if mirrored else 1)


def test_an_orientation_is_told_in_words():
    assert str(AS_THE_FILE_SAYS) == "as the file says"
    said = str(Orientation(90, True, True))
    assert "90 degrees" in said
    assert "mirrored" in said
    assert "base and apex" in said
    assert "mirror image" not in said
    # Of an odd number of mirrorings no turn and shift is the same.
    assert "a mirror image" in str(Orientation(90, True, False))
    assert "a mirror image" in str(Orientation(0, False, True))


def smooth_cine():
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = canonical_axes(NORMAL).T * [1.2, 1.4, 9.0]
    return Cine(np.zeros((2, 3, 60, 70), np.float32), mr_from_index, np.array([0, 0.5]), 1.0)


@pytest.mark.parametrize("varied", [(12.0, 1.0), (-7.0, 1.1)])
def test_pixels_of_another_view_are_the_same_points_of_the_patient(varied):
    here = view_of(smooth_cine()).cropped((3, 5), (32, 48))
    there = here.varied(*varied)
    for column, row in [(0, 0), (10, 20), (47, 31)]:
        point_mm = here.corner_mm + here.pixel_mm * np.array([column, row]) @ here.axes[:2]
        x, y = here.pixels_of(there) @ (column, row, 1.0)
        again_mm = there.corner_mm + there.pixel_mm * np.array([x, y]) @ there.axes[:2]
        np.testing.assert_allclose(again_mm, point_mm, atol=1e-9)


def test_a_varied_view_keeps_its_middle():
    here = view_of(smooth_cine())
    middle = (np.array(here.shape[::-1]) - 1) / 2
    there = here.varied(30.0, 1.2)
    np.testing.assert_allclose(there.pixels_of(here) @ (*middle, 1.0), middle, atol=1e-9)


def test_grey_values_of_the_heart_do_not_depend_on_fat_far_away():
    """In a wide field, the heart's window is normalised as if it was all there is."""
    rng = np.random.default_rng(0)
    wide = rng.uniform(0.2, 1.0, (384, 384)).astype(np.float32)
    known = np.ones(wide.shape, bool)
    bright = wide.copy()
    bright[:60, :] *= 9
    middle = slice(160, 224), slice(160, 224)
    alone = normalise(wide[128:256, 128:256])[32:96, 32:96]
    np.testing.assert_allclose(normalise_locally(bright, known)[middle], alone, atol=0.05)
    assert np.abs(normalise(bright[40:344, 40:344])[120:184, 120:184] - alone).max() < 0.05
    small = normalise_locally(wide[:100, :90], known[:100, :90])
    np.testing.assert_allclose(small, normalise(wide[:100, :90]), atol=1e-6)


def test_what_lies_outside_the_image_does_not_change_its_grey_values():
    image = np.random.default_rng(1).uniform(50, 60, (128, 128)).astype(np.float32)
    known = np.zeros(image.shape, bool)
    known[:, :64] = True
    padded = np.where(known, image, 0)
    np.testing.assert_allclose(
        normalise(padded, known)[:, :64], normalise(image[:, :64]), atol=0.05
    )


@pytest.mark.parametrize(("images", "ways"), [(24, 5), (250, 3), (300, 2), (400, 2), (5000, 1)])
def test_the_fewer_images_the_more_ways_they_are_shown(images, ways):
    assert count_turns(images, 5) == ways
    assert count_turns(images, 1) == 1
    assert len(TURNS_DEG) == len(set(TURNS_DEG)) == 5


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_neighbours_in_time_are_seen_turned_the_other_way(count):
    first, second, third = (turns_deg(phase, count) for phase in range(3))
    assert len(set(first)) == count
    assert first == third
    assert sum(first) == -sum(second)
    others = {10.0, -10.0, 20.0, -20.0}
    assert set(first) | set(second) == (others if count == 2 else {0.0, *others})


@pytest.fixture(scope="module")
def study():
    """A short stack through the ventricles, well off the middle of a wide field."""
    rng = np.random.default_rng(77)
    heart = draw_heart(rng)
    mr = MrSettings(
        phases=3, matrix=150, pixel_mm=2.0, through_plane_samples=2, window_samples=1, slices=9
    )
    cine = acquire_cine(rng, heart, [800.0] * 9, mr)
    return as_cine(cine, 2), cine.labels[:2]


def stored_otherwise(array):
    """Base first, turned, mirrored: ``(phase, z, y, x)`` with the header left as it was."""
    return np.ascontiguousarray(array[:, ::-1, :, ::-1].transpose(0, 1, 3, 2))


@pytest.mark.slow
def test_a_lost_header_costs_next_to_nothing(study):
    """Identity matrix, base first, mirrored: labels lie on the images as with a right header."""
    images, truth = study
    right = segment_cine(images, QUICK)
    spacing = np.linalg.norm(images.mr_from_index[:3, :3], axis=0)
    identity = np.diag([*spacing[[1, 0, 2]], 1.0])
    stored = replace(images, intensity=stored_otherwise(images.intensity), mr_from_index=identity)
    found = segment_cine(stored, QUICK)
    assert right.orientation == AS_THE_FILE_SAYS
    assert found.orientation.upside_down
    for name in ("lv_cavity", "lv_myocardium", "rv_cavity"):
        value = LABELS[name]
        best = dice(right.labels == value, truth == value)
        # A tenth of a pixel along the outlines of these bodies, some 25 pixels wide, is 0.01.
        assert dice(found.labels == value, stored_otherwise(truth) == value) > best - 0.03
    # The grid of the heart lies in the file's frame, right-handed, on the labels.
    steps = found.heart_mr_from_index[:3, :3]
    assert np.linalg.det(steps) > 0
    inside = np.argwhere(found.labels[0] == LABELS["lv_cavity"])[:, ::-1].mean(axis=0)
    on_grid = np.argwhere(found.heart[0] == LABELS["lv_cavity"])[:, ::-1].mean(axis=0)
    here_mm = identity[:3, :3] @ inside
    there_mm = steps @ on_grid + found.heart_mr_from_index[:3, 3]
    # Slices are 10 mm apart and their ends rounded differently; in the plane nothing may shift.
    assert np.abs(here_mm - there_mm)[:2].max() < 2
    assert abs(here_mm - there_mm)[2] < 5


def test_a_part_of_the_heart_in_a_corner_is_found(study):
    """The field ends through the heart: what is in it is labelled."""
    images, truth = study
    columns = np.flatnonzero((truth == LABELS["lv_cavity"]).any(axis=(0, 1, 2)))
    cut = int(columns.mean())
    part = replace(images, intensity=np.ascontiguousarray(images.intensity[..., :cut]))
    place = locate_heart(part)
    seen = place.view
    inside = [
        seen.image_from_view(4) @ (column, row, 1.0)
        for column in (0, seen.shape[1] - 1)
        for row in (0, seen.shape[0] - 1)
    ]
    low, high = np.min(inside, axis=0), np.max(inside, axis=0)
    z = seen.order[4]
    rows, cols = np.nonzero(truth[0, z, :, :cut])
    assert low[0] < cols.min()
    assert cols.max() < high[0]
    assert low[1] < rows.min()
    assert rows.max() < high[1]


def test_view_can_be_asked_for_in_another_orientation():
    cine = smooth_cine()
    turned = view.view_of(cine, Orientation(90, False, True))
    plain = view.view_of(cine)
    np.testing.assert_allclose(turned.axes[0], plain.axes[1], atol=1e-12)
    assert turned.order == plain.order[::-1]


@pytest.mark.parametrize(("ways", "alone"), [(1, 0), (2, 0), (5, 1)])
def test_one_look_of_several_goes_without_the_slice_towards_the_apex(
    study, monkeypatch, ways, alone
):
    cine = study[0]
    shown = []

    def predict(images):
        shown.append(images)
        return np.full((len(images), 3, 7, *images.shape[2:]), 1 / 7, np.float32)

    monkeypatch.setattr(inference, "predict", predict)
    # As wide as the field, at 4 mm a pixel: what is in the images does not matter here.
    inference.label_probability(cine, view_of(cine).varied(scale=2.0), ways)

    # Nine slices are shown in two parts.
    lower, upper = ([look for look in shown if len(look) == count] for count in (5, 4))
    assert len(lower) == len(upper) == 2 * ways == len(shown) / 2
    # Of nine the four nearest the apex; the first has no neighbour there anyway.
    without = [bool((look[:4, 0] == look[:4, 1]).all()) for look in lower]
    assert sum(without) == 2 * alone
    for look, own in zip(lower + upper, without + len(upper) * [False], strict=True):
        np.testing.assert_array_equal(look[:-1, 2], look[1:, 1])
        first = 4 if own else 1
        np.testing.assert_array_equal(look[first:, 0], look[first - 1 : -1, 1])


def test_a_cropped_view_shows_that_part_of_the_whole():
    cine = smooth_cine()
    whole = view_of(cine)
    image = np.random.default_rng(2).normal(size=cine.intensity.shape[2:]).astype(np.float32)
    part = whole.cropped((3, 11), (20, 30)).sample(image, 1)
    np.testing.assert_allclose(part, whole.sample(image, 1)[3:23, 11:41], atol=1e-3)


@pytest.mark.parametrize(("turn_deg", "believed"), [(66, True), (76, False)])
def test_a_right_ventricle_seventy_degrees_off_speaks_against_the_file(turn_deg, believed):
    look = looking_at(Orientation(turn_deg))
    assert find_orientation(look).is_the_files == believed


@pytest.mark.parametrize(("share", "mirrored"), [(0.83, True), (0.87, False)])
def test_a_file_is_mirrored_by_a_seventh_less_doubt(share, mirrored):
    labels = drawn_heart(np.eye(3))
    found = find_orientation(lambda tried: (labels, 1000.0 * (share if tried.mirrored else 1)))
    assert found.mirrored == mirrored


@pytest.mark.parametrize("turn_deg", [0, 90])
@pytest.mark.parametrize(
    ("small_end", "share", "exchanged"), [(-1, 0.83, True), (-1, 0.87, False), (0, 0.5, False)]
)
def test_base_and_apex_of_a_short_stack_are_told_by_doubt(small_end, share, exchanged, turn_deg):
    """Cuts of one size but for the file's last slice, or its first one, which is half of it."""

    def look(tried):
        axes = tried.applied(Orientation(turn_deg).applied(np.eye(3)))
        axes[2, 2] = 0.0
        labels = drawn_heart(axes)
        labels[-1 if (small_end == -1) != tried.upside_down else 0, :32] = 0
        return labels, 1000.0 * (share if tried.upside_down else 1.0) * (1 + tried.mirrored)

    assert find_orientation(look).upside_down == exchanged


@pytest.mark.parametrize(("share", "believed"), [(1.08, False), (1.13, True)])
def test_a_file_is_believed_where_any_other_way_is_more_doubtful(share, believed):
    look = looking_at(Orientation(180))

    def doubtful(tried):
        return look(tried)[0], 1000.0 * (1 if tried.is_the_files else share)

    assert find_orientation(doubtful).is_the_files == believed


def test_atria_lie_at_the_base_whatever_the_ventricles_taper():
    labels = np.zeros((8, 40, 40), np.uint8)
    labels[:6, 10:30, 10:20] = LABELS["lv_cavity"]
    labels[5:, 5:35, 10:30] = LABELS["left_atrium"]
    assert lie_of(labels).rise > 0.25
    assert lie_of(labels[::-1]).rise < -0.25
