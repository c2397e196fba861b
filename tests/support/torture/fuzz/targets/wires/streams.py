"""Fuzz targets for binary messages: FRI's datagrams, and those of ROS 2."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.kuka.fri.wire import FriError, decode
from service.compute.camera_model import CameraModel
from service.compute.poses.ros_messages import (
    CdrError,
    StampedImage,
    StampedTransform,
    decode_camera_info,
    decode_image,
    decode_pose,
    decode_tf,
    encode_camera_info,
    encode_image,
    encode_pose,
    encode_tf,
)
from tests.support.rig.rig import REPOSITORY
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

_CAMERA = CameraModel(480, 320, 700.0, 700.0, 239.5, 159.5, -0.05, 0.01)


# --- FRI ----------------------------------------------------------------------------------------------------------


def _datagrams(_: Path) -> list[bytes]:
    rows = (REPOSITORY / "tests" / "data" / "kuka" / "fri.jsonl").read_text().splitlines()
    return [bytes.fromhex(row["hex"]) for row in map(json.loads, rows) if "q" in row]


def _datagram(data: bytes, _: Path) -> None:
    message = decode(data)
    if not np.isfinite([*message.joints_rad, *(message.commanded_rad or ()), message.time_s]).all():
        raise MisbehavedError("a joint that is not finite is accepted")


# --- ROS 2 --------------------------------------------------------------------------------------------------------


def _pose() -> StampedTransform:
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.2, 0.3
    return StampedTransform(1_000_000_000, "world", "camera", T)


def _messages(_: Path) -> list[bytes]:
    image = StampedImage(1_000_000_000, "camera", "jpeg", b"\xff\xd8\xff\xd9")
    pose = encode_pose(1_000_000_000, "world", _pose().T_parent_child, np.eye(6))
    return [
        bytes([kind]) + data
        for kind, data in enumerate(
            (
                encode_image(image),
                encode_camera_info(1_000_000_000, "camera", _CAMERA),
                pose,
                encode_tf([_pose()] * 3),
            )
        )
    ]


def _message(data: bytes, _: Path) -> None:
    """The first byte chooses the type of the message."""
    decoders: tuple[Callable[[bytes], object], ...] = (decode_image, decode_camera_info, decode_pose, decode_tf)
    found = decoders[(data[:1] or b"\0")[0] % len(decoders)](data[1:])
    poses = found if isinstance(found, list) else [found]
    if not all(np.isfinite(one.T_parent_child).all() for one in poses if isinstance(one, StampedTransform)):
        raise MisbehavedError("a pose that is not finite is accepted")


TARGETS: tuple[Target, ...] = (
    Target("fri", "drivers.kuka.fri.wire:decode", _datagram, _datagrams, errors=(FriError,), says_place=False),
    Target(
        "ros_message", "service.compute.poses.ros_messages", _message, _messages, errors=(CdrError,), says_place=False
    ),
)
