"""A protocol with a part of its viewpoints and every kind of step: for sizes at which the whole would take hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

_COUNTED = ("views", "viewpoints_captured")


def shortened(protocol: Path, divisor: int, into: Path) -> Path:
    """Write the protocol with one viewpoint of `divisor`, and with the gates that count views lowered alike."""
    document: dict[str, Any] = yaml.safe_load(protocol.read_text(encoding="utf-8"))
    for step in document["steps"]:
        taken = 0
        for viewpoint_set in step.get("params", {}).get("viewpoints", []):
            for arc in viewpoint_set["arcs"]:
                arc["count"] = max(1, round(arc["count"] / divisor))
                taken += arc["count"]
        for gate in step.get("gates", []):
            if taken and gate["measure"] in _COUNTED:
                gate["min"] = min(taken, max(1, gate["min"] // divisor))
    document["id"] += "_short"
    document["title"] += f", one viewpoint of {divisor}"
    into.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return into
