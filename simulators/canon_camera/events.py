"""The records of a Canon EOS's events: size, code, payload. Each GetEvent is answered with what is new."""

from __future__ import annotations

import struct
from enum import IntEnum

from simulators.still_camera.body import CameraFile

END = struct.pack("<II", 8, 0)  # closes each answer
_ENUMERATION = 3
_BUTTON = 0x0001  # bit of what a record of changes tells
_PRESSED = 4  # the button's state once an EOS M has taken the release
_VERSION_OF_CHANGES, _SOME_VERSION = 0xD199, 0x0F  # libgphoto2 reads such records only after their version


class Event(IntEnum):
    """Codes of the records."""

    VALUE = 0xC189
    CHOICES = 0xC18A
    STATUS = 0xC18B
    CHANGES = 0xC1A5
    OBJECT_ADDED = 0xC1A7
    TRANSFER_WANTED = 0xC1A9


def record(code: int, payload: bytes) -> bytes:
    """Build a record; its size includes the two words of its head, and is a multiple of four."""
    padded = payload + b"\0" * (-len(payload) % 4)
    return struct.pack("<II", 8 + len(padded), code) + padded


def value(code: int, data: bytes) -> bytes:
    """A property has this value now."""
    return record(Event.VALUE, struct.pack("<I", code) + data)


def choices(code: int, count: int, data: bytes) -> bytes:
    """A property offers these values."""
    return record(Event.CHOICES, struct.pack("<III", code, _ENUMERATION, count) + data)


def status(*, busy: bool) -> bytes:
    """The camera has begun or ended an exposure."""
    return record(Event.STATUS, struct.pack("<I", int(busy)))


def pressed() -> bytes:
    """An EOS M has taken the release: without this record libgphoto2 takes it for refused."""
    changes = struct.pack("<IHHHH", 12, _BUTTON, 0, _PRESSED, 0)
    return value(_VERSION_OF_CHANGES, struct.pack("<I", _SOME_VERSION)) + record(Event.CHANGES, changes)


def object_added(handle: int, storage: int, parent: int, file: CameraFile) -> bytes:
    """There is a new file on the card."""
    head = struct.pack("<IIHHIIIIII", handle, storage, file.format, 0, 0, 0, len(file.data), 0, parent, handle)
    return record(Event.OBJECT_ADDED, head + file.name.encode("ascii") + b"\0")


def transfer_wanted(handle: int, file: CameraFile) -> bytes:
    """A file in the memory waits to be fetched."""
    head = struct.pack("<IHHIII", handle, file.format, 0, 0, len(file.data), 0)
    return record(Event.TRANSFER_WANTED, head + file.name.encode("ascii") + b"\0")
