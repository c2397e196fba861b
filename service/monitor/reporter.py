"""Gathers what the screens show of a run's devices and machine, and writes it to a file twice a second."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError, LeaveNeededError, SafetyStopError
from drivers.interfaces import Camera, Lightbox, RobotArm, SafetyState, TowerLight
from service.core.errors import OrthocaptureError
from service.core.run.state import WAITING_FOR_HAND
from service.monitor.alarm import Alarm
from service.monitor.heartbeat import Heartbeat
from service.monitor.snapshot import (
    STOPS,
    Asks,
    Doing,
    Message,
    RobotPhase,
    Snapshot,
    Standing,
    frames_wanted,
    write_frame,
    write_snapshot,
)

_log = logging.getLogger(__name__)
_EVERY_S = 0.4
_FRAME_S = 0.3
_LIGHT_S = 3.0
_CAMERA_S = 30.0  # reading the battery takes time that exposures need
_MESSAGES = 12
_QUIET_S = 1.0  # silence of the main loop, after which the heartbeat watches the robot
_WATCHED_S = 0.3  # length of the pose stream that shows whether the arm moves
_STOPS: Mapping[SafetyState, RobotPhase] = {
    SafetyState.PROTECTIVE_STOP: "protective_stop",
    SafetyState.SAFEGUARD_STOP: "safeguard_stop",
    SafetyState.EMERGENCY_STOP: "emergency_stop",
    SafetyState.FAULT: "fault",
    SafetyState.UNKNOWN: "unknown",
}


_TOWER: Mapping[Standing, TowerLight] = {
    "works": TowerLight.WORKING,
    "waits": TowerLight.WAITING,
    "stopped": TowerLight.STOPPED,
    "ended": TowerLight.OFF,
}


@dataclass(frozen=True, slots=True)
class OpenDevices:
    """The devices open at this moment, by role and name in rig.yaml; none is opened just to be shown."""

    robots: Mapping[str, RobotArm] = field(default_factory=dict[str, RobotArm])
    cameras: Mapping[str, Camera] = field(default_factory=dict[str, Camera])
    lightboxes: Mapping[str, Lightbox] = field(default_factory=dict[str, Lightbox])


@dataclass
class Reporter:
    """Told by the runner's thread what goes on; heartbeat threads keep writing it while that thread is busy.

    Only the runner's thread talks to devices, with one exception: while it is in a long call, a heartbeat thread
    reads the pose stream, which satisfies no watchdog (`RobotArm.samples`). A device that does not answer is shown as
    "unknown"; a failure to write the file is logged. Neither disturbs the capture.
    """

    data: Path
    run_id: str
    devices: Callable[[], OpenDevices]
    camera: Callable[[], Camera]  # opens it, for the live view that somebody asked for
    alarm: Alarm | None = None
    outcome: str = "its program ended before the run did"  # the final alert's text
    monotonic_s: Callable[[], float] = time.monotonic
    _news: tuple[Message, ...] = ()
    _progress: tuple[str, int, int] = ("", 0, 0)
    _activity: tuple[str, float] = ("", 0.0)
    _newest: Snapshot = field(default_factory=lambda: Snapshot(doing="starting"))
    _watched: tuple[float, dict[str, Any]] = (
        0.0,
        {},
    )  # time, and the robot's state then
    _writing: threading.Lock = field(default_factory=threading.Lock)
    _heartbeat: Heartbeat = field(init=False)
    _known: dict[str, Any] = field(default_factory=dict[str, Any])
    _due_s: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        self._heartbeat = Heartbeat(self.beat, self.watch)

    def begin(self) -> None:
        """Write twice a second from now on, until `end`."""
        self._newest = self._newest.model_copy(update={"attended_utc_s": time.time()})
        self.busy("starting")
        self._heartbeat.begin()

    def show(self, what: str, done: int, total: int) -> None:
        """Set the progress of the work under way."""
        self._progress = (what, done, total)

    def busy(self, what: str) -> None:
        """Announce a call of the main loop that may take long."""
        self._activity = (what, time.time())

    def tell(self, message: str) -> None:
        """Add one message."""
        news = Message(at_utc=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"), text=message)
        self._news = (*self._news, news)[-_MESSAGES:]
        self._due_s.pop("snapshot", None)

    def attend(
        self, doing: Doing, step: str, attempt: int, *, pedal_armed: bool = False, asks: Asks = "", words: str = ""
    ) -> None:
        """Called by the main loop between calls: read the devices and write the snapshot if it is due.

        Args:
            asks: what people are asked for now; "" for nothing.
            words: the question, or what goes on, for alerts.
        """
        self._activity = ("", 0.0)
        changed = (doing, step, attempt, pedal_armed, asks) != self._known.get("at")
        if not changed and not self._due("snapshot", _EVERY_S):
            return
        if changed and self._known.get("at", ("", ""))[1] != step:
            self._progress = ("", 0, 0)
        self._known["at"] = (doing, step, attempt, pedal_armed, asks)
        devices = self.devices()
        robot = self._robot(devices)
        if doing == "paused" and robot["robot"] == "moving":
            doing = "pausing"
        now_s = time.time()
        self._newest = Snapshot(
            at_utc_s=now_s,
            attended_utc_s=now_s,
            robot_utc_s=now_s,
            pid=getpid(),
            doing=doing,
            step=step,
            attempt=attempt,
            pedal_armed=pedal_armed,
            asks=asks,
            question=words,
            **robot,
            **self._light(devices),
            **self._camera(devices),
            disk_free_bytes=shutil.disk_usage(self.data).free,
        )
        self.beat()
        self._tower(devices, self._newest.standing)
        if self.alarm is not None:
            self.alarm.follow(self._newest.standing, self._elsewhere())
        if doing in ("asking", "paused") or self._progress[0] == WAITING_FOR_HAND:
            self._frame()

    def beat(self) -> None:
        """Write the last known state with the current time."""
        (what, done, total), (activity, since_s) = self._progress, self._activity
        with self._writing:
            newest, (watched_s, robot) = self._newest, self._watched
            if newest.doing == "ended":
                return
            told: dict[str, Any] = {
                "at_utc_s": time.time(), "pid": getpid(), "what": what, "done": done, "total": total,
                "messages": self._news, "activity": activity, "activity_utc_s": since_s,
            }  # fmt: skip
            if watched_s > newest.robot_utc_s:
                told |= {"robot_utc_s": watched_s, **robot}
            snapshot = newest.model_copy(update=told)
            self._write(lambda: write_snapshot(self.data, self.run_id, snapshot))

    def watch(self) -> None:
        """Read the robot's pose stream while the main loop is in a long call. May block on the robot."""
        newest = self._newest
        if time.time() - newest.attended_utc_s < _QUIET_S or newest.doing == "ended":
            return
        asked_s = time.time()
        for name, robot in self.devices().robots.items():
            now_s = self.monotonic_s()
            try:
                samples = robot.samples(now_s - _WATCHED_S, now_s)
            except DeviceError:
                samples = ()
            phase: RobotPhase = "unknown"
            if samples:
                first, last = samples[0], samples[-1]
                moves = _turns(last.joint_velocities_rad_s) or _turns(last.joints_rad - first.joints_rad)
                phase = _STOPS.get(last.safety) or ("moving" if moves else "standing")
            self._watched = (asked_s, {"robot": phase, "robot_name": name})
            return
        self._watched = (asked_s, {"robot": "not_connected"})

    def _elsewhere(self) -> str:
        """The run's state in a few words, for alerts."""
        newest = self._newest
        if newest.robot in STOPS:
            return f"the robot reports: {newest.robot.replace('_', ' ')}"
        return newest.question or ("paused" if newest.doing == "paused" else newest.step)

    def end(self) -> None:
        """Write the final state and stop; called when the runner ends, for whatever reason."""
        step, attempt = self._known.get("at", ("", "", 0, False, ""))[1:3]
        self._tower(self.devices(), "ended")
        with self._writing:
            self._newest = Snapshot(
                at_utc_s=time.time(), pid=getpid(), doing="ended", step=step, attempt=attempt, messages=self._news
            )
            self._write(lambda: write_snapshot(self.data, self.run_id, self._newest))
        self._heartbeat.end()
        if self.alarm is not None:
            self.alarm.follow("ended", self.outcome)
            self.alarm.close()

    def _robot(self, devices: OpenDevices) -> dict[str, Any]:
        for name, robot in devices.robots.items():
            try:
                state = robot.state()
                stop = _STOPS.get(state.sample.safety)
                moving = stop is None and _moves(robot)
            except DeviceError:
                return {"robot": "unknown", "robot_name": name}
            phase: RobotPhase = stop or (
                "moving" if moving or _turns(state.sample.joint_velocities_rad_s) else "standing"
            )
            return {"robot": phase, "robot_name": name, "speed_fraction": state.speed_fraction}
        return {"robot": "not_connected"}

    def _tower(self, devices: OpenDevices, standing: Standing) -> None:
        """Set the signal tower; a light box without one, or one that does not answer, is ignored."""
        light = _TOWER[standing]
        for box in devices.lightboxes.values():
            if light == self._known.get("tower") or self.monotonic_s() < self._due_s.get("tower", 0.0):
                continue
            try:
                box.show_tower(light)
            except DeviceError as error:
                _log.warning("the signal tower cannot be switched: %s", error)
                self._due_s["tower"] = self.monotonic_s() + _CAMERA_S
            else:
                self._known["tower"] = light

    def _light(self, devices: OpenDevices) -> Mapping[str, Any]:
        for box in devices.lightboxes.values():
            if self._due("light", _LIGHT_S):
                try:
                    reading = box.read()
                except DeviceError:
                    self._known["light"] = {}
                else:
                    self._known["light"] = {"light_lux": reading.light_lux, "temperature_c": reading.temperature_c}
        return self._known.get("light", {})

    def _camera(self, devices: OpenDevices) -> Mapping[str, Any]:
        for camera in devices.cameras.values():
            if self._due("camera", _CAMERA_S):
                try:
                    report = camera.report()
                except DeviceError:
                    self._known["camera"] = {}
                else:
                    self._known["camera"] = {
                        "camera_battery_fraction": report.battery_fraction,
                        "camera_free_bytes": report.free_bytes,
                    }
        return self._known.get("camera", {})

    def _frame(self) -> None:
        """Write a frame of the live view while somebody looks; only when the camera is idle."""
        if not frames_wanted(self.data, self.run_id) or not self._due("frame", _FRAME_S):
            return
        try:
            jpeg = self.camera().preview()
        except OrthocaptureError as error:
            self.tell(f"the live view does not work: {error}")
            self._due_s["frame"] = self.monotonic_s() + _CAMERA_S
            return
        self._write(lambda: write_frame(self.data, self.run_id, jpeg))

    def _due(self, what: str, every_s: float) -> bool:
        now_s = self.monotonic_s()
        if now_s < self._due_s.get(what, 0.0):
            return False
        self._due_s[what] = now_s + every_s
        return True

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            _log.warning("the state for the screens cannot be written: %s", error)


def _moves(robot: RobotArm) -> bool:
    try:
        return robot.is_moving()
    except (SafetyStopError, LeaveNeededError):  # its motion was cut short; whoever started it gets the same error
        return False


def _turns(velocities_rad_s: Any) -> bool:
    return bool(abs(velocities_rad_s).max() > 0.001)
