"""Reads a recording of ROS 2 in an MCAP file (rosbag2): frames, poses, cameras and compressed images."""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.poses.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    CdrError,
    StampedImage,
    StampedTransform,
    decode_camera_info,
    decode_image,
    decode_pose,
    decode_tf,
)
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Transform, inverse, transform
from service.core.units import ms, seconds_of_ns


@dataclass(frozen=True, slots=True)
class Timing:
    """The rule by which a pose may be taken for a time that no message has.

    Attributes:
        within_ns: largest time to the nearest message.
        interpolate: true to interpolate between the messages before and after, if these are not farther apart than
            `most_ns`.
        most_ns: largest time between these two messages.
    """

    within_ns: int = 0
    interpolate: bool = False
    most_ns: int = 0


@dataclass(frozen=True, slots=True)
class FoundPose:
    """T_a_b (4, 4) at a time, and how it was found."""

    T_a_b: Transform
    away_ns: int  # of the farthest message that was taken for it
    interpolated: bool


class NoPoseError(Exception):
    """There is no pose at this time; says why in a sentence."""


@dataclass
class _Edge:
    parent: str
    static: bool
    stamps_ns: list[int] = field(default_factory=list[int])
    poses: list[Transform] = field(default_factory=list[Transform])
    ordered: bool = True


class FrameTree:
    """Frames and the transforms between them, from messages in any order."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._edges: dict[str, _Edge] = {}  # by child

    def add(self, found: StampedTransform, *, static: bool) -> None:
        """Add a transform. Raises DataError if its child has another parent."""
        edge = self._edges.setdefault(found.child, _Edge(found.parent, static))
        if edge.parent != found.parent or edge.static != static:
            raise DataError(
                f"the frame {found.child!r} has two parents, {edge.parent!r} and {found.parent!r}, or is once static "
                "and once not",
                where=self._where,
                remedy="Record one tree of frames",
            )
        if static:
            edge.stamps_ns, edge.poses = [0], [found.T_parent_child]
            return
        edge.ordered = edge.ordered and (not edge.stamps_ns or found.stamp_ns > edge.stamps_ns[-1])
        edge.stamps_ns.append(found.stamp_ns)
        edge.poses.append(found.T_parent_child)

    def frames(self) -> tuple[str, ...]:
        """Return the names of all frames, sorted."""
        return tuple(sorted({*self._edges, *(edge.parent for edge in self._edges.values())}))

    def is_static(self, a: str, b: str) -> bool:
        """Return whether two frames do not move against each other. Raises as `pose` does."""
        up, down = self._between(a, b)
        return all(self._edges[child].static for child in (*up, *down))

    def pose(self, a: str, b: str, stamp_ns: int, timing: Timing) -> FoundPose:
        """Return T_a_b at a time.

        Raises:
            DataError: a frame is unknown, or the two are not connected.
            NoPoseError: a transform between them has no message that may be taken for this time.
        """
        up, down = self._between(a, b)
        away, interpolated = 0, False
        T_top = [np.eye(4), np.eye(4)]
        for side, chain in enumerate((up, down)):
            for child in chain:  # from the frame upwards
                found = self._at(child, stamp_ns, timing)
                T_top[side] = found.T_a_b @ T_top[side]
                away, interpolated = max(away, found.away_ns), interpolated or found.interpolated
        return FoundPose(inverse(T_top[0]) @ T_top[1], away, interpolated)

    def _between(self, a: str, b: str) -> tuple[list[str], list[str]]:
        """Return the children on the ways from a and from b up to their lowest common frame."""
        ways = [self._upwards(a), self._upwards(b)]
        while ways[0] and ways[1] and ways[0][-1] == ways[1][-1]:
            ways = [ways[0][:-1], ways[1][:-1]]
        tops = [self._edges[way[-1]].parent if way else frame for way, frame in zip(ways, (a, b), strict=True)]
        if tops[0] != tops[1]:
            raise DataError(
                f"the frames {a!r} and {b!r} are not connected (they end in {tops[0]!r} and {tops[1]!r})",
                where=self._where,
                remedy="Record the transforms between them too, also /tf_static",
            )
        return ways[0], ways[1]

    def _upwards(self, frame: str) -> list[str]:
        if frame not in self.frames():
            raise DataError(
                f"there is no frame {frame!r}; there are {', '.join(self.frames()) or 'none'}",
                where=self._where,
                remedy="Name one of these frames",
            )
        way: list[str] = []
        while frame in self._edges:
            if frame in way:
                raise DataError(f"the frame {frame!r} is above itself", where=self._where, remedy="Record a tree")
            way.append(frame)
            frame = self._edges[frame].parent
        return way

    def _at(self, child: str, stamp_ns: int, timing: Timing) -> FoundPose:
        edge = self._edges[child]
        if edge.static:
            return FoundPose(edge.poses[0], 0, interpolated=False)
        if not edge.ordered:
            order = sorted(range(len(edge.stamps_ns)), key=edge.stamps_ns.__getitem__)
            edge.stamps_ns = [edge.stamps_ns[k] for k in order]
            edge.poses = [edge.poses[k] for k in order]
            edge.ordered = True
        return _chosen(edge, child, stamp_ns, timing)


def _chosen(edge: _Edge, child: str, stamp_ns: int, timing: Timing) -> FoundPose:
    after = bisect_left(edge.stamps_ns, stamp_ns)
    near = [k for k in (after - 1, after) if 0 <= k < len(edge.stamps_ns)]
    best = min(near, key=lambda k: abs(edge.stamps_ns[k] - stamp_ns))
    away = abs(edge.stamps_ns[best] - stamp_ns)
    if away <= timing.within_ns:
        return FoundPose(edge.poses[best], away, interpolated=False)
    what = f"{edge.parent} → {child}: the nearest message is {ms(seconds_of_ns(away)):.3f} ms away"
    if not timing.interpolate:
        raise NoPoseError(what)
    if len(near) < 2:
        raise NoPoseError(f"{what}, and there is none on the other side")
    gap = edge.stamps_ns[after] - edge.stamps_ns[after - 1]
    if gap > timing.most_ns:
        raise NoPoseError(f"{what}, and those before and after are {ms(seconds_of_ns(gap)):.3f} ms apart")
    share = (stamp_ns - edge.stamps_ns[after - 1]) / gap
    T = _interpolated(edge.poses[after - 1], edge.poses[after], share)
    return FoundPose(T, max(abs(edge.stamps_ns[k] - stamp_ns) for k in near), interpolated=True)


def _interpolated(T_before: Transform, T_after: Transform, share: float) -> Transform:
    """Interpolate the pose: the position on the line, the rotation about the axis from one to the other."""
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415 - half a second

    turned = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([T_before[:3, :3], T_after[:3, :3]])))(share)
    return transform(turned, (1 - share) * T_before[:3, 3] + share * T_after[:3, 3])


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
    """The content of a recording, except the images, which are passed on as they are read.

    Attributes:
        frames: transforms of /tf and /tf_static.
        poses: poses by topic of PoseStamped or PoseWithCovarianceStamped, in order of the file.
        cameras: the camera of its first message by topic of CameraInfo.
        image_topics: topics of compressed images.
        other: types of the topics that are not read, by topic.
    """

    frames: FrameTree
    poses: dict[str, list[StampedTransform]] = field(default_factory=dict[str, list[StampedTransform]])
    cameras: dict[str, CameraModel] = field(default_factory=dict[str, CameraModel])
    image_topics: set[str] = field(default_factory=set[str])
    other: dict[str, str] = field(default_factory=dict[str, str])


def recording_file(path: Path) -> Path:
    """Return the MCAP file of a recording, which may be given as the folder of rosbag2.

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
    """Yield the topic, type and bytes of every message in CDR. Raises one of _DAMAGES, and OSError."""
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
    """Yield the records of a file and of its chunks; the sizes of chunks are checked before they are unpacked."""
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
        """Read `count` bytes at most, and none beyond the size."""
        data = self._file.read(min(count, self._left))
        self._left -= len(data)
        return data


def _plain(error: BaseException) -> str:
    """Return the text of an error in one printable line."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return "".join(c if c.isprintable() else "?" for c in text)[:300]
