"""The simulated cine: physics of its contrast, statistics of its noise, geometry of its slices."""

import numpy as np
import pytest
from pydantic import ValidationError

from data_synth.heart import BeatingHeart
from data_synth.mr import (
    FULL_SCALE,
    RELAXATION,
    MrSettings,
    SyntheticCine,
    acquire_cine,
    add_noise,
    count_slices,
    draw_shading,
    steady_state_signal,
)
from data_synth.population import draw_heart
from data_synth.tissue import TRUTH_LABELS, Tissue

CLEAN = MrSettings(
    phases=3,
    slices=6,
    slice_gap_mm=12.0,
    pixel_mm=2.0,
    matrix=110,
    snr=1e6,
    coil_shading=0.0,
    breath_hold_shift_mm=0.0,
    planning_error_deg=0.0,
)


@pytest.fixture(scope="module")
def heart() -> BeatingHeart:
    return draw_heart(np.random.default_rng(5), 0.0)


@pytest.fixture(scope="module")
def cine(heart) -> SyntheticCine:
    return acquire_cine(np.random.default_rng(0), heart, [800.0] * 6, CLEAN)


def simulated_steady_state(t1: float, t2: float, angle: float, repetition: float) -> float:
    """Transverse signal at TE = TR / 2 by playing pulses one after the other (Bloch equations)."""
    magnetisation = np.array([0.0, 0.0, 1.0])
    decay = np.diag(np.exp(-repetition / np.array([t2, t2, t1])))
    regrowth = np.array([0, 0, 1 - np.exp(-repetition / t1)])
    sign = 1.0
    for _ in range(6000):
        c, s = np.cos(sign * angle), np.sin(sign * angle)
        excited = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ magnetisation
        magnetisation = decay @ excited + regrowth
        sign = -sign
    return float(np.hypot(*excited[:2])) * np.exp(-repetition / 2 / t2)


@pytest.mark.parametrize("tissue", [Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM, Tissue.FAT])
def test_contrast_follows_the_bloch_equations(tissue):
    settings = MrSettings()
    t1, t2, density = RELAXATION[tissue]
    expected = density * simulated_steady_state(
        t1, t2, np.deg2rad(settings.flip_angle_deg), settings.repetition_ms
    )
    # 6000 pulses last 18 s, over 12 times the longest T1: the rest is below exp(-12) = 6e-6.
    assert steady_state_signal(settings)[tissue] == pytest.approx(expected, rel=1e-4)


def test_tissues_look_as_in_a_cine():
    signal = steady_state_signal(MrSettings())
    assert set(RELAXATION) == set(Tissue)
    assert signal[Tissue.LV_CAVITY] > 2.5 * signal[Tissue.LV_MYOCARDIUM]
    assert signal[Tissue.FAT] > 2 * signal[Tissue.LV_MYOCARDIUM]
    assert signal[Tissue.LUNG] < 0.3 * signal[Tissue.LV_MYOCARDIUM]


def test_noise_is_rician_with_the_wanted_strength():
    settings = MrSettings(snr=20.0)
    blood = float(steady_state_signal(settings)[Tissue.LV_CAVITY])
    deviation = blood / 20 * FULL_SCALE
    rng = np.random.default_rng(0)
    n = 400
    dark = add_noise(rng, np.zeros((n, n), np.float32), settings).astype(float)
    bright = add_noise(rng, np.full((n, n), blood, np.float32), settings).astype(float)
    # Rayleigh mean in the dark, near-Gaussian spread in blood; 5 standard errors of n^2 samples.
    assert dark.mean() == pytest.approx(deviation * np.sqrt(np.pi / 2), abs=5 * deviation / n)
    assert bright.std() == pytest.approx(deviation, rel=5 / n + 2 / 20**2)
    second_moment = (bright**2).mean()
    expected = (blood * FULL_SCALE) ** 2 + 2 * deviation**2
    assert second_moment == pytest.approx(expected, rel=5 * 2 / 20 / n)


def test_shading_is_smooth_with_mean_one():
    shading = draw_shading(np.random.default_rng(2), MrSettings(coil_shading=0.3))
    assert shading.mean() == pytest.approx(1, abs=1e-5)
    assert shading.min() > 0
    assert np.abs(np.diff(shading, axis=0)).max() < 0.06


def test_slices_are_perpendicular_to_the_long_axis_from_apex_to_base(cine, heart):
    axes = cine.mr_from_index[:3, :3] / [2.0, 2.0, 20.0]
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], heart.long_axis, atol=1e-12)
    assert np.linalg.det(axes) > 0


def test_labels_are_the_tissue_at_the_middle_of_each_voxel(cine, heart):
    rng = np.random.default_rng(1)
    z, y, x = (rng.integers(0, size, 3000) for size in cine.labels.shape[1:])
    points = np.stack([x, y, z], axis=1) @ cine.mr_from_index[:3, :3].T + cine.mr_from_index[:3, 3]
    for k, phase in enumerate(cine.phases):
        tissue = heart.tissue(points, float(phase))
        expected = np.zeros(len(points), np.uint8)
        for value, name in TRUTH_LABELS.values():
            expected[tissue == name] = value
        np.testing.assert_array_equal(cine.labels[k, z, y, x], expected)


def test_a_voxel_deep_in_one_tissue_has_that_tissues_signal(cine):
    from scipy.ndimage import binary_erosion

    signal = steady_state_signal(CLEAN) * FULL_SCALE
    for value, tissue in ((1, Tissue.LV_CAVITY), (2, Tissue.LV_MYOCARDIUM)):
        # Four pixels (8 mm) inside in-plane; the mid-ventricle's walls run along the slice axis.
        inside = binary_erosion(cine.labels[0, 2] == value, iterations=4 if value == 1 else 2)
        assert inside.sum() > 20
        found = np.median(cine.intensity[0, 2][inside])
        assert found == pytest.approx(signal[tissue], abs=1.5)


def test_thick_slices_mix_tissues_between_their_pure_values(cine):
    signal = steady_state_signal(CLEAN) * FULL_SCALE
    assert cine.intensity.max() <= np.ceil(signal.max()) + 1
    mixed = (cine.intensity[0] > 1.2 * signal[Tissue.LV_MYOCARDIUM]) & (cine.labels[0] == 2)
    assert mixed.sum() > 50


def test_trigger_times_are_phases_of_each_slices_own_beat(heart):
    settings = CLEAN.model_copy(update={"matrix": 32, "slices": 3, "through_plane_samples": 1})
    told: list[tuple[int, int]] = []
    cine = acquire_cine(
        np.random.default_rng(0),
        heart,
        [700.0, 800.0, 930.0],
        settings,
        progress=lambda done, total: told.append((done, total)),
    )
    np.testing.assert_allclose(cine.trigger_times_ms[:, 1], [700 / 3, 800 / 3, 310.0])
    np.testing.assert_allclose(cine.phases, [0, 1 / 3, 2 / 3])
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_the_window_blurs_what_moves(heart):
    """Averaging over a window leaves a still chest as it is and smears a moving edge."""
    frames = []
    for samples in (1, 9):
        settings = CLEAN.model_copy(update={"slices": 3, "window_samples": samples})
        cine = acquire_cine(np.random.default_rng(0), heart, [800.0] * 3, settings)
        frames.append(cine.intensity.astype(float))
    change = np.abs(frames[0] - frames[1])
    still = np.ones(change.shape[2:], bool)
    still[10:100, 10:100] = False
    # SNR of 1e6 leaves rounding alone: one grey value.
    assert change[..., still].max() <= 1
    assert change.max() > 50


def test_default_stack_covers_the_heart_from_apex_to_roof(heart):
    settings = MrSettings()
    count = count_slices(heart, settings)
    step = settings.slice_thickness_mm + settings.slice_gap_mm
    shape = heart.shape
    height = shape.lv_length + shape.apex_wall + shape.la_z + shape.la_radius_z
    assert (count - 1) * step > height
    assert count_slices(heart, CLEAN) == 6


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("phases", 1),
        ("snr", 0.0),
        ("snr", -3.0),
        ("snr", float("nan")),
        ("pixel_mm", -1.4),
        ("slice_thickness_mm", 0.0),
        ("matrix", 0),
        ("speed", 1),
    ],
)
def test_impossible_protocols_are_refused(name, value):
    with pytest.raises(ValidationError, match=name):
        MrSettings.model_validate({name: value})
