"""Makes an input smaller as long as it shows the same fault."""

from __future__ import annotations

import time
from collections.abc import Callable


def minimised(data: bytes, shows: Callable[[bytes], bool], *, tries: int, seconds: float) -> bytes:
    """Delta debugging over bytes: halves, quarters … single bytes are left out, and what is left becomes plain.

    Args:
        data: shows the fault.
        shows: whether an input shows the same one.
        tries, seconds: after which the smallest input so far is good enough.
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
