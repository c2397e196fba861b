"""Measures how long processes had to wait for a processor or for memory, as Linux counts it.

Where the system does not count this, the answer is that nothing had to wait.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field
from pathlib import Path

from service.core.units import seconds_of_ns, seconds_of_us

_MEMORY = Path("/proc/pressure/memory")
_KILLED = Path("/proc/vmstat")


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """How long a thread has computed, and how long it was ready to and had to wait for a processor."""

    computed_s: float
    waited_s: float


def processor_time(thread: int, process: int | str = "self") -> ProcessorTime:
    """Return the times of one thread (its native id) since it began. Raises OSError where they are not counted."""
    words = Path(f"/proc/{process}/task/{thread}/schedstat").read_text().split()
    return ProcessorTime(seconds_of_ns(int(words[0])), seconds_of_ns(int(words[1])))


def processor_times(process: int | str) -> dict[int, ProcessorTime]:
    """Return the times of every living thread of a process, by its native id; empty where they are not counted."""
    found: dict[int, ProcessorTime] = {}
    try:
        threads = [int(entry.name) for entry in Path(f"/proc/{process}/task").iterdir()]
    except OSError:
        return found
    for thread in threads:
        try:
            found[thread] = processor_time(thread, process)
        except OSError:  # it has ended meanwhile
            continue
    return found


def memory_stall_s() -> float:
    """Return the seconds since boot in which all that was to run waited for memory; 0 where they are not counted."""
    try:
        told = re.search(r"^full .*total=(\d+)", _MEMORY.read_text(), re.MULTILINE)
    except OSError:
        return 0.0
    return 0.0 if told is None else seconds_of_us(int(told[1]))


def killed_for_memory() -> int:
    """Return how many processes the kernel has killed for want of memory since boot; 0 where it does not count."""
    try:
        told = re.search(r"^oom_kill (\d+)", _KILLED.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return 0 if told is None else int(told[1])


@dataclass(frozen=True, slots=True)
class _Seen:
    """Holds the times of a thread at a look, and since when it has been ready without running; None: it sleeps."""

    times: ProcessorTime
    waits_since_s: float | None


def _is_ready(thread: int, process: int | str) -> bool:
    """Return whether a thread runs, or would if it had a processor; False where the system does not say."""
    try:
        status = Path(f"/proc/{process}/task/{thread}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[:1] == ["R"]


@dataclass
class HeldUp:
    """Measures, from when it is made, how long a process could not run.

    Linux counts a wait for a processor when it ends. A thread that was ready at two looks, without having run in
    between, has waited since the first of them: `look` often enough, and a wait that goes on counts as well.
    """

    process: int | str
    _began: dict[int, ProcessorTime] = field(init=False)
    _memory_s: float = field(init=False)
    _seen: dict[int, _Seen] = field(init=False, default_factory=dict[int, "_Seen"])

    def __post_init__(self) -> None:
        self.look()
        self._began = {thread: seen.times for thread, seen in self._seen.items()}
        self._memory_s = memory_stall_s()

    def look(self) -> None:
        """Look at the threads once more."""
        now_s, before = time.monotonic(), self._seen
        self._seen = {}
        for thread, times in processor_times(self.process).items():
            since_s = None
            if _is_ready(thread, self.process):
                last = before.get(thread)
                waits_on = last is not None and last.times == times and last.waits_since_s is not None
                since_s = last.waits_since_s if last is not None and waits_on else now_s
            self._seen[thread] = _Seen(times, since_s)

    @property
    def seconds(self) -> float:
        """The longest that one of its threads has waited for a processor, and the time lost to want of memory."""
        self.look()
        now_s, longest_s = time.monotonic(), 0.0
        for thread, seen in self._seen.items():
            going_on_s = 0.0 if seen.waits_since_s is None else now_s - seen.waits_since_s
            longest_s = max(longest_s, seen.times.waited_s - self._before(thread).waited_s + going_on_s)
        return longest_s + memory_stall_s() - self._memory_s

    @property
    def share(self) -> float:
        """Return the part, 0 to 1, of the time in which its threads wanted to run and could not."""
        computed_s = waited_s = 0.0
        for thread, times in processor_times(self.process).items():
            computed_s += times.computed_s - self._before(thread).computed_s
            waited_s += times.waited_s - self._before(thread).waited_s
        waited_s += memory_stall_s() - self._memory_s
        return waited_s / (computed_s + waited_s) if waited_s > 0 else 0.0

    def _before(self, thread: int) -> ProcessorTime:
        return self._began.get(thread, ProcessorTime(0.0, 0.0))
