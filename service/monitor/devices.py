"""What a runner sees of its open devices: the state of the robot, the light and the camera, as typed readings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from drivers.errors import DeviceError, LeaveNeededError, SafetyStopError
from drivers.interfaces import Camera, Lightbox, RobotArm, SafetyState
from service.core.geometry import Array
from service.monitor.snapshot import RobotPhase

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
    """The open robots' gravest state by their pose streams up to `now_s` (monotonic), which satisfies no watchdog."""
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
