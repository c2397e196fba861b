"""Reads a recording of ROS 2 in an MCAP file (rosbag2): frames, poses, cameras and compressed images."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

from service.compute.camera_model import CameraModel
from service.compute.poses.ros.cdr import CdrError
from service.compute.poses.ros.frames import FrameTree
from service.compute.poses.ros.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    StampedImage,
    StampedTransform,
    decode_camera_info,
    decode_image,
    decode_pose,
    decode_tf,
)
from service.core.errors import ConfigurationError, DataError

_LARGEST_CHUNK = 1 << 31  # unpacked
_REMEDY = "Record again, or convert the recording with `ros2 bag convert` into the storage mcap"
# What mcap and the libraries that unpack its chunks raise for damaged files.
_DAMAGES = (
    ValueError,
    LookupError,
    EOFError,
    OverflowError,
    AttributeError,
    TypeError,
    RuntimeError,
    struct.error,
    zlib.error,
)


@dataclass
class Recording:
    """What a recording holds, except the images, which are passed on as they are read.

    Attributes:
        frames: of /tf and /tf_static.
        poses: by topic of PoseStamped or PoseWithCovarianceStamped, in order of the file.
        cameras: by topic of CameraInfo: the camera of its first message.
        image_topics: topics of compressed images.
        other: types of the topics that are not read, by topic.
    """

    frames: FrameTree
    poses: dict[str, list[StampedTransform]] = field(default_factory=dict[str, list[StampedTransform]])
    cameras: dict[str, CameraModel] = field(default_factory=dict[str, CameraModel])
    image_topics: set[str] = field(default_factory=set[str])
    other: dict[str, str] = field(default_factory=dict[str, str])


def recording_file(path: Path) -> Path:
    """The MCAP file of a recording, which may be given as the folder of rosbag2.

    Raises DataError if there is none, or more than one.
    """
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise DataError(
                f"the folder holds {len(files)} files .mcap", where=str(path), remedy=f"Name the file. {_REMEDY}"
            )
        return files[0]
    if not path.is_file():
        raise DataError("there is no such file", where=str(path), remedy="Check the path")
    return path


def read_recording(
    path: Path, on_image: Callable[[str, StampedImage], None] = lambda _topic, _image: None
) -> Recording:
    """Read a recording from its beginning to its end.

    Args:
        path: an MCAP file.
        on_image: gets topic and image of every compressed image.

    Raises:
        ConfigurationError: the package mcap is not installed.
        DataError: the file is not MCAP, is damaged, or a message is not what its type says; names the message.
    """
    found = Recording(FrameTree(str(path)))
    last = "its beginning"
    try:
        for number, (topic, kind, data) in enumerate(_messages(path), start=1):
            last = f"message {number} of {topic}"
            try:
                _take(found, topic, kind, data, on_image)
            except CdrError as error:
                what = f"{last} is not a {kind}: {error}"
                raise DataError(what, where=f"{path}: {last}", remedy=_REMEDY) from error
    except _DAMAGES as error:
        raise DataError(
            f"the file cannot be read after {last} ({_plain(error)})", where=str(path), remedy=_REMEDY
        ) from error
    except OSError as error:
        raise DataError(
            f"the file cannot be read ({error.strerror})", where=str(path), remedy="Check its permissions"
        ) from error
    return found


def _take(
    found: Recording, topic: str, kind: str, data: bytes, on_image: Callable[[str, StampedImage], None]
) -> None:
    if kind == TF:
        for one in decode_tf(data):
            found.frames.add(one, static=topic.endswith("tf_static"))
    elif kind in (POSE, POSE_WITH_COVARIANCE):
        found.poses.setdefault(topic, []).append(decode_pose(data))
    elif kind == CAMERA_INFO:
        if topic not in found.cameras:
            found.cameras[topic] = decode_camera_info(data)
    elif kind == COMPRESSED_IMAGE:
        found.image_topics.add(topic)
        on_image(topic, decode_image(data))
    else:
        found.other[topic] = kind


def _messages(path: Path) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and bytes of every message in CDR. Raises one of _DAMAGES, and OSError."""
    try:
        from mcap.exceptions import McapError  # noqa: PLC0415 - optional
        from mcap.records import Channel, Message, Schema  # noqa: PLC0415
    except ImportError as error:
        raise ConfigurationError(
            "recordings of ROS need the package mcap, which is not installed",
            where=str(path),
            remedy="Install orthocapture[ros]",
        ) from error
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str, str]] = {}
    try:
        for record in _records(path):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels[record.id] = record.topic, schemas.get(record.schema_id, ""), record.message_encoding
            elif isinstance(record, Message):
                topic, kind, encoding = channels[record.channel_id]
                if encoding == "cdr":
                    yield topic, kind, bytes(record.data)
    except McapError as error:
        raise ValueError(_plain(error)) from error


def _records(path: Path) -> Iterator[Any]:
    """The records of a file and of its chunks; the sizes that chunks state are checked before they are unpacked."""
    from lz4.frame import get_frame_info  # noqa: PLC0415 - come with mcap
    from mcap.records import Chunk  # noqa: PLC0415
    from mcap.stream_reader import StreamReader, breakup_chunk  # noqa: PLC0415
    from zstandard import ZstdError, frame_content_size  # noqa: PLC0415

    sizes: dict[str, Callable[[bytes], int]] = {
        "zstd": frame_content_size,
        "lz4": lambda data: get_frame_info(data)["content_size"],
    }
    size = path.stat().st_size
    with path.open("rb") as file:
        bounded = cast("IO[bytes]", _Bounded(file, size))
        for record in StreamReader(bounded, emit_chunks=True, record_size_limit=size).records:
            if not isinstance(record, Chunk):
                yield record
                continue
            size_of = sizes.get(record.compression, len)
            try:
                unpacked = max(size_of(record.data), record.uncompressed_size)
                if unpacked > _LARGEST_CHUNK:
                    raise ValueError(f"a chunk claims to have {unpacked:,} bytes")
                yield from breakup_chunk(record, validate_crc=True)
            except ZstdError as error:
                raise ValueError(_plain(error)) from error


class _Bounded:
    """Reads no more than a file holds: a wrong length would set gigabytes aside."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size

    def read(self, count: int) -> bytes:
        """At most so many bytes."""
        data = self._file.read(min(count, self._left))
        self._left -= len(data)
        return data


def _plain(error: BaseException) -> str:
    """The words of an error in one printable line."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return "".join(c if c.isprintable() else "?" for c in text)[:300]
