"""What a camera answers to an operation: response codes, and the reply that the sockets carry out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from simulators.faults import Fault
from simulators.ptpip.codec import Request

OK, GENERAL_ERROR, SESSION_NOT_OPEN, NOT_SUPPORTED = 0x2001, 0x2002, 0x2003, 0x2005
INVALID_STORAGE, INVALID_HANDLE, STORE_FULL, ACCESS_DENIED = 0x2008, 0x2009, 0x200C, 0x200F
STORE_NOT_AVAILABLE = 0x2013
DEVICE_BUSY, INVALID_VALUE, INVALID_PARAMETER = 0x2019, 0x201C, 0x201D
# What kinds of planned faults answer instead of the camera.
REJECTIONS = {
    "busy": DEVICE_BUSY,
    "disk_full": STORE_FULL,
    "reject": ACCESS_DENIED,
    "error": GENERAL_ERROR,
    "ignore": OK,
}


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer: response code, its parameters, and a data phase; the socket applies `wire_fault` to it."""

    code: int = OK
    parameters: tuple[int, ...] = ()
    data: bytes | None = None
    wire_fault: Fault | None = None


class Responder(Protocol):
    """Carries out one session's operations."""

    def handle(self, request: Request, data: bytes) -> Reply:
        """Carry out one operation; `data` is the client's data phase, or empty."""
        ...
