"""The newest word of a runner: one small file a run, replaced as a whole, read by the web process."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from service.core.model import Record

STALE_S = 5.0
Doing = Literal["asking", "working", "pausing", "paused", "ended", "unknown"]
RobotPhase = Literal[
    "not_connected", "standing", "moving", "protective_stop", "safeguard_stop", "emergency_stop", "fault", "unknown"
]


class Message(Record):
    """One line of news."""

    at_utc: str
    text: str


class Snapshot(Record):
    """What a runner says of itself, its devices and its machine. What cannot be told is None, or "unknown"."""

    at_utc_s: float = 0.0
    pid: int = 0
    doing: Doing = "unknown"
    step: str = ""
    attempt: int = 0
    what: str = ""  # of the work under way
    done: int = 0
    total: int = 0
    messages: tuple[Message, ...] = ()  # newest last
    robot: RobotPhase = "unknown"
    robot_name: str = ""  # in rig.yaml
    speed_fraction: float | None = None
    camera_battery_fraction: float | None = None
    camera_free_bytes: int | None = None
    light_lux: float | None = None
    temperature_c: float | None = None
    disk_free_bytes: int | None = None
    pedal_armed: bool = False  # one press given; a second one lets the robot move

    def age_s(self) -> float:
        """Seconds since it was written."""
        return time.time() - self.at_utc_s

    def shown(self) -> tuple[object, ...]:
        """What a screen would show differently, in steps that people see: without this, noise redraws every page."""
        steps = {"light_lux": 0.05, "temperature_c": 0.2, "disk_free_bytes": 1e9, "camera_free_bytes": 1e9}
        seen = dict(self) | {"at_utc_s": 0.0}
        if self.light_lux:
            seen["light_lux"] = math.log(self.light_lux)
        return tuple(round(value / steps[name]) if name in steps and value else value for name, value in seen.items())

    @property
    def stale(self) -> bool:
        """Whether it no longer tells how things stand."""
        return self.age_s() > STALE_S


def _path(data: Path, run_id: str, suffix: str) -> Path:
    return data / "monitor" / f"{run_id}.{suffix}"


def log_path(data: Path, run_id: str) -> Path:
    """Where the output of a run's runner goes."""
    return _path(data, run_id, "log")


def write_snapshot(data: Path, run_id: str, snapshot: Snapshot) -> None:
    """Replace the file. Not durable: after a crash it says nothing. Raises OSError."""
    _replace(_path(data, run_id, "json"), snapshot.model_dump_json().encode())


def read_snapshot(data: Path, run_id: str) -> Snapshot:
    """The newest; an unknown one when there is none, or when its runner has fallen silent."""
    try:
        snapshot = Snapshot.model_validate_json(_path(data, run_id, "json").read_bytes())
    except (OSError, ValidationError):
        return Snapshot()
    if snapshot.stale and snapshot.doing != "ended":
        return snapshot.model_copy(update={"doing": "unknown", "robot": "unknown"})
    return snapshot


# --- live view: a frame for whoever looks, taken only while somebody does ---------------------------------------


def ask_for_frames(data: Path, run_id: str) -> None:
    """Somebody looks at the live view now. Raises OSError."""
    path = _path(data, run_id, "wanted")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def frames_wanted(data: Path, run_id: str, *, within_s: float = 3.0) -> bool:
    """Whether somebody has looked lately."""
    try:
        return time.time() - _path(data, run_id, "wanted").stat().st_mtime < within_s
    except OSError:
        return False


def write_frame(data: Path, run_id: str, jpeg: bytes) -> None:
    """Replace the newest frame. Raises OSError."""
    _replace(_path(data, run_id, "jpg"), jpeg)


def frame_path(data: Path, run_id: str) -> Path:
    """Where the newest frame lies, if any; its time of change says how old it is."""
    return _path(data, run_id, "jpg")


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    temporary.write_bytes(content)
    temporary.replace(path)
