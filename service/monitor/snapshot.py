"""Keeps what runners and workers reported last: small files, replaced atomically, that other processes read."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import socket
from pathlib import Path
from typing import Any, Literal

import psutil
from pydantic import ValidationError

from service.core.records.base import Record, age_s
from service.store.durable_effects import Clock

STALE_S = 5.0
STARTING_S = 120.0  # time to load everything when started, also on a busy machine
LASTING_S = 1.5  # an activity is shown once it has lasted this long; otherwise every motion would redraw the page
_QUIET_STEP_S = 5.0
Doing = Literal["starting", "asking", "working", "pausing", "paused", "ended", "unknown"]
Asks = Literal["", "confirm", "sign", "recovery"]
Standing = Literal["works", "waits", "stopped", "ended"]  # for the tower and for alerts
RobotPhase = Literal[
    "not_connected", "standing", "moving", "protective_stop", "safeguard_stop", "emergency_stop", "fault", "unknown"
]


STOPS = frozenset({"protective_stop", "safeguard_stop", "emergency_stop", "fault"})


class Message(Record):
    """One message with its time."""

    at_utc: str
    text: str


class Snapshot(Record):
    """A runner's report on itself, its devices and its machine. Unknown values are None or "unknown".

    A heartbeat thread writes it (`at_utc_s`) and states since when the main loop has been in a long call
    (`attended_utc_s`), which call that is, and when the robot was last heard from.
    """

    at_utc_s: float = 0.0
    attended_utc_s: float = 0.0  # 0: same as at_utc_s
    robot_utc_s: float = 0.0  # 0: same as attended_utc_s
    starved_s: float = 0.0  # seconds for which the main loop waited for a processor since its last report
    activity: str = ""  # the long call of the main loop, in words
    activity_utc_s: float = 0.0  # the time when it began
    pid: int = 0
    doing: Doing = "unknown"
    step: str = ""
    attempt: int = 0
    what: str = ""  # the work that `done` and `total` count
    done: int = 0
    total: int = 0
    messages: tuple[Message, ...] = ()  # newest last
    robot: RobotPhase = "unknown"
    robot_name: str = ""  # the name in rig.yaml
    speed_fraction: float | None = None
    camera_battery_fraction: float | None = None
    camera_free_bytes: int | None = None
    light_lux: float | None = None
    temperature_c: float | None = None
    disk_free_bytes: int | None = None
    asks: Asks = ""  # the thing that people are asked for now
    question: str = ""
    pedal_armed: bool = False  # pressed once; a second press lets the robot move

    def age_s(self, now_utc_s: float) -> float:
        """Return the seconds since it was written, by now."""
        return now_utc_s - self.at_utc_s

    def shown(self) -> tuple[object, ...]:
        """Return what a screen shows, rounded to visible steps: without rounding, noise would redraw every page."""
        steps = {"light_lux": 0.05, "temperature_c": 0.2, "disk_free_bytes": 1e9, "camera_free_bytes": 1e9}
        seen: dict[str, Any] = dict(self) | {"at_utc_s": 0.0, "activity_utc_s": 0.0, "activity": self.lasting}
        seen |= {"attended_utc_s": self.quiet_s // _QUIET_STEP_S, "robot_utc_s": self.robot_silent_s > STALE_S}
        seen["starved_s"] = self.starved_s // _QUIET_STEP_S
        if self.light_lux:
            seen["light_lux"] = math.log(self.light_lux)
        return tuple(round(value / steps[name]) if name in steps and value else value for name, value in seen.items())

    def stale(self, now_utc_s: float) -> bool:
        """Return whether it is too old by now to show the current state, or is from before the clock was set back."""
        return abs(self.age_s(now_utc_s)) > (STARTING_S if self.doing == "starting" else STALE_S)

    @property
    def standing(self) -> Standing:
        """The run's state as far as the runner knows: works, waits for a person, stopped or ended."""
        if self.doing == "ended":
            return "ended"
        if self.asks == "recovery" or self.robot in STOPS:
            return "stopped"
        return "waits" if self.doing in ("asking", "paused") else "works"

    @property
    def quiet_s(self) -> float:
        """Seconds since the main loop's last report, when this was written."""
        return max(0.0, self.at_utc_s - self.attended_utc_s) if self.attended_utc_s else 0.0

    def unattended_s(self, now_utc_s: float) -> float:
        """Return the seconds since the main loop's last report, by now; infinity if the clock was set back since."""
        return age_s(self.at_utc_s, now_utc_s, if_set_back_s=math.inf) + self.quiet_s

    @property
    def robot_silent_s(self) -> float:
        """Seconds since the robot was last heard from, when this was written."""
        return max(0.0, self.at_utc_s - self.robot_utc_s) if self.robot_utc_s else self.quiet_s

    @property
    def lasting(self) -> str:
        """The activity, once it has lasted long enough to be shown; otherwise ""."""
        return self.activity if self.activity_s >= LASTING_S else ""

    @property
    def activity_s(self) -> float:
        """Seconds that the activity had lasted when this was written."""
        return max(0.0, self.at_utc_s - self.activity_utc_s) if self.activity else 0.0


def _path(data: Path, run_id: str, suffix: str) -> Path:
    return data / "monitor" / f"{run_id}.{suffix}"


def log_path(data: Path, run_id: str) -> Path:
    """Return the path of the file that takes the output of a run's runner."""
    return _path(data, run_id, "log")


def write_snapshot(data: Path, run_id: str, snapshot: Snapshot) -> None:
    """Replace the file; not durable, since it means nothing after a crash. Raises OSError."""
    _replace(_path(data, run_id, "json"), snapshot.model_dump_json().encode())


def read_snapshot(data: Path, run_id: str, now_utc_s: float) -> Snapshot:
    """Return the latest snapshot; an unknown one if there is none, or if its runner has by now fallen silent."""
    try:
        snapshot = Snapshot.model_validate_json(_path(data, run_id, "json").read_bytes())
    except (OSError, ValidationError):
        return Snapshot()
    if snapshot.stale(now_utc_s) and snapshot.doing != "ended":
        return snapshot.model_copy(update={"doing": "unknown", "robot": "unknown"})
    return snapshot


# --- live view: frames are taken only while somebody looks --------------------------------------------------------


def ask_for_frames(data: Path, run_id: str, camera: str = "") -> None:
    """Note that somebody is looking at the live view of a camera now; "": the first one. Raises OSError."""
    _replace(_path(data, run_id, "wanted"), camera.encode())


def frames_wanted(data: Path, run_id: str, now_utc_s: float, *, within_s: float = 3.0) -> str | None:
    """Return the camera whose live view was last looked at within this time; "": the first one; None: none was."""
    path = _path(data, run_id, "wanted")
    try:
        age = age_s(path.stat().st_mtime, now_utc_s, if_set_back_s=math.inf)
        return path.read_text() if age < within_s else None
    except OSError:
        return None


def write_frame(data: Path, run_id: str, jpeg: bytes, camera: str = "") -> None:
    """Replace the latest frame of a camera. Raises OSError."""
    _replace(frame_path(data, run_id, camera), jpeg)


def frame_path(data: Path, run_id: str, camera: str = "") -> Path:
    """Return the path of a camera's latest frame, which may not exist; its modification time shows its age."""
    named = f"{hashlib.sha256(camera.encode()).hexdigest()[:16]}." if camera else ""
    return _path(data, run_id, f"{named}jpg")


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    temporary.write_bytes(content)
    temporary.replace(path)


_EVERY_S = 2.0
_STALE_S = 15.0
_log = logging.getLogger(__name__)


class WorkerSign(Record):
    """A worker's report on itself; `kinds` are those of the jobs that it was started for, empty: all."""

    host: str
    pid: int
    at_utc_s: float
    jobs_done: int
    kinds: tuple[str, ...] = ()

    def lives(self, now_utc_s: float) -> bool:
        """Return whether the worker has reported lately, by now, and is not known to be dead."""
        if self.host == socket.gethostname() and not psutil.pid_exists(self.pid):
            return False
        return abs(now_utc_s - self.at_utc_s) <= _STALE_S


class SignOfLife:
    """This process's file. A failure to write is logged and disturbs no computation."""

    def __init__(self, data: Path, clock: Clock, kinds: tuple[str, ...] = ()) -> None:
        self._clock, self._kinds = clock, kinds
        self._path = _folder(data) / f"{socket.gethostname()}-{os.getpid()}.json"
        self._due_s = 0.0

    def give(self, jobs_done: int) -> None:
        """Write it, if it is due."""
        now_s = self._clock.monotonic_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _EVERY_S
        now_utc_s = self._clock.utc_s()
        host, pid = socket.gethostname(), os.getpid()
        sign = WorkerSign(host=host, pid=pid, at_utc_s=now_utc_s, jobs_done=jobs_done, kinds=self._kinds)
        part = self._path.with_suffix(".part")
        try:
            part.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(sign.model_dump_json())
            part.replace(self._path)
        except OSError as error:
            _log.warning("the worker's sign of life cannot be written: %s", error)

    def close(self) -> None:
        """Remove it."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def living_workers(data: Path, clock: Clock) -> list[WorkerSign]:
    """Return the workers of a data folder that are alive, as far as is known; removes the files of dead ones."""
    now_utc_s = clock.utc_s()
    found: list[WorkerSign] = []
    for path in sorted(_folder(data).glob("*.json")):
        try:
            sign = WorkerSign.model_validate_json(path.read_bytes())
        except (OSError, ValidationError):
            continue
        if sign.lives(now_utc_s):
            found.append(sign)
        elif sign.host == socket.gethostname():
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    return found


def _folder(data: Path) -> Path:
    return data / "monitor" / "workers"
