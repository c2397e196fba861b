"""The RobotArm driver for KUKA arms with our Sunrise application; runs in the child of drivers.host."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections import deque
from typing import NoReturn

import numpy as np

from drivers.arm.latch import Latch
from drivers.arm.stream import MINIMUM_COVERAGE, PoseStream, judge, ringing_s
from drivers.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    SafetyStopError,
    UnreachablePoseError,
)
from drivers.interfaces import (
    Array,
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    Exchange,
    Payload,
    RobotSample,
    RobotState,
    Sample,
    SettleCriteria,
    SettleReport,
    Transform,
)
from drivers.kuka import KukaConfig
from drivers.kuka.fri.poses import FriPoses
from drivers.kuka.link import Link
from drivers.kuka.speeds import Speeds
from drivers.kuka.wire import JOINTS, Hello, State, agree, flange_words, to_abc
from service.core.arms import ArmModel, flange_pose, known_arms
from service.core.geometry import to_rotation_vector
from service.core.seven_axes import nearest_posture
from service.core.units import mm

DRIVER_VERSION = "1"
HEARTBEAT_S = 0.3  # the application stops the arm if no line comes for longer (docs/reference/kuka_protocol.md)
LONGEST_RINGING_S = 10.0
STOP_S = 5.0
FRAME_TOLERANCE_M = 0.0005
_REMEDY_STOP = "A person must find and clear the cause and release the stop on the smartPAD; then try again"


class KukaRobot:
    """One arm. A motion is a request with an ACK; its end is a line of its own, so that `stop` always works."""

    def __init__(self, config: KukaConfig) -> None:
        self._config = config
        self._where = f"{config.host}:{config.port}"
        self._latch = Latch(self._where)
        self._link: Link | None = None
        self._refused: Hello | None = None  # the greeting of an arm of a model that is not known
        self._stream: PoseStream | None = None
        self._arm: ArmModel | None = None  # as the application states it
        self._arrived: deque[RobotSample] = deque()  # from the link's thread to the stream's
        self._speeds = Speeds()
        self._fri: FriPoses | None = None
        self._state: State | None = None
        self._T_flange_tcp: Transform = np.eye(4)
        self._motion = 0  # the last one whose end was not observed yet
        self._last_motion = 0
        self._permitted = False
        self._attended_s = -np.inf
        self._left_alone = False

    # --- device ------------------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Connect and return the controller's identity.

        The arm can then be observed; it moves only after `let_move`. Raises DeviceUnavailableError,
        DeviceFaultError for an application of another version or an arm of another model, and DeviceRefusedError for
        an application without FRI if the configuration asks for it.
        """
        self.close()
        self._refused = None
        self._arrived.clear()
        self._speeds = Speeds()
        address = (self._config.host, self._config.port)
        self._link = link = Link(address, self._config.connect_timeout_s, self._receive)
        known = {arm.name: arm for arm in known_arms() if arm.family == "seven_axes"}
        if link.hello.model not in known:
            self._refused = link.hello  # a recording has the greeting of this arm as well
            self.close()
            remedy = f"Known are {', '.join(known)}"
            raise DeviceFaultError(f"the arm is a {link.hello.model!r}", where=self._where, remedy=remedy)
        self._arm = known[link.hello.model]
        self._stream = PoseStream(
            self._next_sample,
            stale_after_s=self._config.stale_after_s,
            where=self._where,
            vendor_errors=(ConnectionError,),
        )
        self._stream.await_first(self._config.connect_timeout_s)
        self._stream.latest()
        if self._config.fri_port is not None:
            self._listen(link, self._config.fri_port)
        return self._identity()

    def heartbeat(self, sent_monotonic_s: float) -> None:
        """Pass a heartbeat, sent at this host time.monotonic(), on to the controller.

        It is not passed on if it waited in a queue, or if nobody has looked at a moving arm for `unattended_s`.
        """
        now_s = time.monotonic()
        self._left_alone = bool(self._motion) and now_s - self._attended_s > self._config.unattended_s
        link = self._link
        if link is not None and now_s - sent_monotonic_s <= HEARTBEAT_S and not self._left_alone:
            link.beat()

    def close(self) -> None:
        """Stop any motion and disconnect; does not raise if the link is dead."""
        self._latch.close()
        self._permitted = False
        if self._link is not None and not self._link.death:
            with contextlib.suppress(DeviceError):
                self.stop()
        if self._fri is not None:
            self._fri.close()
        if self._stream is not None:
            self._stream.close()
        if self._link is not None:
            self._link.close()
        self._stream = self._link = self._state = self._fri = None
        self._motion = self._last_motion = 0

    def report(self) -> DeviceReport:
        """Return versions, clock offset, and what prevents the arm from moving."""
        sample = self._streaming().latest()
        state = self._newest()
        problems: list[str] = []
        if obstacle := self._obstacle() or self._latch.stop:
            problems.append(str(obstacle))
        if state.mode != "AUT":
            problems.append(
                f"The arm is in {state.mode}: in T1 the flange moves at 250 mm/s at most, and a person holds the "
                "enabling switch. Switch to AUT on the smartPAD when the motions have been checked"
            )
        if state.override < 1.0:
            problems.append(f"The override stands at {100 * state.override:.0f} %. Set it to 100 % on the smartPAD")
        problems += [*self._frame_problems(state), *(self._fri.problems() if self._fri is not None else [])]
        tcp = to_rotation_vector(self._T_flange_tcp)
        return DeviceReport(
            identity=self._identity(),
            clock_offset_s=self._streaming().clock_offset_s(),
            clock="uptime",
            details={
                "operating mode": state.mode,
                "safety": sample.safety.value,
                "override": f"{100 * state.override:.0f} %",
                "tool centre point (m, rad)": " ".join(f"{v:.4f}" for v in tcp),
                "joints (rad)": " ".join(f"{v:.4f}" for v in sample.joints_rad),
                "flange (X Y Z in mm, A B C in °)": flange_words(state.T_base_flange),
                **(self._fri.details() if self._fri is not None else {}),
            },
            problems=tuple(problems),
        )

    def _listen(self, link: Link, port: int) -> None:
        """Start the process that listens to FRI, and have the application send to it."""
        if problems := self._frame_problems(self._newest()):
            what, _, remedy = problems[0].partition(". ")
            raise DeviceFaultError(f"FRI's poses would be in another frame: {what}", where=self._where, remedy=remedy)
        host = self._config.fri_host or link.local_host
        self._fri = FriPoses((host, port), self._pose_of, self._newest)
        self._request("fri", host=host, port=port, period_ms=self._config.fri_period_ms)
        self._fri.await_first(self._config.connect_timeout_s)

    def _pose_of(self, joints_rad: Array) -> Transform:
        return flange_pose(self._arm or self._not_open(), joints_rad)

    def _frame_problems(self, state: State) -> list[str]:
        """Say whether the flange is where the joints have it; for an arm at rest, as the two are read in turn."""
        apart_m = float(np.linalg.norm((self._pose_of(state.joints_rad) - state.T_base_flange)[:3, 3]))
        if state.motion or apart_m < FRAME_TOLERANCE_M:
            return []
        return [
            f"The controller has the flange {mm(apart_m):.1f} mm from where its joints put it. Set "
            "the robot's base to the origin of the world in the station setup, and install it again"
        ]

    def answers(self) -> DeviceAnswers:
        """Return what the application greeted with, and the newest line of its stream.

        Of an arm that `open` refused for its model that is the greeting alone: how far its joints go is not known.
        """
        if self._link is None and self._refused is not None:
            return DeviceAnswers(
                exchanges=(_greeting(self._refused),), silent=("the stream: the model of the arm is not known",)
            )
        link, state = self._linked(), self._newest()
        now = f"mode {state.mode}, safety {state.safety_word}, ready {state.ready}, locked {state.locked}"
        return DeviceAnswers(
            exchanges=(_greeting(link.hello), Exchange(question="state", answer=now)),
            samples=(
                Sample(
                    source="stream",
                    fields={
                        "time_s": (state.time_s,),
                        "joints_rad": tuple(map(float, state.joints_rad)),
                        "commanded_rad": tuple(map(float, state.commanded_rad)),
                        "override": (state.override,),
                    },
                ),
            ),
        )

    def _identity(self) -> DeviceIdentity:
        hello = self._linked().hello
        return DeviceIdentity(
            "robot", hello.model, hello.serial, hello.software, "kuka_sunrise", DRIVER_VERSION, self._where
        )

    # --- arm -----------------------------------------------------------------------------------------------

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion after a person's confirmation; clears stops that ended before `not_before_monotonic_s`.

        Raises SafetyStopError or LeaveNeededError if a stop is active or was seen after that time.
        """
        sample = self._streaming().next()
        if not sample.safety.may_move:
            raise self._safety_error(sample)
        self._latch.let_move(confirmed_by, not_before_monotonic_s)
        self._motion = 0
        self._request("permit", by=confirmed_by)
        self._permitted = True

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Set the load and the tool centre point (4, 4, metres) and verify both as the controller answers them.

        Raises DeviceRefusedError if the controller rejects them, DeviceFaultError if they read back differently.
        """
        if obstacle := self._obstacle() or self._latch.stop:
            raise obstacle
        xyz_m, abc_rad = to_abc(np.asarray(T_flange_tcp, dtype=np.float64))
        wanted: dict[str, list[float]] = {
            "mass_kg": [payload.mass_kg],
            "centre_m": list(payload.centre_of_gravity_m),
            "tcp_xyz_m": xyz_m,
            "tcp_abc_rad": abc_rad,
        }
        answer = self._request("tool", **{**wanted, "mass_kg": payload.mass_kg})
        for name, values in wanted.items():
            if not agree(answer.get(name), values):
                raise DeviceFaultError(
                    f"{name} reads back as {answer.get(name)!r}, not {values}",
                    where=self._where,
                    remedy="Check on the smartPAD whether another program sets the tool; end it, then try again",
                )
        self._T_flange_tcp = np.array(T_flange_tcp, dtype=np.float64)

    def state(self) -> RobotState:
        """Return the newest sample with the controller's modes. Raises DeviceUnavailableError if it is stale."""
        self._attend()
        sample = self._streaming().latest()
        state = self._newest()
        return RobotState(
            sample=sample, robot_mode=state.mode, program_running=not state.locked, speed_fraction=state.override
        )

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return the buffered samples between two host times, oldest first; does not count as supervising the arm.

        They are those of FRI where it has them without a gap.
        """
        listened = self._fri.between(start_monotonic_s, end_monotonic_s) if self._fri is not None else ()
        return listened or self._streaming().between(start_monotonic_s, end_monotonic_s)

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Return joints (7,) for a flange pose, in radians: close to `near_rad`, the elbow clear of the limits.

        Raises UnreachablePoseError if there are none.
        """
        near = np.array(self._joints(near_rad))
        joints = nearest_posture(self._arm or self._not_open(), np.asarray(T_base_flange, dtype=np.float64), near)
        if joints is None:
            x, y, z = T_base_flange[:3, 3]
            raise UnreachablePoseError(
                f"the arm cannot reach the flange pose at ({x:.3f}, {y:.3f}, {z:.3f}) m in its base frame",
                where=self._where,
                remedy="Choose another viewpoint or move the station",
            )
        return joints

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint motion to `target_rad` (7,) and return at once.

        Raises SafetyStopError, LeaveNeededError, or DeviceRefusedError if the controller does not start it.
        """
        target = self._joints(target_rad)
        if hold := self._obstacle() or self._latch.hold:
            raise hold
        answer = self._request("move", q=target, speed_rad_s=speed_rad_s, acceleration_rad_s2=acceleration_rad_s2)
        motion = answer.get("motion")
        if not isinstance(motion, int):
            raise DeviceFaultError(f"the motion's number is {motion!r}", where=self._where, remedy=_REMEDY_STOP)
        self._attend()
        self._motion = self._last_motion = motion

    def stop(self) -> None:
        """Decelerate and return when the arm stands still. Raises DeviceTimeoutError if it does not come to rest."""
        link, motion = self._linked(), self._motion
        self._request("stop")
        deadline_s = time.monotonic() + STOP_S
        while motion and link.ended(motion) is None and not link.death:
            if time.monotonic() > deadline_s:
                remedy = "Press the stop key of the smartPAD"
                raise DeviceTimeoutError("the arm does not come to rest", where=self._where, remedy=remedy)
            time.sleep(0.005)

    def is_moving(self) -> bool:
        """Return whether the last motion is still under way.

        Raises the SafetyStopError or LeaveNeededError that interrupted it, or DeviceUnavailableError if the stream is
        stale.
        """
        self._attend()
        sample = self._streaming().latest()
        if not sample.safety.may_move:
            raise self._safety_error(sample)
        if not self._motion:
            return False
        ended = self._linked().ended(self._motion)
        if ended is None:
            return True
        if ended.code and ended.code != "stopped":
            if ended.code == "heartbeat" and self._left_alone:
                self._latch.end(f"{ended.what}: nobody had looked at it for {self._config.unattended_s:g} s")
            elif ended.code != "safety":
                self._latch.end(ended.what)
            self._motion = 0
            raise self._latch.stop or self._linked().error(ended.code, ended.what)
        self._motion = 0
        return False

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the last window of the pose stream against the criteria. Returns at once; meant to be polled."""
        self._attend()
        stream = self._streaming()
        now_s = stream.latest().monotonic_s
        # Stillness alone does not tell: the brakes may still be on before a motion begins, and the window may end
        # before a motion of which the end is known already.
        ended = self._linked().ended(self._last_motion)
        under_way = bool(self._last_motion) and (
            ended is None or now_s - ended.at_s < MINIMUM_COVERAGE * criteria.window_s
        )
        report = judge(self.samples(now_s - criteria.window_s, now_s), criteria)
        if under_way:
            report = dataclasses.replace(report, settled=False)
        if not report.settled:
            return report
        recent = self.samples(now_s - criteria.window_s - LONGEST_RINGING_S, now_s)
        return dataclasses.replace(report, ringing_s=ringing_s(recent, criteria))

    # --- parts -------------------------------------------------------------------------------------------

    def _receive(self, state: State, now_s: float) -> None:
        """Take a line of the stream (in the link's thread)."""
        self._latch.see(state.safety, now_s)
        if state.locked and self._permitted:
            self._permitted = False
            if state.safety.may_move and self._latch.stop is None and not self._motion:
                self._latch.end("the application has locked the arm")
        self._state = state
        self._arrived.append(self._speeds.sample(state, now_s))

    def _next_sample(self) -> RobotSample | None:
        if self._arrived:
            return self._arrived.popleft()
        if self._link is not None and self._link.death:
            raise ConnectionError(self._link.death)
        return None

    def _obstacle(self) -> DeviceError | None:
        """Return what prevents the arm from moving until a person resolves it; None if nothing does."""
        sample = self._streaming().latest()
        if not sample.safety.may_move:
            return self._safety_error(sample)
        if not self._newest().ready:
            return self._linked().error("not_ready", "the arm is not ready to move")
        return None

    def _safety_error(self, sample: RobotSample) -> SafetyStopError:
        name = sample.safety.value.replace("_", " ")
        return SafetyStopError(f"the arm is in {name}", where=self._where, remedy=_REMEDY_STOP)

    def _request(self, do: str, **fields: object) -> dict[str, object]:
        return dict(self._linked().request(do, self._config.answer_timeout_s, **fields))

    def _attend(self) -> None:
        self._attended_s = time.monotonic()

    def _linked(self) -> Link:
        return self._link or self._not_open()

    def _streaming(self) -> PoseStream:
        stream = self._stream or self._not_open()
        stream.catch_up()
        return stream

    def _newest(self) -> State:
        return self._state or self._not_open()

    def _not_open(self) -> NoReturn:
        raise DeviceUnavailableError("the robot is not connected", where=self._where, remedy="Open it first")

    def _joints(self, values: Array) -> list[float]:
        joints = np.asarray(values, dtype=np.float64)
        if joints.shape != (JOINTS,) or not np.all(np.isfinite(joints)):
            raise DeviceRefusedError(
                f"joints must be seven finite numbers, not {values}",
                where=self._where,
                remedy="Choose another viewpoint",
            )
        return [float(v) for v in joints]


def _greeting(hello: Hello) -> Exchange:
    return Exchange(question="greeting", answer=json.dumps(dataclasses.asdict(hello)))
