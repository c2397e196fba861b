"""Signs of life of the workers: one small file each, rewritten every two seconds and removed when it ends."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from pathlib import Path

import psutil
from pydantic import ValidationError

from service.core.records.events import Record
from service.store.durable_effects import Clock

_EVERY_S = 2.0
_STALE_S = 15.0
_log = logging.getLogger(__name__)


class WorkerSign(Record):
    """What a worker reports about itself."""

    host: str
    pid: int
    at_utc_s: float
    jobs_done: int

    def lives(self, now_utc_s: float) -> bool:
        """Whether it has reported lately, by now, and is not known to be dead."""
        if self.host == socket.gethostname() and not psutil.pid_exists(self.pid):
            return False
        return abs(now_utc_s - self.at_utc_s) <= _STALE_S


class SignOfLife:
    """This process's file. A failure to write is logged and disturbs no computation."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._clock = clock
        self._path = _folder(data) / f"{socket.gethostname()}-{os.getpid()}.json"
        self._due_s = 0.0

    def give(self, jobs_done: int) -> None:
        """Write it, if it is due."""
        now_s = self._clock.monotonic_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _EVERY_S
        now_utc_s = self._clock.utc_s()
        sign = WorkerSign(host=socket.gethostname(), pid=os.getpid(), at_utc_s=now_utc_s, jobs_done=jobs_done)
        part = self._path.with_suffix(".part")
        try:
            part.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(sign.model_dump_json())
            part.replace(self._path)
        except OSError as error:
            _log.warning("the worker's sign of life cannot be written: %s", error)

    def close(self) -> None:
        """Remove it."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


def living_workers(data: Path, clock: Clock) -> list[WorkerSign]:
    """The workers of a data folder that are alive, as far as is known; removes the files of dead ones."""
    now_utc_s = clock.utc_s()
    found: list[WorkerSign] = []
    for path in sorted(_folder(data).glob("*.json")):
        try:
            sign = WorkerSign.model_validate_json(path.read_bytes())
        except (OSError, ValidationError):
            continue
        if sign.lives(now_utc_s):
            found.append(sign)
        elif sign.host == socket.gethostname():
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    return found


def _folder(data: Path) -> Path:
    return data / "monitor" / "workers"
