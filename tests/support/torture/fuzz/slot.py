"""Memory shared by the parsing process and its watcher: the current input, and counts."""

from __future__ import annotations

import mmap
import struct
import time
from dataclasses import dataclass
from pathlib import Path

from tests.support.torture.fuzz.mutations import LARGEST

_HEAD = struct.Struct("<32sQQQQddddQ")
_INPUT_AT = 128


@dataclass(frozen=True, slots=True)
class Reading:
    """The content of a slot at one moment.

    Attributes:
        target: name of the current target.
        inputs, refused: counts for this target so far.
        busy: whether an input is being parsed.
        data: that input.
        began_s: time.monotonic() at its start.
        cpu_s: CPU time of the process at that moment.
        bound_s: CPU time that the input may take.
        spent_s: wall time from the first input of this target to the end of the last.
        peak_kib: largest memory growth of the process for this target.
    """

    target: str
    inputs: int
    refused: int
    busy: bool
    data: bytes
    began_s: float
    cpu_s: float
    bound_s: float
    spent_s: float
    peak_kib: int


class Slot:
    """One file, mapped by both processes."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(b"\0" * (_INPUT_AT + 2 * LARGEST))
        with path.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)
        self._target, self._bound_s = "", 0.0
        self._first_s = self.spent_s = 0.0
        self.inputs = self.refused = self.peak_kib = 0

    def open(self, target: str, bound_s: float) -> None:
        """Reset the counts for a new target."""
        self._target, self._bound_s = target, bound_s
        self._first_s = self.spent_s = 0.0
        self.inputs = self.refused = self.peak_kib = 0
        self._write(False, 0, 0.0, 0.0)

    def begin(self, data: bytes, clock_s: float, cpu_s: float) -> None:
        """Store the input that is parsed from now on."""
        self._map[_INPUT_AT : _INPUT_AT + len(data)] = data
        self.inputs += 1
        self._first_s = self._first_s or clock_s
        self._write(True, len(data), clock_s, cpu_s)

    def end(self, *, refused: bool, peak_kib: int) -> None:
        """Note that the input was parsed, or properly refused."""
        self.refused += refused
        self.spent_s = time.monotonic() - self._first_s
        self.peak_kib = max(self.peak_kib, peak_kib)
        self._write(False, 0, 0.0, 0.0)

    def _write(self, busy: bool, length: int, clock_s: float, cpu_s: float) -> None:
        counts = self.inputs, self.refused, busy, length
        times = clock_s, cpu_s, self._bound_s, self.spent_s
        # A single copy: packing in place would first write zeros, which the other side could see.
        self._map[: _HEAD.size] = _HEAD.pack(self._target.encode(), *counts, *times, self.peak_kib)

    def read(self) -> Reading:
        """Read the slot from the other process."""
        name, inputs, refused, busy, length, clock_s, cpu_s, bound_s, spent_s, kib = _HEAD.unpack_from(self._map)
        data = self._map[_INPUT_AT : _INPUT_AT + length]
        target = name.rstrip(b"\0").decode()
        return Reading(target, inputs, refused, bool(busy), data, clock_s, cpu_s, bound_s, spent_s, kib)

    def close(self) -> None:
        """Unmap the memory."""
        self._map.close()
