"""How this process deals with memory that it no longer needs: it keeps it for the next array."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST_KEPT = 32 << 20  # the most that glibc accepts
_MOST_KEPT = 1 << 30


def keep_freed_memory() -> None:
    """Work on images makes and frees arrays of megabytes by the thousand.

    By default glibc gives each back to the system, which has to clear it anew for the next one: up to half of the
    time. Without effect where the C library has no such setting.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)
