"""A whole small run on the simulated turntable: it takes the place of the arm, from doctor to the last photograph."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from service.core.geometry import inverse, rotation_angle_rad
from service.core.records.run_events import ViewpointCaptured
from service.store.store import Store
from tests.support.arms.grbl_simulator import CENTRE_M, TURN, mount, table
from tests.support.rig.patience import PATIENT_GRBL
from tests.support.rig.rig import orthocapture, simulated_rig

pytestmark = [pytest.mark.timeout(400)]
VIEWS = 3
PROTOCOL: dict[str, Any] = {
    "id": "turntable",
    "version": "1.0.0",
    "title": "Photographs around a turntable",
    "spheres": {"radius_mm": 15, "registration": 10, "control": 3},
    "camera": {
        "aperture_f": 22, "exposure_s": "1/15", "iso": 100, "focus_mode": "Manual", "image_quality": "JPEG",
    },
    "motion": {"speed_rad_s": 1.0, "acceleration_rad_s2": 1.5, "dwell_s": 0.0},
    "settle": {"window_s": 0.3, "timeout_s": 60},
    "steps": [
        {
            "id": "around",
            "kind": "viewpoint_capture",
            "title": "Photographs from all sides",
            "instructions": "The table turns. Confirm to let it move.",
            "params": {
                "purpose": "dataset",
                "viewpoints": [
                    {
                        "station": "table",
                        "prefix": "t",
                        "image_top": "up",
                        "arcs": [
                            {
                                "tilt_deg": 35, "azimuth_from_deg": 20, "azimuth_to_deg": 320,
                                "count": VIEWS, "distance_m": 0.62,
                            }
                        ],
                    }
                ],
            },
            "gates": [
                {"measure": "viewpoints_captured", "min": VIEWS, "unit": "views"},
                {"measure": "moved_during_exposure", "max": 0, "unit": "images"},
            ],
            "recovery": {"retries": 1},
        }
    ],
}  # fmt: skip


def rig_with_table(simulated: str, port: Path) -> dict[str, Any]:
    """The simulated rig with the turntable in the place of its arm."""
    rig = yaml.safe_load(Path(simulated).read_text(encoding="utf-8"))
    axis = TURN.model_dump(mode="json", exclude_none=True)
    rig["devices"]["turntable"] = {
        "driver": "grbl", "port": str(port), "axes": [axis], "T_base_flange_zero": mount().tolist(),
        **PATIENT_GRBL,
    }  # fmt: skip
    rig["stations"] = {
        "table": {"robot": "turntable", "scene_centre_m": CENTRE_M.tolist(), "approach_azimuth_deg": -90.0}
    }
    rig["T_flange_camera_nominal"] = np.eye(4).tolist()
    return rig


@pytest.mark.slow
@pytest.mark.whole
def test_a_run_with_the_turntable_instead_of_the_arm(tmp_path: Path) -> None:
    folder, data, protocol = tmp_path / "rig", tmp_path / "data", tmp_path / "turntable.yaml"
    folder.mkdir()
    protocol.write_text(yaml.safe_dump(PROTOCOL), encoding="utf-8")
    with (
        simulated_rig(folder, "--scene", "3", "--image-width", "320", "--hand", "steady", host="127.0.0.58") as ready,
        table(tmp_path, "--world", ready["world"]) as port,
    ):
        rig = folder / "with_table.yaml"
        rig.write_text(yaml.safe_dump(rig_with_table(ready["rig"], port)), encoding="utf-8")
        doctor = orthocapture("doctor", "--rig", str(rig), "--data", str(data), "--json", timeout_s=120)
        told = json.loads(doctor.stdout)["devices"]["turntable"]
        assert told["problems"] == []
        assert told["details"]["state"] == "Alarm"  # locked, and the doctor unlocks nothing
        done = orthocapture(
            "run",
            str(protocol),
            "--rig",
            str(rig),
            "--data",
            str(data),
            "--auto-confirm",
            "--no-worker",
            timeout_s=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        exposures = [json.loads(row) for row in (folder / "truth_exposures.jsonl").read_text().splitlines()]
    with Store.open(data) as store:
        (run,) = store.runs()
        taken = [e.payload for e in store.events(run.run_id) if isinstance(e.payload, ViewpointCaptured)]
    assert len(taken) == VIEWS
    true = {row["sha256"]: np.array(row["T_world_camera"]) for row in exposures}
    for view in taken:
        gap = inverse(true[view.artefacts[0].sha256]) @ np.array(view.T_base_flange)
        assert np.linalg.norm(gap[:3, 3]) < 0.005  # of the drawing of the mount
        assert rotation_angle_rad(gap) < np.radians(0.8)
