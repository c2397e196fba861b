"""Units are converted in one place, and exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.core.units import (
    deg,
    gigabytes,
    megabytes,
    megapixels,
    metres,
    metres_of_um,
    mm,
    mrad,
    ms,
    rad_of_mrad,
    seconds_of_ns,
    seconds_of_us,
    um,
)


@pytest.mark.parametrize(("given_mm", "given_m"), [(15, 0.015), (30, 0.03), (0.7, 0.0007), (-1.1, -0.0011)])
def test_millimetres_as_written_become_the_same_decimal_in_metres(given_mm: float, given_m: float) -> None:
    assert metres(given_mm) == given_m


@settings(deadline=None)  # a busy machine is no failure
@given(st.floats(-1e3, 1e3))
def test_there_and_back(value: float) -> None:
    assert metres(mm(value)) == pytest.approx(value, rel=1e-15)
    assert rad_of_mrad(mrad(value)) == pytest.approx(value, rel=1e-15)
    assert math.radians(deg(value)) == pytest.approx(value, rel=1e-15)
    assert metres_of_um(um(value)) == pytest.approx(value, rel=1e-15)


def test_arrays_keep_their_shape() -> None:
    points_m = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(mm(points_m), 1000 * points_m)
    np.testing.assert_allclose(metres(mm(points_m)), points_m, rtol=1e-15)


def test_durations_and_sizes() -> None:
    assert ms(0.25) == 250
    assert (seconds_of_us(1_500_000), seconds_of_ns(1_500_000_000)) == (1.5, 1.5)
    assert (megabytes(2_500_000), gigabytes(2_500_000_000)) == (2.5, 2.5)
    assert megapixels(9504, 6336) == 60.217344
