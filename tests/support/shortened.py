"""A protocol with a part of its views and every kind of step: for sizes at which the whole would take hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

_COUNTED = ("views", "viewpoints_captured")
#: Board images that a calibration keeps, by what it solves: with fewer the protocol's own gates cannot pass.
_FEWEST = {"intrinsics": 15, "hand_eye": 12}


def shortened(
    protocol: Path, divisor: int, into: Path, *, slice_mm: float | None = None, settle_s: float | None = None
) -> Path:
    """Write the protocol with one view of `divisor`, and with the gates that count views lowered alike.

    Board images are shortened too, but never below what lens and hand-eye need to pass the gates on their figures.

    Args:
        slice_mm: the gate on the CT's slices lets those of this thickness pass, so that a coarse simulated CT, which
            takes seconds, can be imported; None: as the protocol has it.
        settle_s: how long a coat settles; None: as the protocol has it.
    """
    document: dict[str, Any] = yaml.safe_load(protocol.read_text(encoding="utf-8"))
    for step in document["steps"]:
        planned, taken = _shorten_views(step.get("params", {}), divisor)
        for gate in step.get("gates", []):
            if planned and gate["measure"] in _COUNTED:
                gate["min"] = max(1, gate["min"] * taken // planned)
            if slice_mm is not None and gate["measure"] == "slice_spacing_mm":
                gate["max"] = slice_mm
        if settle_s is not None and "settle_s" in step.get("params", {}):
            step["params"]["settle_s"] = settle_s
    document["id"] += "_short"
    document["title"] += f", one view of {divisor}"
    into.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return into


def _shorten_views(params: dict[str, Any], divisor: int) -> tuple[int, int]:
    """Shorten a step's views in place; how many it had and has."""
    planned = taken = 0
    for viewpoint_set in params.get("viewpoints", []):
        for arc in viewpoint_set["arcs"]:
            planned += arc["count"]
            arc["count"] = max(1, round(arc["count"] / divisor))
            taken += arc["count"]
    board = params.get("board_poses")
    if board is not None:
        fewest = max(_FEWEST[what] for what in params["solve"])
        planned += board["count"]
        board["count"] = min(board["count"], max(fewest, round(board["count"] / divisor)))
        taken += board["count"]
    return planned, taken
