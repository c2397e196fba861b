"""The Measures of a step kind: what gates can name is what a step can yield, and nothing else."""

from __future__ import annotations

from typing import Annotated

import pytest

from service.core.errors import DataError
from service.steps.measures import Count, Measure, MeasureRecord, Px, RegistrationMeasures


class One(MeasureRecord):
    """Of one registration."""

    rms_px: Annotated[Px, "rms error"] = None


class Measured(RegistrationMeasures[One]):
    """Of a step that registers."""

    outlines: Annotated[Count, "outlines found"] = None
    weight_g: Annotated[float | None, Measure("g", 1, 10), "weight"] = None


def test_a_declaration_has_unit_limits_and_meaning() -> None:
    assert Measured.declared_for(["colmap", "robot"]) == {
        "outlines": Measure("", 0, 1e6, "outlines found"),
        "weight_g": Measure("g", 1, 10, "weight"),
        "colmap_rms_px": Measure("px", 1e-3, 50, "rms error"),
        "robot_rms_px": Measure("px", 1e-3, 50, "rms error"),
    }


def test_numbers_are_recorded_under_the_names_that_gates_use() -> None:
    recorded = {"outlines": 40.0, "robot_rms_px": 0.25, "robot_corrected_rms_px": 0.125}
    measures = Measured.read_all(recorded, ["robot", "robot_corrected", "colmap"])
    assert measures.registrations["robot_corrected"].rms_px == 0.125
    assert measures.plain() == recorded


def test_what_was_not_measured_is_not_recorded() -> None:
    assert Measured(weight_g=2).plain() == {"weight_g": 2.0}


@pytest.mark.parametrize("name", ["inliers", "glomap_rms_px", "robot_sigma_mm"])
def test_what_is_not_declared_is_refused(name: str) -> None:
    with pytest.raises(DataError, match=f"does not declare: {name}"):
        Measured.read_all({"outlines": 40.0, name: 1.0}, ["robot"])
