"""The serial line to a GRBL controller: its thread asks for status reports and matches answers to lines."""

from __future__ import annotations

import contextlib
import logging
import math
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import serial

from drivers.errors import DeviceRefusedError, DeviceTimeoutError, DeviceUnavailableError
from drivers.grbl import POLL_S, GrblConfig
from drivers.grbl.wire import (
    LONGEST_LINE,
    RESET,
    STATUS,
    Alarm,
    Feedback,
    Message,
    Ok,
    Refused,
    Setting,
    Status,
    Welcome,
    parse,
)

LINK_ERRORS = (serial.SerialException, OSError, termios.error)
_LOST_S = 0.2  # a request whose report did not come by then is repeated: noise, homing, an alarm
_CABLE = "Check the cable and the power of the controller, then reconnect"

_LOG = logging.getLogger(__name__)


@dataclass
class Sent:
    """A line that waits for its answer."""

    line: bytes
    sent_s: float  # host time.monotonic()
    answer: Ok | Refused | None = None  # None: none yet, or none to come
    said: list[Setting | Feedback] = field(default_factory=list[Setting | Feedback])
    dropped: bool = False  # no answer will come: the controller has restarted, or the connection is lost


class Link:
    """One connection.

    Args:
        port: serial device or URL.
        config: the line's baud rate, and when this process was suspended.
        receive: called in the reading thread for each status report, alarm and welcome, with the host's
            time.monotonic() at which the report was asked for, or the message arrived.

    Raises:
        DeviceUnavailableError: the port cannot be opened.
    """

    def __init__(self, port: str, config: GrblConfig, receive: Callable[[Message, float], None]) -> None:
        self._where, self._receive = port, receive
        self._stood_still_s = config.stood_still_s
        self._news = threading.Condition()
        self._writing = threading.Lock()
        self._waiting: deque[Sent] = deque()
        self._welcomes = 0
        self._asked_s = -1.0  # when the open request for a status report was sent; -1: none is open
        self._doubtful = False  # it was sent again: the next report may answer the one before
        self.answered_s = -math.inf  # when the newest answer to a line arrived, monotonic
        self.went_on_s = -math.inf  # when this process went on after it had been suspended, monotonic
        self._stop = threading.Event()
        self.version = ""
        self.death = ""  # why the connection ended
        try:
            self._port = serial.serial_for_url(port, baudrate=config.baudrate, timeout=0.01, write_timeout=1.0)
        except (*LINK_ERRORS, ValueError) as error:
            what = f"the port cannot be opened ({error})"
            remedy = "Check the cable, and the port in rig.yaml"
            raise DeviceUnavailableError(what, where=port, remedy=remedy) from error
        self._thread = threading.Thread(target=self._run, name="grbl link", daemon=True)
        self._thread.start()

    def reset(self, timeout_s: float) -> None:
        """Reset the controller, which stops whatever moves, and wait for its welcome.

        Raises DeviceUnavailableError if none comes.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._news:
            before = self._welcomes
        resets = 0
        while True:
            self.act(RESET)
            resets += 1
            # Some boards restart when their port is opened and hear nothing until then, so the reset is repeated.
            wait_s = min(1.0, deadline_s - time.monotonic())
            with self._news:
                if self._news.wait_for(lambda: self._welcomes > before or bool(self.death), wait_s):
                    break
            if time.monotonic() >= deadline_s:
                what = f"nothing on this port greets as GRBL within {timeout_s:g} s"
                raise DeviceUnavailableError(what, where=self._where, remedy=_CABLE)
        if resets > 1:  # a late welcome would drop the lines that are sent next
            with self._news:
                self._news.wait_for(lambda: self._welcomes >= before + resets or bool(self.death), 1.0)
        self.require_alive()

    def act(self, command: bytes) -> None:
        """Send a real-time command. Raises DeviceUnavailableError if the line is dead."""
        with self._writing:
            self._write(command)

    def send(self, line: bytes) -> Sent:
        """Send a line and do not wait. Raises DeviceUnavailableError if the line is dead."""
        sent = Sent(line, time.monotonic())
        with self._writing:
            with self._news:
                self._waiting.append(sent)
            self._write(line + b"\n")
        return sent

    def request(self, line: bytes, timeout_s: float) -> tuple[Setting | Feedback, ...]:
        """Send a line, wait for its answer and return what the controller said before it.

        Raises:
            DeviceRefusedError: it was refused.
            DeviceTimeoutError, DeviceUnavailableError: there was no answer.
        """
        sent = self.send(line)
        self.await_answer(sent, timeout_s)
        return self.answer_to(sent, f" in {timeout_s:g} s")

    def await_answer(self, sent: Sent, timeout_s: float) -> bool:
        """Wait for the answer to a line; returns whether it came, or never will."""
        with self._news:
            return self._news.wait_for(lambda: sent.answer is not None or sent.dropped or bool(self.death), timeout_s)

    def answer_to(self, sent: Sent, why_none: str) -> tuple[Setting | Feedback, ...]:
        """What the controller said before its answer to a line; `why_none` ends the sentence that there is none.

        Raises as `request`.
        """
        words = sent.line.decode("ascii")
        if isinstance(sent.answer, Refused):
            what, remedy = f"the controller refuses {words}: {sent.answer.words}", "See what it names, then try again"
            raise DeviceRefusedError(what, where=self._where, remedy=remedy)
        if sent.answer is None:
            if self.death:
                raise self._lost()
            why = ": the controller has restarted" if sent.dropped else why_none
            raise DeviceTimeoutError(f"no answer to {words}{why}", where=self._where, remedy=_CABLE)
        return tuple(sent.said)

    @property
    def unanswered(self) -> int:
        """Number of lines that wait for their answer."""
        with self._news:
            return len(self._waiting)

    def misses_answer(self, within_s: float) -> bool:
        """Return whether the oldest line without an answer was sent longer ago than this."""
        with self._news:
            return bool(self._waiting) and time.monotonic() - self._waiting[0].sent_s > within_s

    def forget_unanswered(self) -> None:
        """Wait for no more of the answers, since they were lost: each later one would count for the line before."""
        with self._news:
            _LOG.warning("%s: answers to %d lines were lost", self._where, len(self._waiting))
            self._drop_waiting()

    def require_alive(self) -> None:
        """Raise DeviceUnavailableError if the connection has ended."""
        if self.death:
            raise self._lost()

    def close(self) -> None:
        """Close the port."""
        self._die("it was closed")
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        with contextlib.suppress(*LINK_ERRORS):  # the line is dead already
            self._port.close()

    def _write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except LINK_ERRORS as error:
            self._die(str(error))
            raise self._lost() from error

    def _lost(self) -> DeviceUnavailableError:
        what = f"the connection is lost: {self.death or 'it broke while sending'}"
        return DeviceUnavailableError(what, where=self._where, remedy=_CABLE)

    def _run(self) -> None:
        heard = b""
        next_s, looked_s = 0.0, time.monotonic()
        try:
            while not self._stop.is_set():
                now_s = time.monotonic()
                if now_s >= next_s and (self._asked_s < 0 or now_s - self._asked_s > _LOST_S):
                    next_s = now_s + POLL_S
                    self._doubtful = self._doubtful or self._asked_s >= 0
                    self._asked_s = now_s
                    self.act(STATUS)
                heard += self._port.read(max(1, self._port.in_waiting))
                before_s, looked_s = looked_s, time.monotonic()
                if looked_s - before_s > self._stood_still_s:
                    self.went_on_s = looked_s
                *lines, heard = heard.split(b"\n")
                heard = heard[-LONGEST_LINE:]  # noise without line ends must not accumulate
                for line in lines:
                    self._take(parse(line), time.monotonic())
        except (*LINK_ERRORS, DeviceUnavailableError) as error:
            self._die(str(error))

    def _take(self, message: Message | None, now_s: float) -> None:
        match message:
            case Status():
                asked_s, self._asked_s = self._asked_s, -1.0
                doubtful, self._doubtful = self._doubtful, False
                if asked_s >= 0 and not doubtful:  # otherwise nobody knows how old it is
                    self._receive(message, asked_s)
            case Ok() | Refused():
                self._answer(message)
            case Setting() | Feedback():
                with self._news:
                    if self._waiting:
                        self._waiting[0].said.append(message)
            case Alarm():
                self._receive(message, now_s)
            case Welcome():
                with self._news:
                    self.version = message.version
                    self._welcomes += 1
                    self._drop_waiting()
                self._asked_s = -1.0
                self._receive(message, now_s)
            case None:
                _LOG.debug("%s: a line that is none of GRBL's", self._where)

    def _drop_waiting(self) -> None:
        for sent in self._waiting:
            sent.dropped = True
        self._waiting.clear()
        self._news.notify_all()

    def _answer(self, answer: Ok | Refused) -> None:
        with self._news:
            if self._waiting:
                self._waiting.popleft().answer = answer
            self.answered_s = time.monotonic()
            self._news.notify_all()

    def _die(self, why: str) -> None:
        with self._news:
            self.death = self.death or why
            self._news.notify_all()
