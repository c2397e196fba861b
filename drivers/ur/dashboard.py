"""The dashboard server of a controller: what it states about itself, and ending the program that runs there.

Each question has a connection of its own. A controller that was in local control when a client connected refuses
that client's commands until it reconnects, even after the pendant was switched to Remote; and an answer that comes
too late must not be taken for the answer to the next question.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import DeviceFaultError, DeviceRefusedError, DeviceUnavailableError
from drivers.interfaces import Exchange

PORT = 29999
#: What a dashboard can be asked without any effect.
QUESTIONS = (
    "PolyscopeVersion",
    "version",
    "get robot model",
    "get serial number",
    "robotmode",
    "safetymode",
    "safetystatus",
    "is in remote control",
    "get operational mode",
    "running",
    "programState",
    "get loaded program",
)
MINIMUM_VERSION = {3: (3, 15), 5: (5, 10)}  # the first with get_inverse_kin_has_solution()
_SWITCH = "Switch the pendant from Local to Remote, then try again"
_LONGEST_SERIAL = 20
_LONGEST_MODEL = 30  # such as UR8 Long
_LONGEST_LINE = 1000  # limit for answers, which are less than a tenth as long
_REMEDY = "Check that this address is that of a Universal Robots controller, then restart it"
_E_SERIES = ("UR3", "UR5", "UR10", "UR16")  # whose letter the dashboard leaves out; larger arms have none
_PATIENCE = 2  # questions without an answer after which no more are asked
_SHOWN = 120  # characters of an unexpected answer in messages


@dataclass(frozen=True, slots=True)
class ControllerFacts:
    """Holds what the dashboard reports about a controller."""

    model: str
    serial: str
    software: str
    version: tuple[int, int]


class Dashboard:
    """Asks one controller's dashboard server; every answer must come within `timeout_s`."""

    def __init__(self, host: str, timeout_s: float) -> None:
        self._host, self._timeout_s = host, timeout_s
        self._local = True

    def facts(self) -> ControllerFacts:
        """Read the model, serial number and software version.

        Raises DeviceFaultError if the software is too old or an answer makes no sense, DeviceUnavailableError if the
        dashboard fails.
        """
        self._local = True  # until it says that it is not
        software, serial, model = self._ask("PolyscopeVersion", "get serial number", "get robot model")
        match = re.search(r"([0-9]{1,3})\.([0-9]{1,3})[0-9.]{0,20}", software)
        if match is None:
            raise self._nonsense(f"the controller reports no version: {software[:_SHOWN]!r}")
        version = (int(match.group(1)), int(match.group(2)))
        minimum = MINIMUM_VERSION.get(version[0], (0, 0))
        if version < minimum:
            raise DeviceFaultError(
                f"Polyscope {version[0]}.{version[1]} cannot say whether a pose is reachable",
                where=self._host,
                remedy=f"Update the controller to {minimum[0]}.{minimum[1]} or later",
            )
        if not (serial.isascii() and serial.isdigit() and len(serial) <= _LONGEST_SERIAL):
            raise self._nonsense(f"the controller reports no serial number: {serial[:_SHOWN]!r}")
        if not re.match(r"UR ?[0-9]", model) or len(model) > _LONGEST_MODEL:
            raise self._nonsense(f"the controller reports no model of a robot: {model[:_SHOWN]!r}")
        letter = "e" if version[0] >= 5 and model in _E_SERIES else ""
        return ControllerFacts(f"{model}{letter}", serial, match.group(0), version)

    def ask_all(self) -> tuple[tuple[Exchange, ...], tuple[str, ...]]:
        """The answers to all questions that change nothing, and why some got none; a dead server is not asked on."""
        exchanges: list[Exchange] = []
        silent: list[str] = []
        for question in QUESTIONS:
            try:
                exchanges.append(Exchange(question=question, answer=self._ask(question)[0]))
            except DeviceUnavailableError as error:
                silent.append(error.what)
                if len(silent) == _PATIENCE:
                    break
        return tuple(exchanges), tuple(silent)

    def obstacle(self, version: tuple[int, int], *, running: bool) -> DeviceRefusedError | None:
        """Why the controller starts no program for a client: it is in local control. None if it is not.

        It is asked only if no program runs, since one that runs was let start, and as long as it was local. CB3 has
        no such mode. Raises DeviceUnavailableError if the dashboard fails.
        """
        if version[0] < 5:
            return None
        if self._local or not running:
            self._local = self._ask("is in remote control")[0].lower() == "false"
        if not self._local:
            return None
        return DeviceRefusedError("the controller is in local control", where=self._host, remedy=_SWITCH)

    def end_program(self, running: Callable[[], bool]) -> None:
        """End the program that runs at the controller; a refusal counts only if one is `running`.

        An earlier client's script in another register range would block the constructor of the vendor's control
        interface for minutes. Raises DeviceRefusedError, DeviceUnavailableError.
        """
        try:
            self.stop()
        except DeviceRefusedError:
            if running():
                raise

    def stop(self) -> None:
        """End the program that runs at the controller.

        Raises DeviceRefusedError in the controller's words, DeviceUnavailableError if the dashboard fails.
        """
        answer = self._ask("stop")[0]
        if answer.lower().startswith("stopped"):
            return
        remedy = "End the program on the pendant, then try again"
        if "remote control" in answer.lower():
            remedy = _SWITCH
        raise DeviceRefusedError(
            f"the controller does not end its program: {answer[:_SHOWN]!r}", where=self._host, remedy=remedy
        )

    def _nonsense(self, what: str) -> DeviceFaultError:
        return DeviceFaultError(what, where=self._host, remedy=_REMEDY)

    def _ask(self, *questions: str) -> list[str]:
        """The answers to these lines, each on one line."""
        answers: list[str] = []
        question = "its welcome"
        try:
            with (
                socket.create_connection((self._host, PORT), timeout=self._timeout_s) as connection,
                connection.makefile("rw", encoding="utf-8", errors="replace", newline="\n") as lines,
            ):
                lines.readline(_LONGEST_LINE)
                for question in questions:
                    lines.write(f"{question}\n")
                    lines.flush()
                    answer = lines.readline(_LONGEST_LINE)
                    if not answer:
                        raise ConnectionAbortedError("the connection was closed")
                    answers.append(answer.strip())
        except TimeoutError as error:
            raise DeviceUnavailableError(
                f"the dashboard server did not answer `{question}` within {self._timeout_s:g} s",
                where=self._host,
                remedy="Look whether the pendant shows a message; restart the controller if it happens again",
            ) from error
        except OSError as error:
            raise DeviceUnavailableError(
                f"the dashboard server failed at `{question}`: {error.strerror or error}",
                where=self._host,
                remedy=_REMEDY,
            ) from error
        return answers
