"""Eq. (1) and (2), gamma and delta: checked by arithmetic that shares nothing with the code."""

from __future__ import annotations

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.evaluation.dissection import guidance, keep_out, stored_energy_mj
from pipeline.evaluation.dissection_values import ENERGY_STEP_MM
from pipeline.field.fixture import DEVICES, Fixture, delta_from_gamma, steepest_slope
from pipeline.field.potential import potential
from pipeline.paper.laws import POWERS, smallest_delta_mm

DIGITS = 60


def exact_potential(q: Decimal, delta: Decimal, m: int) -> Decimal:
    """Eq. (1) in 60 digits."""
    return 1 - (-((q * q / (2 * delta * delta)) ** m)).exp()


def exact_slope(q: Decimal, delta: Decimal, m: int) -> Decimal:
    """The derivative of Eq. (1), by differentiating its power series term by term.

    f = -sum over k >= 1 of (-1)^k u^k / k! with u = c q^(2m), c = (2 delta^2)^-m; hence
    f' = -sum of (-1)^k c^k 2 m k q^(2mk - 1) / k!. The terms fall once k exceeds u.
    """
    c = (1 / (2 * delta * delta)) ** m
    total, term = Decimal(0), Decimal(1)
    for k in range(1, 400):
        term = term * -c * q ** (2 * m) / k
        total -= term * 2 * m * k / q
    return total


@pytest.fixture(autouse=True)
def many_digits():
    before = getcontext().prec
    getcontext().prec = DIGITS
    yield
    getcontext().prec = before


@pytest.mark.parametrize("m", POWERS)
def test_potential_is_the_formula_of_the_paper(m):
    for q in ("0.013", "1.7", "5", "7.07", "9.9"):
        expected = float(exact_potential(Decimal(q), Decimal(5), m))
        # One rounding of the power 2m and of expm1: some 2m units in the last place.
        assert potential(float(q), 5.0, m) == pytest.approx(expected, rel=1e-14 * 4 * m)


@pytest.mark.parametrize("m", POWERS)
def test_steepest_slope_is_where_the_series_says(m):
    """The closed form is the largest of the exact derivative, found by golden section."""
    delta = Decimal("3.7")
    low, high = Decimal("0.05"), Decimal("1.6") * delta
    ratio = (Decimal(5).sqrt() - 1) / 2
    for _ in range(90):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        if exact_slope(a, delta, m) < exact_slope(b, delta, m):
            low = a
        else:
            high = b
    largest = float(exact_slope((low + high) / 2, delta, m))
    assert steepest_slope(m) / 3.7 == pytest.approx(largest, rel=1e-12)


@given(gamma=st.floats(0.1, 20), level=st.floats(1e-4, 0.9), m=st.integers(1, 12))
def test_delta_gives_the_level_at_gamma(gamma, level, m):
    delta = delta_from_gamma(gamma, level, m)
    found = float(exact_potential(Decimal(gamma), Decimal(delta), m))
    # delta's rounding of 1e-16 is raised to the power 2m and scaled by at most 10 here.
    assert found == pytest.approx(level, rel=1e-12)


@pytest.mark.parametrize("device", ["touch", "omega7"])
@pytest.mark.parametrize("m", [1, 2, 4])
def test_smallest_delta_is_what_a_fixture_accepts(device, m):
    limit = DEVICES[device]
    assert limit.stiffness_n_per_m is not None
    least = smallest_delta_mm(limit.force_n, m, limit.stiffness_n_per_m)
    kept = {"structure": "heart", "kind": "guidance", "m": m, "f_max_n": limit.force_n}
    Fixture(**kept, device=device, delta_mm=least * 1.001)
    with pytest.raises(ValueError, match="stiffer than"):
        Fixture(**kept, device=device, delta_mm=least * 0.999)


@pytest.mark.parametrize("make", [guidance, keep_out])
@pytest.mark.parametrize("device", ["touch", "omega7"])
def test_stored_energy_is_the_integral_of_the_force(make, device):
    fixture = make("heart", device)
    found = stored_energy_mj(fixture)
    q = ENERGY_STEP_MM * np.arange(0, 1001)
    # Simpson's rule on 1000 steps of h = 0.02 mm: error below 20 h^4 f'''' / 180, and f'''' is
    # below 100 / delta^4 < 10 N/mm^4 for these widths: 2e-7.
    force = fixture.f_max_n * potential(q, fixture.resolved_delta_mm, fixture.m)
    whole = (force[0] + force[-1] + 4 * force[1:-1:2].sum() + 2 * force[2:-1:2].sum()) * (
        ENERGY_STEP_MM / 3
    )
    assert found[1000] == pytest.approx(whole, abs=1e-6)
    assert found[0] == 0
    assert math.isclose(found[-1] - found[-2], fixture.f_max_n * ENERGY_STEP_MM, rel_tol=1e-9)
