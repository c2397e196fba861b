"""The RobotArm driver for turntables and linear axes under GRBL 1.1; runs in the child of drivers.host."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import deque
from collections.abc import Iterable
from importlib.metadata import version
from typing import NoReturn

import numpy as np

from drivers.arm.stream import PoseStream, judge, ringing_s
from drivers.errors import (
    DeviceError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    UnreachablePoseError,
)
from drivers.grbl import GrblConfig
from drivers.grbl.axes import Axes
from drivers.grbl.homing import home
from drivers.grbl.link import Link
from drivers.grbl.mover import Mover
from drivers.grbl.setup import Setup, setup_of
from drivers.grbl.wire import FEED_HOLD, JOG_CANCEL, Feedback, Message, Setting, Status
from drivers.interfaces import (
    Array,
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    Exchange,
    Payload,
    RobotSample,
    RobotState,
    SettleCriteria,
    SettleReport,
    Transform,
)
from service.core.units import mm

LONGEST_RINGING_S = 10.0
STOP_S = 5.0


class GrblTable:
    """Axes that carry specimen or camera.

    The controller is locked after power-up and after each alarm. This driver never unlocks it: once a person has let
    the axes move, it homes them, which also finds the position again.
    """

    def __init__(self, config: GrblConfig) -> None:
        self._config = config
        self._where = config.port
        self._axes = Axes(config.axes, np.array(config.T_base_flange_zero))
        self._mover = Mover(self._where, config)
        self._link: Link | None = None
        self._stream: PoseStream | None = None
        self._setup: Setup | None = None
        self._told: tuple[Exchange, ...] = ()  # to `open`; kept where its settings did not suit
        self._arrived: deque[RobotSample] = deque()  # from the link's thread to the stream's
        self._before: RobotSample | None = None

    # --- device ------------------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Connect, reset the controller and read its settings; the axes can then be observed, and do not move.

        Raises DeviceUnavailableError, and DeviceFaultError for another firmware or unsuitable settings.
        """
        self.close()
        self._arrived.clear()
        self._before, self._told = None, ()
        self._link = link = Link(self._where, self._config, self._receive)
        try:
            link.reset(self._config.connect_timeout_s)
            settings = link.request(b"$$", self._config.answer_timeout_s)
            build = link.request(b"$I", self._config.answer_timeout_s)
            self._told = (*_exchanges("$$", settings), *_exchanges("$I", build))
            self._setup = setup_of(settings, build, self._config.axes, self._where)
            self._mover.connect(link, self._setup)
            self._stream = PoseStream(
                self._next_sample,
                stale_after_s=self._config.stale_after_s,
                where=self._where,
                vendor_errors=(ConnectionError,),
            )
            self._stream.latest()
        except DeviceError:
            self.close()
            raise
        return self._identity()

    def heartbeat(self, sent_monotonic_s: float) -> None:
        """Note a heartbeat that was sent at this host time.monotonic(): without one the axes are stopped."""
        self._mover.beat(sent_monotonic_s)

    def close(self) -> None:
        """Stop any motion and disconnect; does not raise if the link is dead."""
        if self._link is not None and not self._link.death and self._mover.moving:
            with contextlib.suppress(DeviceError):
                self.stop()
        self._mover.disconnect()
        if self._stream is not None:
            self._stream.close()
        if self._link is not None:
            self._link.close()
        self._stream = self._link = self._setup = None

    def report(self) -> DeviceReport:
        """Return versions and state, and what prevents the axes from moving."""
        setup = self._setup or self._not_open()
        status = self._mover.status or self._not_open()
        problems = list(setup.problems)
        if stop := self._mover.latch.stop:
            problems.append(str(stop))
        if self._mover.override < 1.0:
            problems.append(f"The feed override stands at {100 * self._mover.override:.0f} %. Set it to 100 %")
        return DeviceReport(
            identity=self._identity(),
            details={
                "state": status.state,
                "axes": " ".join(axis.letter for axis in self._config.axes),
                "position (° or mm)": self._position_words(),
            },
            problems=tuple(problems),
        )

    def answers(self) -> DeviceAnswers:
        """Ask for settings and build, as `open` does, and give the last status.

        If `open` failed because of them, returns what the controller answered then.
        """
        if self._link is None and self._told:
            return DeviceAnswers(exchanges=self._told)
        link, exchanges = self._linked(), list[Exchange]()
        for question in ("$$", "$I"):
            exchanges += _exchanges(question, link.request(question.encode(), self._config.answer_timeout_s))
        if (status := self._mover.status) is not None:
            exchanges.append(Exchange(question="?", answer=status.state))
        return DeviceAnswers(exchanges=tuple(exchanges))

    def _position_words(self) -> str:
        position = self._mover.position
        if position is None or not self._mover.homed:
            return "not known until the axes are homed, after a person has let them move"
        return " ".join(f"{c:.3f}" for c in position)

    def _identity(self) -> DeviceIdentity:
        setup = self._setup or self._not_open()
        letters = "".join(axis.letter for axis in self._config.axes)
        driver = f"pyserial {version('pyserial')}"
        return DeviceIdentity("robot", f"GRBL {letters}", setup.name, setup.build, "grbl", driver, self._where)

    # --- arm -----------------------------------------------------------------------------------------------

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion after a person's confirmation, and home the axes if their position is not known.

        Raises SafetyStopError or LeaveNeededError for a stop that is active or was seen after that time, and for
        homing that failed; DeviceUnavailableError if the line is dead.
        """
        link, mover = self._linked(), self._mover
        mover.refuse_while_door_is_open()
        if mover.status is not None and not mover.at_rest(mover.status):
            self.stop()  # still braking: a reset now would lose the position
        mover.latch.let_move(confirmed_by, not_before_monotonic_s)
        if mover.homed and mover.status is not None and mover.status.state == "Idle" and not link.unanswered:
            return
        mover.resetting = True
        try:
            link.reset(self._config.connect_timeout_s)  # after some alarms it hears nothing else
            if not mover.homed:
                home(link, lambda: mover.newest, self._config)
            mover.homed = True
        except DeviceError as error:
            if mover.latch.stop is None:  # not an alarm, which has stopped it already
                with contextlib.suppress(DeviceError):
                    link.reset(self._config.connect_timeout_s)
                mover.latch.end(f"homing failed ({error.what})")
            if isinstance(error, DeviceUnavailableError):  # a confirmation alone would not bring the line back
                raise
            raise (mover.latch.stop or error) from error
        finally:
            mover.resetting = False
        self._await_report()

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Do nothing: a GRBL controller knows neither load nor tool."""

    def state(self) -> RobotState:
        """Return the newest sample with the controller's state.

        Raises SafetyStopError in an alarm during which the controller reports nothing, DeviceUnavailableError if the
        reports are stale.
        """
        self._mover.attend()
        sample = self._latest()
        status = self._mover.status or self._not_open()
        ready = status.state in ("Idle", "Jog") and self._mover.homed
        return RobotState(sample, status.state, ready, self._mover.override)

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return the buffered samples between two host times, oldest first; does not count as supervision."""
        return self._streaming().between(start_monotonic_s, end_monotonic_s)

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Return the axes' values (N,), radians or metres, that bring the camera's mount closest to a pose.

        Raises UnreachablePoseError if it stays further away than rig.yaml allows.
        """
        values, distance_m, angle_rad = self._axes.nearest(np.asarray(T_base_flange), self._values(near_rad))
        angle_deg = float(np.degrees(angle_rad))
        if distance_m > self._config.reach_within_m or angle_deg > self._config.reach_within_deg:
            what = f"the axes bring the camera's mount only within {mm(distance_m):.0f} mm and {angle_deg:.1f}° of it"
            remedy = "Choose a viewpoint on the circle that the axes reach, or correct the rig file"
            raise UnreachablePoseError(what, where=self._where, remedy=remedy)
        return values

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a motion to the axes' values (N,), radians or metres, and return at once.

        Raises SafetyStopError, LeaveNeededError; DeviceRefusedError for a target out of range, or if the controller
        accelerates more than wanted. Its setting is not changed, because each change wears its memory.
        """
        setup = self._setup or self._not_open()
        target = self._axes.to_machine(self._values(target_rad))
        self._mover.require_ready()
        for i, axis in enumerate(self._config.axes):
            if not axis.lowest - 1e-6 <= target[i] <= axis.highest + 1e-6:
                what = f"axis {axis.letter} would go to {target[i]:.3f}, beyond {axis.lowest:g} to {axis.highest:g}"
                raise DeviceRefusedError(what, where=self._where, remedy="Choose another viewpoint")
            wanted = np.degrees(acceleration_rad_s2)
            if axis.turns and setup.acceleration[i] > wanted * (1 + 1e-6):
                given = f"{setup.acceleration[i]:g}°/s²"
                what = f"axis {axis.letter} accelerates by {given}, the protocol allows {wanted:.3g}"
                remedy = "Lower the setting $120, $121 … of the axis, or change the motion of the protocol"
                raise DeviceRefusedError(what, where=self._where, remedy=remedy)
        speeds = np.array(
            [np.degrees(speed_rad_s) if a.turns else mm(self._config.slide_speed_m_s) for a in self._config.axes]
        )
        # From a higher speed they would not stand in time if nobody were left to stop them.
        fastest = setup.acceleration * (self._config.rest_within_s - self._config.reaction_s)
        self._mover.begin(target, np.minimum(speeds, fastest))

    def stop(self) -> None:
        """Hold, drop what is left of the motion, and return when the axes stand.

        Raises DeviceTimeoutError if they do not come to rest.
        """
        link, mover = self._linked(), self._mover
        mover.abandon()
        since_s = time.monotonic()
        while not link.death:
            status, asked_s = mover.newest
            rests = status is not None and mover.at_rest(status)
            parsed = not link.unanswered or link.misses_answer(self._config.answer_timeout_s)  # or it was lost
            current = rests and parsed and asked_s > max(since_s, link.answered_s)
            if current and self._shown_since(asked_s):
                return
            if time.monotonic() > since_s + STOP_S:
                remedy = "Press the emergency stop of the machine"
                raise DeviceTimeoutError("the axes do not come to rest", where=self._where, remedy=remedy)
            if not rests or not parsed:  # again and again: a jog that was not parsed yet begins after the others
                link.act(FEED_HOLD if status is not None and status.state == "Run" else JOG_CANCEL)
            time.sleep(0.01)

    def is_moving(self) -> bool:
        """Return whether the last motion is still under way.

        Raises the SafetyStopError or LeaveNeededError that interrupted it, or DeviceUnavailableError if the line
        is dead or the reports are stale.
        """
        self._mover.attend()
        if self._mover.interrupted:
            if (stop := self._mover.latch.stop) is not None:
                raise stop
            self._linked().require_alive()
        moving = self._mover.moving
        # While the newest sample is older than the arrival, a caller would read where the axes were before it.
        return self._latest().monotonic_s < self._mover.arrived_s or moving

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the last window of the reports against the criteria. Returns at once; meant to be polled."""
        self._mover.attend()
        stream = self._streaming()
        now_s = self._latest().monotonic_s
        report = judge(stream.between(now_s - criteria.window_s, now_s), criteria)
        if self._mover.moving:
            report = dataclasses.replace(report, settled=False)
        if not report.settled:
            return report
        recent = stream.between(now_s - criteria.window_s - LONGEST_RINGING_S, now_s)
        return dataclasses.replace(report, ringing_s=ringing_s(recent, criteria))

    # --- parts -------------------------------------------------------------------------------------------

    def _receive(self, message: Message, at_s: float) -> None:
        """Take a status report, an alarm or a welcome (in the link's thread)."""
        self._mover.take(message, at_s)
        if not isinstance(message, Status) or self._mover.position is None:
            return
        values = self._axes.from_machine(self._mover.position.tolist())
        sample = self._sample(values, at_s)
        self._before = sample
        self._arrived.append(sample)

    def _sample(self, values: Array, at_s: float) -> RobotSample:
        T, before = self._axes.T_base_flange(values), self._before
        velocities, speed_m_s = np.zeros(len(values)), 0.0
        if before is not None:
            elapsed_s = max(at_s - before.controller_time_s, 1e-3)
            velocities = (values - before.joints_rad) / elapsed_s
            speed_m_s = float(np.linalg.norm(T[:3, 3] - before.T_base_flange[:3, 3])) / elapsed_s
        driven = self._mover.driven
        return RobotSample(
            controller_time_s=at_s,  # GRBL has no clock: when the report was asked for
            monotonic_s=at_s,
            joints_rad=values,
            joint_velocities_rad_s=velocities,
            target_velocities_rad_s=np.ones(len(values))
            if driven
            else np.zeros(len(values)),  # it states only whether
            T_base_flange=T,
            tcp_speed_m_s=speed_m_s,
            safety=self._mover.safety,
        )

    def _next_sample(self) -> RobotSample | None:
        if self._arrived:
            return self._arrived.popleft()
        if self._link is not None and self._link.death:
            raise ConnectionError(self._link.death)
        return None

    def _latest(self) -> RobotSample:
        try:
            return self._streaming().latest()
        except DeviceUnavailableError as error:
            if (stop := self._mover.latch.stop) is not None:  # in some alarms the controller reports nothing
                raise stop from error
            raise

    def _await_report(self) -> None:
        """Wait for a report that was asked for from now on; while it homes, the controller gives none."""
        since_s = time.monotonic()
        while not self._shown_since(since_s):
            if time.monotonic() > since_s + self._config.answer_timeout_s:
                what = "the controller reports nothing after it homed"
                raise DeviceTimeoutError(what, where=self._where, remedy="Check its cable, then reconnect")
            time.sleep(0.005)

    def _shown_since(self, asked_s: float) -> bool:
        """Return whether the newest sample is of a report that was asked for then or later."""
        newest = self._streaming().newest()
        return newest is not None and newest.monotonic_s >= asked_s

    def _linked(self) -> Link:
        return self._link or self._not_open()

    def _streaming(self) -> PoseStream:
        return self._stream or self._not_open()

    def _not_open(self) -> NoReturn:
        raise DeviceUnavailableError("the axes are not connected", where=self._where, remedy="Open them first")

    def _values(self, values: Array) -> Array:
        out = np.asarray(values, dtype=np.float64)
        if out.shape != (len(self._config.axes),) or not np.all(np.isfinite(out)):
            what = f"the axes need {len(self._config.axes)} finite numbers, not {values}"
            raise DeviceRefusedError(what, where=self._where, remedy="Choose another viewpoint")
        return out


def _exchanges(question: str, answers: Iterable[Setting | Feedback]) -> list[Exchange]:
    """The lines of an answer, each with its question."""
    lines = (f"${a.number}={a.value:.12g}" if isinstance(a, Setting) else f"[{a.text}]" for a in answers)
    return [Exchange(question=question, answer=line) for line in lines]
