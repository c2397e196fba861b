"""An in-memory rig for tests of the runner: arm, camera, light box, and an operator who answers from a script."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError, DeviceUnavailableError, UnreachablePoseError
from drivers.interfaces import (
    Camera,
    CameraSettings,
    CapturedFile,
    CapturedImage,
    CtSource,
    Device,
    DeviceIdentity,
    DeviceReport,
    Lightbox,
    Payload,
    RobotArm,
    RobotSample,
    RobotState,
    SafetyState,
    Scanner,
    SettleCriteria,
    SettleReport,
)
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform, from_rotation_vector, to_rotation_vector, transform
from service.core.records.import_list import ImportList
from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import HandWork, RunState
from service.monitor.snapshot import Doing
from service.rig import CollisionSection, LensSection, OpticsSection
from service.runner.held_run import AnswerBy
from service.steps.context import ConnectionEnd, FurtherCamera, LeaveToMove, StationLayout
from service.store.durable_effects import Clock, SystemClock
from tests.support.rig.bench_lightbox import BenchLightbox

TRAVEL_S = 0.02
EXPOSURE_S = 0.02  # from the release to the arrival of the file
_RATE_HZ = 500.0


def _nothing(_count: int) -> None:
    pass


@dataclass
class BenchArm:
    """An arm whose six joints are the flange's position and rotation vector, so that its kinematics are exact.

    A motion takes TRAVEL_S; the stream is the arm's actual motion, sampled at 500 Hz.
    """

    clock: Clock = field(default_factory=SystemClock)
    serial: str = "A-1"
    safety: SafetyState = SafetyState.NORMAL
    on_move: Callable[[int], None] = _nothing  # called with the number of the motion once it has begun
    reachable: Callable[[Transform], bool] = lambda _T: True
    connected: bool = False
    opened: int = 0
    moves: int = 0
    stops: int = 0
    stopped_short: int = 0
    configured: int = 0
    let_by: list[str] = field(default_factory=list[str])
    _legs: list[tuple[float, Array, float, Array]] = field(default_factory=list[tuple[float, Array, float, Array]])

    def __post_init__(self) -> None:
        start = np.array([0.1, 0.4, 0.5, 0.0, 3.0, 0.0])
        self._legs.append((-np.inf, start, -np.inf, start))

    def open(self) -> DeviceIdentity:
        self.connected, self.opened = True, self.opened + 1
        return self.report().identity

    def close(self) -> None:
        self.connected = False

    def report(self) -> DeviceReport:
        return DeviceReport(DeviceIdentity("robot", "Bench arm", self.serial, "5.12", "bench", "1", "memory"))

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        self.let_by.append(confirmed_by)

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        self.configured += 1

    def state(self) -> RobotState:
        self._answer()
        return RobotState(self._sample(self.clock.monotonic_s()), "RUNNING", self.is_moving(), 1.0)

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        self._answer()
        count = int((min(end_monotonic_s, self.clock.monotonic_s() + 0.05) - start_monotonic_s) * _RATE_HZ)
        return tuple(self._sample(start_monotonic_s + i / _RATE_HZ) for i in range(count))

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        if not self.reachable(T_base_flange):
            raise UnreachablePoseError("no joint solution for this pose", where="arm")
        return to_rotation_vector(T_base_flange)

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        self._answer()
        now = self.clock.monotonic_s()
        self._legs.append((now, self._joints(now), now + TRAVEL_S, target_rad))
        self.moves += 1
        self.on_move(self.moves)

    def dawdle(self) -> None:
        """Make the current motion take ten seconds, so that a test has time to stop it on any machine."""
        start_s, start, _, target = self._legs[-1]
        self._legs[-1] = (start_s, start, start_s + 10.0, target)

    def push(self, by_rad: float, *, joint: int = 2) -> None:
        """Let somebody push a joint by hand, as in free drive; a motion under way ends there."""
        at_s = max(self.clock.monotonic_s(), self._legs[-1][2])
        there = self._joints(at_s).copy()
        there[joint] += by_rad
        self._legs.append((at_s, there, at_s, there))

    def stop(self) -> None:
        self.stops += 1
        if self.is_moving():
            self.stopped_short += 1
            now = self.clock.monotonic_s()
            here = self._joints(now)
            self._legs.append((now, here, now, here))

    def is_moving(self) -> bool:
        return self.clock.monotonic_s() < self._legs[-1][2]

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        now = self.clock.monotonic_s()
        still = now - self._legs[-1][2] > criteria.window_s
        joints = self._joints(now)
        return SettleReport(still, 10, 0.0, 0.0, 0.0, 0.0, from_rotation_vector(joints), joints)

    def _answer(self) -> None:
        if not self.connected:
            raise DeviceUnavailableError("the arm is not connected", where="arm")

    def _joints(self, at_s: float) -> Array:
        begun, origin, end, target = next((leg for leg in reversed(self._legs) if leg[0] <= at_s), self._legs[0])
        if at_s >= end:  # exactly at the target, wherever it came from
            return target
        return origin + (at_s - begun) / (end - begun) * (target - origin)

    def _sample(self, at_s: float) -> RobotSample:
        joints, zeros = self._joints(at_s), np.zeros(6)
        pose = from_rotation_vector(joints)
        return RobotSample(at_s - 100.0, at_s, joints, zeros, zeros, pose, 0.0, self.safety)


def numbered(exposure: int) -> NDArray[np.uint8]:
    """A small picture showing a number."""
    picture = np.full((40, 60, 3), 255, dtype=np.uint8)
    cv2.putText(picture, str(exposure), (5, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0))
    return picture


@dataclass
class BenchCamera:
    """A camera that writes a small real JPEG, a different one each time."""

    clock: Clock = field(default_factory=SystemClock)
    serial: str = "C-1"
    on_capture: Callable[[int], None] = _nothing  # called with the exposure's number; may raise
    exif: Callable[[CameraSettings], CameraSettings] = lambda applied: applied
    picture: Callable[[int], NDArray[np.uint8]] = numbered  # of the exposure with this number
    connected: bool = False
    opened: int = 0
    exposures: int = 0
    arrivals_s: list[float] = field(default_factory=list[float])  # monotonic time of each image that arrived
    applied: CameraSettings | None = None
    # Presses of its own button that were not collected yet; not None: settings to which the dials were turned.
    pressed: list[CameraSettings | None] = field(default_factory=list[CameraSettings | None])

    def open(self) -> DeviceIdentity:
        self.connected, self.opened = True, self.opened + 1
        return self.report().identity

    def close(self) -> None:
        self.connected, self.applied = False, None

    def report(self) -> DeviceReport:
        return DeviceReport(DeviceIdentity("camera", "Bench camera", self.serial, "2.0", "bench", "1", "memory"))

    def apply(self, settings: CameraSettings) -> CameraSettings:
        if not self.connected:
            raise DeviceUnavailableError("the camera is not connected", where="camera")
        self.applied = settings
        return settings

    def settings(self) -> CameraSettings:
        return self.apply(self.applied or CameraSettings(8.0, 0.01, 400))

    def capture(self, folder: Path) -> CapturedImage:
        self.exposures += 1
        trigger = self.clock.monotonic_s()
        try:
            self.on_capture(self.exposures)
        except DeviceUnavailableError:
            self.connected = False
            raise
        if not self.connected or self.applied is None:
            raise DeviceUnavailableError("the camera is not connected or was not set", where="camera")
        picture = self.picture(self.exposures)
        path = folder / f"DSC{self.exposures:05d}.JPG"
        assert cv2.imwrite(str(path), picture)
        self.clock.sleep(EXPOSURE_S)
        self.arrivals_s.append(self.clock.monotonic_s())
        data = path.read_bytes()
        jpeg = CapturedFile(path, path.name, hashlib.sha256(data).hexdigest(), len(data), "image/jpeg")
        return CapturedImage(
            files=(jpeg,),
            counter=self.exposures,
            exif_time=f"2026:11:21 10:00:{self.exposures:02d}",
            exif=self.exif(self.applied),
            lens="Bench 50 mm",
            focal_length_mm=50.0,
            trigger_monotonic_s=trigger,
            arrival_monotonic_s=self.clock.monotonic_s(),
        )

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        pressed, self.pressed = self.pressed, []
        images: list[CapturedImage] = []
        for number, dialled in enumerate(pressed):
            inside = folder / str(number)
            inside.mkdir()
            if dialled is not None:
                self.applied = dialled
            images.append(self.capture(inside))
        return tuple(images)

    def preview(self) -> bytes:
        raise NotImplementedError


@dataclass
class BenchRig:
    """service.steps.context.Devices with these in-memory devices."""

    arm: BenchArm = field(default_factory=BenchArm)
    shutter: BenchCamera = field(default_factory=BenchCamera)
    card: Camera | None = None  # instead of it: a camera without a cable
    box: BenchLightbox | None = field(default_factory=BenchLightbox)
    further: tuple[FurtherCamera, ...] = ()
    ended: list[ConnectionEnd] = field(default_factory=list[ConnectionEnd])  # of which the runner is told next
    _on_open: Callable[[str, DeviceReport], None] | None = None

    def keep_time(self, clock: Clock) -> None:
        """Let all devices live by this clock."""
        self.arm.clock = self.shutter.clock = clock
        if self.box is not None:
            self.box.clock = clock
        for one in self.further:
            assert isinstance(one.camera, BenchCamera)
            one.camera.clock = clock

    def robot(self, station: str) -> RobotArm:
        self._open("robot", self.arm, opened=self.arm.opened > 0)
        return self.arm

    def camera(self) -> Camera:
        if self.card is not None:
            return self.card
        self._open("camera", self.shutter, opened=self.shutter.opened > 0)
        return self.shutter

    def camera_named(self, name: str) -> Camera:
        if not name:
            return self.camera()
        return next(one.camera for one in self.further if one.name == name)

    def further_cameras(self) -> tuple[FurtherCamera, ...]:
        for one in self.further:
            shutter = one.camera
            assert isinstance(shutter, BenchCamera)
            self._open(one.name, shutter, opened=shutter.opened > 0)
        return self.further

    def imported(self) -> ImportList | None:
        """No imported files."""
        return None

    def scanner(self, name: str | None = None) -> Scanner:
        raise ConfigurationError("the bench has no scanner")

    def ct(self) -> CtSource:
        raise ConfigurationError("the bench has no CT")

    def lightbox(self) -> Lightbox | None:
        return self.box

    def layout(self, station: str) -> StationLayout:
        return StationLayout(station, "robot", (0.0, 0.8, 0.0), (0.0, -1.0, 0.0))

    def nominal_T_flange_camera(self) -> Transform:
        return transform(np.eye(3), np.array([0.0, 0.0, 0.1]))

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        return CollisionSection(), None

    def lens(self) -> LensSection | None:
        return LensSection(focal_length_mm=50, sensor_width_mm=35.7, image_px=(900, 600))

    def let_move(self, leave: LeaveToMove) -> None:
        self.arm.let_move(leave.by, leave.not_before_monotonic_s)

    def watch(self, on_open: Callable[[str, DeviceReport], None], before_open: Callable[[str], None]) -> None:
        self._on_open = on_open

    def ended_connections(self) -> tuple[ConnectionEnd, ...]:
        ended, self.ended = tuple(self.ended), []
        return ended

    def hold_arms(self) -> None:
        if self.arm.connected:
            self.arm.stop()
            self.arm.close()
            self.arm.opened = 0  # it is opened anew when a step asks for it

    def reopen(self, device: Device) -> None:
        device.close()
        name = "robot" if device is self.arm else "lightbox" if device is self.box else "camera"
        self._open(name, device, opened=False)

    def _open(self, name: str, device: Device, *, opened: bool) -> None:
        if not opened:
            device.open()
            try:
                if self._on_open is not None:
                    self._on_open(name, device.report())
            except DeviceError:  # as a station does: the next caller opens it from scratch
                device.close()
                vars(device)["opened"] = 0
                raise


Answer = Callable[[AskOperator, RunState], OperatorAction | None]


def agree(question: AskOperator, _state: RunState) -> OperatorAction | None:
    """Confirm with every item ticked, or sign; questions about recovery are left to the test."""
    if question.for_ == "recovery":
        raise AssertionError(f"an unexpected question: {question.text}")
    return answer(question, question.for_)


def answer(question: AskOperator, verb: str, **fields: object) -> OperatorAction:
    """An action on the step that the question is about."""
    full: dict[str, object] = {"action": verb, "step": question.step, **fields}
    if verb == "confirm":
        full.setdefault("checklist", question.checklist)
    if verb == "sign":
        full.setdefault("meaning", "I have read the figures")
        full.setdefault("signed_sha256", question.sign_sha256)
    return OperatorAction.model_validate(full)


@dataclass
class ScriptedOperator:
    """Answers each (step, kind of question) from a script, one answer after the other; agrees otherwise."""

    script: Mapping[tuple[str, str], list[Answer]] = field(default_factory=dict[tuple[str, str], list[Answer]])
    name: str = "Ada"
    on_show: Callable[[str], None] = lambda _what: None
    on_attend: Callable[[Doing], None] = lambda _doing: None
    on_prepare: Callable[[], None] = lambda: None
    asked: list[AskOperator] = field(default_factory=list[AskOperator])
    told: list[str] = field(default_factory=list[str])
    busy_with: list[str] = field(default_factory=list[str])
    attended: list[tuple[Doing, bool]] = field(default_factory=list[tuple[Doing, bool]])
    prepared: list[tuple[str, int]] = field(default_factory=list[tuple[str, int]])
    mended: list[tuple[str, int, tuple[HandWork, ...]]] = field(
        default_factory=list[tuple[str, int, tuple[HandWork, ...]]]
    )

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        self.asked.append(question)
        answers = self.script.get((question.step, question.for_), [])
        return (answers.pop(0) if answers else agree)(question, state)

    def show(self, what: str, done: int, total: int) -> None:
        self.on_show(what)

    def tell(self, message: str) -> None:
        self.told.append(message)

    def busy(self, what: str) -> None:
        self.busy_with.append(what)

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        if not self.attended or self.attended[-1] != (doing, pedal_armed):
            self.attended.append((doing, pedal_armed))
        self.on_attend(doing)

    def stuck(self, why: str, for_s: float) -> None:
        assert for_s < 600, f"the run waits for nothing: {why}"

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        return question.checklist

    def prepare(self, step: str, attempt: int) -> None:
        self.prepared.append((step, attempt))
        self.on_prepare()

    def mend(self, step: str, attempt: int, hands: Sequence[HandWork]) -> None:
        self.mended.append((step, attempt, tuple(hands)))


def other_settings(applied: CameraSettings) -> CameraSettings:
    """EXIF of a camera whose ISO dial was turned."""
    return replace(applied, iso=applied.iso * 2)
