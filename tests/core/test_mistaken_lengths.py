"""One list of mistaken units for meshes, lists of spheres and boards: each names any two units that were confused."""

from __future__ import annotations

import numpy as np
import pytest

from service.compute.calibration.hand_eye_uncertainty import BoardSizeFound
from service.compute.registration.identity import words_of_unit
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.units import MISTAKEN_LENGTHS, mistaken_length

SPHERES_M = np.random.default_rng(2).uniform(-0.2, 0.2, (10, 3))


def test_every_two_units_can_be_confused() -> None:
    assert len(MISTAKEN_LENGTHS) == 12
    assert MISTAKEN_LENGTHS["inches taken as millimetres"] == pytest.approx(25.4)
    assert MISTAKEN_LENGTHS["millimetres taken as metres"] == pytest.approx(0.001)
    assert mistaken_length(1.0, 0.2) == ""


@pytest.mark.parametrize("words", MISTAKEN_LENGTHS)
def test_a_mistaken_unit_is_named_by_boards_lists_and_constellations(words: str) -> None:
    factor = MISTAKEN_LENGTHS[words]
    assert mistaken_length(1.01 * factor, 0.02) == words
    assert words in words_of_unit(1.01 * factor)
    with pytest.raises(ComputeError, match=words):
        BoardSizeFound(factor, 1e-4 * factor, 0.002, 1.0, 0.015).require_credible()
    with pytest.raises(ComputeError, match=rf"\({words}\), 10 do"):
        match_constellations(SPHERES_M, SPHERES_M / factor)
