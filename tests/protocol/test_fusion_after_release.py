"""Nobody waits for the fusion before the specimen is freed; what it checks of the transport is known by then."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.core.protocol import load_protocol
from service.steps import params_models

PROTOCOLS = Path(__file__).parents[2] / "protocols"


@pytest.mark.parametrize("name", ["exvivo_spine", "handheld_spine"])
def test_the_specimen_is_freed_before_the_fusion_and_after_the_scans_were_compared_with_the_ct(name: str) -> None:
    protocol = load_protocol(PROTOCOLS / f"{name}.yaml", params_models()).protocol
    order = protocol.step_ids
    freed = order.index("specimen_release")
    assert order.index("evaluation") < freed < order.index("ground_truth")
    for step, earlier in (("control_scan", "ct_import"), ("scanning", "control_scan")):
        assert order.index(step) < freed
        assert getattr(protocol.step(step).params, "compare_with", None) == earlier
        assert any(gate.measure == "sphere_change_max_mm" for gate in protocol.step(step).gates)
