"""Phases mixed with their neighbours: what is kept and what goes."""

import numpy as np
import pytest

from pipeline.imaging.inference import blend_phases


@pytest.mark.parametrize(("count", "share"), [(25, 0.25), (8, 0.1), (3, 0.2), (2, 0.25)])
def test_blending_is_the_cyclic_low_pass_that_its_formula_says(count, share):
    value = np.random.default_rng(1).uniform(0.4, 0.6, (count, 2, 7, 1, 3)).astype(np.float32)
    mean = 1 - 2 * share + 2 * share * np.cos(2 * np.pi * np.fft.fftfreq(count))
    kept = (2 * mean - mean**2)[:, None, None, None, None]
    expected = np.fft.ifft(kept * np.fft.fft(value, axis=0), axis=0).real
    blend_phases(value, share)
    np.testing.assert_allclose(value, expected, atol=1e-6)


def test_blending_leaves_the_turn_at_end_systole_where_it_is():
    """A border that comes in, turns and goes out as a parabola, and a pixel that flickers."""
    time = np.arange(12.0)
    value = np.zeros((12, 1, 2, 1, 1), np.float32)
    value[:, 0, 0, 0, 0], value[:, 0, 1, 0, 0] = (
        0.2 + 0.02 * (time - 5) ** 2,
        0.5 + 0.1 * (-1) ** time,
    )
    parabola = value[2:10, 0, 0].copy()
    blend_phases(value, 0.25)
    np.testing.assert_allclose(value[2:10, 0, 0], parabola, atol=1e-6)
    np.testing.assert_allclose(value[:, 0, 1], 0.5, atol=1e-6)


def test_blending_leaves_no_probability_below_nothing():
    value = np.zeros((6, 1, 1, 1, 1), np.float32)
    value[0] = 1
    blend_phases(value, 0.25)
    np.testing.assert_allclose(value.ravel(), [0.625, 0.25, 0, 0, 0, 0.25], atol=1e-7)
