"""What a recorded Canon EOS stated: the table that the simulated one serves instead of its own.

A recording names each property by its EOS code, with the numbers that libgphoto2 read from the body's events. They
go back into events in the same way: numbers as four bytes, image formats as structures, texts with a closing zero.

`recordings` holds what is public of real bodies, one file each, with its source; bench/cameras/canon_listings.py
wrote them from logs of events, or from listings of settings in words.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from simulators.canon_camera.formats import CODES, FORMATS, ImageFormat, of_number
from simulators.recordings import recorded_device
from simulators.serve import SimulatorError

MODEL, FIRMWARE, LENS, SERIAL = "Canon EOS R5", "3-1.8.2", "RF24-70mm F2.8 L IS USM", "012025000017"
_MAKER = "Canon"
_FOLDER = Path(str(resources.files("simulators.canon_camera"))) / "recordings"
_EVENTS = range(0xD001, 0xD200)  # codes of which a body tells in events
_STRUCTURES = {*range(0xD180, 0xD193), 0xD1A0, 0xD1D3}  # custom functions and the state of the focus points
_SERIAL, _LENS = 0xD1AF, 0xD1D8


@dataclass(slots=True)
class Number:
    """A property that is a number of four bytes, what it offers, and whether a client may set it."""

    value: int
    choices: tuple[int, ...] = ()
    writable: bool = True


@dataclass(slots=True)
class Formats:
    """A property that is an image format."""

    value: ImageFormat = FORMATS[0]
    choices: tuple[ImageFormat, ...] = FORMATS
    writable: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """Holds the properties of a body and its identity."""

    entries: Mapping[int, Number | Formats | str]  # in its order
    model: str = MODEL
    firmware: str = FIRMWARE
    controls: tuple[int, ...] = (0xD402, 0xD407)  # of its device info
    free_bytes: int | None = None
    not_served: tuple[str, ...] = field(default=())

    def text(self, code: int, otherwise: str) -> str:
        """A text that it states; another one if it does not."""
        entry = self.entries.get(code)
        return entry if isinstance(entry, str) and entry else otherwise

    @property
    def lens(self) -> str:
        """The name of the lens."""
        return self.text(_LENS, LENS)

    @property
    def serial(self) -> str:
        """The serial number."""
        return self.text(_SERIAL, SERIAL)


@cache
def names() -> tuple[str, ...]:
    """The recorded bodies."""
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.json")))


def recording_of(name: str) -> Path:
    """The file of a recorded body."""
    return _FOLDER / f"{name}.json"


def replayed_table(file: Path, name: str = "") -> Table:
    """The table of the body of this name in a recording, or of its first. Raises SimulatorError."""
    device = recorded_device(file, "gphoto", name)
    listing = device.listing
    if not listing["maker"].startswith(_MAKER):
        raise SimulatorError(f"{file.name} holds a body of {listing['maker']}: another simulator serves it")
    entries: dict[int, Number | Formats | str] = {}
    not_served: list[str] = []
    for stated in listing["properties"]:
        code, value = int(stated["code"], 16), stated["value"]
        label = stated["code"] if value == "" else f"{stated['code']} = {value}"
        if code not in _EVENTS:
            not_served.append(f"{label}: it is stated otherwise than in events")
        elif code in _STRUCTURES:
            not_served.append(f"{label}: of a structure that is not known")
        elif stated["form"] == "range":
            not_served.append(f"{label}: no event states a range")
        elif code in CODES and stated["type"] == "str":
            not_served.append(f"{label}: no number of an image format")
        else:
            entries[code] = _entry(code, stated)
    if not entries:
        raise SimulatorError(
            f"{file.name} holds no property of a Canon EOS in remote mode: there is nothing to serve"
        )
    if entries.get(_SERIAL) == "":
        entries[_SERIAL] = SERIAL  # without it, libgphoto2 would state another one
    controls = tuple(int(code, 16) for code in listing.get("controls", ()))
    free_bytes = device.report.get("free_bytes")
    return Table(entries, listing["model"], listing["firmware"], controls, free_bytes, tuple(not_served))


def _entry(code: int, stated: dict[str, Any]) -> Number | Formats | str:
    value, numbers, writable = stated["value"], stated.get("numbers", ()), stated["access"] != "ro"
    if isinstance(value, str):
        return value
    if code in CODES:
        return Formats(of_number(value), tuple(map(of_number, numbers)), writable)
    return Number(value & 0xFFFFFFFF, tuple(number & 0xFFFFFFFF for number in numbers), writable)
