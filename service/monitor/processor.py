"""How long a thread of this process has computed, and how long it was ready to and had to wait for a processor."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from service.core.units import seconds_of_ns


def processor_s() -> float:
    """Seconds that this thread has computed or waited for a processor, as far as the system tells of waits."""
    try:
        computed_s, waited_s = _scheduled(threading.get_native_id())
    except OSError:
        return time.thread_time()
    return computed_s + waited_s


def waited_s(thread: int) -> float:
    """Seconds that a thread (its native id) has waited for a processor; 0 where no system tells it."""
    try:
        return _scheduled(thread)[1]
    except OSError:
        return 0.0


def _scheduled(thread: int) -> tuple[float, float]:
    """Seconds on a processor, and waiting for one, as Linux counts them. Raises OSError."""
    computed_ns, waited_ns, _ = Path(f"/proc/self/task/{thread}/schedstat").read_text().split()
    return seconds_of_ns(int(computed_ns)), seconds_of_ns(int(waited_ns))
