"""The protocol without a robot as its user runs it: a simulated hand follows the words to a registered data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
WIDTH = "1024"


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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One run, shared by the tests of this file."""
    folder = tmp_path_factory.mktemp("handheld")
    options = ("--scene", "7", "--image-width", WIDTH, "--ct-voxel-mm", "1.0", "--hand", "usual")
    with simulated_rig(folder, *options, host="127.0.0.9") as rig:
        assert "robot" not in Path(rig["rig"]).read_text()
        answer = orthocapture(
            "run", str(small_protocol(folder)), "--rig", rig["rig"], "--data", str(folder / "data"),
            "--operator", "Ada", "--auto-confirm", "--json", timeout_s=840,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-3000:] + answer.stderr[-3000:]
    return {"data": str(folder / "data"), "told": answer.stderr, **json.loads(answer.stdout.splitlines()[-1])}


def test_the_hand_covers_the_hemisphere_in_spite_of_its_mistakes(run: dict[str, Any]) -> None:
    measures = run["steps"]["handheld_capture"]["measures"]
    assert measures["hemisphere_coverage"] >= 0.9
    assert measures["predicted_target_error_mm"] < 0.15
    taken = [run["steps"][name]["measures"] for name in ("board_capture", "handheld_capture")]
    # Of the mishaps of every fourth press, a blurred board, a finger and half a way still leave a usable image.
    assert sum(m["images_not_used"] for m in taken) >= 2, "settings turned, and an image taken twice"
    assert sum(m["images_used"] for m in taken) >= 19


def test_every_image_that_was_not_used_says_why(run: dict[str, Any]) -> None:
    refused = [line for line in run["told"].splitlines() if "not used: " in line]
    assert len(refused) >= 2
    assert any("ISO 200; required are" in line for line in refused)
    assert run["told"].count("next: ") >= 19


def test_the_registration_is_as_good_as_with_a_robot(run: dict[str, Any]) -> None:
    measures = run["steps"]["evaluation"]["measures"]
    assert measures["best_mean_radial_error_mm"] < 0.2


def test_the_evidence_verifies(run: dict[str, Any]) -> None:
    answer = orthocapture("audit", "verify", run["run"], "--data", run["data"], "--json")
    assert answer.returncode == 0, answer.stdout
    shown = json.loads(orthocapture("audit", "show", run["run"], "--data", run["data"], "--json").stdout)
    kinds = [event["kind"] for event in shown["events"]]
    assert "view_held" in kinds
    assert "viewpoint_captured" not in kinds
