"""How long a thread of this process has computed, and how long it was ready to and had to wait for a processor."""

from __future__ import annotations

import threading
import time

from drivers.machine_pressure import processor_time


def processor_s() -> float:
    """Seconds that this thread has computed or waited for a processor, as far as the system tells of waits."""
    try:
        times = processor_time(threading.get_native_id())
    except OSError:
        return time.thread_time()
    return times.computed_s + times.waited_s


def waited_s(thread: int) -> float:
    """Seconds that a thread (its native id) has waited for a processor; 0 where no system tells it."""
    try:
        return processor_time(thread).waited_s
    except OSError:
        return 0.0
