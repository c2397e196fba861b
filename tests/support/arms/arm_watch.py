"""Observes a simulated arm over a separate connection: when it moved and came to rest, on the controller's clock."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass

from tests.support.processes.waiting import until
from tests.support.vendor.ur_rtde_protocol import RtdeClient

LONGEST_STEP_S = 0.05  # longest gap that counts; in a longer one the simulator was not scheduled


@dataclass(frozen=True, slots=True)
class Seen:
    """A sample: when it came, the controller's time, the fastest driven joint's speed, joints, if a program runs."""

    at_s: float  # host time.monotonic()
    time_s: float
    speed_rad_s: float
    joints_rad: tuple[float, ...]
    program_runs: bool


class ArmWatch:
    """All samples since the watch began."""

    def __init__(self, host: str) -> None:
        self._client = RtdeClient(host)
        self._client.output_setup(["timestamp", "target_qd", "actual_q", "runtime_state"], 125.0)
        self._client.start()
        self._seen: list[Seen] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._client.shutdown()
        self._thread.join(5.0)
        self._client.close()

    def mark(self) -> int:
        """Mark the present moment, for the methods that take `since`."""
        return len(self._seen)

    def samples(self) -> list[Seen]:
        """All of them."""
        return list(self._seen)

    @property
    def now(self) -> Seen:
        return self._seen[-1]

    def wait_moving(self, at_least_rad_s: float) -> None:
        until(lambda: bool(self._seen) and self.now.speed_rad_s >= at_least_rad_s, "it moves", every_s=0.002)

    def wait_resting(self) -> None:
        until(lambda: self.now.speed_rad_s == 0.0, "it rests", every_s=0.01)

    def wait_stopped(self, since: int) -> None:
        """Wait until the arm rests and the program that moved it has ended since a mark.

        A driver that is opened again at once may have sent the next one before this is looked at.
        """
        until(
            lambda: self.now.speed_rad_s == 0.0 and not all(seen.program_runs for seen in self._seen[since:]),
            "it is stopped", every_s=0.01,
        )  # fmt: skip

    def pass_s(self, seconds: float) -> None:
        """Let so much time of the controller pass."""
        end_s = self.now.time_s + seconds
        until(lambda: self.now.time_s >= end_s, "the controller's clock stands", every_s=0.02)

    def moved_for_s(self, since: int) -> float:
        """Time from a mark until the arm was last driven, on the controller's clock; 0 if it never was."""
        elapsed_s = last_s = 0.0
        for before, sample in zip(self._seen[since - 1 :], self._seen[since:], strict=False):
            elapsed_s += min(sample.time_s - before.time_s, LONGEST_STEP_S)
            if sample.speed_rad_s > 0.0:
                last_s = elapsed_s
        return last_s

    def way_rad(self, since: int) -> float:
        """How far the first joint has moved since a mark."""
        return abs(self.now.joints_rad[0] - self._seen[since - 1].joints_rad[0])

    def joints_at(self, time_s: float) -> tuple[float, ...]:
        """The joints in the sample that is nearest to a time of the controller."""
        return min(self._seen, key=lambda sample: abs(sample.time_s - time_s)).joints_rad

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                data = self._client.data()
                speed_rad_s = max(abs(v) for v in data["target_qd"])
                runs = data["runtime_state"] == (2,)
                self._seen.append(Seen(time.monotonic(), data["timestamp"][0], speed_rad_s, data["actual_q"], runs))


@contextlib.contextmanager
def watched_arm(host: str) -> Generator[ArmWatch]:
    """Observe the arm at this address."""
    watch = ArmWatch(host)
    try:
        yield watch
    finally:
        watch.close()
