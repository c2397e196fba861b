"""Pose, camera and sphere files: they survive a round trip, and every fault is named with its place."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import (
    read_camera_json,
    read_poses,
    read_spheres_json,
    write_camera_json,
    write_poses_csv,
    write_transforms_json,
)
from service.compute.sfm.estimate import write_pose_covariance
from service.core.errors import DataError
from service.core.geometry import Transform, transform
from tests.support.scenes.colmap_model import write_colmap_text

CAMERA = CameraModel(1536, 1024, 2150.5, 2152.25, 770.125, 508.5, -0.05, 0.04, 3e-4, -2e-4)
CSV = "image,x,y,z,qx,qy,qz,qw\n"

numbers = st.floats(-5, 5, allow_nan=False)


@st.composite
def pose_sets(draw: st.DrawFn) -> dict[str, Transform]:
    names = draw(
        st.lists(st.from_regex(r"[a-z]{1,8}[0-9]{2}\.jpg", fullmatch=True), min_size=1, max_size=5, unique=True)
    )
    poses: dict[str, Transform] = {}
    for name in names:
        vector = np.array(draw(st.tuples(numbers, numbers, numbers)))
        poses[name] = transform(Rotation.from_rotvec(vector), np.array(draw(st.tuples(numbers, numbers, numbers))))
    return poses


def _assert_same(found: dict[str, Transform], expected: dict[str, Transform]) -> None:
    assert set(found) == set(expected)
    for name, T in expected.items():
        np.testing.assert_allclose(found[name], T, atol=1e-9)


@given(poses=pose_sets())
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_csv_and_transforms_round_trip(poses: dict[str, Transform], tmp_path: Path) -> None:
    write_poses_csv(tmp_path / "poses.csv", poses)
    _assert_same(read_poses(tmp_path / "poses.csv"), poses)
    write_transforms_json(tmp_path / "transforms.json", CAMERA, poses)
    _assert_same(read_poses(tmp_path / "transforms.json"), poses)


def test_the_file_of_covariances_holds_each_under_its_image_with_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "pose_covariance.json"
    each = np.arange(72.0).reshape(2, 6, 6)
    write_pose_covariance(path, ["a1.jpg", "b2.jpg"], each, "model")
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document["position_unit"] == "model"
    assert len(document["order"]) == 6
    assert {name: np.array(C).tolist() for name, C in document["covariance"].items()} == {
        "a1.jpg": each[0].tolist(),
        "b2.jpg": each[1].tolist(),
    }


def test_colmap_text_round_trip_and_convention(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    turn = Rotation.from_euler("xyz", [150, 20, -35], degrees=True)
    poses = {"a1.jpg": transform(turn, np.array([0.1, 0.2, 0.7])), "sub/b.jpg": transform(np.eye(3), np.zeros(3))}
    write_colmap_text(tmp_path / "sparse" / "0", CAMERA, poses)
    _assert_same(read_poses(tmp_path), poses)
    text = (tmp_path / "sparse" / "0" / "cameras.txt").read_text(encoding="utf-8").splitlines()
    fields = text[-1].split()
    assert fields[1] == "OPENCV"
    # COLMAP's pixel centres are at half-integers
    assert [float(v) for v in fields[6:8]] == [CAMERA.cx + 0.5, CAMERA.cy + 0.5]
    assert capfd.readouterr() == ("", "")


def test_colmap_model_written_by_hand(tmp_path: Path) -> None:
    """World-to-camera, quaternion scalar first: a camera 2 m in front of the origin, turned by 180° about y."""
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("1 0 0 1 0 0 0 2 1 view.png\n\n")
    (tmp_path / "points3D.txt").write_text("")
    T = read_poses(tmp_path)["view.png"]
    np.testing.assert_allclose(T[:3, 3], [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize(
    ("file", "before", "after", "said"),
    [
        ("images.txt", b"view.png", b"vi\xffw.png", "the name of an image is not UTF-8"),
        ("frames.txt", b"1 1 ", b"1 7 ", "Rig with ID 7 does not exist"),
    ],
)
def test_a_damaged_colmap_model_is_refused_in_words(
    tmp_path: Path, file: str, before: bytes, after: bytes, said: str
) -> None:
    write_colmap_text(tmp_path, CAMERA, {"view.png": np.eye(4)})
    (tmp_path / file).write_bytes((tmp_path / file).read_bytes().replace(before, after))
    with pytest.raises(DataError, match=said):
        read_poses(tmp_path)


@pytest.mark.slow
def test_a_colmap_model_that_announces_endless_data_is_given_up(tmp_path: Path) -> None:
    """The library would count to four thousand million (found by bench/torture/fuzz)."""
    write_colmap_text(tmp_path, CAMERA, {"view.png": np.eye(4)})
    binary = tmp_path / "binary"
    binary.mkdir()
    pycolmap.Reconstruction(str(tmp_path)).write_binary(str(binary))
    whole = (binary / "frames.bin").read_bytes()
    (binary / "frames.bin").write_bytes(whole[:72] + b"\xff\xff\xff\xff")
    with pytest.raises(DataError, match="took far longer than a sound model takes"):
        read_poses(binary)


def test_transforms_json_is_opengl(tmp_path: Path) -> None:
    """The identity in OpenGL is a camera that looks along -z with y up; ours looks along -z with y down."""
    frame = {"file_path": "./images/v.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    T = read_poses(tmp_path / "transforms.json")["images/v.png"]
    np.testing.assert_allclose(T[:3, :3], np.diag([1, -1, -1]))


@pytest.mark.parametrize(
    ("body", "line", "message"),
    [
        ("a.jpg,0,0,0,0,0,0\n", 2, "7 fields"),
        ("a.jpg,0,0,0,0,0,0,1\nb.jpg,0,zero,0,0,0,0,1\n", 3, "not a number"),
        ("a.jpg,0,0,0,0,0,0,1\na.jpg,0,0,0,0,0,0,1\n", 3, "two poses"),
        ("a.jpg,0,0,0,0,0,0,0.9\n", 2, "length is 0.9"),
        ("a.jpg,0,nan,0,0,0,0,1\n", 2, "not finite"),
    ],
)
def test_malformed_csv_names_the_line(tmp_path: Path, body: str, line: int, message: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(CSV + body)
    with pytest.raises(DataError, match=message) as caught:
        read_poses(path)
    assert caught.value.where == f"{path}:{line}"


def test_wrong_header_and_missing_pose(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("name,x,y\n")
    with pytest.raises(DataError, match="first line"):
        read_poses(path)
    path.write_text("﻿" + CSV + "images/a.jpg,0,0,0,0,0,0,1\r\n")  # as saved by a spreadsheet
    assert list(read_poses(path, ["a.jpg"])) == ["a.jpg"]
    with pytest.raises(DataError, match=r"1 of 2 images have no pose: b\.jpg"):
        read_poses(path, ["a.jpg", "b.jpg"])


def test_unknown_or_broken_pose_sources(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        read_poses(tmp_path / "none.csv")
    with pytest.raises(DataError, match="no COLMAP model"):
        read_poses(tmp_path)
    (tmp_path / "poses.xlsx").write_bytes(b"PK")
    with pytest.raises(DataError, match="unknown kind"):
        read_poses(tmp_path / "poses.xlsx")
    (tmp_path / "t.json").write_text('{"frames": [\n')
    with pytest.raises(DataError, match="not valid JSON"):
        read_poses(tmp_path / "t.json")
    mirrored = {"file_path": "a", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({"frames": [mirrored]}))
    with pytest.raises(DataError, match=r"not a rotation.*frames\[0\]"):
        read_poses(tmp_path / "t.json")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / name).write_bytes(b"\x01\x02\x03")
    with pytest.raises(DataError, match="COLMAP model"):
        read_poses(tmp_path)


def test_camera_json(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    write_camera_json(path, CAMERA)
    assert read_camera_json(path) == CAMERA
    write_camera_json(path, CAMERA, simulated=True)
    assert json.loads(path.read_text())["simulated"] is True
    assert read_camera_json(path) == CAMERA
    good: dict[str, Any] = json.loads(path.read_text())
    for change, message in (
        ({"k7": 0.1}, "unknown k7"),
        ({"k3": "small"}, "k3 is 'small'"),
        ({"fx": None}, "missing fx"),
        ({"fx": "wide"}, "fx is 'wide'"),
        ({"fx": -3.0}, "positive"),
    ):
        document = {**good, **change}
        path.write_text(json.dumps({k: v for k, v in document.items() if v is not None}))
        with pytest.raises(DataError, match=message):
            read_camera_json(path)


def test_more_distortion_goes_through_the_files_that_can_hold_it(tmp_path: Path) -> None:
    camera = dataclasses.replace(CAMERA, k3=0.02, k4=0.01, k5=-0.004, k6=0.001)
    path = tmp_path / "camera.json"
    write_camera_json(path, camera)
    assert read_camera_json(path) == camera
    pixels = np.random.default_rng(0).uniform(0, 1024, (50, 2))
    rays = np.column_stack([camera.normalise(pixels), np.ones(50)])
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-6)
    reference = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(rays), reference, atol=1e-9)
    write_colmap_text(tmp_path / "model", camera, {"a.jpg": np.eye(4)})
    assert "FULL_OPENCV" in (tmp_path / "model" / "cameras.txt").read_text()
    with pytest.raises(DataError, match="rational"):
        write_transforms_json(tmp_path / "t.json", camera, {"a.jpg": np.eye(4)})


def test_spheres_json(tmp_path: Path) -> None:
    path = tmp_path / "spheres.json"
    path.write_text('{"radius_mm": 15, "registration_mm": [[1, 2, 3], [4, 5, 6]], "control_mm": []}')
    spheres = read_spheres_json(path)
    assert spheres.radius_m == pytest.approx(0.015)
    np.testing.assert_allclose(spheres.centres_m, [[0.001, 0.002, 0.003], [0.004, 0.005, 0.006]])
    assert spheres.control_m.shape == (0, 3)
    for body, message in (
        ('{"radius_mm": 15}', "missing registration_mm"),
        ('{"radius_mm": -1, "registration_mm": [[1, 2, 3]]}', "radius_mm is -1"),
        ('{"radius_mm": 15, "registration_mm": [[1, 2]]}', "registration_mm is not a list"),
        ('{"radius_mm": 15, "registration_mm": [[1, 2, "x"]]}', "not an array of numbers"),
        ('{"radius_mm": 15, "registration_mm": []}', "empty"),
        ("[1]", "JSON object"),
    ):
        path.write_text(body)
        with pytest.raises(DataError, match=message):
            read_spheres_json(path)
