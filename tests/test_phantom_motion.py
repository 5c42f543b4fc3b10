"""The motion is one smooth map: invertible, cyclic, and true to the muscle's volume."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_synth.beat import ATRIUM, TWIST, VENTRICLE, nominal_phase
from data_synth.heart import BeatingHeart
from data_synth.population import draw_heart
from data_synth.tissue import Tissue

PHASES = (0.1, 0.2, 0.36, 0.5, 0.85)
phases = st.floats(0, 1, exclude_max=True)
seeds = st.integers(0, 30)
# Everything within the envelope that the phantom looks at, and some way beyond.
offsets = st.lists(
    st.tuples(*[st.floats(-160, 160, allow_subnormal=False)] * 3), min_size=1, max_size=20
)


@pytest.fixture(scope="module", params=[(0, 0.0), (1, 1.0), (2, 2.0)])
def heart(request) -> BeatingHeart:
    seed, spread = request.param
    return draw_heart(np.random.default_rng(seed), spread)


def points_in(heart: BeatingHeart, count: int = 20000) -> tuple[np.ndarray, np.ndarray]:
    """Random points of the heart at the R peak, with their tissue."""
    points = heart.centre_mm + np.random.default_rng(7).uniform(-110, 110, (count, 3))
    labels = heart.heart_tissue(points, 0.0)
    return points[labels > 0], labels[labels > 0]


def jacobians(heart: BeatingHeart, points: np.ndarray, phase: float) -> np.ndarray:
    """Determinant of the map's slope by central differences."""
    # Rounding of coordinates near 100 mm against truncation: 1e-14 / 1e-4 = 1e-10 and 1e-8.
    step = 1e-4 * np.eye(3)
    columns = [
        (heart.carry(points + h, phase) - heart.carry(points - h, phase)) / 2e-4 for h in step
    ]
    return np.linalg.det(np.stack(columns, axis=-1))


@given(seed=seeds, spread=st.sampled_from([0.0, 1.0, 2.0]), phase=phases, offsets=offsets)
def test_reference_undoes_carry_and_carry_undoes_reference(seed, spread, phase, offsets):
    heart = draw_heart(np.random.default_rng(seed), spread)
    points = heart.centre_mm + np.array(offsets)
    # The closed-form inverses round at 1e-13 mm; slopes of 0.1 to 10 leave that far below 1e-9.
    there = heart.carry(points, phase)
    np.testing.assert_allclose(heart.reference(there, phase), points, rtol=0, atol=1e-9)
    back = heart.reference(points, phase)
    np.testing.assert_allclose(heart.carry(back, phase), points, rtol=0, atol=1e-9)


def test_nothing_moves_at_the_r_peak(heart):
    points, _ = points_in(heart)
    np.testing.assert_allclose(heart.carry(points, 0.0), points, rtol=0, atol=1e-10)


def test_the_cycle_closes_smoothly(heart):
    points, _ = points_in(heart)
    step = 1e-6
    before, after = heart.carry(points, 1 - step), heart.carry(points, step)
    np.testing.assert_allclose(heart.carry(points, 1.0), points, rtol=0, atol=1e-10)
    # Both sides are at rest at the R peak or move alike: no point runs over 400 mm per cycle.
    assert np.abs(before - points).max() < 400 * step
    assert np.abs(after - points).max() < 400 * step


@pytest.mark.parametrize("knots", [VENTRICLE, TWIST, ATRIUM])
def test_curves_have_knots_in_order_within_one_cycle(knots):
    place = np.array(knots)[:, 0]
    assert place[0] == 0
    assert (np.diff(place) > 0).all()
    assert place[-1] < 1


@given(end_systole=st.floats(0.3, 0.42))
def test_end_systole_falls_where_it_is_wanted(end_systole):
    assert nominal_phase(end_systole, end_systole) == pytest.approx(0.36, abs=1e-12)
    places = [nominal_phase(p, end_systole) for p in np.linspace(0, 0.999, 50)]
    assert (np.diff(places) > 0).all()


@pytest.mark.parametrize("phase", PHASES)
def test_nothing_folds(heart, phase):
    points, _ = points_in(heart)
    assert jacobians(heart, points, phase).min() > 0.05


@pytest.mark.parametrize("phase", PHASES)
def test_muscle_of_the_left_ventricle_keeps_its_volume(heart, phase):
    """Exact but near the valve plane and the tip of the apex, where the contraction fades."""
    points, labels = points_in(heart)
    muscle = points[labels == Tissue.LV_MYOCARDIUM]
    height = heart.into_heart(muscle)[:, 2]
    # Between the fading at the base (14 mm) and the rounded knots at the apex (15 mm).
    middle = (height < -14.5) & (height > 15 - heart.shape.lv_length)
    volume = jacobians(heart, muscle, phase)
    side = heart.into_heart(heart.carry(muscle, phase))[:, 0]
    # Beyond x = 26 mm the right side's larger descent begins and shears the outer septum.
    np.testing.assert_allclose(volume[middle & (side < 26)], 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(volume.mean(), 1.0, rtol=0, atol=0.02)


def test_base_descends_while_apex_and_roof_stay(heart):
    length = heart.shape.lv_length
    axis = np.array([[0, 0, 0.0], [0, 0, -length], [0, 0, 62.0]])
    reference = heart.into_patient(axis)
    moved = heart.carry(reference, heart.pulse.end_systole) - reference
    base, apex, roof = moved @ heart.long_axis
    assert base == pytest.approx(-heart.pulse.descent_lv, rel=0.15)
    assert abs(apex) < 0.15 * heart.pulse.descent_lv
    assert abs(roof) < 0.5


def test_apex_and_base_twist_against_each_other(heart):
    phase = 0.34 / 0.36 * heart.pulse.end_systole
    z = np.array([-0.85, -0.12]) * heart.shape.lv_length
    ring = np.stack([np.zeros(2), np.full(2, 12.0), z], axis=1)
    moved = heart.into_heart(heart.carry(heart.into_patient(ring), phase))
    # Both points started on the anterior wall. Seen from the apex, the right ventricle to the left,
    # the apex turns counter-clockwise in systole: its anterior wall towards the right ventricle.
    apex, base = np.arctan2(moved[:, 0], moved[:, 1])
    assert apex > 0.08
    assert base < 0
