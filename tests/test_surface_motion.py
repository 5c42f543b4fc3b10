"""Vertices between phases: exact at the phases, smooth over the seam, true for slow motion."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry import Float, MovingSurface
from pipeline.surface.motion import positions_at

TRIANGLES = np.array([[0, 1, 2]])


def wave(phases: Float, harmonic: int = 1) -> Float:
    """Three vertices ``(phase, 3, 3)`` that go round with different sizes and delays."""
    angle = 2 * np.pi * harmonic * phases[:, None, None]
    size, delay = np.arange(9).reshape(3, 3) + 1, np.linspace(0, 3, 9).reshape(3, 3)
    return np.asarray(size * np.cos(angle - delay))


def moving(phases: Float, harmonic: int = 1) -> MovingSurface:
    return MovingSurface(wave(phases, harmonic), TRIANGLES, phases)


UNEVEN = np.array([0.02, 0.1, 0.16, 0.3, 0.33, 0.5, 0.62, 0.8, 0.95])


@pytest.mark.parametrize("phases", [np.arange(25) / 25, UNEVEN, UNEVEN[:5], UNEVEN[:2]])
def test_stored_phases_are_met_whatever_the_beat(phases):
    one = moving(phases)
    for beat in (-1, 0, 3):
        np.testing.assert_allclose(positions_at(one, phases + beat), one.vertices_mm, atol=1e-9)


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_a_harmonic_is_followed_to_the_error_of_a_quintic_spline(harmonic):
    """A periodic spline of degree 5 misses a harmonic by (B_6(x) - B_6(0)) (2 pi h step)^6 / 6!.

    That is to leading order in the step; B_6 is 1/42 at the ends and -31/1344 in the middle, 3/64
    apart. Twice that allows for the higher orders.
    """
    step = 1 / 25
    between = np.linspace(0, 1, 173)
    found = positions_at(moving(np.arange(25) / 25, harmonic), between)
    bound = 2 * 3 / 64 * (2 * np.pi * harmonic * step) ** 6 / 720
    error = np.abs(found - wave(between, harmonic)) / (np.arange(9).reshape(3, 3) + 1)
    assert error.max() < bound


def test_velocity_and_acceleration_do_not_step_over_the_seam():
    """Differences of the same size on both sides of the end of the beat."""
    one = moving(UNEVEN)
    eps = 1e-4
    edge = UNEVEN[0] + np.array([-2, -1, 0, 1, 2]) * eps
    places = positions_at(one, edge)
    slopes = np.diff(places, axis=0) / eps
    bends = np.diff(slopes, axis=0) / eps
    largest_bend = (2 * np.pi) ** 2 * 9
    assert np.abs(np.diff(slopes, axis=0)).max() < 2 * largest_bend * eps
    # A step in acceleration would not shrink with eps; (2 pi)^3 9 eps does.
    assert np.abs(np.diff(bends, axis=0)).max() < 4 * 2 * np.pi * largest_bend * eps


def test_one_phase_is_a_still_heart():
    one = moving(np.array([0.3]))
    found = positions_at(one, np.array([0.0, 0.9]))
    np.testing.assert_array_equal(found, np.repeat(one.vertices_mm, 2, axis=0))
