"""Connecting to a controller: probes with a timeout, and wrapped vendor exceptions."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Generator

from drivers.errors import DeviceUnavailableError
from drivers.ur.dashboard import PORT as DASHBOARD_PORT

RTDE_PORT, SCRIPT_PORT = 30004, 30003
VENDOR_ERRORS = (RuntimeError, ValueError, TypeError)


@contextlib.contextmanager
def vendor(where: str, doing: str) -> Generator[None]:
    """Translate the vendor library's exceptions into DeviceUnavailableError.

    Args:
        where: address of the controller, for the message.
        doing: the attempt in words, as in "reading the state".
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
