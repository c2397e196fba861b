"""The RobotArm driver over ur_rtde (receive and control) and the dashboard; runs in the child of drivers.host."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import logging
import time
from collections.abc import Callable, Generator
from typing import TypeVar

import numpy as np

from drivers.arm.latch import Latch
from drivers.arm.stream import STREAM_HZ, PoseStream, driven, judge, ringing_s
from drivers.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    UnreachablePoseError,
)
from drivers.interfaces import (
    Array,
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    Payload,
    RobotSample,
    RobotState,
    SettleCriteria,
    SettleReport,
    Transform,
)
from drivers.ur import UrConfig
from drivers.ur import vendor as library
from drivers.ur.answers import answers_of
from drivers.ur.dashboard import ControllerFacts, Dashboard
from drivers.ur.link import VENDOR_ERRORS, probe, vendor
from drivers.ur.primary import Calibration, calibration_of
from drivers.ur.safety import safety_error
from drivers.ur.samples import (
    PLAYING,
    RESTART,
    VARIABLES,
    SampleReader,
    joint_values,
    joints_for,
    require_open,
    robot_mode,
    speed_fraction,
)
from drivers.ur.script import ControlScript
from drivers.ur.tool import SET_ELSEWHERE, read_back
from drivers.ur.watchdog import Watchdog
from service.core.arms import known_arm
from service.core.geometry import from_rotation_vector, inverse, to_rotation_vector

DRIVER_VERSION = "1"
TOOL_CHANGE_S = 0.05  # by the controller's clock, until a new tool shows in the stream
LONGEST_RINGING_S = 10.0  # how far back the end of the last motion is searched for
KINEMATICS_S = 2.0  # until the controller has stated with which calibration it computes
MOTION_START_S = 0.06  # until the target velocity of a new motion shows in the stream

_LOG = logging.getLogger(__name__)
T = TypeVar("T")


class UrRobot:
    """One arm. Motions are asynchronous, so that `stop` can interrupt them and the watchdog is kicked meanwhile."""

    def __init__(self, config: UrConfig) -> None:
        self._config = config
        self._where = config.host
        self._facts: ControllerFacts | None = None
        self._dashboard = Dashboard(config.host, config.connect_timeout_s)
        self._stream: PoseStream | None = None
        self._motion_started_s = -np.inf
        self._latch = Latch(config.host)
        self._samples = SampleReader(self._latch)
        self._watchdog = Watchdog(
            self._latch,
            watchdog_s=config.watchdog_s,
            unattended_s=config.unattended_s,
            newest=self._newest,
        )
        self._script = ControlScript(config, self._latch, self._watchdog, end_others=self._end_others)
        self._calibration: Calibration | None = None  # asked for by the first report of a connection
        self._configured: tuple[Payload, Transform] | None = None  # the tool as this driver set it
        self._tool_read = 0  # value of ControlScript.sent when the tool was last read

    # --- device ------------------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Connect and return the controller's identity.

        The arm can then be observed; it moves only after `let_move`, and never during a safety stop. Raises
        DeviceUnavailableError, and DeviceFaultError if the controller's software is too old.
        """
        self.close()
        probe(self._config.host, self._config.connect_timeout_s)
        self._facts = facts = self._dashboard.facts()
        self._calibration = None
        self._configured = None
        self._samples.tool.start(known_arm(facts.model))
        with vendor(self._where, "connecting the receive interface"):
            self._samples.read_from(library.receive(self._config.host, STREAM_HZ, list(VARIABLES)))
        self._stream = PoseStream(
            self._samples.read,
            stale_after_s=self._config.stale_after_s,
            where=self._where,
            vendor_errors=VENDOR_ERRORS,
        )
        self._stream.await_first(self._config.connect_timeout_s)
        if not (self._obstacle() or self._latch.stop):
            self._perform("starting the control script", lambda _: None)  # sends the script and reads the tool
            self._streaming().clear()  # of poses that were computed without it
        return self._identity()

    def heartbeat(self, sent_monotonic_s: float) -> None:
        """Pass a heartbeat, sent at this host time.monotonic(), on to the watchdog."""
        self._watchdog.beat(sent_monotonic_s)

    def close(self) -> None:
        """Stop any motion, then end the script and the connections; does not raise if the link is dead."""
        self._latch.close()
        stream = self._stream
        alive = stream is not None and stream.alive
        if alive:
            with contextlib.suppress(*VENDOR_ERRORS, DeviceError):
                self._script.stop_motion(self._driven_next)
        self._stream = None
        if stream is not None:
            stream.close()
        if alive:
            with contextlib.suppress(*VENDOR_ERRORS):
                self._script.end()
        else:
            self._script.abandon()
        receive, self._samples.receive = self._samples.receive, None
        with contextlib.suppress(*VENDOR_ERRORS):
            if receive is not None and receive.isConnected():
                receive.disconnect()

    def report(self) -> DeviceReport:
        """Return versions, clock offset, and what prevents the arm from moving."""
        state = self.state()
        problems: list[str] = []
        if obstacle := self._obstacle() or self._latch.stop:
            problems.append(str(obstacle))
        elif not self._script.connected or not state.program_running:
            problems.append("The control script does not run. Reconnect")
        if state.speed_fraction < 1.0:
            problems.append(
                f"The speed slider stands at {100 * state.speed_fraction:.0f} %: motions take longer. "
                "Set it to 100 % on the pendant"
            )
        if self._calibration is None:
            self._calibration = calibration_of(self._config.host, KINEMATICS_S)
        tcp, identity = to_rotation_vector(self._samples.tool.T_flange_tcp), self._identity()
        return DeviceReport(
            identity=identity,
            clock_offset_s=self._streaming().clock_offset_s(),
            clock="uptime",
            details={
                "robot mode": state.robot_mode,
                "safety": state.sample.safety.value,
                "speed slider": f"{100 * state.speed_fraction:.0f} %",
                "tool centre point (m, rad)": " ".join(f"{v:.4f}" for v in tcp),
                "calibration": self._calibration(known_arm(identity.model), state.sample.joints_rad),
                "joints (rad)": " ".join(f"{v:.4f}" for v in state.sample.joints_rad),
            },
            problems=tuple(problems),
        )

    def answers(self) -> DeviceAnswers:
        """Ask the dashboard, the primary interface and the stream; nothing is written."""
        return answers_of(self._where, self._dashboard, self._samples.receive, kinematics_s=KINEMATICS_S)

    def _identity(self) -> DeviceIdentity:
        facts = require_open(self._facts, self._where)
        library = f"ur_rtde {importlib.metadata.version('ur-rtde')}"
        version = f"{DRIVER_VERSION} ({library})"
        return DeviceIdentity("robot", facts.model, facts.serial, facts.software, "ur", version, self._where)

    # --- arm -----------------------------------------------------------------------------------------------

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion after a person's confirmation; clears stops that ended before `not_before_monotonic_s`.

        A tool that was changed elsewhere is set again. Raises SafetyStopError, LeaveNeededError or ToolChangedError
        if a stop is active, or for what was seen after that time; DeviceError if the tool cannot be set.
        """
        sample = self._streaming().next()
        if not sample.safety.may_move:
            raise safety_error(sample.safety, self._where)
        changed = self._latch.changed
        self._latch.let_move(confirmed_by, not_before_monotonic_s)
        self._watchdog.arrive()
        if changed is not None and self._configured is not None:
            try:
                self.configure(*self._configured)
            except DeviceError as error:
                self._latch.change(f"the tool was changed, and could not be set again: {error}")
                raise

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Set the payload and the tool centre point (4, 4, metres) and verify both by reading them back.

        Raises DeviceRefusedError if the controller rejects them, DeviceFaultError if they read back differently.
        """
        pose = to_rotation_vector(np.asarray(T_flange_tcp, dtype=np.float64))

        def set_both(control: library.Control) -> None:
            if not control.setTcp(pose.tolist()):
                raise self._refusal("the controller did not accept the tool centre point")
            if not control.setPayload(payload.mass_kg, list(payload.centre_of_gravity_m)):
                raise self._refusal(f"the controller did not accept the payload of {payload.mass_kg:g} kg")
            self._read_tool(control)

        tool = self._samples.tool
        with tool.changing(payload):
            self._perform("setting payload and tool", set_both)
            # The stream lags behind the answer: poses of the previous tool can still arrive.
            settled_s = self._streaming().latest().controller_time_s + TOOL_CHANGE_S
            while self._streaming().next().controller_time_s < settled_s:
                pass
            receive = require_open(self._samples.receive, self._where)
            read_back(
                lambda: abs(receive.getPayload() - payload.mass_kg) < 1e-6,
                f"payload of {payload.mass_kg:g} kg",
                self._where,
            )
        self._streaming().clear()
        difference = inverse(tool.T_flange_tcp) @ T_flange_tcp - np.eye(4)
        if float(np.max(np.abs(difference))) > 1e-6:
            raise DeviceFaultError(
                "the tool centre point reads back differently from what was set",
                where=self._where,
                remedy=SET_ELSEWHERE,
            )
        self._configured = (payload, np.asarray(T_flange_tcp, dtype=np.float64))

    def state(self) -> RobotState:
        """Return the newest sample with the controller's modes. Raises DeviceUnavailableError if it is stale."""
        self._watchdog.attend()
        sample = self._streaming().latest()
        receive = require_open(self._samples.receive, self._where)
        with vendor(self._where, "reading the state"):
            return RobotState(
                sample=sample,
                robot_mode=robot_mode(receive),
                program_running=receive.getRuntimeState() == PLAYING,
                speed_fraction=speed_fraction(receive),
            )

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return the buffered samples between two host times, oldest first; does not count as supervising the arm."""
        self._raise_if_changed()
        return self._streaming().between(start_monotonic_s, end_monotonic_s)

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Return the controller's joint solution (6,), in radians, for a flange pose, closest to `near_rad`.

        Checks first that a solution exists, because an unreachable pose would end the control script. Raises
        UnreachablePoseError if there is none, or if it lies beyond the safety limits.
        """
        near = joint_values(near_rad, self._where)

        def ask(control: library.Control) -> Array:
            try:
                return joints_for(control, T_base_flange, self._samples.tool.T_flange_tcp, near, self._where)
            except (UnreachablePoseError, DeviceFaultError):
                self._raise_unless_running(control)  # a script that ended is why
                raise

        return self._perform("inverse kinematics", ask)

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint motion to `target_rad` (6,) and return at once.

        Raises SafetyStopError, LeaveNeededError, or DeviceRefusedError if the controller does not start it.
        """
        target = joint_values(target_rad, self._where)
        self._begin("joint motion", lambda control: control.moveJ(target, speed_rad_s, acceleration_rad_s2, True))

    def stop(self) -> None:
        """Decelerate and return when the arm stands still; without a running script, stop the program by dashboard.

        Raises DeviceTimeoutError if the arm does not come to rest, DeviceRefusedError if the controller refuses,
        because it is in local control.
        """
        with vendor(self._where, "stopping the motion"):
            self._watchdog.look()
            if self._script.stop_motion(self._driven_next):
                return
        self._dashboard.stop()

    def is_moving(self) -> bool:
        """Return whether the last motion is still under way.

        Raises the SafetyStopError, LeaveNeededError or ToolChangedError that interrupted it, or
        DeviceUnavailableError if the stream is stale.
        """
        self._watchdog.attend()
        self._raise_if_changed()
        if self._driven(self._streaming().latest()) or time.monotonic() - self._motion_started_s < MOTION_START_S:
            return True
        if self._script.moves():
            return True
        # If the link has just died, the newest sample may predate the motion, and no program appears to run: only a
        # sample that arrives from now on proves that the arm is at rest.
        if self._driven(self._streaming().next()):
            return True
        if self._watchdog.moving:
            with vendor(self._where, "asking for the program"):
                self._watchdog.look()
            if stop := self._latch.stop:
                raise stop
            self._watchdog.arrive()
        return False

    def _driven(self, sample: RobotSample) -> bool:
        """Return whether the controller drives the arm in this sample. Raises SafetyStopError if it shows a stop."""
        if not sample.safety.may_move:
            raise safety_error(sample.safety, self._where)
        return driven(sample)

    def _driven_next(self) -> bool:
        return driven(self._streaming().next())

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the last window of the pose stream against the criteria. Returns at once; meant to be polled."""
        self._watchdog.attend()
        self._raise_if_changed()
        stream = self._streaming()
        now_s = stream.latest().monotonic_s
        report = judge(stream.between(now_s - criteria.window_s, now_s), criteria)
        if not report.settled:
            return report
        recent = stream.between(now_s - criteria.window_s - LONGEST_RINGING_S, now_s)
        return dataclasses.replace(report, ringing_s=ringing_s(recent, criteria))

    # --- parts -------------------------------------------------------------------------------------------

    def _streaming(self) -> PoseStream:
        return require_open(self._stream, self._where)

    def _newest(self) -> RobotSample | None:
        stream = self._stream  # another thread may set it to None
        return stream.newest() if stream is not None else None

    def _obstacle(self) -> DeviceError | None:
        """Return what prevents the arm from moving until a person resolves it; None if nothing does."""
        state = self.state()
        if not state.sample.safety.may_move:
            return safety_error(state.sample.safety, self._where)
        if state.robot_mode != "RUNNING":
            remedy = "Power the arm on and release its brakes on the pendant"
            return DeviceRefusedError(f"the arm is in mode {state.robot_mode}", where=self._where, remedy=remedy)
        # A controller in local control sends what it measures, and starts no program: one that runs was let start.
        return self._dashboard.obstacle(require_open(self._facts, self._where).version, running=state.program_running)

    def _end_others(self) -> None:
        self._dashboard.end_program(lambda: self.state().program_running)

    @contextlib.contextmanager
    def _commanding(self, doing: str, hold: DeviceError | None) -> Generator[library.Control]:
        with self._script.commanding(doing, hold) as control:
            if self._tool_read != self._script.sent:
                self._read_tool(control)
            yield control

    def _perform(self, doing: str, commands: Callable[[library.Control], T]) -> T:
        """Give commands that move nothing; retry once if the script lapsed meanwhile (see Watchdog.lapsed)."""
        try:
            with self._commanding(doing, self._obstacle() or self._latch.stop) as control:
                return commands(control)
        except DeviceError:
            with vendor(self._where, doing):
                if not self._watchdog.lapsed():
                    raise
        with self._commanding(doing, self._obstacle() or self._latch.stop) as control:
            return commands(control)

    def _read_tool(self, control: library.Control) -> None:
        with vendor(self._where, "reading the tool centre point"):
            pose = control.getTCPOffset()
        if len(pose) != 6:
            self._raise_unless_running(control)
            raise DeviceFaultError("the tool centre point cannot be read back", where=self._where, remedy=RESTART)
        self._samples.tool.state(from_rotation_vector(np.array(pose)))
        self._tool_read = self._script.sent

    def _begin(self, what: str, start: Callable[[library.Control], bool]) -> None:
        with self._commanding(f"starting the {what}", self._obstacle() or self._latch.hold) as control:
            self._motion_started_s = time.monotonic()
            self._watchdog.begin()
            if start(control):
                return
            self._motion_started_s = -np.inf
            self._watchdog.arrive()
            raise self._refusal(f"the controller did not start the {what}")

    def _refusal(self, what: str) -> DeviceError:
        """Why a call just returned False: a stop or a refusal. Raises DeviceUnavailableError for a lost link."""
        self._streaming().next()
        self._watchdog.excuse()
        if stop := self._obstacle() or self._latch.stop:
            return stop
        return DeviceRefusedError(what, where=self._where, remedy="See the log of the pendant for the reason")

    def _raise_unless_running(self, control: library.Control) -> None:
        if not control.isProgramRunning():
            raise self._refusal("the control script ended")

    def _raise_if_changed(self) -> None:
        if changed := self._latch.changed:
            raise changed
