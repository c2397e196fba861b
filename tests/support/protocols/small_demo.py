"""The demonstration with the arm's poses alone and three views at each station, for whole runs with other devices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tests.support.rig.rig import REPOSITORY

SLICE_MM = 1.5  # of the CT, which a simulator makes in seconds
COARSE = ("--ct-voxel-mm", str(SLICE_MM), "--scan-spacing-mm", "1.0")  # of a simulated rig: fewer voxels and faces
VIEWS = 6  # at both stations
_BOARD_IMAGES = (2, 4, 5)  # by arc
_CONTROL_VIEWS = 2  # at each station
_NEEDS_TIME = ("ground_truth", "specimen_release", "layout_check")
# Gates of those steps that few pixels and coarse voxels do not meet.
_LOOSE_MM = {"sphere_distance_change_max_mm": 3.0, "loop_closure_mm": 3.0}
_ARC = {"tilt_deg": 28, "azimuth_from_deg": -50, "azimuth_to_deg": 50, "count": VIEWS // 2, "distance_m": 0.66}


def small_demo(path: Path, *registration_gates: dict[str, Any], raw: bool = False, every_step: bool = False) -> Path:
    """Write the protocol to a file; the registration is also judged by these gates.

    `raw`: the cameras write raw files as well, in which the outlines are measured. `every_step`: with the steps that
    need much time as well.
    """
    document = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text(encoding="utf-8"))
    steps = [step for step in document["steps"] if every_step or step["id"] not in _NEEDS_TIME]
    if raw:
        document["camera"]["image_quality"] = "RAW+JPEG"
    for step in steps:
        for gate in step.get("gates", []):
            if gate["measure"] == "slice_spacing_mm":
                gate["max"] = SLICE_MM
            if gate["measure"] == "specimen_coverage":
                gate["min"] = 0.3
            if gate["measure"] in _LOOSE_MM:
                gate["max"] = _LOOSE_MM[gate["measure"]]
        if step["id"].startswith("viewpoint_capture"):
            step["params"]["viewpoints"][0]["arcs"] = [_ARC]
            step["gates"][0]["min"] = VIEWS // 2
        if step["id"].startswith("control_capture"):
            step["params"]["viewpoints"][0]["arcs"][0]["count"] = _CONTROL_VIEWS
            step["gates"][0]["min"] = _CONTROL_VIEWS
        if step["id"] == "camera_calibration":
            for arc, count in zip(step["params"]["viewpoints"][0]["arcs"], _BOARD_IMAGES, strict=True):
                arc["count"] = count
        if step["id"] == "registration":
            step["params"]["poses"] = ["robot", "robot_corrected"]
            step["gates"] += registration_gates
            if raw:
                step["params"]["measure_on"] = "raw"
    path.write_text(yaml.safe_dump({**document, "steps": steps}, sort_keys=False, allow_unicode=True), "utf-8")
    return path
