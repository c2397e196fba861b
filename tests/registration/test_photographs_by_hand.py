"""The commands of the tutorial on photographs taken by hand, each fed with the files that the one before it wrote."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import write_camera_json
from service.core.geometry import inverse
from simulators.scan_station.formats import encode
from simulators.scan_station.station import scan_scene
from simulators.scene.world import Scene
from tests.support.scenes.scene_photographs import photograph, pose_above

WIDTH_PX, IMAGES, SEED = 640, 8, 7


def run(*words: object) -> None:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output


@pytest.mark.timeout(600)
@pytest.mark.slow  # renders photographs, matches them and searches them for spheres
@pytest.mark.sweep  # each command alone: test_sfm_command.py, test_register_command.py
def test_a_model_from_the_photographs_alone_is_registered_with_the_scan_that_gives_its_scale(tmp_path: Path) -> None:
    scene = Scene.generate(SEED)
    poses = {
        f"DSC{k + 1:05d}.JPG": pose_above(2 * np.pi * k / IMAGES, np.deg2rad(22 + 12 * (k % 2)))
        for k in range(IMAGES)
    }
    photograph(scene, poses, WIDTH_PX, tmp_path / "images")
    write_camera_json(tmp_path / "camera.json", CameraModel(**dataclasses.asdict(scene.camera_intrinsics(WIDTH_PX))))
    scan = scan_scene(scene, spray=True, control_spheres=True, spacing_m=1.2e-3)
    (_, data), *_ = encode("ply", "scan.ply", 1e3 * scan.vertices_m, scan.faces, scan.normals)
    (tmp_path / "scan.ply").write_bytes(data)

    given = ("--images", tmp_path / "images", "--camera", tmp_path / "camera.json")
    run("sfm", *given, "--out", tmp_path / "model", "--effort", "quick")
    model = ("--poses", tmp_path / "model", "--estimate-scale")
    scanned = ("--mesh", tmp_path / "scan.ply", "--radius-mm", 15)
    run("register", *given, *model, *scanned, "--out", tmp_path / "result.json")

    record = json.loads((tmp_path / "result.json").read_text())
    assert record["n_images"] == IMAGES
    found = {image["image"]: np.array(image["T_scan_camera"]) for image in record["images"]}
    for name, T_world_camera in poses.items():
        T_scan_camera = inverse(scan.T_world_scan) @ T_world_camera
        assert 1e3 * np.linalg.norm(found[name][:3, 3] - T_scan_camera[:3, 3]) < 1.0, name
    assert np.array(record["covariance"]).shape == (7, 7)  # pose and scale
