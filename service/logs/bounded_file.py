"""A log file written by several processes: rotated by size, bounded in total, silent when the disk is nearly full."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shutil
from collections.abc import Callable, Generator
from pathlib import Path
from typing import BinaryIO

from service.core.equipment.disk_space import LEAST_FREE_BYTES
from service.core.units import gigabytes

NAME = "orthocapture.jsonl"
FILE_BYTES = 10_000_000
FILES = 10  # the current file and the older ones: 100 MB in total
_STOPPED = "less than {:.1f} GB are free: logging stops until there is more; the evidence is still recorded"
_GOES_ON = "logging resumes: there is space again"


class BoundedFile(logging.Handler):
    """Writes lines to DATA/logs/orthocapture.jsonl; older ones move to orthocapture.1.jsonl, .2 …, then go.

    A failure here never disturbs the process that logs: a line that cannot be written is lost.
    """

    def __init__(
        self,
        data: Path,
        *,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        super().__init__(logging.INFO)
        self._data = data
        self._file_bytes, self._files = file_bytes, files
        self._free_bytes = free_bytes
        self._stream: BinaryIO | None = None
        self._stopped = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record as a line; rotate the files first if it does not fit. `logging.Handler` holds its lock."""
        if not self._data.is_dir():
            return  # no data folder yet, and a log must not create one
        with contextlib.suppress(OSError):
            full = self._free_bytes(self._data) < LEAST_FREE_BYTES
            if full and self._stopped:
                return
            if full != self._stopped:
                self._write(self._line(record, _STOPPED.format(gigabytes(LEAST_FREE_BYTES)) if full else _GOES_ON))
                self._stopped = full
            if not full:
                self._write(self._line(record))

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        super().close()

    def _line(self, record: logging.LogRecord, instead: str = "") -> bytes:
        if instead:
            record = logging.LogRecord(__name__, logging.WARNING, __file__, 0, instead, None, None)
        return self.format(record).encode(errors="backslashreplace") + b"\n"

    def _write(self, line: bytes) -> None:
        folder = self._data / "logs"
        folder.mkdir(exist_ok=True)
        with _locked(folder / ".lock"):
            path = folder / NAME
            if self._stream is not None and not _is(self._stream, path):  # another process has rotated
                self._stream.close()
                self._stream = None
            if self._stream is None:
                self._stream = path.open("ab", buffering=0)
            size = os.fstat(self._stream.fileno()).st_size  # other processes append too
            if size and size + len(line) > self._file_bytes:
                self._stream.close()
                self._rotate(path)
                self._stream = path.open("ab", buffering=0)
            self._stream.write(line)

    def _rotate(self, path: Path) -> None:
        for number in range(self._files - 1, 0, -1):
            older = path.with_suffix(f".{number}.jsonl")
            newer = path if number == 1 else path.with_suffix(f".{number - 1}.jsonl")
            if newer.exists():
                newer.replace(older)


@contextlib.contextmanager
def _locked(path: Path) -> Generator[None]:
    with path.open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _is(stream: BinaryIO, path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        here, there = os.fstat(stream.fileno()), path.stat()
        return (here.st_dev, here.st_ino) == (there.st_dev, there.st_ino)
    return False
