"""A log file that several processes write: rotated by size, bounded in all, silent where the disk is nearly full."""

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

NAME = "orthocapture.jsonl"
FILE_BYTES = 10_000_000
FILES = 10  # the one that is written and those before it: 100 MB in all
_STOPPED = "less than {:.1f} GB are free: no more is written here until there is more; the evidence goes on"
_GOES_ON = "the log goes on: there is space again"


class BoundedFile(logging.Handler):
    """Writes lines to DATA/logs/orthocapture.jsonl; older ones are in orthocapture.1.jsonl, .2 … and then gone.

    Nothing that goes wrong here disturbs what is logged: a line that cannot be written is lost.
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
        """See logging.Handler, which holds this process' lock meanwhile."""
        if not self._data.is_dir():
            return  # there is no data folder yet, and a log does not make one
        with contextlib.suppress(OSError):
            full = self._free_bytes(self._data) < LEAST_FREE_BYTES
            if full and self._stopped:
                return
            if full != self._stopped:
                self._write(self._line(record, _STOPPED.format(LEAST_FREE_BYTES / 1e9) if full else _GOES_ON))
                self._stopped = full
            if not full:
                self._write(self._line(record))

    def close(self) -> None:
        """Let go of the file."""
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
            size = os.fstat(self._stream.fileno()).st_size  # not this process' own place in it
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
