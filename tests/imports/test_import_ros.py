"""`orthocapture import-ros` on recordings that rosbags writes: poses at the images' times, the mount, refusals."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.calibration.board import Board
from service.compute.poses.pose_files import read_poses_csv
from service.core.geometry import Array, inverse, transform
from tests.support.boards.board_folder import CAMERA, T_FLANGE_CAMERA, BoardFolder, board_folder

BOARD = Board(9, 6, 0.02)
STORE: Any = get_typestore(Stores.ROS2_JAZZY)
MS = 1_000_000
T_LINK_FLANGE = transform(Rotation.from_euler("xyz", [0.3, -0.2, 1.0]), np.array([0.0, 0.1, 0.05]))
T_MAP_BASE = transform(Rotation.from_euler("xyz", [0.0, 0.0, 2.0]), np.array([5.0, 1.0, 0.0]))
#: Frames as a site has them: map → base_link → link → tool0 → camera_optical.
FRAMES = ("--base", "base_link", "--flange", "tool0")


def ros(name: str, *values: Any) -> Any:
    return STORE.types[name](*values)


def header(stamp_ns: int, frame: str) -> Any:
    return ros("std_msgs/msg/Header", ros("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9)), frame)


def stamped(stamp_ns: int, parent: str, child: str, T: Array) -> Any:
    quaternion = ros("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
    moved = ros("geometry_msgs/msg/Transform", ros("geometry_msgs/msg/Vector3", *T[:3, 3].tolist()), quaternion)
    return ros("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, moved)


def pose(stamp_ns: int, frame: str, T: Array) -> Any:
    quaternion = ros("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
    placed = ros("geometry_msgs/msg/Pose", ros("geometry_msgs/msg/Point", *T[:3, 3].tolist()), quaternion)
    return ros("geometry_msgs/msg/PoseStamped", header(stamp_ns, frame), placed)


def tf(*transforms: Any) -> Any:
    return ros("tf2_msgs/msg/TFMessage", list(transforms))


def image(stamp_ns: int, data: bytes, form: str = "rgb8; jpeg compressed bgr8") -> Any:
    pixels = np.frombuffer(data, dtype=np.uint8)
    return ros("sensor_msgs/msg/CompressedImage", header(stamp_ns, "camera_optical"), form, pixels)


def camera_info(stamp_ns: int) -> Any:
    terms = np.array([CAMERA.k1, CAMERA.k2, CAMERA.p1, CAMERA.p2, 0.0])
    P = np.column_stack([CAMERA.matrix, np.zeros(3)])
    region = ros("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    return ros("sensor_msgs/msg/CameraInfo", header(stamp_ns, "camera_optical"), CAMERA.height, CAMERA.width,
               "plumb_bob", terms, CAMERA.matrix.ravel(), np.eye(3).ravel(), P.ravel(), 0, 0, region)  # fmt: skip


def write_bag(folder: Path, messages: Sequence[tuple[str, int, Any]]) -> Path:
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: dict[str, Any] = {}
        for topic, stamp_ns, message in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(topics[topic], stamp_ns, STORE.serialize_cdr(message, kind))
    return folder


def stamp_of(k: int) -> int:
    return 1_700_000_000 * 10**9 + k * 500 * MS


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> BoardFolder:
    return board_folder(tmp_path_factory.mktemp("boards"), BOARD)


def recorded(photographs: BoardFolder, folder: Path, late_ns: int = 0) -> Path:
    """A recording of the photographs; poses come in pairs around each image if late_ns is not 0."""
    static = tf(stamped(0, "link", "tool0", T_LINK_FLANGE), stamped(0, "tool0", "camera_optical", T_FLANGE_CAMERA))
    messages: list[tuple[str, int, Any]] = [("/tf_static", 1, static), ("/info", 2, camera_info(2))]
    for k, (name, T_base_flange) in enumerate(photographs.T_base_flange.items()):
        stamp = stamp_of(k)
        T_base_link = T_base_flange @ inverse(T_LINK_FLANGE)
        for at in (stamp - late_ns, stamp + late_ns) if late_ns else (stamp,):
            messages.append(("/tf", at, tf(stamped(at, "base_link", "link", T_base_link))))
            messages.append(("/pose", at, pose(at, "base_link", T_base_flange)))
        messages.append(("/tf", stamp, tf(stamped(stamp + 7 * MS, "map", "base_link", T_MAP_BASE))))
        messages.append(("/image", stamp, image(stamp, (photographs.images / name).read_bytes())))
    return write_bag(folder, messages)


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["import-ros", *map(str, words)], catch_exceptions=False)


def check_poses(out: Path, photographs: BoardFolder, atol: float = 1e-9) -> None:
    poses = read_poses_csv(out / "poses.csv")
    for k, T in enumerate(photographs.T_base_flange.values()):
        np.testing.assert_allclose(poses[f"{stamp_of(k)}.jpg"], T, atol=atol)


@pytest.mark.slow
def test_a_recording_calibrates_a_hand_eye_as_its_files_would(photographs: BoardFolder, tmp_path: Path) -> None:
    bag, out = recorded(photographs, tmp_path / "bag"), tmp_path / "out"
    done = run(bag, "--out", out, *FRAMES, "--camera-frame", "camera_optical")
    assert done.exit_code == 0, done.output
    assert "9 images with a pose: 9 of the same time" in done.output
    check_poses(out, photographs)
    for k, name in enumerate(photographs.T_base_flange):
        assert (out / "images" / f"{stamp_of(k)}.jpg").read_bytes() == (photographs.images / name).read_bytes()
    mount = json.loads((out / "hand_eye.json").read_text())
    np.testing.assert_allclose(mount["T_flange_camera"], T_FLANGE_CAMERA, atol=1e-12)
    words = ["calibrate", "hand-eye", "--images", out / "images", "--robot-poses", out / "poses.csv", "--camera",
             out / "camera.json", "--board", "9x6", "--square-mm", "20", "--out", out / "solved.json"]  # fmt: skip
    solved = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert solved.exit_code == 0, solved.output
    T = json.loads((out / "solved.json").read_text())["T_flange_camera"]
    assert np.allclose(T, T_FLANGE_CAMERA, atol=1e-3)


def test_times_that_differ_are_refused_unless_asked_for(photographs: BoardFolder, tmp_path: Path) -> None:
    bag = recorded(photographs, tmp_path / "bag", late_ns=4 * MS)
    strict = run(bag, "--out", tmp_path / "strict", *FRAMES)
    assert strict.exit_code == 1
    assert "base_link → link: the nearest message is 4.000 ms away" in strict.output
    near = run(bag, "--out", tmp_path / "near", *FRAMES, "--within-ms", "5")
    assert "0 of the same time, 9 nearest (messages up to 4.000 ms away)" in near.output
    between = run(bag, "--out", tmp_path / "between", *FRAMES, "--interpolate-ms", "10", "--json")
    record = json.loads(between.stdout)
    assert [one["interpolated"] for one in record["poses"].values()] == [True] * 9
    check_poses(tmp_path / "between", photographs)
    far = run(bag, "--out", tmp_path / "far", *FRAMES, "--interpolate-ms", "7")
    assert "those before and after are 8.000 ms apart" in far.output
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "near", "between"}  # nothing is left of the others


def test_interpolation_is_along_the_line_and_about_the_axis(photographs: BoardFolder, tmp_path: Path) -> None:
    T = transform(Rotation.from_rotvec([0.0, 0.0, 0.4]), np.array([0.4, 0.0, 0.0]))
    data = (photographs.images / "b0.jpg").read_bytes()
    messages = [
        ("/tf", 1000, tf(stamped(1000, "base", "flange", np.eye(4)))),
        ("/image", 1250, image(1250, data)),
        ("/tf", 2000, tf(stamped(2000, "base", "flange", T))),
    ]
    out = tmp_path / "out"
    done = run(
        write_bag(tmp_path / "bag", messages), "--out", out, "--base", "base", "--flange", "flange",
        "--interpolate-ms", "1",
    )  # fmt: skip
    assert "1 INTERPOLATED" in done.output
    (found,) = read_poses_csv(out / "poses.csv").values()
    expected = transform(Rotation.from_rotvec([0.0, 0.0, 0.1]), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_poses_of_a_topic_must_be_in_the_named_frame(photographs: BoardFolder, tmp_path: Path) -> None:
    bag = recorded(photographs, tmp_path / "bag")
    done = run(bag, "--out", tmp_path / "out", "--base", "base_link", "--pose-topic", "/pose")
    assert done.exit_code == 0, done.output
    check_poses(tmp_path / "out", photographs)
    other = run(bag, "--out", tmp_path / "other", "--base", "map", "--pose-topic", "/pose")
    assert "poses of /pose are in the frame 'base_link', not in 'map'" in other.output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--base", "world", "--flange", "tool0"],
            "no frame 'world'; there are base_link, camera_optical, link, map",
        ),
        ([*FRAMES, "--image-topic", "/other"], "1 topic of compressed images (/image)"),
        (["--base", "base_link", "--pose-topic", "/tool"], "no topic /tool of poses; there is /pose"),
        (["--base", "base_link", "--flange", "tool0", "--camera-frame", "map"], "'map' moves against 'tool0'"),
    ],
)
def test_names_that_are_not_there_are_answered_with_those_that_are(
    photographs: BoardFolder, tmp_path: Path, options: list[str], words: str
) -> None:
    done = run(recorded(photographs, tmp_path / "bag"), "--out", tmp_path / "out", *options)
    assert done.exit_code == 1
    assert words in done.output


def test_what_is_no_recording_is_told(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    assert "the folder holds 0 files .mcap" in run(tmp_path / "bag", "--out", tmp_path / "a", *FRAMES).output
    file = tmp_path / "text.mcap"
    file.write_text("this is no recording")
    done = run(file, "--out", tmp_path / "b", *FRAMES)
    assert done.exit_code == 1
    assert "cannot be read after its beginning" in done.output


def test_a_recording_that_is_cut_short_names_the_last_message(photographs: BoardFolder, tmp_path: Path) -> None:
    bag = recorded(photographs, tmp_path / "bag")
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    done = run(file, "--out", tmp_path / "out", *FRAMES)
    assert done.exit_code == 1
    assert "cannot be read after" in done.output
