"""What a hosted driver is doing, in memory that its parent can still read when a library has ended the process.

What ended the process twice is left out from then on, if the device can do without it: reading one of its values.
"""

from __future__ import annotations

import mmap
import os
import weakref
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager

from drivers.errors import DeviceRefusedError

MOST_ENDS = 2
_NOTE_BYTES = 256


class Note:
    """The parent's end: the note of each process that it starts, and how many ended at what."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("doing")
        os.truncate(self.descriptor, _NOTE_BYTES)
        weakref.finalize(self, os.close, self.descriptor)
        self._memory = mmap.mmap(self.descriptor, _NOTE_BYTES)
        self._ends: Counter[str] = Counter()

    def read(self) -> str:
        """Return what the process is doing, or was when it ended; "" if it has not said it."""
        return self._memory[:_NOTE_BYTES].rstrip(b"\0").decode(errors="replace")

    def clear(self) -> None:
        """Forget it, before another process begins."""
        self._memory[:_NOTE_BYTES] = bytes(_NOTE_BYTES)

    def count_end(self) -> str:
        """Count that the process ended while doing this, and return what it was."""
        if what := self.read():
            self._ends[what] += 1
        return what

    @property
    def left_out(self) -> frozenset[str]:
        """Return what has ended a process too often."""
        return frozenset(what for what, ends in self._ends.items() if ends >= MOST_ENDS)


class _Told:
    """The child's end; in a process that has no parent, nobody reads it."""

    def __init__(self) -> None:
        self.memory: mmap.mmap | None = None
        self.left_out: frozenset[str] = frozenset()
        self.now = ""

    def write(self, what: str) -> None:
        """Say it, cut at what the note can hold."""
        self.now = what
        if self.memory is not None:
            self.memory[:_NOTE_BYTES] = _shorten(what).encode().ljust(_NOTE_BYTES, b"\0")


_TOLD = _Told()


def _shorten(what: str) -> str:
    return what.encode()[:_NOTE_BYTES].decode(errors="ignore")


def take_note(descriptor: int) -> None:
    """In the child: write into this memory of the parent from now on."""
    _TOLD.memory = mmap.mmap(descriptor, _NOTE_BYTES)


def leave_out(what: frozenset[str]) -> None:
    """In the child: refuse these from now on."""
    _TOLD.left_out = what


@contextmanager
def doing(what: str, *, where: str = "", optional: bool = False) -> Generator[None]:
    """Say what the driver does inside, such as "Reading the setting iso".

    Raises DeviceRefusedError if it is optional and has ended the driver's process twice.
    """
    if optional and _shorten(what) in _TOLD.left_out:
        raise DeviceRefusedError(
            f"{what} has ended the driver's process {MOST_ENDS} times and is left out",
            where=where,
            remedy="Look at the device itself for it; a newer version of the maker's library may be able to read it",
        )
    before = _TOLD.now
    _TOLD.write(what)
    try:
        yield
    finally:
        _TOLD.write(before)
