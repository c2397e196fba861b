"""Reduces an input while it still shows the same fault."""

from __future__ import annotations

import time
from collections.abc import Callable


def minimised(data: bytes, shows: Callable[[bytes], bool], *, tries: int, seconds: float) -> bytes:
    """Reduce an input by delta debugging: drop halves, quarters … single bytes, then simplify the remaining ones.

    Args:
        data: an input that shows the fault.
        shows: whether an input shows the same fault.
        tries, seconds: limits, after which the smallest input so far is returned.
    """
    ends_s = time.monotonic() + seconds
    size = max(len(data) // 2, 1)
    while tries > 0 and time.monotonic() < ends_s:
        at, smaller = 0, False
        while at < len(data) and tries > 0 and time.monotonic() < ends_s:
            tries -= 1
            without = data[:at] + data[at + size :]
            if shows(without):
                data, smaller = without, True
            else:
                at += size
        if size == 1 and not smaller:
            break
        size = max(size // 2, 1)
    return data
