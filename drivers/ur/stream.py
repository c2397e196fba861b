"""The controller's pose stream: a sampling thread, a ring buffer in time, and the judgement of standing still."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import takewhile

import numpy as np

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import RobotSample, SafetyState, SettleCriteria, SettleReport
from drivers.stillness import pose_spread

BUFFER_S = 300.0  # an image's pose is looked up once its files have arrived, which takes a while for 60 megapixels
STREAM_HZ = 125.0
POLL_S = 0.004
STALL_S = 0.25  # without a look: this process itself stood still
MINIMUM_COVERAGE = 0.8  # of the settle window by samples
TARGET_AT_REST_RAD_S = 1e-9  # the controller's target velocity, beyond which it drives the arm

_LOG = logging.getLogger(__name__)


def safety_state(bits: int) -> SafetyState:
    """The state behind the controller's safety_status_bits, the gravest first (RTDE guide)."""
    for mask, state in (
        (1 << 9 | 1 << 8, SafetyState.FAULT),  # fault, violation
        (1 << 7 | 1 << 6 | 1 << 5, SafetyState.EMERGENCY_STOP),
        (1 << 4, SafetyState.SAFEGUARD_STOP),
        (1 << 2, SafetyState.PROTECTIVE_STOP),
        (1 << 3, SafetyState.FAULT),  # recovery mode
        (1 << 1, SafetyState.REDUCED),
        (1 << 0, SafetyState.NORMAL),
    ):
        if bits & mask:
            return state
    return SafetyState.UNKNOWN


class PoseStream:
    """Polls a source of samples in its own thread and keeps the last BUFFER_S seconds.

    `read` returns the newest sample, or None while the controller's clock has not advanced: the vendor's getters go
    on returning old data when the link is dead. Whatever of `vendor_errors` it raises ends the stream.
    """

    def __init__(
        self,
        read: Callable[[], RobotSample | None],
        *,
        stale_after_s: float,
        where: str,
        vendor_errors: tuple[type[Exception], ...],
    ) -> None:
        self._read, self._stale_after_s, self._where = read, stale_after_s, where
        self._vendor_errors = vendor_errors
        self._samples: deque[RobotSample] = deque()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._death = ""
        self._looked_s = self._looking_since_s = -float("inf")  # the newest look; from when on without a pause
        self._thread = threading.Thread(target=self._run, name="ur pose stream", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join(5.0)

    @property
    def alive(self) -> bool:
        """Whether samples come in."""
        return self.newest() is not None

    def newest(self) -> RobotSample | None:
        """The newest sample, None when it is too old; does not wait."""
        with self._lock:
            newest = self._samples[-1] if self._samples else None
        fresh = newest is not None and time.monotonic() - newest.monotonic_s <= self._stale_after_s
        return newest if fresh else None

    def latest(self) -> RobotSample:
        """The newest sample. Raises DeviceUnavailableError when it is too old."""
        deadline_s = time.monotonic() + self._stale_after_s
        while True:
            with self._lock:
                newest = self._samples[-1] if self._samples else None
            now_s = time.monotonic()
            if newest is not None and now_s - newest.monotonic_s <= self._stale_after_s:
                return newest
            waits = newest is None or self._not_looking(now_s)
            if self._death or now_s > deadline_s or not waits:
                age = f"for {now_s - newest.monotonic_s:.1f} s" if newest else "yet"
                raise DeviceUnavailableError(
                    f"the robot's stream brought no new sample {age}{self._death}",
                    where=self._where,
                    remedy="Check the cable and the controller, then reconnect",
                )
            time.sleep(POLL_S)

    def _not_looking(self, now_s: float) -> bool:
        """Whether this process has stood still: then the age of a sample says nothing of the link."""
        return now_s - self._looked_s > STALL_S or now_s - self._looking_since_s <= self._stale_after_s

    def next(self) -> RobotSample:
        """A sample that arrives from now on. Raises DeviceUnavailableError when none does."""
        now_s = time.monotonic()
        while (sample := self.latest()).monotonic_s <= now_s:
            time.sleep(POLL_S)
        return sample

    def between(self, start_s: float, end_s: float) -> tuple[RobotSample, ...]:
        """Samples that arrived between two host times, oldest first."""
        with self._lock:
            # From the newest backwards: what is asked for is nearly always recent, and the buffer is long.
            recent = takewhile(lambda s: s.monotonic_s >= start_s, reversed(self._samples))
            found = [s for s in recent if s.monotonic_s <= end_s]
        return tuple(reversed(found))

    def clear(self) -> None:
        """Forget everything, since the tool offset behind the flange poses changed on the way."""
        with self._lock:
            self._samples.clear()

    def clock_offset_s(self) -> float:
        """Controller time minus host monotonic time; the least delayed sample of the last seconds decides."""
        self.latest()
        with self._lock:
            recent = list(self._samples)[-int(5 * STREAM_HZ) :]
        return max(s.controller_time_s - s.monotonic_s for s in recent)

    def _run(self) -> None:
        while not self._stop.wait(POLL_S):
            now_s = time.monotonic()
            if now_s - self._looked_s > STALL_S:
                self._looking_since_s = now_s
            self._looked_s = now_s
            try:
                sample = self._read()
            except self._vendor_errors as error:
                self._death = f" ({error})"
                _LOG.warning("%s: pose stream: %s", self._where, error)
                return
            if sample is None:
                continue
            with self._lock:
                self._samples.append(sample)
                while self._samples[0].monotonic_s < sample.monotonic_s - BUFFER_S:
                    self._samples.popleft()


def judge(samples: Sequence[RobotSample], criteria: SettleCriteria) -> SettleReport:
    """Whether an arm stood still over `samples`, which should span criteria.window_s; see drivers.stillness."""
    spread = pose_spread(samples)
    joint_speed = float(max(np.max(np.abs(s.joint_velocities_rad_s)) for s in samples))
    tcp_speed = max(s.tcp_speed_m_s for s in samples)
    at_target = not any(driven(s) for s in samples)
    covered_s = samples[-1].monotonic_s - samples[0].monotonic_s
    return SettleReport(
        settled=bool(
            at_target
            and covered_s >= MINIMUM_COVERAGE * criteria.window_s
            and joint_speed < criteria.joint_speed_rad_s
            and tcp_speed < criteria.tcp_speed_m_s
            and spread.within(criteria)
        ),
        samples=spread.samples,
        joint_speed_rad_s=joint_speed,
        tcp_speed_m_s=tcp_speed,
        position_peak_to_peak_m=spread.position_peak_to_peak_m,
        rotation_peak_to_peak_rad=spread.rotation_peak_to_peak_rad,
        T_base_flange=spread.T_base_flange,
        joints_rad=np.mean([s.joints_rad for s in samples], axis=0),
    )


def ringing_s(samples: Sequence[RobotSample], criteria: SettleCriteria) -> float:
    """How long the arm went on swinging after the controller's target had come to rest, in seconds.

    0 where `samples`, oldest first, do not reach back to a commanded motion.
    """
    last_loud_s: float | None = None
    for sample in reversed(samples):
        if driven(sample):
            return 0.0 if last_loud_s is None else last_loud_s - sample.monotonic_s
        if last_loud_s is None and (
            np.max(np.abs(sample.joint_velocities_rad_s)) >= criteria.joint_speed_rad_s
            or sample.tcp_speed_m_s >= criteria.tcp_speed_m_s
        ):
            last_loud_s = sample.monotonic_s
    return 0.0


def driven(sample: RobotSample) -> bool:
    """Whether the controller drives the arm in this sample."""
    return bool(np.any(np.abs(sample.target_velocities_rad_s) > TARGET_AT_REST_RAD_S))
