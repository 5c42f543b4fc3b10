"""Cines that do not lie across the left ventricle, seen in slices that do."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mr_phantom import as_cine, dice
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from data_synth.mr import MrSettings, acquire_cine, acquire_volume, count_slices
from data_synth.population import draw_heart
from pipeline.errors import StageError
from pipeline.geometry import transform_points
from pipeline.imaging import reformat, segmentation
from pipeline.imaging.cine import Cine
from pipeline.imaging.inference import PlaneProbability
from pipeline.imaging.labels import LABELS
from pipeline.imaging.network import CLASSES
from pipeline.imaging.reformat import (
    THIN_STEP_MM,
    clear_beyond,
    confidence_on_acquired,
    labels_on_acquired,
    reformat_to_short_axis,
)
from pipeline.imaging.segmentation import segment_cine
from pipeline.imaging.settings import THIN_MM, SegmentSettings
from pipeline.imaging.view import AS_THE_FILE_SAYS, Orientation, View, canonical_axes
from tests.outside_heart import Scan, render

QUICK = SegmentSettings(most_views=1)

VOXEL_MM = 3.0

LEAN_DEG = 25.0
"""The heart's axis off where it was drawn, towards the level: so it lies in the stout."""


def leaning_heart(seed):
    heart = draw_heart(np.random.default_rng(seed))
    across = np.cross(heart.long_axis, [0.0, 0.0, 1.0])
    turn = Rotation.from_rotvec(-np.deg2rad(LEAN_DEG) * across / np.linalg.norm(across))
    frame = np.array(heart.mr_from_heart)
    frame[:3, :3] = turn.as_matrix() @ frame[:3, :3]
    return replace(heart, mr_from_heart=tuple(map(tuple, frame)))


def volume_of(heart, axes, phases=2):
    settings = MrSettings(
        phases=phases, volume_axes=axes, volume_voxel_mm=VOXEL_MM, through_plane_samples=4
    )
    return acquire_volume(np.random.default_rng(3), heart, [800.0], settings)


def angle_deg(one, other):
    return np.degrees(np.arccos(np.clip(one @ other, -1, 1)))


def normal(cine):
    return canonical_axes(np.cross(cine.mr_from_index[:3, 0], cine.mr_from_index[:3, 1]))[2]


@pytest.fixture(scope="module")
def heart():
    return leaning_heart(906_001)


@pytest.fixture(scope="module")
def transverse(heart):
    made = volume_of(heart, "transverse")
    return as_cine(made), made.labels


@pytest.fixture(scope="module")
def drawn(transverse):
    return reformat_to_short_axis(transverse[0])


@pytest.fixture
def already_drawn(drawn, monkeypatch):
    """Looking for the axis takes longer than all else."""
    monkeypatch.setattr(segmentation, "reformat_to_short_axis", lambda cine: drawn)


def test_slices_are_drawn_across_the_left_ventricle_wherever_it_points(heart, transverse, drawn):
    cine, _ = transverse
    assert angle_deg(normal(cine), heart.long_axis) > 40
    # A look that would change the axis by less than this ends the search.
    assert angle_deg(normal(drawn.cine), heart.long_axis) < reformat.SETTLED_DEG
    assert drawn.tilt_deg == pytest.approx(angle_deg(normal(cine), heart.long_axis), abs=3)
    np.testing.assert_allclose(drawn.cine.spacing_mm, (VOXEL_MM, VOXEL_MM, THIN_STEP_MM))
    np.testing.assert_array_equal(drawn.cine.phases, cine.phases)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["sagittal", "coronal"])
@pytest.mark.parametrize("thick", [1, 3])
def test_so_they_are_through_other_planes_and_thick_slices(axes, thick):
    heart = draw_heart(np.random.default_rng(906_002))
    cine = as_cine(volume_of(heart, axes))
    frame = cine.mr_from_index.copy()
    frame[:3, 2] *= thick
    count = cine.intensity.shape[1] // thick * thick
    parts = cine.intensity[:, :count].reshape(2, -1, thick, *cine.intensity.shape[2:])
    found = reformat_to_short_axis(replace(cine, intensity=parts.mean(2), mr_from_index=frame))
    assert angle_deg(normal(found.cine), heart.long_axis) < reformat.SETTLED_DEG
    assert found.cine.spacing_mm[2] == pytest.approx(3 if thick > 1 else THIN_STEP_MM)


@pytest.mark.slow
@pytest.mark.parametrize("step_mm", [3.0, 8.0])
@pytest.mark.parametrize("seed", [31, 32])
def test_people_of_another_renderer_are_labelled_in_slices_across_the_body(seed, step_mm):
    scan = Scan(step_mm=step_mm, thickness_mm=step_mm, pixel_mm=2.0, depths=2, transverse=True)
    study = render(seed, scan)
    found = segment_cine(study.cine, QUICK)
    assert step_mm > THIN_MM or found.reformatted_deg is not None
    # Of those in short axis Dice is up to 0.08 better; muscle is as thick as the slices are far.
    for name, least in {"lv_cavity": 0.92, "lv_myocardium": 0.8, "rv_cavity": 0.86}.items():
        value = LABELS[name]
        assert dice(found.labels == value, study.labels == value) >= least, name


def test_drawn_slices_show_what_was_acquired(transverse, drawn):
    cine, _ = transverse
    rng = np.random.default_rng(0)
    index = np.column_stack([rng.integers(5, n - 5, 2000) for n in cine.intensity.shape[:0:-1]])
    there = transform_points(
        np.linalg.inv(drawn.cine.mr_from_index) @ cine.mr_from_index, index.astype(float)
    )
    last = np.array(drawn.cine.intensity.shape[:0:-1]) - 1
    inside = ((there > 1) & (there < last - 1)).all(axis=1)
    assert inside.sum() > 300
    nearest = np.rint(there[inside]).astype(int)
    near = np.abs(nearest - there[inside]).max(axis=1) < 0.25
    x, y, z = index[inside][near].T
    u, v, w = nearest[near].T
    for k in range(2):
        smooth, seen = (
            gaussian_filter(one[k], 1.0) for one in (cine.intensity, drawn.cine.intensity)
        )
        assert np.corrcoef(smooth[z, y, x], seen[w, v, u])[0, 1] > 0.97


def test_labels_come_back_on_the_pixels_that_were_acquired(transverse, already_drawn):
    cine, truth = transverse
    found = segment_cine(cine, QUICK)
    assert found.labels.shape == cine.intensity.shape
    assert found.confidence.shape == cine.intensity.shape[:2]
    assert found.reformatted_deg > 40
    assert (found.confidence > QUICK.min_confidence).all()
    # Of cavities what is asked of stacks in short axis; the muscle is three of these voxels thick.
    for name, least in {"lv_cavity": 0.95, "rv_cavity": 0.93, "lv_myocardium": 0.86}.items():
        value = LABELS[name]
        for phase in range(2):
            assert dice(found.labels[phase] == value, truth[phase] == value) >= least, name


def test_what_is_wrong_is_told_of_drawn_slices(transverse, already_drawn, monkeypatch):
    def refused(cine, through, *_):
        assert cine is through.cine
        raise StageError("slice 4 is not understood")

    monkeypatch.setattr(segmentation, "_segment", refused)
    with pytest.raises(StageError, match=r"slice 4 .* drawn across it through them, 2 mm apart"):
        segment_cine(transverse[0], QUICK)


@pytest.mark.parametrize("thick", [1, 2])
def test_thin_slices_are_looked_at_beside_those_drawn_through_them(
    transverse, drawn, monkeypatch, thick
):
    """And where nothing was acquired nothing is labelled, whatever they show."""
    frame = transverse[0].mr_from_index.copy()
    frame[:3, 2] *= thick
    through = replace(drawn, acquired=replace(transverse[0], mr_from_index=frame))
    monkeypatch.setattr(segmentation, "reformat_to_short_axis", lambda cine: through)
    calls, told = [], []

    def labelled(cine, view, most_views, progress):
        calls.append("drawn")
        progress(2, 2)
        return "found"

    def mixed(found, acquired, orientation, progress):
        calls.append("own")
        progress(1, 2)

    def cleared(found, acquired):
        calls.append("cleared")
        raise StageError("enough is seen")

    monkeypatch.setattr(segmentation, "label_probability", labelled)
    monkeypatch.setattr(segmentation, "mix_in_own", mixed)
    monkeypatch.setattr(segmentation, "clear_beyond", cleared)
    with pytest.raises(StageError, match="enough is seen"):
        segment_cine(transverse[0], QUICK, lambda *done: told.append(done))
    assert calls == (["drawn", "own", "cleared"] if thick == 1 else ["drawn", "cleared"])
    assert told == ([(2, 4), (3, 4)] if thick == 1 else [(2, 2)])


@pytest.mark.parametrize(
    ("step_mm", "understood", "tried"),
    [
        (3.0, {"own", "drawn"}, ["drawn"]),
        (8.0, {"own", "drawn"}, ["own"]),
        (8.0, {"drawn"}, ["own", "drawn"]),
        (8.0, set(), ["own", "drawn"]),
    ],
)
def test_thick_slices_are_seen_as_they_are_where_they_are_understood(
    transverse, already_drawn, monkeypatch, step_mm, understood, tried
):
    """And those drawn through them where they are not; if neither are, their own are named."""
    seen = []

    def segmented(cine, through, *_):
        seen.append("own" if through is None else "drawn")
        if seen[-1] not in understood:
            raise StageError(f"{seen[-1]} slices are not understood")
        return seen[-1]

    monkeypatch.setattr(segmentation, "_segment", segmented)
    frame = transverse[0].mr_from_index.copy()
    frame[:3, 2] *= step_mm / VOXEL_MM
    cine = replace(transverse[0], mr_from_index=frame)
    if understood:
        assert segment_cine(cine, QUICK) == tried[-1]
    else:
        with pytest.raises(StageError, match=r"^own slices are not understood$"):
            segment_cine(cine, QUICK)
    assert seen == tried


@pytest.fixture(scope="module")
def in_short_axis(heart):
    settings = MrSettings(phases=2, matrix=128, pixel_mm=2.0, through_plane_samples=4)
    slices = count_slices(heart, settings)
    return as_cine(acquire_cine(np.random.default_rng(4), heart, [800.0] * slices, settings))


def test_slices_across_the_left_ventricle_stay_though_the_file_tells_no_directions(in_short_axis):
    assert reformat_to_short_axis(in_short_axis) is None
    lost = np.diag([*in_short_axis.spacing_mm, 1.0])
    placed_nowhere = replace(in_short_axis, mr_from_index=lost)
    assert angle_deg(normal(placed_nowhere), reformat.USUAL_AXIS) > reformat.FARTHEST_DEG
    assert reformat_to_short_axis(placed_nowhere) is None
    # A part of a stack shows a left ventricle that is wider than long.
    middle = replace(in_short_axis, intensity=in_short_axis.intensity[:, 2:9], mr_from_index=lost)
    assert reformat_to_short_axis(middle) is None


def test_few_slices_and_far_ones_are_not_looked_at(transverse, monkeypatch):
    monkeypatch.setattr(reformat, "locate_heart", lambda cine: pytest.fail("looked at"))
    cine, _ = transverse
    few = cine.intensity[:, : int(reformat.LEAST_VIEW_MM / VOXEL_MM) - 1]
    assert reformat_to_short_axis(replace(cine, intensity=few)) is None
    far = cine.mr_from_index.copy()
    far[:3, 2] *= 1.01 * reformat.WIDEST_MM / VOXEL_MM
    assert reformat_to_short_axis(replace(cine, mr_from_index=far)) is None


def test_slices_of_beats_of_other_lengths_are_brought_to_one_moment(transverse):
    """Images that rise with the moment at which they show the heart are alike after it."""
    cine, _ = transverse
    phases = np.arange(20) / 20
    # Systole of a longer beat is a smaller share of it.
    seen = np.stack([phases**power for power in (1.0, 1.2, 0.8)])
    wave = np.cos(2 * np.pi * seen)
    intensity = np.broadcast_to(wave.T[..., None, None], (20, 3, 4, 4)).astype(np.float32)
    stack = replace(cine, intensity=intensity, phases=phases, moments=seen)
    brought = reformat._of_one_beat(stack)
    assert brought.moments is None
    # Between two phases a line is drawn: off by the second derivative times step squared by 8.
    widest = np.diff(seen, append=1 + seen[:, :1]).max()
    off = np.abs(brought.intensity - np.cos(2 * np.pi * phases)[:, None, None, None]).max()
    assert off <= (2 * np.pi * widest) ** 2 / 8 + 1e-6
    assert np.abs(wave - wave[0]).max() > 4 * off


TRUE_AXIS = Rotation.from_euler("zx", [10, 12], degrees=True).apply(reformat.USUAL_AXIS)


def off_by(degrees, about=(0.0, 0.0, 1.0)):
    across = np.cross(TRUE_AXIS, about)
    across /= np.linalg.norm(across)
    return Rotation.from_rotvec(np.deg2rad(degrees) * across).apply(TRUE_AXIS)


def look_of(along, axis, ringed, cavity=100.0):
    return reformat._Look(along, axis, cavity, ringed, np.zeros((1, 3)))


@pytest.fixture
def looks(monkeypatch):
    """Looks at a ventricle whose axis shows a third as far off as slices are tilted, and which is
    ringed the less the more they are; some may be blind, and one led astray."""
    seen = []
    astray = {}

    def look(few, axis, own):
        seen.append(axis)
        tilt_deg = angle_deg(axis, TRUE_AXIS)
        if len(seen) in astray:
            return astray[len(seen)]
        pole = np.cross(axis, TRUE_AXIS)
        turn = np.deg2rad(2 / 3 * tilt_deg) * pole / max(np.linalg.norm(pole), 1e-12)
        return look_of(axis, Rotation.from_rotvec(turn).apply(axis), 100 - tilt_deg)

    monkeypatch.setattr(reformat, "_look_along", look)
    return seen, astray


def test_looks_end_where_the_next_would_change_nothing(looks):
    seen, _ = looks
    best = reformat._best_look(None, look_of(off_by(70), off_by(28), 40.0))
    assert angle_deg(best.along, TRUE_AXIS) < reformat.SETTLED_DEG * 1.5
    assert best.tilt_deg < reformat.SETTLED_DEG
    assert len(seen) <= 2 + reformat.MOST_LOOKS


def test_a_usual_heart_is_looked_for_where_the_slices_own_mislead(looks):
    best = reformat._best_look(None, look_of(off_by(70), off_by(-60), 40.0))
    assert angle_deg(best.along, TRUE_AXIS) < reformat.SETTLED_DEG * 1.5


def test_a_look_that_is_led_astray_is_not_followed(looks):
    _, astray = looks
    astray[3] = look_of(off_by(40), off_by(80), 30.0)
    best = reformat._best_look(None, look_of(off_by(70), off_by(15), 40.0))
    # The better of the first two looks: along the slices' own, or a usual heart's axis.
    assert angle_deg(best.along, TRUE_AXIS) == pytest.approx(
        min(15.0, angle_deg(reformat.USUAL_AXIS, TRUE_AXIS)), abs=1e-6
    )


def test_none_is_best_where_all_are_blind(looks):
    _, astray = looks
    astray |= {1: None, 2: None}
    assert reformat._best_look(None, look_of(off_by(70), off_by(28), 40.0)) is None


@pytest.mark.parametrize(
    ("tilt_deg", "ringed", "best", "drawn"),
    [
        (60, 50.0, 60.0, True),
        (60, 50.0, 46.0, True),
        (60, 50.0, 44.0, False),
        (60, 82.0, 100.0, False),
        (33, 50.0, 60.0, False),
    ],
)
def test_slices_are_drawn_only_where_they_show_more(
    transverse, monkeypatch, tilt_deg, ringed, best, drawn
):
    cine, _ = transverse
    moved = []
    along = normal(cine)
    axis = Rotation.from_rotvec(np.deg2rad(tilt_deg) * np.array([-1.0, 0, 0])).apply(along)
    middle_mm = transform_points(cine.mr_from_index, np.array([30.0, 30.0, 25.0]))[None]
    found = replace(look_of(axis, axis, best), heart_mm=middle_mm)
    monkeypatch.setattr(reformat, "_look", lambda few, along: look_of(along, axis, ringed))
    monkeypatch.setattr(reformat, "_best_look", lambda few, own: found)
    monkeypatch.setattr(reformat, "_of_one_beat", lambda one: moved.append(one) or one)
    result = reformat_to_short_axis(cine)
    assert (result is not None) == drawn
    if drawn:
        assert result.tilt_deg == pytest.approx(angle_deg(normal(result.cine), along))
        assert angle_deg(normal(result.cine), axis) < 1e-6
        assert moved[0] is cine


def test_few_slices_of_a_volume_keep_their_places(transverse):
    cine, _ = transverse
    few = reformat._of_few_slices(cine)
    assert few.spacing_mm[2] == pytest.approx(9.0)
    own, first = (
        transform_points(one.mr_from_index, np.array([3.0, 4.0, k]))
        for one, k in ((few, 2.0), (cine, 6.0))
    )
    np.testing.assert_allclose(own, first)
    np.testing.assert_array_equal(few.intensity[:, 2], cine.intensity[:, 6])


def test_beyond_what_was_acquired_goes_on_what_is_seen_at_its_side():
    """A ramp along z is a ramp, and level beyond its ends."""
    cine = acquired_about(np.zeros(3))
    ramp = np.arange(30.0, dtype=np.float32)[None, :, None, None]
    cine = replace(cine, intensity=ramp + np.zeros_like(cine.intensity))
    axis = np.array([0.0, 0.0, 1.0])
    drawn = reformat._drawn_along(
        cine, axis, np.array([-60.0, -60, -60]), np.array([60.0, 60, 60]), (3.0, 3.0, 3.0)
    )
    height_mm = drawn.mr_from_index[2, 3] + 3.0 * np.arange(drawn.intensity.shape[1])
    expected = np.clip((height_mm - cine.mr_from_index[2, 3]) / 2.5, 0, 29)
    inner = np.abs(expected - 14.5) < 10
    for column in (0, 20):
        seen = drawn.intensity[0, :, 20, column]
        np.testing.assert_allclose(seen[inner], expected[inner], atol=1e-3)
        np.testing.assert_allclose(seen[height_mm > 40], 29, atol=1e-3)


def planes(axes, corner_mm, shape, count, pixel_mm=2.0, step_mm=3.0):
    """Planes as the network labels them, all background, and where their pixels are."""
    frame = np.eye(4)
    frame[:3, :3] = axes.T * (pixel_mm, pixel_mm, step_mm)
    frame[:3, 3] = corner_mm
    view = View(frame, axes, corner_mm, shape, tuple(range(count)), pixel_mm)
    value = np.zeros((1, count, CLASSES, *shape), np.float32)
    value[:, :, 0] = 1
    z, y, x = np.indices((count, *shape), float)
    return PlaneProbability(value, view, 1), transform_points(frame, np.stack([x, y, z], -1))


def acquired_about(middle_mm, shape=(30, 32, 34), spacing_mm=2.5):
    frame = np.diag([spacing_mm] * 3 + [1.0])
    frame[:3, 3] = middle_mm - spacing_mm * (np.array(shape[::-1]) - 1) / 2
    return Cine(np.zeros((1, *shape), np.float32), frame, np.zeros(1), 0.8)


AXES = Rotation.from_euler("xyz", [50, -20, 35], degrees=True).as_matrix()


def test_nothing_is_labelled_where_nothing_was_acquired():
    middle_mm = np.array([20.0, -10.0, 5.0])
    found, points_mm = planes(AXES, middle_mm - AXES.T @ (60, 60, 60), (60, 60), 40)
    found.value[:, :, 0], found.value[:, :, 1] = 0.1, 0.9
    cine = acquired_about(middle_mm)
    clear_beyond(found, cine)
    half_mm = 2.5 * np.array(cine.intensity.shape[:0:-1]) / 2
    within = (np.abs(points_mm - middle_mm) <= half_mm).all(axis=-1)
    assert 0.1 < within.mean() < 0.9
    np.testing.assert_array_equal(found.value[0, :, 1] > 0.5, within)
    np.testing.assert_allclose(found.value.sum(axis=2), 1)


def test_labels_keep_their_place_between_frames():
    """A ball labelled in slanted planes is the same ball on the acquired grid."""
    middle_mm, radius_mm = np.array([20.0, -10.0, 5.0]), 22.0
    found, points_mm = planes(AXES, middle_mm - AXES.T @ (50, 50, 45), (50, 50), 31)
    depth_mm = radius_mm - np.linalg.norm(points_mm - middle_mm, axis=-1)
    found.value[0, :, 3] = np.clip(0.5 + depth_mm / 20, 0, 1)
    found.value[0, :, 0] = 1 - found.value[0, :, 3]
    cine = acquired_about(middle_mm + 3)
    labels = labels_on_acquired(found, cine)
    z, y, x = np.indices(cine.intensity.shape[1:], float)
    at_mm = transform_points(cine.mr_from_index, np.stack([x, y, z], -1))
    off_mm = np.linalg.norm(at_mm - middle_mm, axis=-1) - radius_mm
    # Chords of 2, 2 and 3 mm leave the ball by their squares over 8 r, which add up.
    chord_mm = (2**2 + 2**2 + 3**2) / (8 * (radius_mm - 3))
    np.testing.assert_array_equal(labels[0][off_mm < -chord_mm], 3)
    np.testing.assert_array_equal(labels[0][off_mm > chord_mm], 0)


def test_what_the_slices_show_themselves_is_mixed_in_where_they_reach(monkeypatch):
    """Probabilities that are straight in space are so wherever they are asked for. Slices whose
    beats were longer are brought to one moment before."""
    middle_mm = np.array([20.0, -10.0, 5.0])
    slope = np.array([0.004, -0.003, 0.002])

    def straight(points_mm):
        return 0.4 + (points_mm - middle_mm) @ slope

    found, points_mm = planes(AXES, middle_mm - AXES.T @ (60, 60, 60), (60, 60), 40)
    cine = acquired_about(middle_mm)
    ramp = np.arange(2, dtype=np.float32)[:, None, None, None] + np.zeros_like(cine.intensity)
    cine = replace(cine, intensity=ramp, phases=np.array([0, 0.5]), moments=np.zeros((30, 2)))
    found = replace(found, value=np.repeat(found.value, 2, axis=0))
    axes = Rotation.from_euler("xyz", [20, 70, -15], degrees=True).as_matrix()
    half_mm = np.array([50.0, 40, 52.5])
    own, at_mm = planes(axes, middle_mm - half_mm @ axes, (41, 51), 36)
    seen = []

    def looked(one, view, most_views):
        assert view is own.view
        assert most_views == 1
        assert one.moments is None
        assert (one.intensity == 10 + 2 * one.phases[0]).all()
        seen.extend(one.phases.tolist())
        own.value[0, :, 2] = straight(at_mm) * (1 + one.phases[0])
        own.value[0, :, 0] = 1 - own.value[0, :, 2]
        return own

    monkeypatch.setattr(reformat, "label_probability", looked)

    def brought(cine):
        return replace(cine, intensity=cine.intensity + 10, moments=None)

    monkeypatch.setattr(reformat, "_of_one_beat", brought)
    place = SimpleNamespace(view=own.view, orientation=AS_THE_FILE_SAYS)
    monkeypatch.setattr(reformat, "locate_heart", lambda cine: place)
    told = []
    before = found.value.copy()
    reformat.mix_in_own(found, cine, Orientation(mirrored=True))
    np.testing.assert_array_equal(found.value, before)
    reformat.mix_in_own(found, cine, AS_THE_FILE_SAYS, lambda *done: told.append(done))
    assert seen == [0, 0.5]
    assert told == [(1, 2), (2, 2)]
    within = (np.abs((points_mm - middle_mm) @ axes.T) <= half_mm).all(axis=-1)
    assert 0.1 < within.mean() < 0.9
    for phase, times in enumerate((1, 1.5)):
        expected = np.where(within, 0.3 * times * straight(points_mm), 0)
        np.testing.assert_allclose(found.value[phase, :, 2], expected, atol=1e-5)
        np.testing.assert_allclose(found.value[phase, :, 0], 1 - expected, atol=1e-5)
        assert not found.value[phase][:, [1, 3, 4, 5, 6]].any()


def test_slices_that_show_no_heart_themselves_are_not_mixed_in(monkeypatch):
    def nowhere(cine):
        raise StageError("no heart")

    monkeypatch.setattr(reformat, "locate_heart", nowhere)
    found, _ = planes(AXES, np.zeros(3), (60, 60), 40)
    reformat.mix_in_own(found, acquired_about(np.zeros(3)), AS_THE_FILE_SAYS)
    np.testing.assert_array_equal(found.value[:, :, 0], 1)


def test_confidence_of_an_acquired_slice_is_that_of_the_planes_its_heart_lies_on():
    middle_mm = np.zeros(3)
    found, _ = planes(AXES, middle_mm - AXES.T @ (50, 50, 45), (50, 50), 31)
    cine = acquired_about(middle_mm)
    height_mm = np.arange(31) * 3.0 - 45
    rising = (0.5 + height_mm / 200)[None]
    labels = np.zeros(cine.intensity.shape, np.uint8)
    labels[0, 4, 7, 9] = 1
    own = confidence_on_acquired(rising, found, cine, labels)
    assert own.shape == (1, 30)
    place_mm = transform_points(cine.mr_from_index, np.array([9.0, 7.0, 4.0]))
    half_a_plane = 1.5 / 200
    assert own[0, 4] == pytest.approx(0.5 + AXES[2] @ place_mm / 200, abs=half_a_plane)
    # Elsewhere the mean over a slice, whose middle lies on the axis of the grid.
    middles_mm = cine.mr_from_index[2, 3] + 2.5 * np.arange(30)
    expected = 0.5 + AXES[2, 2] * middles_mm / 200
    np.testing.assert_allclose(np.delete(own[0], 4), np.delete(expected, 4), atol=half_a_plane)


def test_a_heart_that_none_of_the_looks_finds_is_left_to_the_slices_own(transverse, monkeypatch):
    cine, _ = transverse
    first = reformat._look
    monkeypatch.setattr(
        reformat,
        "_look",
        lambda few, along, acquired=None: first(few, along) if acquired is None else None,
    )
    assert reformat_to_short_axis(cine) is None
    monkeypatch.setattr(segmentation, "_segment", lambda cine, through, *_: through)
    assert segment_cine(cine, QUICK) is None


def test_images_without_a_heart_are_left_to_be_refused(transverse):
    cine, _ = transverse
    noise = np.random.default_rng(1).normal(100, 10, cine.intensity.shape).astype(np.float32)
    assert reformat_to_short_axis(replace(cine, intensity=noise)) is None
