"""The connection to the Sunrise application: requests with their answers, the stream, and the ends of motions."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    LeaveNeededError,
    SafetyStopError,
    UnreachablePoseError,
)
from drivers.kuka.wire import LONGEST_LINE, Hello, Line, State, WireError, hello_of, parse, state_of, whole

_RECONNECT = "Check the cable, and on the smartPAD that the application OrthocaptureServer runs; then reconnect"
_ERRORS: dict[str, tuple[type[DeviceError], str]] = {
    "locked": (LeaveNeededError, "Look whether anybody is in reach; the arm moves after a person has confirmed"),
    "safety": (SafetyStopError, "A person must find and clear the cause on the smartPAD; then try again"),
    "limits": (UnreachablePoseError, "Choose another viewpoint or move the station"),
    "moving": (DeviceBusyError, "Wait until the motion has ended"),
    "load": (DeviceRefusedError, "Enter the mass of camera, lens and mount in the rig file"),
    "not_ready": (DeviceRefusedError, "See the smartPAD: the arm must be mastered, and ready to move"),
    "taken": (DeviceUnavailableError, "End the other program that is connected to the arm"),
    "failed": (DeviceFaultError, "See the log of the application on the smartPAD"),
}

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class MotionEnd:
    """How a motion ended: `code` is empty if it arrived."""

    code: str
    what: str
    at_s: float  # host time.monotonic() when that was heard


class Link:
    """One connection.

    Args:
        address: host and port of the application.
        timeout_s: longest wait for the connection and the greeting.
        on_state: called for each line of the stream from the reading thread, with the host time.monotonic().

    Raises:
        DeviceUnavailableError, DeviceFaultError: nothing listens there, or it speaks another protocol.
    """

    def __init__(self, address: tuple[str, int], timeout_s: float, on_state: Callable[[State, float], None]) -> None:
        self._where = f"{address[0]}:{address[1]}"
        self._on_state = on_state
        self._sending = threading.Lock()
        self._news = threading.Condition()
        self._answers: dict[int, Line] = {}
        self._ended: dict[int, MotionEnd] = {}
        self._sequence = 0
        self.death = ""  # why the connection ended
        try:
            self._socket = socket.create_connection(address, timeout=timeout_s)
        except OSError as error:
            what = f"the application cannot be reached: {error.strerror or error}"
            raise DeviceUnavailableError(what, where=self._where, remedy=_RECONNECT) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._lines = self._socket.makefile("rb")
        try:
            self.hello = self._greet()
        except DeviceError:
            self._lines.close()
            self._socket.close()
            raise
        self._socket.settimeout(None)
        threading.Thread(target=self._read, name="kuka link", daemon=True).start()

    def _greet(self) -> Hello:
        try:
            raw = self._lines.readline(LONGEST_LINE)
        except OSError as error:
            what = "the application did not greet in time"
            raise DeviceUnavailableError(what, where=self._where, remedy=_RECONNECT) from error
        if not raw:
            raise DeviceUnavailableError(
                "the application closed the connection", where=self._where, remedy=_RECONNECT
            )
        try:
            line = parse(raw)
            if line["is"] == "err":
                raise self.error(str(line.get("code")), str(line.get("what")))
            return hello_of(line)
        except WireError as error:
            remedy = "Install the application of this version of orthocapture (docs/howto/kuka.md)"
            raise DeviceFaultError(str(error), where=self._where, remedy=remedy) from error

    @property
    def local_host(self) -> str:
        """Address of this machine in the network of the controller."""
        return str(self._socket.getsockname()[0])

    def beat(self) -> None:
        """Send a sign of life; a dead connection is noticed elsewhere."""
        try:
            self._send({"do": "beat"})
        except OSError as error:
            _LOG.debug("beat: %s", error)

    def request(self, do: str, timeout_s: float, **fields: object) -> Line:
        """Send a request and return its ACK.

        Raises:
            DeviceError: what the controller answered instead; DeviceTimeoutError, DeviceUnavailableError: nothing.
        """
        with self._news:
            self._sequence += 1
            sequence = self._sequence
        try:
            self._send({"seq": sequence, "do": do, **fields})
        except OSError as error:
            raise self._lost() from error
        with self._news:
            self._news.wait_for(lambda: sequence in self._answers or bool(self.death), timeout_s)
            answer = self._answers.pop(sequence, None)
        if answer is None:
            if self.death:
                raise self._lost()
            what = f"the application did not answer {do!r} within {timeout_s:g} s"
            raise DeviceTimeoutError(what, where=self._where, remedy=_RECONNECT)
        if answer["is"] == "err":
            raise self.error(str(answer.get("code")), str(answer.get("what")))
        return answer

    def ended(self, motion: int) -> MotionEnd | None:
        """How a motion ended; None while it is under way."""
        with self._news:
            return self._ended.get(motion)

    def error(self, code: str, what: str) -> DeviceError:
        """The error of the tree for a code of the wire."""
        kind, remedy = _ERRORS.get(code, (DeviceRefusedError, "See the log of the application on the smartPAD"))
        return kind(what, where=self._where, remedy=remedy)

    def close(self) -> None:
        """Close the connection."""
        self._die("it was closed")
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError as error:
            _LOG.debug("%s: %s", self._where, error)
        self._socket.close()

    def _send(self, line: dict[str, object]) -> None:
        raw = json.dumps(line, separators=(",", ":")).encode() + b"\n"
        with self._sending:
            self._socket.sendall(raw)

    def _lost(self) -> DeviceUnavailableError:
        what = f"the connection is lost: {self.death or 'it broke while sending'}"
        return DeviceUnavailableError(what, where=self._where, remedy=_RECONNECT)

    def _read(self) -> None:
        try:
            while raw := self._lines.readline(LONGEST_LINE):
                self._take(parse(raw), time.monotonic())
            self._die("the application ended it")
        except (OSError, ValueError) as error:  # WireError is a ValueError; so is a read from a closed file
            self._die(str(error))
        finally:
            self._lines.close()

    def _take(self, line: Line, now_s: float) -> None:
        if line["is"] == "state":
            self._on_state(state_of(line), now_s)
            return
        with self._news:
            if line.get("seq") is not None:
                self._answers[whole(line, "seq")] = line
            elif line.get("motion") is not None:
                code, what = (str(line.get("code")), str(line.get("what"))) if line["is"] == "err" else ("", "")
                self._ended[whole(line, "motion")] = MotionEnd(code, what, now_s)
            else:
                _LOG.warning("%s: %s", self._where, line)
            self._news.notify_all()

    def _die(self, why: str) -> None:
        with self._news:
            self.death = self.death or why
            self._news.notify_all()
