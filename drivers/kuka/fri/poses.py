"""The driver's side of FRI: starts the listening process, and keeps what it tells as samples of the pose stream."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from drivers.arm.stream import BUFFER_S, within
from drivers.errors import DeviceUnavailableError
from drivers.interfaces import Array, RobotSample, SafetyState, Transform
from drivers.kuka.fri.sample import SIZE, FriSample, unpack
from drivers.kuka.fri.wire import Session
from drivers.kuka.speeds import Speeds
from drivers.kuka.wire import State

LONGEST_GAP_S = 0.1  # with a longer one the samples of FRI are not used
STALE_S = 1.0
_LOG = logging.getLogger(__name__)


class FriPoses:
    """A process that listens, a thread that reads what it tells, and the samples of the last BUFFER_S seconds.

    The poses are those of the arm's nominal kinematics at the measured joints.

    Args:
        address: host and UDP port of this machine.
        pose_of: T_base_flange (4, 4) of joints (7,).
        newest: the application's newest state, which has what FRI does not tell.

    Raises:
        DeviceUnavailableError: the port cannot be listened at.
    """

    def __init__(
        self, address: tuple[str, int], pose_of: Callable[[Array], Transform], newest: Callable[[], State]
    ) -> None:
        self._where = f"{address[0]}:{address[1]}"
        self._pose_of, self._newest = pose_of, newest
        self._lock = threading.Lock()
        self._speeds = Speeds()
        self._samples: deque[RobotSample] = deque()
        self._last: FriSample | None = None
        path = os.pathsep.join(p for p in sys.path if p)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "drivers.kuka.fri", address[0], str(address[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path},
        )
        assert self._process.stdout is not None
        told = self._process.stdout.readline().decode("utf-8", "replace").strip()
        if told != "ready":
            self.close()
            remedy = "End the program that listens there, or set fri_host to an address of this machine"
            raise DeviceUnavailableError(f"FRI: {told or 'its process ended'}", where=self._where, remedy=remedy)
        threading.Thread(target=self._read, name="fri", daemon=True).start()

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()  # at which it ends
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def await_first(self, timeout_s: float) -> None:
        """Wait for the first message, or until it is clear that none comes; `problems` then says why."""
        deadline_s = time.monotonic() + timeout_s
        while self._last is None and time.monotonic() < deadline_s:
            time.sleep(0.01)

    def between(self, start_s: float, end_s: float) -> tuple[RobotSample, ...]:
        """Return the samples between two host times, oldest first; none if FRI was interrupted in between."""
        end_s = min(end_s, time.monotonic())
        with self._lock:
            found = within(self._samples, start_s, end_s)
        times = np.array([start_s, *(s.monotonic_s for s in found), end_s])
        return found if found and float(np.max(np.diff(times))) <= LONGEST_GAP_S else ()

    def details(self) -> dict[str, str]:
        """The state of FRI, for the report."""
        last = self._last
        if last is None:
            return {"FRI": "no message yet"}
        lost = last.lost / max(1, last.received + last.lost)
        return {
            "FRI": f"{last.session.name}, quality {last.quality.name}, every {last.period_ms} ms",
            "FRI messages": f"{last.received}, {last.lost} lost ({100 * lost:.1f} %), {last.refused} refused",
        }

    def problems(self) -> list[str]:
        """Return what is wrong with FRI; each says what to do."""
        last = self._last
        if last is not None and last.session is Session.IDLE:
            return [
                f"The controller ended the session of FRI with {self._where}, and the poses are those of the "
                "application. If it ended on the smartPAD, start it again; then reconnect"
            ]
        if last is None or time.monotonic() - last.monotonic_s > STALE_S:
            return [
                f"FRI brings no messages to {self._where}, and the poses are those of the application. Check the "
                "cable of FRI's network (KONI), the addresses at both ends, and the firewall of this machine for UDP"
            ]
        if last.session in (Session.COMMANDING_WAIT, Session.COMMANDING_ACTIVE):
            return ["Another application commands the arm through FRI. End it on the smartPAD"]
        return []

    def _read(self) -> None:
        stdout = self._process.stdout
        assert stdout is not None
        with stdout:
            while len(record := stdout.read(SIZE)) == SIZE:
                self._take(unpack(record))

    def _take(self, told: FriSample) -> None:
        last = self._last
        if last is not None and told.monotonic_s - last.monotonic_s > LONGEST_GAP_S:
            silent_s = told.monotonic_s - last.monotonic_s
            _LOG.warning("%s: FRI was silent for %.2f s; those poses are the application's", self._where, silent_s)
        if told.session is Session.IDLE and (last is None or last.session is not Session.IDLE):
            _LOG.warning("%s: FRI is IDLE: the controller has ended the session", self._where)
        if told.joints_rad and told.session is not Session.IDLE:
            sample = self._speeds.sample(self._state(told), told.monotonic_s)
            with self._lock:
                self._samples.append(sample)
                while self._samples[0].monotonic_s < sample.monotonic_s - BUFFER_S:
                    self._samples.popleft()
        self._last = told

    def _state(self, told: FriSample) -> State:
        """The application's newest state with FRI's joints, and its clock."""
        now = self._newest()
        joints = np.array(told.joints_rad)
        stopped = now.safety.may_move and not told.is_normal
        return State(
            number=now.number,
            time_s=told.time_s,
            joints_rad=joints,
            commanded_rad=now.commanded_rad if told.commanded_rad is None else np.array(told.commanded_rad),
            T_base_flange=self._pose_of(joints),
            mode=now.mode,
            safety=SafetyState.PROTECTIVE_STOP if stopped else now.safety,
            safety_word=now.safety_word,
            ready=now.ready,
            locked=now.locked,
            motion=now.motion,
            override=now.override,
        )
