"""Makes this process keep freed memory for its next arrays, or return it."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST_KEPT = 32 << 20  # the largest value that glibc accepts
_MOST_KEPT = 1 << 30


def keep_freed_memory() -> None:
    """Keep freed memory instead of returning it to the system.

    Image processing allocates and frees thousands of arrays of several megabytes. By default glibc returns each to
    the system, which must clear it again for the next one; that takes up to half of the time. No effect with other C
    libraries.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)


def return_freed_memory() -> None:
    """Return to the system what was freed and kept, before a step whose arrays have other sizes."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
