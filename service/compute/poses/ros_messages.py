"""Encodes and decodes the messages of ROS 2 that recordings hold, in Common Data Representation (CDR)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, from_quaternion
from service.core.units import nanoseconds

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"

_HEADER = """std_msgs/Header header
"""
_OF_HEADER = """MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
_OF_TIME = """MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_OF_POSE = """MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
"""
_OF_POINT = """MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""
_OF_QUATERNION = """MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_OF_COVARIANCE = """MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
"""
_OF_REGION = """MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"""
_OF_STAMPED = """MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
"""
_OF_TRANSFORM = """MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
"""
_OF_VECTOR = _OF_POINT.replace("Point", "Vector3")
_STAMPED = (_OF_HEADER, _OF_TIME)
_RULE = "=" * 80 + "\n"
_CAMERA_INFO = """uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
"""
#: Definitions in the form `ros2msg` of MCAP: the message, then every type in it.
DEFINITIONS = {
    COMPRESSED_IMAGE: _RULE.join([_HEADER + "string format\nuint8[] data\n", *_STAMPED]),
    CAMERA_INFO: _RULE.join([_HEADER + _CAMERA_INFO, *_STAMPED, _OF_REGION]),
    POSE_WITH_COVARIANCE: _RULE.join(
        [
            _HEADER + "geometry_msgs/PoseWithCovariance pose\n",
            *_STAMPED,
            _OF_COVARIANCE,
            _OF_POSE,
            _OF_POINT,
            _OF_QUATERNION,
        ]
    ),
    TF: _RULE.join(
        [
            "geometry_msgs/TransformStamped[] transforms\n",
            _OF_STAMPED,
            *_STAMPED,
            _OF_TRANSFORM,
            _OF_VECTOR,
            _OF_QUATERNION,
        ]
    ),
}
_SECOND = nanoseconds(1.0)
_UNIT = 1e-3  # tolerance of a quaternion's length
_TF_BYTES = 8 + 4 + 4 + 56  # least size of a TransformStamped


@dataclass(frozen=True, slots=True)
class StampedImage:
    """A compressed image: the unchanged file, with its time stamp."""

    stamp_ns: int
    frame: str
    form: str  # jpeg, png
    data: bytes


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """T_parent_child (4, 4), metres, at a time."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: Transform


def encode_image(image: StampedImage) -> bytes:
    """Encode a sensor_msgs/CompressedImage."""
    out = CdrWriter()
    _write_header(out, image.stamp_ns, image.frame)
    out.text(image.form)
    out.blob(image.data)
    return out.bytes()


def decode_image(data: bytes) -> StampedImage:
    """Decode a sensor_msgs/CompressedImage. Raises CdrError."""
    read = CdrReader(data)
    stamp_ns, frame = _read_header(read)
    form = read.text()
    return StampedImage(stamp_ns, frame, form, read.blob())


def encode_camera_info(stamp_ns: int, frame: str, camera: CameraModel) -> bytes:
    """Encode a sensor_msgs/CameraInfo with OpenCV's distortion; pixel centres lie at integers, in ROS as here."""
    out = CdrWriter()
    _write_header(out, stamp_ns, frame)
    out.number("I", camera.height)
    out.number("I", camera.width)
    terms = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, camera.k4, camera.k5, camera.k6)
    rational = any(terms[5:])
    out.text("rational_polynomial" if rational else "plumb_bob")
    out.doubles(terms if rational else terms[:5], sequence=True)
    out.doubles(np.asarray(camera.matrix, dtype=np.float64).ravel(), sequence=False)
    out.doubles(np.eye(3).ravel(), sequence=False)
    out.doubles(np.column_stack([camera.matrix, np.zeros(3)]).ravel(), sequence=False)
    for number in (0, 0, 0, 0, 0, 0):  # no binning, and the whole image
        out.number("I", number)
    out.number("?", False)
    return out.bytes()


def decode_camera_info(data: bytes) -> CameraModel:
    """Decode the camera of a sensor_msgs/CameraInfo. Raises CdrError, also for a distortion that is not OpenCV's."""
    read = CdrReader(data)
    _read_header(read)
    height, width = read.integer("I"), read.integer("I")
    model = read.text()
    terms = [float(term) for term in read.doubles(read.sequence_length(8))]
    K = read.doubles(9).reshape(3, 3)
    if model not in ("plumb_bob", "rational_polynomial") or len(terms) not in (0, 4, 5, 8):
        raise CdrError(
            f"the distortion model {model!r} with {len(terms)} terms is not plumb_bob or rational_polynomial"
        )
    if not np.isfinite([*terms, *K.ravel()]).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or abs(K[0, 1]) > 0:
        raise CdrError("the camera matrix is not that of a calibrated camera")
    k1, k2, p1, p2, k3, k4, k5, k6 = [*terms, *[0.0] * (8 - len(terms))]
    return CameraModel(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, k3=k3, k4=k4, k5=k5, k6=k6)


def encode_pose(stamp_ns: int, frame: str, T: Transform, covariance: Array) -> bytes:
    """Encode a geometry_msgs/PoseWithCovarianceStamped.

    Args:
        stamp_ns: nanoseconds since 1970.
        frame: frame in which the pose is.
        T: (4, 4) T_frame_body, metres.
        covariance: (6, 6) covariance of (d, w) in the axes of the frame, m and rad, as ROS has it.
    """
    out = CdrWriter()
    _write_header(out, stamp_ns, frame)
    _write_transform(out, T)
    out.doubles(covariance.ravel(), sequence=False)
    return out.bytes()


def decode_pose(data: bytes) -> StampedTransform:
    """Decode a geometry_msgs/PoseStamped, or one with a covariance, left out; `child` is "". Raises CdrError."""
    read = CdrReader(data)
    stamp_ns, frame = _read_header(read)
    return StampedTransform(stamp_ns, frame, "", _read_transform(read))


def encode_tf(transforms: list[StampedTransform]) -> bytes:
    """Encode a tf2_msgs/TFMessage."""
    out = CdrWriter()
    out.number("I", len(transforms))
    for one in transforms:
        _write_header(out, one.stamp_ns, one.parent)
        out.text(one.child)
        _write_transform(out, one.T_parent_child)
    return out.bytes()


def decode_tf(data: bytes) -> list[StampedTransform]:
    """Decode a tf2_msgs/TFMessage. Raises CdrError."""
    read = CdrReader(data)
    found: list[StampedTransform] = []
    for _ in range(read.sequence_length(_TF_BYTES)):
        stamp_ns, parent = _read_header(read)
        child = read.text()
        found.append(StampedTransform(stamp_ns, parent.lstrip("/"), child.lstrip("/"), _read_transform(read)))
    return found


def _write_header(out: CdrWriter, stamp_ns: int, frame: str) -> None:
    out.number("i", stamp_ns // _SECOND)
    out.number("I", stamp_ns % _SECOND)
    out.text(frame)


def _read_header(read: CdrReader) -> tuple[int, str]:
    seconds, rest = read.integer("i"), read.integer("I")
    return seconds * _SECOND + rest, read.text()


def _write_transform(out: CdrWriter, T: Transform) -> None:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - half a second

    out.doubles([*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()], sequence=False)


def _read_transform(read: CdrReader) -> Transform:
    values = read.doubles(7)
    if not np.isfinite(values).all() or abs(float(np.linalg.norm(values[3:])) - 1) > _UNIT:
        raise CdrError("a pose is not finite, or its quaternion does not have length 1")
    return from_quaternion(values[:3], values[3:])


# Common Data Representation (CDR), the encoding of ROS 2 messages: primitives, aligned, little- or big-endian.
#
# Source: OMG, "Common Object Request Broker Architecture", part 2, 9.3; encapsulation as in OMG's DDSI-RTPS, 10.2.


_LITTLE, _BIG = b"\0\1\0\0", b"\0\0\0\0"
_HEAD = 4  # bytes of the encapsulation, from whose end everything is aligned


class CdrError(ValueError):
    """The bytes are not a message of the expected type."""


class CdrWriter:
    """Encodes one message, little-endian."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE)

    def bytes(self) -> bytes:
        """Return the encoded message."""
        return bytes(self._data)

    def number(self, code: str, value: float) -> None:
        """Write a number with a code of the module struct: i, I, d, …"""
        self._align(struct.calcsize(code))
        self._data += struct.pack(f"<{code}", value)

    def text(self, value: str) -> None:
        """Write a string, with its terminating zero."""
        encoded = value.encode() + b"\0"
        self.number("I", len(encoded))
        self._data += encoded

    def blob(self, value: bytes) -> None:
        """Write a sequence of bytes."""
        self.number("I", len(value))
        self._data += value

    def doubles(self, values: Sequence[float] | NDArray[np.float64], *, sequence: bool) -> None:
        """Write doubles: an array of fixed length, or a sequence, which gives its length."""
        if sequence:
            self.number("I", len(values))
        for value in values:
            self.number("d", float(value))

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - _HEAD) % size)


class CdrReader:
    """Decodes one message. Every method raises CdrError where the bytes end, or hold something else."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (_LITTLE[:2], _BIG[:2]):
            raise CdrError(f"the message is not plain CDR (it begins with {data[:4].hex()})")
        self._order = "<" if data[:2] == _LITTLE[:2] else ">"
        self._data, self._at = data, _HEAD

    def integer(self, code: str) -> int:
        """Read a whole number with a code of the module struct."""
        return int(self._unpack(code, 1)[0])

    def doubles(self, count: int) -> NDArray[np.float64]:
        """Read (count,) doubles."""
        return np.array(self._unpack("d", count), dtype=np.float64)

    def text(self) -> str:
        """Read a string."""
        raw = self.blob()
        if not raw.endswith(b"\0"):
            raise CdrError("a string does not end with a zero")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError("a string is not UTF-8") from error

    def blob(self) -> bytes:
        """Read a sequence of bytes."""
        return self._take(self.integer("I"))

    def sequence_length(self, least_bytes: int) -> int:
        """Read the length of a sequence whose elements take so many bytes at least."""
        count = self.integer("I")
        if count * least_bytes > len(self._data) - self._at:
            raise CdrError(f"a sequence of {count} elements does not fit into the message")
        return count

    def _unpack(self, code: str, count: int) -> tuple[float, ...]:
        size = struct.calcsize(code)
        self._at += -(self._at - _HEAD) % size
        return struct.unpack(f"{self._order}{count}{code}", self._take(count * size))

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise CdrError("the message is cut short")
        self._at += size
        return self._data[self._at - size : self._at]
