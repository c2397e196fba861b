"""Which scan a run's data set rests on: one rule for pages, report, audit and exports."""

from __future__ import annotations

from service.core.protocol.models import Protocol
from service.core.run.state import RunState


def registered_scan(protocol: Protocol, state: RunState) -> str:
    """The step whose scan the last registration used; before there is one, the last scan; "" without any."""
    scans = [step.id for step in reversed(protocol.steps) if step.gives == "scan_surface"]
    for step in reversed(protocol.steps):
        if step.gives == "registrations" and state.steps[step.id].result:
            named = str(step.params.model_dump().get("scan") or "")
            return named if named in scans else ""
    return next((step for step in scans if state.steps[step].result), "")


def control_scan(protocol: Protocol) -> str:
    """The step whose scan still shows the control spheres, as the last evaluation names it; "" without any."""
    judged = next((step for step in reversed(protocol.steps) if step.gives == "accuracy"), None)
    return "" if judged is None else str(judged.params.model_dump().get("control_scan") or "")
