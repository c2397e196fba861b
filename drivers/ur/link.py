"""Connecting to a controller: probes with a timeout, facts from its dashboard, and wrapped vendor exceptions."""

from __future__ import annotations

import contextlib
import re
import socket
import struct
from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.errors import DeviceFaultError, DeviceUnavailableError

if TYPE_CHECKING:
    from drivers.ur import vendor as library

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
VENDOR_ERRORS = (RuntimeError, ValueError, TypeError)
_LONGEST_SERIAL = 20
_LONGEST_LINE = 1000  # limit for dashboard answers, which are less than a tenth as long
_REMEDY = "Check that this address is that of a Universal Robots controller, then restart it"
_E_SERIES = ("UR3", "UR5", "UR10", "UR16")  # whose letter the dashboard leaves out; larger arms have none
MINIMUM_VERSION = {3: (3, 15), 5: (5, 10)}  # the first with get_inverse_kin_has_solution()


@dataclass(frozen=True, slots=True)
class ControllerFacts:
    """What the dashboard reports about a controller."""

    model: str
    serial: str
    software: str
    version: tuple[int, int]
    remote_control: bool


@contextlib.contextmanager
def vendor(where: str, doing: str) -> Generator[None]:
    """Translate the vendor library's exceptions into DeviceUnavailableError.

    Args:
        where: address of the controller, for the message.
        doing: what is being attempted, as in "reading the state".
    """
    try:
        yield
    except VENDOR_ERRORS as error:
        raise DeviceUnavailableError(
            f"{doing} failed: {error}", where=where, remedy="Check the controller and its network, then reconnect"
        ) from error


def probe(host: str, timeout_s: float) -> None:
    """Check that all three servers answer, because the vendor's constructors wait for ever on a silent one.

    Raises DeviceUnavailableError, which names the port that refuses the connection or does not answer.
    """
    _ask(host, RTDE_PORT, struct.pack(">HBH", 5, ord("V"), 2), timeout_s, "RTDE")
    _ask(host, DASHBOARD_PORT, b"", timeout_s, "dashboard")
    _ask(host, SCRIPT_PORT, None, timeout_s, "script")


def _ask(host: str, port: int, question: bytes | None, timeout_s: float, name: str) -> None:
    where = f"{host}:{port}"
    try:
        with socket.create_connection((host, port), timeout=timeout_s) as connection:
            if question is None:
                return
            connection.sendall(question)
            if not connection.recv(64):
                raise DeviceUnavailableError(
                    f"the {name} server closed the connection", where=where, remedy="Restart the controller"
                )
    except TimeoutError:
        remedy = "Restart the controller; check that no firewall blocks the answer"
        raise DeviceUnavailableError(
            f"the {name} server did not answer within {timeout_s:g} s", where=where, remedy=remedy
        ) from None
    except OSError as error:
        remedy = "Check that the controller is on, its address is right, and the service is enabled on the pendant"
        raise DeviceUnavailableError(
            f"the {name} server cannot be reached: {error.strerror or error}", where=where, remedy=remedy
        ) from error


def connect_dashboard(host: str) -> library.Dashboard:
    """Return a connected dashboard client. Raises DeviceUnavailableError."""
    # Imported here, so that the rest of this module works without the vendor's library.
    from drivers.ur import vendor as library  # noqa: PLC0415

    client = library.dashboard(host)
    with vendor(host, "connecting to the dashboard"):
        client.connect(2000)
    return client


def read_facts(dashboard: library.Dashboard, host: str, timeout_s: float) -> ControllerFacts:
    """Read the model, serial number, software version and control mode.

    Raises DeviceFaultError if the software is too old or an answer makes no sense, DeviceUnavailableError if the
    dashboard fails.
    """
    with vendor(host, "reading the version"):
        software = dashboard.polyscopeVersion()
    match = re.search(r"([0-9]{1,3})\.([0-9]{1,3})", software)
    if match is None:
        raise DeviceFaultError(f"the controller reports no version: {software!r}", where=host, remedy=_REMEDY)
    version = (int(match.group(1)), int(match.group(2)))
    minimum = MINIMUM_VERSION.get(version[0], (0, 0))
    if version < minimum:
        raise DeviceFaultError(
            f"Polyscope {version[0]}.{version[1]} cannot say whether a pose is reachable",
            where=host,
            remedy=f"Update the controller to {minimum[0]}.{minimum[1]} or later",
        )
    # The vendor's client refuses to ask a CB3 these two questions, although the CB3 answers them.
    serial, model = _questions(host, "get serial number", "get robot model", timeout_s=timeout_s)
    if not (serial.isascii() and serial.isdigit() and len(serial) <= _LONGEST_SERIAL):
        raise DeviceFaultError(f"the controller reports no serial number: {serial!r}", where=host, remedy=_REMEDY)
    remote = True
    if version[0] >= 5:  # CB3 has no local mode
        with vendor(host, "asking for remote control"):
            remote = dashboard.isInRemoteControl()
    letter = "e" if version[0] >= 5 and model in _E_SERIES else ""
    return ControllerFacts(f"{model}{letter}", serial, software, version, remote)


def _questions(host: str, *questions: str, timeout_s: float) -> list[str]:
    answers: list[str] = []
    try:
        with (
            socket.create_connection((host, DASHBOARD_PORT), timeout=timeout_s) as connection,
            connection.makefile("rw", encoding="utf-8", errors="replace", newline="\n") as lines,
        ):
            lines.readline(_LONGEST_LINE)  # welcome
            for question in questions:
                lines.write(f"{question}\n")
                lines.flush()
                answers.append(lines.readline(_LONGEST_LINE).strip())
    except OSError as error:
        raise DeviceUnavailableError(f"the dashboard server failed: {error}", where=host, remedy=_REMEDY) from error
    return answers
