"""Which of a controller's input registers somebody else uses, in words: RTDE lets one client write each."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable
from itertools import groupby

from drivers.errors import DeviceRefusedError, DeviceUnavailableError
from drivers.ur.link import RTDE_PORT

IN_USE = "already in use"  # in the vendor's exception
_HEADER = struct.Struct(">HB")
_HALF = 24
_WRITTEN = {"int": range(24), "double": range(24)}


def registers_refused(host: str, timeout_s: float, *, upper: bool) -> DeviceRefusedError:
    """The error for a controller that does not give its registers to the control script; asks it which."""
    first = _HALF if upper else 0
    names = [f"input_{kind}_register_{first + number}" for kind, numbers in _WRITTEN.items() for number in numbers]
    try:
        taken = [
            name for name, state in zip(names, _states(host, names, timeout_s), strict=True) if state == "IN_USE"
        ]
    except (OSError, ValueError):
        taken = []
    which = _in_words(taken) or f"some of the input registers {first} to {first + _HALF - 1}"
    other = (
        "remove `upper_registers` from rig.yaml"
        if upper
        else "set `upper_registers: true` in rig.yaml, which uses registers 24 to 47"
    )
    return DeviceRefusedError(
        f"the controller does not give its registers to the control script: in use are {which}",
        where=host,
        remedy="On the pendant switch off the fieldbus that reserves them (Installation, Fieldbus: EtherNet/IP, "
        f"PROFINET, MODBUS), and end other programs that control the arm; or {other}",
    )


def _states(host: str, names: list[str], timeout_s: float) -> list[str]:
    """The type of each register, or IN_USE or NOT_FOUND. Raises OSError, ValueError."""
    with socket.create_connection((host, RTDE_PORT), timeout=timeout_s) as connection:
        connection.sendall(_frame("V", struct.pack(">H", 2)) + _frame("I", ",".join(names).encode()))
        with connection.makefile("rb") as answers:
            while True:
                head = answers.read(_HEADER.size)
                if len(head) < _HEADER.size:
                    raise DeviceUnavailableError(
                        "the RTDE server closed the connection",
                        where=host,
                        remedy="Look whether the controller runs and nothing between blocks port 30004",
                    )
                size, kind = _HEADER.unpack(head)
                payload = answers.read(size - _HEADER.size)
                if kind == ord("I"):
                    return payload[1:].decode("ascii", "replace").split(",")


def _frame(kind: str, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), ord(kind)) + payload


def _in_words(names: Iterable[str]) -> str:
    """`input_int_register 0 to 23, input_double_register 0 to 23`."""
    found: list[str] = []
    for kind, of_kind in groupby(names, key=lambda name: name.rpartition("_")[0]):
        numbers = [int(name.rpartition("_")[2]) for name in of_kind]
        for _, run in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0]):
            span = [number for _, number in run]
            found.append(f"{kind} {span[0]}" + (f" to {span[-1]}" if len(span) > 1 else ""))
    return ", ".join(found)
