"""A recording for ROS 2 (rosbag2 in MCAP): images, camera, poses with covariances, and the tree of frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from service.compute.poses.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    DEFINITIONS,
    POSE_WITH_COVARIANCE,
    TF,
    StampedImage,
    StampedTransform,
    encode_camera_info,
    encode_image,
    encode_pose,
    encode_tf,
)
from service.core.errors import ConfigurationError
from service.core.units import nanoseconds, nanoseconds_of_us
from service.dataset.export_folder import ExportFolder
from service.dataset.exporter import Exporter, ground_truth_ply
from service.dataset.records import DataSet, PosedView

FILE = "data_set.mcap"
WORLD, SCAN, CAMERA = "world", "scan", "camera"
#: Topic → type of its messages.
TOPICS = {
    "/camera/image/compressed": COMPRESSED_IMAGE,
    "/camera/camera_info": CAMERA_INFO,
    "/camera/pose": POSE_WITH_COVARIANCE,
    "/tf": TF,
    "/tf_static": TF,
}
_LATCHED = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""  # quality of service that late subscribers of /tf_static need
_FORMS = {".jpg": "jpeg", ".png": "png"}
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EXIF = ("%Y:%m:%d %H:%M:%S.%f%z", "%Y:%m:%d %H:%M:%S%z", "%Y:%m:%d %H:%M:%S.%f", "%Y:%m:%d %H:%M:%S")


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`data_set.mcap` and `metadata.yaml`, which `ros2 bag` plays, and `mesh.ply` in metres.

    Topics: `/camera/image/compressed` (the photographs as they are), `/camera/camera_info` (OpenCV's distortion),
    `/camera/pose` (T_world_camera with its 6 × 6 covariance), `/tf` (world → camera) and `/tf_static` (world → scan,
    the same frame). The camera frame is x right, y down, z forward, as ROS's optical frames. Units are metres and
    radians; pixel centres lie at integers. A stamp is the time that the photograph states, of the camera's clock,
    taken as UTC if it states no offset; if not every photograph states a time of its own, stamps are one second
    apart.
    """
    stamps = stamps_ns(dataset.views)
    folder.written_by(FILE, lambda path: _recording(path, dataset, stamps))
    mark = f"# {dataset.mark}\n" if dataset.mark else ""
    folder.text("metadata.yaml", mark + _metadata(stamps))
    folder.file("mesh.ply", lambda: ground_truth_ply(dataset.mesh, dataset.mark))


def stamps_ns(views: Sequence[PosedView]) -> dict[str, int]:
    """Return each view's stamp, ns since 1970, of its photograph; counted if a time is missing or repeated."""
    taken = {view.name: _time_ns(view.taken) for view in views}
    known = {name: stamp for name, stamp in taken.items() if stamp is not None}
    if len(set(known.values())) == len(views):
        return known
    return {view.name: (index + 1) * nanoseconds(1.0) for index, view in enumerate(views)}


def _time_ns(taken: str) -> int | None:
    for form in _EXIF:
        try:
            moment = datetime.strptime(taken, form)  # noqa: DTZ007 - the camera's time; see `write`
        except ValueError:
            continue
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        return nanoseconds_of_us((moment - _EPOCH) // timedelta(microseconds=1))
    return None


def _recording(path: Path, dataset: DataSet, stamps: dict[str, int]) -> None:
    try:
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415 - optional
    except ImportError as error:
        raise ConfigurationError(
            "the format mcap needs the package mcap, which is not installed",
            where="--format mcap",
            remedy="Install orthocapture[ros]",
        ) from error
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)  # photographs are compressed already
        writer.start(profile="ros2", library="orthocapture")
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for topic, kind in TOPICS.items():
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
            quality = {"offered_qos_profiles": _LATCHED if topic == "/tf_static" else ""}
            channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], quality)
        about = {"run": str(dataset.statement.get("run", "")), "frame": "world is the frame of mesh.ply, in metres"}
        writer.add_metadata("orthocapture", {**about, "simulated": str(dataset.simulated).lower()})
        for sequence, (topic, stamp, data) in enumerate(_messages(dataset, stamps)):
            writer.add_message(channels[topic], stamp, data, stamp, sequence)
        writer.finish()


def _messages(dataset: DataSet, stamps: dict[str, int]) -> Iterator[tuple[str, int, bytes]]:
    """Yield the topic, stamp and bytes of every message, in order of time."""
    static = StampedTransform(min(stamps.values()), WORLD, SCAN, np.eye(4))
    yield "/tf_static", static.stamp_ns, encode_tf([static])
    for view in sorted(dataset.views, key=lambda view: stamps[view.name]):
        stamp = stamps[view.name]
        image = StampedImage(stamp, CAMERA, _FORMS[view.suffix], dataset.pixels.picture(view))
        yield "/tf", stamp, encode_tf([StampedTransform(stamp, WORLD, CAMERA, view.T_world_camera)])
        yield "/camera/pose", stamp, encode_pose(stamp, WORLD, view.T_world_camera, view.covariance)
        yield "/camera/camera_info", stamp, encode_camera_info(stamp, CAMERA, view.camera)
        yield "/camera/image/compressed", stamp, encode_image(image)


def _metadata(stamps: dict[str, int]) -> str:
    """Return the description that rosbag2 puts beside its file."""
    first, last = min(stamps.values()), max(stamps.values())
    counts = {topic: 1 if topic == "/tf_static" else len(stamps) for topic in TOPICS}
    start, length = {"nanoseconds_since_epoch": first}, {"nanoseconds": last - first}
    topics: list[dict[str, Any]] = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": _LATCHED if topic == "/tf_static" else "",
            },
            "message_count": counts[topic],
        }
        for topic, kind in TOPICS.items()
    ]
    described = {
        "version": 5,
        "storage_identifier": "mcap",
        "duration": length,
        "starting_time": start,
        "message_count": sum(counts.values()),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [FILE],
        "files": [{"path": FILE, "starting_time": start, "duration": length, "message_count": sum(counts.values())}],
    }
    return yaml.safe_dump({"rosbag2_bagfile_information": described}, sort_keys=False)


KIND = Exporter(
    "mcap", "rosbag2/MCAP: images, camera, poses and frames for ROS 2, written without ROS", write, one_camera=True
)
