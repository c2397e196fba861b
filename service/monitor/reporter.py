"""Gathers what the screens show of a run's devices and machine, and writes it to a file twice a second."""

from __future__ import annotations

import ctypes
import logging
import math
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from os import getpid
from pathlib import Path

from drivers.errors import DeviceError, LeaveNeededError, SafetyStopError
from drivers.interfaces import Camera, Lightbox, RobotArm, SafetyState, TowerLight
from drivers.machine_pressure import processor_time
from service.core.errors import OrthocaptureError
from service.core.geometry import Array
from service.core.records.run_events import HostClock
from service.core.run.state import WAITING_FOR_HAND
from service.core.units import seconds_of_us
from service.monitor.alarm import Alarm
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
from service.store.durable_effects import Clock, SystemClock

_SYSTEM_TIME = re.compile(r"^System time\s*:\s*([0-9.]+) seconds (fast|slow) of NTP time", re.MULTILINE)
_LEAP = re.compile(r"^Leap status\s*:\s*(.+?)\s*$", re.MULTILINE)
_TIMEOUT_S = 3.0
_STA_UNSYNC = 0x40
_NOT_SET_S = 16.0  # the kernel's value for an unknown error


def host_clock() -> HostClock:
    """Return the clock's state now; unknown values are None. Never raises."""
    return _of_chrony() or _of_kernel()


def _of_chrony() -> HostClock | None:
    program = shutil.which("chronyc")
    if program is None:
        return None
    try:
        done = subprocess.run(
            [program, "-n", "tracking"],
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=True,
            env={**os.environ, "LC_ALL": "C"},
        )
    except (OSError, subprocess.SubprocessError):
        return None
    found, leap = _SYSTEM_TIME.search(done.stdout), _LEAP.search(done.stdout)
    if found is None:
        return None
    offset_s = float(found[1]) if found[2] == "fast" else -float(found[1])
    synchronised = leap is not None and leap[1] != "Not synchronised"
    return HostClock(source="chrony", synchronised=synchronised, offset_s=offset_s if synchronised else None)


class _Timex(ctypes.Structure):
    """The beginning of struct timex of adjtimex(2), with padding for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror_us", ctypes.c_long),
        ("esterror_us", ctypes.c_long),
        ("status", ctypes.c_int),
        ("room", ctypes.c_char * 256),
    )


def _of_kernel() -> HostClock:
    """Read whether the clock is synchronised, and the kernel's bound of its error; the kernel knows no offset."""
    nothing = HostClock(source="", synchronised=None, offset_s=None)
    if not sys.platform.startswith("linux"):
        return nothing
    found = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(found)) < 0:
        return nothing
    synchronised = not found.status & _STA_UNSYNC
    error_s = seconds_of_us(found.maxerror_us)
    return HostClock(
        source="kernel",
        synchronised=synchronised,
        offset_s=None,
        error_s=error_s if synchronised and error_s < _NOT_SET_S else None,
    )


def processor_s() -> float:
    """Return the seconds that this thread has computed or waited for a processor, if the system reports waits."""
    try:
        times = processor_time(threading.get_native_id())
    except OSError:
        return time.thread_time()
    return times.computed_s + times.waited_s


def waited_s(thread: int) -> float:
    """Return the seconds that a thread (its native id) has waited for a processor; 0 if the system does not say."""
    try:
        return processor_time(thread).waited_s
    except OSError:
        return 0.0


_WATCHED_S = 0.3  # length of the pose stream that shows whether the arm moves
_STILL_RAD_S = 0.001  # joints that turn more slowly stand still
# Of several arms the first of these is told; the others could otherwise move beside "The robot stands still".
_GRAVEST: tuple[RobotPhase, ...] = (
    "emergency_stop", "protective_stop", "safeguard_stop", "fault", "unknown", "moving", "standing", "not_connected",
)  # fmt: skip
_STOPS: Mapping[SafetyState, RobotPhase] = {
    SafetyState.PROTECTIVE_STOP: "protective_stop",
    SafetyState.SAFEGUARD_STOP: "safeguard_stop",
    SafetyState.EMERGENCY_STOP: "emergency_stop",
    SafetyState.FAULT: "fault",
    SafetyState.UNKNOWN: "unknown",
}


@dataclass(frozen=True, slots=True)
class OpenDevices:
    """The devices open at this moment, by role and name in rig.yaml; none is opened just to be shown."""

    robots: Mapping[str, RobotArm] = field(default_factory=dict[str, RobotArm])
    cameras: Mapping[str, Camera] = field(default_factory=dict[str, Camera])
    lightboxes: Mapping[str, Lightbox] = field(default_factory=dict[str, Lightbox])


@dataclass(frozen=True, slots=True)
class RobotReading:
    """The state of the open robot with the gravest one; `name` is that in rig.yaml."""

    phase: RobotPhase = "not_connected"
    name: str = ""
    speed_fraction: float | None = None


@dataclass(frozen=True, slots=True)
class LightReading:
    """The light and the temperature at the light box; None if it did not answer."""

    light_lux: float | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, slots=True)
class CameraReading:
    """Charge of the battery (0 … 1) and free memory of the camera; None if it did not answer."""

    battery_fraction: float | None = None
    free_bytes: int | None = None


def read_robot(devices: OpenDevices) -> RobotReading:
    """Ask the open robots for their states, and return the gravest; "unknown" of one that does not answer."""
    return _gravest(_asked(name, robot) for name, robot in devices.robots.items())


def watch_robot(devices: OpenDevices, now_s: float) -> RobotReading:
    """Return the open robots' gravest state by their pose streams up to `now_s` (monotonic). No watchdog is fed."""
    return _gravest(_watched(name, robot, now_s) for name, robot in devices.robots.items())


def _gravest(readings: Iterable[RobotReading]) -> RobotReading:
    return min(readings, key=lambda reading: _GRAVEST.index(reading.phase), default=RobotReading())


def _asked(name: str, robot: RobotArm) -> RobotReading:
    try:
        state = robot.state()
        stop = _STOPS.get(state.sample.safety)
        moving = stop is None and _moves(robot)
    except DeviceError:
        return RobotReading("unknown", name)
    turning = moving or _turns(state.sample.joint_velocities_rad_s)
    return RobotReading(stop or ("moving" if turning else "standing"), name, state.speed_fraction)


def _watched(name: str, robot: RobotArm, now_s: float) -> RobotReading:
    try:
        samples = robot.samples(now_s - _WATCHED_S, now_s)
    except DeviceError:
        samples = ()
    if not samples:
        return RobotReading("unknown", name)
    first, last = samples[0], samples[-1]
    turning = _turns(last.joint_velocities_rad_s) or _turns(last.joints_rad - first.joints_rad)
    return RobotReading(_STOPS.get(last.safety) or ("moving" if turning else "standing"), name)


def read_light(box: Lightbox) -> LightReading:
    """Ask a light box for its reading."""
    try:
        reading = box.read()
    except DeviceError:
        return LightReading()
    return LightReading(reading.light_lux, reading.temperature_c)


def read_camera(camera: Camera) -> CameraReading:
    """Ask a camera for its report."""
    try:
        report = camera.report()
    except DeviceError:
        return CameraReading()
    return CameraReading(report.battery_fraction, report.free_bytes)


def _moves(robot: RobotArm) -> bool:
    try:
        return robot.is_moving()
    except (SafetyStopError, LeaveNeededError):  # its motion was cut short; whoever started it gets the same error
        return False


def _turns(joints: Array) -> bool:
    return bool(abs(joints).max() > _STILL_RAD_S)


class Heartbeat:
    """Calls each function repeatedly in a thread of its own, so that one that blocks does not hold up the others."""

    def __init__(self, clock: Clock, *works: Callable[[], None], every_s: float = 0.5) -> None:
        self._every_s = every_s
        self._stop = clock.signal()
        self._threads = [
            threading.Thread(target=self._run, args=(work,), name="reporter heartbeat", daemon=True) for work in works
        ]

    def begin(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def end(self, within_s: float = 2.0) -> None:
        """Make no further calls. A thread blocked by a device is left behind and ends with the process."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(within_s)

    def _run(self, work: Callable[[], None]) -> None:
        while not self._stop.is_set():
            work()
            self._stop.wait(self._every_s)


_log = logging.getLogger(__name__)
_EVERY_S = 0.4
_FRAME_S = 0.3
_LIGHT_S = 3.0
_CAMERA_S = 30.0  # reading the battery takes time that exposures need
_MESSAGES = 12
_QUIET_S = 1.0  # silence of the main loop, after which the heartbeat watches the robot
_TOWER: Mapping[Standing, TowerLight] = {
    "works": TowerLight.WORKING,
    "waits": TowerLight.WAITING,
    "stopped": TowerLight.STOPPED,
    "ended": TowerLight.OFF,
}


@dataclass(frozen=True, slots=True)
class _Moment:
    """The last report of the main loop; a change of it is written at once."""

    doing: Doing = "unknown"
    step: str = ""
    attempt: int = 0
    pedal_armed: bool = False
    asks: Asks = ""


@dataclass
class Reporter:
    """Writes what the runner's thread reports; heartbeat threads go on writing it while that thread is busy.

    Only the runner's thread talks to devices, with one exception: while it is in a long call, a heartbeat thread
    reads the pose stream, which satisfies no watchdog (`RobotArm.samples`). A device that does not answer is shown as
    "unknown"; a failure to write the file is logged. Neither disturbs the capture.
    """

    data: Path
    run_id: str
    devices: Callable[[], OpenDevices]
    camera: Callable[[str], Camera]  # opens it by its name, for the live view that somebody asked for; "": the first
    alarm: Alarm | None = None
    outcome: str = "its program ended before the run did"  # the final alert's text
    clock: Clock = field(default_factory=SystemClock)
    _news: tuple[Message, ...] = ()
    _progress: tuple[str, int, int] = ("", 0, 0)
    _activity: tuple[str, float] = ("", 0.0)
    _newest: Snapshot = field(default_factory=lambda: Snapshot(doing="starting"))
    _attended_s: float = field(init=False)  # monotonic time of the main loop's last report
    _watched: tuple[float, RobotReading] = (-math.inf, RobotReading())  # monotonic time, and the robot's state then
    _writing: threading.Lock = field(default_factory=threading.Lock)
    _heartbeat: Heartbeat = field(init=False)
    _moment: _Moment | None = None
    _attends: tuple[int, float] = (0, 0.0)  # the main loop's thread, and how long it had waited for a processor
    _tower_light: TowerLight | None = None  # the light that the signal tower shows
    _light: LightReading = field(default_factory=LightReading)
    _camera: CameraReading = field(default_factory=CameraReading)
    _due_s: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        self._attended_s = self.clock.monotonic_s()
        self._heartbeat = Heartbeat(self.clock, self.beat, self.watch)

    def begin(self) -> None:
        """Write twice a second from now on, until `end`."""
        self._attended_s = self.clock.monotonic_s()
        self.busy("starting")
        self._heartbeat.begin()

    def show(self, what: str, done: int, total: int) -> None:
        """Set the progress of the work under way."""
        self._progress = (what, done, total)

    def busy(self, what: str) -> None:
        """Announce a call of the main loop that may take long."""
        self._activity = (what, self.clock.monotonic_s())

    def tell(self, message: str) -> None:
        """Add one message."""
        news = Message(at_utc=self.clock.utc_now().strftime("%Y-%m-%dT%H:%M:%SZ"), text=message)
        self._news = (*self._news, news)[-_MESSAGES:]
        self._due_s.pop("snapshot", None)

    def attend(
        self, doing: Doing, step: str, attempt: int, *, pedal_armed: bool = False, asks: Asks = "", words: str = ""
    ) -> None:
        """Read the devices and write the snapshot if it is due; the main loop calls this between its calls.

        Args:
            asks: the thing that people are asked for now; "" for nothing.
            words: the text of the question, or of what goes on, for alerts.
        """
        self._activity = ("", 0.0)
        thread = threading.get_native_id()
        self._attends = (thread, waited_s(thread))
        moment, before = _Moment(doing, step, attempt, pedal_armed, asks), self._moment
        if moment == before and not self._due("snapshot", _EVERY_S):
            return
        if before is None or before.step != step:
            self._progress = ("", 0, 0)
        self._moment = moment
        devices = self.devices()
        newest = self._snapshot(moment, words, devices)
        with self._writing:
            self._newest, self._attended_s = newest, self.clock.monotonic_s()
        self.beat()
        self._tower(devices, self._newest.standing)
        if self.alarm is not None:
            self.alarm.follow(self._newest.standing, self._elsewhere())
        if self._newest.doing in ("asking", "paused") or self._progress[0] == WAITING_FOR_HAND:
            self._frame()

    def _snapshot(self, moment: _Moment, words: str, devices: OpenDevices) -> Snapshot:
        """Return the state now, with readings of the devices that are due."""
        robot = read_robot(devices)
        # What a device told that is not connected any more is not the present state of anything.
        self._light = self._light if devices.lightboxes else LightReading()
        self._camera = self._camera if devices.cameras else CameraReading()
        for box in devices.lightboxes.values():
            if self._due("light", _LIGHT_S):
                self._light = read_light(box)
        for camera in devices.cameras.values():
            if self._due("camera", _CAMERA_S):
                self._camera = read_camera(camera)
        return Snapshot(
            at_utc_s=self.clock.utc_s(),
            pid=getpid(),
            doing="pausing" if moment.doing == "paused" and robot.phase == "moving" else moment.doing,
            step=moment.step,
            attempt=moment.attempt,
            pedal_armed=moment.pedal_armed,
            asks=moment.asks,
            question=words,
            robot=robot.phase,
            robot_name=robot.name,
            speed_fraction=robot.speed_fraction,
            light_lux=self._light.light_lux,
            temperature_c=self._light.temperature_c,
            camera_battery_fraction=self._camera.battery_fraction,
            camera_free_bytes=self._camera.free_bytes,
            disk_free_bytes=shutil.disk_usage(self.data).free,
        )

    def beat(self) -> None:
        """Write the last known state with the current time."""
        (what, done, total), (activity, since_s) = self._progress, self._activity
        with self._writing:
            newest, attended_s, (watched_s, robot) = self._newest, self._attended_s, self._watched
            if newest.doing == "ended":
                return
            now_utc_s = self.clock.utc_s()
            ahead_s = now_utc_s - self.clock.monotonic_s()  # as of now: the clock may have been set since
            told: dict[str, object] = {
                "at_utc_s": now_utc_s, "pid": getpid(), "what": what, "done": done, "total": total,
                "messages": self._news, "activity": activity, "activity_utc_s": ahead_s + since_s,
                "attended_utc_s": ahead_s + attended_s, "robot_utc_s": ahead_s + max(attended_s, watched_s),
                "starved_s": self._starved_s(),
            }  # fmt: skip
            if watched_s > attended_s:
                told |= {"robot": robot.phase, "robot_name": robot.name}
            snapshot = newest.model_copy(update=told)
            self._write(lambda: write_snapshot(self.data, self.run_id, snapshot))

    def _starved_s(self) -> float:
        """Return how long the main loop has waited for a processor since it last reported."""
        thread, waited_before_s = self._attends
        return waited_s(thread) - waited_before_s if thread else 0.0

    def watch(self) -> None:
        """Read the robot's pose stream while the main loop is in a long call. May block on the robot."""
        asked_s = self.clock.monotonic_s()
        if asked_s - self._attended_s < _QUIET_S or self._newest.doing == "ended":
            return
        self._watched = (asked_s, watch_robot(self.devices(), self.clock.monotonic_s()))

    def _elsewhere(self) -> str:
        """Return the run's state in a few words, for alerts."""
        newest = self._newest
        if newest.robot in STOPS:
            return f"the robot reports: {newest.robot.replace('_', ' ')}"
        return newest.question or ("paused" if newest.doing == "paused" else newest.step)

    def end(self) -> None:
        """Write the final state and stop; called when the runner ends, for whatever reason."""
        last = self._moment or _Moment()
        self._tower(self.devices(), "ended")
        with self._writing:
            self._newest = Snapshot(
                at_utc_s=self.clock.utc_s(),
                pid=getpid(),
                doing="ended",
                step=last.step,
                attempt=last.attempt,
                messages=self._news,
            )
            self._write(lambda: write_snapshot(self.data, self.run_id, self._newest))
        self._heartbeat.end()
        if self.alarm is not None:
            self.alarm.follow("ended", self.outcome)
            self.alarm.close()

    def _tower(self, devices: OpenDevices, standing: Standing) -> None:
        """Set the signal tower; a light box without one, or one that does not answer, is ignored."""
        light = _TOWER[standing]
        for box in devices.lightboxes.values():
            if light == self._tower_light or self.clock.monotonic_s() < self._due_s.get("tower", 0.0):
                continue
            try:
                box.show_tower(light)
            except DeviceError as error:
                _log.warning("the signal tower cannot be switched: %s", error)
                self._due_s["tower"] = self.clock.monotonic_s() + _CAMERA_S
            else:
                self._tower_light = light

    def _frame(self) -> None:
        """Write a frame of the live view while somebody looks; only when the camera is idle."""
        wanted = frames_wanted(self.data, self.run_id, self.clock.utc_s())
        if wanted is None or not self._due("frame", _FRAME_S):
            return
        try:
            jpeg = self.camera(wanted).preview()
        except OrthocaptureError as error:
            self.tell(f"the live view does not work: {error}")
            self._due_s["frame"] = self.clock.monotonic_s() + _CAMERA_S
            return
        self._write(lambda: write_frame(self.data, self.run_id, jpeg, wanted))

    def _due(self, what: str, every_s: float) -> bool:
        now_s = self.clock.monotonic_s()
        if now_s < self._due_s.get(what, 0.0):
            return False
        self._due_s[what] = now_s + every_s
        return True

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            _log.warning("the state for the screens cannot be written: %s", error)
