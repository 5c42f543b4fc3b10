"""Distances to the border of a mask are those of another library, to the last bit in every call."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pipeline.imaging.depth import depth_px


@pytest.mark.parametrize("seed", range(8))
def test_distances_are_exact_wherever_arrays_lie_in_memory(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random(tuple(rng.integers(20, 200, 2))) > 0.01
    truth = distance_transform_edt(mask).astype(np.float32)
    held = []
    for size in rng.integers(1, 60_000, 24):
        # What is held moves what is allocated next.
        held.append(np.empty(size, np.uint8))
        np.testing.assert_array_equal(depth_px(mask), truth)


def test_a_mask_without_a_border_is_deeper_than_any_image():
    assert depth_px(np.ones((30, 40), bool)).min() > 1e9
    assert not depth_px(np.zeros((30, 40), bool)).any()
