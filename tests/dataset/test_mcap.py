"""The recording for ROS 2, read by programs that are not ours: mcap-ros2-support and rosbags."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from service.core.geometry import Array, apply, inverse
from service.dataset.exporter import exporter, write_data_set
from service.dataset.records import DataSet, PosedView
from tests.support.scenes.posed import posed_data_set, scene


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    made = posed_data_set(tmp_path_factory.mktemp("photographs"))
    times = [
        "2026:11:24 10:00:00.250+01:00",
        "2026:11:24 09:00:07",
        "2026:11:24 09:00:01.000001",
        "2026:11:24 09:00:09",
    ]
    views = tuple(dataclasses.replace(v, taken=time) for v, time in zip(made.views, times, strict=True))
    return dataclasses.replace(made, views=views)


@pytest.fixture(scope="module")
def bag(dataset: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "bag"
    write_data_set(dataset, exporter("mcap"), folder)
    return folder


def pose_of(position: Any, orientation: Any) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w]).as_matrix()
    T[:3, 3] = [position.x, position.y, position.z]
    return T


def in_time(dataset: DataSet) -> list[PosedView]:
    return [dataset.views[k] for k in (0, 2, 1, 3)]


def test_mcaps_own_decoder_projects_the_solid_to_its_pixels(bag: Path, dataset: DataSet) -> None:
    corners = np.asarray(scene().mesh.vertices)
    found: dict[str, list[Any]] = {}
    with (bag / "data_set.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    for view, info, pose, tf in zip(
        in_time(dataset), found["/camera/camera_info"], found["/camera/pose"], found["/tf"], strict=True
    ):
        T = pose_of(pose.pose.pose.position, pose.pose.pose.orientation)
        np.testing.assert_allclose(T, view.T_world_camera, atol=1e-12)
        (moved,) = tf.transforms
        assert (moved.header.frame_id, moved.child_frame_id) == ("world", "camera")
        np.testing.assert_array_equal(pose_of(moved.transform.translation, moved.transform.rotation), T)
        np.testing.assert_array_equal(np.array(pose.pose.covariance).reshape(6, 6), view.covariance)
        K, d = np.array(info.k).reshape(3, 3), np.array(info.d)
        rotation, shift = cv2.Rodrigues(inverse(T)[:3, :3])[0], inverse(T)[:3, 3]
        pixels, _ = cv2.projectPoints(corners, rotation, shift, K, d)
        expected = view.camera.project(apply(inverse(view.T_world_camera), corners))
        np.testing.assert_allclose(pixels[:, 0], expected, atol=1e-6)
        assert (info.height, info.width, info.distortion_model) == (
            view.camera.height,
            view.camera.width,
            "plumb_bob",
        )


def test_rosbags_opens_the_folder_as_a_recording_of_ros(bag: Path, dataset: DataSet) -> None:
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts == {
            "/camera/image/compressed": 4, "/camera/camera_info": 4, "/camera/pose": 4, "/tf": 4, "/tf_static": 1
        }  # fmt: skip
        images: list[Any] = []
        for connection, stamp_ns, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/camera/image/compressed":
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
                images.append((stamp_ns, message))
            if connection.topic == "/tf_static":
                assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == [("world", "scan")]
    for view, (_, message) in zip(in_time(dataset), images, strict=True):
        assert bytes(message.data) == dataset.pixels.picture(view)
        assert message.format == "png"
    begin = 1_795_510_800 * 10**9  # 2026-11-24 09:00 UTC
    assert [stamp - begin for stamp, _ in images] == [250_000_000, 1_000_001_000, 7 * 10**9, 9 * 10**9]
    described = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert described["duration"]["nanoseconds"] == images[-1][0] - images[0][0]


def test_the_recording_says_of_which_run_it_is_and_whether_that_was_simulated(bag: Path, dataset: DataSet) -> None:
    with (bag / "data_set.mcap").open("rb") as file:
        (about,) = make_reader(file).iter_metadata()
    assert about.name == "orthocapture"
    assert about.metadata == {
        "run": str(dataset.statement.get("run", "")),
        "frame": "world is the frame of mesh.ply, in metres",
        "simulated": "true" if dataset.simulated else "false",
    }


def test_photographs_without_times_are_a_second_apart(dataset: DataSet, tmp_path: Path) -> None:
    first, *others = dataset.views
    untimed = dataclasses.replace(dataset, views=(dataclasses.replace(first, taken=""), *others))
    write_data_set(untimed, exporter("mcap"), tmp_path / "bag")
    with (tmp_path / "bag" / "data_set.mcap").open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(["/camera/pose"])]
    assert times == [10**9, 2 * 10**9, 3 * 10**9, 4 * 10**9]
