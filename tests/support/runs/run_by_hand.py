"""A run of the protocol without a robot, shortened, with a simulated hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig


def small_protocol(folder: Path) -> Path:
    """handheld_spine.yaml with fewer images, at the poses that take the least time."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "handheld_spine.yaml").read_text())
    steps: dict[str, Any] = {step["id"]: step for step in protocol["steps"]}
    board, hand = steps["board_capture"], steps["handheld_capture"]
    for ring, count in zip(board["params"]["hemisphere"], (2, 3, 3, 1), strict=True):
        ring["count"] = count
    for ring, count in zip(hand["params"]["hemisphere"], (3, 9), strict=True):
        ring["count"] = count
    board["params"]["min_images"], hand["params"]["min_images"] = 8, 11
    for step, images in ((board, 8), (hand, 11)):
        next(gate for gate in step["gates"] if gate["measure"] == "images_used")["min"] = images
    calibration = steps["camera_calibration"]
    next(gate for gate in calibration["gates"] if gate["measure"] == "views")["min"] = 8
    next(gate for gate in calibration["gates"] if gate["measure"] == "tilt_deg")["min"] = 25
    registration = steps["registration"]["params"]
    registration["poses"] = ["spheres", "colmap"]
    steps["ground_truth"]["params"]["chamfer_spacing_mm"] = 1.0
    registration["structure_from_motion"] = {"max_image_size": 1600, "max_features": 1500, "neighbours": 8}
    path = folder / "handheld_small.yaml"
    path.write_text(yaml.safe_dump(protocol, sort_keys=False))
    return path


def run_by_hand(folder: Path, protocol: Path, *options: str, host: str) -> dict[str, Any]:
    """Run a protocol to its end on a rig simulated with these options; its summary, data folder and output."""
    always = ("--image-width", "1024", "--ct-voxel-mm", "1.0", "--hand", "usual")
    with simulated_rig(folder, *always, *options, host=host) as rig:
        assert "robot" not in Path(rig["rig"]).read_text()
        answer = orthocapture(
            "run", str(protocol), "--rig", rig["rig"], "--data", str(folder / "data"),
            "--operator", "Ada", "--auto-confirm", "--json", timeout_s=840,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-3000:] + answer.stderr[-3000:]
    return {"data": str(folder / "data"), "told": answer.stderr, **json.loads(answer.stdout.splitlines()[-1])}
