"""Masks become one piece without holes or tunnels, and good masks stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from skimage.measure import euler_number

from pipeline.surface.solid import closed, filled, largest_piece, one_piece


def coordinates(half: int = 16):
    z, y, x = np.indices((2 * half + 1,) * 3) - half
    return x, y, z


def test_a_ball_is_left_alone():
    x, y, z = coordinates()
    ball = x**2 + y**2 + z**2 < 64
    np.testing.assert_array_equal(one_piece(ball), ball)


def test_specks_and_holes_go():
    x, y, z = coordinates()
    ball = x**2 + y**2 + z**2 < 64
    spoiled = ball.copy()
    spoiled[16, 16, 16:18] = False
    spoiled[2:4, 2:4, 2:4] = True
    np.testing.assert_array_equal(one_piece(spoiled), ball)


@pytest.mark.parametrize("width", [0.5, 1.5, 2.5])
def test_a_bored_tunnel_is_plugged_and_little_else(width):
    """The Euler number of one solid without tunnels is 1; the plug lies within the bore."""
    x, y, z = coordinates()
    ball = x**2 + y**2 + z**2 < 81
    bored = ball & (x**2 + y**2 > width**2)
    assert euler_number(bored) == 0

    mended = one_piece(bored)

    assert euler_number(mended) == 1
    added = mended & ~bored
    # A closing by a ball rounds the mouth of the bore within its reach of 4 voxels.
    assert (np.hypot(x, y)[added] <= width + 4).all()
    assert (mended & bored == bored).all()


def test_a_ring_too_wide_for_any_plug_stays_a_ring():
    """Nothing is filled that a ball of the largest reach does not fill."""
    x, y, z = coordinates()
    ring = (np.hypot(x, y) - 11) ** 2 + z**2 < 6
    np.testing.assert_array_equal(one_piece(ring), ring)


def test_closing_agrees_with_scipy():
    """Same voxels as grey-box morphology with a ball as structuring element."""
    x, y, z = coordinates(12)
    two = ((x - 5) ** 2 + y**2 + z**2 < 20) | ((x + 5) ** 2 + y**2 + z**2 < 20)
    reach = 3
    offset = np.indices((2 * reach + 1,) * 3) - reach
    element = (offset**2).sum(axis=0) <= reach**2
    np.testing.assert_array_equal(closed(two, reach), ndimage.binary_closing(two, element))


def test_the_larger_of_two_pieces_stays():
    row = np.array([[[0, 1, 0, 1, 1, 0]]], dtype=bool)
    np.testing.assert_array_equal(largest_piece(row), [[[0, 0, 0, 1, 1, 0]]])


def test_filling_keeps_what_is_open_to_the_outside():
    block = np.ones((5, 5, 5), dtype=bool)
    block[2, 2, 2:] = False
    padded = np.pad(block, 1)
    np.testing.assert_array_equal(filled(padded), padded)
