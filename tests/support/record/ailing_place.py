"""A second place of the signatures that is away in one of several ways, and comes back."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from service.store.durable_effects import DurableFiles
from service.store.signatures.log import NAME
from service.store.signatures.second_place import SecondPlace
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock

QUICK_S = 0.05


class RefusingFiles(DurableFiles):
    """Files of a place whose disk refuses with this error, until it is mended."""

    def __init__(self, number: int) -> None:
        self.number = number

    def append(self, path: Path, offset: int, data: bytes) -> None:
        if self.number:
            raise OSError(self.number, os.strerror(self.number), str(path))
        super().append(path, offset, data)


class Ailing:
    """A place that is away in one of several ways, and can be brought back."""

    def __init__(self, way: str, folder: Path) -> None:
        self.copy = folder / "share [of the lab]" / NAME
        self.files = RefusingFiles(0)
        self.go_away(way)

    def go_away(self, way: str) -> None:
        """The share is away from now on."""
        self.files.number = {"full": errno.ENOSPC, "read-only": errno.EROFS}.get(way, 0)
        if self.copy.parent.is_dir():
            shutil.rmtree(self.copy.parent)
        if way == "a file in place of the folder":
            self.copy.parent.write_text("in the way")
        elif way != "no folder":
            self.copy.parent.mkdir()
        if way == "hangs":
            os.mkfifo(self.copy)

    def place(self, data: Path) -> SecondPlace:
        return SecondPlace.of(data, self.copy, SteppedClock(), self.files, patience_s=QUICK_S)

    def mend(self) -> None:
        """The share is back."""
        self.files.number = 0
        if self.copy.is_fifo():
            until(self._is_let_go, "nobody waits at the pipe")
        elif self.copy.parent.is_file():
            self.copy.parent.unlink()
        self.copy.parent.mkdir(exist_ok=True)

    def _is_let_go(self) -> bool:
        """Let go whoever waits for the pipe's other end; False if nobody does yet, as on a busy machine."""
        try:
            descriptor = os.open(self.copy, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            return False
        self.copy.unlink()
        os.close(descriptor)
        return True


WAYS = {
    "no folder": "No such file or directory",
    "a file in place of the folder": "Not a directory",
    "full": "No space left on device",
    "read-only": "Read-only file system",
    "hangs": "it has not answered for 0.05 s",
}
