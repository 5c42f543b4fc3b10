"""Physics behind the simulated cine: signal, field, coils, noise, sampling and flow."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_synth.bssfp import (
    RELAXATION,
    chemical_shift_hz,
    fresh_blood,
    steady_state,
    steady_state_signal,
)
from data_synth.coils import array_loops, shading, sum_of_squares
from data_synth.flow import (
    LEFT,
    STEPS,
    axial_speed,
    chamber_areas,
    jet_loss,
    unsaturated_share,
    valve_jets,
)
from data_synth.heart import BeatingHeart
from data_synth.mr import (
    FULL_SCALE,
    MrSettings,
    add_noise,
)
from data_synth.offresonance import dipole_field_ppm, middle_mm, off_resonance_hz
from data_synth.population import draw_heart
from data_synth.sampling import Slice, profile_quantiles, spread_samples
from data_synth.tissue import Tissue


@pytest.fixture(scope="module")
def heart() -> BeatingHeart:
    return draw_heart(np.random.default_rng(5), 0.0)


def played_pulses(t1, t2, angle, repetition, precession, pulses):
    """Signal at TE = TR / 2 after each pulse of alternating sign, from M0 along z (Bloch)."""
    magnetisation = np.array([0.0, 0.0, 1.0])
    half = repetition / 2
    decay = np.exp(-half / np.array([t2, t2, t1]))
    regrowth = np.array([0, 0, 1 - np.exp(-half / t1)])
    c, s = np.cos(precession / 2), np.sin(precession / 2)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    signal = np.empty(pulses, complex)
    for n in range(pulses):
        sign = 1 - 2 * (n % 2)
        ca, sa = np.cos(angle), sign * np.sin(angle)
        # About y, so that the pulse tips z towards +x or -x in turns.
        magnetisation = np.array([[ca, 0, sa], [0, 1, 0], [-sa, 0, ca]]) @ magnetisation
        magnetisation = decay * (turn @ magnetisation) + regrowth
        signal[n] = sign * (magnetisation[0] + 1j * magnetisation[1])
        magnetisation = decay * (turn @ magnetisation) + regrowth
    return signal


@pytest.mark.parametrize("field", [1.5, 3.0])
@pytest.mark.parametrize("tissue", [Tissue.LV_CAVITY, Tissue.LV_MYOCARDIUM, Tissue.FAT])
@pytest.mark.parametrize("error_hz", [0.0, 70.0, -140.0])
def test_signal_is_where_the_bloch_equations_settle(tissue, field, error_hz):
    settings = MrSettings(field_strength_t=field)
    t1, t2, density = RELAXATION[field][tissue]
    precession = 2 * np.pi * (chemical_shift_hz(field)[tissue] + error_hz) * 3e-3
    settled = played_pulses(t1, t2, np.deg2rad(50.0), 3.0, precession, 5000)[-1]
    # 5000 pulses last 15 s, over 7.7 times the longest T1: the rest is below exp(-7.7) = 5e-4.
    found = steady_state_signal(settings, error_hz)[tissue]
    assert abs(found - density * settled) < 6e-4 * density


@given(
    st.floats(200, 3000),
    st.floats(0.02, 1.0),
    st.floats(0.05, 1.5),
    st.floats(-20, 20),
)
def test_signal_repeats_with_opposite_sign_every_turn(t1, share, angle, precession):
    """A whole extra turn within TR changes the sign at TE = TR / 2, and never the strength."""
    once, again = steady_state(
        np.full(2, t1),
        np.full(2, t1 * share),
        precession + np.array([0, 2 * np.pi]),
        angle,
        3.0,
    )
    assert abs(once + again) < 1e-9
    # No more than the equilibrium magnetisation can be turned into signal.
    assert abs(once) <= 1


def test_fresh_blood_settles_as_the_bloch_equations_say():
    settings = MrSettings()
    fresh = fresh_blood(settings)
    t1, t2, _ = RELAXATION[1.5][Tissue.LV_CAVITY]
    played = played_pulses(t1, t2, np.deg2rad(50.0), 3.0, 0.0, 600)
    # Neighbouring pulses average the part that oscillates.
    smooth = ((played[1:] + played[:-1]) / 2).real
    steady = abs(steady_state_signal(settings)[Tissue.LV_CAVITY])
    times_s = 3e-3 * np.arange(1, 600)
    expected = steady * (1 + (fresh.gain - 1) * np.exp(-times_s / fresh.memory_s))
    # What oscillates falls as E2 = 0.99 a pulse; past 100 pulses its neighbours' sum is < 1 %.
    np.testing.assert_allclose(smooth[100:], expected[100:], rtol=0.01)


@pytest.mark.parametrize("field", [1.5, 3.0])
def test_tissues_look_as_in_a_cine(field):
    signal = np.abs(steady_state_signal(MrSettings(field_strength_t=field)))
    assert set(RELAXATION[field]) == set(Tissue)
    blood, muscle = signal[Tissue.LV_CAVITY], signal[Tissue.LV_MYOCARDIUM]
    assert 2.5 * muscle < blood < 4 * muscle
    assert signal[Tissue.FAT] > 1.8 * muscle
    assert signal[Tissue.LUNG] < 0.3 * muscle
    assert signal[Tissue.AIR] == signal[Tissue.GAS] == 0


def test_fat_opposes_water_at_the_usual_repetition_time():
    """At TR 3 ms and 1.5 T fat turns 0.65 times within TR: it lies in the next pass band."""
    fat, muscle = steady_state_signal(MrSettings())[[Tissue.FAT, Tissue.LV_MYOCARDIUM]]
    assert (fat * np.conj(muscle)).real < -0.9 * abs(fat * muscle)
    fat, muscle = steady_state_signal(MrSettings(repetition_ms=1.0))[
        [Tissue.FAT, Tissue.LV_MYOCARDIUM]
    ]
    assert (fat * np.conj(muscle)).real > 0.9 * abs(fat * muscle)


def test_field_of_a_sphere_is_a_dipoles():
    """Outside: a dipole; inside nothing after Lorentz' correction (Jackson's sphere, ch. 5)."""
    n, radius = 96, 10.0
    x, y, z = np.mgrid[:n, :n, :n] - n / 2 + 0.5
    r = np.sqrt(x * x + y * y + z * z)
    field = dipole_field_ppm(np.clip(radius + 0.5 - r, 0, 1))
    exact = (radius / r) ** 3 * (2 * z * z - x * x - y * y) / r**2 / 3
    away = (r > 14) & (r < 25)
    # The grid's own copies lie 96 cells off: each adds at most (10 / 71)^3 * 2 / 3 = 0.002, and
    # the largest sum over the six nearest is four times that at the shell's rim.
    np.testing.assert_allclose(field[away], exact[away], atol=0.008)
    assert np.abs(field[r < 7]).max() < 0.02


def test_field_error_over_the_heart_is_as_measured_in_people(heart):
    """Kellman et al., J. Cardiovasc. Magn. Reson. 15:63 (2013): after shimming on the heart,
    61.8 (sd 15.5) Hz from end to end over the heart at 1.5 T and 125.0 (40.6) Hz at 3 T.
    """
    points = np.random.default_rng(0).uniform(-60, 60, (8000, 3)) + middle_mm(heart)
    muscle = points[heart.tissue(points, 0.0) == Tissue.LV_MYOCARDIUM]
    span_hz, double_hz = (
        np.subtract(
            *np.percentile(
                off_resonance_hz(heart, MrSettings(field_strength_t=field), muscle), (99.5, 0.5)
            )
        )
        for field in (1.5, 3.0)
    )
    assert double_hz == pytest.approx(2 * span_hz)
    assert abs(span_hz - 61.8) < 2 * 15.5


def test_loops_make_the_field_of_a_circular_current(heart):
    """On the axis of a circle: 2 pi R^2 / (R^2 + d^2)^(3/2), by Biot and Savart."""
    turn = np.arange(200) * 2 * np.pi / 200
    loop = 40.0 * np.stack([np.zeros(200), np.cos(turn), np.sin(turn)], axis=1)
    depth = np.array([5.0, 30.0, 90.0])
    points = np.stack([depth, 0 * depth, 0 * depth], axis=1)
    exact = 2 * np.pi * 40.0**2 / (40.0**2 + depth**2) ** 1.5
    # 200 chords: the polygon's area falls short by (2 pi / 200)^2 / 6 = 1.6e-4.
    np.testing.assert_allclose(sum_of_squares(points, loop[None]), exact, rtol=1e-3)


def test_coils_are_brighter_near_the_skin_and_one_at_the_heart(heart):
    centre, chest = heart.centre_mm, heart.chest
    front = np.array([centre[0], -chest.half_depth + 25, centre[2]])
    points = np.vstack([centre, (centre + front) / 2, front])
    raw = shading(heart, points, 1.0)
    assert raw[0] == pytest.approx(1)
    assert raw[0] < raw[1] < raw[2]
    np.testing.assert_allclose(shading(heart, points, 0.5), np.sqrt(raw))
    np.testing.assert_array_equal(shading(heart, points, 0.0), 1.0)
    loops = array_loops(chest, 0.0)
    inside = (loops[..., 0] / chest.half_width) ** 2 + (loops[..., 1] / chest.half_depth) ** 2 < 1
    assert not inside.any()


def test_noise_is_rician_with_the_wanted_strength():
    settings = MrSettings()
    blood = float(abs(steady_state_signal(settings)[Tissue.LV_CAVITY]))
    deviation = blood / 20 * FULL_SCALE
    rng = np.random.default_rng(0)
    n = 400
    dark = add_noise(rng, np.zeros((n, n), np.complex64), settings, 20.0).astype(float)
    # Any phase of the signal gives the same magnitude.
    full = np.full((n, n), blood * np.exp(0.7j), np.complex64)
    bright = add_noise(rng, full, settings, 20.0).astype(float)
    # Rayleigh mean in the dark, near-Gaussian spread in blood; 5 standard errors of n^2 samples.
    assert dark.mean() == pytest.approx(deviation * np.sqrt(np.pi / 2), abs=5 * deviation / n)
    assert bright.std() == pytest.approx(deviation, rel=5 / n + 2 / 20**2)
    second_moment = (bright**2).mean()
    expected = (blood * FULL_SCALE) ** 2 + 2 * deviation**2
    assert second_moment == pytest.approx(expected, rel=5 * 2 / 20 / n)


def test_slice_profile_has_the_asked_width_and_soft_edges():
    shares = (np.arange(200_000) + 0.5) / 200_000
    np.testing.assert_allclose(profile_quantiles(shares, 0.0), shares - 0.5)
    density, edges = np.histogram(profile_quantiles(shares, 0.15), np.linspace(-1.05, 1.05, 106))
    middle = (edges[1:] + edges[:-1]) / 2
    # Half the height of the middle at half the thickness: the definition of the full width.
    half = np.interp([-0.5, 0.5], middle, density / density.max())
    np.testing.assert_allclose(half, 0.5, atol=0.03)
    # Half a thickness beyond the edge is 3.3 of its deviations: 5e-4 of either half.
    assert density[np.abs(middle) > 1].sum() < 5e-4 * density.sum()


def test_samples_cover_thickness_pixel_and_window():
    settings = MrSettings(through_plane_samples=16, window_samples=4)
    samples = spread_samples(np.eye(3), settings, 8.0, 1.4, 0.0)
    x, y, depth = samples.offsets_mm.T
    np.testing.assert_allclose(np.sort(depth), (np.arange(16) + 0.5) / 2 - 4)
    for along in (x, y):
        np.testing.assert_allclose(np.sort(along), ((np.arange(16) + 0.5) / 16 - 0.5) * 1.4)
        assert abs(np.corrcoef(depth, along)[0, 1]) < 0.25
    values, counts = np.unique(samples.instants, return_counts=True)
    np.testing.assert_allclose(values, [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_array_equal(counts, 4)
    # No drift from early-shallow to late-deep, which would shear what moves.
    assert abs(np.corrcoef(depth, samples.instants)[0, 1]) < 0.25


def test_blood_speed_through_the_base_carries_the_stroke_volume(heart):
    """What passes the mitral plane in a cycle, to and fro, is twice the stroke volume."""
    known = chamber_areas(heart)
    volume_ml = [heart.volumes_ml(k / 8)["lv_endocardium"] for k in range(8)]
    counted_ml = known.areas_mm2[LEFT].sum(axis=1) * np.diff(known.heights_mm)[0] / 1000
    # One in eight of a volume's N points lies in a cell that its surface cuts; their chance error
    # is sqrt(N / 8) / 2 of N > 500. Six harmonics of the beat leave a few ml more.
    np.testing.assert_allclose(counted_ml[:: STEPS // 8], volume_ml, rtol=0.04)
    outflow_ml = known.outflow_mm3(LEFT) / 1000
    assert outflow_ml.sum() / STEPS == pytest.approx(0, abs=1e-6)
    # Kick and twist apart, the volume falls once and rises once: in and out are both the stroke.
    stroke_ml = max(volume_ml) - min(volume_ml)
    assert np.maximum(outflow_ml, 0).sum() / STEPS == pytest.approx(stroke_ml, rel=0.08)
    apex, base = (axial_speed(known, LEFT, z).max() for z in (-75.0, -20.0))
    assert base > apex


@given(st.floats(0, 5000), st.floats(2, 20), st.floats(0.3, 2), st.floats(0.1, 2))
def test_steady_inflow_settles_between_exchange_and_memory(speed, thickness, rr_s, memory_s):
    share = unsaturated_share(np.full(STEPS, speed), thickness, rr_s, memory_s, 0.5)
    exchange = speed / thickness / rr_s
    np.testing.assert_allclose(share, 0.5 * exchange / (exchange + 1 / memory_s), rtol=1e-9)


def test_jets_darken_blood_behind_open_valves_alone(heart):
    jets = valve_jets(heart)
    mitral, aortic = jets[0], jets[2]
    fill, eject = (float(jet.flow_mm3.argmax()) / STEPS for jet in (mitral, aortic))
    valve = heart.into_heart(heart.carry(heart.into_patient(np.zeros((1, 3))), fill))[0]
    below = np.zeros((8, 3))
    below[:, 0], below[:, 2] = mitral.radius_mm, -np.arange(2.0, 42.0, 5.0)
    filling, ejecting = (
        jet_loss(heart, jets, valve + below, phase, 0.8, 5.0) for phase in (fill, eject)
    )
    assert filling[0] < 0.9
    assert (np.diff(filling) > 0).all()
    np.testing.assert_allclose(ejecting, 1.0, atol=0.05)
    # Healthy streams: about a metre a second through open valves.
    for jet in (mitral, aortic):
        speed_m_s = jet.flow_mm3.max() / 0.8 / (np.pi * jet.radius_mm**2) / 1000
        assert 0.4 < speed_m_s < 1.8
    np.testing.assert_array_equal(jet_loss(heart, jets, valve + below, fill, 0.8, 0.0), 1.0)


@pytest.mark.parametrize("pace", [0.6, 1.0, 1.5])
def test_the_stroke_through_a_valve_is_the_same_however_long_the_beat(heart, monkeypatch, pace):
    """Systole keeps nearly its length in a slow heart, so blood is no slower for its long beat."""
    rr_s, passed = heart.rr_s * pace, []
    aortic = valve_jets(heart)[2]

    def loss(_heart, _jets, _points, phase, cycle_s, _moment):
        passed.append(aortic.flow_mm3[int(phase * STEPS) % STEPS] / cycle_s)
        return 1.0

    monkeypatch.setattr("data_synth.sampling.jet_loss", loss)
    shown = SimpleNamespace(
        heart=heart,
        in_heart=None,
        settings=MrSettings(),
        view=SimpleNamespace(rr_s=rr_s, jets=()),
        _nominal=lambda phase: heart.nominal_phase(phase % 1.0, rr_s),
    )
    phases = (np.arange(1000) + 0.5) / 1000
    for phase in phases:
        Slice._jet_loss(shown, phase, shown._nominal(phase))
    stroke_mm3 = np.mean(passed) * rr_s
    # Where the pace changes, differences over 2 thousandths of a beat blur the flow.
    assert stroke_mm3 == pytest.approx(aortic.flow_mm3.mean(), rel=0.01)
