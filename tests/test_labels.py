"""The most probable class is the one that NumPy finds."""

import numpy as np
import pytest

from pipeline.imaging.labels import most_probable


@pytest.mark.parametrize(("shape", "axis"), [((3, 7, 8, 9), 1), ((7, 8, 9), 0), ((0, 7, 4, 4), 1)])
def test_the_first_of_equal_ones_is_taken(shape, axis):
    # Eleven values for seven classes: most pixels have equal ones.
    chance = np.random.default_rng(0).integers(0, 11, shape).astype(np.float32) / 10
    found = most_probable(chance, axis)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, chance.argmax(axis=axis))
