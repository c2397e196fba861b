"""A whole small run with a second simulated camera: extrinsics against the simulator's truth, and the data set."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.poses.files.camera_files import read_camera_json
from service.compute.poses.files.pose_files import read_poses_csv
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad
from tests.support.protocols.small_demo import SLICE_MM, VIEWS, small_demo
from tests.support.rig.rig import orthocapture, simulated_rig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]
SECOND = "camera_2"


@dataclass(frozen=True)
class Ended:
    """A run that has ended, its data set in plain files and in COLMAP's, and the simulator's truth."""

    place: str
    data: Path
    plain: Path
    colmap: Path
    truth: dict[str, Any]

    @property
    def second(self) -> dict[str, Any]:
        """What the data set says of the second camera."""
        (said,) = json.loads((self.plain / "dataset.json").read_text())["further_cameras"]
        return said


FURTHER_GATES = (
    {"measure": "further_views", "min": VIEWS, "unit": "images"},
    {"measure": "further_consistency_mm", "max": 1.5, "unit": "mm"},
    {"measure": "further_consistency_mrad", "max": 2.0, "unit": "mrad"},
)


@pytest.fixture(scope="module", params=["fixed", "stereo"])
def ended(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    place, folder = str(request.param), tmp_path_factory.mktemp("second")
    data = folder / "data"
    options = ("--scene", "7", "--image-width", "960", "--ct-voxel-mm", str(SLICE_MM), "--speed-up", "10")
    with simulated_rig(folder, *options, "--second-camera", place, host="127.0.0.49") as rig:
        answer = orthocapture(
            "run", str(small_demo(folder / "two_cameras.yaml", *FURTHER_GATES)), "--rig", rig["rig"],
            "--data", str(data), "--operator", "Ada", "--auto-confirm", timeout_s=1400,
        )  # fmt: skip
        assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
        truth = json.loads(Path(rig["truth"]).read_text())
    for form in ("plain", "colmap"):
        made = orthocapture(
            "export", "latest", "--format", form, "--out", str(folder / form), "--data", str(data), timeout_s=400
        )
        assert made.returncode == 0, made.stdout + made.stderr
    return Ended(place, data, folder / "plain", folder / "colmap", truth)


def error(found: Transform, truth: Transform) -> Array:
    """(6,) of (d, w), m and rad."""
    turned = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([found[:3, 3] - truth[:3, 3], turned])


def test_the_extrinsics_are_true_within_their_covariance(ended: Ended) -> None:
    T_outer_camera, said = np.array(ended.truth["second_camera"]["T_outer_camera"]), ended.second
    if ended.place == "fixed":
        found = np.array(said["T_scan_camera"])
        T_outer_camera = inverse(np.array(ended.truth["scans"][-1]["T_world_scan"])) @ T_outer_camera
    else:
        found = np.array(said["T_first_camera"])
    e = error(found, T_outer_camera)
    assert e @ np.linalg.solve(np.array(said["covariance"]), e) < 16.8  # 99 % of chi-squared with six degrees
    assert np.linalg.norm(e[:3]) < (1e-3 if ended.place == "fixed" else 0.3e-3)
    assert said["sigma_mm"] < (1.0 if ended.place == "fixed" else 0.3)
    assert said["images"] == VIEWS
    assert not said["images_left_out"]


def test_the_offset_of_the_clocks_is_the_simulators(ended: Ended) -> None:
    said = ended.second
    assert said["clock_offset_s"] == pytest.approx(
        ended.truth["second_camera"]["clock_ahead_s"], abs=max(0.05, 4 * said["clock_offset_sigma_s"])
    )
    assert 0 < said["clock_offset_sigma_s"] < 0.1


def test_plain_files_have_both_cameras(ended: Ended) -> None:
    further = ended.plain / "further" / SECOND
    first, second = (read_camera_json(folder / "camera.json") for folder in (ended.plain, further))
    assert first != second
    poses, of_second = (read_poses_csv(folder / "poses.csv") for folder in (ended.plain, further))
    assert len(poses) == len(of_second) == VIEWS
    assert {path.name for path in (further / "images").iterdir()} == set(of_second)
    with (ended.plain / "views.csv").open() as file:
        assert sorted(row["camera"] for row in csv.DictReader(file)) == [""] * VIEWS + [SECOND] * VIEWS
    between = [inverse(poses[name]) @ of_second[name.replace(".jpg", f"_{SECOND}.jpg")] for name in sorted(poses)]
    if ended.place == "stereo":
        assert all(np.allclose(T, ended.second["T_first_camera"], atol=1e-8) for T in between)
    else:
        assert all(np.allclose(T, ended.second["T_scan_camera"], atol=1e-8) for T in of_second.values())
        assert rotation_angle_rad(between[0] @ inverse(between[1])) > 0.05


def test_colmap_has_two_cameras(ended: Ended) -> None:
    (cameras,) = ended.colmap.rglob("cameras.txt")
    (images,) = ended.colmap.rglob("images.txt")
    assert sum(not row.startswith("#") for row in cameras.read_text().splitlines()) == 2
    rows = [row.split() for row in images.read_text().splitlines() if row and not row.startswith("#")]
    used = {row[9]: row[8] for row in rows}
    assert len(used) == 2 * VIEWS
    assert len({camera for name, camera in used.items() if SECOND in name}) == 1
    assert {camera for name, camera in used.items() if SECOND in name} & {
        camera for name, camera in used.items() if SECOND not in name
    } == set()


def test_the_second_cameras_images_show_the_spheres_where_its_pose_says(ended: Ended) -> None:
    """The true spheres, projected by the exported pose and camera, against the simulator's own projection."""
    further = ended.plain / "further" / SECOND
    camera: CameraModel = read_camera_json(further / "camera.json")
    T_world_scan = np.array(ended.truth["scans"][-1]["T_world_scan"])
    log = [
        json.loads(row) for row in (ended.data.parent / f"truth_exposures_{SECOND}.jsonl").read_text().splitlines()
    ]
    true_poses = {row["sha256"]: np.array(row["T_world_camera"]) for row in log}
    hashes = json.loads((ended.plain / "dataset.json").read_text())["image_sha256"]
    centres_m = np.array(ended.truth["registration_m"])
    for name, T_scan_camera in read_poses_csv(further / "poses.csv").items():
        shown = [
            camera.project(_seen(centres_m, T)) for T in (T_world_scan @ T_scan_camera, true_poses[hashes[name]])
        ]
        assert np.linalg.norm(shown[0] - shown[1], axis=1).max() < 0.6  # px


def _seen(points_m: Array, T_world_camera: Transform) -> Array:
    return (points_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]


def test_the_evidence_verifies_and_replays(ended: Ended) -> None:
    verified = orthocapture("audit", "verify", "latest", "--data", str(ended.data), "--json", timeout_s=300)
    assert json.loads(verified.stdout)["ok"] is True
    again = orthocapture("replay", "latest", "--data", str(ended.data), timeout_s=600)
    assert again.returncode == 0, again.stdout + again.stderr
