"""The demonstration from one side and without a CT, from the calibration to the evaluation, with few photographs."""

from __future__ import annotations

from typing import Any

import yaml

from tests.support.rig.rig import REPOSITORY, without_calibration_and_ct

VIEWS = 3  # of the data set, and as many of the control spheres
_STEPS = (
    "camera_set_up", "camera_calibration", "board_removal", "viewpoint_capture_1", "control_capture_1",
    "control_scan", "control_sphere_removal", "scanning", "registration", "evaluation",
)  # fmt: skip
_ARC = {"tilt_deg": 28, "azimuth_from_deg": -50, "azimuth_to_deg": 50, "count": VIEWS, "distance_m": 0.66}
_OF_OTHER_STEPS = ("sphere_change_max_mm", "since_application_min")  # gates: of the CT, of the spray


def one_side(poses: str) -> dict[str, Any]:
    """The protocol, whose registration takes the poses of the camera from this source."""
    document = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text(encoding="utf-8"))
    by_id = {step["id"]: step for step in document["steps"] if step["id"] in _STEPS}
    for name in ("viewpoint_capture_1", "control_capture_1"):
        without_calibration_and_ct(by_id[name])
        by_id[name]["params"]["viewpoints"][0]["arcs"] = [_ARC]
        by_id[name]["gates"][0]["min"] = VIEWS
    for name, compared in (("control_scan", None), ("scanning", "control_scan")):
        params = {"spheres": by_id[name]["params"]["spheres"], "wait_s": 600}
        by_id[name]["params"] = params if compared is None else {**params, "compare_with": compared}
        by_id[name]["gates"] = [one for one in by_id[name]["gates"] if one["measure"] not in _OF_OTHER_STEPS]
    by_id["control_sphere_removal"]["requires"] = ["control_capture_1", "control_scan"]
    images = {"images_of": ["viewpoint_capture_1"], "control_images_of": ["control_capture_1"]}
    solved = {"calibration": "camera_calibration", "scan": "scanning", "poses": [poses]}
    if poses != "spheres":
        solved["hand_eye"] = "camera_calibration"
    by_id["registration"]["params"] = images | solved
    by_id["registration"]["gates"] = [
        {"measure": f"{poses}_markers", "min": 10, "unit": "spheres"},
        {"measure": f"{poses}_rms_px", "max": 1.0, "unit": "px"},
    ]
    by_id["evaluation"]["params"] = {
        "registration": "registration", "images_of": ["control_capture_1"], "scan": "scanning",
        "control_scan": "control_scan",
    }  # fmt: skip
    return {**document, "steps": [by_id[name] for name in _STEPS]}
