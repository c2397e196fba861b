"""Units are converted in one place, and exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.core.units import deg, metres, mm, mrad, rad_of_mrad


@pytest.mark.parametrize(("given_mm", "given_m"), [(15, 0.015), (30, 0.03), (0.7, 0.0007), (-1.1, -0.0011)])
def test_millimetres_as_written_become_the_same_decimal_in_metres(given_mm: float, given_m: float) -> None:
    assert metres(given_mm) == given_m


@given(st.floats(-1e3, 1e3))
def test_there_and_back(value: float) -> None:
    assert metres(mm(value)) == pytest.approx(value, rel=1e-15)
    assert rad_of_mrad(mrad(value)) == pytest.approx(value, rel=1e-15)
    assert math.radians(deg(value)) == pytest.approx(value, rel=1e-15)


def test_arrays_keep_their_shape() -> None:
    points_m = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(mm(points_m), 1000 * points_m)
    np.testing.assert_allclose(metres(mm(points_m)), points_m, rtol=1e-15)
