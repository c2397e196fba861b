"""Observes a simulated device through what it tells the simulated world of its place, past driver and program."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import cast

from tests.support.processes.waiting import until

_STILL = 5  # as often a device at rest tells the same place, ten times a second
LONGEST_STEP_S = 0.05  # longest gap that counts; in a longer one the simulator or this process was not scheduled


@dataclass(frozen=True, slots=True)
class _Seen:
    """A place, when it was told (host time.monotonic()), and the controller's time, which axes do not tell."""

    at_s: float
    place: object
    time_s: float


@dataclass(frozen=True, slots=True)
class Joints:
    """The joints of an arm, when they were told (host time.monotonic()), and the controller's time."""

    at_s: float
    time_s: float
    joints_rad: list[float]


class WorldWatch:
    """Listens like the world; a device connects by itself."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._seen: list[_Seen] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        """HOST:PORT for the option --world."""
        host, port = self._listener.getsockname()
        return f"{host}:{port}"

    def close(self) -> None:
        self._listener.close()

    def mark(self) -> float:
        """The present moment, for `moved_for_s`."""
        return time.monotonic()

    def moved_for_s(self, since_s: float) -> float:
        """Time from a mark until the place last changed; 0 if it never did."""
        elapsed_s = last_s = 0.0
        for before, after in zip(self._seen, self._seen[1:], strict=False):
            if after.at_s > since_s:
                elapsed_s += min(after.at_s - max(before.at_s, since_s), LONGEST_STEP_S)
                if before.place != after.place:
                    last_s = elapsed_s
        return last_s

    def joints(self) -> list[Joints]:
        """What an arm has told."""
        told = [one for one in self._seen if isinstance(one.place, list)]
        return [Joints(one.at_s, one.time_s, cast("list[float]", one.place)) for one in told]

    def wait_moving(self, since_s: float, for_s: float) -> None:
        """Wait until the device has moved for so long since a mark."""
        until(lambda: self.moved_for_s(since_s) >= for_s, "it moves", every_s=0.02)

    def wait_resting(self, since_s: float) -> None:
        """Wait until the device has told the same place again and again since a mark."""

        def rests() -> bool:
            told = [seen.place for seen in self._seen if seen.at_s > since_s][-_STILL:]
            return len(told) == _STILL and all(place == told[0] for place in told)

        until(rests, "it rests", every_s=0.02)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                threading.Thread(target=self._read, args=(link,), daemon=True).start()

    def _read(self, link: socket.socket) -> None:
        with contextlib.suppress(OSError), link, link.makefile("r") as lines:
            for line in lines:
                told = json.loads(line)
                place = told.get("q") or told.get("T_world_camera")
                self._seen.append(_Seen(time.monotonic(), place, told.get("t", 0.0)))


@contextlib.contextmanager
def watched_world() -> Generator[WorldWatch]:
    """Observe the devices that are given its address."""
    watch = WorldWatch()
    try:
        yield watch
    finally:
        watch.close()
