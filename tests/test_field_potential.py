"""The potential and the force law: limits, slopes, sides."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.field.potential import direction_scale, offence, potential, pull

GUIDANCE, OUTSIDE, INSIDE = 0, 1, -1
DELTA_MM = 6.0


@given(st.floats(0, 100), st.integers(1, 6))
def test_potential_is_one_minus_a_gaussian_of_any_sharpness(q, m):
    # The plain formula loses what is below the last bit of 1.
    plain = 1 - np.exp(-((q**2 / (2 * DELTA_MM**2)) ** m))

    assert potential(q, DELTA_MM, m) == pytest.approx(plain, abs=1e-15)
    assert 0 <= potential(q, DELTA_MM, m) <= 1


@pytest.mark.parametrize("m", [1, 2, 3])
def test_potential_rises_from_nothing_to_all(m):
    heights = potential(np.linspace(0, 12 * DELTA_MM, 500), DELTA_MM, m)

    assert heights[0] == 0
    assert (np.diff(heights) >= 0).all()
    assert heights[-1] == pytest.approx(1, abs=1e-15)


def test_sides_of_a_surface():
    distance = np.array([-2.0, 0.0, 3.0])

    np.testing.assert_array_equal(offence(distance, GUIDANCE), [2, 0, 3])
    np.testing.assert_array_equal(offence(distance, OUTSIDE), [0, 0, 3])
    np.testing.assert_array_equal(offence(distance, INSIDE), [2, 0, 0])


@pytest.mark.parametrize("side", [GUIDANCE, OUTSIDE, INSIDE])
@pytest.mark.parametrize("m", [1, 2])
def test_pull_rises_where_the_potential_does(side, m):
    """Its sign is that of the potential's slope over the distance, and its size the potential."""
    distance, step = np.linspace(-15, 15, 301), 1e-4

    def height(at):
        return potential(offence(at, side), DELTA_MM, m)

    slope = height(distance + step) - height(distance - step)
    found = pull(distance, side, DELTA_MM, m)

    np.testing.assert_array_equal(np.abs(found), height(distance))
    clear = (np.abs(slope) > 1e-12) & (np.abs(distance) > step)
    assert (np.sign(found) == np.sign(slope))[clear].all()


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_direction_is_a_unit_vector_or_fades(gradient):
    length = float(np.linalg.norm(gradient))

    scaled = length * direction_scale(length)

    assert scaled == pytest.approx(min(1.0, 2 * length), abs=1e-15)
