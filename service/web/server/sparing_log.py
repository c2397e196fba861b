"""What a server says on stderr: each kind of message now and then, and how many were left out; never a flood."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from service.logs.terminal import EscapingFormatter
from service.store.durable_effects import Clock

EVERY_S = 60.0
_KINDS = 200  # all further ones count as one
_LEFT_OUT = "left_out"  # in a record, for handlers that come after
_FAULTS = 10  # of the software per period: people are given a reference, which must be found

Kind = tuple[str | int, ...]


@dataclass(slots=True)
class _Repeats:
    """What was said of one kind since `since_s`."""

    since_s: float
    name: str
    words: str
    written: int = 0
    left_out: int = 0


class SparingHandler(logging.StreamHandler[TextIO]):
    """Writes messages of one kind at most once a minute. A kind is a line of code and an error's place."""

    def __init__(self, stream: TextIO, clock: Clock, *, every_s: float = EVERY_S) -> None:
        super().__init__(stream)
        words = EscapingFormatter("%(asctime)s %(name)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%SZ")
        words.converter = time.gmtime
        self.setFormatter(words)
        self._clock = clock
        self._every_s = every_s
        self._told: dict[Kind, _Repeats] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it if one of its kind was just written; logging.Handler holds its lock."""
        now_s = self._clock.monotonic_s()
        self._tell(now_s)
        kind = _kind(record)
        if kind not in self._told and len(self._told) >= _KINDS:
            kind = ("others",)
        told = self._told.setdefault(kind, _Repeats(now_s, record.name, record.getMessage().partition("\n")[0][:200]))
        if told.written < (_FAULTS if record.exc_info and record.name.startswith("orthocapture") else 1):
            told.written += 1
            super().emit(record)
        else:
            told.left_out += 1
            vars(record)[_LEFT_OUT] = True

    async def tell(self) -> None:
        """Say how many were left out in times that are over; to be called now and then."""
        self.acquire()
        try:
            self._tell(self._clock.monotonic_s())
        finally:
            self.release()

    def close(self) -> None:
        """Say how many were left out at all."""
        self._tell(float("inf"))
        super().close()

    def _tell(self, now_s: float) -> None:
        over = [kind for kind, told in self._told.items() if now_s - told.since_s >= self._every_s]
        for told in map(self._told.pop, over):
            if told.left_out:
                words = f"{told.left_out} more messages like this were left out: {told.words}"
                super().emit(logging.makeLogRecord({"name": told.name, "levelname": "WARNING", "msg": words}))


def told(record: logging.LogRecord) -> bool:
    """Whether the sparing handler, which comes first, has not left this message out."""
    return not vars(record).get(_LEFT_OUT)


def _kind(record: logging.LogRecord) -> Kind:
    place = (record.name, record.pathname, record.lineno)
    _, error, traceback = record.exc_info or (None, None, None)
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    if error is None or traceback is None:
        return place
    return (*place, type(error).__name__, traceback.tb_frame.f_code.co_filename, traceback.tb_lineno)


@contextmanager
def sparing_log(clock: Clock) -> Generator[SparingHandler]:
    """All messages of this process go through one such handler to stderr, and through no other."""
    handler = SparingHandler(sys.stderr, clock)
    root = logging.getLogger()
    usual = root.handlers[:]
    for each in usual:
        root.removeHandler(each)
    root.addHandler(handler)
    try:
        yield handler
    finally:
        root.removeHandler(handler)
        for each in usual:
            root.addHandler(each)
        handler.close()
