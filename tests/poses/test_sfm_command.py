"""`orthocapture sfm`: a COLMAP model that register reads, robot poses in different frames, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import read_colmap_model, write_camera_json, write_poses_csv
from service.core.geometry import Transform, align_points, apply, inverse, look_at
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Transform]]:
    folder = tmp_path_factory.mktemp("capture")
    camera = camera_of_width(480)
    (folder / "images").mkdir()
    scene, poses = slabs(), dict[str, Transform]()
    for k, T in enumerate(ring_of_poses(6)):
        name = f"v{k}.png"
        assert cv2.imwrite(str(folder / "images" / name), render(scene, camera, T, k))
        poses[name] = T
    write_camera_json(folder / "camera.json", camera)
    return folder, poses


def arguments(folder: Path, out: Path, *more: str) -> list[str]:
    camera = folder / "camera.json"
    given = ["sfm", "--images", folder / "images", "--camera", camera, "--out", out, "--effort", "quick", "--json"]
    return [*map(str, given), *more]


def rms_m(folder: Path, poses: dict[str, Transform]) -> float:
    found = read_colmap_model(folder)
    a = np.array([poses[name][:3, 3] for name in found])
    b = np.array([T[:3, 3] for T in found.values()])
    T, s = align_points(a, b, with_scale=True)
    return float(np.sqrt(np.mean(np.sum((a - apply(T, s * b)) ** 2, axis=1))))


@pytest.mark.slow
def test_robot_poses_of_two_frames_are_noticed_and_not_believed(
    capture: tuple[Path, dict[str, Transform]], tmp_path: Path
) -> None:
    """The second half of the robot's poses is in another base frame; the model is correct anyway."""
    folder, poses = capture
    other = look_at(np.array([0.5, 0.1, 0.2]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    robot = {name: T if k < 3 else inverse(other) @ T for k, (name, T) in enumerate(poses.items())}
    write_poses_csv(tmp_path / "robot.csv", robot)
    done = RUNNER.invoke(app, arguments(folder, tmp_path / "out", "--robot-poses", str(tmp_path / "robot.csv")))
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["missing"] == []
    assert record["robot_poses_off_mm"] > 50
    assert rms_m(tmp_path / "out", poses) < 4e-4
    covariance = json.loads((tmp_path / "out" / "pose_covariance.json").read_text())
    assert set(covariance["covariance"]) == set(poses)
    assert np.linalg.eigvalsh(np.array(covariance["covariance"]["v0.png"])).min() > 0


@pytest.mark.slow
def test_wrong_principal_point_is_refined(capture: tuple[Path, dict[str, Transform]], tmp_path: Path) -> None:
    """Six pixels off: held fixed it would turn the cameras; refined, most of it is found."""
    folder, poses = capture
    camera = camera_of_width(480)
    wrong = CameraModel(480, 320, camera.fx, camera.fy, camera.cx + 3, camera.cy - 3, camera.k1, camera.k2)
    write_camera_json(tmp_path / "camera.json", wrong)
    words = arguments(folder, tmp_path / "out", "--refine-principal-point")
    words[words.index(str(folder / "camera.json"))] = str(tmp_path / "camera.json")
    done = RUNNER.invoke(app, words)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["camera"]
    assert abs(found["cx"] - camera.cx) < 2
    assert found["fx"] == camera.fx
    assert rms_m(tmp_path / "out", poses) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "reason"),
    [
        (["--hybrid"], "--mesh or --spheres"),
        (["--refine-intrinsics", "--refine-principal-point"], "includes the principal point"),
    ],
)
def test_contradicting_options_are_refused(
    capture: tuple[Path, dict[str, Transform]], tmp_path: Path, more: list[str], reason: str
) -> None:
    done = RUNNER.invoke(app, arguments(capture[0], tmp_path / "out", *more))
    assert done.exit_code == 2
    assert reason in " ".join(done.output.split())


@pytest.mark.slow
def test_robot_poses_of_other_images_are_refused(capture: tuple[Path, dict[str, Transform]], tmp_path: Path) -> None:
    write_poses_csv(tmp_path / "robot.csv", {"other.png": np.eye(4)})
    done = RUNNER.invoke(app, arguments(capture[0], tmp_path / "out", "--robot-poses", str(tmp_path / "robot.csv")))
    assert done.exit_code == 1
    assert "no image of the folder" in json.loads(done.stdout)["error"]["what"]
