"""How a command ends: the one table of exit statuses, which an error has, and a signal's request to stop."""

from __future__ import annotations

import queue
import signal
from collections.abc import Generator
from contextlib import contextmanager, suppress
from enum import IntEnum

from service.core.errors import OrthocaptureError, PersonNeededError

# --- exit statuses: one table, and which of them an error has ----------------------------------


class ExitStatus(IntEnum):
    """How a command ended."""

    DONE = 0
    FAILED = 1
    NOT_POSSIBLE = 2
    WAITS_FOR_A_PERSON = 75  # EX_TEMPFAIL of sysexits.h


#: What each means, for the command line's page of the documents.
MEANINGS: dict[ExitStatus, str] = {
    ExitStatus.DONE: "done, and whatever was checked is as it should be",
    ExitStatus.FAILED: "refused or failed; or done, and something differs, is outside its limits or not completed",
    ExitStatus.NOT_POSSIBLE: "wrong usage: unknown command, option or value; for `replay` also a run that cannot be "
    "replayed",
    ExitStatus.WAITS_FOR_A_PERSON: "the run waits for a decision of a person, and the command had nobody to ask; the "
    "run stays open",
}


def exit_status(error: OrthocaptureError) -> ExitStatus:
    """Return the status of a command that ends with this error."""
    return ExitStatus.WAITS_FOR_A_PERSON if isinstance(error, PersonNeededError) else ExitStatus.FAILED


# --- a request to stop that the handler of a signal may make ------------------------------------------------------

_SLICE_S = 0.5  # a signal that another thread received runs its handler only when the main thread wakes up


class StopRequest:
    """Made by Ctrl-C or SIGTERM; the main thread waits for it.

    It is no Event: a handler that sets one waits for ever for its lock if the signal interrupts the main thread while
    that holds the lock within `wait`. A SimpleQueue may be put into from a handler.
    """

    def __init__(self) -> None:
        self._made = False
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()

    def make(self) -> None:
        """Make the request; also from the handler of a signal."""
        self._made = True
        self._news.put(None)

    def is_made(self) -> bool:
        """Return whether the request was made."""
        return self._made

    def wait(self, timeout_s: float = float("inf")) -> bool:
        """Wait until the request is made, at most so long. Returns whether it was."""
        left_s = timeout_s
        while not self._made and left_s > 0:
            slice_s = min(_SLICE_S, left_s)
            with suppress(queue.Empty):
                self._news.get(timeout=slice_s)
            left_s -= slice_s
        return self._made


@contextmanager
def stop_requested() -> Generator[StopRequest]:
    """Let Ctrl-C and SIGTERM make a request instead of ending the process, until the block is left."""
    request = StopRequest()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: request.make()) for number in numbers}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
