"""The potential of a fixture and the force it exerts: the formulas, once.

Plain NumPy on numbers or arrays. The compiled kernels use these same functions, which is why
``side`` is a whole number: 0 for guidance, +1 where the outside of the surface is forbidden,
-1 where the inside is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# A number or an array of them: NumPy and numba both evaluate the formulas below.
Numbers = Any

MEDIAL_GRADIENT = 0.5
"""Below this length of the distance's gradient the direction fades to zero."""


def offence(distance_mm: Numbers, side: int) -> Numbers:
    """How far the tool is from where it may be, mm: the ``q`` of the potential.

    Guidance counts the distance to the surface; a forbidden region the depth past it.
    """
    if side == 0:
        return np.abs(distance_mm)
    return np.maximum(side * distance_mm, 0.0)


def potential(q_mm: Numbers, delta_mm: float, m: int) -> Numbers:
    """Potential ``f(q) = 1 - exp(-(q^2 / (2 delta^2))^m)``, from 0 on; rounded, it is 1 far off.

    >>> float(round(potential(3.0, delta_mm=6.7, m=2), 4))
    0.01
    """
    return -np.expm1(-((q_mm * q_mm / (2.0 * delta_mm * delta_mm)) ** m))


def pull(distance_mm: Numbers, side: int, delta_mm: float, m: int) -> Numbers:
    """Potential with the sign that turns the distance's gradient into the direction of rise.

    The force is ``-f_max * pull * direction(gradient of the distance)``.
    """
    height = potential(offence(distance_mm, side), delta_mm, m)
    if side == 0:
        return np.sign(distance_mm) * height
    return side * height


def direction_scale(gradient_length: Numbers) -> Numbers:
    """What a distance's gradient is multiplied by to become the direction of the force.

    A unit vector wherever the gradient is at least 0.5 long. On the medial axis, where two
    parts of the surface are equally near and the gradient of the interpolated distance passes
    through zero, the direction is twice the gradient, so that the force passes through zero
    instead of flipping.
    """
    return 1.0 / np.maximum(gradient_length, MEDIAL_GRADIENT)
