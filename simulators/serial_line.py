"""The serial line of a simulated device: a pseudo-terminal behind a link that keeps its name."""

from __future__ import annotations

import os
import select
import time
import tty
from contextlib import suppress
from pathlib import Path


class Terminal:
    """This end of the line. What the client does not read is lost, as on a line without flow control."""

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self._ends: tuple[int, int] | None = None

    def plug_in(self) -> str:
        """Create the pseudo-terminal and its link; returns its path."""
        master, slave = os.openpty()
        tty.setraw(slave)  # it stays open here, so that the terminal survives while no client holds it
        os.set_blocking(master, False)
        self._ends = (master, slave)
        name = os.ttyname(slave)
        if self._link is not None:
            self._link.parent.mkdir(parents=True, exist_ok=True)
            temporary = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(name)
            temporary.replace(self._link)
        return name

    def unplug(self) -> None:
        """Pull the cable: the terminal disappears."""
        if self._ends is None:
            return
        for end in self._ends:
            os.close(end)
        self._ends = None
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def pull_out(self, seconds: float) -> None:
        """Pull the cable and put it in again after some seconds."""
        self.unplug()
        time.sleep(seconds)
        self.plug_in()

    def receive(self, timeout_s: float) -> bytes:
        """Return what arrives within a time; empty if nothing does."""
        if self._ends is None or not select.select([self._ends[0]], [], [], timeout_s)[0]:
            return b""
        try:
            return os.read(self._ends[0], 4096)
        except BlockingIOError:
            return b""

    def send(self, data: bytes) -> None:
        """Send bytes."""
        if self._ends is not None:
            with suppress(BlockingIOError):
                os.write(self._ends[0], data)
