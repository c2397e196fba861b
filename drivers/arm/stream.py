"""The controller's pose stream: a sampling thread, a ring buffer, and the judgement whether the arm has settled."""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import takewhile

import numpy as np

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import RobotSample, SettleCriteria, SettleReport
from drivers.stillness import pose_spread

BUFFER_S = 300.0  # an image's pose is looked up after its files arrived, which takes a while at 60 megapixels
STREAM_HZ = 125.0
POLL_S = 0.004
STALL_S = 0.25  # a longer gap between two polls means that this process itself was suspended
MINIMUM_COVERAGE = 0.8  # fraction of the settle window that samples must cover
TARGET_AT_REST_RAD_S = 1e-9  # above this target velocity the controller drives the arm

_LOG = logging.getLogger(__name__)
# drivers.stillness needs it; read for the first time in a motion, it would hold all threads of this process.
importlib.import_module("scipy.spatial.transform")


class PoseStream:
    """Polls a source of samples in its own thread and keeps the last BUFFER_S seconds.

    Args:
        read: returns the newest sample, or None while the controller's clock has not advanced, since a
            dead link may keep returning old data.
        stale_after_s: age of the newest sample above which the stream counts as dead.
        where: address of the controller, for messages.
        vendor_errors: exceptions of `read` that end the stream.
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
        self._reading = threading.Lock()
        self._stop = threading.Event()
        self._death = ""
        self._looked_s = self._looking_since_s = -float("inf")  # time of the last poll; start of gapless polling
        self._thread = threading.Thread(target=self._run, name="pose stream", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the sampling thread."""
        self._stop.set()
        self._thread.join(5.0)

    @property
    def alive(self) -> bool:
        """Return whether the stream is alive, i.e. its newest sample is not stale."""
        return self.newest() is not None

    def newest(self) -> RobotSample | None:
        """Return the newest sample, or None if it is stale or the stream has ended; does not wait."""
        with self._lock:
            newest = self._samples[-1] if self._samples else None
        fresh = newest is not None and time.monotonic() - newest.monotonic_s <= self._stale_after_s
        return newest if fresh and not self._death else None

    def await_first(self, timeout_s: float) -> None:
        """Wait for the first sample, which on a busy machine comes later than any other may."""
        deadline_s = time.monotonic() + timeout_s
        while not self._samples and not self._death and time.monotonic() < deadline_s:
            time.sleep(POLL_S)

    def latest(self) -> RobotSample:
        """Return the newest sample. Raises DeviceUnavailableError if it is stale or the stream has ended."""
        deadline_s = time.monotonic() + self._stale_after_s
        while True:
            with self._lock:
                newest = self._samples[-1] if self._samples else None
            now_s = time.monotonic()
            if newest is not None and now_s - newest.monotonic_s <= self._stale_after_s and not self._death:
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
        """Return whether this process was suspended, so that the age of a sample says nothing about the link."""
        return now_s - self._looked_s > STALL_S or now_s - self._looking_since_s <= self._stale_after_s

    def next(self) -> RobotSample:
        """Wait for a sample that arrives after this call. Raises DeviceUnavailableError if none does."""
        now_s = time.monotonic()
        while (sample := self.latest()).monotonic_s <= now_s:
            time.sleep(POLL_S)
        return sample

    def between(self, start_s: float, end_s: float) -> tuple[RobotSample, ...]:
        """Return the samples that arrived between two host times (time.monotonic()), oldest first."""
        with self._lock:
            return within(self._samples, start_s, end_s)

    def clear(self) -> None:
        """Discard all samples, because the tool offset behind their flange poses has changed."""
        with self._lock:
            self._samples.clear()

    def clock_offset_s(self) -> float:
        """Return controller time minus host monotonic time, from the least delayed sample of the last 5 s."""
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
            self._take()
            if self._death:
                return

    def catch_up(self) -> None:
        """Take all samples that have arrived, and not only one at each poll.

        For a source that has its samples at hand: after a pause of this process many are waiting.
        """
        while self._take():
            pass

    def _take(self) -> bool:
        """Take one sample, in the order in which they come; returns whether there was one."""
        with self._reading:
            try:
                sample = None if self._death else self._read()
            except self._vendor_errors as error:
                self._death = f" ({error})"
                _LOG.warning("%s: pose stream: %s", self._where, error)
                return False
            if sample is None:
                return False
            with self._lock:
                self._samples.append(sample)
                while self._samples[0].monotonic_s < sample.monotonic_s - BUFFER_S:
                    self._samples.popleft()
            return True


def within(samples: deque[RobotSample], start_s: float, end_s: float) -> tuple[RobotSample, ...]:
    """Return the samples of a buffer between two host times (time.monotonic()), oldest first."""
    # Search from the newest backwards: the buffer is long, and callers nearly always want recent samples.
    recent = takewhile(lambda s: s.monotonic_s >= start_s, reversed(samples))
    return tuple(reversed([s for s in recent if s.monotonic_s <= end_s]))


def judge(samples: Sequence[RobotSample], criteria: SettleCriteria) -> SettleReport:
    """Judge whether the arm stood still over `samples`, which should span criteria.window_s (drivers.stillness)."""
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
    """Return how long the arm kept oscillating after the commanded motion had ended, in seconds.

    Returns 0 if `samples`, oldest first, do not reach back to a commanded motion.
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
    """Return whether the controller drives the arm in this sample, i.e. any target joint velocity is not zero."""
    return bool(np.any(np.abs(sample.target_velocities_rad_s) > TARGET_AT_REST_RAD_S))
