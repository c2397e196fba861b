"""The properties of a simulated Canon EOS R5: codes, what it offers, and what they are now."""

from __future__ import annotations

import struct
import threading
from enum import IntEnum

from simulators.canon_camera import events
from simulators.canon_camera.formats import FORMATS, JPEG, JPEG_LARGE_NORMAL, RAW_FILE
from simulators.canon_camera.recorded import LENS, SERIAL, Formats, Number, Table
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.operations import NotWritableError, RefusedValueError


class Code(IntEnum):
    """Property codes."""

    APERTURE = 0xD101
    SHUTTER = 0xD102
    ISO = 0xD103
    EXPOSURE_COMPENSATION = 0xD104
    EXPOSURE_MODE = 0xD105
    DRIVE = 0xD106
    FOCUS = 0xD108
    WHITE_BALANCE = 0xD109
    BATTERY = 0xD111
    AVAILABLE_SHOTS = 0xD11B
    DESTINATION = 0xD11C
    STORAGE = 0xD11E
    IMAGE_FORMAT = 0xD120
    SERIAL = 0xD1AF
    VIEWFINDER_OUTPUT = 0xD1B0
    VIEWFINDER_MODE = 0xD1B1
    LENS = 0xD1D8


CARD, MEMORY = 2, 4  # destinations of files
MANUAL_FOCUS, ONE_SHOT = 3, 0
MANUAL_EXPOSURE, APERTURE_PRIORITY, BULB = 3, 2, 4
_BATTERY = ((87, 2), (62, 4), (37, 1), (12, 5))  # at least so many per cent: code
_NEARLY_EMPTY = 0
_PER_STOP = 8  # steps of the codes of exposure times; f-numbers have twice as many for a factor of two
_ONE_SECOND, _F_1 = 0x38, 0x08
_APERTURE_CODES = range(_F_1, 0x71)


def thirds(first: int, count: int) -> tuple[int, ...]:
    """Codes of values that lie a third of a stop apart: eight to a stop, of which a third has 3 and two thirds 5."""
    return tuple(first + 8 * (i // 3) + (0, 3, 5)[i % 3] for i in range(count))


_APERTURES = (2.8, 3.2, 3.5, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9, 10, 11, 13, 14, 16, 18, 20, 22)
_SECONDS = (30, 25, 20, 15, 13, 10, 8, 6, 5, 4, 3.2, 2.5, 2, 1.6, 1.3, 1, 0.8, 0.6, 0.5, 0.4, 0.3)
_FRACTIONS = (
    *(4, 5, 6, 8, 10, 13, 15, 20, 25, 30, 40, 50, 60, 80, 100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000),
    *(1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400, 8000),
)
_ISOS = (
    *(100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400),
    *(8000, 10000, 12800),
)
APERTURE_F = dict(zip(thirds(0x20, len(_APERTURES)), _APERTURES, strict=True))
ISO = dict(zip(thirds(0x48, len(_ISOS)), _ISOS, strict=True))
SHUTTER = dict(
    zip(
        thirds(0x10, len(_SECONDS) + len(_FRACTIONS)),
        [(round(10 * s), 10) for s in _SECONDS] + [(1, n) for n in _FRACTIONS],
        strict=True,
    )
)


# From +3 to -3 by thirds of a stop, in signed bytes; with the dial on M they change no picture.
_ABOVE_ZERO = thirds(0, 10)[:0:-1]
COMPENSATIONS = (*_ABOVE_ZERO, 0, *((-code) & 0xFF for code in reversed(_ABOVE_ZERO)))


def eos_r5() -> Table:
    """After power-on, with the dial on M: f/8, 1/60 s, ISO 400, daylight, files to the card."""
    entries: dict[int, Number | Formats | str] = {
        Code.APERTURE: Number(0x38, tuple(APERTURE_F)),
        Code.SHUTTER: Number(0x68, tuple(SHUTTER)),
        Code.ISO: Number(0x58, (0, *ISO)),
        Code.EXPOSURE_COMPENSATION: Number(0, COMPENSATIONS),
        Code.EXPOSURE_MODE: Number(MANUAL_EXPOSURE, writable=False),
        Code.DRIVE: Number(0, (0, 0x12, 0x04, 0x05, 0x10, 0x11)),
        Code.FOCUS: Number(MANUAL_FOCUS, (0, 1), writable=False),
        Code.WHITE_BALANCE: Number(1, (0, 23, 1, 8, 2, 3, 4, 5, 6, 9)),
        Code.BATTERY: Number(2, writable=False),
        Code.AVAILABLE_SHOTS: Number(0, writable=False),
        Code.DESTINATION: Number(CARD, (CARD, MEMORY)),
        Code.STORAGE: Number(0x00010001, writable=False),
        Code.VIEWFINDER_OUTPUT: Number(1, (0, 1, 2, 3)),
        Code.VIEWFINDER_MODE: Number(1, (0, 1)),
        Code.IMAGE_FORMAT: Formats(),
        Code.SERIAL: SERIAL,
        Code.LENS: LENS,
    }
    return Table(entries)


class Properties:
    """All properties and the event records that tell of them; used by several threads."""

    def __init__(self, table: Table) -> None:
        self._entries = dict(table.entries)
        self._unstated = eos_r5().entries  # of a body that does not state what an exposure needs
        self._lock = threading.Lock()
        self._news = bytearray()

    @property
    def codes(self) -> tuple[int, ...]:
        """The codes of all properties, in the body's order."""
        return tuple(self._entries)

    def announce(self, record: bytes) -> None:
        """Add a record to the next answer to GetEvent."""
        with self._lock:
            self._news += record

    def news(self) -> bytes:
        """All records since the last call, with the closing one."""
        with self._lock:
            said, self._news = bytes(self._news), bytearray()
        return said + events.END

    def announce_all(self) -> None:
        """Tell values and choices of everything, as at the beginning of remote control."""
        with self._lock:
            for code, entry in self._entries.items():
                self._news += self._value_of(code)
                if isinstance(entry, str) or not entry.choices:
                    continue
                if isinstance(entry, Number):
                    packed = struct.pack(f"<{len(entry.choices)}I", *entry.choices)
                else:
                    packed = b"".join(choice.encode() for choice in entry.choices)
                self._news += events.choices(code, len(entry.choices), packed)

    def _value_of(self, code: int) -> bytes:
        entry = self._entries[code]
        if isinstance(entry, str):
            return events.value(code, entry.encode("ascii", "replace") + b"\0")
        if isinstance(entry, Formats):
            return events.value(code, entry.value.encode())
        return events.value(code, struct.pack("<I", entry.value))

    def tell(self, number: int) -> None:
        """Tell the value of one property again. Raises NotWritableError if there is none."""
        if number not in self._entries:
            raise NotWritableError(f"{number:04X}")
        with self._lock:
            self._news += self._value_of(number)

    def set_from_client(self, data: bytes) -> None:
        """Set a value: size, code, value. Raises NotWritableError or RefusedValueError."""
        if len(data) < 12 or struct.unpack_from("<I", data)[0] != len(data):
            raise RefusedValueError(f"{len(data)} bytes are not a value")
        code = int(struct.unpack_from("<I", data, 4)[0])
        entry = self._entries.get(code)
        if isinstance(entry, Formats) and entry.writable:
            chosen = next((choice for choice in entry.choices if choice.encode() == data[8:]), None)
            if chosen is None:
                raise RefusedValueError("no such image format")
            entry.value = chosen
        else:
            self._accept(code, int(struct.unpack_from("<I", data, 8)[0]))
        self.tell(code)

    def _accept(self, code: int, value: int) -> None:
        entry = self._entries.get(code)
        if not isinstance(entry, Number) or not entry.writable:
            raise NotWritableError(f"{code:04X}")
        if entry.choices and value not in entry.choices:
            raise RefusedValueError(f"{code:04X} does not offer {value}")
        if code in (Code.APERTURE, Code.SHUTTER) and self.value(Code.EXPOSURE_MODE) != MANUAL_EXPOSURE:
            raise NotWritableError(f"{code:04X}: the mode dial is not on M")
        entry.value = value

    def put(self, code: Code, value: int) -> None:
        """Change a value from inside the camera, and announce it if this body states it."""
        with self._lock:
            entry = self._entries.get(code)
            if isinstance(entry, Number):
                entry.value = value
                self._news += self._value_of(code)

    def offer(self, code: Code, choices: tuple[int, ...]) -> None:
        """Offer only these values from now on, and take the first of them."""
        entry = self._entries.get(code)
        if isinstance(entry, Number):
            entry.choices = choices
        self.put(code, choices[0])

    def charge(self, percent: int) -> None:
        """Set the charge of the battery, of which the camera only tells quarters."""
        self.put(Code.BATTERY, next((code for least, code in _BATTERY if percent >= least), _NEARLY_EMPTY))

    def value(self, code: Code) -> int:
        """The current number; the simulated EOS R5's if this body does not state it."""
        with self._lock:
            entry = self._entries.get(code, self._unstated[code])
        assert isinstance(entry, Number)
        return entry.value

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        aperture, shutter, iso = (self.value(code) for code in (Code.APERTURE, Code.SHUTTER, Code.ISO))
        fraction = SHUTTER.get(shutter) or _fraction(2.0 ** ((_ONE_SECOND - shutter) / _PER_STOP))
        formats = self._entries.get(Code.IMAGE_FORMAT)
        kinds = formats.value.parts if isinstance(formats, Formats) else FORMATS[0].parts
        jpeg = next((part for part in kinds if part[0] == JPEG), None)
        stated = aperture in _APERTURE_CODES  # otherwise the body chooses it, or there is no lens that states one
        f_number = 2.0 ** ((aperture - _F_1) / (2 * _PER_STOP)) if stated else 8.0
        return ExposureSettings(
            aperture_f=APERTURE_F.get(aperture, f_number),
            exposure_s=fraction[0] / fraction[1],
            exposure_fraction=fraction,
            iso=ISO.get(iso, 400),
            jpeg=jpeg is not None,
            raw=any(part[0] == RAW_FILE for part in kinds),
            jpeg_level=3 if jpeg == JPEG_LARGE_NORMAL else 1,
            on_card=self.value(Code.DESTINATION) != MEMORY,
            states_aperture=stated or self.value(Code.EXPOSURE_MODE) not in (MANUAL_EXPOSURE, BULB),
        )


def _fraction(exposure_s: float) -> tuple[int, int]:
    """A time as a body writes it: 1/n, or tenths of a second."""
    within_s = min(max(exposure_s, 1 / 32000), 30.0)
    return (1, round(1 / within_s)) if within_s < 1 / 4 else (round(10 * within_s), 10)
