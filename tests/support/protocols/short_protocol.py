"""A protocol of a few minutes for the simulated rig: a checklist, a capture, a step to skip, a step to sign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tests.support.rig.rig import REPOSITORY, without_calibration_and_ct


def short_protocol(folder: Path, *, views: int = 5, release: bool = False) -> Path:
    """Write the protocol into a folder of protocols."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    steps: dict[str, dict[str, Any]] = {step["id"]: step for step in protocol["steps"]}
    capture = steps["viewpoint_capture_1"]
    capture["params"]["viewpoints"][0]["arcs"] = [
        {"tilt_deg": 25, "azimuth_from_deg": -40, "azimuth_to_deg": 40, "count": views, "distance_m": 0.62}
    ]
    capture["gates"][0]["min"] = views
    without_calibration_and_ct(capture)
    capture["simulated_hands"] = [{"action": "mount_camera"}]
    extra = {
        "id": "photographs",
        "kind": "checklist",
        "title": "Photograph the set-up",
        "checklist": ["An overview photograph is taken"],
        "gates": [{"measure": "checklist_items_open", "max": 0, "unit": "items"}],
        "skippable": True,
    }
    removal = {**steps["control_sphere_removal"], "requires": ["viewpoint_capture_1"]}
    protocol |= {"id": "short", "title": "A short protocol", "release": "second_person" if release else "none"}
    protocol["steps"] = [steps["fixation"], capture, extra, removal]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump(protocol, sort_keys=False))
    return path
