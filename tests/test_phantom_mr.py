"""The simulated cine: what its images show, and the geometry of its slices."""

import numpy as np
import pytest
from mr_phantom import CLEAN, QUICK, changed, pure, tissue_map
from pydantic import ValidationError
from scipy.ndimage import binary_dilation, binary_erosion

from data_synth import mr
from data_synth.breathing import BREATHING_AXIS
from data_synth.bssfp import (
    steady_state_signal,
)
from data_synth.heart import BeatingHeart
from data_synth.mr import (
    FULL_SCALE,
    LONG_AXIS_VIEWS,
    MrSettings,
    SyntheticCine,
    acquire_cine,
    acquire_long_axis,
    acquire_volume,
    count_slices,
)
from data_synth.plan import plan_long_axis
from data_synth.population import draw_heart
from data_synth.tissue import Tissue, truth_values


@pytest.fixture(scope="module")
def heart() -> BeatingHeart:
    return draw_heart(np.random.default_rng(5), 0.0)


@pytest.fixture(scope="module")
def cine(heart) -> SyntheticCine:
    return acquire_cine(np.random.default_rng(0), heart, [800.0] * 6, CLEAN)


def test_blood_is_as_much_brighter_than_muscle_as_in_people(heart):
    """Thiele et al., J. Magn. Reson. Imaging 14:362-367 (2001): signal of blood over signal of
    muscle in steady-state cines is 3.5 (sd 1.1) at end-diastole and 3.2 (1.3) at systole.
    """
    usual = MrSettings(
        phases=3, slices=3, slice_gap_mm=20.0, pixel_mm=1.6, matrix=96,
        breath_hold_shift_mm=0.0, planning_error_deg=0.0,
    )  # fmt: skip
    found = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, usual)
    for k, mean, deviation in ((0, 3.5, 1.1), (1, 3.2, 1.3)):
        blood, muscle = (
            np.median(found.intensity[k, 1][pure(heart, found, 1, tissue, k)])
            for tissue in (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM)
        )
        assert abs(blood / muscle - mean) < deviation


def dark_border(heart, settings):
    """Least signal on the border of fat and septal-free muscle, over the muscle's own."""
    found = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, settings)
    tissue = tissue_map(heart, found, 0, 1)
    border = binary_dilation(tissue == Tissue.FAT) & (tissue == Tissue.LV_MYOCARDIUM)
    deep = binary_erosion(tissue == Tissue.LV_MYOCARDIUM, iterations=2)
    image = found.intensity[0, 1]
    return np.percentile(image[border], 10) / np.median(image[deep])


def test_fat_is_outlined_in_black_where_it_opposes_water(heart):
    fine = changed(slices=3, slice_gap_mm=20.0, phases=2, pixel_mm=1.4, matrix=96)
    assert dark_border(heart, fine) < 0.5
    # In the same pass band nothing cancels: the border lies between muscle and brighter fat.
    assert dark_border(heart, fine.model_copy(update={"repetition_ms": 1.0})) > 0.9


def test_a_dark_band_appears_where_the_frequency_misses_by_half_the_repetition_rate(heart):
    plain = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, changed(**QUICK))
    off = changed(**QUICK, shim_error_hz=1000 / 6)
    banded = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, off)
    inside = binary_erosion(plain.labels[0, 1] == 1, iterations=2)
    ratio = banded.intensity[0, 1][inside] / plain.intensity[0, 1][inside]
    assert ratio.max() < 0.15
    sloped = changed(**QUICK, shim_error_hz=1000 / 6, shim_error_hz_per_cm=40.0)
    part = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, sloped)
    ratio = part.intensity[0, 1][inside] / plain.intensity[0, 1][inside]
    assert ratio.min() < 0.3
    assert ratio.max() > 0.7


@pytest.mark.parametrize("field", [1.5, 3.0])
def test_snr_of_the_cavity_is_measured_as_asked(heart, field):
    asked = changed(slices=3, slice_gap_mm=20.0, phases=6, snr=25.0, field_strength_t=field)
    found = acquire_cine(np.random.default_rng(3), heart, [800.0] * 3, asked)
    inside = np.logical_and.reduce([pure(heart, found, 1, Tissue.LV_CAVITY, k) for k in range(6)])
    values = found.intensity[:, 1, inside].astype(float)
    assert values.size > 500
    # Standard error of a deviation from n samples is 1 / sqrt(2 n); rounding adds below 1e-3.
    expected = pytest.approx(25.0, rel=5 / np.sqrt(2 * values.size) + 0.005)
    assert values.mean() / values.std() == expected


def test_slices_are_perpendicular_to_the_long_axis_from_apex_to_base(cine, heart):
    axes = cine.mr_from_index[:3, :3] / [2.0, 2.0, 20.0]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], heart.long_axis, atol=1e-12)
    assert np.linalg.det(axes) > 0
    assert cine.pixel_mm == pytest.approx(2.0)
    assert cine.slice_step_mm == pytest.approx(20.0)
    assert (cine.slice_thickness_mm, cine.field_strength_t) == (8.0, 1.5)


def test_labels_are_the_tissue_at_the_middle_of_each_voxel(heart):
    """At the place the heart had in this breath-hold, and the state it had in this beat."""
    rr_ms = [700.0, 800.0, 1000.0]
    settings = changed(slices=3, slice_gap_mm=20.0, breath_hold_shift_mm=4.0, window_samples=4)
    found = acquire_cine(np.random.default_rng(2), heart, rr_ms, settings)
    assert np.abs(found.shifts_mm).max() > 1
    rng = np.random.default_rng(1)
    z, y, x = (rng.integers(0, size, 2000) for size in found.labels.shape[1:])
    frame = found.mr_from_index
    points = np.stack([x, y, z], axis=1) @ frame[:3, :3].T + frame[:3, 3]
    for k, phase in enumerate(found.phases):
        for n, rr in enumerate(rr_ms):
            here = z == n
            state = heart.nominal_phase(float(phase), rr / 1000)
            tissue = heart.heart_tissue(points[here] - found.shifts_mm[n], state)
            expected = truth_values()[tissue]
            np.testing.assert_array_equal(found.labels[k, n, y[here], x[here]], expected)


def test_a_voxel_deep_in_one_tissue_has_that_tissues_signal(cine, heart):
    signal = np.abs(steady_state_signal(CLEAN)) * FULL_SCALE
    for tissue, least in ((Tissue.LV_CAVITY, 20), (Tissue.LV_MYOCARDIUM, 1)):
        inside = pure(heart, cine, 2, tissue)
        assert inside.sum() >= least
        found = np.median(cine.intensity[0, 2][inside])
        assert found == pytest.approx(signal[tissue], abs=1.5)


def test_partial_volume_mixes_what_a_voxel_holds(cine):
    """Where muscle and blood share a voxel its signal lies between theirs, never beyond."""
    signal = np.abs(steady_state_signal(CLEAN)) * FULL_SCALE
    assert cine.intensity.max() <= np.ceil(signal.max()) + 1
    mixed = (cine.intensity[0] > 1.2 * signal[Tissue.LV_MYOCARDIUM]) & (cine.labels[0] == 2)
    assert mixed.sum() > 50


def test_a_voxel_averages_what_lies_in_its_box(heart):
    """Mean signal of the ventricle in a slice, against points strewn in its voxels at random."""
    settings = changed(slices=3, slice_gap_mm=20.0, phases=2, slice_edge=0.0)
    found = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, settings)
    region = binary_erosion(np.isin(found.labels[0, 1], (1, 2)), iterations=2)
    rng = np.random.default_rng(1)
    y, x = np.argwhere(region)[rng.integers(0, region.sum(), 20_000)].T
    place = rng.uniform(-0.5, 0.5, (20_000, 3))
    depth = 1 + place[:, 2] * found.slice_thickness_mm / found.slice_step_mm
    index = np.stack([x + place[:, 0], y + place[:, 1], depth], axis=1)
    points = index @ found.mr_from_index[:3, :3].T + found.mr_from_index[:3, 3]
    signal = FULL_SCALE * steady_state_signal(settings)[heart.tissue(points, 0.0)].real
    # Chance: 5 standard errors of the points. Six samples instead of a box err by 1 % at most.
    error = 5 * signal.std() / np.sqrt(20_000) + 0.01 * signal.mean()
    assert found.intensity[0, 1][region].mean() == pytest.approx(signal.mean(), abs=error)


def test_trigger_times_are_phases_of_each_slices_own_beat(heart):
    settings = changed(matrix=32, slices=3, through_plane_samples=1)
    told: list[tuple[int, int]] = []
    found = acquire_cine(
        np.random.default_rng(0),
        heart,
        [700.0, 800.0, 930.0],
        settings,
        progress=lambda done, total: told.append((done, total)),
    )
    np.testing.assert_allclose(found.trigger_times_ms[:, 1], [700 / 3, 800 / 3, 310.0])
    np.testing.assert_allclose(found.phases, [0, 1 / 3, 2 / 3])
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_the_window_blurs_what_moves(heart):
    """Averaging over a window leaves a still chest as it is and smears a moving edge."""
    frames = []
    for samples in (1, 8):
        settings = changed(
            slices=3, slice_gap_mm=20.0, window_samples=samples, through_plane_samples=8
        )
        found = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, settings)
        frames.append(found.intensity.astype(float))
    change = np.abs(frames[0] - frames[1])[:, 1]
    y, x = np.mgrid[:110, :110].reshape(2, -1)
    frame = found.mr_from_index
    points = np.stack([x, y, np.ones(x.size)], axis=1) @ frame[:3, :3].T + frame[:3, 3]
    still = ~binary_dilation(heart.near_heart(points).reshape(110, 110), iterations=4)
    assert still.sum() > 1000
    # SNR of 1e6 leaves rounding alone: one grey value.
    assert change[:, still].max() <= 1
    assert change.max() > 50


def test_same_seed_gives_the_same_bytes_on_any_number_of_threads(heart, monkeypatch):
    settings = changed(**QUICK, snr=20.0, phases=2, breath_hold_shift_mm=1.5)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(mr, "THREADS", threads)
        made = acquire_cine(np.random.default_rng(7), heart, [800.0] * 3, settings)
        found.append(made.intensity.tobytes())
    assert found[0] == found[1]
    other = acquire_cine(np.random.default_rng(8), heart, [800.0] * 3, settings)
    assert other.intensity.tobytes() != found[0]


def test_default_stack_covers_the_heart_from_apex_to_roof(heart):
    settings = MrSettings()
    count = count_slices(heart, settings)
    shape = heart.shape
    height = shape.lv_length + shape.apex_wall + shape.la_z + shape.la_radius_z
    assert (count - 1) * settings.slice_step_mm > height
    assert count_slices(heart, CLEAN) == 6


def test_inflow_brightens_moving_blood_alone(heart):
    plain, inflow = (
        acquire_cine(np.random.default_rng(0), heart, [800.0] * 6, settings)
        for settings in (CLEAN, changed(inflow=0.35))
    )
    blood, muscle = (pure(heart, plain, 2, t) for t in (Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM))
    assert inflow.intensity[0, 2][blood].mean() > 1.05 * plain.intensity[0, 2][blood].mean()
    change = inflow.intensity[0, 2].astype(float) - plain.intensity[0, 2]
    assert np.abs(change[muscle]).max() <= 1
    # A long-axis view lies along the stream, so less fresh blood crosses it.
    along = acquire_long_axis(np.random.default_rng(0), heart, [800.0] * 3, changed(inflow=0.35))
    view = along["four_chamber"]
    inside = pure(heart, view, 0, Tissue.LV_CAVITY)
    assert view.intensity[0, 0][inside].mean() < inflow.intensity[0, 2][blood].mean()


def test_long_axis_views_pass_through_apex_and_mitral_centre(heart):
    apex = heart.centre_mm - heart.long_axis * heart.shape.lv_length
    tricuspid = heart.into_patient(np.array([[heart.shape.ra_x, heart.shape.ra_y, 0.0]]))[0]
    for view in LONG_AXIS_VIEWS:
        frame = plan_long_axis(np.random.default_rng(0), heart, view, CLEAN)
        normal = frame[:3, 2] / np.linalg.norm(frame[:3, 2])
        for point in (apex, heart.centre_mm):
            assert abs((point - frame[:3, 3]) @ normal) < 1e-9
        on_right_valve = abs((tricuspid - frame[:3, 3]) @ normal) < 1e-9
        assert on_right_valve == (view == "four_chamber")
        assert np.linalg.det(frame[:3, :3]) > 0


def test_long_axis_views_show_the_chambers_they_are_named_for(heart):
    views = acquire_long_axis(np.random.default_rng(0), heart, [800.0, 900.0, 1000.0], CLEAN)
    assert tuple(views) == LONG_AXIS_VIEWS
    held = {}
    for name, view in views.items():
        assert view.intensity.shape == view.labels.shape == (3, 1, 110, 110)
        counts = np.bincount(view.labels[0].ravel(), minlength=7) * 4.0
        held[name] = {int(value) for value in np.flatnonzero(counts > 100)}
    # 1 cavity, 2 muscle, 3 right ventricle, 4 and 5 atria, 6 aorta: by area over 1 cm^2.
    assert held["four_chamber"] >= {1, 2, 3, 4, 5}
    assert held["two_chamber"] >= {1, 2, 4}
    assert 3 not in held["two_chamber"]
    assert 5 not in held["two_chamber"]
    assert held["three_chamber"] >= {1, 2, 3, 4, 6}
    assert views["three_chamber"].rr_ms == [900.0]


def test_long_axis_views_lie_as_readers_expect():
    """Left (x) on the right and back (y) below, or back on the right and feet (-z) below."""
    expected = {"four_chamber": (0, 1, 1), "two_chamber": (1, 2, -1), "three_chamber": (1, 2, -1)}
    for seed in range(3):
        drawn = draw_heart(np.random.default_rng(seed))
        for view, (right, below, sense) in expected.items():
            frame = plan_long_axis(np.random.default_rng(0), drawn, view, CLEAN)
            axes = frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0)
            np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
            assert np.linalg.det(axes) == pytest.approx(1)
            assert axes[right, 0] > 0
            assert axes[below, 1] * sense > 0


def test_volume_is_isotropic_and_holds_the_heart(heart):
    settings = changed(
        phases=2, volume_voxel_mm=4.0, volume_snr=1e6, through_plane_samples=4, volume_gating_mm=0.0
    )
    found = acquire_volume(np.random.default_rng(0), heart, [790.0, 811.0], settings)
    sizes = np.linalg.norm(found.mr_from_index[:3, :3], axis=0)
    np.testing.assert_allclose(sizes, 4.0)
    assert found.slice_thickness_mm == 4.0
    np.testing.assert_array_equal(found.rr_ms, 800.0)
    for k in range(2):
        # The flat mitral plane, 20 cm^2, may lie anywhere within its layer of 4 mm voxels.
        counted_ml = (found.labels[k] == 1).sum() * 0.064
        assert counted_ml == pytest.approx(heart.volumes_ml(k / 2)["lv_endocardium"], abs=4.0)
    edges = np.concatenate([found.labels[:, [0, -1]].ravel(), found.labels[:, :, [0, -1]].ravel()])
    assert not np.isin(edges, (1, 2, 3, 4, 5)).any()


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        ("transverse", ([1, 0, 0], [0, 1, 0], [0, 0, 1])),
        ("sagittal", ([0, 1, 0], [0, 0, -1], [-1, 0, 0])),
        ("coronal", ([1, 0, 0], [0, 0, -1], [0, 1, 0])),
    ],
)
def test_a_volume_in_the_scanners_planes_holds_the_heart(heart, axes, expected):
    settings = changed(
        phases=2, volume_axes=axes, volume_voxel_mm=5.0, volume_snr=1e6, through_plane_samples=1,
        planning_error_deg=0.0,
    )  # fmt: skip
    found = acquire_volume(np.random.default_rng(0), heart, [800.0], settings)
    np.testing.assert_allclose(found.mr_from_index[:3, :3].T / 5.0, expected, atol=1e-12)
    for k in range(2):
        counted_ml = (found.labels[k] == 1).sum() * 0.125
        # A voxel's layer over some 150 cm^2 of wall decides by chance which side it falls on.
        assert counted_ml == pytest.approx(heart.volumes_ml(k / 2)["lv_endocardium"], rel=0.05)
    for axis in (1, 2, 3):
        ends = np.take(found.labels, [0, -1], axis=axis)
        assert not np.isin(ends, (1, 2, 3, 4, 5)).any()


def test_gating_blurs_the_volume_along_the_breathing_axis(heart):
    sharp, blurred = (
        acquire_volume(
            np.random.default_rng(0), heart, [800.0],
            changed(phases=2, volume_voxel_mm=5.0, volume_snr=1e6, volume_gating_mm=gate,
                    through_plane_samples=4),
        )
        for gate in (0.0, 12.0)
    )  # fmt: skip
    np.testing.assert_array_equal(sharp.labels, blurred.labels)
    images = [made.intensity.astype(float) for made in (sharp, blurred)]
    near = binary_dilation(sharp.labels > 0, np.ones((1, 3, 3, 3)), iterations=2)
    along_axis = [(np.diff(image, axis=1)[near[:, 1:]] ** 2).sum() for image in images]
    assert along_axis[1] < 0.95 * along_axis[0]
    # The chest rests while the heart moves.
    z, y, x = (grid.ravel() for grid in np.indices(sharp.labels.shape[1:]))
    frame = sharp.mr_from_index
    points = np.stack([x, y, z], axis=1) @ frame[:3, :3].T + frame[:3, 3]
    way = 10.0 * np.array(BREATHING_AXIS)
    far = ~(
        heart.near_heart(points) | heart.near_heart(points + way) | heart.near_heart(points - way)
    )
    assert far.sum() > 1000
    assert np.abs(images[1] - images[0]).reshape(2, -1)[:, far].max() <= 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("phases", 1),
        ("snr", 0.0),
        ("snr", -3.0),
        ("snr", float("nan")),
        ("volume_snr", 0.0),
        ("pixel_mm", -1.4),
        ("slice_thickness_mm", 0.0),
        ("matrix", 0),
        ("speed", 1),
        ("field_strength_t", 2.0),
        ("acquisition", "spiral"),
        ("inflow", 1.2),
        ("shim_error_hz", 1e4),
    ],
)
def test_impossible_protocols_are_refused(name, value):
    with pytest.raises(ValidationError, match=name):
        MrSettings.model_validate({name: value})
