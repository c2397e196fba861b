"""Makes this process keep freed memory for its next arrays, or return it; and the pages of files that it maps."""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Generator
from contextlib import contextmanager, suppress
from typing import cast

import numpy as np
from numpy.typing import NDArray

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST_KEPT = 32 << 20  # the largest value that glibc accepts
_MOST_KEPT = 1 << 30
_RETURNED = 1 << 20
# Of what is smaller: the arrays of the next block of faces need no cleared pages. With glibc's own 128 kB, more than
# half of the time went into these.
_SMALLER_KEPT = 32 << 20


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


@contextmanager
def large_arrays_returned() -> Generator[None]:
    """Within this block, return each freed array of a megabyte or more to the system at once.

    Surfaces and their samples have few, large arrays of ever other sizes: of what is kept for the next ones, most
    would lie unused. Afterwards the process keeps what it frees, as a worker does.
    """
    return_freed_memory()
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, _RETURNED)
        libc.mallopt(_M_TRIM_THRESHOLD, _SMALLER_KEPT)
    try:
        yield
    finally:
        keep_freed_memory()


def return_freed_memory() -> None:
    """Return to the system what was freed and kept, before a step whose arrays have other sizes."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def forget_pages(array: NDArray[np.generic]) -> None:
    """Give back the memory in which the file behind a mapped array is cached for this process; it is read again.

    No effect on other arrays, and on systems without this advice.
    """
    if isinstance(array, np.memmap) and array.mode == "c":
        return  # what was changed in memory alone would be lost
    base: object = array
    while isinstance(base, np.ndarray):
        base = cast("object", base.base)
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)
