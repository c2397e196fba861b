"""Shortens a protocol to a part of its views, with every kind of step, where the whole would take hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

_COUNTED = ("views", "viewpoints_captured")
#: Least number of board images of a calibration, by what it solves: with fewer the gates cannot pass.
_FEWEST = {"intrinsics": 15, "hand_eye": 12}


def shortened(
    protocol: Path,
    divisor: int,
    into: Path,
    *,
    slice_mm: float | None = None,
    settle_s: float | None = None,
    chamfer_spacing_mm: float | None = None,
) -> Path:
    """Write the protocol with one view in `divisor`, and with the gates that count views lowered accordingly.

    Board images are reduced too, but never below what the calibration of lens and hand-eye needs to pass its gates.

    Args:
        slice_mm: CT slice thickness that its gate shall accept, so that a coarse simulated CT, which takes seconds,
            can be imported; None: as in the protocol.
        settle_s: settling time of the coating; None: as in the protocol.
        chamfer_spacing_mm: distance between the samples of CT and scan that are compared; None: as in the protocol.
    """
    document: dict[str, Any] = yaml.safe_load(protocol.read_text(encoding="utf-8"))
    for step in document["steps"]:
        planned, taken = _shorten_views(step.get("params", {}), divisor)
        for gate in step.get("gates", []):
            if planned and gate["measure"] in _COUNTED:
                gate["min"] = max(1, gate["min"] * taken // planned)
            if slice_mm is not None and gate["measure"] == "slice_spacing_mm":
                gate["max"] = slice_mm
        for name, value in (("settle_s", settle_s), ("chamfer_spacing_mm", chamfer_spacing_mm)):
            if value is not None and name in step.get("params", {}):
                step["params"][name] = value
    document["id"] += "_short"
    document["title"] += f", one view of {divisor}"
    into.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return into


def _shorten_views(params: dict[str, Any], divisor: int) -> tuple[int, int]:
    """Reduce a step's views in place; returns the old and the new number."""
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
